# SPDX-License-Identifier: Apache-2.0
"""A video as a folder of photos: frames at a rate, each with place, height, gimbal, lens and time of its track."""

import datetime as dt
import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError, FlightError, ImageError, SasgeoError, StoreError, counted
from sasgeo_bench.core.folders import fresh_folder, locked, sha256_of
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import message_of, plain
from sasgeo_bench.flights.log_units import LOWEST_M
from sasgeo_bench.observing.pictures import STEEPEST_DEG
from sasgeo_bench.observing.tracks import Moment, Track, read_track
from sasgeo_bench.observing.video_motion import NEAR_S, STEP_S, Begin, Headings, MotionSeen, find_begin, find_headings
from sasgeo_bench.sensing.camera import Attitude
from sasgeo_bench.sensing.photos import Lens
from sasgeo_bench.sensing.video import EVERY_S, Due, Video

Floats = NDArray[np.float64]

FRAMES: Final = "frames"  # folder below the root of outputs

_RECORD: Final = "frames.json"
_VERSION: Final = 1  # raised when the same video gives other photos
_QUALITY: Final = 92  # of JPEGs
_SAMPLE: Final = 2**20  # bytes of each end of a video that tell it from others
_NUMBER: Final = re.compile("[0-9]+")
_ENDS_APART_S, _ENDS_APART = 3.0, 0.05  # seconds, and share of a video: its own track ends no farther from its end
_XMP: Final = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {}/></rdf:RDF></x:xmpmeta>"""


@dataclass(frozen=True, kw_only=True)
class VideoRequest:
    """A video whose frames become photos.

    Parameters
    ----------
    path : Path
        Of the video.
    out : Path
        Root of what is made: the photos get a folder in `out/frames`.
    track : Path, optional
        SRT, or a log of the flight; by default the SRT of the same name beside the video.
    every_s : float
        Seconds between frames.
    fov_deg : float, optional
        Horizontal field of view, degrees, in place of the focal length in an SRT.
    offset_s : float, optional
        Seconds of the track's clock at which the video begins; by default by the motion that both show. Times of an SRT
        are those of the video.
    needs_track : bool
        Whether frames without a place are of no use.
    needs_lens : bool
        Whether frames without a lens are of no use.

    Raises
    ------
    ConfigError
        If a number is out of range.
    """

    path: Path
    out: Path
    track: Path | None = None
    every_s: float = EVERY_S
    fov_deg: float | None = None
    offset_s: float | None = None
    needs_track: bool = True
    needs_lens: bool = True

    def __post_init__(self) -> None:
        if not 0.1 <= self.every_s <= 3600:
            raise ConfigError(f"--every lies within 0.1 and 3600 s, got {self.every_s!r}")
        if self.fov_deg is not None and not 5 <= self.fov_deg <= 115:
            raise ConfigError(f"--fov, the horizontal field of view, lies within 5 and 115 deg, got {self.fov_deg!r}")
        if self.offset_s is not None and not abs(self.offset_s) <= 1e6:
            raise ConfigError(f"--offset is seconds of the track at which the video begins, got {self.offset_s!r}")


def video_photos(request: VideoRequest) -> Path:
    """Write frames of a video as photos, and return their folder; a second call with the same words finds it.

    Each is a JPEG named by its time in the video, with EXIF and XMP as those of a drone's photo have them. Frames are
    left out, and counted, that the track does not cover, that are of take-off and landing, and that look too far up.

    Raises
    ------
    ImageError
        If the video cannot be decoded, or no frame is left.
    FlightError
        If there is no track, it is damaged, or it does not tell when the video began.
    ConfigError
        If the lens is not known.
    StoreError
        If the folder cannot be written; nothing is half-written.
    """
    video = Video.open(request.path)
    found = request.track or _beside(request.path)
    if found is None and request.needs_track:
        raise FlightError(_no_track(video))
    track = None if found is None else read_track(found)
    if track is not None and request.offset_s is not None and not track.has_own_clock:
        raise ConfigError(f"{plain(track.path.name)} counts from the video's begin: leave out --offset")
    if request.fov_deg is None and request.needs_lens and (track is None or track.film_mm is None):
        raise ConfigError(
            f"nothing says the lens of {plain(request.path.name)}: say --fov, the horizontal field of view in degrees"
        )
    absolute = request.path.absolute()
    stem = re.sub(r"[^a-z0-9]+", "-", absolute.stem.lower()).strip("-")[:40] or "video"
    folder = request.out / FRAMES / f"{stem}-{hashlib.sha256(str(absolute).encode()).hexdigest()[:6]}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    key = _key(request, found)
    with locked(folder):
        lines = _kept(folder, key)
        when = ", of an earlier call"
        if lines is None:
            lines, when = _written(_Cutter(request=request, video=video, track=track), folder, key), ""
    for line in lines[:-1]:
        tell(line)
    tell(f"{lines[-1]} in {folder}{when}")
    return folder


def _written(cutter: "_Cutter", folder: Path, key: str) -> list[str]:
    try:
        with fresh_folder(folder) as scratch:
            lines = cutter.cut(scratch)
            (scratch / _RECORD).write_text(json.dumps({"key": key, "lines": lines}) + "\n", encoding="utf-8")
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(f"{folder} cannot be written ({message_of(error)}): free some space, and run again") from error
    return lines


def _beside(path: Path) -> Path | None:
    """Return the subtitles that a drone writes beside a video."""
    return next((one for one in (path.with_suffix(end) for end in (".SRT", ".srt", ".Srt")) if one.is_file()), None)


def _no_track(video: Video) -> str:
    name, srt = plain(video.path.name), plain(video.path.with_suffix(".SRT").name)
    inside = f"take its subtitles out (ffmpeg -i {name} -map 0:s:0 {srt}), or " if video.has_subtitles else ""
    return (
        f"{name} has no track, such as {srt} beside it: {inside}say --track FILE (SRT, GPX, CSV, a drone's log), or "
        "locate it with --near LON,LAT or --region, --height and --fov"
    )


def _key(request: VideoRequest, track: Path | None) -> str:
    """Return the hash of all that photos follow from; of a video of gigabytes its ends, size and time tell it."""
    about = request.path.stat()
    with plain_file(request.path).open("rb") as file:
        ends = file.read(_SAMPLE)
        file.seek(max(0, about.st_size - _SAMPLE))
        ends += file.read(_SAMPLE)
    asked = [
        _VERSION,
        cv2.__version__,
        hashlib.sha256(ends).hexdigest(),
        about.st_size,
        about.st_mtime_ns,
        None if track is None else (track.name, sha256_of(track)),  # lines name it
        (request.every_s, request.fov_deg, request.offset_s),
    ]
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def _kept(folder: Path, key: str) -> list[str] | None:
    """Return what was told of the photos of an earlier call; None if there are none for the same words."""
    try:
        record = json.loads(plain_file(folder / _RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    lines = record.get("lines") if isinstance(record, dict) and record.get("key") == key else None
    return [str(line) for line in lines] if isinstance(lines, list) and lines else None


@dataclass(kw_only=True)
class _Cutter:
    """Cuts one video into photos."""

    request: VideoRequest
    video: Video
    track: Track | None
    headings: Headings | None = None
    lines: list[str] = field(default_factory=list)
    left_out: "Counter[str]" = field(default_factory=Counter)

    def cut(self, folder: Path) -> list[str]:
        """Write the photos into a folder; return lines for the user, the last of which sums up."""
        seen = MotionSeen() if self._needs_motion else None
        times_s = list(self._decoded(folder, seen))
        begin = self._begin(seen)
        self._find_headings(seen, begin)
        photos = 0
        for time_s in times_s:
            photos += self._finished(folder / self._name(time_s), time_s, begin)
        if not photos:
            why = self.left_out.most_common(1)
            raise ImageError(
                f"no frame of {plain(self.video.path.name)} can be used: {counted(why[0][1], 'frame')} {why[0][0]}"
                if why
                else f"{self.video.path} holds no frame that can be decoded: copy it again from the drone"
            )
        self._tell()
        name = plain(self.video.path.name)
        return [*self.lines, f"{counted(photos, 'frame')} of {name}, one every {self.request.every_s:g} s, as photos"]

    @property
    def _needs_motion(self) -> bool:
        """Return whether the motion that the video shows says what the track does not."""
        track = self.track
        if track is None:
            return False
        return track.camera_deg is None or (track.has_own_clock and self.request.offset_s is None)

    def _name(self, time_s: float) -> str:
        return f"{self.video.path.stem}_{time_s:09.3f}s.jpg"

    def _decoded(self, folder: Path, seen: MotionSeen | None) -> Iterator[float]:
        """Write frames without a word of where they are, and yield their times."""
        due = Due(self.request.every_s)
        label, done_s = f"seconds of {plain(self.video.path.name)}", 0
        all_s = max(1, math.ceil(self.video.length_s or 0.0))
        progress.begin(label, all_s)

        def is_wanted(time_s: float) -> bool:
            nonlocal done_s
            if time_s >= done_s + 1:
                progress.advance(label, int(time_s) - done_s)
                done_s = int(time_s)
            return seen is not None or self._is_used(time_s, Begin(time_s=self.request.offset_s or 0.0))

        every_s = self.request.every_s if seen is None else min(STEP_S, self.request.every_s)
        for frame in self.video.frames(every_s, is_wanted):
            if seen is not None:
                seen.add(frame.time_s, frame.rgb)
            if not due.is_now(frame.time_s):
                continue
            _, data = cv2.imencode(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            (folder / self._name(frame.time_s)).write_bytes(data.tobytes())
            yield frame.time_s
        progress.advance(label, max(0, all_s - done_s))

    def _is_used(self, time_s: float, begin: Begin) -> bool:
        """Return whether a frame becomes a photo; count why not."""
        moment = self._moment(time_s, begin)
        if isinstance(moment, str):
            self.left_out[moment] += 1
        return not isinstance(moment, str)

    def _moment(self, time_s: float, begin: Begin) -> Moment | str | None:
        """Return what the track says of a frame; why it is left out; or None without a track."""
        if self.track is None:
            return None
        found = self.track.at(time_s + begin.time_s)
        if isinstance(found, str):
            return found
        if found.height_m is not None and found.height_m < LOWEST_M:
            return f"less than {LOWEST_M:g} m above take-off"
        if found.camera is None and self.headings is not None:
            return replace(found, camera=Attitude(yaw_deg=self.headings.at(time_s), pitch_deg=-90.0))
        if found.camera is not None:
            tilt_deg = math.degrees(math.acos(np.clip(found.camera.matrix[2, 0], -1.0, 1.0)))
            if tilt_deg > STEEPEST_DEG:
                return f"that look more than {STEEPEST_DEG:g} degrees away from straight down"
        return found

    def _begin(self, seen: MotionSeen | None) -> Begin:
        """Return when the video began by the track's clock, and say how that is known."""
        track = self.track
        if track is None or not track.has_own_clock:
            return Begin(time_s=0.0)
        name = plain(track.path.name)
        if seen is None or self.request.offset_s is not None:
            begin = Begin(time_s=self.request.offset_s or 0.0)
            self.lines.append(f"{name}: the video begins at {begin.time_s:g} s of it, as --offset says")
            return begin
        created_s, start_s = self.video.created_s, track.log.start_s
        stated_s = None if created_s is None or start_s is None else created_s - start_s
        begin = find_begin(seen, track.log, name, stated_s=stated_s)
        about = f"{begin.time_s:.1f} s of it (+-{max(begin.sigma_s, 0.1):.1f})"
        line = f"{name}: the video begins at {about}, by the motion that it shows"
        if stated_s is not None:
            off_s = begin.time_s - stated_s
            side = "later" if off_s > 0 else "earlier"
            if abs(off_s) <= NEAR_S:
                line += f"; {abs(off_s):.1f} s {side} than by the clocks, which is taken into account"
            else:
                line += f"; clocks disagree: by them it is {stated_s:.1f} s (many cameras write local time as if UTC)"
        self.lines.append(line)
        return begin

    def _find_headings(self, seen: MotionSeen | None, begin: Begin) -> None:
        track = self.track
        if seen is None or track is None or track.camera_deg is not None:
            return
        self.headings = find_headings(seen, track.log, begin.time_s)
        heads = "of any heading"
        if self.headings is not None:
            heads = f"its up by the track's course and the motion seen (+-{self.headings.sigma_deg:.0f} deg)"
        self.lines.append(f"{plain(track.path.name)}: no angles of the camera: taken as looking straight down, {heads}")

    def _finished(self, path: Path, time_s: float, begin: Begin) -> bool:
        """Write into a photo what is known of it, or remove it; return whether it stays."""
        moment = self._moment(time_s, begin)
        if isinstance(moment, str):
            self.left_out[moment] += 1
            path.unlink()
            return False
        jpeg = path.read_bytes()
        exif, xmp = self._metadata(moment, time_s, begin)
        packet = b"http://ns.adobe.com/xap/1.0/\0" + xmp.encode()
        parts = [b"\xff\xe1" + (len(part) + 2).to_bytes(2, "big") + part for part in (exif.tobytes(), packet)]
        path.write_bytes(jpeg[:2] + b"".join(parts) + jpeg[2:])
        return True

    def _metadata(self, moment: Moment | None, time_s: float, begin: Begin) -> tuple[Image.Exif, str]:
        exif = Image.Exif()
        exif[ExifTags.Base.Software] = "sasgeo-bench"
        inner, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
        taken, zone = self._clock(time_s, begin)
        inner[ExifTags.Base.DateTimeOriginal] = f"{taken:%Y:%m:%d %H:%M:%S}"
        inner[ExifTags.Base.SubsecTimeOriginal] = f"{taken.microsecond // 1000:03d}"
        if zone:
            inner[ExifTags.Base.OffsetTimeOriginal] = zone
        said: dict[str, str] = {}
        focal_px = self._focal_px(None if moment is None else moment.film_mm)
        if focal_px is not None:
            width, height = self.video.size_px
            said |= {"CalibratedFocalLength": f"{focal_px:.3f}"}
            said |= {"CalibratedOpticalCenterX": f"{width / 2}", "CalibratedOpticalCenterY": f"{height / 2}"}
        if moment is not None:
            gps.update(_place(moment, self.track.sigma_m if self.track else None))
            if moment.height_m is not None:
                said["RelativeAltitude"] = f"{moment.height_m:+.3f}"
            if moment.altitude_m is not None and self.track is not None:
                said["AbsoluteAltitude"] = f"{moment.altitude_m:+.3f}"
                said["AltitudeType"] = "RtkAlt" if self.track.log.altitude_of == "ellipsoid" else "GpsFusionAlt"
            if moment.camera is not None:
                for angle in ("yaw", "pitch", "roll"):
                    value = getattr(moment.camera, f"{angle}_deg")
                    said[f"Gimbal{angle.title()}Degree"] = f"{value:+.2f}"
        return exif, _XMP.format(" ".join(f'drone-dji:{name}="{value}"' for name, value in said.items()))

    def _focal_px(self, film_mm: float | None) -> float | None:
        width, height = self.video.size_px
        if self.request.fov_deg is not None:
            return width / 2 / math.tan(math.radians(self.request.fov_deg) / 2)
        if film_mm is None:
            return None
        return Lens(film_mm=film_mm).focal_px(self.video.path.name, (max(width, height), min(width, height)))

    def _clock(self, time_s: float, begin: Begin) -> tuple[dt.datetime, str]:
        """Return when a frame was taken, and its zone if that is known: by the track, the video's head, or its file."""
        track = self.track
        if track is not None and track.began is not None:
            return track.began + dt.timedelta(seconds=time_s), ""
        if track is not None and track.has_own_clock and track.log.start_s is not None:
            return _utc(track.log.start_s + begin.time_s + time_s), "+00:00"
        if self.video.created_s is not None:
            return _utc(self.video.created_s + time_s), ""
        return _utc(self.video.path.stat().st_mtime + time_s), ""

    def _misfit(self, track: Track) -> str:
        """Return why a track by the video's clock does not look like that of this video; empty where it does."""
        if track.has_own_clock:
            return ""
        ours, theirs = self.video.path.stem.casefold(), track.path.stem.casefold()
        if ours != theirs and _NUMBER.sub("#", ours) == _NUMBER.sub("#", theirs):
            return "another number in its name"
        ends_s, length_s = float(track.time_s[-1]), self.video.length_s
        if length_s is None or abs(ends_s - length_s) <= max(_ENDS_APART_S, _ENDS_APART * length_s):
            return ""
        return f"it ends at {ends_s:.0f} s, the video at {length_s:.0f} s"

    def _tell(self) -> None:
        """Add what a user should know: of the track, of the lens, and of what was left out."""
        track, name = self.track, plain(self.video.path.name)
        if track is not None:
            self.lines[:0] = [f"{plain(track.path.name)}: {note}" for note in track.notes]
            odd = self._misfit(track)
            if odd:
                self.lines.insert(0, f"{plain(track.path.name)} may be of another video than {name}: {odd}")
            if track.sigma_m is not None:
                self.lines.append(f"{plain(track.path.name)}: places are rounded, good to {track.sigma_m:.1f} m")
            if track.began is None and track.log.start_s is None and self.video.created_s is None:
                self.lines.append(f"{name} says no date: that of its file is taken")
        else:
            self.lines.append(f"{name} has no track: frames have no place, and are taken as seen from straight above")
        if self.request.fov_deg is None and track is not None and track.film_mm is not None:
            self.lines.append(
                f"lens: {track.film_mm[0]:g} mm on 35 mm film, of the whole width of the sensor; a video that shows "
                "less than photos do needs --fov"
            )
        if self.video.is_cut_off:
            read_s, length_s = self.video.read_s, self.video.length_s or 0.0
            self.lines.append(f"{name} ends after {read_s:.1f} s, its head says {length_s:.1f} s: it is cut off")
        self.lines += [f"left out: {counted(count, 'frame')} {why}" for why, count in self.left_out.most_common()]


def _utc(time_s: float) -> dt.datetime:
    return dt.datetime.fromtimestamp(time_s, tz=dt.UTC)


def _place(moment: Moment, sigma_m: float | None) -> Mapping[int, object]:
    found: dict[int, object] = {ExifTags.GPS.GPSMapDatum: "WGS-84"}
    for value, tag, ends in zip(
        moment.lonlat, (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLatitude), ("EW", "NS"), strict=True
    ):
        micro = round(abs(value) * 3600e6)  # millionths of a second
        degrees, rest = divmod(micro, 3_600_000_000)
        minutes, rest = divmod(rest, 60_000_000)
        found[tag] = (IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(rest, 1_000_000))
        found[tag - 1] = ends[value < 0]
    if sigma_m is not None:
        found[ExifTags.GPS.GPSHPositioningError] = IFDRational(round(sigma_m * 100), 100)
    return found
