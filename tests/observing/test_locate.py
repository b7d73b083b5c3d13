# SPDX-License-Identifier: Apache-2.0
"""Locating own pictures from end to end, over a town; its faults, what is kept, and what is written."""

import csv
import json
import math
import os
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
from affine import Affine
from PIL import Image
from pyproj import Geod
from scipy.spatial.transform import Rotation

import sasgeo_bench as sgb
from sasgeo_bench.cli.observing import line_of
from sasgeo_bench.core.errors import ConfigError, MatchError
from sasgeo_bench.geometry.projection import to_grid, to_lonlat
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.observing import locate as locating
from sasgeo_bench.observing.chances import Chances, answers_for, shipped_answers
from sasgeo_bench.observing.fixes import COLUMNS, Fix, LocateRequest, verdict
from sasgeo_bench.observing.locate import answer_key, locate, map_of
from sasgeo_bench.observing.pictures import Told
from sasgeo_bench.observing.results import csv_text, page_text, write_results
from sasgeo_bench.regions.packed_map import pack_map
from sasgeo_bench.sensing.crops import drawn_crops
from tests.flights.test_log_subtitles import block
from tests.videos import write_video

TOWN = "town-riverside"
SIDE_PX, PIXEL_M = 448, 0.5


@pytest.fixture(scope="module")
def crop(towns: Path) -> sgb.Crop:
    """A drawn picture of the town with the pose at which it was drawn."""
    region = sgb.read_region(towns / "regions" / TOWN)
    return next(islice(drawn_crops([region], seed=11, side_px=SIDE_PX, pixel_m=PIXEL_M, zoom=1.0), 6, None))


@pytest.fixture(scope="module")
def pictures(towns: Path, crop, tmp_path_factory) -> Path:
    """The picture as a turned GeoTIFF, and as a plain PNG beside a file that is none."""
    folder = tmp_path_factory.mktemp("pictures")
    epsg = sgb.read_region(towns / "regions" / TOWN).grid.epsg
    place = Affine.translation(crop.pose.easting_m, crop.pose.northing_m) @ Affine.rotation(-crop.pose.yaw_deg)
    transform = place @ Affine.scale(crop.pixel_m, -crop.pixel_m) @ Affine.translation(-SIDE_PX / 2, -SIDE_PX / 2)
    profile = {"driver": "GTiff", "width": SIDE_PX, "height": SIDE_PX, "count": 3, "dtype": "uint8"}
    with rasterio.open(
        folder / "a.tif", "w", crs=f"EPSG:{epsg}", transform=transform, photometric="RGB", **profile
    ) as out:
        out.write(np.moveaxis(crop.rgb, 2, 0))
    (folder / "b.jpg").write_text("no picture")
    Image.fromarray(crop.rgb).save(folder / "c.png")
    return folder


@pytest.fixture(scope="module")
def located(towns: Path, pictures: Path, tmp_path_factory):
    """The folder of pictures, located once by the program's own defaults."""
    into = tmp_path_factory.mktemp("located")
    width = SIDE_PX * PIXEL_M
    found = sgb.locate(pictures, out=towns, into=into, ground_width=width, region=TOWN, most_false=0.1, trusted=True)
    return into, found


def off(fix: Fix, pose: sgb.Pose) -> float:
    return math.hypot(fix.x_m - pose.easting_m, fix.y_m - pose.northing_m)


def test_a_drawn_picture_is_found_where_it_was_drawn(located, crop):
    _, found = located
    fix = found.fixes[0]
    assert (fix.file, fix.status, fix.is_accepted) == ("a.tif", "found", True)
    assert off(fix, crop.pose) < 5.0
    assert fix.file_distance_m == pytest.approx(off(fix, crop.pose), abs=0.5)
    lon, lat = to_lonlat(found.manifest.epsg).transform(fix.x_m, fix.y_m)
    assert (fix.lon, fix.lat) == pytest.approx((lon, lat), abs=1e-6)
    assert fix.p_false <= 0.1


@pytest.mark.slow
def test_frames_of_a_video_are_found_where_they_were_drawn(towns: Path, crop, tmp_path):
    """A second of one picture, from so high that its pixels are as wide, with what a DJI writes beside it."""
    manifest = sgb.read_region(towns / "regions" / TOWN).manifest
    lon, lat = to_lonlat(manifest.epsg).transform(crop.pose.easting_m, crop.pose.northing_m)
    heading = crop.pose.yaw_deg - to_grid(lon, lat, manifest.epsg)[2]
    height_m = crop.pixel_m * 24.0 * math.hypot(SIDE_PX, SIDE_PX) / math.hypot(36.0, 24.0)
    said = (
        f"[focal_len: 24.00] [latitude: {lat:.7f}] [longitude: {lon:.7f}] [rel_alt: {height_m:.2f} abs_alt: 0.0] "
        f"[gb_yaw: {heading:.1f} gb_pitch: -90.0 gb_roll: 0.0]"
    )
    video = write_video(tmp_path / "DJI_0001.MP4", [crop.rgb] * 10)
    video.with_suffix(".SRT").write_text("".join(block(at, said, step_ms=500) for at in (1, 2, 3)))
    found = sgb.locate(video, out=towns, into=tmp_path / "into", region=TOWN, most_false=0.1, trusted=True, every=5.0)
    (fix,) = found.fixes
    assert (fix.file, fix.status) == ("DJI_0001_00000.000s.jpg", "found")
    assert off(fix, crop.pose) < 5.0
    assert fix.file_distance_m == pytest.approx(off(fix, crop.pose), abs=0.5)


def test_flags_of_a_video_are_refused_of_pictures(pictures: Path, towns: Path):
    with pytest.raises(ConfigError, match="--every is of a video, and these pictures are none: leave it out"):
        sgb.locate(pictures / "c.png", out=towns, region=TOWN, ground_width=200.0, every=2.0)


def test_the_position_in_the_file_lies_in_the_disc_and_not_in_its_middle(located, crop):
    fix = located[1].fixes[0]
    lon, lat = to_lonlat(located[1].manifest.epsg).transform(crop.pose.easting_m, crop.pose.northing_m)
    away_m = Geod(ellps="WGS84").inv(lon, lat, fix.prior_lon, fix.prior_lat)[2]
    assert 10.0 < away_m <= fix.prior_radius_m == 500.0


def test_without_a_position_the_whole_map_is_searched_and_said_to_be_uncalibrated(located):
    fix = located[1].fixes[2]
    assert fix.file == "c.png"
    assert (fix.prior_lon, fix.prior_radius_m, fix.file_distance_m) == (None, None, None)
    assert "not calibrated on pictures like yours" in fix.note
    assert "a whole map searched" in fix.note
    assert "an unknown heading" in fix.note


def test_one_picture_that_is_none_costs_its_own_row(located):
    into, found = located
    assert [fix.status for fix in found.fixes].count("failed") == 1
    with (into / "locate.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == ["a.tif", "b.jpg", "c.png"]
    assert tuple(rows[0]) == COLUMNS
    assert rows[1]["status"] == "failed"
    assert "no JPEG, TIFF or DNG" in rows[1]["reason"]
    assert rows[1]["lon"] == rows[1]["p_false"] == ""
    assert (rows[0]["is_accepted"], rows[1]["is_accepted"]) == ("true", "false")


def test_where_every_picture_fails_results_of_an_earlier_call_stay(located, towns, tmp_path):
    into, _ = located
    before = {name: (into / name).read_bytes() for name in ("locate.csv", "index.html")}
    (tmp_path / "b.jpg").write_text("no picture")
    lines = []
    words = {"ground_width": 100.0, "region": TOWN, "trusted": True, "tell": lines.append}
    sgb.locate(tmp_path, out=towns, into=into, **words)
    assert {name: (into / name).read_bytes() for name in before} == before
    assert f"no picture could be asked: {into} keeps the results of an earlier call" in lines
    sgb.locate(tmp_path, out=towns, into=tmp_path / "into", **words)  # with none, the table says what is wrong
    assert "no JPEG, TIFF or DNG" in (tmp_path / "into" / "locate.csv").read_text()


def test_the_page_shows_every_picture_and_what_the_chances_stand_on(located):
    into, _ = located
    page = (into / "index.html").read_text()
    assert page.count("<article") == 3
    assert "calibrated on" in page
    assert "OpenStreetMap contributors" in page
    (first, _) = sorted((into / "pictures").iterdir(), key=lambda path: page.index(path.name))
    assert page.count(first.name) == 4  # a panel each
    with Image.open(first) as strip:
        assert strip.size == (4 * 240 + 3 * 6, 240)
        pixels = np.asarray(strip.convert("RGB"))
    assert pixels[:, :240].std() > 5  # the picture
    assert pixels[:, -240:].std() > 5  # the map


@pytest.mark.slow
def test_a_second_call_asks_nothing_anew_and_tries_what_failed(located, towns, pictures, monkeypatch):
    into, found = located
    asked = []
    one = locating._Asker.ask
    monkeypatch.setattr(
        locating._Asker, "ask", lambda self, path, name, key: (asked.append(name), one(self, path, name, key))[1]
    )
    again = sgb.locate(
        pictures, out=towns, into=into, ground_width=SIDE_PX * PIXEL_M, region=TOWN, most_false=0.1, trusted=True
    )
    assert asked == ["b.jpg"]
    assert [replace(fix, seconds=0.0) for fix in again.fixes] == [replace(fix, seconds=0.0) for fix in found.fixes]


@pytest.mark.slow
def test_a_packed_map_gives_the_same_fixes(located, towns, pictures, tmp_path):
    pack_map(towns / "regions" / TOWN, tmp_path / "town.map")
    width, region = SIDE_PX * PIXEL_M, str(tmp_path / "town.map")
    words = {"ground_width": width, "region": region, "most_false": 0.1, "trusted": True}
    found = sgb.locate(pictures, out=tmp_path / "out", into=tmp_path / "into", **words)
    assert [replace(fix, seconds=0.0) for fix in found.fixes] == [replace(fix, seconds=0.0) for fix in located[1].fixes]
    assert (tmp_path / "into" / "index.html").is_file()


@pytest.mark.slow
def test_a_picture_that_is_added_or_changed_gets_an_answer_and_a_strip_of_its_own(towns, pictures, tmp_path):
    folder = tmp_path / "own"
    folder.mkdir()
    shutil.copy(pictures / "a.tif", folder / "b.tif")

    def call() -> dict[str, Fix]:
        found = sgb.locate(folder, out=towns, into=tmp_path / "into", region=TOWN, trusted=True)
        return {fix.file: fix for fix in found.fixes}

    first = call()
    with rasterio.open(folder / "b.tif") as source:
        pixels, profile = source.read(), source.profile
    with rasterio.open(folder / "a.tif", "w", **profile) as target:  # before it in the order of names
        target.write(pixels[:, ::-1])
    second = call()
    assert second["b.tif"] == first["b.tif"]
    strips = {name: (tmp_path / "into" / "pictures" / f"{fix.key}.webp").read_bytes() for name, fix in second.items()}
    assert strips["a.tif"] != strips["b.tif"]
    page = (tmp_path / "into" / "index.html").read_text()
    assert page.index(second["a.tif"].key) < page.index(second["b.tif"].key)
    # changed within a time stamp that is kept
    times = (folder / "b.tif").stat()
    with rasterio.open(folder / "b.tif", "r+") as target:
        target.write(pixels[:, :, ::-1])
    os.utime(folder / "b.tif", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert call()["b.tif"].key != first["b.tif"].key


def test_a_line_that_was_cut_off_is_asked_again(located, tmp_path):
    into, _ = located
    text = (into / "answers.jsonl").read_text()
    (tmp_path / "answers.jsonl").write_text(text[: len(text) - 40])
    kept, whole = locating.read_answers(tmp_path / "answers.jsonl"), locating.read_answers(into / "answers.jsonl")
    assert len(kept) == len(whole) - 1
    assert all(whole[key] == fix for key, fix in kept.items())


def test_a_map_is_chosen_by_the_position(towns, pictures, tmp_path):
    request = LocateRequest(pictures=pictures, out=towns, into=tmp_path)
    paths = [pictures / "b.jpg", pictures / "a.tif"]
    assert map_of(request, paths).name.partition("@")[0] == TOWN
    with pytest.raises(ConfigError, match=r"new-region NAME --center 100\.00000,10\.00000"):
        map_of(replace(request, near=(100.0, 10.0)), paths)
    swapped = [locating.read_manifest(towns / "regions" / TOWN).bounds_lonlat[at] for at in (1, 0)]
    with pytest.raises(ConfigError, match="longitude comes first"):
        map_of(replace(request, near=(swapped[0] + 0.001, swapped[1] + 0.001)), paths)
    with pytest.raises(ConfigError, match="no JPEG, TIFF or DNG"):  # the fault of the only picture
        map_of(request, paths[:1])
    with pytest.raises(ConfigError, match="no picture says where it was taken"):
        map_of(replace(request, told=Told(ground_width_m=200.0)), [pictures / "c.png"])


@pytest.mark.slow
def test_a_picture_of_another_place_is_a_row(towns, pictures, tmp_path):
    found = locate(
        LocateRequest(
            pictures=pictures / "a.tif",
            out=towns,
            into=tmp_path,
            region=towns / "regions" / TOWN,
            near=(100.0, 10.0),
            is_sandboxed=False,
        )
    )
    assert found.fixes[0].status == "failed"
    assert "km beside the map" in found.fixes[0].reason


@pytest.mark.slow
def test_a_segmenter_that_must_learn_is_refused(towns, pictures, tmp_path):
    request = LocateRequest(
        pictures=pictures / "a.tif",
        out=towns,
        into=tmp_path,
        segmenter="pixel_forest",
        region=towns / "regions" / TOWN,
        is_sandboxed=False,
    )
    with pytest.raises(MatchError, match="pixel_forest needs training"):
        locate(request)


@pytest.mark.slow
def test_a_matcher_without_stored_answers_accepts_nothing(towns, pictures, tmp_path):
    found = locate(
        LocateRequest(
            pictures=pictures / "a.tif",
            out=towns,
            into=tmp_path,
            matcher="raster_soft",
            region=towns / "regions" / TOWN,
            is_sandboxed=False,
        )
    )
    (fix,) = found.fixes
    assert (fix.status, fix.is_accepted, fix.p_false) == ("withheld", False, None)
    assert "not calibrated" in fix.reason
    assert fix.lon is not None


def test_stored_answers_order_right_before_false():
    answers = answers_for("sasgeo", sgb.load_matcher("sasgeo").card.version, "osm_unet")
    assert answers is not None
    assert answers is shipped_answers()[0]
    chances = Chances.of(answers)
    p_false = np.array([chances.p_false(item) for item in answers.predictions()])
    false = answers.is_false
    assert p_false[false].mean() > 0.7
    assert p_false[~false].mean() < 0.3
    # the fit that is stored is that of these answers
    again = Chances.fitted(answers)
    np.testing.assert_allclose(again.rejector.p_false(answers.predictions()), p_false, rtol=1e-6, atol=1e-9)
    # a place that is left out changes the fit
    without = Chances.fitted(answers, without=[answers.places[0]])
    assert without.p_false(answers.predictions()[0]) != chances.p_false(answers.predictions()[0])
    assert answers_for("sasgeo", "0", "osm_unet") is None
    assert answers_for("sasgeo", answers.version, "colour_thresholds") is None


def test_an_answer_is_kept_for_its_own_words_alone(towns, pictures):
    request = LocateRequest(pictures=pictures, out=towns, into=Path("b"))
    manifest = locating.read_manifest(towns / "regions" / TOWN)

    def key(**change):
        return answer_key(replace(request, **change), manifest, ("same", "same"), pictures / "a.tif", "a.tif")

    changes = (
        {},
        {"matcher": "sasgeo_hard"},
        {"segmenter": "osm_unet_held_out"},
        {"radius_m": 250.0},
        {"near": (9.0, 47.0)},
        {"heading": (10.0, 5.0)},
        {"is_turned": True},
        {"told": Told(height_m=50.0)},
        {"told": Told(dem=pictures / "a.tif")},
        {"uses_position": False},
        {"most_false": 0.1},
    )
    keys = [key(**change) for change in changes]
    assert len(set(keys)) == len(changes)
    assert key() == keys[0]


def test_an_answer_says_why_it_is_withheld():
    prior = sgb.Prior(center_m=(0.0, 0.0), radius_m=500.0, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
    answer = Prediction(query_id="q", diagnostics={"modes_above": 3.0})
    how = {"side_m": 156.9, "most_false": 0.05}
    assert verdict(answer, 0.05, prior, **how) == ("found", "")
    assert verdict(answer, 0.3, prior, **how) == ("withheld", "2 other places within 500 m look alike")
    nowhere = ("not on this map", "no place within 500 m explains what is seen, taken as 157 m wide")
    assert verdict(answer, 0.9, prior, **how) == nowhere
    assert verdict(answer, None, prior, **how)[0] == "withheld"


FIXES = (
    Fix(
        file="<b>&.jpg",
        status="found",
        lon=9.5,
        lat=47.1,
        x_m=537_000.0,
        y_m=5_216_000.0,
        heading_deg=89.7,
        p_false=0.01,
        is_accepted=True,
        taken_at="2024-05-01T10:20:30",
        height_m=80.0,
        view=(537_000.0, 5_216_000.0, 90.0, 1.0),
    ),
    Fix(file="=1+1.jpg", status="withheld", lon=9.6, lat=47.2, p_false=0.5, heading_deg=1.0, reason="2 places, alike"),
    Fix(file="c.jpg", status="failed", reason="damaged"),
)


@pytest.fixture(scope="module")
def files(located, tmp_path_factory) -> Path:
    """The files about `FIXES`."""
    folder = tmp_path_factory.mktemp("files")
    write_results(replace(located[1], request=replace(located[1].request, into=folder), fixes=FIXES))
    return folder


def test_tables_hold_all_pictures_and_tracks_the_accepted_ones(files):
    rows = list(csv.DictReader(csv_text(FIXES).splitlines()))
    assert [row["file"] for row in rows] == ["<b>&.jpg", "'=1+1.jpg", "c.jpg"]
    assert rows[1]["reason"] == "2 places, alike"
    places = json.loads((files / "locate.geojson").read_text())
    assert [one["geometry"]["coordinates"] for one in places["features"]] == [[9.5, 47.1], [9.6, 47.2]]
    assert "OpenStreetMap" in places["attribution"]
    gpx = ET.fromstring((files / "locate.gpx").read_text())  # noqa: S314 - our own text
    space = "{http://www.topografix.com/GPX/1/1}"
    points = gpx.findall(f"{space}wpt")
    assert [(one.get("lat"), one.get("lon"), one.findtext(f"{space}name")) for one in points] == [
        ("47.1000000", "9.5000000", "<b>&.jpg")
    ]
    kml = ET.fromstring((files / "locate.kml").read_text())  # noqa: S314
    assert kml.find(".//{http://www.opengis.net/kml/2.2}coordinates").text == "9.5000000,47.1000000"


def test_a_trajectory_has_the_heading_as_scipy_reads_it(files):
    (head, line) = (files / "locate.tum").read_text().splitlines()
    assert head.startswith("#")
    numbers = np.array(line.split(), dtype=float)
    assert numbers[0] == 1714558830.0  # 2024-05-01 10:20:30 UTC
    assert numbers[1:4].tolist() == [537_000.0, 5_216_000.0, 80.0]
    ahead = Rotation.from_quat(numbers[4:]).apply([1.0, 0.0, 0.0])
    assert ahead == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)  # a heading of 90 degrees is east


def test_names_of_files_are_text_on_the_page(located):
    found = replace(located[1], fixes=FIXES)
    page = page_text(found)
    assert "<b>&.jpg" not in page
    assert "&lt;b&gt;&amp;.jpg" in page


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("--near", "47.1"), "--near is LON,LAT"),
        (("--near", "9.5,147.1"), "--near is longitude,latitude"),
        (("--heading", "north"), "--heading is DEG"),
        (("--heading", "10+-0"), "--heading is DEG"),
        (("--heading", "400"), "within -180 and 360"),
        (("--radius", "0"), "--radius lies within"),
        (("--height", "-5"), "height is above 0"),
        (("--most-false", "1"), "--most-false lies between"),
        (("--region", "nowhere"), "built are"),
    ],
)
def test_words_that_make_no_sense_end_in_one_line(mistake, pictures, towns, words, hint):
    assert hint in mistake("locate", pictures / "a.tif", "--out", towns, *words)


def test_a_line_of_a_fix_is_one_line():
    assert line_of(Fix(file="new\nline.jpg", status="failed", reason="damaged")) == "new line.jpg: failed: damaged"


def test_no_picture_is_one_line(mistake, tmp_path):
    assert "there is no picture or folder" in mistake("locate", tmp_path / "none.jpg")
    assert "holds no picture" in mistake("locate", tmp_path)


@pytest.mark.parametrize("yaw_deg", [None, 40.0])
def test_the_disc_of_a_tilted_view_holds_its_middle_wherever_the_camera_stood(yaw_deg):
    sigma_deg = None if yaw_deg is None else 10.0
    prior = sgb.Prior(center_m=(5.0, 7.0), radius_m=100.0, yaw_deg=yaw_deg, yaw_sigma_deg=sigma_deg, scale_sigma=0.1)
    view = locating.prior_of_view(prior, (3.0, 60.0))
    rng = np.random.default_rng(2)
    for _ in range(500):
        turn, far_m = rng.uniform(0, 2 * np.pi), 100.0 * np.sqrt(rng.random())
        heading = np.radians(rng.uniform(0, 360) if yaw_deg is None else yaw_deg + rng.uniform(-30, 30))
        east_m = 5.0 + far_m * np.cos(turn) + 3.0 * np.cos(heading) + 60.0 * np.sin(heading)
        north_m = 7.0 + far_m * np.sin(turn) - 3.0 * np.sin(heading) + 60.0 * np.cos(heading)
        assert np.hypot(east_m - view.center_m[0], north_m - view.center_m[1]) <= view.radius_m + 1e-6
    assert view.radius_m < 161.0
    assert locating.prior_of_view(prior, (0.0, 0.0)) is prior
