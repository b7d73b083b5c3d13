# SPDX-License-Identifier: Apache-2.0
"""Drift is measured as it was made: by hand, drawn from a profile, and on real runs."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import ConfigError, FlightError
from sasgeo_bench.flights.drift import (
    fit_profile,
    law_figures,
    measure_drift,
    pair_run,
    poisson_interval,
    segment_errors,
)
from sasgeo_bench.flights.drift_profile import Dropouts, HeadingDrift, Resets, ScaleDrift, load_profile
from sasgeo_bench.flights.odometry import dead_reckon, draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory, read_tum

LENGTHS_M = (50.0, 100.0, 200.0)


def flight(length_m=3000.0, step_m=5.0) -> Trajectory:
    """Lines of 500 m, to and fro, at 10 m/s, with some tilt."""
    at = np.arange(0.0, length_m + step_m / 2, step_m)
    corners = np.array([[0, 0], [0, 500], [50, 500], [50, 0], [100, 0], [100, 500], [150, 500], [150, 0]] * 2, float)
    corners[8:] += (200, 0)
    path = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    east, north = (np.interp(at, path, axis) for axis in corners.T)
    yaw = np.degrees(np.arctan2(np.gradient(east), np.gradient(north)))
    position = np.stack([east, north, np.full(len(at), 80.0)], axis=1)
    return Trajectory.of_angles(time_s=at / 10, position_m=position, yaw_deg=yaw, pitch_deg=5.0, roll_deg=-2.0)


def changed(flown, *, position_m=None, turn_deg=0.0) -> Trajectory:
    """The same poses elsewhere, turned clockwise about the vertical."""
    turn = Rotation.from_euler("z", -np.broadcast_to(turn_deg, len(flown))[:, None], degrees=True)
    return Trajectory(
        time_s=flown.time_s,
        position_m=flown.position_m if position_m is None else position_m,
        quaternion_xyzw=(turn * flown.rotation).as_quat(),
    )


def value_of(figures, figure, length_m=None):
    rows = figures[figures["figure"] == figure]
    return rows[rows["length_m"] == length_m].iloc[0] if length_m else rows.iloc[0]


def drawn_runs(profile, count, *, seed=0, flown=None):
    flown = flown or flight()
    runs = (draw_odometry(flown, profile, rng=np.random.default_rng([seed, at])) for at in range(count))
    return [pair_run(flown, dead_reckon(flown, steps), sequence=str(at)) for at, steps in enumerate(runs)]


# By hand


@given(turn_deg=st.floats(-180, 180), east_m=st.floats(-1e5, 1e5))
def test_where_the_estimates_frame_lies_and_points_is_no_error(turn_deg, east_m) -> None:
    flown = flight(600.0)
    turn = Rotation.from_euler("z", -turn_deg, degrees=True)
    moved = changed(
        flown, position_m=turn.apply(flown.position_m.copy()) + np.array([east_m, 7, -3]), turn_deg=turn_deg
    )
    found = segment_errors(pair_run(flown, moved, sequence="a"), 50.0, spacing_m=5.0)
    np.testing.assert_allclose(found.position_pct, 0, atol=1e-6)
    np.testing.assert_allclose(found.yaw_deg, 0, atol=1e-6)


def test_a_heading_that_drifts_gives_its_rate_with_its_sign_and_a_segment_is_aligned_at_its_first_pose() -> None:
    flown = flight(600.0)
    turned = changed(flown, turn_deg=flown.distance_m / 100 * 2)  # clockwise, 2 degrees after 100 m
    found = segment_errors(pair_run(flown, turned, sequence="a"), 50.0, spacing_m=5.0)
    np.testing.assert_allclose(found.yaw_deg, 1.0, atol=1e-6)
    flown = flight(450.0)  # straight north
    turned = changed(flown, turn_deg=10.0)
    found = segment_errors(pair_run(flown, turned, sequence="a"), 100.0, spacing_m=10.0)
    np.testing.assert_allclose(found.position_pct, 100 * 2 * math.sin(math.radians(5)), rtol=1e-6)


def test_a_jump_is_a_reset_and_no_drift() -> None:
    flown = flight(1000.0)
    places = flown.position_m + np.where(flown.distance_m[:, None] > 505, [30.0, 0, 0], 0)
    figures = measure_drift([pair_run(flown, changed(flown, position_m=places), sequence="a")], lengths_m=[100.0])
    assert value_of(figures, "position_pct", 100.0)["value"] < 1e-6
    rate = value_of(figures, "resets_per_km")
    assert rate["value"] == pytest.approx(1.0)
    assert (rate["lo"], rate["hi"]) == pytest.approx(poisson_interval(1))


def test_a_gap_is_a_lost_stretch_and_a_hover_is_none() -> None:
    flown = flight(1000.0)
    is_seen = (flown.distance_m < 300) | (flown.distance_m > 400)
    seen = Trajectory(
        time_s=flown.time_s[is_seen],
        position_m=flown.position_m[is_seen],
        quaternion_xyzw=flown.quaternion_xyzw[is_seen],
    )
    run = pair_run(flown, seen, sequence="a")
    assert (run.lost, run.lost_m) == (1, pytest.approx(110.0))
    assert len(run.stretches) == 2
    assert pair_run(flown, seen, sequence="a", lost_s=60).lost == 0
    hover = Trajectory.of_angles(
        time_s=[0, 1, 2, 30, 31], position_m=[[0, 5 * n, 9] for n in (0, 1, 2, 2, 3)], yaw_deg=[0] * 5
    )
    assert pair_run(hover, hover, sequence="a").lost == 0


def test_a_length_that_no_run_reaches_has_no_figure_and_poses_too_far_apart_are_told_of() -> None:
    flown = flight(300.0)
    figures = measure_drift([pair_run(flown, flown, sequence="a")], lengths_m=[100.0, 5000.0], draws=10)
    row = value_of(figures, "position_pct", 5000.0)
    assert math.isnan(row["value"])
    assert (row["sequences"], row["segments"]) == (0, 0)
    run = pair_run(flight(600.0, step_m=20.0), flight(600.0, step_m=20.0), sequence="a", lost_s=60)
    with pytest.warns(UserWarning, match=r"poses are 20\.0 m apart, farther than a tenth of 50 m"):
        measure_drift([run], lengths_m=[50.0], draws=10)


def test_runs_of_one_sequence_are_one_cluster_and_one_cluster_alone_has_no_interval() -> None:
    runs = drawn_runs(load_profile("wheel-poor"), 6, flown=flight(600.0))
    whole = [pair_run(flight(600.0), flight(600.0), sequence="a") for _ in range(3)]
    for some, sequences in (([*runs, *whole], 7), (runs[:2], 2), (runs[:1], 1)):
        row = value_of(measure_drift(some, lengths_m=[100.0], draws=50), "position_pct", 100.0)
        assert row["sequences"] == sequences
        assert bool(np.isfinite([row["lo"], row["hi"]]).all()) is (sequences > 1)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"time_s": 1e6}, r"0 of 61 poses of the estimate \(1000000\.000 to 1000030\.000 s\) .* give both one clock"),
        ({"pitch_deg": 90.0}, "differ by 90 degrees of tilt"),
        ({"size": 100}, r"60 of 60 steps are off by more than 1 m .* are of one flight, and"),  # no resets
    ],
)
def test_what_cannot_be_paired_is_refused(change, found) -> None:
    flown = flight(300.0)
    pitch = Rotation.from_euler("x", change.get("pitch_deg", 0.0), degrees=True)
    other = Trajectory(
        time_s=flown.time_s + change.get("time_s", 0.0),
        position_m=change.get("size", 1) * flown.position_m,
        quaternion_xyzw=(flown.rotation * pitch).as_quat(),
    )
    with pytest.raises(FlightError, match=found):
        pair_run(flown, other, sequence="a")


@pytest.mark.parametrize("lengths_m", [[], [0.0], [-5.0], [math.inf], [math.nan]])
def test_lengths_that_cannot_be_are_refused(lengths_m) -> None:
    run = pair_run(flight(300.0), flight(300.0), sequence="a")
    with pytest.raises(FlightError, match="lengths of segments are positive metres"):
        measure_drift([run], lengths_m=lengths_m)
    with pytest.raises(FlightError, match="one run at least"):
        measure_drift([])


@pytest.mark.parametrize(("length_m", "size"), [(1e-9, 1.0), (10.0, 1e9)])
def test_paths_of_more_steps_than_memory_holds_are_refused(length_m, size) -> None:
    flown = flight(300.0)
    large = changed(flown, position_m=size * flown.position_m)
    run = pair_run(large, large, sequence="a")
    with pytest.raises(FlightError, match=r"has more than 1000000 steps of .*: choose longer ones"):
        segment_errors(run, length_m, spacing_m=length_m / 10)


# Drawn from a profile


@pytest.mark.parametrize("name", ["vio-stereo", "vio-mono", "wheel-poor", "vo-mono-survey"])
def test_measuring_drawn_flights_gives_back_the_law_of_the_profile(name) -> None:
    profile = load_profile(name).model_copy(update={"resets": Resets(), "run_spread": 0.0})  # else few runs decide
    runs = drawn_runs(profile, 25)
    figures = measure_drift(runs, lengths_m=LENGTHS_M, draws=1000)
    for figure, length_m, law in law_figures(profile, runs, lengths_m=LENGTHS_M).itertuples(index=False):
        row = value_of(figures, figure, length_m)
        # The law is of first order, good to 5 %.
        assert 0.95 * row["lo"] <= law <= 1.05 * row["hi"], (figure, length_m)


def test_fitting_drawn_flights_gives_back_the_parameters_within_their_intervals() -> None:
    profile = load_profile("vio-stereo").model_copy(update={"run_spread": 0.3})
    fitted = fit_profile(drawn_runs(profile, 25, seed=3), name="again", lengths_m=LENGTHS_M, draws=300)
    rows = fitted.parameters.set_index("name")
    true = {"heading.walk_deg_at_100m": profile.heading.walk_deg_at_100m, "scale.bias_pct": 0.0}
    for name, value in true.items():
        assert rows.loc[name, "lo"] <= value <= rows.loc[name, "hi"], name
    # Beyond its length, slip is known by the product of its variance and its length.
    found, asked = (each.slip.sigma_pct**2 * each.slip.length_m for each in (fitted.profile, profile))
    assert found == pytest.approx(asked, rel=0.4)
    assert fitted.profile.run_spread == pytest.approx(0.3, abs=0.2)
    assert fitted.profile.resets == Resets()


def test_resets_and_dropouts_are_counted_at_their_rates() -> None:
    rare = {"resets": Resets(per_km=2.0, position_m=20.0), "dropouts": Dropouts(per_km=1.0, length_m=60.0)}
    profile = load_profile("perfect").model_copy(update=rare)
    figures = measure_drift(drawn_runs(profile, 20), lengths_m=[50.0], draws=10)
    for figure, rate in (("resets_per_km", 2.0), ("lost_per_km", 1.0)):
        row = value_of(figures, figure)
        assert row["lo"] <= rate <= row["hi"], figure
    # A step is lost if a part of it is: with steps of 5 m, 5 m more than the dropout.
    assert value_of(figures, "lost_pct")["value"] == pytest.approx(6.5, abs=2.5)
    assert value_of(figures, "position_pct", 50.0)["value"] < 1e-6


def test_a_fitted_scale_does_not_end_with_the_first_reset() -> None:
    rare = {"scale": ScaleDrift(bias_pct=3.0), "resets": Resets(per_km=1.0, position_m=20.0, scale_pct=3.0)}
    runs = drawn_runs(load_profile("perfect").model_copy(update=rare), 8)
    fitted = fit_profile(runs, name="mine", lengths_m=[100.0, 200.0], draws=10).profile
    assert fitted.scale.bias_pct > 1
    assert fitted.resets.scale_pct == fitted.scale.bias_pct


def test_a_profile_needs_two_sequences_and_a_name() -> None:
    runs = drawn_runs(load_profile("vio-mono"), 2, flown=flight(600.0))
    with pytest.raises(FlightError, match="two sequences, got 1"):
        fit_profile(runs[:1], name="mine", lengths_m=[50.0], draws=10)
    with pytest.raises(ConfigError, match="'id'"):
        fit_profile(runs, name="not a name", lengths_m=[50.0], draws=10)


def test_a_heading_that_saturates_is_told_from_one_that_walks() -> None:
    profile = load_profile("perfect").model_copy(update={"heading": HeadingDrift(walk_deg_at_100m=3.0, length_m=50.0)})
    fitted = fit_profile(drawn_runs(profile, 12), name="saturates", lengths_m=(50.0, 100.0, 400.0), draws=50)
    assert fitted.profile.heading.length_m in (50.0, 100.0)
    assert fitted.profile.heading.walk_deg_at_100m == pytest.approx(3.0, rel=0.3)


# Real runs


FOLDER = Path(os.environ.get("SASGEO_ODOMETRY") or "missing")


@pytest.mark.skipif(not (FOLDER / "gt").is_dir(), reason="real odometry: SASGEO_ODOMETRY names no folder with gt/")
def test_real_runs_are_read_paired_and_measured() -> None:
    runs = []
    for sequence, level in (("V2_01", "easy"), ("MH_05", "difficult")):
        truth = read_tum(FOLDER / "gt" / f"{sequence}_{level}.txt.gz")
        estimate = read_tum(FOLDER / "est" / f"rpg_vio_stereo_{sequence}.txt.gz")
        runs.append(pair_run(truth, estimate, sequence=sequence))
    assert [round(run.path_m) for run in runs] == [36, 98]
    assert sum(run.resets + run.lost for run in runs) == 0
    row = value_of(measure_drift(runs, lengths_m=[10.0], draws=100), "position_pct", 10.0)
    assert 0.3 < row["value"] < 2.0
