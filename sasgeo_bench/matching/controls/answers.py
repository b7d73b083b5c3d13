# SPDX-License-Identifier: Apache-2.0
"""Parts that simple matchers share: ranking candidates, and poses from a prior."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import Match
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.query import Query


def is_blind(query: Query) -> bool:
    """Tell if a view is wholly unknown."""
    return bool((query.evidence.cells == UNKNOWN).all())


def ranked_candidates(
    query: Query,
    scores: Sequence[float | None],
    *,
    top_k: int,
    poses: Sequence[Pose] | None = None,
    diagnostics: dict[str, float] | None = None,
) -> Match:
    """Rank the candidates of a retrieval query by score, larger is better; ties keep their order.

    Parameters
    ----------
    query : Query
        Of the track retrieval.
    scores : sequence of float or None
        One for each candidate; those with None are dropped.
    top_k : int
        Number of candidates to return.
    poses : sequence of Pose, optional
        One for each candidate, for heading and scale; the place is that of the candidate.
    diagnostics : dict of str to float, optional
        Diagnostics of the answer.
    """
    chosen = [(at, score) for at, score in enumerate(scores) if score is not None]
    chosen = sorted(chosen, key=lambda item: -item[1])[:top_k]
    turned = [
        replace(query.candidates[at], yaw_deg=poses[at].yaw_deg, scale=poses[at].scale)
        if poses is not None
        else query.candidates[at]
        for at, _ in chosen
    ]
    return Match(poses=turned, scores=[float(score) for _, score in chosen], diagnostics=dict(diagnostics or {}))


def offsets_m(points_m: NDArray[np.float64], place_m: tuple[float, float]) -> NDArray[np.float64]:
    """Return distances of places, shape (N, 2), from one place, metres."""
    return np.asarray(np.hypot(points_m[:, 0] - place_m[0], points_m[:, 1] - place_m[1]))


def points_of(poses: Sequence[Pose]) -> NDArray[np.float64]:
    """Return easting and northing of poses, shape (N, 2)."""
    return np.array([(pose.easting_m, pose.northing_m) for pose in poses], dtype=np.float64).reshape(-1, 2)


def middle_m(prior: Prior, grid: Grid) -> tuple[float, float]:
    """Return the centre of the disc of a prior, or of the map if it has none."""
    if prior.center_m is not None:
        return prior.center_m
    west_m, south_m, east_m, north_m = grid.bounds_m
    return (west_m + east_m) / 2, (south_m + north_m) / 2


def at_place(point_m: NDArray[np.float64] | tuple[float, float], prior: Prior) -> Pose:
    """Return the pose at a place with the heading of the prior, north if it has none."""
    return Pose(easting_m=float(point_m[0]), northing_m=float(point_m[1]), yaw_deg=prior.yaw_deg or 0.0)
