# SPDX-License-Identifier: Apache-2.0
"""The error for a target of `inspect` or `verify` that is none: what it is, or what there is instead."""

import difflib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from sasgeo_bench.boards.board_files import BOARD
from sasgeo_bench.cli.built_regions import MOST_NAMED
from sasgeo_bench.cli.targets import is_region_file
from sasgeo_bench.core.errors import ConfigError, named
from sasgeo_bench.observing.results import PAGE, TABLE
from sasgeo_bench.regions.region_files import MANIFEST
from sasgeo_bench.regions.region_spec import list_region_files
from sasgeo_bench.running.prediction_files import RUN, is_run
from sasgeo_bench.scoring.submission_files import SUBMISSION
from sasgeo_bench.tasks.query import base_of
from sasgeo_bench.tasks.split import list_split_files
from sasgeo_bench.tasks.suites.all_suites import list_suites
from sasgeo_bench.tasks.task_files import TASK

_ELSEWHERE: Final = {  # what else a folder may be, by a file in it, and the command for it
    BOARD: "a board: publish --board {0} makes a site of it",
    TABLE: "what locate found: open {0}/index.html in a browser, or read {0}/locate.csv",
    SUBMISSION: "a submission: verify {0} --for BOARD checks it",
}


def no_target(target: str, out: Path, folders: Collection[Path]) -> ConfigError:
    """Return the error for what is no region, task or split: it says what the target is, or what there is.

    `folders` hold region files besides those that ship.
    """
    path = Path(target)
    if path.is_dir():
        message = _of_folder(path, out)
    elif is_region_file(path):
        is_built = (out / "regions" / path.stem / MANIFEST).is_file()
        whole = f"inspect {path.stem} shows it" if is_built else f"build-region {path} first, then inspect {path.stem}"
        message = f"{path} is a region file: {whole}"
    elif path.name == PAGE:
        message = f"{path} is a page: open it in a browser"
    elif path.exists():
        whole = f"name its folder {path.parent}" if path.name in {MANIFEST, TASK, RUN} else _there(out)
        message = f"{target} is a file, not a region, task or run: {whole}"
    else:
        message = _of_name(
            str(path).removeprefix(f"{out / 'tasks'}/").removeprefix(f"{out / 'regions'}/"), out, folders
        )
    return ConfigError(message)


def _of_folder(folder: Path, out: Path) -> str:
    """Describe a folder that is no target itself: a board, a submission, or one that holds targets."""
    other = next((text for file, text in _ELSEWHERE.items() if (folder / file).is_file()), None)
    if other is not None:
        return f"{folder} is {other.format(folder)}"
    if is_run(folder):
        return f"{folder} holds a run: inspect shows what went wrong in it, verify {folder} --tasks TASK checks it"
    is_root = any((folder / kind).is_dir() for kind in ("regions", "tasks", "runs"))
    inside = [] if is_root else [str(path) for path in _targets_in(folder)]
    if not inside:
        return f"{folder} is no region, task or run: {_there(folder if is_root else out)}"
    more = ", ..." if len(inside) > MOST_NAMED else ""
    return f"{folder} is no region, task or run, but holds some: name one, as {', '.join(inside[:MOST_NAMED])}{more}"


def _targets_in(folder: Path) -> Iterator[Path]:
    """Yield regions and tasks in a folder or in its folders, and the runs of each matcher in it."""
    for file in (MANIFEST, TASK):
        yield from sorted(path.parent for depth in ("*", "*/*") for path in folder.glob(f"{depth}/{file}"))
    yield from (path for path in sorted(folder.glob("*")) if is_run(path))


def _of_name(name: str, out: Path, folders: Collection[Path]) -> str:
    """Describe a name or path where nothing is: a suite or region that is misspelled, or not made yet."""
    suite, slash, region = name.partition("/")
    tasks = [f"{path.parent.parent.name}/{path.parent.name}" for path in sorted((out / "tasks").glob(f"*/*/{TASK}"))]
    if suite in list_suites():
        made = [task for task in tasks if task.startswith(f"{suite}/")]
        same = [task for task in made if base_of(task) == base_of(name)]
        near = same or difflib.get_close_matches(name, made, n=1, cutoff=0.8) or made
        there = f"there is {', '.join(near[:MOST_NAMED])}" if near else f"draw it with make-queries --suite {suite}"
        return f"{out / 'tasks'} holds no task {name}: {there}"
    if slash:
        near = difflib.get_close_matches(suite, list_suites(), n=1)
        hint = f", did you mean '{near[0]}/{region}'?" if near else f" (list suites shows all): {_there(out)}"
        return f"{name} is no folder, and there is no suite {suite!r}{hint}"
    known = list_region_files(folders=tuple(folders))
    base, _, date = name.partition("@")
    if base_of(base) in known:
        of_date = f" --date {date}" if date else ""
        return f"{out / 'regions'} holds no region {name!r}: build-region {base_of(base)}{of_date} first"
    built = [path.parent.name for path in sorted((out / "regions").glob(f"*/{MANIFEST}"))]
    near = difflib.get_close_matches(name, [*built, *list_split_files(), *list_suites(), *known], n=1)
    hint = f", did you mean {near[0]!r}?" if near else f": {_there(out)}"
    return f"there is no region, task, split or run {name!r}{hint}"


def _there(out: Path) -> str:
    """Name what a root holds, or what makes something in it."""
    regions = [path.parent.name for path in sorted((out / "regions").glob(f"*/{MANIFEST}"))]
    tasks = [f"{path.parent.parent.name}/{path.parent.name}" for path in sorted((out / "tasks").glob(f"*/*/{TASK}"))]
    runs = [str(path) for path in sorted((out / "runs").glob("*")) if is_run(path)]
    found = [named(names, noun) for names, noun in ((regions, "region"), (tasks, "task"), (runs, "run")) if names]
    if not found:
        return f"build-region and make-queries put some into {out}"
    return f"name one of those in {out}, {', '.join(found)}"
