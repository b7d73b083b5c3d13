# SPDX-License-Identifier: Apache-2.0
"""`measure-ageing` as a user meets it."""

import datetime as dt
from pathlib import Path

import pytest

from sasgeo_bench.ageing.ratebook import RateBook
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.osm.synthetic.town import TownPlan, write_town


@pytest.fixture(scope="module")
def towns(tmp_path_factory):
    """Three dated files of an embedded town, in a folder of their own."""
    folder = tmp_path_factory.mktemp("towns")
    plan = TownPlan(morphology="suburb", seed=1, size_m=500.0, center_lonlat=(11.0, 48.0))
    paths = [folder / f"suburb-{year}-01-01.osm.pbf" for year in (2014, 2019, 2025)]
    for path, year in zip(paths, (2014, 2019, 2025), strict=True):
        write_town(plan, path, on=dt.date(year, 1, 1))
    return paths


def extracts(paths):
    return [word for path in paths for word in ("--extract", path)]


def test_three_files_are_written_and_named(program, towns, tmp_path):
    code, out, err = program("measure-ageing", *extracts(towns), "--out", "a")
    assert code == 0, err
    assert out.split() == ["a/ageing.parquet", "a/ageing.md", "a/ageing.svg"]
    assert "suburb-2014-01-01.osm.pbf of 2014-01-01" in err
    text = (tmp_path / "a/ageing.md").read_text()
    assert "suburb: how the map aged" in text
    assert str(tmp_path) not in text


def test_places_are_put_beside_each_other(program, towns, tmp_path):
    for place in ("north", "south"):
        assert (
            program("measure-ageing", *extracts(towns[::2]), "--place", place, "--country", "x", "--out", place)[0] == 0
        )
    code, out, err = program("measure-ageing", "--compare", "north", "south", "--out", "both.md")
    assert code == 0, err
    assert out.strip() == "both.md"
    assert "| south |" in Path(tmp_path / "both.md").read_text()
    code, out, err = program(
        "measure-ageing", "--compare", "north", "--control", "south", "--rates", "r.toml", "--out", "one.md"
    )
    assert code == 0, err
    assert out.split() == ["one.md", "r.toml"]
    assert parse_toml((tmp_path / "r.toml").read_text(), RateBook, source="r.toml").names == ("north",)
    assert "| class | south |" in (tmp_path / "one.md").read_text()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--at", "2014-13-01"), "--at must be a date"),
        (("--at", "2014-01-01"), "got 1 for 2 extracts"),
        (("--bounds", "11,48,10,49"), "--bounds must be west,south,east,north"),
        (("--bounds", "here"), "--bounds must be west,south,east,north"),
        (("--bounds", "-7,61,-6,62"), "nothing in common"),
        (("--extract", "none.osm.pbf"), "no extract at none.osm.pbf"),
    ],
)
def test_a_mistake_gets_one_line_and_exit_2(words, expected, mistake, towns, tmp_path):
    assert expected in mistake("measure-ageing", *extracts(towns[:2]), *words)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_nothing_measured_is_told(mistake):
    for words in (("measure-ageing", "--compare", "nowhere"), ("compare-ageing", "nowhere")):
        assert "run measure-ageing with --out nowhere first" in mistake(*words)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), "measure-ageing needs --extract, or --compare"),
        (("--extract", "a.osm", "--rates", "r.toml"), "--control and --rates go with --compare"),
        (("--compare", "a", "--at", "2014-01-01", "--margin-m", "5"), "leave out --at and --margin-m"),
        (("--compare", "a", "--extract", "b.osm", "--bounds", "1,1,2,2"), "leave out --extract and --bounds"),
    ],
)
def test_a_flag_of_the_other_task_is_refused_and_not_passed_over(words, expected, mistake):
    assert expected in mistake("measure-ageing", *words)


def test_the_folder_of_all_output_is_taken_from_the_environment(program, towns, tmp_path, monkeypatch):
    monkeypatch.setenv("SASGEO_OUT", "all")
    assert program("measure-ageing", *extracts(towns[::2]))[0] == 0
    assert (tmp_path / "all" / "ageing.parquet").is_file()
    assert program("measure-ageing", "--compare", "all")[1].strip() == "all/ageing-summary.md"
