# SPDX-License-Identifier: Apache-2.0
"""Commands that draw queries and list the suites they are drawn by."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import (
    ExtractFolders,
    Out,
    OwnRegionFolders,
    say,
    tell,
)
from sasgeo_bench.cli.seeds import SeedFile, private_seed
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.parallel import spread
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.all_suites import SUITES, find_suite
from sasgeo_bench.tasks.task_plan import Request, Wanted, plan_requests, root_of


def make_queries_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    suite: Annotated[
        list[str] | None, typer.Option(help="name from list-suites; may be repeated; default: all but controls")
    ] = None,
    regions: Annotated[
        list[str] | None,
        typer.Option(
            "--regions", help="id from list-regions, or own file; may be repeated; default: all that can be built"
        ),
    ] = None,
    split: Annotated[str, typer.Option(help="id of a shipped split, or a file of your own (*.toml)")] = "crossfit",
    n: Annotated[int, typer.Option(help="sites in each region; each carries all the variants of a suite")] = 8,
    seed: Annotated[int | None, typer.Option(help="public seed, the root of all chance; default: 0")] = None,
    seed_file: SeedFile = None,
    prior: Annotated[
        str | None, typer.Option(help="prior group, as in r500-weak-s3; default: that of the suite")
    ] = None,
    extracts: ExtractFolders = None,
    region_folders: OwnRegionFolders = None,
    out: Out = Path("out"),
    up_to: Annotated[bool, typer.Option("--up-to", help="fewer sites where a region does not hold n")] = False,
    skip: Annotated[bool, typer.Option("--skip", help="pass over what a region cannot carry, and say so")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be drawn and written, and stop")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="regions at once")] = 1,
) -> None:
    """Draw queries into OUT/tasks/<suite>/<region>/ and their truths into OUT/truth/<suite>/<region>/."""
    private = private_seed(seed_file, public=seed)
    wanted = Wanted(
        suites=tuple(suite or SUITES),
        regions=tuple(regions or ()),
        split=split,
        count=n,
        seed=private or seed or 0,
        group=PriorGroup.parse(prior) if prior else None,
        extract_folders=tuple(extracts or ()),
        region_folders=tuple(region_folders or ()),
        out=root_of(out, private),
        may_be_fewer=up_to,
    )
    requests = plan_requests(wanted, tell=tell)
    if dry_run:
        for item in requests:
            per_site = len(find_suite(item.suite).variants) * len(find_suite(item.suite).card.tracks)
            folder = item.out / "tasks" / item.suite / item.region.id
            most = f"at most {item.count} sites, {item.count * per_site} queries"
            say(f"{item.suite} on {item.region.id}: {most}, {folder}")
        return
    by_region: dict[str, list[Request]] = {}
    for item in requests:
        by_region.setdefault(item.region.id, []).append(item)
    work = partial(_make_all, skip=skip)
    for _ in spread(work, list(by_region.values()), jobs=jobs):
        pass


def _make_all(requests: list[Request], *, skip: bool) -> None:
    """Make the tasks of one region in turn."""
    for request in requests:
        try:
            make_tasks(request, tell=tell)
        except ConfigError as error:
            if not skip:
                raise
            tell(f"{request.suite} on {request.region.id}: passed over, {error}")
