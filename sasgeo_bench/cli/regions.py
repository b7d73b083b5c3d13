# SPDX-License-Identifier: Apache-2.0
"""Commands that build regions and list them."""

import datetime as dt
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sasgeo_bench.build import BuildPlan, build_region, plan_build
from sasgeo_bench.cli.console import (
    ExtractFolders,
    Out,
    RegionFolders,
    print_table,
    read_date,
    say,
    tell,
)
from sasgeo_bench.processes import spread
from sasgeo_bench.store.catalog import (
    find_region_file,
    list_region_files,
    read_region_file,
)


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


def list_regions_command(regions: RegionFolders = None) -> None:
    """List the regions that come with the package, and your own."""
    table = Table("id", "title", "km2", "cell", "dates", "scenes", box=None, pad_edge=False)
    for name, path in sorted(list_region_files(folders=regions or ()).items()):
        spec = read_region_file(path)
        grid = spec.grid()
        area_km2 = grid.rows * grid.cols * grid.cell_size_m**2 / 1e6
        dates = [extract.date.isoformat() for extract in spec.extract]
        shown = dates[0] if len(dates) == 1 else f"{dates[0]} .. {dates[-1]} ({len(dates)})"
        table.add_row(name, spec.title, f"{area_km2:.1f}", f"{grid.cell_size_m:g} m", shown, ", ".join(spec.scenes))
    print_table(table)
