# SPDX-License-Identifier: Apache-2.0
"""Odometry that is drawn: its drift lasts, depends on distance alone, and is what its covariances say."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError, FlightError, StoreError
from sasgeo_bench.flights.drift_profile import (
    DriftProfile,
    Dropouts,
    HeadingDrift,
    Resets,
    ScaleDrift,
    SlipDrift,
    list_profiles,
    load_profile,
    read_drift_profile,
    write_drift_profile,
)
from sasgeo_bench.flights.odometry import (
    LOST_M,
    Odometry,
    dead_reckon,
    draw_gauss_markov,
    draw_odometry,
    heading_law,
    lattice_covariance,
    mean_variance,
)
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import wrap_deg
from tests.slow import rest_slow

KINDS = {
    "scale": {"scale": ScaleDrift(bias_pct=1.0, wander_pct=1.0, length_m=100.0)},
    "slip": {"slip": SlipDrift(sigma_pct=2.0, length_m=20.0)},
    "walk": {"heading": HeadingDrift(walk_deg_at_100m=2.0)},
    "rate": {"heading": HeadingDrift(rate_deg_at_100m=2.0)},
    "saturates": {"heading": HeadingDrift(walk_deg_at_100m=2.0, length_m=100.0)},
}


def profile(**parts) -> DriftProfile:
    return load_profile("perfect").model_copy(update=parts)


def curved(step_m=20.0, length_m=800.0) -> Trajectory:
    """A spiral that climbs, at 10 m/s; the body heads where it flies."""
    at = np.arange(0.0, length_m + step_m / 2, step_m)
    angle = np.sqrt(at + 100) / 8
    radius = 4 * angle * 8
    east, north = radius * np.cos(angle), radius * np.sin(angle)
    yaw = np.degrees(np.arctan2(np.gradient(east), np.gradient(north)))
    return Trajectory.of_angles(time_s=at / 10, position_m=np.stack([east, north, at / 50], axis=1), yaw_deg=yaw)


def straight(step_m=10.0, length_m=1000.0) -> Trajectory:
    at = np.arange(0.0, length_m + step_m / 2, step_m)
    position = np.stack([0 * at, at, 0 * at + 80], axis=1)
    return Trajectory.of_angles(time_s=at / 10, position_m=position, yaw_deg=0 * at)


def true_odometry(flown) -> Odometry:
    return draw_odometry(flown, load_profile("perfect"), rng=np.random.default_rng(0))


def end_errors(flown, drift, count, seed=0):
    """East and north, metres, and heading, degrees, of the believed end, shape (count, 3)."""
    found = []
    for at in range(count):
        believed = dead_reckon(flown, draw_odometry(flown, drift, rng=np.random.default_rng([seed, at])))
        turn = float(wrap_deg(believed.yaw_deg[-1] - flown.yaw_deg[-1]))
        found.append([*(believed.position_m[-1] - flown.position_m[-1])[:2], turn])
    return np.array(found)


# Increments


def test_without_drift_the_increments_lead_along_the_flight_in_the_axes_of_the_body() -> None:
    flown = curved()
    reckoned = dead_reckon(flown, true_odometry(flown))
    np.testing.assert_allclose(reckoned.position_m, flown.position_m, atol=1e-9)
    np.testing.assert_allclose(reckoned.rotation.as_matrix(), flown.rotation.as_matrix(), atol=1e-9)
    flown = Trajectory.of_angles(time_s=[0.0, 1.0], position_m=[[0, 0, 80], [10, 0, 80]], yaw_deg=[90.0, 120.0])
    steps = true_odometry(flown)
    assert (steps.right_m[0], steps.up_m[0], steps.yaw_deg[0]) == pytest.approx((0, 10, 30))


def test_the_same_seed_gives_the_same_odometry_and_another_one_another() -> None:
    first, again, other = (
        draw_odometry(curved(), load_profile("vio-mono"), rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert first.up_m.tolist() == again.up_m.tolist()
    assert first.up_m.tolist() != other.up_m.tolist()


@pytest.mark.parametrize("kind", rest_slow(KINDS, but=2))
def test_five_times_as_many_poses_have_the_same_drift_at_the_same_distance(kind) -> None:
    """The fault of white noise on each step: its drift after a distance depends on how often one looks."""
    fine, coarse = (
        np.mean(end_errors(straight(step), profile(**KINDS[kind]), 400, seed=int(step)) ** 2, axis=0)
        for step in (10.0, 50.0)
    )
    # Root mean squares of place and heading; 400 runs each know one to 4 %.
    assert np.sqrt(fine[:2].sum()) == pytest.approx(np.sqrt(coarse[:2].sum()), rel=0.13)
    assert np.sqrt(fine[2]) == pytest.approx(np.sqrt(coarse[2]), rel=0.13, abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "law"),
    [
        ("scale", 10 * np.sqrt(1 + mean_variance(np.array([1000.0]), length_m=100.0)[0])),
        ("slip", 20 * np.sqrt(2 * mean_variance(np.array([1000.0]), length_m=20.0)[0])),
        ("walk", 1000 * np.radians(2.0 / 10) * np.sqrt(1000 / 3)),
        ("rate", 1000 * np.radians(20.0) / 2),
        ("saturates", 1000 * np.radians(0.2) * np.sqrt(heading_law(np.array([1000.0]), length_m=100.0).mean[0])),
    ],
)
def test_the_end_of_a_kilometre_is_off_by_the_law(kind, law) -> None:
    errors = end_errors(straight(), profile(**KINDS[kind]), 300)
    assert np.sqrt(np.mean(errors[:, 0] ** 2 + errors[:, 1] ** 2)) == pytest.approx(law, rel=0.12)


def test_errors_of_neighbouring_increments_are_alike_and_their_sum_grows() -> None:
    """Differences of truth plus white noise have no such correlation; two published systems were fed with them."""
    flown, drift = straight(step_m=2.0), profile(slip=SlipDrift(sigma_pct=2.0, length_m=20.0))
    errors = np.array([draw_odometry(flown, drift, rng=np.random.default_rng(seed)).up_m - 2.0 for seed in range(40)])
    lag = np.mean(errors[:, :-1] * errors[:, 1:]) / np.mean(errors**2)
    assert lag == pytest.approx(np.exp(-2 / 20), abs=0.05)
    white = np.sqrt(100) * np.std(errors)
    assert np.std(errors[:, :100].sum(axis=1)) > 2.5 * white


@pytest.mark.parametrize("name", ["vio-stereo", "vio-mono", "wheel-poor", "vo-mono-survey"])
def test_covariances_are_those_of_the_increments(name) -> None:
    flown, drift = curved(), load_profile(name)
    true, found = true_odometry(flown), []
    for seed in range(400):
        steps = draw_odometry(flown, drift, rng=np.random.default_rng(seed))
        turn = wrap_deg(steps.yaw_deg - true.yaw_deg)
        error = np.stack([steps.right_m - true.right_m, steps.up_m - true.up_m, turn], axis=1)
        found.append(np.einsum("ni,ni->n", error, np.linalg.solve(steps.covariance, error[..., None])[..., 0]))
    # Normalized squared error, 3 if it fits. wheel-poor has two errors alone: across, it is as far as it turns.
    assert 2.5 <= np.mean(found) <= 3.6


@pytest.mark.parametrize("name", ["vio-stereo", "vio-mono", "wheel-poor", "vo-mono-survey"])
def test_an_optimistic_odometer_errs_as_an_honest_one_and_states_covariances_nine_times_too_small(name) -> None:
    for seed in range(5):
        honest, optimistic = (
            draw_odometry(curved(), load_profile(name), belief=belief, rng=np.random.default_rng(seed))
            for belief in ("honest", "optimistic")
        )
        for part in ("right_m", "up_m", "yaw_deg"):
            np.testing.assert_array_equal(getattr(optimistic, part), getattr(honest, part))
        np.testing.assert_allclose(9 * optimistic.covariance, honest.covariance)


def test_runs_differ_by_more_than_chance_within_them() -> None:
    flown = straight(step_m=20.0, length_m=2000.0)
    spreads = []
    for run_spread in (0.0, 0.9):
        drift = profile(run_spread=run_spread, slip=SlipDrift(sigma_pct=2.0, length_m=20.0))
        runs = [draw_odometry(flown, drift, rng=np.random.default_rng(seed)).up_m - 20.0 for seed in range(120)]
        amplitudes = np.sqrt(np.mean(np.square(runs), axis=1))
        spreads.append(np.std(np.log(amplitudes)))
    assert spreads[0] < 0.15
    assert spreads[1] == pytest.approx(0.9, abs=0.2)


def test_a_reset_jumps_is_believed_and_changes_the_scale_from_there_on() -> None:
    flown = straight(step_m=10.0, length_m=3000.0)
    drift = profile(resets=Resets(per_km=0.5, position_m=50.0, yaw_deg=5.0, scale_pct=10.0))
    steps = draw_odometry(flown, drift, rng=np.random.default_rng(0))
    jumps = np.flatnonzero(steps.covariance[:, 0, 0] > 2000)
    assert 1 <= len(jumps) <= 5
    assert np.std(steps.up_m[: jumps[0]]) < 1e-6
    after = steps.up_m[jumps[0] + 1 : jumps[1] if len(jumps) > 1 else None]
    assert np.std(after) < 1e-6
    assert abs(after[0] - 10.0) > 0.05


def test_a_lost_step_says_nothing_and_reckoning_goes_on_from_where_it_was() -> None:
    flown = straight(step_m=10.0, length_m=3000.0)
    steps = draw_odometry(flown, profile(dropouts=Dropouts(per_km=1.0, length_m=100.0)), rng=np.random.default_rng(1))
    assert 3 < steps.is_lost.sum() < 150
    assert not steps.up_m[steps.is_lost].any()
    assert (steps.covariance[steps.is_lost, 0, 0] == LOST_M**2).all()
    believed = dead_reckon(flown, steps)
    assert len(believed) < len(flown)
    assert believed.position_m[-1, 1] == pytest.approx(3000.0 - 10 * steps.is_lost.sum())


def test_nothing_drifts_while_hovering_and_a_process_over_steps_of_nothing_stays() -> None:
    hover = Trajectory.of_angles(time_s=np.arange(9.0), position_m=np.zeros((9, 3)), yaw_deg=np.arange(9.0))
    steps = draw_odometry(hover, load_profile("vio-mono"), rng=np.random.default_rng(0))
    assert not steps.up_m.any()
    np.testing.assert_allclose(steps.yaw_deg, 1.0)
    assert (np.linalg.eigvalsh(steps.covariance) > 0).all()
    drawn = draw_gauss_markov(np.zeros(4), length_m=10.0, rng=np.random.default_rng(0))
    assert len(set(drawn.values.tolist())) == 1
    np.testing.assert_allclose(drawn.means, drawn.values[:-1])


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(FlightError, match="'honest' or 'optimistic', got 81 and 'sure'"):
        draw_odometry(straight(length_m=800.0), load_profile("perfect"), belief="sure", rng=np.random.default_rng(0))
    with pytest.raises(FlightError, match="two poses"):
        draw_odometry(straight(length_m=0.0), load_profile("perfect"), rng=np.random.default_rng(0))
    zeros = np.zeros(2)
    with pytest.raises(FlightError, match=r"covariance of 2 increments has shape \(2, 2\)"):
        Odometry(right_m=zeros, up_m=zeros, yaw_deg=zeros, covariance=np.zeros((2, 2)), is_lost=zeros > 0)


# Processes


@pytest.mark.parametrize("length_m", [0.5, 10.0, 1e5])
def test_a_lattice_has_the_variance_of_one_long_step(length_m) -> None:
    whole = mean_variance(np.array([40.0]), length_m=length_m)[0]
    assert lattice_covariance(8, 5.0, length_m=length_m).mean() == pytest.approx(whole, rel=1e-6)


# Profiles


@pytest.mark.parametrize("name", list_profiles())
def test_every_shipped_profile_says_where_it_comes_from_and_survives_a_round(name, tmp_path) -> None:
    shipped = load_profile(name)
    assert shipped.id == name
    assert len(shipped.source) > 20
    assert len(shipped.limits) > 20
    write_drift_profile(shipped, tmp_path / "again.toml")
    assert read_drift_profile(tmp_path / "again.toml") == shipped


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("id = 3", "'id'"),
        ("[slip]\nsigma_pct = -1.0", "'slip.sigma_pct'"),
        ("[slip]\nsigma = 1.0", "unknown key 'slip.sigma'"),
        ("[heading]\nlength_m = 0.0", "'heading.length_m'"),
        ("run_spread = nan", "'run_spread'"),
        ("[resets]\nper_km = inf", "'resets.per_km'"),
        ("[slip", "not valid TOML"),
    ],
)
def test_a_wrong_profile_is_refused_in_one_line(tmp_path, text, found) -> None:
    path = tmp_path / "mine.toml"
    head = "" if text.startswith("id") else 'id = "mine"\n'
    path.write_text(f'{head}title = "mine"\nsource = "mine"\nlimits = "mine"\n{text}\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=found):
        read_drift_profile(path)


def test_profiles_that_are_none_are_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="there is no drift profile 'vio': choose of perfect, vio-mono"):
        load_profile("vio")
    with pytest.raises(ConfigError, match="cannot be read as a drift profile"):
        read_drift_profile(tmp_path)
    (tmp_path / "large.toml").write_text("#" * 200_000)
    with pytest.raises(ConfigError, match="more than 100000 bytes"):
        read_drift_profile(tmp_path / "large.toml")
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        write_drift_profile(load_profile("perfect"), tmp_path / "file" / "mine.toml")


def test_covariances_tell_no_more_of_the_way_than_the_increments_do() -> None:
    """Solved for the length of a step, the variance of the turn gives what the odometer says, not the truth."""
    flown = straight(step_m=25.0)
    poor = load_profile("wheel-poor")
    steps = draw_odometry(flown, poor, rng=np.random.default_rng(8))
    per_m = poor.heading.walk_deg_at_100m**2 / 100
    told_m = steps.covariance[:, 2, 2] / per_m
    assert told_m == pytest.approx(np.hypot(steps.right_m, steps.up_m), rel=1e-6, abs=1e-4)
    assert np.abs(told_m - 25.0).max() > 0.1
