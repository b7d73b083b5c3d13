# SPDX-License-Identifier: Apache-2.0
"""Yardsticks: matchers of objects that see the map's own objects of a place, each whole and apart, instead of patches.

What an `oracle_` finds more than the matcher it is named after is what perfect instances would be worth to it.
"""

import json
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import shapely

from sasgeo_baselines.learned import read_learned
from sasgeo_baselines.liu_object_graph import LiuObjectGraph
from sasgeo_baselines.road_2rit import Road2Rit
from sasgeo_baselines.spatial_graph_clique import SpatialGraphClique
from sasgeo_baselines.stfm_centroids import StfmCentroids
from sasgeo_baselines.triangle_rsim import TriangleRsim
from sasgeo_bench import Match, Matcher, MatcherCard, Pose, Query, Region, Training, inverse

if TYPE_CHECKING:
    import geopandas as gpd

COLUMNS = ["class", "level", "is_bridge", "geometry"]  # of the vectors of a query


def objects_at(region: Region, pose: Pose, size_m: tuple[float, float]) -> "gpd.GeoDataFrame":
    """Return what a map has drawn in a view of (width, height) metres at a pose, as vectors of a query.

    Objects are cut at the border of the view and have no errors; (right, up) from its middle, metres.
    """
    right_m, up_m = size_m[0] / 2, size_m[1] / 2
    corners_m = np.array([[-right_m, -up_m], [right_m, -up_m], [right_m, up_m], [-right_m, up_m]])
    outline = shapely.Polygon(pose.to_map(corners_m))
    features = region.features
    table = features.iloc[np.sort(features.sindex.query(outline, predicate="intersects"))]
    table = table[table["is_visible"].to_numpy()]
    cut = shapely.intersection(shapely.make_valid(table.geometry.to_numpy()), outline)
    table = table.set_geometry(shapely.transform(cut, inverse(pose).to_map)).set_crs(None, allow_override=True)
    parts = table.explode(ignore_index=True)[COLUMNS]
    return parts[parts.geometry.geom_type.isin(["LineString", "Polygon"])].reset_index(drop=True)


def poses_of(saved: dict[str, dict[str, float]]) -> dict[str, Pose]:
    """Return the learned poses by the id of their query."""
    return {query_id: Pose(**numbers) for query_id, numbers in saved.items()}


def oracle_card(card: MatcherCard) -> MatcherCard:
    """Return the card of the yardstick of a matcher of objects."""
    return replace(
        card,
        name=f"oracle_{card.name}",
        version="1",
        title=f"{card.title}, with perfect objects",
        ours=(
            f"`{card.name}`, whose view holds the objects that the map itself has drawn in it, whole and apart, in "
            "place of what was perceived; cells of areas are as perceived. Learning keeps the true poses of the "
            "queries that it is then asked; without them it answers as that matcher does"
        ),
        limits="Knows what no matcher can know; a yardstick, never ranked: a pipeline names it among its oracles",
    )


class OracleObjects:
    """A matcher of objects that gets the place of its view, and reads the map's objects there."""

    inner: ClassVar[type[Matcher]]
    card: MatcherCard

    def __init_subclass__(cls, *, inner: type[Matcher]) -> None:
        cls.inner, cls.card = inner, oracle_card(inner.card)

    def __init__(self) -> None:
        self._inner = self.inner()
        self._poses: dict[str, Pose] = {}

    def learn(self, training: Training) -> str:
        """Keep the true pose of each query whose place is on the map."""
        present = {query.query_id: truth.pose for query, truth in training.pairs if truth.pose is not None}
        return json.dumps({query_id: asdict(pose) for query_id, pose in sorted(present.items())})

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index the map as the matcher does."""
        self._region = region
        self._poses = {} if learned is None else read_learned(self.card.name, learned, poses_of)
        self._inner.prepare(region, None)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Answer by the objects of the map at the true pose, where it is known."""
        if query.query_id in self._poses:
            shown = objects_at(self._region, self._poses[query.query_id], query.evidence.size_m)
            query = replace(query, vectors=shown)
        return self._inner.match(query, top_k=top_k)


class OracleLiuObjectGraph(OracleObjects, inner=LiuObjectGraph):
    """`liu_object_graph` with perfect objects."""


class OracleRoad2Rit(OracleObjects, inner=Road2Rit):
    """`road_2rit` with perfect roads."""


class OracleSpatialGraphClique(OracleObjects, inner=SpatialGraphClique):
    """`spatial_graph_clique` with perfect objects."""


class OracleStfmCentroids(OracleObjects, inner=StfmCentroids):
    """`stfm_centroids` with perfect objects."""


class OracleTriangleRsim(OracleObjects, inner=TriangleRsim):
    """`triangle_rsim` with perfect buildings."""
