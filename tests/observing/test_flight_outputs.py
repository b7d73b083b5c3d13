# SPDX-License-Identifier: Apache-2.0
"""Files of a flight's fixes, each read by a program of others: GDAL, numpy and pandas, the reader of bags."""

import math
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pandas as pd
import pyogrio
import pytest
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.flights.logs import read_log
from sasgeo_bench.observing.fix_files import NS
from sasgeo_bench.observing.flight_messages import departures, origin_of
from sasgeo_bench.observing.flight_outputs import write_fixes
from tests.observing.flown import SPREAD, START_NS, invented

FLIGHT = invented(4, is_accepted=[True, True, False, True])
LONS, LATS = ([getattr(fix, name) for fix in FLIGHT.accepted] for name in ("lon_deg", "lat_deg"))
TIMES = pd.to_datetime([fix.time_ns for fix in FLIGHT.accepted], utc=True)


@pytest.fixture
def written(tmp_path):
    """Write a flight into a file of a name, and return its path."""

    def write(name, *, flight=FLIGHT, has_all=False, kind="vision_position_estimate"):
        sent = departures(flight, has_all=has_all)
        write_fixes(tmp_path / name, flight, sent, kind=kind, origin=origin_of(sent))
        return tmp_path / name

    return write


def test_gdal_reads_the_places_and_times_of_a_gpx(written):
    points = pyogrio.read_dataframe(written("a.gpx"), layer="track_points")
    assert points.geometry.x.tolist() == pytest.approx(LONS, abs=1e-7)
    assert points.geometry.y.tolist() == pytest.approx(LATS, abs=1e-7)
    assert points["time"].tolist() == TIMES.tolist()
    assert points["fix"].isna().all()
    everything = pyogrio.read_dataframe(written("b.gpx", has_all=True), layer="track_points")
    assert everything["fix"].fillna("").tolist() == ["", "", "none", ""]


def test_gdal_reads_the_track_of_a_kml(written):
    track = pyogrio.read_dataframe(written("a.kml")).iloc[0]
    np.testing.assert_allclose(np.array(track.geometry.coords)[:, :2], np.stack([LONS, LATS], axis=1), atol=1e-7)
    assert (track["begin"], track["end"]) == (TIMES[0], TIMES[-1])
    log = read_log(written("b.kml"))  # our own reader has each time
    assert log.start_s + log.time_s == pytest.approx([fix.time_ns / NS for fix in FLIGHT.accepted])


def test_gdal_reads_what_is_known_of_each_fix_in_a_geojson(written):
    points = pyogrio.read_dataframe(written("a.geojson", has_all=True))
    assert points["is_accepted"].tolist() == [True, True, False, True]
    assert points["unix_s"].tolist() == pytest.approx([fix.time_ns / NS for fix in FLIGHT.fixes])
    assert points["time_s"].tolist() == [0, 1, 2, 3]
    assert points.geometry.x.tolist() == [fix.lon_deg for fix in FLIGHT.fixes]
    np.testing.assert_allclose(np.stack(points["covariance"]), np.tile(np.ravel(SPREAD), (4, 1)))
    assert "(c) a & b" in written("b.geojson").read_text()


def test_a_trajectory_has_the_nanoseconds_and_the_heading_of_each_fix(written):
    path = written("a.tum", flight=invented(2, time_ns=[START_NS + 1, START_NS + NS + 7]))
    rows = np.loadtxt(path)
    assert [Decimal(line.split()[0]) * NS for line in path.read_text().splitlines()[1:]] == [
        START_NS + 1,
        START_NS + NS + 7,
    ]
    assert rows[1, 1:3].tolist() == [539_015.0, 5_221_011.0]
    ahead = Rotation.from_quat(rows[:, 4:]).apply([1.0, 0.0, 0.0])
    yaw = np.radians([350.4, 0.4])
    np.testing.assert_allclose(ahead[:, :2], np.stack([np.sin(yaw), np.cos(yaw)], axis=1), atol=1e-6)


def test_a_bag_holds_places_poses_and_when_they_were_sent(written):
    reading = pytest.importorskip("rosbags.highlevel")
    path = written("a.mcap", has_all=True)
    found = {"/sasgeo/fix": [], "/sasgeo/pose": []}
    with reading.AnyReader([path]) as bag:
        for connection, at_ns, raw in bag.messages():
            found[connection.topic].append((at_ns, bag.deserialize(raw, connection.msgtype)))
    fixes, poses = found["/sasgeo/fix"], found["/sasgeo/pose"]
    assert [at_ns for at_ns, _ in fixes] == [fix.time_ns + NS // 4 for fix in FLIGHT.fixes]
    stamps = [one.header.stamp.sec * NS + one.header.stamp.nanosec for _, one in fixes]
    assert stamps == [fix.time_ns for fix in FLIGHT.fixes]
    assert [one.status.status for _, one in fixes] == [0, 0, -1, 0]
    assert [(one.longitude, one.latitude) for _, one in fixes] == [(fix.lon_deg, fix.lat_deg) for fix in FLIGHT.fixes]
    spread = np.reshape(fixes[0][1].position_covariance, (3, 3))
    np.testing.assert_allclose(spread[:2, :2], np.array(SPREAD)[:2, :2])
    assert (fixes[0][1].position_covariance_type, poses[0][1].header.frame_id) == (3, "EPSG:32632")
    pose = poses[1][1].pose.pose
    turn = Rotation.from_quat([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    assert turn.as_euler("zyx", degrees=True)[0] == pytest.approx(90.0 - 0.4)
    assert (pose.position.x, pose.position.y) == (539_015.0, 5_221_011.0)


def test_the_ellipse_of_a_pose_is_turned_into_the_grid(written):
    reading = pytest.importorskip("rosbags.highlevel")
    flight = invented(1, heading_deg=[0.0], yaw_deg=[90.0])  # true north is the grid's east
    with reading.AnyReader([written("a.mcap", flight=flight)]) as bag:
        connection, _, raw = next(bag.messages([one for one in bag.connections if one.topic == "/sasgeo/pose"]))
        spread = np.reshape(bag.deserialize(raw, connection.msgtype).pose.covariance, (6, 6))
    (ee, en, eh), (_, nn, nh), (_, _, hh) = SPREAD
    rad = math.pi / 180
    # The grid's east is true north, its north true west; a heading counts the other way.
    assert spread[0, [0, 1, 5]] == pytest.approx([nn, -en, -nh * rad])
    assert spread[1, [1, 5]] == pytest.approx([ee, eh * rad])
    assert spread[5, 5] == pytest.approx(hh * rad**2)


def test_a_table_has_a_row_a_message_and_the_time_at_which_it_was_sent(written):
    rows = pd.read_csv(written("a.csv"), dtype={"timestamp": str})
    assert [Decimal(one) * NS for one in rows["timestamp"]] == [fix.time_ns + NS // 4 for fix in FLIGHT.accepted]
    assert rows["usec"].tolist() == [fix.time_ns // 1000 for fix in FLIGHT.accepted]
    assert rows["covariance[6]"].tolist() == pytest.approx([16.0] * 3)
    gps = pd.read_csv(written("b.csv", kind="gps_input", has_all=True))
    assert gps["fix_type"].tolist() == [3, 3, 1, 3]
    assert gps["lat"].tolist() == [round(fix.lat_deg * 1e7) for fix in FLIGHT.fixes]


def test_no_file_is_written_over_another(written):
    path = written("a.tum")
    before = path.read_bytes()
    with pytest.raises(StoreError, match="is there already: name another file by --to, or remove it"):
        written("a.tum")
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("a.shp", {}, "names no kind of file: end it in one of .gpx"),
        ("a.kml", {"has_all": True}, "would not say which fixes are accepted: leave out --all"),
        ("a.csv", {"has_all": True}, "would not say which fixes are accepted: leave out --all"),
        *(
            (
                f"a.{one}",
                {"is_dated": False},
                "does not say when it began, and a.* holds dates: give one, as in --start",
            )
            for one in ("gpx", "kml", "mcap", "csv")
        ),
    ],
)
def test_what_a_file_cannot_hold_is_refused_and_nothing_written(written, tmp_path, name, changes, words):
    flight = FLIGHT if changes.get("is_dated", True) else replace(invented(), clock="flight")
    with pytest.raises(ConfigError, match=words):
        written(name, flight=flight, has_all=changes.get("has_all", False))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("begin_ns", [10 * NS, 4_112_848_800 * NS])  # 1970 and 2100
def test_a_clock_that_was_not_set_gives_no_date(written, begin_ns):
    flight = replace(invented().starting(begin_ns), clock="camera")
    with pytest.raises(ConfigError, match="does not say when it began, and"):
        written("a.mcap", flight=flight)


def test_a_flight_without_a_date_has_seconds_since_its_first_view(written):
    flight = replace(invented(2, time_ns=[0, NS]), clock="flight", begin_ns=0)
    points = pyogrio.read_dataframe(written("a.geojson", flight=flight))
    assert points["time_s"].tolist() == [0, 1]
    assert points["unix_s"].isna().all()
    assert np.loadtxt(written("a.tum", flight=flight))[:, 0].tolist() == [0.0, 1.0]


def test_a_folder_that_cannot_be_written_is_named(written, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"cannot be written \(.*\): name another file by --to"):
        written("file/a.mcap")
