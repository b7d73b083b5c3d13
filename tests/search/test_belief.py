# SPDX-License-Identifier: Apache-2.0
"""A belief on a grid: it moves as odometry says, spreads by its covariance, and is summed up as a fix."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.matching.belief_fix import fix_of, followed
from sasgeo_bench.matching.tracker import check_fix
from sasgeo_bench.search.belief import COARSEST_M, MOST, GridBelief, yaw_count
from sasgeo_bench.tasks.query import Step

MAPPED = Grid(epsg=32632, west_m=1000.0, north_m=9000.0, cell_size_m=4.0, rows=400, cols=500)
START = Pose(easting_m=1800.0, northing_m=8300.0, yaw_deg=90.0)


def believed(*poses, factor=1, reach=64):
    """A belief with the same mass at each of some poses."""
    row, col = MAPPED.to_cells(np.array([(START.easting_m, START.northing_m)]))[0] // 8 * 8
    found = GridBelief.blank(MAPPED, factor, (row - reach, col - reach, row + reach, col + reach))
    for pose in poses:
        at = found.grid.to_cells(np.array([(pose.easting_m, pose.northing_m)]))[0]
        found.mass[(round(pose.yaw_deg / found.yaw_step_deg), *at)] += 1 / len(poses)
    return found


def moments(belief):
    """Mean and covariance of east, north and yaw about the start's heading."""
    places, turns = belief.places_m, wrap_deg(belief.yaws_deg - START.yaw_deg)
    plane, of_yaw = belief.mass.sum(axis=0).ravel(), belief.mass.sum(axis=(1, 2))
    mean = np.array([*(plane @ places), of_yaw @ turns])
    away = places - mean[:2]
    variances = [*(plane @ away**2), of_yaw @ (turns - mean[2]) ** 2]
    return mean, np.array(variances), float(plane @ (away[:, 0] * away[:, 1]))


def step(increment=(0.0, 50.0, 0.0), covariance=(0.0,) * 9):
    return Step(sequence_id="f", frame=1, increment=increment, covariance=tuple(covariance))


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_an_increment_moves_the_belief_ahead_to_the_right_and_clockwise(factor):
    before, _, _ = moments(believed(START, factor=factor))
    after, _, _ = moments(followed(believed(START, factor=factor), step((7.0, 50.0, 12.0)), diffuses=True))
    assert after - before == pytest.approx([50.0, -7.0, 12.0], abs=0.2)  # heading east, right is south


def test_every_heading_moves_its_own_way():
    other = replace(START, yaw_deg=180.0)
    after = followed(believed(START, other), step((0.0, 40.0, 0.0)), diffuses=True)
    poses = [fix_of(after, least=0.9).pose, *(mode for mode, _ in fix_of(after, least=0.9).modes)]
    offsets = {(round(pose.easting_m - 1802.0), round(pose.northing_m - 8298.0)) for pose in poses}
    assert offsets == {(40, 0), (0, -40)}


@pytest.mark.parametrize("sigma_m", [0.5, 3.0, 12.0, 40.0])
def test_diffusion_has_the_covariance_of_the_increment_in_the_axes_of_the_heading(sigma_m):
    covariance = np.diag([sigma_m**2, (sigma_m / 2) ** 2, 9.0]).ravel()
    _, still, _ = moments(followed(believed(START), step((0.0, 0.0, 0.0)), diffuses=True))
    _, spread, _ = moments(followed(believed(START), step((0.0, 0.0, 0.0), covariance), diffuses=True))
    grown = spread - still
    assert grown[2] == pytest.approx(9.0, rel=0.02)
    if sigma_m == 40.0:  # more than five cells: as wide in both axes
        assert grown[:2].sum() == pytest.approx(sigma_m**2 * 1.25, rel=0.1)
    else:
        assert grown[1] == pytest.approx(sigma_m**2, rel=0.06)  # heading east, right is south
    if sigma_m == 12.0:  # below about a cell it is as wide in both axes
        assert grown[0] == pytest.approx((sigma_m / 2) ** 2, rel=0.06)


def test_without_diffusion_covariances_count_nothing_and_the_first_view_moves_nothing():
    wide = np.diag([100.0, 100.0, 25.0]).ravel()
    kept = followed(believed(START), step(covariance=wide), diffuses=False)
    assert (kept.mass == followed(believed(START), step(), diffuses=False).mass).all()
    first = believed(START)
    assert followed(first, Step(sequence_id="f", frame=0), diffuses=True) is first


def test_a_lost_increment_spreads_the_belief_widely_and_within_the_map():
    lost = followed(believed(START), Step(sequence_id="f", frame=1), diffuses=False)
    _, variances, _ = moments(lost)
    assert np.sqrt(variances[:2]).min() > 250.0  # the map is 1600 x 2000 m
    assert math.sqrt(variances[2]) > 60.0
    assert lost.mass.size <= MOST
    west_m, south_m, east_m, north_m = lost.grid.bounds_m
    assert min(west_m - 1000.0, south_m - 7400.0, 3000.0 - east_m, 9000.0 - north_m) >= -532.0
    assert lost.mass.sum() == pytest.approx(1.0, abs=1e-4)


def test_a_belief_that_leaves_the_map_goes_on():
    belief = believed(START)
    for _ in range(25):
        belief = followed(belief, step((0.0, 100.0, 0.0), np.diag([1.0, 1.0, 0.1]).ravel()), diffuses=True).fitted()
    assert belief.mass.sum() == pytest.approx(1.0, abs=1e-4)
    assert belief.grid.bounds_m[0] <= 3000.0 + 500.0


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_cells_of_another_size_keep_mass_and_means(factor):
    cloud = followed(believed(START), step((0.0, 0.0, 0.0), np.diag([400.0, 400.0, 100.0]).ravel()), diffuses=True)
    for _ in range(factor // 2):
        cloud = cloud.coarser()
    mean, variances, _ = moments(cloud)
    for other in (cloud.coarser(), cloud.finer() if factor > 1 else cloud):
        assert len(other.mass) == yaw_count(MAPPED, other.factor)
        same, spread, _ = moments(other)
        assert same == pytest.approx(mean, abs=0.2)
        assert spread == pytest.approx(variances, rel=0.2)
        assert other.mass.sum() == pytest.approx(1.0, abs=1e-4)


def test_a_window_follows_the_belief_and_its_cells_its_size():
    wide = GridBelief.of(Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0), MAPPED)
    assert wide.mass.size <= MOST or wide.grid.cell_size_m == COARSEST_M
    assert wide.grid.bounds_m == (1000.0, 7400.0, 3016.0, 9000.0)  # whole squares of 32 m
    logs = np.full((len(wide.asked), *wide.shape), -40.0, dtype=np.float32)
    at = wide.grid.to_cells(np.array([(START.easting_m, START.northing_m)]))[0]
    logs[(0, *at)] = 0.0
    narrow = wide.weighed(logs, outlier_probability=0.0).fitted()
    assert narrow.grid.cell_size_m == 4.0
    assert np.hypot(*(np.array(narrow.grid.bounds_m[:2]) - (1800.0, 8300.0))) < 100.0
    assert narrow.mass.sum() == pytest.approx(1.0, abs=1e-4)


def test_an_even_prior_covers_its_disc_and_its_headings():
    prior = Prior(center_m=(1800.0, 8300.0), radius_m=200.0, yaw_deg=350.0, yaw_sigma_deg=20.0, scale_sigma=0.03)
    belief = GridBelief.of(prior, MAPPED)
    _, variances, _ = moments(belief)
    assert variances[:2] == pytest.approx([200.0**2 / 4] * 2, rel=0.02)
    assert belief.mass.sum(axis=(1, 2)).argmax() * belief.yaw_step_deg == 350.0
    beyond = GridBelief.of(replace(prior, center_m=(0.0, 0.0)), MAPPED)
    assert beyond.mass.sum() == pytest.approx(1.0, abs=1e-4)


def test_a_view_that_lies_costs_the_truth_no_more_than_the_doubt():
    belief = believed(START, replace(START, easting_m=1900.0))
    logs = np.full((len(belief.asked), *belief.shape), -1000.0, dtype=np.float32)
    at = belief.grid.to_cells(np.array([(1900.0, 8300.0)]))[0]
    logs[(slice(None), *at)] = 0.0
    found = belief.weighed(logs, outlier_probability=0.01)
    assert sorted(found.mass[found.mass > 1e-6].tolist()) == pytest.approx([0.01 / 1.01, 1 / 1.01], rel=1e-3)


def test_a_fix_is_the_mean_of_what_is_near_the_most_mass_and_lists_the_rest():
    places = [(1802.0, 8302.0), (1802.0, 8302.0), (1810.0, 8302.0), (1990.0, 8302.0)]
    headings = [90.0, 90.0, 100.0, 300.0]
    poses = [Pose(easting_m=e, northing_m=n, yaw_deg=yaw) for (e, n), yaw in zip(places, headings, strict=True)]
    fix = check_fix(fix_of(believed(*poses), least=0.7), top_k=5)
    assert (round(fix.pose.easting_m, 1), round(fix.pose.northing_m, 1)) == (1804.7, 8302.0)
    assert fix.pose.yaw_deg == pytest.approx(93.3, abs=0.1)
    assert fix.confidence == pytest.approx(0.75)
    assert fix.is_accepted
    assert not fix_of(believed(*poses), least=0.8).is_accepted
    (mode, share), *_ = fix.modes
    assert (round(mode.easting_m), round(mode.yaw_deg), round(share, 2)) == (1990, 300, 0.25)
    assert math.sqrt(fix.covariance[0][0]) == pytest.approx(math.sqrt(0.25 * 185.3**2 + 10.7 + 4 / 3), rel=0.01)
