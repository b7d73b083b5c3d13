# SPDX-License-Identifier: Apache-2.0
"""Rows of `leaderboard.parquet`: one metric of one matcher on one set of queries."""

import math
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any, Final, NamedTuple, Self, TypeVar

import pandas as pd

from sasgeo_bench.files.plugins import YARDSTICK
from sasgeo_bench.scoring.intervals import BoardInterval
from sasgeo_bench.scoring.metric import Metric
from sasgeo_bench.scoring.score import MISSING

ALL_SUITES: Final = "all suites"
AS_SUBMITTED: Final = "as submitted"  # source of the answers: their author,
RUN_HERE: Final = "run here"  # our run of the code, on queries of a public seed only,
PACKED: Final = "answers came packed"  # in an archive beside a pipeline file: nobody here has asked for them,
REPRODUCED: Final = "reproduced"  # or of a private seed too, where it is not shown to be worse,
NOT_REPRODUCED: Final = "not reproduced"  # or is shown to be worse
UNRANKED: Final = frozenset(  # controls: not ranked
    {"random", "prior_centre", "map_density_prior", "dead_reckoning", "prior_only"}
)
_THREADS: Final = 4  # each holds some 100 MB of draws

Item = TypeVar("Item")


class GroupKey(NamedTuple):
    """Suite, track and prior group; values of two groups are never ranked against each other."""

    suite: str
    track: str
    prior_group: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RowKey:
    """Matcher, queries and counts of a row; rows of one matcher on the same queries share them.

    Parameters
    ----------
    matcher, rejector : str
        Names; the rejector is "" for metrics that take every answer.
    suite, track, prior_group, stratum : str
        Set of queries. Values of two prior groups are never ranked against each other.
    n : int
        Queries in the denominator: all that the matcher was asked.
    answered, missing : int
        Of these: with an answer, and without any row.
    blocks, places : int
        Numbers of blocks and places of the queries.
    """

    matcher: str
    rejector: str = ""
    suite: str
    track: str
    prior_group: str
    stratum: str
    n: int
    answered: int
    missing: int
    blocks: int
    places: int

    @classmethod
    def of(cls, scores: pd.DataFrame, group: GroupKey, *, matcher: str, stratum: str, rejector: str = "") -> Self:
        """Count some scored rows of a group."""
        return cls(
            **group._asdict(),
            matcher=matcher,
            stratum=stratum,
            rejector=rejector,
            n=len(scores),
            answered=int(scores["is_answered"].sum()),
            missing=int((scores["status"] == MISSING).sum()),
            blocks=int(scores["block"].nunique()),
            places=int(scores["place"].nunique()),
        )

    def row(self, metric: Metric, found: BoardInterval, **more: Any) -> "Row":  # noqa: ANN401
        """Return the row of one metric on these queries; `more` are other fields of a `Row`."""
        key = {field.name: getattr(self, field.name) for field in fields(RowKey)}
        ends = {name: getattr(found, name) for name in ("value", "lo", "hi", "lo_blocks", "hi_blocks")}
        how = "" if math.isnan(found.lo) else found.how
        return Row(**key, metric=metric.name, unit=metric.unit, better=metric.better, **ends, interval=how, **more)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row(RowKey):
    """One metric of one matcher.

    Parameters
    ----------
    metric, unit, better : str
        Definition, see `metrics.Metric`.
    value, lo, hi : float
        The value and its 95 % interval by places; NaN if missing.
    lo_blocks, hi_blocks : float
        Its interval by blocks: of the places that were asked, rather than of places like them.
    interval : str
        What lies farthest out: "places" (bootstrap over places, then blocks, then sites), "blocks" (over blocks, then
        sites: few places), "wilson" (Wilson's over sites: few sites, or nothing varies), or "".
    is_applicable : bool
        False if the matcher's card excludes the task; then there is no value.
    rank_best, rank_worst : int
        Rank interval among the ranked matchers; None for others, and with fewer than `LEAST_PLACES` places.
    detectable : float
        Least difference from the best rival that these queries can show (alpha 5 %, power 80 %); NaN without a rank.
    """

    metric: str
    unit: str
    better: str
    value: float
    lo: float = math.nan
    hi: float = math.nan
    lo_blocks: float = math.nan
    hi_blocks: float = math.nan
    interval: str = ""
    is_applicable: bool = True
    rank_best: int | None = None
    rank_worst: int | None = None
    detectable: float = math.nan


COLUMNS: Final = tuple(field.name for field in fields(Row))


def in_threads(
    make: Callable[[Item], Iterable[Row]], items: Iterable[Item], done: Callable[[], None] = lambda: None
) -> list[Row]:
    """Return the rows of all items in order, made by a few threads; call `done` in this thread after each item.

    Most of the time goes into draws and their sums, which release the interpreter lock.
    """
    rows: list[Row] = []
    with ThreadPoolExecutor(max_workers=min(_THREADS, os.cpu_count() or 1)) as pool:
        for found in pool.map(lambda item: list(make(item)), items):
            rows += found
            done()
    return rows


def name_alone(matcher: str) -> str:
    """Return the name of an entry without the version and hash that tell it from another of its name.

    >>> name_alone("random 1 (c85212)"), name_alone("random")
    ('random', 'random')
    """
    return matcher.partition(" ")[0]


def is_unranked(matcher: str) -> bool:
    """Return True for a control of any version.

    >>> is_unranked("oracle_pose 1 (c85212)"), is_unranked("raster_uniform")
    (True, False)
    """
    name = name_alone(matcher)
    return name in UNRANKED or name.startswith(YARDSTICK)


def bare(value: float) -> BoardInterval:
    """Return a value without an interval."""
    return BoardInterval(value=value)


def to_frame(rows: list[Row]) -> pd.DataFrame:
    """Return rows as a table with the columns of `Row`."""
    frame = pd.DataFrame({name: [getattr(row, name) for row in rows] for name in COLUMNS}, columns=list(COLUMNS))
    return frame.astype(dict.fromkeys(("rank_best", "rank_worst"), "Int64"))  # integers or missing


@dataclass(frozen=True, slots=True)
class EntryLabel:
    """Shared fields of an entry's rows: version, hash of code and settings ("" for a file), source of the answers.

    `set_apart` is the reason for excluding it from ranks; None if it is ranked.
    """

    version: str
    hash: str
    how: str
    set_apart: str | None = None


def with_entry_labels(board: pd.DataFrame, contestants: Mapping[str, EntryLabel]) -> pd.DataFrame:
    """Return the board with the columns version, hash, how, is_control and set_apart after the matcher.

    The hash is missing for a file, and `set_apart` for ranked entries.
    """
    board = board.copy()
    for at, name in enumerate(("version", "hash", "how")):
        board.insert(1 + at, name, [getattr(contestants[matcher], name) or None for matcher in board["matcher"]])
    board.insert(4, "is_control", board["matcher"].map(is_unranked).astype(bool))
    reasons = [contestants[matcher].set_apart for matcher in board["matcher"]]
    board.insert(5, "set_apart", pd.Series(reasons, index=board.index, dtype=object))
    return board


def is_apart(board: pd.DataFrame) -> "pd.Series[bool]":
    """Return a mask of the rows that are excluded from ranks; all False if the table has no such column.

    >>> is_apart(pd.DataFrame({"matcher": ["mine"], "set_apart": ["trained on vaduz"]})).tolist()
    [True]
    """
    if "set_apart" not in board:
        return pd.Series(data=False, index=board.index)
    return board["set_apart"].notna()
