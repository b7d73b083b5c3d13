# SPDX-License-Identifier: Apache-2.0
"""Own pictures as tasks: truths, priors, flights, heights over a slope, and pictures that are left out."""

import json
import math
import shutil
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from pyproj import Transformer
from rasterio.transform import from_origin

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import ConfigError, ImageError, SasgeoError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.observing.import_photos import ImportRequest, import_photos
from sasgeo_bench.observing.photo_flights import flights_of
from sasgeo_bench.observing.picture_poses import PoseFacts
from sasgeo_bench.observing.pictures import OwnPicture
from sasgeo_bench.observing.posed_pictures import GPS_SIGMA_M, Heights, PosedPicture
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.running.segment_tasks import SegmentTasks, segment_tasks
from sasgeo_bench.sensing.crops import drawn_crops
from sasgeo_bench.tasks.query import TRUTH_SIGMA, PriorGroup
from sasgeo_bench.tasks.task_files import QUERIES, TRUTH, Task
from tests import pose_files
from tests.sensing import test_visual_odometry as plane
from tests.sensing.test_photos import write_photo, xmp_of

TOWN = "town-riverside"
WIDTH, HEIGHT, FILM_MM = 480, 360, 24.0
FOCAL = FILM_MM * math.hypot(WIDTH, HEIGHT) / math.hypot(36.0, 24.0)
HEAD = (
    *("file", "lon", "lat", "RelativeAltitude", "gimbal_yaw", "gimbal_pitch", "gimbal_roll", "DateTimeOriginal"),
    *("ImageWidth", "ImageHeight", "FocalLengthIn35mmFormat", "horizontal_accuracy"),
)


@pytest.fixture(scope="module")
def region(towns: Path) -> sgb.Region:
    return sgb.read_region(towns / "regions" / TOWN)


@pytest.fixture(scope="module")
def middle(region) -> tuple[float, float]:
    west, south, east, north = region.grid.bounds_m
    return ((west + east) / 2, (south + north) / 2)


def lonlat(region, east, north):
    return Transformer.from_crs(region.grid.epsg, 4326, always_xy=True).transform(east, north)


def north_of_grid(region, east, north):
    """Bearing of true north in the grid at a place."""
    lon, lat = lonlat(region, east, north)
    back = Transformer.from_crs(4326, region.grid.epsg, always_xy=True)
    x, y = back.transform(lon, lat + 1e-3)
    return math.degrees(math.atan2(x - east, y - north))


def row(region, name, place, **more):
    """A row of a table: angles are against true north, the place is in the CRS of the region."""
    usual = {
        "height": 80.0,
        "angles": (0.0, -90.0, 0.0),
        "time": "",
        "size": (WIDTH, HEIGHT),
        "film": FILM_MM,
        "sigma": "",
    }
    told = usual | more
    lon, lat = lonlat(region, *place)
    cells = [name, f"{lon:.10f}", f"{lat:.10f}", told["height"], *told["angles"], told["time"], *told["size"]]
    return ",".join(map(str, [*cells, told["film"], told["sigma"]]))


@pytest.fixture
def laid(towns, tmp_path):
    """Lay pictures of noise with a table of their poses; return what imports them."""

    def lay(rows, *, without=(), out=None, **options):
        folder = tmp_path / "photos"
        folder.mkdir(exist_ok=True)
        rng = np.random.default_rng(3)
        for line in rows:
            name = line.split(",")[0]
            if name not in without:
                noise = rng.integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
                Image.fromarray(noise).resize((WIDTH, HEIGHT)).save(folder / name)
        table = tmp_path / "poses.csv"
        table.write_text("\n".join([",".join(HEAD), *rows]) + "\n")
        given = {"poses": table, "out": out or tmp_path / "out"} | options
        return ImportRequest(pictures=folder, region=towns / "regions" / TOWN, **given)

    return lay


def asked(task):
    """Queries and truths of a task by id."""
    truths = {truth.query_id: truth for truth in task.truths}
    return [(query, truths[query.query_id]) for query in task.queries()]


def quiet(request):
    lines = []
    with reporting(lines.append):
        tasks = import_photos(request)
    return tasks, lines


def offset(middle, east, north):
    return (middle[0] + east, middle[1] + north)


def camera_of(region, place, height, angles):
    """Plain numpy: position and rows right, down, ahead of a camera in the grid's east, north, up."""
    lean = north_of_grid(region, *place)
    return np.array([*place, height]), pose_files.camera(*angles) @ pose_files.about(2, lean)


def project(position, turn, point):
    """Pixel of a point by a pinhole in the middle of the picture."""
    x, y, ahead = turn @ (np.asarray(point) - position)
    return np.array([WIDTH / 2 + FOCAL * x / ahead, HEIGHT / 2 + FOCAL * y / ahead])


def test_drawn_crops_get_the_poses_at_which_they_were_drawn(region, laid, tmp_path):
    """Each is the picture of a camera straight above, so high that its pixels are as wide."""
    rows, poses = [], {}
    folder = tmp_path / "photos"
    folder.mkdir()
    for at, crop in enumerate(islice(drawn_crops([region], seed=7, side_px=200, pixel_m=0.5, zoom=1.2), 8)):
        name, film = f"crop {at}.png", 24.0
        Image.fromarray(crop.rgb).save(folder / name)
        place = (crop.pose.easting_m, crop.pose.northing_m)
        height = crop.pixel_m * film * math.hypot(200, 200) / math.hypot(36.0, 24.0)
        yaw = crop.pose.yaw_deg - north_of_grid(region, *place)
        rows.append(row(region, name, place, height=height, angles=(yaw, -90.0, 0.0), size=(200, 200), film=film))
        poses[height] = crop.pose
    request = laid(rows, without={line.split(",")[0] for line in rows})
    tasks, lines = quiet(request)
    pairs = asked(tasks[0])
    assert len(tasks) == 1  # without times there is no flight
    assert len(pairs) >= 5  # some reach beyond the map, which is said
    assert len(pairs) == 8 or any("not wholly on the map" in line for line in lines)
    for query, truth in pairs:
        crop_pose = poses[min(poses, key=lambda height: abs(height - truth.measured["height_m"]))]
        assert truth.pose.easting_m == pytest.approx(crop_pose.easting_m, abs=0.01)
        assert truth.pose.northing_m == pytest.approx(crop_pose.northing_m, abs=0.01)
        assert abs((truth.pose.yaw_deg - crop_pose.yaw_deg + 180) % 360 - 180) < 0.01
        assert query.frames[0].camera.intrinsics.width_px == 200
        assert (query.track, query.suite, query.prior_group) == ("localization", "photos", "r500-weak-s10")
        assert query.evidence.unknown_share == 1.0
        assert (truth.detector, truth.is_present, truth.block[: len(TOWN)]) == ("real", True, TOWN)


@pytest.mark.slow
def test_the_truth_lies_anywhere_in_the_disc(region, middle, laid):
    rows = [row(region, f"{at}.png", offset(middle, at, -at)) for at in range(12)]
    (task,), _ = quiet(laid(rows))
    off = [
        math.dist(query.prior.center_m, (truth.pose.easting_m, truth.pose.northing_m)) for query, truth in asked(task)
    ]
    assert max(off) <= 500.0
    assert min(off) > 5.0
    assert np.std(off) > 50.0
    first = [query.prior for query in task.queries()]
    assert first != [query.prior for query in quiet(laid(rows, seed=1))[0][0].queries()]
    assert first == [query.prior for query in quiet(laid(rows))[0][0].queries()]


@pytest.mark.parametrize("angles", [(0.0, -90.0, 0.0), (37.0, -75.0, 5.0), (200.0, -62.0, -8.0)])
def test_the_middle_of_a_view_is_seen_at_the_same_pixel_from_its_truth(angles, region, middle, laid):
    (task,), _ = quiet(laid([row(region, "a.png", middle, angles=angles)]))
    ((query, truth),) = asked(task)
    camera = query.frames[0].camera
    seen = camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 0.0], [10.0, 0.0, 0.0]]))
    points = truth.pose.to_map(np.array([[0.0, 0.0], [0.0, 10.0], [10.0, 0.0]]))
    position, turn = camera_of(region, middle, 80.0, angles)
    scale = FOCAL / camera.intrinsics.focal_px[0]
    shown = [project(position, turn, [*point, 0.0]) for point in points]
    # The frame is a part of the picture: distances between the points are alike, as are turns.
    np.testing.assert_allclose((seen[1:] - seen[0]) * scale, np.array(shown[1:]) - shown[0], atol=0.01)
    assert truth.measured["tilt_deg"] == pytest.approx(90 + angles[1], abs=8.1)


def slope(region, middle, path, *, degrees, base=200.0):
    """Heights that rise to the east, 200 m in the middle of the town."""
    west, north = middle[0] - 1500, middle[1] + 1500
    rise = math.tan(math.radians(degrees))
    cells = base + rise * (np.arange(300) * 10.0 + 5.0 - 1500.0)
    with rasterio.open(
        path, "w", driver="GTiff", width=300, height=300, count=1, dtype="float32",
        crs=f"EPSG:{region.grid.epsg}", transform=from_origin(west, north, 10.0, 10.0),
    ) as out:  # fmt: skip
        out.write(np.tile(cells.astype(np.float32), (300, 1)), 1)
    return path, rise


def absolute(line, altitude):
    """A row with an altitude above the sea in place of the height above take-off."""
    cells = line.split(",")
    cells[3] = str(altitude)
    return ",".join(cells)


@pytest.mark.parametrize("angles", [(90.0, -90.0, 0.0), (90.0, -80.0, 0.0), (270.0, -75.0, 0.0), (45.0, -70.0, 0.0)])
def test_a_slope_of_20_degrees_moves_no_truth_by_2_metres(angles, region, middle, laid, tmp_path):
    dem, rise = slope(region, middle, tmp_path / "dem.tif", degrees=20.0)
    request = laid([absolute(row(region, "a.png", middle, angles=angles), 280.0)], heights=Heights(dem=dem))
    request.poses.write_text(request.poses.read_text().replace("RelativeAltitude", "AbsoluteAltitude"))
    (task,), lines = quiet(request)
    ((query, truth),) = asked(task)
    assert any("taken to be above the sea" in line for line in lines)
    # The pixel that the middle of the view has, and where its ray meets the slope.
    position, _ = camera_of(region, middle, 280.0, angles)
    here = np.array([truth.pose.easting_m, truth.pose.northing_m])
    height = truth.measured["height_m"]
    flat = np.array([*here, 280.0 - height])
    ray = flat - position
    along = (200.0 + rise * (position[0] - middle[0]) - position[2]) / (ray[2] - rise * ray[0])
    met = position + along * ray
    assert np.linalg.norm(met[:2] - here) < 2.0
    assert height == pytest.approx(280.0 - (200.0 + rise * (here[0] - middle[0])), abs=0.2)
    assert query.frames[0].height_sigma_m > 0


def test_heights_come_from_where_the_user_says(region, middle, laid):
    line = row(region, "a.png", middle)
    heights = {}
    for name, given in {"own": Heights(), "stated": Heights(height_m=60.0)}.items():
        (task,), _ = quiet(laid([line], heights=given))
        heights[name] = task.truths[0].measured["height_m"]
    request = laid([absolute(line, 500.0)], heights=Heights(takeoff_m=430.0))
    request.poses.write_text(request.poses.read_text().replace("RelativeAltitude", "AbsoluteAltitude"))
    heights["take-off"] = quiet(request)[0][0].truths[0].measured["height_m"]
    assert heights == {"own": 80.0, "stated": 60.0, "take-off": 70.0}


def test_the_truth_says_how_far_it_is_off(region, middle, laid):
    rows = [row(region, "gps.png", middle), row(region, "rtk.png", middle, sigma="0.02")]
    (task,), _ = quiet(laid(rows))
    found = sorted(truth.measured["truth_sigma_m"] for truth in task.truths)
    # A degree of tilt at 80 m is 1.4 m beside the place of the camera.
    assert found == pytest.approx([math.hypot(0.02, 1.4), math.hypot(GPS_SIGMA_M, 1.4)], abs=0.01)
    assert {truth.strength_unit for truth in task.truths} == {TRUTH_SIGMA}
    assert sorted(truth.strength for truth in task.truths) == [2.0, 5.0]
    assert "1.4 to 3.6 m: success within less than two of them, rounded up" in task.manifest.what
    (task,), _ = quiet(laid(rows, sigma_m=0.5))
    assert min(truth.measured["truth_sigma_m"] for truth in task.truths) == pytest.approx(
        math.hypot(0.02, 1.4), abs=0.01
    )
    assert max(truth.measured["truth_sigma_m"] for truth in task.truths) == pytest.approx(
        math.hypot(0.5, 1.4), abs=0.01
    )


def clock(seconds):
    return f"2025:10:02 12:{seconds // 60:02}:{seconds % 60:02}"


def test_pictures_that_follow_each_other_are_flights(region, middle, laid):
    times = [0, 2, 4, 6, 50, 52, 54, 200]  # four, three, and one alone
    rows = [
        row(region, f"{at}.png", offset(middle, 10 * at, 0), time=clock(second), angles=(90.0, -90.0, 0.0))
        for at, second in enumerate(times)
    ]
    tasks, lines = quiet(laid(rows))
    assert [task.manifest.suite for task in tasks] == ["photos", "photos-flights"]
    assert any(line.startswith("2 flights of 7 pictures: a gap of 30 s ends one") for line in lines)
    flights = {}
    for query, truth in asked(tasks[1]):
        flights.setdefault(query.step.sequence_id, []).append((query, truth))
    assert sorted(map(len, flights.values())) == [3, 4]
    for pairs in flights.values():
        assert [query.step.frame for query, _ in pairs] == list(range(len(pairs)))
        assert [query.prior.has_place for query, _ in pairs] == [True] + [False] * (len(pairs) - 1)
        for (_, before), (query, truth) in pairwise(pairs):
            right, up, turn = query.step.increment
            assert (right, up, turn) == (pytest.approx(0, abs=2), pytest.approx(10, abs=2), pytest.approx(0, abs=5))
            assert truth.measured["distance_m"] - before.measured["distance_m"] == pytest.approx(10.0, abs=0.2)
            assert truth.measured["time_s"] - before.measured["time_s"] == 2.0


def posed(name, time_s, east=0.0, lens="x"):
    picture = OwnPicture(path=Path(name), scale_sigma=0.1)
    pose = sgb.Pose(easting_m=east, northing_m=0.0, yaw_deg=0.0)
    return PosedPicture(
        name=name,
        picture=picture,
        pose=pose,
        sigma_m=1.0,
        position_m=(east, 0.0, 80.0),
        side_m=50.0,
        time_s=time_s,
        lens=lens,
    )


def test_a_flight_ends_at_a_gap_another_camera_or_a_leap():
    gap = [posed(str(at), time) for at, time in enumerate([0.0, 10.0, 20.0, 50.0, 60.0, 89.9])]
    assert [[one.name for one in flight] for flight in flights_of(gap)] == [["0", "1", "2"], ["3", "4", "5"]]
    lenses = [posed(str(at), float(at), lens="ab"[at > 2]) for at in range(6)]
    assert [len(flight) for flight in flights_of(lenses)] == [3, 3]
    leap = [posed(str(at), float(at), east=1000.0 * (at > 2)) for at in range(5)]
    assert [len(flight) for flight in flights_of(leap)] == [3]
    one_second = [posed(str(at), float(at // 2)) for at in range(6)]
    assert [[one.name for one in flight] for flight in flights_of(one_second)] == [["0", "2", "4"]]
    assert flights_of([replace(one, time_s=None) for one in gap]) == []


@pytest.fixture
def flown(region, middle, laid, tmp_path):
    """Lay photos of a textured plane, 15 m from each to the next, northward; the fourth shows nothing."""

    def lay(shifts, **options):
        folder = tmp_path / "photos"
        folder.mkdir(exist_ok=True)
        rows = []
        for at, (east, north) in enumerate(shifts):
            rgb = plane.picture((0.0, 15.0 * at - 40.0, 60.0, 0.0, 0.0, 0.0))
            Image.fromarray(rgb if at != 3 else np.full_like(rgb, 90)).save(folder / f"{at}.png")
            place = offset(middle, east, 15.0 * at - 40.0 + north)
            angles = (-north_of_grid(region, *place), -90.0, 0.0)
            film = plane.FOCAL_PX * math.hypot(36.0, 24.0) / math.hypot(plane.SIDE_PX, plane.SIDE_PX)
            size = (plane.SIDE_PX, plane.SIDE_PX)
            more = {"height": 60.0, "angles": angles, "time": clock(2 * at), "film": film, "size": size}
            rows.append(row(region, f"{at}.png", place, **more))
        return laid(rows, without={line.split(",")[0] for line in rows}, **options)

    return lay


def test_visual_odometry_is_what_the_pictures_show(flown, program):
    request = flown(np.zeros((6, 2)))
    words = ("--region", str(request.region), "--poses", str(request.poses), "--out", str(request.out))
    code, out, err = program("import-photos", str(request.pictures), *words, "--odometry", "visual")
    assert code == 0, err
    tasks = [Task.open(Path(line)) for line in out.splitlines()]
    steps = [query.step for query in sorted(tasks[1].queries(), key=lambda query: query.step.frame)]
    assert [step.increment is None for step in steps] == [True, False, False, True, True, False]
    for step in steps:
        if step.increment is not None:
            np.testing.assert_allclose(step.increment, (0.0, 15.0, 0.0), atol=0.3)
            spread_m = math.sqrt(step.covariance[4])
            assert 0.1 * 15.0 < spread_m < 0.3 * 15.0  # heights above take-off are known to 10 %
    assert "visual: matches of ORB features" in tasks[1].manifest.what
    assert "odometer" not in tasks[0].manifest.what
    (line,) = [line for line in err.splitlines() if line.startswith("visual odometry")]
    assert line.startswith("visual odometry: 2 of 5 pairs of pictures lost (40%); off the files' positions by 0.")


@pytest.mark.slow
def test_visual_odometry_does_not_know_the_positions(flown):
    plain, moved = (
        [(query.step, query.prior.center_m) for query in quiet(flown(shifts, odometry="visual"))[0][1].queries()]
        for shifts in (np.zeros((6, 2)), np.random.default_rng(5).uniform(-9, 9, (6, 2)))
    )
    assert [step for step, _ in plain] == [step for step, _ in moved]
    assert [center_m for _, center_m in plain] != [center_m for _, center_m in moved]


def test_drawn_odometry_looks_at_no_picture(flown):
    tasks, lines = quiet(flown(np.zeros((6, 2))))
    assert all(query.step.increment is not None for query in tasks[1].queries() if query.step.frame)
    assert "drifts as vio-mono was measured to" in tasks[1].manifest.what
    assert not any(line.startswith("visual odometry") for line in lines)


def test_pictures_without_a_pose_are_left_out_and_counted(region, middle, laid):
    rows = [
        row(region, "good.png", middle),
        row(region, "tilted.png", middle, angles=(0.0, -25.0, 0.0)),
        row(region, "low.png", middle, height=-3),
        row(region, "off.png", offset(middle, 900, 0)),
        row(region, "edge.png", offset(middle, 500, 0)),
        row(region, "bare.png", middle, angles=("", "", "")),
        row(region, "broken.png", middle),
        row(region, "tiny.png", middle, height=5),
    ]
    request = laid(rows)
    noise = (request.pictures / "broken.png").read_bytes()
    (request.pictures / "broken.png").write_bytes(noise[: len(noise) // 2])
    Image.new("RGB", (8, 8)).save(request.pictures / "stray.png")
    (request.pictures / "none.jpg").write_text("no picture")
    (task,), lines = quiet(request)
    assert task.manifest.queries == 1
    told = "\n".join(lines)
    assert "left out: 2 pictures (none.jpg, stray.png) that the table does not name" in told
    assert "left out: 1 picture (tilted.png) that look more than 60 degrees away from straight down" in told
    assert "left out: 1 picture (low.png) that were not above the ground" in told
    assert "left out: 1 picture (edge.png) whose view is not wholly on the map town-riverside" in told
    off_m = middle[0] + 900 - region.grid.bounds_m[2]
    assert f"left out: 1 picture (off.png) that were taken {off_m:.0f} m or more beside the map town" in told
    assert "left out: 1 picture (bare.png) without angles of the camera" in told
    assert "left out: 1 picture (tiny.png) that show less ground than 16 m a side" in told
    assert "left out: 1 picture (broken.png) that cannot be decoded" in told


def test_several_cameras_are_said(region, middle, laid):
    rows = [row(region, "a.png", middle), row(region, "b.png", offset(middle, 5, 5), size=(240, 180))]
    request = laid(rows)
    Image.new("RGB", (240, 180), (9, 99, 9)).save(request.pictures / "b.png")
    _, lines = quiet(request)
    assert "2 cameras: camera 480 x 360 (1), camera 240 x 180 (1)" in lines


def test_a_georeferenced_picture_needs_no_table(towns, region, middle, tmp_path):
    path = tmp_path / "photos" / "a.tif"
    path.parent.mkdir()
    rgb = np.random.default_rng(1).integers(0, 256, (3, 200, 200), dtype=np.uint8)
    with rasterio.open(
        path, "w", driver="GTiff", width=200, height=200, count=3, dtype="uint8", photometric="RGB",
        crs=f"EPSG:{region.grid.epsg}", transform=from_origin(middle[0] - 50, middle[1] + 50, 0.5, 0.5),
    ) as out:  # fmt: skip
        out.write(rgb)
    request = ImportRequest(pictures=path.parent, region=towns / "regions" / TOWN, out=tmp_path / "out", sigma_m=0.5)
    (task,), _ = quiet(request)
    (truth,) = task.truths
    assert (truth.pose.easting_m, truth.pose.northing_m) == pytest.approx(middle, abs=0.01)
    assert abs((truth.pose.yaw_deg + 180) % 360 - 180) < 0.01
    assert truth.measured["truth_sigma_m"] == 0.5
    _, lines = quiet(replace(request, heights=Heights(height_m=80.0)))
    assert "heights are passed over of 1 georeferenced picture: each tells its size" in lines


def exif_of(region, place):
    """GPS of EXIF at a place of the map."""
    lon, lat = lonlat(region, *place)
    parts = {}
    for name, value, sides in (("Latitude", lat, "NS"), ("Longitude", lon, "EW")):
        minutes = abs(value) * 60
        whole = (int(minutes // 60), int(minutes % 60), (minutes % 1) * 60)
        parts[getattr(ExifTags.GPS, f"GPS{name}")] = tuple(IFDRational(round(one * 1e6), 1_000_000) for one in whole)
        parts[getattr(ExifTags.GPS, f"GPS{name}Ref")] = sides[value < 0]
    return parts


def test_photos_of_a_drone_need_no_table(towns, region, middle, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    told = {"RelativeAltitude": "+80.0", "GimbalYawDegree": "30", "GimbalPitchDegree": "-90", "GimbalRollDegree": "0"}
    rtk = told | {"RtkStdLon": "0.011", "RtkStdLat": "0.013"}
    gps = exif_of(region, middle)
    write_photo(folder / "gps.jpg", gps=gps, xmp=xmp_of(told), focal=24)
    write_photo(folder / "rtk.jpg", gps=gps, xmp=xmp_of(rtk), focal=24)
    write_photo(folder / "loose.jpg", gps={}, xmp=xmp_of(told), focal=24)
    write_photo(folder / "flat.jpg", gps=gps, xmp=xmp_of(told), focal=None)
    request = ImportRequest(pictures=folder, region=towns / "regions" / TOWN, out=tmp_path / "out")
    (task,), lines = quiet(request)
    sigmas = sorted(truth.measured["truth_sigma_m"] for truth in task.truths)
    assert sigmas == pytest.approx([math.hypot(0.013, 1.4), math.hypot(GPS_SIGMA_M, 1.4)], abs=0.01)
    for query, truth in asked(task):
        assert (truth.pose.easting_m, truth.pose.northing_m) == pytest.approx(middle, abs=0.05)
        assert truth.pose.yaw_deg == pytest.approx(30.0 + north_of_grid(region, *middle), abs=0.01)
        assert str(query.observed_on) == "2024-05-01"
    assert any("(loose.jpg) without a position (say --poses or --track" in line for line in lines)
    assert any(
        line.startswith("places of 1 picture are good to less than 0.5 m, and taken as WGS 84") for line in lines
    )
    assert any("(flat.jpg) whose camera is not known (it has no focal length" in line for line in lines)


@pytest.mark.parametrize(
    ("zones", "counts", "line"),
    [
        (("", ""), [6], ""),
        (("+02:00", "+02:00"), [6], ""),
        (("+02:00", "-05:00"), [3, 3], "clocks: photos of 2 zones, whose times are taken in UTC"),
        (("+02:00", ""), [6], "clocks: 3 of 6 photos state no zone (EXIF's OffsetTimeOriginal): all are taken to"),
    ],
)
def test_photos_of_several_zones_are_flights_by_utc(towns, region, middle, tmp_path, zones, counts, line):
    """Six photos two seconds apart by their clocks, of which the last three may be of another camera."""
    told = {"RelativeAltitude": "+80.0", "GimbalYawDegree": "30", "GimbalPitchDegree": "-90", "GimbalRollDegree": "0"}
    for at in range(6):
        taken = f"2024:05:01 10:20:{10 + 2 * at}{zones[at // 3]}"
        gps = exif_of(region, offset(middle, 10 * at, 0))
        (tmp_path / "photos").mkdir(exist_ok=True)
        write_photo(tmp_path / "photos" / f"{at}.jpg", gps=gps, xmp=xmp_of(told), focal=24, taken=taken)
    tasks, lines = quiet(
        ImportRequest(pictures=tmp_path / "photos", region=towns / "regions" / TOWN, out=tmp_path / "out")
    )
    flown = [query.step.sequence_id for query in tasks[1].queries()]
    assert sorted(flown.count(one) for one in set(flown)) == counts
    assert [one[: len(line)] for one in lines if one.startswith("clocks")] == ([line] if line else [])


def test_a_table_outdoes_the_file_but_not_a_picture_that_exif_turns(region, middle, laid):
    """Where the clocks of both disagree, that is said."""
    place = offset(middle, 50, 20)
    times = {"a.jpg": "2024:05:01 10:20:30", "b.jpg": "2024:05:01 11:20:30", "turned.jpg": ""}
    rows = [row(region, name, place, size=(400, 300), time=time) for name, time in times.items()]
    request = laid(rows, without=set(times))
    for name in times:
        orientation = 6 if name == "turned.jpg" else None
        write_photo(request.pictures / name, gps=exif_of(region, middle), orientation=orientation)
    (task,), lines = quiet(request)
    assert [(round(truth.pose.easting_m), round(truth.pose.northing_m)) for truth in task.truths] == [
        (round(place[0]), round(place[1]))
    ] * 2
    assert any("(turned.jpg) that EXIF turns" in line for line in lines)
    assert any(line.startswith("clocks disagree: the table is +3600 s (median) off EXIF at 1 of 2") for line in lines)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("suffix", ["png", "webp"])
def test_a_png_or_webp_that_exif_turns_is_treated_as_a_jpeg(suffix, late, region, middle, laid):
    rows = [row(region, f"a.{suffix}", middle), row(region, "b.png", middle)]
    request = laid(rows)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    path = request.pictures / f"a.{suffix}"
    Image.open(path).save(path, exif=exif)
    if late and suffix == "png":  # the chunk behind the pixels, as some programs write it
        data = path.read_bytes()
        at = data.index(b"eXIf") - 4
        chunk = data[at : at + 12 + int.from_bytes(data[at : at + 4])]
        data = data.replace(chunk, b"")
        end = data.index(b"IEND") - 4
        path.write_bytes(data[:end] + chunk + data[end:])
    (task,), lines = quiet(request)
    assert task.manifest.queries == 1
    assert any(f"(a.{suffix}) that EXIF turns" in line for line in lines)


def test_a_png_with_damaged_exif_is_left_out(region, middle, laid):
    request = laid([row(region, name, middle) for name in ("a.png", "b.png")])
    path = request.pictures / "a.png"
    Image.open(path).save(path, exif=b"garbage")
    (task,), lines = quiet(request)
    assert task.manifest.queries == 1
    assert any("(a.png) that cannot be read (it is no sound picture" in line for line in lines)


def test_two_pictures_of_one_name_do_not_share_a_row(region, middle, laid):
    request = laid([row(region, name, middle) for name in ("a.png", "b.png")])
    for folder in ("may", "june"):
        (request.pictures / folder).mkdir()
        (request.pictures / folder / "a.png").write_bytes((request.pictures / "a.png").read_bytes())
    (request.pictures / "a.png").unlink()
    (task,), lines = quiet(request)
    assert task.manifest.queries == 1
    assert any(
        "2 pictures (june/a.png, may/a.png) of one name, for which the table has one row" in one for one in lines
    )


def test_a_heading_without_a_pitch_is_of_a_camera_that_looks_straight_down(region, middle, laid):
    names = ("down.jpg", "bare.jpg", "tilted.jpg")
    request = laid([row(region, name, middle, angles=(75.0, "", "")) for name in names], without=names)
    for name, pitch in zip(names, ("-88", None, "-60"), strict=True):
        told = {"GimbalYawDegree": "30", "GimbalPitchDegree": pitch, "GimbalRollDegree": "0"} if pitch else {}
        write_photo(request.pictures / name, gps=exif_of(region, middle), xmp=xmp_of(told), size=(WIDTH, HEIGHT))
    (task,), lines = quiet(request)
    yaws = sorted(truth.pose.yaw_deg - north_of_grid(region, *middle) for truth in task.truths)
    assert yaws == pytest.approx([30.0, 75.0, 75.0], abs=0.01)
    start = "the table has a heading and no pitch: taken as cameras that look straight down"
    assert f"{start} (2 pictures)" in lines
    assert any(line.startswith("not used: the table's heading, without a pitch") for line in lines)


def test_a_lens_of_a_table_fits_a_smaller_copy_of_its_picture(region, middle, laid):
    """COLMAP's sizes of scaled pictures are rounded, side by side; of another shape it is another picture's."""
    rows = [row(region, name, middle) for name in ("a.png", "b.png")]
    request = laid(rows)
    lens = f"PINHOLE 961 720 {2 * FOCAL * 961 / 960} {2 * FOCAL} 480.5 360"
    folder = request.poses.parent / "model"
    folder.mkdir()
    (folder / "cameras.txt").write_text(f"1 {lens}\n2 PINHOLE 900 900 800 800 450 450\n")
    lon, lat = lonlat(region, *middle)
    down = "0 1 0 0 0 0 80"  # half a turn about its right: it looks down, and its up is north
    (folder / "images.txt").write_text(f"1 {down} 1 a.png\n\n2 {down} 2 b.png\n\n")
    origin = PoseFacts(origin=(lon, lat, 0.0))
    tasks, lines = quiet(replace(request, poses=folder, facts=origin))
    ((query, truth),) = asked(tasks[0])
    assert truth.measured["height_m"] == pytest.approx(80.0, abs=0.01)
    assert (truth.pose.easting_m, truth.pose.northing_m) == pytest.approx(middle, abs=0.01)
    assert query.frames[0].camera.intrinsics.focal_px == pytest.approx((FOCAL, FOCAL), rel=1e-6)
    assert any("(b.png) whose camera is not known (it has no focal length" in line for line in lines)
    assert any(line.startswith("heights count from the origin") for line in lines)


def test_a_tum_file_names_the_pictures_of_its_folder_by_their_order(region, middle, laid):
    request = laid([row(region, name, middle, time=clock(0)) for name in ("b.png", "a.png", "c.png")])
    lon, lat = lonlat(region, *middle)
    tum = request.poses.with_name("run.txt")
    tum.write_text("".join(f"{at} {10 * at} 0 80 1 0 0 0\n" for at in (5, 6, 7)))
    # Pictures of noise have no lens of their own: one with EXIF has.
    for name in ("a", "b", "c"):
        (request.pictures / f"{name}.png").unlink()
        write_photo(request.pictures / f"{name}.jpg", focal=24)
    (request.pictures / "film.mp4").write_bytes(b"")
    tasks, lines = quiet(replace(request, poses=tum, facts=PoseFacts(origin=(lon, lat, 0.0))))
    assert sum("1 .mp4" in line for line in lines) == 1
    east = sorted(round(truth.pose.easting_m - middle[0], 1) for truth in tasks[0].truths)
    assert east == pytest.approx([50.0, 60.0, 70.0], abs=3.0)  # its east is the true one
    steps = [query.step.frame for query in tasks[1].queries()]
    assert steps == [0, 1, 2]


def test_swapped_places_are_guessed_where_they_lie_on_the_map(region, middle, laid):
    cells = row(region, "a.png", middle).split(",")
    cells[1:3] = cells[2:0:-1]
    with pytest.raises(ConfigError, match="longitude and latitude seem to be swapped"):
        quiet(laid([",".join(cells)]))
    cells[1:3] = [str(math.radians(float(cell))) for cell in cells[2:0:-1]]
    with pytest.raises(ConfigError, match="places seem to be in radians: call the columns lat_rad and lon_rad"):
        quiet(laid([",".join(cells)]))
    request = laid([",".join(cells)])
    request.poses.write_text(request.poses.read_text().replace("lon,lat", "lon_rad,lat_rad"))
    (task,), _ = quiet(request)
    (truth,) = task.truths
    assert (truth.pose.easting_m, truth.pose.northing_m) == pytest.approx(middle, abs=0.05)


def test_altitudes_above_the_ellipsoid_are_no_heights_above_the_sea(region, middle, laid, tmp_path):
    dem, _ = slope(region, middle, tmp_path / "dem.tif", degrees=0.0)
    request = laid([absolute(row(region, "a.png", middle), 280.0)], heights=Heights(dem=dem))
    request.poses.write_text(request.poses.read_text().replace("RelativeAltitude", "ellipsoidal_height"))
    with pytest.raises(ConfigError, match="counts from the ellipsoid, where the ground's heights do from the sea"):
        quiet(request)
    with pytest.raises(ConfigError, match="counts from the ellipsoid"):
        quiet(replace(request, heights=Heights(takeoff_m=200.0)))
    with pytest.raises(ConfigError, match="does not cover"):
        quiet(laid([row(region, "a.png", middle)], heights=Heights(dem=slope_far(region, middle, tmp_path))))


@pytest.mark.parametrize(("kind", "is_refused"), [("RtkAlt", True), ("GpsFusionAlt", False)])
def test_altitudes_of_rtk_count_from_the_ellipsoid(kind, is_refused, region, middle, towns, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    told = {"AbsoluteAltitude": "+280.0", "AltitudeType": kind, "RelativeAltitude": "+80.0", "GimbalYawDegree": "0"}
    told |= {"GimbalPitchDegree": "-90", "GimbalRollDegree": "0"}
    write_photo(folder / "a.jpg", gps=exif_of(region, middle), xmp=xmp_of(told), focal=24)
    write_photo(folder / "b.jpg", gps=exif_of(region, middle), xmp=xmp_of(told | {"AltitudeType": "x"}), focal=24)
    heights = Heights(takeoff_m=200.0)
    request = ImportRequest(pictures=folder, region=towns / "regions" / TOWN, out=tmp_path / "out", heights=heights)
    (task,), lines = quiet(request)
    assert task.manifest.queries == 2 - is_refused
    assert any("(a.jpg) whose altitude counts from the ellipsoid" in line for line in lines) == is_refused


def slope_far(region, middle, folder):
    """Heights of another place."""
    return slope(region, offset(middle, 50_000, 0), folder / "far.tif", degrees=1.0)[0]


# What is asked, error, its words.
REFUSED = [
    ({"name": "clean"}, ConfigError, "is no name for a suite of your own"),
    ({"name": "My Photos"}, ConfigError, "is no name for a suite of your own"),
    ({"sigma_m": 0.0}, ConfigError, "--sigma lies above 0"),
    ({"seed": -1}, ConfigError, "--seed is 0 or more"),
    ({"group": PriorGroup.parse("gnss")}, ConfigError, "for pictures take r50 or r100"),
    ({"region": Path("none")}, StoreError, "none"),
    ({"pictures": Path("none")}, ImageError, "there is no picture or folder none"),
    ({"poses": Path("none.csv")}, SasgeoError, "name a table of poses"),
]


@pytest.mark.parametrize(("changes", "error", "words"), REFUSED)
def test_what_cannot_be_imported_is_refused_in_one_line(changes, error, words, region, middle, laid):
    request = laid([row(region, "a.png", middle)])
    with pytest.raises(error) as caught:
        import_photos(replace(request, **changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_heights_have_one_source():
    with pytest.raises(ConfigError, match="heights come from one source"):
        Heights(height_m=80.0, takeoff_m=400.0)
    with pytest.raises(ConfigError, match="--height lies above 0"):
        Heights(height_m=-1.0)


def test_nothing_is_written_where_no_picture_is_left(region, middle, laid, tmp_path):
    with pytest.raises(ConfigError, match=r"1 picture \(a\.png\) that were taken 4\.5 km or more beside the map"):
        quiet(laid([row(region, "a.png", offset(middle, 5000, 0))]))
    request = laid([row(region, name, middle) for name in ("a.png", "b.png")])
    for name in ("a.png", "b.png"):  # of one size: like faults are counted together
        (request.pictures / name).write_bytes((request.pictures / "a.png").read_bytes()[:3000])
    lines = []
    with reporting(lines.append), pytest.raises(ConfigError, match=r"2 pictures \(.*\) that cannot be decoded"):
        import_photos(request)
    assert sum("cannot be decoded" in line for line in lines) == 1
    assert "it is truncated" in lines[-1]
    assert not list((tmp_path / "out").rglob("*.parquet"))


def test_the_most_frequent_reason_stands_for_those_that_were_told(region, middle, laid):
    far = [row(region, name, offset(middle, 5000, 0)) for name in ("a.png", "b.png")]
    rows = [*far, row(region, "c.png", middle, height=-3)]
    with pytest.raises(ConfigError, match=r"2 .* beside the map town-riverside .*, the others for the") as caught:
        quiet(laid(rows))
    assert "above the ground" not in str(caught.value)


def test_a_fault_of_a_file_is_told_without_its_folders(region, middle, laid):
    request = laid([row(region, "a.png", middle), row(region, "bad/junk/b.jpg", middle)], without=["bad/junk/b.jpg"])
    (request.pictures / "bad" / "junk").mkdir(parents=True)
    (request.pictures / "bad" / "junk" / "b.jpg").write_text("no picture")
    _, lines = quiet(request)
    assert any("that cannot be read (it is no JPEG" in line for line in lines)


def test_a_tum_file_is_refused_where_names_sort_by_text_and_not_by_number(region, middle, laid):
    lon, lat = lonlat(region, *middle)
    names = [f"frame_{at}.png" for at in (1, 2, 10)]
    request = laid([row(region, name, middle) for name in names])
    request.poses.write_text("".join(f"{at} {10 * at} 0 80 1 0 0 0\n" for at in (5, 6, 7)))
    facts = PoseFacts(origin=(lon, lat, 0.0))
    with pytest.raises(ConfigError, match="pad the numbers of the names with zeros"):
        quiet(replace(request, facts=facts))
    with pytest.raises(ConfigError, match="focal length"):  # pictures of noise have no lens: the poses were taken
        quiet(replace(request, facts=replace(facts, names=tuple(names))))


def test_the_command_prints_the_folders_of_its_tasks(region, middle, laid, program):
    request = laid([row(region, "a.png", middle)])
    words = ("--region", str(request.region), "--poses", str(request.poses), "--out", str(request.out))
    code, out, err = program("import-photos", str(request.pictures), *words)
    assert code == 0, err
    assert out.strip() == str(request.out / "tasks" / "photos" / TOWN)
    assert "1 query in" in err
    manifest = Task.open(request.out / "tasks" / "photos" / TOWN).manifest
    assert (manifest.suite, manifest.queries, manifest.frames) == ("photos", 1, 1)


@pytest.mark.usefixtures("in_threads")
def test_a_segmenter_that_need_not_learn_sees_pictures_of_a_task_without_a_split(region, middle, laid):
    tasks, _ = quiet(laid([row(region, "a.png", middle)]))
    wanted = SegmentTasks(
        spec="colour_thresholds", tasks=[tasks[0].folder], split=None, out=tasks[0].root, is_sandboxed=False
    )
    (folder,) = segment_tasks(wanted)
    (query,) = Task.open(folder).queries()
    assert query.suite == "photos+colour_thresholds"
    assert query.evidence.unknown_share < 1.0
    with pytest.raises(ConfigError, match="unet needs training, and these tasks have no split: name one with --split"):
        segment_tasks(replace(wanted, spec="unet"))


def test_pictures_that_replace_others_of_their_name_say_so(laid, region, middle):
    rows = [row(region, f"{at}.png", offset(middle, 30 * at, 0)) for at in range(2)]
    assert not [line for line in quiet(laid(rows))[1] if "replaced" in line]
    assert not [line for line in quiet(laid(rows))[1] if "replaced" in line]  # the same again
    (told,) = (line for line in quiet(laid(rows[:1]))[1] if "replaced" in line)
    assert told.endswith(
        f"photos/{TOWN} held the queries of another import, which are replaced (another --name keeps both)"
    )


def test_a_task_credits_what_its_map_was_made_of_and_no_other(laid, region, middle, towns, tmp_path):
    own = tmp_path / "regions" / TOWN
    shutil.copytree(towns / "regions" / TOWN, own)
    manifest = json.loads((own / "region.json").read_text())
    terms = {"attribution": "building: a land survey (CC0-1.0)", "licence": "CC0-1.0"}
    (own / "region.json").write_text(json.dumps(manifest | terms))
    request = laid([row(region, "a.png", middle)])
    for folder, said in ((request.region, ATTRIBUTION), (own, terms["attribution"])):
        (task,), _ = quiet(replace(request, region=folder))
        assert (task.manifest.attribution, task.manifest.licence == "CC0-1.0") == (said, folder == own)
        for file in (task.folder / QUERIES, task.truth / TRUTH):
            assert pq.read_schema(file).metadata[b"attribution"].decode() == said
