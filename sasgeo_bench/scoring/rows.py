# SPDX-License-Identifier: Apache-2.0
"""One figure of one matcher, and of which queries it is: the rows of `leaderboard.parquet`."""

import math
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any, Final, Self, TypeVar

import pandas as pd

from sasgeo_bench.scoring.intervals import Interval
from sasgeo_bench.scoring.metrics import Metric
from sasgeo_bench.scoring.score import MISSING

ALL_SUITES: Final = "all suites"
AS_SUBMITTED: Final = "as submitted"  # how answers came: their author gave them,
RUN_HERE: Final = "run here"  # or we ran the code, on queries of a public seed alone,
REPRODUCED: Final = "reproduced"  # or on a private seed too, where it is not shown to do worse,
NOT_REPRODUCED: Final = "not reproduced"  # or where it is
UNRANKED: Final = frozenset({"random", "prior_centre", "map_density_prior"})  # controls: beside the ranks
YARDSTICK: Final = "oracle_"  # how the names of yardsticks begin, which know what no matcher can: beside the ranks, too
_THREADS: Final = 4  # each holds some 100 MB of draws

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One figure of one matcher.

    Parameters
    ----------
    matcher, rejector : str
        Whose; the rejector is "" for figures that take every answer.
    suite, track, prior_group, stratum : str
        Of which queries. Figures of two prior groups are never ranked against each other.
    n : int
        Queries in the denominator; the same for every matcher.
    answered, missing : int
        Of these: with an answer, and without any row.
    blocks, places : int
        How many of each the queries come from.
    metric, unit, better : str
        Of what.
    value, lo, hi : float
        The figure and its 95 % interval; NaN where there is none.
    interval : str
        How it was found: "blocks" (bootstrap over blocks, then sites), "wilson" (Wilson's over sites lies farther out
        at one end or both: of few sites, or where nothing varies, draws say too little), or "".
    is_applicable : bool
        False where the matcher's card says it cannot; then there is no figure.
    rank_best, rank_worst : int
        Ranks it can have among the matchers that are ranked; None where it is not, and with fewer than `LEAST_BLOCKS`
        blocks.
    detectable : float
        Least difference from the best of the others that these queries would show (alpha 5 %, power 80 %); NaN where
        there is no rank.
    """

    matcher: str
    rejector: str
    suite: str
    track: str
    prior_group: str
    stratum: str
    n: int
    answered: int
    missing: int
    blocks: int
    places: int
    metric: str
    unit: str
    better: str
    value: float
    lo: float = math.nan
    hi: float = math.nan
    interval: str = ""
    is_applicable: bool = True
    rank_best: int | None = None
    rank_worst: int | None = None
    detectable: float = math.nan


COLUMNS: Final = tuple(field.name for field in fields(Row))


@dataclass(frozen=True, slots=True, kw_only=True)
class RowKey:
    """Fields that all rows about the same queries of one matcher share; see `Row`."""

    matcher: str
    suite: str
    track: str
    prior_group: str
    stratum: str
    n: int
    answered: int
    missing: int
    blocks: int
    places: int
    rejector: str = ""

    @classmethod
    def of(
        cls,
        scores: pd.DataFrame,
        *,
        matcher: str,
        suite: str,
        track: str,
        prior_group: str,
        stratum: str,
        rejector: str = "",
    ) -> Self:
        """Count some scored rows."""
        return cls(
            matcher=matcher,
            suite=suite,
            track=track,
            prior_group=prior_group,
            stratum=stratum,
            rejector=rejector,
            n=len(scores),
            answered=int(scores["is_answered"].sum()),
            missing=int((scores["status"] == MISSING).sum()),
            blocks=int(scores["block"].nunique()),
            places=int(scores["place"].nunique()),
        )

    def row(self, metric: Metric, found: Interval, how: str = "", **more: Any) -> Row:  # noqa: ANN401
        """Return the row of one metric about these queries; `more` are other fields of a `Row`."""
        key = {name: getattr(self, name) for name in self.__slots__}
        return Row(
            **key,
            metric=metric.name,
            unit=metric.unit,
            better=metric.better,
            value=found.value,
            lo=found.lo,
            hi=found.hi,
            interval="" if math.isnan(found.lo) else how,
            **more,
        )


def side_by_side(
    make: Callable[[Item], Iterable[Row]], items: Iterable[Item], done: Callable[[], None] = lambda: None
) -> list[Row]:
    """All rows of some items in their order, made by a few threads.

    Most of the time of a board goes into draws and their sums, which leave the interpreter to other threads meanwhile.
    `done` is called in this thread after each item.

    Examples
    --------
    >>> side_by_side(lambda item: [], [1, 2])
    []
    """
    rows: list[Row] = []
    with ThreadPoolExecutor(max_workers=min(_THREADS, os.cpu_count() or 1)) as pool:
        for found in pool.map(lambda item: list(make(item)), items):
            rows += found
            done()
    return rows


def name_alone(matcher: str) -> str:
    """Name of a contestant without the version and hash that it bears beside another of its name.

    Examples
    --------
    >>> name_alone("random 1 (c85212)"), name_alone("random")
    ('random', 'random')
    """
    return matcher.partition(" ")[0]


def is_unranked(matcher: str) -> bool:
    """Whether a contestant is a control, of whatever version.

    Examples
    --------
    >>> is_unranked("oracle_pose 1 (c85212)"), is_unranked("raster_uniform")
    (True, False)
    """
    name = name_alone(matcher)
    return name in UNRANKED or name.startswith(YARDSTICK)


def bare(value: float) -> Interval:
    """A figure without an interval."""
    return Interval(value=value, lo=math.nan, hi=math.nan)


def to_frame(rows: list[Row]) -> pd.DataFrame:
    """Rows as a table with the columns of `Row`.

    Examples
    --------
    >>> to_frame([]).columns[0]
    'matcher'
    """
    frame = pd.DataFrame([{name: getattr(row, name) for name in COLUMNS} for row in rows], columns=list(COLUMNS))
    return frame.astype(dict.fromkeys(("rank_best", "rank_worst"), "Int64"))  # whole numbers, and none where none is


@dataclass(frozen=True, slots=True)
class Contestant:
    """What all rows of a contestant say: version, hash of code and settings ("" for a file), how its answers came.

    `set_apart` is why it is in no rank; None where it is.
    """

    version: str
    hash: str
    how: str
    set_apart: str | None = None


def with_contestants(board: pd.DataFrame, contestants: Mapping[str, Contestant]) -> pd.DataFrame:
    """Rows that also say whose code they are of, how the answers came, and whether they are of a control or set apart.

    Parameters
    ----------
    board : pandas.DataFrame
        Columns as the fields of `Row`.
    contestants : mapping of str to Contestant
        By matcher.

    Returns
    -------
    pandas.DataFrame
        With the columns version, hash (missing for a file), how, is_control and set_apart (missing where it is not)
        behind the matcher.

    Examples
    --------
    >>> with_contestants(to_frame([]), {}).columns[:6].tolist()
    ['matcher', 'version', 'hash', 'how', 'is_control', 'set_apart']
    """
    board = board.copy()
    for at, name in enumerate(("version", "hash", "how")):
        board.insert(1 + at, name, [getattr(contestants[matcher], name) or None for matcher in board["matcher"]])
    board.insert(4, "is_control", board["matcher"].map(is_unranked).astype(bool))
    reasons = [contestants[matcher].set_apart for matcher in board["matcher"]]
    board.insert(5, "set_apart", pd.Series(reasons, index=board.index, dtype=object))
    return board


def is_apart(board: pd.DataFrame) -> "pd.Series[bool]":
    """Which rows are set apart; none of a table that does not say so.

    Examples
    --------
    >>> is_apart(pd.DataFrame({"matcher": ["mine"], "set_apart": ["trained on vaduz"]})).tolist()
    [True]
    """
    if "set_apart" not in board:
        return pd.Series(data=False, index=board.index)
    return board["set_apart"].notna()
