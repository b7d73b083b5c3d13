# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of tilt from the road plane: borders of one road are parallel on the ground, so they must be there.

After Popov et al. (2026), who calibrate oblique traffic video by road borders and lanes. Only roll and pitch are
sought: parallel lines say nothing of height, place or heading.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.sensing.camera import Attitude, Camera
from sasgeo_bench.sensing.ground import Plane

Lines = NDArray[np.float64]

_ROBUST: Final = 2.0  # standard deviations from which a line counts less: roads that widen are no rails
_END_PX: Final = 6  # of a straight piece, left out at both ends: corners are round
_WIDEST_PX: Final = 200.0
_NARROWEST_PX: Final = 3.0
_HALF_TURN_DEG: Final = 180.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TiltFit:
    """A camera turned so that roads are parallel: what was added to its pitch and roll, and how sure that is.

    `before_deg`, `after_deg` are the root mean square angles of borders against their road, on the ground;
    `pitch_sigma_deg`, `roll_sigma_deg` are standard deviations of what is left, as far as lines and prior say.
    """

    camera: Camera
    pitch_deg: float
    roll_deg: float
    pitch_sigma_deg: float
    roll_sigma_deg: float
    before_deg: float
    after_deg: float


def refine_tilt(
    camera: Camera,
    roads: Sequence[Lines],
    *,
    attitude_sigma_deg: float,
    end_sigma_px: float = 0.5,
    parallel_sigma_deg: float = 0.2,
) -> TiltFit:
    """Refine roll and pitch of a camera so that the borders of each road become parallel on level ground.

    Parameters
    ----------
    camera : Camera
        As believed.
    roads : sequence of ndarray, shape (n, 2, 2), n >= 2
        For each road, or group of parallel roads, the two ends (column, row) of each border, pixels.
    attitude_sigma_deg : float
        Standard deviation of the believed roll and pitch: the prior, which decides where no line does.
    end_sigma_px : float
        Standard deviation of the ends of a border, across it.
    parallel_sigma_deg : float
        Standard deviation of the angle between borders on the ground: roads are not quite parallel.

    Returns
    -------
    TiltFit
        The refined camera, by least squares with a robust loss. Without roads it is the believed one.

    Raises
    ------
    CameraError
        If a sigma is not positive, or lines have another shape.

    Notes
    -----
    A road of width w along a tilt error d converges by w * d / H on the ground at height H: 0.25 degrees for 6 m, 5
    degrees and 120 m. One narrow road is weak evidence; parallel streets far apart, given as one group, are strong.
    Each direction of roads tells of the tilt along it alone.

    Examples
    --------
    Two streets of a grid, 60 m apart each way, correct a tilt that is 5 degrees off:

    >>> from sasgeo_bench.sensing.camera import Intrinsics
    >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=800, height_px=800)
    >>> true = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=100.0, yaw_deg=0.0, tilt_deg=25.0)
    >>> ends = np.array([[[-30, 10], [-30, 90]], [[30, 10], [30, 90]], [[-40, 20], [40, 20]], [[-40, 80], [40, 80]]])
    >>> lines = true.project(np.pad(ends.reshape(-1, 2), ((0, 0), (0, 1))).astype(float)).reshape(4, 2, 2)
    >>> believed = true.turned(Attitude(pitch_deg=5.0))
    >>> fit = refine_tilt(believed, [lines[:2], lines[2:]], attitude_sigma_deg=5.0)
    >>> round(believed.tilt_deg), round(fit.camera.tilt_deg)
    (30, 25)
    """
    if not all(sigma > 0 for sigma in (attitude_sigma_deg, end_sigma_px, parallel_sigma_deg)):
        raise CameraError(
            "standard deviations are positive, got "
            f"attitude_sigma_deg={attitude_sigma_deg!r}, {end_sigma_px!r}, {parallel_sigma_deg!r}"
        )
    if any(lines.ndim != 3 or lines.shape[1:] != (2, 2) or len(lines) < 2 for lines in roads):
        raise CameraError(
            f"borders of a road have shape (2 or more, 2 ends, 2), got {[lines.shape for lines in roads]!r}"
        )
    sigmas = [_sigmas_deg(lines, end_sigma_px, parallel_sigma_deg) for lines in roads]

    def residuals(turn_deg: NDArray[np.float64]) -> NDArray[np.float64]:
        turned = _turned(camera, turn_deg)
        of_roads = [_angles_deg(turned, lines, sigma) / sigma for lines, sigma in zip(roads, sigmas, strict=True)]
        prior = turn_deg / attitude_sigma_deg
        return np.concatenate([*map(_damped, of_roads), prior])

    found = least_squares(residuals, np.zeros(2), x_scale=attitude_sigma_deg)
    slopes = np.asarray(found.jac, dtype=np.float64)
    pitch_sigma_deg, roll_sigma_deg = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))).tolist()
    refined = _turned(camera, found.x)
    return TiltFit(
        camera=refined,
        pitch_deg=float(found.x[0]),
        roll_deg=float(found.x[1]),
        pitch_sigma_deg=pitch_sigma_deg,
        roll_sigma_deg=roll_sigma_deg,
        before_deg=_spread_deg(camera, roads, sigmas),
        after_deg=_spread_deg(refined, roads, sigmas),
    )


def _turned(camera: Camera, turn_deg: NDArray[np.float64]) -> Camera:
    return camera.turned(Attitude(pitch_deg=float(turn_deg[0]), roll_deg=float(turn_deg[1])))


def _damped(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return residuals whose squares are those of the soft L1 loss."""
    scaled = residual / _ROBUST
    return np.asarray(np.sign(residual) * _ROBUST * np.sqrt(2 * (np.sqrt(1 + scaled**2) - 1)))


def _sigmas_deg(lines: Lines, end_sigma_px: float, parallel_sigma_deg: float) -> NDArray[np.float64]:
    """Return how far the direction of each border may be off, degrees."""
    lengths_px = np.maximum(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1), 1.0)
    return np.asarray(np.hypot(np.degrees(np.sqrt(2) * end_sigma_px / lengths_px), parallel_sigma_deg))


def _angles_deg(camera: Camera, lines: Lines, sigmas_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle on the ground between each border and the weighted mean of its road, degrees."""
    bearings_deg = _bearings_deg(camera, lines)
    if not np.isfinite(bearings_deg).all():
        return np.full(len(lines), 1e3)  # residual of a border above the horizon
    off_deg = _off_deg(bearings_deg, bearings_deg[0])
    return np.asarray(off_deg - np.average(off_deg, weights=sigmas_deg**-2))


def _bearings_deg(camera: Camera, lines: Lines) -> NDArray[np.float64]:
    """Return the bearing of each line on level ground, degrees; NaN where an end shows none."""
    ends_m = camera.unproject(lines.reshape(-1, 2), Plane())[:, :2].reshape(-1, 2, 2)
    along = ends_m[:, 1] - ends_m[:, 0]
    return bearing_deg(along[:, 0], along[:, 1])


def _off_deg(bearings_deg: NDArray[np.float64], reference_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles between lines without direction, in [-90, 90)."""
    quarter = _HALF_TURN_DEG / 2
    return np.asarray((bearings_deg - reference_deg + quarter) % _HALF_TURN_DEG - quarter)


def _spread_deg(camera: Camera, roads: Sequence[Lines], sigmas: Sequence[NDArray[np.float64]]) -> float:
    if not roads:
        return 0.0
    angles = [_angles_deg(camera, lines, sigma) for lines, sigma in zip(roads, sigmas, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(angles) ** 2)))


def join_parallel(camera: Camera, roads: Sequence[Lines], *, within_deg: float) -> list[Lines]:
    """Join roads whose directions on level ground differ by at most `within_deg`, as streets of one grid do.

    Directions are those of the believed camera: allow for the error of its tilt. Use it where streets are laid out in a
    grid; roads that are joined and not parallel pull the tilt away from the truth.
    """
    groups: list[list[Lines]] = []
    firsts: list[NDArray[np.float64]] = []
    for lines in roads:
        bearing = _bearings_deg(camera, lines)[0]
        near = (index for index, first in enumerate(firsts) if abs(_off_deg(bearing, first)) <= within_deg)
        index = next(near, None)
        if index is None:
            firsts.append(bearing)
            groups.append([lines])
        else:
            groups[index].append(lines)
    return [np.concatenate(group) for group in groups]


def road_borders(is_road: NDArray[np.bool_], *, least_px: float = 80.0) -> list[Lines]:
    """Return pairs of straight borders of roads in a mask of a picture, shape (H, W), each pair (2, 2, 2) pixels.

    Straight pieces of outlines, `least_px` long at least, are paired where they run beside each other with road between
    them. Each outline lies half a pixel inside the road on both sides, which leaves borders parallel. A lens with
    distortion bends them: rectify its mask first.

    >>> mask = np.zeros((200, 200), dtype=bool)
    >>> mask[80:101] = True  # a road across the picture, whose outer pixels are 20 apart
    >>> borders = road_borders(mask)
    >>> len(borders), sorted(borders[0][:, 0, 1].round().tolist())
    (1, [80.0, 100.0])
    """
    pieces = _straight_pieces(is_road, least_px)
    scored = sorted(
        ((_beside_px(is_road, first, second), i, j) for (i, first), (j, second) in combinations(enumerate(pieces), 2)),
        reverse=True,
    )
    used: set[int] = set()
    pairs = []
    for overlap_px, i, j in scored:
        if overlap_px > 0 and not {i, j} & used:
            used |= {i, j}
            pairs.append(np.stack([pieces[i], pieces[j]]))
    return pairs


def _straight_pieces(is_road: NDArray[np.bool_], least_px: float) -> list[Lines]:
    """Return the ends, (2, 2) each, of lines fitted to straight pieces of the outlines of roads."""
    outlines, _ = cv2.findContours(is_road.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    limit = np.array(is_road.shape[::-1]) - 1
    pieces = []
    for outline in outlines:
        points = outline.reshape(-1, 2)
        # 4 pixels: bend by which the outline of a road may leave a straight line
        corners = cv2.approxPolyDP(outline, 4.0, closed=True).reshape(-1, 2)
        if len(corners) < 2:  # a speck
            continue
        at = sorted(int(np.flatnonzero((points == corner).all(axis=1))[0]) for corner in corners)
        looped = np.concatenate([points, points])
        for begin, end in zip(at, [*at[1:], at[0] + len(points)], strict=True):
            piece = looped[begin + _END_PX : end - _END_PX]
            piece = piece[((piece > 0) & (piece < limit)).all(axis=1)]  # the picture's edge is no border of a road
            if len(piece) > 2 and np.linalg.norm(piece[-1] - piece[0]) >= least_px:  # to fit a line
                pieces.append(_fitted(piece.astype(np.float64)))
    return pieces


def _fitted(points: Lines) -> Lines:
    dx, dy, x, y = cv2.fitLine(points.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().tolist()
    middle, along = np.array([x, y]), np.array([dx, dy])
    ends = (points[[0, -1]] - middle) @ along
    return np.asarray(middle + ends[:, None] * along + 0.5)


def _beside_px(is_road: NDArray[np.bool_], first: Lines, second: Lines) -> float:
    """Return along how many pixels two lines are the borders of one road; 0 if they are not."""
    along = (first[1] - first[0]) / np.linalg.norm(first[1] - first[0])
    other = (second[1] - second[0]) / np.linalg.norm(second[1] - second[0])
    if abs(along @ other) < np.cos(np.radians(12.0)):  # degrees: skew between the two borders of a road in the picture
        return 0.0
    spans = np.sort([(line - first[0]) @ along for line in (first, second)], axis=1)
    low, high = spans[:, 0].max(), spans[:, 1].min()
    if high - low < 0.5 * (spans[:, 1] - spans[:, 0]).min():  # 0.5: overlap of the shorter border, beside the other
        return 0.0
    steps = np.linspace(low, high, 9 + 2)[1:-1]  # 9 places between two borders that must be road
    on_first = first[0] + steps[:, None] * along
    # Where the line across a place on the first border meets the second one.
    normal = np.array([-other[1], other[0]])
    across = np.array([-along[1], along[0]])
    gaps_px = (second[0] - on_first) @ normal / (across @ normal)
    if not (np.abs(gaps_px).min() > _NARROWEST_PX and np.abs(gaps_px).max() < _WIDEST_PX):
        return 0.0
    between = np.floor(on_first + gaps_px[:, None] / 2 * across).astype(int)
    inside = ((between >= 0) & (between < is_road.shape[::-1])).all(axis=1)
    return float(high - low) if inside.all() and is_road[between[:, 1], between[:, 0]].all() else 0.0
