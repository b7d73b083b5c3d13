# SPDX-License-Identifier: Apache-2.0
"""Suite `instance-twins`: one hall against a row of houses with the same mask."""

from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.tasks.suites.base import Draft, Scene, Seeds, Site, SuiteCard, Variant
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite
from sasgeo_bench.tasks.twin import Change, split_long
from sasgeo_bench.tasks.vectors import instances_of_mask

HOUSE_M: Final = 7.0
LEAST_AREA_M2: Final = 160.0
_NEAR_M: Final = 70.0
_LEAST_HALLS: Final = 2


def _halls(scene: Scene) -> NDArray[np.float64] | None:
    """Centres of buildings that could be a row of houses, where two or more lie near each other."""
    features = scene.map.features
    chosen = features[(features["class"] == "building").to_numpy() & features["is_visible"].to_numpy()]
    shapes = chosen.geometry.to_numpy()
    large = shapes[shapely.area(shapes) >= LEAST_AREA_M2]
    places = shapely.get_coordinates(shapely.centroid(large)).reshape(-1, 2)
    if len(places) == 0:
        return np.zeros((0, 2))
    tree = shapely.STRtree(shapely.points(places))
    hits = tree.query(shapely.points(places), predicate="dwithin", distance=_NEAR_M)[0]
    return np.asarray(places[np.bincount(hits, minlength=len(places)) >= _LEAST_HALLS])


def _change(scene: Scene, site: Site, rng: np.random.Generator) -> Change:
    del scene, site, rng
    return lambda piece: split_long(piece, piece_m=HOUSE_M, least_area_m2=LEAST_AREA_M2)


class InstanceTwins(TwinSuite):
    """As every twin suite; the falsifier's vectors are derived from the mask, which is the same at both places."""

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """Instances as perceived, as derived from the mask, or none."""
        draft = super().draw(scene, site, variant, seeds)
        if variant.role != "falsifier":
            return draft
        return Draft(evidence=draft.evidence, vectors=instances_of_mask(draft.evidence))


SUITE: Final = InstanceTwins(
    card=SuiteCard(
        name="instance-twins",
        version=1,
        title="Instance twins (G3)",
        what="A twin in which every hall is a row of houses of seven metres; the two masks are the same cell by cell.",
        separates="Instances of the perceived vectors from masks, which tie.",
        falsifier="Instances derived from the mask, which is the same at both places, must gain nothing.",
        strength_unit="1 with perceived instances",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no vectors"),
        Variant(role="stress", kind="G3", strength=1.0),
        Variant(role="falsifier", kind="instances of the mask"),
    ),
    change_of=_change,
    find=_halls,
    needs="no two buildings of at least 160 m2 near each other",
)
