# SPDX-License-Identifier: Apache-2.0
"""Photos of many makers and kinds: their angles, sizes and focal lengths mean one thing, or are refused by name."""

import datetime as dt
import json
import math
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from sasgeo_bench.core.errors import CameraError, ImageError
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.image import decode_image
from sasgeo_bench.sensing.photos import Lens, read_photo

RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
PACKET = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{rdf}">{parts}</rdf:RDF></x:xmpmeta>'
DJI = "http://www.dji.com/drone-dji/1.0/"
AUTEL = "http://www.autelrobotics.com/drone/1.0/"
PARROT = "http://www.parrot.com/drone-parrot/1.0/"
SKYDIO = "https://www.skydio.com/drone-skydio/1.0/"
PIX4D = "http://pix4d.com/camera/1.0/"
HEIGHT_M = 100.0


def part_of(uri, facts, *, prefix="p", as_elements=False):
    """One description of an XMP packet; facts of a structure are written as elements in it."""
    plain = {name: value for name, value in facts.items() if not isinstance(value, dict)}
    attributes = "" if as_elements else " ".join(f'{prefix}:{name}="{value}"' for name, value in plain.items())
    whole = facts if as_elements else {name: value for name, value in facts.items() if isinstance(value, dict)}
    elements = "".join(f"<{prefix}:{name}{_inside(prefix, value)}</{prefix}:{name}>" for name, value in whole.items())
    return f'<rdf:Description rdf:about="" xmlns:{prefix}="{uri}" {attributes}>{elements}</rdf:Description>'


def _inside(prefix, value):
    if not isinstance(value, dict):
        return f">{value}"
    return ' rdf:parseType="Resource">' + "".join(f"<{prefix}:{at}>{of}</{prefix}:{at}>" for at, of in value.items())


def packet_of(*parts):
    return PACKET.format(rdf=RDF, parts="".join(parts)).encode()


def gimbal(yaw=0.0, pitch=-90.0, roll=0.0, *, height=HEIGHT_M, names="Gimbal{}Degree", **more):
    angles = {"Yaw": yaw, "Pitch": pitch, "Roll": roll}
    return {names.format(name): value for name, value in angles.items()} | {"RelativeAltitude": height} | more


def exif_of(*, make="", film=24, inner=None, orientation=None):
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = make
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(
        {
            ExifTags.GPS.GPSLatitudeRef: "N",
            ExifTags.GPS.GPSLatitude: (49.0, 0.0, 0.0),
            ExifTags.GPS.GPSLongitudeRef: "E",
            ExifTags.GPS.GPSLongitude: (9.0, 0.0, 0.0),  # the middle of a zone: true north is grid north
        }
    )
    inner = dict(inner or {})
    if film:
        inner[ExifTags.Base.FocalLengthIn35mmFilm] = film
    exif.get_ifd(ExifTags.IFD.Exif).update(inner)
    return exif


def write(path, xmp, *, size=(400, 300), kind="JPEG", **exif):
    image = Image.new("RGB", size)
    about = exif_of(**exif)
    if kind == "TIFF":
        about[700] = xmp
        image.save(path, kind, exif=about.tobytes())
    else:
        image.save(path, kind, exif=about, xmp=xmp)
    return path


def middle_m(photo):
    """East and north of the ground in the middle of a photo, from the point beneath the camera, metres."""
    camera = photo.camera(epsg=32632)
    seen = camera.unproject(np.array([[photo.width_px / 2, photo.height_px / 2]]), Plane())[0, :2]
    return seen - camera.position_m[:2]


def extent_m(photo):
    """Width and height of a photo that looks straight down, on the ground, metres."""
    corners = np.array([[0.0, 0.0], [photo.width_px, 0.0], [0.0, photo.height_px]])
    first, across, down = photo.camera(epsg=32632).unproject(corners, Plane())[:, :2]
    return math.dist(first, across), math.dist(first, down)


def skydio(yaw, pitch, roll):
    angles = {"Roll": roll, "Pitch": pitch, "Yaw": yaw}
    return part_of(SKYDIO, {"CameraOrientationNED": angles, "RelativeAltitude": HEIGHT_M})


def skydio_by_attributes(yaw, pitch, roll):
    inside = f'<q:CameraOrientationNED q:Roll="{roll}" q:Pitch="{pitch}" q:Yaw="{yaw}"/>'
    height = f'q:RelativeAltitude="{HEIGHT_M}"'
    return f'<rdf:Description rdf:about="" xmlns:q="{SKYDIO}" {height}>{inside}</rdf:Description>'


def pix4d(yaw, pitch, roll):
    return part_of(PIX4D, {"Yaw": yaw, "Pitch": pitch, "Roll": roll, "AboveGroundAltitude": HEIGHT_M})


AHEAD_30, SIDE_10 = HEIGHT_M * math.tan(math.radians(30)), HEIGHT_M * math.tan(math.radians(10))
# Maker, XMP, heading of the picture's up, and what its middle shows: east and north, metres.
POINTED = [
    ("DJI", part_of(DJI, gimbal(90, -60)), 90, (AHEAD_30, 0)),
    ("DJI", part_of(DJI, gimbal(30, -90, 60)), 90, (0, 0)),  # straight down a roll is a turn
    ("Autel Robotics", part_of(AUTEL, gimbal(90, 90)), 90, (0, 0)),
    ("Autel Robotics", part_of(AUTEL, gimbal(90, 60)), 90, (AHEAD_30, 0)),
    ("Autel Robotics", part_of(DJI, gimbal(0, 60)), 0, (0, AHEAD_30)),  # newer firmware
    ("Autel Robotics", pix4d(90, 30, 0), 90, (AHEAD_30, 0)),  # older firmware
    ("Parrot", part_of(PARROT, gimbal(180, -60, names="Camera{}Degree")) + pix4d(0, 0, 0), 180, (0, -AHEAD_30)),
    ("Skydio", skydio(90, -60, 0), 90, (AHEAD_30, 0)),
    ("Skydio", skydio_by_attributes(90, -60, 0), 90, (AHEAD_30, 0)),
    ("Sentera", pix4d(90, 30, 0), 90, (AHEAD_30, 0)),
    ("Sentera", pix4d(0, 0, 0), 0, (0, 0)),
    ("Sentera", pix4d(0, -5, 0), 0, (0, -HEIGHT_M * math.tan(math.radians(5)))),
    ("Sentera", pix4d(0, 0, 10), 0, (-SIDE_10, 0)),  # right wing down: the camera looks to the left
    ("senseFly", pix4d(0, 0, 10), 0, (SIDE_10, 0)),
    ("senseFly", pix4d(0, 0, 10).replace(PIX4D, "http://ns.sensefly.com/Camera/1.0/"), 0, (SIDE_10, 0)),
    ("", pix4d(0, 0, 10) + part_of("http://ns.adobe.com/tiff/1.0/", {"Make": "senseFly"}), 0, (SIDE_10, 0)),
]


@pytest.mark.parametrize(("make", "xmp", "yaw_deg", "expected_m"), POINTED)
def test_each_maker_looks_where_its_own_signs_say(make, xmp, yaw_deg, expected_m, tmp_path):
    photo = read_photo(write(tmp_path / "a.jpg", packet_of(xmp), make=make))
    np.testing.assert_allclose(middle_m(photo), expected_m, atol=0.01)
    assert (photo.camera(epsg=32632).yaw_deg - yaw_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize(
    ("make", "xmp", "words"),
    [
        ("Autel Robotics", part_of(AUTEL, gimbal(0, 20)), r"\+20 degrees, which Autel counts .* upwards or downwards"),
        ("Camera", pix4d(0, -90, 0), "seems to count from the horizon"),
        ("Sentera", pix4d(0, 90, 0), "looks at the horizon or the sky"),
        ("DJI", part_of(DJI, gimbal(0, -135, 0, height=-5)), "-5 m above the ground"),
        ("X", part_of("http://example.com/other/", gimbal()), "height above take-off, gimbal angles missing"),
        ("DJI", part_of("http://ns.adobe.com/camera-raw-settings/1.0/", gimbal(), prefix="drone-dji"), "missing"),
    ],
)
def test_angles_that_are_not_understood_are_refused_on_one_line(make, xmp, words, tmp_path):
    photo = read_photo(write(tmp_path / "a.jpg", packet_of(xmp), make=make))
    with pytest.raises(CameraError, match=words) as caught:
        photo.camera()
    assert str(caught.value).startswith("a.jpg")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("as_elements", [False, True])
@pytest.mark.parametrize("uri", [DJI, DJI.rstrip("/")])
def test_names_are_known_by_their_namespace_and_not_by_a_prefix(uri, as_elements, tmp_path):
    other = part_of("http://example.com/editor/", gimbal(11, -45, 3, height=7), prefix="drone-dji")
    xmp = packet_of(other, part_of(uri, gimbal(90, -60), prefix="q", as_elements=as_elements), other)
    photo = read_photo(write(tmp_path / "a.jpg", xmp))
    assert (photo.gimbal.yaw_deg, photo.gimbal.pitch_deg, photo.height_m) == (90, -60, HEIGHT_M)


FULL, HALF = (400, 300), (200, 150)
CALIBRATED = gimbal(CalibratedFocalLength="366.667", CalibratedOpticalCenterX="200.0", CalibratedOpticalCenterY="150.0")
PIXELS = (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)
ZOOM = ExifTags.Base.DigitalZoomRatio


def sensor(pixels_mm, focal_mm=8.8, unit=3, units_mm=10):
    return {
        ExifTags.Base.FocalLength: focal_mm,
        ExifTags.Base.FocalPlaneXResolution: pixels_mm * units_mm,
        ExifTags.Base.FocalPlaneResolutionUnit: unit,
    }


FILM_M = (144.2, 108.2)  # 24 mm on film, from 100 m
EXTENTS = [
    ("film", {}, gimbal(), FILM_M),
    ("film, scaled down", {"size": HALF, "inner": dict(zip(PIXELS, FULL, strict=True))}, gimbal(), FILM_M),
    ("film, 16 : 9", {"size": (400, 225)}, gimbal(), (144.2, 81.1)),
    ("calibrated", {}, CALIBRATED, (109.1, 81.8)),
    ("calibrated, scaled down", {"size": HALF}, CALIBRATED, (109.1, 81.8)),
    ("its EXIF kept", {"size": HALF, "inner": dict(zip(PIXELS, FULL, strict=True))}, CALIBRATED, (109.1, 81.8)),
    ("16 : 9 by the camera", {"size": (400, 225)}, CALIBRATED, (109.1, 61.4)),
    ("centre beside the middle", {}, CALIBRATED | {"CalibratedOpticalCenterX": "196.1"}, (109.1, 81.8)),
    ("zoom", {"make": "DJI", "inner": {ZOOM: 2.0}}, gimbal(), (72.1, 54.1)),
    ("zoom of 0/0", {"make": "X", "inner": {ZOOM: IFDRational(0, 0)}}, gimbal(), FILM_M),
    ("sensor", {"film": None, "inner": sensor(40.0)}, gimbal(), (113.6, 85.2)),
    ("sensor in inches", {"film": None, "inner": sensor(40.0, unit=2, units_mm=25.4)}, gimbal(), (113.6, 85.2)),
    ("sensor, scaled down", {"film": None, "size": HALF, "inner": sensor(40.0) | dict(zip(PIXELS, FULL, strict=True))},
     gimbal(), (113.6, 85.2)),
    ("turned upright", {"orientation": 6, "size": HALF}, CALIBRATED, (81.8, 109.1)),
]  # fmt: skip


@pytest.mark.parametrize(("how", "facts", "expected_m"), [row[1:] for row in EXTENTS], ids=[row[0] for row in EXTENTS])
def test_the_focal_length_belongs_to_the_size_of_picture_that_it_was_measured_for(how, facts, expected_m, tmp_path):
    photo = read_photo(write(tmp_path / "a.jpg", packet_of(part_of(DJI, facts)), **how))
    assert extent_m(photo) == pytest.approx(expected_m, abs=0.1)


def test_skydio_calibrates_across_and_down_from_the_middle_of_the_first_pixel(tmp_path):
    facts = {
        "CalibratedFocalLength": {"X": "366", "Y": "368"},
        "CalibratedOpticalCenter": {"X": "199.5", "Y": "149.5"},
        "CameraOrientationNED": {"Roll": 0, "Pitch": -90, "Yaw": 0},
        "RelativeAltitude": HEIGHT_M,
    }
    for size in (FULL, HALF):
        photo = read_photo(write(tmp_path / "a.jpg", packet_of(part_of(SKYDIO, facts)), size=size, film=None))
        assert photo.lens.calibrated_size_px == FULL
        assert extent_m(photo) == pytest.approx((109.0, 81.7), abs=0.1)


UNFIT = [
    ("cut", {"size": (400, 200)}, CALIBRATED, "400 x 200 pixels is cut out of a picture of 400 x 300, or turned"),
    ("turned by a program", {"size": (300, 400)}, CALIBRATED, "or turned"),
    ("cut, by EXIF", {"size": (300, 300), "inner": dict(zip(PIXELS, FULL, strict=True))}, gimbal(), "cut out of"),
    ("three sizes", {"size": (200, 150), "inner": dict(zip(PIXELS, (800, 600), strict=True))}, CALIBRATED, "of 800 x"),
    ("zoom of others", {"make": "X", "inner": {ZOOM: 2.0}}, gimbal(), "digital zoom of 2"),
    ("film against sensor", {"inner": sensor(80.0)}, gimbal(), "two focal lengths, 277 px by 35 mm film and 704 px"),
    ("calibrated, of no size", {"size": HALF}, gimbal(CalibratedFocalLength="277"),
     "139 px by 35 mm film and 277 px by calibration"),
    ("nothing", {"film": None}, gimbal(), "no focal length"),
    ("no unit", {"film": None, "inner": sensor(40.0, unit=1)}, gimbal(), "no focal length"),
]  # fmt: skip


@pytest.mark.parametrize(("how", "facts", "words"), [row[1:] for row in UNFIT], ids=[row[0] for row in UNFIT])
def test_a_focal_length_of_another_picture_is_refused_on_one_line(how, facts, words, tmp_path):
    photo = read_photo(write(tmp_path / "a.jpg", packet_of(part_of(DJI, facts)), **how))
    with pytest.raises(CameraError, match=words) as caught:
        photo.intrinsics()
    assert "\n" not in str(caught.value)
    assert "intrinsics" in str(caught.value)


@pytest.mark.parametrize(
    ("uri", "facts", "word"),
    [
        (PIX4D, {"ModelType": "fisheye"}, "fisheye"),
        ("http://ns.google.com/photos/1.0/panorama/", {"ProjectionType": "equirectangular"}, "equirectangular"),
    ],
)
def test_a_picture_that_no_pinhole_takes_has_no_focal_length(uri, facts, word, tmp_path):
    photo = read_photo(write(tmp_path / "a.jpg", packet_of(part_of(DJI, CALIBRATED), part_of(uri, facts))))
    with pytest.raises(CameraError, match=f"is a {word} picture, which no pinhole describes"):
        photo.camera()


def test_a_calibrated_focal_length_in_another_unit_is_not_taken():
    assert Lens(calibrated_px=8.8, film_mm=24.0).focal_px("a.jpg", FULL) == pytest.approx(277.4, abs=0.1)


def test_a_tiff_is_read_as_a_jpeg_is(tmp_path):
    xmp = packet_of(part_of(DJI, CALIBRATED))
    inner = {ExifTags.Base.DateTimeOriginal: "2024:05:01 10:20:30"}
    one, two = (
        read_photo(write(tmp_path / "a", xmp, kind=kind, make="DJI", inner=inner, orientation=6))
        for kind in ("JPEG", "TIFF")
    )
    assert one == two
    assert one.taken_at is not None


def raw_photo(xmp, *, parts, crop=None):
    """A DNG without pixels: a preview, and directories of other pictures (kind, width, height) hanging on it."""
    ascii_, short, long_, byte = 2, 3, 4, 1
    end = 8 + len(xmp)
    offsets, body = [], b""
    for kind, width, height in parts:
        offsets.append(end + len(body))
        entries = [(254, long_, 1, kind), (256, long_, 1, width), (257, long_, 1, height)]
        entries += [(50720, short, 2, crop[0] | crop[1] << 16)] if crop and not kind else []
        body += _directory(entries)
    subs = end + len(body)
    body += struct.pack(f"<{len(offsets)}L", *offsets)
    first = [
        (254, long_, 1, 1), (256, long_, 1, 160), (257, long_, 1, 120), (271, ascii_, 4, 0x494A44),
        (274, short, 1, 8), (330, long_, len(offsets), subs), (700, byte, len(xmp), 8),
    ]  # fmt: skip
    start = end + len(body)
    return struct.pack("<2sHL", b"II", 42, start) + xmp + body + _directory(first)


def _directory(entries):
    rows = b"".join(struct.pack("<HHLL", *entry) for entry in entries)
    return struct.pack("<H", len(entries)) + rows + struct.pack("<L", 0)


def test_the_size_of_a_raw_photo_is_that_of_its_picture_and_not_of_its_preview(tmp_path):
    path = tmp_path / "a.dng"
    xmp = packet_of(part_of(DJI, CALIBRATED))
    for crop, size in ((None, (304, 408)), ((400, 300), (300, 400))):
        path.write_bytes(raw_photo(xmp, parts=[(0, 408, 304), (1, 960, 720)], crop=crop))
        photo = read_photo(path)
        assert (photo.width_px, photo.height_px) == size  # its orientation turns it
        assert (photo.lens.make, photo.gimbal.pitch_deg, photo.height_m) == ("DJI", -90, HEIGHT_M)


def test_the_preview_of_a_raw_photo_is_not_decoded_as_if_it_were_the_photo(tmp_path):
    path = tmp_path / "a.dng"
    Image.new("RGB", (16, 12)).save(path, "TIFF", tiffinfo={254: 1})
    with pytest.raises(ImageError, match="is a preview of another picture in the file: export it as JPEG"):
        decode_image(path.read_bytes(), name="a.dng")


@pytest.mark.parametrize(
    "content", [b"II*\0", b"MM\0*\0\0\0\x08\0\0", b"II*\0\x08\0\0\0\0\0\0\0\0\0", b"II+\0\x08\0\0\0" + bytes(20)]
)
def test_a_damaged_tiff_is_refused_on_one_line(content, tmp_path):
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(ImageError) as caught:
        read_photo(tmp_path / "a.tif")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not shutil.which("exiftool"), reason="exiftool is not installed")
@pytest.mark.parametrize("kind", ["JPEG", "TIFF"])
def test_exiftool_reads_the_same(kind, tmp_path):
    flown = {"FlightYawDegree": "+4.5", "FlightPitchDegree": "-3.25", "FlightRollDegree": "+1.75"}
    facts = CALIBRATED | {"GimbalYawDegree": "-12.30", "GimbalRollDegree": "+0.5", "AbsoluteAltitude": "+512.3"} | flown
    inner = dict(zip(PIXELS, FULL, strict=True)) | {ZOOM: 1.5, ExifTags.Base.FocalLength: 8.8}
    inner[ExifTags.Base.DateTimeOriginal] = "2024:05:01 10:20:30"
    inner[ExifTags.Base.SubsecTimeOriginal] = "25"
    inner[ExifTags.Base.OffsetTimeOriginal] = "-04:30"
    path = write(tmp_path / "a", packet_of(part_of(DJI, facts, prefix="drone-dji")), kind=kind, make="DJI", inner=inner)
    command = [str(shutil.which("exiftool")), "-n", "-j", str(path)]
    run = subprocess.run(command, capture_output=True, check=True)  # noqa: S603 - ours
    (tags,) = json.loads(run.stdout)
    photo = read_photo(Path(path))
    assert (photo.lon_deg, photo.lat_deg) == (
        pytest.approx(tags["GPSLongitude"]),
        pytest.approx(tags["GPSLatitude"]),
    )
    assert (photo.height_m, photo.altitude_m) == (tags["RelativeAltitude"], float(tags["AbsoluteAltitude"]))
    for name, body in (("Gimbal", photo.gimbal), ("Flight", photo.flight)):
        found = {"Yaw": body.yaw_deg, "Pitch": body.pitch_deg, "Roll": body.roll_deg}
        assert found == {axis: float(tags[f"{name}{axis}Degree"]) for axis in found}
    whole = dt.datetime.strptime(tags["SubSecDateTimeOriginal"], "%Y:%m:%d %H:%M:%S.%f%z")
    assert photo.taken_at == whole.replace(tzinfo=None)
    assert photo.utc_offset == whole.utcoffset()
    assert (photo.taken_at.microsecond, photo.utc_offset) == (250_000, dt.timedelta(hours=-4, minutes=-30))
    assert (photo.width_px, photo.height_px) == (tags["ImageWidth"], tags["ImageHeight"])
    lens = photo.lens
    assert (lens.calibrated_px, lens.zoom) == (tags["CalibratedFocalLength"], tags["DigitalZoomRatio"])
    assert (lens.focal_mm, lens.film_mm) == (tags["FocalLength"], tags["FocalLengthIn35mmFormat"])
