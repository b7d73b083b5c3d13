# SPDX-License-Identifier: Apache-2.0
"""Metrics of other packages: found by name or module:NAME, and measured on scored rows."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Real
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.core.errors import MatchError, MetricError
from sasgeo_bench.core.plugins import METRICS as GROUP
from sasgeo_bench.core.plugins import check_own_name, code_of, find_inside, list_entry_points, plugin_code
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import is_line, message_of, one_line, typed
from sasgeo_bench.matching.matcher import MOST_CARD_TEXT, numbers_of
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.metric import MeanMetric, Metric
from sasgeo_bench.scoring.metrics import METRICS, TRACKS
from sasgeo_bench.scoring.rows import LEADERBOARD_SCHEMA
from sasgeo_bench.scoring.score import NOT_APPLICABLE

SHIPPED: Final[Mapping[str, Metric]] = {metric.name: metric for metric in METRICS}
COLUMNS: Final = frozenset({*LEADERBOARD_SCHEMA.names, "rank", "control"})  # of boards and their tables
_SLACK: Final = 1e-9  # of a value beside its bound


class ForeignMetric(NamedTuple):
    """A metric of another package, as it was named, and the SHA-256 of its code."""

    spec: str
    metric: MeanMetric
    sha256: str

    @property
    def code(self) -> str:
        """Return where its code is, as module:NAME."""
        return ":".join(code_of(self.spec, GROUP))


def list_metrics() -> tuple[str, ...]:
    """Return the names of all metrics: ours in the order of their table, then those of installed packages."""
    return (*SHIPPED, *(name for name in list_entry_points(GROUP) if name not in SHIPPED))


def find_metric(spec: str) -> Metric:
    """Return the metric of a name, or of "module:NAME": an instance of `MeanMetric`.

    Raise `MatchError` if there is none, with the nearest name, or it cannot be imported, is no metric, says nothing of
    itself, or has the name of another one.

    >>> find_metric("success_25m").better
    'higher'
    >>> find_metric("succes_25m")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: there is no metric 'succes_25m', did you mean 'success_25m'? (list metrics
    shows all; or module:NAME)
    """
    return SHIPPED[spec] if spec in SHIPPED else _foreign(spec)


def find_metrics(specs: Sequence[str]) -> tuple[ForeignMetric, ...]:
    """Return metrics of other packages; raise `MatchError` as `find_metric` does, for one of ours, or two of a name."""
    ours = next((spec for spec in specs if spec in SHIPPED), None)
    if ours is not None:
        raise MatchError(f"{ours} is on every board: name metrics of your own alone")
    found = [ForeignMetric(spec, _foreign(spec), plugin_code(spec, GROUP)) for spec in dict.fromkeys(specs)]
    first = {item.metric.name: item.spec for item in reversed(found)}
    twice = next((item for item in found if first[item.metric.name] != item.spec), None)
    if twice is not None:
        raise MatchError(
            f"{first[twice.metric.name]} and {twice.spec} are both named {twice.metric.name!r}: rename one"
        )
    return tuple(found)


def _foreign(spec: str) -> MeanMetric:
    found = find_inside(spec, GROUP, shipped=SHIPPED)
    if not isinstance(found, MeanMetric):
        is_function = callable(found) and not isinstance(found, type)
        what = "a function" if is_function else f"an object of type {type(found).__name__}"
        mend = f": name MeanMetric(name=..., values={spec.partition(':')[2]}, ...)" if is_function else ""
        raise MatchError(f"{spec}: {what} is no metric, which is an instance of sasgeo_bench.MeanMetric{mend}")
    try:
        check_own_name(spec, found.name, GROUP, shipped=SHIPPED)
        fault = _silence(found)
    except MatchError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001 - of whatever its fields hold
        fault = f"what it says of itself cannot be read ({message_of(error)})"
    if fault:
        raise MatchError(f"{spec}: {fault}")
    return found


def _silence(metric: MeanMetric) -> str | None:
    """Return what a metric should say of itself, and does not; None if it says all."""
    blank = next((name for name in ("meaning", "unit", "source") if not _is_line(getattr(metric, name))), None)
    is_better = isinstance(metric.better, str) and metric.better in ("higher", "lower")
    tracks = metric.tracks if isinstance(metric.tracks, tuple | list) else ()
    are_tracks = bool(tracks) and all(isinstance(track, str) and track in TRACKS for track in tracks)
    faults = {
        f"it is named {metric.name!r}, as a column of boards: rename it": metric.name in COLUMNS,
        f"its {blank} is {_shown(getattr(metric, str(blank), ''))}, expected a line of text, {MOST_CARD_TEXT} "
        "characters at most": blank is not None,
        f"better is {_shown(metric.better)}, expected 'higher' or 'lower'": not is_better,
        f"bounds are {_shown(metric.bounds)}, expected the least and the greatest value, as in "
        "(0.0, 1.0)": not _are_bounds(metric.bounds),
        f"tracks are {_shown(metric.tracks)}, expected some of {TRACKS}": not are_tracks,
        "is_primary is true, and boards rank by metrics that ship alone: leave it out": metric.is_primary,
        "read_with is no name of a metric": not isinstance(metric.read_with, str),
        "values is no function of scored rows": not callable(metric.values),
        "counts is no function of scored rows": not callable(metric.counts),
    }
    return next((fault for fault, is_there in faults.items() if is_there), None)


def _shown(value: object) -> str:
    return one_line(repr(value))


def _is_line(value: object) -> bool:
    return isinstance(value, str) and bool(value.strip()) and is_line(value, MOST_CARD_TEXT)


def _are_bounds(given: object) -> bool:
    if not isinstance(given, tuple | list) or len(given) != 2 or not all(isinstance(end, Real) for end in given):
        return False
    try:
        return float(given[0]) < float(given[1])
    except OverflowError:  # of a whole number beyond all floats
        return False


def values_of(metric: MeanMetric, scores: pd.DataFrame) -> Floats:
    """Return the value of each row by a metric of another package, shape (N,); NaN for a query that does not count.

    It is given a copy. Raise `MetricError` if it fails, or a value is no number, or out of bounds.
    """
    rows = scores.reset_index(drop=True)
    found = _asked(metric.values, rows, "values")
    counts = _asked(metric.counts, rows, "counts")
    if counts.dtype != bool:
        raise MetricError(f"its counts are of type {counts.dtype}, expected bool")
    values = np.where(counts, found.astype(float), np.nan)
    low, high = map(float, metric.bounds)
    wrong = np.isinf(values) | (values < low - _SLACK) | (values > high + _SLACK)
    if wrong.any():
        raise MetricError(
            f"it says {values[wrong][0]:g}, expected a finite number between {low:g} and {high:g}, or NaN for a query "
            "that does not count"
        )
    return np.clip(values, low, high)


def _asked(function: Callable[[pd.DataFrame], object], rows: pd.DataFrame, what: str) -> NDArray[np.generic]:
    """Return what a function of somebody's own says of each row of a copy: bools, or numbers."""
    try:
        given = function(rows.copy())
    except (Exception, SystemExit) as error:  # whatever code of somebody's own raises
        raise MetricError(f"it fails ({message_of(error)})") from error
    try:
        in_order = not isinstance(given, pd.Series) or given.index.equals(rows.index)
        found = np.asanyarray(given)
        if found.dtype.kind == "O" and found.ndim == 1:
            found = np.array([math.nan if one is pd.NA else one for one in found], dtype=object)
        numbers = numbers_of(found)
    except (Exception, SystemExit) as error:  # of a list of lists, or of an object that says it is an array
        raise MetricError(
            f"it returns {typed(given)} of no numbers as its {what}, expected one for each row of scores "
            f"({message_of(error)})"
        ) from error
    if not in_order:
        raise MetricError(f"its {what} are of other rows, or in another order, than the scores")
    if numbers.shape != (len(rows),):
        raise MetricError(f"its {what} have shape {numbers.shape}, expected ({len(rows)},): one for each row of scores")
    return numbers if found.dtype.kind == "O" else np.asarray(found)


def with_metrics(
    found: Sequence[ForeignMetric], scores: Mapping[str, pd.DataFrame]
) -> tuple[dict[str, pd.DataFrame], tuple[MeanMetric, ...]]:
    """Measure scored rows by matcher with metrics of other packages; return the rows with a column for each of them.

    The metrics that are returned read those columns, so that code that is not ours is called once, here. Raise
    `MetricError`, naming the metric, if it fails, or counts a query of one matcher and not of another.
    """
    frames = dict(scores)
    for spec, metric, _ in found:
        columns = {name: _column(metric, frame, spec=spec, matcher=name) for name, frame in scores.items()}
        fault = unequal(columns, scores)
        if fault:
            raise MetricError(f"{spec}: {fault}")
        if not any(np.isfinite(column).any() for column in columns.values()):
            tell(f"{metric.name}: no query of this board counts, so it has no figures")
        frames = {name: frame.assign(**{_key(metric): columns[name]}) for name, frame in frames.items()}
    return frames, tuple(
        replace(
            item.metric, values=partial(_read, key=_key(item.metric)), counts=partial(_is_there, key=_key(item.metric))
        )
        for item in found
    )


def _key(metric: MeanMetric) -> str:
    return f"metric {metric.name}"  # no column of scores has a space


def _read(scores: pd.DataFrame, key: str) -> Floats:
    return scores[key].to_numpy(float)


def _is_there(scores: pd.DataFrame, key: str) -> Bools:
    return scores[key].notna().to_numpy(bool)


def _column(metric: MeanMetric, frame: pd.DataFrame, *, spec: str, matcher: str) -> Floats:
    """Return the values of all rows of a matcher; NaN on other tracks, and where its card excludes the task."""
    values = np.full(len(frame), np.nan)
    is_asked = (frame["status"] != NOT_APPLICABLE).to_numpy(bool)
    for track in metric.tracks:
        mine = is_asked & (frame["track"] == track).to_numpy(bool)
        if mine.any():
            try:
                values[mine] = values_of(metric, frame[mine])
            except MetricError as error:
                raise MetricError(f"{spec}, on the answers of {matcher} ({track}): {error}") from error
    return values


def unequal(columns: Mapping[str, Floats], scores: Mapping[str, pd.DataFrame]) -> str | None:
    """Say which query counts for one matcher and not for another."""
    counted: dict[str, tuple[bool, str]] = {}
    for name, values in columns.items():
        is_asked = (scores[name]["status"] != NOT_APPLICABLE).to_numpy(bool)
        ids, counts = scores[name]["query_id"].to_numpy(object)[is_asked], ~np.isnan(values[is_asked])
        for query, does in zip(ids.tolist(), counts.tolist(), strict=True):
            before, other = counted.setdefault(query, (does, name))
            if before != does:
                first, second = (name, other) if does else (other, name)
                return (
                    f"query {query} counts for {first}, and not for {second}: what counts may depend on the query and "
                    "its truth, never on the answer, or a method could choose its queries"
                )
    return None
