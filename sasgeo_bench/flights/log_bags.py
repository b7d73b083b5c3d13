# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 1 and 2 and MCAP files of ROS 2, with the message types that a bag brings along.

Which topic is read. Of PX4's own messages (`px4_msgs`) those that a ULog has, as `log_ulog` reads them. Otherwise the
`NavSatFix` or `LocationFix` with the most fixes; topics that an estimator writes, as their names tell, and
`geographic_msgs` only where there is no other. Heights are those of mavros above home (`rel_alt`), attitudes those of
its `imu/data`. Times are the stamps of the headers, else those of the recorder.
"""

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.flights import log_ulog
from sasgeo_bench.flights.log_points import FlightLog, LogSource, listed, shown
from sasgeo_bench.flights.log_streams import (
    MOST_LOG_BYTES,
    Clock,
    Estimate,
    Fixes,
    LoggedOdometry,
    Stream,
    Streams,
    first_with_fixes,
    flight_of,
    known_fields,
    library,
    quaternions_of_enu,
    stated_of,
)

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

Floats = NDArray[np.float64]

BAGS: Final = (".bag", ".mcap", ".db3")  # and folders
METADATA: Final = "metadata.yaml"  # of the folder of a bag of ROS 2

_EPOCH_NS: Final = 10**18  # clocks of a simulator begin at 0 and never come there
_NS: Final = 1e9
_PX4: Final = "px4_msgs/msg/"
# Types of PX4's messages -> topic of a ULog.
_OF_PX4: Final = MappingProxyType(
    {
        f"{_PX4}VehicleGpsPosition": "vehicle_gps_position",
        f"{_PX4}SensorGps": "sensor_gps",
        f"{_PX4}VehicleGlobalPosition": "vehicle_global_position",
        f"{_PX4}VehicleLocalPosition": "vehicle_local_position",
        f"{_PX4}HomePosition": "home_position",
        f"{_PX4}VehicleLandDetected": "vehicle_land_detected",
        f"{_PX4}VehicleAttitude": "vehicle_attitude",
        f"{_PX4}VehicleOdometry": "vehicle_odometry",
        f"{_PX4}EstimatorStatusFlags": "estimator_status_flags",
        f"{_PX4}EstimatorStatus": "estimator_status",
    }
)
_FIX: Final = "sensor_msgs/msg/NavSatFix"
_LOCATION: Final = "foxglove_msgs/msg/LocationFix"
# Types of places that are an estimator's -> path to what has latitude, longitude and altitude above the ellipsoid.
_GEOGRAPHIC: Final = MappingProxyType(
    {
        "geographic_msgs/msg/GeoPointStamped": "position",
        "geographic_msgs/msg/GeoPoseStamped": "pose.position",
        "geographic_msgs/msg/GeoPoseWithCovarianceStamped": "pose.pose.position",
    }
)
# Ends of topics that mavros and robot_localization write what they fused into.
_FUSED: Final = ("global_position/global", "gps/filtered")
_HEIGHT: Final = ("std_msgs/msg/Float64", "global_position/rel_alt")
_TURNS: Final = ("sensor_msgs/msg/Imu", "imu/data")


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file by its suffix, or the folder of a bag of ROS 2."""
    return path.suffix.lower() in BAGS or (path / METADATA).is_file()


def read_bag(path: Path) -> FlightLog:
    """Read the flight of a bag.

    Parameters
    ----------
    path : Path
        `.bag` of ROS 1; `.mcap`, `.db3` or the folder of a bag of ROS 2.

    Returns
    -------
    FlightLog
        Its first note says which topic the places are from.

    Raises
    ------
    ConfigError
        If rosbags is not installed.
    FlightError
        If the bag has no places, or is damaged: one that was cut off has no index, and its own tool makes it anew.
    """
    with _opened(path) as bag, known_fields(bag.source):
        topics = _px4_topics(bag, log_ulog.TOPICS)
        has_px4 = any(topic in log_ulog.PLACES for topic, _ in topics.topics)
        streams = log_ulog.streams_of(topics) if has_px4 else _ros_streams(bag)
    return flight_of(bag.source, streams)


def read_receivers(path: Path) -> list[Fixes]:
    """Read the receivers of a bag on one clock, in the order in which one is taken for the truth."""
    with _opened(path) as bag, known_fields(bag.source):
        receivers = log_ulog.receivers_of(_px4_topics(bag, log_ulog.RECEIVERS))
        return receivers or list(_RosPlaces.of(bag).receivers)


def read_odometry(path: Path, *, topic: str | None = None) -> LoggedOdometry:
    """Read the odometry of a bag.

    Parameters
    ----------
    path : Path
        As `read_bag` takes it.
    topic : str, optional
        Topic of `nav_msgs/Odometry`, `PoseStamped` or `PoseWithCovarianceStamped`, of a body with its axes forward,
        left, up. By default what PX4's own messages say, as of a ULog.

    Returns
    -------
    LoggedOdometry
        With the fixes of a `NavSatFix` and the attitudes of mavros, unless all is of PX4.

    Raises
    ------
    ConfigError
        If rosbags is not installed.
    FlightError
        As `read_bag`; if there is no such topic, none is named of a bag without PX4's messages, or its name says that
        it fused a receiver.
    """
    with _opened(path) as bag, known_fields(bag.source):
        if topic is None:
            topics = _px4_topics(bag, log_ulog.OF_DRIFT)
            if any(name in log_ulog.PLACES for name, _ in topics.topics):
                return log_ulog.odometry_of(topics)
        poses = {one.topic: one for one in bag.connections(_POSES)}
        if topic not in poses:
            there = f"one of {listed(list(poses))}, if it fused no GNSS" if poses else "of poses, of which it has none"
            why = "no bag says of poses whether they fused GNSS" if topic is None else f"has no poses on {shown(topic)}"
            raise bag.source.fault(f"{why}: say --topic, {there}")
        if topic.endswith(_FUSED_POSES):
            raise bag.source.fault(
                f"{topic} is what the autopilot or a filter made of the receiver: a copy of the truth, and no odometry"
            )
        places = _RosPlaces.of(bag)
        if places.fixes.is_estimate:
            raise bag.source.fault(f"{places.fixes.track.name} is an estimate, and no truth: log a NavSatFix")
        table = bag.table(poses[topic], [f"{_POSES[poses[topic].msgtype]}.{name}" for name in _POSE_FIELDS])
        east, north, up, *turns = table.values.T
        values = np.column_stack([north, east, -up, quaternions_of_enu(*turns)])
        stream = Stream.of(bag.source, topic, places.clock.seconds(table), values)
        estimate = Estimate(poses=stream, fused="as --topic says")
        return LoggedOdometry.of(
            bag.source,
            (places.fixes, places.notes),
            [estimate],
            _attitudes(bag, places.clock),
            (places.clock.note,),
        )


_POSES: Final = MappingProxyType(
    {
        "nav_msgs/msg/Odometry": "pose.pose",
        "geometry_msgs/msg/PoseStamped": "pose",
        "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    }
)
_POSE_FIELDS: Final = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "wxyz"))
# Ends of topics of mavros and robot_localization that have fused a receiver, or may have.
_FUSED_POSES: Final = (
    *("local_position/pose", "local_position/pose_cov", "local_position/odom", "global_position/local", "odometry/in"),
    *("odometry/filtered", "odometry/filtered_map", "odometry/global", "odometry/gps"),
)


@contextmanager
def _opened(path: Path) -> Iterator["_Bag"]:
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - only where it is installed
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError("a bag needs the package rosbags: pip install 'sasgeo-bench[logs]'") from error
    source = LogSource(path=path, unit="fix")
    if not path.is_dir():
        source.check_size(MOST_LOG_BYTES)
        plain_file(path)
    with ExitStack() as stack:
        with library(source, _FAULTS, mend=_MEND):
            reader = stack.enter_context(AnyReader([path], default_typestore=get_typestore(Stores.LATEST)))
        yield _Bag(source=source, reader=reader)


_FAULTS: Final = (Exception,)  # asserts and errors of each storage and of every type
_MEND: Final = (
    "mend a bag that was cut off by `rosbag reindex`, `ros2 bag reindex` or `mcap recover`; an MCAP without ROS 2 "
    "(protobuf, JSON) is not read"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bag:
    """A bag that is open."""

    source: LogSource
    reader: "AnyReader"

    def connections(self, kinds: Collection[str]) -> list["Connection"]:
        """Return connections of some types that have messages, in the order of their topics."""
        found = [one for one in self.reader.connections if one.msgtype in kinds and one.msgcount]
        return sorted(found, key=lambda one: one.topic)

    def table(self, connection: "Connection", paths: Sequence[str]) -> "_Table":
        """Return the messages of a topic, with the values at some paths of attributes; whole arrays are spread."""
        recorded, stamps, values = array("q"), array("q"), array("d")
        getters = [_getter(path) for path in paths]
        width = 0
        with library(self.source, _FAULTS, mend=_MEND):
            for one, recorded_ns, data in self.reader.messages([connection]):
                message = self.reader.deserialize(data, one.msgtype)
                recorded.append(recorded_ns)
                stamps.append(_stamp_ns(message))
                row = [value for get in getters for value in np.ravel(get(message)).tolist()]
                width = len(row)
                values.extend(row)
        if not recorded:
            raise self.source.fault(f"says that {shown(connection.topic)} has messages, and holds none: {_MEND}")
        return _Table(
            name=connection.topic,
            recorded_ns=np.array(recorded, dtype=np.int64),
            stamps_ns=np.array(stamps, dtype=np.int64),
            values=np.array(values).reshape(len(recorded), width),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Table:
    """Messages of one topic, in the order of the bag.

    `stamps_ns` are those of their headers, 0 where they have none.
    """

    name: str
    recorded_ns: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    values: Floats

    @property
    def is_stamped(self) -> bool:
        """Return whether every header has its time."""
        return bool((self.stamps_ns > 0).all())


def _getter(path: str) -> Callable[[object], Any]:
    """Return what gets the value at a path, of an array one by its number."""
    name, _, number = path.rstrip("]").partition("[")
    get = attrgetter(name)
    return (lambda message: get(message)[int(number)]) if number else get


def _stamp_ns(message: Any) -> int:  # noqa: ANN401 - of a type that the bag brings along
    stamp: Any = message.header.stamp if hasattr(message, "header") else getattr(message, "timestamp", 0)
    return int(stamp.sec * 10**9 + stamp.nanosec) if hasattr(stamp, "nanosec") else 0


_Maker = Callable[[LogSource, _Table, Floats], Fixes]


# PX4


def _px4_topics(bag: _Bag, names: Collection[str]) -> log_ulog.Topics:
    """Return what PX4's own messages say, as topics of a ULog."""
    topics: dict[tuple[str, int], Mapping[str, NDArray[Any]]] = {}
    told: list[str] = []
    for connection in bag.connections(_OF_PX4):
        # of one type are the receiver that PX4 chose and any other, and poses of a camera and of the estimator
        topic = next((one for one in names if connection.topic.endswith(f"/{one}")), _OF_PX4[connection.msgtype])
        if topic not in names:
            continue
        number = sum(one == topic for one, _ in topics)
        fields = [name for name, _ in bag.reader.typestore.fielddefs[connection.msgtype][1]]
        kept = [name for name in fields if name in _NUMBERS]
        table = bag.table(connection, kept)
        topics[topic, number] = dict(zip(_spread(kept), table.values.T, strict=True))
        told.append(f"{connection.topic} is {topic} {number}")
    return log_ulog.Topics(source=bag.source, topics=topics, notes=(f"topics: {'; '.join(told)}",) if told else ())


# Fields of PX4's messages that are read, by any of its versions.
_NUMBERS: Final = frozenset(
    {
        *("timestamp", "time_utc_usec", "lat", "lon", "alt", "latitude_deg", "longitude_deg", "altitude_msl_m", "eph"),
        *("fix_type", "lat_lon_valid", "x", "y", "z", "xy_valid", "z_valid", "landed", "q", "position"),
        *("control_mode_flags", *log_ulog.FUSING, "reset_counter", "xy_reset_counter"),
    }
)


def _spread(names: Sequence[str]) -> list[str]:
    """Return the names of columns, of which a quaternion has four and a place three."""
    sizes = {"q": 4, "position": 3}
    return [
        column
        for name in names
        for column in ([f"{name}[{at}]" for at in range(sizes[name])] if name in sizes else [name])
    ]


# ROS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _RosPlaces:
    """Fixes of the topic that is read, a note on the others, and its clock; `receivers` are in the order of choice."""

    fixes: Fixes
    notes: tuple[str, ...]
    clock: "_RosClock"
    receivers: tuple[Fixes, ...]

    @classmethod
    def of(cls, bag: _Bag) -> "_RosPlaces":
        """Return the first topic with two fixes: of a receiver that with most messages, else of an estimator."""
        raw = [bag.table(one, _FIX_FIELDS) for one in bag.connections([_FIX])]
        tables: list[tuple[_Table, _Maker]] = [(one, _fixes_of_ros) for one in raw if not one.name.endswith(_FUSED)]
        tables += [(bag.table(one, _PLACE_FIELDS), _places_of_ros) for one in bag.connections([_LOCATION])]
        tables.sort(key=lambda pair: -len(pair[0].recorded_ns))
        estimated = partial(_fixes_of_ros, is_estimate=True)
        tables += [(one, estimated) for one in raw if one.name.endswith(_FUSED)]
        for one in bag.connections(_GEOGRAPHIC):
            paths = [f"{_GEOGRAPHIC[one.msgtype]}.{name}" for name in _PLACE_FIELDS]
            tables.append((bag.table(one, paths), partial(_places_of_ros, is_estimate=True)))
        clocks = {table.name: _RosClock.of(table) for table, _ in tables}
        found = [make(bag.source, table, clocks[table.name].seconds(table)) for table, make in tables]
        what = f"NavSatFix, LocationFix, geographic_msgs or {_PX4.partition('/')[0]}"
        fixes, notes = first_with_fixes(bag.source, found, what)
        clock = clocks[fixes.track.name]
        on_it = [make(bag.source, table, clock.seconds(table)) for table, make in tables]
        receivers = tuple(one for one in on_it if not one.is_estimate)
        return cls(fixes=fixes, notes=notes, clock=clock, receivers=receivers)


def _ros_streams(bag: _Bag) -> Streams:
    """Return what messages of ROS say."""
    places = _RosPlaces.of(bag)
    return Streams(
        fixes=places.fixes,
        heights=_heights(bag, places.clock),
        attitudes=_attitudes(bag, places.clock),
        clock=places.clock.utc(places.fixes.track),
        notes=(*places.notes, places.clock.note),
    )


_PLACE_FIELDS: Final = ("longitude", "latitude", "altitude")
_FIX_FIELDS: Final = (*_PLACE_FIELDS, "status.status", "position_covariance_type", "position_covariance[0]")


def _fixes_of_ros(source: LogSource, table: _Table, time_s: Floats, *, is_estimate: bool = False) -> Fixes:
    """Return the fixes of a NavSatFix: altitudes above the ellipsoid, no fix below 0."""
    lon, lat, alt, status, kind, variance_m2 = table.values.T
    is_fix = status >= 0
    is_stated = is_fix & (kind > 0) & (variance_m2 > 0)
    stated = stated_of(source, table.name, time_s[is_stated], np.sqrt(variance_m2[is_stated]))
    return Fixes.of(
        source,
        table.name,
        time_s,
        (lon, lat, alt),
        is_fix,
        altitude_of="ellipsoid",
        is_estimate=is_estimate,
        stated=stated,
    )


def _places_of_ros(source: LogSource, table: _Table, time_s: Floats, *, is_estimate: bool = False) -> Fixes:
    lon, lat, alt = table.values.T
    is_fix = np.ones(len(lon), dtype=bool)
    return Fixes.of(
        source, table.name, time_s, (lon, lat, alt), is_fix, altitude_of="ellipsoid", is_estimate=is_estimate
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _RosClock:
    """The clock of the places: the stamps of their headers, or the recorder's."""

    base_ns: int
    late_ns: int  # by which the recorder is later, by the median
    note: str

    @classmethod
    def of(cls, table: _Table) -> "_RosClock":
        """Return the clock of a topic."""
        if not table.is_stamped:
            note = f"times: the recorder's, as {table.name} has none of its own"
            return cls(base_ns=int(table.recorded_ns[0]), late_ns=0, note=note)
        late_ns = int(np.median(table.recorded_ns - table.stamps_ns))
        return cls(base_ns=int(table.stamps_ns[0]), late_ns=late_ns, note="times: stamps of headers")

    def seconds(self, table: _Table) -> Floats:
        """Return the times of a topic on this clock, seconds since the first place."""
        own_ns = table.stamps_ns if table.is_stamped else table.recorded_ns - self.late_ns
        return np.asarray((own_ns - self.base_ns) / _NS)

    def utc(self, track: Stream) -> Clock | None:
        """Return UTC, as the computer's clock had it; none of a simulator's."""
        if self.base_ns < _EPOCH_NS:
            return None
        base_s = self.base_ns / _NS
        return Clock(name="the computer's clock", time_s=track.time_s[:1], utc_s=base_s + track.time_s[:1])


def _heights(bag: _Bag, clock: _RosClock) -> Stream | None:
    """Return heights above home as mavros has them."""
    for one in bag.connections([_HEIGHT[0]]):
        if one.topic.endswith(_HEIGHT[1]):
            table = bag.table(one, ["data"])
            return Stream.of(bag.source, one.topic, clock.seconds(table), table.values)
    return None


def _attitudes(bag: _Bag, clock: _RosClock) -> Stream | None:
    """Return attitudes of the vehicle as mavros has them; other inertial sensors have axes of their own."""
    for one in bag.connections([_TURNS[0]]):
        if one.topic.endswith(_TURNS[1]) and "mavros" in one.topic:
            table = bag.table(one, [f"orientation.{name}" for name in "wxyz"])
            turns = quaternions_of_enu(*table.values.T)
            return Stream.of(bag.source, one.topic, clock.seconds(table), turns)
    return None
