# SPDX-License-Identifier: Apache-2.0
"""Trackers that fuse fixes of single views with odometry: right where the views are, silent where they are not."""

import datetime as dt
from dataclasses import dataclass, replace

import numpy as np
import pytest
from sasgeo_baselines.trackers.ekf_loose import EkfLoose
from sasgeo_baselines.trackers.foundloc_ransac import FoundlocRansac
from sasgeo_baselines.trackers.satloc_layers import SatlocLayers
from sasgeo_baselines.trackers.se2_trajectory import Se2Trajectory
from sasgeo_baselines.trackers.vio_dead_reckoning import VioDeadReckoning

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, rotation, wrap_deg
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard
from sasgeo_bench.matching.tracker import check_fix
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.query import Query, Step
from tests.baselines.conftest import region_of, textured, view_of
from tests.slow import rest_slow

FUSING = (EkfLoose, FoundlocRansac, SatlocLayers, Se2Trajectory)
SIGMAS = (0.8, 0.8, 1.0)  # of an increment: metres, metres, degrees
SCALE = 1.015  # by which the odometer is off
NOTHING = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
LOOKS = Evidence(classes=("building",), cells=np.ones((1, 2, 2), dtype=np.uint8), cell_size_m=1.0)


def around(pose, radius_m):
    """A prior that holds a pose, off its middle."""
    center_m = (pose.easting_m + radius_m / 3, pose.northing_m - radius_m / 3)
    return Prior(center_m=center_m, radius_m=radius_m, yaw_deg=pose.yaw_deg + 8, yaw_sigma_deg=10.0, scale_sigma=0.03)


def winding(count, *, spacing_m=50.0, start_m=(2000.0, 1000.0)):
    """Poses of a flight that bends to and fro."""
    poses, place_m = [], np.array(start_m)
    for frame in range(count):
        yaw_deg = 20.0 + 40.0 * np.sin(frame / 6)
        poses.append(Pose(easting_m=float(place_m[0]), northing_m=float(place_m[1]), yaw_deg=yaw_deg))
        place_m = place_m + rotation(yaw_deg) @ [0.0, spacing_m]
    return poses


def views_of(poses, *, seed=0, evidence=None, radius_m=300.0, lost=(), jumps=()):
    """The queries of a flight; at `jumps` the odometer says the step before once more."""
    rng, queries, told = np.random.default_rng(seed), [], None
    for frame, pose in enumerate(poses):
        step = Step(sequence_id="f", frame=frame)
        if frame and frame not in lost:
            before = poses[frame - 1]
            off_m = np.array([pose.easting_m - before.easting_m, pose.northing_m - before.northing_m])
            if frame not in jumps:
                told = np.array([*(rotation(before.yaw_deg).T @ off_m), float(wrap_deg(pose.yaw_deg - before.yaw_deg))])
            noise = np.array(SIGMAS) * rng.standard_normal(3)
            increment = tuple((told * [SCALE, SCALE, 1.0] + noise).tolist())
            covariance = tuple(np.diag(np.square(SIGMAS)).ravel().tolist())
            step = replace(step, increment=increment, covariance=covariance)
        queries.append(
            Query(
                query_id=f"f{frame:06x}",
                track="sequence",
                suite="flight-clean",
                suite_version=1,
                part="test",
                region="made-up",
                prior_group="r500-weak-s3",
                evidence=LOOKS if evidence is None else evidence[frame],
                observed_on=dt.date(2025, 1, 1),
                season="",
                prior=NOTHING if frame else around(pose, radius_m),
                step=step,
            )
        )
    return queries


@dataclass
class Fair:
    """A matcher that finds the right place among others, and puts it first in a part of the views; else it errs."""

    poses: list
    right: float = 1.0
    blind: tuple = ()
    card = MatcherCard(
        name="fair", version="1", title="Fair", source="original", ours="all", licence="MIT", tracks=("localization",)
    )

    def prepare(self, region, learned):
        del learned
        self.grid = region.grid
        self.frame, self.rng = -1, np.random.default_rng(1)

    def match(self, query, *, top_k):
        self.frame += 1
        if self.frame in self.blind:
            return WITHHELD
        prior, truth = query.prior, self.poses[self.frame]
        found = [self._wrong(prior) for _ in range(top_k - 1)]
        offset_m = np.array([truth.easting_m, truth.northing_m]) - prior.center_m
        if self.rng.random() < self.right and np.hypot(*offset_m) <= prior.radius_m:
            shift = self.rng.standard_normal(3) * (3.0, 3.0, 1.5)
            found.insert(0, moved(truth, shift))
        return Match(poses=found, scores=np.linspace(0.9, 0.1, len(found)).tolist())

    def _wrong(self, prior):
        away_m, turn = prior.radius_m * np.sqrt(self.rng.random()), 2 * np.pi * self.rng.random()
        east_m, north_m = np.array(prior.center_m) + away_m * np.array([np.sin(turn), np.cos(turn)])
        yaw_deg = (prior.yaw_deg or 0.0) + (prior.yaw_sigma_deg or 90.0) * self.rng.uniform(-2, 2)
        return Pose(easting_m=float(east_m), northing_m=float(north_m), yaw_deg=yaw_deg)


def moved(pose, shift):
    return Pose(
        easting_m=pose.easting_m + shift[0], northing_m=pose.northing_m + shift[1], yaw_deg=pose.yaw_deg + shift[2]
    )


@dataclass
class Flown:
    """Errors of place (metres), whether each was accepted, and normalised squared errors; shape (N,) each."""

    away_m: np.ndarray
    accepted: np.ndarray
    nees: np.ndarray

    @property
    def is_false(self):
        return self.accepted & (self.away_m > 25)


def fly(tracker, poses, queries):
    away_m, accepted, nees = [], [], []
    tracker.start(queries[0].prior)
    for pose, query in zip(poses, queries, strict=True):
        fix = check_fix(tracker.step(query), top_k=25)
        gap = np.array(
            [
                fix.pose.easting_m - pose.easting_m,
                fix.pose.northing_m - pose.northing_m,
                float(wrap_deg(fix.pose.yaw_deg - pose.yaw_deg)),
            ]
        )
        away_m.append(np.hypot(*gap[:2]))
        accepted.append(fix.is_accepted)
        nees.append(gap @ np.linalg.solve(fix.covariance, gap))
    return Flown(np.array(away_m), np.array(accepted), np.array(nees))


def fused(kind, matcher, queries):
    """Fly with a matcher that knows the poses."""
    tracker = kind(matcher)
    grid = Grid(epsg=32632, west_m=0.0, north_m=6000.0, cell_size_m=2.0, rows=3000, cols=3000)
    tracker.prepare(type("Map", (), {"grid": grid}), None)
    return fly(tracker, matcher.poses, queries)


@pytest.mark.parametrize("kind", rest_slow(FUSING, but=2))
def test_with_views_of_a_map_it_is_right_soon_and_its_covariance_holds(kind):
    region = region_of(textured(3))
    poses = winding(8, spacing_m=25.0, start_m=(1150.0, 8700.0))
    views = [view_of(region, pose, size_cells=96) for pose in poses]
    tracker = kind()
    tracker.prepare(region, None)
    flown = fly(tracker, poses, views_of(poses, evidence=views, radius_m=60.0))
    assert not flown.accepted[0]
    assert flown.accepted[5:].all()
    assert flown.away_m[5:].max() < 6.0
    assert np.median(flown.nees[5:]) < 7.8


@pytest.mark.parametrize("kind", FUSING)
def test_with_errors_in_many_views_it_accepts_hardly_anything_wrong(kind):
    poses = winding(40)
    flown = fused(kind, Fair(poses, right=0.7), views_of(poses))
    assert flown.accepted[10:].mean() > 0.6
    assert flown.is_false.sum() <= 1
    assert np.median(flown.nees[flown.accepted]) < 7.8


@pytest.mark.parametrize("kind", FUSING)
def test_with_nothing_but_errors_it_withholds(kind):
    poses = winding(40)
    flown = fused(kind, Fair(poses, right=0.0), views_of(poses, radius_m=500.0))
    assert flown.accepted.sum() <= 2


@pytest.mark.parametrize("kind", FUSING)
def test_where_nothing_is_seen_it_falls_silent_and_comes_back(kind):
    poses = winding(45)
    flown = fused(kind, Fair(poses, blind=tuple(range(12, 30))), views_of(poses))
    assert flown.accepted[6:12].all()
    assert not flown.accepted[25:30].any()
    assert flown.accepted[40:].all()
    assert not flown.is_false.any()


@pytest.mark.parametrize("kind", FUSING)
def test_carried_elsewhere_unseen_it_is_found_again(kind):
    first = winding(14)
    end_m = (first[-1].easting_m, first[-1].northing_m)
    poses = [*first, *winding(34, start_m=(end_m[0] + 150.0, end_m[1] + 250.0))]
    flown = fused(kind, Fair(poses), views_of(poses, radius_m=500.0, jumps=(14,)))
    assert flown.accepted[6:14].all()
    assert flown.is_false[14:].sum() <= 4
    assert flown.accepted[-6:].all()


@pytest.mark.parametrize("kind", [*FUSING, VioDeadReckoning])
def test_lost_steps_and_a_start_without_a_place_are_borne(kind):
    poses = winding(12)
    queries = views_of(poses, lost=(4, 5, 9))
    queries[0] = replace(queries[0], prior=NOTHING)
    if kind is VioDeadReckoning:
        tracker = kind()
        tracker.prepare(region_of(textured(3, 64)), None)
        flown = fly(tracker, poses, queries)
    else:
        flown = fused(kind, Fair(poses, blind=tuple(range(12))), queries)
    assert not flown.accepted.any()


def test_odometry_alone_is_accepted_while_it_believes_that_it_is_near():
    poses = winding(60)
    tracker = VioDeadReckoning()
    tracker.prepare(region_of(textured(3, 64)), None)
    near, far = (fly(tracker, poses, views_of(poses, radius_m=radius_m)) for radius_m in (6.0, 500.0))
    assert near.accepted[:2].all()
    assert not near.accepted[-1]
    assert not far.accepted.any()
    again = fly(tracker, poses, views_of(poses, radius_m=6.0))
    assert (again.away_m == near.away_m).all()


def test_a_fix_of_half_the_confidence_has_twice_the_covariance():
    here = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    tracker = SatlocLayers(Fair([here]))
    grid = Grid(epsg=32632, west_m=0.0, north_m=6000.0, cell_size_m=2.0, rows=3000, cols=3000)
    tracker.prepare(type("Map", (), {"grid": grid}), None)
    tracker.start(NOTHING)
    query = views_of([here])[0]
    sure, half, none = (
        tracker.covariance_of(Match(poses=[here], scores=[1.0], diagnostics=said), query)
        for said in ({"ks_share": 1.0}, {"ks_share": 0.5}, {"ks_share": 0.0})
    )
    assert np.allclose(half, 2 * sure)
    assert np.allclose(none, 10 * sure)
    assert np.allclose(tracker.covariance_of(Match(poses=[here], scores=[1.0]), query), sure)
