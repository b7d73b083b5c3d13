# SPDX-License-Identifier: Apache-2.0
"""A world in a root folder, a line a step: regions, tasks, answers and a board, made in silence as by commands."""

from pathlib import Path
from typing import Any

from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import RegionFile, find_region_file, read_region_file
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.runner import run
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.split import find_split
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.threaded import threaded


def built(spec: RegionFile | str, out: Path, **options: Any) -> Path:
    """Build a region from its file, or from the shipped one of that name; return its folder."""
    read = read_region_file(find_region_file(spec)) if isinstance(spec, str) else spec
    plan = plan_build(read, out=out, **options)
    build_region(plan)
    return plan.folder


def drawn(out: Path, suite: str, *regions: str, **changes: Any) -> list[Path]:
    """Draw a suite in regions, which are built where they are missing; return the folders of the tasks."""
    values = {"split": "crossfit", "count": 1, "seed": 0} | changes
    wanted = TaskRequest(suites=(suite,), regions=regions, out=out, **values)
    for request in plan_requests(wanted):
        make_tasks(request)
    return [out / "tasks" / suite / region for region in regions]


def answered(out: Path, matcher: str, tasks: list[Path], **options: Any) -> Path:
    """Ask a matcher, which a thread serves, every query of some tasks; return the folder of all runs."""
    with threaded():
        run(plan_run(RunRequest(spec=matcher, tasks=tasks, out=out, **options)))
    return out / "runs"


def scored(out: Path, name: str = "board", **options: Any) -> tuple[Any, ScoreRequest]:
    """Score all runs of a root on a board of that name; return the board, and what was asked for."""
    about = {"split": find_split("crossfit"), "draws": 100} | options
    request = ScoreRequest(predictions=[out / "runs"], root=out, board=out / "boards" / name, **about)
    return make_board(request), request
