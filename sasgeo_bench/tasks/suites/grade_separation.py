# SPDX-License-Identifier: Apache-2.0
"""Suite `grade-separation`: an overpass against a level junction of the same shape."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, SuiteCard, pair
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite, nodes_of, places_of
from sasgeo_bench.tasks.twin import ROADS, level_crossings


def _overpasses(scene: Scene) -> NDArray[np.float64]:
    nodes = nodes_of(scene, ["crossing"])
    is_road = nodes["class"].isin(ROADS).to_numpy()
    return places_of(nodes[is_road & (nodes["level_difference"].to_numpy() != 0)])


class GradeSeparation(TwinSuite):
    """Twins with the bridge layer unknown in every view, so that only the vectors show the difference."""

    def draw(self, shot: Shot) -> Draft:
        """Hide the bridge layer."""
        draft = super().draw(shot)
        return replace(draft, evidence=without(draft.evidence, "bridge"))


def without(evidence: Evidence, class_name: str) -> Evidence:
    """Make one class unknown everywhere."""
    cells = evidence.cells.copy()
    cells[evidence.classes.index(class_name)] = UNKNOWN
    return evidence.replace(cells)


SUITE: Final = GradeSeparation(
    card=SuiteCard(
        name="grade-separation",
        version=2,
        title="Grade separation (G4)",
        what="A twin, at most 800 m away, in which bridges lie on the ground, so that roads which pass over each other "
        "meet.",
        separates="Crossings without connection in the perceived vectors from rasters, in which both look alike.",
        falsifier="Bridges withheld: the vectors of both places show a level junction, and nothing separates them.",
        strength_unit="1 with perceived vectors",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.02,
    ),
    variants=pair("no vectors", "G4", "bridge withheld"),
    change_of=lambda scene, site, rng: level_crossings,  # noqa: ARG005 - the same at every site
    find=_overpasses,
    needs="no bridge that carries one road over another",
    falsifier_sees_change=True,
)
