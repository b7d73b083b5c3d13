# SPDX-License-Identifier: Apache-2.0
"""Thresholds of P(false fix) below which false fixes stay rare, with a guarantee.

Learn-then-Test (Angelopoulos, Bates, Candes, Jordan and Lei, 2021): thresholds are tested in an order that was fixed
beforehand, each by a p-value that holds for finite numbers of answers. The probabilities need not be calibrated.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

from sasgeo_bench.errors import ConfigError

# Fixed before any answer is seen: that is what the promise hangs on. Tests begin at each of `_STARTS`, which share
# delta, and go up from there as far as they hold.
_THRESHOLDS: Final = np.unique(np.concatenate((special.expit(np.linspace(-7.0, 7.0, 141)), [0.01, 0.02, 0.05, 0.1])))
_STARTS: Final = (0.01, 0.02, 0.05, 0.1, 0.2)


def upper_rate(failures: float, trials: float, *, confidence: float = 0.95) -> float:
    """Return Clopper-Pearson's one-sided upper bound of a rate; 1 without a trial.

    `failures` lie in 0..`trials` and need not be whole.

    Raises
    ------
    ConfigError
        If a number is out of range.

    Examples
    --------
    >>> round(upper_rate(0, 299), 4), upper_rate(0, 0)
    (0.01, 1.0)
    """
    if not (0 <= failures <= trials < math.inf and 0 < confidence < 1):
        message = f"0 <= failures <= trials and 0 < confidence < 1, got {failures!r}, {trials!r} and {confidence!r}"
        raise ConfigError(message)
    return 1.0 if failures == trials else float(stats.beta.ppf(confidence, failures + 1.0, trials - failures))


@dataclass(frozen=True, slots=True, kw_only=True)
class RiskBound:
    """A threshold and its guarantee.

    Answers with a lower P(false fix) are accepted; threshold 0 accepts none, since nothing can be guaranteed. Among
    accepted answers like those of calibration at most `alpha` are false, with `confidence` (1 - delta) over calibration
    sets. `accepted` and `false` count calibration answers below the threshold, `units` accepted answers or, if
    `is_by_block`, blocks that hold some. By block the guarantee is of the mean share of a new block, each block with
    equal weight.
    """

    threshold: float
    alpha: float
    confidence: float
    accepted: int
    false: int
    units: int
    is_by_block: bool

    @property
    def is_promised(self) -> bool:
        """Return whether there is a threshold."""
        return self.threshold > 0

    def to_text(self) -> str:
        """Return the guarantee in a sentence."""
        of = "a new block's accepted answers" if self.is_by_block else "accepted answers"
        promise = f"at most {self.alpha:g} of {of} are false, with confidence {self.confidence:g}"
        counted = f"{self.false} of {self.accepted} false in calibration" + (
            f", from {self.units} blocks" if self.is_by_block else ""
        )
        if self.is_promised:
            return f"below {self.threshold:.3g} {promise} ({counted})"
        return f"none can be promised by which {promise}: too few answers, or too many false ones"


def risk_threshold(
    p_false: ArrayLike, is_false: ArrayLike, *, alpha: float, delta: float, blocks: Sequence[str] | None = None
) -> RiskBound:
    """Return the largest threshold for which the share of false fixes among accepted answers is guaranteed.

    `p_false` and `is_false`, shape (N,), belong to calibration answers that the model was not fitted to; withheld ones
    have 1. `alpha` is the tolerated share, `delta` the probability that a calibration set misleads. Answers of one
    block are alike, so N of them guarantee less than N; with `blocks` the guarantee is of the mean share of false fixes
    among the accepted answers of a block, over blocks that accept any.

    Raises
    ------
    ConfigError
        If shapes differ, a number is out of range, or a probability is none.

    Notes
    -----
    Without blocks the p-value is the binomial tail given how many are accepted, exact if answers are exchangeable and
    independent. Answers of one block are not: a promise without blocks is then of further answers from the same
    blocks. With blocks it is that of Hoeffding and Bentkus for means of values in [0, 1], exact for exchangeable blocks
    whatever happens within them, and dear: without any false fix n units promise alpha only if
    (1 - alpha)^n <= delta / 5, so 5 % at 0.9 takes 77 answers or as many blocks; 36 blocks promise no less than 10.3 %.
    Neither speaks of places unlike those of calibration.
    """
    chance, false = _checked(p_false, is_false, alpha, delta, blocks)
    accepted, wrong = _below(chance, None), _below(chance, false)
    if blocks is None:
        units, p_values = accepted, stats.binom.cdf(wrong, accepted, alpha)
    else:
        units, p_values = _by_block(
            chance, false, np.unique(np.asarray(blocks, dtype=str), return_inverse=True)[1], alpha
        )
    at = _last_that_holds((p_values <= delta / len(_STARTS)) & (units > 0))
    counts = (0, 0, 0) if at is None else (int(accepted[at]), int(wrong[at]), int(units[at]))
    return RiskBound(
        threshold=0.0 if at is None else float(_THRESHOLDS[at]),
        alpha=alpha,
        confidence=1.0 - delta,
        accepted=counts[0],
        false=counts[1],
        units=counts[2],
        is_by_block=blocks is not None,
    )


def _checked(
    p_false: ArrayLike, is_false: ArrayLike, alpha: float, delta: float, blocks: Sequence[str] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    chance, false = np.asarray(p_false, dtype=np.float64), np.asarray(is_false, dtype=np.float64)
    if chance.ndim != 1 or false.shape != chance.shape or (blocks is not None and len(blocks) != len(chance)):
        given = "none" if blocks is None else len(blocks)
        message = f"p_false has shape {chance.shape}, is_false {false.shape}, blocks {given}: one of each for an answer"
        raise ConfigError(message)
    if not ((chance >= 0) & (chance <= 1)).all():
        message = "p_false holds numbers that are no probabilities: give 1 where there is none"
        raise ConfigError(message)
    if not (0 < alpha < 1 and 0 < delta < 1):
        message = f"alpha and delta must lie in (0, 1), got {alpha!r} and {delta!r}"
        raise ConfigError(message)
    return chance, false


def _below(chance: NDArray[np.float64], values: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the count of answers below each threshold, or the sum of their values, shape (thresholds,)."""
    above = np.searchsorted(_THRESHOLDS, chance, side="right")
    return np.cumsum(np.bincount(above, weights=values, minlength=len(_THRESHOLDS) + 1))[:-1].astype(np.float64)


def _by_block(
    chance: NDArray[np.float64], false: NDArray[np.float64], block: NDArray[np.int64], alpha: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the number of blocks that accept any answer below each threshold, and the p-value of their mean share."""
    members = [block == at for at in range(block.max(initial=-1) + 1)]
    accepted = np.array([_below(chance[own], None) for own in members]).reshape(-1, len(_THRESHOLDS))
    wrong = np.array([_below(chance[own], false[own]) for own in members]).reshape(-1, len(_THRESHOLDS))
    units = (accepted > 0).sum(axis=0).astype(np.float64)
    total = np.divide(wrong, accepted, out=np.zeros_like(wrong), where=accepted > 0).sum(axis=0)
    mean = np.minimum(total / np.maximum(units, 1.0), alpha)
    # Hoeffding's tail by relative entropy, and Bentkus' by e times a binomial one: either holds, so the less.
    entropy = special.rel_entr(mean, alpha) + special.rel_entr(1.0 - mean, 1.0 - alpha)
    tail = math.e * stats.binom.cdf(np.ceil(total - 1e-9), units, alpha)
    return units, np.minimum(np.exp(-units * entropy), tail)


def _last_that_holds(holds: NDArray[np.bool_]) -> int | None:
    """Return the farthest threshold reached from one of the starts without a failure on the way."""
    failed = np.flatnonzero(~holds)
    begun = [int(np.searchsorted(_THRESHOLDS, start)) for start in _STARTS]
    ends = [int(failed[failed >= start].min(initial=len(holds))) - 1 for start in begun if holds[start]]
    return max(ends, default=None)
