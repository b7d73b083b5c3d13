# SPDX-License-Identifier: Apache-2.0
"""The queries of a published board, drawn again by its pipeline and held against the hashes that it stores."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sasgeo_bench.boards.archive import laid_tasks
from sasgeo_bench.boards.archive_file import is_pack, read_pack
from sasgeo_bench.boards.board_files import read_board_manifest
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.pipeline_spec import PipelineFile, find_pipeline_file, read_pipeline_file
from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.exchange.release_files import BoardTasks
from sasgeo_bench.experiments.entry_cost import fetch_extracts
from sasgeo_bench.experiments.pipeline import draw_all
from sasgeo_bench.experiments.pipeline_plan import PipelinePlan, plan_pipeline
from sasgeo_bench.regions.build import package_version
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.tasks.private_seed import PrivateSeed
from sasgeo_bench.tasks.query import TASK_VERSION
from sasgeo_bench.tasks.task_files import Task


@dataclass(frozen=True, kw_only=True)
class BoardRequest:
    """A request for the queries of a published board.

    `stored` are the results of the board, `out` is the root of what is built. `pipeline` is the file that made the
    board, the shipped one of its name unless given. `without` are regions whose queries are left out. `jobs` counts
    processes. The rest is as in `plan_pipeline`.
    """

    stored: Path
    out: Path
    pipeline: Path | None = None
    extract_folders: tuple[Path, ...] = ()
    region_folders: tuple[Path, ...] = ()
    sealed: PrivateSeed | None = None
    without: tuple[str, ...] = ()
    jobs: int = 1


def _boards_beside(stored: Path) -> list[str]:
    """Return the names of the stored boards that lie where one was looked for."""
    return [path.name for path in stored.parent.glob("*") if is_pack(path)] if stored.parent.is_dir() else []


def plan_board(request: BoardRequest, *, matchers: Sequence[str] = ()) -> PipelinePlan:
    """Plan to draw all queries of a published board and ask `matchers`; only files of settings are read.

    Raises
    ------
    StoreError
        If there are no stored results, or they are damaged.
    ConfigError
        If the pipeline or the seed of sealed places is another one than that of the board, or it cannot be drawn here.
    MatchError
        If there is no such matcher.
    """
    stored = request.stored
    if not is_pack(stored):
        near = difflib.get_close_matches(stored.name, _boards_beside(stored), n=1)
        mend = (
            f"did you mean {stored.parent / near[0]}?"
            if near
            else "name those of a board, as docs/results/systems-objects"
        )
        fault = "holds no stored results" if stored.is_dir() else "is no folder here"
        raise StoreError(f"{stored} {fault}: {mend}")
    _check_version(stored)
    made_by = read_pack(stored).pipeline
    if made_by is None:
        raise ConfigError(f"{stored} are stored results of no pipeline, so how its queries are drawn is unknown")
    spec = read_pipeline_file(request.pipeline or find_pipeline_file(made_by.id))
    if spec.identity != made_by:
        raise ConfigError(
            f"{stored} was made by another text of the pipeline {made_by.id!r} than this one: take the version of "
            f"the program that made it ({_version_of(read_board_manifest(stored))}), or name the file by --pipeline"
        )
    _check_seed(stored, request.sealed)
    plan = plan_pipeline(
        _asking(spec, matchers),
        out=request.out,
        extract_folders=request.extract_folders,
        region_folders=request.region_folders,
        sealed=request.sealed,
    )
    unknown = sorted({*request.without} - {item.region.id for item in plan.requests})
    if unknown:
        raise ConfigError(f"--without names {', '.join(unknown)}, and the board asks about no such region")
    kept = tuple(item for item in plan.requests if item.region.id not in request.without)
    return replace(plan, requests=kept, jobs=request.jobs)


def draw_board(request: BoardRequest) -> BoardTasks:
    """Draw the queries of a published board, and return its tasks, for a release; what is there is not drawn again.

    Raise as `plan_board` does, and `ConfigError` if extracts are missing or no query is drawn as it was.
    """
    plan = plan_board(request)
    if plan.split is None or any(item.found.is_pictured for item in plan.requests):
        what = "has no split" if plan.split is None else "asks about pictures, which a release does not hold"
        raise ConfigError(f"the board {plan.spec.id!r} {what}: its queries cannot be released so far")
    fetch_extracts(plan)
    tasks, controls = draw_all(plan)
    board = asked_tasks(request.stored)
    names = {task.manifest.name for task in board}
    folders = tuple(task for task in [*tasks, *controls] if (task.parent.name, task.name) in names)
    same = same_queries(request.stored, folders)
    return BoardTasks(
        name=plan.spec.id,
        split=plan.split.spec.id,
        folders=folders,
        asked=same,
        lost=sum(len(task.asked) for task in board) - len(same),
    )


def _version_of(about: BoardManifest) -> str:
    """Name the version that made a board, by the numbers that its queries follow from."""
    return _version_text(about.made_by, about.data_version, about.task_version)


def _version_text(made_by: str | None, data: int | None, task: int | None) -> str:
    made = made_by or "an unknown version"
    return f"{made}, data version {data or 'unknown'}, task version {task or 'unknown'}"


def _check_version(stored: Path) -> None:
    """Refuse a board on maps that this version makes otherwise; tell of one whose tasks are of another version."""
    about = read_board_manifest(stored)
    here = _version_text(f"sasgeo-bench {package_version()}", DATA_VERSION, TASK_VERSION)
    if (about.data_version or DATA_VERSION) != DATA_VERSION:
        beside = stored.resolve()
        others = [name for name in sorted(_boards_beside(beside)) if _is_of_this_version(beside.with_name(name))]
        raise ConfigError(
            f"{stored} was made by {_version_of(about)}, and this is {here}, which makes other maps: enter it with the "
            f"version that made it, or enter a board of this one ({', '.join(others) or 'none lies beside it'})"
        )
    if (about.task_version or TASK_VERSION) != TASK_VERSION:
        tell(f"{stored} was made by {_version_of(about)}, this is {here}: queries are held against its hashes")


def _is_of_this_version(folder: Path) -> bool:
    """Return whether a stored board is on maps that this version makes; one that cannot be read is not."""
    try:
        return read_board_manifest(folder).data_version == DATA_VERSION
    except SasgeoError:
        return False


def _check_seed(stored: Path, seed: PrivateSeed | None) -> None:
    """Refuse a seed that did not draw the sealed places of the board: none of their queries would be the same."""
    opened = read_board_manifest(stored).sealed
    if seed is not None and all(one.drawn_by != seed.commitment for one in opened.values()):
        raise ConfigError(
            f"{stored} was not drawn by this seed of sealed places, of commitment {seed.commitment[:12]}: take the "
            "seed that was published with the board, or none"
        )


def _asking(spec: PipelineFile, matchers: Sequence[str]) -> PipelineFile:
    """Return a pipeline that asks some matchers all of its queries, and compares nothing."""
    tasks = [task.model_copy(update={"matchers": []}) for task in spec.task]
    nothing: dict[str, list[str]] = {"contrast": [], "rejectors": [], "metrics": []}
    return spec.model_copy(update={"matchers": list(matchers), "task": tasks, **nothing})


def asked_tasks(stored: Path) -> list[Task]:
    """Return the tasks of a board with the hashes of their queries; nothing else of them can be read later."""
    with laid_tasks([stored]) as folders:
        tasks = [Task.open(folder) for folder in folders]
        return [task for task in tasks if task.asked is not None]


def same_queries(stored: Path, tasks: Sequence[Path]) -> dict[str, str]:
    """Return the hash of each query of a board that tasks hold as the board does, by id, and tell how many.

    Raise `ConfigError` if there is none.
    """
    drawn = {name: asked for task in tasks for name, asked in Task.open(task).asked.items()}
    board = {name: asked for task in asked_tasks(stored) for name, asked in task.asked.items()}
    same = {name: asked for name, asked in board.items() if drawn.get(name) == asked}
    if not same:
        made_by = _version_of(read_board_manifest(stored))
        raise ConfigError(
            f"none of the {len(board)} queries of {stored} is drawn here as it was: they were drawn by another "
            f"version of the program, or from other extracts; take the version that made the board ({made_by})"
        )
    tell(f"{len(same)} of {counted(len(board), 'query', 'queries')} of the board are drawn as they were")
    if len(same) < len(board):
        other = len(drawn.keys() & board.keys() - same.keys())
        tell(f"  left out: {other} that this version draws otherwise, {len(board) - len(same) - other} not drawn here")
    return same
