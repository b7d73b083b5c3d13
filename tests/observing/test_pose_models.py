# SPDX-License-Identifier: Apache-2.0
"""Models and trajectories: quaternions in their order, names with spaces, lenses, times, cameras that are none."""

import json
import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.observing.picture_poses import PoseFacts
from sasgeo_bench.observing.pose_columns import epsg_of_wkt
from sasgeo_bench.observing.pose_tables import read_pose_table
from sasgeo_bench.sensing.camera import Intrinsics
from tests import pose_files as cameras
from tests.pose_files import NAMES, ORIGIN, SHIFTS, local

LOCAL = PoseFacts(origin=ORIGIN)
TURN = cameras.camera(37.0, -63.0, 11.0)


def matrix_of(pose):
    """Rows: right, down, ahead of a pose's camera, north, east, down turned to east, north, up."""
    forward, right, down = pose.attitude.matrix.T
    return np.array([[axis[1], axis[0], -axis[2]] for axis in (right, down, forward)])


# Orders of quaternions


def test_quaternions_of_colmap_have_their_real_part_first(lay):
    x, y, z, w = Rotation.from_matrix(TURN).as_quat()
    (pose,) = read_pose_table(lay(f"1 {w} {x} {y} {z} 0 0 0 1 a.jpg\n\n"), LOCAL).poses
    np.testing.assert_allclose(matrix_of(pose), TURN, atol=1e-6)
    assert pose.lonlat == pytest.approx(ORIGIN[:2], abs=1e-9)


def test_quaternions_of_tum_have_it_last_and_turn_the_other_way(lay):
    numbers = " ".join(map(repr, Rotation.from_matrix(TURN).inv().as_quat().tolist()))
    path = lay(f"1.5 0 0 80 {numbers}\n", "run.txt")
    (pose,) = read_pose_table(path, PoseFacts(origin=(115.46, -8.29, 0.0), names=("a.jpg",))).poses
    np.testing.assert_allclose(matrix_of(pose), TURN, atol=1e-6)
    assert (pose.height_m, pose.height_of, pose.altitude_m) == (pytest.approx(80.0, abs=1e-6), "origin", None)
    assert (pose.time_s, pose.clock) == (1.5, "own")


def test_a_quaternion_that_is_none_is_no_pose(lay):
    lines = "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 0.9 0 0 0 0 0 0 1 b.jpg\n\n3 0 1 0 0 0 0 0 1 c.jpg\n\n"
    table = read_pose_table(lay(lines), LOCAL)
    assert [pose.name for pose in table.poses] == ["c.jpg"]  # half a turn about its right: it looks down
    assert table.left_out == {"whose rotation is none": ("b.jpg",), "whose camera looks level or up": ("a.jpg",)}


# COLMAP


def test_names_of_colmap_may_hold_spaces(lay):
    text = cameras.colmap_text(SHIFTS, local(), ("DJI 0003.JPG", "DJI 0007.JPG", "a  b (1).JPG"))
    assert [pose.name for pose in read_pose_table(lay(text), LOCAL).poses] == [
        "DJI 0003.JPG",
        "DJI 0007.JPG",
        "a  b (1).JPG",
    ]


def test_points_of_an_image_are_no_image(lay):
    points = " ".join(f"{at}.5 {at}.25 {at}" for at in range(50))
    text = f"1 0 1 0 0 0 0 0 1 a.jpg\n{points}\n2 0 1 0 0 0 0 0 1 b.jpg\n{points}\n"
    assert len(read_pose_table(lay(text), LOCAL).poses) == 2


# Model, its parameters, focal lengths, centre, distortion k1 k2 p1 p2 k3.
LENSES = [
    ("SIMPLE_PINHOLE", (2900, 1990, 1510), (2900, 2900), (1990, 1510), (0, 0, 0, 0, 0)),
    ("PINHOLE", (2900, 2910, 1990, 1510), (2900, 2910), (1990, 1510), (0, 0, 0, 0, 0)),
    ("SIMPLE_RADIAL", (2900, 1990, 1510, 0.1), (2900, 2900), (1990, 1510), (0.1, 0, 0, 0, 0)),
    ("RADIAL", (2900, 1990, 1510, 0.1, 0.02), (2900, 2900), (1990, 1510), (0.1, 0.02, 0, 0, 0)),
    ("OPENCV", (2900, 2910, 1990, 1510, 0.1, 0.02, 3e-3, 4e-3), (2900, 2910), (1990, 1510), (0.1, 0.02, 3e-3, 4e-3, 0)),
    (
        "FULL_OPENCV",
        (2900, 2910, 1990, 1510, 0.1, 0.02, 3e-3, 4e-3, 5e-3, 0, 0, 0),
        (2900, 2910),
        (1990, 1510),
        (0.1, 0.02, 3e-3, 4e-3, 5e-3),
    ),
    ("FULL_OPENCV", (2900, 2910, 1990, 1510, 0.1, 0.02, 3e-3, 4e-3, 5e-3, 1, 0, 0), None, None, None),
    ("OPENCV_FISHEYE", (2900, 2910, 1990, 1510, 0.1, 0.02, 3e-3, 4e-3), None, None, None),
    ("NEW_MODEL", (2900, 1990, 1510), None, None, None),
]
NUMBERS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
}


@pytest.mark.parametrize(("model", "params", "focal", "centre", "distortion"), LENSES)
@pytest.mark.parametrize("is_binary", [False, True])
def test_lenses_of_colmap_are_read_where_they_are_pinholes(model, params, focal, centre, distortion, is_binary, lay):
    if is_binary:
        data = struct.pack("<QIiQQ", 1, 1, NUMBERS.get(model, 99), 4000, 3000) + struct.pack(
            f"<{len(params)}d", *params
        )
        lay(data, "cameras.bin")
        path = lay(cameras.colmap_binary(SHIFTS, local()), "images.bin")
    else:
        lay(f"# a comment\n1 {model} 4000 3000 {' '.join(map(repr, params))}\n", "cameras.txt")
        path = lay(cameras.colmap_text(SHIFTS, local()))
    table = read_pose_table(path, LOCAL)
    lens = table.poses[0].intrinsics
    if focal is None:
        assert lens is None
    else:
        assert lens == Intrinsics(
            width_px=4000, height_px=3000, focal_px=focal, centre_px=centre, distortion=distortion
        )
        assert table.notes == ()


# OpenDroneMap


def test_lenses_of_opensfm_are_in_parts_of_the_longer_side(lay):
    lens = read_pose_table(lay(cameras.opensfm(), "r.json")).poses[0].intrinsics
    assert (lens.focal_px, lens.distortion) == (pytest.approx((2900.0, 2900.0)), (0.1, 0.02, 0.004, 0.005, 0.003))
    assert lens.centre_px == pytest.approx((2000 + 0.01 * 4000, 1500 - 0.02 * 4000))


def test_a_fisheye_of_opensfm_has_no_lens(lay):
    text = cameras.opensfm().replace('"brown"', '"fisheye"')
    assert read_pose_table(lay(text, "r.json")).poses[0].intrinsics is None


def test_shots_that_lie_in_no_utm_zone_keep_their_place_alone(lay):
    content = json.loads(cameras.shots())
    content["features"][1]["properties"]["translation"] = [1.0, 2.0, 3.0]
    table = read_pose_table(lay(json.dumps(content), "shots.geojson"))
    assert [pose.attitude is None for pose in table.poses] == [False, True, False]
    assert "translations that lie in no UTM zone of their place: angles are not read" in table.notes


def test_shots_in_the_zone_beside_their_own_are_turned_by_its_north(lay):
    content = json.loads(cameras.shots())
    to_next = cameras.pyproj.Transformer.from_crs(4326, 32751, always_xy=True)
    for one, place, matrix in zip(content["features"], cameras.places(), cameras.matrices(), strict=True):
        lean = -np.degrees(np.arctan(np.tan(np.radians(place[0] - 123.0)) * np.sin(np.radians(place[1]))))
        one["properties"]["translation"] = [*to_next.transform(*place[:2]), place[2]]
        one["properties"]["rotation"] = cameras.rotvec(matrix @ cameras.about(2, lean))
    for pose, matrix in zip(read_pose_table(lay(json.dumps(content), "s.json")).poses, cameras.matrices(), strict=True):
        np.testing.assert_allclose(matrix_of(pose), matrix, atol=2e-4)  # the convergence of a sphere


# Metashape


def test_a_lens_of_metashape_puts_points_where_its_manual_says(lay):
    """Its x' takes p1 (r2 + 2 x2) + 2 p2 x y: p1 and p2 of OpenCV the other way round."""
    lens = read_pose_table(lay(cameras.metashape(), "cameras.xml")).poses[0].intrinsics
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3
    x_of = x * radial + 0.004 * (r2 + 2 * x * x) + 2 * 0.005 * x * y
    y_of = y * radial + 0.005 * (r2 + 2 * y * y) + 2 * 0.004 * x * y
    expected = (2000 + 12.5 + 2900 * x_of, 1500 - 7.5 + 2900 * y_of)
    np.testing.assert_allclose(lens.to_pixels(np.array([[x, y]]))[0], expected, atol=1e-6)
    seen, _ = cv2.projectPoints(
        np.array([[x, y, 1.0]]), np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion)
    )
    np.testing.assert_allclose(seen.ravel() + 0.5, expected, atol=1e-6)


def test_cameras_that_are_switched_off_or_not_aligned_are_left_out(lay):
    more = '<camera id="7" sensor_id="0" component_id="0" label="loose.JPG"></camera>'
    more += '<camera id="8" sensor_id="0" component_id="0" label="off.JPG" enabled="false"></camera>'
    table = read_pose_table(lay(cameras.metashape(more=more), "cameras.xml"))
    assert table.left_out == {"that are not aligned": ("loose.JPG",), "that are switched off": ("off.JPG",)}
    assert len(table.poses) == 3


def test_a_mirrored_camera_of_metashape_is_no_pose(lay):
    text = cameras.metashape()
    mirrored = text.replace(f'label="{NAMES[0]}"><transform>', f'label="{NAMES[0]}"><transform>-')
    table = read_pose_table(lay(mirrored.replace("<transform>--", "<transform>"), "cameras.xml"))
    assert table.left_out == {"whose rotation is none": (NAMES[0],)}


def test_a_model_in_a_crs_in_feet_is_high_in_feet_too(tmp_path):
    path = tmp_path / "images.txt"
    path.write_text("1 0 1 0 0 -980000 200000 300 1 a.jpg\n\n")  # it looks down: x, -y, -z
    (pose,) = read_pose_table(path, PoseFacts(epsg=2263)).poses
    assert pose.place == pytest.approx((980000.0, 200000.0))
    assert pose.altitude_m == pytest.approx(300 * 1200 / 3937)  # of US survey feet


def test_a_chunk_without_aligned_cameras_has_what_was_measured(lay):
    told = '<reference x="115.46" y="-8.29" z="200" yaw="90" pitch="10" roll="0" sx="0.02" sy="0.03" enabled="true"/>'
    text = cameras.metashape()
    begin, end = text.index("<cameras"), text.index("</cameras>")
    camera = f'<cameras><camera id="0" sensor_id="0" label="a.jpg">{told}</camera>'
    camera += '<camera id="1" sensor_id="0" label="b.jpg"/>'
    table = read_pose_table(lay(text[:begin] + camera + text[end:], "cameras.xml"))
    (pose,) = table.poses
    assert (pose.place, pose.altitude_m, pose.sigma_m, pose.tilt_deg) == (
        (115.46, -8.29),
        200.0,
        0.03,
        pytest.approx(10.0),
    )
    assert pose.intrinsics is not None
    assert table.left_out == {"without a position": ("b.jpg",)}
    assert "no camera is aligned: places and angles are those that were measured" in table.notes


def test_a_chunk_in_a_projected_crs_has_its_cameras_where_they_are(lay):
    wkt = cameras.pyproj.CRS.from_epsg(32750).to_wkt("WKT1_GDAL")
    poses = read_pose_table(lay(cameras.metashape(wkt=wkt), "cameras.xml")).poses
    np.testing.assert_allclose([pose.lonlat for pose in poses], cameras.places()[:, :2], atol=1e-8)
    assert {pose.altitude_of for pose in poses} == {"ellipsoid"}


def test_a_local_chunk_lies_around_the_origin_that_the_user_says(lay):
    chunk = cameras.metashape(wkt='LOCAL_CS["Local Coordinates (m)"]')
    begin, end = chunk.index("<components"), chunk.index("</components>")
    frame = '<component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation>'
    cameras_of = ""
    for at, (turn, spot) in enumerate(zip(local(), SHIFTS, strict=True)):
        numbers = np.vstack([np.column_stack([turn.T, spot]), [0, 0, 0, 1]]).ravel().tolist()
        cameras_of += f'<camera id="{at}" component_id="0" label="{at}">'
        cameras_of += f"<transform>{' '.join(map(repr, numbers))}</transform></camera>"
    text = chunk[:begin] + f"<components>{frame}<scale>1</scale></transform></component>" + chunk[end:]
    begin, end = text.index("<cameras"), text.index("</cameras>")
    poses = read_pose_table(lay(f"{text[:begin]}<cameras>{cameras_of}{text[end:]}", "cameras.xml"), LOCAL).poses
    np.testing.assert_allclose([pose.lonlat for pose in poses], cameras.places()[:, :2], atol=1e-8)
    for pose, matrix in zip(poses, cameras.matrices(), strict=True):
        np.testing.assert_allclose(matrix_of(pose), matrix, atol=1e-6)


# TUM


def test_pictures_of_a_trajectory_are_placed_by_their_times(lay):
    down = "1 0 0 0"
    lines = f"10 0 0 80 {down}\n11 10 0 80 {down}\n20 100 0 80 {down}\n"
    times = {"a.jpg": 10.5, "b.jpg": 15.0, "c.jpg": 21.0, "d.jpg": 11.0}
    table = read_pose_table(lay(lines, "run.txt"), PoseFacts(epsg=32750, times_s=times))
    assert [(pose.name, pose.place, pose.time_s) for pose in table.poses] == [
        ("a.jpg", (5.0, 0.0), 10.5),
        ("d.jpg", (10.0, 0.0), 11.0),
    ]
    assert table.left_out == {"without poses within 2 s": ("b.jpg", "c.jpg")}


WGS84_SHIFTED = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG",'
    '"7030"]],TOWGS84[0,0,0,0,0,0,0],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT['
    '"degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4326"]]'
)
EGM96 = (
    'VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005,AUTHORITY["EPSG","5171"]],UNIT["metre",1,AUTHORITY["EPSG",'
    '"9001"]],AUTHORITY["EPSG","5773"]]'
)


@pytest.mark.parametrize("wkt", [WGS84_SHIFTED, f'COMPD_CS["WGS 84 + EGM96 height",{WGS84_SHIFTED},{EGM96}]'])
def test_a_crs_of_metashape_with_towgs84_is_read_by_its_code(lay, wkt):
    assert epsg_of_wkt(Path("a.txt"), wkt) == 4326
    poses = read_pose_table(lay(cameras.metashape(wkt=wkt), "cameras.xml")).poses
    assert {pose.epsg for pose in poses} == {4326}


@pytest.mark.parametrize("epsg", [4326, 31467, 2193])
def test_a_code_is_found_where_none_is_written(epsg):
    bare = re.sub(r',AUTHORITY\["EPSG","\d+"\]', "", pyproj.CRS.from_epsg(epsg).to_wkt("WKT1_GDAL"))
    assert epsg_of_wkt(Path("a.txt"), bare) == epsg


@pytest.mark.parametrize("ellipsoid", ["bessel", "krass", "intl"])
def test_an_ellipsoid_alone_is_no_datum(ellipsoid):
    # pyproj names that of a railway, of Albania, ED50: places would be a hundred metres off
    wkt = pyproj.CRS(f"+proj=tmerc +lon_0=9 +x_0=3500000 +ellps={ellipsoid}").to_wkt("WKT1_GDAL")
    with pytest.raises(PoseError, match="no EPSG code"):
        epsg_of_wkt(Path("a.txt"), wkt)
    assert epsg_of_wkt(Path("a.txt"), pyproj.CRS("+proj=utm +zone=32 +ellps=GRS80").to_wkt()) == 25832


def test_a_damaged_crs_of_metashape_is_one_line(lay):
    with pytest.raises(PoseError, match="states a CRS that is not known"):
        read_pose_table(lay(cameras.metashape(wkt='GEOGCS["WGS 84"'), "cameras.xml"))
