# SPDX-License-Identifier: Apache-2.0
"""A line of provenance travels whole, from a region file to every place that shows or keeps it."""

import json
from typing import get_args

import pytest

from sasgeo_bench.boards.archive import pack_board
from sasgeo_bench.boards.archive_file import unpack_tasks
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.boards.tables import column
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.exchange.release_files import ReleaseMap, map_record
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region import ATTRIBUTION, Provenance
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.regions.region_spec import RegionFile, find_region_file
from tests.world import answered, drawn, scored

TOWN = "town-suburb"
LINES = Provenance.model_fields
NUMBERS = {int: 2024, float: 20.24}


def _stated(name):
    """A value of a line: a number if its type is one, else a text."""
    return next((value for kind, value in NUMBERS.items() if kind in get_args(LINES[name].annotation)), f"whose {name}")


STATED = {name: _stated(name) for name in LINES}


def region_text(**stated):
    """The file of a shipped town with lines of provenance."""
    lines = "".join(f"{name} = {json.dumps(value)}\n" for name, value in stated.items())
    return f"{find_region_file(TOWN).read_text(encoding='utf-8')}\n[provenance]\n{lines}"


def spec_of(**stated):
    return parse_toml(region_text(**stated), RegionFile, source="town.toml")


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", LINES)
def test_every_line_may_be_missing_and_says_its_title_and_its_meaning(name):
    assert LINES[name].default is None
    assert column(LINES[name].title).meaning == LINES[name].description


def test_every_line_reaches_every_file_and_every_table(tmp_path, lay_towns, few_figures, plain_site):  # noqa: ARG001
    out, file = lay_towns(tmp_path, TOWN), tmp_path / "town.toml"
    file.write_text(region_text(**STATED), encoding="utf-8")
    drawn(out, "clean", str(file))
    region, task = out / "regions" / TOWN, out / "tasks" / "clean" / TOWN
    answered(out, "prior_centre", [task])
    board, request = scored(out)
    pack_board(board, request, tmp_path / "results")
    (kept,) = unpack_tasks(tmp_path / "results", tmp_path / "laid")
    for about in (region / "region.json", task / "task.json", kept / "task.json"):
        assert read(about)["provenance"] == STATED, about
    assert read(tmp_path / "laid" / "regions" / TOWN / "region.json")["provenance"] == STATED
    for folder in (request.board, tmp_path / "results"):
        assert [one.provenance.model_dump() for one in Board.open(folder).about.tasks] == [STATED]
    publish(request.board)
    page, method = (
        (request.board / "site" / f"{name}.html").read_text(encoding="utf-8") for name in ("regions", "method")
    )
    credit = Provenance(**STATED).credit
    assert credit == f"{ATTRIBUTION}; {STATED['further_sources']}"
    for about in (task / "task.json", request.board / "board.json", tmp_path / "results" / "pack.json"):
        assert read(about)["attribution"] == credit, about
    for name in ("leaderboard.md", "leaderboard.tex", "site/index.html", "site/method.html"):
        text = (request.board / name).read_text(encoding="utf-8").replace("\\_", "_")
        assert STATED["further_sources"] in text, name
    record = map_record(ReleaseMap(folder=region, manifest=read_manifest(region)))
    for title, text in Provenance(**STATED).titled().items():
        assert title in page
        assert text in page
        assert title in method
    assert STATED.items() <= record.items()


def test_a_region_of_an_older_file_gets_its_lines_and_stays_the_same_map(tmp_path, lay_towns):
    out = lay_towns(tmp_path, TOWN)
    folder = out / "regions" / TOWN
    before = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}
    old = read_manifest(folder)
    assert not old.provenance.titled()
    stated = {name: value for name, value in STATED.items() if name != "further_sources"}
    plan, given = plan_build(spec_of(**stated), out=out), []
    assert not plan.is_current
    with reporting(given.append):
        made = build_region(plan)
    assert f"{TOWN}: its provenance alone has changed: only region.json is written" in given
    assert made == read_manifest(folder).model_copy(update={"provenance": made.provenance})
    assert (made.fingerprint, made.inputs_sha256, made.files) == (old.fingerprint, old.inputs_sha256, old.files)
    after = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}
    assert {name for name, about in after.items() if before[name] != about} == {"region.json"}
    assert plan_build(spec_of(**stated), out=out).is_current
    build_region(plan_build(spec_of(), out=out))
    assert read(folder / "region.json") == old.model_dump(mode="json")
    assert "provenance" not in read(folder / "region.json")


def test_a_further_source_that_is_stated_later_is_named_in_every_file(tmp_path, lay_towns):
    out = lay_towns(tmp_path, TOWN)
    manifest = build_region(plan_build(spec_of(further_sources="a land survey"), out=out))
    assert manifest.attribution == f"{ATTRIBUTION}; a land survey"
    for name in ("layers.tif", "features.parquet", "nodes.parquet", "edges.parquet"):
        assert b"a land survey" in (out / "regions" / TOWN / name).read_bytes(), name
    build_region(plan_build(spec_of(), out=out))
    assert b"a land survey" not in (out / "regions" / TOWN / "layers.tif").read_bytes()


def test_a_misspelt_line_is_refused_and_one_of_a_later_version_is_kept():
    name = next(iter(LINES))
    with pytest.raises(ConfigError, match=f"unknown key 'provenance.{name}x', did you mean '{name}'"):
        spec_of(**{f"{name}x": "somebody"})
    assert Provenance.model_validate({"later": 3}).model_dump() == {"later": 3}
