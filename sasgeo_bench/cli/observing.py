# SPDX-License-Identifier: Apache-2.0
"""Commands for a user's own pictures: locate."""

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Final

import pyarrow as pa
import typer

from sasgeo_bench.cli.built_regions import built_region
from sasgeo_bench.cli.console import CONTESTANT_FAILED, complain, said_after, say
from sasgeo_bench.cli.options import Options, Out, takes
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import plain
from sasgeo_bench.observing.fixes import MATCHER, MOST_FALSE, RADIUS_M, SEGMENTER, Fix, Located, LocateRequest
from sasgeo_bench.observing.locate import locate as located_by
from sasgeo_bench.observing.pictures import Told
from sasgeo_bench.observing.results import PAGE, TABLE, Strips, write_results
from sasgeo_bench.regions.packed_map import is_packed_map, unpack_map
from sasgeo_bench.running.memory import be_lean
from sasgeo_bench.sensing.video import EVERY_S, is_video

_HEADING: Final = re.compile(r"([+-]?[0-9]+(?:\.[0-9]+)?)(?:\+-([0-9]+(?:\.[0-9]+)?))?")
_PAIR: Final = re.compile(r"\s*([+-]?[0-9]+(?:\.[0-9]+)?)\s*,\s*([+-]?[0-9]+(?:\.[0-9]+)?)\s*")
_SIGMA_DEG: Final = 10.0  # of a heading that is given alone


@dataclass(frozen=True, kw_only=True)
class VideoOptions(Options):
    """Flags of commands that take a video in place of pictures."""

    track: Annotated[
        Path | None, typer.Option(help="of a video: SRT, or a log that import-flight reads; default: the SRT beside it")
    ] = None
    every: Annotated[float | None, typer.Option(help=f"seconds between frames of a video; default: {EVERY_S:g}")] = None
    fov: Annotated[
        float | None, typer.Option(help="horizontal field of view of a video, degrees; default: by the SRT")
    ] = None
    offset: Annotated[
        float | None,
        typer.Option(help="seconds of the track at which a video begins; default: by the motion that both show"),
    ] = None

    def check_of_video(self, *names: str) -> None:
        """Raise `ConfigError` if options are given that only a video has."""
        for name in names:
            if getattr(self, name) is not None:
                raise ConfigError(f"--{name} is of a video, and these pictures are none: leave it out")

    def photos_of(self, pictures: Path, out: Path, *, needs_track: bool = True, needs_lens: bool = True) -> Path:
        """Return the folder of a video's frames, which are written if they are not there; anything else as it is."""
        if not is_video(pictures):
            self.check_of_video("track", "every", "fov", "offset")
            return pictures
        # Pictures need no reader of logs, which takes 40 MB.
        from sasgeo_bench.observing.video import VideoRequest, video_photos  # noqa: PLC0415

        request = VideoRequest(
            path=pictures,
            out=out,
            track=self.track,
            every_s=EVERY_S if self.every is None else self.every,
            fov_deg=self.fov,
            offset_s=self.offset,
            needs_track=needs_track,
            needs_lens=needs_lens,
        )
        return video_photos(request)


@dataclass(frozen=True, kw_only=True)
class SearchOptions(Options):
    """Flags of locate, but for those of a video."""

    pictures: Annotated[
        Path, typer.Argument(help="a picture, a folder of them (JPEG, PNG, WebP, GeoTIFF), or a video (MP4, MOV)")
    ] = field(kw_only=False)
    region: Annotated[
        str | None,
        typer.Option(help="built region, its folder, or a packed map (*.map); default: the newest that fits"),
    ] = None
    near: Annotated[str | None, typer.Option(help="LON,LAT of the middle of the search; default: the file's")] = None
    radius: Annotated[float, typer.Option(help="of the search, metres")] = RADIUS_M
    heading: Annotated[
        str | None, typer.Option(help="of the picture's up, DEG or DEG+-DEG from true north, or 'any'")
    ] = None
    height: Annotated[float | None, typer.Option(help="of the camera above the ground, metres")] = None
    ground_width: Annotated[float | None, typer.Option(help="width of the ground in each picture, metres")] = None
    dem: Annotated[
        Path | None,
        typer.Option(help="GeoTIFF of the ground's heights, for photos with an altitude and no height above take-off"),
    ] = None
    matcher: Annotated[str, typer.Option(help="name from list matchers, or module:Class")] = MATCHER
    segmenter: Annotated[str, typer.Option(help="name from list segmenters, with weights, or module:Class")] = SEGMENTER
    exif_position: Annotated[
        bool, typer.Option("--exif-position/--no-exif-position", help="search around the position in the file")
    ] = True
    most_false: Annotated[float, typer.Option(help="P(false fix) up to which a fix is accepted")] = MOST_FALSE
    trusted: Annotated[bool, typer.Option("--trusted", help="run without the sandbox")] = False
    into: Annotated[Path | None, typer.Option(help="folder of the results; default: OUT/locate/NAME")] = None
    out: Out = Path("out")


@dataclass(frozen=True, kw_only=True)
class LocateOptions(VideoOptions, SearchOptions):
    """Flags of locate."""


@takes(LocateOptions)
def locate(options: LocateOptions) -> Located:
    """Find out where pictures were taken, and how far to trust it; a page shows what was seen and where it fits.

    The position in a file is the middle of nothing: it lies anywhere in the disc that is searched, so that it can be
    no answer. A second call goes on where the first was cut off; if every picture fails, results of an earlier call
    stay. A video is located by frames of it, which get places, heights and angles of its track.

    Returns
    -------
    Located
        A fix for each picture, in their order, and the map. Tables and a page lie in `into`.

    Raises
    ------
    ConfigError
        If an option makes no sense, or no built region holds the place.
    FlightError
        If a video has no track, or it does not tell when the video began.
    ImageError
        If there is no picture, or a video cannot be decoded. A picture that cannot be read is a row, no error.
    MatchError
        If the matcher or the segmenter cannot be loaded.
    StoreError
        If the region is missing or damaged, or the results cannot be written.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.locate("garden.jpg")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ImageError: there is no picture or folder garden.jpg: check the path
    """
    if options.region is not None and is_packed_map(Path(options.region)):
        weights = unpack_map(options.region, options.out).about.weights
        if weights is not None:
            tell(f"what {weights.matcher} has learned is left packed: P(false fix) is calibrated without it")
    if options.dem is not None and not options.dem.is_file():
        raise ConfigError(f"there is no file of heights {options.dem}: check the path")
    into = options.into or options.out / "locate" / _name_of(options.pictures)
    heading = None if options.heading in (None, "any") else _heading(options.heading or "")
    request = LocateRequest(
        pictures=options.pictures,
        out=options.out,
        into=into,
        region=None if options.region is None else built_region(options.region, options.out),
        near=None if options.near is None else _lonlat(options.near),
        radius_m=options.radius,
        heading=heading,
        is_turned=options.heading == "any",
        told=Told(height_m=options.height, ground_width_m=options.ground_width, dem=options.dem),
        matcher=options.matcher,
        segmenter=options.segmenter,
        uses_position=options.exif_position,
        most_false=options.most_false,
        is_sandboxed=not options.trusted,
    )
    frames = options.photos_of(
        options.pictures,
        options.out,
        needs_track=request.near is None and request.region is None,
        needs_lens=options.ground_width is None,
    )
    found = located_by(replace(request, pictures=frames), lambda region: Strips(into, region))
    for fix in found.fixes:
        options.say(line_of(fix))
    answered = [found.calibration] if any(fix.p_false is not None for fix in found.fixes) else []
    for note in (*answered, *notes_of(found.fixes)):
        tell(note)
    if all(fix.status == "failed" for fix in found.fixes) and (into / TABLE).is_file():
        tell(f"no picture could be asked: {into} keeps the results of an earlier call")
    else:
        write_results(found)
    return found


def line_of(fix: Fix) -> str:
    """Return what a terminal shows of a fix.

    >>> line_of(Fix(file="a.jpg", status="failed", reason="damaged"))
    'a.jpg: failed: damaged'
    """
    words: list[str] = [fix.status]
    if fix.lon is not None and fix.heading_deg is not None:
        words.append(f"lon,lat {fix.lon:.6f},{fix.lat:.6f} ({fix.x_m:.0f} m east, {fix.y_m:.0f} m north)")
        words.append(f"heading {fix.heading_deg:.0f} deg")
    if fix.p_false is not None:
        words.append(f"P(false fix) {fix.p_false:.3f}")
    if fix.file_distance_m is not None:
        words.append(f"{fix.file_distance_m:.0f} m from the file's position")
    text = f"{plain(fix.file)}: {', '.join(words)}"
    return f"{text}: {fix.reason}" if fix.reason else text


def notes_of(fixes: Sequence[Fix]) -> list[str]:
    """Return each note with how many pictures it is of.

    >>> notes_of([Fix(file=name, status="found", note="taken as seen from straight above") for name in "ab"])
    ['2 pictures: taken as seen from straight above']
    """
    counts = Counter(fix.note for fix in fixes if fix.note)
    return [f"{counted(count, 'picture')}: {note}" for note, count in counts.most_common()]


def locate_command(options: LocateOptions) -> None:
    """Find out where pictures of your own were taken, and how far to trust it: a line for each, tables and a page."""
    be_lean()
    pa.set_memory_pool(pa.system_memory_pool())  # Arrow's own keeps what was freed
    with said_after() as say_later:
        found = locate(**vars(options) | {"say": say_later})
    counts = Counter(fix.status for fix in found.fixes)
    say(", ".join(f"{count} {status}" for status, count in counts.most_common()))
    say(found.request.into / PAGE)
    failed = sum(fix.status == "failed" for fix in found.fixes)
    if failed:
        complain(f"{failed} of {len(found.fixes)} pictures could not be asked; their lines say why")
        raise typer.Exit(CONTESTANT_FAILED)


def _name_of(pictures: Path) -> str:
    """Return a name for the results of a file or folder; of unlike paths it is another one."""
    path = pictures.absolute()
    stem = re.sub(r"[^a-z0-9]+", "-", path.stem.lower()).strip("-")[:40] or "pictures"
    return f"{stem}-{hashlib.sha256(str(path).encode()).hexdigest()[:6]}"


def _lonlat(text: str) -> tuple[float, float]:
    found = _PAIR.fullmatch(text)
    if found is None:
        raise ConfigError(f"--near is LON,LAT in degrees, as in 9.52,47.14, got {text!r}")
    return float(found[1]), float(found[2])


def _heading(text: str) -> tuple[float, float]:
    found = _HEADING.fullmatch(text.replace(" ", ""))
    if found is None or not (found[2] is None or 0 < float(found[2]) <= 180):
        raise ConfigError(f"--heading is DEG, DEG+-DEG or 'any', as in 270+-15, got {text!r}")
    return float(found[1]), _SIGMA_DEG if found[2] is None else float(found[2])
