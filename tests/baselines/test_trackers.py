# SPDX-License-Identifier: Apache-2.0
"""Trackers: what each holds on a flight over a made-up map, and what those hold that fuse fixes of single views."""

import datetime as dt
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from sasgeo_baselines import polar
from sasgeo_baselines.trackers import zhou_smc
from sasgeo_baselines.trackers.ekf_loose import EkfLoose
from sasgeo_baselines.trackers.foundloc_ransac import FoundlocRansac
from sasgeo_baselines.trackers.kinnari_mcl import SHIFTS, Mosaic, Template, surfaces
from sasgeo_baselines.trackers.lsvl_belief import TAUGHT, LsvlBelief, Parts, Ratio, Shares
from sasgeo_baselines.trackers.particles import Particles
from sasgeo_baselines.trackers.satloc_layers import SatlocLayers
from sasgeo_baselines.trackers.se2_trajectory import Se2Trajectory
from sasgeo_baselines.trackers.swapf import DistanceMaps
from sasgeo_baselines.trackers.vio_dead_reckoning import VioDeadReckoning
from sasgeo_baselines.trackers.zhou_smc import EMBEDDING, Embedding, Table, ZhouSmc

import sasgeo_bench as sgb
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, rotation, wrap_deg
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard, Training
from sasgeo_bench.matching.tracker import check_fix
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.query import Query, Step
from tests.made_up import VIEW_CELLS, away_m, blind, dated_region, flight_of, fly, region_of, textured, view_of, way_of
from tests.slow import rest_slow

PROJECT = tomllib.loads((Path(__file__).parents[2] / "baselines" / "pyproject.toml").read_text(encoding="utf-8"))
REGISTERED = PROJECT["project"]["entry-points"]["sasgeo_bench.trackers"]
# How near the last of some views is placed, for filters that look at the map themselves.
GRIDS_M = {"grid_markov": 6.0, "grid_markov_still": 6.0, "lsvl_belief": 16.0}  # one and a half cells, and one
NEAR_M = {
    **GRIDS_M,
    **dict.fromkeys(("kinnari_mcl", "ouyang_cfbvm_pf", "swapf", "zhou_smc"), 10.0),
}
UNSURE = ("lsvl_belief", "zhou_smc")  # sure of their place after more views than are flown here
PARTICLES = 4000  # enough on this map
STEP_M, VIEWS = 30.0, 12
START = Pose(easting_m=1160.0, northing_m=8420.0, yaw_deg=22.0)
PRIOR = Prior(center_m=(1200.0, 8450.0), radius_m=100.0, yaw_deg=25.0, yaw_sigma_deg=10.0, scale_sigma=0.01)
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.01)
FUSING = (EkfLoose, FoundlocRansac, SatlocLayers, Se2Trajectory)


def made(name: str, *, count: int = PARTICLES) -> sgb.Tracker:
    module, _, attribute = REGISTERED[name].partition(":")
    found = getattr(import_module(module), attribute)()
    if hasattr(found, "count"):
        found.count = count
    return found


@pytest.fixture(scope="module")
def region():
    return dated_region(5, 640)


@pytest.fixture(scope="module")
def prepared(region) -> Callable[[str], sgb.Tracker]:
    """A tracker by its name, prepared once: `start` forgets the flight before."""

    @cache
    def of_name(name: str) -> sgb.Tracker:
        found = made(name)
        found.prepare(region, None)
        return found

    return of_name


@pytest.fixture(scope="module")
def flight(region):
    """Views of a straight flight without errors, and where each was taken."""
    poses = way_of(START, VIEWS, STEP_M)
    views = flight_of(region, poses, prior=PRIOR, increment=(0.0, STEP_M, 0.0), sigmas=(0.5, 0.5, 0.5))
    return tuple(views), tuple(poses)


def spread_m2(fix) -> float:
    return float(np.trace(np.array(fix.covariance)[:2, :2]))


@pytest.mark.parametrize("name", REGISTERED)
def test_a_tracker_is_registered_under_the_name_of_its_card_and_says_what_must_come_first(name, flight) -> None:
    tracker = made(name)
    assert isinstance(tracker.card, MatcherCard)
    assert (tracker.card.name, tracker.card.licence) == (name, "Apache-2.0")
    assert tracker.card.limits
    with pytest.raises(RuntimeError, match="prepare"):
        tracker.start(PRIOR)
    with pytest.raises(RuntimeError, match="start"):
        tracker.step(flight[0][0])


@pytest.mark.parametrize(
    ("name", "prior"), [*((name, PRIOR) for name in NEAR_M), *((name, ANYWHERE) for name in GRIDS_M)]
)
def test_a_flight_without_errors_is_followed(name, prior, prepared, flight) -> None:
    views, poses = (of_all[:8] if name in GRIDS_M else of_all for of_all in flight)
    fixes = fly(prepared(name), views, prior)
    assert away_m(fixes[-1], poses[-1]) <= NEAR_M[name]
    assert abs(fixes[-1].pose.yaw_deg - START.yaw_deg) <= 10.0
    assert fixes[-1].is_accepted or name in UNSURE
    assert not fixes[0].is_accepted


@pytest.mark.parametrize("name", [*NEAR_M, "vio_dead_reckoning"])
def test_a_flight_is_answered_alike_whatever_was_flown_before(name, prepared, flight) -> None:
    views, _ = flight
    first = fly(prepared(name), views[:4], PRIOR)
    other = [replace(view, step=replace(view.step, sequence_id="g")) for view in views[:4]]
    is_drawn = hasattr(prepared(name), "count")  # chance comes from the name of the flight
    assert (fly(prepared(name), other, PRIOR)[-1].pose != first[-1].pose) == is_drawn
    again = fly(prepared(name), views[:4], PRIOR)
    assert [fix.pose for fix in again] == [fix.pose for fix in first]
    assert all(np.array_equal(fix.covariance, same.covariance) for fix, same in zip(again, first, strict=True))


@pytest.mark.parametrize("name", NEAR_M)
def test_blank_views_only_move_and_spread_what_is_believed(name, prepared, flight) -> None:
    views, poses = flight
    fixes = fly(prepared(name), [*views[:8], *map(blind, views[8:])], PRIOR)
    assert away_m(fixes[-1], poses[-1]) <= 2 * NEAR_M[name]
    assert spread_m2(fixes[-1]) > spread_m2(fixes[8]) > spread_m2(fixes[7])
    if name in GRIDS_M:
        assert fixes[-1].confidence <= fixes[7].confidence + 1e-6


@pytest.mark.parametrize("name", NEAR_M)
def test_an_unknown_start_blank_views_and_a_lost_step_are_borne(name, prepared, flight) -> None:
    views, _ = flight
    lost = replace(blind(views[3]), step=Step(sequence_id="f", frame=3))
    fixes = fly(prepared(name), [blind(views[0]), views[1], blind(views[2]), lost, views[4]], ANYWHERE)
    even_m = np.hypot(640, 640) / np.sqrt(12)
    assert np.sqrt(spread_m2(fixes[0])) == pytest.approx(even_m, rel=0.05) or name in GRIDS_M  # their grids are wider
    assert np.sqrt(spread_m2(fixes[3])) > 100.0  # nobody knows where the odometer lost its way
    assert not fixes[3].is_accepted
    assert fixes[3].confidence < 0.2


@pytest.mark.parametrize("name", ["grid_markov", "grid_markov_still"])
def test_a_lost_step_is_found_again(name, prepared, flight) -> None:
    views, poses = flight
    fixes = fly(
        prepared(name), [*views[:3], replace(views[3], step=Step(sequence_id="f", frame=3)), *views[4:8]], PRIOR
    )
    assert away_m(fixes[-1], poses[7]) <= 2 * NEAR_M[name]


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 3), (513, 5)], ids=lambda shape: f"{shape[0]} x {shape[1]}")
@pytest.mark.parametrize("name", NEAR_M)
def test_a_map_of_any_size_is_read(name, shape, region, flight) -> None:
    """Of 513 rows the last is alone in its strip and its block."""
    tracker = made(name, count=100)
    small = region_of(region.layers[:, : shape[0], : shape[1]].copy())
    small.manifest = region.manifest
    tracker.prepare(small, None)
    assert len(fly(tracker, flight[0][:2], PRIOR)) == 2


# Grid filters by hand


def test_without_diffusion_odometry_that_says_too_much_is_believed(prepared, flight):
    views, poses = (of_all[:8] for of_all in flight)
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
    views, poses = (of_all[:8] for of_all in flight)
    pairs = [
        (replace(view, region="made-up"), SimpleNamespace(pose=pose)) for view, pose in zip(views, poses, strict=True)
    ]
    assert LsvlBelief().learn(Training(regions={"made-up": region}, pairs=pairs)) == TAUGHT  # too few
    many = [(replace(view, query_id=f"{number:x}"), truth) for number in range(7) for view, truth in pairs]
    ratio = Ratio.of(LsvlBelief().learn(Training(regions={"made-up": region}, pairs=many)))
    assert (np.diff(ratio.log) <= 0).all()
    assert ratio.log[0] > 1.0 > -1.0 > ratio.log[-1]


# Particle filters by hand


def test_distance_maps_of_a_large_map_are_coarser_and_agree(region):
    fine, coarse = DistanceMaps.of(region), DistanceMaps.of(region, most_cells=200 * 200)
    assert (fine.grid.cell_size_m, coarse.grid.cell_size_m) == (2.0, 4.0)
    cells = np.argwhere(np.ones(coarse.grid.shape, dtype=bool))
    rows, cols = fine.grid.to_cells(coarse.grid.to_centres_m(cells)).T
    steps_m = 34.0 / 250
    differences = fine.distance[:, rows, cols].astype(float) - coarse.distance.reshape(len(coarse.distance), -1)
    assert np.abs(differences).max() * steps_m <= 1.5


@pytest.mark.parametrize("heading", range(4))
def test_a_view_is_described_as_the_map_is_under_it(heading, region):
    stride, at = 6, 13  # a place every 24 m
    rows = list(polar.described(region, stride=stride))
    place = {"easting_m": 1000.0 + at * 24.0, "northing_m": 9000.0 - at * 24.0}
    seen = view_of(region, Pose(**place, yaw_deg=90.0 * heading), size_cells=200)
    found = polar.view_descriptor(seen)
    known = ~np.isnan(found)  # three of the groups: the map has no other classes
    mapped = polar.turned(rows[at][at], -heading, yaws=4)
    assert known.sum() == 3 * polar.DEPTH
    assert np.corrcoef(found[known], mapped[known])[0, 1] > 0.99
    assert np.corrcoef(found[known], rows[at][at][known])[0, 1] < 0.9 or heading == 0


def test_what_is_unknown_of_a_view_does_not_change_what_is_known(region):
    seen = view_of(region, Pose(easting_m=1300.0, northing_m=8700.0, yaw_deg=0.0), size_cells=192)
    cells = seen.cells.copy()
    cells[:, :, :90] = UNKNOWN
    known, half = (polar.view_descriptor(view).reshape(-1, polar.DEPTH) for view in (seen, seen.replace(cells)))
    sectors = half[:, : polar.RINGS * polar.SECTORS].reshape(-1, polar.RINGS, polar.SECTORS)
    assert np.isnan(sectors[0, 4:, 9:15]).all()
    assert not np.isnan(sectors[0, :, 1:7]).any()
    both = ~np.isnan(half)
    both[:, polar.RINGS * polar.SECTORS :] = False
    assert np.median(np.abs(half[both] - known[both])) < 0.01


def test_the_table_of_a_large_map_is_coarser_and_agrees_at_its_places(region):
    embedding = Embedding.read()
    fine, coarse = Table.of(region, embedding), Table.of(region, embedding, most_bytes=100_000)
    assert (fine.step_m, coarse.step_m) == (12.0, 24.0)
    assert np.abs(fine.values[::2, ::2].astype(int) - coarse.values).mean() < 8  # their means differ
    found = fine.at(np.array([[1024.0, 8976.0]]), np.array([720.0 + 45.0]))
    assert found[0] == pytest.approx(fine.values[2, 2, 1] / 127, abs=1e-6)


def test_zhou_drops_the_least_likely_and_resamples_where_few_are_effective():
    rng, weight = np.random.default_rng(0), np.linspace(0.0, 1.0, 20_000)
    start = Particles.drawn(
        ANYWHERE, Grid.around(0, 0, size_m=(9.0, 9.0), cell_size_m=1.0, epsg=32632), count=20_000, rng=rng
    )
    even, uneven = start.weighed(weight + 1.0), start.weighed(weight**4)
    assert ZhouSmc().settled(even, rng=rng) is even
    settled = ZhouSmc().settled(uneven, rng=rng)
    assert len(settled) == 18_000
    assert settled.place_m.mean(axis=0) == pytest.approx(uneven.weight @ start.place_m, abs=0.05)


def test_another_embedding_is_refused(tmp_path):
    path = tmp_path / "embedding.npz"
    path.write_bytes(EMBEDDING.read_bytes() + b" ")
    with pytest.raises(ValueError, match="install sasgeo-baselines again"):
        Embedding.read(path)


@pytest.mark.parametrize(
    ("groups", "named"),
    [
        ((*polar.GROUPS, ("canal",)), "canal"),
        (tuple((*names, "canal") if "water" in names else names for names in polar.GROUPS), "canal"),
        (polar.GROUPS[:-2], "green"),
        (polar.GROUPS[::-1], "farmland"),
    ],
)
def test_weights_of_other_classes_are_refused_in_one_line_that_names_the_class(groups, named, monkeypatch):
    monkeypatch.setattr(zhou_smc, "GROUPS", groups)
    with pytest.raises(ValueError, match=rf"^the weights of zhou_smc do not know the class '{named}'.*fit them anew"):
        Embedding.read()


def test_a_correlation_surface_is_that_of_squares_read_one_by_one(region):
    pose = Pose(easting_m=1300.0, northing_m=8700.0, yaw_deg=30.0)
    seen = view_of(region, pose, size_cells=192)
    cells = seen.cells.copy()
    cells[:, :60] = UNKNOWN
    template, mosaic = Template.of(seen.replace(cells)), Mosaic.of(region)
    there = particles_at(pose)
    found = surfaces(template, mosaic, there)[0].reshape(5, 5)
    known, grey = template.known.reshape(16, 16) > 0, template.share.reshape(-1, 16, 16)
    assert known.sum() == 16 * 11
    around = mosaic.around(there, 16 + 2 * SHIFTS)[0].reshape(-1, 20, 20)
    for down, right in ((0, 0), (2, 2), (1, 4)):
        pairs = [(a[known], b[down : down + 16, right : right + 16][known]) for a, b in zip(grey, around, strict=True)]
        first, second = (np.concatenate([pair[side] - pair[side].mean() for pair in pairs]) for side in (0, 1))
        expected = first @ second / np.sqrt((first @ first) * (second @ second))
        assert found[down, right] == pytest.approx(expected, abs=1e-4)
    assert found.argmax() == 12
    assert found[2, 2] > 0.9
    even = Template.of(seen.replace(np.zeros_like(cells)))  # a view without contrast is like nothing
    assert np.abs(surfaces(even, mosaic, there)).max() < 1e-3


def particles_at(pose):
    """One particle."""
    place_m = np.array([[pose.easting_m, pose.northing_m]])
    return Particles(place_m=place_m, yaw_deg=np.array([pose.yaw_deg]), scale=np.ones(1), weight=np.ones(1))


# Those that fuse fixes with odometry: right where the views are, silent where they are not


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
    rng, queries, move = np.random.default_rng(seed), [], None
    for frame, pose in enumerate(poses):
        step = Step(sequence_id="f", frame=frame)
        if frame and frame not in lost:
            before = poses[frame - 1]
            off_m = np.array([pose.easting_m - before.easting_m, pose.northing_m - before.northing_m])
            if frame not in jumps:
                move = np.array([*(rotation(before.yaw_deg).T @ off_m), float(wrap_deg(pose.yaw_deg - before.yaw_deg))])
            noise = np.array(SIGMAS) * rng.standard_normal(3)
            increment = tuple((move * [SCALE, SCALE, 1.0] + noise).tolist())
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


def flown(tracker, poses, queries):
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
    return flown(tracker, matcher.poses, queries)


@pytest.mark.parametrize("kind", rest_slow(FUSING, but=2))
def test_with_views_of_a_map_it_is_right_soon_and_its_covariance_holds(kind):
    region = region_of(textured(3))
    poses = winding(8, spacing_m=25.0, start_m=(1150.0, 8700.0))
    views = [view_of(region, pose, size_cells=96) for pose in poses]
    tracker = kind()
    tracker.prepare(region, None)
    found = flown(tracker, poses, views_of(poses, evidence=views, radius_m=60.0))
    assert not found.accepted[0]
    assert found.accepted[5:].all()
    assert found.away_m[5:].max() < 6.0
    assert np.median(found.nees[5:]) < 7.8


@pytest.mark.parametrize("kind", FUSING)
def test_with_errors_in_many_views_it_accepts_hardly_anything_wrong(kind):
    poses = winding(40)
    found = fused(kind, Fair(poses, right=0.7), views_of(poses))
    assert found.accepted[10:].mean() > 0.6
    assert found.is_false.sum() <= 1
    assert np.median(found.nees[found.accepted]) < 7.8


@pytest.mark.parametrize("kind", FUSING)
def test_with_nothing_but_errors_it_withholds(kind):
    poses = winding(40)
    found = fused(kind, Fair(poses, right=0.0), views_of(poses, radius_m=500.0))
    assert found.accepted.sum() <= 2


@pytest.mark.parametrize("kind", FUSING)
def test_where_nothing_is_seen_it_falls_silent_and_comes_back(kind):
    poses = winding(45)
    found = fused(kind, Fair(poses, blind=tuple(range(12, 30))), views_of(poses))
    assert found.accepted[6:12].all()
    assert not found.accepted[25:30].any()
    assert found.accepted[40:].all()
    assert not found.is_false.any()


@pytest.mark.parametrize("kind", FUSING)
def test_carried_elsewhere_unseen_it_is_found_again(kind):
    first = winding(14)
    end_m = (first[-1].easting_m, first[-1].northing_m)
    poses = [*first, *winding(34, start_m=(end_m[0] + 150.0, end_m[1] + 250.0))]
    found = fused(kind, Fair(poses), views_of(poses, radius_m=500.0, jumps=(14,)))
    assert found.accepted[6:14].all()
    assert found.is_false[14:].sum() <= 4
    assert found.accepted[-6:].all()


@pytest.mark.parametrize("kind", [*FUSING, VioDeadReckoning])
def test_lost_steps_and_a_start_without_a_place_are_borne(kind):
    poses = winding(12)
    queries = views_of(poses, lost=(4, 5, 9))
    queries[0] = replace(queries[0], prior=NOTHING)
    if kind is VioDeadReckoning:
        tracker = kind()
        tracker.prepare(region_of(textured(3, 64)), None)
        found = flown(tracker, poses, queries)
    else:
        found = fused(kind, Fair(poses, blind=tuple(range(12))), queries)
    assert not found.accepted.any()


def test_odometry_alone_is_accepted_while_it_believes_that_it_is_near():
    poses = winding(60)
    tracker = VioDeadReckoning()
    tracker.prepare(region_of(textured(3, 64)), None)
    near, far = (flown(tracker, poses, views_of(poses, radius_m=radius_m)) for radius_m in (6.0, 500.0))
    assert near.accepted[:2].all()
    assert not near.accepted[-1]
    assert not far.accepted.any()
    again = flown(tracker, poses, views_of(poses, radius_m=6.0))
    assert (again.away_m == near.away_m).all()


def test_a_fix_of_half_the_confidence_has_twice_the_covariance():
    here = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    tracker = SatlocLayers(Fair([here]))
    grid = Grid(epsg=32632, west_m=0.0, north_m=6000.0, cell_size_m=2.0, rows=3000, cols=3000)
    tracker.prepare(type("Map", (), {"grid": grid}), None)
    tracker.start(NOTHING)
    query = views_of([here])[0]
    sure, half, none = (
        tracker.covariance_of(Match(poses=[here], scores=[1.0], diagnostics=each), query)
        for each in ({"ks_share": 1.0}, {"ks_share": 0.5}, {"ks_share": 0.0})
    )
    assert np.allclose(half, 2 * sure)
    assert np.allclose(none, 10 * sure)
    assert np.allclose(tracker.covariance_of(Match(poses=[here], scores=[1.0]), query), sure)
