# SPDX-License-Identifier: Apache-2.0
"""Files of the fixes of a flight, by their suffix: GPX, GeoJSON, KML, TUM, MCAP, and CSV of MAVLink messages."""

import csv
import math
import tempfile
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.flights.leap_seconds import is_date
from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.matching.tracker import SIDE
from sasgeo_bench.observing.fix_files import NS, PlacedFix, geojson_text, gpx_text, kml_text, tum_text
from sasgeo_bench.observing.flight_fixes import FlightFixes
from sasgeo_bench.observing.flight_messages import Departure, Kind, Origin, columns_of, message_of, row_of

CSV: Final = ".csv"
MCAP: Final = ".mcap"
SUFFIXES: Final = (".gpx", ".geojson", ".kml", ".tum", MCAP, CSV)
_DATED: Final = (".gpx", ".kml", MCAP, CSV)  # hold times of UTC
_ALL_ALIKE: Final = (".kml", ".tum")  # have no place to say that a fix is not accepted
_MEND: Final = "name another file by --to, or check your rights and the free space"
_FIX, _POSE = "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/PoseWithCovarianceStamped"


def check_output(path: Path, flight: FlightFixes, sent: Sequence[Departure], kind: Kind) -> None:
    """Raise `ConfigError` if a file cannot hold these fixes, `StoreError` if it is there already."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigError(
            f"--to {path} names no kind of file: end it in one of {', '.join(SUFFIXES)}, or say udp:HOST:PORT"
        )
    if path.exists():
        raise StoreError(f"{path} is there already: name another file by --to, or remove it")
    if suffix in _DATED:
        check_dated(flight, path.name)
    if suffix in _ALL_ALIKE or (suffix == CSV and kind != "gps_input"):
        check_accepted(sent, f"{path.name} would not")


def check_dated(flight: FlightFixes, what: str) -> None:
    """Raise `ConfigError` if it is not known when a flight began, or a clock that was not set says so."""
    if flight.start_ns is None or not is_date(flight.start_ns / NS):
        raise ConfigError(
            f"flight {flight.flight} does not say when it began, and {what} holds dates: give one, as in --start "
            "2026-05-01T10:00:00Z"
        )


def check_accepted(sent: Sequence[Departure], what: str) -> None:
    """Raise `ConfigError` if a fix is not accepted, where nothing can say so."""
    if not all(one.fix.is_accepted for one in sent):
        raise ConfigError(
            f"{what} say which fixes are accepted: leave out --all, or take .geojson, .gpx, .mcap or --as gps_input"
        )


def write_fixes(path: Path, flight: FlightFixes, sent: Sequence[Departure], *, kind: Kind, origin: Origin) -> None:
    """Write the fixes of a flight that are sent into a file of the kind of its suffix.

    Raise as `check_output` does, `ConfigError` if a library is not installed, `StoreError` if it cannot be written.
    """
    check_output(path, flight, sent, kind)
    suffix, fixes = path.suffix.lower(), [one.fix for one in sent]
    with fresh_file(path, mend=_MEND) as scratch:
        if suffix == MCAP:
            _write_mcap(scratch, flight, sent)
            return
        text = {
            ".gpx": lambda: gpx_text(fixes, flight.credit, track=flight.flight),
            ".geojson": lambda: geojson_text([_point(flight, fix) for fix in fixes], flight.credit),
            ".kml": lambda: kml_text(fixes, flight.credit, track=flight.flight),
            ".tum": lambda: tum_text(fixes),
            CSV: lambda: _csv_text(flight, sent, kind, origin),
        }[suffix]()
        scratch.write_text(text, encoding="utf-8")


def _point(flight: FlightFixes, fix: PlacedFix) -> tuple[float, float, dict[str, object]]:
    """Return the place of a fix and what GeoJSON says of it."""
    time_ns = fix.time_ns or 0
    properties = {
        "view": fix.name,
        "time_s": (time_ns - flight.begin_ns) / NS,  # since the first view
        "unix_s": None if flight.start_ns is None else time_ns / NS,
        "delay_s": fix.delay_s,
        "east_m": round(fix.east_m, 3),
        "north_m": round(fix.north_m, 3),
        "heading_deg": round(fix.heading_deg, 3),
        "is_accepted": fix.is_accepted,
        "p_false": fix.p_false,
        "covariance": None if fix.covariance is None else list(fix.covariance),
    }
    return fix.lon_deg, fix.lat_deg, properties


def _csv_text(flight: FlightFixes, sent: Sequence[Departure], kind: Kind, origin: Origin) -> str:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns_of(kind))
    for one in sent:
        time_ns = one.fix.time_ns or 0
        message = message_of(one, kind, origin, time_ns, time_ns)
        writer.writerow(row_of(message, flight.begin_ns + round(one.sent_s * NS)))
    return text.getvalue()


def _write_mcap(path: Path, flight: FlightFixes, sent: Sequence[Departure]) -> None:
    """Write a bag of ROS 2: places as NavSatFix, poses in the map's grid, each logged when it was sent."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - only where installed
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - as above
    except ImportError as error:
        raise ConfigError("an MCAP file needs the package rosbags: pip install 'sasgeo-bench[logs]'") from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            fixes = writer.add_connection("/sasgeo/fix", _FIX, typestore=store)
            poses = writer.add_connection("/sasgeo/pose", _POSE, typestore=store)
            for one in sent:
                at_ns = flight.begin_ns + round(one.sent_s * NS)
                writer.write(fixes, at_ns, store.serialize_cdr(_nav_sat_fix(store.types, one.fix), _FIX))
                writer.write(poses, at_ns, store.serialize_cdr(_pose(store.types, one.fix, flight), _POSE))
        next(bag.glob("*.mcap")).replace(path)


def _header(types: Any, fix: PlacedFix, frame: str) -> Any:  # noqa: ANN401 - classes that the library makes
    time_ns = fix.time_ns or 0
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // NS, nanosec=time_ns % NS)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _nav_sat_fix(types: Any, fix: PlacedFix) -> Any:  # noqa: ANN401 - as above
    kind = types[_FIX]
    status = types["sensor_msgs/msg/NavSatStatus"]
    spread = np.full((3, 3), math.nan)  # of east, north, up
    if fix.covariance is not None:
        spread[:] = 0.0
        spread[:2, :2] = np.reshape(fix.covariance, (SIDE, SIDE))[:2, :2]
        spread[2, 2] = math.nan
    return kind(
        header=_header(types, fix, "sasgeo"),
        status=status(status=status.STATUS_FIX if fix.is_accepted else status.STATUS_NO_FIX, service=0),
        latitude=fix.lat_deg,
        longitude=fix.lon_deg,
        altitude=math.nan,
        position_covariance=spread.ravel(),
        position_covariance_type=(
            kind.COVARIANCE_TYPE_UNKNOWN if fix.covariance is None else kind.COVARIANCE_TYPE_KNOWN
        ),
    )


def _pose(types: Any, fix: PlacedFix, flight: FlightFixes) -> Any:  # noqa: ANN401 - as above
    """Return the pose in the map's grid, as REP 103 has it: x east, y north, angles from x, counter-clockwise."""
    spread = np.full((6, 6), math.nan)
    if fix.covariance is not None:
        turn = np.diag([1.0, 1.0, -math.radians(1.0)])
        turn[:2, :2] = rotation(fix.yaw_deg - fix.heading_deg)
        spread[:] = 0.0
        spread[np.ix_([0, 1, 5], [0, 1, 5])] = turn @ np.reshape(fix.covariance, (SIDE, SIDE)) @ turn.T
        spread[[2, 3, 4], [2, 3, 4]] = math.nan
    half = math.radians(90.0 - fix.yaw_deg) / 2
    place = types["geometry_msgs/msg/Point"](x=fix.east_m, y=fix.north_m, z=fix.height_m or 0.0)
    heading = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
    pose = types["geometry_msgs/msg/Pose"](position=place, orientation=heading)
    frame = "map" if flight.epsg is None else f"EPSG:{flight.epsg}"
    return types[_POSE](
        header=_header(types, fix, frame),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=spread.ravel()),
    )
