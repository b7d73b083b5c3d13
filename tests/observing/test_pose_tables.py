# SPDX-License-Identifier: Apache-2.0
"""Tables of poses: three cameras come back alike from every format, told by content; real tables; what is refused."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pyproj
import pytest

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.observing.picture_poses import PicturePose, PoseFacts, PoseTable
from sasgeo_bench.observing.pose_tables import read_pose_table
from sasgeo_bench.sensing.photos import read_photo
from tests import pose_files as cameras
from tests.pose_files import ANGLES, NAMES, ORIGIN, SHIFTS, UTM, local, matrices, places, utm


def gimbal_table():
    header = ("file_name", "lon_deg", "lat_deg", "altitude", "gimbal_yaw", "gimbal_pitch", "gimbal_roll")
    return cameras.rows(header, np.column_stack([places(), ANGLES]))


def geojson():
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": place.tolist()},
            "properties": {"image": name, "GimbalYawDegree": yaw, "GimbalPitchDegree": pitch, "GimbalRollDegree": roll},
        }
        for name, place, (yaw, pitch, roll) in zip(NAMES, places(), ANGLES, strict=True)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


def exiftool_json():
    keys = ("GPSLongitude", "GPSLatitude", "GPSAltitude", "GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
    values = np.column_stack([places(), ANGLES]).tolist()
    return json.dumps(
        [
            {"SourceFile": f"./{name}", **dict(zip(keys, row, strict=True))}
            for name, row in zip(NAMES, values, strict=True)
        ]
    )


def opk_table(*, separator):
    spots, turns = utm()
    header = ("imageName", "X", "Y", "Z", "Omega", "Phi", "Kappa")
    return cameras.rows(header, np.column_stack([spots, [cameras.opk(turn) for turn in turns]]), separator=separator)


def pix4d_geolocation():
    values = np.column_stack(
        [places()[:, 1], places()[:, 0], places()[:, 2], [cameras.from_nadir(*one) for one in ANGLES]]
    )
    return cameras.rows(("#imagename", "latitude", "longitude", "altitude", "yaw", "pitch", "roll"), values)


def metashape_text(header="#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll"):
    values = np.column_stack([places(), [cameras.from_nadir(*one) for one in ANGLES]])
    wkt = pyproj.CRS.from_epsg(4326).to_wkt("WKT1_GDAL")
    return f"# Cameras (3)\n# CoordinateSystem: {wkt}\n" + cameras.rows(header.split(","), values)


def tum():
    lines = ["# time x y z qx qy qz qw"]
    for number, (spot, turn) in enumerate(zip(SHIFTS, local(), strict=True)):
        w, x, y, z = cameras.quaternion(turn.T)  # from the camera to the frame
        lines.append(" ".join(map(repr, [100.0 + number, *map(float, (*spot, x, y, z, w))])))
    return "\n".join(lines) + "\n"


GRID, LOCAL = PoseFacts(epsg=UTM), PoseFacts(origin=ORIGIN)
# Format -> content, what the user says, kind.
FORMATS = {
    "csv": (gimbal_table, None, "CSV"),
    "geojson": (geojson, None, "GeoJSON"),
    "exiftool_json": (exiftool_json, None, "exiftool JSON"),
    "pix4d_external": (lambda: opk_table(separator=" "), GRID, "Pix4D"),
    "pix4d_tabs": (lambda: opk_table(separator="\t"), GRID, "Pix4D"),
    "pix4d_geolocation": (pix4d_geolocation, None, "Pix4D"),
    "metashape_text": (metashape_text, None, "Metashape text"),
    "metashape_plain_names": (lambda: metashape_text("# Label,X,Y,Z,Yaw,Pitch,Roll"), None, "Metashape text"),
    "metashape_xml": (cameras.metashape, None, "Metashape XML"),
    "colmap_text_local": (lambda: cameras.colmap_text(SHIFTS, local()), LOCAL, "COLMAP"),
    "colmap_text_grid": (lambda: cameras.colmap_text(*utm()), GRID, "COLMAP"),
    "opensfm": (cameras.opensfm, None, "OpenDroneMap"),
    "shots": (cameras.shots, None, "OpenDroneMap shots"),
    "tum": (tum, PoseFacts(origin=ORIGIN, names=NAMES), "TUM"),
}


def check_same(table, *, off_deg=1e-4):
    """Cameras are where and how they were, to a millimetre."""
    assert [pose.name for pose in table.poses] == list(NAMES)
    assert not table.left_out
    np.testing.assert_allclose([pose.lonlat for pose in table.poses], places()[:, :2], atol=1e-8, rtol=0)
    np.testing.assert_allclose([pose.altitude_m for pose in table.poses], places()[:, 2], atol=1e-3, rtol=0)
    for pose, angles in zip(table.poses, ANGLES, strict=True):
        turn = pose.attitude.matrix.T @ cameras.body(*angles)
        assert np.degrees(np.linalg.norm(turn - np.eye(3))) < off_deg
        assert pose.tilt_deg == pytest.approx(np.degrees(np.arccos(-cameras.camera(*angles)[2, 2])), abs=1e-3)


@pytest.mark.parametrize("name", FORMATS)
def test_three_cameras_come_back_alike_from_every_format(name, lay):
    content, facts, kind = FORMATS[name]
    table = read_pose_table(lay(content()), facts)
    assert table.kind == kind
    check_same(
        table, off_deg=3e-3 if facts == GRID or name == "shots" else 1e-4
    )  # the test's convergence is a sphere's


def test_a_binary_model_is_read_in_place_of_the_text_beside_it(lay, tmp_path):
    lay(cameras.colmap_binary(SHIFTS, local()), "images.bin")
    lay("1 1 0 0 0 0 0 0 1 other.jpg\n\n", "images.txt")
    for path in (tmp_path, tmp_path / "images.txt"):
        table = read_pose_table(path, LOCAL)
        check_same(table)
        assert table.notes[0] == "images.bin is read, and images.txt beside it is not"


def test_the_heading_is_that_of_the_pictures_up(lay):
    found = [pose.heading_deg for pose in read_pose_table(lay(gimbal_table())).poses]
    up = [-matrix[1] for matrix in matrices()]
    np.testing.assert_allclose(found, [np.degrees(np.arctan2(one[0], one[1])) % 360 for one in up], atol=1e-6)


def flights():
    """The folder of real survey tables, beside the extracts."""
    folders = (
        Path(one).resolve().parent / "flights" for one in os.environ.get("SASGEO_EXTRACTS", "").split(os.pathsep) if one
    )
    return next((one for one in folders if one.is_dir()), None)


EXIFTOOL = shutil.which("exiftool")
no_flights = pytest.mark.skipif(
    flights() is None, reason="real tables: no folder flights beside that of SASGEO_EXTRACTS"
)


@no_flights
@pytest.mark.parametrize(("name", "count"), [("agung-2", 1817), ("freetown-1", 1452)])
def test_a_real_survey_is_read_whole_as_a_plain_parser_reads_it(name, count):
    path = flights() / f"{name}_image_metadata.csv"
    table = read_pose_table(path)
    assert (table.kind, len(table.poses), dict(table.left_out)) == ("exiftool CSV", count, {})
    # deg, min, s with a letter, twice a line, by words alone
    words = re.findall(r'(\d+) deg (\d+)\' ([\d.]+)"" ([NSEW])', path.read_text())
    signed = [(1, -1)[side in "SW"] * (int(d) + int(m) / 60 + float(s) / 3600) for d, m, s, side in words]
    np.testing.assert_allclose([pose.place for pose in table.poses], np.reshape(signed, (-1, 2))[:, ::-1], atol=1e-12)
    pitches = [float(line.split(",")[-2]) for line in path.read_text().splitlines()[1:]]
    np.testing.assert_allclose([pose.tilt_deg for pose in table.poses], np.array(pitches) + 90.0, atol=1e-5)
    assert all(pose.altitude_of == "sea" and pose.clock == "local" for pose in table.poses)


@no_flights
def test_rows_that_are_faulty_on_purpose_are_left_out_by_reason():
    table = read_pose_table(flights() / "agung-2_issue_image_metadata.csv")
    # The names of these pictures say what is wrong with them.
    fault = {why: {re.sub(r".*_D_|\.JPG", "", name) for name in names} for why, names in table.left_out.items()}
    assert fault == {
        "without a position": {"MISSING_COORDS"},
        "with a place that is nowhere on earth": {"INVALID_COORD"},
        "more than 50 km from the others": {"FAR_AWAY"},
        "whose camera looks level or up": {"GIMBAL_UP", "GIMBAL_HORIZON"},
    }
    assert sum(map(len, table.left_out.values())) == 13
    bare = [pose.name for pose in table.poses if pose.attitude is None]
    assert all("MISSING_GIMBAL" in name for name in bare)
    assert len(bare) == 2
    assert any(note.startswith("2 poses") and note.endswith("without angles of the camera") for note in table.notes)


def beach():
    folders = [Path(one) for one in os.environ.get("SASGEO_IMAGERY", "").split(os.pathsep) if one]
    beside = flights()
    folders += [beside.parent / "imagery"] if beside else []
    return next((one / "brighton_beach" for one in folders if (one / "brighton_beach").is_dir()), None)


@pytest.mark.skipif(beach() is None or EXIFTOOL is None, reason="exiftool and the photos of brighton_beach")
@pytest.mark.parametrize(
    "options",
    [
        ["-csv"],
        ["-csv", "-n"],
        ["-json"],
        ["-json", "-n"],
        ["-json", "-G"],
        ["-csv", "-G1", "-n"],
        ["-csv", "-c", "%.9f"],
    ],
)
def test_what_exiftool_prints_of_photos_is_what_the_photos_say(options, lay):
    done = subprocess.run([EXIFTOOL, *options, str(beach())], capture_output=True, check=False)  # noqa: S603 - exiftool
    table = read_pose_table(lay(done.stdout))
    assert len(table.poses) == 6
    for pose in table.poses:
        photo = read_photo(beach() / Path(pose.name).name)
        assert pose.place == pytest.approx((photo.lon_deg, photo.lat_deg), abs=2e-6)  # seconds to two digits
        assert (pose.height_m, pose.height_of) == (photo.height_m, "take-off")
        assert pose.altitude_m == photo.altitude_m
        assert pose.attitude == photo.gimbal
        assert pose.intrinsics == photo.intrinsics()


HEAD = "# Image list with two lines of data per image:\n"
LINE = "{} 1 0 0 0 0 0 0 1 {}\n"
NO_FRAME = "in a frame that it does not state: say --epsg"
DAMAGED = "is damaged, or no list of images of COLMAP"
MODEL, BINARY = cameras.colmap_text(SHIFTS, local()), cameras.colmap_binary(SHIFTS, local())
UNKNOWN = "is no table of poses that is known (CSV with a header"
# Name, content, what the user says, words of the refusal.
REFUSED = [
    ("unknown.txt", "Dear reader,\nthis is no table.\n", None, UNKNOWN),
    ("other.json", '{"a": 1}', None, UNKNOWN),
    ("other.xml", "<gpx></gpx>", None, UNKNOWN),
    ("nameless.csv", "lat,lon,alt\n1,2,3\n", None, UNKNOWN),
    ("placeless.csv", "file,size\na.jpg,3\n", None, UNKNOWN),
    ("empty.csv", "", None, "has no rows"),
    ("commas.csv", ",,,\n", None, "has no rows"),
    ("noise.bin", b"\x01\x00\x02\x00rest", None, "is no table of poses: name one (CSV with a header"),
    ("wide.csv", "file,lat,lon\na.jpg,1,2\n".encode("utf-16"), None, "is no text in UTF-8: save it as CSV in UTF-8"),
    ("two.csv", "file,lat,latitude,lon\na.jpg,1,1,2\nb.jpg,1,1.1,2\n", None, "of one meaning, which differ (line 3)"),
    ("turn.csv", "file,lat,lon,yaw,yaw_est\na.jpg,1,2,10,190\n", None, "of one meaning, which differ (line 2)"),
    ("rad.csv", "file,lat,lon,omega,phi,kappa\na.jpg,1,2,0.1,0,-3.1\n", None, "may be radians, as none is beyond"),
    (
        "rad.csv",
        "file,lat,lon,gimbal_yaw,gimbal_pitch,gimbal_roll\na.jpg,1,2,1,-1.57,0\n",
        None,
        "gimbal_yaw_deg or gimbal_yaw_rad",
    ),
    (
        "feet.csv",
        "file,x,y,z\na.jpg,980000,200000,300\n",
        PoseFacts(epsg=2263),
        "whose unit is 0.3048 m, and z does not state its own: name it in the column, z_ft or z_m",
    ),
    ("latin.csv", "file,lat,lon\nh\xf6he.jpg,1,2\n".encode("latin-1"), None, "is no text in UTF-8"),
    ("poses.zip", b"PK\x03\x04rest", None, "is an archive or a workbook: unpack it, or save it as CSV"),
    ("broken.csv", 'file,lat,lon\n"a"b.jpg,1,2\n', None, "line 2: no sound CSV"),
    ("broken.json", '[{"SourceFile": "a.jpg",', None, "is no sound JSON"),
    ("broken.xml", "<document><chunk>", None, "is no sound XML"),
    ("bomb.xml", '<!DOCTYPE d [<!ENTITY a "b">]><document><chunk>&a;</chunk></document>', None, "is no sound XML"),
    ("unplaced.csv", "file,yaw\na.jpg,3\n", None, "has no columns of position (2 columns (file, yaw)): call them lat"),
    ("grid.csv", "file,x,y\na.jpg,1,2\n", None, "columns x and y in a CRS that it does not state: say --epsg"),
    ("twice.csv", "file,lat,lat,lon\na.jpg,1,1,2\n", None, "2 columns (lat, lat) of one name, latitude"),
    ("pitch.csv", "file,lat,lon,yaw,pitch,roll\na.jpg,1,2,3,4,5\n", None, "may count from straight down or from the"),
    ("bare.csv", "a.jpg,1,2,3,4,5,6\n", None, "has 7 columns and no header: write one, such as imageName,latitude"),
    ("none.csv", "file,lat,lon\na.jpg,,\nb.jpg,,\n", None, "is a pose: 2 rows (a.jpg, b.jpg) without a position"),
    ("rows.csv", "file,lat,lon\n", None, "is a pose: it has no rows"),
    ("model.txt", MODEL, None, NO_FRAME),
    ("names.txt", cameras.colmap_text(SHIFTS, local(), ("DJI", "DJI", "a")), LOCAL, "1 name (DJI) more than once"),
    ("lines.txt", LINE.format(1, "a.jpg") + LINE.format(2, "b.jpg"), LOCAL, "line 2: an image where the points of"),
    ("cut.txt", HEAD + "1 1 0 0 0 0 0 1 a.jpg\n\n", LOCAL, "line 2: no image, which has ten fields"),
    ("images.bin", BINARY[:-3], LOCAL, DAMAGED),
    ("images.bin", BINARY + b"\0", LOCAL, DAMAGED),
    ("shot.json", '[{"shots": {"a.jpg": {"rotation": [0, 0]}}, "cameras": {}}]', None, "is no reconstruction of Open"),
    ("tum.txt", tum(), LOCAL, "(TUM) names no pictures"),
    ("tum.txt", tum(), PoseFacts(origin=ORIGIN, names=("a.jpg",)), "has 3 poses for 1 picture"),
    ("tum.txt", tum(), PoseFacts(names=NAMES), NO_FRAME),
    ("tum.txt", tum().replace("101.0", "99.0"), PoseFacts(origin=ORIGIN, names=NAMES), "time 99.0 does not increase"),
    ("local.xml", cameras.metashape(wkt='LOCAL_CS["Local Coordinates (m)"]'), None, NO_FRAME),
    ("cut.xml", cameras.metashape().replace('03.JPG"><transform>', '03.JPG"><transform>1 '), None, "a damaged camera"),
]


@pytest.mark.parametrize(("name", "content", "facts", "words"), REFUSED)
def test_a_table_that_cannot_be_read_is_refused_in_one_line(name, content, facts, words, lay):
    with pytest.raises(PoseError) as caught:
        read_pose_table(lay(content, name), facts)
    assert words in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_path_that_holds_no_table_is_refused(tmp_path):
    with pytest.raises(PoseError, match="name a table of poses"):
        read_pose_table(tmp_path / "none.csv")
    with pytest.raises(PoseError, match=r"holds no images\.bin or images\.txt"):
        read_pose_table(tmp_path, LOCAL)


def test_a_picture_whose_row_is_left_out_is_not_said_to_have_none():
    poses = (PicturePose(name="a.jpg", place=(9.0, 47.0)),)
    table = PoseTable(path=Path("t.csv"), kind="CSV", poses=poses, left_out={"without a place": ("may/B.jpg",)})
    assert table.why_not("photos/b.JPG") == "whose row is left out"
    assert table.why_not("c.jpg") == "that the table does not name, or in another folder"
