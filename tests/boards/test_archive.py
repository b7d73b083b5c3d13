# SPDX-License-Identifier: Apache-2.0
"""Stored results: scored again they give the same board, they are small, and are there whole or not at all."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.boards import archive, archive_file, build, score
from sasgeo_bench.boards.archive import laid_out, pack_board, score_all, stored_settings
from sasgeo_bench.boards.archive_file import read_pack, read_stored_predictions, unpack, unpack_tasks
from sasgeo_bench.boards.board_figures import figures_extra
from sasgeo_bench.boards.board_files import AdditionalFiles
from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.core import folders
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import plan_pipeline
from sasgeo_bench.scoring import kept_rejection, rejection
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.tasks.query import base_of
from tests.threaded import threaded

pytestmark = pytest.mark.usefixtures("few_figures")

PIPELINE = """
id = "kept"
title = "Kept"
split = "crossfit"
regions = ["town-suburb", "town-agricultural"]
matchers = ["learners:Counts", "random", "prior_centre"]
rejectors = ["margin_nms"]
draws = 100

[[task]]
suites = ["clean"]
sites = 1

[learning]
suites = ["clean"]
most = 5

[[contrast]]
name = "nothing"
first = "random"
second = "prior_centre"
suites = ["clean"]
"""
TABLES = ("leaderboard", "scores", "contrasts", "falsifiers", "controls")


@pytest.fixture(scope="module")
def kept(tmp_path_factory, few_controls, lay_towns):  # noqa: ARG001
    """A board of a pipeline with its stored results, and what was told."""
    out, lines = tmp_path_factory.mktemp("packing"), []
    lay_towns(out / "out", "town-suburb", "town-agricultural")
    with pytest.MonkeyPatch.context() as patch, threaded():
        patch.syspath_prepend(str(Path(__file__).parents[1] / "running"))
        with reporting(lines.append):
            plan = plan_pipeline(parse_toml(PIPELINE, PipelineFile, source="kept.toml"), out=out / "out")
        with reporting(lines.append):
            board = run_pipeline(plan, results=out / "results")
    return board, plan, out / "results" / "kept", lines


def test_scored_again_stored_results_give_the_same_board(kept, program, tmp_path):
    _, plan, folder, _ = kept
    code, _, err = program("score", "--predictions", folder, "--truth", folder, "--name", "again", "--out", tmp_path)
    assert code == 4, err  # the matcher that learns answers blind views: so says the board itself
    first, again = plan.out / "boards" / "kept", tmp_path / "boards" / "again"
    there = contents_of(first)
    assert contents_of(again) == {name: data for name, data in there.items() if name.parts[0] != "pictures"}


def test_fits_are_kept_in_the_users_cache_unless_nothing_is_to_be_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("SASGEO_KEPT_MB", raising=False)
    usual = archive.request_of([tmp_path / "runs"], board=tmp_path / "board", root=tmp_path)
    assert usual.kept_fits == tmp_path / "sasgeo-bench" / "rejectors"
    monkeypatch.setenv("SASGEO_KEPT_MB", "0")
    assert archive.request_of([tmp_path / "runs"], board=tmp_path / "board", root=tmp_path).kept_fits is None


@pytest.mark.usefixtures("undrawn")
def test_scored_once_more_no_rejector_is_fitted_and_the_board_is_the_same(kept, program, tmp_path, monkeypatch):
    _, _, folder, _ = kept
    monkeypatch.setattr(kept_rejection, "_programs", lambda: b"program")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SASGEO_KEPT_MB")
    fitted, judge = [], rejection.judge
    monkeypatch.setattr(rejection, "judge", lambda *given, **more: fitted.append(given) or judge(*given, **more))
    for name in ("once", "twice"):
        assert program("score", "--predictions", folder, "--name", name, "--out", tmp_path)[0] == 4
        assert fitted, "the board has rejectors"
        fitted.append(name)
    assert fitted[-2:] == ["once", "twice"]  # nothing between both
    once, twice = (contents_of(tmp_path / "boards" / name) for name in ("once", "twice"))
    assert once == twice


@pytest.mark.slow
def test_scored_again_stored_results_have_pictures_where_the_same_views_lie(kept, tmp_path, monkeypatch):
    _, plan, folder, _ = kept
    shutil.copytree(plan.out, tmp_path / "out", ignore=shutil.ignore_patterns("boards", "runs"))
    other = tmp_path / "out" / "tasks" / "clean" / "town-agricultural"
    record = json.loads((other / "task.json").read_text(encoding="utf-8"))
    record["files"]["queries.parquet"]["sha256"] = "0" * 64
    (other / "task.json").write_text(json.dumps(record), encoding="utf-8")
    lines = []
    monkeypatch.setattr(build, "figures_extra", lambda *_, **__: AdditionalFiles())
    usual = archive.request_of([folder], board=tmp_path / "again", root=tmp_path / "out")
    with reporting(lines.append):
        score_all(replace(usual, draws=100, rejectors=()))
    record = json.loads((tmp_path / "again" / "pictures" / "pictures.json").read_text(encoding="utf-8"))
    assert len(record["regions"]) == 1
    assert {case["region"] for case in record["cases"]} == {"town-suburb"}
    assert f"pictures of 1 of 2 tasks: {tmp_path / 'out' / 'tasks'} lacks the views of the rest" in lines


@pytest.mark.usefixtures("undrawn")
def test_stored_results_keep_the_version_of_the_maps_they_were_asked_on(kept, tmp_path, monkeypatch):
    _, _, folder, _ = kept
    monkeypatch.setattr(score, "DATA_VERSION", 99)
    usual = archive.request_of([folder], board=tmp_path / "again", root=tmp_path)
    score_all(replace(usual, draws=100, rejectors=()), has_cases=False)
    first = json.loads((folder / "board.json").read_text())
    assert json.loads((tmp_path / "again" / "board.json").read_text())["data_version"] == first["data_version"]


def test_stored_results_hold_the_board_and_what_it_was_made_of(kept):
    board, plan, folder, lines = kept
    names = {path.name for path in folder.iterdir()}
    assert names == {
        *(f"{table}.parquet" for table in (*TABLES, "runs", "tasks", "queries", "truths")),
        *("leaderboard.md", "board.json", "pack.json", "predictions.parquet"),
    }
    first = plan.out / "boards" / "kept"
    for name in TABLES:
        written, found = (read_frame(place / f"{name}.parquet", mend="") for place in (first, folder))
        pd.testing.assert_frame_equal(written, found, check_exact=True)
        assert written.attrs == found.attrs
    for name in ("leaderboard.md", "board.json"):
        assert (first / name).read_bytes() == (folder / name).read_bytes()
    assert "evidence" not in pq.read_schema(folder / "queries.parquet").names
    for name in ("counts", "random", "prior_centre", "oracle_pose", "fft_vote"):
        found = {item.query_id: item for item in read_stored_predictions(folder, name)}
        assert found == {key: replace(item, matcher_s=None) for key, item in board.predictions[name].items()}
    one = next(iter(board.predictions["random"]))
    assert [item.query_id for item in read_stored_predictions(folder, "random", queries={one})] == [one]
    with pytest.raises(StoreError, match="holds no answer of 'nobody'"):
        read_stored_predictions(folder, "nobody")
    learned = pq.read_table(folder / "runs.parquet")["learned"].to_pylist()
    assert len({text for text in learned if text is not None}) == 2  # one of each half
    count = sum(len(rows) for rows in board.predictions.values())
    (given,) = [line for line in lines if f"{count} predictions" in line]
    assert given.startswith(f"{folder}: 0.")
    assert read_pack(folder).dropped == ""


@pytest.mark.usefixtures("undrawn")
def test_stored_results_are_scored_without_a_region(kept, program, tmp_path):
    _, _, folder, _ = kept
    towns = pq.read_table(folder / "tasks.parquet", columns=["region_json"])["region_json"].to_pylist()
    region = json.loads(next(item for item in towns if item))["id"]
    code, _, err = program(
        "score", "--predictions", folder, "--name", "fewer", "--without", region, "--draws", "100", "--out", tmp_path
    )
    assert code in {0, 3}, err
    scores = pd.read_parquet(tmp_path / "boards" / "fewer" / "scores.parquet")
    assert len(scores)
    assert region not in {base_of(name) for name in scores["region"]}


def test_what_is_too_large_is_refused_and_the_old_one_stays(kept, tmp_path):
    board, plan, _, _ = kept
    request = request_of(plan)
    whole = pack_board(board, request, tmp_path / "kept").packed
    before = (tmp_path / "kept" / "pack.json").read_bytes()
    pack_board(board, request, tmp_path / "kept", most_bytes=whole.total_bytes)
    too_large = r"would hold 0\.\d MB \(0\.\d MB of predictions\), 0\.\d+ MB at most: store a"
    with pytest.raises(StoreError, match=too_large):
        pack_board(board, request, tmp_path / "kept", most_bytes=whole.total_bytes - 1)
    assert (tmp_path / "kept" / "pack.json").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".lock"] == ["kept"]


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_stored_again_nothing_changes(kept, program, tmp_path):
    _, _, folder, _ = kept
    program("score", "--predictions", folder, "--name", "kept", "--results", tmp_path / "same", "--out", tmp_path)
    assert contents_of(tmp_path / "same" / "kept") == contents_of(folder)


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("--without", "a board without some regions is not stored: leave --without or --results away"),
        ("--predictions", r"mine.parquet is a file of predictions: only boards of runs are stored"),
        ("--submissions", "results of a board hold no submissions: leave --sub"),
    ],
)
def test_what_is_no_whole_board_of_runs_is_not_stored(kept, tmp_path, flag, words):
    _, _, folder, _ = kept
    (tmp_path / "mine.parquet").touch()
    more = {"--predictions": {"predictions": [folder, tmp_path / "mine.parquet"]}}.get(
        flag, {flag.removeprefix("--"): ("mine",)}
    )
    asked = ScoreRequest(predictions=[folder], root=tmp_path, board=tmp_path / "board")
    with pytest.raises(ConfigError, match=words):
        score_all(replace(asked, **more), results=tmp_path / "results")
    assert not (tmp_path / "results").exists()


def request_of(plan):
    return ScoreRequest(
        predictions=[],
        root=plan.out,
        board=plan.out / "boards" / "kept",
        split=plan.requests[0].split,
        rejectors=plan.spec.rejectors,
        contrasts=[Contrast(name="nothing", first="random", second="prior_centre", suites=("clean",))],
        draws=plan.spec.draws,
    )


def test_a_store_that_is_cut_off_leaves_the_old_one_whole(kept, tmp_path, monkeypatch):
    board, plan, _, _ = kept
    pack_board(board, request_of(plan), tmp_path / "kept")
    before = {path.name: path.read_bytes() for path in (tmp_path / "kept").iterdir() if path.is_file()}

    def cut_off(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(archive_file, "_write_predictions", cut_off)
    with pytest.raises(KeyboardInterrupt):
        pack_board(board, request_of(plan), tmp_path / "kept")
    assert {path.name: path.read_bytes() for path in (tmp_path / "kept").iterdir() if path.is_file()} == before


def test_a_folder_of_something_else_is_not_replaced(kept, tmp_path):
    board, plan, _, _ = kept
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreError, match="holds something else than stored results"):
        pack_board(board, request_of(plan), tmp_path)


@pytest.mark.parametrize(
    ("name", "words"),
    [("pack.json", "holds no sound stored results"), ("truths.parquet", "truths.parquet differs")],
)
def test_damaged_results_are_reported_in_a_line(kept, tmp_path, name, words, program):
    board, plan, _, _ = kept
    pack_board(board, request_of(plan), tmp_path / "kept")
    (tmp_path / "kept" / name).write_bytes(b"{")
    code, _, err = program("score", "--predictions", tmp_path / "kept", "--out", tmp_path / "out")
    assert code == 2
    assert words in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("name", ["mischief:Rejector", "no_such_rejector"])
def test_stored_results_have_no_code_imported_that_no_package_registers(kept, program, tmp_path, monkeypatch, name):
    stored = shutil.copytree(kept[2], tmp_path / "stored")
    record = json.loads((stored / "pack.json").read_text(encoding="utf-8"))
    record["rejectors"] = ["margin_nms", name]
    (stored / "pack.json").write_text(json.dumps(record), encoding="utf-8")
    (tmp_path / "mischief.py").write_text("import pathlib; pathlib.Path('imported').touch()", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    code, _, err = program("score", "--predictions", "stored", "--out", "out")
    assert code == 2
    (line,) = err.strip().splitlines()
    assert line == (
        f"sasgeo-bench: stored names the rejector {name!r}, and data may name registered ones only (list rejectors "
        "shows all): name each that is to judge with --rejector, and code only if you trust it"
    )
    assert not (tmp_path / "imported").exists()
    assert not (tmp_path / "out").exists()


def test_named_on_the_command_line_code_judges_stored_results(kept):
    folder = kept[2]
    asked = archive.request_of([folder], board=Path("board"), root=Path("out"), rejectors=["mine:Rejector"])
    assert asked.rejectors == ["mine:Rejector"]


def hash_again(folder, **changes):
    """Make what pack.json says true of whatever lies there now."""
    record = json.loads((folder / "pack.json").read_text(encoding="utf-8")) | changes
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name != "pack.json"]
    record["files"] = {path.relative_to(folder).as_posix(): sha256_of(path) for path in paths}
    (folder / "pack.json").write_text(json.dumps(record), encoding="utf-8")


@pytest.fixture
def own(kept, tmp_path):
    return Path(shutil.copytree(kept[2], tmp_path / "own"))


def test_every_file_of_stored_results_has_its_hash(kept):
    record = json.loads((kept[2] / "pack.json").read_text(encoding="utf-8"))
    there = {path.relative_to(kept[2]).as_posix(): path for path in kept[2].rglob("*") if path.is_file()}
    assert record["files"].keys() == there.keys() - {"pack.json"}
    assert all(sha256_of(there[name]) == digest for name, digest in record["files"].items())


@pytest.mark.parametrize("name", ["board.json", "predictions.parquet"])
def test_a_file_that_differs_is_missing_or_is_more_is_named(own, mistake, name):
    file, data = own / name, (own / name).read_bytes()
    fetch = "pack.json says ({} {}): fetch the results again"
    file.write_bytes(data + b" ")
    assert fetch.format(name, "differs") in mistake("score", "--predictions", own)
    file.unlink()
    assert fetch.format(name, "is missing") in mistake("score", "--predictions", own)
    file.write_bytes(data)
    (own / "more").touch()
    with pytest.raises(StoreError, match="more is not in its list"):
        unpack_tasks(own, own.parent)
    (own / "more").unlink()
    assert read_pack(own).split == "crossfit"


def as_former(folder, version):
    """Lay stored results out as versions 1 and 2 did: figures, a file for each matcher and for what was learnt."""
    runs, answers = pq.read_table(folder / "runs.parquet"), pq.read_table(folder / "predictions.parquet")
    (folder / "predictions").mkdir()
    for row in runs.to_pylist():
        about = json.loads(row["about"])
        stem = f"{about['matcher']['name']}-{about['hash']}"
        mine = answers.filter(pc.equal(answers["matcher"], row["contestant"])).drop_columns(["matcher"])
        pq.write_table(mine, folder / "predictions" / f"{stem}.parquet")
        if row["learned"] is not None:
            path = folder / "learned" / stem / Path(about["learned"]["file"]).name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(row["learned"], encoding="utf-8")
    pq.write_table(runs.drop_columns(["learned"]), folder / "runs.parquet")
    (folder / "predictions.parquet").unlink()
    (folder / "figures").mkdir()
    (folder / "figures" / "a.svg").write_text("<svg/>", encoding="utf-8")
    hash_again(folder, schema_version=version)


def contents_of(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_results_of_a_former_layout_are_read_as_before_and_replaced_whole(kept, own, tmp_path):
    unpack(own, tmp_path / "now")
    as_former(own, 2)
    assert len(list((own / "learned").rglob("*.json"))) == 2
    unpack(own, tmp_path / "former")
    assert contents_of(tmp_path / "now") == contents_of(tmp_path / "former")
    assert len(read_stored_predictions(own, "random")) == len(kept[0].predictions["random"])
    pack_board(kept[0], request_of(kept[1]), own)
    assert {path.name for path in own.iterdir()} == {path.name for path in kept[2].iterdir()}


def test_a_former_file_with_an_answer_too_many_is_refused(own, mistake):
    as_former(own, 2)
    (path,) = own.glob("predictions/random-*.parquet")
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table, table.slice(0, 1)]), path)
    hash_again(own)
    assert "runs.parquet does not tell the" in mistake("score", "--predictions", own)


def test_results_of_the_first_version_are_read_without_hashes_and_may_be_replaced(kept, own, tmp_path):
    as_former(own, 1)
    record = json.loads((own / "pack.json").read_text(encoding="utf-8"))
    del record["files"]
    (own / "pack.json").write_text(json.dumps(record), encoding="utf-8")
    former = shutil.copytree(own, tmp_path / "former")
    assert read_pack(own).files is None
    assert len(unpack(own, tmp_path / "into").runs) == len(pq.read_table(own / "runs.parquet"))
    pack_board(kept[0], request_of(kept[1]), own)
    assert json.loads((own / "pack.json").read_text(encoding="utf-8"))["schema_version"] == 3
    (former / "NOTES.txt").touch()
    with pytest.raises(StoreError, match=r"1 file \(NOTES.txt\) that would be lost"):
        pack_board(kept[0], request_of(kept[1]), former)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_site")
def test_publishing_stored_results_draws_their_figures_and_leaves_them_as_they_are(kept, tmp_path):
    _, plan, folder, _ = kept
    before, lines = contents_of(folder), []
    with reporting(lines.append):
        site = publish(folder, tmp_path / "site", root=plan.out).folder
    first = plan.out / "boards" / "kept"
    for kind in ("figures", "pictures"):
        drawn = [path for path in (first / kind).rglob("*.*") if path.suffix in {".svg", ".webp"}]
        assert drawn
        for path in drawn:
            assert path.read_bytes() == (site / path.relative_to(first)).read_bytes(), path.name
    for name in ("leaderboard.csv", "leaderboard.tex", "leaderboard.md"):
        assert (first / name).read_bytes() == (site / "files" / name).read_bytes()
    assert contents_of(folder) == before
    assert not [line for line in lines if "differ from those" in line]


@pytest.mark.usefixtures("undrawn", "plain_site")
def test_publishing_stored_results_whose_tables_are_of_another_version_says_so(own, tmp_path):
    table = read_frame(own / "leaderboard.parquet", mend="")
    table.assign(value=0.5).to_parquet(own / "leaderboard.parquet")
    (own / "paper.md").write_text("as the paper has it", encoding="utf-8")
    hash_again(own)
    lines = []
    with reporting(lines.append):
        site = publish(own, tmp_path / "site", root=tmp_path).folder
    assert f"the site shows the tables of this version, which differ from those in {own}: store them anew" in lines
    assert (site / "files" / "paper.md").read_text(encoding="utf-8") == "as the paper has it"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"split": 5}', "split is 5"),
        ('{"rejectors": 5}', "rejectors is 5"),
        ('{"rejectors": null}', "rejectors is None"),
        ('{"rejectors": [5]}', "rejectors.0 is 5"),
        ('{"draws": 1e400}', "1e400 is too large a number"),
        ('{"draws": 1000000000}', "draws is 1000000000"),
        ('{"by_region": 5}', "by_region is 5"),
        ('{"pipeline": 5}', "is 5"),
        ('{"pipeline": "x"}', "is 'x'"),
        ('{"pipeline": {"id": "../../x", "sha256": ""}}', "'../../x'"),
        ('{"contrasts": [5]}', "contrasts.0 is 5"),
        ('{"contrasts": [{"name": "a", "first": "b", "second": 5, "suites": []}]}', "contrasts.0.second is 5"),
        ('{"contestants": {}}', "contestants is {}"),
        ('{"files": null}', "lists no files"),
        ('{"files": {"a": 5}}', "files.a is 5"),
        ('{"splitt": "crossfit"}', "splitt is 'crossfit': Extra inputs are not permitted"),
        ('{"pipeline": {"id": "demo", "sha256": "", "x": 1}}', "pipeline.x is 1: Extra inputs"),
        ('{"schema_version": 4}', "has schema version 4"),
        ("[" * 200_000, "nested too deep"),
    ],
)
def test_settings_of_another_type_are_one_line(own, mistake, text, fault):
    if text.startswith("{"):
        record = json.loads((own / "pack.json").read_text(encoding="utf-8")) | json.loads(text)
        text = json.dumps(record).replace("Infinity", "1e400")
    (own / "pack.json").write_text(text, encoding="utf-8")
    line = mistake("score", "--predictions", own)
    assert fault in line
    assert str(own) in line
    assert len(line) < 600


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("runs", "rows", -3),
        ("runs", "rows", 1),
        ("runs", "rows", 2**60),
        ("runs", "contestant", "other"),
        ("runs", "about", "{}"),
        ("tasks", "task_json", "{}"),
        ("tasks", "task_json", "[" * 100_000),
        ("tasks", "truth_json", "{}"),
        ("truths", "candidate", 10**6),
        ("truths", "pair_id", None),
        ("truths", "block", None),
        ("truths", "role", "x"),
        ("truths", "strength", float("nan")),
        ("truths", "easting_m", float("nan")),
        ("truths", "easting_m", None),
        ("truths", "query_id", "other"),
        ("truths", "task", 99),
        ("truths", "measured", [("age_years", None)]),
        ("queries", "view_bytes", None),
        ("queries", "view_bytes", -1),
        ("queries", "prior_group", "x"),
        ("queries", "candidates", [{"easting_m": float("inf"), "northing_m": 0.0, "yaw_deg": 0.0, "scale": 1.0}]),
        ("predictions", "status", "x"),
        ("predictions", "query_id", "other"),
        ("predictions", "confidence", 7.0),
        ("predictions", "latency_s", -1.0),
        ("predictions", "candidates", [{"easting_m": 0.0, "northing_m": 0.0, "yaw_deg": 0.0, "scale": 0.0}]),
    ],
)
def test_rows_that_nobody_scores_are_one_line_that_names_the_results(own, mistake, table, column, value):
    (path,) = own.glob(f"{table}.parquet")
    found = pq.read_table(path)
    rows = found.to_pylist()
    rows[0][column] = value
    pq.write_table(pa.Table.from_pylist(rows, schema=found.schema), path)
    hash_again(own)
    line = mistake("score", "--predictions", own)
    assert f"{own} holds no sound stored results (" in line
    assert "fetch them again" in line
    assert "sasgeo-bench-" not in line
    assert len(line) < 600


def test_a_table_of_other_columns_is_one_line(own, mistake):
    pq.write_table(pq.read_table(own / "truths.parquet").drop_columns(["kind"]), own / "truths.parquet")
    hash_again(own)
    assert "truths.parquet holds no column 'kind'" in mistake("score", "--predictions", own)


def test_a_link_in_stored_results_is_refused_and_a_site_is_not(own, mistake, tmp_path):
    (own / "site").mkdir()
    (own / "site" / "index.html").touch()
    assert read_pack(own)
    (tmp_path / "secret").write_text("secret", encoding="utf-8")
    (own / "leaderboard.md").unlink()
    (own / "leaderboard.md").symlink_to(tmp_path / "secret")
    hash_again(own)
    assert "leaderboard.md is a link, or no file" in mistake("score", "--predictions", own)


def test_where_results_go_is_looked_at_before_anything_is_scored(own, mistake, tmp_path):
    def refused(folder, *more):
        line = mistake("score", "--predictions", own, "--name", "mine", "--results", folder, *more)
        assert not (tmp_path / "out").exists() or not any((tmp_path / "out").rglob("board.json"))
        return line

    for name in ("thesis/mine", "file"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "thesis" / "mine" / "chapter.txt").touch()
    (tmp_path / "file" / "mine").touch()
    assert "holds something else than stored results" in refused(tmp_path / "thesis")
    assert "holds something else than stored results" in refused(tmp_path / "file")
    assert "is a file: name another folder" in refused(tmp_path / "file" / "mine")
    assert "would lie in the board" in refused(tmp_path / "out" / "boards" / "mine")
    assert "would lie in the board" in refused(own / "more")
    assert "would take the place of the board" in refused(tmp_path / "out" / "boards")
    assert "would take the place of the board" in refused(tmp_path, "--out", tmp_path / "mine")
    assert "--results names no folder" in refused("")
    shutil.copytree(own, tmp_path / "there" / "mine")
    (tmp_path / "there" / "mine" / ".git").mkdir()
    (tmp_path / "there" / "mine" / ".git" / "HEAD").touch()
    (tmp_path / "there" / "mine" / "NOTES.txt").touch()
    assert "2 files (.git/HEAD, NOTES.txt) that would be lost" in refused(tmp_path / "there")


def test_what_cannot_be_written_is_told_before_anything_is_scored(own, mistake, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(folders.tempfile, "TemporaryDirectory", refuse)
    line = mistake("score", "--predictions", own, "--results", tmp_path / "results")
    assert "cannot be written (Read-only file system): check your rights, or name another folder" in line


def test_a_pipeline_looks_where_results_go_before_it_draws(kept, tmp_path):
    plan = replace(kept[1], out=tmp_path / "out")
    (tmp_path / "kept").touch()
    with pytest.raises(StoreError, match="holds something else than stored results"):
        run_pipeline(plan, results=tmp_path)
    assert not (tmp_path / "out").exists()


def test_results_are_stored_where_a_link_leads(kept, own, tmp_path):
    (tmp_path / "kept").symlink_to(own)
    pack_board(kept[0], request_of(kept[1]), tmp_path / "kept")
    assert (tmp_path / "kept").is_symlink()
    assert read_pack(own).split == "crossfit"
    (tmp_path / "one").symlink_to(tmp_path / "two")
    (tmp_path / "two").symlink_to(tmp_path / "one")
    with pytest.raises(StoreError, match="leads in a circle"):
        pack_board(kept[0], request_of(kept[1]), tmp_path / "one")


def test_a_full_disk_is_a_short_line(kept, tmp_path, monkeypatch):
    def fill(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archive_file.shutil, "copyfile", fill)
    with pytest.raises(StoreError, match=r"cannot be written \(No space left on device\)") as caught:
        pack_board(kept[0], request_of(kept[1]), tmp_path / "kept")
    assert len(str(caught.value)) < 400


def test_a_board_of_absent_places_alone_has_figures_of_what_is_left(kept):
    scored, lines = kept[0], []
    absent = {name: frame.assign(is_present=False) for name, frame in scored.scores.items()}
    bare = replace(scored.board, contrasts=CONTRAST_SCHEMA.empty())
    with reporting(lines.append):
        figures = figures_extra(replace(scored, scores=absent, board=bare)).figures
    assert "age of the map" in lines[-1]
    assert "strength" not in " ".join(figures)


def test_a_name_that_leads_out_is_refused(kept, tmp_path):
    board, plan, _, _ = kept
    pack_board(board, request_of(plan), tmp_path / "kept")
    table = pq.read_table(tmp_path / "kept" / "tasks.parquet")
    rows = table.to_pylist()
    rows[0]["task_json"] = json.dumps(json.loads(rows[0]["task_json"]) | {"region": "../../out"})
    pq.write_table(table.from_pylist(rows, schema=table.schema), tmp_path / "kept" / "tasks.parquet")
    hash_again(tmp_path / "kept")
    with (
        pytest.raises(StoreError, match="is no name of a folder"),
        laid_out(ScoreRequest(predictions=[tmp_path / "kept"], root=tmp_path, board=tmp_path / "board")),
    ):
        pass


def test_stored_results_hold_their_own_tasks_and_stand_alone(kept, tmp_path):
    _, _, folder, _ = kept
    with (
        pytest.raises(ConfigError, match="hold their own tasks: leave --tasks away"),
        laid_out(ScoreRequest(predictions=[folder], tasks=[tmp_path], root=tmp_path, board=tmp_path / "board")),
    ):
        pass
    with pytest.raises(ConfigError, match="are both stored results"):
        stored_settings([folder, folder])
    assert [item.name for item in stored_settings([folder]).contrasts] == ["nothing"]


@pytest.mark.usefixtures("undrawn")
def test_answers_of_ones_own_are_scored_beside_stored_results(kept, program, tmp_path):
    _, _, folder, _ = kept
    answers = pq.read_table(folder / "predictions.parquet")
    pq.write_table(answers.filter(pc.equal(answers["matcher"], "random")), tmp_path / "mine.parquet")
    args = ("--predictions", folder, "--predictions", tmp_path / "mine.parquet", "--out", tmp_path, "--draws", 100)
    code, _, err = program("score", *args)
    assert code == 4, err
    table = pd.read_parquet(tmp_path / "boards" / "board" / "leaderboard.parquet")
    rows = table[(table["metric"] == "success_25m") & (table["stratum"] == "all")].set_index("matcher")["value"]
    assert rows["mine"] == rows["random"]
