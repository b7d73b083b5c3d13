# SPDX-License-Identifier: Apache-2.0
"""What every baseline's answer shares: ranking candidates, and seeing whether anything was seen at all."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench import UNKNOWN, Match, Pose, Query


def is_blind(query: Query) -> bool:
    """Whether a view shows nothing: all of it is unknown."""
    return bool((query.evidence.cells == UNKNOWN).all())


def ranked_candidates(
    query: Query,
    scores: Sequence[float | None],
    *,
    top_k: int,
    poses: Sequence[Pose] | None = None,
    diagnostics: dict[str, float] | None = None,
) -> Match:
    """Rank a query's candidates by scores, larger is better; equals keep their order.

    Parameters
    ----------
    query : Query
        One of retrieval.
    scores : sequence of float or None
        One for each candidate; those with None are left out.
    top_k : int
        How many to give.
    poses : sequence of Pose, optional
        Headings and scales to give with them; places are those of the candidates.
    diagnostics : dict of str to float, optional
        To give with them.
    """
    chosen = [at for at, score in enumerate(scores) if score is not None]
    chosen = sorted(chosen, key=lambda at: -(scores[at] or 0.0))[:top_k]
    turned = [
        replace(query.candidates[at], yaw_deg=poses[at].yaw_deg, scale=poses[at].scale)
        if poses is not None
        else query.candidates[at]
        for at in chosen
    ]
    return Match(poses=turned, scores=[float(scores[at] or 0.0) for at in chosen], diagnostics=dict(diagnostics or {}))


def offsets_m(points_m: NDArray[np.float64], place_m: tuple[float, float]) -> NDArray[np.float64]:
    """Distance of each of some places, shape (N, 2), to one, metres."""
    return np.asarray(np.hypot(points_m[:, 0] - place_m[0], points_m[:, 1] - place_m[1]))
