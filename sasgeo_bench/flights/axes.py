# SPDX-License-Identifier: Apache-2.0
"""Axes of a trajectory out of a file: third axis up, or those of a camera; told by how the body turns and moves."""

import math
import warnings
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import FlightError
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.texts import plain

Axes = Literal["up", "camera"]

AXES: Final = ("up", "camera")
# East, north, up out of a first camera's right, down, ahead; forward, right, down of a body in its camera's axes.
_FRAME: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_BODY: Final = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
_ALONG: Final = 0.3  # share of the third axis in the spread of a path that does not lie across it
_AHEAD: Final = 0.7  # mean cosine between the way and the body's axis that looks along it
_LOOKING: Final = 0.01  # a camera looks along its way, and turns by 8 degrees about its second axis (rms)
_TILTED: Final = 0.05
# A camera that looks ahead and down: the body turns about an axis off the third, and the path lies across that axis.
_PITCHED_DEG: Final = (
    10.0,
    80.0,
)  # beyond: the third axis itself, or a level one


def in_axes(flown: Trajectory, axes: Axes | None, path: Path) -> Trajectory:
    """Return a trajectory whose third axis points up.

    Parameters
    ----------
    flown : Trajectory
        As its file has it.
    axes : {"up", "camera"}, optional
        Axes of the file: east, north, up; or right, down, ahead of its first camera, with poses of the camera. By
        default they are up, unless the path shows that they are not.
    path : Path
        Of the file, for messages.

    Raises
    ------
    FlightError
        If the body turns about another axis of the frame than the third, as no level flight does.

    Notes
    -----
    A body that flies level turns about the vertical, so the vertical is that axis of the frame that keeps its place in
    the body: the mean of the axis in the axes of the body has a length near 1. A body that does not turn tells nothing:
    straight up and straight ahead of a camera look alike, and so do a front and the ground. A loop turns about a level
    axis as well; it is told by the body's first axis, which points along the way, where a camera looks with its third.
    Warnings say so of both. A camera that looks ahead and down turns about an axis off the third by 10 to 80 degrees,
    and its path lies flat across that axis, as none does that climbs.

    Examples
    --------
    Two metres ahead in the axes of a camera are two metres north, heading north:

    >>> level = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    >>> ahead = Trajectory(time_s=[0, 1], position_m=[[0, 0, 0], [0, 0, 2]], quaternion_xyzw=level)
    >>> flown = in_axes(ahead, "camera", Path("orb.txt"))
    >>> flown.position_m[1].tolist(), flown.yaw_deg.tolist()
    ([0.0, 2.0, 0.0], [0.0, 0.0])
    """
    if axes is not None and axes not in AXES:
        raise FlightError(f"axes must be one of {', '.join(AXES)}, got {axes!r}")
    if axes == "camera":
        turns = np.matmul(np.matmul(_FRAME, flown.rotation.as_matrix()), _BODY)
        flown = Trajectory(
            time_s=flown.time_s,
            position_m=flown.position_m @ _FRAME.T,
            quaternion_xyzw=type(flown.rotation).from_matrix(turns).as_quat(),
        )
    if axes != "up" and len(flown) >= 10:  # of fewer nothing can be said
        _check_upright(flown, axes, plain(str(path)))
    return flown


def _between_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return math.degrees(math.acos(min(1.0, abs(float(first @ second)))))


def _lies_across(position_m: NDArray[np.float64], axis: NDArray[np.float64]) -> bool:
    _, spread, normals = np.linalg.svd(position_m - position_m.mean(axis=0), full_matrices=False)
    # 0.2: thickness of the path's plane, in its width
    is_plane = spread[1] > 0.05 * spread[0] and spread[2] < 0.2 * spread[1]  # 0.05: width of the path, in its spread
    # 10 degrees between that axis and the normal of the path's plane
    return bool(is_plane) and _between_deg(normals[2], axis) < 10.0


def _check_upright(flown: Trajectory, axes: Axes | None, name: str) -> None:
    """Raise `FlightError` if the third axis is shown not to point up; warn if the path leaves it open."""
    turns = flown.rotation.as_matrix()
    mean = turns.mean(axis=0)
    kept = np.linalg.norm(mean, axis=1)  # of each axis of the frame, in the axes of the body
    axes_of_turn, strength, _ = np.linalg.svd(mean)
    spread_m = flown.position_m.std(axis=0)
    steps_m = np.diff(flown.position_m, axis=0)
    way_m = float(np.linalg.norm(steps_m, axis=1).sum())
    if way_m == 0:
        return
    ahead = np.abs(np.einsum("nij,ni->j", turns[:-1], steps_m)) / way_m
    share = float(spread_m[2] / np.linalg.norm(spread_m))
    looks = share >= _ALONG and ahead[2] >= _AHEAD
    loops = share >= _ALONG and ahead[0] >= _AHEAD
    # 0.7: a body that turns by 45 degrees (rms): its axis is known well, and may lie less off, 18 degrees
    is_around = strength[1] < 0.7
    # 0.2: any body turns by 40 degrees (rms) about another axis than the third
    is_tilted = strength[0] - kept[2] > (_TILTED if is_around else 0.2)
    off_deg = _between_deg(axes_of_turn[:, 0], np.array([0.0, 0.0, 1.0]))
    is_pitched = (
        _PITCHED_DEG[0] < off_deg < _PITCHED_DEG[1]
        and strength[0] - strength[1] > _LOOKING
        and _lies_across(flown.position_m, axes_of_turn[:, 0])
    )
    if (looks and kept[1] - kept[2] > _LOOKING) or (is_tilted and not loops) or is_pitched:
        # 0.9: cosine of an axis of turning with the second axis
        is_second = not is_pitched and (abs(float(axes_of_turn[1, 0])) > 0.9 or (looks and not is_around))
        mend = "turn the frame first, or say --axes up if it is right"
        if is_second and axes is None:
            mend = "say --axes camera (as of ORB-SLAM)"
        about = "the second axis" if is_second else f"an axis {off_deg:.0f} degrees off the third"
        raise FlightError(
            f"{name}: the body turns about {about} of the frame, so its third axis does not point up: {mend}; "
            "quaternions are in the order qx qy qz qw"
        )
    # 0.1: share of the second axis in the spread of a path before a front, or level for a camera
    is_flat = share >= _ALONG and spread_m[1] < 0.1 * np.linalg.norm(spread_m)
    # 0.9 of a body that does not turn
    if axes is None and ((is_flat and strength[2] > 0.9) or (loops and (is_flat or is_tilted))):
        message = (
            f"{name}: the path lies along the third axis, which is read as up, since the body does not turn or loops; "
            "if that axis points ahead, as in the axes of a camera, say --axes camera"
        )
        warnings.warn(message, stacklevel=3)
