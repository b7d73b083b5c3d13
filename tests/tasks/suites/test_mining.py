# SPDX-License-Identifier: Apache-2.0
"""Decoys: far enough, apart, from all four scorers, and a copy of a place is the first that comes to mind."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.tasks.suites.mining import SCORERS, STRIDE_M, candidates, describe, min_distance_m, mine
from sasgeo_bench.tasks.twin import Paste, paste

SIDE_M = 192.0
CLEAR_M = SIDE_M / 2 * np.sqrt(2)


@pytest.fixture(scope="module")
def windows(scene):
    return describe(scene("town-suburb").map, side_m=SIDE_M, clear_m=CLEAR_M)


@pytest.fixture(scope="module")
def wide(scene):
    """Windows of a town with room for many decoys."""
    return describe(scene("town-old-town large").map, side_m=SIDE_M, clear_m=CLEAR_M)


def centres(scene, count=12, where="town-suburb"):
    west, south, east, north = scene(where).map.grid.bounds_m
    rng = np.random.default_rng(5)
    return [tuple(rng.uniform((west + 200, south + 200), (east - 200, north - 200))) for _ in range(count)]


def test_no_decoy_is_near_the_truth_nor_two_of_them_near_each_other(scene, wide):
    least_m = min_distance_m(SIDE_M / 2)
    for center_m in centres(scene, where="town-old-town large"):
        points = mine(wide, center_m, count=200).points_m
        assert len(points) >= 8
        # Measured alike: were decoys nearer to each other than to the truth, the loneliest would be the true one.
        both = np.vstack(([center_m], points))
        apart_m = np.hypot(*(both[:, None] - both[None]).transpose(2, 0, 1))
        assert apart_m[~np.eye(len(both), dtype=bool)].min() >= least_m


def test_as_many_decoys_are_taken_as_fit(scene, wide):
    for center_m in centres(scene, 4, where="town-old-town large"):
        points = mine(wide, center_m, count=200).points_m
        both = np.vstack(([center_m], points))
        apart_m = np.hypot(*(wide.points_m[:, None] - both[None]).transpose(2, 0, 1)).min(axis=1)
        assert apart_m.max() < min_distance_m(SIDE_M / 2)


def test_footprints_of_truth_and_decoy_never_meet():
    assert min_distance_m(96.0) > 2 * 96.0 * np.sqrt(2)


def test_all_four_scorers_contribute_in_turn(scene, wide):
    for center_m in centres(scene, where="town-old-town large"):
        assert mine(wide, center_m, count=8).scorer == 2 * SCORERS


def test_fewer_decoys_are_the_first_of_more_and_the_same_on_another_run(scene, windows):
    again = describe(scene("town-suburb").map, side_m=SIDE_M, clear_m=CLEAR_M)
    for center_m in centres(scene, 4):
        many, few = mine(windows, center_m, count=30), mine(again, center_m, count=2)
        assert len(many.points_m) > 2
        np.testing.assert_array_equal(few.points_m, many.points_m[:2])
        assert few.scorer == many.scorer[:2]
        assert few.alias_index == many.alias_index


def test_windows_are_on_the_lattice(scene, windows):
    grid = scene("town-suburb").map.grid
    cells = (windows.points_m - (grid.west_m, grid.north_m)) / STRIDE_M
    assert np.ptp(cells % 1, axis=0) == pytest.approx([0, 0], abs=1e-6)


@pytest.mark.parametrize("clear_m", [CLEAR_M, 250.0])
def test_windows_are_the_places_whose_whole_square_is_mapped(scene, clear_m):
    state = scene("town-industrial short").map  # its map ends short of its grid
    found = describe(state, side_m=SIDE_M, clear_m=clear_m)
    assert all(state.is_mapped(point, clear_m) for point in found.points_m)
    cells = np.rint((found.points_m - found.points_m[0]) / STRIDE_M).astype(int)
    there = {tuple(cell) for cell in cells.tolist()}
    beside = {(x + right, y + up) for x, y in there for right, up in ((1, 0), (-1, 0), (0, 1), (0, -1))} - there
    assert beside  # and none of those that are left out had room to spare, but for the coarse cells
    for cell in beside:
        assert not state.is_mapped(found.points_m[0] + np.array(cell) * STRIDE_M, clear_m + 17.0)


def test_an_exact_copy_of_a_place_is_the_first_decoy(scene, edited):
    state = scene("town-suburb").map
    west, south, _, _ = state.grid.bounds_m
    source = (west + 272.0, south + 272.0)  # on the lattice
    target = (source[0] + 15 * STRIDE_M, source[1] + 13 * STRIDE_M)
    reach_m = 96 + 64 + 16.0  # as far as any scorer looks
    copied = edited("town-suburb", paste(state.features, [Paste(source_m=source, target_m=target, radius_m=reach_m)]))
    before, after = (mine(describe(of, side_m=SIDE_M, clear_m=CLEAR_M), source, count=9) for of in (state, copied))
    apart_m = np.hypot(*(after.points_m - target).T)
    assert int(np.argmin(apart_m)) == 0
    assert apart_m[0] < STRIDE_M
    assert after.alias_index > 0.95 > before.alias_index


def test_a_place_with_copies_has_a_higher_alias_index_than_without_them(carried):
    made = carried("alias")
    with_copies, without = (
        describe(state, side_m=SIDE_M, clear_m=CLEAR_M) for state in (made.scene.map, made.plain.map)
    )
    gain = []
    for site in made.sites:
        original = made.scene.twins[site.index][0] if site.is_copy else (site.pose.easting_m, site.pose.northing_m)
        before, after = (mine(of, original, count=1).alias_index for of in (without, with_copies))
        gain.append(after - before)
        assert after > 0.9
    assert min(gain) > 0
    assert np.mean(gain) > 0.02


def test_the_alias_index_of_an_exact_copy_is_one_and_needs_no_other_places(windows):
    # Its scale is its own: what else is on the map does not change how like two places are.
    twin = replace(
        windows,
        points_m=windows.points_m[:2] + np.array([[0, 0], [5000, 0]]),
        shares=windows.shares[[0, 0]],
        plain={name: table[[0, 0]] for name, table in windows.plain.items()},
        polar=np.stack((windows.polar[0], np.roll(windows.polar[0], 3, axis=1))),  # turned by 90 degrees
        spectrum=windows.spectrum[[0, 0]],
    )
    assert mine(twin, tuple(twin.points_m[0]), count=1).alias_index == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("east", "south", "sector"), [(0, -1, 0), (1, 0, 3), (0, 1, 6), (-1, 0, 9)])
def test_sectors_run_clockwise_from_north(scene, east, south, sector):
    state = scene("town-suburb").map
    bits = np.zeros_like(state.bits.bits)
    row, col = 512 + 60 * south, 512 + 60 * east
    bits[row - 8 : row + 8, col - 8 : col + 8] = 1 << state.classes.index("building")
    found = describe(replace(state, bits=replace(state.bits, bits=bits)), side_m=SIDE_M, clear_m=CLEAR_M)
    west_m, north_m = state.grid.west_m, state.grid.north_m
    here = int(np.argmin(np.hypot(*(found.points_m - (west_m + 512, north_m - 512)).T)))
    distances = found.polar[here].reshape(-1, 4, 12)[-1, 2]  # buildings come last; the third ring lies at 60 m
    assert int(np.argmin(distances)) == sector


def test_a_map_with_no_place_far_enough_has_no_decoy(windows):
    near = np.hypot(*(windows.points_m - windows.points_m[0]).T) < 300
    small = replace(
        windows,
        points_m=windows.points_m[near],
        shares=windows.shares[near],
        plain={name: table[near] for name, table in windows.plain.items()},
        polar=windows.polar[near],
        spectrum=windows.spectrum[near],
    )
    found = mine(small, tuple(windows.points_m[0]), count=5)
    assert found.points_m.shape == (0, 2)
    assert found.alias_index == 0.0


def test_candidates_are_shuffled_and_all_moved_alike():
    decoys = np.arange(38.0).reshape(-1, 2) * 1000
    at, off = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        poses, right = candidates((-5000.0, 77.7), decoys, yaw_deg=12.0, jitter_m=16.0, rng=rng)
        found = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
        at.append(right)
        off.append(found[right] - (-5000.0, 77.7))
        assert len(poses) == 20
        assert {pose.yaw_deg for pose in poses} == {12.0}
    assert np.bincount(at, minlength=20).min() > 3  # at any position
    assert np.abs(off).max() <= 16.01
    assert np.std(off, axis=0) == pytest.approx([16 / np.sqrt(3)] * 2, rel=0.1)
    assert candidates(None, decoys, yaw_deg=0.0, jitter_m=16.0, rng=np.random.default_rng(0))[1] == -1
