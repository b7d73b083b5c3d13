# SPDX-License-Identifier: Apache-2.0
"""The graph of a view, from perceived vectors where there are some and from thinned masks elsewhere."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import cv2
import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from scipy.spatial import cKDTree

from sasgeo_bench.geometry.angles import bearing_deg, wrap_deg
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.network import LAYERS, ROAD, make_network
from sasgeo_bench.regions.shapes import delaunay_pairs
from sasgeo_bench.sasgeo.kinds import INDEX, KINDS, PATCHES, ROADS, Drawing
from sasgeo_bench.sasgeo.nodes import Bools, Floats, Ints, Nodes, arms_of, nodes_of, nothing, patches_of
from sasgeo_bench.sasgeo.skeleton import lines_of_mask
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.vectors import as_features, instances_of_mask, vector_table

MARGIN_M: Final = 8.0  # of what is known, where a thing may have slipped out of it
NEAR_M: Final = 80.0  # neighbours whose relative place is looked at
BRIDGED_M: Final = 7.0  # ends of a road that face each other so near are a detector's gap
LEAST_M2: Final = 12.0  # smaller patches are specks
_FACING_DEG: Final = 30.0
_MOSTLY: Final = 0.9  # of the cells around a place
_FAMILIES: Final = (ROADS, ("railway",), ("waterway",), ("building",))
_SIGHTS: Final = tuple(dict.fromkeys(kind.classes for kind in KINDS))
_SIGHT_OF: Final = np.array([_SIGHTS.index(kind.classes) for kind in KINDS])
_FREE: Final = (INDEX["dead_end"], INDEX["mask dead_end"])


@dataclass(frozen=True, kw_only=True)
class ObservedGraph:
    """What a view shows, in its own frame.

    Parameters
    ----------
    nodes : Nodes
        Places are (right, up) from the middle of the view, metres.
    is_cut : ndarray of bool, shape (N,)
        Whether a node lies so near to the border of what is known that a part of it may be missing.
    near : ndarray of int64, shape (P, 2)
        Neighbours: pairs of the Delaunay triangulation at most `NEAR_M` apart.
    asked : ndarray of bool, shape (K,)
        Kinds that the view was searched for: where nothing of a family is seen, that is left to the raster score.
    sight : ndarray of bool, shape (S, rows, cols)
        Where a view would show a node, for each set of classes that nodes are made of.
    cell_size_m : float
        Side of its cells.
    """

    nodes: Nodes
    is_cut: Bools
    near: Ints
    asked: Bools
    sight: Bools
    cell_size_m: float

    @classmethod
    def of(cls, query: Query) -> Self:
        """The graph of what a query shows."""
        return cls.make(query.evidence, query.vectors)

    @classmethod
    def make(cls, evidence: Evidence, vectors: gpd.GeoDataFrame | None = None) -> Self:
        """Derive the graph of a view.

        Each family of things (roads, railways, waterways, buildings) is taken from the vectors if they hold any of it,
        else from the masks; areas always from the masks.

        Parameters
        ----------
        evidence : Evidence
            The view.
        vectors : geopandas.GeoDataFrame, optional
            As `Query.vectors`.

        Examples
        --------
        >>> cells = np.zeros((1, 96, 96), dtype=np.uint8)
        >>> cells[0, 45:51] = cells[0, :48, 60:66] = 1
        >>> seen = ObservedGraph.make(Evidence(classes=("road_minor",), cells=cells, cell_size_m=1.0))
        >>> [(KINDS[kind].name, place.round().tolist()) for kind, place in zip(seen.nodes.kind, seen.nodes.places_m)]
        [('mask intersection', [14.0, 0.0])]
        """
        names = set() if vectors is None else set(vectors["class"])
        drawn = {name for family in _FAMILIES if names & set(family) for name in family}
        parts = [nothing()]
        if vectors is not None and drawn:
            parts.append(_from_vectors(vectors, evidence))
        parts.append(_from_mask(evidence, without=drawn))
        nodes = Nodes.joined(parts)
        sight = _sight(evidence)
        is_cut = ~_looked_up(sight, nodes.places_m, nodes.kind, evidence.cell_size_m)
        keep = ~(is_cut & np.isin(nodes.kind, _FREE))
        nodes, is_cut = nodes.taken(keep), is_cut[keep]
        is_cut |= _reaches_out(nodes, evidence)
        return cls(
            nodes=nodes,
            is_cut=is_cut,
            near=delaunay_pairs(nodes.places_m, NEAR_M),
            asked=_asked(evidence, names, drawn),
            sight=sight,
            cell_size_m=evidence.cell_size_m,
        )

    def shows(self, places_m: Floats, kind: Ints) -> Bools:
        """Whether the view would show a node of a kind at (right, up)."""
        return self.asked[kind] & _looked_up(self.sight, places_m, kind, self.cell_size_m)

    @cached_property
    def links(self) -> dict[int, set[int]]:
        """Nodes to which a way leads from each node."""
        return self.nodes.links()

    @property
    def source(self) -> list[Drawing]:
        """What drew each node."""
        return [KINDS[kind].drawing for kind in self.nodes.kind]

    def edges(self) -> pd.DataFrame:
        """Edges with `source`, `target`, `relation`, `distance_m` and `bearing_deg` (clockwise from up).

        The relation is an index into `graph.RELATIONS`, -1 for mere neighbours.
        """
        pairs = np.concatenate((self.nodes.pairs, self.near))
        along_m = self.nodes.places_m[pairs[:, 1]] - self.nodes.places_m[pairs[:, 0]]
        columns = {
            "source": pairs[:, 0],
            "target": pairs[:, 1],
            "relation": np.concatenate((self.nodes.relation, np.full(len(self.near), -1))),
            "distance_m": np.hypot(*along_m.T),
            "bearing_deg": bearing_deg(*along_m.T),
        }
        return pd.DataFrame(columns)


def _from_vectors(vectors: gpd.GeoDataFrame, evidence: Evidence) -> Nodes:
    features = as_features(bridged(vectors))
    nodes = nodes_of(build_graph(features), features, "vectors")
    # A building that the view cuts has another middle and another area than the map's.
    half_m = np.array(evidence.size_m) / 2 - 2.0
    is_whole = (np.abs(shapely.bounds(features.geometry.to_numpy())) < [*half_m, *half_m]).all(axis=1)
    is_house = nodes.kind == INDEX["building"]
    return nodes.taken(~is_house | is_whole[nodes.feature])


def _from_mask(evidence: Evidence, *, without: set[str]) -> Nodes:
    lines = lines_of_mask(evidence)
    ways = as_features(lines[~lines["class"].isin(without).to_numpy()])
    kept = [name for name in PATCHES if name in evidence.classes and name not in without]
    shapes = [instances_of_mask(evidence, name) for name in kept]
    rows = [
        (str(name), 0, False, shape)
        for table in shapes
        for name, shape in zip(table["class"], table.geometry, strict=True)
        if shape.area >= LEAST_M2
    ]
    return Nodes.joined([nodes_of(build_graph(ways), ways, "mask"), patches_of(as_features(vector_table(rows)))])


def bridged(vectors: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Vectors with the gaps of a detector closed: ends of two lines of a class that face each other within 7 m.

    Examples
    --------
    >>> halves = shapely.from_wkt(["LINESTRING (0 0, 47 0)", "LINESTRING (53 0, 99 0)"])
    >>> len(bridged(vector_table([("road_minor", 0, False, half) for half in halves])))
    3
    """
    features = as_features(vectors)
    network = make_network(features[features["class"].isin(list(LAYERS)).to_numpy()])
    free = np.flatnonzero(network.degree(ROAD) == 1)
    places_m = network.vertices[free]
    arm_deg = arms_of(features, places_m)[:, 0]
    if len(free) < 2:  # noqa: PLR2004 - a gap has two ends
        return vectors
    pairs = cKDTree(places_m).query_pairs(BRIDGED_M, output_type="ndarray")
    ahead_deg = bearing_deg(*(places_m[pairs[:, 1]] - places_m[pairs[:, 0]]).T)
    off_deg = np.abs(
        np.stack((wrap_deg(arm_deg[pairs[:, 0]] + 180 - ahead_deg), wrap_deg(arm_deg[pairs[:, 1]] - ahead_deg)))
    )
    pairs = pairs[(off_deg < _FACING_DEG).all(axis=0)]
    rows = list(zip(*(vectors[name] for name in ("class", "level", "is_bridge", "geometry")), strict=True))
    rows += [("road_minor", 0, False, shapely.LineString(places_m[pair])) for pair in pairs]
    return vector_table(rows)


def _asked(evidence: Evidence, names: set[str], drawn: set[str]) -> Bools:
    """Kinds that are looked for: those of which the vectors, or else the masks, hold a class."""
    present = {
        name for name, layer in zip(evidence.classes, evidence.cells, strict=True) if (layer == PRESENT).any()
    } - drawn
    shown = {"vectors": names, "mask": present}
    found = []
    for kind in KINDS:
        own = shown[kind.drawing]
        families = [set(ROADS) if name in ROADS else {name} for name in kind.classes]
        found.append(all(own & family for family in families))
    return np.array(found)


def _sight(evidence: Evidence) -> Bools:
    """Where nearly all cells around are known in every class of a set; a class that a view lacks is known nowhere."""
    sights = np.zeros((len(_SIGHTS), *evidence.shape), dtype=bool)
    size = 2 * max(1, round(MARGIN_M / evidence.cell_size_m)) + 1
    for into, classes in zip(sights, _SIGHTS, strict=True):
        layers = [evidence.layer(name) != UNKNOWN for name in classes if name in evidence.classes]
        if layers:
            known = np.all(layers, axis=0).astype(np.float32)
            into[:] = cv2.boxFilter(known, -1, (size, size), borderType=cv2.BORDER_CONSTANT) > _MOSTLY
    return sights


def _looked_up(sight: Bools, places_m: Floats, kind: Ints, cell_size_m: float) -> Bools:
    rows, cols = sight.shape[1:]
    view = Grid(
        epsg=0,
        west_m=-cols * cell_size_m / 2,
        north_m=rows * cell_size_m / 2,
        cell_size_m=cell_size_m,
        rows=rows,
        cols=cols,
    )
    row, col = view.to_cells(places_m).T
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    return np.asarray(inside & sight[_SIGHT_OF[kind], np.where(inside, row, 0), np.where(inside, col, 0)])


def _reaches_out(nodes: Nodes, evidence: Evidence) -> Bools:
    """Whether a patch is so large that it may go on beyond the view."""
    half_m = np.array(evidence.size_m) / 2 - 1.0
    return np.asarray((np.abs(nodes.places_m) + nodes.radius_m[:, None] > half_m).any(axis=1))
