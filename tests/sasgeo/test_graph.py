# SPDX-License-Identifier: Apache-2.0
"""Correspondences of a view and a map: what raises a score, what lowers it, and what must leave it alone."""

from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest
import shapely

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sasgeo.graph import GraphRules, GraphScore, by_area, by_arms, by_degree, verify
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.nodes import NODE_KINDS
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, warped
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.vectors import VectorNoise, perceive_vectors
from sasgeo_bench.tasks.suites.views import bent
from sasgeo_bench.tasks.vectors import as_features, vector_table

WAYS = (
    *("LINESTRING (-97 -20, -40 -20, 20 -20, 97 -20)", "LINESTRING (-40 -20, -40 97)", "LINESTRING (20 -20, 20 -97)"),
    *("LINESTRING (20 -20, 20 30, 97 30)", "LINESTRING (20 30, -10 50)"),
)
HOUSES = ((-70, 10, 12, 9), (-30, 20, 8, 8), (-12, 5, 18, 9), (40, 45, 10, 14), (50, -60, 9, 9), (-60, -70, 20, 10))
BLANK = Evidence(classes=("road_minor", "building"), cells=np.zeros((2, 200, 200), dtype=np.uint8), cell_size_m=1.0)
HERE = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
EXACT = VectorNoise(missed_share=0.0, gap_share=0.0, shift_m=0.0)


def drawn(pose=HERE, *, ways=WAYS, houses=HOUSES):
    """The hand-made place as a view from a pose has it."""
    rows = [("road_minor", shape) for shape in shapely.from_wkt(list(ways))]
    rows += [("building", shapely.box(x, y, x + w, y + h)) for x, y, w, h in houses]
    back = inverse(pose).to_map
    return vector_table([(name, 0, False, shapely.transform(shape, back)) for name, shape in rows])


def mapped_from(vectors, half_m=400.0):
    """A map of vectors, known as far as that."""
    features = as_features(vectors)
    cells = int(2 * half_m)
    grid = Grid(epsg=32632, west_m=-half_m, north_m=half_m, cell_size_m=1.0, rows=cells, cols=cells)
    return MappedGraph.make(build_graph(features), features, known=np.ones(grid.shape, dtype=bool), grid=grid)


def score(seen, mapped, pose=HERE, **more):
    return verify(seen, mapped, [pose], **more)[0]


@pytest.fixture(scope="module")
def seen():
    return ObservedGraph.make(BLANK, drawn())


@pytest.fixture(scope="module")
def mapped():
    return mapped_from(drawn())


def test_all_is_found_where_it_is_and_unknown_cells_change_nothing_where_nothing_is(seen, mapped):
    found = score(seen, mapped)
    assert found.matched == 3 + 1 + len(HOUSES)  # junctions, and an end
    assert (found.unmatched_seen, found.unmatched_mapped, found.contradicting) == (0, 0, 0)
    assert found.rms_m == pytest.approx(0.0, abs=1e-6)
    assert found.consistency == 1.0
    assert found.score > 20
    cells = BLANK.cells.copy()
    cells[:, 150:180, 5:25] = UNKNOWN
    assert asdict(score(ObservedGraph.make(BLANK.replace(cells), drawn()), mapped)) == asdict(score(seen, mapped))
    one = vector_table([("building", 0, False, shapely.box(-30, 20, -22, 28))])
    assert score(ObservedGraph.make(BLANK, one), mapped).matched == 1
    assert score(ObservedGraph.make(BLANK, one), mapped_from(one)).score > 0
    assert verify(ObservedGraph.make(BLANK, one), mapped, []) == []


@pytest.mark.parametrize("yaw_deg", [30.0, 90.0, 200.0])
def test_a_score_turns_with_map_and_view(seen, yaw_deg):
    turn = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg)
    turned_map = mapped_from(drawn(inverse(turn)))
    off = Pose(easting_m=3.0, northing_m=-2.0, yaw_deg=4.0)
    east_m, north_m = turn.to_map(np.array([(off.easting_m, off.northing_m)]))[0]
    turned = Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg + off.yaw_deg)
    one, other = score(seen, mapped_from(drawn()), off), score(seen, turned_map, turned)
    assert other.score == pytest.approx(one.score, abs=0.2)  # vectors are rounded to a decimetre
    assert (other.matched, other.contradicting) == (one.matched, one.contradicting)
    pose = Pose(easting_m=5.0, northing_m=-5.0, yaw_deg=yaw_deg, scale=1.15)
    found = ObservedGraph.make(BLANK, drawn(pose))
    assert score(found, mapped_from(drawn()), pose).score > 20
    for wrong in (replace(pose, yaw_deg=yaw_deg - 90.0), replace(pose, scale=1.0)):
        assert score(found, mapped_from(drawn()), wrong).score < score(found, mapped_from(drawn()), pose).score - 5


def test_what_is_not_mapped_and_what_is_not_seen_cost(seen, mapped):
    whole = score(seen, mapped)
    fewer = score(ObservedGraph.make(BLANK, drawn(houses=HOUSES[1:])), mapped)
    more = score(seen, mapped_from(drawn(houses=HOUSES[1:])))
    assert (fewer.unmatched_seen, fewer.unmatched_mapped) == (0, 1)
    assert (more.unmatched_seen, more.unmatched_mapped) == (1, 0)
    assert max(fewer.score, more.score) < whole.score - 3
    assert max(fewer.consistency, more.consistency) < 1


def test_nothing_is_missed_where_the_view_is_unknown_or_does_not_reach(seen, mapped):
    gone = ObservedGraph.make(BLANK, drawn(houses=HOUSES[1:]))
    cells = BLANK.cells.copy()
    cells[:, 60:110, 10:60] = UNKNOWN
    hidden = ObservedGraph.make(BLANK.replace(cells), drawn(houses=HOUSES[1:]))
    assert score(gone, mapped).unmatched_mapped == 1
    assert score(hidden, mapped).unmatched_mapped == 0
    beyond = drawn(houses=(*HOUSES, (150, 150, 9, 9), (92, 60, 14, 9)))  # the last one lies across the border
    assert score(seen, mapped_from(beyond)).unmatched_mapped == 0


def test_nothing_is_made_up_where_the_map_ends(seen):
    vectors = drawn(houses=HOUSES[:4])
    features, grid = as_features(vectors), Grid.around(0.0, 0.0, size_m=(800.0, 800.0), cell_size_m=1.0, epsg=32632)
    known = np.ones(grid.shape, dtype=bool)
    known[445:] = False
    half = MappedGraph.make(build_graph(features), features, known=known, grid=grid)
    assert score(seen, mapped_from(vectors)).unmatched_seen == 2
    assert score(seen, half).unmatched_seen == 0


def test_a_way_that_is_cut_on_the_map_is_a_contradiction(seen):
    west = ("LINESTRING (-97 -20, -40 -20, -15 -20)", "LINESTRING (-40 -20, -75 -60)")
    ways = (*west, "LINESTRING (-5 -20, 20 -20, 97 -20)")
    cut = mapped_from(drawn(ways=(*WAYS[1:], *ways)))
    assert score(seen, cut).contradicting > score(seen, mapped_from(drawn())).contradicting


@pytest.mark.parametrize("vectors", [None, vector_table([])])
def test_an_empty_view_or_map_says_nothing(seen, mapped, vectors):
    assert score(ObservedGraph.make(BLANK, vectors), mapped) == GraphScore()
    blind = BLANK.replace(np.full_like(BLANK.cells, UNKNOWN))
    assert score(ObservedGraph.make(blind, vectors), mapped) == GraphScore()
    assert score(seen, mapped_from(vector_table([]))) == GraphScore()


def test_every_figure_is_finite_anywhere(seen, mapped):
    rng = np.random.default_rng(0)
    places = rng.uniform(-500, 500, (30, 2))
    poses = [Pose(easting_m=x, northing_m=y, yaw_deg=float(7 * x), scale=1.1) for x, y in places.tolist()]
    for found in verify(seen, mapped, poses):
        assert np.isfinite(list(asdict(found).values())).all()
        assert 0 <= found.consistency <= 1


# On a town


@pytest.fixture(scope="module")
def town(towns):
    region = read_region(towns / "regions" / "town-riverside")
    return State.of(region), MappedGraph.of(region)


def places(state, rng, count):
    """Poses where something is drawn, and others of the same town for each."""
    west, south, east, north = state.grid.bounds_m
    for _ in range(count):
        at = rng.uniform((west + 250, south + 250), (east - 250, north - 250))
        here = Pose(easting_m=at[0], northing_m=at[1], yaw_deg=float(rng.uniform(0, 360)))
        turns = rng.uniform(0, 2 * np.pi, 8)
        away = np.column_stack((np.cos(turns), np.sin(turns))) * rng.uniform(40, 150, (8, 1)) + at
        yield here, [here, *(replace(here, easting_m=x, northing_m=y) for x, y in away.tolist())]


@pytest.mark.parametrize("with_vectors", [True, False])
def test_the_true_place_outscores_others_of_a_town(town, with_vectors):
    state, mapped = town
    rng, first = np.random.default_rng(1), 0
    for here, poses in places(state, rng, 6):
        view = state.view(here, size_cells=192, cell_size_m=1.0)
        vectors = perceive_vectors(state, here, side_m=192.0, noise=VectorNoise(), rng=rng)
        found = verify(ObservedGraph.make(view, vectors if with_vectors else None), mapped, poses)
        first += found[0].score > max(one.score for one in found[1:])
    assert first >= 5


def test_a_bent_view_keeps_its_place_while_its_cells_miss_the_map(town):
    state, mapped = town
    rng, first, overlaps = np.random.default_rng(2), 0, []
    for here, poses in places(state, rng, 5):
        view = state.view(here, size_cells=192, cell_size_m=1.0)
        vectors = perceive_vectors(state, here, side_m=192.0, noise=EXACT, rng=rng)
        field_m = LocalWarp(rms_m=8.0).field(view.shape, 1.0, rng)
        after = warped(view, field_m)
        lines = [view.classes.index(name) for name in ("road_major", "road_minor", "path_track", "building")]
        known = (after.cells[lines] != UNKNOWN) & (view.cells[lines] == PRESENT)
        overlaps.append((after.cells[lines][known] == PRESENT).mean())
        found = verify(ObservedGraph.make(after, bent(vectors, field_m, 1.0)), mapped, poses)
        first += found[0].score > max(one.score for one in found[1:])
    assert first >= 4
    assert np.mean(overlaps) < 0.75


def test_learnt_rules_hold_for_vectors_and_starting_values_for_masks(town):
    state, mapped = town
    rng = np.random.default_rng(3)
    here, poses = next(places(state, rng, 1))
    view = state.view(here, size_cells=192, cell_size_m=1.0)
    vectors = perceive_vectors(state, here, side_m=192.0, noise=EXACT, rng=rng)
    strict = GraphRules(place_sigma_m=1.0, arm_sigma_deg=4.0)
    drawn, masked = ObservedGraph.make(view, vectors), ObservedGraph.make(view)
    assert verify(masked, mapped, poses, strict) == verify(masked, mapped, poses)
    assert verify(drawn, mapped, [here], strict)[0].score > verify(drawn, mapped, [here])[0].score


@pytest.mark.parametrize("is_visible", [True, False])
def test_masks_show_no_river_below_water_and_vectors_do(is_visible):
    river = shapely.LineString([(-90, -20), (0, -20), (0, 40), (90, 40)])
    street = shapely.LineString([(-60, -90), (-60, -20), (-60, 90)])
    lines = as_features(vector_table([("waterway", 0, False, river), ("road_minor", 0, False, street)]))
    lake = as_features(vector_table([("water", 0, False, shapely.box(-95, -95, 95, 95))]))
    features = pd.concat([lines, lake.assign(is_visible=is_visible)], ignore_index=True)
    grid = Grid(epsg=32632, west_m=-100.0, north_m=100.0, cell_size_m=1.0, rows=200, cols=200)
    mapped = MappedGraph.make(build_graph(features), features, known=np.ones(grid.shape, dtype=bool), grid=grid)
    shown = {NODE_KINDS[kind].name for kind in mapped.nodes.kind}
    assert {"river_bend", "road_water_crossing"} <= shown
    in_a_mask = {"mask river_bend", "mask water crossing"}
    assert shown & in_a_mask == (set() if is_visible else in_a_mask)


def test_ratios_favour_what_is_alike_and_say_nothing_of_what_is_unknown():
    rules = GraphRules()
    assert by_degree(np.array([3, 3, 3, 0]), np.array([3, 4, 5, 3]), rules).tolist() == [0.4, -1.2, -2.5, 0.0]
    areas = by_area(np.array([100.0, 100.0, np.nan]), np.array([100.0, 300.0, 50.0]), rules)
    assert areas.round(1).tolist() == [1.7, -3.0, 0.0]
    arms = by_arms(np.array([[10.0], [90.0], [np.nan]]), np.array([[0.0, 180.0]] * 3), rules)
    assert arms.round(1).tolist() == [1.3, -3.0, 0.0]
