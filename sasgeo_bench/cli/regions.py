# SPDX-License-Identifier: Apache-2.0
"""Commands that build regions and list them."""

import datetime as dt
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import (
    ExtractFolders,
    Out,
    RegionFolders,
    read_date,
    say,
    tell,
)
from sasgeo_bench.parallel import spread
from sasgeo_bench.regions.build import BuildPlan, build_region, plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file


def build_region_command(
    region: Annotated[list[str], typer.Argument(help="ids from list-regions, or files of your own (*.toml)")],
    date: Annotated[
        str | None, typer.Option(help="YYYY-MM-DD of one of the region's extracts; default: newest")
    ] = None,
    extracts: ExtractFolders = None,
    regions: RegionFolders = None,
    out: Out = Path("out"),
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be read and written, and stop")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="regions built at once")] = 1,
) -> None:
    """Build regions from dated extracts: layers, features, graph, manifest and preview in OUT/regions/<id>/."""
    day = read_date(date)
    plans = [_plan(name, out=out, date=day, extracts=extracts, regions=regions) for name in region]
    if dry_run:
        say("\n".join(plan.to_text() for plan in plans))
        return
    for _ in spread(_build, plans, jobs=jobs):
        pass


def _build(plan: BuildPlan) -> None:
    """Build in a process of its own; only there because a process pool needs a function it can name."""
    build_region(plan, tell=tell)


def _plan(
    name: str, *, out: Path, date: dt.date | None, extracts: list[Path] | None, regions: list[Path] | None
) -> BuildPlan:
    spec = read_region_file(find_region_file(name, folders=regions or ()))
    return plan_build(spec, out=out, date=date, extract_folders=extracts or ())
