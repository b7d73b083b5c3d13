# SPDX-License-Identifier: Apache-2.0
"""Accumulation of views by odometry (Eq. 4 of the SASGeo paper), and the errors that it has to live with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from sasgeo_bench.core.errors import CameraError, ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import cell_offsets_m
from sasgeo_bench.sensing.birdseye import SoftView

Planes = NDArray[np.float32]

_SUREST: Final = 0.98  # probability beyond which one frame is not believed
_HALF: Final = 0.5
_M_PER_KM: Final = 1000.0
_MOST_SHARE: Final = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Standard deviations of what is believed of a flight; raise `CameraError` if one is negative or not finite.

    `attitude_deg` is of roll, pitch and yaw of each frame alike; `height_share` of the height, one error for a flight;
    `position_share` of the distance since a frame, across and along; `yaw_deg_per_km` of a random walk of the heading
    after one kilometre.
    """

    attitude_deg: float = 0.0
    height_share: float = 0.0
    position_share: float = 0.0
    yaw_deg_per_km: float = 0.0

    def __post_init__(self) -> None:
        values = [getattr(self, each.name) for each in fields(self)]
        shares = (self.height_share, self.position_share)
        if not all(map(math.isfinite, values)) or min(values) < 0 or max(shares) >= _MOST_SHARE:
            raise CameraError(f"errors are finite and not negative, shares under 1, got {self!r}")

    def apart_m(self, *, distance_m: float, height_m: float, reach_m: float) -> float:
        """Return how far apart two frames show the same point, metres (1 sigma).

        `distance_m` is flown between them at `height_m`; the point lies `reach_m` from the middle of the view. Both
        attitudes are off, and the odometry between them. A wrong height scales both frames, each about its own middle.

        >>> round(Errors(attitude_deg=1.0).apart_m(distance_m=0.0, height_m=100.0, reach_m=0.0), 2)
        2.47
        >>> Errors(position_share=0.01).apart_m(distance_m=200.0, height_m=100.0, reach_m=50.0)
        2.0
        """
        turn = math.sqrt(2) * math.radians(self.attitude_deg)
        walk = math.radians(self.yaw_deg_per_km) * math.sqrt(distance_m / _M_PER_KM)
        shares = (distance_m * self.position_share, distance_m * self.height_share)
        return math.hypot(height_m * turn, reach_m * turn, reach_m * walk, *shares)


def steps_between(poses: Sequence[Pose]) -> list[Pose]:
    """Return each pose in the axes (right, up) of the one before: what perfect odometry says.

    >>> east = [Pose(easting_m=e, northing_m=0.0, yaw_deg=90.0) for e in (0.0, 10.0)]
    >>> step = steps_between(east)[0]
    >>> (round(step.northing_m, 6), step.yaw_deg)  # 10 m straight ahead
    (10.0, 0.0)
    """
    return [_seen_from(before, after) for before, after in pairwise(poses)]


def believed_steps(steps: Sequence[Pose], errors: Errors, rng: np.random.Generator) -> list[Pose]:
    """Return odometry with drift: a constant error of direction and length, and a random walk of the heading."""
    bias = errors.position_share * rng.standard_normal(2)
    found = []
    for step in steps:
        distance_m = math.hypot(step.easting_m, step.northing_m)
        right_m = step.easting_m + distance_m * bias[0]
        up_m = step.northing_m + distance_m * bias[1]
        walk_deg = errors.yaw_deg_per_km * math.sqrt(distance_m / _M_PER_KM) * rng.standard_normal()
        found.append(Pose(easting_m=float(right_m), northing_m=float(up_m), yaw_deg=step.yaw_deg + float(walk_deg)))
    return found


def accumulate(
    frames: Sequence[SoftView],
    steps: Sequence[Pose],
    *,
    errors: Errors | None = None,
    height_m: float = 0.0,
    correlation: float = 0.5,
    caution: float = 0.5,
) -> SoftView:
    """Return what all frames together say of the ground in the last one.

    Parameters
    ----------
    frames : sequence of SoftView
        Heading-up views of one shape, classes and cell size, oldest first.
    steps : sequence of Pose
        Odometry: the pose of each frame in the axes (right, up; metres) of the one before; one less than frames.
    errors : Errors, optional
        What is believed of the errors of attitude, height and odometry; none if not given.
    height_m : float
        Height above the ground, for the errors of attitude.
    correlation : float
        Of the log-odds of two frames of the same ground, 0 to 1: a segmenter that mistakes a field for a road does so
        in each frame. 0 adds log-odds, 1 takes their mean.
    caution : float
        By how many standard deviations of place a frame may be off, see below. 0 ignores the errors.

    Returns
    -------
    SoftView
        On the lattice of the last frame; NaN where no frame says anything.

    Raises
    ------
    ShapeError, CameraError
        If frames differ in lattice or classes, there are none, steps do not fit, or a number is out of range.

    Notes
    -----
    Eq. (4) is a weighted mean of the warped frames, with weights that reflect the uncertainty of perception and
    projection. Here it is that of log-odds, times n / (1 + (n - 1) * correlation) for n frames that know a cell, as for
    equally correlated measurements. Uncertainty of place is no weight but an interval: a frame that may be off by r
    says "present" only where all cells within r are, and "absent" only where none is; elsewhere it says nothing. So
    unknown grows around every border with the distance since a frame, and thin things are forgotten first. r is
    `caution` times `Errors.apart_m` at a mean distance from the middle of the view. More caution makes the states
    that are kept truer, and keeps fewer: choose it on training places.

    Examples
    --------
    Two frames that agree are surer than one, by less than if they were independent:

    >>> frame = SoftView(classes=("water",), probabilities=np.full((1, 4, 4), 0.8, np.float32), cell_size_m=1.0)
    >>> still = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    >>> round(float(accumulate([frame, frame], [still]).probabilities[0, 2, 2]), 3)
    0.864
    """
    _check(frames, steps, correlation, caution)
    errors = errors or Errors()
    last = frames[-1]
    # 0.3826: mean distance of the points of a square from its middle, in sides
    reach_m = 0.3826 * last.probabilities.shape[1] * last.cell_size_m
    total = np.zeros(last.probabilities.shape, dtype=np.float64)
    count = np.zeros(last.probabilities.shape, dtype=np.int64)
    pose, distance_m = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0), 0.0  # of the last frame in frame `index`
    for index in range(len(frames) - 1, -1, -1):
        radius_m = 0.0
        if index < len(frames) - 1:
            # Pose given in the axes of another one in the axes of that one's own frame
            first = steps[index]
            place = first.to_map(np.array([[pose.easting_m, pose.northing_m]]))[0].tolist()
            pose = Pose(easting_m=place[0], northing_m=place[1], yaw_deg=first.yaw_deg + pose.yaw_deg)
            distance_m += math.hypot(steps[index].easting_m, steps[index].northing_m)
            radius_m = caution * errors.apart_m(distance_m=distance_m, height_m=height_m, reach_m=reach_m)
        sure = _certain(frames[index].probabilities, radius_m / last.cell_size_m)
        found = sure if index == len(frames) - 1 else _warped(sure, pose, last.cell_size_m)
        is_known = np.isfinite(found)
        total[is_known] += logit(np.clip(found[is_known], 1 - _SUREST, _SUREST))
        count += is_known
    log_odds = total / (1 + np.maximum(count - 1, 0) * correlation)
    probabilities = np.where(count > 0, expit(log_odds), np.nan).astype(np.float32)
    return SoftView(classes=last.classes, probabilities=probabilities, cell_size_m=last.cell_size_m)


def _check(frames: Sequence[SoftView], steps: Sequence[Pose], correlation: float, caution: float) -> None:
    if not frames or len(steps) != len(frames) - 1:
        raise ShapeError(f"n frames, at least one, have n - 1 steps between them, got {len(frames)} and {len(steps)}")
    kinds = {(frame.classes, frame.probabilities.shape, frame.cell_size_m) for frame in frames}
    if len(kinds) > 1:
        raise ShapeError(f"frames have one lattice and the same classes, got {len(kinds)} kinds of them")
    if not 0 <= correlation <= 1 or not 0 <= caution < math.inf:
        raise CameraError(f"correlation is 0 to 1 and caution not negative, got {correlation!r} and {caution!r}")


def _seen_from(pose: Pose, other: Pose) -> Pose:
    back = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=-pose.yaw_deg)
    offset = np.array([[other.easting_m - pose.easting_m, other.northing_m - pose.northing_m]])
    right_m, up_m = back.to_map(offset)[0].tolist()
    return Pose(easting_m=right_m, northing_m=up_m, yaw_deg=other.yaw_deg - pose.yaw_deg)


def _certain(planes: Planes, radius_cells: float) -> Planes:
    """Return what holds wherever within a radius a cell really lies: the least sure value, NaN if they differ."""
    if radius_cells < _HALF:
        return planes
    steps = np.arange(-math.floor(radius_cells), math.floor(radius_cells) + 1)
    disc = (np.hypot(*np.meshgrid(steps, steps)) <= radius_cells).astype(np.uint8)
    found = np.full(planes.shape, np.nan, dtype=np.float32)
    for plane, cells in zip(planes, found, strict=True):
        is_known = np.isfinite(plane)
        # Beyond its edge a view may show anything, as it may where it is unknown.
        least = cv2.erode(np.where(is_known, plane, 0.0), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
        most = cv2.dilate(np.where(is_known, plane, 1.0), disc, borderType=cv2.BORDER_CONSTANT, borderValue=1.0)
        cells[least >= _HALF] = least[least >= _HALF]
        cells[most <= _HALF] = most[most <= _HALF]
    return found


def _warped(planes: Planes, pose: Pose, cell_size_m: float) -> Planes:
    """Return planes of one frame on the lattice of another, whose pose is given in the first one's axes."""
    rows, cols = planes.shape[1:]
    west_m, north_m = -cols * cell_size_m / 2, rows * cell_size_m / 2
    view = Grid(epsg=0, west_m=west_m, north_m=north_m, cell_size_m=cell_size_m, rows=rows, cols=cols)
    uv = view.to_uv(pose.to_map(cell_offsets_m((rows, cols), cell_size_m)))
    where = (uv - _HALF).reshape(rows, cols, 2).astype(np.float32)  # OpenCV counts from the centre of the first cell
    found = np.full(planes.shape, np.nan, dtype=np.float32)
    for plane, cells in zip(planes, found, strict=True):
        is_known = np.isfinite(plane)
        weight = _taken(is_known.astype(np.float32), where)
        enough = weight > _HALF
        cells[enough] = _taken(np.where(is_known, plane, 0), where)[enough] / weight[enough]
    return found


def _taken(plane: Planes, where: Planes) -> Planes:
    taken = cv2.remap(plane, where, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    return np.asarray(taken, dtype=np.float32)
