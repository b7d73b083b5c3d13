# SPDX-License-Identifier: Apache-2.0
"""Visual odometry: how a camera moved above level ground between two pictures, by what both of them show.

Ground seen from above is nearly a plane. Two pictures of a plane leave the essential matrix undetermined, and no
picture tells its own scale. So matches are laid on the ground by what is believed of the cameras, a rigid motion is
found among them, and then motion and errors of the belief are fitted together (decision 46).
"""

import math
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.sensing.image import AerialImage

Floats = NDArray[np.float64]
Nine = tuple[float, float, float, float, float, float, float, float, float]

_MOST_PX: Final = 1024  # of a side of a picture in which features are found
_FEATURES: Final = 6000  # of forest, few find their partner
_SCALE: Final = 1.2  # between octaves
_RATIO: Final = 0.8  # of the distances to the best and to the second match (Lowe, IJCV 2004)
_LEAST: Final = 12  # matches that agree; of pictures that share nothing 5 did at most
_FARTHEST: Final = 4.0  # heights along a ray to the ground; beyond it pixels are too coarse
_ROUGH_PX: Final = 5.0  # within which matches agree with a rigid motion, besides what tilt does to them
_NEAR_PX: Final = (6.0, 3.0)  # within which matches agree with a fit: the first, and the one that counts
_MATCH_PX: Final = 1.0  # standard deviation of a match
_INDEPENDENT: Final = 40  # matches that count at most: errors of neighbours are alike, by relief and by the lens
_STILL: Final = 1e-4  # radians, and fraction of the height: what is believed to be exact


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How a camera moved from one picture to the next, and how well that is known.

    Parameters
    ----------
    right_m, up_m : float
        From the point beneath the first camera to that beneath the second, in the axes of the first picture: up is
        where its upper edge points, metres on the ground.
    turn_deg : float
        Of the picture's up, degrees clockwise, [-180, 180].
    covariance : tuple of float
        Of the three in this order, 3 x 3, row by row: m2, m deg and deg2.
    inliers : int
        Matches that agree with the motion.
    """

    right_m: float
    up_m: float
    turn_deg: float
    covariance: Nine
    inliers: int

    def of_points(self, before_m: tuple[float, float], after_m: tuple[float, float]) -> Self:
        """Return the motion between points that lie so far (right, up) of those beneath the cameras, metres.

        A camera that turns by 90 degrees on the spot moves what it sees 10 m ahead:

        >>> spot = Motion(right_m=0.0, up_m=0.0, turn_deg=90.0, covariance=(0.0,) * 8 + (1.0,), inliers=99)
        >>> ahead = spot.of_points((0.0, 10.0), (0.0, 10.0))
        >>> round(ahead.right_m), round(ahead.up_m), round(ahead.covariance[4] ** 0.5, 3)  # 10 m times a degree
        (10, -10, 0.175)
        """
        right_m, up_m = rotation(self.turn_deg) @ after_m
        moved = np.eye(3)
        moved[:2, 2] = np.radians([up_m, -right_m])
        return type(self)(
            right_m=float(self.right_m + right_m - before_m[0]),
            up_m=float(self.up_m + up_m - before_m[1]),
            turn_deg=self.turn_deg,
            covariance=_nine(moved @ np.reshape(self.covariance, (3, 3)) @ moved.T),
            inliers=self.inliers,
        )


def relative_motion(before: AerialImage, after: AerialImage) -> Motion | None:
    """Return how the camera moved between two pictures of level ground; None if they show too little in common.

    None as well of a camera that is believed to stand on the ground.

    Parameters
    ----------
    before, after : AerialImage
        Pictures with lens, tilt and height as believed, and their standard deviations. Place and heading of the
        cameras are not used.

    Notes
    -----
    ORB features (Rublee et al., ICCV 2011) that are each other's best match are laid on the ground by lens, tilt and
    height; RANSAC finds the rigid motion on which most agree. Then nine numbers are fitted to these matches: the
    motion, pitch and roll of each camera, the height, and the ratio of both heights, all but the motion held by their
    standard deviations. An error of height is taken to be that of both pictures, as a barometer's is. Length of the
    way is as good as the height. The same pictures always give the same answer.

    Examples
    --------
    Two parts of one picture from straight above, with pixels of half a metre; the second lies 40 pixels to the right
    and 30 above the first:

    >>> blobs = cv2.GaussianBlur(np.random.default_rng(1).uniform(0, 255, (400, 400)), (0, 0), 2.0)
    >>> whole = np.repeat(cv2.normalize(blobs, None, 0, 255, cv2.NORM_MINMAX)[..., None], 3, axis=2).astype(np.uint8)
    >>> before = AerialImage.from_above(whole[50:350, 20:320].copy(), gsd_m=0.5)
    >>> after = AerialImage.from_above(whole[20:320, 60:360].copy(), gsd_m=0.5)
    >>> motion = relative_motion(before, after)
    >>> round(motion.right_m, 1), round(motion.up_m, 1), abs(round(motion.turn_deg, 1))
    (20.0, 15.0, 0.0)
    """
    is_aloft = min(before.camera.height_m, after.camera.height_m) > 0
    matches = match_images(before, after) if is_aloft else None
    if matches is None:
        return None
    fit = _Fit(_View.of(before), _View.of(after), matches)
    start = fit.rigid()
    return None if start is None else fit.refined(*start)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Features that two pictures share: slopes in each, shape (N, 2), and how much a pixel of the first is as one."""

    before: Floats
    after: Floats
    pixel: float


def match_images(before: AerialImage, after: AerialImage) -> Matches | None:
    """Return the ORB features of two pictures that are each other's best match; None if there are too few."""
    (there, words, pixel), (here, others, _) = _features(before), _features(after)
    if min(len(words), len(others)) < _LEAST:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = [match.trainIdx for match in matcher.match(others, words)]
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in matcher.knnMatch(words, others, k=2)
        if best.distance < _RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    if len(pairs) < _LEAST:
        return None
    first, then = np.transpose(pairs)
    return Matches(before=there[first], after=here[then], pixel=pixel)


def _features(image: AerialImage) -> tuple[Floats, NDArray[np.uint8], float]:
    """Return slopes and descriptors of a picture's features, and the slope of a pixel in which they were found."""
    grey = cv2.cvtColor(image.rgb, cv2.COLOR_RGB2GRAY)
    factor = max(1.0, max(image.shape) / _MOST_PX)
    if factor > 1:
        size = (round(grey.shape[1] / factor), round(grey.shape[0] / factor))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    # 7: threshold of a corner, lower than usual, for fields
    points, words = cv2.ORB.create(nfeatures=_FEATURES, scaleFactor=_SCALE, fastThreshold=7).detectAndCompute(
        grey, None
    )
    if words is None:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8), 0.0
    # A feature of octave n has an integer centre in a picture 1.2 ** n times smaller, from which OpenCV scales it up
    # without its half pixel: two views turned by 180 degrees would disagree by two pixels and more.
    centres = np.array([np.add(point.pt, 0.5 * _SCALE**point.octave) for point in points])
    px = centres * np.divide(image.shape, grey.shape)[::-1]
    lens = image.camera.intrinsics
    slopes = lens.to_slopes(px)
    is_seen = np.isfinite(slopes).all(axis=1)
    return slopes[is_seen], words[is_seen].astype(np.uint8), factor / math.sqrt(math.prod(lens.focal_px))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """A camera as believed, in axes in which its picture's up is north: no heading is left in it."""

    matrix: Floats
    height_m: float
    height_sigma: float
    tilt_sigma_rad: float

    @classmethod
    def of(cls, image: AerialImage) -> Self:
        camera = image.camera.above_origin()
        return cls(
            matrix=camera.matrix,
            height_m=camera.height_m,
            height_sigma=max(image.height_sigma_m / camera.height_m, _STILL),
            tilt_sigma_rad=max(math.radians(image.attitude_sigma_deg), _STILL),
        )

    def turned(self, pitch_roll: Floats) -> Floats:
        """Return the matrix of the camera turned about its right and its down, which leaves its heading, by sigmas."""
        turn = Rotation.from_rotvec([*(pitch_roll * self.tilt_sigma_rad), 0.0])
        return np.asarray(turn.as_matrix() @ self.matrix)

    def ground(self, slopes: Floats, matrix: Floats) -> Floats:
        """Return where rays meet the ground, (right, up), shape (N, 2), heights; NaN far away and above the horizon."""
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ matrix
        down = np.where(-rays[:, 2:] * _FARTHEST > np.linalg.norm(rays, axis=1)[:, None], -rays[:, 2:], np.nan)
        return np.asarray(rays[:, :2] / down)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Two views and what they share; lengths are in heights of the first camera, angles in radians."""

    before: _View
    after: _View
    matches: Matches

    def rigid(self) -> tuple[Floats, NDArray[np.bool_]] | None:
        """Return the rigid motion on the ground that most matches agree with, and which do."""
        there = self.before.ground(self.matches.before, self.before.matrix)
        here = self.after.ground(self.matches.after, self.after.matrix) * (self.after.height_m / self.before.height_m)
        is_known = np.asarray(np.isfinite(np.column_stack([there, here])).all(axis=1), dtype=np.bool_)
        if is_known.sum() < _LEAST:
            return None
        tilt_rad = max(self.before.tilt_sigma_rad, self.after.tilt_sigma_rad)
        found, agrees = cv2.estimateAffinePartial2D(
            here[is_known],
            there[is_known],
            method=cv2.RANSAC,  # which begins with the same random numbers at each call
            ransacReprojThreshold=_ROUGH_PX * self.matches.pixel + tilt_rad / 2,
            maxIters=5000,
            confidence=0.9999,
        )
        if found is None:
            return None
        is_known[is_known] = agrees.ravel() > 0
        turn_rad = math.atan2(found[0, 1], found[0, 0])
        return np.array([*found[:, 2], turn_rad]), is_known

    def refined(self, motion: Floats, agrees: NDArray[np.bool_]) -> Motion | None:
        """Return the motion that fits matches and beliefs best."""
        numbers = np.concatenate([motion, np.zeros(6)])
        for near_px in _NEAR_PX:
            if agrees.sum() < _LEAST:
                return None
            numbers = least_squares(self._errors, numbers, args=(agrees,), loss="soft_l1").x
            agrees &= np.linalg.norm(self._off_px(numbers), axis=1) < near_px
        count = int(agrees.sum())
        if count < _LEAST:
            return None
        fitted = least_squares(self._errors, numbers, args=(agrees,))
        jacobian, off = np.asarray(fitted.jac)[: 2 * count], fitted.fun[: 2 * count]
        # 0.5: no match is better than half a pixel; 3: numbers of the motion
        variance = max(0.5**2, float(off @ off) / (2 * count - 3)) * max(1.0, count / _INDEPENDENT)
        beliefs = np.diag([0.0] * 3 + [1.0] * 6)
        unit = np.diag([self.before.height_m, self.before.height_m, math.degrees(1.0)])
        covariance = unit @ np.linalg.inv(jacobian.T @ jacobian / variance + beliefs)[:3, :3] @ unit
        right_m, up_m, turn_deg = (unit @ fitted.x[:3]).tolist()
        return Motion(right_m=right_m, up_m=up_m, turn_deg=turn_deg, covariance=_nine(covariance), inliers=count)

    def _errors(self, numbers: Floats, agrees: NDArray[np.bool_]) -> Floats:
        """Return the errors of some matches and of beliefs in standard deviations."""
        return np.concatenate([self._off_px(numbers)[agrees].ravel() / _MATCH_PX, numbers[3:]])

    def _off_px(self, numbers: Floats) -> Floats:
        """Return how far what the second picture shows lies off in the first, shape (N, 2), pixels."""
        sigma = max(self.before.height_sigma, self.after.height_sigma)
        height, ratio = np.exp(numbers[7:] * sigma)
        seen = self.after.ground(self.matches.after, self.after.turned(numbers[5:7]))
        seen = seen * (height * ratio * self.after.height_m / self.before.height_m)
        placed = numbers[:2] + seen @ rotation(math.degrees(numbers[2])).T
        ahead = np.column_stack([placed, np.full(len(placed), -height)]) @ self.before.turned(numbers[3:5]).T
        off = ahead[:, :2] / ahead[:, 2:] - self.matches.before
        # 1e3: far off, where no ground is seen
        return np.nan_to_num(off / self.matches.pixel, nan=1e3, posinf=1e3, neginf=-1e3)


def _nine(matrix: Floats) -> Nine:
    """Return a covariance row by row, exactly symmetric."""
    a, b, c, d, e, f, g, h, i = ((matrix + matrix.T) / 2).ravel().tolist()
    return (a, b, c, d, e, f, g, h, i)
