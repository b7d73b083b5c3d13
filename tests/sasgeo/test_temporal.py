# SPDX-License-Identifier: Apache-2.0
"""The scorer over time on a made-up map: it follows a flight, learns its scale, and finds a carried drone again."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.sasgeo.temporal import FlightScale, increment_cost
from sasgeo_bench.sasgeo.trackers import SasgeoTrack, SasgeoTrackAlone, SasgeoTrackOne
from sasgeo_bench.tasks.query import Step
from tests.made_up import away_m, blind, dated_region, flight_of, fly, way_of

STEP_M, VIEWS = 40.0, 7
START = Pose(easting_m=1160.0, northing_m=8420.0, yaw_deg=22.0)
COVARIANCE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.25)
PRIOR = Prior(center_m=(1200.0, 8450.0), radius_m=150.0, yaw_deg=25.0, yaw_sigma_deg=10.0, scale_sigma=0.03)


@pytest.fixture(scope="module")
def region():
    return dated_region(5, 640)


def views_of(region, poses, **options):
    return flight_of(region, poses, prior=PRIOR, increment=(0.0, STEP_M, 0.0), sigmas=(1.0, 1.0, 0.5), **options)


def flown(tracker, region, views):
    """Prepare a tracker, and follow a flight with it."""
    tracker.prepare(region, None)
    return fly(tracker, views, PRIOR)


def test_a_flight_is_followed_and_its_covariance_holds_its_errors(region):
    poses = way_of(START, VIEWS, STEP_M)
    fixes = flown(SasgeoTrack(), region, views_of(region, poses))
    assert max(away_m(fix, pose) for fix, pose in zip(fixes[2:], poses[2:], strict=True)) < 6.0
    assert fixes[-1].is_accepted
    assert fixes[-1].confidence > 0.9
    for fix, pose in zip(fixes, poses, strict=True):
        gap_m = np.array([fix.pose.easting_m - pose.easting_m, fix.pose.northing_m - pose.northing_m])
        assert gap_m @ np.linalg.solve(fix.covariance[:2, :2], gap_m) < 14.0


def faint(query, rng):
    """A view as a segmenter sees it that is seldom sure and errs over tens of metres."""
    seen = query.evidence
    shape = seen.cells.shape
    bias = np.stack([cv2.resize(rng.random((4, 4)), shape[:0:-1], interpolation=cv2.INTER_CUBIC) for _ in seen.classes])
    chances = (0.05 + 0.5 * bias + 0.25 * (seen.cells == PRESENT)).clip(0, 1)
    chances[seen.cells == UNKNOWN] = np.nan
    return replace(query, evidence=Evidence.of_probabilities(seen.classes, chances, cell_size_m=seen.cell_size_m))


class CellsAlone(SasgeoTrack):
    """The tracker for which each cell counts alone in faint views, too."""

    switches = replace(SasgeoTrack.switches, correlates="never")


def test_a_flight_is_followed_by_faint_views_whose_errors_hang_together(region):
    poses, rng = way_of(START, VIEWS, STEP_M), np.random.default_rng(7)
    views = [faint(view, rng) for view in views_of(region, poses)]
    off_m = {
        tracker: [away_m(fix, pose) for fix, pose in zip(flown(tracker(), region, views), poses, strict=True)]
        for tracker in (SasgeoTrack, CellsAlone)
    }
    assert max(off_m[SasgeoTrack][2:]) < 10.0
    assert np.median(off_m[CellsAlone]) > 25.0


def test_a_view_that_shows_nothing_moves_the_belief_and_a_lost_step_spreads_it(region):
    poses = way_of(START, VIEWS, STEP_M)
    views = views_of(region, poses)
    views[3] = blind(views[3])
    fixes = flown(SasgeoTrack(), region, views)
    assert away_m(fixes[3], poses[3]) < 10.0
    lost = replace(blind(views[4]), step=replace(views[4].step, increment=None, covariance=None))
    spread = flown(SasgeoTrack(), region, [*views[:4], lost])[-1]
    assert not spread.is_accepted
    assert spread.covariance[0, 0] > 100 * fixes[3].covariance[0, 0]


def test_a_carried_drone_is_found_again_by_another_belief_alone(region):
    there = Pose(easting_m=1500.0, northing_m=8900.0, yaw_deg=200.0)
    poses = [*way_of(START, 5, STEP_M), *way_of(there, 12, STEP_M)]
    views = views_of(region, poses)
    found = flown(SasgeoTrack(), region, views)[-1]
    assert away_m(found, poses[-1]) < 10.0
    assert away_m(flown(SasgeoTrackOne(), region, views)[-1], poses[-1]) > 25.0


def test_without_odometry_what_the_odometer_says_changes_nothing(region):
    poses = way_of(START, 3, STEP_M)
    given = flown(SasgeoTrackAlone(), region, views_of(region, poses))
    misled = flown(SasgeoTrackAlone(), region, views_of(region, poses, said={2: (500.0, 0.0, 90.0)}))
    assert [fix.pose for fix in given] == [fix.pose for fix in misled]


def test_the_scale_of_a_flight_is_learned_and_a_prior_of_it_kept_where_nothing_was_seen(region):
    poses = [replace(pose, scale=1.05) for pose in way_of(START, VIEWS, STEP_M)]
    fixes = flown(SasgeoTrack(), region, views_of(region, poses))
    assert fixes[0].pose.scale == pytest.approx(1.0, abs=0.05)
    assert fixes[-1].pose.scale == pytest.approx(1.05, abs=0.02)
    scale = FlightScale.of(replace(PRIOR, scale_sigma=0.0))
    assert scale.mean == 1.0


def test_the_cost_of_a_step_is_its_distance_from_what_the_odometer_says():
    step = Step(sequence_id="f", frame=1, increment=(0.0, 50.0, 350.0), covariance=COVARIANCE)
    after = Pose(easting_m=50.0, northing_m=2.0, yaw_deg=79.0)
    found = increment_cost(step, Pose(easting_m=0.0, northing_m=0.0, yaw_deg=90.0), after)
    assert found == pytest.approx(2.0**2 + (1.0 / 0.5) ** 2)
    assert increment_cost(Step(sequence_id="f", frame=1), after, after) == 0.0
    exact = replace(step, covariance=(0.0,) * 9)
    assert increment_cost(exact, Pose(easting_m=0.0, northing_m=0.0, yaw_deg=90.0), after) > 1e6


def test_it_is_refused_to_step_before_start(region):
    tracker = SasgeoTrack()
    with pytest.raises(RuntimeError, match=r"sasgeo_track: call prepare\(\) with a region before start\(\)"):
        tracker.start(PRIOR)
    tracker.prepare(region, None)
    with pytest.raises(RuntimeError, match=r"sasgeo_track: call start\(\) first"):
        tracker.step(views_of(region, [START])[0])
