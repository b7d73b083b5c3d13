# SPDX-License-Identifier: Apache-2.0
"""Trajectory: positions and attitudes over time, as a flight log, an estimator or a plan gives them."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from sasgeo_bench.errors import FlightError
from sasgeo_bench.geometry.pose import bearing_deg

Floats = NDArray[np.float64]

_UNIT = 1e-3  # a quaternion's length may be off by so much, from rounding in files
# Columns: forward, right and down of a body that is level and heads north, in (east, north, up).
_LEVEL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """N poses of a body in a frame whose third axis points up, in order of time, one at least.

    Parameters
    ----------
    time_s : ndarray, shape (N,)
        Seconds, strictly increasing, from any origin.
    position_m : ndarray, shape (N, 3)
        East, north, up, metres. An estimator's frame may be turned about the vertical and moved.
    quaternion_xyzw : ndarray, shape (N, 4)
        Rotation from the body to the frame. The body's axes are forward, right, down unless a file has others;
        differences between two trajectories of one body do not depend on them.

    Raises
    ------
    FlightError
        If shapes do not fit, a value is not finite, time does not increase, or a quaternion is not of unit length.

    Examples
    --------
    Ten metres east in one second, level, heading east:

    >>> flown = Trajectory.of_angles(time_s=[0.0, 1.0], position_m=[[0, 0, 80], [10, 0, 80]], yaw_deg=[90.0, 90.0])
    >>> flown.distance_m.tolist(), flown.yaw_deg.round(6).tolist()
    ([0.0, 10.0], [90.0, 90.0])
    >>> flown.at([0.25]).position_m.tolist()
    [[2.5, 0.0, 80.0]]
    """

    time_s: Floats
    position_m: Floats
    quaternion_xyzw: Floats

    def __post_init__(self) -> None:
        """Check shapes and values; keep own arrays, read-only."""
        shapes = {"time_s": (), "position_m": (3,), "quaternion_xyzw": (4,)}
        for name, rest in shapes.items():
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (len(self.time_s), *rest):
                raise FlightError(f"{name} of {len(self.time_s)} poses has shape {values.shape}")
            if not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0, 0])
                raise FlightError(f"{name} of pose {row + 1} is not finite: leave that pose out")
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if not len(self.time_s):
            raise FlightError("a trajectory has one pose at least, got none")
        back = np.flatnonzero(np.diff(self.time_s) <= 0)
        if len(back):
            raise FlightError(
                f"time does not increase after pose {back[0] + 1}: sort the poses and keep one of each time"
            )
        lengths = np.linalg.norm(self.quaternion_xyzw, axis=1)
        off = np.flatnonzero(np.abs(lengths - 1) > _UNIT)
        if len(off):
            raise FlightError(
                f"the quaternion of pose {off[0] + 1} has length {lengths[off[0]]:g}, not 1: order is x y z w"
            )

    @classmethod
    def of_angles(
        cls,
        *,
        time_s: Floats | list[float],
        position_m: Floats | list[list[float]],
        yaw_deg: Floats | list[float],
        pitch_deg: Floats | float = 0.0,
        roll_deg: Floats | float = 0.0,
    ) -> Self:
        """Return a trajectory from angles in the order of `sensing.camera.Attitude`; yaw runs clockwise from north."""
        yaw = np.asarray(yaw_deg, dtype=np.float64)
        angles = np.stack(np.broadcast_arrays(yaw, pitch_deg, roll_deg), axis=1)
        level = Rotation.from_matrix(_LEVEL)
        turned = Rotation.from_euler("ZYX", angles, degrees=True)
        return cls(
            time_s=np.asarray(time_s, dtype=np.float64),
            position_m=np.asarray(position_m, dtype=np.float64),
            quaternion_xyzw=(level * turned).as_quat(),
        )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def rotation(self) -> Rotation:
        """Return the rotations from the body to the frame."""
        return Rotation.from_quat(self.quaternion_xyzw)

    @property
    def yaw_deg(self) -> Floats:
        """Return where the body's first axis points over the ground, clockwise from north, [0, 360)."""
        ahead = self.rotation.apply([1.0, 0.0, 0.0])
        return bearing_deg(ahead[:, 0], ahead[:, 1])

    @property
    def distance_m(self) -> Floats:
        """Return the distance flown over the ground since the first pose, metres; climbs do not count."""
        steps = np.linalg.norm(np.diff(self.position_m[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def at(self, time_s: Floats | list[float]) -> Self:
        """Return the poses at times within the trajectory: positions by lines, attitudes by the shortest turn.

        Raise `FlightError` if a time lies outside.
        """
        times = np.asarray(time_s, dtype=np.float64)
        if times.size and (times.min() < self.time_s[0] or times.max() > self.time_s[-1]):
            raise FlightError(
                f"times from {times.min():.3f} to {times.max():.3f} s, the trajectory has {self.span_text()}"
            )
        position = np.stack([np.interp(times, self.time_s, axis) for axis in self.position_m.T], axis=1)
        turned = Slerp(self.time_s, self.rotation)(times) if len(self) > 1 else self.rotation
        return type(self)(time_s=times, position_m=position, quaternion_xyzw=turned.as_quat())

    def span_text(self) -> str:
        """Return from when to when it goes, for messages; times may count from 1970, so to the millisecond."""
        return f"{self.time_s[0]:.3f} to {self.time_s[-1]:.3f} s"
