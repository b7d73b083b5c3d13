# SPDX-License-Identifier: Apache-2.0
"""The particle filters on a made-up map: they find a place without errors, and survive what a flight brings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from sasgeo_baselines import polar
from sasgeo_baselines.trackers import kinnari_mcl
from sasgeo_baselines.trackers.kinnari_mcl import SHIFTS, KinnariMcl, Mosaic, Template, surfaces
from sasgeo_baselines.trackers.ouyang_cfbvm_pf import OuyangCfbvmPf
from sasgeo_baselines.trackers.particles import Particles
from sasgeo_baselines.trackers.swapf import DistanceMaps, SwaPf
from sasgeo_baselines.trackers.zhou_smc import EMBEDDING, Embedding, Table, ZhouSmc

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.query import Step
from tests.made_up import away_m, flight_of, fly, way_of

FILTERS = {"kinnari_mcl": KinnariMcl, "ouyang_cfbvm_pf": OuyangCfbvmPf, "swapf": SwaPf, "zhou_smc": ZhouSmc}
SLOW = {"zhou_smc"}  # sure of its place after more views than are flown here
COUNT = 4000  # particles: enough on this map
STEP_M, VIEWS = 30.0, 12
START = Pose(easting_m=1160.0, northing_m=8420.0, yaw_deg=20.0)
PRIOR = Prior(center_m=(1200.0, 8450.0), radius_m=100.0, yaw_deg=25.0, yaw_sigma_deg=10.0, scale_sigma=0.01)
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.01)


@pytest.fixture(scope="module")
def region(made):
    return made.region_of(made.textured(5, 640))


@pytest.fixture(scope="module")
def prepared(region):
    """A tracker by its name, prepared once: `start` forgets the flight before."""

    @cache
    def of_name(name):
        tracker = FILTERS[name]()
        tracker.count = COUNT
        tracker.prepare(region, None)
        return tracker

    return of_name


@pytest.fixture(scope="module")
def flight(region):
    """Views of a straight flight without errors, and where each was taken."""
    poses = way_of(START, VIEWS, STEP_M)
    views = flight_of(region, poses, prior=PRIOR, increment=(0.0, STEP_M, 0.0), sigmas=(0.5, 0.5, 0.5))
    return tuple(views), tuple(poses)


@pytest.mark.parametrize("name", FILTERS)
def test_a_flight_without_errors_is_followed(name, prepared, flight):
    views, poses = flight
    fixes = fly(prepared(name), views, PRIOR)
    assert away_m(fixes[-1], poses[-1]) <= 10.0
    assert abs(fixes[-1].pose.yaw_deg - START.yaw_deg) <= 10.0
    assert fixes[-1].is_accepted or name in SLOW
    assert not fixes[0].is_accepted


@pytest.mark.parametrize("name", FILTERS)
def test_a_flight_is_answered_alike_whatever_was_flown_before(name, prepared, flight):
    views, _ = flight
    first = fly(prepared(name), views[:4], PRIOR)
    other = [replace(view, step=replace(view.step, sequence_id="g")) for view in views[:4]]
    assert fly(prepared(name), other, PRIOR)[-1].pose != first[-1].pose  # chance comes from the name of the flight
    again = fly(prepared(name), views[:4], PRIOR)
    assert [fix.pose for fix in again] == [fix.pose for fix in first]
    assert all((fix.covariance == same.covariance).all() for fix, same in zip(again, first, strict=True))


@pytest.mark.parametrize("name", FILTERS)
def test_unknown_views_lost_steps_and_an_unknown_start_are_survived(name, prepared, flight):
    views, _ = flight
    blind = views[0].evidence.replace(np.full_like(views[0].evidence.cells, UNKNOWN))
    odd = [
        replace(views[0], evidence=blind),
        views[1],
        replace(views[2], evidence=blind),
        replace(views[3], step=Step(sequence_id="f", frame=3)),
        views[4],
    ]
    fixes = fly(prepared(name), odd, ANYWHERE)
    spreads_m = [np.sqrt(np.trace(fix.covariance[:2, :2])) for fix in fixes]
    assert spreads_m[0] == pytest.approx(np.hypot(640, 640) / np.sqrt(12), rel=0.05)
    assert spreads_m[3] > 100.0  # nobody knows where the odometer lost its way, but for the edges of the map
    assert not fixes[3].is_accepted


@pytest.mark.parametrize("name", FILTERS)
def test_a_view_that_is_unknown_only_spreads_the_belief(name, prepared, flight):
    views, _ = flight
    blind = views[0].evidence.replace(np.full_like(views[0].evidence.cells, UNKNOWN))
    *_, before, after = fly(prepared(name), [*views[:6], replace(views[6], evidence=blind)], PRIOR)
    assert np.trace(after.covariance[:2, :2]) > np.trace(before.covariance[:2, :2])


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_says_what_must_come_first(name, flight):
    views, _ = flight
    with pytest.raises(RuntimeError, match="prepare"):
        FILTERS[name]().start(PRIOR)
    with pytest.raises(RuntimeError, match="start"):
        FILTERS[name]().step(views[0])


def test_distance_maps_of_a_large_map_are_coarser_and_agree(region):
    fine, coarse = DistanceMaps.of(region), DistanceMaps.of(region, most_cells=200 * 200)
    assert (fine.grid.cell_size_m, coarse.grid.cell_size_m) == (2.0, 4.0)
    cells = np.argwhere(np.ones(coarse.grid.shape, dtype=bool))
    rows, cols = fine.grid.to_cells(coarse.grid.to_centres_m(cells)).T
    steps_m = 34.0 / 250
    differences = fine.distance[:, rows, cols].astype(float) - coarse.distance.reshape(len(coarse.distance), -1)
    assert np.abs(differences).max() * steps_m <= 1.5


@pytest.mark.parametrize("heading", range(4))
def test_a_view_is_described_as_the_map_is_under_it(heading, made, region):
    stride, at = 6, 13  # a place every 24 m
    rows = list(polar.described(region, stride=stride))
    place = {"easting_m": 1000.0 + at * 24.0, "northing_m": 9000.0 - at * 24.0}
    seen = made.view_of(region, Pose(**place, yaw_deg=90.0 * heading), size_cells=200)
    found = polar.view_descriptor(seen)
    known = ~np.isnan(found)  # three of the groups: the map has no other classes
    mapped = polar.turned(rows[at][at], -heading, yaws=4)
    assert known.sum() == 3 * polar.DEPTH
    assert np.corrcoef(found[known], mapped[known])[0, 1] > 0.99
    assert np.corrcoef(found[known], rows[at][at][known])[0, 1] < 0.9 or heading == 0


def test_what_is_unknown_of_a_view_does_not_change_what_is_known(made, region):
    seen = made.view_of(region, Pose(easting_m=1300.0, northing_m=8700.0, yaw_deg=0.0), size_cells=192)
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


def test_a_correlation_surface_is_that_of_squares_read_one_by_one(made, region):
    pose = Pose(easting_m=1300.0, northing_m=8700.0, yaw_deg=30.0)
    seen = made.view_of(region, pose, size_cells=192)
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


def test_a_view_without_contrast_correlates_with_nothing(made, region):
    seen = made.view_of(region, Pose(easting_m=1300.0, northing_m=8700.0, yaw_deg=0.0), size_cells=192)
    even = Template.of(seen.replace(np.zeros_like(seen.cells)))
    assert np.abs(surfaces(even, Mosaic.of(region), particles_at(START))).max() < 1e-3
    assert kinnari_mcl.RATIO[1:].min() > 0


def particles_at(pose):
    """One particle."""
    place_m = np.array([[pose.easting_m, pose.northing_m]])
    return Particles(place_m=place_m, yaw_deg=np.array([pose.yaw_deg]), scale=np.ones(1), weight=np.ones(1))


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 3), (513, 5)], ids=lambda shape: f"{shape[0]} x {shape[1]}")
@pytest.mark.parametrize("name", FILTERS)
def test_a_map_of_any_size_is_read(name, shape, made, flight):
    """Of 513 rows the last is alone in its strip and its block."""
    tracker = FILTERS[name]()
    tracker.count = 100
    tracker.prepare(made.region_of(made.textured(5, 640)[:, : shape[0], : shape[1]].copy()), None)
    views, _ = flight
    assert len(fly(tracker, views[:2], PRIOR)) == 2
