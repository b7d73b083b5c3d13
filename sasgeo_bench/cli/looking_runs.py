# SPDX-License-Identifier: Apache-2.0
"""What `inspect` shows of a run or a board: failures with pictures, strips, and flights."""

from pathlib import Path
from typing import Final

import pandas as pd
from rich.table import Table

from sasgeo_bench.boards.board_files import BOARD, read_board_manifest, read_scores
from sasgeo_bench.boards.cases import case_pixels, count_cases, sample_cases, turned_line, write_png
from sasgeo_bench.boards.flight_page import flight_page
from sasgeo_bench.boards.flight_plots import flight_map_pixels
from sasgeo_bench.boards.run_cases import RunCases, find_flight, picture_of
from sasgeo_bench.boards.strip_plot import best_on_pictures, pictured_tasks, strip_of, strip_pixels
from sasgeo_bench.cli.console import print_table, say
from sasgeo_bench.cli.targets import sheet_path
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.scoring.rows import base_name
from sasgeo_bench.scoring.strata import STRESS
from sasgeo_bench.tasks.query import BY
from sasgeo_bench.tasks.task_files import Task

SOME_CASES: Final = 3
SHOWN_LETTERS: Final = 10  # of a query's id: enough to name it


def run_of(board: Path, out: Path) -> Path:
    """Return the folder of the runs of the matcher of a board that finds most queries with pictures; or of no board it.

    Raise `ConfigError` if the board has no answers to queries with pictures.
    """
    if not (board / BOARD).is_file():
        return board
    about = read_board_manifest(board)
    scores = {str(name): frame for name, frame in read_scores(board).groupby("matcher")}
    tasks = {(item.suite, item.region) for item in about.tasks}
    name = best_on_pictures(scores, {key for key in tasks if BY in key[0]})
    if name is None:
        raise ConfigError(
            f"{board} holds no answers to queries with pictures: name a board of a suite such as aerial+..."
        )
    entry = next(item for item in about.entries if item.name == name)
    return out / "runs" / base_name(entry.name) / str(entry.hash)


def inspect_run(cases: RunCases, out: Path, query: str | None, strip: int | None) -> None:
    """Count the failures of a run by class, with some to look at; or draw one query and its answer, or a strip.

    Of flights print what each is scored, and draw the map of one.
    """
    if cases.flights and strip is None and _inspect_flights(cases, out, query):
        return
    if strip is not None:
        suites = ", ".join(sorted({suite for suite, _ in pictured_tasks(cases)}))
        path = sheet_path(out, "strip", cases.entry.name)
        write_png(path, strip_pixels(*strip_of(cases, strip), title=f"{cases.entry.name} on {suites}"))
        say(f"strip: {path}")
        return
    if query is not None:
        query_id, picture = picture_of(cases, query)
        path = sheet_path(out, cases.entry.name, query_id)
        write_png(path, case_pixels(picture))
        say(f"picture: {path}")
        return
    if not len(cases.scores):
        return
    found = cases.failures()
    counts = count_cases(found)
    some = sample_cases(found, each=SOME_CASES)
    table = Table("failure", "queries", "some of them (--query draws one)", box=None, pad_edge=False)
    for name, count in counts.items():
        listed = some.loc[some["failure"] == name, "query_id"]
        table.add_row(name, str(count), ", ".join(query_id[:SHOWN_LETTERS] for query_id in listed))
    stressed, total = int((cases.scores["role"] == STRESS).sum()), len(cases.scores)
    only = f", {stressed} of the queries under stress: boards count these first, and controls apart" if stressed else ""
    say(f"{cases.entry.name}: {counted(len(found), 'failure')} in {counted(total, 'query', 'queries')}{only}")
    print_table(table)
    if turned := turned_line(cases.scores):
        say(turned)


def _inspect_flights(cases: RunCases, out: Path, query: str | None) -> bool:
    """Print the figures of the flights of a run, and draw a map of the one named, or of the worst.

    Return True if `query` names one of them.
    """
    frames = [found.flights for found in cases.flights.values()]
    order = ["distance_within_25m", "role", "query_id"]  # of flights that are as good the stressed first
    flights = pd.concat(frames, ignore_index=True).sort_values(order, ascending=[True, False, True])
    if query is None:
        _print_flights(cases.entry.name, flights)
        row = flights.iloc[0]
    else:
        flight = find_flight(cases, query)
        if flight is None:
            return False
        row = flights[flights["query_id"] == flight].iloc[0]
    key = (str(row["suite"]), str(row["region"]))
    task = Task.open(cases.root / "tasks" / key[0] / key[1], cases.root)
    views = {cases.entry.name: cases.flights[key].views}
    path = sheet_path(out, cases.entry.name, str(row["query_id"]))
    write_png(path, flight_map_pixels(task, str(row["query_id"]), views))
    say(f"map of {'the worst flight' if query is None else 'the flight'}: {path}")
    playing = path.with_suffix(".html")
    text = flight_page(task, str(row["query_id"]), cases.entry.name, cases.flights[key].views, cases.predictions)
    with fresh_file(playing, mend="name another --out, or free some space") as scratch:
        scratch.write_text(text, encoding="utf-8")
    say(f"page that plays it: {playing}")
    return query is not None


def _print_flights(name: str, flights: pd.DataFrame) -> None:
    """Print a line for each flight, the worst first."""
    shown = {"flight": "query_id", "suite": "suite", "region": "region", "kind": "kind", "status": "status"}
    figures = ("distance_within_25m", "right_accepted", "false_accepted", "error_p95_m", "first_fix_m")
    table = Table(*shown, *figures, box=None, pad_edge=False)
    for row in flights.to_dict("records"):
        texts = [str(row["query_id"])[:SHOWN_LETTERS], *(str(row[column]) for column in list(shown.values())[1:])]
        table.add_row(*texts, *(f"{row[figure]:.3g}" for figure in figures))
    say(f"{name}: {counted(len(flights), 'flight')}, the worst first (--query draws one)")
    print_table(table)
