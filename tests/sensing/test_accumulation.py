# SPDX-License-Identifier: Apache-2.0
"""Frames by odometry: what they give together, and what errors take away."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import CameraError, ShapeError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, cell_offsets_m
from sasgeo_bench.sensing.accumulation import Errors, accumulate, believed_steps, steps_between
from sasgeo_bench.sensing.birdseye import Reading, SoftView

SIZE = 64
HERE = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)


def world(en_m):
    """A road 8 m wide to the north-east, and a lake."""
    east, north = en_m.T
    return (np.abs(east - north) < 4 * math.sqrt(2)) | (np.hypot(east - 30, north + 10) < 12)


def view_of(pose, *, flips=0.0, hidden=0.0, rng=None, seen=0.9):
    """What a detector says of the world from a pose: some cells wrong, one side hidden."""
    there = world(pose.to_map(cell_offsets_m((SIZE, SIZE), 1.0))).reshape(SIZE, SIZE)
    if flips:
        there = there ^ (rng.random(there.shape) < flips)
    probabilities = np.where(there, seen, 1 - seen).astype(np.float32)
    probabilities[:, : round(hidden * SIZE)] = np.nan
    return SoftView(classes=("water",), probabilities=probabilities[None], cell_size_m=1.0)


def flight(count=9, step_m=4.0, turn_deg=3.0):
    poses = [HERE]
    for _ in range(count - 1):
        ahead = poses[-1].to_map(np.array([[0.0, step_m]]))[0]
        poses.append(Pose(easting_m=ahead[0], northing_m=ahead[1], yaw_deg=poses[-1].yaw_deg + turn_deg))
    return poses


def share_right(view, pose, reading=None):
    """Fraction of the known cells that are right, and of unknown ones."""
    truth = world(pose.to_map(cell_offsets_m((SIZE, SIZE), 1.0))).reshape(SIZE, SIZE)
    cells = view.to_evidence(reading or Reading()).cells[0]
    known = cells != UNKNOWN
    return float((cells[known] == truth[known]).mean()), float(1 - known.mean())


def test_nine_frames_are_right_where_one_is_wrong():
    rng, poses = np.random.default_rng(0), flight()
    frames = [view_of(pose, flips=0.2, rng=rng) for pose in poses]
    one, _ = share_right(frames[-1], poses[-1])
    all_nine, _ = share_right(accumulate(frames, steps_between(poses)), poses[-1])
    assert one < 0.82
    assert all_nine > 0.93


def test_frames_show_what_the_last_one_hides():
    poses = flight()
    frames = [view_of(pose) for pose in poses[:-1]] + [view_of(poses[-1], hidden=0.5)]
    view = accumulate(frames, steps_between(poses))
    right, unknown = share_right(view, poses[-1])
    assert np.isnan(frames[-1].probabilities).mean() == 0.5
    assert unknown < 0.05
    assert right > 0.97


def test_one_frame_is_itself():
    frame = view_of(HERE, hidden=0.3)
    np.testing.assert_allclose(accumulate([frame], []).probabilities, frame.probabilities, atol=1e-6)


@given(correlation=st.floats(0, 1), count=st.integers(1, 6))
def test_frames_that_agree_add_up_between_the_mean_and_the_sum(correlation, count):
    still = SoftView(classes=("water",), probabilities=np.full((1, 8, 8), 0.7, np.float32), cell_size_m=1.0)
    found = accumulate([still] * count, [HERE] * (count - 1), correlation=correlation).probabilities[0, 4, 4]
    expected = math.log(7 / 3) * count / (1 + (count - 1) * correlation)
    assert math.log(found / (1 - found)) == pytest.approx(expected, rel=1e-3)


def test_with_drift_declared_unknown_grows_and_what_is_known_stays_right():
    poses = flight(count=2, step_m=20.0)
    hidden = [view_of(poses[0]), view_of(poses[1], hidden=1.0)]
    errors = Errors(position_share=0.15)
    drifting = [believed_steps(steps_between(poses), errors, np.random.default_rng(seed)) for seed in range(20)]
    naive = [share_right(accumulate(hidden, steps), poses[-1]) for steps in drifting]
    aware = [share_right(accumulate(hidden, steps, errors=errors, caution=1.0), poses[-1]) for steps in drifting]
    assert np.mean([right for right, _ in aware]) > np.mean([right for right, _ in naive]) + 0.02
    assert np.mean([unknown for _, unknown in aware]) > np.mean([unknown for _, unknown in naive]) + 0.02


@pytest.mark.parametrize("errors", [Errors(attitude_deg=1.0), Errors(height_share=0.5), Errors(yaw_deg_per_km=60.0)])
def test_every_error_makes_unknown_grow(errors):
    poses = flight()
    frames = [view_of(pose) for pose in poses[:-1]] + [view_of(poses[-1], hidden=0.999)]
    steps = steps_between(poses)
    _, exact = share_right(accumulate(frames, steps), poses[-1])
    _, grown = share_right(accumulate(frames, steps, errors=errors, height_m=100.0, caution=1.0), poses[-1])
    assert grown > exact + 0.01


def test_a_thin_thing_is_forgotten_before_a_wide_one():
    probabilities = np.full((1, SIZE, SIZE), 0.1, dtype=np.float32)
    probabilities[0, :, 20:22] = 0.9
    probabilities[0, :, 40:54] = 0.9
    old = SoftView(classes=("water",), probabilities=probabilities, cell_size_m=1.0)
    nothing = SoftView(classes=("water",), probabilities=np.full_like(probabilities, np.nan), cell_size_m=1.0)
    view = accumulate([old, nothing], [HERE], errors=Errors(attitude_deg=1.0), height_m=100.0, caution=1.0)  # 2.5 m
    cells = view.to_evidence().cells[0, 32]
    assert (cells[18:24] == UNKNOWN).all()
    assert cells[47] == PRESENT
    assert cells[30] == ABSENT


def test_drift_grows_with_the_distance_as_declared_and_without_error_there_is_none():
    steps = [Pose(easting_m=0.0, northing_m=10.0, yaw_deg=0.0)] * 20
    errors = Errors(position_share=0.02)
    ends = []
    for seed in range(300):
        drifted = believed_steps(steps, errors, np.random.default_rng(seed))
        ends.append([sum(step.easting_m for step in drifted), sum(step.northing_m for step in drifted) - 200])
    assert np.std(ends, axis=0) == pytest.approx([4.0, 4.0], rel=0.15)
    assert believed_steps(steps, Errors(), np.random.default_rng(0)) == steps


OTHER = SoftView(classes=("a",), probabilities=np.zeros((1, 3, 3), np.float32), cell_size_m=1.0)


def test_frames_that_do_not_fit_and_absurd_numbers_are_refused():
    for frames, steps in (([], []), ([OTHER], [HERE]), ([view_of(HERE), OTHER], [HERE])):
        with pytest.raises(ShapeError, match="frames"):
            accumulate(frames, steps)
    for how in ({"correlation": 2.0}, {"caution": -1.0}):
        with pytest.raises(CameraError, match=next(iter(how))):
            accumulate([view_of(HERE)], [], **how)
    for how in ({"attitude_deg": -1.0}, {"height_share": float("nan")}, {"position_share": 3.0}):
        with pytest.raises(CameraError, match="errors are"):
            Errors(**how)
