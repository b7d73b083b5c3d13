# SPDX-License-Identifier: Apache-2.0
"""A place becomes a region file in one command, by the newest extract that covers it, or a line says what to get."""

import datetime as dt
import json
import math
import shutil
from dataclasses import replace

import numpy as np
import osmium
import pytest
import rasterio
from PIL import ExifTags, Image

from sasgeo_bench.core.errors import ConfigError, ExtractError, StoreError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.osm.synthetic.town import TownPlan, write_town
from sasgeo_bench.regions import new_region as one_region
from sasgeo_bench.regions.new_region import Days, Place, list_at_hand, new_region
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.regions.region_spec import read_region_file

LON, LAT = 9.5, 47.1
PLACE = Place.around(f"{LON},{LAT}", "300m")
OLD, NEW = "garden-2015-01-01.osm.pbf", "garden-2020-01-01.osm.pbf"


@pytest.fixture(scope="module")
def garden(tmp_path_factory):
    """One town at two dates; read them, do not write to them."""
    folder = tmp_path_factory.mktemp("extracts")
    plan = TownPlan(morphology="suburb", seed=3, size_m=900.0, center_lonlat=(LON, LAT))
    for name in (OLD, NEW):
        write_town(plan, folder / name, on=dt.date.fromisoformat(name[7:17]))
    return folder


@pytest.fixture(autouse=True)
def alone(tmp_path, monkeypatch):
    """No extracts but those of a test."""
    monkeypatch.delenv("SASGEO_EXTRACTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no-cache"))


def copied(source, target, *, time=None, has_box=True):
    """Write an extract without its header, or with another one."""
    header = osmium.io.Header()
    if time:
        header.set("osmosis_replication_timestamp", time)
    if has_box:
        box = osmium.io.Reader(str(source)).header().box()
        header.add_box(box)
    with osmium.SimpleWriter(str(target), header=header) as writer:
        for item in osmium.FileProcessor(str(source)):
            writer.add(item)
    return target


def told(work):
    lines = []
    with reporting(lines.append):
        work()
    return "\n".join(lines)


# What the words of a user mean


@pytest.mark.parametrize(
    ("size", "size_m"),
    [
        ("2km", (2000.0, 2000.0)),
        ("800m", (800.0, 800.0)),
        ("2x3km", (2000.0, 3000.0)),
        ("0.5 x 1.5 km", (500.0, 1500.0)),
    ],
)
def test_a_size_is_one_side_or_width_and_height(size, size_m):
    assert Place.around("9.5,47.1", size).size_m == size_m


@pytest.mark.parametrize("size", ["2", "km", "-2km", "2miles", "2x3x4km", "1e9km", ""])
def test_any_other_size_is_refused(size):
    with pytest.raises(ConfigError, match="size is such as 2km, 800m or 2x3km"):
        Place.around("9.5,47.1", size)


@pytest.mark.parametrize("text", ["9.5", "9.5,47.1,3", "nine,47", "nan,47", "", "9.5;47.1"])
def test_a_centre_that_is_none_is_refused(text):
    with pytest.raises(ConfigError, match="LON,LAT are degrees, such as"):
        Place.around(text, "2km")


@pytest.mark.parametrize("made", [lambda: Place.around("47.1,109.5", "2km"), lambda: Place.within("47,109,48,110")])
def test_a_latitude_of_more_than_90_degrees_is_told_to_be_a_longitude(made):
    with pytest.raises(ConfigError, match="longitude comes first"):
        made()


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        ("2020", (2020, 1, 1), (2020, 12, 31)),
        ("2019-02", (2019, 2, 1), (2019, 2, 28)),
        ("2020-03-04", (2020, 3, 4), (2020, 3, 4)),
    ],
)
def test_a_date_is_a_year_a_month_or_a_day(text, first, last):
    days = Days.read(text)
    assert (days.first, days.last) == (dt.date(*first), dt.date(*last))
    assert [days.away(day) for day in (days.first, days.last)] == [0, 0]
    assert days.away(days.first - dt.timedelta(days=3)) == days.away(days.last + dt.timedelta(days=3)) == 3


@pytest.mark.parametrize("text", ["2020-13", "20", "2020-02-30", "0000", "2020-1-1", "soon"])
def test_any_other_date_is_refused(text):
    with pytest.raises(ConfigError, match="date is YYYY, YYYY-MM or YYYY-MM-DD"):
        Days.read(text)


def test_the_place_of_points_has_500_m_around_them():
    east_deg = 1000 / 111_320 / math.cos(math.radians(LAT))
    place = Place.of_points(np.array([[LON, LAT], [LON + east_deg, LAT], [LON + east_deg / 2, LAT]]))
    assert place.size_m == pytest.approx((2000, 1000), abs=12)  # the grid is turned by its convergence
    assert place.center_lonlat == pytest.approx((LON + east_deg / 2, LAT), abs=2e-5)


def test_points_in_two_towns_are_refused_and_both_are_named_and_a_chain_of_points_is_one_place():
    chain = np.column_stack([np.full(4, LON), LAT + np.arange(4) * 0.08])  # 8.9 km each
    assert Place.of_points(chain).size_m[1] == pytest.approx(3 * 0.08 * 111_200 + 1000, abs=60)
    with pytest.raises(ConfigError, match=r"2 places .* 1 photo near \[8.0, 47.1\]; 2 photos near \[9.5, 47.1\]"):
        Place.of_points(np.array([[LON, LAT], [8.0, LAT], [LON, LAT]]))


# Which extract is taken


def test_the_newest_extract_is_taken_or_the_one_nearest_to_a_date(garden, tmp_path):
    newest = new_region("mine", PLACE, into=tmp_path / "a", folders=[garden])
    asked = new_region("mine", PLACE, into=tmp_path / "b", folders=[garden], days=Days.read("2017-06"))
    for path, file in ((newest, NEW), (asked, OLD)):
        spec = read_region_file(path)
        assert [item.file for item in spec.extract] == [file]
        assert spec.extract[0].sha256 == (sha256_of(garden / file),)
        assert spec.extract[0].date == dt.date.fromisoformat(file[7:17])
        assert spec.provenance.dated_by == "name of the file"
        assert spec.size_m == (300.0, 300.0)


def test_a_date_is_known_by_header_then_name_then_newest_object(garden, tmp_path):
    copied(garden / NEW, tmp_path / "a-2001-01-01.osm.pbf", time="2016-05-04T10:00:00Z")
    copied(garden / NEW, tmp_path / "b-190203.osm.pbf", has_box=False)
    copied(garden / NEW, tmp_path / "c.osm.pbf", has_box=False)
    newest = max(item.timestamp for item in osmium.FileProcessor(str(garden / NEW))).date()
    found = {item.path.name[0]: item for item in list_at_hand([tmp_path])}
    assert {name: (item.date, item.date_known_by) for name, item in found.items()} == {
        "a": (dt.date(2016, 5, 4), "header of the file"),
        "b": (dt.date(2019, 2, 3), "name of the file"),
        "c": (newest, "newest object"),
    }
    places = np.array(
        [(item.lon, item.lat) for item in osmium.FileProcessor(str(garden / NEW), osmium.osm.NODE)], dtype=float
    )
    for name in "bc":
        assert found[name].boxes == ((*places.min(axis=0), *places.max(axis=0)),)


def test_a_history_is_of_any_day_before_its_last(garden, tmp_path):
    shutil.copy(garden / OLD, tmp_path / OLD)
    shutil.copy(garden / NEW, tmp_path / "past-2020-01-01.osh.pbf")
    days = Days.read("2018-03")
    (first, second) = list_at_hand([tmp_path], days=days)
    assert (first.path.name, first.date) == ("past-2020-01-01.osh.pbf", dt.date(2018, 3, 31))
    assert (second.path.name, second.date) == (OLD, dt.date(2015, 1, 1))
    assert [item.date.year for item in list_at_hand([tmp_path])] == [2020, 2015]


def test_an_extract_of_a_part_is_taken_only_if_none_covers_the_place_and_its_share_is_said(garden, tmp_path):
    half = TownPlan(morphology="suburb", seed=4, size_m=900.0, center_lonlat=(LON + 900 / 75_900, LAT))
    write_town(half, tmp_path / "half-2024-01-01.osm.pbf")
    place = Place.around(f"{LON + 450 / 75_900},{LAT}", "400m")  # on the edge of both
    lines = told(lambda: new_region("edge", place, into=tmp_path / "a", folders=[garden, tmp_path]))
    assert "no extract maps the whole place; " in lines
    share = int(lines.partition("maps ")[2].partition("maps ")[2].partition("%")[0])
    assert 40 <= share <= 60
    lines = told(lambda: new_region("whole", PLACE, into=tmp_path / "b", folders=[garden, tmp_path]))
    assert f"{garden / NEW}: bounds [" in lines
    assert "whole place" not in lines


def test_a_damaged_extract_is_passed_over_with_a_line(garden, tmp_path):
    (tmp_path / "broken-2025-01-01.osm.pbf").write_bytes((garden / NEW).read_bytes()[:20_000])
    (tmp_path / "text-2025-01-01.osm.pbf").write_text("no map")
    (tmp_path / "empty-2025-01-01.osm.pbf").write_text("")
    lines = told(lambda: new_region("mine", PLACE, into=tmp_path / "a", folders=[tmp_path, garden]))
    for name in ("broken", "text", "empty"):
        assert any(line.startswith("passed over: ") and name in line for line in lines.splitlines()), name
    assert read_region_file(tmp_path / "a" / "mine.toml").extract[0].file == NEW


def test_where_none_covers_the_place_the_regional_extract_is_named(garden, tmp_path):
    andorra = Place.around("1.52,42.51", "1km")
    with pytest.raises(ExtractError, match=r"get https://download\.geofabrik\.de/europe/andorra-latest\.osm\.pbf \(or"):
        new_region("mine", andorra, into=tmp_path, folders=[garden])
    turned = Place.around(f"{LAT},{LON}", "300m")
    with pytest.raises(ExtractError, match=f"{NEW} covers .*: longitude comes first"):
        new_region("mine", turned, into=tmp_path, folders=[garden])
    with pytest.raises(ExtractError, match=f"{NEW} covers .*: latitude and longitude look swapped in the log"):
        new_region("mine", replace(turned, source="log"), into=tmp_path, folders=[garden])
    assert list(tmp_path.glob("*.toml")) == []


def test_a_regional_extract_is_downloaded_where_none_is_at_hand_and_no_date_is_asked_for(garden, tmp_path, monkeypatch):
    asked = []

    def download(_, *, most_mb):
        asked.append(most_mb)
        return garden / NEW

    monkeypatch.setattr(one_region, "download_regional", download)
    path = new_region("mine", PLACE, into=tmp_path, most_mb=7.0)
    spec = read_region_file(path)
    assert (asked, spec.extract[0].file) == ([7.0], NEW)
    for words in ({"most_mb": 0.0}, {"most_mb": 7.0, "days": Days.read("2015")}):
        with pytest.raises(ExtractError, match="no extract in"):
            new_region("other", PLACE, into=tmp_path, **words)
    assert asked == [7.0]


# What is written


def test_a_region_file_that_is_there_stays_and_is_refused_if_it_is_another(garden, tmp_path):
    path = new_region("mine", PLACE, into=tmp_path, folders=[garden], keep_cut=True)
    before = {one.name: one.read_bytes() for one in tmp_path.iterdir()}
    lines = told(lambda: new_region("mine", PLACE, into=tmp_path, folders=[garden], keep_cut=True))
    assert f"{path} is there already" in lines
    other = Place.around(f"{LON},{LAT}", "200m")
    with pytest.raises(StoreError, match="is there, and says something else"):
        new_region("mine", other, into=tmp_path, folders=[garden], keep_cut=True)
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == before


def test_a_name_is_an_identifier_and_none_of_the_package(garden, tmp_path):
    for name, words in (("My Town", "small letters, digits and hyphens"), ("vaduz", "comes with the program")):
        with pytest.raises(ConfigError, match=words):
            new_region(name, PLACE, into=tmp_path, folders=[garden])


def test_a_region_and_its_cut_are_built_at_once_and_alike(garden, program, tmp_path):
    words = ["--center", f"{LON},{LAT}", "--size", "300m", "--extracts", garden, "--country", "Nowhere"]
    code, printed, err = program("new-region", "whole", *words)
    assert (code, printed) == (0, "my-regions/whole.toml\n"), err
    assert f"build it: sasgeo-bench build-region my-regions/whole.toml --extracts {garden}" in err
    assert program("new-region", "piece", *words, "--keep-cut")[0] == 0
    assert program("build-region", "my-regions/whole.toml", "--extracts", garden)[0] == 0
    code, _, err = program("build-region", "my-regions/piece.toml")  # its cut lies beside it
    assert code == 0, err
    layers = []
    for name in ("whole", "piece"):
        assert read_manifest(tmp_path / "out/regions" / name).provenance.country == "Nowhere"
        with rasterio.open(tmp_path / "out/regions" / name / "layers.tif") as source:
            layers.append(source.read())
    np.testing.assert_array_equal(*layers)
    assert (
        read_region_file(tmp_path / "my-regions/piece.toml").scenes
        == read_region_file(tmp_path / "my-regions/whole.toml").scenes
    )


def photo(path, lon=None, lat=None):
    exif = Image.Exif()
    if lon is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(
            {
                ExifTags.GPS.GPSLatitudeRef: "N",
                ExifTags.GPS.GPSLatitude: (lat, 0.0, 0.0),
                ExifTags.GPS.GPSLongitudeRef: "E",
                ExifTags.GPS.GPSLongitude: (lon, 0.0, 0.0),
            }
        )
    Image.new("L", (40, 30)).save(path, format="JPEG", exif=exif)


def test_the_place_of_photos_is_where_they_are_and_those_without_a_place_are_named(garden, program, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    photo(folder / "one.jpg", LON, LAT)
    photo(folder / "two.JPG", LON + 0.001, LAT)
    photo(folder / "none.jpg")
    (folder / "broken.jpeg").write_text("no photo")
    (folder / "notes.txt").write_text("no photo either")
    code, _, err = program("new-region", "mine", "--photos", folder, "--extracts", garden)
    assert code == 0, err
    assert "1 photo (none.jpg) of 4 without a position" in err
    assert "1 photo of 4 cannot be read: " in err
    spec = read_region_file(tmp_path / "my-regions/mine.toml")
    assert spec.center_lonlat == pytest.approx((LON + 0.0005, LAT), abs=2e-5)
    assert spec.size_m == pytest.approx((1076, 1001), abs=3)


def test_the_place_of_a_flight_is_where_it_was_flown_whatever_its_units(garden, program, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("\n".join(["t,latitude,longitude,height", f"1,{LAT},{LON},9", f"2,{LAT},{LON + 0.001},9", ""]))
    code, _, err = program("new-region", "mine", "--flight", log, "--extracts", garden)
    assert code == 0, err
    spec = read_region_file(tmp_path / "my-regions/mine.toml")
    assert spec.center_lonlat == pytest.approx((LON + 0.0005, LAT), abs=2e-5)
    assert spec.size_m == pytest.approx((1076, 1001), abs=3)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--center", "9.5,47.1"], "say where the region lies by --center LON,LAT and --size 2km, by --bounds, by"),
        (["--size", "2km", "--bounds", "9,47,10,48"], "say where the region lies"),
        (["--center", "9.5,47.1", "--size", "2km", "--bounds", "9,47,10,48"], "say where the region lies"),
        (["--center", "9.5,47.1", "--size", "0km"], "size_m must be two positive lengths"),
        (["--center", "9.5,47.1", "--size", "1000000000km"], "make it smaller"),
        (["--bounds", "179.9,10,-179.9,10.1"], "a box over the antimeridian must be split in two"),
        (["--center", "179.9999,10", "--size", "2km"], "a box over the antimeridian must be split in two"),
        (["--center", "47.1,-109.5", "--size", "2km"], "longitude comes first"),
        (["--photos", "nowhere"], "nowhere is not there"),
        (["--photos", "photos.zip"], "photos.zip is a file: unpack it"),
        (["--photos", "bare/a.jpg"], "bare/a.jpg is a file: name the folder of the photos, as bare"),
        (["--photos", "flight.ulg"], "flight.ulg is a file: say --flight for a log"),
        (["--photos", "."], "holds no photo"),
        (["--photos", "bare"], "no photo says where it was taken"),
        (["--bounds", "9,47,9.1,47.1", "--vehicle", "2"], "--vehicle tells which of several a log is of"),
        (["--flight", "nowhere.gpx", "--vehicle", "2"], "nowhere.gpx is no telemetry log: leave out --vehicle"),
        (["--flight", "nowhere.gpx"], "there is no flight log nowhere.gpx"),
        (["--flight", "photos.zip"], "photos.zip is no flight log that is read"),
        (["--center", "9.5,47.1", "--size", "300m", "--most-mb", "0"], "europe/liechtenstein-latest.osm.pbf"),
    ],
)
def test_a_mistake_is_one_line(words, line, mistake, tmp_path):
    (tmp_path / "photos.zip").write_text("an archive")
    (tmp_path / "flight.ulg").write_text("a log")
    (tmp_path / "bare").mkdir()
    Image.new("L", (4, 3)).save(tmp_path / "bare" / "a.jpg")
    assert line in mistake("new-region", "mine", *words, "--quiet")
    assert not (tmp_path / "my-regions").exists()


def test_a_large_extract_is_cut_before_it_is_read_and_gives_the_same(garden, tmp_path, monkeypatch):
    whole = new_region("mine", PLACE, into=tmp_path / "a", folders=[garden])
    monkeypatch.setattr(one_region, "LARGE_BYTES", 1000)
    lines = told(lambda: new_region("mine", PLACE, into=tmp_path / "b", folders=[garden]))
    assert f"{NEW} is large (" in lines
    assert "--keep-cut spares that" in lines
    assert (tmp_path / "b/mine.toml").read_bytes() == whole.read_bytes()
    lines = told(lambda: new_region("mine", PLACE, into=tmp_path / "c", folders=[garden], keep_cut=True))
    assert "spares" not in lines


@pytest.mark.slow
@pytest.mark.real
def test_a_real_place_is_found_among_all_extracts_and_of_its_border_that_is_said(real_extracts, tmp_path):
    spec = read_region_file(
        new_region("mine", Place.around("1.5218,42.5075", "1km"), into=tmp_path, folders=[real_extracts])
    )
    assert (spec.extract[0].file, spec.scenes[0]) == ("andorra-2025-01-19.osm.pbf", "urban")
    border = Place.around("9.51,47.12", "2km")
    lines = told(lambda: new_region("border", border, into=tmp_path, folders=[real_extracts], days=Days.read("2020")))
    assert "liechtenstein-2019-11-18.osm.pbf maps 35% of it" in lines
    assert json.dumps("header of the file") in (tmp_path / "border.toml").read_text()
