# SPDX-License-Identifier: Apache-2.0
"""Derive a MapGraph from features: junctions, crossings, buildings, clusters, areas, bends, and relations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.osm.features import SEA, check_features
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.network import (
    LAYERS,
    RAIL,
    ROAD,
    WATER,
    Bools,
    Chains,
    Floats,
    Ints,
    Network,
    find_crossings,
    find_meetings,
    make_chains,
    make_network,
)
from sasgeo_bench.regions.region import MapGraph
from sasgeo_bench.regions.shapes import centroids, delaunay_pairs, find_bends, groups_within, long_sides, touching_pairs

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


def build_graph(features: gpd.GeoDataFrame, *, bounds_m: Bounds | None = None) -> MapGraph:
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


def _sorted(features: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
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

    def _finish_edges(self, new_id: Ints, en_m: Floats) -> pd.DataFrame:
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


def _draw_ways(draft: _Draft, ways: gpd.GeoDataFrame, bounds_m: Bounds | None) -> None:
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


def _is_on_square(network: Network, ways: gpd.GeoDataFrame) -> Bools:
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


def _draw_buildings(draft: _Draft, buildings: gpd.GeoDataFrame, bounds_m: Bounds | None) -> None:
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


def _draw_areas(draft: _Draft, areas: gpd.GeoDataFrame) -> None:
    """Add waters, greens, fields and car parks; those that touch or overlap are adjacent."""
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


def _typed(columns: Mapping[str, object], dtypes: Mapping[str, str]) -> pd.DataFrame:
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
