# SPDX-License-Identifier: Apache-2.0
"""Photos of drones: what is read, what is refused, and real neighbours on the ground."""

import datetime as dt
import os
from pathlib import Path

import numpy as np
import pyproj
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.photo_overlap import compare
from sasgeo_bench.core.errors import CameraError, ImageError
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.photos import read_photo

XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}>{elements}
</rdf:Description></rdf:RDF></x:xmpmeta>"""
POSE = {
    "RelativeAltitude": "+50.00",
    "GimbalYawDegree": "+90.00",
    "GimbalPitchDegree": "-60.00",
    "GimbalRollDegree": "+0.00",
    "FlightYawDegree": "+91.00",
    "FlightPitchDegree": "+2.00",
    "FlightRollDegree": "-1.00",
}
ZURICH = {
    ExifTags.GPS.GPSLatitudeRef: "N",
    ExifTags.GPS.GPSLatitude: (47.0, 22.0, 30.0),
    ExifTags.GPS.GPSLongitudeRef: "E",
    ExifTags.GPS.GPSLongitude: (8.0, 30.0, 0.0),
}


TAKEN = "2024:05:01 10:20:30"


def xmp_of(pose, *, as_elements=False):
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in pose.items())
    elements = "".join(f"<drone-dji:{name}>{value}</drone-dji:{name}>" for name, value in pose.items())
    return XMP.format(attributes="" if as_elements else attributes, elements=elements if as_elements else "")


DRONES = xmp_of(POSE)


def write_photo(path, *, gps=ZURICH, xmp=DRONES, focal=20, orientation=None, size=(400, 300), taken=TAKEN):
    """A photo of nothing, with the metadata of a drone's."""
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    if focal:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = taken[:19]
    if zone := taken[19:]:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.OffsetTimeOriginal] = zone
    Image.new("L", size).save(path, format="JPEG", exif=exif, xmp=xmp.encode())
    return path


@pytest.fixture
def photo_path(tmp_path: Path) -> Path:
    return tmp_path / "DJI_0001.JPG"


@pytest.mark.parametrize("as_elements", [False, True])
def test_place_height_angles_and_focal_length_are_read(photo_path, as_elements):
    photo = read_photo(write_photo(photo_path, xmp=xmp_of(POSE, as_elements=as_elements)))
    assert (photo.lon_deg, photo.lat_deg) == (pytest.approx(8.5), pytest.approx(47.375))
    assert (photo.height_m, photo.lens.film_mm) == (50.0, 20.0)
    assert (photo.gimbal.yaw_deg, photo.gimbal.pitch_deg, photo.flight.roll_deg) == (90.0, -60.0, -1.0)
    assert photo.taken_at == dt.datetime(2024, 5, 1, 10, 20, 30)  # noqa: DTZ001 - the drone names no zone
    gps = ZURICH | {ExifTags.GPS.GPSLatitudeRef: "S", ExifTags.GPS.GPSLongitudeRef: "W"}
    photo = read_photo(write_photo(photo_path, gps=gps))
    assert (photo.lon_deg, photo.lat_deg) == (pytest.approx(-8.5), pytest.approx(-47.375))


def test_the_camera_of_a_photo_heads_by_the_grid(photo_path):
    camera = read_photo(str(write_photo(photo_path))).camera()
    assert camera.height_m == 50.0
    assert camera.tilt_deg == pytest.approx(30.0)
    # West of the zone's meridian (9 E) grid north lies west of true north: (8.5 - 9) sin(47.375) = -0.368 degrees.
    assert camera.yaw_deg == pytest.approx(90.368, abs=0.002)
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    assert camera.position_m[:2] == pytest.approx(to_grid.transform(8.5, 47.375), abs=1e-3)


@pytest.mark.parametrize(
    ("orientation", "to_stored"),
    [
        (0, lambda col, row: (col, row)),  # unknown
        (1, lambda col, row: (col, row)),
        (3, lambda col, row: (400 - col, 300 - row)),
        (6, lambda col, row: (row, 300 - col)),
        (8, lambda col, row: (400 - row, col)),
    ],
)
def test_a_turned_photo_shows_the_same_ground(photo_path, orientation, to_stored):
    stored = read_photo(write_photo(photo_path)).camera()
    photo = read_photo(write_photo(photo_path, orientation=orientation))
    upright = photo.camera()
    corners = np.array([[0.0, 0.0], [photo.width_px, 30.0], [50.0, photo.height_px]])
    expected = stored.unproject(np.array([to_stored(*corner) for corner in corners]), Plane())
    np.testing.assert_allclose(upright.unproject(corners, Plane()), expected, atol=1e-6)


@pytest.mark.parametrize("datum", ["WGS-84", "WGS84", "WGS 84", "wgs-84\0", "World Geodetic System 1984", " "])
def test_wgs_84_is_known_however_it_is_spelt(photo_path, datum):
    photo = read_photo(write_photo(photo_path, gps=ZURICH | {ExifTags.GPS.GPSMapDatum: datum}))
    assert (photo.lon_deg, photo.place_fault) == (pytest.approx(8.5), "")


def without(*names):
    return {name: value for name, value in POSE.items() if name not in names}


@pytest.mark.parametrize(
    ("how", "hint"),
    [
        ({"gps": {}}, "GPS missing"),
        (
            {"gps": ZURICH | {ExifTags.GPS.GPSLatitude: (0.0, 0.0, 0.0), ExifTags.GPS.GPSLongitude: (0.0, 0.0, 0.0)}},
            "GPS",
        ),
        ({"gps": ZURICH | {ExifTags.GPS.GPSLatitude: (IFDRational(0, 0), 0.0, 0.0)}}, "GPS"),
        ({"gps": ZURICH | {ExifTags.GPS.GPSMapDatum: "TOKYO"}}, r"a place in another datum than WGS 84 \('TOKYO'\)"),
        ({"xmp": xmp_of(without("RelativeAltitude"))}, "height above take-off missing; give height_m"),
        ({"xmp": xmp_of(without("GimbalPitchDegree"))}, "gimbal angles missing"),
        ({"xmp": xmp_of(POSE | {"GimbalYawDegree": "nan"})}, "gimbal angles missing"),
        ({"xmp": ""}, "height above take-off, gimbal angles missing"),
        ({"focal": None}, "focal length"),
        ({"xmp": xmp_of(POSE | {"RelativeAltitude": "-12.30"})}, r"-12\.3 m above the ground .*give its own height"),
        ({"xmp": xmp_of(POSE | {"RelativeAltitude": "0.00"})}, r"\+0 m above the ground"),
        ({"xmp": xmp_of(POSE | {"GimbalPitchDegree": "+90.00"})}, r"gimbal pitch \+90\.0"),
    ],
)
def test_a_photo_without_pose_is_refused_on_one_line_where_its_pose_is_asked_for(photo_path, how, hint):
    photo = read_photo(write_photo(photo_path, **how))
    with pytest.raises(CameraError, match=hint) as caught:
        photo.camera()
    assert "\n" not in str(caught.value)
    assert "DJI_0001" in str(caught.value)


def test_a_height_of_ones_own_stands_in_for_a_missing_one(photo_path):
    photo = read_photo(write_photo(photo_path, xmp=xmp_of(without("RelativeAltitude"))))
    assert photo.camera(height_m=33.0).height_m == 33.0
    below = read_photo(write_photo(photo_path, xmp=xmp_of(POSE | {"RelativeAltitude": "-12.30"})))
    assert below.camera(height_m=33.0).height_m == 33.0
    with pytest.raises(CameraError, match="height_m"):
        below.camera(height_m=-1.0)


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><x:xmpmeta xmlns:x="adobe:ns:meta/">&b;</x:xmpmeta>'


@pytest.mark.parametrize(
    ("how", "limits", "hint"),
    [
        ({"orientation": 2}, {}, "mirrored"),
        ({"orientation": 9}, {}, "orientation 9"),
        ({"xmp": "<x:xmpmeta>"}, {}, "damaged metadata"),
        ({"xmp": BOMB}, {}, "damaged metadata"),
        ({}, {"most_bytes": 100}, "at most 100 are read"),
        ({}, {"most_pixels": 100}, "at most 100 are read"),
    ],
)
def test_a_damaged_or_huge_photo_is_refused_on_one_line(photo_path, how, limits, hint):
    write_photo(photo_path, **how)
    with pytest.raises(ImageError, match=hint) as caught:
        read_photo(photo_path, **limits)
    assert "\n" not in str(caught.value)


def test_what_is_no_photo_is_refused(photo_path):
    with pytest.raises(ImageError, match="no photo"):
        read_photo(photo_path)
    for content in (b"", b"\xff\xd8\xff\xe0 and no more", b"GIF89a"):
        photo_path.write_bytes(content)
        with pytest.raises(ImageError, match=r"no JPEG|damaged|is empty: copy it again"):
            read_photo(photo_path)


def brighton_beach() -> Path | None:
    """The folder of real photos, where there is one."""
    folders = [os.environ.get("SASGEO_IMAGERY"), f"{os.environ.get('SASGEO_EXTRACTS', '')}/../imagery"]
    found = [Path(folder, "brighton_beach") for folder in folders if folder]
    return next((folder for folder in found if len(list(folder.glob("*.JPG"))) > 1), None)


@pytest.mark.slow
@pytest.mark.skipif(brighton_beach() is None, reason="real photos: SASGEO_IMAGERY names no folder with brighton_beach")
def test_neighbouring_photos_of_a_real_flight_agree_on_the_ground():
    pairs = compare(brighton_beach())
    assert len(pairs) == 5
    for _, pair in pairs:
        assert 0.55 < pair.overlap < 0.75
        assert pair.features >= 20
        assert pair.offset_m < 3.0  # GPS without correction
        assert abs(pair.turn_deg) < 2.5
        assert 0.97 < pair.scale < 1.03
        assert pair.rest_m < 0.3
