# SPDX-License-Identifier: Apache-2.0
"""Errors of the first pose, success, and the rank of the right answer; every query counts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.matching.matcher import Prediction, candidates_at
from sasgeo_bench.running.prediction_files import CANDIDATE_M
from sasgeo_bench.scoring.base import Bools, Floats, Ints, check_column
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
            raise MetricError(f"a rank has above >= 0 and 0 <= right <= tied, got {self!r}")


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
    check_candidate(truth, len(candidates))
    if prediction is None or prediction.status != "ok":
        return MISS
    given: set[int] = set()
    right = []
    for pose, _ in prediction.candidates:
        # As in `matcher.check_match`: of two candidates at one position, the first one not used yet.
        at = next((index for index in candidates_at(pose, candidates, CANDIDATE_M) if index not in given), -1)
        given.add(at)
        right.append(at == truth.candidate)
    return rank_of([score for _, score in prediction.candidates], right)


def check_candidate(truth: Truth, count: int) -> None:
    """Raise MetricError if none of so many candidates is right."""
    if not 0 <= truth.candidate < count:
        raise MetricError(
            f"query {truth.query_id} has no right candidate ({truth.candidate} of {count}): "
            "leave absent places out of recall, the integrity track counts them"
        )


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


def ranks_of_lists(row: Ints, scores: Floats, is_right: Bools, count: int) -> Ranks:
    """Return `rank_of` of so many answers, whose candidates stand one after the other, shape (C,).

    `row` is the answer of each candidate, in ascending order.

    >>> row, scores = np.array([0, 0, 0, 0, 2]), np.array([9.0, 7.0, 7.0, 1.0, 5.0])
    >>> found = ranks_of_lists(row, scores, np.array([False, False, True, True, False]), 3)
    >>> found.above.tolist(), found.tied.tolist(), found.right.tolist()
    ([1, 0, 0], [2, 0, 0], [1, 0, 0])
    """
    best = np.full(count, np.inf)
    best[row[is_right]] = -np.inf
    np.maximum.at(best, row[is_right], scores[is_right])
    is_tied = scores == best[row]
    above, tied, right = (
        np.bincount(row[mask], minlength=count) for mask in (scores > best[row], is_tied, is_tied & is_right)
    )
    return Ranks(above=above, tied=tied, right=right)


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
        raise MetricError(f"k must be at least 1, got {k!r}")
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


SUCCESS_DEG: Final = 5.0
AUC_M: Final = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """Errors of N answers, each of shape (N,) and not negative; infinite without an answer.

    `position_m` is the distance on the map plane, `yaw_deg` unsigned in [0, 180], `log_scale` is |ln(scale / true
    scale)|: twice too large and half as large are equally wrong, and 0.1 is about 10 %.
    """

    position_m: Floats
    yaw_deg: Floats
    log_scale: Floats

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        count = np.size(self.position_m)
        for name in ("position_m", "yaw_deg", "log_scale"):
            column = check_column(getattr(self, name), name, count)
            if (column < 0).any():
                raise MetricError(f"{name} holds {column.min():g}, errors are not negative")
            object.__setattr__(self, name, column)


def first_pose(prediction: Prediction | None) -> Pose | None:
    """Return the fix of an answer, its first pose; None for no row, no answer, a crash or a time-out.

    Of poses with equal scores the first listed counts, since a vehicle would use it.
    """
    if prediction is None or prediction.status != "ok" or not prediction.candidates:
        return None
    return prediction.candidates[0][0]


def columns_of(poses: Sequence[Pose | None]) -> Floats:
    """Return easting, northing, yaw and scale of N poses, shape (N, 4); NaN for None."""
    nothing = (math.nan,) * 4
    return np.array([nothing if pose is None else _numbers(pose) for pose in poses]).reshape(-1, 4)


def pose_errors(given: Floats, true: Floats) -> PoseErrors:
    """Return the errors of N fixes against N truths, shape (N, 4) each (`columns_of`); infinite for NaN, never clipped.

    Raise MetricError if there are not as many answers as truths.

    >>> truth = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=350.0)
    >>> fixes = columns_of([Pose(easting_m=3.0, northing_m=4.0, yaw_deg=10.0), None])
    >>> errors = pose_errors(fixes, columns_of([truth, truth]))
    >>> errors.position_m.tolist(), errors.yaw_deg.tolist(), errors.log_scale.tolist()
    ([5.0, inf], [20.0, inf], [0.0, inf])
    """
    if len(given) != len(true):
        raise MetricError(f"{len(given)} answers for {len(true)} truths: give NaN where there is no answer")
    is_given = ~np.isnan(given[:, 0])
    gap = np.where(is_given[:, None], given, true) - true
    ratio = np.where(is_given, given[:, 3], true[:, 3]) / true[:, 3]
    return PoseErrors(
        position_m=np.where(is_given, np.hypot(gap[:, 0], gap[:, 1]), np.inf),
        yaw_deg=np.where(is_given, np.abs(wrap_deg(gap[:, 2])), np.inf),
        log_scale=np.where(is_given, np.abs(np.log(ratio)), np.inf),
    )


def _numbers(pose: Pose) -> tuple[float, float, float, float]:
    return (pose.easting_m, pose.northing_m, pose.yaw_deg, pose.scale)


def successes(errors: PoseErrors, within_m: float, within_deg: float = SUCCESS_DEG) -> Bools:
    """Return which fixes are right, shape (N,): `position_m <= within_m` and `yaw_deg <= within_deg`.

    Use 180 degrees to ignore the heading. An error equal to a tolerance is within it, as in all of this package. Metres
    are those of the region's UTM zone, which differ from metres on the ground by at most 0.1 %. Raise MetricError if a
    tolerance is negative or `within_m` is not finite.

    >>> errors = PoseErrors(position_m=[5.0, 5.1, 0.0], yaw_deg=[5.0, 0.0, 5.1], log_scale=[0.0, 0.0, 0.0])
    >>> successes(errors, 5.0).tolist()
    [True, False, False]
    """
    if not 0 <= within_m < math.inf or not within_deg >= 0:
        raise MetricError(f"tolerances must be finite and not negative, got {within_m!r} m and {within_deg!r} deg")
    return (errors.position_m <= within_m) & (errors.yaw_deg <= within_deg)


def area_values(errors: PoseErrors) -> Floats:
    """Return each query's part of the success AUC, shape (N,): max(0, 1 - error / 50 m), 0 for a wrong heading.

    >>> area_values(PoseErrors(position_m=[10.0, 60.0, 0.0], yaw_deg=[0.0, 0.0, 90.0], log_scale=[0.0] * 3)).tolist()
    [0.8, 0.0, 0.0]
    """
    near = np.maximum(0.0, 1.0 - errors.position_m / AUC_M)
    return np.where(errors.yaw_deg <= SUCCESS_DEG, near, 0.0)
