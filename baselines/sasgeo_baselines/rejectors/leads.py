# SPDX-License-Identifier: Apache-2.0
"""Statistics of the scores and places of an answer: lead of the first place, entropy and spread over places."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench import Pose, Prediction

# The widest tolerance of the benchmark: nearer candidates are one answer.
APART_M: Final = 25.0
MOST: Final = 1e100  # numbers are clipped to it, so that squares and differences stay finite

Values = NDArray[np.float64]


def with_withheld(predictions: Sequence[Prediction], rule: Callable[[Sequence[Prediction]], Values]) -> Values:
    """Return a rule's values for answers with candidates, and 1 for those without, shape (N,)."""
    found = np.ones(len(predictions))
    at = answered(predictions)
    if len(at):
        found[at] = rule([predictions[index] for index in at])
    return found


def answered(predictions: Sequence[Prediction]) -> NDArray[np.int64]:
    """Return indices of answers with candidates."""
    return np.array([at for at, item in enumerate(predictions) if item.candidates], dtype=np.int64)


def margin(prediction: Prediction) -> float:
    """Return the score of the first candidate less that of the second; 0 without a second."""
    scores = scores_of(prediction)
    return float(min(scores[0] - scores[1], MOST)) if len(scores) > 1 else 0.0


def margin_nms(prediction: Prediction) -> float:
    """Return the score of the first candidate less that of the best at least `APART_M` away from it.

    Without one, less that of the last candidate: a rival that was not returned scores no better.
    """
    scores = scores_of(prediction)
    (first, _), *others = prediction.candidates
    away_m = np.array([math.dist(_place(first), _place(pose)) for pose, _ in others])
    rivals = scores[1:][away_m >= APART_M]
    return float(min(scores[0] - (rivals.max() if len(rivals) else scores[-1]), MOST))


def entropy(prediction: Prediction) -> float:
    """Return the entropy of a softmax over standardised scores, nats; for one candidate that of a tie of two."""
    scores = scores_of(prediction)
    if len(scores) == 1:
        return math.log(2)
    shares = softmax(scores)
    return float(-(shares * np.log(np.maximum(shares, 1e-300))).sum())


def softmax(scores: Values) -> Values:
    """Return shares that sum to 1, by a softmax of scores over their standard deviation; equal shares of equal scores.

    >>> softmax(np.array([30.0, 10.0])).round(3).tolist() == softmax(np.array([3.0, 1.0])).round(3).tolist()
    True
    """
    scaled = scores / max(float(np.abs(scores).max()), 1e-300)
    spread = float(scaled.std())
    if not np.ptp(scaled) > 0 or not spread > 0:
        return np.full(len(scores), 1.0 / len(scores))
    weights = np.exp((scaled - scaled.max()) / spread)
    return np.asarray(weights / weights.sum())


def ratios(scores: Values) -> Values:
    """Return the ratio of each further score to the first, 0..1: 1 for a tie, 0 for one that is nothing beside it.

    Scores are similarities, or negative distances: then the ratio is that of the first distance to the further one.
    Where the first is positive and another is not, that other is nothing beside it.

    >>> ratios(np.array([4.0, 3.0, -1.0])).tolist(), ratios(np.array([-1.0, -4.0])).tolist()
    ([0.75, 0.0], [0.25])
    """
    first, others = scores[0], scores[1:]
    above, below = (np.maximum(others, 0.0), first) if first > 0 else (np.full(len(others), first), others)
    return np.divide(above, below, out=np.ones(len(others)), where=below != 0)


def scores_of(prediction: Prediction) -> Values:
    """Return the scores of the candidates, best first, shape (N,)."""
    return np.clip(np.array([score for _, score in prediction.candidates], dtype=np.float64), -MOST, MOST)


@dataclass(frozen=True, slots=True, kw_only=True)
class Firsts:
    """The first K candidates of N of the answers, `at`: places in m, shape (N, K, 2), and scores, shape (N, K)."""

    at: NDArray[np.int64]
    places_m: Values
    scores: Values

    @classmethod
    def of(cls, answers: Sequence[Prediction], most: int) -> "list[Firsts]":
        """Return the first candidates, at most so many, of answers with as many of them."""
        counts = np.array([min(len(item.candidates), most) for item in answers], dtype=np.int64)
        found = []
        for count in np.unique(counts).tolist():
            at = np.flatnonzero(counts == count)
            listed = [answers[index].candidates[:count] for index in at.tolist()]
            places_m = np.array([[_place(pose) for pose, _ in one] for one in listed]).reshape(-1, count, 2)
            scores = np.array([[score for _, score in one] for one in listed], dtype=np.float64)
            found.append(cls(at=at, places_m=places_m, scores=np.clip(scores, -MOST, MOST)))
        return found

    def spreads_m2(self, *, slope: float, far_m: float) -> Values:
        """Return the variance along an axis of the places, m2, shape (N,); it is the mean of both axes.

        A weight is the exponential of `slope` times the score; an offset from the mean place counts as `far_m` at most.
        """
        weights = np.exp(slope * (self.scores - self.scores.max(axis=1, keepdims=True)))
        shares = (weights / weights.sum(axis=1, keepdims=True))[:, None]
        away_m = np.abs(self.places_m - shares @ self.places_m)
        return np.asarray((shares @ np.square(np.minimum(away_m, far_m)))[:, 0].mean(axis=1))


def _place(pose: Pose) -> tuple[float, float]:
    return (pose.easting_m, pose.northing_m)


def base_rate(is_false: NDArray[np.bool_]) -> float:
    """Return the share of false fixes with one more of each kind (Laplace): never 0 or 1."""
    return float((is_false.sum() + 1) / (len(is_false) + 2))
