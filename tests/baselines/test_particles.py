# SPDX-License-Identifier: Apache-2.0
"""The core of the particle filters: draws, motion, resampling, moments and clusters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.trackers.particles import LOST_M, Noise, Particles, generator

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Prior

GRID = Grid(epsg=32632, west_m=1000.0, north_m=9000.0, cell_size_m=2.0, rows=300, cols=200)


def particles_at(places_m, *, yaw_deg=0.0, weight=None):
    """Particles at places, of equal weight unless given."""
    place_m = np.asarray(places_m, dtype=np.float64)
    count = len(place_m)
    weights = np.full(count, 1.0 / count) if weight is None else np.asarray(weight, dtype=np.float64)
    yaws = np.broadcast_to(np.asarray(yaw_deg, dtype=np.float64), count).copy()
    return Particles(place_m=place_m, yaw_deg=yaws, scale=np.ones(count), weight=weights)


def test_particles_of_a_disc_are_even_over_it_and_head_as_the_prior_says():
    prior = Prior(center_m=(100.0, 200.0), radius_m=50.0, yaw_deg=350.0, yaw_sigma_deg=20.0, scale_sigma=0.1)
    drawn = Particles.drawn(prior, GRID, count=20_000, rng=generator("t", "disc"))
    away_m = np.hypot(*(drawn.place_m - prior.center_m).T)
    assert away_m.max() <= 50.0
    assert np.mean(away_m <= 25.0) == pytest.approx(0.25, abs=0.01)
    assert drawn.yaw_deg.mean() == pytest.approx(350.0, abs=0.5)
    assert (drawn.yaw_deg.std(), drawn.scale.std()) == pytest.approx((20.0, 0.1), rel=0.03)


def test_particles_without_a_prior_are_even_over_the_map_and_all_headings():
    prior = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
    drawn = Particles.drawn(prior, GRID, count=20_000, rng=generator("t", "map"))
    assert drawn.place_m.mean(axis=0) == pytest.approx([1200.0, 8700.0], abs=4.0)
    assert (drawn.place_m >= [1000.0, 8400.0]).all()
    assert abs(np.exp(1j * np.radians(drawn.yaw_deg)).mean()) < 0.02
    assert np.unique(drawn.scale).tolist() == [1.0]


def test_motion_follows_the_heading_of_each_particle_and_spreads_by_both_noises():
    start = particles_at(np.zeros((20_000, 2)), yaw_deg=90.0)
    covariance = (9.0, 0.0, 0.0, 0.0, 16.0, 0.0, 0.0, 0.0, 4.0)
    moved = start.moved((0.0, 50.0, 10.0), covariance, noise=Noise(place_m=4.0), rng=generator("t", "moved"))
    assert moved.place_m.mean(axis=0) == pytest.approx([50.0, 0.0], abs=0.2)
    assert moved.place_m.std(axis=0) == pytest.approx([np.hypot(4, 4), np.hypot(3, 4)], rel=0.03)  # up is east
    assert (moved.yaw_deg.mean(), moved.yaw_deg.std()) == pytest.approx((100.0, 2.0), rel=0.03)


def test_a_lost_increment_spreads_widely_around_where_the_particles_were():
    moved = particles_at(np.zeros((20_000, 2))).moved(None, None, noise=Noise(), rng=generator("t", "lost"))
    assert moved.place_m.std(axis=0) == pytest.approx([LOST_M, LOST_M], rel=0.03)
    assert moved.yaw_deg.std() == pytest.approx(90.0, rel=0.03)


@given(
    weights=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30), count=st.integers(1, 60), seed=st.integers(0, 99)
)
def test_systematic_resampling_draws_each_particle_count_times_its_weight(weights, count, seed):
    weight = (np.array(weights) + 1e-3) / (np.array(weights) + 1e-3).sum()
    start = particles_at(np.column_stack([np.arange(len(weight)), np.zeros(len(weight))]), weight=weight)
    drawn = start.resampled(count, rng=np.random.default_rng(seed))
    times = np.bincount(drawn.place_m[:, 0].astype(int), minlength=len(weight))
    assert times.sum() == count == len(drawn)
    assert (np.abs(times - count * weight) < 1.0 + 1e-9).all()
    assert drawn.weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("way", ["resampled", "resampled_multinomial"])
def test_resampling_keeps_the_mean(way):
    rng = np.random.default_rng(3)
    start = particles_at(rng.normal(size=(500, 2))).weighed(rng.random(500))
    means = [getattr(start, way)(400, rng=rng).place_m.mean(axis=0) for _ in range(400)]
    assert np.mean(means, axis=0) == pytest.approx(start.weight @ start.place_m, abs=0.01)


def test_weights_follow_the_likelihood_and_stay_where_nothing_is_likely():
    start = particles_at(np.zeros((4, 2)))
    halved = start.weighed(np.array([3.0, 1.0, 0.0, 0.0]))
    assert halved.weight.tolist() == [0.75, 0.25, 0.0, 0.0]
    assert halved.effective_count == pytest.approx(1.6)
    assert start.weighed(np.zeros(4)).weight.tolist() == [0.25] * 4


@given(turn_deg=st.floats(-720.0, 720.0))
def test_the_mean_and_spread_of_headings_turn_with_them(turn_deg):
    start = particles_at(np.zeros((3, 2)), yaw_deg=[-10.0, 0.0, 22.0], weight=[0.25, 0.5, 0.25])
    turned = particles_at(np.zeros((3, 2)), yaw_deg=start.yaw_deg + turn_deg, weight=start.weight)
    assert np.cos(np.radians(turned.mean.yaw_deg - start.mean.yaw_deg - turn_deg)) == pytest.approx(1.0)
    assert turned.covariance == pytest.approx(start.covariance, abs=1e-6)


def test_a_covariance_by_hand_and_of_equal_particles():
    start = particles_at([[0.0, 0.0], [6.0, 2.0]], yaw_deg=[358.0, 2.0])
    expected = [[10.0, 3.0, 6.0], [3.0, 2.0, 2.0], [6.0, 2.0, 4.25]]  # with 1 m2, 1 m2 and 0.25 deg2 added
    assert start.covariance == pytest.approx(np.array(expected), abs=1e-6)
    assert start.spread_m == pytest.approx(np.sqrt(10.0))
    assert np.linalg.eigvalsh(particles_at(np.zeros((5, 2))).covariance)[0] == pytest.approx(0.25)


def test_the_heaviest_cluster_is_that_of_most_weight_not_of_most_particles():
    places_m = np.concatenate([np.zeros((80, 2)), np.full((40, 2), 500.0), [[5000.0, 0.0]]])
    weight = np.concatenate([np.full(80, 0.3 / 80), np.full(40, 0.4 / 40), [0.3]])
    found = particles_at(places_m, weight=weight).heaviest_cluster(reach_m=30.0, least=20)
    assert (found.count, found.mass) == (2, pytest.approx(0.4))
    assert np.flatnonzero(found.members).tolist() == list(range(80, 120))


def test_scattered_particles_are_one_cluster():
    found = particles_at(np.random.default_rng(0).uniform(0, 3e4, (50, 2))).heaviest_cluster(reach_m=30.0, least=20)
    assert (found.count, found.mass, found.members.all()) == (1, 1.0, True)
