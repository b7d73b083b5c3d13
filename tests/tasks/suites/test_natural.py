# SPDX-License-Identifier: Apache-2.0
"""Places that look alike and were found: they do, nothing nearer does, and the disc holds what the suite says."""

import datetime as dt
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import UNKNOWN, LayerBits
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.tasks.query import CEILING, PriorGroup
from sasgeo_bench.tasks.sampling import Drawer
from sasgeo_bench.tasks.split import find_split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import NaturalTwin, changed_share
from sasgeo_bench.tasks.suites.mining import STRIDE_M, describe
from sasgeo_bench.tasks.suites.natural import (
    LEAST_LIKENESS,
    NATURAL_TWINS,
    STEP,
    align,
    in_order,
    mine_twins,
    own_likeness,
    pair_of,
)
from sasgeo_bench.tasks.suites.rivals import holds
from tests.tasks.suites.conftest import MAIN_REACH_M

TOWN = "town-grid large"
SIDE_M = 96.0
SIZE = 1024  # cells of a map made by hand, 1 m each


def hand_made(*drawings, turns=(0.0, 0.0), at=((256, 256), (768, 700))):
    """A map of buildings: one drawing at two places, row and column, turned there counter-clockwise as on paper."""
    mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
    for turn_deg, (row, col) in zip(turns, at, strict=True):
        piece = np.zeros((288, 288), dtype=np.uint8)
        for top, left, high, wide in drawings:
            piece[top : top + high, left : left + wide] = 1
        turn = cv2.getRotationMatrix2D((143.5, 143.5), turn_deg, 1.0)
        mask[row - 144 : row + 144, col - 144 : col + 144] |= cv2.warpAffine(
            piece, turn, (288, 288), flags=cv2.INTER_NEAREST
        )
    return of_mask(mask)


def of_mask(mask):
    grid = Grid(epsg=32632, west_m=500000.0, north_m=5200000.0, cell_size_m=1.0, rows=SIZE, cols=SIZE)
    return State(
        region="by-hand",
        date=dt.date(2025, 1, 1),
        grid=grid,
        classes=("building",),
        bits=LayerBits(bits=mask.astype(np.uint32), count=1),
        features=None,
        graph=None,
        coverage=shapely.box(*grid.bounds_m),
    )


def place(state, row, col):
    west, _, _, north = state.grid.bounds_m
    return (west + col, north - row)


HOUSES = (
    (60, 60, 20, 14),
    (70, 150, 12, 40),
    (130, 90, 30, 12),
    (190, 70, 14, 14),
    (170, 170, 26, 20),
    (110, 200, 10, 22),
)


@pytest.mark.parametrize("turn_deg", [-8.0, 0.0, 6.0, 10.0])
def test_a_turned_copy_is_found_where_it_lies_and_with_its_turn(turn_deg):
    state = hand_made(*HOUSES, turns=(0.0, turn_deg))
    here, there = place(state, 256, 256), place(state, 768, 700)
    found = align(state, here, state, (there[0] + 13, there[1] - 17), side_m=SIDE_M)
    assert math.dist(found.twin_m, there) <= 3
    assert found.likeness > 0.97
    # Counter-clockwise on paper is a heading further left.
    assert found.turn_deg == pytest.approx(-turn_deg, abs=2.0)
    seen = Pose(easting_m=here[0], northing_m=here[1], yaw_deg=33.0, scale=1.0)
    view = state.view(seen, size_cells=96, cell_size_m=1.0)
    twin = state.view(found.pose(seen), size_cells=96, cell_size_m=1.0)
    assert changed_share(view, twin) < 0.35  # edges: the turn is known to 2 degrees, the place to 2 m


def test_likeness_is_the_share_of_what_is_drawn_at_either_place_that_the_other_shows():
    # A building in four is missing at the second place.
    four = ((60, 60, 16, 16), (60, 200, 16, 16), (200, 60, 16, 16), (200, 200, 16, 16))
    state = hand_made(*four)
    mask = state.bits.bits.copy()
    mask[768 - 144 + 60 : 768 - 144 + 76, 700 - 144 + 60 : 700 - 144 + 76] = 0
    found = align(of_mask(mask), place(state, 256, 256), of_mask(mask), place(state, 768, 700), side_m=2 * SIDE_M)
    assert found.likeness == pytest.approx(6 / 7, abs=0.02)
    assert found.turn_deg == 0


def test_a_view_along_a_straight_line_has_no_place_of_its_own():
    road = np.zeros((SIZE, SIZE), dtype=np.uint8)
    road[500:508] = 1
    state = of_mask(road)
    assert own_likeness(state, place(state, 504, 512), SIDE_M) > LEAST_LIKENESS
    state = hand_made(*HOUSES)
    assert own_likeness(state, place(state, 256, 256), SIDE_M) < LEAST_LIKENESS


def test_the_order_is_that_of_the_mean_over_scorers_each_over_its_median():
    rows = [(0, 5), (0, 6), (1, 7)]
    distances = [np.array([[1.0, 9.0], [10.0, 40.0]]), np.array([[3.0], [20.0]])]
    # medians 3 and 20: means 0.42, 2.5 and 1
    assert in_order(rows, distances) == [(0, 5), (1, 7), (0, 6)]
    assert in_order([], []) == []


def test_a_place_without_another_one_within_reach_has_no_twin(alike):
    scene = alike(TOWN)
    kwargs = {"side_m": SIDE_M, "clear_m": scene.view_reach_m, "min_density": 0.1}
    assert mine_twins(scene.map, within_m=2 * scene.view_reach_m + 40, **kwargs) == ()


def test_pairs_look_alike_do_not_overlap_and_beat_what_lies_beside_them(alike):
    scene = alike(TOWN)
    assert len(scene.natural) >= 20
    assert [twin.rank for twin in scene.natural] == list(range(1, len(scene.natural) + 1))
    assert len({twin.place_m for twin in scene.natural}) == len(scene.natural)
    for twin in scene.natural[:12]:
        apart_m = math.dist(twin.place_m, twin.twin_m)
        assert 2 * scene.view_reach_m <= apart_m <= NATURAL_TWINS.within_m(None)
        assert twin.likeness >= LEAST_LIKENESS
        for place_m in (twin.place_m, twin.twin_m):
            assert own_likeness(scene.map, place_m, SIDE_M) <= LEAST_LIKENESS
            assert scene.map.is_mapped(np.array(place_m), scene.view_reach_m)


def test_the_lattice_on_which_places_are_compared_does_not_tell_a_place_from_its_twin(alike):
    scene = alike(TOWN)
    west, _, _, north = scene.map.grid.bounds_m

    def phases(places_m):
        return (np.array(places_m) - (west, north)) % STRIDE_M

    places, twins = (phases([getattr(twin, name) for twin in scene.natural]) for name in ("place_m", "twin_m"))
    (node,) = {tuple(one) for one in phases(describe(scene.map, side_m=SIDE_M, clear_m=100.0).points_m)}
    on_lattice = (places == node).all(axis=1), (twins == node).all(axis=1)
    assert (on_lattice[0] | on_lattice[1]).all()  # one of the two is
    assert 0.3 < on_lattice[0].mean() < 0.7
    assert 0.3 < on_lattice[1].mean() < 0.7


def test_a_pair_seen_from_its_twin_leads_back():
    pair = NaturalTwin(place_m=(10.0, 20.0), twin_m=(300.0, 40.0), turn_deg=12.0, likeness=0.9, rank=3)
    seen = Pose(easting_m=10.0, northing_m=20.0, yaw_deg=355.0, scale=1.02)
    assert pair.reversed().pose(pair.pose(seen)) == seen
    assert pair.reversed().reversed() == pair


def test_pairs_are_more_alike_than_pairs_taken_at_random(alike):
    scene, rng = alike(TOWN), np.random.default_rng(3)

    def share(one_m, other):
        seen = Pose(easting_m=one_m[0], northing_m=one_m[1], yaw_deg=0.0, scale=1.0)
        views = (scene.map.view(pose, size_cells=96, cell_size_m=1.0) for pose in (seen, other.pose(seen)))
        return changed_share(*views)

    pairs = [(twin.place_m, twin) for twin in scene.natural[:30]]
    mixed = [
        (scene.natural[at].place_m, twin) for at, (_, twin) in zip(rng.permutation(len(pairs)), pairs, strict=True)
    ]
    assert np.mean([share(*pair) for pair in pairs]) < np.mean([share(*pair) for pair in mixed]) - 0.1


def drawn(made):
    drawer = Drawer(
        suite=made.suite,
        scene=made.scene,
        seeds=made.seeds,
        group=made.suite.card.group,
        split=find_split("crossfit"),
    )
    return [(job, *drawer.draw(job)) for job in drawer.jobs(made.sites)]


def test_the_disc_holds_both_but_that_of_the_control_omits_the_twin(carried, root):
    made = carried("natural-twins", root)
    for job, query, truth in drawn(made):
        twin = pair_of(made.scene, job.site)
        assert holds(query.prior, job.site.en_m)
        assert holds(query.prior, twin.twin_m) == (truth.role != "control")
        assert truth.is_present
        if truth.role == "stress":
            assert truth.measured["margin"] == pytest.approx(1 - twin.likeness, abs=1e-4)
            assert -1e-4 <= truth.strength - truth.measured["margin"] <= STEP + 1e-4
            assert truth.measured["rivals_in_disc"] == 1
            assert (query.vectors is not None) == truth.kind.endswith("vectors")


def test_the_disc_of_an_absent_place_holds_its_look_alike_alone(carried, root):
    made = carried("natural-absent", root)
    for job, query, truth in drawn(made):
        twin, is_elsewhere = pair_of(made.scene, job.site), truth.kind == "elsewhere"
        assert truth.is_present == (truth.role == "control")
        if truth.role == "control" or is_elsewhere:
            assert holds(query.prior, job.site.en_m)
        else:
            assert holds(query.prior, twin.twin_m)
            assert not holds(query.prior, job.site.en_m)
        assert (truth.pose is None) == is_elsewhere
        if truth.role == "stress":
            shown = made.scene.look_alikes[job.site.index] if is_elsewhere else twin
            assert truth.measured["margin"] == pytest.approx(1 - shown.likeness, abs=1e-4)
            assert -1e-4 <= truth.strength - truth.measured["margin"] <= STEP + 1e-4


def test_a_falsifier_sees_nothing_that_tells_the_two_places_apart(carried, root):
    for name in ("natural-twins", "natural-absent"):
        made = carried(name, root)
        (falsifier,) = (one for one in made.suite.variants if one.role == "falsifier")
        for site in made.sites:
            blind = made.drawn(site, falsifier)
            twin = pair_of(made.scene, site)
            one, other = (falsifier.view(made.scene.map, pose).cells for pose in (site.pose, twin.pose(site.pose)))
            is_seen = blind.evidence.cells != UNKNOWN
            np.testing.assert_array_equal(one[is_seen], other[is_seen])
            assert 0.5 < is_seen.mean() < 1
            assert blind.measured[CEILING] == 0.5
            assert blind.measured["unknown_added"] == pytest.approx((one != other).mean(), abs=0.02)


def test_a_look_alike_elsewhere_is_more_like_the_place_than_the_other_places_there(carried):
    made = carried("natural-absent")
    likest = [made.scene.look_alikes[site.index].likeness for site in made.sites]
    twin = made.scene.look_alikes[made.sites[0].index]
    assert made.scene.elsewhere.is_mapped(np.array(twin.twin_m), SIDE_M / 2)
    others = [
        align(
            made.scene.map, site.en_m, made.scene.elsewhere, made.scene.look_alikes[other.index].twin_m, side_m=SIDE_M
        )
        for site, other in zip(made.sites, (*made.sites[1:], made.sites[0]), strict=True)
    ]
    assert np.mean(likest) >= np.mean([other.likeness for other in others])


def test_a_region_without_look_alikes_and_a_disc_too_small_for_two_are_refused(scene, alike):
    assert NATURAL_TWINS.lack(scene(TOWN)) == "no two places of it look alike"
    assert NATURAL_TWINS.lack(alike(TOWN)) is None
    small = PriorGroup(radius_m=100.0, yaw="weak", scale_sigma=0.03)
    assert "needs a disc that holds two places" in NATURAL_TWINS.refusal(small)
    assert "needs a disc that omits one" in NATURAL_TWINS.refusal(replace(small, radius_m=None))
    assert NATURAL_TWINS.within_m(replace(small, radius_m=2000.0)) == 2000.0


@pytest.mark.real
@pytest.mark.slow
def test_a_real_town_with_every_plot_has_look_alikes_and_one_of_single_farms_has_none(tmp_path, real_extracts):
    for region, least in (("duitama", 20), ("cayococo", 0)):
        spec = read_region_file(find_region_file(region))
        plan = plan_build(spec, out=tmp_path, extract_folders=(real_extracts,))
        build_region(plan)
        found = mine_twins(
            State.read(plan.folder), side_m=SIDE_M, clear_m=MAIN_REACH_M / 2, within_m=800.0, min_density=0.1
        )
        assert len(found) >= least
        assert len(found) == 0 or least
