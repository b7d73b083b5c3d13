# SPDX-License-Identifier: Apache-2.0
"""Graph of a view, from perceived vectors, or from centre lines of masks where there are none."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Self

import cv2
import numpy as np
import scipy
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import bearing_deg, wrap_deg
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence, cell_offsets_m
from sasgeo_bench.regions.graph import LAYERS, ROAD, build_graph, make_network
from sasgeo_bench.sasgeo.nodes import (
    INDEX,
    NODE_KINDS,
    PATCHES,
    ROADS,
    Bools,
    Floats,
    Ints,
    Nodes,
    arms_of,
    nodes_of,
    nothing,
    patches_of,
)
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.vectors import as_features, instances_of_mask, vector_table

if TYPE_CHECKING:
    import geopandas as gpd

# Classes thinned together, and the class of their lines: crossings do not depend on the class of a road.
SKELETON_LAYERS: Final = {"road_minor": ROADS} | {name: (name,) for name in LAYERS if name not in ROADS}
_FORK: Final = 3


def lines_of_mask(evidence: Evidence) -> "gpd.GeoDataFrame":
    """Return the centre lines of `SKELETON_LAYERS` in a view, as `Query.vectors`."""
    rows = []
    for name, classes in SKELETON_LAYERS.items():
        layers = [evidence.layer(one) == PRESENT for one in classes if one in evidence.classes]
        if layers and np.any(layers):
            rows += [(name, 0, False, line) for line in middle_lines(np.any(layers, axis=0), evidence.cell_size_m)]
    return vector_table(rows)


_ROUGH_CELLS: Final = 0.75  # tolerance of the simplification of stairs


def middle_lines(present: NDArray[np.bool_], cell_size_m: float) -> NDArray[np.object_]:
    """Return the centre lines of a mask in (right, up) from its middle, metres; they end at forks."""
    from skimage.morphology import skeletonize  # noqa: PLC0415 - as in `load_libraries`

    closed = cv2.morphologyEx(present.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
    thin = np.asarray(skeletonize(closed > 0), dtype=np.bool_)
    places_m = cell_offsets_m((present.shape[0], present.shape[1]), cell_size_m)
    ends = _links(thin)
    if not len(ends):
        return np.empty(0, dtype=object)
    lines = _merged(shapely.linestrings(places_m[ends]))
    lines = _merged(lines[~_is_spur(lines)])
    # 0.75 cells: tolerance of the simplification of stairs
    return np.asarray(shapely.simplify(lines, _ROUGH_CELLS * cell_size_m), dtype=object)


def _links(thin: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return pairs of neighbouring cells by number, row by row, shape (E, 2)."""
    # Diagonal neighbours are linked only where no common neighbour is set: else each fork would be a triangle.
    number = np.arange(thin.size).reshape(thin.shape)
    falls = thin[:-1, :-1] & thin[1:, 1:] & ~thin[:-1, 1:] & ~thin[1:, :-1]
    rises = thin[:-1, 1:] & thin[1:, :-1] & ~thin[:-1, :-1] & ~thin[1:, 1:]
    across, down = thin[:, :-1] & thin[:, 1:], thin[:-1] & thin[1:]
    parts = (
        (number[:, :-1][across], number[:, 1:][across]),
        (number[:-1][down], number[1:][down]),
        (number[:-1, :-1][falls], number[1:, 1:][falls]),
        (number[:-1, 1:][rises], number[1:, :-1][rises]),
    )
    return np.concatenate([np.column_stack(part) for part in parts])


def _merged(lines: NDArray[np.object_]) -> NDArray[np.object_]:
    if not len(lines):
        return lines
    return np.asarray(shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines))), dtype=object)


SPUR_M: Final = 8.0  # shorter branches are corners of a broad line


def _is_spur(lines: NDArray[np.object_]) -> NDArray[np.bool_]:
    tips_m = np.stack([shapely.get_coordinates(shapely.get_point(lines, at)) for at in (0, -1)], axis=1)
    _, tip = np.unique(tips_m.reshape(-1, 2), axis=0, return_inverse=True)
    tip = tip.reshape(-1, 2)
    ends = np.sort(np.bincount(tip.ravel())[tip], axis=1)
    return np.asarray((shapely.length(lines) < SPUR_M) & (ends[:, 0] == 1) & (ends[:, 1] >= _FORK))


NEAR_M: Final = 80.0  # neighbours whose relative places are compared
_FACING_DEG: Final = 30.0
_FAMILIES: Final = (ROADS, ("railway",), ("waterway",), ("building",))
_SIGHTS: Final = tuple(dict.fromkeys(kind.classes for kind in NODE_KINDS))
_VISIBLE_OF: Final = np.array([_SIGHTS.index(kind.classes) for kind in NODE_KINDS])
_FREE: Final = (INDEX["dead_end"], INDEX["mask dead_end"])


@dataclass(frozen=True, kw_only=True)
class ObservedGraph:
    """Nodes and relations in a view, in its own frame: places are (right, up) from its middle, metres.

    `is_cut`, shape (N,), marks nodes near the border of known cells, of which a part may be missing; `near`, shape (P,
    2), pairs of the Delaunay triangulation within `NEAR_M`; `asked`, shape (K,), judged kinds: a family of which
    nothing is seen is left to the raster score; `visible`, shape (S, rows, cols), cells where nodes are visible, for
    each set of classes of a kind of node.
    """

    nodes: Nodes
    is_cut: Bools
    near: Ints
    asked: Bools
    visible: Bools
    cell_size_m: float

    @classmethod
    def of(cls, query: Query) -> Self:
        """Return the graph of the view of a query."""
        return cls.make(query.evidence, query.vectors)

    @classmethod
    def make(cls, evidence: Evidence, vectors: "gpd.GeoDataFrame | None" = None) -> Self:
        """Derive the graph of a view.

        Each family (roads, railways, waterways, buildings) comes from the vectors if they hold any of it, else from the
        masks; areas always from the masks.

        Examples
        --------
        >>> cells = np.zeros((1, 96, 96), dtype=np.uint8)
        >>> cells[0, 45:51] = cells[0, :48, 60:66] = 1
        >>> seen = ObservedGraph.make(Evidence(classes=("road_minor",), cells=cells, cell_size_m=1.0))
        >>> nodes = seen.nodes
        >>> [(NODE_KINDS[kind].name, place.round().tolist()) for kind, place in zip(nodes.kind, nodes.places_m)]
        [('mask intersection', [14.0, 0.0])]
        """
        from sasgeo_bench.regions.layers import delaunay_pairs  # noqa: PLC0415 - imports GDAL

        names = set() if vectors is None else set(vectors["class"])
        drawn = {name for family in _FAMILIES if names & set(family) for name in family}
        parts = [nothing()]
        if vectors is not None and drawn:
            parts.append(_from_vectors(vectors, evidence))
        parts.append(_from_mask(evidence, without=drawn))
        nodes = Nodes.joined(parts)
        visible = _visible(evidence)
        is_cut = ~_looked_up(visible, nodes.places_m, nodes.kind, evidence.cell_size_m)
        keep = ~(is_cut & np.isin(nodes.kind, _FREE))
        nodes, is_cut = nodes.taken(keep), is_cut[keep]
        # Which patches may extend beyond the view
        half_m = np.array(evidence.size_m) / 2 - 1.0
        is_cut |= np.asarray((np.abs(nodes.places_m) + nodes.radius_m[:, None] > half_m).any(axis=1))
        return cls(
            nodes=nodes,
            is_cut=is_cut,
            near=delaunay_pairs(nodes.places_m, NEAR_M),
            asked=_asked(evidence, names, drawn),
            visible=visible,
            cell_size_m=evidence.cell_size_m,
        )

    def shows(self, places_m: Floats, kind: Ints) -> Bools:
        """Return which nodes of some kinds at (right, up) are visible."""
        return self.asked[kind] & _looked_up(self.visible, places_m, kind, self.cell_size_m)

    @cached_property
    def links(self) -> dict[int, set[int]]:
        """Return the nodes that ways connect with each node."""
        return self.nodes.links()


def _from_vectors(vectors: "gpd.GeoDataFrame", evidence: Evidence) -> Nodes:
    features = as_features(bridged(vectors))
    nodes = nodes_of(build_graph(features), features, "vectors")
    # A building that the view cuts differs from the map in centre and area.
    half_m = np.array(evidence.size_m) / 2 - 2.0
    is_whole = (np.abs(shapely.bounds(features.geometry.to_numpy())) < [*half_m, *half_m]).all(axis=1)
    is_house = nodes.kind == INDEX["building"]
    return nodes.taken(~is_house | is_whole[nodes.feature])


LEAST_M2: Final = 12.0  # smaller patches are noise


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


BRIDGED_M: Final = 7.0  # facing ends of roads within this distance are one road: as far as a street is wide


def bridged(vectors: "gpd.GeoDataFrame") -> "gpd.GeoDataFrame":
    """Return vectors with facing ends of roads within 7 m joined: a road that a detector broke is one road."""
    features = as_features(vectors)
    network = make_network(features[features["class"].isin(list(LAYERS)).to_numpy()])
    free = np.flatnonzero(network.degree(ROAD) == 1)
    places_m = network.vertices[free]
    arm_deg = arms_of(features, places_m)[:, 0]
    if len(free) < 2:  # a join has two ends
        return vectors
    pairs = scipy.spatial.cKDTree(places_m).query_pairs(BRIDGED_M, output_type="ndarray")
    ahead_deg = bearing_deg(*(places_m[pairs[:, 1]] - places_m[pairs[:, 0]]).T)
    off_deg = np.abs(
        np.stack((wrap_deg(arm_deg[pairs[:, 0]] + 180 - ahead_deg), wrap_deg(arm_deg[pairs[:, 1]] - ahead_deg)))
    )
    pairs = pairs[(off_deg < _FACING_DEG).all(axis=0)]
    rows = list(zip(*(vectors[name] for name in ("class", "level", "is_bridge", "geometry")), strict=True))
    rows += [("road_minor", 0, False, shapely.LineString(places_m[pair])) for pair in pairs]
    return vector_table(rows)


def _asked(evidence: Evidence, names: set[str], drawn: set[str]) -> Bools:
    """Return the kinds to judge: those with all families in the vectors, or else in the masks."""
    present = {
        name for name, layer in zip(evidence.classes, evidence.cells, strict=True) if (layer == PRESENT).any()
    } - drawn
    shown = {"vectors": names, "mask": present}
    found = []
    for kind in NODE_KINDS:
        own = shown[kind.drawing]
        families = [set(ROADS) if name in ROADS else {name} for name in kind.classes]
        found.append(all(own & family for family in families))
    return np.array(found)


MARGIN_M: Final = 8.0  # along the border of known cells, where objects may be cut


def _visible(evidence: Evidence) -> Bools:
    """Return where nearly all cells around are known in each set of classes; absent sets are known nowhere."""
    sights = np.zeros((len(_SIGHTS), *evidence.shape), dtype=bool)
    size = 2 * max(1, round(MARGIN_M / evidence.cell_size_m)) + 1
    for into, classes in zip(sights, _SIGHTS, strict=True):
        layers = [evidence.layer(name) != UNKNOWN for name in classes if name in evidence.classes]
        if layers:
            known = np.all(layers, axis=0).astype(np.float32)
            # 0.9 of the cells around a place
            into[:] = cv2.boxFilter(known, -1, (size, size), borderType=cv2.BORDER_CONSTANT) > 0.9
    return sights


def _looked_up(visible: Bools, places_m: Floats, kind: Ints, cell_size_m: float) -> Bools:
    rows, cols = visible.shape[1:]
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
    return np.asarray(inside & visible[_VISIBLE_OF[kind], np.where(inside, row, 0), np.where(inside, col, 0)])
