# SPDX-License-Identifier: Apache-2.0
"""Pictures of a board and of single queries: small, the same each time, and of what they say they are of."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards import board_pictures
from sasgeo_bench.boards.board_pictures import (
    CASE_BYTES,
    MOST_BYTES,
    REGION_BYTES,
    SUITE_BYTES,
    pictures_extra,
)
from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.cases import case_pixels, fitted, words_of
from sasgeo_bench.boards.run_cases import Case, facts_of, read_picture
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.split import find_split
from tests.plain_boards import plain_boards
from tests.slow import rest_slow

HASH = "0123456789ab"
FEW = 6  # cases that are drawn
ASKED = (("absent", "town-riverside"), ("alias", "town-grid+alias"))
EVERY = (*ASKED, ("no-priors", "town-riverside"))


def answer(query, truth, number):
    """Every third place is found, every third one missed by 300 m, and the others are withheld."""
    near, far = (
        replace(truth.pose, easting_m=truth.pose.easting_m + off_m)
        if truth.pose
        else Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
        for off_m in (3.0, 300.0)
    )
    if query.candidates:
        near = far = query.candidates[0]
    poses = ((near, 2.5), (far, 1.25)) if number % 3 == 0 else ((far, 2.5), (near, -1.0))
    return Prediction(
        query_id=query.query_id,
        candidates=() if number % 3 == 1 else poses,
        confidence=0.5,
        diagnostics={"margin_nats": 1.25, "odd": float(number)},
        latency_s=0.1,
    )


@pytest.fixture(scope="module")
def root(tasks, tmp_path_factory):
    """A root with runs of its own beside tasks, truths and maps that others share."""
    out = tmp_path_factory.mktemp("pictures") / "out"
    out.mkdir()
    for kind in ("tasks", "truth", "regions"):
        (out / kind).symlink_to(tasks / kind)
    for suite, region in ASKED:
        folder = out / "runs" / "mine" / HASH / suite / region
        task = out / "tasks" / suite / region
        truths = {truth.query_id: truth for truth in task_files.read_truths(out / "truth" / suite / region)}
        answers = [answer(query, truths[query.query_id], at) for at, query in enumerate(task_files.read_queries(task))]
        prediction_files.write_part(folder, answers, asked=task_files.Task.open(task).asked)
        about = {"matcher": {"name": "mine", "version": "1"}, "hash": HASH, "suite": suite, "region": region}
        sha256 = task_files.read_task(task)["files"][task_files.QUERIES]["sha256"]
        RunManifest(**about, queries_sha256=sha256).save(folder)
    return out


@pytest.fixture(scope="module")
def made(root, tmp_path_factory):
    """A board with its pictures, what was told, and the board in memory."""
    lines, kept = [], []

    def pictures(board):
        kept.append(board)
        with reporting(lines.append):
            return pictures_extra(board, root=root)

    folder = tmp_path_factory.mktemp("made") / "board"
    request = ScoreRequest(predictions=[root / "runs"], root=root, board=folder, draws=100)
    with pytest.MonkeyPatch.context() as patch, plain_boards():
        patch.setattr(board_pictures, "MOST_CASES", FEW)
        make_board(request, (pictures,))
        yield folder, lines, kept[0]


def test_a_board_lists_its_pictures_and_each_of_them_is_small(made):
    folder, lines, _ = made
    record = json.loads((folder / "pictures" / "pictures.json").read_text(encoding="utf-8"))
    assert record["attribution"] == "(c) OpenStreetMap contributors, ODbL"
    assert [one["region"] for one in record["regions"]] == ["town-grid", "town-riverside"]
    assert [one["suite"] for one in record["suites"]] == ["absent", "alias"]
    listed = {one["file"]: kind for kind in ("regions", "suites", "cases") for one in record[kind]}
    files = {path.relative_to(folder / "pictures").as_posix() for path in (folder / "pictures").rglob("*.webp")}
    assert files == set(listed)
    most = {"regions": REGION_BYTES, "suites": SUITE_BYTES, "cases": CASE_BYTES}
    sizes = {name: (folder / "pictures" / name).stat().st_size for name in files}
    assert all(size <= most[listed[name]] for name, size in sizes.items())
    assert sum(sizes.values()) <= MOST_BYTES
    assert all(cv2.imread(str(folder / "pictures" / name)) is not None for name in files)
    assert lines[-1].startswith(f"pictures: 2 of regions, 2 of suites, {len(record['cases'])} of cases, ")


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_several_processes_draw_the_same_pictures(made, root):
    folder, _, board = made
    drawn = pictures_extra(board, root=root, jobs=2).pictures
    there = {path.relative_to(folder / "pictures").as_posix() for path in (folder / "pictures").rglob("*.webp")}
    assert there <= set(drawn)
    assert all(drawn[name] == (folder / "pictures" / name).read_bytes() for name in there)


def test_each_case_says_what_it_is_of_in_plain_numbers_and_words(made):
    folder, _, board = made
    cases = json.loads((folder / "pictures" / "pictures.json").read_text(encoding="utf-8"))["cases"]
    assert {"absent accepted", "aliased"} <= {one["failure"] for one in cases}
    for one in cases:
        assert set(one) == {*("query_id", "matcher", "failure", "file", "suite", "region", "kind", "alt", "facts")}
        assert all(isinstance(value, str | float) for value in one["facts"].values())
        row = board.scores["mine"].set_index("query_id").loc[one["query_id"]]
        assert (row["suite"], row["region"], row["kind"]) == (one["suite"], one["region"], one["kind"])
        assert bool(row["is_present"]) == (one["failure"] != "absent accepted")
    (wrong,) = [one for one in cases if one["failure"] != "absent accepted" and one["suite"] == "absent"][:1]
    error_m = board.scores["mine"].set_index("query_id").loc[wrong["query_id"], "position_error_m"]
    assert wrong["facts"].get("error_m", np.inf) == pytest.approx(error_m)


def test_every_answer_has_its_place_and_every_failure_its_class(made):
    folder, _, board = made
    answers = pd.read_parquet(folder / "answers.parquet")
    scores = board.scores["mine"]
    asked = scores[scores["role"] != "falsifier"].set_index("query_id")
    assert set(answers["query_id"]) == set(asked.index)
    off_m = np.hypot(
        answers["fix_easting_m"] - answers["true_easting_m"], answers["fix_northing_m"] - answers["true_northing_m"]
    )
    expected = asked.loc[answers["query_id"], "position_error_m"].to_numpy(float)
    is_known = ~np.isnan(expected)  # of localization: candidates of a retrieval are right or wrong
    assert is_known.any()
    found = off_m.fillna(np.inf).to_numpy()[is_known]  # no answer is infinitely far off
    assert found == pytest.approx(expected[is_known], abs=0.2)
    is_wrong = ~asked.loc[answers["query_id"], "is_right"].to_numpy(bool) & answers["is_present"].to_numpy(bool)
    assert (answers.loc[is_wrong, "failure"] != "").all()
    cases = json.loads((folder / "pictures" / "pictures.json").read_text(encoding="utf-8"))["cases"]
    classes = answers.set_index(["query_id", "matcher"])["failure"]
    assert all(classes[one["query_id"], one["matcher"]] == one["failure"] for one in cases)


@pytest.fixture(scope="module")
def caseless(made, root):
    """What is drawn of the board without its cases, with the blocks of a split."""
    _, _, board = made
    return pictures_extra(board, root=root, split=find_split("crossfit"), has_cases=False)


def test_a_map_says_where_it_lies_and_which_blocks_it_has(caseless, root):
    first = json.loads(caseless.pictures["pictures.json"])["regions"][0]
    assert tuple(first["bounds_m"]) == read_manifest(root / "regions" / first["region"]).bounds_m
    edges = np.array([one["bounds_m"] for one in first["blocks"]])
    assert [*edges[:, :2].min(axis=0), *edges[:, 2:].max(axis=0)] == first["bounds_m"]
    assert first["blocks"][0]["name"] == f"{first['region']}/0-0"


def test_without_cases_no_truth_is_shown(caseless):
    assert not caseless.tables
    files = caseless.pictures
    assert {name.partition("/")[0] for name in files} == {"pictures.json", "regions", "suites"}
    assert json.loads(files["pictures.json"])["cases"] == []


def test_a_board_is_written_without_the_pictures_that_cannot_be_drawn(made, root, tmp_path):
    _, _, board = made
    (tmp_path / "tasks").symlink_to(root / "tasks")
    lines = []
    with reporting(lines.append):
        assert pictures_extra(board, root=tmp_path).pictures == {}
    assert any("holds no region.json: build the region first" in line for line in lines)
    assert lines[-1] == "pictures: 0 of regions, 0 of suites, 0 of cases, 0.00 MB"


def case_at(root, suite, region, number=0, **changes):
    task = root / "tasks" / suite / region
    truths = {truth.query_id: truth for truth in task_files.read_truths(root / "truth" / suite / region)}
    query = list(task_files.read_queries(task))[number]
    truth = truths[query.query_id]
    values = {"prediction": answer(query, truth, 0), "failure": "other", **changes}
    return Case(matcher="mine", query=query, truth=truth, **values), task_files.Task.open(task)


@pytest.mark.parametrize(
    ("asked", "prediction"),
    [
        *((asked, "answer") for asked in EVERY),
        *rest_slow((asked, None) for asked in EVERY),
        (ASKED[0], Prediction(query_id="x", status="timeout")),
    ],
)
def test_any_query_has_a_picture_answered_or_not_and_the_same_each_time(root, asked, prediction):
    changes = {} if prediction == "answer" else {"prediction": prediction}
    values = {"p_false": {"sure": 0.25}, "orders": {"margin": 0.5}, "accepted": {"sure": True}}
    case, task = case_at(root, *asked, **values, **changes)
    picture = read_picture(case, task)
    first, again = case_pixels(picture), case_pixels(read_picture(case, task))
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert fitted(first, CASE_BYTES) == fitted(again, CASE_BYTES)
    text = "\n".join(picture.lines)
    assert "P(false) sure: 0.25, accepted" in text
    assert "margin (an order, no probability): 0.5\n" in text
    assert ("margin_nats: 1.25 nat" in text) == (prediction == "answer")


def test_what_orders_answers_alone_is_told_apart_from_a_probability():
    rows = pd.DataFrame({"query_id": ["q"], "p_right": [0.25], "accepted_0.05": [True], "is_answered": [True]})
    words = {
        ("mine", "margin"): rows.assign(is_calibrated=False).set_index("query_id"),
        ("mine", "own"): rows.set_index("query_id"),
    }
    given = words_of(words, "mine", "q")
    assert (given["orders"], given["p_false"]) == ({"margin": 0.75}, {"own": 0.75})
    assert given["accepted"] == {"margin": True, "own": True}


def test_the_map_of_a_case_holds_both_places(root):
    case, task = case_at(root, "absent", "town-riverside")
    picture = read_picture(case, task)
    for pose in (case.truth.pose, case.fix):
        if pose is not None:
            assert picture.part.west_m <= pose.easting_m <= picture.part.east_m
            assert picture.part.south_m <= pose.northing_m <= picture.part.north_m
    np.testing.assert_array_equal(picture.at_true is None, case.truth.pose is None)


def test_what_is_not_known_of_a_case_is_not_said(root):
    case, _ = case_at(root, "absent", "town-riverside", prediction=None)
    given = facts_of(case)
    assert given["status"] == "missing"
    assert not {"error_m", "confidence", "score_margin"} & set(given)
    with_nan = Prediction(query_id=case.query.query_id, diagnostics={"odd": float("inf")})
    assert "reported_odd" not in facts_of(replace(case, prediction=with_nan))
    assert facts_of(replace(case, prediction=with_nan))["status"] == "withheld"


def test_a_picture_that_fits_in_no_quality_is_made_smaller():
    noise = np.random.default_rng(1).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    worst = len(cv2.imencode(".webp", noise, [cv2.IMWRITE_WEBP_QUALITY, 10])[1])
    found = cv2.imdecode(np.frombuffer(fitted(noise, worst - 1), np.uint8), cv2.IMREAD_COLOR)
    assert found.shape == (150, 150, 3)


def test_a_picture_that_fits_in_no_quality_and_size_is_refused():
    noise = np.random.default_rng(1).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    with pytest.raises(StoreError, match="a picture of 200 x 200 pixels does not fit into 100 bytes"):
        fitted(noise, 100)


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_inspect_counts_the_failures_of_a_run_and_draws_any_of_its_queries(root, program, tmp_path):
    run = root / "runs" / "mine" / HASH
    code, text, err = program("inspect", run)
    assert code == 0, err
    assert "absent accepted" in text
    assert re.search(r"failures in \d+ queries, \d+ of the queries under stress", text)
    assert not (tmp_path / "out").exists()
    query = task_files.Task.open(root / "tasks" / "alias" / "town-grid+alias").ids()[2]
    code, text, err = program("inspect", run, "--query", query[:10], "--out", tmp_path / "mine")
    assert code == 0, err
    path = Path(text.removeprefix("picture: ").strip())
    assert path == tmp_path / "mine" / "sheets" / f"mine-{query}.png"
    assert cv2.imread(str(path)).shape[2] == 3
    one = path.read_bytes()
    assert program("inspect", run / "alias" / "town-grid+alias", "--query", query, "--out", tmp_path / "mine")[0] == 0
    assert path.read_bytes() == one


def test_inspect_names_what_is_wrong_with_a_run_in_one_line(root, program, tmp_path):
    run = root / "runs" / "mine" / HASH

    def fault(*words):
        code, _, err = program("inspect", *words)
        assert code == 2, err
        assert "\n" not in err.strip().splitlines()[-1]
        return err

    assert "was asked no query 'zz'; 'inspect " in fault(run, "--query", "zz")
    assert "lists some that went wrong" in fault(run, "--query", "zz")
    known = task_files.Task.open(root / "tasks" / "alias" / "town-grid+alias").ids()[0]
    assert f"did you mean {known}?" in fault(run, "--query", known[:-1] + "z")
    assert "--query is empty: name the beginning of an id" in fault(run, "--query", "")
    assert "draws a query of a task or a run" in fault("crossfit", "--query", known)
    assert "ids begin with" in fault(run, "--query", next(_beginnings(root)))
    out = shutil.copytree(root, tmp_path / "out", symlinks=True)
    for kind in ("tasks", "truth"):
        (out / kind).unlink()
        shutil.copytree(root / kind, out / kind)
    mine = out / "runs" / "mine" / HASH / "alias" / "town-grid+alias"
    query = task_files.Task.open(out / "tasks" / "alias" / "town-grid+alias").ids()[0]
    rows = dict.fromkeys(task_files.Task.open(out / "tasks" / "alias" / "town-grid+alias").ids(), "f" * 64)
    old = prediction_files.Answers.open(
        mine, task_files.Task.open(out / "tasks" / "alias" / "town-grid+alias").asked
    ).found.values()
    for part in prediction_files.parts_of(mine):
        part.unlink()
    prediction_files.write_part(mine, list(old), asked=rows)
    assert "was drawn anew since" in fault(mine, "--query", query)
    shutil.rmtree(out / "truth" / "alias")
    assert "holds no truths of" in fault(mine, "--query", query)
    shutil.rmtree(out / "tasks" / "alias")
    assert "there is no folder" in fault(mine)
    (out / "regions").unlink()
    there = task_files.Task.open(out / "tasks" / "absent" / "town-riverside").ids()[0]
    assert "holds no region.json: build the region first" in fault(out / "runs" / "mine" / HASH, "--query", there)


def _beginnings(root):
    """First letters that several ids share."""
    names = [name for asked in ASKED for name in task_files.Task.open(root / "tasks" / asked[0] / asked[1]).ids()]
    return (name[0] for name in names if sum(other[0] == name[0] for other in names) > 1)
