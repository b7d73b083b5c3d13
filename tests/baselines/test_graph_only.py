# SPDX-License-Identifier: Apache-2.0
"""`graph_only`: what it tells apart, with and without vectors, and what it does not look at."""

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely
from sasgeo_baselines import graph_only
from sasgeo_baselines.graph_only import KINDS, GraphOnly, Nodes

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import WITHHELD, check_match
from sasgeo_bench.osm.features import DTYPES, make_features
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.graph import build_graph

NORTH = Prior(center_m=None, radius_m=None, yaw_deg=0.0, yaw_sigma_deg=5.0, scale_sigma=0.0)
PLACES = tuple(Pose(easting_m=1000.0 + east_m, northing_m=8904.0, yaw_deg=0.0) for east_m in (300, 100, 200))
RING = ((30, 30), (30, 56), (56, 30), (56, 56))
ROW = ((44, 20), (44, 36), (44, 52), (44, 68))
# A crossroads, and two forks 20 m apart; (right, up) in metres.
CROSS = (((-40, 0), (0, 0), (40, 0)), ((0, -40), (0, 0), (0, 40)))
FORKS = (((-40, 0), (-10, 0), (10, 0), (40, 0)), ((-10, -40), (-10, 0)), ((10, 0), (10, 40)))


def houses(corners) -> np.ndarray:
    layers = np.zeros((3, 96, 96), dtype=np.uint8)
    for row, col in corners:
        layers[0, row : row + 10, col : col + 10] = 1
    return layers


def features_of(lines) -> gpd.GeoDataFrame:
    count = len(lines)
    columns = {name: np.zeros(count) for name in DTYPES} | {
        "osm_type": ["way"] * count,
        "osm_id": np.arange(count),
        "timestamp": [None] * count,
        "class": ["road_minor"] * count,
        "is_visible": np.ones(count, dtype=bool),
        "geometry": [shapely.LineString(line) for line in lines],
    }
    return make_features(columns, epsg=32632)


def vectors_of(lines) -> gpd.GeoDataFrame:
    shapes = [shapely.LineString(line) for line in lines]
    columns = {"class": ["road_minor"] * len(lines), "level": np.int16(0), "is_bridge": False}
    return gpd.GeoDataFrame(columns, geometry=shapes)


def moved(lines, place: Pose):
    return [[(place.easting_m + right, place.northing_m + up) for right, up in line] for line in lines]


@pytest.fixture
def prepared(made):
    """A map with a ring of houses, a row of them, and nothing; their roads are forks, a crossroads and none."""
    layers = np.zeros((3, 192, 400), dtype=np.uint8)
    for start, corners in ((52, RING), (152, ROW)):
        layers[:, 48:144, start : start + 96] |= houses(corners)
    region = made.region_of(layers)
    region.graph = build_graph(features_of([*moved(FORKS, PLACES[1]), *moved(CROSS, PLACES[2])]))
    matcher = GraphOnly()
    matcher.prepare(region, None)
    return matcher


def view_of(made, corners) -> Evidence:
    return Evidence(classes=made.classes, cells=houses(corners), cell_size_m=1.0)


def scores(made, matcher, view, *, vectors=None) -> dict[float, float]:
    """Score by easting."""
    query = replace(made.query_of(view, NORTH, candidates=PLACES), vectors=vectors)
    match = check_match(matcher.match(query, top_k=3), query, top_k=3)
    return {pose.easting_m: score for pose, score in zip(match.poses, match.scores, strict=True)}


@pytest.mark.parametrize(("corners", "best"), [(RING, 1100.0), (ROW, 1200.0)])
def test_a_ring_and_a_row_of_as_many_houses_are_told_apart(made, prepared, corners, best) -> None:
    found = scores(made, prepared, view_of(made, corners))
    assert next(iter(found)) == best
    assert found[best] == pytest.approx(0.0)


def test_a_class_that_is_unknown_is_not_looked_at(made, prepared) -> None:
    view = view_of(made, ROW)
    hidden = view.cells.copy()
    hidden[0] = UNKNOWN
    assert set(scores(made, prepared, view.replace(hidden)).values()) == {0.0}


def test_of_houses_half_hidden_half_are_expected(made, prepared) -> None:
    view = view_of(made, RING)
    hidden, absent = view.cells.copy(), view.cells.copy()
    hidden[:, :48], absent[:, :48] = UNKNOWN, 0
    by_state = [scores(made, prepared, view.replace(cells))[1100.0] for cells in (hidden, absent)]
    # Two seen of four, where half is known: the counts agree, and the distances alone differ.
    assert by_state[0] == pytest.approx(by_state[1] + (2 / 7) / 2, abs=1e-3)


def test_vectors_tell_a_crossroads_from_two_forks_where_layers_do_not(made, prepared) -> None:
    blank = Evidence(classes=made.classes, cells=np.zeros((3, 96, 96), dtype=np.uint8), cell_size_m=1.0)
    for lines, best in ((FORKS, 1100.0), (CROSS, 1200.0)):
        by_lines = scores(made, prepared, blank, vectors=vectors_of(lines))
        assert by_lines[best] == max(by_lines[1100.0], by_lines[1200.0])
        assert by_lines[1100.0] != by_lines[1200.0]
    without = scores(made, prepared, blank)
    assert without[1100.0] == pytest.approx(without[1200.0], abs=0.1)


def test_vectors_are_enough_and_nothing_at_all_is_withheld(made, prepared) -> None:
    blind = Evidence(classes=made.classes, cells=np.full((3, 96, 96), UNKNOWN, dtype=np.uint8), cell_size_m=1.0)
    found = scores(made, prepared, blind, vectors=vectors_of(CROSS))
    assert found[1200.0] == 0.0 > found[1100.0]
    query = made.query_of(blind, NORTH, candidates=PLACES)
    assert prepared.match(query, top_k=3) == WITHHELD
    assert prepared.match(replace(query, vectors=vectors_of(())), top_k=3) == WITHHELD


def test_a_graph_of_what_is_seen_is_derived_as_that_of_the_map_is() -> None:
    nodes = Nodes.seen(vectors_of(FORKS), epsg=32632)
    assert sorted(nodes.places_m.tolist()) == [[-10.0, 0.0], [10.0, 0.0]]
    assert {KINDS[kind] for kind in nodes.kind} == {"intersection"}
    (cross,) = Nodes.seen(vectors_of(CROSS), epsg=32632).kind
    assert KINDS[cross] == "large intersection"
    apart = nodes.around((0.0, 0.0), 48.0).distance(Nodes.seen(vectors_of(CROSS), epsg=32632).around((0.0, 0.0), 48.0))
    assert apart > 0
    assert nodes.around((-10.0, 0.0), 5.0).counts.tolist() == [1.0, *(0.0 for _ in KINDS[1:])]


def test_a_view_is_found_on_the_map_and_the_same_candidate_twice_ties(made, prepared) -> None:
    anywhere = replace(NORTH, yaw_deg=None, yaw_sigma_deg=None)
    best = prepared.match(made.query_of(view_of(made, ROW), anywhere), top_k=3).poses[0]
    assert np.hypot(best.easting_m - 1200.0, best.northing_m - 8904.0) <= 24.0
    query = made.query_of(view_of(made, ROW), NORTH, candidates=(PLACES[1], PLACES[2], PLACES[1]))
    match = check_match(prepared.match(query, top_k=3), query, top_k=3)
    assert match.scores[0] > match.scores[1] == match.scores[2]


def test_a_large_prior_is_tried_on_a_wider_lattice(made, prepared, monkeypatch) -> None:
    query = made.query_of(view_of(made, ROW), NORTH)
    monkeypatch.setattr(graph_only, "MOST_TRIED", 12)
    best = check_match(prepared.match(query, top_k=3), query, top_k=3).poses[0]
    assert np.hypot(best.easting_m - 1200.0, best.northing_m - 8904.0) <= 32.0


def test_a_place_beyond_the_map_is_no_place(made, prepared) -> None:
    far = replace(PLACES[0], easting_m=90_000.0)
    query = made.query_of(view_of(made, ROW), NORTH, candidates=(far, PLACES[2]))
    assert [pose.easting_m for pose in prepared.match(query, top_k=3).poses] == [1200.0]
