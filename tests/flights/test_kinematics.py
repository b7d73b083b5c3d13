# SPDX-License-Identifier: Apache-2.0
"""Flown paths: limits of speed, turn rate, acceleration and climb hold, and attitudes are those of real flights."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.kinematics import (
    GRAVITY_MPS2,
    Limits,
    crab_deg,
    fly,
    length_m,
    round_corners,
    tilt_deg,
    yaw_rate_deg_s,
)
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import wrap_deg

CORNER = [[0.0, 0.0], [0.0, 300.0], [300.0, 300.0]]


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _survey(leg_m: float, legs: int, spacing_m: float = 60.0) -> np.ndarray:
    """A lawn-mower path as a user might type it."""
    return np.column_stack([np.repeat(np.arange(legs) * spacing_m, 2), np.resize([0, leg_m, leg_m, 0], 2 * legs)])


def _velocity_mps(flown: Trajectory) -> np.ndarray:
    return np.diff(flown.position_m, axis=0) / np.diff(flown.time_s)[:, None]


@st.composite
def _paths(draw: st.DrawFn) -> np.ndarray:
    """Legs of 40 to 400 m with turns of up to 150 degrees."""
    legs = draw(st.lists(st.tuples(st.floats(40.0, 400.0), st.floats(-150.0, 150.0)), min_size=2, max_size=6))
    lengths, turns = np.array(legs).T
    course = np.radians(np.cumsum(turns))
    sides = lengths[:, None] * np.column_stack([np.sin(course), np.cos(course)])
    return np.vstack([[0.0, 0.0], np.cumsum(sides, axis=0)])


@settings(max_examples=30)
@given(
    path_m=_paths(),
    slow_mps=st.floats(8.0, 14.0),
    more_mps=st.floats(0.0, 6.0),
    corner_mps=st.floats(2.0, 8.0),
    rate_deg_s=st.floats(20.0, 90.0),
    gain_mps2=st.floats(1.0, 4.0),
    seed=st.integers(0, 99),
)
def test_speed_turn_rate_acceleration_and_climb_keep_their_limits(
    path_m, slow_mps, more_mps, corner_mps, rate_deg_s, gain_mps2, seed
) -> None:
    limits = Limits(
        speed_mps=(slow_mps, slow_mps + more_mps),
        corner_mps=corner_mps,
        turn_rate_deg_s=rate_deg_s,
        acceleration_mps2=gain_mps2,
        climb_mps=1.0,
    )
    flown = fly(path_m, height_m=100.0, rng=_rng(seed), limits=limits)
    velocity = _velocity_mps(flown)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    assert speed.max() <= limits.speed_mps[1] * 1.001
    assert np.abs(velocity[:, 2]).max() <= 1.0 + 1e-9
    course = np.unwrap(np.arctan2(velocity[:, 0], velocity[:, 1]))
    assert np.degrees(np.abs(np.diff(course)).max()) / 0.2 <= rate_deg_s * 1.05
    assert np.abs(np.diff(speed)).max() / 0.2 <= gain_mps2 * 1.05 + 0.05
    side = np.abs(np.diff(course)) / 0.2 * (speed[1:] + speed[:-1]) / 2
    assert side.max() <= limits.side_mps2 * 1.05
    assert tilt_deg(flown).max() <= limits.tilt_deg + 0.01
    assert yaw_rate_deg_s(flown).max() <= rate_deg_s * 1.05 + 2  # with what the crab angle changes
    rounded_m = length_m(round_corners(path_m, limits.turn_radius_m))
    assert -0.2 * limits.speed_mps[1] <= flown.distance_m[-1] / 0.98 - rounded_m <= 0.03 * rounded_m


@given(path_m=_paths(), radius_m=st.floats(1.0, 60.0))
def test_rounded_corners_lie_inside_and_are_no_sharper_than_asked_where_sides_are_long(path_m, radius_m) -> None:
    rounded = round_corners(path_m, radius_m)
    assert rounded[0].tolist() == path_m[0].tolist()
    assert rounded[-1].tolist() == path_m[-1].tolist()
    assert length_m(rounded) <= length_m(path_m) + 1e-9
    assert (rounded.min(axis=0) >= path_m.min(axis=0) - 1e-9).all()
    assert (rounded.max(axis=0) <= path_m.max(axis=0) + 1e-9).all()


def test_a_square_corner_is_a_quarter_of_a_circle() -> None:
    rounded = round_corners(CORNER, 40.0)
    centre = np.array([40.0, 260.0])
    assert np.hypot(*(rounded[1:-1] - centre).T) == pytest.approx(40.0)
    assert length_m(rounded) == pytest.approx(600 - 80 + 20 * np.pi, rel=1e-4)


def test_a_flight_follows_its_path_at_an_even_speed_and_slows_for_the_corner() -> None:
    flown = fly(CORNER, height_m=80.0, rng=_rng(), limits=Limits(speed_mps=(10.0, 10.0)))
    assert flown.position_m[0, :2] == pytest.approx([0, 0], abs=1e-6)
    assert flown.position_m[-1, :2] == pytest.approx([300, 300], abs=2.5)  # poses are 0.2 s apart
    assert flown.position_m[:, 2] == pytest.approx(80.0, abs=3.0)
    assert np.diff(flown.time_s) == pytest.approx(0.2)
    speed = np.diff(flown.distance_m) / 0.2
    assert np.median(speed) == pytest.approx(10.0, abs=1e-3)
    assert 2.5 < speed.min() < 4.5
    assert np.abs(wrap_deg(flown.yaw_deg[:100])).max() < 12  # heads north with a crab angle, then east
    assert np.abs(wrap_deg(flown.yaw_deg[-100:] - 90)).max() < 12


def test_the_same_seed_flies_the_same_flight_and_another_another() -> None:
    first, again, other = (fly(CORNER, height_m=80.0, rng=_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first.quaternion_xyzw, again.quaternion_xyzw)
    assert np.array_equal(first.position_m, again.position_m)
    assert len(other) != len(first)


def test_a_drone_leans_into_its_turn() -> None:
    """In a steady turn to the right the right side is down, by the centripetal force."""
    angles = np.linspace(0.0, 4 * np.pi, 1000)
    circle = 60.0 * np.column_stack([-np.cos(angles), np.sin(angles)])  # clockwise from above
    flown = fly(circle, height_m=80.0, rng=_rng(), limits=Limits(speed_mps=(12.0, 12.0)))
    right = flown.rotation.apply([0.0, 1.0, 0.0])
    lean_deg = np.degrees(np.arcsin(-right[:, 2]))
    assert lean_deg[50:-50].mean() == pytest.approx(np.degrees(np.arctan(12.0**2 / 60 / GRAVITY_MPS2)), abs=2.0)


def test_heights_climb_evenly_from_the_first_to_the_last() -> None:
    flown = fly(CORNER, height_m=(60.0, 120.0), rng=_rng())
    assert flown.position_m[[0, -1], 2] == pytest.approx([60, 120], abs=2.5)
    assert np.abs(_velocity_mps(flown)[:, 2]).max() < 3.0
    with pytest.raises(FlightError, match=r"from 60 to 400 m is too steep: this path leaves time for \d+ m of climb"):
        fly(CORNER, height_m=(60.0, 400.0), rng=_rng())


@cache
def _measured(carriage: str) -> dict[str, list[float]]:
    """Percentiles of surveys of about the size of the measured flights (docs/concepts/flights.md)."""
    flights = [
        fly(_survey(leg_m, legs), height_m=90.0, rng=_rng(seed), carriage=carriage)  # type: ignore[arg-type]
        for seed in range(16)
        for leg_m, legs in ((500.0, 6), (600.0, 8))
    ]
    taken = {"tilt": (tilt_deg, (50, 95, 99)), "rate": (yaw_rate_deg_s, (50, 95, 99)), "crab": (crab_deg, (5, 95))}
    return {
        name: np.percentile(np.concatenate([measure(flown) for flown in flights]), at).tolist()
        for name, (measure, at) in taken.items()
    }


def test_surveys_have_the_attitudes_of_real_flights() -> None:
    found = _measured("body")
    assert found["tilt"] == pytest.approx([9.6, 21.5, 24.0], abs=1.0)
    assert found["crab"] == pytest.approx([-5.0, 2.5], abs=0.7)
    p50, p95, p99 = found["rate"]
    assert p50 == pytest.approx(0.24, abs=0.08)
    assert p95 == pytest.approx(18, abs=3)  # it follows the length of the legs
    assert p99 == pytest.approx(59, abs=4)


def test_a_gimbal_leans_as_measured() -> None:
    assert _measured("gimbal")["tilt"][:2] == pytest.approx([5.0, 8.0], abs=0.4)


def test_measures_of_attitude_are_those_of_a_known_flight() -> None:
    """Flies north-east, points north, then north-east again after a turn through north."""
    flown = Trajectory.of_angles(
        time_s=[0.0, 2.0, 4.0], position_m=[[0, 0, 50], [10, 10, 50], [20, 20, 50]], yaw_deg=[350.0, 350.0, 10.0],
        roll_deg=-20.0,
    )  # fmt: skip
    assert crab_deg(flown).tolist() == pytest.approx([55.0, 45.0])
    assert yaw_rate_deg_s(flown).tolist() == pytest.approx([0.0, 10.0])
    assert tilt_deg(flown).tolist() == pytest.approx([20.0] * 3)


@pytest.mark.parametrize(
    ("path", "match"),
    [
        ([[0, 0]], "two distinct points at least, got 1"),
        ([[0, 0], [0, 0]], "two distinct points at least, got 1"),
        ([[0, 0, 0], [1, 1, 1]], r"shape \(N, 2\), got shape \(2, 3\)"),
        ([[0, 0], [float("nan"), 1]], "finite eastings"),
        ([[0, 0], [0, 100], [1, 0]], "turns back on itself at point 2"),
        ([[0, 0], [1e6, 0]], "500 km at most, got 1000 km"),
        ([], "a path has finite eastings and northings"),
    ],
)
def test_paths_that_cannot_be_flown_are_refused(path: list, match: str) -> None:
    with pytest.raises(FlightError, match=match):
        fly(path, height_m=80.0, rng=_rng())


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ({"speed_mps": (12.0, 8.0)}, "must not fall"),
        ({"corner_mps": 9.0}, "must not fall"),
        ({"climb_mps": 0.0}, "positive numbers"),
        ({"acceleration_mps2": float("inf")}, "positive numbers"),
        ({"tilt_deg": 90.0}, "less than 90"),
    ],
)
def test_limits_that_cannot_be_are_refused(values: dict, match: str) -> None:
    with pytest.raises(FlightError, match=match):
        Limits(**values)


@pytest.mark.parametrize("wish", [{"height_m": 0.0}, {"height_m": float("nan")}, {"step_s": 0.0}, {"carriage": "kite"}])
def test_heights_and_steps_that_cannot_be_are_refused(wish: dict) -> None:
    with pytest.raises(FlightError, match=next(iter(wish))):
        fly(CORNER, rng=_rng(), **({"height_m": 80.0} | wish))
