# SPDX-License-Identifier: Apache-2.0
"""Suite `no-priors`: neither place nor heading nor scale is known."""

from typing import Final

from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, SuiteCard, Variant
from sasgeo_bench.tasks.suites.vectors import site_vectors

SCALE_SIGMA: Final = 0.15
# The views, and so their scales, are the same as without priors: a sigma of 0.03 would be false.
GIVEN: Final = PriorGroup(radius_m=500.0, yaw="known", scale_sigma=SCALE_SIGMA)
LEAST_KM2: Final = 0.5


class NoPriorsSuite(Suite):
    """The same view twice: without any prior and, as falsifier, with priors."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a map so small that searching it needs no prior."""
        area_km2 = float(scene.map.known.sum()) * scene.map.grid.cell_size_m**2 / 1e6
        return None if area_km2 >= LEAST_KM2 else f"{area_km2:.2f} km2 mapped, at least {LEAST_KM2:g} are needed"

    def draw(self, shot: Shot) -> Draft:
        """Perceive layers and vectors; the variant determines the priors."""
        group = None if shot.variant.role == "stress" else GIVEN
        return Draft(evidence=shot.perceived(), vectors=site_vectors(shot), group=group)


SUITE: Final = NoPriorsSuite(
    card=SuiteCard(
        name="no-priors",
        version=1,
        title="No priors (G5)",
        what="Place and heading are unknown over the whole region, the scale to 15 %; perceived vectors are given.",
        separates="Invariant proposals of the graph from searches that enumerate headings and scales.",
        falsifier="With priors given the same views must show no gain of the graph's proposals.",
        strength_unit="1 where nothing is known",
        has_own_priors=True,
        group=PriorGroup(radius_m=None, yaw="unknown", scale_sigma=SCALE_SIGMA),
    ),
    variants=(
        Variant(role="control", kind="priors given"),
        Variant(role="stress", kind="G5", strength=1.0),
        Variant(role="control", kind="priors given", view_cells=384),
        Variant(role="stress", kind="G5", strength=1.0, view_cells=384),
        Variant(role="falsifier", kind="priors given again"),
    ),
)
