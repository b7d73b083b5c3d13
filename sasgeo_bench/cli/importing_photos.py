# SPDX-License-Identifier: Apache-2.0
"""Commands that make tasks of a user's own pictures and masks: import-photos, import-masks."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from sasgeo_bench.cli.built_regions import built_region
from sasgeo_bench.cli.console import said_after
from sasgeo_bench.cli.observing import VideoOptions
from sasgeo_bench.cli.options import Options, Out, takes
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.observing.import_masks import SUITE as MASKS
from sasgeo_bench.observing.import_masks import MaskRequest
from sasgeo_bench.observing.import_masks import import_masks as masks_imported
from sasgeo_bench.observing.import_photos import GROUP, SUITE, ImportRequest
from sasgeo_bench.observing.import_photos import import_photos as imported_by
from sasgeo_bench.observing.masks import read_legend
from sasgeo_bench.observing.photo_flights import OdometerName
from sasgeo_bench.observing.picture_poses import PoseFacts
from sasgeo_bench.observing.posed_pictures import GPS_SIGMA_M, Heights
from sasgeo_bench.sensing.video import is_video
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.task_files import Task

_NUMBER: Final = r"[+-]?[0-9]+(?:\.[0-9]+)?"
_ORIGIN: Final = re.compile(rf"\s*({_NUMBER})\s*,\s*({_NUMBER})\s*(?:,\s*({_NUMBER})\s*)?")


@dataclass(frozen=True, kw_only=True)
class PosedOptions(Options):
    """Flags of both commands: where pictures lie, how high they were taken, and what is known before."""

    region: Annotated[str, typer.Option(help="built region, or its folder")]
    poses: Annotated[Path | None, typer.Option(help="table of poses; default: EXIF and XMP of the photos")] = None
    epsg: Annotated[int | None, typer.Option(help="of a table's eastings and northings")] = None
    origin: Annotated[str | None, typer.Option(help="LON,LAT[,HEIGHT] of a table's metres east, north, up")] = None
    pitch_zero: Annotated[
        Literal["down", "horizon"] | None, typer.Option(help="where a table's plain pitch counts from")
    ] = None
    height: Annotated[float | None, typer.Option(help="of the cameras above the ground, metres")] = None
    dem: Annotated[Path | None, typer.Option(help="heights of the ground above the sea, a GeoTIFF")] = None
    takeoff_height: Annotated[float | None, typer.Option(help="altitude of the place of take-off, metres")] = None
    sigma: Annotated[
        float | None,
        typer.Option(help=f"standard deviation of positions that state none, metres; default: GPS, {GPS_SIGMA_M:g}"),
    ] = None
    prior: Annotated[str, typer.Option(help="prior group, as in r500-weak-s10")] = GROUP.name
    seed: Annotated[int, typer.Option(help="of priors and odometry")] = 0
    out: Out = Path("out")


@dataclass(frozen=True, kw_only=True)
class ImportPhotosOptions(VideoOptions, PosedOptions):
    """Flags of import-photos."""

    pictures: Annotated[
        Path, typer.Argument(help="folder of photos (JPEG, TIFF, PNG, WebP, GeoTIFF), or a video (MP4, MOV)")
    ] = field(kw_only=False)
    name: Annotated[str, typer.Option(help="suite of the task")] = SUITE
    odometry: Annotated[
        OdometerName,
        typer.Option(help="of flights: the truth with drawn errors, or found by matching pictures (visual)"),
    ] = "drawn"


@dataclass(frozen=True, kw_only=True)
class ImportMasksOptions(PosedOptions):
    """Flags of import-masks."""

    masks: Annotated[Path, typer.Argument(help="folder of masks (PNG, GeoTIFF, npy, npz), or a COCO file (json)")] = (
        field(kw_only=False)
    )
    legend: Annotated[Path, typer.Option(help="what values, colours, bands or categories mean (*.toml)")]
    photos: Annotated[
        Path | None, typer.Option(help="folder of the photos, of the same names; default: masks are georeferenced")
    ] = None
    name: Annotated[str, typer.Option(help="suite of the task")] = MASKS


@takes(ImportPhotosOptions)
def import_photos(options: ImportPhotosOptions) -> tuple[Task, ...]:
    """Make tasks of pictures of your own, whose places are known: single views, and flights.

    `segment` makes evidence of them, then `run` and `score` work as on any task. Positions come from the photos or a
    table (exiftool, CSV, GeoJSON, TUM, COLMAP, OpenDroneMap, Pix4D, Metashape); they are truths, and how far each is
    off is stored with it. Frames of a video get the poses of its track.

    Returns
    -------
    tuple of Task
        The task of single views, and that of flights where pictures follow each other.

    Raises
    ------
    ConfigError
        If an option makes no sense, or no picture can be asked.
    FlightError
        If a video has no track, or it does not tell when the video began.
    ImageError
        If there is no picture, or a video cannot be decoded.
    PoseError
        If the table cannot be read.
    StoreError
        If the region is missing or damaged.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.import_photos("photos", region="vaduz", height=80.0, takeoff_height=460.0)
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: heights come from one source: give --height, --dem or --takeoff-height alone
    """
    request = replace(_request(options, options.pictures), odometry=options.odometry)
    if options.track is not None and not is_video(options.pictures):
        options.check_of_video("every", "fov")
        request = replace(request, log=options.track, offset_s=options.offset)
    else:
        request = replace(request, pictures=options.photos_of(options.pictures, options.out))
    tasks = imported_by(request)
    for task in tasks:
        options.say(task.folder)
    return tasks


def _request(options: "ImportPhotosOptions | ImportMasksOptions", pictures: Path) -> ImportRequest:
    heights = Heights(height_m=options.height, dem=options.dem, takeoff_m=options.takeoff_height)
    return ImportRequest(
        pictures=pictures,
        region=built_region(options.region, options.out),
        out=options.out,
        name=options.name,
        poses=options.poses,
        facts=PoseFacts(epsg=options.epsg, origin=_origin(options.origin), pitch_zero=options.pitch_zero),
        heights=heights,
        sigma_m=options.sigma,
        group=PriorGroup.parse(options.prior),
        seed=options.seed,
    )


@takes(ImportMasksOptions)
def import_masks(options: ImportMasksOptions) -> tuple[Task, ...]:
    """Make tasks of masks or probabilities that your own network made of pictures whose places are known.

    Their evidence is there at once: `run` and `score` work as on any task. What the legend does not name is unknown,
    and said. Poses are as in `import_photos`: of the photos that the masks are of, of a table, or the masks' own.

    Returns
    -------
    tuple of Task
        The task of single views, and that of flights where pictures follow each other.

    Raises
    ------
    ConfigError
        If an option or the legend makes no sense, or no mask can be asked.
    ImageError
        If there is no mask.
    PoseError
        If the table cannot be read.
    StoreError
        If the region is missing or damaged.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.import_masks("masks", legend="nowhere.toml", region="vaduz")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: nowhere.toml cannot be read: name a legend (*.toml)
    """
    legend = read_legend(options.legend)
    photos = _request(options, options.photos or options.masks)
    tasks = masks_imported(MaskRequest(photos=photos, masks=options.masks, legend=legend))
    for task in tasks:
        options.say(task.folder)
    return tasks


def import_masks_command(options: ImportMasksOptions) -> None:
    """Make tasks of masks or probabilities that your own network made of pictures whose places are known."""
    with said_after() as say_later:
        import_masks(**vars(options) | {"say": say_later})


def import_photos_command(options: ImportPhotosOptions) -> None:
    """Make tasks of pictures of your own, whose places are known: single views, and flights."""
    with said_after() as say_later:
        import_photos(**vars(options) | {"say": say_later})


def _origin(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    found = _ORIGIN.fullmatch(text)
    if found is None:
        raise ConfigError(f"--origin is LON,LAT or LON,LAT,HEIGHT in degrees and metres, got {text!r}")
    return float(found[1]), float(found[2]), float(found[3] or 0.0)
