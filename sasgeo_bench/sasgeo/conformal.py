# SPDX-License-Identifier: Apache-2.0
"""Thresholds with a promise: below which stated chance of a false fix the false ones among the accepted stay rare.

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
    """Largest rate that some failures in some trials do not rule out: Clopper-Pearson's upper end, one-sided.

    Parameters
    ----------
    failures, trials : float
        0 <= failures <= trials; need not be whole.
    confidence : float
        In (0, 1).

    Returns
    -------
    float
        In [0, 1]; 1 without a trial.

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
    """A threshold, and what is promised of it.

    Parameters
    ----------
    threshold : float
        Accept where the chance of a false fix is below it; 0 where none can be promised, so that nothing is accepted.
    alpha : float
        Among accepted answers like those of calibration at most this share is false,
    confidence : float
        with this confidence over calibration sets: 1 - delta.
    accepted, false : int
        Calibration answers below the threshold, and how many of them are false.
    units : int
        What the promise counts: accepted answers, or blocks that hold some.
    is_by_block : bool
        Whether it is of the mean share of a new block, each counting alike, not of a new answer.
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
        """Whether there is a threshold at all."""
        return self.threshold > 0

    def to_text(self) -> str:
        """What is promised, in a sentence."""
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
    """Largest threshold at which the share of false fixes among the accepted is promised.

    Parameters
    ----------
    p_false : array_like, shape (N,)
        Stated chance of each calibration answer to be false, by a model that was fitted on others; 1 if withheld.
    is_false : array_like of bool, shape (N,)
        Whether it was.
    alpha : float
        Share of false ones among the accepted, in (0, 1).
    delta : float
        How often calibration sets may mislead, in (0, 1).
    blocks : sequence of str, length N, optional
        Block of each answer. Answers of one block are alike, so that N of them promise less than N; with blocks the
        promise is of the mean share of false ones among the accepted of a block, over blocks that accept any.

    Returns
    -------
    RiskBound
        With threshold 0 where none can be promised.

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

    Examples
    --------
    >>> clean = risk_threshold(np.full(100, 0.003), np.zeros(100), alpha=0.05, delta=0.1)
    >>> clean.accepted, clean.is_promised
    (100, True)
    >>> risk_threshold(np.full(20, 0.003), np.zeros(20), alpha=0.05, delta=0.1).to_text()
    'none can be promised by which at most 0.05 of accepted answers are false, with confidence 0.9: too few answers,
    or too many false ones'
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
    return RiskBound(
        threshold=0.0 if at is None else float(_THRESHOLDS[at]),
        alpha=alpha,
        confidence=1.0 - delta,
        accepted=0 if at is None else int(accepted[at]),
        false=0 if at is None else int(wrong[at]),
        units=0 if at is None else int(units[at]),
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
        message = "p_false holds what is no probability: a missing one is 1, for nothing vouches for that answer"
        raise ConfigError(message)
    if not (0 < alpha < 1 and 0 < delta < 1):
        message = f"alpha and delta must lie in (0, 1), got {alpha!r} and {delta!r}"
        raise ConfigError(message)
    return chance, false


def _below(chance: NDArray[np.float64], values: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """How many answers lie below each threshold, or what their values sum to, shape (thresholds,)."""
    above = np.searchsorted(_THRESHOLDS, chance, side="right")
    return np.cumsum(np.bincount(above, weights=values, minlength=len(_THRESHOLDS) + 1))[:-1].astype(np.float64)


def _by_block(
    chance: NDArray[np.float64], false: NDArray[np.float64], block: NDArray[np.int64], alpha: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Blocks that accept any answer below each threshold, and the p-value of their mean share of false ones."""
    members = [block == at for at in range(block.max(initial=-1) + 1)]
    accepted = np.array([_below(chance[mine], None) for mine in members]).reshape(-1, len(_THRESHOLDS))
    wrong = np.array([_below(chance[mine], false[mine]) for mine in members]).reshape(-1, len(_THRESHOLDS))
    units = (accepted > 0).sum(axis=0).astype(np.float64)
    total = np.divide(wrong, accepted, out=np.zeros_like(wrong), where=accepted > 0).sum(axis=0)
    mean = np.minimum(total / np.maximum(units, 1.0), alpha)
    # Hoeffding's tail by relative entropy, and Bentkus' by e times a binomial one: either holds, so the less.
    entropy = special.rel_entr(mean, alpha) + special.rel_entr(1.0 - mean, 1.0 - alpha)
    tail = math.e * stats.binom.cdf(np.ceil(total - 1e-9), units, alpha)
    return units, np.minimum(np.exp(-units * entropy), tail)


def _last_that_holds(holds: NDArray[np.bool_]) -> int | None:
    """Farthest threshold that is reached from one of the starts with nothing failing on the way."""
    failed = np.flatnonzero(~holds)
    begun = [int(np.searchsorted(_THRESHOLDS, start)) for start in _STARTS]
    ends = [int(failed[failed >= start].min(initial=len(holds))) - 1 for start in begun if holds[start]]
    return max(ends, default=None)
