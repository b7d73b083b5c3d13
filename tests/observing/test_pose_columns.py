# SPDX-License-Identifier: Apache-2.0
"""Tables with columns: names, units, degrees, angles, heights, times, uncertainty and lenses; rows that are none."""

import datetime as dt
import json

import numpy as np
import pytest

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.observing.picture_poses import PoseFacts
from sasgeo_bench.observing.pose_tables import read_pose_table
from sasgeo_bench.sensing.camera import Attitude
from tests.pose_files import about, body

PLACE = "115.46,-8.29"


@pytest.fixture
def read(tmp_path):
    """Read a table that is given as text."""

    def run(content, **facts):
        path = tmp_path / "poses.csv"
        path.write_text(content, encoding="utf-8")
        return read_pose_table(path, PoseFacts(**facts))

    return run


def reasons(table):
    return {why: set(names) for why, names in table.left_out.items()}


def one(read, header, row, **facts):
    """The one pose of a table with a name and a place before the columns in question."""
    (pose,) = read(f"file,lon,lat,{header}\na.jpg,{PLACE},{row}\n", **facts).poses
    return pose


@pytest.mark.parametrize(
    "cell",
    [
        "-8.29075",
        "8.29075 S",
        "S 8.29075",
        "8 deg 17' 26.70\" S",
        "8\u00b017'26.7\"S",
        "8\u00ba 17\u2032 26.7\u2033 S",
        "8 17 26.7 S",
        "8 deg 17.445' S",
        "8d17m26.7s S",
        "-8 17 26.7",
        "8,17.445S",
        "-8.29075\u00b0",
    ],
)
def test_degrees_are_read_however_they_are_written(cell, read):
    doubled = cell.replace('"', '""')
    table = read(f'file,lat,lon\na.jpg,"{doubled}",115.5\n')
    assert table.poses[0].place == pytest.approx((115.5, -8.29075), abs=1e-12)


# Latitude, longitude -> why they are none.
FAULTS = [
    ("", "115.46", "without a position"),
    ("undef", "115.46", "without a position"),
    ("nan", "nan", "without a position"),
    ("8 deg 17' 26.70\"", "115.46", "whose position does not say N or S, E or W"),
    ("8 deg 77' 26.70\" S", "115.46", "whose position is no number"),
    ("north", "115.46", "whose position is no number"),
    ("8,2907 S", "115.46", "whose position is no number"),
    ("8,05 S", "115.46", "whose position is no number"),
    ("-8,05", "115.46", "whose position is no number"),
    ("115.46 E", "8.29 S", "whose longitude and latitude are swapped"),
    ("115.46", "-8.29", "whose longitude and latitude are swapped"),
    ("-8.29 N", "115.46", "whose position has a sign and a letter that contradict each other"),
    ("250 deg 0' 0.00\" N", "325 deg 0' 0.00\" W", "with a place that is nowhere on earth"),
    ("91", "200", "with a place that is nowhere on earth"),
    ("0", "0", "at 0, 0, where no receiver had a fix"),
    ("48.85", "2.35", "more than 50 km from the others"),
]


@pytest.mark.parametrize(("lat", "lon", "why"), FAULTS)
def test_a_position_that_cannot_be_is_left_out_with_its_reason(lat, lon, why, read):
    quoted = [one.replace('"', '""') for one in (lat, lon)]
    table = read('file,lat,lon\nb.jpg,-8.29,115.46\nc.jpg,-8.29,115.47\na.jpg,"{}","{}"\n'.format(*quoted))
    assert reasons(table) == {why: {"a.jpg"}}
    assert [pose.name for pose in table.poses] == ["b.jpg", "c.jpg"]


def test_rows_without_a_name_or_with_other_cells_are_left_out(read):
    table = read("file,lat,lon\n,-8.29,115.46\na.jpg,-8.29\nb.jpg,-8.29,115.46,7\nc.jpg,-8.29,115.46,,\n")
    assert [pose.name for pose in table.poses] == ["c.jpg"]
    assert reasons(table) == {"without a name": {"line 2"}, "of other than the header's 3 cells": {"a.jpg", "b.jpg"}}


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("file,EXIF:GPSLatitude,EXIF:GPSLatitudeRef,EXIF:GPSLongitude,GPSLongitudeRef", "a.jpg,8.29,South,115.46,E"),
        ("SourceFile,GPS:GPSLatitude,GPS:GPSLatitudeRef,GPS:GPSLongitude,GPS:GPSLongitudeRef", "a.jpg,8.29,S,115.46,E"),
        ("SourceFile,EXIF:GPSLatitude,Composite:GPSLatitude,Composite:GPSLongitude", "a.jpg,8.29,-8.29,115.46"),
        ("SourceFile,GPSPosition", 'a.jpg,"8.29 S, 115.46 E"'),
        ("SourceFile,GPSPosition", "a.jpg,-8.29 115.46"),
        ("image;Latitude [deg];Longitude [deg]", "a.jpg;-8,29;115,46"),
        ("Photo\tlat_e7\tlng_e7", "a.jpg\t-82900000\t1154600000"),
        ("# name lat lon", "a.jpg -8.29 115.46"),
    ],
)  # fmt: skip
def test_places_are_found_under_their_usual_names(header, row, read):
    (pose,) = read(f"{header}\n{row}\n").poses
    assert pose.name == "a.jpg"
    assert pose.place == pytest.approx((115.46, -8.29), abs=1e-12)


@pytest.mark.parametrize("group", ["EXIF", "GPS"])
def test_numbers_of_exif_have_no_sign_and_say_no_side(group, read):
    table = read(
        f"SourceFile,{group}:GPSLatitude,Composite:GPSLatitude,GPSLongitude\na.jpg,8.29,,115.46\nb.jpg,8.29,-8.29,115.46\n"
    )
    assert reasons(table) == {"whose position does not say N or S, E or W": {"a.jpg"}}


def test_a_name_that_holds_spaces_is_what_the_numbers_leave(read):
    (pose,) = read("imageName X Y Z Omega Phi Kappa\nDJI  0001 (2).JPG 330000 9083000 200 0 0 0\n", epsg=32750).poses
    assert pose.name == "DJI  0001 (2).JPG"
    assert pose.place == (330000.0, 9083000.0)


def test_a_geolocation_file_of_pix4d_needs_no_header(read):
    table = read("a.jpg,-8.29,115.46,539.9,0.02,0.04\nb.jpg,-8.291,115.46,540\n".replace(",540", ",540,0.02,0.04"))
    assert (table.kind, table.poses[0].place, table.poses[0].sigma_m) == ("Pix4D", (115.46, -8.29), 0.02)
    assert table.notes[0] == "no header: read as Pix4D writes it, name, latitude, longitude, altitude"
    (pose,) = read("a.jpg,330000,9083000,539.9\n", epsg=32750).poses
    assert pose.lonlat == pytest.approx((115.46, -8.29), abs=0.02)


# Angles


def test_a_pitch_without_a_word_counts_from_where_the_user_says(read):
    said = [
        one(read, "yaw,pitch,roll", angles, pitch_zero=zero)
        for zero, angles in (("down", "90,30,0"), ("horizon", "90,-60,0"))
    ]
    assert said[0].attitude.pitch_deg == pytest.approx(-60.0)
    for pose in said:
        np.testing.assert_allclose(pose.attitude.matrix, body(90.0, -60.0, 0.0), atol=1e-9)


def test_angles_of_pix4d_are_of_the_body_below_which_the_camera_looks_down(read):
    (pose,) = read(f"#imagename,longitude,latitude,altitude,yaw,pitch,roll\na.jpg,{PLACE},100,37,23,11\n").poses
    np.testing.assert_allclose(pose.attitude.matrix, body(37.0, 23.0, 11.0) @ about(1, -90.0), atol=1e-9)


def test_omega_phi_kappa_turn_about_fixed_axes_one_after_the_other(read):
    pose = one(read, "omega,phi,kappa", "5,-7,30")
    to_enu = about(0, 5.0) @ about(1, -7.0) @ about(2, 30.0)  # of the picture's right, up, back
    right, down, ahead = to_enu[:, 0], -to_enu[:, 1], -to_enu[:, 2]
    ned = [[axis[1], axis[0], -axis[2]] for axis in (ahead, right, down)]
    np.testing.assert_allclose(pose.attitude.matrix, np.transpose(ned), atol=1e-9)


def test_a_gimbal_without_yaw_follows_the_drone_which_is_said(read):
    table = read(f"SourceFile,GPSLongitude,GPSLatitude,GimbalPitchDegree,FlightYawDegree\na.jpg,{PLACE},-80,+90.5\n")
    assert table.poses[0].attitude == Attitude(pitch_deg=-80.0, yaw_deg=90.5)
    assert "the camera's yaw is taken from FlightYawDegree" in table.notes
    assert "the camera's roll is taken as 0" in table.notes


def test_pitch_yaw_and_roll_of_makers_notes_are_no_gimbals(read):
    """Exiftool prints DJI's body, and Pix4D's camera, under one name; the gimbal's own goes first."""
    header = "SourceFile,GPSLongitude,GPSLatitude,Pitch,Yaw,Roll"
    table = read(f"{header},GimbalPitchDegree,GimbalYawDegree,GimbalRollDegree\na.jpg,{PLACE},1.8,46,3,-89.9,45,0\n")
    assert table.poses[0].attitude == Attitude(pitch_deg=-89.9, yaw_deg=45.0)
    table = read(f"{header}\na.jpg,{PLACE},1.8,46,3\n")
    assert table.poses[0].attitude is None
    assert any("which is the camera's or the drone's, by maker" in note for note in table.notes)


def test_rows_without_angles_keep_their_place_and_are_counted(read):
    table = read(f"file,lon,lat,gimbal_yaw,gimbal_pitch,gimbal_roll\na.jpg,{PLACE},10,-90,0\nb.jpg,{PLACE},10,,\n")
    assert [pose.attitude is None for pose in table.poses] == [False, True]
    assert table.poses[1].heading_deg == 10.0
    assert "1 pose (b.jpg) without angles of the camera" in table.notes


def test_pitches_that_count_from_elsewhere_are_left_out(read):
    header = "#imagename,longitude,latitude,yaw,pitch,roll"
    table = read(f"{header}\na.jpg,{PLACE},0,-80,0\nb.jpg,{PLACE},0,5,0\n")
    assert reasons(table) == {"whose pitch seems to count from the horizon, not from straight down": {"a.jpg"}}
    header = "SourceFile,GPSLongitude,GPSLatitude,Make,GimbalYawDegree,GimbalPitchDegree,GimbalRollDegree"
    table = read(f"{header}\na.jpg,{PLACE},Autel Robotics,0,20,0\nb.jpg,{PLACE},Autel Robotics,0,80,0\n")
    assert reasons(table) == {"whose pitch may count up or down": {"a.jpg"}}
    assert table.poses[0].attitude.pitch_deg == -80.0


def test_angles_in_the_unit_that_a_cell_or_a_column_states(read):
    angles = "1.5707963267948966 rad,-80 deg,0\u00b0"
    assert one(read, "gimbal_yaw,gimbal_pitch,gimbal_roll", angles).attitude == Attitude(pitch_deg=-80.0, yaw_deg=90.0)
    stated = [
        one(read, ",".join(f"{name}_{unit}" for name in ("omega", "phi", "kappa")), row).attitude.matrix
        for unit, row in (("deg", "1,2,3"), ("rad", ",".join(str(np.radians(value)) for value in (1, 2, 3))))
    ]
    np.testing.assert_allclose(*stated, atol=1e-9)


def test_of_columns_of_one_meaning_the_one_that_is_read_is_said(read):
    table = read("file,lat,latitude,lon\na.jpg,-8.29,-8.290001,115.46\nb.jpg,-8.28,,115.46\n")
    assert [pose.place[1] for pose in table.poses] == [-8.290001, -8.28]
    assert "latitude is read, and lat where that is empty" in table.notes


def test_a_decimal_comma_is_no_separator_of_minutes(read):
    table = read('file,lat,lat_ref,lon\na.jpg,"48,05",N,9.0\nb.jpg,48.05,N,9.0\n')
    assert reasons(table) == {"whose position is no number": {"a.jpg"}}


def test_a_place_in_another_datum_is_none_unless_the_user_says_which(read):
    content = "file,lat,lon,GPSMapDatum\na.jpg,35.0,139.0,TOKYO\nb.jpg,35.0,139.0,WGS-84\n"
    assert reasons(read(content)) == {"with a position in another datum than WGS 84 ('TOKYO'): say --epsg": {"a.jpg"}}
    assert len(read(content, epsg=4301).poses) == 2


def test_a_crs_in_feet_has_eastings_in_feet_and_heights_in_what_they_state(read):
    (pose,) = read("file,x,y,z_ft\na.jpg,980000,200000,300\n", epsg=2263).poses
    (same,) = read("file,x_m,y_m,z_m\na.jpg,298704.5974,60960.1219,91.44\n", epsg=2263).poses
    assert pose.altitude_m == pytest.approx(91.44)
    assert same.place == pytest.approx(pose.place, abs=1e-3)
    assert pose.lonlat == pytest.approx((-74.0158, 40.7156), abs=1e-3)


def test_a_heading_against_magnetic_north_is_not_read(read):
    header = f"SourceFile,GPSLongitude,GPSLatitude,GPSImgDirection,GPSImgDirectionRef\na.jpg,{PLACE},90,"
    assert read(header + "True North\n").poses[0].heading_deg == 90.0
    assert read(header + "Magnetic North\n").poses[0].heading_deg is None


# Heights, times, uncertainty, lens


@pytest.mark.parametrize(
    ("header", "row", "height", "altitude"),
    [
        ("RelativeAltitude,AbsoluteAltitude", "+40.10,+198.61", (40.1, "take-off"), (198.61, "sea")),
        ("rel_alt_m", "40.1", (40.1, "take-off"), None),
        ("height_agl_ft", "100", (30.48, "ground"), None),
        ("GPSAltitude", "198.6 m Above Sea Level", None, (198.6, "sea")),
        ("GPSAltitude", "12.5 m Below Sea Level", None, (-12.5, "sea")),
        ("EXIF:GPSAltitude,EXIF:GPSAltitudeRef", "12.5 m,Below Sea Level", None, (-12.5, "sea")),
        ("ellipsoidal_height_m", "250.5", None, (250.5, "ellipsoid")),
        ("altitude [m]", "250.5", None, (250.5, "unstated")),
        ("altitude", "820.2 ft", None, (820.2 * 0.3048, "unstated")),
        ("altitude_ft", "820.2 m", None, (820.2, "unstated")),
        ("altitude", "10000 cm", None, (100.0, "unstated")),
        ("altitude", "10000 kg", None, None),
        ("altitude", "100 m or so", None, None),
        ("AbsoluteAltitude,AltitudeType", "+198.61,RtkAlt", None, (198.61, "ellipsoid")),
        ("AbsoluteAltitude,AltitudeType", "+198.61,GpsFusionAlt", None, (198.61, "sea")),
        ("GPSAltitude", "undef", None, None),
        ("GPSAltitude", "0/0", None, None),
        ("GPSAltitude", "3721/10", None, (372.1, "sea")),
    ],
)
def test_heights_are_read_with_what_they_count_from(header, row, height, altitude, read):
    pose = one(read, header, row)
    assert (pose.height_m and round(pose.height_m, 9)) == (height and height[0])
    assert not height or pose.height_of == height[1]
    assert (pose.altitude_m and round(pose.altitude_m, 9)) == (altitude and round(altitude[0], 9))
    assert not altitude or pose.altitude_of == altitude[1]


NOON = dt.datetime(2025, 10, 2, 12, 8, 47, tzinfo=dt.UTC).timestamp()


@pytest.mark.parametrize(
    ("header", "row", "time_s", "clock"),
    [
        ("DateTimeOriginal", "2025:10:02 12:08:47", NOON, "local"),
        ("SubSecDateTimeOriginal,DateTimeOriginal", "2025:10:02 12:08:47.25+08:00,x", NOON + 0.25 - 8 * 3600, "utc"),
        ("time,x", "2025-10-02 12:08:47-03,x", NOON + 3 * 3600, "utc"),
        ("DateTimeOriginal,SubSecTimeOriginal,OffsetTime", "2025:10:02 12:08:47,25,-03:30", NOON + 0.25 + 12600, "utc"),
        ("timestamp", "2025-10-02T12:08:47Z", NOON, "utc"),
        ("GPSDateTime", "2025:10:02 12:08:47Z", NOON, "utc"),
        ("time_utc", "2025-10-02 12:08:47", None, "own"),
        ("time_s", "1759406927.125", 1759406927.125, "own"),
        ("timestamp_ms", "1759406927125", 1759406927.125, "own"),
        ("timestamp", "1759406927", None, "own"),
        ("DateTimeOriginal", "0000:00:00 00:00:00", None, "own"),
        ("DateTimeOriginal", "", None, "own"),
    ],
)  # fmt: skip
def test_times_are_seconds_with_the_clock_that_they_are_by(header, row, time_s, clock, read):
    pose = one(read, header, row)
    assert (pose.time_s, pose.clock) == (time_s, clock)


@pytest.mark.parametrize(
    ("header", "row", "sigma"),
    [
        ("GPSHPositioningError", "4.5 m", 4.5),
        ("RtkStdLon,RtkStdLat,RtkStdHgt", "0.012,0.015,0.03", 0.015),
        ("horizontal_accuracy_cm", "2", 0.02),
        ("RtkStdLon", "0.012", None),
        ("GPSHPositioningError", "undef", None),
        ("GPSHPositioningError", "0", None),
    ],
)
def test_the_uncertainty_of_a_place_is_read_in_metres(header, row, sigma, read):
    assert one(read, header, row).sigma_m == (sigma and pytest.approx(sigma))


def test_a_lens_is_read_as_of_a_photo_and_not_of_one_that_was_turned(read):
    header = "ImageWidth,ImageHeight,FocalLengthIn35mmFormat,Orientation"
    lens = one(read, header, "4000,3000,24 mm,Horizontal (normal)").intrinsics
    assert lens.focal_px[0] == pytest.approx(24 * 5000 / np.hypot(36, 24))
    assert lens.centre_px == (2000.0, 1500.0)
    assert one(read, header, "4000,3000,24 mm,Rotate 90 CW").intrinsics is None
    assert one(read, "ImageWidth,ImageHeight", "4000,3000").intrinsics is None
    calibrated = "ImageWidth,ImageHeight,CalibratedFocalLength,CalibratedOpticalCenterX,CalibratedOpticalCenterY"
    assert one(read, calibrated, "2000,1500,3666.67,2000,1500").intrinsics.focal_px[0] == pytest.approx(3666.67 / 2)


def test_what_is_not_read_and_not_understood_is_said(read):
    table = read(f"file,lon,lat,altitude,ISO,height\na.jpg,{PLACE},high,100,3000\n")
    assert table.notes == (
        "column altitude: 1 cell not understood",
        "altitude does not say what it counts from",
        "not read: 2 columns (ISO, height)",
    )


# GeoJSON


def collection(*features, **more):
    return json.dumps({"type": "FeatureCollection", "features": list(features), **more})


def feature(name, geometry, **told):
    return {"type": "Feature", "geometry": geometry, "properties": {"name": name, **told}}


def test_points_of_geojson_are_poses_and_other_shapes_are_none(read):
    line = {"type": "LineString", "coordinates": [[115.46, -8.29], [115.47, -8.29]]}
    features = [
        feature("a.jpg", {"type": "Point", "coordinates": [115.46, -8.29, 130.0]}, latitude=7.0, heading=12),
        feature("b.jpg", line),
        feature("c.jpg", None),
        feature("d.jpg", {"type": "Point", "coordinates": [115.46, -8.29]}, heading=None),
    ]
    table = read(collection(*features))
    assert [(pose.name, pose.place, pose.altitude_m) for pose in table.poses] == [
        ("a.jpg", (115.46, -8.29), 130.0),
        ("d.jpg", (115.46, -8.29), None),
    ]
    assert reasons(table) == {"that are no points": {"b.jpg"}, "without a position": {"c.jpg"}}
    assert table.poses[0].heading_deg == 12.0


def test_geojson_may_state_an_older_crs(read):
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32750"}}
    point = {"type": "Point", "coordinates": [330000.0, 9083000.0]}
    (pose,) = read(collection(feature("a.jpg", point), crs=crs)).poses
    assert (pose.place, pose.epsg) == ((330000.0, 9083000.0), 32750)


@pytest.mark.parametrize(("stated", "fault"), [("+proj=utm +zone=32 +ellps=intl", "no EPSG code"), ("EPSG:1", "known")])
def test_geojson_in_a_crs_that_leaves_the_datum_open_or_is_none_is_refused(read, stated, fault):
    point = {"type": "Point", "coordinates": [330000.0, 5200000.0]}
    with pytest.raises(PoseError, match=fault):
        read(collection(feature("a.jpg", point), crs={"type": "name", "properties": {"name": stated}}))
