# SPDX-License-Identifier: Apache-2.0
"""Build regions: the function and its command."""

from collections import deque
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from sasgeo_bench.cli.console import read_date, say, shown_progress
from sasgeo_bench.cli.options import Dask, ExtractFolders, ImageryFolders, Options, Out, RegionFolders, takes
from sasgeo_bench.core.progress import reported, spread
from sasgeo_bench.regions import build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sensing.rendering.palettes import PALETTES
from sasgeo_bench.sensing.rendering.seasons import SEASONS

if TYPE_CHECKING:
    from sasgeo_bench.sensing.rendering.palettes import Family
    from sasgeo_bench.sensing.rendering.seasons import Season


@dataclass(frozen=True, kw_only=True)
class BuildOptions(Options):
    """Flags of build-region."""

    region: Annotated[list[str], typer.Argument(help="ids from list regions, or files of your own (*.toml)")] = field(
        kw_only=False
    )
    date: Annotated[str | None, typer.Option(help="YYYY-MM-DD of one of the region's extracts; default: newest")] = None
    extracts: ExtractFolders = None
    imagery: ImageryFolders = None
    region_files: RegionFolders = None
    out: Out = Path("out")
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be read and written, and stop")] = False
    jobs: Annotated[int, typer.Option(min=1, help="regions built at once")] = 1
    dask: Dask = None


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
    plans = [
        build.plan_build(
            spec,
            out=options.out,
            date=read_date(options.date),
            extract_folders=options.extracts or (),
            imagery_folders=options.imagery or (),
            with_preview=True,
        )
        for spec in specs
    ]
    if options.dry_run:
        options.say("\n".join(plan.to_text() for plan in plans))
    else:
        built = spread(reported(build.build_region), plans, jobs=options.jobs, dask=options.dask, label="regions built")
        deque(built, maxlen=0)
    return tuple(plan.folder for plan in plans)


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Options):
    """Flags of render-imagery."""

    region: Annotated[list[str], typer.Argument(help="ids from list regions, or files of your own; built before")] = (
        field(kw_only=False)
    )
    date: Annotated[str | None, typer.Option(help="YYYY-MM-DD of the map that is shown; default: newest")] = None
    family: Annotated[str, typer.Option(help=f"palette: {', '.join(PALETTES)}")] = "calibration"
    season: Annotated[str, typer.Option(help=", ".join(SEASONS))] = "autumn"
    gsd_m: Annotated[float, typer.Option(help="side of a pixel on the ground, metres, 0.25 to 2")] = 0.5
    seed: Annotated[int, typer.Option(min=0, help="random seed of the rendering")] = 0
    extracts: ExtractFolders = None
    region_files: RegionFolders = None
    out: Out = Path("out")
    jobs: Annotated[int, typer.Option(min=1, help="regions rendered at once")] = 1


@takes(RenderOptions)
def render_imagery(options: RenderOptions) -> tuple[Path, ...]:
    """Render reference imagery of built regions: `ortho.tif`, of any of their dates, in a look that no query has.

    The map's hash stays: tasks stay valid, and so do answers of methods that look at no imagery.

    Returns
    -------
    tuple of Path
        The image of each region.

    Raises
    ------
    ConfigError
        If there is no such region, date, family, season or resolution.
    StoreError
        If a region is not built, or cannot be written.
    ImageryError
        If a region has real imagery, or nothing to draw.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.render_imagery(["town-grid"], season="monsoon")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: season is one of spring, summer, autumn, winter, snow, got 'monsoon'
    """
    from sasgeo_bench.sensing.reference_imagery import Look, render_place  # noqa: PLC0415 - build-region needs none

    look = Look(
        family=cast("Family", options.family),
        season=cast("Season", options.season),
        gsd_m=options.gsd_m,
        seed=options.seed,
    )
    specs = [read_region_file(find_region_file(name, folders=options.region_files or ())) for name in options.region]
    render = partial(
        render_place,
        look=look,
        date=read_date(options.date),
        out=options.out,
        extract_folders=options.extracts or (),
    )
    return tuple(spread(reported(render), specs, jobs=options.jobs, label="regions rendered"))


def render_imagery_command(options: RenderOptions) -> None:
    """Render reference imagery of built regions: OUT/regions/<id>/ortho.tif, of any date, in a look no query has."""
    with shown_progress():
        paths = render_imagery(**vars(options))
    for path in paths:
        say(path)


def build_region_command(options: BuildOptions) -> None:
    """Build regions from dated extracts: layers, features, graph, imagery and preview in OUT/regions/<id>/."""
    with shown_progress():
        build_region(**vars(options) | {"say": say})
