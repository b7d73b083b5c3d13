# SPDX-License-Identifier: Apache-2.0
"""A board of flights: figures along the way, maps of a flight, its page, and stored results that give it again."""

import html
import json
import math
import re
import time
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards.board_files import read_leaderboard, read_scores
from sasgeo_bench.boards.board_pictures import FLIGHT_BYTES
from sasgeo_bench.boards.flight_page import ellipse_of, flight_page
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.cli.boards import score, show_board
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.scoring.flights import score_flights
from sasgeo_bench.scoring.requirements import compliance_frame, parse_requirements
from sasgeo_bench.tasks import flight_sampling, task_files
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.browser import PATIENCE_S, browser, find_chromium

pytestmark = pytest.mark.usefixtures("small_flight_views")

SUITE, REGION = "flight-overconfident", "town-riverside"
HASH = "0" * 12
SURE = (25.0, 0.0, 0.0, 0.0, 25.0, 0.0, 0.0, 0.0, 4.0)


def quiet(_):
    return None


def run(out, name, *, off_m, accepts):
    """Write the answers of a tracker that is so far off, and accepts every view whose number `accepts` takes."""
    task, truths = out / "tasks" / SUITE / REGION, task_files.read_truths(out / "truth" / SUITE / REGION)
    answers = []
    for number, truth in enumerate(truths):
        pose = replace(truth.pose, northing_m=truth.pose.northing_m + off_m)
        answers.append(
            Prediction(
                query_id=truth.query_id,
                candidates=((pose, 1.0),),
                is_accepted=accepts(number),
                covariance=SURE,
                latency_s=0.1,
            )
        )
    folder = out / "runs" / name / HASH / SUITE / REGION
    prediction_files.write_part(folder, answers, asked=task_files.Task.open(task).asked)
    about = {"matcher": {"name": name, "version": "1"}, "hash": HASH, "suite": SUITE, "region": REGION}
    sha256 = task_files.read_task(task)["files"][task_files.QUERIES]["sha256"]
    RunManifest(**about, queries_sha256=sha256, cpu_s=3.0).save(folder)


@pytest.fixture(scope="module")
def out(tmp_path_factory, lay_towns):
    """A root with two trackers, their board in boards/mine, and its stored results in results/mine."""
    root = lay_towns(tmp_path_factory.mktemp("flights") / "out", REGION)
    wanted = TaskRequest(
        suites=(SUITE,), regions=(REGION,), split="crossfit", count=2, seed=0, out=root, may_be_fewer=True
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))
        for request in plan_requests(wanted):
            make_tasks(request)
    run(root, "near", off_m=3.0, accepts=lambda _: True)
    run(root, "far", off_m=40.0, accepts=lambda number: number % 2 == 0)
    score(predictions=root / "runs", out=root, name="mine", draws=100, results=root / "results")
    return root


def test_figures_of_flights_stand_on_the_board(out):
    table = read_leaderboard(out / "boards" / "mine")
    whole = table[table["stratum"] == "all"].set_index(["matcher", "metric"])["value"]
    assert (whole["near", "distance_within_25m"], whole["far", "distance_within_25m"]) == (1.0, 0.0)
    assert (whole["near", "false_accepted"], whole["far", "distance_within_50m"]) == (0.0, 1.0)
    assert 0.4 < whole["far", "false_accepted"] < 0.6
    assert whole["near", "right_accepted"] == 1.0
    costs = table[table["suite"] == "all suites"].set_index(["matcher", "metric"])
    assert costs.loc[("near", "latency_p50"), "value"] == 0.1
    views = costs.loc[("near", "cpu_per_fix"), "n"]
    assert costs.loc[("near", "cpu_per_fix"), "value"] == pytest.approx(3.0 / views)
    assert costs.loc[("far", "cpu_per_fix"), "value"] > 1.5 * costs.loc[("near", "cpu_per_fix"), "value"]


def test_a_flight_is_a_row_and_not_a_view(out):
    rows = read_scores(out / "boards" / "mine")
    truths = list(task_files.read_truths(out / "truth" / SUITE / REGION))
    assert len(rows) == 2 * len({truth.query_id[:-6] for truth in truths})
    assert rows["views"].sum() == 2 * len(truths)
    assert (rows["track"] == "sequence").all()


def test_errors_along_the_way_and_how_rarely_the_map_may_be_asked_are_drawn(out):
    names = {path.name.split("-")[0] for path in (out / "boards" / "mine" / "figures").glob("*.svg")}
    assert {"distance", "interval", "drift", "stress", "price"} <= names
    assert not {"errors", "recall", "risk", "cost"} & names
    (drawn,) = (out / "boards" / "mine" / "figures").glob("distance-*.svg")
    text = drawn.read_text(encoding="utf-8")
    assert "Error along the way" in text
    assert ">1000<" in text


def test_a_flight_is_shown_with_a_map_for_each_tracker(out):
    board = out / "boards" / "mine"
    (flight,) = json.loads((board / "pictures" / "pictures.json").read_text(encoding="utf-8"))["flights"]
    assert flight["suite"] == SUITE
    assert flight["alt"].endswith("with the estimates of far, near")
    path = board / "pictures" / flight["file"]
    assert path.stat().st_size <= FLIGHT_BYTES
    assert cv2.imread(str(path)).shape[1] > 700


@pytest.mark.usefixtures("plain_site")
def test_the_page_of_a_suite_has_its_table_figures_and_flight(out):
    publish(out / "boards" / "mine", root=out)
    (page,) = (out / "boards" / "mine" / "site").glob(f"suite*{SUITE}*.html")
    text = page.read_text(encoding="utf-8")
    for shown in ("distance_within_25m", "false_accepted", f"flights/{SUITE}.webp", "distance-"):
        assert shown in text


@pytest.mark.usefixtures("undrawn")
def test_stored_results_give_the_same_board(out):
    again = score(predictions=out / "results" / "mine", out=out, name="again", draws=100, cases=False)
    first, second = (
        frame.sort_values(["matcher", "suite", "stratum", "metric"], ignore_index=True)
        for frame in (read_leaderboard(out / "boards" / "mine"), again.leaderboard)
    )
    columns = ["matcher", "suite", "stratum", "metric", "n", "value", "lo", "hi"]
    pd.testing.assert_frame_equal(first[columns], second[columns], check_dtype=False)


ASKED = {
    "within": ["5m,1deg"],
    "require": ["80% within 50 m, p95 latency 400 ms", "false <= 1%, available_30s >= 30%, false_of_confirmed <= 1%"],
}


@pytest.mark.usefixtures("undrawn", "plain_site")
def test_limits_and_requirements_are_on_the_board_its_page_and_on_stored_results_scored_again(out, tmp_path, capsys):
    results = tmp_path / "results"
    board = score(predictions=out / "runs", out=out, name="asked", draws=100, cases=False, results=results, **ASKED)
    mine = board.leaderboard[board.leaderboard["metric"] == "distance_within_5m_1deg"]
    assert mine[mine["stratum"] == "all"].set_index("matcher")["value"].to_dict() == {"near": 1.0, "far": 0.0}
    plain = read_leaderboard(out / "boards" / "mine")
    more = {"distance_within_5m_1deg", "latency_within_0.4s"}
    rest = board.leaderboard[~board.leaderboard["metric"].isin(more)].reset_index(drop=True)
    pd.testing.assert_frame_equal(rest, plain)  # not a digit of the others depends on what is asked
    found = board.requirements.set_index(["requirement", "matcher"])["verdict"]
    assert found["80% within 50 m"].to_dict() == dict.fromkeys(("far", "near"), "not shown")  # flights are few
    assert (found["false <= 1%", "far"], found["available_30s >= 30%", "near"]) == ("fails", "passes")

    about = json.loads((board.folder / "board.json").read_text(encoding="utf-8"))
    assert {name: about[name] for name in ASKED} == ASKED
    assert not ASKED.keys() & json.loads((out / "boards" / "mine" / "board.json").read_text(encoding="utf-8")).keys()
    again = score(predictions=results / "asked", out=tmp_path, name="asked", cases=False)
    pd.testing.assert_frame_equal(again.requirements, board.requirements)
    site = publish(again.folder, tmp_path / "site", root=out).folder
    text = (site / "index.html").read_text(encoding="utf-8")
    assert "Who meets the requirements" in text
    assert "files/requirements.parquet" in text
    assert "available_30s &gt;= 30%" in text
    (page,) = site.glob(f"suite*{SUITE}*.html")
    assert "Share of the flown distance with an estimate within 5m and 1deg" in page.read_text(encoding="utf-8")
    text = (board.folder / "leaderboard.md").read_text(encoding="utf-8")
    assert "| matcher | all | 80% within 50 m |" in text
    (shares,) = (line.split("|") for line in text.splitlines() if line.startswith("| far ") and "accepted" in line)
    confirmed = board.requirements.set_index(["requirement", "matcher"])["accepted"]["false_of_confirmed <= 1%", "far"]
    assert sum(f"of {100 * confirmed:.3g} % confirmed" in cell for cell in shares) == 1
    assert sum(" % accepted" in cell for cell in shares) == 1
    assert "## Fixes in use: flight-overconfident" in text
    head = next(line for line in text.splitlines() if line.startswith("| matcher | distance_within_25m"))
    assert {"distance_within_5m_1deg", "distance_within_50m", "available_30s"} <= set(head.split(" | "))
    capsys.readouterr()
    show_board(board)
    shown = capsys.readouterr().out.splitlines()
    head = next(line for line in shown if SUITE in line and "matcher" in line)
    assert any(line.startswith("flights under stress  2 ") for line in shown)  # of six
    assert {"distance_within_5m_1deg", "distance_within_50m", "available_30s"} <= set(head.split())
    assert "| error_p95 (m) | first_fix (m) |" in text


@pytest.mark.parametrize(
    ("flag", "text", "fault"),
    [
        ("--within", "5 feet", "--within says '5 feet': '5 feet' is no limit"),
        ("--require", "fast enough", "--require says 'fast enough', which is no requirement: say it as in '80% within"),
    ],
)
def test_what_is_no_limit_or_requirement_is_a_line_and_leaves_no_board(out, mistake, flag, text, fault):
    assert fault in mistake("score", "--predictions", out / "runs", "--name", "odd", "--out", out, flag, text)
    assert not (out / "boards" / "odd").exists()


def test_a_run_of_flights_is_listed_and_its_worst_flight_drawn(out, program):
    code, printed, _ = program("inspect", str(out / "runs" / "far"), "--out", str(out))
    assert code == 0
    assert "far: 6 flights, the worst first (--query draws one)" in printed
    path = printed.rpartition("map of the worst flight: ")[2].splitlines()[0]
    assert cv2.imread(path).shape[1] > 300
    flight = read_scores(out / "boards" / "mine")["query_id"].iloc[0]
    code, printed, _ = program("inspect", str(out / "runs" / "far"), "--query", flight[:10], "--out", str(out))
    shown = out / "sheets" / f"far-{flight}.png"
    assert (code, printed) == (0, f"map of the flight: {shown}\npage that plays it: {shown.with_suffix('.html')}\n")


def test_a_flight_is_named_by_a_beginning_or_a_view_of_its_own_and_by_nothing_else(out, program):
    run_folder = str(out / "runs" / "far")
    flight = read_scores(out / "boards" / "mine")["query_id"].iloc[0]
    code, printed, _ = program("inspect", run_folder, "--query", f"{flight}000003", "--out", str(out))
    shown = out / "sheets" / f"far-{flight}.png"
    assert (code, printed) == (0, f"map of the flight: {shown}\npage that plays it: {shown.with_suffix('.html')}\n")
    for query, why in (("", "--query is empty"), ("../../", "was asked no query"), ("zz", "was asked no query")):
        code, _, err = program("inspect", run_folder, "--query", query, "--out", str(out))
        assert code == 2
        assert why in err


def page_of(out, name="far"):
    """The page of the first flight of a tracker, with what its script shows, and the truths of its views."""
    folder = out / "runs" / name / HASH / SUITE / REGION
    task = task_files.Task.open(out / "tasks" / SUITE / REGION, out)
    answers = {one.query_id: one for one in prediction_files.read_predictions(folder)}
    views = score_flights(tuple(task.heads()), task.truths, answers).views
    flight = views["sequence_id"].iloc[0]
    text = flight_page(task, flight, "<b>far</b>", views, answers)
    data = json.loads(text.partition("const flight = ")[2].partition(";\nconst count")[0])
    return text, data, [truth for truth in task.truths if truth.query_id.startswith(flight)], task


def test_the_page_of_a_flight_shows_each_view_where_it_was_and_was_believed(out):
    text, data, truths, task = page_of(out)
    assert "<b>far" not in text
    assert "&lt;b&gt;far&lt;/b&gt; on flight-overconfident over town-riverside" in text
    assert task.manifest.provenance.credit in html.unescape(text)
    assert re.search(r"(src|href)=.?https?:|url\(http", text) is None
    per_m = float(re.search(r"perMetre = ([0-9.e-]+)", text)[1])
    true = np.array([(truth.pose.easting_m, truth.pose.northing_m) for truth in truths])
    shown = np.column_stack([data["trueX"], data["trueY"]]) / per_m
    # right is east and down is south: the way from view to view is the same, to a tenth of a pixel
    np.testing.assert_allclose(np.diff(shown, axis=0) * (1, -1), np.diff(true, axis=0), atol=0.21 / per_m)
    off = np.column_stack([data["x"], data["y"]]) / per_m - shown
    np.testing.assert_allclose(off, np.tile((0, -40), (len(off), 1)), atol=0.21 / per_m)
    assert set(data["error"]) == {40.0}
    assert sum(data["accepted"]) in (len(truths) // 2, (len(truths) + 1) // 2)
    half_px = math.sqrt(25 * 5.991464547) * per_m
    assert data["ellipse"][0][:2] == pytest.approx([half_px, half_px], abs=0.01)
    assert len(text) < 1e6


def test_the_ellipse_of_a_covariance_is_as_long_and_turned_as_points_drawn_of_it():
    covariance = np.diag([0.0, 0.0, 1.0])
    covariance[:2, :2] = [[100.0, 60.0], [60.0, 50.0]]
    major, minor, turn_deg = ellipse_of(Prediction(query_id="", covariance=tuple(covariance.ravel())), 2.0)
    points = np.random.default_rng(1).multivariate_normal([0, 0], covariance[:2, :2], 200_000) * (2.0, -2.0)  # pixels
    turn = np.radians(turn_deg)
    along, across = points @ [np.cos(turn), np.sin(turn)], points @ [-np.sin(turn), np.cos(turn)]
    assert abs(np.corrcoef(along, across)[0, 1]) < 0.01
    assert np.mean((along / major) ** 2 + (across / minor) ** 2 <= 1) == pytest.approx(0.95, abs=0.003)
    assert major > minor
    assert ellipse_of(None, 1.0) is None
    assert ellipse_of(Prediction(query_id=""), 1.0) is None
    assert ellipse_of(Prediction(query_id="", covariance=(0.0,) * 9), 1.0) is None


def test_of_very_many_views_every_second_one_is_shown(out, monkeypatch):
    _, whole, truths, _ = page_of(out)
    monkeypatch.setattr("sasgeo_bench.boards.flight_page.MOST_VIEWS", len(truths) - 1)
    text, data, _, _ = page_of(out)
    assert f"One of 2 of the {len(truths)} views is shown." in text
    assert data["frame"] == whole["frame"][::2]


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine (.ci/install-chromium installs one)")
def test_the_page_plays_in_a_browser_from_a_file_and_asks_nobody(out, tmp_path):
    text, data, _, _ = page_of(out)
    path = tmp_path / "flight.html"
    path.write_text(text, encoding="utf-8")
    with browser(find_chromium(), tmp_path / "profile") as page:
        page.width(400)
        page.open(f"{path.as_uri()}#3")
        assert page.value("document.getElementById('frame').textContent").startswith("3 of ")
        assert page.value("document.getElementById('error').textContent") == "40 m"
        assert page.value("document.getElementById('fix').textContent") in ("accepted, FALSE", "not accepted")
        assert page.value("document.documentElement.scrollWidth <= 400")
        page.value("(show(0), document.getElementById('speed').value = '40', document.getElementById('play').click())")
        last, end = len(data["frame"]) - 1, time.monotonic() + PATIENCE_S
        while page.value("document.getElementById('at').value") != str(last):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert [url for url in page.asked if not url.startswith(("file:", "data:"))] == []
        assert page.faults == []


def test_the_receiver_is_checked_by_the_fixes_of_a_run(out, program, mistake):
    code, printed, err = program("check-gnss", str(out / "runs" / "near"), "--out", str(out), "--pull-off", "2,20")
    assert code == 0, err
    rows = [line.split() for line in printed.splitlines()[1:] if line.strip()]
    assert [row[:4] for row in rows] == [[SUITE, REGION, "6", "2"]] * 2
    scores = read_scores(out / "boards" / "mine")
    hours = scores.groupby("pair_id")["duration_s"].first().sum() / 3600
    assert float(rows[0][4]) == pytest.approx(hours, rel=0.05)  # three flights along one path are one
    assert "one path count as one" in err
    assert [row[6] for row in rows] == ["0.00"] * 2  # false alarms: its fixes are 3 m off
    assert float(rows[0][7]) == pytest.approx(2.996 / hours, rel=0.01)  # the rule of three
    assert rows[1][9] == "100%"
    # fixes that are accepted 40 m off alarm every flight
    printed = program("check-gnss", str(out / "runs" / "far"), "--out", str(out))[1]
    assert float(printed.splitlines()[1].split()[6]) > 0
    assert "--pull-off must be positive metres a second" in mistake(
        "check-gnss", out / "runs" / "near", "--pull-off", "0"
    )


def test_a_requirement_of_single_views_is_not_shown_of_flights_and_not_passed_over(out):
    board = read_leaderboard(out / "boards" / "mine")
    rows = compliance_frame(parse_requirements(["position_p95 <= 30 m, 1% within 200 m"]), board)
    found = {(row["matcher"], row["requirement"]): row["verdict"] for row in rows.to_dict("records")}
    assert {name for name, _ in found} == {"near", "far"}
    assert {verdict for (_, text), verdict in found.items() if text.startswith("position")} == {"not shown"}
    assert len(found) == 4
