# SPDX-License-Identifier: Apache-2.0
"""Thresholds of P(false fix) below which false fixes stay rare, with a guarantee; horizontal protection levels.

Learn-then-Test (Angelopoulos, Bates, Candes, Jordan and Lei, 2021): thresholds are tested in an order that was fixed
beforehand, each by a p-value that holds for finite numbers of answers. The probabilities need not be calibrated.

Of the protection levels the separation leaves out one class at a time; the conformal multiple of `sigma_m` is fitted in
`scoring.protection`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # its statistics are loaded where they are used: matchers start without them
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sasgeo_bench.core.errors import ConfigError, ShapeError
from sasgeo_bench.sasgeo.integrity import Diagnostic, Modes

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
        raise ConfigError(
            f"0 <= failures <= trials and 0 < confidence < 1, got {failures!r}, {trials!r} and {confidence!r}"
        )
    return 1.0 if failures == trials else float(scipy.stats.beta.ppf(confidence, failures + 1.0, trials - failures))


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
        units, p_values = accepted, scipy.stats.binom.cdf(wrong, accepted, alpha)
    else:
        units, p_values = _by_block(
            chance, false, np.unique(np.asarray(blocks, dtype=str), return_inverse=True)[1], alpha
        )
    # Farthest threshold reached from one of the starts without a failure on the way
    holds = (p_values <= delta / len(_STARTS)) & (units > 0)
    failed = np.flatnonzero(~holds)
    begun = [int(np.searchsorted(_THRESHOLDS, start)) for start in _STARTS]
    ends = [int(failed[failed >= start].min(initial=len(holds))) - 1 for start in begun if holds[start]]
    at = max(ends, default=None)
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
        raise ConfigError(
            f"p_false has shape {chance.shape}, is_false {false.shape}, blocks {given}: one of each for an answer"
        )
    if not ((chance >= 0) & (chance <= 1)).all():
        raise ConfigError("p_false holds numbers that are no probabilities: give 1 where there is none")
    if not (0 < alpha < 1 and 0 < delta < 1):
        raise ConfigError(f"alpha and delta must lie in (0, 1), got {alpha!r} and {delta!r}")
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
    tail = math.e * scipy.stats.binom.cdf(np.ceil(total - 1e-9), units, alpha)
    return units, np.minimum(np.exp(-units * entropy), tail)


RISKS: Final = (1e-2, 1e-3)
SCALE: Final = "sigma_m"  # the diagnostic that conformal levels scale
METHODS: Final = {
    "separation": "how far the best mode moves if one class is left out, the worst of them, and what the refined "
    "position is uncertain by",
    "gauss": "the posterior taken for one Gaussian about the chosen mode: its longer axis",
    "density": "radius around the chosen mode that holds all of the posterior but the risk",
}


def level_name(method: str, risk: float) -> str:
    """Return the name of the diagnostic of a protection level, metres."""
    return f"hpl_{method}_{risk:g}_m"


PROTECTION: Final = (
    Diagnostic(SCALE, "m", "standard deviation of the posterior about the chosen mode, longer axis"),
    *(
        Diagnostic(level_name(method, risk), "m", f"protection level at a risk of {risk:g}: {meaning}")
        for method, meaning in METHODS.items()
        for risk in RISKS
    ),
)


def sigmas(risk: float) -> float:
    """Return the radius of a round Gaussian exceeded with a probability, in standard deviations: sqrt(-2 ln risk).

    Raises
    ------
    ShapeError
        If the risk is not within (0, 1).
    """
    if not 0 < risk < 1:
        raise ShapeError(f"risk must lie in (0, 1), got {risk!r}")
    return math.sqrt(-2.0 * math.log(risk))


def posterior_sigma_m(modes: Modes) -> float:
    """Return the standard deviation of the posterior about the chosen mode along its longer axis, metres.

    It is taken about the chosen mode, whose error is bounded, not about the mean. The mass of no mode being right is
    ignored.
    """
    off_m = modes.positions_m - modes.positions_m[0]
    spread = (modes.shares[:, None] * off_m).T @ off_m
    return float(np.sqrt(np.linalg.eigvalsh(spread)[-1].clip(0.0) + modes.sigma_m**2))


def gauss_level(modes: Modes, risk: float) -> float:
    """Return the protection level of the posterior as one Gaussian, metres."""
    return sigmas(risk) * posterior_sigma_m(modes)


def density_level(modes: Modes, risk: float) -> float:
    """Return the radius around the chosen mode that holds the posterior but for the risk, metres.

    Half of the risk goes to modes beyond it, half to positions within a mode. It is infinite where the mass of no mode
    being right exceeds that.
    """
    order = np.argsort(modes.away_m, kind="stable")
    beyond = 1.0 - np.cumsum(modes.masses[order])
    enough = np.flatnonzero(beyond <= risk / 2)
    if not len(enough):
        return math.inf
    return float(modes.away_m[order[enough[0]]] + sigmas(risk / 2) * modes.sigma_m)


def separation_level(modes: Modes, risk: float) -> float:
    """Return the protection level by leaving out one class at a time: shift of the best mode and some sigmas, metres.

    It is infinite where nothing can disagree: with one mode, or one class that holds all evidence.

    Notes
    -----
    After solution separation in receiver autonomous integrity monitoring (Brown and McBurney, NAVIGATION 1988; Blanch
    et al., IEEE TAES 2015), for one fault at a time: one misleading class. The best mode moves within one list, found
    with all classes, so places that only the other classes would find are missed; and the refined position is assumed
    to be as good without a class as with it.

    Examples
    --------
    Only the first class supports the first mode: without it the answer lies 50 m away.

    >>> two = Modes(
    ...     positions_m=np.array([[0.0, 0.0], [50.0, 0.0]]), by_class=np.array([[9.0, 1.0], [2.0, 3.0]]), sigma_m=2.0
    ... )
    >>> round(separation_level(two, 1e-2), 1)
    56.1
    """
    without = modes.scores[:, None] - modes.by_class
    highest = without.max(axis=0)
    near = 1e-9 * (1.0 + np.abs(modes.by_class).max())  # ties may differ by rounding
    is_mute = highest - without.min(axis=0) <= near
    if is_mute.any():
        return math.inf
    moved_m = np.where(without >= highest - near, modes.away_m[:, None], 0.0).max(initial=0.0)
    return float(moved_m + sigmas(risk) * modes.sigma_m)


def levels_of(modes: Modes) -> dict[str, float]:
    """Return the `PROTECTION` of an answer by name, metres, without infinite levels."""
    ways = {"separation": separation_level, "gauss": gauss_level, "density": density_level}
    levels = {level_name(method, risk): way(modes, risk) for method, way in ways.items() for risk in RISKS}
    found = {SCALE: posterior_sigma_m(modes), **levels}
    return {name: value for name, value in found.items() if math.isfinite(value)}
