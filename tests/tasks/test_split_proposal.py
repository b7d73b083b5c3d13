# SPDX-License-Identifier: Apache-2.0
"""A split is proposed of places and countries: none stands in two parts, and a single place is all test."""

import datetime as dt
import shutil
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.osm.locate import Extract
from sasgeo_bench.regions.region_spec import RegionFile, StatedProvenance, find_region_file, read_region_file
from sasgeo_bench.tasks.split import make_split, read_split_file
from sasgeo_bench.tasks.split_proposal import propose_split, split_text

EXTRACT = Extract(file="a.osm.pbf", date=dt.date(2020, 1, 1), sha256=("0" * 64,))


def region(name, lon, *, country=None, side_m=1000.0):
    return RegionFile(
        id=name,
        title=name,
        scenes=["urban"],
        center_lonlat=(lon, 47.0),
        size_m=(side_m, side_m),
        cell_size_m=10.0,
        extract=[EXTRACT],
        provenance=StatedProvenance(country=country),
    )


def parts(regions):
    spec = propose_split("mine", regions)
    return {name: place.part for place in spec.place for name in place.regions}


def test_a_single_place_is_all_test_and_of_two_the_smaller_calibrates():
    assert parts([region("a", 9.0)]) == {"a": "test"}
    assert parts([region("a", 9.0), region("b", 10.0, side_m=3000.0)]) == {"a": "calibration", "b": "test"}


def test_one_country_is_all_test_as_a_single_place_is():
    assert parts(
        [region(name, lon, country="A Land") for name, lon in zip("abc", (9, 10, 11), strict=True)]
    ) == dict.fromkeys("abc", "test")


def test_half_of_the_ground_tests_and_a_quarter_each_trains_and_calibrates():
    found = parts([region(f"r{number}", number) for number in range(8)])
    assert [list(found.values()).count(part) for part in ("test", "train", "calibration")] == [4, 2, 2]


def test_regions_that_lie_near_are_one_place_also_over_a_border_and_hold_their_countries_together():
    near_deg = 3000 / 75_900  # 2 km between the outlines
    regions = [
        region("west", 9.0, country="A"),
        region("east", 9.0 + near_deg, country="B"),
        region("far", 12.0, country="B"),
        region("other", 14.0, country="C"),
        region("last", 16.0, country="D"),
    ]
    spec = propose_split("mine", regions)
    assert [(place.name, place.regions, place.country) for place in spec.place] == [
        ("west", ["west", "east"], None),
        ("far", ["far"], "b"),
        ("other", ["other"], "c"),
        ("last", ["last"], "d"),
    ]
    assert spec.place[0].part == spec.place[1].part == "test"
    assert {place.part for place in spec.place[2:]} == {"train", "calibration"}


@given(st.lists(st.tuples(st.floats(-20, 20), st.sampled_from(["A", "B", "C", None])), min_size=1, max_size=6))
def test_no_country_stands_in_two_parts_and_no_two_parts_come_near(listed):
    regions = [region(f"r{number}", lon, country=country) for number, (lon, country) in enumerate(listed)]
    spec = propose_split("mine", regions)
    make_split(spec, {one.id: one.grid() for one in regions})  # refuses parts that come near each other
    found = {name: place.part for place in spec.place for name in place.regions}
    assert set(found) == {one.id for one in regions}
    for one, other in combinations(regions, 2):
        if one.provenance.country and one.provenance.country == other.provenance.country:
            assert found[one.id] == found[other.id]


def test_what_is_written_is_read_as_it_was_proposed(tmp_path):
    spec = propose_split("mine", [read_region_file(find_region_file(name)) for name in ("vaduz", "monaco", "porto")])
    (tmp_path / "mine.toml").write_text(split_text(spec), encoding="utf-8")
    assert read_split_file(tmp_path / "mine.toml") == spec


def test_the_command_writes_a_split_that_queries_are_drawn_by(program, towns, tmp_path):
    code, printed, err = program("new-split", "mine", "town-grid")
    assert (code, printed) == (0, "my-splits/mine.toml\n"), err
    assert "test         town-grid" in err
    words = [
        "--suite",
        "clean",
        "--regions",
        "town-grid",
        "--split",
        "my-splits/mine.toml",
        "--n",
        "1",
        "--out",
        tmp_path / "out",
    ]
    shutil.copytree(towns / "regions" / "town-grid", tmp_path / "out/regions/town-grid")
    code, _, err = program("make-queries", *words)
    assert code == 0, err
    code, _, err = program("new-split", "mine", "town-grid")
    assert code == 0
    assert "is there already" in err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["mine", "vadus"], "there is no region 'vadus', did you mean 'vaduz'"),
        (["mine", "vaduz", "vaduz"], "name each region once"),
        (["My split", "vaduz"], "split 'My split'"),
        (["mine"], "missing argument"),
    ],
)
def test_a_mistake_is_one_line(words, line, mistake, tmp_path):
    assert line in mistake("new-split", *words)
    assert not (tmp_path / "my-splits").exists()


def test_another_split_that_is_there_is_kept(mistake, program, tmp_path):
    assert program("new-split", "mine", "vaduz")[0] == 0
    before = (tmp_path / "my-splits/mine.toml").read_bytes()
    assert "says something else" in mistake("new-split", "mine", "monaco")
    assert (tmp_path / "my-splits/mine.toml").read_bytes() == before
