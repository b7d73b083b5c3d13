# SPDX-License-Identifier: Apache-2.0
"""A place, heading and scale on the map (Sim(2)): compose, invert, Log and Exp."""

import cmath
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.bounds import BOUNDS, bounds_text
from sasgeo_bench.errors import PoseError
from sasgeo_bench.geometry.angles import normalize_deg, rotation, wrap_deg

_SMALL: Final = 1e-9  # below this (c - 1) / log(c) is 1 to the last digit that matters


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Where a view lies and how it is turned: easting, northing in metres, yaw in [0, 360) degrees, residual scale.

    As a map of offsets it takes (right, up) of the view, metres, to (east, north): `t + scale * R(yaw) q`. A pose with
    scale 1 is one of SE(2).

    Examples
    --------
    >>> Pose(easting_m=10.0, northing_m=0.0, yaw_deg=-90.0).yaw_deg
    270.0
    """

    easting_m: float
    northing_m: float
    yaw_deg: float
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what is no pose; bring yaw into its range."""
        if not all(map(math.isfinite, (self.easting_m, self.northing_m, self.yaw_deg, self.scale))):
            message = f"a pose has finite values, got {self!r}"
            raise PoseError(message)
        if self.scale <= 0:
            message = f"scale must be positive, got {self.scale!r}"
            raise PoseError(message)
        if type(self.yaw_deg) is not float or not 0.0 < self.yaw_deg < 360.0:  # noqa: PLR2004 - in its range already
            if not abs(self.yaw_deg) <= BOUNDS["yaw_deg"][1]:
                message = f"yaw_deg must lie within {bounds_text('yaw_deg')}, got {self.yaw_deg!r}"
                raise PoseError(message)
            object.__setattr__(self, "yaw_deg", float(normalize_deg(self.yaw_deg)))

    def to_map(self, offsets_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """(right, up) of the view, shape (N, 2), metres -> easting/northing, shape (N, 2).

        Examples
        --------
        >>> Pose(easting_m=5.0, northing_m=5.0, yaw_deg=90.0).to_map(np.array([[0.0, 2.0]])).round(9).tolist()
        [[7.0, 5.0]]
        """
        turned = self.scale * offsets_m @ rotation(self.yaw_deg).T
        return np.asarray(turned + np.array([self.easting_m, self.northing_m]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """What is known before matching: a disc that holds the place, a yaw and a scale, each with its sigma, or None.

    Parameters
    ----------
    center_m : tuple of float, optional
        Easting and northing of the disc's centre; None where the place may be anywhere in the region.
    radius_m : float, optional
        Radius of the disc, given with `center_m`.
    yaw_deg, yaw_sigma_deg : float, optional
        Heading and its standard deviation; None where any heading may be.
    scale_sigma : float
        Standard deviation of the view's scale around 1.

    Raises
    ------
    PoseError
        If a value is out of range, or one of a pair is missing.

    Examples
    --------
    >>> Prior(center_m=(10.0, 10.0), radius_m=5.0, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03).has_place
    True
    """

    center_m: tuple[float, float] | None
    radius_m: float | None
    yaw_deg: float | None
    yaw_sigma_deg: float | None
    scale_sigma: float

    def __post_init__(self) -> None:
        """Refuse halves of pairs and impossible values."""
        if (self.center_m is None) != (self.radius_m is None) or (self.yaw_deg is None) != (self.yaw_sigma_deg is None):
            message = f"a prior has center_m with radius_m and yaw_deg with yaw_sigma_deg, or neither, got {self!r}"
            raise PoseError(message)
        spreads = [value for value in (self.radius_m, self.yaw_sigma_deg) if value is not None]
        numbers = (*(self.center_m or ()), self.yaw_deg or 0.0, self.scale_sigma, *spreads)
        if not all(map(math.isfinite, numbers)) or min(spreads, default=1.0) <= 0 or self.scale_sigma < 0:
            message = f"a prior has finite values, a positive radius and sigmas, got {self!r}"
            raise PoseError(message)

    @property
    def has_place(self) -> bool:
        """Whether the place is known within a disc."""
        return self.center_m is not None


def compose(first: Pose, second: Pose) -> Pose:
    """Pose of `second`, given in the frame of `first`.

    Examples
    --------
    >>> north = Pose(easting_m=0.0, northing_m=100.0, yaw_deg=90.0)
    >>> ahead = Pose(easting_m=0.0, northing_m=10.0, yaw_deg=0.0)
    >>> compose(north, ahead).easting_m
    10.0
    """
    return _from_complex(
        _turn(first) * _turn(second),
        _turn(first) * complex(second.easting_m, second.northing_m) + complex(first.easting_m, first.northing_m),
    )


def inverse(pose: Pose) -> Pose:
    """Pose that undoes another: composed with it, either way, it is the identity.

    Examples
    --------
    >>> inverse(Pose(easting_m=0.0, northing_m=10.0, yaw_deg=0.0)).northing_m
    -10.0
    """
    turn = 1 / _turn(pose)
    return _from_complex(turn, -turn * complex(pose.easting_m, pose.northing_m))


def log(pose: Pose) -> NDArray[np.float64]:
    """Tangent vector of a pose: (east m, north m, yaw in degrees [-180, 180), log scale), shape (4,).

    Notes
    -----
    With a turn and scale as one complex number c, the Log of (c, t) is (log c, t log(c) / (c - 1)): the closed form of
    the matrix logarithm, used in Eq. (10) of the SASGeo paper.

    Examples
    --------
    >>> log(Pose(easting_m=3.0, northing_m=4.0, yaw_deg=0.0)).tolist()
    [3.0, 4.0, 0.0, 0.0]
    """
    yaw_deg = float(wrap_deg(pose.yaw_deg))
    rate = complex(math.log(pose.scale), -math.radians(yaw_deg))
    velocity = complex(pose.easting_m, pose.northing_m) / _mean_turn(rate)
    return np.array([velocity.real, velocity.imag, yaw_deg, rate.real])


def exp(tangent: NDArray[np.float64]) -> Pose:
    """Inverse of `log` for a tangent vector of shape (4,): east m, north m, yaw in degrees, log scale.

    Raises
    ------
    PoseError
        If the vector has another shape.

    Examples
    --------
    >>> exp(np.array([3.0, 4.0, 0.0, 0.0])).northing_m
    4.0
    """
    if np.shape(tangent) != (4,):
        message = f"a tangent vector has shape (4,): east, north, yaw, log scale; got shape {np.shape(tangent)}"
        raise PoseError(message)
    east_m, north_m, yaw_deg, log_scale = map(float, tangent)
    rate = complex(log_scale, -math.radians(yaw_deg))
    return _from_complex(cmath.exp(rate), _mean_turn(rate) * complex(east_m, north_m))


def _mean_turn(rate: complex) -> complex:
    """(exp(rate) - 1) / rate, the mean turn along the way; 1 for no turn."""
    return complex(np.expm1(rate) / rate) if abs(rate) > _SMALL else 1 + rate / 2


def _turn(pose: Pose) -> complex:
    """Scale and turn as one complex number; yaw runs clockwise, the complex plane counter-clockwise."""
    return cmath.rect(pose.scale, -math.radians(pose.yaw_deg))


def _from_complex(turn: complex, place: complex) -> Pose:
    return Pose(
        easting_m=place.real,
        northing_m=place.imag,
        yaw_deg=math.degrees(-cmath.phase(turn)),
        scale=abs(turn),
    )
