# SPDX-License-Identifier: Apache-2.0
"""What a region file may say, and what is told where it may not."""

import datetime as dt

import pytest

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions import region_spec
from sasgeo_bench.regions.region_spec import OWN_FOLDER, RegionFile, find_region_file

EXTRACT = f'[[extract]]\nfile = "a.osm.pbf"\ndate = 2020-01-01\nsha256 = ["{"0" * 64}"]\n'


def text(place: str = "center_lonlat = [9.0, 47.0]\nsize_m = [100, 100]", *, cell: str = "1.0", more: str = "") -> str:
    head = f'id = "mine"\ntitle = "Mine"\nscenes = ["urban"]\n{place}\ncell_size_m = {cell}\n{more}\n'
    return head + EXTRACT


def read(content: str) -> RegionFile:
    return parse_toml(content, RegionFile, source="mine.toml")


def fault(content: str) -> str:
    with pytest.raises(ConfigError) as caught:
        read(content)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_centre_and_a_size_make_a_grid_of_that_size_around_it_and_bounds_one_that_covers_them():
    grid = read(text()).grid()
    assert grid.epsg == 32632
    assert grid.shape == (100, 100)
    assert abs(grid.west_m + 50 - 500_000) < 1
    assert read(text("center_lonlat = [18.4, -33.9]\nsize_m = [100, 100]")).grid().epsg == 32734
    grid = read(text("bounds_lonlat = [9.0, 47.0, 9.01, 47.01]")).grid()
    west, south, east, north = grid.bounds_m
    assert 750 < east - west < 780
    assert 1100 < north - south < 1125


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("bounds_lonlat = [9.1, 47.0, 9.0, 47.1]", "west 9.1 > east 9.0"),
        ("bounds_lonlat = [179.9, 47.0, -179.9, 47.1]", "antimeridian"),
        ("center_lonlat = [180.0, -16.83]\nsize_m = [1024, 1024]", "over the antimeridian must be split in two"),
        ("center_lonlat = [179.999, 0.0]\nsize_m = [512, 64]\nepsg = 32601", "must be split in two"),
        ("bounds_lonlat = [9.0, 47.1, 9.1, 47.0]", "swap"),
        ("bounds_lonlat = [9.0, 84.5, 9.1, 84.6]", "84"),
        ("bounds_lonlat = [9.0, 47.0, 9.0, 47.1]", "positive size"),
        ("bounds_lonlat = [nan, 47.0, 9.0, 47.1]", "within -180..180"),
        ("center_lonlat = [190.0, 47.0]\nsize_m = [100, 100]", "within -180..180"),
        ("bounds_lonlat = [0.0, 40.0, 12.0, 50.0]", "make it smaller"),
        ("center_lonlat = [9.0, 47.0]\nsize_m = [1e6, 1e6]", "GB each"),
        ("center_lonlat = [9.0, 47.0]\nsize_m = [-5, 100]", "positive"),
        ("center_lonlat = [9.0, 47.0]", "either by center_lonlat and size_m, or by bounds_lonlat"),
        ("", "either by"),
    ],
)
def test_a_place_that_is_none_is_refused_with_the_mend(place, words):
    assert words in fault(text(place))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (text(more="epsg = 4326"), "not a projected CRS in metres"),
        (text(more="epsg = 999999"), "unknown"),
        (text(more="epsg = 3857"), "epsg 3857 stretches this place by 1.4"),  # a web map, whose 400 m are 268 m
        (text(more="epsg = 5041"), "epsg 5041 stretches this place by"),  # the pole's
        (text(more="coverage_lonlat = [[9.0, 47.0], [9.1, 47.0]]"), "at least 3"),
        (text(more="cell_sise = 3"), "unknown key 'cell_sise'"),
        *((text(cell=cell), "cell_size_m must lie between") for cell in ("0.0", "-1.0", "nan", "inf", "1e6")),
        (text().replace(f'sha256 = ["{"0" * 64}"]', ""), "needs either sha256"),
        (text().replace("0" * 64, "0" * 63), "sha256"),
        (text().replace("a.osm.pbf", "../a.osm.pbf"), "without folders"),
        (text() + EXTRACT, "two extracts have the date 2020-01-01"),
    ],
)
def test_other_faults_are_reported_in_one_line(content, words):
    assert words in fault(content)


def test_the_newest_extract_is_picked_and_any_by_its_date():
    region = read(text() + EXTRACT.replace("2020", "2022"))
    assert region.pick(None).date == dt.date(2022, 1, 1)
    assert region.pick(dt.date(2020, 1, 1)).date == dt.date(2020, 1, 1)
    with pytest.raises(ConfigError, match="2020-01-01, 2022-01-01"):
        region.pick(dt.date(2021, 1, 1))


def test_a_region_that_new_region_wrote_is_found_by_its_name_after_those_of_the_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"there is no region 'my-town' \(list regions or new-region\)"):
        find_region_file("my-town")
    own = OWN_FOLDER / "my-town.toml"
    own.parent.mkdir()
    own.write_text(text().replace('"mine"', '"my-town"'), encoding="utf-8")
    assert find_region_file("my-town") == own
    with pytest.raises(ConfigError, match="there is no region 'my-twn', did you mean 'my-town'"):
        find_region_file("my-twn")
    other = tmp_path / "others" / "my-town.toml"
    other.parent.mkdir()
    other.write_text(own.read_text(encoding="utf-8"), encoding="utf-8")
    assert find_region_file("my-town", folders=[other.parent]) == other
    (OWN_FOLDER / "vaduz.toml").write_text(text().replace('"mine"', '"vaduz"'), encoding="utf-8")
    assert find_region_file("vaduz") != OWN_FOLDER / "vaduz.toml"


def test_a_region_that_ships_is_found_without_reading_the_others(monkeypatch):
    expected = region_spec.list_region_files()
    monkeypatch.setattr(region_spec, "list_region_files", None)
    assert find_region_file("vaduz") == expected["vaduz"]
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="there is no region"):
        find_region_file("../regions/vaduz")


def test_lines_of_provenance_are_written_in_the_order_of_their_fields():
    stated = '[provenance]\nsource = "a"\ndated_by = "b"\ncountry = "c"\nsurveyed_by = "d"\n'
    assert list(read(text() + stated).origin.model_dump()) == ["surveyed_by", "country", "dated_by", "source"]
