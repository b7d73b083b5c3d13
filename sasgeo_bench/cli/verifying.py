# SPDX-License-Identifier: Apache-2.0
"""Command `verify`: hold what lies in a folder or file against its hashes, its tasks, or the places of its split."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

from sasgeo_bench.cli.built_regions import find_built
from sasgeo_bench.cli.console import EXIT_USER, complain, say, shown_progress
from sasgeo_bench.cli.options import Out, RegionFolders
from sasgeo_bench.cli.targets import find_task, is_split
from sasgeo_bench.core.errors import ConfigError, counted, named
from sasgeo_bench.core.progress import spread, tell
from sasgeo_bench.regions.packed_map import is_packed_map, unpack_map
from sasgeo_bench.regions.region_files import differing_files, read_features
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.running.prediction_files import Violation, is_run, parts_of
from sasgeo_bench.scoring.submission_files import count_excluded, is_submission, validate
from sasgeo_bench.tasks.split import find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.task_files import Task

PARQUET: Final = ".parquet"
MOST_MISSING: Final = 5  # queries without a row that are named; the others are counted


def verify_command(
    target: Annotated[
        str | None,
        typer.Argument(
            help="a built region, a packed map (*.map), a task (SUITE/REGION), a split, a run, a submission, the "
            "folder of one, or a file of predictions"
        ),
    ] = None,
    tasks: Annotated[
        list[Path] | None,
        typer.Option("--tasks", "--for", help="of answers: task folder, or stored results of a board; may be repeated"),
    ] = None,
    predictions: Annotated[str | None, typer.Option(hidden=True)] = None,  # as `validate` had it
    region_folders: RegionFolders = None,
    out: Out = Path("out"),
) -> None:
    """Check a region or task against its hashes, answers against tasks, and a split for ground that its parts share."""
    if (target is None) == (predictions is None):
        raise ConfigError("verify needs one target: name a region, a task, a split, a run, a submission or predictions")
    target = target or predictions or ""
    if is_submission(Path(target)):
        _verify_submission(Path(target), tasks or [])
        return
    task_folder, region_folder = find_task(target, out), find_built(target, out)
    if tasks and (task_folder is not None or region_folder is not None or is_split(target)):
        raise ConfigError(f"{target} holds no answers, and --tasks is what answers are held against: leave it out")
    if task_folder is not None:
        from sasgeo_bench.tasks.build import check_task  # noqa: PLC0415 - drawing takes a second to import

        task = Task.open(task_folder, out)
        with_truths = "every query has its truth" if task.has_truths else "its truths are not here"
        faults, good = check_task(task), f"all files are as task.json says, and {with_truths}"
    elif region_folder is not None:
        faults, good = differing_files(region_folder), f"all files are as the manifest says{_size(target, out)}"
    elif is_split(target):
        faults, good = _shared_ground(target, out, region_folders or [])
    elif (tasks or target.endswith(PARQUET) or is_run(Path(target))) and parts_of(Path(target)):
        _verify_answers(Path(target), tasks or [])
        return
    else:
        from sasgeo_bench.cli.no_target import no_target  # noqa: PLC0415 - looks for all that it might be

        raise no_target(target, out, region_folders or [])
    for line in faults:
        say(line)
    if faults:
        raise typer.Exit(EXIT_USER)
    say(f"{target}: {good}")


def _size(target: str, out: Path) -> str:
    """Return what a packed map adds to the line of its region: its size, and what was left out."""
    return f"; {unpack_map(target, out).about.to_text()}" if is_packed_map(Path(target)) else ""


def _verify_answers(predictions: Path, tasks: list[Path]) -> None:
    """List everything in which predictions are not what the tasks ask for, and count queries without a row."""
    from sasgeo_bench.boards.archive import laid_tasks  # noqa: PLC0415 - boards take a second to import

    if not tasks:
        raise ConfigError(f"{predictions} holds answers: name --tasks, task folders or the stored results of a board")
    with laid_tasks(tasks) as folders:
        asked = [Task.open(folder) for folder in folders]
        _show(validate(predictions, asked), predictions)
        excluded = count_excluded(predictions, asked)
    rest = f"{counted(excluded, 'answer')} to other queries set aside" if excluded else "and nothing else"
    say(f"{predictions}: answers every query of {counted(len(folders), 'task')}, {rest}")


def _show(faults: Iterable[Violation], predictions: Path) -> None:
    """Print faults, of many queries without a row the first, and end if there are any."""
    count = missing = 0
    for violation in faults:
        count += 1
        missing += violation.is_missing_row
        if missing <= MOST_MISSING or not violation.is_missing_row:
            say(violation.to_text())
    if missing > MOST_MISSING:
        more = counted(missing - MOST_MISSING, "more query", "more queries")
        say(f"{predictions.name}, query_id: found no row for {more}, expected one for every query")
    if count:
        complain(f"{predictions}: {counted(count, 'violation')}")
        raise typer.Exit(EXIT_USER)


def _verify_submission(folder: Path, tasks: list[Path]) -> None:
    """Validate a submission: queries without a row are no faults but misses, which are reported."""
    from sasgeo_bench.exchange.submissions import hold_submission  # noqa: PLC0415 - as boards

    submission, found = hold_submission(folder, tasks)
    _show([fault for fault in found if not fault.is_missing_row], folder)
    missing = len(found)
    misses = f", {counted(missing, 'query', 'queries')} without a row count as misses" if missing else ""
    against = "" if tasks else "; its rows were held against no queries (--for names the stored results of its board)"
    say(
        f"{folder}: a sound submission of {submission.card.name} {submission.card.version} to {submission.board}, "
        f"{counted(len(submission.tasks), 'task')}{misses}{against}"
    )


def _shared_ground(target: str, out: Path, folders: list[Path]) -> tuple[list[str], str]:
    """Ground that parts of a split share, and what was searched."""
    from sasgeo_bench.tasks.duplicates import (  # noqa: PLC0415 - its trees take half a second to import
        BLOCK,
        Arrangements,
        constellations,
        search_look_alikes,
        search_split,
    )

    grids = {name: read_region_file(path).grid() for name, path in list_region_files(folders=folders).items()}
    split = make_split(read_split_file(find_split_file(target)), grids)
    built = [region for region in split.spec.region_ids if (out / "regions" / region).is_dir()]
    missing = [region for region in split.spec.region_ids if region not in built]
    if missing:
        tell(f"not searched, for not built: {named(missing, 'region')}")
    if len({split.part_of(place) for place, blocks in split.blocks.items() if blocks[0].region in built}) < 2:
        raise ConfigError(
            f"{out / 'regions'} holds regions of fewer than two parts of split {split.spec.id!r}: build-region more"
        )
    with shown_progress():
        read = spread(lambda name: read_features(out / "regions" / name), built, label="regions read")
        described = [(constellations(features), Arrangements.of(features)) for features in read]
    maps, blocks = (dict(zip(built, side, strict=True)) for side in zip(*described, strict=True))
    faults = [
        f"{item.first} and {item.second} of different parts hold the same ground: {item.count} buildings lie alike"
        for item in search_split(split, maps)
    ] + [
        f"{item.first} and {item.second} of different parts look alike: {counted(item.count, 'pair')} of blocks of "
        f"{BLOCK} buildings"
        for item in search_look_alikes(split, blocks)
    ]
    searched = f"{counted(len(built), 'region')} and {sum(map(len, blocks.values()))} blocks of {BLOCK} buildings"
    return faults, f"no two parts share ground or look alike, {searched} searched"
