# SPDX-License-Identifier: Apache-2.0
"""The map graph: a village counted by hand, and what must not change when the map is shuffled, moved or turned."""

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.regions.graph import EDGE_DTYPES, NODE_DTYPES, build_graph
from sasgeo_bench.regions.region import MapGraph
from tests.drawn_features import features_of

Row = dict[str, Any]
BOUNDS_M = (0.0, 0.0, 1000.0, 1000.0)


def line(osm_id: int, name: str, *corners: tuple[float, float], **columns: object) -> Row:
    return {"osm_id": osm_id, "class": name, "geometry": shapely.LineString(corners), **columns}


def area(osm_id: int, name: str, *box: float, **columns: object) -> Row:
    return {"osm_id": osm_id, "class": name, "geometry": shapely.box(*box), **columns}


def table(*rows: Row) -> gpd.GeoDataFrame:
    return features_of(*rows, width_m=5.0)


def village() -> gpd.GeoDataFrame:
    above = {"is_bridge": True, "level": 1}
    below = {"is_tunnel": True, "is_visible": False, "level": -1}
    return table(
        # The main road runs from border to border, with a T, an X and a level crossing on it.
        line(1, "road_major", (0, 500), (200, 500), (400, 500), (600, 500), (1000, 500)),
        line(2, "road_minor", (400, 500), (400, 700)),
        line(3, "road_minor", (600, 300), (600, 500), (600, 800)),
        # A roundabout south of the X, and from it a bridge over the river to the border.
        line(4, "road_minor", (600, 300), (620, 280), (600, 260), (580, 280), (600, 300)),
        line(5, "road_minor", (600, 260), (600, 0), **above),
        line(5, "bridge", (600, 260), (600, 0), **above),
        line(6, "road_minor", (800, 400), (800, 600), **above),
        # North of the X the road dives into a tunnel and comes out again.
        line(8, "road_minor", (600, 800), (600, 900), **below),
        line(9, "road_minor", (600, 900), (600, 950)),
        line(10, "railway", (200, 0), (200, 500), (200, 1000)),
        line(11, "path_track", (150, 800), (250, 800), **above),
        line(12, "waterway", (210, 50), (300, 50), (300, 200), (1000, 200)),
        *(area(20 + i, "building", 420 + 15 * i, 620, 430 + 15 * i, 628) for i in range(4)),
        area(24, "building", 900, 850, 908, 870),
        area(25, "building", 905, 900, 925, 910, is_visible=False),
        area(30, "green", 700, 700, 800, 800),
        area(31, "farmland", 800, 700, 900, 800),
    )


def places(graph: MapGraph, kind: str) -> list[tuple[float, float]]:
    points = graph.nodes.geometry[graph.nodes["kind"] == kind]
    return [(round(point.x, 3), round(point.y, 3)) for point in points]


def links(graph: MapGraph, relation: str) -> list[tuple[tuple[int, int], tuple[int, int], float]]:
    points = [(round(point.x), round(point.y)) for point in graph.nodes.geometry]
    edges = graph.edges[graph.edges["relation"] == relation]
    ends = zip(edges["source"], edges["target"], edges["length_m"], strict=True)
    return sorted((*sorted((points[a], points[b])), round(length, 1)) for a, b, length in ends)


def only(graph: MapGraph, kind: str) -> pd.Series:
    nodes = graph.nodes[graph.nodes["kind"] == kind]
    assert len(nodes) == 1
    return nodes.iloc[0]


@pytest.fixture(scope="module")
def graph() -> MapGraph:
    return build_graph(village(), bounds_m=BOUNDS_M)


def test_the_village_has_the_nodes_counted_by_hand(graph: MapGraph) -> None:
    counted = {
        "intersection": 4,
        "dead_end": 6,
        "crossing": 1,
        "level_crossing": 1,
        "road_rail_crossing": 1,
        "road_water_crossing": 1,
        "building": 5,
        "building_cluster": 1,
        "river_bend": 2,
        "area": 2,
    }
    assert graph.nodes["kind"].value_counts().to_dict() == counted
    assert graph.nodes["id"].tolist() == list(range(24))


def test_intersections_have_the_degree_of_their_roads_and_neither_clip_edge_nor_portal_is_a_dead_end(graph) -> None:
    assert places(graph, "intersection") == [(400, 500), (600, 260), (600, 300), (600, 500)]
    nodes = graph.nodes[graph.nodes["kind"] == "intersection"]
    assert nodes["degree"].tolist() == [3, 3, 3, 4]
    assert nodes["class"].tolist() == ["road_major", "road_minor", "road_minor", "road_major"]
    assert (nodes["osm_id"] == -1).all()
    assert places(graph, "dead_end") == [(150, 800), (250, 800), (400, 700), (600, 950), (800, 400), (800, 600)]
    found = places(build_graph(village()), "dead_end")
    assert {(0, 500), (1000, 500), (600, 0)} <= set(found)
    assert len(found) == 9


def test_roads_connect_their_junctions_through_the_tunnel_and_both_ways_round(graph: MapGraph) -> None:
    arc = round(40 * 2**0.5, 1)
    assert links(graph, "connectivity") == sorted(
        [
            ((400, 500), (600, 500), 200.0),
            ((400, 500), (400, 700), 200.0),
            ((600, 300), (600, 500), 200.0),
            ((600, 260), (600, 300), arc),
            ((600, 260), (600, 300), arc),
            ((600, 500), (600, 950), 450.0),
            ((800, 400), (800, 600), 200.0),
            ((150, 800), (250, 800), 100.0),
            ((200, 500), (200, 800), 300.0),  # along the railway
            ((300, 50), (300, 200), 150.0),  # along the river
            ((300, 200), (600, 200), 300.0),
        ]
    )


def test_crossings_name_the_way_above_and_how_far_above(graph: MapGraph) -> None:
    seen = {
        kind: (*places(graph, kind)[0], *only(graph, kind)[["class", "osm_id", "level_difference", "degree"]])
        for kind in ("crossing", "road_rail_crossing", "road_water_crossing", "level_crossing")
    }
    assert seen == {
        "crossing": (800, 500, "road_minor", 6, 1, 0),
        "road_rail_crossing": (200, 800, "path_track", 11, 1, 0),
        "road_water_crossing": (600, 200, "road_minor", 5, 1, 0),
        "level_crossing": (200, 500, "road_major", -1, 0, 4),
    }


def test_crossings_point_to_the_junctions_along_their_roads(graph: MapGraph) -> None:
    assert [edge[:2] for edge in links(graph, "crossing")] == [
        ((150, 800), (200, 800)),
        ((200, 500), (400, 500)),
        ((200, 800), (250, 800)),
        ((600, 200), (600, 260)),
        ((600, 500), (800, 500)),
        ((800, 400), (800, 500)),
        ((800, 500), (800, 600)),
    ]
    edges = graph.edges[graph.edges["relation"] == "crossing"]
    assert graph.nodes["kind"].to_numpy()[edges["source"]].tolist().count("crossing") == 3
    assert edges["length_m"].isna().all()


def test_four_houses_in_a_row_are_a_cluster_and_the_lone_house_is_not(graph: MapGraph) -> None:
    cluster = only(graph, "building_cluster")
    assert places(graph, "building_cluster") == [(447.5, 624)]
    assert (cluster["count"], cluster["area_m2"], cluster["osm_id"]) == (4, 320.0, -1)
    houses = graph.nodes[graph.nodes["kind"] == "building"]
    np.testing.assert_allclose(houses["bearing_deg"], [90, 90, 90, 90, 0])
    members = graph.edges[graph.edges["relation"] == "membership"]
    assert set(members["target"]) == {cluster["id"]}
    assert set(members["source"]) == set(houses["id"][:4])


def test_houses_in_a_row_are_adjacent_to_the_next_and_areas_to_those_they_touch(graph: MapGraph) -> None:
    assert [edge[:2] for edge in links(graph, "adjacency")] == [
        ((425, 624), (440, 624)),
        ((440, 624), (455, 624)),
        ((455, 624), (470, 624)),
        ((750, 750), (850, 750)),
    ]


def test_the_river_bends_twice_towards_the_inside_and_water_over_it_changes_nothing(graph) -> None:
    assert places(graph, "river_bend") == [(300, 50), (300, 200)]
    bends = graph.nodes[graph.nodes["kind"] == "river_bend"]
    np.testing.assert_allclose(bends["bearing_deg"], [315, 135], atol=0.1)
    water = table(area(99, "water", 280, 0, 1000, 300))
    wet = build_graph(pd.concat([village(), water], ignore_index=True), bounds_m=BOUNDS_M)
    for kind in ("river_bend", "road_water_crossing"):
        assert places(wet, kind) == places(graph, kind)
        assert places(graph, kind)


def test_edges_have_the_distance_and_bearing_from_source_to_target(graph: MapGraph) -> None:
    edge = graph.edges[(graph.edges["relation"] == "connectivity") & (graph.edges["length_m"] == 450)].iloc[0]
    points = graph.nodes.geometry
    assert (points[edge["source"]].y, points[edge["target"]].y) == (950, 500)
    assert (edge["distance_m"], edge["bearing_deg"]) == (450.0, 180.0)


def test_columns_have_the_types_of_the_schema_even_when_empty_and_others_are_refused(graph) -> None:
    for found in (graph, build_graph(table())):
        assert {name: str(kind) for name, kind in found.nodes.dtypes.items() if name != "geometry"} == NODE_DTYPES
        assert {name: str(kind) for name, kind in found.edges.dtypes.items()} == EDGE_DTYPES
        assert found.nodes.crs == village().crs
    empty = build_graph(table())
    assert (len(empty.nodes), len(empty.edges)) == (0, 0)
    with pytest.raises(ShapeError, match="columns"):
        build_graph(village().drop(columns="level"))


def test_a_tram_in_its_street_makes_no_level_crossing_but_where_it_leaves_it_may() -> None:
    street = line(1, "road_minor", (0, 0), (50, 0), (100, 0), (200, 0))
    tram = line(2, "railway", (0, 0), (50, 0), (100, 0), (100, 90))
    across = line(3, "path_track", (80, 40), (100, 40), (120, 40))
    cut = line(2, "railway", (0, 0), (50, 0), (100, 0), (100, 40), (100, 90))
    assert places(build_graph(table(street, tram)), "level_crossing") == []
    assert places(build_graph(table(street, cut, across)), "level_crossing") == [(100, 40)]


def test_a_culvert_under_a_road_is_no_crossing_and_a_ford_is_one_and_a_path_may_end_on_a_square() -> None:
    road = line(1, "road_minor", (0, 0), (50, 0), (100, 0))
    culvert = line(2, "waterway", (25, -50), (25, 50), is_visible=False, is_tunnel=True)
    ford = line(3, "waterway", (50, -50), (50, 0), (50, 50))
    graph = build_graph(table(road, culvert, ford))
    assert places(graph, "road_water_crossing") == [(50, 0)]
    assert only(graph, "road_water_crossing")["level_difference"] == 0
    path = line(1, "path_track", (0, 5), (50, 0))
    square = {"osm_id": 2, "class": "road_minor", "geometry": shapely.Polygon([(50, 0), (90, 0), (90, 40), (50, 40)])}
    assert places(build_graph(table(path, square)), "dead_end") == [(0, 5)]


def test_a_loop_on_one_junction_has_no_edge_to_itself_and_a_free_ring_no_junction() -> None:
    loop = line(1, "road_minor", (0, 0), (50, 50), (100, 0), (50, -50), (0, 0))
    arm = line(2, "road_minor", (-90, 0), (0, 0))
    graph = build_graph(table(loop, arm))
    assert places(graph, "intersection") == [(0, 0)]
    assert links(graph, "connectivity") == [((-90, 0), (0, 0), 90.0)]
    assert len(build_graph(table(loop)).nodes) == 0


@pytest.mark.parametrize(("gap_m", "clusters"), [(14.0, 1), (16.0, 0)])
def test_the_gap_of_the_rules_decides_what_is_a_cluster(gap_m: float, clusters: int) -> None:
    houses = [area(i, "building", i * (10 + gap_m), 0, i * (10 + gap_m) + 10, 8) for i in range(3)]
    assert len(places(build_graph(table(*houses)), "building_cluster")) == clusters


def differences(left: MapGraph, right: MapGraph) -> list[str]:
    """Names of the tables that differ."""
    pairs = {"nodes": (pd.DataFrame(left.nodes), pd.DataFrame(right.nodes)), "edges": (left.edges, right.edges)}
    return [name for name, (here, there) in pairs.items() if not here.equals(there)]


def unordered(graph: MapGraph, move: Callable[[float, float], tuple[float, float]], turn_deg: float) -> list[list[Any]]:
    """What the graph says apart from ids, with every place moved and every bearing turned."""
    place = [tuple(round(value, 2) + 0.0 for value in move(point.x, point.y)) for point in graph.nodes.geometry]
    nodes = graph.nodes.drop(columns=["id", "geometry", "bearing_deg", "area_m2"])
    half = (graph.nodes["kind"] == "building").map({True: 180.0, False: 360.0})
    turned = ((graph.nodes["bearing_deg"] + turn_deg) % half).round(1).fillna(-1) % half
    facts = zip(place, turned, nodes.itertuples(index=False, name=None), strict=True)
    edges = []
    for edge in graph.edges.itertuples():
        source, target, bearing = place[edge.source], place[edge.target], edge.bearing_deg + turn_deg
        if edge.relation in ("adjacency", "connectivity") and source > target:
            source, target, bearing = target, source, bearing + 180
        lengths = (round(edge.distance_m, 1), -1 if np.isnan(edge.length_m) else round(edge.length_m, 1))
        shown = round(bearing % 360, 1) % 360 if edge.distance_m > 1e-3 else 0  # two nodes at one place
        edges.append((edge.relation, source, target, *lengths, shown))
    return [sorted(facts), sorted(edges)]


def moved(features: gpd.GeoDataFrame, matrix: list[float]) -> gpd.GeoDataFrame:
    """Apply x' = a x + b y + e, y' = c x + d y + f."""
    return features.assign(geometry=features.geometry.affine_transform(matrix)).pipe(gpd.GeoDataFrame)


def test_turning_the_village_a_quarter_clockwise_adds_90_deg_to_its_bearings(graph: MapGraph) -> None:
    turned = build_graph(moved(village(), [0, 1, -1, 0, 0, 0]), bounds_m=(0.0, -1000.0, 1000.0, 0.0))
    assert unordered(turned, lambda x, y: (x, y), 0) == unordered(graph, lambda x, y: (y, -x), 90)


corners = st.tuples(st.integers(0, 8), st.integers(0, 8)).map(lambda cell: (cell[0] * 50.0, cell[1] * 50.0))
ways = st.tuples(
    st.sampled_from(["road_major", "road_minor", "path_track", "railway", "waterway"]),
    st.lists(corners, min_size=2, max_size=4, unique=True),
    st.integers(-1, 1),
)
houses = st.tuples(st.integers(0, 40), st.integers(0, 40))
places_drawn = st.tuples(st.lists(ways, max_size=7), st.lists(houses, max_size=6, unique=True))


def drawn(place: tuple[list[Any], list[Any]]) -> list[Row]:
    lines = [
        line(i, name, *path, level=level, is_visible=level >= 0) for i, (name, path, level) in enumerate(place[0], 1)
    ]
    return lines + [area(100 + i, "building", 9 * x, 9 * y, 9 * x + 8, 9 * y + 5) for i, (x, y) in enumerate(place[1])]


@settings(max_examples=20, deadline=None)
@given(place=places_drawn, random=st.randoms(use_true_random=False))
def test_the_order_of_the_features_does_not_matter(place: tuple[list[Any], list[Any]], random: Any) -> None:
    rows = drawn(place)
    shuffled = random.sample(rows, len(rows))
    assert differences(build_graph(table(*rows)), build_graph(table(*shuffled))) == []


# Diagonals of the lattice turn by 45 deg exactly: what the last bits decide is no property of the map.
@patch("sasgeo_bench.regions.graph.BEND_TURN_DEG", 40.0)
@settings(max_examples=20, deadline=None)
@given(place=places_drawn, east=st.integers(-9, 9), north=st.integers(-9, 9))
def test_moving_the_map_moves_the_nodes_and_nothing_else(place, east, north) -> None:
    here = table(*drawn(place))
    there = build_graph(moved(here, [1, 0, 0, 1, east * 65536, north * 65536]))
    back = unordered(there, lambda x, y: (x - east * 65536, y - north * 65536), 0)
    assert back == unordered(build_graph(here), lambda x, y: (x, y), 0)


@settings(max_examples=20, deadline=None)
@given(place=places_drawn)
def test_turning_the_map_turns_the_bearings_and_nothing_else(place) -> None:
    # Without waterways: of two equal samples of a bend the line's direction picks one. The village has bends.
    # Sheared, so that no four corners of the lattice lie on one circle, where the last bit picks a diagonal.
    lattice = table(*(row for row in drawn(place) if row["class"] != "waterway"))
    here = moved(lattice, [1, 0.137, 0.071, 1, 0, 0])
    turned = build_graph(moved(here, [0, 1, -1, 0, 0, 0]))
    assert unordered(turned, lambda x, y: (x, y), 0) == unordered(build_graph(here), lambda x, y: (y, -x), 90)


@settings(max_examples=20, deadline=None)
@given(place=places_drawn)
def test_edges_join_two_nodes_and_measure_the_way_no_shorter_than_the_straight_line(place) -> None:
    edges = build_graph(table(*drawn(place))).edges
    assert (edges["source"] != edges["target"]).all()
    along = edges[edges["relation"] == "connectivity"]
    assert (along["length_m"] >= along["distance_m"] - 1e-3).all()
    assert edges["bearing_deg"].between(0, 360, inclusive="left").all()
