# SPDX-License-Identifier: Apache-2.0
"""Roads, railways and waterways as networks: shared vertices, segments, chains between breaks, crossings in plan."""

from dataclasses import dataclass
from typing import Final

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.shapes import overlapping

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


def make_network(ways: gpd.GeoDataFrame) -> Network:
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
