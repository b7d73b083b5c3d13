# SPDX-License-Identifier: Apache-2.0
"""Photos get their poses from the log of their flight: joined by UTC, or by the second of the log that is stated."""

import math

import numpy as np
import pytest
from PIL import ExifTags, Image

from sasgeo_bench.core.errors import ConfigError, FlightError, PoseError
from sasgeo_bench.observing.import_photos import ImportRequest
from sasgeo_bench.observing.logged_photos import poses_by_log
from sasgeo_bench.observing.posed_pictures import GPS_SIGMA_M, Heights, pose_pictures
from tests.sensing.test_photos import write_photo, xmp_of

LON, LAT, STEP = 9.5200013, 47.1400017, 1e-4  # of as many digits as a receiver has


def log_of(path, *, gap=(), clock="2025-05-01T10:00:{:06.3f}Z"):
    """A flight to the north with a point a second, 40 of them, that turns by a degree a second and climbs."""
    rows = [
        f"{clock.format(at)},{LAT + at * STEP:.7f},{LON},{80 + at},{300 + at},{(350 + at) % 360}"
        for at in range(40)
        if at not in gap
    ]
    path.write_text("\n".join(["time,lat,lon,height_agl_m,alt_m,heading_deg", *rows]) + "\n", encoding="ascii")
    return path


def gps_of(lon, lat):
    return {
        ExifTags.GPS.GPSLatitudeRef: "N",
        ExifTags.GPS.GPSLatitude: (lat, 0, 0),
        ExifTags.GPS.GPSLongitudeRef: "E",
        ExifTags.GPS.GPSLongitude: (lon, 0, 0),
    }


def photo(path, time, *, offset="+02:00", part="", xmp=b""):
    exif = Image.Exif()
    inner = exif.get_ifd(ExifTags.IFD.Exif)
    if time:
        inner[ExifTags.Base.DateTimeOriginal] = time
    if offset:
        inner[ExifTags.Base.OffsetTimeOriginal] = offset
    if part:
        inner[ExifTags.Base.SubsecTimeOriginal] = part
    Image.new("L", (40, 30)).save(path, format="JPEG", exif=exif, **({"xmp": xmp} if xmp else {}))
    return path


def test_a_photo_lies_between_the_points_of_the_log_at_its_own_moment(tmp_path):
    log = log_of(tmp_path / "log.csv")
    found = {
        "a": photo(tmp_path / "a.jpg", "2025:05:01 12:00:12", part="25"),
        "b": photo(tmp_path / "b.jpg", "2025:05:01 05:30:20", offset="-04:30"),
    }
    table = poses_by_log(log, found)
    for pose, second in zip(table.poses, (12.25, 20.0), strict=True):
        assert pose.place == pytest.approx((LON, LAT + second * STEP), abs=1e-7)
        assert pose.height_m == pytest.approx(80 + second)
        assert pose.height_of == "take-off"
        # 350 degrees and more: past north the short way
        assert pose.attitude.yaw_deg % 360 == pytest.approx((350 + second) % 360)
        assert pose.tilt_deg == pytest.approx(0, abs=1e-4)
        assert pose.time_s == pytest.approx(1746093600 + second)
    assert "12.2 s after the log begins, by UTC of both" in table.notes[0]


def test_an_offset_is_the_second_of_the_log_at_the_first_photo_whatever_the_clocks_say(tmp_path):
    log = log_of(tmp_path / "log.csv")
    late, early = (photo(tmp_path / f"{at}.jpg", f"1999:01:01 00:00:0{at}", offset="") for at in (7, 2))
    found = {"b": late, "a": early}
    with pytest.raises(FlightError, match=r"2 photos \(b, a\) without the zone of the clock: say --offset"):
        poses_by_log(log, found)
    places = {pose.name: pose.place[1] for pose in poses_by_log(log, found, offset_s=10.0).poses}
    assert places == pytest.approx({"a": LAT + 10 * STEP, "b": LAT + 15 * STEP}, abs=1e-7)
    zones = {
        "b": photo(tmp_path / "8.jpg", "1999:01:01 00:00:09", offset="-01:00"),
        "a": photo(tmp_path / "9.jpg", "1999:01:01 02:00:02", offset="+01:00"),
    }
    places = {pose.name: pose.place[1] for pose in poses_by_log(log, zones, offset_s=10.0).poses}
    assert places == pytest.approx({"a": LAT + 10 * STEP, "b": LAT + 17 * STEP}, abs=1e-7)


def test_photos_that_the_log_does_not_tell_are_left_out_with_the_reason(tmp_path):
    log = log_of(tmp_path / "log.csv", gap=range(15, 30))
    (tmp_path / "broken.jpg").write_text("no photo")
    found = {
        "good": photo(tmp_path / "good.jpg", "2025:05:01 12:00:05"),
        "early": photo(tmp_path / "early.jpg", "2025:05:01 11:59:00"),
        "gap": photo(tmp_path / "gap.jpg", "2025:05:01 12:00:22"),
        "timeless": photo(tmp_path / "timeless.jpg", ""),
        "broken": tmp_path / "broken.jpg",
    }
    table = poses_by_log(log, found)
    assert [pose.name for pose in table.poses] == ["good"]
    assert table.left_out == {
        "that the track does not cover": ("early",),
        "in a gap of more than 10 s of the track": ("gap",),
        "without a time (EXIF's DateTimeOriginal)": ("timeless",),
        "that cannot be read": ("broken",),
    }
    with pytest.raises(PoseError, match=r"no photo was taken while log.csv ran .*: if a clock is wrong, say --offset"):
        poses_by_log(log, {"early": found["early"]})
    with pytest.raises(PoseError, match=r"\(1 photo \(timeless\) without a time \(EXIF's DateTimeOriginal\)\)$"):
        poses_by_log(log, {"timeless": found["timeless"]})


def test_a_photo_outside_the_log_is_told_once(tmp_path):
    folder, log = tmp_path / "photos", log_of(tmp_path / "log.csv")
    folder.mkdir()
    times = {"good.jpg": "2025:05:01 12:00:05", "early.jpg": "2025:05:01 11:59:00"}
    table = poses_by_log(log, {name: photo(folder / name, time) for name, time in times.items()})
    found = pose_pictures(folder, table, epsg=32632, heights=Heights())
    assert found.left_out["that the track does not cover"] == ["early.jpg"]
    assert sum("early.jpg" in names for names in found.left_out.values()) == 1
    assert not [line for line in table.lines() if "early" in line]


def test_a_log_without_headings_asks_for_one_that_has_them_not_for_a_column(tmp_path):
    folder, log = tmp_path / "photos", tmp_path / "flight.gpx"
    folder.mkdir()
    points = (f'<trkpt lat="{LAT + at * STEP}" lon="{LON}"><ele>{300 + at}</ele><time>2025-05-01T10:00:{at:02d}Z</time>'
              "</trkpt>" for at in range(40))  # fmt: skip
    head = '<gpx version="1.1" creator="a" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    log.write_text(f"{head}{''.join(points)}</trkseg></trk></gpx>", encoding="utf-8")
    table = poses_by_log(log, {"a.jpg": photo(folder / "a.jpg", "2025:05:01 12:00:05")})
    (why,) = pose_pictures(folder, table, epsg=32632, heights=Heights()).left_out
    assert why == (
        "without angles of the camera (flight.gpx has no headings: name a log that has, or a table with gimbal_pitch)"
    )


def test_a_log_that_contradicts_the_photos_own_positions_is_told(tmp_path):
    log = log_of(tmp_path / "log.csv")
    for far_deg, is_told in ((0.0, False), (0.01, True)):
        path = tmp_path / f"{far_deg}.jpg"
        write_photo(path, gps=gps_of(LON, LAT + 5 * STEP + far_deg))
        notes = " ".join(poses_by_log(log, {"a": path}, offset_s=5.0).notes)
        assert ("the log puts 1 photo 1112 m (median) from their own positions" in notes) is is_told


def test_the_gimbal_of_a_photo_goes_before_the_body_of_the_drone(tmp_path):
    log = log_of(tmp_path / "log.csv")
    told = xmp_of({"GimbalYawDegree": "33", "GimbalPitchDegree": "-80", "GimbalRollDegree": "0"}).encode()
    found = {"a": photo(tmp_path / "a.jpg", "2025:05:01 12:00:05", xmp=told)}
    assert poses_by_log(log, found).poses[0].attitude is None  # the photo's own is kept


def test_a_log_that_does_not_say_utc_needs_an_offset_and_a_table_beside_it_is_refused(tmp_path):
    log = log_of(tmp_path / "log.csv", clock="{:.3f}")
    log.write_text(log.read_text().replace("time,", "time_s,"))
    found = {"a": photo(tmp_path / "a.jpg", "2025:05:01 12:00:05")}
    with pytest.raises(FlightError, match=r"log\.csv does not say UTC: say --offset"):
        poses_by_log(log, found)
    assert np.isclose(poses_by_log(log, found, offset_s=3.0).poses[0].place[1], LAT + 3 * STEP)
    with pytest.raises(ConfigError, match="give --poses or --track alone"):
        ImportRequest(pictures=tmp_path, region=tmp_path, out=tmp_path, poses=log, log=log)


def test_a_clock_that_counts_whole_seconds_costs_half_of_one_and_is_told(tmp_path):
    log = log_of(tmp_path / "log.csv")
    found = {"a": photo(tmp_path / "a.jpg", "2025:05:01 12:00:12")}
    table = poses_by_log(log, found)
    (pose,) = table.poses
    assert pose.place[1] == pytest.approx(LAT + 12.5 * STEP, abs=1e-7)
    way_m = STEP * 111_180  # of a second, which is truncated in the photo
    assert pose.sigma_m == pytest.approx(math.hypot(GPS_SIGMA_M, way_m / math.sqrt(6)), abs=0.02)
    assert any("count whole seconds" in note for note in table.notes)
    both = found | {"b": photo(tmp_path / "b.jpg", "2025:05:01 12:00:14", part="5")}
    first, second = poses_by_log(log, both).poses
    assert [one.place[1] for one in (first, second)] == pytest.approx([LAT + at * STEP for at in (12, 14.5)], abs=1e-7)
    assert first.sigma_m is None
