# SPDX-License-Identifier: Apache-2.0
"""The only file that knows which way yaw turns: 0 is grid north, clockwise positive, degrees."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def normalize_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Any angle -> [0, 360), degrees.

    Examples
    --------
    >>> float(normalize_deg(-90.0))
    270.0
    """
    turned = np.mod(np.asarray(angle_deg, dtype=np.float64), 360.0)
    return np.where(turned >= 360.0, 0.0, turned)  # noqa: PLR2004 - mod of a tiny negative angle rounds up to a full turn


def wrap_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Any angle -> [-180, 180), degrees; differences of yaw go through here.

    Examples
    --------
    >>> float(wrap_deg(350.0 - 10.0))
    -20.0
    """
    return normalize_deg(np.asarray(angle_deg, dtype=np.float64) + 180.0) - 180.0


def bearing_deg(east_m: ArrayLike, north_m: ArrayLike) -> NDArray[np.float64]:
    """Grid bearing of an offset, clockwise from north, [0, 360) degrees.

    Parameters
    ----------
    east_m, north_m : array_like
        Offset, metres; of any one shape.

    Returns
    -------
    ndarray of float
        Bearing, degrees; 0 for no offset.

    Examples
    --------
    >>> bearing_deg([0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0]).tolist()
    [0.0, 90.0, 180.0, 270.0]
    """
    return normalize_deg(np.degrees(np.arctan2(east_m, north_m)))


def rotation(yaw_deg: float) -> NDArray[np.float64]:
    """Matrix from a view's (right, up) to the map's (east, north), shape (2, 2).

    Examples
    --------
    A landmark due east, seen with yaw 90, is at the top of the view:

    >>> (rotation(90.0) @ [0.0, 1.0]).round(9).tolist()
    [1.0, 0.0]
    """
    sine, cosine = np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg))
    return np.array([[cosine, sine], [-sine, cosine]])


def to_math_deg(yaw_deg: ArrayLike) -> NDArray[np.float64]:
    """Yaw -> mathematical angle (counter-clockwise from east, REP 103), [0, 360) degrees; its own inverse.

    Examples
    --------
    >>> float(to_math_deg(0.0)), float(to_math_deg(90.0))
    (90.0, 0.0)
    """
    return normalize_deg(90.0 - np.asarray(yaw_deg, dtype=np.float64))
