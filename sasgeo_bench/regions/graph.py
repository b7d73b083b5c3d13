# SPDX-License-Identifier: Apache-2.0
"""Derive a MapGraph from features: junctions, crossings, buildings, clusters, areas, bends, and relations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import lazy_loader  # type: ignore[import-untyped, unused-ignore]
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.osm.features import SEA, check_features
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region import MapGraph

if TYPE_CHECKING:
    import geopandas as gpd
    import pandas as pd
else:  # loaded when a graph is made; and so are the layers, with GDAL: a matcher that reads one may need neither
    gpd, pd = lazy_loader.load("geopandas"), lazy_loader.load("pandas")

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Lines = NDArray[np.object_]

ROAD, RAIL, WATER = 0, 1, 2
# In order of rank: where several ways meet, the first of their classes names the node.
LAYERS: Final = {
    name: layer
    for layer, names in enumerate(load_taxonomy().of_graph(part) for part in ("road", "rail", "water"))
    for name in names
}

# Ways that share an OSM node share equal coordinates; a millimetre absorbs what a rotation does to the last bits.
VERTEX_M: Final = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """Segments between shared vertices; each undirected segment occurs once per layer."""

    vertices: Floats  # shape (V, 2): easting and northing, metres
    keys: Ints  # shape (V,): ascending key of each vertex on the millimetre lattice of `origin` and `stride`
    ends: Ints  # shape (S, 2): vertices of each segment, in the direction of its way; segments of a way are adjacent
    way: Ints  # shape (S,): row of the way in the source table
    layer: Ints  # shape (S,): ROAD, RAIL or WATER
    is_visible: Bools  # shape (S,): false in tunnels and under ground
    origin: Floats  # shape (2,): smallest easting and northing, metres
    stride: int  # cells in a column of the lattice

    def lookup(self, en_m: Floats) -> Ints:
        """Return the vertex at each place of shape (N, 2), metres; -1 where there is none."""
        if not len(self.keys):
            return np.full(len(en_m), -1)
        cells = np.rint((en_m - self.origin) / VERTEX_M).astype(np.int64)
        key = cells[:, 0] * self.stride + cells[:, 1]
        place = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        return np.where(self.keys[place] == key, place, -1)

    def degree(self, layer: int, *, visible_only: bool = False) -> Ints:
        """Count the segment ends of a layer at each vertex, shape (V,)."""
        chosen = self.layer == layer
        if visible_only:
            chosen = chosen & self.is_visible
        return np.bincount(self.ends[chosen].ravel(), minlength=len(self.vertices))


def make_network(ways: "gpd.GeoDataFrame") -> Network:
    """Cut ways with the classes of `LAYERS` into segments that share the vertices of their layer.

    Areas among them (squares) are left out. A segment drawn by two ways of one layer counts once, and is visible if
    either is.

    >>> ways = gpd.GeoDataFrame(
    ...     {"class": ["road_minor", "road_minor"], "is_visible": True},
    ...     geometry=shapely.from_wkt(["LINESTRING (0 0, 10 0, 20 0)", "LINESTRING (10 0, 10 9)"]),
    ... )
    >>> make_network(ways).degree(ROAD).tolist()
    [1, 3, 1, 1]
    """
    lines, row = shapely.get_parts(np.asarray(ways.geometry.array), return_index=True)
    is_line = shapely.get_type_id(lines) == 1  # line type of shapely.get_type_id
    lines, row = lines[is_line], row[is_line].astype(np.int64)
    en_m, line = shapely.get_coordinates(lines, return_index=True)
    origin = en_m.min(axis=0) if len(en_m) else np.zeros(2)
    cells = np.rint((en_m - origin) / VERTEX_M).astype(np.int64)
    stride = int(cells[:, 1].max(initial=0)) + 1
    keys, first, vertex = np.unique(cells[:, 0] * stride + cells[:, 1], return_index=True, return_inverse=True)
    inside = (line[1:] == line[:-1]) & (vertex[1:] != vertex[:-1])
    ends = np.stack([vertex[:-1][inside], vertex[1:][inside]], axis=1)
    way = row[line[:-1][inside]]
    layer = ways["class"].map(LAYERS).to_numpy(dtype=np.int64)[way]
    visible = ways["is_visible"].to_numpy(dtype=bool)[way]
    # Visible segments first, so that of two equal ones the visible one is kept.
    order = np.argsort(~visible, kind="stable")
    pair = (pair_keys(ends, len(keys)) * len(LAYERS) + layer)[order]
    kept = np.sort(order[np.unique(pair, return_index=True)[1]])
    return Network(
        vertices=en_m[first],
        keys=keys,
        ends=ends[kept],
        way=way[kept],
        layer=layer[kept],
        is_visible=visible[kept],
        origin=origin,
        stride=stride,
    )


def pair_keys(pairs: Ints, count: int) -> Ints:
    """Return one integer for each unordered pair, shape (N, 2), of numbers below `count`.

    >>> pair_keys(np.array([[1, 2], [2, 1]]), 10).tolist()
    [12, 12]
    """
    return np.asarray(pairs.min(axis=1) * count + pairs.max(axis=1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Chains:
    """The segments of one layer, joined into chains."""

    en_m: Floats  # shape (P, 2): vertices of all chains, one chain after the other, metres
    at_m: Floats  # shape (P,): distance of each from the start of its chain, metres
    first: Ints  # shape (C + 1,): row of `en_m` where each chain begins; the last entry is P
    tips: Ints  # shape (C, 2): network vertices at either end
    length_m: Floats  # shape (C,): length of each chain, metres
    of_segment: Ints  # shape (S,): chain of each segment of the network; -1 in other layers
    segment_at_m: Floats  # shape (S, 2): distance of both ends of each segment from the start of its chain, or NaN
    part_segment: Ints  # shape (P,): segment that begins at each row of `en_m`; -1 at the last vertex of a chain

    def segment_at(self, chain: Ints, at_m: Floats) -> Ints:
        """Return the network segment at a distance along each chain, metres."""
        shift_m = np.cumsum(self.length_m + 1.0) - self.length_m  # one axis for all chains
        axis_m = self.at_m + np.repeat(shift_m, np.diff(self.first))
        part = np.searchsorted(axis_m, at_m + shift_m[chain], side="right") - 1
        return self.part_segment[np.clip(part, self.first[chain], self.first[chain + 1] - 2)]


def make_chains(network: Network, layer: int, *, is_break: Bools) -> Chains:
    """Join the segments of a layer (ROAD, RAIL or WATER) into chains that end at breaks and forks.

    `is_break`, shape (V,), marks vertices inside a way where a chain must end too. Elsewhere a way continues past a
    fork inside it: a river past its tributaries, a track past its switches. Chain ends depend on the geometry only;
    order and direction of chains follow the order of the ways.

    >>> ways = gpd.GeoDataFrame(
    ...     {"class": ["road_minor", "road_minor"], "is_visible": True},
    ...     geometry=shapely.from_wkt(["LINESTRING (0 0, 10 0)", "LINESTRING (10 0, 10 9)"]),
    ... )
    >>> make_chains(make_network(ways), ROAD, is_break=np.zeros(3, dtype=bool)).length_m.tolist()
    [19.0]
    """
    chosen = np.flatnonzero(network.layer == layer)
    pieces = _pieces(network, chosen, is_break)
    merged = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(pieces)))
    en_m, chain = shapely.get_coordinates(merged, return_index=True)
    first = np.searchsorted(chain, np.arange(len(merged) + 1))
    vertex = network.lookup(en_m)
    step_m = np.linalg.norm(np.diff(en_m, axis=0, prepend=en_m[:1]), axis=1)
    step_m[first[:-1]] = 0.0
    total_m = np.cumsum(step_m)
    at_m = total_m - total_m[first[:-1]][chain]
    parts = np.flatnonzero(chain[1:] == chain[:-1])
    # Find every segment in its chain by the pair of its vertices.
    count = len(network.vertices)
    part_key = pair_keys(np.stack([vertex[parts], vertex[parts + 1]], axis=1), count)
    order = np.argsort(part_key)
    part = parts[order[np.searchsorted(part_key[order], pair_keys(network.ends[chosen], count))]]
    of_segment = np.full(len(network.ends), -1)
    of_segment[chosen] = chain[part]
    is_turned = vertex[part] != network.ends[chosen, 0]
    segment_at_m = np.full((len(network.ends), 2), np.nan)
    segment_at_m[chosen] = np.stack([at_m[part + is_turned], at_m[part + ~is_turned]], axis=1)
    part_segment = np.full(len(en_m), -1)
    part_segment[part] = chosen
    return Chains(
        en_m=en_m,
        at_m=at_m,
        first=first,
        tips=np.stack([vertex[first[:-1]], vertex[first[1:] - 1]], axis=1),
        length_m=at_m[first[1:] - 1],
        of_segment=of_segment,
        segment_at_m=segment_at_m,
        part_segment=part_segment,
    )


def _pieces(network: Network, chosen: Ints, is_break: Bools) -> Lines:
    """Return runs of successive segments of one way between breaks, as lines."""
    if not len(chosen):
        return np.empty(0, dtype=object)
    ends, way = network.ends[chosen], network.way[chosen]
    begins = np.ones(len(chosen), dtype=bool)
    begins[1:] = (way[1:] != way[:-1]) | (ends[1:, 0] != ends[:-1, 1]) | is_break[ends[1:, 0]]
    piece = np.cumsum(begins) - 1
    is_last = np.append(begins[1:], True)
    owner = np.concatenate([piece, piece[is_last]])
    order = np.argsort(owner, kind="stable")
    vertex = np.concatenate([ends[:, 0], ends[is_last, 1]])[order]
    return np.asarray(shapely.linestrings(network.vertices[vertex], indices=owner[order]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Crossings:
    """Places where visible ways cross in plan."""

    en_m: Floats  # shape (N, 2): place, metres
    segments: Ints  # shape (N, 2): the two segments; the layer of the first is not the greater one
    shares: Floats  # shape (N, 2): position of the crossing along each of the two, in [0, 1]
    vertex: Ints  # shape (N,): the shared vertex, or -1


def find_crossings(network: Network) -> Crossings:
    """Find where ways cross without a shared vertex, except two waterways.

    A way that ends on another without a shared vertex does not cross it; one that has a vertex on it and continues
    does.

    >>> ways = gpd.GeoDataFrame(
    ...     {"class": ["road_minor", "waterway"], "is_visible": True},
    ...     geometry=shapely.from_wkt(["LINESTRING (0 0, 20 0)", "LINESTRING (5 -5, 5 5)"]),
    ... )
    >>> find_crossings(make_network(ways)).en_m.tolist()
    [[5.0, 0.0]]
    """
    seen = np.flatnonzero(network.is_visible)
    lines = np.asarray(shapely.linestrings(network.vertices[network.ends[seen]]))
    left, right = seen[overlapping(lines, lines)]
    pairs = np.stack([left, right], axis=1)[left < right]
    pairs = pairs[np.arange(len(pairs))[:, None], np.argsort(network.layer[pairs], axis=1, kind="stable")]
    ends = network.ends[pairs]
    shares_vertex = (ends[:, 0, :, None] == ends[:, 1, None, :]).any(axis=(1, 2))
    pairs = pairs[~shares_vertex & (network.layer[pairs[:, 0]] != WATER)]
    corner = network.vertices[network.ends[pairs]]
    ahead = corner[:, :, 1] - corner[:, :, 0]
    area = _cross(ahead[:, 0], ahead[:, 1])
    is_skew = area != 0  # parallel segments may overlap, but they do not cross
    pairs, corner, ahead, area = pairs[is_skew], corner[is_skew], ahead[is_skew], area[is_skew]
    between = corner[:, 1, 0] - corner[:, 0, 0]
    shares = np.stack([_cross(between, ahead[:, 1]) / area, _cross(between, ahead[:, 0]) / area], axis=1)
    slack = VERTEX_M / np.linalg.norm(ahead, axis=2)
    found = np.flatnonzero(((shares >= -slack) & (shares <= 1 + slack)).all(axis=1))
    pairs, shares, slack = pairs[found], np.clip(shares[found], 0, 1), slack[found]
    nearer = np.rint(shares)
    vertex = np.take_along_axis(network.ends[pairs], nearer[..., None].astype(np.int64), axis=2)[..., 0]
    degrees = np.stack([network.degree(layer) for layer in (ROAD, RAIL, WATER)])
    is_tail = degrees[network.layer[pairs], vertex] == 1
    passes = ~((np.abs(shares - nearer) <= slack) & is_tail).any(axis=1)
    pairs, shares = pairs[passes], shares[passes]
    en_m = corner[found[passes], 0, 0] + shares[:, :1] * ahead[found[passes], 0]
    # A crossing at a vertex of one way is found on both of its segments there.
    place = np.column_stack([np.rint((en_m - network.origin) / (10 * VERTEX_M)).astype(np.int64), network.layer[pairs]])
    kept = np.sort(np.unique(place, axis=0, return_index=True)[1])
    return Crossings(en_m=en_m[kept], segments=pairs[kept], shares=shares[kept], vertex=np.full(len(kept), -1))


def find_meetings(network: Network, layer: int) -> Crossings:
    """Find where visible roads and ways of another layer pass through one vertex: level crossings and fords.

    Where they run along each other (a tram in its street) they do not cross.

    >>> ways = gpd.GeoDataFrame(
    ...     {"class": ["road_minor", "railway"], "is_visible": True},
    ...     geometry=shapely.from_wkt(["LINESTRING (0 0, 5 0, 20 0)", "LINESTRING (5 -5, 5 0, 5 5)"]),
    ... )
    >>> find_meetings(make_network(ways), RAIL).en_m.tolist()
    [[5.0, 0.0]]
    """
    passes = (network.degree(ROAD, visible_only=True) > 1) & (network.degree(layer, visible_only=True) > 1)
    at_vertex = np.full((2, len(network.vertices)), -1)
    keys = []
    for row, kind in enumerate((ROAD, layer)):
        chosen = np.flatnonzero((network.layer == kind) & network.is_visible)
        at_vertex[row, network.ends[chosen].ravel()] = np.repeat(chosen, 2)
        keys.append(pair_keys(network.ends[chosen], len(network.vertices)))
    shared = np.intersect1d(keys[0], keys[1])
    passes[shared // max(len(network.vertices), 1)] = False
    passes[shared % max(len(network.vertices), 1)] = False
    vertex = np.flatnonzero(passes)
    segments = at_vertex[:, vertex].T
    shares = (network.ends[segments, 1] == vertex[:, None]).astype(np.float64)
    return Crossings(en_m=network.vertices[vertex], segments=segments, shares=shares, vertex=vertex)


def _cross(left: Floats, right: Floats) -> Floats:
    return np.asarray(left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0])


KINDS: Final = (
    *("area", "building", "building_cluster", "crossing", "dead_end", "intersection"),
    *("level_crossing", "river_bend", "road_rail_crossing", "road_water_crossing"),
)
RELATIONS: Final = ("adjacency", "connectivity", "crossing", "membership")
# Kinds of crossings of two layers; that of a railway with a river or a railway is a plain crossing.
CROSSING_KIND: Final = {(ROAD, RAIL): "road_rail_crossing", (ROAD, WATER): "road_water_crossing"}

# Column -> dtype; `geometry` (Point) comes last.
NODE_DTYPES: Final = {
    "id": "int64",
    "kind": "str",
    "degree": "int16",
    "class": "str",
    "osm_id": "int64",
    "area_m2": "float32",
    "count": "int32",
    "level_difference": "int16",
    "bearing_deg": "float32",
}
EDGE_DTYPES: Final = {
    "source": "int64",
    "target": "int64",
    "relation": "str",
    "distance_m": "float32",
    "length_m": "float32",
    "bearing_deg": "float32",
}
PASSING_DEGREE, JUNCTION_DEGREE = 2, 3
AREA_DIMENSION: Final = 2
FULL_TURN_DEG, HALF_TURN_DEG = 360.0, 180.0
SEVERAL: Final = -1


# Waterways: spacing of samples (about the width of a stream with its banks), length of the moving average that hides
# the digitizing noise, length within which a bend must turn (also the least distance between two bends), least turn.
BEND_STEP_M, BEND_SMOOTHING_M, BEND_WINDOW_M, BEND_TURN_DEG = 10.0, 60.0, 120.0, 45.0

Bounds = tuple[float, float, float, float]


def build_graph(features: "gpd.GeoDataFrame", *, bounds_m: Bounds | None = None) -> MapGraph:
    """Derive the graph of a feature table.

    Features that are not visible from above make no node, but roads connect through them. Nothing outside `bounds_m`
    (west, south, east, north) becomes a node, and a road that ends on the border is cut there, not a dead end. Raise
    `ShapeError` if `features` is no feature table.
    """
    check_features(features)
    names = features["class"]
    draft = _Draft()
    ways = _sorted(features[names.isin(list(LAYERS)).to_numpy()])
    _draw_ways(draft, ways, bounds_m)
    is_seen = features["is_visible"].to_numpy()
    _draw_buildings(draft, _sorted(features[is_seen & (names == "building").to_numpy()]), bounds_m)
    # The centroid of the sea depends on where the extract was cut, not on the place.
    is_area = (
        is_seen & names.isin(load_taxonomy().of_graph("area")).to_numpy() & (features["osm_type"] != SEA).to_numpy()
    )
    _draw_areas(draft, _sorted(features[is_area]))
    return draft.finish(features.crs, bounds_m)


def _sorted(features: "gpd.GeoDataFrame") -> "gpd.GeoDataFrame":
    """Sort rows by class, type and id, so that nothing below depends on the order they came in."""
    order = np.lexsort(
        [pd.Categorical(features[name]).codes for name in ("class", "osm_type")] + [features["osm_id"].to_numpy()]
    )
    return features.iloc[order]


class _Draft:
    """Nodes and edges while they are found; edges refer to nodes by the order in which they were added."""

    def __init__(self) -> None:
        self._nodes: list[dict[str, NDArray[np.generic]]] = []
        self._edges: list[tuple[Ints, Ints, Ints, Floats]] = []
        self._count = 0

    def add_nodes(self, kind: str, en_m: Floats, **columns: object) -> Ints:
        """Add nodes at places of shape (N, 2); a missing column gets its "not applicable" value."""
        count = len(en_m)
        values = {
            "degree": 0, "class": "", "osm_id": SEVERAL, "area_m2": np.nan, "count": 1, "level_difference": 0,
            "bearing_deg": np.nan, **columns,
        }  # fmt: skip
        batch = {name: np.broadcast_to(np.asarray(value), count) for name, value in values.items()}
        batch["class"] = batch["class"].astype(object)
        self._nodes.append(batch | {"kind": np.full(count, KINDS.index(kind)), "east": en_m[:, 0], "north": en_m[:, 1]})
        self._count += count
        return np.arange(self._count - count, self._count)

    def add_edges(self, relation: str, source: Ints, target: Ints, length_m: Floats | None = None) -> None:
        """Add edges between existing nodes; skip one that lacks a node (-1) or joins a node to itself."""
        real = (source >= 0) & (target >= 0) & (source != target)
        length_m = np.full(len(source), np.nan) if length_m is None else length_m
        code = np.full(int(real.sum()), RELATIONS.index(relation))
        self._edges.append((code, source[real], target[real], length_m[real]))

    def finish(self, crs: object, bounds_m: Bounds | None) -> MapGraph:
        """Drop nodes outside the bounds, number the rest by kind and place, and measure the edges."""
        table = {name: np.concatenate([batch[name] for batch in self._nodes]) for name in self._nodes[0]}
        en_m = np.column_stack([table["east"], table["north"]])
        order = np.lexsort([table["osm_id"], en_m[:, 1], en_m[:, 0], table["kind"]])
        order = order[_is_inside(en_m[order], bounds_m)]
        new_id = np.full(self._count, -1)
        new_id[order] = np.arange(len(order))
        table |= {"id": new_id, "kind": np.array(KINDS, dtype=object)[table["kind"]]}
        columns = _typed({name: table[name][order] for name in NODE_DTYPES}, NODE_DTYPES)
        nodes = gpd.GeoDataFrame(columns, geometry=gpd.GeoSeries(shapely.points(en_m[order]), crs=crs))
        return MapGraph(nodes=nodes, edges=self._finish_edges(new_id, en_m[order]))

    def _finish_edges(self, new_id: Ints, en_m: Floats) -> "pd.DataFrame":
        code, source, target, length_m = (np.concatenate(part) for part in zip(*self._edges, strict=True))
        source, target = new_id[source], new_id[target]
        is_mutual = np.isin(code, [RELATIONS.index("adjacency"), RELATIONS.index("connectivity")])
        swap = is_mutual & (source > target)
        source, target = np.where(swap, target, source), np.where(swap, source, target)
        order = np.lexsort([length_m, target, source, code])
        order = order[(source[order] >= 0) & (target[order] >= 0)]
        source, target = source[order], target[order]
        along = en_m[target] - en_m[source]
        columns = {
            "source": source,
            "target": target,
            "relation": np.array(RELATIONS, dtype=object)[code[order]],
            "distance_m": np.linalg.norm(along, axis=1),
            "length_m": length_m[order],
            "bearing_deg": _wrapped(bearing_deg(along[:, 0], along[:, 1]), FULL_TURN_DEG),
        }
        return _typed(columns, EDGE_DTYPES)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ways:
    """The network of a map and the attributes of its ways, in one order."""

    network: Network
    names: NDArray[np.object_]  # class of each way
    rank: Ints  # of the class; 0 is the highest
    osm_id: Ints
    height: Ints  # OSM layer; a bridge without one lies above the ground


def _draw_ways(draft: _Draft, ways: "gpd.GeoDataFrame", bounds_m: Bounds | None) -> None:
    names = ways["class"].to_numpy(dtype=object)
    level = ways["level"].to_numpy(dtype=np.int64)
    table = _Ways(
        network=make_network(ways),
        names=names,
        rank=pd.Categorical(names, categories=list(LAYERS)).codes.astype(np.int64),
        osm_id=ways["osm_id"].to_numpy(),
        height=np.where(ways["is_bridge"].to_numpy(), np.maximum(level, 1), level),
    )
    degree = table.network.degree(ROAD)
    is_fork = (degree > 0) & (degree != PASSING_DEGREE)
    roads = make_chains(table.network, ROAD, is_break=is_fork)
    unbroken = np.zeros(len(degree), dtype=bool)
    lines = {layer: make_chains(table.network, layer, is_break=unbroken) for layer in (RAIL, WATER)}
    is_dead = _is_inside(table.network.vertices, bounds_m, on_border=False) & ~_is_on_square(table.network, ways)
    junction = _add_junctions(draft, table, is_dead)
    draft.add_edges("connectivity", junction[roads.tips[:, 0]], junction[roads.tips[:, 1]], roads.length_m)
    stops = _Stops(chains=lines, layers=[], nodes=[], chain=[], at_m=[])
    _add_crossings(draft, table, roads, junction, stops)
    _add_bends(draft, table, stops)
    stops.connect(draft)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stops:
    """Nodes along railways and waterways, collected until they can be sorted."""

    chains: dict[int, Chains]
    layers: list[Ints]
    nodes: list[Ints]
    chain: list[Ints]
    at_m: list[Floats]

    def add(self, layer: int, nodes: Ints, chain: Ints, at_m: Floats) -> None:
        self.layers.append(np.full(len(nodes), layer))
        self.nodes.append(nodes)
        self.chain.append(chain)
        self.at_m.append(at_m)

    def add_on_segments(self, layer: int, nodes: Ints, segments: Ints, shares: Floats) -> None:
        """Record nodes by their share of the way along segments of a layer; skip segments of other layers."""
        chains = self.chains[layer]
        chosen = chains.of_segment[segments] >= 0
        nodes, segments, shares = nodes[chosen], segments[chosen], shares[chosen]
        begin_m, end_m = chains.segment_at_m[segments].T
        self.add(layer, nodes, chains.of_segment[segments], begin_m + shares * (end_m - begin_m))

    def connect(self, draft: _Draft) -> None:
        layer, node, chain = (np.concatenate(part) for part in (self.layers, self.nodes, self.chain))
        at_m = np.concatenate(self.at_m)
        order = np.lexsort([node, at_m, chain, layer])
        here, there = order[:-1], order[1:]
        same = (layer[here] == layer[there]) & (chain[here] == chain[there])
        here, there = here[same], there[same]
        draft.add_edges("connectivity", node[here], node[there], at_m[there] - at_m[here])


def _is_on_square(network: Network, ways: "gpd.GeoDataFrame") -> Bools:
    shapes = np.asarray(ways.geometry.array)
    vertex = network.lookup(shapely.get_coordinates(shapes[shapely.get_dimensions(shapes) == AREA_DIMENSION]))
    return np.isin(np.arange(len(network.vertices)), vertex)


def _add_junctions(draft: _Draft, ways: _Ways, is_dead: Bools) -> Ints:
    """Add intersections and dead ends; return the node at each vertex, -1 where there is none."""
    network = ways.network
    degree, seen = network.degree(ROAD), network.degree(ROAD, visible_only=True)
    carrier = _carriers(ways, ROAD)
    node = np.full(len(degree), -1)
    forks = np.flatnonzero((degree >= JUNCTION_DEGREE) & (seen > 0))
    tips = np.flatnonzero((degree == 1) & (seen == 1) & is_dead)
    for kind, vertex in (("intersection", forks), ("dead_end", tips)):
        way, osm_id = carrier[vertex].T
        node[vertex] = draft.add_nodes(
            kind, network.vertices[vertex], degree=degree[vertex], osm_id=osm_id, **{"class": ways.names[way]}
        )
    return node


def _carriers(ways: _Ways, layer: int) -> Ints:
    """Return way of highest class and OSM id (-1 for several) at each vertex, shape (V, 2); (-1, -1) off the layer."""
    network = ways.network
    chosen = np.flatnonzero(network.layer == layer)
    vertex, way = network.ends[chosen].ravel(), np.repeat(network.way[chosen], 2)
    carrier = np.full((len(network.vertices), 2), -1)
    # Of several values written to one place the last stays: the highest class, and the least and greatest id.
    order = np.argsort(ways.rank[way], kind="stable")[::-1]
    carrier[vertex[order], 0] = way[order]
    order = np.argsort(ways.osm_id[way], kind="stable")
    least, greatest = np.full(len(carrier), SEVERAL), np.full(len(carrier), SEVERAL)
    least[vertex[order[::-1]]] = ways.osm_id[way[order[::-1]]]
    greatest[vertex[order]] = ways.osm_id[way[order]]
    carrier[:, 1] = np.where(least == greatest, least, SEVERAL)
    return carrier


def _add_crossings(draft: _Draft, ways: _Ways, roads: Chains, junction: Ints, stops: _Stops) -> None:
    """Add the places where ways cross, at grade or not; the upper way names the node, else the higher class."""
    network = ways.network
    parts = (find_crossings(network), find_meetings(network, RAIL), find_meetings(network, WATER))
    segments, shares = (np.concatenate([getattr(part, name) for part in parts]) for name in ("segments", "shares"))
    en_m, vertex = (np.concatenate([getattr(part, name) for part in parts]) for name in ("en_m", "vertex"))
    layer, way = network.layer[segments], network.way[segments]
    height, rank = ways.height[way], ways.rank[way]
    is_second = (height[:, 1] > height[:, 0]) | ((height[:, 1] == height[:, 0]) & (rank[:, 1] < rank[:, 0]))
    above = np.where(is_second, way[:, 1], way[:, 0])
    difference = np.abs(height[:, 0] - height[:, 1])
    is_level = (vertex >= 0) & (layer[:, 1] == RAIL)
    above[is_level] = _carriers(ways, ROAD)[vertex[is_level], 0]
    ends = network.degree(ROAD) + network.degree(RAIL)
    kind = np.full(len(vertex), "crossing", dtype=object)
    for pair, name in CROSSING_KIND.items():
        kind[(layer == pair).all(axis=1)] = name
    kind[is_level] = "level_crossing"
    for name in ("crossing", *CROSSING_KIND.values(), "level_crossing"):
        chosen = np.flatnonzero(kind == name)
        nodes = draft.add_nodes(
            name,
            en_m[chosen],
            degree=ends[vertex[chosen]] if name == "level_crossing" else 0,
            level_difference=difference[chosen],
            osm_id=np.where(difference > 0, ways.osm_id[above], SEVERAL)[chosen],
            **{"class": ways.names[above[chosen]]},
        )
        at = np.where(vertex[chosen] >= 0, junction[vertex[chosen]], -1)
        draft.add_edges("crossing", nodes, at)
        for segment, share in zip(segments[chosen].T, shares[chosen].T, strict=True):
            _link_to_ends(draft, roads, junction, nodes[at < 0], segment[at < 0])
            stops.add_on_segments(RAIL, nodes, segment, share)
            stops.add_on_segments(WATER, nodes, segment, share)


def _link_to_ends(draft: _Draft, roads: Chains, junction: Ints, nodes: Ints, segments: Ints) -> None:
    """Link crossings to the junctions at both ends of their roads; skip segments of other layers."""
    chosen = roads.of_segment[segments] >= 0
    for end in roads.tips[roads.of_segment[segments[chosen]]].T:
        draft.add_edges("crossing", nodes[chosen], junction[end])


def _add_bends(draft: _Draft, ways: _Ways, stops: _Stops) -> None:
    from sasgeo_bench.regions.layers import find_bends  # noqa: PLC0415 - as pandas above

    chains, network = stops.chains[WATER], ways.network
    bends = find_bends(
        chains.en_m,
        chains.at_m,
        chains.first,
        step_m=BEND_STEP_M,
        smoothing_m=BEND_SMOOTHING_M,
        window_m=BEND_WINDOW_M,
        turn_deg=BEND_TURN_DEG,
    )
    segment = chains.segment_at(bends.line, bends.at_m)
    seen = np.flatnonzero(network.is_visible[segment])
    way = network.way[segment[seen]]
    nodes = draft.add_nodes(
        "river_bend",
        bends.en_m[seen],
        osm_id=ways.osm_id[way],
        bearing_deg=_wrapped(bearing_deg(*bends.inward[seen].T), FULL_TURN_DEG),
        **{"class": ways.names[way]},
    )
    stops.add(WATER, nodes, bends.line[seen], bends.at_m[seen])


def _draw_buildings(draft: _Draft, buildings: "gpd.GeoDataFrame", bounds_m: Bounds | None) -> None:
    from sasgeo_bench.regions.layers import (  # noqa: PLC0415 - as pandas above
        centroids,
        delaunay_pairs,
        groups_within,
        long_sides,
    )

    shapes = np.asarray(buildings.geometry.array)
    en_m = centroids(shapes)
    is_real = np.isfinite(en_m).all(axis=1) & _is_inside(en_m, bounds_m)
    shapes, en_m, osm_id = shapes[is_real], en_m[is_real], buildings["osm_id"].to_numpy()[is_real]
    area_m2 = shapely.area(shapes)
    bearing = _wrapped(bearing_deg(*long_sides(shapes).T), HALF_TURN_DEG)
    about = {"class": "building"}
    nodes = draft.add_nodes("building", en_m, osm_id=osm_id, area_m2=area_m2, bearing_deg=bearing, **about)
    pairs = delaunay_pairs(en_m, 60.0)  # m between centres: across one street, not across a block
    draft.add_edges("adjacency", *nodes[pairs].T)

    # 15 m: more than between neighbours, less than a street with two front gardens (20 m and more)
    group = groups_within(shapes, 15.0)
    size = np.bincount(group)
    chosen = np.flatnonzero(size >= 3)  # two houses are a pair, and are nodes anyway
    area = np.bincount(group, weights=area_m2)
    weight = area_m2 / area[group]
    centre: Floats = np.column_stack(
        [np.bincount(group, weights=weight * part, minlength=len(size)) for part in en_m.T]
    )
    clusters = draft.add_nodes("building_cluster", centre[chosen], area_m2=area[chosen], count=size[chosen], **about)
    cluster = np.full(len(size), -1)
    cluster[chosen] = clusters
    draft.add_edges("membership", nodes, cluster[group])
    near = np.unique(np.sort(cluster[group[pairs]], axis=1), axis=0)
    draft.add_edges("adjacency", *near.T)


def _draw_areas(draft: _Draft, areas: "gpd.GeoDataFrame") -> None:
    """Add waters, greens, fields and car parks; those that touch or overlap are adjacent."""
    from sasgeo_bench.regions.layers import centroids, touching_pairs  # noqa: PLC0415 - as pandas above

    shapes = np.asarray(areas.geometry.array)
    is_real = (shapely.get_dimensions(shapes) == AREA_DIMENSION) & ~shapely.is_empty(shapes)
    shapes, areas = shapes[is_real], areas[is_real]
    nodes = draft.add_nodes(
        "area",
        centroids(shapes),
        osm_id=areas["osm_id"].to_numpy(),
        area_m2=shapely.area(shapes),
        **{"class": areas["class"].to_numpy(dtype=object)},
    )
    pairs = touching_pairs(shapes)
    draft.add_edges("adjacency", *nodes[pairs].T)


def _typed(columns: Mapping[str, object], dtypes: Mapping[str, str]) -> "pd.DataFrame":
    return pd.DataFrame({name: columns[name] for name in dtypes}).astype(dict(dtypes))


def _is_inside(en_m: Floats, bounds_m: Bounds | None, *, on_border: bool = True) -> Bools:
    """Return which places lie in the bounds; `on_border` is the answer for the border itself."""
    if bounds_m is None:
        return np.ones(len(en_m), dtype=bool)
    west, south, east, north = bounds_m
    if on_border:
        return np.asarray(((en_m >= (west, south)) & (en_m <= (east, north))).all(axis=1))
    return np.asarray(((en_m > (west, south)) & (en_m < (east, north))).all(axis=1))


def _wrapped(angle_deg: Floats, turn_deg: float) -> NDArray[np.float32]:
    """Return angles in [0, turn) that stay below the turn when stored in four bytes."""
    short = np.mod(angle_deg, turn_deg).astype(np.float32)
    return np.where(short >= turn_deg, np.float32(0), short)
