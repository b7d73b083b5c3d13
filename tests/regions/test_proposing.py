# SPDX-License-Identifier: Apache-2.0
"""A line of a manifest becomes regions: windows lie where a place is built, and nothing of one place costs another."""

import datetime as dt
import json
from itertools import combinations

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.config import LONGEST_LINE
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.geometry.projection import to_lonlat
from sasgeo_bench.osm.synthetic.town import TownPlan, write_town
from sasgeo_bench.regions import proposing
from sasgeo_bench.regions.proposing import LEAST_BUILT_KM2, STEP_M, find_windows, propose_regions
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.regions.region_spec import read_region_file

EPSG = 32632
FAR_EAST_M, FAR_NORTH_M = 500_000.0, 5_216_000.0  # whole steps


def houses(*blocks):
    """Return a house in the middle of each step of blocks, given as first column and row, columns, rows."""
    steps = [(c, r) for col, row, cols, rows in blocks for c in range(col, col + cols) for r in range(row, row + rows)]
    at_m = (np.array(steps, dtype=float) + 0.5) * STEP_M + (FAR_EAST_M, FAR_NORTH_M)
    return np.column_stack(to_lonlat(EPSG).transform(at_m[:, 0], at_m[:, 1]))


def boxes(windows):
    return [shapely.box(one.col, one.row, one.col + one.cols, one.row + one.rows) for one in windows]


def test_what_fits_into_one_window_is_that_window_and_no_smaller_than_one_may_be():
    (town,) = find_windows(houses((0, 0, 20, 15), (29, 29, 1, 1)))
    assert (town.size_m, town.built) == ((32 * STEP_M, 32 * STEP_M), 301)
    (hamlet,) = find_windows(houses((0, 0, 2, 3)))
    assert (hamlet.size_m, hamlet.built) == ((6 * STEP_M, 6 * STEP_M), 6)


def test_two_towns_have_a_window_each_and_a_hamlet_between_them_has_none():
    windows = find_windows(houses((0, 0, 20, 20), (60, 0, 14, 14), (40, 40, 3, 3)))
    assert [one.built for one in windows] == [400, 196]
    assert [box.bounds for box in boxes(windows)] == [(3906, 40750, 3926, 40770), (3966, 40750, 3980, 40764)]


def test_a_stray_house_far_away_moves_nothing():
    near = find_windows(houses((0, 0, 20, 20)))
    assert find_windows(houses((0, 0, 20, 20), (2000, 0, 1, 1))) == near


def test_without_a_house_there_is_no_window():
    assert find_windows(np.empty((0, 2))) == []


@given(st.lists(st.tuples(*[st.integers(0, 90)] * 2, *[st.integers(1, 40)] * 2), min_size=1, max_size=4))
def test_windows_keep_their_sizes_and_apart_and_count_what_is_built(blocks):
    windows = find_windows(houses(*blocks))
    assert 1 <= len(windows) <= proposing.MOST_WINDOWS
    assert not any(one.intersection(other).area for one, other in combinations(boxes(windows), 2))
    built = {(c, r) for col, row, cols, rows in blocks for c in range(col, col + cols) for r in range(row, row + rows)}
    east, north = int(FAR_EAST_M / STEP_M), int(FAR_NORTH_M / STEP_M)
    for one in windows:
        least_m = proposing.SHORTEST_M if len(windows) > 1 else proposing.LEAST_M
        assert least_m <= min(one.size_m) <= max(one.size_m) <= proposing.LONGEST_M
        assert one.size_m[0] * one.size_m[1] <= proposing.MOST_KM2 * 1e6
        inside = {
            (c, r)
            for c, r in built
            if one.col <= c + east < one.col + one.cols and one.row <= r + north < one.row + one.rows
        }
        assert one.built == len(inside)
    assert all(one.built_km2 >= LEAST_BUILT_KM2 for one in windows[1:])


@pytest.fixture(scope="module")
def towns(tmp_path_factory):
    """Two towns as files, the first at two dates; read them, do not write to them."""
    folder = tmp_path_factory.mktemp("extracts")
    suburb = TownPlan(morphology="suburb", seed=3, size_m=600.0, center_lonlat=(9.5, 47.1))
    for day in (dt.date(2015, 1, 1), dt.date(2020, 1, 1)):
        write_town(suburb, folder / f"garden-{day}.osm.pbf", on=day)
    mill = TownPlan(morphology="industrial", seed=5, size_m=600.0, center_lonlat=(14.2, 50.1))
    write_town(mill, folder / "mill-2020-01-01.osm.pbf", on=dt.date(2020, 1, 1))
    return folder


def row(file, place, **changes):
    fields = {"country": "Nowhere", "what": "garden town", "date": file[-18:-8]} | changes
    lines = [f"{key} = {json.dumps(value)}" for key, value in {"file": file, "place": place, **fields}.items()]
    return "\n".join(["[[extract]]", *lines, ""])


FIRST, SECOND, MILL = "garden-2015-01-01.osm.pbf", "garden-2020-01-01.osm.pbf", "mill-2020-01-01.osm.pbf"


@pytest.fixture
def manifest(tmp_path):
    def write(*rows):
        path = tmp_path / "manifest.toml"
        path.write_text("\n".join(rows), encoding="utf-8")
        return path

    return write


def test_a_line_of_a_manifest_is_a_region_that_is_built_and_knows_its_country(towns, manifest, program, tmp_path):
    origin = {"source": "archive of the mill, shelf 3", "date_known_by": "a stamp", "owner": "its own key"}
    listed = manifest(row(SECOND, "garden"), row(FIRST, "garden"), row(MILL, "mill", country="Elsewhere", **origin))
    into, out = tmp_path / "mine", tmp_path / "out"
    code, printed, _ = program("new-region", "--manifest", listed, "--into", into, "--extracts", towns)
    assert (code, printed.splitlines()) == (0, [str(into / "garden.toml"), str(into / "mill.toml")])
    garden, mill = (read_region_file(into / f"{name}.toml") for name in ("garden", "mill"))
    assert [extract.date.year for extract in garden.extract] == [2015, 2020]
    assert garden.extract[0].sha256 == (sha256_of(towns / FIRST),)
    assert garden.title == "Garden, Nowhere: garden town"
    assert mill.scenes == ["suburban", "riverside"]
    assert program("build-region", "--every", "--region-files", into, "--extracts", towns, "--out", out)[0] == 0
    stated = read_manifest(out / "regions" / "mill").provenance
    assert (stated.country, stated.dated_by, stated.source) == ("Elsewhere", "a stamp", origin["source"])
    assert read_manifest(out / "regions" / "garden").counts["building"] > 20


def test_two_places_are_added_by_a_line_each(towns, manifest, program, tmp_path):
    rows = [
        f'  {{ file = "{file}", place = "{place}", country = "Nowhere", what = "town", date = 2020-01-01 }},'
        for file, place in ((SECOND, "garden"), (MILL, "mill"))
    ]
    into, out = tmp_path / "mine", tmp_path / "out"
    listed = manifest("extract = [", *rows, "]")
    assert program("new-region", "--manifest", listed, "--into", into, "--extracts", towns)[0] == 0
    assert program("build-region", "--every", "--region-files", into, "--extracts", towns, "--out", out)[0] == 0
    for place in ("garden", "mill"):
        assert read_manifest(out / "regions" / place).coverage.share > 0.3  # 600 m in the smallest window
        assert (out / "regions" / place / "preview.png").is_file()


def test_each_date_keeps_how_it_is_known_and_where_it_comes_from(towns, manifest):
    rows = (row(FIRST, "garden", date_known_by="header", source="shelf 1"), row(SECOND, "garden", source="shelf 2"))
    ((_, text),) = propose_regions(manifest(*rows), folders=[towns])
    stated = proposing.parse_toml(text, proposing.RegionFile, source="garden").provenance
    assert stated.source == "2015-01-01: shelf 1; 2020-01-01: shelf 2"
    assert stated.dated_by == "2015-01-01: header"


def test_what_was_changed_by_hand_is_kept(towns, manifest, program, tmp_path):
    asked = ("new-region", "--manifest", manifest(row(MILL, "mill")), "--into", tmp_path / "mine", "--extracts", towns)
    program(*asked)
    assert program(*asked)[1] == ""
    path = tmp_path / "mine" / "mill.toml"
    path.write_text(path.read_text("utf-8").replace("garden town", "my mill"), encoding="utf-8")
    code, printed, err = program(*asked)
    assert (code, printed) == (0, "")
    assert f"{path}: kept, although the manifest gives another: remove it to have that\n" in err
    assert "my mill" in path.read_text("utf-8")


def test_an_address_is_one_to_load_from_only_with_the_hash_of_what_lies_there(towns, manifest):
    hashed = {"source": "https://example.org/mill.osm.pbf", "source_sha256": "a" * 64}
    for more, urls in ((hashed, 1), ({"source": hashed["source"]}, 0), (hashed | {"source": "https://a b"}, 0)):
        ((_, text),) = propose_regions(manifest(row(MILL, "mill", **more)), folders=[towns])
        assert (text.count("urls = "), text.count("source = ")) == (urls, 1 - urls)
        assert text.count("a" * 64) == urls


def test_a_place_that_cannot_be_read_is_left_out_with_a_line(towns, manifest):
    rows = (row("gone-2020-01-01.osm.pbf", "gone"), row("lost-2020-01-01.osm.pbf", "lost", sha256="0" * 64))
    lines, found = [], []
    with reporting(lines.append), pytest.raises(ConfigError, match=r"no region of 2 places \(gone, lost\) of 3"):
        found.extend(name for name, _ in propose_regions(manifest(*rows, row(MILL, "mill")), folders=[towns]))
    assert found == ["mill"]
    assert "gone: left out: gone-2020-01-01.osm.pbf has no sha256, and is in none of the folders" in lines[0]
    assert "lost: left out: lost-2020-01-01.osm.pbf (SHA-256 0000" in lines[1]


def test_a_place_of_a_known_region_is_left_out(towns, manifest):
    ((_, text),) = propose_regions(manifest(row(MILL, "mill")), folders=[towns])
    known = proposing.parse_toml(text, proposing.RegionFile, source="mill")
    lines = []
    with reporting(lines.append):
        for again in (row(MILL, "mill"), row(SECOND, "mill"), row(MILL, "other")):
            assert list(propose_regions(manifest(again), folders=[towns], known=[known])) == []
    held = f"has regions already: region mill holds {MILL}"
    assert lines == ["mill: has regions already: region mill"] * 2 + [f"other: {held}"]


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        (
            [row(FIRST, "garden"), row(MILL, "mill").replace("country", "land")],
            r"manifest.toml: extract 2 \(mill-2020-01-01.osm.pbf\): 'country' is missing",
        ),
        (
            [row(FIRST, "garden"), row(MILL, "mill", date="2020-02-30")],
            r"extract 2 \(mill-2020-01-01.osm.pbf\): 'date' is a day, YYYY-MM-DD, got '2020-02-30'",
        ),
        ([row(MILL, "mill"), row(MILL, "mill", country="Elsewhere")], "two extracts are of one day"),
        ([row(MILL, "mill"), row(MILL, "mill", date="2019-01-01")], "is of two days: name one"),
        ([row(FIRST, "garden"), row(SECOND, "garden", country="E")], "garden lies in E and in Nowhere"),
        (
            [row(MILL, "The Mill")],
            r"extract 1 \(mill-2020-01-01.osm.pbf\): 'place' has small letters, digits and hyphens between",
        ),
        ([row(FIRST, "nis"), row(MILL, "nis-2")], "nis-2 may be the name of a second region of nis: rename one"),
        ([""], "'extract' is missing"),
    ],
)
def test_a_wrong_manifest_is_refused_in_one_line(manifest, rows, fault):
    with pytest.raises(ConfigError, match=fault) as caught:
        list(propose_regions(manifest(*rows)))
    assert "\n" not in str(caught.value)


def test_of_every_region_one_that_cannot_be_built_costs_no_other(towns, manifest, program, tmp_path):
    listed = manifest(row(MILL, "mill"), row(SECOND, "garden"))
    into, out = tmp_path / "mine", tmp_path / "out"
    program("new-region", "--manifest", listed, "--into", into, "--extracts", towns)
    path = into / "garden.toml"
    path.write_text(path.read_text("utf-8").replace(sha256_of(towns / SECOND), "0" * 64), encoding="utf-8")
    asked = ("build-region", "--every", "--region-files", into, "--extracts", towns, "--out", out)
    code, _, err = program(*asked)
    assert code == 2
    assert "garden: not built: garden-2020-01-01.osm.pbf (SHA-256 0000" in err
    assert err.splitlines()[-1].endswith("not built: 1 region (garden) of 2; the lines above say why")
    assert read_manifest(out / "regions" / "mill").id == "mill"


def test_a_region_file_that_cannot_be_read_costs_no_other(towns, manifest, program, tmp_path):
    into, out = tmp_path / "mine", tmp_path / "out"
    program("new-region", "--manifest", manifest(row(MILL, "mill")), "--into", into, "--extracts", towns)
    (into / "a.toml").write_text("id = 3", encoding="utf-8")
    code, _, err = program("build-region", "--every", "--region-files", into, "--extracts", towns, "--out", out)
    assert code == 2
    assert "a: not built: " in err
    assert err.splitlines()[-1].endswith("not built: 1 region (a) of 2; the lines above say why")
    assert read_manifest(out / "regions" / "mill").id == "mill"


def test_what_was_made_of_the_same_extracts_is_not_read_again(towns, manifest, program, tmp_path, monkeypatch):
    into, rows = tmp_path / "mine", [row(FIRST, "garden"), row(SECOND, "garden")]
    first = program("new-region", "--manifest", manifest(*rows), "--into", into, "--extracts", towns)
    monkeypatch.setattr(proposing, "_houses", None)  # reading it would fail
    again = program("new-region", "--manifest", manifest(*rows), "--into", into, "--extracts", towns)
    assert (first[0], again[0], again[1]) == (0, 0, "")
    assert "kept" not in again[2]
    renamed = [one.replace("garden town", "new words") for one in rows]
    assert (
        "garden.toml: kept, although the manifest gives another"
        in (program("new-region", "--manifest", manifest(*renamed), "--into", into, "--extracts", towns)[2])
    )


def test_a_newer_map_of_a_place_is_read(towns, manifest, program, tmp_path):
    into = tmp_path / "mine"
    program("new-region", "--manifest", manifest(row(FIRST, "garden")), "--into", into, "--extracts", towns)
    err = program(
        "new-region",
        "--manifest",
        manifest(row(FIRST, "garden"), row(SECOND, "garden")),
        "--into",
        into,
        "--extracts",
        towns,
    )[2]
    assert "garden.toml: kept, although the manifest gives another" in err


def test_an_older_map_of_other_ground_is_left_out_of_the_region_with_a_line(towns, manifest):
    rows = (row(FIRST, "town"), row(MILL, "town", date="2021-01-01"))  # the mill lies far from the garden
    lines = []
    with reporting(lines.append):
        ((_, text),) = propose_regions(manifest(*rows), folders=[towns])
    assert [one.file for one in proposing.parse_toml(text, proposing.RegionFile, source="town").extract] == [MILL]
    assert [line for line in lines if line.startswith("town: without its map of 2015-01-01: ")]


def test_a_place_may_have_a_title_and_its_second_region_a_number(towns, manifest):
    ((_, text),) = propose_regions(manifest(row(MILL, "mill", title="Mühle am Bach")), folders=[towns])
    assert 'title = "Mühle am Bach, Nowhere: garden town"' in text
    spec = proposing.parse_toml(text, proposing.RegionFile, source="mill")
    (listed,) = proposing.read_places(manifest(row(MILL, "old-mill")))["old-mill"]
    second = proposing._text(
        "old-mill-2", [listed], spec.extract, centre=spec.center_lonlat, size_m=spec.size_m, scenes=["sparse"]
    )
    assert 'title = "Old Mill (2), Nowhere: garden town"' in second


def test_origins_that_are_too_long_name_their_commits_in_short():
    days = [dt.date(year, 1, 1) for year in (2010, 2014, 2016)]
    texts = {day: f"https://example.org/maps@{number:040x} data/of/a/town.osm.bz2" for number, day in enumerate(days)}
    stated = proposing._of_dates(texts)
    assert len(stated) <= LONGEST_LINE
    assert [part[:10] for part in stated.split("; ")] == [day.isoformat() for day in days]
    assert "@000000000000 data" in stated


def test_a_folder_that_cannot_be_written_into_is_a_line_and_nothing_is_left(towns, manifest, mistake, tmp_path):
    into = tmp_path / "mine"
    into.write_text("a file", encoding="utf-8")
    line = mistake("new-region", "--manifest", manifest(row(MILL, "mill")), "--into", into, "--extracts", towns)
    assert f"{into / 'mill.toml'} cannot be written" in line
    assert into.read_text(encoding="utf-8") == "a file"


def test_a_region_that_no_file_could_state_is_left_out_with_a_line(towns, manifest):
    listed = manifest(row(FIRST, "a", what="x" * (LONGEST_LINE - 5)), row(MILL, "b"))
    lines = []
    with reporting(lines.append), pytest.raises(ConfigError, match=r"no region of 1 place \(a\) of 2"):
        list(propose_regions(listed, folders=[towns]))
    assert lines[0].startswith("a: left out: its region a: 'title': String should have at most")


def test_any_printable_text_comes_back_from_the_file_as_it_was(towns, manifest):
    odd = 'quote " and \\ and <b>bold</b> | ü'
    ((_, text),) = propose_regions(manifest(row(MILL, "mill", country=odd, what=odd, source=odd)), folders=[towns])
    spec = proposing.parse_toml(text, proposing.RegionFile, source="mill")
    assert (spec.provenance.country, spec.provenance.source) == (odd, odd)
    assert spec.title == f"Mill, {odd}: {odd}"


def test_an_empty_folder_builds_nothing(tmp_path, mistake):
    assert "no region file (*.toml) to build" in mistake("build-region", "--every", "--region-files", tmp_path)


def test_files_are_found_where_other_commands_find_them(towns, manifest, monkeypatch):
    monkeypatch.setenv("SASGEO_EXTRACTS", str(towns))
    assert [name for name, _ in propose_regions(manifest(row(MILL, "mill")))] == ["mill"]


def test_regions_are_named_or_every_one_is_built(mistake):
    line = "name regions to build, or build --every region, not both"
    assert line in mistake("build-region")
    assert line in mistake("build-region", "monaco", "--every")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--manifest", "no.toml", "--center", "9.5,47.1"), "leave center out, or leave out --manifest"),
        (("my-town", "--manifest", "no.toml"), "leave name out, or leave out --manifest"),
        (("--center", "9.5,47.1", "--size", "2km"), "name the region, such as my-town"),
    ],
)
def test_a_place_is_named_or_a_manifest_is(mistake, words, expected):
    assert expected in mistake("new-region", *words)
