# SPDX-License-Identifier: Apache-2.0
"""Build regions: the function and its command."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Final, TypeVar, cast

import numpy as np
import typer
from numpy.typing import NDArray

from sasgeo_bench.cli.built_regions import built_region
from sasgeo_bench.cli.console import read_date, say, shown_progress
from sasgeo_bench.cli.options import Dask, ExtractFolders, ImageryFolders, Options, Out, RegionFolders, takes
from sasgeo_bench.core.errors import ConfigError, ImageError, SasgeoError, counted, named
from sasgeo_bench.core.folders import absolute, fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import reported, spread, tell
from sasgeo_bench.regions import build
from sasgeo_bench.regions.packed_map import SUFFIX, UNPACKED, Weights, pack_map
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.regions.region_spec import (
    OWN_FOLDER,
    RegionFile,
    find_region_file,
    list_region_files,
    read_region_file,
)
from sasgeo_bench.sensing.rendering.palettes import PALETTES
from sasgeo_bench.sensing.rendering.seasons import SEASONS

if TYPE_CHECKING:
    from sasgeo_bench.regions.new_region import Place
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
        extract_folders=(*(options.extracts or ()), *_own_folders(options)),
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


def _own_folders(options: BuildOptions) -> list[Path]:
    """Return the folders of the user's own region files: extracts that were cut for them lie there."""
    named_files = [Path(name).parent for name in options.region or () if name.endswith(".toml")]
    return list(dict.fromkeys([*(options.region_files or ()), *named_files]))


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


PHOTOS: Final = (".jpg", ".jpeg", ".tif", ".tiff", ".dng")


@dataclass(frozen=True, kw_only=True)
class NewRegionOptions(Options):
    """Flags of new-region."""

    name: Annotated[str | None, typer.Argument(help="id of the region, such as my-town")] = field(
        default=None, kw_only=False
    )
    center: Annotated[str | None, typer.Option(help="LON,LAT of its middle, degrees; with --size")] = None
    size: Annotated[str | None, typer.Option(help="of its sides, such as 2km, 800m or 2x3km (width x height)")] = None
    bounds: Annotated[str | None, typer.Option(help="W,S,E,N, degrees; instead of --center")] = None
    photos: Annotated[
        Path | None, typer.Option(help="folder of photos: the place is where they are, and 500 m around")
    ] = None
    flight: Annotated[
        Path | None, typer.Option(help="log of a flight: the place is where it was flown, and 500 m around")
    ] = None
    vehicle: Annotated[int | None, typer.Option(help="system id of the vehicle in a .tlog of several")] = None
    country: Annotated[str | None, typer.Option(help="country of the place, for its provenance and for splits")] = None
    date: Annotated[
        str | None, typer.Option(help="YYYY, YYYY-MM or YYYY-MM-DD: take the extract nearest to it; default: newest")
    ] = None
    keep_cut: Annotated[
        bool, typer.Option("--keep-cut", help="cut the place out of its extract, and write the cut beside the file")
    ] = False
    extracts: ExtractFolders = None
    into: Annotated[Path, typer.Option(help="folder to write the region file into")] = OWN_FOLDER
    most_mb: Annotated[
        float, typer.Option(min=0, help="largest regional extract to download where none is at hand, MB; 0: none")
    ] = 500.0


@takes(NewRegionOptions)
def new_region(options: NewRegionOptions) -> Path:
    """Write the region file of a place: the newest extract at hand that covers it, and the kinds of its ground.

    Where none covers it, the line of the error names the regional extract to get; it is downloaded where there is a
    network. A file that is there already stays as it is.

    Returns
    -------
    Path
        The region file, `into/name.toml`, as `build_region` takes it.

    Raises
    ------
    ConfigError
        If the place is not given once, cannot be read or lies in two.
    ExtractError
        If no extract covers the place.
    StoreError
        If a file cannot be written, or is there and is of another region.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.new_region("my-town", center="47.15,109.52", size="2km")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: LON,LAT are degrees, and no latitude lies beyond 90, got '47.15,109.52': longitude comes first
    """  # noqa: E501 - an error is one line
    from sasgeo_bench.regions import new_region as one_region  # noqa: PLC0415 - build-region needs none

    if options.name is None:
        raise ConfigError("name the region, such as my-town: it becomes its id, and the name of its file")
    folders = options.extracts or []
    path = one_region.new_region(
        options.name,
        replace(_place(options), country=options.country),
        into=options.into,
        folders=folders,
        days=one_region.Days.read(options.date) if options.date else None,
        keep_cut=options.keep_cut,
        most_mb=options.most_mb,
    )
    options.say(path)
    more = "".join(f" --extracts {quote(str(folder))}" for folder in folders) if not options.keep_cut else ""
    tell(f"build it: sasgeo-bench build-region {quote(str(path))}{more}")
    return path


def _place(options: NewRegionOptions) -> "Place":
    from sasgeo_bench.regions.new_region import Place  # noqa: PLC0415 - as above

    ways = [way is not None for way in (options.center, options.bounds, options.photos, options.flight)]
    if sum(ways) != 1 or (options.size is not None) != (options.center is not None):
        raise ConfigError(
            "say where the region lies by --center LON,LAT and --size 2km, by --bounds, by --photos, or by --flight"
        )
    if options.vehicle is not None and options.flight is None:
        raise ConfigError("--vehicle tells which of several a log is of: give --flight, or leave it out")
    if options.center is not None:
        return Place.around(options.center, options.size or "")
    if options.bounds is not None:
        return Place.within(options.bounds)
    if options.flight is not None:
        return replace(Place.of_points(_flown_over(options.flight, options.vehicle), noun="point"), source="log")
    return replace(Place.of_points(_taken_at(options.photos or Path())), source="photos")


def _flown_over(log: Path, vehicle: int | None) -> NDArray[np.float64]:
    """Return longitude and latitude of points of a log, of a thousand or two at most."""
    from sasgeo_bench.flights.logs import read_places  # noqa: PLC0415 - as above

    lonlat = read_places(log, vehicle=vehicle)
    return lonlat[:: max(1, len(lonlat) // 1000)]


def _taken_at(folder: Path) -> NDArray[np.float64]:
    """Return longitude and latitude of the photos of a folder; a line names those that do not say theirs."""
    from sasgeo_bench.sensing.photos import read_photo  # noqa: PLC0415 - as above

    if not folder.is_dir():
        if not folder.exists():
            raise ConfigError(f"{folder} is not there: check the path of the photos")
        from sasgeo_bench.observing.pictures import ARCHIVES  # noqa: PLC0415 - as above

        kind = folder.suffix.lower()
        mend = f"name the folder of the photos, as {folder.parent}" if kind in PHOTOS else "say --flight for a log"
        mend = "unpack it, and name the folder of the photos" if kind in ARCHIVES else mend
        raise ConfigError(f"{folder} is a file: {mend}")
    paths = sorted(path for path in folder.iterdir() if path.name.lower().endswith(PHOTOS))
    if not paths:
        raise ConfigError(f"{folder} holds no photo ({', '.join(PHOTOS)}): name the folder that they lie in")
    lonlat, without, broken = [], [], []
    for path in paths:
        try:
            photo = read_photo(path)
        except ImageError as error:
            broken.append(error)
            continue
        if photo.lon_deg is None or photo.lat_deg is None:
            without.append(path.name)
        else:
            lonlat.append((photo.lon_deg, photo.lat_deg))
    if broken:
        tell(f"{counted(len(broken), 'photo')} of {len(paths)} cannot be read: {broken[0]}")
    if without:
        tell(f"{named(without, 'photo')} of {len(paths)} without a position")
    return np.array(lonlat, dtype=np.float64).reshape(-1, 2)


def new_region_command(
    options: NewRegionOptions,
    *,
    manifest: Annotated[
        Path | None, typer.Option(help="list of extracts (*.toml): a file for each of one to three windows of each")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="with --manifest, places read at once")] = 1,
) -> None:
    """Write the region file of a place: INTO/NAME.toml, from the newest extract at hand that covers it; or of many."""
    given = vars(options) | {"say": say}
    with shown_progress():
        if manifest is None:
            new_region(**given)
            return
        shared = {name: given.pop(name) for name in ("into", "extracts", "say", "tell", "progress")}
        other = [name for name, value in vars(NewRegionOptions()).items() if name in given and given[name] != value]
        if other:
            raise ConfigError(
                f"--manifest states the places itself: leave {other[0].replace('_', '-')} out, or leave out --manifest"
            )
        propose_regions(manifest, jobs=jobs, **shared)


@dataclass(frozen=True, kw_only=True)
class ProposeOptions(Options):
    """Keywords of propose_regions, as flags of new-region --manifest."""

    manifest: Annotated[Path, typer.Argument(help="list of extracts (*.toml): file, place, country, what, date")] = (
        field(kw_only=False)
    )
    into: Annotated[Path, typer.Option(help="folder to write region files into")] = OWN_FOLDER
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


def pack_map_command(
    region: Annotated[str, typer.Argument(help="built region, or its folder")],
    *,
    with_imagery: Annotated[
        bool, typer.Option("--with-imagery", help="pack the aerial imagery, too: it is far larger than the map")
    ] = False,
    learned: Annotated[
        Path | None,
        typer.Option(help="folder of a run, OUT/runs/MATCHER/HASH/SUITE/REGION: pack what it has learned, too"),
    ] = None,
    into: Annotated[Path | None, typer.Option(help="file to write, *.map; default: OUT/maps/REGION.map")] = None,
    out: Out = Path("out"),
) -> None:
    """Write what matching reads of a built region into one file, for a computer that builds no regions."""
    folder = built_region(region, out)
    path = into or out / UNPACKED / f"{absolute(folder).name}{SUFFIX}"
    weights = None if learned is None else _learned_by(learned)
    about = pack_map(folder, path, with_imagery=with_imagery, learned=weights)
    say(f"{path}: {about.to_text()}")


def _learned_by(run: Path) -> tuple[Weights, Path]:
    """Return who learned what in a run, and the file of that text."""
    from sasgeo_bench.matching.cards import read_learned  # noqa: PLC0415 - build-region needs none
    from sasgeo_bench.running.prediction_files import RunManifest  # noqa: PLC0415 - as above

    about = RunManifest.open(run)
    training = None if about is None else about.learned
    if about is None or training is None or training.file is None:
        what = "holds no run" if about is None else "is a run without training"
        raise ConfigError(f"{run} {what}: name one that was made with --train, as OUT/runs/MATCHER/HASH/SUITE/REGION")
    path = absolute(run).parent.parent / training.file
    if read_learned(path) is None:
        raise ConfigError(f"{path} is missing, which {run} says was learned: run again with the same --train")
    return Weights(matcher=about.matcher.name, trained_on=tuple(training.trained_on), pairs=training.pairs), path


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
