# SPDX-License-Identifier: Apache-2.0
"""Tables of poses with named columns: CSV, GeoJSON, what exiftool prints, and text of Pix4D and Metashape."""

import csv
import datetime as dt
import io
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self, cast

import numpy as np
import pyproj
from pyproj.exceptions import CRSError
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import CameraError, PoseError, counted, named
from sasgeo_bench.core.paths import read_bounded
from sasgeo_bench.core.texts import message_of, plain
from sasgeo_bench.flights.log_formats import key_of
from sasgeo_bench.flights.log_units import UNITS, WORDS
from sasgeo_bench.geometry.projection import WGS84, has_open_datum
from sasgeo_bench.observing.picture_poses import (
    SWAPPED,
    AltitudeOf,
    Clock,
    HeightOf,
    PicturePose,
    PoseFacts,
    attitude_of,
    check_crs,
    convergence_deg,
    metres_of_unit,
    picture_heading_deg,
    turn_about_up,
)
from sasgeo_bench.sensing.camera import Attitude, Intrinsics
from sasgeo_bench.sensing.photos import DJI, PIX4D, Lens, camera_angles, datum_fault, is_ellipsoidal, positive_of

MOST_BYTES: Final = 300_000_000  # of a table: reconstructions hold the points of the ground as well
KNOWN: Final = (
    "CSV with a header (as of exiftool -csv), exiftool -json, GeoJSON of points, TUM, COLMAP images.txt or images.bin, "
    "OpenDroneMap reconstruction.json or shots.geojson, Pix4D geolocation or calibrated_external_camera_parameters, "
    "Metashape XML or text"
)
_IMAGE_TO_CAMERA: Final = np.diag([1.0, -1.0, -1.0])  # photogrammetry's right, up, back to right, down, ahead


@dataclass(frozen=True, kw_only=True)
class Read:
    """What a reader found, before places are checked."""

    kind: str
    poses: Sequence[PicturePose]
    left_out: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def bytes_of(path: Path) -> bytes:
    """Return the bytes of a table, `MOST_BYTES` at most; raise `PoseError` if it cannot be read."""
    try:
        return read_bounded(path, MOST_BYTES)
    except OSError as error:
        raise PoseError(f"{path} cannot be read ({error.strerror or error}): check the path") from error


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """Names of columns, and the cells of each row with what a message calls it (its line or number)."""

    kind: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, Sequence[str]]]
    pitch_zero: str | None = None
    epsg: int | None = None
    notes: tuple[str, ...] = ()


# Field -> names of columns as `key_of` makes them, without unit, best first.
_NAMES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "name": (
            *("source_file", "file_name", "filename", "file", "image_name", "imagename", "image", "image_file"),
            *("image_path", "photo", "photo_name", "photo_id", "picture", "label", "path", "name"),
        ),
        "latitude": ("latitude", "lat", "gpslatitude", "gps_latitude", "gps_lat", "y_latitude"),
        "longitude": ("longitude", "lon", "lng", "long", "gpslongitude", "gps_longitude", "gps_lon", "x_longitude"),
        "both": ("gpsposition", "gps_position"),
        "latitude_ref": ("gpslatitude_ref", "latitude_ref", "lat_ref", "latitude_hemisphere", "lat_hemisphere"),
        "longitude_ref": ("gpslongitude_ref", "longitude_ref", "lon_ref", "longitude_hemisphere", "lon_hemisphere"),
        "east": ("x_est", "x", "easting", "east", "e", "x_east", "x_easting", "utm_x", "utm_e", "utm_easting"),
        "north": ("y_est", "y", "northing", "north", "n", "y_north", "y_northing", "utm_y", "utm_n", "utm_northing"),
        "take-off": (
            *("relative_altitude", "rel_altitude", "relative_alt", "rel_alt", "height_above_takeoff"),
            "height_above_take_off",
        ),
        "ground": ("agl", "height_agl", "alt_agl", "altitude_agl", "above_ground_altitude", "height_above_ground"),
        "sea": ("absolute_altitude", "abs_alt", "gpsaltitude", "gps_altitude", "amsl", "alt_msl", "altitude_msl"),
        "sea_ref": ("gpsaltitude_ref",),
        "sea_type": ("altitude_type",),
        "datum": ("gpsmap_datum",),
        "ellipsoid": ("ellipsoidal_height", "ellipsoid_height", "altitude_ellipsoidal", "alt_ellipsoid"),
        "unstated": ("z_est", "altitude", "alt", "z", "z_altitude", "z_height", "elevation", "ele"),
        "gimbal_yaw": ("gimbal_yaw_degree", "gimbal_yaw", "camera_yaw_degree", "camera_yaw"),
        "gimbal_pitch": ("gimbal_pitch_degree", "gimbal_pitch", "camera_pitch_degree", "camera_pitch"),
        "gimbal_roll": ("gimbal_roll_degree", "gimbal_roll", "camera_roll_degree", "camera_roll"),
        "flight_yaw": ("flight_yaw_degree", "flight_yaw", "heading", "hdg", "compass_heading", "gpsimg_direction"),
        "direction_ref": ("gpsimg_direction_ref",),
        "yaw": ("yaw_est", "yaw"),
        "pitch": ("pitch_est", "pitch"),
        "roll": ("roll_est", "roll"),
        "omega": ("omega_est", "omega"),
        "phi": ("phi_est", "phi"),
        "kappa": ("kappa_est", "kappa"),
        "sigma": (
            *("gpshpositioning_error", "horizontal_accuracy", "accuracy_horizontal", "accuracy_horz", "accuracy_h"),
            *("h_acc", "hacc", "gpsxyaccuracy", "position_sigma", "sigma", "accuracy", "xy_accuracy"),
        ),
        "sigma_east": ("rtk_std_lon", "x_accuracy", "accuracy_x", "sigma_x", "std_x", "sd_e", "sde"),
        "sigma_north": ("rtk_std_lat", "y_accuracy", "accuracy_y", "sigma_y", "std_y", "sd_n", "sdn"),
        "time": (
            *("sub_sec_date_time_original", "date_time_original", "datetime_original", "create_date", "capture_time"),
            *("date_time", "datetime", "taken_at", "timestamp", "time", "gpsdate_time", "utc", "date_time_utc"),
        ),
        "parts": ("sub_sec_time_original",),
        "zone": ("offset_time_original", "offset_time"),
        "make": ("make",),
        "film": ("focal_length_in35mm_format", "focal_length_in35mm_film"),
        "focal": ("focal_length",),
        "calibrated": ("calibrated_focal_length",),
        "centre_x": ("calibrated_optical_center_x",),
        "centre_y": ("calibrated_optical_center_y",),
        "width": ("image_width", "exif_image_width"),
        "height": ("image_height", "exif_image_height"),
        "zoom": ("digital_zoom_ratio",),
        "orientation": ("orientation",),
    }
)
_QUANTITY: Final = MappingProxyType(
    dict.fromkeys(("latitude", "longitude"), "place")
    | dict.fromkeys(("take-off", "ground", "sea", "ellipsoid", "unstated", "east", "north"), "height")
    | dict.fromkeys(("sigma", "sigma_east", "sigma_north"), "height")
    | dict.fromkeys(("gimbal_yaw", "gimbal_pitch", "gimbal_roll", "flight_yaw", "yaw", "pitch", "roll"), "angle")
    | dict.fromkeys(("omega", "phi", "kappa"), "angle")
    | {"time": "time"}
)
_FIELD_OF: Final = MappingProxyType(
    {key: (name, rank) for name, keys in _NAMES.items() for rank, key in enumerate(keys)}
)
_UNKNOWN: Final = frozenset({"", "nan", "null", "none", "na", "n/a", "-", "--", "undef", "inf", "unknown"})
_NUMBER: Final = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?:/([-+]?\d+(?:\.\d+)?))?")
# A number, its unit, and what exiftool prints after that of an altitude.
_MEASURED: Final = re.compile(r"(.*[\d.])\s*([A-Za-z]+|\u00b0)(?: (?:above|below) sea level)?", re.IGNORECASE)
_LENS_UNITS: Final = ("mm", "px", "pixels")
_RADIANS: Final = (0.02, 3.15)  # of the largest angle of a table that may be in radians; a smaller one is next to none
# By which two columns of one meaning may differ: degrees of a place, metres of one, degrees of an angle.
_ALIKE: Final = MappingProxyType({"place": 1e-5, "height": 1.0, "angle": 0.1})
_MINUTE, _SECOND = "['\u2032\u2019m]", "(?:[\"\u2033\u201ds]|'')"
_DEGREES: Final = re.compile(  # capitals alone are sides: "s" are seconds
    r"(?P<first>[NSEW])?\s*(?P<sign>[-+])?\s*(?P<deg>\d+(?:\.\d+)?)\s*(?:deg|d|[\u00b0\u00ba])?"
    rf"(?:(?:(?<=[d\u00b0\u00bag])\s*|[\s,]+)(?P<min>[0-5]?\d(?:\.\d+)?)\s*{_MINUTE}?"
    rf"(?:(?:(?<={_MINUTE})\s*|\s+)(?P<sec>[0-5]?\d(?:\.\d+)?)\s*{_SECOND}?)?)?"
    r"\s*(?P<last>[NSEW])?"
)
_MOMENT: Final = re.compile(
    r"(\d{4})[-:/.](\d\d)[-:/.](\d\d)[ T](\d\d):(\d\d):(\d\d)(?:[.,](\d+))?\s*(Z|UTC|GMT|[-+]\d\d(?::?\d\d)?)?"
)
_PLAIN_UNIT: Final = re.compile(r"[\[(](?:decimal )?(?:degrees?|units?)[\])]", re.IGNORECASE)
_LETTERS: Final = MappingProxyType({"longitude": "EW", "latitude": "NS"})
_BODY: Final = ("yaw", "pitch", "roll")
_NO_PLACE, NO_NUMBER = "without a position", "whose position is no number"
_NO_SIDE: Final = "whose position does not say N or S, E or W"


def _is_unknown(text: str) -> bool:
    return text.strip().lower() in _UNKNOWN


def number_in(text: str) -> float | None:
    """Return the number that a cell is; None for anything else, 0/0 included."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None or "_" in text:
        return None
    below = float(match[2] or 1)
    value = float(match[1]) / below if below else math.nan
    return value if math.isfinite(value) else None


def measured_in(text: str, name: str, factor: float) -> float | None:
    """Return the number of a cell by the unit in it, else times a factor; None where the unit is none of its field's.

    >>> measured_in("100 ft", "sea", 1.0), measured_in("5", "sea", 0.01), measured_in("5 kg", "sea", 1.0)
    (30.48, 0.05, None)
    """
    match = _MEASURED.fullmatch(text.strip())
    if match is None:
        value = number_in(text)
    else:
        value, unit, quantity = number_in(match[1]), match[2].lower().replace("\u00b0", "deg"), _QUANTITY.get(name)
        words = WORDS[quantity] if quantity else dict.fromkeys(_LENS_UNITS, "")
        if unit not in words:
            return None
        factor = UNITS[quantity][words[unit]] if quantity else 1.0
    return None if value is None else value * factor


def read_sheet(path: Path, facts: PoseFacts) -> Sheet:
    """Return the columns and rows of a text; raise `PoseError` if it is no table of poses."""
    lines = _lines_of(path)
    begin = next((at for at, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    comments = [line.lstrip("# ").strip() for line in lines[:begin] if line.strip("# \t\r\n")]
    if not any(line.strip(" ,;\t\r\n") for line in lines[begin:]):
        raise PoseError(f"{path.name} has no rows: name a table of poses")
    delimiter = max(",;\t", key=lines[begin].count)
    if delimiter not in lines[begin]:
        delimiter = ""
    rows = list(_rows_of(path, lines[begin:], begin, delimiter))
    first = rows[0][1] if delimiter else rows[0][1][0].split()
    commented = next((cells for line in reversed(comments) if _is_header(cells := _split(line, delimiter))), ())
    epsg = _epsg_of(path, comments)
    if _is_header(first):
        header, rows = tuple(first), rows[1:]
    elif commented:
        header = tuple(commented)
    else:
        return _headless(path, rows, facts)
    if not delimiter:  # a name may hold spaces: it is what the numbers leave
        rows = [(line, cells[0].rsplit(maxsplit=len(header) - 1)) for line, cells in rows]
    keys = [key_of(name) for name in header]
    kind, zero = "CSV", None
    if "SourceFile" in header:
        kind = "exiftool CSV"
    elif keys[0] in ("label", "photo_id") and (commented or epsg is not None):
        kind, zero = "Metashape text", "down"
    elif keys[0] in ("imagename", "image_name", "image") and (commented or "omega" in keys):
        kind, zero = "Pix4D", "down"
    return Sheet(kind=kind, header=header, rows=_with_commas(rows, delimiter), pitch_zero=zero, epsg=epsg)


def _lines_of(path: Path) -> list[str]:
    try:
        text = bytes_of(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise PoseError(f"{path.name} is no text in UTF-8: save it as CSV in UTF-8") from error
    return io.StringIO(text, newline="").readlines()


def _rows_of(path: Path, lines: Sequence[str], before: int, delimiter: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the lines with cells, but for comments; `before` lines stand above them."""
    if not delimiter:
        yield from ((f"line {n}", [line.strip()]) for n, line in enumerate(lines, before + 1) if line.strip())
        return
    reader = csv.reader(lines, delimiter=delimiter, strict=True, skipinitialspace=True)
    try:
        for row in reader:
            if any(cell.strip() for cell in row) and not row[0].startswith("#"):
                yield f"line {before + reader.line_num}", row
    except csv.Error as error:
        where = before + reader.line_num
        raise PoseError(f"{path.name}, line {where}: no sound CSV ({message_of(error)}): mend the line") from error


def _split(comment: str, delimiter: str) -> list[str]:
    """Return the cells of a header in a comment, which may have commas where the rows have tabs or spaces."""
    by = delimiter if delimiter and delimiter in comment else "," if "," in comment else None
    return [cell.strip() for cell in comment.split(by)]


def _is_header(cells: Sequence[str]) -> bool:
    """Return whether cells are names of columns: one of a picture at least, and none a number."""
    fields = {found[0] for cell in cells if (found := _field_of(cell)) is not None}
    return "name" in fields and len(fields) > 1 and all(number_in(cell) is None for cell in cells)


def _with_commas(rows: Sequence[tuple[str, list[str]]], delimiter: str) -> Sequence[tuple[str, list[str]]]:
    """Return rows with decimal points: where the separator is no comma, numbers may have decimal commas."""
    if delimiter == ",":
        return rows
    comma = re.compile(r"\s*[-+]?\d+,\d+\s*")
    return [
        (line, [cell.replace(",", ".") if comma.fullmatch(cell) else cell for cell in cells]) for line, cells in rows
    ]


def _epsg_of(path: Path, comments: Sequence[str]) -> int | None:
    """Return the CRS that a comment of Metashape states; None without one, or if it is a local one."""
    for line in comments:
        name, _, wkt = line.partition(":")
        if key_of(name) == "coordinate_system":
            return epsg_of_wkt(path, wkt.strip())
    return None


def crs_of_wkt(path: Path, wkt: str) -> pyproj.CRS | None:
    """Return a CRS without its heights and its TOWGS84, which Metashape adds; None if it is local.

    Raise `PoseError` if it is not known.
    """
    if not wkt or wkt.startswith(("LOCAL_CS", "ENGCRS")):
        return None
    try:
        crs = pyproj.CRS.from_user_input(wkt)
    except CRSError as error:
        raise PoseError(f"{path.name} states a CRS that is not known: export it in one with an EPSG code") from error
    while crs.is_compound or crs.is_bound:
        crs = crs.sub_crs_list[0] if crs.is_compound else cast("pyproj.CRS", crs.source_crs)
    return crs


def epsg_of_wkt(path: Path, wkt: str) -> int | None:
    """Return the EPSG code of a CRS without its heights; None if it is local; raise `PoseError` if it has none."""
    crs = crs_of_wkt(path, wkt)
    return None if crs is None else epsg_of_crs(path, crs)


def epsg_of_crs(path: Path, crs: pyproj.CRS) -> int:
    """Return the EPSG code of a CRS; raise `PoseError` if it has none, or its datum is open."""
    # to_2d changes axes that WKT leaves open, and the code is then no longer found
    epsg = None if has_open_datum(crs) else crs.to_epsg(min_confidence=70) or crs.to_2d().to_epsg(min_confidence=70)
    if epsg is None:
        raise PoseError(f"{path.name} is in {plain(crs.name)}, which has no EPSG code: export it in a CRS that has one")
    return int(epsg)


def _headless(path: Path, rows: Sequence[tuple[str, list[str]]], facts: PoseFacts) -> Sheet:
    """Return the sheet of a geolocation file of Pix4D, which needs no header; raise `PoseError` for any other."""
    first = rows[0][1]
    numbers = [number_in(cell) is not None for cell in first[1:]]
    if len(first) < 3 or not all(numbers) or not re.search(r"\.[A-Za-z]{3,4}$", first[0].strip()):
        raise PoseError(f"{path.name} is no table of poses that is known ({KNOWN}): export it in one of these")
    if len(first) not in (4, 6):
        raise PoseError(
            f"{path.name} has {len(first)} columns and no header: write one, such as imageName,latitude,longitude,"
            "altitude,omega,phi,kappa"
        )
    is_grid = facts.epsg is not None and not check_crs(facts.epsg)
    places = ("x", "y", "z") if is_grid else ("latitude", "longitude", "altitude")
    header = ("imagename", *places, *(("accuracy_horz", "accuracy_vert")[: len(first) - 4]))
    note = f"no header: read as Pix4D writes it, name, {', '.join(places)}"
    return Sheet(kind="Pix4D", header=header, rows=rows, pitch_zero="down", notes=(note,))


@dataclass(frozen=True, slots=True)
class _Column:
    at: int
    rank: int
    group: str
    factor: float | None  # to s, m or degrees; None: the name states none


def _field_of(title: str) -> tuple[str, int, float | None] | None:
    """Return the field of a column, its rank among the names of that field, and the factor of the unit in its name."""
    name = title.rpartition(":")[2].lstrip("#")  # after the group of tags, as in Composite:GPSLatitude
    key = key_of(_PLAIN_UNIT.sub("", name))
    if key in _FIELD_OF:
        return (*_FIELD_OF[key], None)
    start, _, unit = key.rpartition("_")
    if start in _FIELD_OF:
        name, rank = _FIELD_OF[start]
        quantity = _QUANTITY.get(name, "")
        if unit in WORDS.get(quantity, {}):
            return name, rank, UNITS[quantity][WORDS[quantity][unit]]
    return None


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """Columns of a sheet by field, the best first; and what its rows are read with."""

    sheet: Sheet
    path: Path
    facts: PoseFacts
    found: Mapping[str, Sequence[_Column]]
    bad: "Counter[str]" = field(default_factory=Counter)  # cells that are no numbers, by field
    taken: "Counter[str]" = field(default_factory=Counter)  # what was read in place of something else

    @classmethod
    def of(cls, path: Path, sheet: Sheet, facts: PoseFacts) -> Self:
        found: defaultdict[str, list[_Column]] = defaultdict(list)
        for at, title in enumerate(sheet.header):
            meant = _field_of(title)
            if meant is not None:
                group = title.rpartition(":")[0].strip().lower()
                found[meant[0]].append(_Column(at, meant[1], group, meant[2]))
        for name, columns in found.items():
            columns.sort(key=lambda column: (column.rank, column.group != "composite"))
            twins = [one for one in columns if (one.rank, one.group) == (columns[0].rank, columns[0].group)]
            if len(twins) > 1:
                titles = named([plain(sheet.header[one.at]) for one in twins], "column")
                raise PoseError(f"{path.name} has {titles} of one name, {name.replace('_', ' ')}: keep one of them")
        return cls(sheet=sheet, path=path, facts=facts, found=found)

    def has(self, *names: str) -> bool:
        return all(name in self.found for name in names)

    def cell(self, row: Sequence[str], name: str) -> tuple[str, _Column] | None:
        """Return the first known cell of a field with its column."""
        for column in self.found.get(name, ()):
            if not _is_unknown(row[column.at]):
                return row[column.at].strip(), column
        return None

    def text(self, row: Sequence[str], name: str) -> str:
        found = self.cell(row, name)
        return found[0] if found else ""

    def number(self, row: Sequence[str], name: str, unstated: float = 1.0) -> float | None:
        """Return a number in m or degrees; `unstated` is the factor where neither cell nor column has a unit."""
        found = self.cell(row, name)
        if found is None:
            return None
        text, column = found
        value = measured_in(text, name, column.factor or unstated)
        if value is None:
            self.bad[self.sheet.header[column.at]] += not re.fullmatch(r"[-+]?0+/0+", text)
        return value

    def plain_numbers(self, column: _Column) -> Iterator[float]:
        """Yield the cells of a column that are numbers without a unit."""
        for _, row in self.sheet.rows:
            value = number_in(row[column.at]) if column.at < len(row) else None
            if value is not None:
                yield value

    def value(self, row: Sequence[str], name: str, column: _Column) -> float | None:
        """Return what one of several columns of a field says of a row; None where that is nothing."""
        text = row[column.at].strip()
        if name not in _LETTERS:
            return measured_in(text, name, column.factor or 1.0)
        found = _degrees(text, column, self.text(row, f"{name}_ref")[:1].upper(), _LETTERS[name])
        return None if isinstance(found, str) else found

    def title(self, name: str) -> str:
        return plain(self.sheet.header[self.found[name][0].at])


def poses_of_sheet(path: Path, sheet: Sheet, facts: PoseFacts) -> Read:
    """Return the poses of a table with columns; raise `PoseError` if it leaves open what a column is."""
    columns = _Columns.of(path, sheet, facts)
    if not columns.has("name"):
        raise PoseError(f"{path.name} has no column that names the pictures: call it file_name")
    is_grid, epsg = _crs_of(columns)
    unit_m = metres_of_unit(epsg) if is_grid else 1.0
    _check_units(columns, unit_m)
    _check_twins(columns)
    zero = _pitch_zero(columns)
    poses: list[PicturePose] = []
    left_out: defaultdict[str, list[str]] = defaultdict(list)
    count = len(sheet.header)
    for line, cells in sheet.rows:
        row = [*cells[:count], *[""] * (count - len(cells))]
        name = name_of(columns.text(row, "name"))
        if len(cells) < count or any(cell.strip() for cell in cells[count:]):
            left_out[f"of other than the header's {counted(count, 'cell')}"].append(name or line)
            continue
        place = _to_grid(columns, row, unit_m) if is_grid else _place_of(columns, row)
        if not name:
            left_out["without a name"].append(line)
        elif isinstance(place, str):
            left_out[place].append(name)
        else:
            pose = _with_angles(columns, row, PicturePose(name=name, place=place, epsg=epsg), zero)
            if isinstance(pose, str):
                left_out[pose].append(name)
            else:
                poses.append(_with_rest(columns, row, pose))
    return Read(kind=sheet.kind, poses=poses, left_out=left_out, notes=_notes(columns, poses))


def _crs_of(columns: _Columns) -> tuple[bool, int]:
    """Return whether places are eastings and northings, and the EPSG code of their CRS."""
    sheet, facts, name = columns.sheet, columns.facts, columns.path.name
    stated = facts.epsg or sheet.epsg
    if columns.has("latitude", "longitude") or columns.has("both"):
        return False, stated if stated is not None and check_crs(stated) else WGS84
    if not columns.has("east", "north"):
        raise PoseError(
            f"{name} has no columns of position ({named([plain(one) for one in sheet.header], 'column')}): call them "
            "lat_deg and lon_deg, or easting_m and northing_m"
        )
    if stated is None:
        raise PoseError(
            f"{name} has columns {columns.title('east')} and {columns.title('north')} in a CRS that it does not state: "
            "say --epsg"
        )
    return True, stated


def _pitch_zero(columns: _Columns) -> str | None:
    """Return where a pitch without a word more counts from; None where none is read."""
    zero = columns.sheet.pitch_zero or columns.facts.pitch_zero
    if zero is None and columns.has("pitch") and not (columns.has("gimbal_pitch") or columns.has("omega")):
        if not columns.sheet.kind.startswith("exiftool"):
            raise PoseError(
                f"{columns.path.name} has a pitch in column {columns.title('pitch')} that may count from straight down "
                "or from the horizon: say --pitch-zero down or horizon"
            )
        columns.taken[f"not read: {columns.title('pitch')}, which is the camera's or the drone's, by maker"] += 1
    return zero


def name_of(text: str) -> str:
    """Return the name of a picture with "/" between folders."""
    return text.replace("\\", "/").removeprefix("./")


def _check_units(columns: _Columns, unit_m: float) -> None:
    """Refuse angles that may be in radians, and heights that may be in a CRS's feet or in metres."""
    path, kind = columns.path, columns.sheet.kind
    for start, names in (("", ("omega", "phi", "kappa")), ("", _BODY), ("gimbal_", _BODY)):
        own = [columns.found[start + name][0] for name in names if start + name in columns.found]
        titles = [plain(columns.sheet.header[column.at]) for column in own]
        is_stated = any(column.factor for column in own) or any("deg" in title.lower() for title in titles)
        values = [abs(value) for column in own for value in columns.plain_numbers(column)]
        low, high = _RADIANS
        is_free = not kind.startswith(("exiftool", "Metashape"))  # which write degrees
        if is_free and len(own) == len(names) and not is_stated and low < max(values, default=0.0) <= high:
            raise PoseError(
                f"{path.name} has angles in {', '.join(titles)} that may be radians, as none is beyond {high:g}: name "
                f"the unit in the columns, {titles[0]}_deg or {titles[0]}_rad"
            )
    if unit_m == 1.0:
        return
    for name, quantity in _QUANTITY.items():
        for column in columns.found.get(name, ()) if quantity == "height" and name not in ("east", "north") else ():
            if column.factor is None and next(columns.plain_numbers(column), None) is not None:
                title = plain(columns.sheet.header[column.at])
                raise PoseError(
                    f"{path.name} is in a CRS whose unit is {unit_m:.4f} m, and {title} does not state its own: name "
                    f"it in the column, {title}_ft or {title}_m"
                )


def _check_twins(columns: _Columns) -> None:
    """Say which of several columns of one meaning is read; raise `PoseError` if they are of a pose and differ."""
    sheet = columns.sheet
    if sheet.kind.startswith(("exiftool", "Metashape")):  # which write several on purpose
        return
    for name, found in columns.found.items():
        first, *others = (plain(sheet.header[one.at]) for one in found)
        if not others:
            continue
        columns.taken[f"{first} is read, and {', '.join(others)} where that is empty"] += 1
        # Altitudes may be of two receivers, headings of a compass and of a track.
        quantity = _QUANTITY.get(name, "")
        is_one = name in ("east", "north") or (quantity in ("place", "angle") and name != "flight_yaw")
        for line, row in sheet.rows if is_one else ():
            values = [columns.value(row, name, one) for one in found if one.at < len(row)]
            known = [value for value in values if value is not None]
            off = max(known, default=0.0) - min(known, default=0.0)
            off = min(off, abs(360.0 - off)) if quantity != "height" else off
            if off > _ALIKE[quantity]:
                raise PoseError(
                    f"{columns.path.name} has {first} and {', '.join(others)} of one meaning, which differ ({line}): "
                    "keep one of them"
                )


def _to_grid(columns: _Columns, row: Sequence[str], unit_m: float) -> tuple[float, float] | str:
    texts = [columns.cell(row, name) for name in ("east", "north")]
    if None in texts:
        return _NO_PLACE
    east, north = (columns.number(row, name, unit_m) for name in ("east", "north"))
    return NO_NUMBER if east is None or north is None else (east / unit_m, north / unit_m)


def _place_of(columns: _Columns, row: Sequence[str]) -> tuple[float, float] | str:
    """Return longitude and latitude of a row, or why it has none."""
    cells = [columns.cell(row, name) for name in ("longitude", "latitude")]
    both = columns.text(row, "both")
    if None in cells and both:
        parts = re.split(r"\s*,\s*" if "," in both else r"\s+", both)  # exiftool prints numbers with a space between
        if len(parts) == 2:
            cells = [(part, _Column(-1, 0, "", None)) for part in reversed(parts)]
    found: list[float] = []
    fault = datum_fault(columns.text(row, "datum")) if columns.facts.epsg is None else ""
    if fault:
        return f"with a position {fault}: say --epsg"
    for (name, letters), cell in zip(_LETTERS.items(), cells, strict=True):
        if cell is None:
            return _NO_PLACE
        value = _degrees(*cell, columns.text(row, f"{name}_ref")[:1].upper(), letters)
        if isinstance(value, str):
            return value
        found.append(value)
    return found[0], found[1]


def _degrees(text: str, column: _Column, ref: str, letters: str) -> float | str:
    """Return a longitude or latitude in degrees, or why it is none; `ref` is the letter in a column of its own."""
    if column.factor is not None:
        value = number_in(text)
        return NO_NUMBER if value is None else round(value * column.factor, 12)
    match = _DEGREES.fullmatch(text)
    has_letter = bool(match and (match["first"] or match["last"]))
    # A comma after bare degrees is XMP's before minutes (8,17.445S), else it may be that of a decimal.
    if match is None or (re.search(r"\d,", text) and not (has_letter and "." in (match["min"] or ""))):
        return NO_NUMBER
    value = float(match["deg"]) + float(match["min"] or 0) / 60 + float(match["sec"] or 0) / 3600
    side, is_minus = (match["last"] or match["first"] or ref).upper(), match["sign"] == "-"
    if side and side not in letters:
        return SWAPPED if side in "NSEW" else _NO_SIDE
    if is_minus and side == letters[0]:
        return "whose position has a sign and a letter that contradict each other"
    # Exiftool's plain EXIF numbers have no sign, and nothing has that is written in minutes.
    if not side and match["sign"] is None and (match["min"] is not None or column.group in ("exif", "gps")):
        return _NO_SIDE
    return -value if is_minus or side == letters[1] else value


def _with_angles(columns: _Columns, row: Sequence[str], pose: PicturePose, zero: str | None) -> PicturePose | str:
    """Return a pose with its attitude and heading, or why its angles cannot be."""
    drone_yaw = columns.number(row, "flight_yaw")
    if columns.text(row, "direction_ref")[:1].upper() == "M" and "irection" in columns.title("flight_yaw"):
        drone_yaw = None  # against magnetic north
    if columns.has("gimbal_pitch"):
        return _with_gimbal(columns, row, pose, drone_yaw)
    if columns.has("omega", "phi", "kappa"):
        omega, phi, kappa = (columns.number(row, name) for name in ("omega", "phi", "kappa"))
        if omega is None or phi is None or kappa is None:
            return _headed(pose, drone_yaw)
        # Photogrammetry's turns about x, y', z'': from the picture's right, up, back to east, north, up of the grid.
        image_to_grid = Rotation.from_euler("XYZ", (omega, phi, kappa), degrees=True).as_matrix()
        north_deg = float(convergence_deg(np.array([pose.lonlat]), pose.epsg)[0])
        return turned(pose, attitude_of(_IMAGE_TO_CAMERA @ image_to_grid.T @ turn_about_up(north_deg)))
    return _with_body(columns, row, pose, zero, drone_yaw)


def _with_body(
    columns: _Columns, row: Sequence[str], pose: PicturePose, zero: str | None, drone_yaw: float | None
) -> PicturePose | str:
    """Return a pose with angles that are called yaw, pitch and roll alone, counted from where `zero` says."""
    yaw, pitch, roll = (columns.number(row, name) for name in ("yaw", "pitch", "roll"))
    if yaw is None or pitch is None or roll is None or zero is None:
        headings = (yaw, columns.number(row, "gimbal_yaw"), drone_yaw)
        return _headed(pose, next((one for one in headings if one is not None), None))
    if zero == "horizon":
        return turned(pose, Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll))
    told = {(PIX4D, "Yaw"): repr(yaw), (PIX4D, "Pitch"): repr(pitch), (PIX4D, "Roll"): repr(roll)}
    attitude = camera_angles(told, columns.text(row, "make")).attitude
    if attitude is None:
        return "whose pitch seems to count from the horizon, not from straight down"
    return turned(pose, attitude)


def _with_gimbal(
    columns: _Columns, row: Sequence[str], pose: PicturePose, drone_yaw: float | None
) -> PicturePose | str:
    """Return a pose with the attitude of a gimbal, which follows the drone's yaw where it does not say its own."""
    yaw, pitch, roll = (columns.number(row, f"gimbal_{name}") for name in ("yaw", "pitch", "roll"))
    heading = drone_yaw if yaw is None else yaw
    if pitch is None or heading is None:
        return _headed(pose, heading)
    if yaw is None:
        columns.taken[f"the camera's yaw is taken from {columns.title('flight_yaw')}"] += 1
    if roll is None:
        columns.taken["the camera's roll is taken as 0"] += 1
    told = (("Roll", roll or 0.0), ("Pitch", pitch), ("Yaw", heading))
    xmp = {(DJI, f"Gimbal{name}Degree"): repr(value) for name, value in told}
    attitude = camera_angles(xmp, columns.text(row, "make")).attitude
    return "whose pitch may count up or down" if attitude is None else turned(pose, attitude)


def _headed(pose: PicturePose, heading_deg: float | None) -> PicturePose:
    return pose if heading_deg is None else replace(pose, heading_deg=heading_deg % 360.0)


def turned(pose: PicturePose, attitude: Attitude) -> PicturePose:
    """Return a pose with an attitude and the heading of its picture."""
    return replace(pose, attitude=attitude, heading_deg=picture_heading_deg(attitude))


def _with_rest(columns: _Columns, row: Sequence[str], pose: PicturePose) -> PicturePose:
    """Return a pose with its heights, time, uncertainty and lens."""
    height_of: HeightOf = "take-off" if columns.cell(row, "take-off") else "ground"
    height_m = columns.number(row, height_of)
    altitude_of: AltitudeOf = next(
        (kind for kind in ("sea", "ellipsoid") if columns.cell(row, kind)),
        "unstated",
    )
    altitude_m = columns.number(row, altitude_of)
    is_below = "below" in columns.text(row, altitude_of).lower()
    is_below_ref = columns.text(row, "sea_ref").lower().startswith(("below", "1"))
    if altitude_m is not None and altitude_of == "sea" and altitude_m > 0 and (is_below or is_below_ref):
        altitude_m = -altitude_m
    if altitude_of == "sea" and is_ellipsoidal(columns.text(row, "sea_type")):
        altitude_of = "ellipsoid"
    spreads = [columns.number(row, name) for name in ("sigma_east", "sigma_north")]
    sigma_m = columns.number(row, "sigma")
    if sigma_m is None and None not in spreads:
        sigma_m = max(spreads)  # type: ignore[type-var]
    time_s, clock = _moment(columns, row)
    return replace(
        pose,
        height_m=height_m,
        height_of=height_of,
        altitude_m=altitude_m,
        altitude_of=altitude_of,
        sigma_m=sigma_m if sigma_m is not None and sigma_m > 0 else None,
        time_s=time_s,
        clock=clock,
        intrinsics=_lens_of(columns, row, pose.name),
    )


def _moment(columns: _Columns, row: Sequence[str]) -> tuple[float | None, Clock]:
    """Return the time of a row in seconds, and its clock."""
    found = columns.cell(row, "time")
    if found is None:
        return None, "own"
    text, column = found
    match = _MOMENT.fullmatch(text)
    if match is None:
        value = number_in(text)
        if value is None or column.factor is None:
            columns.bad[columns.sheet.header[column.at]] += 1
            return None, "own"
        return value * column.factor, "own"
    try:
        whole = dt.datetime(*(int(part) for part in match.groups()[:6]), tzinfo=dt.UTC)  # type: ignore[arg-type,misc]
    except ValueError:  # as 0000:00:00 00:00:00
        return None, "own"
    parts = match[7] or (columns.text(row, "parts") if re.fullmatch(r"\d+", columns.text(row, "parts")) else "")
    zone = match[8] or columns.text(row, "zone")
    key = key_of(columns.sheet.header[column.at].rpartition(":")[2])
    is_utc = zone in ("Z", "UTC", "GMT") or "utc" in key or key == "gpsdate_time"
    seconds = whole.timestamp() + float(f"0.{parts or 0}")
    shift = re.fullmatch(r"([-+])(\d\d)(?::?(\d\d))?", zone)
    if shift:
        ahead_s = (int(shift[2]) * 60 + int(shift[3] or 0)) * 60
        return seconds - (ahead_s if shift[1] == "+" else -ahead_s), "utc"
    return seconds, "utc" if is_utc else "local"


def _lens_of(columns: _Columns, row: Sequence[str], name: str) -> Intrinsics | None:
    """Return the lens of a row by the tags that exiftool prints; None where they do not tell it."""
    width, height = (columns.number(row, side) for side in ("width", "height"))
    turned = columns.text(row, "orientation").lower()
    has_lens = any(columns.cell(row, one) for one in ("film", "focal", "calibrated"))
    if not has_lens or not width or not height or (turned and turned != "1" and not turned.startswith("horizontal")):
        return None
    middle = [columns.number(row, f"centre_{axis}") for axis in "xy"]
    lens = Lens(
        focal_mm=columns.number(row, "focal"),
        film_mm=positive_of(columns.number(row, "film")),
        calibrated_px=positive_of(columns.number(row, "calibrated")),
        calibrated_size_px=(2 * middle[0], 2 * middle[1]) if middle[0] and middle[1] else None,
        zoom=positive_of(columns.number(row, "zoom")),
        make=columns.text(row, "make"),
    )
    try:
        focal_px = lens.focal_px(name, (width, height))
        return Intrinsics(
            width_px=int(width),
            height_px=int(height),
            focal_px=(focal_px, focal_px),
            centre_px=(width / 2, height / 2),
        )
    except CameraError:
        columns.taken["without a lens that its row tells"] += 1
        return None


def _notes(columns: _Columns, poses: Sequence[PicturePose]) -> tuple[str, ...]:
    """Return what a user should know of how a table was read."""
    sheet = columns.sheet
    notes = list(sheet.notes)
    notes += [f"{text} ({counted(count, 'row')})" if count > 1 else text for text, count in columns.taken.items()]
    notes += [
        f"column {plain(title)}: {counted(count, 'cell')} not understood"
        for title, count in columns.bad.items()
        if count
    ]
    for name in ("take-off", "ground", "sea", "ellipsoid"):
        if columns.has(name):
            notes.append(f"heights above the {name} by {columns.title(name)}")
    if columns.has("unstated"):
        notes.append(f"{columns.title('unstated')} does not say what it counts from")
    lacking = [plain(pose.name) for pose in poses if pose.attitude is None]
    if 0 < len(lacking) < len(poses):
        notes.append(f"{named(lacking, 'pose')} without angles of the camera")
    for what, many in (("height_m", "height"), ("altitude_m", "altitude")):
        low = [plain(pose.name) for pose in poses if getattr(pose, what) is None]
        if 0 < len(low) < len(poses):
            notes.append(f"{named(low, 'pose')} without {many}")
    used = {column.at for several in columns.found.values() for column in several}
    others = [plain(title) for at, title in enumerate(sheet.header) if at not in used and title.strip()]
    if others:
        notes.append(f"not read: {named(others, 'column')}")
    return tuple(notes)


def cell_of(value: Any) -> str:  # noqa: ANN401 - whatever JSON holds
    """Return a value of JSON as a cell of a table; empty for lists and objects."""
    return "" if value is None or isinstance(value, list | dict) else str(value)


def read_geojson(path: Path, found: Mapping[str, Any], features: Sequence[Mapping[str, Any]], facts: PoseFacts) -> Read:
    """Return the poses of points with properties; places are those of the geometry."""
    try:
        crs = found["crs"]["properties"]["name"] if found.get("crs") else "EPSG:4326"
        epsg = WGS84 if "CRS84" in crs else epsg_of_crs(path, pyproj.CRS.from_user_input(crs))
    except (TypeError, KeyError, CRSError) as error:
        raise PoseError(f"{path.name} states a CRS that is not known: write it by WGS 84, as GeoJSON is") from error
    is_geographic = check_crs(epsg)
    places = ("longitude", "latitude") if is_geographic else ("easting", "northing")
    barred = {"longitude", "latitude", "both", "east", "north", "latitude_ref", "longitude_ref"}
    own: list[Mapping[str, Any]] = [one.get("properties") or {} for one in features]
    keys = [
        key for key in dict.fromkeys(key for one in own for key in one) if (_field_of(key) or ("",))[0] not in barred
    ]
    has_altitude = not any((_field_of(key) or ("",))[0] in ("sea", "ellipsoid", "unstated") for key in keys)
    header = (*places, *(("altitude",) if has_altitude else ()), *keys)
    rows, others = [], []
    for number, (one, told) in enumerate(zip(features, own, strict=True), start=1):
        geometry = one.get("geometry") or {}
        at = geometry.get("coordinates") if geometry.get("type") == "Point" else None
        cells = [cell_of(told.get(key)) for key in keys]
        if geometry and at is None:
            others.append(
                next(
                    (cell for key, cell in zip(keys, cells, strict=True) if (_field_of(key) or ("",))[0] == "name"), ""
                )
                or f"feature {number}"
            )
            continue
        at = [cell_of(value) for value in (at if isinstance(at, list) else [])[:3]]
        at += [""] * (3 - len(at))
        rows.append((f"feature {number}", [*at[: 2 + has_altitude], *cells]))
    known = facts if facts.epsg else replace(facts, epsg=None if epsg == WGS84 else epsg, origin=None)
    read = poses_of_sheet(path, Sheet(kind="GeoJSON", header=header, rows=rows), known)
    return replace(read, left_out={**read.left_out, **({"that are no points": others} if others else {})})
