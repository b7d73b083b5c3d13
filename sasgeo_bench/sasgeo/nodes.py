# SPDX-License-Identifier: Apache-2.0
"""Comparable nodes of a map or a view: kinds by source, places, arms, areas and relations."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, Self

import lazy_loader  # type: ignore[import-untyped, unused-ignore]
import numpy as np
import scipy  # its trees are loaded where they are used: a map that was prepared before needs none
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import bearing_deg, wrap_deg
from sasgeo_bench.regions.graph import LAYERS, RELATIONS, ROAD, VERTEX_M, find_crossings, make_chains, make_network
from sasgeo_bench.regions.region import MapGraph

if TYPE_CHECKING:
    import geopandas as gpd
else:  # loaded when a table of geometry is made
    gpd = lazy_loader.load("geopandas")

Drawing = Literal["vectors", "mask"]

ROADS: Final = tuple(name for name, layer in LAYERS.items() if layer == ROAD)


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeKind:
    """A kind of node, its source, and probabilities to start from.

    A node can be missed only where `classes` are known; `hit` is the probability that a visible map node is seen,
    `extra` the share of seen nodes that no map has, `spread_m` the standard deviation of its centre.
    """

    name: str
    drawing: Drawing
    classes: tuple[str, ...]
    hit: float
    extra: float
    spread_m: float = 0.0


def _kind(name: str, drawing: Drawing, classes: tuple[str, ...], *chances: float) -> NodeKind:
    hit, extra, *spread_m = chances
    return NodeKind(name=name, drawing=drawing, classes=classes, hit=hit, extra=extra, spread_m=sum(spread_m))


_RAIL: Final = (*ROADS, "railway")
_WATER: Final = (*ROADS, "waterway")
# Vectors show connections and separate houses; a mask shows neither, so its nodes have kinds of their own. A junction
# is seen only where all its roads are, and a road that is missed leaves new ends: crossings are hit less often than
# houses, and ends are often extra. These are guesses to start from (`rule_fitting`).
NODE_KINDS: Final = (
    _kind("intersection", "vectors", ROADS, 0.75, 0.08),
    _kind("dead_end", "vectors", ROADS, 0.7, 0.5),
    _kind("crossing", "vectors", ROADS, 0.75, 0.08),
    _kind("level_crossing", "vectors", _RAIL, 0.75, 0.08),
    _kind("road_rail_crossing", "vectors", _RAIL, 0.75, 0.08),
    _kind("road_water_crossing", "vectors", _WATER, 0.75, 0.1),
    _kind("river_bend", "vectors", ("waterway",), 0.5, 0.3, 10.0),
    _kind("building", "vectors", ("building",), 0.85, 0.1),
    _kind("mask intersection", "mask", ROADS, 0.6, 0.3),
    _kind("mask dead_end", "mask", ROADS, 0.4, 0.8, 2.0),
    _kind("mask rail crossing", "mask", _RAIL, 0.6, 0.3),
    _kind("mask water crossing", "mask", _WATER, 0.5, 0.3),
    _kind("mask river_bend", "mask", ("waterway",), 0.4, 0.4, 10.0),
    _kind("building patch", "mask", ("building",), 0.75, 0.2),
    _kind("farmland patch", "mask", ("farmland",), 0.4, 0.5, 8.0),
    _kind("green patch", "mask", ("green",), 0.4, 0.5, 8.0),
    _kind("parking patch", "mask", ("parking",), 0.5, 0.4, 4.0),
    _kind("water patch", "mask", ("water",), 0.5, 0.4, 6.0),
)
INDEX: Final = {kind.name: at for at, kind in enumerate(NODE_KINDS)}
_OF_RIVERS: Final = (INDEX["mask water crossing"], INDEX["mask river_bend"])
PATCHES: Final = tuple(kind.classes[0] for kind in NODE_KINDS if kind.name.endswith("patch"))


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
MOST_ARMS: Final = 6
_ALONG_WAYS: Final = [RELATIONS.index(name) for name in ("connectivity", "crossing")]
_TOWARDS_DEG: Final = 45.0
_PASSING: Final = 2

_BY_NODE: Final = ("places_m", "kind", "degree", "area_m2", "reach_m", "arms_deg", "feature")  # fields of `Nodes`
_IN_A_MASK: Final = {
    "intersection": "mask intersection",
    "dead_end": "mask dead_end",
    "level_crossing": "mask rail crossing",
    "road_rail_crossing": "mask rail crossing",
    "road_water_crossing": "mask water crossing",
    "river_bend": "mask river_bend",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Nodes:
    """Nodes and their relations.

    `places_m`, shape (N, 2), are easting and northing of a map, (right, up) of a view; `kind` is an index into
    `NODE_KINDS`. `degree` counts the roads that meet: 0 where none do or several junctions are one. `area_m2` is that
    of buildings and patches, else NaN. `arms_deg`, shape (N, MOST_ARMS), are bearings of the roads that leave a
    junction or an end, NaN behind the last one. `reach_m` is how far a patch extends from its place, 0 for other nodes.
    `pairs`, shape (E, 2), are edges and `relation` their index into
    `graph.RELATIONS`. `feature` is the `osm_id` of a node's feature, -1 for several.
    """

    places_m: Floats
    kind: Ints
    degree: Ints
    area_m2: Floats
    reach_m: Floats
    arms_deg: Floats
    pairs: Ints
    relation: Ints
    feature: Ints

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def radius_m(self) -> Floats:
        """Radius of a disc of the area of each node, 0 without an area; shape (N,)."""
        return np.asarray(np.nan_to_num(np.sqrt(self.area_m2 / np.pi)))

    def links(self) -> dict[int, set[int]]:
        """Return the nodes that ways connect with each node, or cross there."""
        found: dict[int, set[int]] = {}
        for one, two in self.pairs[np.isin(self.relation, _ALONG_WAYS)].tolist():
            found.setdefault(one, set()).add(two)
            found.setdefault(two, set()).add(one)
        return found

    def taken(self, keep: Bools) -> Self:
        """Return selected nodes and the edges between them."""
        pairs = np.where(keep, np.cumsum(keep) - 1, -1)[self.pairs]
        stays = (pairs >= 0).all(axis=1)
        own = {name: getattr(self, name)[keep] for name in _BY_NODE}
        return type(self)(**own, pairs=pairs[stays], relation=self.relation[stays])

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Join sets of nodes, with no edge between two sets."""
        starts = np.cumsum([0, *(len(part) for part in parts)])
        pairs = [part.pairs + start for part, start in zip(parts, starts[:-1], strict=True)]
        own = {name: np.concatenate([getattr(part, name) for part in parts]) for name in (*_BY_NODE, "relation")}
        return cls(**own, pairs=np.concatenate(pairs))


def nothing() -> Nodes:
    """Return an empty set of nodes."""
    none = np.zeros(0, dtype=np.int64)
    return Nodes(
        places_m=np.zeros((0, 2)),
        kind=none,
        degree=none,
        area_m2=np.zeros(0),
        reach_m=np.zeros(0),
        arms_deg=np.zeros((0, MOST_ARMS)),
        pairs=none.reshape(0, 2),
        relation=none,
        feature=none,
    )


def in_plan(ways: "gpd.GeoDataFrame") -> "gpd.GeoDataFrame":
    """Return ways as a mask shows them: the visible ones, with a vertex wherever roads cross.

    A mask does not tell a bridge over a road from a junction, so both must give the same nodes, arms and connections.

    Examples
    --------
    >>> ways = gpd.GeoDataFrame(
    ...     {"class": ["road_minor", "road_major"], "is_visible": True},
    ...     geometry=shapely.from_wkt(["LINESTRING (0 0, 40 0)", "LINESTRING (9 -30, 9 30)"]),
    ... )
    >>> in_plan(ways).geometry.to_wkt().tolist()
    ['MULTILINESTRING ((0 0, 9 0, 40 0))', 'MULTILINESTRING ((9 -30, 9 0, 9 30))']
    """
    ways = ways[ways["is_visible"].to_numpy(dtype=bool)]
    network = make_network(ways)
    found = find_crossings(network)
    is_road = (network.layer[found.segments] == ROAD).all(axis=1)
    # 3 decimals of places, as those of features: a millimetre
    segments, shares, en_m = found.segments[is_road], found.shares[is_road], found.en_m[is_road].round(3)
    if not len(segments):
        return ways
    # Where one of both has a vertex at the crossing already, the other gets the same.
    tips_m = network.vertices[network.ends[segments].reshape(-1, 4)]
    off_m = np.hypot(*np.moveaxis(tips_m - en_m[:, None], 2, 0))
    nearest = off_m.argmin(axis=1)
    rows = np.arange(len(segments))
    en_m = np.where((off_m[rows, nearest] <= 2 * VERTEX_M)[:, None], tips_m[rows, nearest], en_m)
    between: dict[int, list[tuple[float, list[float]]]] = {}
    for segment, share, place in zip(segments.ravel(), shares.ravel(), np.repeat(en_m, 2, axis=0), strict=True):
        between.setdefault(int(segment), []).append((float(share), place.tolist()))
    shapes = np.asarray(ways.geometry.array).copy()
    for row in np.unique(network.way[segments]).tolist():
        lines = []
        for segment in np.flatnonzero(network.way == row).tolist():
            start, end = network.vertices[network.ends[segment]].tolist()
            lines.append([start, *(place for _, place in sorted(between.get(segment, ()))), end])
        shapes[row] = shapely.MultiLineString(lines)
    return ways.set_geometry(gpd.GeoSeries(shapes, index=ways.index, crs=ways.crs))


def nodes_of(graph: MapGraph, features: "gpd.GeoDataFrame", drawing: Drawing) -> Nodes:
    """Return the nodes of a graph as vectors or as a mask show them.

    The arms of junctions come from `features`, of which the graph was made. For a mask both are of ways `in_plan`;
    junctions within a road's width merge, and buildings come from `patches_of`.
    """
    table = graph.nodes
    names = table["kind"].to_numpy(dtype=object)
    on_road = table["class"].isin(ROADS).to_numpy()
    names = np.where((names == "crossing") & ~on_road, "", names)  # a railway over a river is no landmark
    own = [kind.name for kind in NODE_KINDS if kind.drawing == drawing]
    renamed = _IN_A_MASK if drawing == "mask" else dict(zip(own, own, strict=True))
    kind = np.array([INDEX[renamed[name]] if name in renamed else -1 for name in names], dtype=np.int64)
    places_m = np.asarray(shapely.get_coordinates(table.geometry.to_numpy())).reshape(-1, 2)
    code = {name: at for at, name in enumerate(RELATIONS)}
    degree = np.where(names == "crossing", 4, table["degree"].to_numpy(dtype=np.int64))  # arms of two roads that cross
    if drawing == "mask":
        degree[names == "level_crossing"] = 0  # as where the railway passes over the road
    found = Nodes(
        places_m=places_m,
        kind=kind,
        degree=degree,
        area_m2=np.where(names == "building", table["area_m2"].to_numpy(dtype=np.float64), np.nan),
        reach_m=np.zeros(len(names)),
        arms_deg=arms_of(features, places_m),
        pairs=graph.edges[["source", "target"]].to_numpy(dtype=np.int64),
        relation=np.array([code[name] for name in graph.edges["relation"]], dtype=np.int64),
        feature=table["osm_id"].to_numpy(dtype=np.int64),
    ).taken(kind >= 0)
    return _blurred(found) if drawing == "mask" else found


BLUR_M: Final = 8.0  # junctions nearer than this are one in a mask: a road's width


def _blurred(nodes: Nodes) -> Nodes:
    """Merge nodes of one kind within a road's width."""
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415 - as scipy above

    near = (
        scipy.spatial.cKDTree(nodes.places_m).query_pairs(BLUR_M, output_type="ndarray") if len(nodes) else nodes.pairs
    )
    near = near[nodes.kind[near[:, 0]] == nodes.kind[near[:, 1]]]
    links = scipy.sparse.coo_array((np.ones(len(near)), near.T), shape=(len(nodes), len(nodes)))
    group = nodes.kind
    if len(nodes):
        group = np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
    size = np.bincount(group)
    first = np.full(len(size), len(nodes))
    np.minimum.at(first, group, np.arange(len(nodes)))
    pairs = group[nodes.pairs]
    is_edge = pairs[:, 0] != pairs[:, 1]
    middle = [np.bincount(group, weights=part) / size for part in nodes.places_m.T]
    arms_deg = _outer_arms(nodes, near)
    row, arm = np.nonzero(np.isfinite(arms_deg))
    outer = _by_row(group[row], arms_deg[row, arm], len(size))
    has_arms = np.bincount(group, weights=np.isfinite(nodes.arms_deg).any(axis=1), minlength=len(size)) == size
    count = np.where(has_arms, np.isfinite(outer).sum(axis=1), 0)
    return Nodes(
        places_m=np.column_stack(middle) if len(nodes) else nodes.places_m,
        kind=nodes.kind[first],
        degree=np.where(size == 1, nodes.degree[first], count),
        area_m2=nodes.area_m2[first],
        reach_m=nodes.reach_m[first],
        arms_deg=np.where(has_arms[:, None], outer, np.nan),
        pairs=pairs[is_edge],
        relation=nodes.relation[is_edge],
        feature=np.where(size == 1, nodes.feature[first], -1),
    )


def _outer_arms(nodes: Nodes, near: Ints) -> Floats:
    """Return arms of nodes without those that lead to another node near them."""
    arms_deg = nodes.arms_deg.copy()
    for one, two in (near.T, near[:, ::-1].T):
        towards_deg = bearing_deg(*(nodes.places_m[two] - nodes.places_m[one]).T)
        leads_there = np.abs(wrap_deg(arms_deg[one] - towards_deg[:, None])) < _TOWARDS_DEG
        row, arm = np.nonzero(leads_there)
        arms_deg[one[row], arm] = np.nan
    return arms_deg


def _by_row(row: Ints, bearing: Floats, count: int) -> Floats:
    """Return the bearings of each row, shape (count, MOST_ARMS), NaN behind the last one."""
    order = np.argsort(row, kind="stable")
    row, bearing = row[order], bearing[order]
    turn = np.arange(len(row)) - np.searchsorted(row, row)
    table = np.full((count, MOST_ARMS), np.nan)
    table[row[turn < MOST_ARMS], turn[turn < MOST_ARMS]] = bearing[turn < MOST_ARMS]
    return table


ARM_M: Final = 12.0  # along a road to where its direction is measured: past the curbs of a junction


def arms_of(features: "gpd.GeoDataFrame", places_m: Floats) -> Floats:
    """Return bearings of the roads that leave places where a road begins, ends or forks.

    Parameters
    ----------
    features : geopandas.GeoDataFrame
        A feature table.
    places_m : ndarray of float, shape (N, 2)
        In its frame.

    Returns
    -------
    ndarray of float, shape (N, MOST_ARMS)
        Degrees in [0, 360), clockwise from the frame's second axis, NaN behind the last one.

    Examples
    --------
    >>> ways = gpd.GeoDataFrame(
    ...     {"class": ["road_minor"] * 2, "is_visible": True},
    ...     geometry=shapely.from_wkt(["LINESTRING (0 0, 50 0, 90 0)", "LINESTRING (50 0, 50 30)"]),
    ... )
    >>> sorted(arms_of(ways, np.array([(50.0, 0.0)]))[0, :3].tolist())
    [0.0, 90.0, 270.0]
    """
    arms = np.full((len(places_m), MOST_ARMS), np.nan)
    network = make_network(features[features["class"].isin(list(LAYERS)).to_numpy()])
    degree = network.degree(ROAD)
    chains = make_chains(network, ROAD, is_break=(degree > 0) & (degree != _PASSING))
    if not len(chains.length_m) or not len(places_m):
        return arms
    line = np.repeat(np.arange(len(chains.length_m)), np.diff(chains.first))
    ways = shapely.linestrings(chains.en_m, indices=line)
    along_m = np.minimum(ARM_M, chains.length_m / 2)
    points = (
        shapely.line_interpolate_point(ways, along_m),
        shapely.line_interpolate_point(ways, chains.length_m - along_m),
    )
    vertex = chains.tips.T.ravel()
    away_m = np.concatenate([shapely.get_coordinates(part) for part in points]) - network.vertices[vertex]
    # The last row is for places that are no vertex.
    table = _by_row(vertex, bearing_deg(*away_m.T), len(network.vertices) + 1)
    return np.asarray(table[network.lookup(places_m)])


TOUCH_M: Final = 0.5  # outlines nearer than this are one patch in a mask


def patches_of(features: "gpd.GeoDataFrame") -> Nodes:
    """Return buildings and areas as a mask shows them: touching areas of one class merge.

    Examples
    --------
    >>> from sasgeo_bench.tasks.vectors import as_features, vector_table
    >>> row = [("building", 0, False, shapely.box(at, 0, at + 9, 9)) for at in (0, 9, 50)]
    >>> patches_of(as_features(vector_table(row))).area_m2.tolist()
    [162.0, 81.0]
    """
    from sasgeo_bench.regions.layers import centroids, groups_within  # noqa: PLC0415 - imports GDAL

    names, seen = features["class"].to_numpy(dtype=object), features["is_visible"].to_numpy(dtype=bool)
    all_shapes = np.asarray(features.geometry.array)
    is_area = seen & (shapely.get_dimensions(all_shapes) == 2) & (shapely.area(all_shapes) > 0)
    parts = []
    for name in PATCHES:
        chosen = np.flatnonzero(is_area & (names == name))
        if not len(chosen):
            continue
        shapes = all_shapes[chosen]
        group = groups_within(shapes, TOUCH_M)
        area_m2: Floats = np.bincount(group, weights=shapely.area(shapes)).astype(np.float64)
        weight = shapely.area(shapes) / area_m2[group]
        parts_m = [np.bincount(group, weights=weight * part) for part in centroids(shapes).T]
        middle: Floats = np.column_stack(parts_m)
        corners_m, owner = shapely.get_coordinates(shapes, return_index=True)
        reach_m = np.zeros(len(area_m2))
        np.maximum.at(reach_m, group[owner], np.hypot(*(corners_m - middle[group[owner]]).T))
        count, is_one = len(area_m2), np.bincount(group) == 1
        last = np.full(count, -1)
        last[group] = features["osm_id"].to_numpy(dtype=np.int64)[chosen]
        parts.append(
            Nodes(
                places_m=middle,
                kind=np.full(count, INDEX[f"{name} patch"]),
                degree=np.zeros(count, dtype=np.int64),
                area_m2=area_m2,
                reach_m=reach_m,
                arms_deg=np.full((count, MOST_ARMS), np.nan),
                pairs=np.zeros((0, 2), dtype=np.int64),
                relation=np.zeros(0, dtype=np.int64),
                feature=np.where(is_one, last, -1),
            )
        )
    return Nodes.joined([nothing(), *parts])


def out_of_water(nodes: Nodes, features: "gpd.GeoDataFrame") -> Nodes:
    """Return the nodes of a mask without those of rivers where visible water covers them: no line is drawn there.

    Examples
    --------
    >>> from sasgeo_bench.tasks.vectors import as_features, vector_table
    >>> rows = [("green", 0, False, shapely.box(0, 0, 9, 9)), ("water", 0, False, shapely.box(5, 0, 20, 9))]
    >>> pond = as_features(vector_table(rows))
    >>> len(out_of_water(patches_of(pond), pond))  # patches stay, whatever lies on them
    2
    """
    shapes = np.asarray(features.geometry.array)
    is_water = (features["class"] == "water").to_numpy() & features["is_visible"].to_numpy(dtype=bool)
    water = shapely.STRtree(shapes[is_water & (shapely.get_dimensions(shapes) == 2)])  # areas
    rivers = np.flatnonzero(np.isin(nodes.kind, _OF_RIVERS))
    covered = water.query(shapely.points(nodes.places_m[rivers]), predicate="intersects")[0]
    keep = np.ones(len(nodes), dtype=bool)
    keep[rivers[covered]] = False
    return nodes.taken(keep)
