# SPDX-License-Identifier: Apache-2.0
"""Build regions: the function and its command."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import read_date, say, tell
from sasgeo_bench.cli.options import ExtractFolders, ImageryFolders, Options, Out, RegionFolders, takes
from sasgeo_bench.progress import spread
from sasgeo_bench.regions import build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file


@dataclass(frozen=True, kw_only=True)
class BuildOptions(Options):
    """Flags of build-region."""

    region: Annotated[list[str], typer.Argument(help="ids from list-regions, or files of your own (*.toml)")] = field(
        kw_only=False
    )
    date: Annotated[str | None, typer.Option(help="YYYY-MM-DD of one of the region's extracts; default: newest")] = None
    extracts: ExtractFolders = None
    imagery: ImageryFolders = None
    region_files: RegionFolders = None
    out: Out = Path("out")
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be read and written, and stop")] = False
    jobs: Annotated[int, typer.Option(min=1, help="regions built at once")] = 1


@takes(BuildOptions)
def build_region(options: BuildOptions) -> tuple[Path, ...]:
    """Build regions from dated extracts: layers, features, graph, imagery if there is any, manifest and preview.

    A region that is up to date is not built again.

    Returns
    -------
    tuple of Path
        Folder of each region: `out/regions/<id>`, of an older date `out/regions/<id>@<date>`.

    Raises
    ------
    ConfigError
        If there is no such region, or none of that date.
    ExtractError
        If an extract is not on this machine and cannot be downloaded.
    ImageryError
        If a picture of the region file is not on this machine, or cannot be used.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> folders = sgb.build_region(["town-grid", "town-suburb"], date="2019-01-01", dry_run=True)
    >>> [folder.as_posix() for folder in folders]
    ['out/regions/town-grid@2019-01-01', 'out/regions/town-suburb@2019-01-01']
    """
    specs = [read_region_file(find_region_file(name, folders=options.region_files or ())) for name in options.region]
    folders = {"extract_folders": options.extracts or (), "imagery_folders": options.imagery or ()}
    plans = [build.plan_build(spec, out=options.out, date=read_date(options.date), **folders) for spec in specs]
    if options.dry_run:
        options.say("\n".join(plan.to_text() for plan in plans))
    else:
        for _ in spread(partial(build.build_region, tell=options.tell), plans, jobs=options.jobs):
            pass
    return tuple(plan.folder for plan in plans)


def build_region_command(options: BuildOptions) -> None:
    """Build regions from dated extracts: layers, features, graph, imagery and preview in OUT/regions/<id>/."""
    build_region(**vars(options) | {"say": say, "tell": tell})
