# SPDX-License-Identifier: Apache-2.0
"""Rank of the right answer in a list: recall and reciprocal rank with ties; every query counts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from sasgeo_bench.errors import MetricError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import candidates_at
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.scoring.base import Floats, Ints, check_column
from sasgeo_bench.tasks.query import Truth


@dataclass(frozen=True, slots=True, kw_only=True)
class Rank:
    """Rank of the first right pose of one answer.

    `above` counts poses with a higher score, `tied` those with the same score, including itself, and `right` the right
    ones among the tied; 0 if no pose of the answer is right or there is no answer. Raise MetricError if more are right
    than tied, or a number is negative.
    """

    above: int
    tied: int
    right: int

    def __post_init__(self) -> None:
        """Check the counts."""
        if not (self.above >= 0 and 0 <= self.right <= self.tied):
            message = f"a rank has above >= 0 and 0 <= right <= tied, got {self!r}"
            raise MetricError(message)


MISS: Final = Rank(above=0, tied=0, right=0)


def rank_of(scores: ArrayLike, is_right: ArrayLike) -> Rank:
    """Return the rank of the best right pose of one answer; `MISS` without one.

    `scores`, shape (K,), may be in any order; larger is better.

    >>> rank_of([9.0, 7.0, 7.0, 1.0], [False, False, True, True])
    Rank(above=1, tied=2, right=1)
    """
    score = check_column(scores, "scores")
    right = check_column(is_right, "is_right", len(score)) > 0
    if not right.any():
        return MISS
    best = score[right].max()
    ties = score == best
    return Rank(above=int((score > best).sum()), tied=int(ties.sum()), right=int((ties & right).sum()))


def rank_candidate(prediction: Prediction | None, truth: Truth, candidates: Sequence[Pose]) -> Rank:
    """Return the rank of the right candidate in an answer to a retrieval query; `MISS` if the answer lacks it.

    A pose of the answer is the candidate at its position. Raise MetricError if no candidate is right: recall is a share
    of the queries whose place is present.
    """
    if not 0 <= truth.candidate < len(candidates):
        message = (
            f"query {truth.query_id} has no right candidate ({truth.candidate} of {len(candidates)}): "
            "leave absent places out of recall, the integrity track counts them"
        )
        raise MetricError(message)
    if prediction is None or prediction.status != "ok":
        return MISS
    given: set[int] = set()
    right = []
    for pose, _ in prediction.candidates:
        # As in `matcher.check_match`: of two candidates at one position, the first one not used yet.
        at = next((index for index in candidates_at(pose, candidates) if index not in given), -1)
        given.add(at)
        right.append(at == truth.candidate)
    return rank_of([score for _, score in prediction.candidates], right)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranks:
    """Ranks of N queries as columns, each of shape (N,); see `Rank`."""

    above: Ints
    tied: Ints
    right: Ints

    @classmethod
    def of(cls, ranks: Sequence[Rank]) -> Self:
        """Return the columns of some ranks."""
        table = np.array([(rank.above, rank.tied, rank.right) for rank in ranks], dtype=np.int64).reshape(-1, 3)
        return cls(above=table[:, 0], tied=table[:, 1], right=table[:, 2])


def hits(ranks: Ranks, k: int) -> Floats:
    """Return the chance that a right pose is among the first k, shape (N,), if tied poses are in random order.

    0 or 1 without ties; the mean is Recall@k. Raise MetricError if k is less than 1.

    With m places left for t tied poses of which r are right, all r are left out with chance C(t - r, m) /
    C(t, m), which is the product of (t - m - j) / (t - j) over j < r. With one right pose the chance to be in is m / t.

    >>> ranks = Ranks.of([Rank(above=0, tied=1, right=1), Rank(above=0, tied=4, right=1), MISS])
    >>> hits(ranks, 1).tolist(), hits(ranks, 5).tolist()
    ([1.0, 0.25, 0.0], [1.0, 1.0, 0.0])
    """
    if k < 1:
        message = f"k must be at least 1, got {k!r}"
        raise MetricError(message)
    places = np.clip(k - ranks.above, 0, ranks.tied)
    left_out = np.ones(len(places))
    for step in range(int(ranks.right.max(initial=0))):
        share = np.maximum(ranks.tied - places - step, 0) / np.maximum(ranks.tied - step, 1)
        left_out *= np.where(step < ranks.right, share, 1.0)
    return np.where(ranks.right > 0, 1.0 - left_out, 0.0)


def reciprocal_ranks(ranks: Ranks) -> Floats:
    """Return the expected 1 / rank of the first right pose, shape (N,), if tied poses are in random order.

    The mean is the MRR.

    One of two tied poses behind a better one: (1/2 + 1/3) / 2.

    >>> reciprocal_ranks(Ranks.of([Rank(above=1, tied=2, right=1)])).round(4).tolist()
    [0.4167]
    """
    last = int((ranks.above + ranks.tied).max(initial=1))
    before = np.zeros(len(ranks.above))
    total = np.zeros(len(ranks.above))
    for place in range(1, last + 1):
        now = hits(ranks, place)
        total += (now - before) / place
        before = now
    return total
