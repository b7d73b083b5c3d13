# SPDX-License-Identifier: Apache-2.0
"""Rows of `leaderboard.parquet`: one metric of one matcher on one set of queries."""

import math
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final, NamedTuple, Self, TypeVar

import pandas as pd

from sasgeo_bench.core.plugins import YARDSTICK
from sasgeo_bench.scoring.frames import (
    MATCHER,
    PRIOR_GROUP,
    REJECTOR,
    TRACK,
    Column,
    Schema,
    Shown,
    row_columns,
)
from sasgeo_bench.scoring.intervals import BoardInterval
from sasgeo_bench.scoring.metric import Metric
from sasgeo_bench.scoring.score import MISSING

ALL_SUITES: Final = "all suites"
AS_SUBMITTED: Final = "as submitted"  # source of the answers: their author,
RUN_HERE: Final = "run here"  # our run of the code, on queries of a public seed only,
PACKED: Final = "answers came packed"  # in an archive beside a pipeline file: not asked for here,
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

    The rejector is "" for metrics that take every answer.
    """

    matcher: Annotated[str, MATCHER]
    rejector: Annotated[str, REJECTOR] = ""
    suite: Annotated[str, Shown("What is done to a view or a map")]
    track: Annotated[str, TRACK]
    prior_group: Annotated[str, PRIOR_GROUP]
    stratum: Annotated[
        str,
        Shown(
            "Which of the suite's queries: a role, a kind of stress, one of its steps at one size of view, or a bin "
            "of what was measured at the truth",
            "part",
        ),
    ]
    n: Annotated[
        int,
        Shown(
            "Queries, or flights, in the denominator. Rows with different n do not compare: they are of different ones"
        ),
    ]
    answered: Annotated[int, "Queries with an answer"]
    missing: Annotated[int, Shown("Queries without a row; they count as misses")]
    blocks: Annotated[
        int,
        Shown(
            "Pieces of ground of about 1 km that the queries come from, and in how many places: intervals resample "
            "places, then blocks in them"
        ),
    ]
    places: Annotated[int, "Places of the queries"]

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
    """One metric of one matcher; its definition is in `metrics.METRICS`."""

    metric: Annotated[str, "Name of the metric"]
    unit: Annotated[str, "Its unit; 1 for none"]
    better: Annotated[str, "Which values are better: higher or lower ones"]
    value: Annotated[float, "The value; NaN if missing"]
    lo: Annotated[float, "Lower end of its 95 % interval by places; NaN if missing"] = math.nan
    hi: Annotated[float, "Upper end of that"] = math.nan
    lo_blocks: Annotated[
        float, "Lower end of its interval by blocks: of the places that were asked, rather than of places like them"
    ] = math.nan
    hi_blocks: Annotated[float, "Upper end of that"] = math.nan
    interval: Annotated[
        str,
        'What lies farthest out: "places" (bootstrap over places, then blocks, then sites), "blocks" (over blocks, '
        'then sites: few places), "wilson" (Wilson\'s over sites: few sites, or nothing varies), or ""',
    ] = ""
    is_applicable: Annotated[bool, "False if the matcher's card excludes the task; then there is no value"] = True
    rank_best: Annotated[
        int | None, "Best rank it can have; missing of who is not ranked, and with fewer than `LEAST_PLACES` places"
    ] = None
    rank_worst: Annotated[int | None, "Worst rank it can have"] = None
    detectable: Annotated[
        float,
        Shown(
            "Smallest difference from the best other matcher that so many places can show (5 %, power 80 %); inf if "
            "none, - where no entry is ranked"
        ),
    ] = math.nan


FIGURE_SCHEMA: Final = Schema("leaderboard", row_columns(Row))


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


def base_name(matcher: str) -> str:
    """Return the name of an entry without the version and hash that tell it from another of its name.

    >>> base_name("random 1 (c85212)"), base_name("random")
    ('random', 'random')
    """
    return matcher.partition(" ")[0]


def is_unranked(matcher: str) -> bool:
    """Return True for a control of any version.

    >>> is_unranked("oracle_pose 1 (c85212)"), is_unranked("raster_uniform")
    (True, False)
    """
    name = base_name(matcher)
    return name in UNRANKED or name.startswith(YARDSTICK)


def bare(value: float) -> BoardInterval:
    """Return a value without an interval."""
    return BoardInterval(value=value)


@dataclass(frozen=True, slots=True)
class EntryLabel:
    """Shared fields of an entry's rows; `set_apart` is None if it is ranked."""

    version: Annotated[str, "Version of the matcher"]
    hash: Annotated[str, "Hash of its code and settings; missing of a file of answers"]
    how: Annotated[str, "Where the answers come from"]
    set_apart: Annotated[str | None, "Why it is excluded from ranks; missing if it is not"] = None


LEADERBOARD_SCHEMA: Final = Schema(
    FIGURE_SCHEMA.name,
    (
        FIGURE_SCHEMA["matcher"],
        *row_columns(EntryLabel)[:3],
        Column("is_control", bool, "It is a reference for reading the figures, and has no rank"),
        *row_columns(EntryLabel)[3:],
        *FIGURE_SCHEMA.columns[1:],
    ),
    needed=FIGURE_SCHEMA.names,
    is_required=True,
)


def with_entry_labels(board: pd.DataFrame, contestants: Mapping[str, EntryLabel]) -> pd.DataFrame:
    """Return figures with the labels of their matchers, as the columns of `LEADERBOARD_SCHEMA`."""
    labels = [contestants[matcher] for matcher in board["matcher"]]
    texts = {
        name: pd.Series([getattr(label, name) or None for label in labels], index=board.index)
        for name in ("version", "hash", "how")
    }
    is_control = board["matcher"].map(is_unranked).astype(bool)
    set_apart = pd.Series([label.set_apart for label in labels], index=board.index, dtype=object)
    return board.assign(**texts, is_control=is_control, set_apart=set_apart)[list(LEADERBOARD_SCHEMA.names)]


def is_set_apart(board: pd.DataFrame) -> "pd.Series[bool]":
    """Return a mask of the rows that are excluded from ranks; all False if the table has no such column.

    >>> is_set_apart(pd.DataFrame({"matcher": ["mine"], "set_apart": ["trained on vaduz"]})).tolist()
    [True]
    """
    if "set_apart" not in board:
        return pd.Series(data=False, index=board.index)
    return board["set_apart"].notna()
