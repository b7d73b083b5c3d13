# SPDX-License-Identifier: Apache-2.0
"""A place, heading and scale on the map (Sim(2)), the prior on it, and the sense of yaw.

Yaw is in degrees, 0 is grid north, clockwise positive. No other file defines it.
"""

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.core.texts import BOUNDS, bounds_text


def normalize_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Reduce any angle to [0, 360), degrees."""
    turned = np.mod(np.asarray(angle_deg, dtype=np.float64), 360.0)
    return np.where(turned >= 360.0, 0.0, turned)  # mod of a tiny negative angle rounds up to a full turn


def wrap_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Reduce any angle to [-180, 180), degrees; use it for differences of yaw.

    >>> float(wrap_deg(350.0 - 10.0))
    -20.0
    """
    return normalize_deg(np.asarray(angle_deg, dtype=np.float64) + 180.0) - 180.0


def bearing_deg(east_m: ArrayLike, north_m: ArrayLike) -> NDArray[np.float64]:
    """Return the grid bearing of an offset in metres, clockwise from north, [0, 360) degrees; 0 for no offset.

    >>> bearing_deg([0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0]).tolist()
    [0.0, 90.0, 180.0, 270.0]
    """
    return normalize_deg(np.degrees(np.arctan2(east_m, north_m)))


def rotation(yaw_deg: float) -> NDArray[np.float64]:
    """Return the matrix from a view's (right, up) to the map's (east, north), shape (2, 2).

    A landmark due east, seen with yaw 90, is at the top of the view:

    >>> (rotation(90.0) @ [0.0, 1.0]).round(9).tolist()
    [1.0, 0.0]
    """
    sine, cosine = np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg))
    return np.array([[cosine, sine], [-sine, cosine]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Place and heading of a view: easting, northing in metres, yaw in [0, 360) degrees, residual scale.

    As a map of offsets it takes (right, up) of the view, metres, to (east, north): `t + scale * R(yaw) q`. A pose with
    scale 1 is one of SE(2).
    """

    easting_m: float
    northing_m: float
    yaw_deg: float
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Check the values; bring yaw into its range."""
        if not all(map(math.isfinite, (self.easting_m, self.northing_m, self.yaw_deg, self.scale))):
            raise PoseError(f"a pose has finite values, got {self!r}")
        if self.scale <= 0:
            raise PoseError(f"scale must be positive, got {self.scale!r}")
        if type(self.yaw_deg) is not float or not 0.0 < self.yaw_deg < 360.0:  # in its range already
            if not abs(self.yaw_deg) <= BOUNDS["yaw_deg"][1]:
                raise PoseError(f"yaw_deg must lie within {bounds_text('yaw_deg')}, got {self.yaw_deg!r}")
            object.__setattr__(self, "yaw_deg", float(normalize_deg(self.yaw_deg)))

    def to_map(self, offsets_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (right, up) of the view, shape (N, 2), metres, to easting/northing, shape (N, 2).

        >>> Pose(easting_m=5.0, northing_m=5.0, yaw_deg=90.0).to_map(np.array([[0.0, 2.0]])).round(9).tolist()
        [[7.0, 5.0]]
        """
        turned = self.scale * offsets_m @ rotation(self.yaw_deg).T
        return np.asarray(turned + np.array([self.easting_m, self.northing_m]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """Knowledge before matching: a disc that holds the place, a yaw and a scale; `PoseError` if out of range.

    `center_m` (easting, northing) and `radius_m` are None if the place may be anywhere in the region, `yaw_deg` and its
    standard deviation `yaw_sigma_deg` if any heading is possible. `scale_sigma` is the standard deviation around 1.
    """

    center_m: tuple[float, float] | None
    radius_m: float | None
    yaw_deg: float | None
    yaw_sigma_deg: float | None
    scale_sigma: float

    def __post_init__(self) -> None:
        if (self.center_m is None) != (self.radius_m is None) or (self.yaw_deg is None) != (self.yaw_sigma_deg is None):
            raise PoseError(
                f"a prior has center_m with radius_m and yaw_deg with yaw_sigma_deg, or neither, got {self!r}"
            )
        spreads = [value for value in (self.radius_m, self.yaw_sigma_deg) if value is not None]
        numbers = (*(self.center_m or ()), self.yaw_deg or 0.0, self.scale_sigma, *spreads)
        if not all(map(math.isfinite, numbers)) or min(spreads, default=1.0) <= 0 or self.scale_sigma < 0:
            raise PoseError(f"a prior has finite values, a positive radius and sigmas, got {self!r}")

    @property
    def has_place(self) -> bool:
        """Return whether the place is known within a disc."""
        return self.center_m is not None


def reckon(start_m: ArrayLike, yaw_deg: float, increments: ArrayLike) -> NDArray[np.float64]:
    """Return the places that an odometer's increments lead to from a start, shape (N, 2): easting and northing, metres.

    Parameters
    ----------
    start_m : array-like, shape (2,)
        Easting and northing, metres.
    yaw_deg : float
        Heading at the start, degrees clockwise from grid north.
    increments : array-like, shape (N - 1, 3)
        Right and up, metres, and the turn, degrees clockwise, each in the axes of the pose before; NaN where nothing is
        known, which counts as no motion.

    Examples
    --------
    Ten metres north, a turn to the right, and five metres ahead, which is east:

    >>> reckon([0.0, 0.0], 0.0, [[0.0, 10.0, 90.0], [0.0, 5.0, 0.0]]).round(6).tolist()
    [[0.0, 0.0], [0.0, 10.0], [5.0, 10.0]]
    """
    known = np.nan_to_num(np.asarray(increments, dtype=np.float64).reshape(-1, 3))
    yaws = np.radians(yaw_deg + np.concatenate([[0.0], np.cumsum(known[:, 2])]))[:-1]
    moved = (known[:, 0] + 1j * known[:, 1]) * np.exp(-1j * yaws)  # east + i north; yaw is clockwise
    at = np.concatenate([[0.0], np.cumsum(moved)])
    return np.asarray(np.asarray(start_m, dtype=np.float64) + np.stack([at.real, at.imag], axis=1))


def inverse(pose: Pose) -> Pose:
    """Return the pose that undoes another: composed with it, either way, it is the identity.

    >>> inverse(Pose(easting_m=0.0, northing_m=10.0, yaw_deg=0.0)).northing_m
    -10.0
    """
    # Scale and turn as one complex number; yaw runs clockwise, the complex plane counter-clockwise.
    turn = 1 / cmath.rect(pose.scale, -math.radians(pose.yaw_deg))
    place = -turn * complex(pose.easting_m, pose.northing_m)
    yaw_deg = math.degrees(-cmath.phase(turn))
    return Pose(easting_m=place.real, northing_m=place.imag, yaw_deg=yaw_deg, scale=abs(turn))
