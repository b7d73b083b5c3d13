# SPDX-License-Identifier: Apache-2.0
"""The graph of a map as masks show it: what lies at which level makes no difference."""

import numpy as np
import pytest
import shapely
from hypothesis import assume, example, given
from hypothesis import strategies as st

from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.sasgeo.nodes import INDEX, in_plan, nodes_of
from sasgeo_bench.tasks.twin import level_crossings
from sasgeo_bench.tasks.vectors import as_features, vector_table

PLACES = st.tuples(st.integers(-200, 200), st.integers(-200, 200))
ROADS = st.lists(st.lists(PLACES, min_size=2, max_size=4, unique=True), min_size=2, max_size=5)


def ways(lines, name="road_minor"):
    """Each road a level above the one before it, so that nothing meets where it crosses."""
    return as_features(vector_table([(name, level, level > 0, line) for level, line in enumerate(lines)]))


def in_mask(features):
    """Nodes and links as a mask shows them, in an order of their own."""
    plan = in_plan(features)
    nodes = nodes_of(build_graph(plan), plan, "mask")
    order = np.lexsort(nodes.places_m.round(1).T)
    rank = np.argsort(order)
    links = sorted({tuple(sorted(rank[pair].tolist())) for pair in nodes.pairs})
    return nodes, order, links


def assert_same_in_a_mask(one, other):
    (left, by, links), (right, at, others) = in_mask(one), in_mask(other)
    assert left.kind[by].tolist() == right.kind[at].tolist()
    np.testing.assert_allclose(left.places_m[by], right.places_m[at], atol=2e-3)
    assert left.degree[by].tolist() == right.degree[at].tolist()
    arms = [np.sort(nodes.arms_deg[order] % 359.9, axis=1) for nodes, order in ((left, by), (right, at))]
    np.testing.assert_allclose(*arms, atol=0.2)
    assert links == others


@given(ROADS)
@example([[(-100, 0), (100, 0)], [(0, -100), (0, 100)]])
@example([[(-100, 0), (100, 0)], [(-50, -100), (-50, 100)], [(30, -90), (30, 100)]])
@example([[(-100, 0), (0, 0), (100, 0)], [(0, -100), (0, 100)]])  # one has a vertex there already
def test_roads_on_bridges_give_the_nodes_arms_and_links_of_roads_that_meet(places):
    lines = [shapely.LineString(points) for points in places]
    assume(all(line.is_simple for line in lines))
    both = [(one, two) for at, one in enumerate(lines) for two in lines[:at]]
    # Ends on another road, and roads along each other, meet in one of the two maps alone.
    assume(all(one.relate(two)[0] in "0F" and one.boundary.distance(two) > 1 for one, two in both))
    assume(all(one.distance(two.boundary) > 1 for one, two in both))
    corners = [shapely.MultiPoint(shapely.get_coordinates(line)) for line in lines]
    crossings = [shapely.intersection(one, two) for one, two in both]
    away_m = [part.distance(place) for place in crossings if not place.is_empty for part in corners]
    assume(all(distance == 0 or distance > 0.01 for distance in away_m))
    features = ways(lines)
    assert_same_in_a_mask(features, level_crossings(features))


def test_a_road_that_crosses_itself_meets_itself_in_a_mask():
    loop = shapely.LineString([(-100, 0), (100, 0), (100, 100), (0, 100), (0, -100)])
    nodes, *_ = in_mask(ways([loop]))
    at = np.flatnonzero(nodes.kind == INDEX["mask intersection"])
    assert nodes.places_m[at].tolist() == [[0.0, 0.0]]
    assert nodes.degree[at].tolist() == [4]
    assert np.sort(nodes.arms_deg[at][0, :4]) == pytest.approx([0, 90, 180, 270])


def test_a_railway_over_a_road_is_the_level_crossing_that_it_looks_like():
    road, rail = shapely.from_wkt(["LINESTRING (-90 0, 0 0, 90 0)", "LINESTRING (0 -90, 0 0, 0 90)"])
    level = [("road_minor", 0, False, road), ("railway", 0, False, rail)]
    over = [("road_minor", 0, False, shapely.LineString([(-90, 0), (90, 0)])), ("railway", 1, True, rail)]
    assert_same_in_a_mask(*(as_features(vector_table(rows)) for rows in (level, over)))


def test_what_lies_in_a_tunnel_is_not_in_a_mask():
    lines = shapely.from_wkt(["LINESTRING (-90 0, 90 0)", "LINESTRING (0 -90, 0 90)"])
    features = ways(lines)
    features["is_visible"] = [True, False]
    nodes, *_ = in_mask(features)
    assert np.abs(nodes.places_m).max(axis=1).tolist() == [90.0, 90.0]
    assert set(nodes.kind.tolist()) == {INDEX["mask dead_end"]}
