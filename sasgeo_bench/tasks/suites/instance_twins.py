# SPDX-License-Identifier: Apache-2.0
"""Suite `instance-twins`: one hall against a row of houses with the same mask."""

from dataclasses import replace
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, SuiteCard, pair
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite, with_neighbours
from sasgeo_bench.tasks.twin import split_long
from sasgeo_bench.tasks.vectors import instances_of_mask

LEAST_AREA_M2: Final = 160.0


def _halls(scene: Scene) -> NDArray[np.float64]:
    features = scene.map.features
    chosen = features[(features["class"] == "building").to_numpy() & features["is_visible"].to_numpy()]
    shapes = chosen.geometry.to_numpy()
    large = shapes[shapely.area(shapes) >= LEAST_AREA_M2]
    return with_neighbours(shapely.get_coordinates(shapely.centroid(large)).reshape(-1, 2), within_m=70.0)


class InstanceTwins(TwinSuite):
    """Twins whose falsifier derives the vectors from the mask, which is the same at both places."""

    def draw(self, shot: Shot) -> Draft:
        """Give instances as perceived, as derived from the mask, or none."""
        draft = super().draw(shot)
        if shot.variant.role != "falsifier":
            return draft
        return replace(draft, vectors=instances_of_mask(draft.evidence))


SUITE: Final = InstanceTwins(
    card=SuiteCard(
        name="instance-twins",
        version=2,
        title="Instance twins (G3)",
        what="A twin, at most 800 m away, in which every hall is a row of houses of seven metres; the two masks are "
        "the same cell by cell.",
        separates="Instances of the perceived vectors from masks, which tie.",
        falsifier="Instances derived from the mask, which is the same at both places, must gain nothing.",
        strength_unit="1 with perceived instances",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.05,
    ),
    variants=pair("no vectors", "G3", "instances of the mask"),
    change_of=lambda scene, site, rng: (  # noqa: ARG005 - the same at every site
        lambda piece: split_long(piece, piece_m=7.0, least_area_m2=LEAST_AREA_M2)
    ),
    find=_halls,
    needs="no two buildings of at least 160 m2 near each other",
)
