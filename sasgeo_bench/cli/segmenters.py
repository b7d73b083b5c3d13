# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of segmenters; and the one that makes evidence of pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import CONTESTANT_FAILED, complain, say, shown_progress
from sasgeo_bench.cli.options import Options, Out, RegionFolders, takes
from sasgeo_bench.running.segment_tasks import SegmentTasks, segment_tasks
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.tasks.split import find_split
from sasgeo_bench.tasks.task_files import Task


@dataclass(frozen=True, kw_only=True)
class SegmentOptions(Options):
    """Flags of segment."""

    segmenter: Annotated[str, typer.Option(help="name from list segmenters, or module:Class")]
    tasks: Annotated[
        list[Path],
        typer.Option(help="task folders of pictures, OUT/tasks/SUITE/REGION"),
    ]
    split: Annotated[
        str | None, typer.Option(help="which places a segmenter learns from for which; default: the split of the tasks")
    ] = None
    recalibrated: Annotated[
        bool, typer.Option("--recalibrated", help="shift probabilities to the map's shares of the classes: +shares")
    ] = False
    most_trained: Annotated[int, typer.Option(min=1, help="pictures to learn from at most, evenly over places")] = 80
    segment_s: Annotated[float, typer.Option(help="seconds for one picture")] = Limits().match_s
    learn_s: Annotated[float, typer.Option(help="seconds to learn")] = Limits().learn_s
    trusted: Annotated[bool, typer.Option("--trusted", help="run without the sandbox")] = False
    region_files: RegionFolders = None
    jobs: Annotated[int, typer.Option(min=1, help="tasks at once")] = 1
    out: Out = Path("out")


@takes(SegmentOptions)
def segment(options: SegmentOptions) -> tuple[Path, ...]:
    """Make evidence of the pictures of tasks with a segmenter, which learns at other places than it is asked about.

    Returns
    -------
    tuple of Path
        Folders of tasks that every matcher can answer, `out/tasks/<suite>+<segmenter>/<region>`; their truths beside.
        Recalibrated ones are `out/tasks/<suite>+<segmenter>+shares/<region>`.

    Raises
    ------
    ConfigError
        If a task has no pictures, or there is nothing to learn from.
    MatchError
        If the segmenter cannot be loaded, or its card is not sound. A picture that it fails at has no evidence.
    StoreError
        If a task or its truths are missing or damaged.
    """
    split = options.split or Task.open(options.tasks[0]).manifest.split  # none of pictures of one's own
    return segment_tasks(
        SegmentTasks(
            spec=options.segmenter,
            tasks=options.tasks,
            split=None if split is None else find_split(split, folders=tuple(options.region_files or ())),
            out=options.out,
            is_recalibrated=options.recalibrated,
            most=options.most_trained,
            limits=Limits(match_s=options.segment_s, learn_s=options.learn_s),
            is_sandboxed=not options.trusted,
            jobs=options.jobs,
        ),
    )


def segment_command(options: SegmentOptions) -> None:
    """Make evidence of the pictures of tasks, so that every matcher can answer them: OUT/tasks/SUITE+SEGMENTER/."""
    with shown_progress():
        folders = segment(**vars(options))
    for folder in folders:
        say(folder)
    if any(Task.open(folder).manifest.failed_pictures for folder in folders):
        complain(
            f"pictures failed, so the command ends with status {CONTESTANT_FAILED}; it tries them again when repeated"
        )
        raise typer.Exit(CONTESTANT_FAILED)
