# SPDX-License-Identifier: Apache-2.0
"""Folders of other datasets are read as they are laid out, and refused in one line where they are not."""

import datetime as dt
import os
import re
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.exchange.importers.items import Attitude, Box, Dataset, Item, Position, UtmPlaces
from sasgeo_bench.exchange.importers.kinds import IMPORTERS, read_dataset
from sasgeo_bench.exchange.importers.reader import MapSheet, cut_tiles
from sasgeo_bench.exchange.importers.retrieval import geodesic_m
from tests.exchange.importers import writers

PLACES = {"000000": (120.38, 30.32), "000001": (120.381, 30.32), "002256": (119.5, 29.1)}
WRITERS = {
    "university-1652": writers.write_university,
    "sues-200": writers.write_sues,
    "dense-uav": lambda root: writers.write_dense(root, PLACES),
    "uav-visloc": writers.write_visloc,
}


def by_id(dataset: Dataset) -> dict[str, Item]:
    return {item.item_id: item for item in dataset.items}


@pytest.fixture(params=list(IMPORTERS))
def kind(request):
    return request.param


@pytest.fixture
def folder(kind, tmp_path):
    return WRITERS[kind](tmp_path / "set")


def refusal(kind, folder):
    """The one line that a bad folder gets."""
    with pytest.raises(DatasetError) as fault:
        read_dataset(folder, kind)
    line = str(fault.value)
    assert line.isprintable()
    assert len(line) < 500
    return line


# What each holds


def test_university_has_labels_and_no_place_and_large_images_are_queries_of_a_view_of_their_own(tmp_path):
    root = writers.write_university(tmp_path)
    dataset = read_dataset(root, "university-1652")
    items = by_id(dataset)
    assert [dataset.count(role) for role in ("query", "gallery", "train")] == [5, 6, 1]
    assert items["test/query_drone/0000/image-02.jpeg"].label == "0000"
    assert items["train/street/0009/1.jpg"].view == "street"
    assert {(item.position, item.height_m, item.attitude) for item in dataset.items} == {(None, None, None)}
    writers.put(root / "test" / "4K_drone" / "0001" / "a.jpg")
    item = by_id(read_dataset(root, "university-1652"))["test/4K_drone/0001/a.jpg"]
    assert (item.role, item.view) == ("query", "drone_4k")


def test_sues_has_a_height_for_each_drone_and_raw_says_not_what_is_a_query(tmp_path):
    items = by_id(read_dataset(writers.write_sues(tmp_path / "split"), "sues-200"))
    drone, satellite = (items[f"Testing/300/gallery_{view}/0001/0.jpg"] for view in ("drone", "satellite"))
    assert (drone.height_m, drone.group, satellite.height_m, satellite.group) == (300.0, "300", None, "300")
    assert items["Training/150/drone/0003/0.jpg"].role == "train"
    dataset = read_dataset(writers.write_sues_raw(tmp_path / "raw"), "sues-200")
    assert {item.role for item in dataset.items} == {"unsplit"}
    assert by_id(dataset)["drone_view_512/0200/250/0.jpg"].height_m == 250.0
    assert any("split_datasets.py" in note for note in dataset.notes)


def test_dense_uav_gives_longitude_before_latitude_whatever_its_readme_says(tmp_path):
    item = by_id(read_dataset(writers.write_dense(tmp_path, PLACES), "dense-uav"))["test/query_drone/002256/H80.JPG"]
    assert item.position == Position(longitude_deg=119.5, latitude_deg=29.1)
    assert item.height_m == 80.0  # of its name; the file's own height has no datum


def test_of_several_lines_of_a_label_the_last_counts_and_a_note_says_so(tmp_path):
    root = writers.write_dense(tmp_path, {"000000": (120.0, 30.0)})
    lines = "a/000000/H80.JPG E120.0 N30.0\r\na\\000000\\H90.JPG  E120.001 N30.0 90"  # may lack a height
    writers.put(root / "Dense_GPS_ALL.txt", lines)
    dataset = read_dataset(root, "dense-uav")
    assert {item.position for item in dataset.items} == {Position(longitude_deg=120.001, latitude_deg=30.0)}
    assert any(note.startswith("1 label with lines") for note in dataset.notes)


def test_visloc_has_angles_where_its_table_has_them_and_tells_what_it_leaves_out(tmp_path):
    root = writers.write_visloc(tmp_path)
    writers.put(root / "01" / "drone" / "01_0099.JPG")
    dataset = read_dataset(root, "uav-visloc")
    frame = by_id(dataset)["01/drone/01_0001.JPG"]
    assert frame.position == Position(longitude_deg=116.005, latitude_deg=29.715)
    assert frame.attitude == Attitude(heading_deg=350.0, pitch_deg=1.5, roll_deg=-2.5)
    assert (frame.height_m, frame.taken_on, frame.group) == (520.5, dt.date(2018, 10, 13), "01")
    # The second-last column is Phi1 where there are ten columns, and the longitude where there are six.
    assert by_id(dataset)["07/drone/07_0001.JPG"].attitude is None
    assert any(note.startswith("1 flight (07) with frames without angles") for note in dataset.notes)
    assert {item.group for item in dataset.items} == {"01", "07"}
    assert "left out 1 map (satellite12.tif) of flights without a folder" in dataset.notes
    assert "left out 1 x image of 01/drone without a row in 01/01.csv" in dataset.notes


def test_a_flight_without_a_row_for_its_map_has_queries_alone(tmp_path):
    root = writers.write_visloc(tmp_path)
    writers.write_flight(root, "09", [(116.0, 29.7)])
    dataset = read_dataset(root, "uav-visloc")
    assert [item.role for item in dataset.items if item.group == "09"] == ["query"]
    assert any(note.startswith("1 flight (09) without a map") for note in dataset.notes)


def test_a_flight_may_have_a_map_in_parts(tmp_path):
    root = tmp_path / "set"
    writers.write_flight(root, "09", [(116.005, 29.715)])
    writers.write_maps(root, {"09_01-01": writers.BOX, "09_01-02": writers.BOX}, size=(1024, 1024))
    tiles = [item for item in read_dataset(root, "uav-visloc").items if item.role == "gallery"]
    assert {item.item_id[:8] for item in tiles} == {"09_01-01", "09_01-02"}
    assert {item.group for item in tiles} == {"09"}


PARTS = {"01-01": (1100, 700), "01-02": (948, 700), "02-01": (1100, 324), "02-02": (948, 324)}


def in_parts(root: Path, parts: dict[str, tuple[int, int]]) -> Path:
    """The set as it is published: the table has one map of flight 09, and its folder has it in parts."""
    writers.write_flight(root, "09", [(116.005, 29.715)])
    writers.write_maps(root, {"09": writers.BOX}, size=(1, 1))
    (root / "09" / "satellite09.tif").unlink()
    for name, size in parts.items():
        writers.write_tiff(root / "09" / f"satellite09_{name}.tif", *size)
    return root


def test_a_map_in_parts_with_one_row_in_the_table_is_their_mosaic(tmp_path):
    found = read_dataset(in_parts(tmp_path / "parts", PARTS), "uav-visloc")
    whole = tmp_path / "whole"
    writers.write_flight(whole, "09", [(116.005, 29.715)])
    writers.write_maps(whole, {"09": writers.BOX}, size=(2048, 1024))
    assert found.items == read_dataset(whole, "uav-visloc").items
    assert found.count("gallery") == 10
    assert "1 map (09/satellite09.tif) in parts: each is read as the mosaic of its parts" in found.notes


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"02-01": None}, "09/satellite09.tif is in parts, and 1 part (_02-01) is missing"),
        ({"02-02": (948, 300)}, "sizes that make no grid"),
        (dict.fromkeys(PARTS), "holds no 09/satellite09.tif"),
        ({"03-01": (5, 5)}, "1 part (_03-02) is missing"),
    ],
)
def test_parts_that_make_no_map_are_refused(changed, expected, tmp_path):
    parts = {name: size for name, size in (PARTS | changed).items() if size}
    assert expected in refusal("uav-visloc", in_parts(tmp_path, parts))


def test_the_table_of_maps_may_have_a_space_in_its_name(tmp_path):
    root = writers.write_visloc(tmp_path)
    (root / "satellite_coordinates_range.csv").rename(root / "satellite_ coordinates_range.csv")
    assert read_dataset(root, "uav-visloc").count("gallery") == 20


def test_tiles_cover_their_map_and_are_placed_by_their_zoom():
    box = Box(west_deg=116.0, south_deg=29.70, east_deg=116.04, north_deg=29.72)
    tiles = {
        tile.item_id: tile
        for tile in cut_tiles(MapSheet(name="01", flight="01", box=box, width_px=2048, height_px=1024))
    }
    assert sorted(tiles) == [
        *(f"01_1_{column:03}_000.png" for column in range(2)),
        *(f"01_2_{column:03}_{row:03}.png" for column in range(4) for row in range(2)),
    ]
    corner = tiles["01_2_003_001.png"]
    assert corner.box is not None
    edges = (corner.box.west_deg, corner.box.south_deg, corner.box.east_deg, corner.box.north_deg)
    np.testing.assert_allclose(edges, (116.03, 29.70, 116.04, 29.71), atol=1e-12)
    small = MapSheet(name="01", flight="01", box=box, width_px=200, height_px=100)
    assert list(cut_tiles(small)) == []  # of one tile: none as released


# Places


@given(st.floats(-179.9, 179.9), st.floats(-79.9, 83.9))
def test_distances_in_the_grid_are_those_on_the_ellipsoid(longitude_deg, latitude_deg):
    # Metres of longitude times the cosine of each frame's own latitude shear a flight: here 100 m stay 100 m.
    there_deg = latitude_deg - 0.001 if latitude_deg > 0 else latitude_deg + 0.001
    pair = [Position(longitude_deg=longitude_deg, latitude_deg=place) for place in (latitude_deg, there_deg)]
    found = UtmPlaces.of(pair)
    if found.epsg[0] == found.epsg[1]:
        grid_m = np.hypot(np.diff(found.easting_m), np.diff(found.northing_m))
        true_m = geodesic_m(*(np.array([place.longitude_deg, place.latitude_deg]) for place in pair))
        np.testing.assert_allclose(grid_m, true_m, rtol=2e-3)


def test_a_straight_flight_north_stays_straight():
    latitudes = np.linspace(29.0, 31.0, 21)
    flight = UtmPlaces.of([Position(longitude_deg=116.0, latitude_deg=float(each)) for each in latitudes])
    line = np.polyfit(flight.northing_m, flight.easting_m, 1)
    off_m = flight.easting_m - np.polyval(line, flight.northing_m)
    sheared_m = np.radians(116.0) * 6_378_137 * np.cos(np.radians(latitudes))
    assert np.abs(off_m).max() < 15.0
    assert np.ptp(sheared_m) > 200_000.0  # what two published trajectories have


@pytest.mark.parametrize(("longitude", "latitude"), [(181.0, 0.0), (0.0, 84.1), (float("nan"), 0.0), (0.0, -90.0)])
def test_what_is_no_place_is_refused(longitude, latitude):
    with pytest.raises(DatasetError, match="is no place"):
        Position(longitude_deg=longitude, latitude_deg=latitude)


def test_headings_come_into_one_turn():
    turned = {-10.0: 350.0, 360.0: 0.0, 725.0: 5.0, -1e-20: 0.0}
    assert {value: Attitude(heading_deg=value).heading_deg for value in turned} == turned


# Bad folders


def test_there_must_be_a_folder_which_is_told_what_it_should_hold(kind, tmp_path):
    line = refusal(kind, tmp_path)
    assert "is empty" in line
    assert IMPORTERS[kind].layout in line
    assert "there is no folder" in refusal(kind, tmp_path / "nowhere")
    assert "there is no folder" in refusal(kind, writers.put(tmp_path / "file.zip"))


NEEDED = {
    "university-1652": ("test/query_drone", "test/gallery_satellite", "test/query_satellite", "test/gallery_drone"),
    "sues-200": ("Testing/150/query_drone", "Testing/300/gallery_satellite"),
    "dense-uav": ("Dense_GPS_ALL.txt", "test/query_drone", "test/gallery_satellite"),
    "uav-visloc": ("satellite_coordinates_range.csv", "01/01.csv", "01/drone", "01/satellite01.tif", "07/07.csv"),
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in NEEDED.items() for name in names])
def test_what_is_missing_is_named(kind, name, tmp_path):
    root = WRITERS[kind](tmp_path / "set")
    path = root / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert f"holds no {name}: " in refusal(kind, root)


def test_the_folder_of_another_kind_is_refused(kind, tmp_path):
    for other, write in WRITERS.items():
        if {kind, other} == {"university-1652", "dense-uav"}:
            continue  # they share a layout, and differ in the digits of their labels: below
        if other != kind:
            assert "holds no" in refusal(kind, write(tmp_path / other))


@pytest.mark.parametrize("name", ["a", "00001", "\uff11\uff12\uff13\uff14", "0a00"])
def test_a_folder_that_is_no_label_is_refused(name, tmp_path):
    root = writers.write_university(tmp_path)
    writers.put(root / "test" / "query_drone" / name / "0.jpg")
    assert f"{name} is not named by a label of 4 digits" in refusal("university-1652", root)


def test_a_label_has_its_digits_and_an_image_and_an_image_a_byte(tmp_path):
    root = writers.write_university(tmp_path)
    (root / "test" / "query_drone" / "0005").mkdir()
    assert "test/query_drone/0005 holds no image" in refusal("university-1652", root)
    writers.put(root / "test" / "query_drone" / "0005" / "0.jpg", b"")
    assert "test/query_drone/0005/0.jpg is an empty file" in refusal("university-1652", root)
    root = WRITERS["dense-uav"](tmp_path / "dense")
    assert "test/query_drone/000000 is not named by a label of 4 digits" in refusal("university-1652", root)


def test_other_files_are_left_out_and_counted(tmp_path):
    root = writers.write_university(tmp_path)
    for name in ("Thumbs.db", "a.txt", ".DS_Store"):
        writers.put(root / "test" / "query_drone" / "0000" / name)
    (root / "test" / "query_drone" / "0000" / "more.jpg").mkdir()
    dataset = read_dataset(root, "university-1652")
    assert dataset.count("query") == 5
    assert dataset.notes == (
        "left out 1 x entry among images that is no file",
        "left out 2 x file that is no image by its name",
    )


@pytest.mark.parametrize("name", ["a\nb.jpg", "\x1b[31m.jpg", "\u202egpj.jpg", os.fsdecode(b"\xff.jpg")])
def test_a_name_that_is_no_printable_line_is_refused(name, tmp_path):
    root = writers.write_university(tmp_path)
    writers.put(root / "test" / "query_drone" / "0000" / name)
    assert "holds a name that is no printable line" in refusal("university-1652", root)


@pytest.mark.parametrize("name", ["<b>.jpg", "=1+1.jpg", "[red]a|b.jpg", 'a b\'s "c".jpg', "日本.jpg"])
def test_markup_in_a_name_is_text(name, tmp_path):
    root = writers.write_university(tmp_path)
    writers.put(root / "test" / "query_drone" / "0000" / name)
    assert f"test/query_drone/0000/{name}" in by_id(read_dataset(root, "university-1652"))


@pytest.mark.parametrize(
    "place", ["test/query_drone/0000/link.jpg", "test/query_drone/0003", "test/4K_drone", "train/drone"]
)
def test_a_link_that_leads_out_of_the_folder_is_refused(place, tmp_path):
    root = writers.write_university(tmp_path / "set")
    outside = writers.put(tmp_path / "outside" / "0000" / "secret.jpg")
    target = outside if place.endswith(".jpg") else outside.parents[1]
    (root / place).parent.mkdir(exist_ok=True)
    (root / place).symlink_to(target)
    assert f"{place} is a link that leads out" in refusal("university-1652", root)


@pytest.mark.parametrize("name", ["Dense_GPS_ALL.txt", "test"])
def test_no_table_and_no_folder_is_a_link_out(name, tmp_path):
    root = WRITERS["dense-uav"](tmp_path / "set")
    (root / name).rename(tmp_path / "elsewhere")
    (root / name).symlink_to(tmp_path / "elsewhere")
    assert "is a link that leads out" in refusal("dense-uav", root)


def test_a_link_within_the_folder_and_one_to_it_are_followed(tmp_path):
    root = writers.write_university(tmp_path / "set")
    (root / "test" / "query_street").symlink_to(root / "test" / "query_drone")
    (tmp_path / "alias").symlink_to(root)
    assert read_dataset(tmp_path / "alias", "university-1652").count("query") == 8


def test_a_circle_of_links_is_no_bug_of_ours(tmp_path):
    root = writers.write_university(tmp_path / "set")
    one, two = (root / "test" / "query_drone" / "0000" / name for name in ("a.jpg", "b.jpg"))
    one.symlink_to(two)
    two.symlink_to(one)
    with suppress(DatasetError):
        assert read_dataset(root, "university-1652").count("query") == 5


@pytest.mark.parametrize(
    "content", [b"\x00\xff\xfe" * 50, b"", b"PK\x03\x04" + bytes(range(256)), b"\n\n", b'"' * 200_000]
)
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("dense-uav", "Dense_GPS_ALL.txt"),
        ("uav-visloc", "satellite_coordinates_range.csv"),
        ("uav-visloc", "01/01.csv"),
        ("uav-visloc", "01/satellite01.tif"),
    ],
)
def test_rubbish_in_the_place_of_a_table_or_map_is_refused(kind, name, content, tmp_path):
    root = WRITERS[kind](tmp_path / "set")
    (root / name).write_bytes(content)
    assert name in refusal(kind, root)


def test_a_picture_that_only_names_another_file_is_no_map(tmp_path):
    root = writers.write_visloc(tmp_path / "set")
    virtual = '<VRTDataset rasterXSize="2048" rasterYSize="1024"></VRTDataset>'
    writers.put(root / "01" / "satellite01.tif", virtual)
    assert "01/satellite01.tif is no TIFF" in refusal("uav-visloc", root)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("a/000000/H80.JPG N30.0 E120.0", "expected '<folder>/<label>/<image> E<longitude> N<latitude> [height]'"),
        ("a/000000/H80.JPG E120.0 N30.0 80 90", "expected '<folder>/<label>/<image>"),
        ("a/000000/H80.JPG E120.0 N30.0 high", "line 1, height: expected a number, got 'high'"),
        ("a/000000/H80.JPG Enan N30.0", "line 1, longitude: expected a number, got 'nan'"),
        ("a/000000/H80.JPG E30.0 N120.0", "are the two swapped?"),
        ("a/000000/H80.JPG E181.0 N30.0", "line 1: longitude 181.0, latitude 30.0 is no place"),
        ("a/000009/H80.JPG E120.0 N30.0", "has no line for the label of test/query_drone/000000/H80.JPG"),
        ("<script>\x1b[31m" * 40, "expected '<folder>"),
    ],
)
def test_a_wrong_line_of_dense_uav_is_named(line, expected, tmp_path):
    root = writers.write_dense(tmp_path, {"000000": (120.0, 30.0)})
    writers.put(root / "Dense_GPS_ALL.txt", line)
    fault = refusal("dense-uav", root)
    assert expected in fault
    assert "Dense_GPS_ALL.txt" in fault


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("num,filename", "filename,filename", "01/01.csv has two columns of one name"),
        (",520.5,", ",tall,", "line 2, height: expected a number, got 'tall'"),
        (",520.5,", ",1e9,", "heights lie within -1000..30000 m"),
        (",520.5,", ",520.5,1,", "01/01.csv line 2 has 11 cells, its first line 10"),
        (",29.715,", ",91.0,", "01/01.csv line 2: longitude 116.005, latitude 91.0 is no place"),
        (",29.715,116.005,", ",116.005,29.715,", "are the two swapped?"),
        (",350.0,", ",inf,", "line 2, Phi1: expected a number, got 'inf'"),
        ("01_0001.JPG", "01_0009.JPG", "01/drone holds no '01_0009.JPG', which 01/01.csv line 2 names"),
        ("01_0001.JPG", "../drone/01_0001.JPG", "01/drone holds no '../drone/01_0001.JPG'"),
        ("01_0001.JPG", "01_0002.JPG", "line 3: '01_0002.JPG' has a row already"),
    ],
)
def test_a_wrong_table_of_a_flight_is_named(old, new, expected, tmp_path):
    root = writers.write_visloc(tmp_path)
    table = root / "01" / "01.csv"
    table.write_text(table.read_text().replace(old, new, 1))
    assert expected in refusal("uav-visloc", root)
    writers.put(table, writers.FRAME_COLUMNS + "\n\n")
    assert "01/01.csv names no frame" in refusal("uav-visloc", root)


def test_an_angle_may_be_missing_and_a_date_wrong(tmp_path):
    root = writers.write_visloc(tmp_path)
    table = root / "01" / "01.csv"
    table.write_text(table.read_text().replace("350.0", "", 1).replace("2018-10-13", "autumn", 1))
    dataset = read_dataset(root, "uav-visloc")
    frame = by_id(dataset)["01/drone/01_0001.JPG"]
    assert (frame.attitude, frame.taken_on) == (Attitude(pitch_deg=1.5, roll_deg=-2.5), None)
    assert any(note.startswith("1 frame without a date") for note in dataset.notes)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("satellite01.tif", "../../etc.tif", "expected a map named satelliteNN.tif, got '../../etc.tif'"),
        ("29.72,116.0,29.7,116.04", "29.7,116.0,29.72,116.04", "LT is the north-west corner"),
        ("29.72,116.0,", "29.72,216.0,", "longitude 216.0, latitude 29.72 is no place"),
        ("RB_lat_map", "south", "has no column 'RB_lat_map'"),
    ],
)
def test_a_wrong_row_of_the_table_of_maps_is_named(old, new, expected, tmp_path):
    root = writers.write_visloc(tmp_path)
    table = root / "satellite_coordinates_range.csv"
    table.write_text(table.read_text().replace(old, new, 1))
    assert expected in refusal("uav-visloc", root)


def test_an_unknown_kind_is_told_those_there_are(tmp_path):
    with pytest.raises(DatasetError, match=re.escape("did you mean 'uav-visloc'? There are university-1652, ")):
        read_dataset(tmp_path, "visloc")


def test_nothing_in_a_folder_is_changed(kind, folder):
    before = snapshot(folder)
    read_dataset(folder, kind)
    assert snapshot(folder) == before


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        path.relative_to(folder).as_posix(): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in sorted(folder.rglob("*"))
    }
