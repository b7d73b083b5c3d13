# SPDX-License-Identifier: Apache-2.0
"""The grid filters on a made-up map: they find a place without errors, and survive what a flight brings."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from sasgeo_baselines.trackers.grid_markov import GridMarkov, GridMarkovStill
from sasgeo_baselines.trackers.lsvl_belief import TAUGHT, LsvlBelief, Ratio
from sasgeo_baselines.trackers.lsvl_descriptors import Parts, Shares

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.tasks.query import Step
from tests.made_up import VIEW_CELLS, away_m, blind, dated_region, flight_of, fly, view_of, way_of

FILTERS = {"grid_markov": GridMarkov, "grid_markov_still": GridMarkovStill, "lsvl_belief": LsvlBelief}
NEAR_M = {"grid_markov": 6.0, "grid_markov_still": 6.0, "lsvl_belief": 16.0}  # one and a half cells, and one
SLOW = {"lsvl_belief"}  # sure of its place after more views than are flown here
STEP_M, VIEWS = 30.0, 8
START = Pose(easting_m=1160.0, northing_m=8420.0, yaw_deg=22.0)
PRIOR = Prior(center_m=(1200.0, 8450.0), radius_m=150.0, yaw_deg=25.0, yaw_sigma_deg=10.0, scale_sigma=0.01)
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.01)


@pytest.fixture(scope="module")
def region():
    return dated_region(5, 640)


@pytest.fixture(scope="module")
def prepared(region):
    """A tracker by its name, prepared once: `start` forgets the flight before."""

    @cache
    def of_name(name):
        tracker = FILTERS[name]()
        tracker.prepare(region, None)
        return tracker

    return of_name


@pytest.fixture(scope="module")
def flight(region):
    """Views of a straight flight without errors, and where each was taken."""
    poses = way_of(START, VIEWS, STEP_M)
    views = flight_of(region, poses, prior=PRIOR, increment=(0.0, STEP_M, 0.0), sigmas=(0.5, 0.5, 0.5))
    return tuple(views), tuple(poses)


@pytest.mark.parametrize("prior", [PRIOR, ANYWHERE], ids=["disc", "anywhere"])
@pytest.mark.parametrize("name", FILTERS)
def test_a_flight_without_errors_is_followed(name, prior, prepared, flight):
    views, poses = flight
    fixes = fly(prepared(name), views, prior)
    assert away_m(fixes[-1], poses[-1]) <= NEAR_M[name]
    assert abs(fixes[-1].pose.yaw_deg - START.yaw_deg) <= 6.0
    assert fixes[-1].is_accepted or name in SLOW


@pytest.mark.parametrize("name", FILTERS)
def test_a_flight_is_answered_alike_whatever_was_flown_before(name, prepared, flight):
    views, _ = flight
    first, again = fly(prepared(name), views[:3], PRIOR), fly(prepared(name), views[:3], PRIOR)
    assert [fix.pose for fix in first] == [fix.pose for fix in again]


@pytest.mark.parametrize("name", FILTERS)
def test_a_blank_view_only_moves_and_spreads_what_is_believed(name, prepared, flight):
    views, poses = flight
    fixes = fly(prepared(name), [*views[:5], *map(blind, views[5:])], PRIOR)
    assert away_m(fixes[-1], poses[-1]) <= 2 * NEAR_M[name]
    spread, before = (np.trace(np.array(fix.covariance)[:2, :2]) for fix in (fixes[-1], fixes[4]))
    assert spread > before
    assert fixes[-1].confidence <= fixes[4].confidence + 1e-6


def test_without_diffusion_odometry_that_says_too_much_is_believed(prepared, flight):
    views, poses = flight
    turned = [
        replace(
            view,
            step=replace(
                view.step, increment=(0.0, 1.3 * STEP_M, 0.0), covariance=tuple(np.diag([9, 81, 4.0]).ravel())
            ),
        )
        if view.step.frame
        else view
        for view in views
    ]
    moved, still = (fly(prepared(name), turned, PRIOR) for name in ("grid_markov", "grid_markov_still"))
    assert away_m(moved[-1], poses[-1]) < 10.0 < away_m(still[-1], poses[-1])


@pytest.mark.parametrize("name", FILTERS)
def test_a_lost_step_is_found_again(name, prepared, flight):
    views, poses = flight
    lost = [*views[:3], replace(views[3], step=Step(sequence_id="f", frame=3)), *views[4:]]
    fixes = fly(prepared(name), lost, PRIOR)
    assert away_m(fixes[-1], poses[-1]) <= 2 * NEAR_M[name] or name in SLOW
    assert fly(prepared(name), [*lost[:3], blind(lost[3])], PRIOR)[-1].confidence < 0.2


@pytest.mark.parametrize("name", FILTERS)
def test_what_is_called_too_early_is_refused(name, flight):
    tracker = FILTERS[name]()
    with pytest.raises(RuntimeError, match="prepare"):
        tracker.start(PRIOR)
    with pytest.raises(RuntimeError, match="start"):
        tracker.step(flight[0][0])


def test_descriptors_of_a_view_and_of_the_map_agree_at_its_place_and_heading(region):
    described = Shares.of(region).described(VIEW_CELLS / 4)
    pose = Pose(easting_m=1328.0, northing_m=8680.0, yaw_deg=130.0)
    view = Parts.of(view_of(region, pose, size_cells=VIEW_CELLS), described.classes)
    compared = described.compared(view, described.grid)
    table = np.stack([compared.distances(yaw_deg) for yaw_deg in np.arange(0.0, 360.0, 10.0)])
    yaw, row, col = np.unravel_index(np.nanargmin(table), table.shape)
    assert yaw == 13
    assert np.hypot(*(described.grid.to_centres_m(np.array([(row, col)]))[0] - (1328.0, 8680.0))) <= 16.0
    assert np.isnan(compared.distances(0.0)).sum() == 0
    far = described.grid.window(-500, -500, 2, 2)
    assert np.isnan(described.compared(view, far).distances(0.0)).all()


def test_a_ratio_is_learned_of_training_views_and_falls(region, flight):
    views, poses = flight
    pairs = [
        (replace(view, region="made-up"), SimpleNamespace(pose=pose)) for view, pose in zip(views, poses, strict=True)
    ]
    assert LsvlBelief().learn(Training(regions={"made-up": region}, pairs=pairs)) == TAUGHT  # too few
    many = [(replace(view, query_id=f"{number:x}"), truth) for number in range(7) for view, truth in pairs]
    ratio = Ratio.of(LsvlBelief().learn(Training(regions={"made-up": region}, pairs=many)))
    assert (np.diff(ratio.log) <= 0).all()
    assert ratio.log[0] > 1.0 > -1.0 > ratio.log[-1]
