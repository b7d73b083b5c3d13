# SPDX-License-Identifier: Apache-2.0
"""What a contrast shows, in words that follow from its figures by fixed rules; nobody writes a verdict by hand."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

from sasgeo_bench.errors import counted
from sasgeo_bench.scoring.frames import Column, Schema, Shown, row_columns

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
_NOTHING: Final = 1e-9  # a smaller excess is a rounding error
Outcome = Literal["decided", "decided, small", "cause open", "null", "not decided", "not tested"]


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

    `ceiling` is the share of right answers that nobody can exceed. For a difference (`LESS`) it is less what the first
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
    if not least > gain + _NOTHING:  # false where the gain is not known
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
        return gain / self.attainable if self.attainable > _NOTHING else math.nan

    @property
    def is_out_of_reach(self) -> bool:
        """Return whether the first side can gain less than was to matter; a loss can be shown all the same."""
        is_lost = self.is_shown and self.winner == self.second
        return self.least > self.attainable + _NOTHING and not is_lost

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
        return "null" if -self.least < self.ends[0] and self.ends[1] < self.least else "not decided"

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
    def _reach(self) -> str:
        """Return which countries a verdict is of, where they are too few to speak for others."""
        is_few = 0 < self.countries < min(self.places, LEAST_PLACES)
        return f"; of {counted(self.countries, 'country', 'countries')} alone" if is_few else ""

    def _unshown(self) -> str:
        if self.outcome == "null":
            return f"null: any difference is smaller than would matter{self._reach}"
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
            "Which is better at 5 %, and whether by as much as matters; null where a difference that matters is ruled "
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
