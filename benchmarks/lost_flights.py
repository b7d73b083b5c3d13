# SPDX-License-Identifier: Apache-2.0
"""Say how far each tracker of a stored board gets before it is lost.

    .venv/bin/python benchmarks/lost_flights.py docs/results/flights --suite flight-real-age

A flight is found at its first accepted fix within 25 m. It is lost where from then on the estimate, accepted or not, is
more than 100 m off for more than 500 m of the way; what a tracker finds again later does not count. Losses are counted
over all that was flown between being found and being lost, or the end, so that flights that end before they are lost
count for what they are. Intervals (95 %) draw places. Where nobody was lost the upper end is 3 over the way flown.
"""

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sasgeo_bench.boards.archive_file import read_stored_predictions, unpack_tasks
from sasgeo_bench.boards.board_files import read_scores
from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.scoring.flights import view_frame
from sasgeo_bench.scoring.intervals import ClusterDraws, percentile_interval, seed_of_text
from sasgeo_bench.tasks.query import SEQUENCE
from sasgeo_bench.tasks.task_files import Task

RIGHT_M, LOST_M, LOST_FOR_M = 25.0, 100.0, 500.0
RULE_OF_THREE = 3.0  # upper end of 95 % for a rate of which nothing was seen
HEAD = (
    "| Tracker | Map | Flights | Found, % | Kilometres since | Lost | Losses per 100 km | 95 % |\n"
    "|---|---|---:|---:|---:|---:|---:|---|"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """Whether a flight was found, how far it was followed from there, and whether it was lost."""

    is_found: bool
    kept_m: float
    is_lost: bool


def kept(distance_m: np.ndarray, error_m: np.ndarray, is_accepted: np.ndarray) -> Kept:
    """Return how far one flight of N views was followed; all arrays have shape (N,).

    >>> way_m = np.arange(0.0, 2000.0, 100.0)
    >>> off_m = np.where(way_m < 700, 5.0, 300.0)
    >>> kept(way_m, off_m, off_m < 10)
    Kept(is_found=True, kept_m=700.0, is_lost=True)
    """
    right = np.flatnonzero(is_accepted & (error_m <= RIGHT_M))
    if not len(right):
        return Kept(is_found=False, kept_m=0.0, is_lost=False)
    first = int(right[0])
    off = error_m > LOST_M
    begin: float | None = None
    for at_m, is_off in zip(distance_m[first:], off[first:], strict=True):
        if not is_off:
            begin = None
        elif begin is None:
            begin = float(at_m)
        elif at_m - begin > LOST_FOR_M:
            return Kept(is_found=True, kept_m=begin - float(distance_m[first]), is_lost=True)
    return Kept(is_found=True, kept_m=float(distance_m[-1] - distance_m[first]), is_lost=False)


def flights_of(folder: Path, suite: str) -> pd.DataFrame:
    """Return a row for each tracker and flight of a suite: what it was flown over, and how it was followed.

    Raise `StoreError` if the folder holds no board, or the board no flights of that suite.
    """
    rows = []
    scores = read_scores(folder)
    flown = scores[scores["track"] == SEQUENCE]
    matchers = sorted(flown.loc[flown["suite"] == suite, "matcher"].unique())
    if not matchers:
        there = ", ".join(sorted(flown["suite"].unique())) or "no suite of flights"
        raise StoreError(f"{folder} has no flights of suite {suite!r}: it has {there}")
    with tempfile.TemporaryDirectory() as scratch:
        folders = [path for path in unpack_tasks(folder, Path(scratch)) if path.parent.name == suite]
        tasks = [Task.open(path, truth=Path(scratch) / "truth") for path in folders]
        truths = {truth.query_id: truth for task in tasks for truth in task.truths}
        heads = sorted((head for task in tasks for head in task.heads()), key=lambda head: head.query_id)
        for matcher in matchers:
            mine = {item.query_id: item for item in read_stored_predictions(folder, matcher, queries=truths)}
            views = view_frame(heads, [truths[head.query_id] for head in heads], mine)
            for name, part in views.groupby("sequence_id"):  # whose ids begin with it, and go on with the time
                columns = (part[key].to_numpy() for key in ("distance_m", "error_m", "is_accepted"))
                found, truth = kept(*columns), truths[part["query_id"].iloc[0]]
                row = {key: getattr(truth, key) for key in ("role", "kind", "strength")}
                row |= {"place": part["place"].iloc[0], "matcher": matcher, "flight": name}
                rows.append(row | {"found": found.is_found, "kept_m": found.kept_m, "lost": found.is_lost})
    return pd.DataFrame(rows)


def lines(flights: pd.DataFrame) -> Iterator[str]:
    """Yield a row of the table for each tracker and map, first those of the least losses."""
    flights = flights[flights["role"] != "falsifier"]
    for (strength, kind), rows in flights.groupby(["strength", "kind"], sort=True):
        name = kind if strength == 0 else f"{strength:g}"
        for matcher, part in rows.groupby("matcher"):
            way_km, lost = part["kept_m"].sum() / 1000, int(part["lost"].sum())
            yield (
                f"| {matcher} | {name} | {len(part)} | {100 * part['found'].mean():.0f} | {way_km:.0f} | {lost} | "
                f"{_rate(lost, way_km)} | {_interval(part)} |"
            )


def _rate(lost: float, way_km: float) -> str:
    return f"{100 * lost / way_km:.1f}" if way_km > 0 else "-"


def _interval(part: pd.DataFrame) -> str:
    """Return the interval of losses per 100 km, by places."""
    way_km = part["kept_m"].sum() / 1000
    if way_km <= 0:
        return "-"
    if not part["lost"].any():
        return f"0 to {100 * RULE_OF_THREE / way_km:.1f}"
    drawn = ClusterDraws(
        blocks=part["place"].tolist(),
        sites=part["flight"].tolist(),
        places=part["place"].tolist(),
        seed=seed_of_text("lost_flights"),
    )
    sums = np.concatenate(list(drawn.sums(np.column_stack((part["lost"].to_numpy(float), part["kept_m"] / 1e5)))))
    ends = percentile_interval(100 * part["lost"].sum() / way_km, sums[:, 0] / np.maximum(sums[:, 1], 1e-9))
    return f"{ends.lo:.1f} to {ends.hi:.1f}"


def main(words: Sequence[str] | None = None) -> None:
    """Print the table of one suite."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board", type=Path)
    parser.add_argument("--suite", default="flight-real-age")
    options = parser.parse_args(words)
    try:
        flights = flights_of(options.board, options.suite)
    except SasgeoError as error:
        parser.error(str(error))
    print(HEAD, *lines(flights), sep="\n")


if __name__ == "__main__":
    main()
