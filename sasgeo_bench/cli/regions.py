# SPDX-License-Identifier: Apache-2.0
"""Build regions: the function and its command."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar, cast

import typer

from sasgeo_bench.cli.console import read_date, say, shown_progress
from sasgeo_bench.cli.options import Dask, ExtractFolders, ImageryFolders, Options, Out, RegionFolders, takes
from sasgeo_bench.core.errors import ConfigError, SasgeoError, named
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import reported, spread, tell
from sasgeo_bench.regions import build
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.regions.region_spec import RegionFile, find_region_file, list_region_files, read_region_file
from sasgeo_bench.sensing.rendering.palettes import PALETTES
from sasgeo_bench.sensing.rendering.seasons import SEASONS

if TYPE_CHECKING:
    from sasgeo_bench.sensing.rendering.palettes import Family
    from sasgeo_bench.sensing.rendering.seasons import Season

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class BuildOptions(Options):
    """Flags of build-region."""

    region: Annotated[list[str] | None, typer.Argument(help="ids from list regions, or files of your own (*.toml)")] = (
        field(default=None, kw_only=False)
    )
    every: Annotated[
        bool, typer.Option("--every", help="all regions of --region-files, or without it all real places that ship")
    ] = False
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

    A region that is up to date is not built again. Of `every` region one that cannot be built costs no other.

    Returns
    -------
    tuple of Path
        Folder of each region: `out/regions/<id>`, of an older date `out/regions/<id>@<date>`.

    Raises
    ------
    ConfigError
        If no region is named, there is no such one, or none of that date; once all others are built, if some of `every`
        region could not be.
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
    wanted = _wanted(options)
    plan = partial(
        build.plan_build,
        out=options.out,
        date=read_date(options.date),
        extract_folders=options.extracts or (),
        imagery_folders=options.imagery or (),
        with_preview=True,
    )
    specs = [spec for spec in wanted.values() if spec is not None]
    if not options.every:
        plans = [plan(spec) for spec in specs]
    else:
        plans = [one for one in (_attempt(spec.id, partial(plan, spec)) for spec in specs) if one is not None]
    if options.dry_run:
        options.say("\n".join(plan.to_text() for plan in plans))
        return tuple(plan.folder for plan in plans)
    built = spread(
        reported(_build if options.every else build.build_region),
        plans,
        jobs=options.jobs,
        dask=options.dask,
        label="regions built",
    )
    done = {plan.spec.id for plan, found in zip(plans, built, strict=True) if found is not None}
    failed = [name for name in wanted if name not in done]
    if failed:
        raise ConfigError(f"not built: {named(failed, 'region')} of {len(wanted)}; the lines above say why")
    return tuple(plan.folder for plan in plans)


def _build(plan: build.BuildPlan) -> Manifest | None:
    return _attempt(plan.spec.id, partial(build.build_region, plan))


def _attempt(name: str, work: Callable[[], Result]) -> Result | None:
    """Do what one region needs; if that fails, a line says why, and the others are done."""
    try:
        return work()
    except SasgeoError as error:
        tell(f"{name}: not built: {error}")
        return None


def _wanted(options: BuildOptions) -> dict[str, RegionFile | None]:
    """Return the regions to build, by name; None, and a line, for one of `every` that cannot be read."""
    folders = options.region_files or ()
    if bool(options.region) == options.every:
        raise ConfigError("name regions to build, or build --every region, not both: list regions shows them")
    if not options.every:
        specs = [read_region_file(find_region_file(name, folders=folders)) for name in options.region or ()]
        return {spec.id: spec for spec in specs}
    if not folders:
        shipped = {name: read_region_file(path) for name, path in list_region_files().items()}
        return {name: spec for name, spec in shipped.items() if spec.extract[0].town is None}
    paths = [path for folder in folders for path in sorted(folder.glob("*.toml"))]
    if not paths:
        raise ConfigError(f"{', '.join(map(str, folders))}: no region file (*.toml) to build")
    return {path.stem: _attempt(path.stem, partial(read_region_file, path)) for path in paths}


@dataclass(frozen=True, kw_only=True)
class ProposeOptions(Options):
    """Flags of propose-regions."""

    manifest: Annotated[Path, typer.Argument(help="list of extracts (*.toml): file, place, country, what, date")] = (
        field(kw_only=False)
    )
    into: Annotated[Path, typer.Option(help="folder to write region files into")] = Path("my-regions")
    extracts: ExtractFolders = None
    jobs: Annotated[int, typer.Option(min=1, help="places read at once")] = 1


@takes(ProposeOptions)
def propose_regions(options: ProposeOptions) -> tuple[Path, ...]:
    """Write region files for the extracts of a manifest: one to three windows for each place, where it is built.

    A file that is there already stays as it is, and is not made anew if its extracts are the same; a place whose
    extracts have regions in the package is left out.

    Returns
    -------
    tuple of Path
        The region files of the manifest, those that were there among them.

    Raises
    ------
    ConfigError
        If the manifest cannot be read, or lacks a key.
    StoreError
        If a region file cannot be written.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.propose_regions("nowhere.toml")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: nowhere.toml cannot be read: name a manifest of extracts (*.toml)
    """
    from sasgeo_bench.regions.proposing import propose_regions as proposed  # noqa: PLC0415 - build-region needs none

    known = [read_region_file(path) for path in list_region_files().values()]
    there = {path.stem: path for path in sorted(options.into.glob("*.toml"))}
    written = {name: spec for name, path in there.items() if (spec := _read(path)) is not None}
    found = []
    for name, text in proposed(
        options.manifest, folders=options.extracts or (), known=known, written=written, jobs=options.jobs
    ):
        path = options.into / f"{name}.toml"
        found.append(path)
        if not os.path.lexists(path):
            with fresh_file(path, mend="name another folder by --into, or check your rights") as scratch:
                scratch.write_text(text, encoding="utf-8")
            options.say(path)
        elif not _holds(path, text):
            tell(f"{path}: kept, although the manifest gives another: remove it to have that")
    return tuple(found)


def _read(path: Path) -> RegionFile | None:
    """Return a region file that was written before; None if it is none."""
    try:
        return read_region_file(path)
    except SasgeoError:
        return None


def _holds(path: Path, text: str) -> bool:
    try:
        return plain_file(path).read_text(encoding="utf-8") == text
    except (OSError, UnicodeDecodeError):
        return False


def propose_regions_command(options: ProposeOptions) -> None:
    """Write region files for the extracts of a manifest: one to three windows for each place, where it is built."""
    with shown_progress():
        propose_regions(**vars(options) | {"say": say})


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
