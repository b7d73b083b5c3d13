# SPDX-License-Identifier: Apache-2.0
"""Commands that run matchers and check their predictions."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from sasgeo_bench.cli.console import Out, say, shown_progress, tell
from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.running.plan import RunPlan, RunRequest, plan_run
from sasgeo_bench.running.prediction_files import merge_runs
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.tasks.split import Split, find_split, list_split_files
from sasgeo_bench.tasks.task_files import read_asked, read_task

SHARD: Final = re.compile(r"[0-9]{1,9}/[0-9]{1,9}")


def run_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    matcher: Annotated[str, typer.Option(help="name from list-matchers, or module:Class")],
    tasks: Annotated[list[Path], typer.Option(help="task folder, OUT/tasks/SUITE/REGION; may be repeated")],
    top_k: Annotated[int, typer.Option(help="poses asked of each query")] = 25,
    jobs: Annotated[int, typer.Option(help="processes at once")] = 1,
    dask: Annotated[
        str | None, typer.Option(help="address of a dask scheduler, or local:N for N processes of this machine")
    ] = None,
    shard: Annotated[str, typer.Option(help="i/n: answer the i-th of n parts of the queries")] = "1/1",
    limit: Annotated[int | None, typer.Option(help="queries of each task at most")] = None,
    match_s: Annotated[float, typer.Option(help="seconds for one query")] = Limits().match_s,
    prepare_s: Annotated[float, typer.Option(help="seconds for one map")] = Limits().prepare_s,
    memory_mb: Annotated[
        int, typer.Option(help="MB (10^6 bytes) for all processes of the matcher")
    ] = Limits().memory_bytes // 10**6,
    scratch_mb: Annotated[
        int, typer.Option(help="MB of files that the matcher may write, in memory, where the system has a way")
    ] = Limits().scratch_bytes // 10**6,
    train: Annotated[
        list[Path] | None,
        typer.Option(
            help="task folder to learn from, its truths beside it, of a place that is not asked; may be repeated"
        ),
    ] = None,
    most_trained: Annotated[
        int, typer.Option(help="queries to learn from at most, evenly over places, suites and sites")
    ] = 200,
    learn_s: Annotated[float, typer.Option(help="seconds to learn")] = Limits().learn_s,
    split: Annotated[
        str | None,
        typer.Option(help="with --train, what is one place; default: the split of the tasks, if it is a shipped one"),
    ] = None,
    again: Annotated[list[str] | None, typer.Option(help="ask rows of this status again, as in timeout")] = None,
    trusted: Annotated[bool, typer.Option("--trusted", help="do not shut the matcher in; run.json says so")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what is left to do, and stop")] = False,
    out: Out = Path("out"),
) -> None:
    """Ask a matcher every query of some tasks; goes on where an earlier run was cut off."""
    request = RunRequest(
        spec=matcher,
        tasks=tasks,
        out=out,
        top_k=top_k,
        limits=Limits(
            match_s=match_s,
            prepare_s=prepare_s,
            learn_s=learn_s,
            memory_bytes=memory_mb * 10**6,
            scratch_bytes=scratch_mb * 10**6,
        ),
        jobs=jobs,
        dask=dask,
        shard=_shard(shard),
        limit=limit,
        again=tuple(again or ()),
        is_shut_in=not trusted,
        train=tuple(train or ()),
        most_trained=most_trained,
        split=_split(split, tasks) if train else None,
    )
    plan = plan_run(request)
    if dry_run:
        say(plan.to_text())
        return
    _carry_out(plan)


def _carry_out(plan: RunPlan) -> None:
    """Run, and say what came of it."""
    for line in plan.lesson_lines() if plan.lesson is None else ():
        tell(f"{plan.card.name}: {line}")
    with shown_progress() as progress:
        report = run(plan, tell=tell, progress=progress)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(report.counts.items())) or "nothing left"
    tell(f"{plan.card.name} {plan.card.version}: {counts}")
    for status, message in sorted(report.messages.items()):
        tell(f"  {status}, the first of {report.counts[status]}: {message}")
    for folder in report.folders:
        say(folder)


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not SHARD.fullmatch(text):
        message = f"--shard must be i/n, as in 1/2, got {text!r}"
        raise ConfigError(message)
    return int(index), int(count)


def _split(name: str | None, tasks: Sequence[Path]) -> Split | None:
    """The split that is named, or else that of the tasks, with all shipped regions; None where nobody knows it."""
    if name is None:
        name = str(read_task(tasks[0]).get("split"))
        if name not in list_split_files():
            return None
    return find_split(name)


def merge_command(
    *,
    runs: Annotated[list[Path], typer.Option(help="folder of parts, or file; may be repeated")],
    into: Annotated[Path, typer.Option(help="predictions file to write")],
    tasks: Annotated[
        list[Path] | None,
        typer.Option(help="task folder; may be repeated; of folders, answers to these alone; default: all there are"),
    ] = None,
) -> None:
    """Put the parts of a run, shards of several machines included, into one predictions file, sorted by query."""
    asked = {name: said for task in tasks or () for name, said in read_asked(task).items()}
    count = merge_runs(runs, into, asked=asked if tasks else None)
    say(f"{into}: {counted(count, 'prediction')}")
