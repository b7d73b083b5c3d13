# SPDX-License-Identifier: Apache-2.0
"""Suite `growth`: many buildings stand that the map does not have."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, SuiteCard, Variant, controls, ladder
from sasgeo_bench.tasks.suites.twins import nodes_of, places_of

ERROR_FACTOR: Final = 2.0  # the detector across domains: in its own, new houses alone mislead no matcher
NEW_PER_OLD: Final = (0.5, 1.0, 2.0, 4.0)


class GrowthSuite(Suite):
    """Buildings appear near existing ones; nothing vanishes."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without buildings."""
        return None if len(self.anchors(scene)) else "no building to grow from"

    def anchors(self, scene: Scene) -> NDArray[np.float64]:
        """Return the buildings."""
        return places_of(nodes_of(scene, ("building", "building_cluster")))

    def draw(self, shot: Shot) -> Draft:
        """Add buildings, then perceive; a control sees the place as mapped."""
        if shot.variant.strength == 0:
            return Draft(evidence=shot.perceived(error_factor=ERROR_FACTOR), changed_share=0.0)
        clean = shot.clean()
        grown = growth(shot.variant.strength)(clean, shot.rng("growth"))
        seen = shot.perceived(grown, error_factor=ERROR_FACTOR)
        old, new = (int((item.layer("building") == PRESENT).sum()) for item in (clean, grown))
        return Draft.of_change(seen, clean, grown, new_per_old_area=(new - old) / old if old else 0.0)


def growth(new_per_old: float) -> Ageing:
    """Return ageing in which so many buildings appear for each existing one, and nothing else happens."""
    building = Rates(vanish_per_year=0.0, appear_per_year=float(np.log1p(new_per_old)))
    return Ageing(years=1.0, rates={"building": building}, place="-")


SUITE: Final = GrowthSuite(
    card=SuiteCard(
        name="growth",
        version=1,
        title="Growth (S3)",
        what="For each building on the map 0.5 to 4 others have appeared nearby, on free ground; all is seen with "
        "twice the detector's error.",
        separates="Matchers that weigh what is seen and not mapped by its class from those that punish it alike.",
        falsifier="Nothing has appeared: scores as in the control.",
        strength_unit="new buildings for each on the map",
        min_density=0.05,
    ),
    variants=(
        *controls(),
        *ladder("S3", NEW_PER_OLD, small=NEW_PER_OLD, large=(2.0,)),
        Variant(role="falsifier", kind="no growth"),
    ),
)
