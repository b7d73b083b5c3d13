# SPDX-License-Identifier: Apache-2.0
"""The only file that defines the sense of yaw: 0 is grid north, clockwise positive, degrees."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def normalize_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Reduce any angle to [0, 360), degrees."""
    turned = np.mod(np.asarray(angle_deg, dtype=np.float64), 360.0)
    return np.where(turned >= 360.0, 0.0, turned)  # noqa: PLR2004 - mod of a tiny negative angle rounds up to a full turn


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
