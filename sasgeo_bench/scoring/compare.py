# SPDX-License-Identifier: Apache-2.0
"""Paired tests of two methods, Holm's adjustment, rank intervals, and least detectable differences."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.stats import chi2, norm, permutation_test
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests

from sasgeo_bench.core.errors import MetricError, counted
from sasgeo_bench.scoring.base import Bools, Floats, Ints, block_codes, check_column
from sasgeo_bench.scoring.decisions import Curve, Fixes
from sasgeo_bench.scoring.frames import Column, Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import LEVEL

_FLIPS: Final = 2**18  # of signs, at most: exact up to 18 places
_SWAPS: Final = 1999  # of sides at places, where each takes a sort
_NOTHING: Final = 1e-12  # a smaller difference or spread is a rounding error


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedTest:
    """Discordant queries, which only one of two methods got right, and the two-sided p-value (1 without any)."""

    first_only: int
    second_only: int
    p_value: float


def _pairs(first: ArrayLike, second: ArrayLike) -> tuple[Bools, Bools]:
    ours, theirs = check_column(first, "first"), check_column(second, "second", np.size(first))
    if not (np.isin(ours, (0, 1)).all() and np.isin(theirs, (0, 1)).all()):
        raise MetricError(
            "McNemar's test takes hits that are 0 or 1: decide ties first, as by `hits == 1`, or use the bootstrap"
        )
    return ours > 0, theirs > 0


def mcnemar_exact(first: ArrayLike, second: ArrayLike) -> PairedTest:
    """Test by McNemar's exact test whether two methods are right equally often.

    The inputs are hits (0 or 1), shape (N,), in the same order of queries. The p-value is that of a fair coin tossed
    once per discordant query. Raise MetricError if a value is neither 0 nor 1, or the numbers differ.

    The test assumes independent queries, which those of one block are not: compare `mcnemar_clustered`.

    Six discordant queries, all for the first: 2 / 2^6.

    >>> mcnemar_exact([1, 1, 1, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0])
    PairedTest(first_only=6, second_only=0, p_value=0.03125)
    """
    ours, theirs = _pairs(first, second)
    gained, lost = int((ours & ~theirs).sum()), int((~ours & theirs).sum())
    table = [[int((ours & theirs).sum()), gained], [lost, int((~ours & ~theirs).sum())]]
    p_value = float(mcnemar(table, exact=True).pvalue) if gained + lost else 1.0
    return PairedTest(first_only=gained, second_only=lost, p_value=min(p_value, 1.0))


def mcnemar_clustered(first: ArrayLike, second: ArrayLike, blocks: Sequence[str]) -> PairedTest:
    """Test by McNemar's test for clustered queries whether two methods are right equally often.

    The inputs are as for `mcnemar_exact`, with the block of each query. The p-value is NaN for fewer than two blocks.
    Raise MetricError if a value is neither 0 nor 1, or the numbers differ.

    Obuchowski, Statistics in Medicine 17 (1998): with d_k = first only less second only in block k of K, the statistic
    (K - 1) / K (sum d_k)^2 / sum d_k^2 is chi-squared with one degree of freedom. It tests the difference of the means
    over all queries, which boards print; Durkalski et al. (2003) give each block the same weight instead. With one
    query per block it is McNemar's test without correction, times (K - 1) / K.

    Blocks differ by 2, 2 and 2, so the statistic is (2/3) 6^2 / 12 = 2:

    >>> found = mcnemar_clustered([1] * 6, [0] * 6, ["a", "a", "b", "b", "c", "c"])
    >>> round(found.p_value, 4)
    0.1573
    """
    ours, theirs = _pairs(first, second)
    _, code = block_codes(blocks, len(ours))
    each = np.bincount(code, weights=ours.astype(float) - theirs, minlength=1)
    count = len(each)
    squared = float((each**2).sum())
    if count < 2:  # one block cannot differ from itself
        p_value = math.nan
    else:
        statistic = (count - 1) / count * float(each.sum()) ** 2 / squared if squared > 0 else 0.0
        p_value = float(chi2.sf(statistic, 1))
    gained, lost = int((ours & ~theirs).sum()), int((~ours & theirs).sum())
    return PairedTest(first_only=gained, second_only=lost, p_value=p_value)


def sign_flip(sums: Floats) -> float:
    """Return the two-sided p-value of the sign-flip test over places; NaN for fewer than two.

    `sums`, shape (K,), are the sums of the differences of two methods in each place. If the methods are equally good,
    either could have had the other's answers in all of a place, so each sum could as well have the other sign. The
    p-value is the share of all 2^K choices of signs, or of 2^18 random ones, whose sum is as far from 0.

    Fisher, The Design of Experiments, 1935; as a test over clusters Canay, Romano and Shaikh, Econometrica 2017.

    Six places that all favour the first:

    >>> sign_flip(np.array([1.0, 2.0, 1.0, 3.0, 1.0, 1.0]))  # 2 / 2^6
    0.03125
    """
    if len(sums) < 2:  # one place cannot differ from itself
        return math.nan
    if not sums.any():
        return 1.0
    found = permutation_test(
        (sums,),
        lambda values, axis: values.sum(axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=_FLIPS,
        batch=2**14,
        rng=np.random.default_rng(0),
    )
    return min(float(found.pvalue), 1.0)


def swap_places(first: Fixes, second: Fixes, place: Ints, name: str) -> float:
    """Return the p-value of swapping two sides at random places, for an area, which is no sum over places.

    `first` and `second` are answers to the same N queries, `place` the number of the place of each, shape (N,), `name`
    the area. As `sign_flip`, but with all of a place swapped; NaN for fewer than two places, and where the area is not
    defined. Confidences become ranks among the side's own answers, so that both sides share one scale; this changes no
    area.
    """
    count = int(place.max(initial=-1)) + 1
    if count < 2:  # one place cannot differ from itself
        return math.nan
    curve = Curve.of(_stacked(first, second), is_merged=True)
    cells = (np.ones(2 * len(place)), (np.concatenate((place, count + place)), np.arange(2 * len(place))))
    masses = (csr_array(cells, shape=(2 * count, 2 * len(place))) @ curve.sides).toarray()  # of each side at each place
    swapped = np.random.default_rng(0).random((_SWAPS, count)) < 0.5  # a fair coin
    swapped = np.vstack((np.zeros(count, dtype=bool), swapped))
    gaps = np.concatenate([_gaps(curve, masses, part, name) for part in np.array_split(swapped, 16)])
    if math.isnan(gaps[0]):  # as of AUROC without a false answer: no comparison holds, and p would be 0
        return math.nan
    return float((np.abs(gaps) >= abs(gaps[0]) - _NOTHING).mean())


def _gaps(curve: Curve, masses: Floats, swapped: Bools, name: str) -> Floats:
    """Return an area of the first side less that of the second, shape (D,), with the sides of some places swapped."""
    ours, theirs = (
        getattr(curve.areas(np.hstack(which).astype(float) @ masses), name)
        for which in ((~swapped, swapped), (swapped, ~swapped))
    )
    return np.asarray(ours - theirs)


def _stacked(first: Fixes, second: Fixes) -> Fixes:
    """Return the answers of both sides one after the other, with ranks for confidences."""
    ranks = []
    for answers in (first, second):
        sizes = np.bincount(answers.tie, minlength=len(answers.steps) + 1)
        middle = np.cumsum(sizes) - sizes / 2
        ranks.append(np.where(np.isnan(answers.confidence), np.nan, -middle[answers.tie]))
    return Fixes(
        confidence=np.concatenate(ranks),
        is_answered=np.concatenate((first.is_answered, second.is_answered)),
        is_right=np.concatenate((first.is_right, second.is_right)),
        is_present=np.concatenate((first.is_present, second.is_present)),
    )


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Return p-values adjusted for the number of registered contrasts (Holm, Scandinavian Journal of Statistics 1979).

    A contrast holds at level a if its adjusted value is at most a. Pass every registered contrast and no others. Raise
    MetricError if a value lies outside [0, 1] or is NaN: a contrast without a test has p = 1.

    >>> {name: round(value, 3) for name, value in holm({"graph": 0.01, "stability": 0.04, "unknown": 0.03}).items()}
    {'graph': 0.03, 'stability': 0.06, 'unknown': 0.06}
    """
    wrong = next((name for name, value in p_values.items() if not 0 <= value <= 1), None)
    if wrong is not None:
        raise MetricError(f"p-value of {wrong!r} is {p_values[wrong]!r}, expected 0..1; an untested contrast has 1")
    adjusted = multipletests(list(p_values.values()), method="holm")[1] if p_values else ()
    return dict(zip(p_values, map(float, adjusted), strict=True))


def distinguishable(values: ArrayLike, draws: ArrayLike, *, better: Literal["higher", "lower"]) -> Bools:
    """Return which method is better than which, shape (M, M), at a level of 95 % for all pairs at once.

    An element is True where the method of the row is better than that of the column and the difference is significant.
    `values`, shape (M,), is the metric of each method, `draws`, shape (D, M), the same in D paired draws. Raise
    MetricError if shapes do not fit, or a number is not finite.

    A difference counts where it exceeds c standard deviations of its draws. c is the 95 % quantile, over draws, of the
    largest |draw - difference| / deviation of any pair (Romano and Wolf, Econometrica 2005; for ranks Mogstad et al.,
    Review of Economic Studies 2024).

    >>> chance = np.random.default_rng(1).normal(0.0, 0.01, (1000, 2))
    >>> distinguishable([0.5, 0.9], chance + [0.5, 0.9], better="higher").tolist()
    [[False, False], [True, False]]
    """
    figures, table = np.asarray(values, dtype=np.float64), np.asarray(draws, dtype=np.float64)
    if figures.ndim != 1 or table.ndim != 2 or table.shape[1:] != figures.shape or not len(table):
        raise MetricError(f"values have shape {figures.shape} and draws {table.shape}, expected (M,) and (D, M)")
    table = table[~np.isnan(table).any(axis=1)]
    if not (np.isfinite(figures).all() and np.isfinite(table).all() and len(table)):
        raise MetricError("a figure or a draw is not finite: ranks are for figures that every method has")
    sign = 1.0 if better == "higher" else -1.0
    found = np.zeros((len(figures), len(figures)), dtype=bool)
    rows, cols = np.triu_indices(len(figures), 1)
    if not len(rows):
        return found
    gaps = sign * (figures[rows] - figures[cols])
    lo, hi = _bounds(sign * (table[:, rows] - table[:, cols]), gaps)
    found[rows, cols], found[cols, rows] = lo > _NOTHING, hi < -_NOTHING
    return found


def _bounds(draws: Floats, gaps: Floats) -> tuple[Floats, Floats]:
    """Return simultaneous intervals of P differences, shape (P,) each, from draws of shape (D, P)."""
    spread = draws.std(axis=0)
    varies = spread > _NOTHING
    if not varies.any():
        return gaps, gaps
    largest = (np.abs(draws[:, varies] - gaps[varies]) / spread[varies]).max(axis=1)
    reach = float(np.quantile(largest, LEVEL, method="inverted_cdf")) * np.where(varies, spread, 0.0)
    return gaps - reach, gaps + reach


@dataclass(frozen=True, slots=True, kw_only=True)
class RankInterval:
    """Best and worst rank a method can have; 1 is best."""

    best: int
    worst: int

    @property
    def text(self) -> str:
        """Return the interval as a table prints it: "2" or "2-4"."""
        return str(self.best) if self.best == self.worst else f"{self.best}-{self.worst}"


def rank_intervals(is_better: ArrayLike) -> tuple[RankInterval, ...]:
    """Return the rank interval of each method from the table of `distinguishable`, shape (M, M).

    The best rank is one more than the number of better methods; the worst leaves room for all known to be worse. Raise
    MetricError if the table is not square, or two methods are better than each other.

    The first beats the third, nothing else is certain:

    >>> [rank.text for rank in rank_intervals([[0, 0, 1], [0, 0, 0], [0, 0, 0]])]
    ['1-2', '1-3', '2-3']
    """
    table = np.asarray(is_better, dtype=bool)
    if table.ndim != 2 or table.shape[0] != table.shape[1] or (table & table.T).any():  # a table
        raise MetricError(
            f"is_better has shape {table.shape}, expected (M, M) with no two methods better than each other"
        )
    above, below = table.sum(axis=0), table.sum(axis=1)
    return tuple(
        RankInterval(best=1 + int(up), worst=len(table) - int(down)) for up, down in zip(above, below, strict=True)
    )


_Z_POWER: Final = float(norm.ppf(0.8))  # the deviate of a power of 80 %


def intraclass_correlation(values: ArrayLike, blocks: Sequence[str] | Ints) -> float:
    """Return how much more alike values of one block are than values of different blocks, at most 1.

    Negative where values of a block are less alike than chance. NaN for fewer than two blocks, without a block of two
    queries, or where nothing varies. For two methods, pass the difference of their hits per query. Raise MetricError if
    a value is not finite.

    The analysis-of-variance estimator for blocks of unequal size (Donner, International Statistical Review 1986):
    (B - W) / (B + (n0 - 1) W), with B and W the mean squares between and within K blocks and
    n0 = (N - sum n_k^2 / N) / (K - 1).

    >>> intraclass_correlation([1.0, 1.0, 0.0, 0.0], ["a", "a", "b", "b"])
    1.0
    """
    column = check_column(values, "values")
    if not np.isfinite(column).all():
        raise MetricError("values holds infinity: correlate hits or differences of hits")
    sizes, code = block_codes(blocks, len(column))
    count, total = len(sizes), len(column)
    if count < 2 or total == count:  # nothing within or nothing between
        return math.nan
    means = np.bincount(code, weights=column) / sizes
    between = float((sizes * (means - column.mean()) ** 2).sum()) / (count - 1)
    within = float(((column - means[code]) ** 2).sum()) / (total - count)
    size = (total - float((sizes**2).sum()) / total) / (count - 1)
    spread = between + (size - 1) * within
    return (between - within) / spread if spread > _NOTHING else math.nan


def design_effect(sizes: ArrayLike, correlation: float) -> float:
    """Return how many times more queries blocks need than independent ones, at least 1.

    `sizes`, shape (K,), are the queries of each block; a negative correlation counts as 0. Raise MetricError if there
    is no block, a block is empty, or the correlation exceeds 1.

    Kish 1965: 1 + (m - 1) rho, with m = sum n_k^2 / sum n_k the size of the block of a random query, which for equal
    blocks is their size.

    >>> round(design_effect([50] * 36, 0.05), 2)
    3.45
    """
    column = check_column(sizes, "sizes")
    if not len(column) or not (column >= 1).all() or not correlation <= 1:
        raise MetricError(f"expected blocks with queries in them and a correlation of at most 1, got {correlation!r}")
    size = float((column**2).sum() / column.sum())
    return 1.0 + (size - 1.0) * max(correlation, 0.0)


def detectable_difference(pairs: float, discordant_share: float, *, level: float = 0.05) -> float:
    """Return the least difference of two shares that McNemar's test finds with a power of 80 %.

    `pairs` are independent pairs: queries divided by the design effect. `discordant_share`, in [0, 1], is the share of
    queries that just one of the two methods gets right; the result is infinite if even that difference would be missed.
    The test is two-sided at `level`; among m contrasts Holm's adjustment asks for 0.05 / m of the first. Raise
    MetricError if a number is out of range.

    Connor, Biometrics 1987: n = (z_a sqrt(p) + z_b sqrt(p - d^2))^2 / d^2, solved for the difference d:
    d = sqrt(p) (z_a sqrt(n) + z_b sqrt(n + z_b^2 - z_a^2)) / (n + z_b^2).

    >>> round(detectable_difference(521, 0.06), 4)
    0.03
    """
    if not pairs >= 0 or not 0 <= discordant_share <= 1:
        raise MetricError(
            f"expected pairs >= 0 and a discordant share in [0, 1], got {pairs!r} and {discordant_share!r}"
        )
    z_level = float(norm.isf(level / 2))
    # Even if all discordant pairs point one way, d = p: n p^2 must reach (z_a sqrt(p) + z_b sqrt(p - p^2))^2.
    least = z_level + _Z_POWER * math.sqrt(1.0 - discordant_share)
    if pairs * discordant_share < least**2:
        return math.inf
    root = z_level * math.sqrt(pairs) + _Z_POWER * math.sqrt(pairs + _Z_POWER**2 - z_level**2)
    return math.sqrt(discordant_share) * root / (pairs + _Z_POWER**2)


def detectable_mean(pairs: float, spread: float, *, level: float = 0.05) -> float:
    """Return the least difference of two means that a test over pairs finds with a power of 80 %.

    `pairs` are independent pairs, as for `detectable_difference`, `spread` is the standard deviation of the difference
    of a pair. For shares of a flight, which lie between 0 and 1, where discordant queries say too little. Raise
    MetricError if a number is out of range.

    (z_a + z_b) s / sqrt(n), as in Chow, Shao, Wang and Lokhnygina, Sample Size Calculations in Clinical Research, 2018.

    >>> round(detectable_mean(35, 0.18), 3)
    0.085
    """
    if not pairs > 0 or not spread >= 0:
        raise MetricError(f"expected pairs > 0 and a spread >= 0, got {pairs!r} and {spread!r}")
    return (float(norm.isf(level / 2)) + _Z_POWER) * spread / math.sqrt(pairs)


def sensitivity(
    first: ArrayLike, second: ArrayLike, blocks: Sequence[str] | Ints, *, are_shares: bool = False
) -> float:
    """Return the minimum detectable difference of two methods on a suite; infinite if even the largest would be missed.

    `first` and `second` are hits in [0, 1], shape (N,), for the same queries, or shares of flights (`are_shares`). A
    correlation that cannot be estimated counts as 0. Raise MetricError if there is no query, or numbers differ.
    """
    ours = check_column(first, "first")
    gaps = ours - check_column(second, "second", len(ours))
    sizes, _ = block_codes(blocks, len(ours))
    if not len(sizes):
        raise MetricError("no queries, so no difference can be detected: draw some first")
    correlation = intraclass_correlation(gaps, blocks)
    effect = design_effect(sizes, 0.0 if math.isnan(correlation) else correlation)
    if are_shares:
        return detectable_mean(len(ours) / effect, float(gaps.std()))
    return detectable_difference(len(ours) / effect, float(np.abs(gaps).mean()))


ALPHA: Final = 0.05
# With fewer clusters there are no ranks and no decisions: an exact sign test cannot reach 5 %, since 2 / 2^5 > 5 %.
LEAST_PLACES: Final = 6
LEAST_BLOCKS: Final = LEAST_PLACES  # where the question is about the places that were asked, as of two seeds
ContrastMetric = Literal[
    "primary",
    "interaction",
    "shift",
    "false_accepted",
    "aurc",
    "e_aurc",
    "auroc",
    "right_at_absent_0.01",
    "right_at_absent_0.05",
]
# The sides of other metrics are "matcher x rejector".
OF_MATCHERS: Final = frozenset({"primary", "interaction", "shift", "false_accepted"})
LESS: Final = frozenset({"interaction", "shift"})  # differences of a figure and that on other views of the site
RELATIVE: Final = frozenset({"aurc", "e_aurc"})  # their least difference is a share of the second side
LOWER: Final = RELATIVE | {"false_accepted"}  # less is better
_NO_FINDING: Final = 1e-9  # a smaller excess is a rounding error
Outcome = Literal["decided", "decided, small", "cause open", "equal", "not decided", "not tested"]
BETTER: Final[frozenset[Outcome]] = frozenset({"decided", "decided, small", "cause open"})  # in which one is better


def attainable(best: float, second: float, *, is_lower_better: bool) -> float:
    """Return the most by which a best value is better than a second one: 0 if it is worse, NaN if one is not known.

    >>> attainable(0.25, 0.75, is_lower_better=True), attainable(0.25, 0.75, is_lower_better=False)
    (0.5, 0.0)
    """
    gain = second - best if is_lower_better else best - second
    return gain if math.isnan(gain) else max(0.0, gain)


def best_value(
    metric: ContrastMetric, *, ceiling: float = 1.0, control: float | None = None, false_share: float | None = None
) -> float:
    """Return the best value that a first side can have; NaN where it is not known.

    `ceiling` is the share of right answers that none can exceed. For a difference (`LESS`) it is less what the first
    side reaches on the `control`. For "aurc" the best is the area of a perfect order where a share r of many answers is
    false, r + (1 - r) ln(1 - r) (Geifman et al., ICLR 2019).

    >>> best_value("interaction", control=0.9).__round__(9), best_value("aurc", false_share=0.75).__round__(3)
    (0.1, 0.403)
    """
    if metric == "auroc":
        return 1.0
    if metric in {"e_aurc", "false_accepted"}:
        return 0.0
    if metric == "aurc":
        if false_share is None:
            return math.nan
        return false_share + (1.0 - false_share) * math.log1p(-false_share) if false_share < 1 else 1.0
    if metric in LESS:
        return math.nan if control is None else ceiling - control
    return ceiling


def unreachable(name: str, metric: ContrastMetric, *, gain: float, least: float) -> str | None:
    """Return why a contrast cannot be registered, if its least difference exceeds what can be gained, and the mend.

    >>> unreachable("graph", "primary", gain=0.3, least=0.5)
    "contrast 'graph' cannot be reached: at most 0.300 can be gained, and 0.500 is to matter: lower min_effect"
    """
    if not least > gain + _NO_FINDING:  # false where the gain is not known
        return None
    more = {
        "aurc": ', or take metric = "e_aurc"',
        "interaction": " (second of its pilot is a difference, the share under stress less that on the controls)",
        "shift": " (second of its pilot is a difference, the share with its detector less that with `published`)",
    }.get(metric, "")
    return (
        f"contrast {name!r} cannot be reached: at most {gain:.3f} can be gained, and {least:.3f} is to matter: lower "
        f"min_effect{more}"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of a contrast."""

    name: Annotated[str, Shown("Pair of entries that was registered before anything was run", "contrast")]
    first: Annotated[str, Shown("First entry of the pair, and what it reaches")]
    second: Annotated[str, Shown("Second entry of the pair, and what it reaches")]
    metric: Annotated[str, "What is compared"]
    n: Annotated[int, "Queries"] = 0
    blocks: Annotated[int, "Their blocks"] = 0
    places: Annotated[
        int, "Their places, the unit of intervals and tests; fewer than `LEAST_PLACES` decide nothing"
    ] = 0
    countries: Annotated[int, "Their countries"] = 0
    first_value: Annotated[float, "The metric of the first side"] = math.nan
    second_value: Annotated[float, "The metric of the second side"] = math.nan
    best: Annotated[
        float,
        "The best value that the first side could have on these queries: the mean ceiling, or that of a perfect order",
    ] = math.nan
    difference: Annotated[float, Shown("First less second on the same queries, with its 95 % interval by places")] = (
        math.nan
    )
    lo: Annotated[float, "Lower end of its 95 % interval by places; NaN without draws"] = math.nan
    hi: Annotated[float, "Upper end of that"] = math.nan
    lo_blocks: Annotated[float, "Lower end of its interval by blocks"] = math.nan
    hi_blocks: Annotated[float, "Upper end of that"] = math.nan
    lo_countries: Annotated[float, "Lower end of its interval by countries, where the split names some"] = math.nan
    hi_countries: Annotated[float, "Upper end of that"] = math.nan
    first_only: Annotated[int, "Discordant queries: better for the first side only; 0 for areas"] = 0
    second_only: Annotated[int, "Those that are better for the second side only"] = 0
    p_exact: Annotated[
        float, "McNemar's exact test, which assumes independent queries; NaN where it does not apply"
    ] = math.nan
    p_clustered: Annotated[float, "Obuchowski's test for blocks; NaN where it does not apply"] = math.nan
    p_places: Annotated[float, "The sign-flip test over places"] = math.nan
    p_holm: Annotated[
        float,
        Shown(
            "Chance of a difference as large if there were none, by flipping the sides of whole places; adjusted by "
            "Holm for the number of registered contrasts",
            "p (Holm)",
        ),
    ] = math.nan
    detectable: Annotated[
        float, "Least difference that as many places can show; NaN for areas and for too few places"
    ] = math.nan
    least: Annotated[float, Shown("The least difference that was registered as mattering", "matters")] = math.nan
    is_lower_better: Annotated[bool, "The metric is one of which less is better"] = False
    note: Annotated[str, "Why it was not tested or decided, if a side failed or there is no query"] = ""
    gains_without_stress: Annotated[
        bool, "The first side is better without the stress, too, so the stress is not shown to be the cause"
    ] = False

    @property
    def attainable(self) -> float:
        """Return the most by which the first side could be better than the second, 0 if it could not."""
        return attainable(self.best, self.second_value, is_lower_better=self.is_lower_better)

    @property
    def gained_share(self) -> float:
        """Return the gain of the first side as a share of what it could gain; negative for a loss, NaN for none."""
        gain = -self.difference if self.is_lower_better else self.difference
        return gain / self.attainable if self.attainable > _NO_FINDING else math.nan

    @property
    def is_out_of_reach(self) -> bool:
        """Return whether the first side can gain less than was to matter; a loss can be shown all the same."""
        is_lost = self.is_shown and self.winner == self.second
        return self.least > self.attainable + _NO_FINDING and not is_lost

    @property
    def ends(self) -> tuple[float, float]:
        """Return the ends that decide: by countries where places share some and they are enough, else by places."""
        return (self.lo, self.hi) if math.isnan(self.lo_countries) else (self.lo_countries, self.hi_countries)

    @property
    def is_shown(self) -> bool:
        """Return whether a difference is shown: the interval by places leaves out 0, after Holm's adjustment, too.

        Where places share countries, and there are enough of these, the interval by countries leaves out 0, too.
        """
        lo, hi = self.ends
        return self.p_holm <= ALPHA and (lo > 0 or hi < 0)

    @property
    def winner(self) -> str:
        """Return the side with the better figure."""
        return self.first if (self.difference > 0) != self.is_lower_better else self.second

    @property
    def loser(self) -> str:
        """Return the other side."""
        return self.second if self.winner == self.first else self.first

    @property
    def outcome(self) -> Outcome:
        """Return the verdict in a word."""
        if not self.n:
            return "not decided" if self.note else "not tested"
        if self.places < LEAST_PLACES or self.is_out_of_reach:
            return "not decided"
        if self.is_shown:
            if max(map(abs, self.ends)) < self.least:
                return "decided, small"
            return "cause open" if self.gains_without_stress and self.winner == self.first else "decided"
        return "equal" if -self.least < self.ends[0] and self.ends[1] < self.least else "not decided"

    @property
    def verdict(self) -> str:
        """Return the verdict in a line.

        >>> found = Finding(name="graph", first="with", second="without", metric="primary", n=90, blocks=30, places=18,
        ...     first_value=0.7, second_value=0.6, best=1.0, difference=0.1, lo=0.02, hi=0.2, p_holm=0.01, least=0.03)
        >>> found.verdict
        'with is better; whether by as much as matters is not decided'
        >>> replace(found, gains_without_stress=True).outcome, replace(found, least=0.5).verdict
        ('cause open', 'not decided: at most 0.400 can be gained, and 0.500 was to matter')
        """
        if not self.n:
            return self.note or "not tested: no query"
        if self.places < LEAST_PLACES:
            return f"not decided: {counted(self.places, 'place')}, at least {LEAST_PLACES} are needed"
        if self.is_out_of_reach:
            return f"not decided: at most {self.attainable:.3f} can be gained, and {self.least:.3f} was to matter"
        if not self.is_shown:
            return self._unshown()
        nearest, farthest = sorted(map(abs, self.ends))
        size = "; whether by as much as matters is not decided"
        if nearest >= self.least:
            size = ", by as much as matters"
        elif farthest < self.least:
            size = ", by less than would matter"
        cause = "; cause open: it gains without the stress, too" if self.outcome == "cause open" else ""
        return f"{self.winner} is better{size}{cause}{self._reach}"

    @property
    def headline(self) -> str:
        """Return what came of a contrast with the names of both sides, without the reason where neither is better.

        >>> found = Finding(name="age", first="with", second="without", metric="primary", n=90, blocks=30, places=18,
        ...     best=1.0, second_value=0.6, difference=0.0, lo=-0.02, hi=0.02, p_holm=1.0, least=0.03)
        >>> found.headline, replace(found, hi=0.2).headline
        ('with and without are equal (within 0.03)', 'with against without: not decided')
        >>> replace(found, difference=0.1, lo=0.04, hi=0.2, p_holm=0.01).headline
        'with is better than without, by as much as matters'
        """
        if self.outcome in BETTER:
            return f"{self.winner} is better than {self.loser}" + self.verdict.removeprefix(f"{self.winner} is better")
        if self.outcome == "equal":
            return f"{self.first} and {self.second} are {self._equal}"
        return f"{self.first} against {self.second}: {self.outcome}"

    @property
    def _equal(self) -> str:
        return f"equal (within {self.least:.2g})"

    @property
    def _reach(self) -> str:
        """Return which countries a verdict is of, where they are too few to speak for others."""
        is_few = 0 < self.countries < min(self.places, LEAST_PLACES)
        return f"; of {counted(self.countries, 'country', 'countries')} alone" if is_few else ""

    def _unshown(self) -> str:
        if self.outcome == "equal":
            return f"{self._equal}: any difference is smaller than would matter{self._reach}"
        if self.p_holm <= ALPHA and (self.lo > 0 or self.hi < 0):
            return "not decided: a difference is shown by places, none by countries"
        if self.lo > 0 or self.hi < 0:
            return "not decided: no difference shown after Holm's adjustment"
        if -self.least < self.lo and self.hi < self.least:
            return "not decided: one that matters is ruled out by places, not by countries"
        return "not decided: no difference shown, and one that matters is not ruled out"


CONTRAST_SCHEMA: Final = Schema(
    "contrasts",
    (
        *row_columns(Finding),
        Column(
            "attainable",
            float,
            "The most by which the first could be better than the second: up to the ceiling of these queries, or to a "
            "perfect order",
            "attainable",
        ),
        Column("gained_share", float, "What the first gains, as a share of what it could gain; negative for a loss"),
        Column("outcome", str, "The verdict in a word"),
        Column(
            "verdict",
            str,
            "Which is better at 5 %, and whether by as much as matters; equal where a difference that matters is ruled "
            "out; cause open where the first gains without the stress, too; not decided where neither is shown, where "
            f"less can be gained than was to matter, and with fewer than {LEAST_PLACES} places",
            "verdict",
        ),
    ),
    needed=(*(column.name for column in row_columns(Finding)), "outcome", "verdict"),
)


def with_causes(findings: tuple[Finding, ...], gains: Mapping[str, bool]) -> tuple[Finding, ...]:
    """Return findings that know whether their first side gains without the stress, too, by name of the contrast."""
    return tuple(replace(item, gains_without_stress=gains.get(item.name, False)) for item in findings)
