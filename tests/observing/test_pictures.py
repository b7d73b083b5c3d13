# SPDX-License-Identifier: Apache-2.0
"""Own pictures: what their files say of place, heading and size, held against rasterio and plain geometry."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine
from PIL import ExifTags, Image
from pyproj import Geod, Transformer

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import CameraError, ConfigError, ImageError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.geometry.projection import to_grid
from sasgeo_bench.observing.pictures import (
    FINEST_M,
    WIDEST_M,
    Told,
    largest_square,
    list_pictures,
    open_picture,
    see,
)
from sasgeo_bench.sensing.ground import Dem, Plane
from tests.sensing.test_ground import write_dem
from tests.sensing.test_photos import POSE, ZURICH, write_photo, xmp_of

GEOD = Geod(ellps="WGS84")


def write_geotiff(path: Path, *, transform: Affine, crs: str, size: tuple[int, int] = (400, 300), **more) -> Path:
    """A picture whose upper half is red and whose lower half is blue."""
    cols, rows = size
    bands = np.zeros((3, rows, cols), dtype=np.uint8)
    bands[0, : rows // 2], bands[2, rows // 2 :] = 200, 200
    profile = {"driver": "GTiff", "width": cols, "height": rows, "count": 3, "dtype": "uint8"}
    with rasterio.open(path, "w", crs=crs, transform=transform, photometric="RGB", **profile, **more) as target:
        target.write(bands)
    return path


def turned(heading_deg: float, gsd_m: float, *, east_m: float, north_m: float, size: tuple[int, int]) -> Affine:
    """The transform of a picture whose up has a heading in the grid, around a place."""
    cols, rows = size
    place = Affine.translation(east_m, north_m) @ Affine.rotation(-heading_deg)
    return place @ Affine.scale(gsd_m, -gsd_m) @ Affine.translation(-cols / 2, -rows / 2)


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 200.0])
def test_a_georeferenced_picture_says_its_middle_its_pixels_and_where_up_is(tmp_path, heading_deg):
    transform = turned(heading_deg, 0.6, east_m=520_000.0, north_m=5_220_000.0, size=(400, 300))
    path = write_geotiff(tmp_path / "a.tif", transform=transform, crs="EPSG:32632")
    found = open_picture(path)
    lon, lat = Transformer.from_crs(32632, 4326, always_xy=True).transform(520_000.0, 5_220_000.0)
    assert found.lonlat == pytest.approx((lon, lat), abs=1e-9)
    assert found.gsd_m == pytest.approx(0.6)
    # true north by the ellipsoid, not by any code of ours
    up = Transformer.from_crs(32632, 4326, always_xy=True).transform(
        520_000.0 + 50 * math.sin(math.radians(heading_deg)), 5_220_000.0 + 50 * math.cos(math.radians(heading_deg))
    )
    azimuth_deg = GEOD.inv(lon, lat, *up)[0] % 360
    assert (found.heading_deg - azimuth_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.02)
    assert (found.position_by, found.heading_by, found.note) == ("georeference", "georeference", "")
    told = open_picture(path, Told(height_m=80.0))
    assert (told.gsd_m, told.note) == (found.gsd_m, "--height passed over: its georeference tells its size")


def test_a_picture_in_degrees_gets_square_pixels(tmp_path):
    # 0.00001 deg: 1.11 m north and 0.75 m east at 47.5 N
    transform = Affine.translation(8.5, 47.5) @ Affine.scale(1e-5, -1e-5)
    path = write_geotiff(tmp_path / "a.tif", transform=transform, crs="EPSG:4326")
    found = open_picture(path)
    across_m, down_m = GEOD.inv(8.5, 47.4985, 8.504, 47.4985)[2], GEOD.inv(8.502, 47.5, 8.502, 47.497)[2]
    assert found.gsd_m == pytest.approx(math.sqrt(across_m * down_m / (400 * 300)), rel=2e-3)
    sight = see(found)
    assert sight.side_m == pytest.approx(across_m, rel=0.01)  # narrower than it is high
    assert sight.image.rgb.shape[0] / sight.image.rgb.shape[1] == pytest.approx(down_m / across_m, rel=0.02)


def test_a_turned_picture_is_seen_in_its_own_axes(tmp_path):
    transform = turned(140.0, 0.5, east_m=520_000.0, north_m=5_220_000.0, size=(400, 300))
    sight = see(open_picture(write_geotiff(tmp_path / "a.tif", transform=transform, crs="EPSG:32632")))
    rgb = sight.image.rgb
    rows = rgb.shape[0]
    assert (rgb[: rows // 2 - 3, 3:-3, 0] > 150).all()
    assert (rgb[rows // 2 + 3 :, 3:-3, 2] > 150).all()
    assert sight.side_m == pytest.approx(150.0, abs=1.0)


def test_of_a_whole_mosaic_the_middle_is_read(tmp_path):
    transform = turned(0.0, 1.0, east_m=520_000.0, north_m=5_220_000.0, size=(3000, 2000))
    sight = see(
        open_picture(write_geotiff(tmp_path / "a.tif", transform=transform, crs="EPSG:32632", size=(3000, 2000)))
    )
    assert sight.side_m == WIDEST_M
    assert max(sight.image.shape) <= 1.3 * WIDEST_M


def test_what_the_file_has_no_picture_of_is_black(tmp_path):
    path = tmp_path / "a.tif"
    transform = turned(0.0, 0.5, east_m=520_000.0, north_m=5_220_000.0, size=(400, 400))
    write_geotiff(path, transform=transform, crs="EPSG:32632", size=(400, 400), nodata=0)
    with rasterio.open(path, "r+") as target:
        bands = target.read()
        bands[:, :, :150] = 0
        target.write(bands)
    rgb = see(open_picture(path)).image.rgb
    assert not rgb[:, : int(0.3 * rgb.shape[1])].any()
    empty = tmp_path / "empty.tif"
    write_geotiff(empty, transform=transform, crs="EPSG:32632", size=(400, 400), nodata=0)
    with rasterio.open(empty, "r+") as target:
        target.write(np.zeros_like(bands))
    with pytest.raises(ImageError, match="shows nothing"):
        see(open_picture(empty))


def test_a_photo_says_place_height_and_heading(tmp_path):
    down = xmp_of(POSE | {"GimbalPitchDegree": "-90.00", "GimbalYawDegree": "-30.00"})
    found = open_picture(write_photo(tmp_path / "a.jpg", xmp=down))
    assert found.lonlat == pytest.approx((8.5, 47.375))
    assert found.heading_deg == pytest.approx(330.0)
    assert (found.height_m, found.heading_by, found.position_by) == (50.0, "gimbal", "EXIF")
    sight = see(found)
    lens = found.camera.intrinsics
    assert sight.side_m == pytest.approx(300 * 50.0 / lens.focal_px[0], abs=0.1)
    assert sight.middle_m == pytest.approx((0.0, 0.0), abs=0.01)
    # where the user says how high it was, that counts
    higher = see(open_picture(tmp_path / "a.jpg", Told(height_m=100.0)))
    assert higher.side_m == pytest.approx(2 * sight.side_m, abs=0.1)


def test_a_tilted_photo_looks_ahead_and_its_camera_is_found_behind_the_view(tmp_path):
    found = open_picture(write_photo(tmp_path / "a.jpg", xmp=xmp_of(POSE)))  # pitch -60: 30 degrees ahead
    sight = see(found)
    right_m, ahead_m = sight.middle_m
    assert right_m == pytest.approx(0.0, abs=0.1)
    assert 10.0 < ahead_m < 80.0
    square = shapely.box(
        right_m - sight.side_m / 2, ahead_m - sight.side_m / 2, right_m + sight.side_m / 2, ahead_m + sight.side_m / 2
    )
    assert found.camera.footprint(Plane()).buffer(0.1).covers(square)
    view = sight.view_pose(Pose(easting_m=1000.0, northing_m=2000.0, yaw_deg=90.0))
    assert (view.easting_m, view.northing_m) == pytest.approx((1000.0 + ahead_m, 2000.0), abs=0.1)
    again = sight.camera_pose(view)
    assert (again.easting_m, again.northing_m) == pytest.approx((1000.0, 2000.0))


def test_a_sideways_photo_heads_where_its_own_up_points(tmp_path):
    down = xmp_of(POSE | {"GimbalPitchDegree": "-90.00", "GimbalYawDegree": "10.00"})
    plain = open_picture(write_photo(tmp_path / "a.jpg", xmp=down))
    side = open_picture(write_photo(tmp_path / "b.jpg", xmp=down, orientation=6))
    assert (side.heading_deg - plain.heading_deg) % 360 == pytest.approx(270.0)
    assert see(side).image.shape == see(plain).image.shape[::-1]


def test_a_fine_photo_is_averaged_and_shows_the_same_ground(tmp_path):
    down = xmp_of(POSE | {"GimbalPitchDegree": "-90.00", "RelativeAltitude": "+30.00"})
    path = write_photo(tmp_path / "a.jpg", xmp=down, size=(2000, 1500))
    image = see(open_picture(path)).image
    gsd_m = image.camera.height_m / image.camera.intrinsics.focal_px[0]
    assert FINEST_M / 2 < gsd_m <= FINEST_M
    # a point of the ground lies as far from the middle of both, in pixels of each
    whole = open_picture(path).camera
    factor = gsd_m / (whole.height_m / whole.intrinsics.focal_px[0])
    assert factor == pytest.approx(round(factor))
    point = np.array([[4.0, -3.0, 0.0]])
    small_px = image.camera.project(point) - image.camera.project(np.zeros((1, 3)))
    whole_px = whole.project(point) - whole.project(np.zeros((1, 3)))
    assert small_px * factor == pytest.approx(whole_px)
    middle_px = image.camera.project(np.zeros((1, 3)))[0]
    assert middle_px == pytest.approx(np.array(image.shape[::-1]) / 2, abs=1.0)


@pytest.mark.parametrize(
    ("footprint", "middle_m", "side_m"),
    [
        (shapely.box(-200, -300, 200, 300), (0.0, 0.0), WIDEST_M),
        (shapely.box(-30, 100, 30, 300), (0.0, 130.0), 60.0),
        (shapely.Polygon(), (0.0, 0.0), 0.0),
    ],
)
def test_the_square_is_the_largest_and_the_nearest(footprint, middle_m, side_m):
    middle, side = largest_square(footprint)
    assert side == pytest.approx(side_m, abs=0.1)
    assert middle == pytest.approx(middle_m, abs=3.0)  # to a step of the search


def test_true_north_in_the_grid_is_that_of_the_ellipsoid():
    for lon, lat, epsg in ((11.9, 60.0, 32632), (6.1, -33.0, 32732), (9.0, 10.0, 32632)):
        east_m, north_m, bearing_deg = to_grid(lon, lat, epsg)
        lon2, lat2, _ = GEOD.fwd(lon, lat, 0.0, 100.0)
        x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(lon2, lat2)
        expected = math.degrees(math.atan2(x - east_m, y - north_m))
        assert (bearing_deg - expected + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)


def test_pictures_of_a_folder_are_listed_by_path_and_others_are_said(tmp_path):
    lines = []
    for name in ("b.JPG", "a/c.png", ".hidden/d.jpg", "notes.txt", "e.DNG", "f.mp4", "g.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with reporting(lines.append):
        found = list_pictures(tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in found] == ["a/c.png", "b.JPG"]
    assert len(lines) == 1
    assert "2 .mp4, 1 .dng" in lines[0]


@pytest.mark.parametrize(
    ("name", "told", "hint"),
    [
        ("none.jpg", Told(), "there is no picture"),
        ("a.zip", Told(), "archive: unpack"),
        ("plain.png", Told(), "--ground-width"),
        ("bare.jpg", Told(), "--height in metres"),
        ("bare.jpg", Told(ground_width_m=9.0), "at least 16 m"),
        ("horizon.jpg", Told(), "horizon"),
        ("ahead.jpg", Told(), "away from straight down"),
        ("down.jpg", Told(ground_width_m=90.0), "--height in place of"),
        ("low.jpg", Told(), "-3 m above take-off"),
        ("text.jpg", Told(), "no JPEG, TIFF or DNG"),
        ("text.tif", Told(), "no JPEG, TIFF or DNG"),
    ],
)
def test_what_cannot_be_used_is_refused_on_one_line_that_mends_it(tmp_path, name, told, hint):
    (tmp_path / "a.zip").write_bytes(b"PK")
    Image.new("RGB", (40, 30)).save(tmp_path / "plain.png")
    write_photo(tmp_path / "bare.jpg", xmp="")
    write_photo(tmp_path / "horizon.jpg", xmp=xmp_of(POSE | {"GimbalPitchDegree": "0.00"}))
    write_photo(tmp_path / "ahead.jpg", xmp=xmp_of(POSE | {"GimbalPitchDegree": "-15.00"}))
    write_photo(tmp_path / "down.jpg", xmp=xmp_of(POSE | {"GimbalPitchDegree": "-90.00"}))
    write_photo(tmp_path / "low.jpg", xmp=xmp_of(POSE | {"RelativeAltitude": "-3.00"}))
    (tmp_path / "text.jpg").write_text("no picture")
    (tmp_path / "text.tif").write_text("no picture")
    with pytest.raises((ImageError, CameraError), match=hint) as refusal:
        see(open_picture(list_pictures(tmp_path / name)[0], told), told)
    assert "\n" not in str(refusal.value)


def test_a_photo_without_a_position_has_none(tmp_path):
    nowhere = {key: value for key, value in ZURICH.items() if isinstance(value, str)}
    found = open_picture(write_photo(tmp_path / "a.jpg", gps=nowhere))
    assert (found.lonlat, found.position_by) == (None, "")


def test_a_position_of_another_datum_is_passed_over_and_said(tmp_path):
    tokyo = ZURICH | {ExifTags.GPS.GPSMapDatum: "TOKYO"}
    found = open_picture(write_photo(tmp_path / "a.jpg", gps=tokyo))
    assert found.lonlat is None
    assert found.heading_deg is not None
    assert "TOKYO" in found.note


def test_a_photo_with_an_altitude_alone_is_as_high_as_that_is_above_the_ground(tmp_path):
    """Ground at 420 m under one at 500 m; what a drone says above take-off counts where it says so."""
    east_m, north_m = Transformer.from_crs(4326, 32632, always_xy=True).transform(8.5, 47.375)
    grid = sgb.Grid.from_bounds(east_m - 999, north_m - 999, east_m + 999, north_m + 999, cell_size_m=20.0, epsg=32632)
    dem = write_dem(tmp_path / "dem.tif", Dem(grid=grid, cells_m=np.full(grid.shape, 420.0, dtype=np.float32)))
    facts = {name: value for name, value in POSE.items() if name != "RelativeAltitude"}
    path = write_photo(tmp_path / "a.jpg", xmp=xmp_of(facts | {"AbsoluteAltitude": "+500.00"}))
    found = open_picture(path, Told(dem=dem))
    assert (found.height_m, found.note) == (pytest.approx(80.0), "height above the ground by dem.tif")
    with pytest.raises(CameraError, match="how high the drone was"):
        open_picture(path)
    exif = ZURICH | {ExifTags.GPS.GPSAltitude: 505.0, ExifTags.GPS.GPSAltitudeRef: b"\x00"}
    assert open_picture(write_photo(path, xmp=xmp_of(facts), gps=exif), Told(dem=dem)).height_m == pytest.approx(85.0)
    write_photo(path, xmp=xmp_of(facts), gps=exif | {ExifTags.GPS.GPSAltitudeRef: b"\x02"})
    with pytest.raises(CameraError, match="from the ellipsoid"):
        open_picture(path, Told(dem=dem))
    write_photo(path, xmp=xmp_of(facts | {"AbsoluteAltitude": "+500.00", "AltitudeType": "RtkAlt"}))
    with pytest.raises(CameraError, match="from the ellipsoid"):
        open_picture(path, Told(dem=dem))
    with pytest.raises(CameraError, match="a photo without an altitude: say --height"):
        open_picture(write_photo(path, xmp=xmp_of(facts)), Told(dem=dem))
    with pytest.raises(ConfigError, match="cannot be read as a GeoTIFF of heights"):
        open_picture(path, Told(dem=tmp_path / "none.tif"))
    assert open_picture(write_photo(path), Told(dem=dem)).height_m == 50.0
    with pytest.raises(ConfigError, match="told in one way"):
        Told(dem=dem, height_m=80.0)


def test_numbers_that_cannot_be_are_refused():
    for wrong in ({"height_m": 0.0}, {"height_m": math.nan}, {"ground_width_m": 1e9}):
        with pytest.raises(CameraError, match="is above 0 and at most"):
            replace(Told(), **wrong)


def test_a_georeferenced_picture_that_leaves_the_datum_open_is_refused(tmp_path):
    transform = turned(0.0, 0.6, east_m=520_000.0, north_m=5_220_000.0, size=(400, 300))
    path = write_geotiff(tmp_path / "a.tif", transform=transform, crs="+proj=utm +zone=32 +ellps=bessel")
    with pytest.raises(ImageError, match="leaves the datum open"):
        open_picture(path)
