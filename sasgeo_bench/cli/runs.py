# SPDX-License-Identifier: Apache-2.0
"""Run matchers and merge their predictions: the functions and their commands."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from sasgeo_bench.cli.console import CONTESTANT_FAILED, complain, said_after, say
from sasgeo_bench.cli.options import Dask, Options, Out, RegionFolders, takes
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.matching.matcher import SOUND
from sasgeo_bench.regions.packed_map import unpack_map
from sasgeo_bench.running import runner
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import merge_runs
from sasgeo_bench.running.runner import RunReport
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.tasks.split import Split, find_split, list_split_files
from sasgeo_bench.tasks.task_files import Task

PackedMaps = Annotated[
    list[Path] | None,
    typer.Option(help="packed map (*.map), in place of the built region of its tasks; may be repeated"),
]
SHARD: Final = re.compile(r"[0-9]{1,9}/[0-9]{1,9}")


@dataclass(frozen=True, kw_only=True)
class RunOptions(Options):
    """Flags of run."""

    matcher: Annotated[str, typer.Option(help="name from list matchers or list trackers, or module:Class")]
    tasks: Annotated[list[Path], typer.Option(help="task folders, as OUT/tasks/SUITE/*")]
    maps: PackedMaps = None
    top_k: Annotated[int, typer.Option(help="poses asked of each query")] = 25
    jobs: Annotated[int, typer.Option(help="processes at once")] = 1
    dask: Dask = None
    shard: Annotated[str, typer.Option(help="i/n: answer the i-th of n parts of the queries")] = "1/1"
    limit: Annotated[int | None, typer.Option(help="queries of each task at most")] = None
    match_s: Annotated[float, typer.Option(help="seconds for one query")] = Limits().match_s
    prepare_s: Annotated[float, typer.Option(help="seconds for one map")] = Limits().prepare_s
    memory_mb: Annotated[int, typer.Option(help="MB (10^6 bytes) for all processes of the matcher")] = (
        Limits().memory_bytes // 10**6
    )
    scratch_mb: Annotated[
        int, typer.Option(help="MB of files that the matcher may write, in memory, where the system has a way")
    ] = Limits().scratch_bytes // 10**6
    train: Annotated[
        list[Path] | None,
        typer.Option(help="task folder to learn from, with its truths, of a place that is not asked; may be repeated"),
    ] = None
    most_trained: Annotated[
        int, typer.Option(help="queries to learn from at most, evenly over places, suites and sites")
    ] = 200
    learn_s: Annotated[float, typer.Option(help="seconds to learn")] = Limits().learn_s
    split: Annotated[
        str | None,
        typer.Option(help="with --train, what is one place; default: the split of the tasks, if it is a shipped one"),
    ] = None
    region_files: RegionFolders = None
    again: Annotated[list[str] | None, typer.Option(help="ask queries with this status again, e.g. timeout")] = None
    trusted: Annotated[bool, typer.Option("--trusted", help="run without the sandbox; run.json states it")] = False
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what is left to do, and stop")] = False
    out: Out = Path("out")


@takes(RunOptions)
def run(options: RunOptions) -> RunReport:
    """Ask a matcher every query of some tasks; goes on where an earlier run was cut off.

    The matcher answers in a process of its own, which sees no truth.

    Returns
    -------
    RunReport
        Folders of the predictions; how many rows of which status were added, none of a dry run.

    Raises
    ------
    MatchError
        If the matcher cannot be loaded, or its card is not sound. A query that it fails at is a row, no error.
    ConfigError
        If a number makes no sense, or there is nothing to learn from but what is asked.
    StoreError
        If a task or its region is missing or of another version.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> tasks = sgb.make_tasks(suite="clean", regions="town-grid", n=4)  # doctest: +SKIP
    >>> sgb.run(matcher="my_matcher:MyMatcher", tasks=tasks, jobs=2, tell=print).counts  # doctest: +SKIP
    {'ok': 112}
    """
    limits = Limits(
        match_s=options.match_s,
        prepare_s=options.prepare_s,
        learn_s=options.learn_s,
        memory_bytes=options.memory_mb * 10**6,
        scratch_bytes=options.scratch_mb * 10**6,
    )
    plan = plan_run(
        RunRequest(
            spec=options.matcher,
            tasks=options.tasks,
            out=options.out,
            top_k=options.top_k,
            limits=limits,
            jobs=options.jobs,
            dask=options.dask,
            shard=_shard(options.shard),
            limit=options.limit,
            again=tuple(options.again or ()),
            is_sandboxed=not options.trusted,
            train=tuple(options.train or ()),
            most_trained=options.most_trained,
            split=_split(options.split, options.tasks, options.region_files) if options.train else None,
            maps=[unpack_map(path, options.out) for path in options.maps or ()],
        )
    )
    if options.dry_run:
        options.say(plan.to_text())
        return RunReport(counts={}, messages={}, folders=tuple(part.folder for part in plan.parts))
    report = runner.run(plan)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(report.counts.items())) or "nothing left"
    tell(f"{plan.card.name}, version {plan.card.version}: {counts}")
    for status, message in sorted(report.messages.items()):
        tell(f"  {status}, one of {report.counts[status]}: {message}")
    for folder in report.folders:
        options.say(folder)
    return report


def run_command(options: RunOptions) -> None:
    """Ask a matcher every query of some tasks; goes on where an earlier run was cut off."""
    with said_after() as say_later:
        report = run(**vars(options) | {"say": say_later})
    if report.counts and not report.counts.keys() & SOUND:
        complain(f"no query was answered, so the command ends with status {CONTESTANT_FAILED}; the rows are kept")
        raise typer.Exit(CONTESTANT_FAILED)


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not SHARD.fullmatch(text):
        raise ConfigError(f"--shard must be i/n, as in 1/2, got {text!r}")
    return int(index), int(count)


def _split(name: str | None, tasks: Sequence[Path], folders: Sequence[Path] | None) -> Split | None:
    """The split that is named, or else that of the tasks, with all known regions; None where it is unknown."""
    if name is None:
        name = str(Task.open(tasks[0]).manifest.split)
        if name not in list_split_files():
            return None
    return find_split(name, folders=tuple(folders or ()))


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
    asked = {name: asked for task in tasks or () for name, asked in Task.open(task).asked.items()}
    count = merge_runs(runs, into, asked=asked if tasks else None)
    say(f"{into}: {counted(count, 'prediction')}")
