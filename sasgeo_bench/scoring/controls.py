# SPDX-License-Identifier: Apache-2.0
"""Controls of a board, compared with what is known about them in advance; falsifiers of registered contrasts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
import pandas as pd

from sasgeo_bench.core.errors import counted
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA, LEAST_PLACES, Finding
from sasgeo_bench.scoring.contrasts import PRIMARY, Contrast, both_on, mean_finding
from sasgeo_bench.scoring.frames import MATCHER, Column, Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.scoring.metrics import is_present, primary_of
from sasgeo_bench.scoring.rows import UNRANKED, base_name
from sasgeo_bench.scoring.score import FIX_M, MISSING, NOT_APPLICABLE
from sasgeo_bench.tasks.query import BLIND, CONTROLS, NOISE_FREE, SHUFFLED, TURNED, TWINS, PriorGroup

ORACLE: Final = "oracle_pose"
REFERENCE: Final = "fft_vote"  # the simplest search: it must find a view without error
ALPHA: Final = 1e-4  # level of each test against chance; a board has dozens
NEARLY_ALL: Final = 0.9
_AT_CHANCE: Final = {
    SHUFFLED: "shuffled map at chance",
    TURNED: "turned map at chance",
    TWINS: "identical twins tie",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Result of one control, as "shuffled map at chance", for one matcher on n queries."""

    control: Annotated[str, Shown("Queries whose right score is known beforehand", "control query")]
    matcher: Annotated[str, MATCHER]
    n: Annotated[int, "Its queries"]
    found: Annotated[
        float, Shown("How many were right, or were answered where none must be")
    ]  # a tie counts by its chance
    expected: Annotated[float, Shown("How many are right by guessing, or how many there must be")]
    p: Annotated[
        float, Shown("Chance of finding as many or more by guessing; a control fails below 0.0001")
    ]  # NaN without a test
    holds: Annotated[
        bool,
        Shown(
            "held, or FAILED: then do not trust the rows of the matcher, nor the board if it is itself a control",
            "outcome",
        ),
    ]

    @property
    def is_of_board(self) -> bool:
        """Return True if a failure is the board's fault: a rival's failure is that of its own rows.

        >>> names = ("random 1 (c85212)", "fft_vote", "oracle_of_mine")
        >>> same = {"control": "c", "n": 1, "found": 1.0, "expected": 0.0, "p": 0.0, "holds": False}
        >>> [Verdict(matcher=name, **same).is_of_board for name in names]
        [True, True, False]
        """
        return base_name(self.matcher) in {ORACLE, REFERENCE, *UNRANKED}

    @property
    def fails_at(self) -> int | None:
        """Return how many right answers fail the control; None where even all of them would not, for want of queries.

        Of controls against chance; where the trials differ in their chance, no fewer than this fail it.

        >>> coins = {"control": "identical twins tie", "matcher": "m", "found": 3.0, "p": 0.66, "holds": True}
        >>> [Verdict(n=n, expected=n / 2, **coins).fails_at for n in (6, 14, 60)]
        [None, 14, 45]
        """
        ways = _ways(np.full(self.n, self.expected / self.n))
        rare = np.flatnonzero(np.cumsum(ways[::-1])[::-1] < ALPHA)
        return int(rare[0]) if len(rare) else None

    @property
    def can_fail(self) -> bool:
        """Return False for a test against chance of so few queries that no answers could fail it."""
        return math.isnan(self.p) or self.fails_at is not None

    def to_text(self) -> str:
        """Return the result in one line.

        >>> Verdict(control="blind views withheld", matcher="m", n=4, found=4.0, expected=0.0, p=math.nan, holds=False
        ... ).to_text()
        'blind views withheld: FAILED by m, 4 of 4 where 0 are expected'
        """
        word = "held" if self.holds else "FAILED"
        chance = "" if math.isnan(self.p) else f" (p {self.p:.2g})"
        figures = f"{self.found:g} of {self.n} where {self.expected:.3g} are expected{chance}"
        return f"{self.control}: {word} by {self.matcher}, {figures}"


CONTROL_SCHEMA: Final = Schema("controls", row_columns(Verdict))


def is_control(scores: pd.DataFrame) -> Bools:
    """Return a mask of the scored rows in the suite of controls."""
    return (scores["suite"] == CONTROLS).to_numpy(bool)


def evaluate_controls(scored: Mapping[str, pd.DataFrame]) -> tuple[Verdict, ...]:
    """Check every control of each matcher that answered it.

    `scored` holds all scored rows by matcher, including the suite `controls`.
    """
    verdicts: list[Verdict] = []
    for matcher, frame in scored.items():
        asked = frame[~frame["status"].isin((MISSING, NOT_APPLICABLE))]
        name = base_name(matcher)
        if name == ORACLE:
            verdicts += _perfect(matcher, asked)
            continue
        controls = asked[is_control(asked)]
        verdicts += _by_chance(matcher, controls)
        verdicts += _withheld(matcher, controls)
        if name == REFERENCE:
            verdicts += _nearly_all(matcher, controls)
    return tuple(sorted(verdicts, key=lambda item: (item.holds, item.control, item.matcher)))


def failed_controls(verdicts: Sequence[Verdict], matcher: str) -> tuple[Verdict, ...]:
    """Return the controls that an entry failed, of those that speak of its rows alone."""
    return tuple(item for item in verdicts if item.matcher == matcher and not (item.holds or item.is_of_board))


def reason_implausible(verdicts: Sequence[Verdict], matcher: str) -> str | None:
    """Return why the answers of an entry cannot come from the view and the map alone; None if they can.

    >>> one = Verdict(control=_AT_CHANCE[TWINS], matcher="mine", n=24, found=24.0, expected=12.0, p=6e-8, holds=False)
    >>> reason_implausible([one], "mine")
    'right 24 of 24 times at the control "identical twins tie", where guessing is right 12 times'
    """
    for item in failed_controls(verdicts, matcher):
        if item.control in _AT_CHANCE.values():
            guessed = f"where guessing is right {item.expected:.3g} times"
            return f'right {item.found:g} of {item.n} times at the control "{item.control}", {guessed}'
    return None


def hits(scores: pd.DataFrame) -> Floats:
    """Return the primary metric of each row, shape (N,): 1 if right, the chance of a tie."""
    parts = [
        pd.Series(primary_of(str(track)).values(part), index=part.index) for track, part in scores.groupby("track")
    ]
    joined = pd.concat(parts).reindex(scores.index) if parts else pd.Series(dtype=float)
    return np.asarray(joined, dtype=np.float64)


def chances(scores: pd.DataFrame) -> Floats:
    """Return the chance of a blind guess in each row, shape (N,): among candidates, or within a prior's disc."""
    radii_m = [PriorGroup.parse(name).radius_m or math.inf for name in scores["prior_group"]]
    discs = np.minimum(1.0, (FIX_M / np.array(radii_m, dtype=float)) ** 2)
    pools = scores["pool"].to_numpy(float)
    is_retrieval = (scores["track"] == "retrieval").to_numpy(bool)
    return np.asarray(np.where(is_retrieval, 1 / np.maximum(pools, 1), discs), dtype=np.float64)


def at_least(count: float, each: Floats) -> float:
    """Return the chance of at least `count` hits in independent trials of chance `each` (Poisson binomial).

    >>> at_least(2, np.array([0.5, 0.5]))
    0.25
    """
    return float(min(1.0, _ways(each)[math.ceil(count - 1e-9) :].sum()))


def _ways(each: Floats) -> Floats:
    """Return the chance of every number of hits, shape (N + 1,), in N independent trials of chance `each`."""
    ways = np.ones(1)
    for chance in each:
        ways = np.convolve(ways, (1 - chance, chance))
    return ways


def _by_chance(matcher: str, controls: pd.DataFrame) -> Iterator[Verdict]:
    """Check that no matcher beats chance where the map holds no information: it would come from elsewhere."""
    for kind, name in _AT_CHANCE.items():
        mine = controls[controls["kind"] == kind]
        if len(mine):
            found = float(hits(mine).sum())
            each = np.full(len(mine), 0.5) if kind == TWINS else chances(mine)
            p = at_least(found, each)
            yield _verdict(name, matcher, len(mine), found, float(each.sum()), holds=p >= ALPHA, p=p)


def _withheld(matcher: str, controls: pd.DataFrame) -> Iterator[Verdict]:
    """Check that a matcher gives no answer to an empty view."""
    blind = controls[controls["kind"] == BLIND]
    if len(blind):
        yield _exact("blind views withheld", matcher, len(blind), float(blind["is_answered"].sum()), 0.0)


def _nearly_all(matcher: str, controls: pd.DataFrame) -> Iterator[Verdict]:
    """Check that views without error are found; otherwise the search, the map or the truth is at fault."""
    clear = controls[controls["kind"] == NOISE_FREE]
    if len(clear):
        found, least = float(hits(clear).sum()), NEARLY_ALL * len(clear)
        name = "views without error found, at least"
        yield _verdict(name, matcher, len(clear), found, least, holds=found >= least)


def _perfect(matcher: str, asked: pd.DataFrame) -> Iterator[Verdict]:
    """Check that the oracle is always right and withholds absent places; otherwise scorer or truth is at fault."""
    present, absent = asked[is_present(asked)], asked[~is_present(asked)]
    if len(present):
        yield _exact("oracle always right", matcher, len(present), float(hits(present).sum()), float(len(present)))
    if len(absent):
        yield _exact("oracle withholds absent places", matcher, len(absent), float(absent["is_answered"].sum()), 0.0)


def _exact(control: str, matcher: str, n: int, found: float, expected: float) -> Verdict:
    return _verdict(control, matcher, n, found, expected, holds=found == expected)


def _verdict(
    control: str, matcher: str, n: int, found: float, expected: float, *, holds: bool, p: float = math.nan
) -> Verdict:
    return Verdict(control=control, matcher=matcher, n=n, found=found, expected=expected, p=p, holds=holds)


EVERY: Final = "all"  # suites, or kinds


@dataclass(frozen=True, slots=True, kw_only=True)
class Falsifier:
    """Result of a contrast on queries where its methods should not differ.

    The finding's p-values are not adjusted, since this is not part of the registered test.
    """

    contrast: Annotated[str, "Name of the contrast"]
    suite: Annotated[str, 'One suite, or "all" together']
    kind: Annotated[str, 'A kind of falsifier, or "control": the same places without stress']
    finding: Finding

    @property
    def verdict(self) -> str:
        """Return in words whether the first method gains where it should not."""
        found = self.finding
        if found.places < LEAST_PLACES:
            return f"not decided: {counted(found.places, 'place')}"
        if found.lo > 0:
            return "GAIN without the stress"
        return "loss without the stress" if found.hi < 0 else "no gain shown"


def evaluate_falsifiers(
    contrasts: Sequence[Contrast], scores: Mapping[str, pd.DataFrame], *, draws: int = DRAWS
) -> tuple[Falsifier, ...]:
    """Compare the methods of each contrast by success or recall on controls and falsifiers of its suites.

    The order is by contrast: all suites together, then suite by suite. Raise ConfigError if a contrast names a method
    that is not on the board.
    """
    means = (contrast for contrast in contrasts if contrast.metric == PRIMARY)
    return tuple(item for contrast in means for item in _of(contrast, scores, draws))


def _of(contrast: Contrast, scores: Mapping[str, pd.DataFrame], draws: int) -> Iterator[Falsifier]:
    first, second = both_on(contrast, scores, _unstressed)
    for suite, kind, rows in _parts(first):
        yield Falsifier(
            contrast=contrast.name,
            suite=suite,
            kind=kind,
            finding=mean_finding(contrast, first[rows], second[rows], draws, is_tested=False),
        )


def _parts(frame: pd.DataFrame) -> Iterator[tuple[str, str, "pd.Series[bool]"]]:
    """Yield suite, kind and row mask of each part; if there are several, all of them together come first."""
    parts = sorted(set(zip(frame["suite"], frame["kind"], strict=True)))
    if len(parts) > 1:
        yield EVERY, EVERY, frame["suite"].notna()
    for suite, kind in parts:
        yield str(suite), str(kind), (frame["suite"] == suite) & (frame["kind"] == kind)


def _unstressed(frame: pd.DataFrame) -> "pd.Series[bool]":
    """Return a mask of present places without stress; a view that is all unknown cannot be found."""
    return frame["is_present"].astype(bool) & (frame["role"] != "stress") & (frame["unknown_share"] < 1)


_CONTRAST_COLUMNS: Final = (
    *("first", "second", "first_value", "second_value", "difference", "lo", "hi", "lo_blocks", "hi_blocks"),
    *("n", "blocks", "places", "first_only", "second_only"),
)
FALSIFIER_SCHEMA: Final = Schema(
    "falsifiers",
    (
        *row_columns(Falsifier)[:3],
        *(replace(CONTRAST_SCHEMA[name], source=f"finding.{name}") for name in _CONTRAST_COLUMNS),
        Column("verdict", str, "Whether the first gains where it should not"),
    ),
)


def gains_without_stress(falsifiers: Sequence[Falsifier]) -> dict[str, bool]:
    """Return by contrast whether its first method gains where it should not: all suites of it together."""
    found: dict[str, bool] = {}
    for item in falsifiers:  # the first of a contrast is of all its suites
        found.setdefault(item.contrast, item.finding.places >= LEAST_PLACES and item.finding.lo > 0)
    return found
