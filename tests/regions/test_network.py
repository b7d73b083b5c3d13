# SPDX-License-Identifier: Apache-2.0
"""The network of ways, held against slow and plain ways to say the same."""

from itertools import combinations, pairwise

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.regions.graph import RAIL, ROAD, WATER, find_crossings, find_meetings, make_chains, make_network

corners = st.tuples(st.integers(0, 6), st.integers(0, 6))
paths = st.lists(st.lists(corners, min_size=2, max_size=5, unique=True), min_size=1, max_size=8)


def ways(*paths: list[tuple[float, float]], name: str = "road_minor", visible: bool = True) -> gpd.GeoDataFrame:
    lines = [shapely.LineString(path) for path in paths]
    return gpd.GeoDataFrame({"class": [name] * len(lines), "is_visible": [visible] * len(lines)}, geometry=lines)


def segments(paths: list[list[tuple[int, int]]]) -> set[frozenset[tuple[int, int]]]:
    return {frozenset(pair) for path in paths for pair in pairwise(path)}


@given(paths=paths)
def test_the_degree_of_a_vertex_counts_the_different_segments_that_end_there(paths: list) -> None:
    network = make_network(ways(*paths))
    found = {tuple(place): n for place, n in zip(network.vertices.tolist(), network.degree(ROAD), strict=True)}
    ends = [corner for segment in segments(paths) for corner in segment]
    assert found == {corner: ends.count(corner) for corner in ends}


@given(paths=paths)
def test_chains_hold_every_segment_once_and_fork_nowhere_inside(paths: list) -> None:
    network = make_network(ways(*paths))
    degree = network.degree(ROAD)
    chains = make_chains(network, ROAD, is_break=degree != 2)
    drawn_m = sum(np.hypot(*np.subtract(*segment)) for segment in segments(paths))
    assert chains.length_m.sum() == pytest.approx(drawn_m)
    assert (chains.of_segment >= 0).all()
    step_m = np.abs(np.diff(chains.segment_at_m, axis=1))[:, 0]
    np.testing.assert_allclose(step_m, np.linalg.norm(np.diff(network.vertices[network.ends], axis=1)[:, 0], axis=1))
    is_open = chains.tips[:, 0] != chains.tips[:, 1]
    assert (degree[chains.tips[is_open]] != 2).all()
    middle_m = chains.segment_at_m.mean(axis=1)
    np.testing.assert_array_equal(chains.segment_at(chains.of_segment, middle_m), np.arange(len(network.ends)))


irrational = st.tuples(st.floats(0, 100), st.floats(0, 100)).map(lambda xy: (round(xy[0], 2), round(xy[1], 2)))


@settings(deadline=None)
@given(pairs=st.lists(st.tuples(irrational, irrational), min_size=2, max_size=9, unique=True))
def test_crossings_are_those_that_a_test_of_every_pair_finds(pairs: list) -> None:
    lines = [shapely.LineString(pair) for pair in pairs if shapely.LineString(pair).length > 1]
    far = [
        (left, right)
        for left, right in combinations(lines, 2)
        # Ends within a centimetre of the other line are for the tests below.
        if min(*(shapely.distance(right, shapely.boundary(left).geoms).tolist()), 1) > 0.01
        and min(*(shapely.distance(left, shapely.boundary(right).geoms).tolist()), 1) > 0.01
    ]
    for left, right in far:
        found = find_crossings(make_network(ways(list(left.coords), list(right.coords))))
        expected = shapely.get_coordinates(left.intersection(right)) if left.crosses(right) else np.empty((0, 2))
        np.testing.assert_allclose(found.en_m, expected, atol=1e-6)


def test_a_way_with_a_vertex_on_another_crosses_it_once_and_one_that_ends_on_or_runs_along_it_does_not() -> None:
    road = [(0.0, 0.0), (100.0, 0.0)]
    through = [(50.0, -40.0), (50.0, 0.0), (60.0, 40.0)]
    assert find_crossings(make_network(ways(road, through))).en_m.tolist() == [[50, 0]]
    assert find_crossings(make_network(ways(road, through[:2], through[1:]))).en_m.tolist() == [[50, 0]]
    assert len(find_crossings(make_network(ways(road, through[:2]))).en_m) == 0
    assert len(find_crossings(make_network(ways([(0, 0), (90, 0)], [(30, 0), (120, 0)]))).en_m) == 0
    cross = ([(0, 0), (90, 0)], [(30, -9), (30, 9)])
    assert len(find_crossings(make_network(ways(*cross))).en_m) == 1
    assert len(find_crossings(make_network(ways(*cross, visible=False))).en_m) == 0
    assert len(find_crossings(make_network(ways(*cross, name="waterway"))).en_m) == 0


def test_an_empty_table_makes_an_empty_network() -> None:
    network = make_network(gpd.GeoDataFrame({"class": [], "is_visible": []}, geometry=[]))
    chains = make_chains(network, WATER, is_break=np.zeros(0, dtype=bool))
    assert (len(network.ends), len(chains.length_m), len(find_crossings(network).en_m)) == (0, 0, 0)
    assert len(find_meetings(network, RAIL).vertex) == 0
    assert network.lookup(np.zeros((2, 2))).tolist() == [-1, -1]


def test_a_river_runs_on_past_its_tributary() -> None:
    network = make_network(ways([(0, 0), (50, 0), (99, 0)], [(50, 40), (50, 0)], name="waterway"))
    chains = make_chains(network, WATER, is_break=np.zeros(len(network.vertices), dtype=bool))
    assert sorted(chains.length_m.tolist()) == [40, 99]
