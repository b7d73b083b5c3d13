# SPDX-License-Identifier: Apache-2.0
"""`orb_homography`: ORB features of view and imagery, the ratio test, and a similarity by RANSAC."""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.global_descriptor import lattice_m
from sasgeo_baselines.image.dense import (
    APART_M,
    AROUND_M,
    MOST_PLACES,
    SPREAD,
    answer_candidates,
    answer_places,
    disc_of,
)
from sasgeo_baselines.image.features import PIXEL_M, Features, map_features, view_features
from sasgeo_baselines.image.view_image import LIMITS, MASKED, PICTURE, side_of, under_roofs, view_image

RATIO: Final = 0.85
NEAR_M: Final = 3.0  # of a match from where the similarity puts it
LEAST_MATCHES: Final = 5  # that agree
_SLACK_DEG: Final = 10.0


def similarity(seen: NDArray[np.float64], mapped: NDArray[np.float64]) -> sgb.Mode | None:
    """Return the similarity that takes (right, up) to (east, north), both of shape (N, 2), by RANSAC; None without one.

    Its score counts the matches that agree, each as 1 less the square of its error in units of `NEAR_M`.

    >>> seen = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0], [-30.0, 10.0], [5.0, -20.0], [9.0, 9.0]])
    >>> pose = sgb.Pose(easting_m=500.0, northing_m=200.0, yaw_deg=90.0)
    >>> found = similarity(seen, pose.to_map(seen))
    >>> round(found.pose.easting_m, 3), round(found.pose.yaw_deg, 3), round(found.score, 3)
    (500.0, 90.0, 6.0)
    """
    if len(seen) < LEAST_MATCHES:
        return None
    origin = mapped.mean(axis=0)
    matrix, agreeing = cv2.estimateAffinePartial2D(
        seen, mapped - origin, method=cv2.RANSAC, ransacReprojThreshold=NEAR_M, maxIters=2000, confidence=0.999
    )
    if matrix is None or int(np.count_nonzero(agreeing)) < LEAST_MATCHES:
        return None
    scale = math.hypot(matrix[0, 0], matrix[1, 0])
    if not 0.1 < scale < 10:  # all matches in one point
        return None
    east_m, north_m = (matrix[:, 2] + origin).tolist()
    yaw_deg = math.degrees(math.atan2(-matrix[1, 0], matrix[0, 0]))
    pose = sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg, scale=scale)
    errors = np.linalg.norm(pose.to_map(seen) - mapped, axis=1) / NEAR_M
    return sgb.Mode(pose=pose, score=float(np.maximum(1 - errors**2, 0).sum()))


def is_likely(pose: sgb.Pose, prior: sgb.Prior) -> bool:
    """Return whether heading and scale of a pose are what a prior leaves open, with some slack."""
    # 0.1: slack of scale, and 10 degrees: beyond what the prior makes likely
    if abs(pose.scale - 1) > SPREAD * prior.scale_sigma + 0.1:
        return False
    if prior.yaw_deg is None or prior.yaw_sigma_deg is None:
        return True
    off_deg = (pose.yaw_deg - prior.yaw_deg + 180) % 360 - 180
    return abs(off_deg) <= SPREAD * prior.yaw_sigma_deg + _SLACK_DEG


def apart(modes: Iterable[sgb.Mode], *, most: int) -> list[sgb.Mode]:
    """Return the best modes, none nearer than `APART_M` to a better one; of equal ones the first."""
    kept: list[sgb.Mode] = []
    for mode in sorted(modes, key=lambda item: -item.score):
        points_m = sgb.points_of([other.pose for other in kept])
        if len(kept) < most and (sgb.offsets_m(points_m, _place(mode.pose)) >= APART_M).all():
            kept.append(mode)
    return kept


def _place(pose: sgb.Pose) -> tuple[float, float]:
    return (pose.easting_m, pose.northing_m)


class OrbHomography:
    """ORB features matched window by window, and the similarity on which most of them agree."""

    card = sgb.MatcherCard(
        name="orb_homography",
        version="1",
        title="ORB features, ratio test and a similarity by RANSAC",
        source="ORB (Rublee et al., ICCV 2011), ratio test (Lowe, IJCV 2004), RANSAC (Fischler and Bolles, 1981)",
        ours=(
            f"{PICTURE}; pixels of 0.5 m; a similarity, as the picture is level already; windows of 1.7 views, half a "
            "view apart, each with a ratio test of its own (0.85); at least five matches within 3 m; each counts 1 "
            "less the square of its error"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("image", "imagery"),
        limits=f"Needs corners that light and seasons leave alone; answers nothing where few agree; {LIMITS}",
    )

    is_masked = False  # features on roofs of the map are left out

    def __init__(self) -> None:
        self._features: Features | None = None

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Find the features of the imagery."""
        del learned
        found = map_features(region)
        self._features = None
        if found is not None:
            self._features, self._grid = found
            if self.is_masked:
                row, col = self._grid.to_cells(self._features.points).T
                self._features = self._features.chosen(~under_roofs(region, self._grid)[row, col])

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Return the similarities with most matches, or rank the candidates by that of the window around each."""
        seen_image = view_image(query, gsd_m=PIXEL_M)
        if self._features is None or seen_image is None:
            return sgb.WITHHELD
        side_m = side_of(query)
        seen = view_features(seen_image, side_m=side_m)
        diagnostics = {"features": float(len(seen)), "seen_share": float(seen_image.is_seen.mean())}
        if query.track == "retrieval":
            found = [self._near(seen, pose, query.prior, side_m) for pose in query.candidates]
            return answer_candidates(query, found, top_k=top_k, diagnostics=diagnostics)
        disc = disc_of(query.prior)
        # 0.5: step of the side of a view between two windows
        places = lattice_m(query.prior, self._grid, step_m=0.5 * side_m)
        windows = [self._window(seen, (x, y), side_m, query.prior) for x, y in places.tolist()]
        modes = [mode for mode in windows if mode is not None and disc.has(mode.pose)]
        most = min(top_k, MOST_PLACES)
        return answer_places(apart(modes, most=most + 1), top_k=most, diagnostics=diagnostics)

    def _near(self, seen: Features, candidate: sgb.Pose, prior: sgb.Prior, side_m: float) -> sgb.Mode | None:
        """Return the similarity of the window around a candidate, if it puts the view there."""
        mode = self._window(seen, _place(candidate), side_m, prior)
        if mode is None or math.dist(_place(mode.pose), _place(candidate)) > AROUND_M:
            return None
        return mode

    def _window(
        self, seen: Features, middle_m: tuple[float, float], side_m: float, prior: sgb.Prior
    ) -> sgb.Mode | None:
        assert self._features is not None  # noqa: S101 - match() has looked
        # 0.85: reach of the side of a view, half the side of a window: holds a view anywhere around its middle
        within = np.asarray((np.abs(self._features.points - middle_m) <= 0.85 * side_m).all(axis=1))
        mapped = self._features.chosen(within)
        if min(len(seen), len(mapped)) < LEAST_MATCHES:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(seen.descriptors, mapped.descriptors, k=2)
        chosen = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
        if len(chosen) < LEAST_MATCHES:
            return None
        ours, theirs = (np.array([getattr(item, name) for item in chosen]) for name in ("queryIdx", "trainIdx"))
        mode = similarity(seen.points[ours], mapped.points[theirs])
        return mode if mode is not None and is_likely(mode.pose, prior) else None


class OrbHomographyMasked(OrbHomography):
    """`orb_homography_masked`: the same without features on the roofs of the map."""

    is_masked = True
    card = replace(
        OrbHomography.card,
        name="orb_homography_masked",
        title="ORB features beside the roofs of the map, and a similarity by RANSAC",
        ours=f"`orb_homography` {MASKED}",
    )
