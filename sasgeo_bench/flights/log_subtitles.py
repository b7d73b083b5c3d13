# SPDX-License-Identifier: Apache-2.0
"""Subtitles that drones of DJI write beside a video (SRT): place, height, gimbal and lens of its frames."""

import datetime as dt
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import numpy as np

from sasgeo_bench.core.errors import counted
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.flights.log_points import (
    MOST_BYTES,
    FlightLog,
    Floats,
    LogSource,
    altitude_note,
    tell_left_out,
)

_NUMBER: Final = r"[+-]?\d+(?:\.\d+)?"
# The end of a block is not used, so that one at 00:00:60,000 is as good as any.
_TIMES: Final = re.compile(r"^[ \t]*(\d+):(\d{1,2}):(\d{1,2})[,.](\d{1,6})[ \t]*-->.*$", re.MULTILINE)
_TAG: Final = re.compile(r"<[^<>]{0,200}>")
# Names are of 40 letters at most: without an end, a text of letters alone would take the square of its length.
_PAIR: Final = re.compile(rf"([A-Za-z_]{{1,40}})\s*:\s*({_NUMBER})(?![\d:])")  # several stand in one bracket
_CALL: Final = re.compile(
    r"([A-Za-z][A-Za-z.]{0,39})\s*\(([^()]{0,200})\)"
)  # as in GPS (8.5,47.4,12), G.PRY (-90.0, 0, 3)
_ABOVE_HOME: Final = re.compile(rf"\bH\s+({_NUMBER})\s*m\b(?!/s)")
_CLOCK: Final = re.compile(
    r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})[ T]+(\d{1,2}):(\d{2}):(\d{2})((?:[,.:]\d{1,6}){0,2})(?!\d)"
)
_OF_LOG: Final = ("time_s", "lon_deg", "lat_deg", "height_m", "altitude_m")
_LEAST_STEP_S: Final = 0.2  # between points: positions jump by a receiver's step, at a hundred blocks in a second
_RADIANS: Final = (np.pi, np.pi / 2)  # largest longitude and latitude
# Column -> by what keys it is known, the best first.
_KEYS: Final = {
    "height_m": ("rel_alt", "barometer", "h"),
    "altitude_m": ("abs_alt", "altitude"),
    "film_mm": ("focal_len",),
    "zoom": ("dzoom_ratio",),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Subtitles:
    """What the subtitles of a video say of N points, in order; None for what they do not have.

    Parameters
    ----------
    log : FlightLog
        Places, heights above take-off, altitudes, and the attitude of the body. Times count from the video's begin.
    gimbal_deg : ndarray, shape (N, 3), optional
        Yaw from true north, pitch (-90 is straight down) and roll of the camera, degrees.
    film_mm : ndarray, shape (N,), optional
        Focal length on 35 mm film, the digital zoom included.
    began : datetime, optional
        By the drone's clock when the video began; its zone is not said.
    """

    log: FlightLog
    gimbal_deg: Floats | None = None
    film_mm: Floats | None = None
    began: dt.datetime | None = None


def read_srt(path: Path) -> Subtitles:
    r"""Read the subtitles of a video; raise `FlightError` if they are damaged or hold no flight.

    A time is that of the block in the video. The drone's own clock has no zone, and dates the begin alone. Blocks at
    0, 0 have no fix and are left out. Between two changes of what is said nothing is known to have happened: repeated
    blocks are left out, too.

    Parameters
    ----------
    path : Path
        File of subtitles (.srt), as drones write it or as `ffmpeg -i VIDEO -map 0:s:0 FILE.srt` takes it out.

    Examples
    --------
    >>> import tempfile
    >>> said = "[latitude: 47.140{}] [longtitude: 9.52] [rel_alt: -0.5 abs_alt: 459.7]"
    >>> block = "{}\n00:00:0{},000 --> 00:00:0{},000\n" + said + "\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "DJI_0001.SRT")
    ...     _ = path.write_text("\n".join(block.format(at, at, at + 1, at) for at in (1, 2)))
    ...     found = read_srt(path)
    >>> found.log.time_s.tolist(), found.log.lat_deg.tolist(), found.log.height_m.tolist()
    ([1.0, 2.0], [47.1401, 47.1402], [-0.5, -0.5])
    """
    source = LogSource(path=path, unit="subtitle")
    blocks = list(_blocks(_text(source)))
    source.check_count(len(blocks))
    if not blocks:
        raise source.fault("holds no subtitles (00:00:01,000 --> 00:00:02,000): name the drone's own file")
    notes = []
    if len(blocks) > 1 and blocks[-1].is_open and not blocks[-2].is_open:
        notes.append("cut off: the file ends within a subtitle, and is read up to there")
        del blocks[-1]
    placed = [block for block in blocks if block.place is not None]
    if not placed:
        raise source.fault(
            f"no place in {counted(len(blocks), 'subtitle')}: switch on video captions in the drone's app, or name a "
            "log of the flight (--track)"
        )
    fixed = [block for block in placed if block.place != (0.0, 0.0)]
    if not fixed:
        raise source.fault("every place is 0, 0: the drone had no fix; name a log of the flight (--track)")
    if len(fixed) < len(placed):
        tell_left_out(source, len(placed) - len(fixed), "at 0, 0, where the drone had no fix")
    if len(placed) < len(blocks):
        tell_left_out(source, len(blocks) - len(placed), "without a place")
    return _Columns.of(source, fixed, notes).subtitles()


def _text(source: LogSource) -> str:
    source.check_size()
    try:
        with plain_file(source.path).open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise source.fault(f"cannot be read ({message_of(error)}): check its rights") from error
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace").replace("\r", "\n")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:  # a degree sign in Latin-1, say
        text = content.decode("latin-1")
    return text.replace("\r", "\n")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    """One subtitle: its number, its begin in the video, and what was found in its text."""

    number: int
    time_s: float
    values: Mapping[str, float]
    place: tuple[float, float] | None = None  # longitude, latitude
    has_units: bool = False  # whether the place ends in a height in M
    gimbal_deg: tuple[float, float, float] | None = None  # yaw, pitch, roll
    body_deg: tuple[float, float, float] | None = None
    clock: dt.datetime | None = None
    is_open: bool = False  # whether a bracket is not closed


def _blocks(text: str) -> Iterator[_Block]:
    """Yield subtitles by their lines of times: blank lines stand within them, too."""
    heads = list(_TIMES.finditer(text))
    for at, head in enumerate(heads):
        end = heads[at + 1].start() if at + 1 < len(heads) else len(text)
        hours, minutes, seconds, fraction = head.groups()
        time_s = 3600 * int(hours) + 60 * int(minutes) + int(seconds) + float(f"0.{fraction}")
        yield _block(at + 1, time_s, _TAG.sub(" ", text[head.end() : end]).replace("°", ""))


def _block(number: int, time_s: float, text: str) -> _Block:
    pairs = {name.lower(): value for name, value in _PAIR.findall(text)}
    calls = {name.upper(): [part.strip() for part in inside.split(",")] for name, inside in _CALL.findall(text)}
    values = {name: float(value) for name, value in pairs.items()}
    if above := _ABOVE_HOME.search(text):
        values["h"] = float(above[1])
    if (inside := calls.get("BAROMETER")) and (height := _floats(inside[:1])):
        values["barometer"] = height[0]
    # Some firmware writes "longtitude"; and numbers without a point: tenths of a millimetre, ten thousandths of a zoom.
    lon, lat = values.get("longitude", values.get("longtitude")), values.get("latitude")
    place = None if lon is None or lat is None else (lon, lat)
    third = ""
    inside = calls.get("GPS") or calls.get("RTK") or []
    if place is None and (pair := _floats(inside[:2])) and len(pair) == 2:
        place, third = (pair[0], pair[1]), inside[-1]
    for name, least, factor in (("focal_len", 100.0, 0.1), ("dzoom_ratio", 1000.0, 1e-4)):
        if name in values and "." not in pairs[name] and values[name] >= least:
            values[name] *= factor
    return _Block(
        number=number,
        time_s=time_s,
        values={key: values[key] for keys in _KEYS.values() for key in keys if key in values},
        place=place,
        has_units=third[-1:] in ("M", "m"),
        gimbal_deg=_angles(values, "gb_") or _pry(calls.get("G.PRY")),
        body_deg=_angles(values, "") or _pry(calls.get("F.PRY")),
        clock=_clock(text),
        is_open=any(text.count(begin) > text.count(end) for begin, end in ("[]", "()")),
    )


def _floats(parts: Sequence[str]) -> list[float]:
    """Return numbers, or nothing if one of the texts is none."""
    found = [re.fullmatch(rf"({_NUMBER})[Mm]?", part) for part in parts]
    return [float(one[1]) for one in found if one] if all(found) else []


def _angles(values: Mapping[str, float], start: str) -> tuple[float, float, float] | None:
    yaw, pitch, roll = (values.get(f"{start}{name}") for name in ("yaw", "pitch", "roll"))
    if yaw is None or (start and pitch is None):
        return None
    return (yaw, pitch or 0.0, roll or 0.0)


def _pry(inside: Sequence[str] | None) -> tuple[float, float, float] | None:
    """Return yaw, pitch, roll by DJI's pitch, roll, yaw."""
    found = _floats(inside or [])
    return (found[2], found[0], found[1]) if len(found) == 3 else None


def _clock(text: str) -> dt.datetime | None:
    found = _CLOCK.search(text)
    if found is None:
        return None
    fraction = re.sub(r"\D", "", found[7])  # milliseconds, and in some firmware microseconds after another comma
    try:
        moment = dt.datetime(*(int(found[at]) for at in range(1, 7)))  # type: ignore[arg-type] # noqa: DTZ001 - no zone
    except ValueError:
        return None
    return moment + dt.timedelta(seconds=float(f"0.{fraction or 0}"))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """Columns of the points of a flight, and what is to be told of them."""

    source: LogSource
    numbers: list[int]
    columns: dict[str, Floats]
    began: dt.datetime | None
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, source: LogSource, blocks: Sequence[_Block], notes: list[str]) -> Self:
        """Return the columns of blocks with places; one that not all of them have is none, which is noted."""
        columns: dict[str, Floats] = {"time_s": np.array([block.time_s for block in blocks])}
        columns["lon_deg"], columns["lat_deg"] = _degrees(blocks, notes).T
        for name, keys in _KEYS.items():
            found = [[block.values[key] for key in keys if key in block.values][:1] for block in blocks]
            if all(found):
                columns[name] = np.array(found)[:, 0]
            elif any(found):
                notes.append(f"{keys[0]} of {sum(map(bool, found))} of {counted(len(blocks), 'subtitle')}: not read")
        for name in ("gimbal_deg", "body_deg"):
            angles = [getattr(block, name) for block in blocks]
            if all(one is not None for one in angles):
                columns[name] = np.array(angles)
            elif any(one is not None for one in angles):
                known = sum(one is not None for one in angles)
                notes.append(f"angles of {known} of {counted(len(blocks), 'subtitle')}: not read")
        kept = _changes(columns)
        first = next((block for block in blocks if block.clock is not None), None)
        began = None if first is None or first.clock is None else first.clock - dt.timedelta(seconds=first.time_s)
        return cls(
            source=source,
            numbers=[blocks[at].number for at in kept],
            columns={name: column[kept] for name, column in columns.items()},
            began=began,
            notes=notes,
        )

    def subtitles(self) -> Subtitles:
        columns, notes = self.columns, self.notes
        of_log: dict[str, Floats] = {key: value for key, value in columns.items() if key in _OF_LOG}
        if "body_deg" in columns:
            of_log |= dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), columns["body_deg"].T, strict=True))
        if "height_m" in columns:
            notes.append("height: above the place of take-off")
        if "altitude_m" in columns:
            notes.append(altitude_note("unknown"))
        if "gimbal_deg" in columns:
            notes.append("angles of the camera: yaw, pitch and roll of the gimbal")
        if self.began is not None:
            notes.append(f"clock: the video began at {self.began:%Y-%m-%d %H:%M:%S}, of a zone that is not said")
        film_mm = columns.get("film_mm")
        return Subtitles(
            log=FlightLog.of(self.source, self.numbers, of_log, notes=tuple(notes)),
            gimbal_deg=columns.get("gimbal_deg"),
            film_mm=None if film_mm is None else film_mm * columns.get("zoom", np.ones(len(film_mm))),
            began=self.began,
        )


def _degrees(blocks: Sequence[_Block], notes: list[str]) -> Floats:
    """Return longitudes and latitudes, shape (N, 2); note where the file has them in another order or unit."""
    places = np.array([block.place for block in blocks])
    # GPS(lon,lat,satellites) of most drones; GPS(lat,lon,0.0M) of a Matrice 300 with an XT2.
    if all(block.has_units for block in blocks) or (np.abs(places[:, 1]) > 90).any():
        places = places[:, ::-1]
        notes.append("GPS: latitude first, as where its third value is in metres")
    # In degrees all of this is open sea: some firmware of the Mavic 2 writes radians.
    if (np.abs(places) <= _RADIANS).all():
        places = np.degrees(places)
        notes.append("latitude and longitude: in radians, since as degrees they lie in the sea off Africa")
    return np.asarray(places)


def _changes(columns: Mapping[str, Floats]) -> list[int]:
    """Return the points at which something changed since the one before, and the last."""
    time_s = columns["time_s"]
    said = np.column_stack([column for name, column in columns.items() if name != "time_s"])
    kept = [0]
    for at in range(1, len(time_s)):
        gained_s = time_s[at] - time_s[kept[-1]]
        is_last = at == len(time_s) - 1
        if gained_s < 0 or (gained_s > _LEAST_STEP_S - 1e-6 and (is_last or (said[at] != said[kept[-1]]).any())):
            kept.append(at)  # where time goes back, which the log refuses
    return kept
