# SPDX-License-Identifier: Apache-2.0
"""Columns of tables with latitude and longitude: formats that are recognized by their names, and any other table.

A name is compared in small letters, its words joined by "_", with and without its topic ("GPS." of "GPS.Lat"). Where
the units of a format come from: the table in `docs/concepts/flights.md`.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

from sasgeo_bench.flights.log_points import AltitudeOf, LogSource, listed, shown
from sasgeo_bench.flights.log_units import LEAST_FIX, WORDS, LogFacts

QUANTITIES: Final = MappingProxyType(
    {
        "latitude": "place",
        "longitude": "place",
        "time": "time",
        "height": "height",
        "altitude": "height",
        "yaw": "angle",
        "pitch": "angle",
        "roll": "angle",
    }
)
# Field -> names without their unit, of a table of any format.
NAMES: Final = MappingProxyType(
    {
        "latitude": ("lat", "latitude", "gps_lat", "gps_latitude", "gpslatitude"),
        "longitude": ("lon", "lng", "long", "longitude", "gps_lon", "gps_lng", "gps_longitude", "gpslongitude"),
        "time": (
            *("time", "timestamp", "t", "date_time", "datetime", "utc", "gps_time", "gpst", "elapsed", "elapsed_time"),
            *("date_time_utc", "datetime_utc", "utc_time", "time_utc", "time_boot", "flight_time", "fly_time"),
            *("date_time_original", "datetime_original"),
        ),
        "height": (
            *("height", "agl", "relative_alt", "rel_alt", "alt_rel", "relalt", "altitude_relative", "altituderelative"),
            *("relative_altitude", "rel_home_alt", "height_agl", "alt_agl", "altitude_agl", "height_above_takeoff"),
            *("height_above_ground",),
        ),
        "yaw": ("yaw", "heading", "hdg", "compass_heading"),
        "pitch": ("pitch",),
        "roll": ("roll",),
    }
)
# Of what no height above the ground is: altitudes, and what they count from. The first that a table has is read.
_NAMES_OF_ALTITUDES: Final[Mapping[AltitudeOf, tuple[str, ...]]] = MappingProxyType(
    {
        "geoid": (
            *("amsl", "alt_amsl", "altitude_amsl", "alt_msl", "altitude_msl", "h_msl"),
            *("altitude_above_sea_level", "altitude_above_mean_sea_level"),
        ),
        "ellipsoid": ("alt_ellipsoid", "altitude_ellipsoid", "ellipsoidal_height", "alt_hae", "hae"),
        "unknown": ("alt", "altitude", "ele", "elevation"),
    }
)
ALTITUDES: Final = MappingProxyType({name: of for of, names in _NAMES_OF_ALTITUDES.items() for name in names})

_DATES: Final = ("date", "date_local", "date_utc", "gps_date")
# Of several receivers or drones in one table, where the format names no such column; these may number lines as well.
NUMBERING: Final = ("receiver", "antenna", "sensor", "device", "drone", "uav", "vehicle", "id")
_RECEIVERS: Final = (
    *("instance", "gps_instance", "sysid", "sys_id", "system_id", "src_system", "srcsystem", "gps_id"),
    *(f"{word}_id" for word in NUMBERING[:-1]),
    *NUMBERING,
)
# Of the sign of a place, beside its value.
_HEMISPHERES: Final = MappingProxyType(
    {
        name: re.compile(
            rf"(?:(?:gps_?)?{place}_?)?(?:{both})(?:_?(?:ind|indicator|hemi|hemisphere))?"
            rf"|(?:gps_?)?{place}_?(?:hemi|hemisphere|dir|direction|ref|sign|indicator)"
        )
        for name, place, both in (
            ("latitude", "lat(?:itude)?", "n_?s|n_or_s|north_?south"),
            ("longitude", "(?:lon|lng|long|longitude)", "e_?w|e_or_w|east_?west"),
        )
    }
)
# Of the part of a second beside whole seconds.
_PARTS: Final = MappingProxyType(
    {word: unit for word, unit in WORDS["time"].items() if unit != "s"}
    | dict.fromkeys(("nanosec", "nanosecs"), "ns")
    | dict.fromkeys(("microsec", "microsecs"), "us")
    | dict.fromkeys(("millisec", "millisecs"), "ms")
)
# Topics of what turns by itself.
_CARRIED: Final = re.compile(r"gimbal|camera|mount|payload|\b(?:cam|mnt)\d*\b", re.IGNORECASE)
# Beside heights above the ellipsoid.
_GEODETIC: Final = re.compile(
    rf"(?:g(?:ps|nss)_)?(?:undulation|geoid(?:al)?(?:_(?:sep(?:aration)?|height|undulation))?|h_?msl|sd[neu])"
    rf"(?:_(?:{'|'.join(WORDS['height'])}))?"
)
_PARTS_OF_DAY: Final = re.compile(r"(?:(?:utc|gps|gnss|local|time)_)?(?:(hours?|hh)|minutes?|mins?|mm)")
_OF_GPS: Final = frozenset({"status", "gms", "gwk", "n_sats", "nsats", "hdop", "h_dop", "gcrs", "g_crs", "spd"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A format that is recognized by names of columns.

    Parameters
    ----------
    name : str
        For messages.
    signs : tuple of frozenset
        Names, all of one set, that tell the format: as names are compared, or as they are written.
    altitudes : mapping
        Name of an altitude -> what it counts from, as the format has it; others are looked for by common names.
    epoch : tuple of str
        Names of times that count from 1970, UTC.
    gps : tuple of str
        Names of dates and weeks that count without leap seconds.
    columns : mapping
        Field -> name -> unit; the first name that is there is read. None: it holds dates, or the unit is asked for.
        Fields that are missing here are looked for by their common names; those with no name are never there.
    counts : bool
        Places, and what is "mm" or "cdeg" here, are integers as the message has them, if places are whole numbers.
    fix : mapping
        Name -> least value that is a fix.
    receiver : str
        Name of the column that numbers receivers.
    no_yaw : float, optional
        Yaw that means unknown.
    is_sorted : bool
        Whether lines are in the order of time.
    """

    name: str = ""
    signs: tuple[frozenset[str], ...] = ()
    columns: Mapping[str, Mapping[str, str | None]] = field(default_factory=dict)
    altitudes: Mapping[str, AltitudeOf] = field(default_factory=dict)
    epoch: tuple[str, ...] = ()
    gps: tuple[str, ...] = ()
    counts: bool = False
    fix: Mapping[str, float] = field(default_factory=lambda: {"fix_type": LEAST_FIX})
    receiver: str = ""
    no_yaw: float | None = None
    is_sorted: bool = True


PX4: Final = Format(
    name="PX4",
    signs=(
        *(
            frozenset({"timestamp", "lat", "lon", sign})
            for sign in ("alt_ellipsoid", "timestamp_sample", "satellites_used", "terrain_alt", "time_utc_usec")
        ),
        frozenset({"timestamp", "latitude_deg", "longitude_deg", "altitude_msl_m"}),
    ),
    columns={
        "time": {"timestamp": "us"},
        "altitude": {"altitude_msl_m": "m", "alt": "mm"},
        "yaw": {"heading": "rad", "yaw": "rad"},
        "pitch": {},
        "roll": {},
    },
    altitudes={"altitude_msl_m": "geoid", "alt": "geoid"},
    counts=True,
)
_ANY: Final = Format()
FORMATS: Final = (
    Format(
        name="DJI",
        signs=(frozenset({"osd_latitude", "osd_longitude"}),),
        columns={
            "latitude": {"osd_latitude": "deg"},
            "longitude": {"osd_longitude": "deg"},
            "time": {
                "osd_fly_time_s": "s",
                "custom_update_time_local": None,
                "custom_update_time": None,
                "osd_fly_time": None,
            },
            "height": {"osd_height_m": "m", "osd_height_ft": "ft", "osd_height": None},
            "altitude": {"osd_altitude_m": "m", "osd_altitude_ft": "ft"},
            "yaw": {"osd_yaw_360": "deg", "osd_yaw": "deg"},
            "pitch": {"osd_pitch": "deg"},
            "roll": {"osd_roll": "deg"},
        },
    ),
    Format(
        name="MAVLink",
        signs=(
            frozenset({"time_boot_ms", "relative_alt", "lat", "lon"}),
            frozenset({"relative_alt", "hdg", "vx", "vy", "lat", "lon"}),
            frozenset({"time_usec", "fix_type", "lat", "lon"}),
            frozenset({"global_position_int_lat", "global_position_int_lon"}),
            frozenset({"gps_raw_int_lat", "gps_raw_int_lon"}),
        ),
        columns={
            "time": {"time_boot_ms": "ms", "time_usec": "us", "timestamp": None},
            "height": {"relative_alt": "mm"},
            "altitude": {"alt": "mm"},
            "yaw": {"hdg": "cdeg"},
            "pitch": {"attitude_pitch": "rad"},
            "roll": {"attitude_roll": "rad"},
        },
        altitudes={"alt": "geoid"},
        epoch=("time_usec",),
        counts=True,
        no_yaw=65535.0,
    ),
    Format(
        name="ArduPilot",
        signs=(frozenset({"TimeUS", "Lat", "Lng"}), frozenset({"TimeMS", "Lat", "Lng"})),
        columns={
            "time": {"time_us": "us", "time_ms": "ms"},
            "height": {"rel_home_alt": "m", "rel_alt": "m"},
            "altitude": {"alt": "m"},
            "yaw": {"yaw": "deg"},
            "pitch": {"pitch": "deg"},
            "roll": {"roll": "deg"},
        },
        altitudes={"alt": "geoid"},
        counts=True,
        fix={"status": LEAST_FIX},
        receiver="i",
        no_yaw=0.0,
    ),
    Format(
        name="QGroundControl",
        signs=(frozenset({"timestamp", "altitude_relative", "heading", "gps_lat", "gps_lon"}),),
        columns={
            "latitude": {"gps_lat": "deg"},
            "longitude": {"gps_lon": "deg"},
            "time": {"timestamp": None},
            "height": {"altitude_relative": None},
            "yaw": {"heading": "deg"},
            "pitch": {"pitch": "deg"},
            "roll": {"roll": "deg"},
        },
    ),
    Format(
        name="RTKLIB",
        signs=(
            frozenset({"latitude_deg", "longitude_deg", "q", "ns"}),
            frozenset({"latitude_deg", "longitude_deg", "sdn_m"}),
            frozenset({"latitude_deg", "longitude_deg", "gpst"}),
            frozenset({"utc", "latitude_deg", "longitude_deg", "height_m"}),
        ),
        columns={
            "time": {"gpst": None, "utc": None, "jst": None, "time": None},
            "height": {},
            "altitude": {"height_m": "m"},
        },
        gps=("gpst",),
        fix={"q": 1.0},
    ),
    Format(
        name="ROS",
        signs=(frozenset({"field_latitude", "field_longitude"}),),
        columns={
            "latitude": {"field_latitude": "deg"},
            "longitude": {"field_longitude": "deg"},
            "time": {"time": "ns", "field_header_stamp": "ns"},
            "height": {},
            "altitude": {"field_altitude": "m"},
        },
        altitudes={"field_altitude": "ellipsoid"},
        epoch=("time", "field_header_stamp"),
        fix={"field_status_status": 0.0},
    ),
    Format(
        name="exiftool",
        signs=(frozenset({"SourceFile", "GPSLatitude", "GPSLongitude"}),),
        columns={
            "latitude": {"gpslatitude": "deg"},
            "longitude": {"gpslongitude": "deg"},
            "time": {"sub_sec_date_time_original": None, "date_time_original": None},
            "height": {"relative_altitude": "m"},
            "altitude": {"gpsaltitude": "m"},
            "yaw": {"flight_yaw_degree": "deg"},
            "pitch": {"flight_pitch_degree": "deg"},
            "roll": {"flight_roll_degree": "deg"},
        },
        is_sorted=False,
    ),
    PX4,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column that is read; `unit` is None if neither its name nor the format tells it."""

    at: int
    name: str
    unit: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """What is read of a table."""

    format: Format
    keys: tuple[str, ...]  # of all columns, without their topics
    fields: dict[str, Column]
    altitude_of: AltitudeOf = "unknown"
    hemispheres: dict[str, Column] = field(default_factory=dict)  # of the sign of a latitude or longitude
    part: Column | None = None  # of a second, beside whole seconds
    date: Column | None = None
    receiver: Column | None = None
    fix: Column | None = None
    least_fix: float = 0.0


def find_layout(source: LogSource, header: Sequence[str], facts: LogFacts) -> Layout:
    """Return the columns of a table.

    Raise `FlightError` if places are missing, two columns may be meant, or a column that no name stands for may be the
    time.
    """
    short = [key_of(name.rpartition(".")[2]) for name in header]
    keys = [(short[at], key_of(name)) for at, name in enumerate(header)]
    names = {key for both in keys for key in both} | {name.rpartition(".")[2].strip() for name in header}
    log_format = next((one for one in FORMATS if any(sign <= names for sign in one.signs)), _ANY)
    found: dict[str, Column] = {}
    part: Column | None = None
    for name in NAMES:
        matches = list(_matches(name, header, keys, log_format))
        if name == "time":
            part = _part(header, short, matches, log_format)
            matches = [column for column in matches if part is None or column.at != part.at]
        # Of several messages, that of the places, or of the vehicle.
        for topic in (_topic(found["latitude"]), "") if "latitude" in found else ():
            if len(matches) > 1:
                matches = [column for column in matches if _topic(column) == topic] or matches
        if len(matches) > 1:
            raise source.fault(
                f"{name} is ambiguous, columns {listed([item.name for item in matches])}: keep one of them"
            )
        if matches:
            found[name] = matches[0]
    _check_meaning(source, header, short, log_format, found, facts)
    lacking = [name for name in ("latitude", "longitude") if name not in found]
    if lacking:
        raise source.fault(
            f"no column of {' and '.join(lacking)}, found {listed(header) if header else 'none'}: name "
            "them lat_deg and lon_deg"
        )
    fix = next((name for name in log_format.fix if name in names), "")
    topic = _topic(found["latitude"])
    if log_format.no_yaw == 0 and "yaw" in found and not _is_yaw_of_gps(found["yaw"], short):
        log_format = replace(log_format, no_yaw=None)
    fields = {name: column for name, column in found.items() if facts.unit(QUANTITIES[name]) != "none"}
    altitude, altitude_of = _altitude(header, keys, log_format, topic)
    layout = Layout(
        format=log_format,
        keys=tuple(short),
        fields=fields if altitude is None else {**fields, "altitude": altitude},
        altitude_of=altitude_of,
        date=_named(header, keys, _DATES),
        hemispheres=_hemispheres(header, short, log_format),
        part=part if facts.time_unit != "none" else None,
        receiver=_receiver(header, keys, log_format, topic),
        fix=_named(header, keys, (fix,)),
        least_fix=log_format.fix.get(fix, 0.0),
    )
    if "time" not in found and facts.time_unit != "none":
        _check_no_time(source, header, keys, layout)
    return layout


def _altitude(
    header: Sequence[str], keys: Sequence[tuple[str, str]], log_format: Format, topic: str | None
) -> tuple[Column | None, AltitudeOf]:
    """Return the column of altitudes and what they count from; none whose unit is open is read, nor one of two."""
    if "altitude" in log_format.columns:
        for name, unit in log_format.columns["altitude"].items():
            places = [at for at, both in enumerate(keys) if name in both]
            if places:
                column = Column(at=places[0], name=header[places[0]], unit=unit)
                return (column if len(places) == 1 else None), log_format.altitudes.get(name, "unknown")
        return None, "unknown"
    found: dict[AltitudeOf, list[Column]] = {"geoid": [], "ellipsoid": [], "unknown": []}
    for at, both in enumerate(keys):
        for name, unit in (_words_of(key, WORDS["height"]) for key in both):
            if name in ALTITUDES and unit and _topic_of(header[at]) in (topic, ""):
                found[ALTITUDES[name]].append(Column(at=at, name=header[at], unit=WORDS["height"][unit]))
                break
    for reference, columns in found.items():
        if columns:
            return (columns[0] if len(columns) == 1 else None), reference
    return None, "unknown"


def _check_meaning(
    source: LogSource,
    header: Sequence[str],
    short: Sequence[str],
    log_format: Format,
    found: Mapping[str, Column],
    facts: LogFacts,
) -> None:
    """Raise `FlightError` if other columns tell that seconds are of a minute, or heights above the ellipsoid."""
    parts = {bool(match[1]): header[at] for at, key in enumerate(short) if (match := _PARTS_OF_DAY.fullmatch(key))}
    if len(parts) > 1 and "time" in found and found["time"].unit == "s" and facts.time_unit is None:
        names = listed([parts[True], parts[False], found["time"].name])
        raise source.fault(
            f"the time is in parts, columns {names}: join them, as in 10:02:03.5, or say --time-unit none"
        )
    if "height" not in found or "height" in log_format.columns or facts.height_unit == "none":
        return
    height = found["height"]
    beside = next((header[at] for at, key in enumerate(short) if _GEODETIC.fullmatch(key)), "")
    if beside and _words_of(short[height.at], WORDS["height"])[0] == "height":
        raise source.fault(
            f"column {shown(height.name)} may count from the ellipsoid, as {shown(beside)} beside it tells: say "
            "--height-unit none, or name it height_agl_m if it counts from the ground"
        )


def _receiver(
    header: Sequence[str], keys: Sequence[tuple[str, str]], log_format: Format, topic: str | None
) -> Column | None:
    if log_format.receiver:
        return _named([name if _topic_of(name) == topic else "" for name in header], keys, (log_format.receiver,))
    names = [name if _topic_of(name) in (topic, "") else "" for name in header]
    found = (_named(names, keys, (name,)) for name in _RECEIVERS)
    return next((column for column in found if column is not None), None)


def _hemispheres(header: Sequence[str], short: Sequence[str], log_format: Format) -> dict[str, Column]:
    """Return the columns of N or S, and of E or W; NS of RTKLIB counts satellites."""
    found = {}
    for name, pattern in _HEMISPHERES.items():
        places = [at for at, key in enumerate(short) if pattern.fullmatch(key)]
        if places and log_format.name != "RTKLIB":
            found[name] = Column(at=places[0], name=header[places[0]])
    return found


def _part(header: Sequence[str], short: Sequence[str], times: Sequence[Column], log_format: Format) -> Column | None:
    """Return the column of parts of a second that goes with a column of seconds, or of dates and clocks."""
    whole = next((column for column in times if column.unit in ("s", None)), None)
    if whole is None:
        return None
    # NS beside EW is a hemisphere, and counts satellites for RTKLIB.
    is_no_time = log_format.name == "RTKLIB" or any(_HEMISPHERES["longitude"].fullmatch(key) for key in short)
    base = _words_of(short[whole.at], WORDS["time"])[0]
    for at, key in enumerate(short):
        start, word = _words_of(key, _PARTS)
        is_beside = _topic_of(header[at]) == _topic_of(whole.name) and at != whole.at
        if key == "ns" and is_no_time:
            continue
        if word and is_beside and start in ("", base, "stamp"):
            return Column(at=at, name=header[at], unit=_PARTS[word])
    return None


def _words_of(key: str, words: Mapping[str, str]) -> tuple[str, str]:
    """Return a key without the unit at its end, and that unit; it may be all of the key."""
    start, _, word = key.rpartition("_")
    return (start, word) if word in words else (key, "")


def _is_yaw_of_gps(yaw: Column, short: Sequence[str]) -> bool:
    topic = _topic_of(yaw.name)
    if topic:
        return topic.upper().startswith("GPS")
    return bool(_OF_GPS & set(short)) and not {"pitch", "roll"} & set(short)


def key_of(name: str) -> str:
    """Return a name as names are compared.

    >>> [key_of(name) for name in ("OSD.flyTime [s]", "TimeUS", "compass_heading(degrees)", "Heading (°)")]
    ['osd_fly_time_s', 'time_us', 'compass_heading_degrees', 'heading_deg']
    """
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip()).lower()
    words = words.replace("°", "deg").replace("\u00b5", "u").replace("\u03bc", "u")
    return re.sub(r"^time(?=[mu]s$)", "time_", re.sub(r"[^a-z0-9]+", "_", words).strip("_"))


def unread(header: Sequence[str], layout: Layout, read: Collection[str], *, has_dates: bool) -> tuple[str, ...]:
    """Return a line on the columns of a table that are not read, none if all are; `read` are fields."""
    others = (layout.part, layout.receiver, layout.fix, layout.date if has_dates else None)
    known = {column.at for name, column in layout.fields.items() if name in read}
    known |= {column.at for column in (*others, *layout.hemispheres.values()) if column is not None}
    left = [at for at, name in enumerate(header) if at not in known and name.strip()]
    is_altitude = "altitude" not in read and any(_is_altitude(layout.keys[at]) for at in left)
    why = "; an altitude is read if one column of them states its unit" if is_altitude else ""
    return (f"not read: {listed([header[at] for at in left])}{why}",) if left else ()


def _matches(name: str, header: Sequence[str], keys: Sequence[tuple[str, str]], log_format: Format) -> list[Column]:
    """Return the columns of a field: by the format, else by its names, of which those with a unit go first."""
    if QUANTITIES[name] == "angle":
        keys = [("", "") if _CARRIED.search(_topic_of(header[at])) else both for at, both in enumerate(keys)]
    if name in log_format.columns:
        found = ((key, unit) for key, unit in log_format.columns[name].items() if any(key in both for both in keys))
        best, unit = next(found, ("", None))
        return [Column(at=at, name=header[at], unit=unit) for at, both in enumerate(keys) if best and best in both]
    matches = []
    for at, both in enumerate(keys):
        units = [unit for is_it, unit in (_unit_of(key, name) for key in both) if is_it]
        if units:
            matches.append(Column(at=at, name=header[at], unit=units[0]))
    return [column for column in matches if column.unit] or matches


def _topic(column: Column | None) -> str | None:
    return None if column is None else _topic_of(column.name)


def _topic_of(name: str) -> str:
    return name.strip().rpartition(".")[0]


def _unit_of(key: str, name: str) -> tuple[bool, str | None]:
    words = WORDS[QUANTITIES[name]]
    if name == "time" and key in words and len(key) > 2:  # "seconds", and no "s"
        return True, words[key]
    for base in NAMES[name]:
        if key == base:
            return True, None
        if key.startswith(f"{base}_") and key[len(base) + 1 :] in words:
            return True, words[key[len(base) + 1 :]]
    return False, None


def _named(header: Sequence[str], keys: Sequence[tuple[str, str]], names: Sequence[str]) -> Column | None:
    """Return the first column of some names; a column whose header is empty is none."""
    places = (at for at, both in enumerate(keys) if header[at] and any(name and name in both for name in names))
    at = next(places, None)
    return None if at is None else Column(at=at, name=header[at])


def _check_no_time(source: LogSource, header: Sequence[str], keys: Sequence[tuple[str, str]], layout: Layout) -> None:
    """Raise `FlightError` if a column that is not known may be the time."""
    known = {column.at for column in (layout.fix, layout.part, *layout.fields.values()) if column is not None}
    known |= {column.at for column in layout.hemispheres.values()}
    if layout.receiver is not None and "id" not in keys[layout.receiver.at]:  # a number of lines may be the time
        known.add(layout.receiver.at)
    open_ones = [header[at] for at, both in enumerate(keys) if at not in known and not _is_no_time(both)]
    if open_ones:
        raise source.fault(
            f"no column of time is known, it may be one of {listed(open_ones)}: name it time_s, time_ms or time_us, or "
            "say --time-unit none if the log has no times"
        )


def _is_no_time(both: tuple[str, str]) -> bool:
    return any(_is_altitude(key) or any(_unit_of(key, name)[0] for name in NAMES if name != "time") for key in both)


def _is_altitude(key: str) -> bool:
    return key in ALTITUDES or _words_of(key, WORDS["height"])[0] in ALTITUDES
