# SPDX-License-Identifier: Apache-2.0
"""The stored results: they are of the file that is registered, small, and the page about them says what they say."""

import json
import re
import runpy
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from benchmarks import absent_places
from benchmarks.claims import tables
from benchmarks.rescored import differences, rescored
from sasgeo_bench.boards.archive import stored_settings
from sasgeo_bench.boards.archive_file import MOST_BYTES
from sasgeo_bench.boards.board import read_board
from sasgeo_bench.boards.pipeline_spec import find_pipeline_file, read_pipeline_file
from sasgeo_bench.scoring.segmenter_board import SegmenterBoard, page_tables, with_tables
from sasgeo_bench.tasks.query import PUBLISHED

RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAGES = sorted(RESULTS.glob("*.md"))
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
BOARDS = sorted(path.parent.name for path in RESULTS.glob("*/board.json"))
SEGMENTERS = RESULTS / "segmenters"
PROGRAM = re.compile(r"```python\n(.*?)```\n\n```text\n(.*?)```", re.DOTALL)
ROW = re.compile(r"^\|(?!---).*\|$", re.MULTILINE)

pytestmark = pytest.mark.skipif(not BOARDS, reason="no results are stored yet")


def test_there_are_results_of_the_registered_experiment():
    assert {"places", "modules"} <= set(BOARDS)


@pytest.mark.parametrize("name", BOARDS)
def test_results_are_of_the_pipeline_as_it_is_registered(name):
    spec = read_pipeline_file(find_pipeline_file(name))
    assert stored_settings([RESULTS / name]).pipeline == spec.identity
    record = json.loads((RESULTS / name / "board.json").read_text(encoding="utf-8"))
    assert {entry["name"] for entry in record["entries"]} >= set(spec.matchers) - {"oracle_pose"}


def test_a_stored_board_is_scored_again_alike(tmp_path):
    """The smallest one; a workflow does so with each of them every month."""
    assert rescored(RESULTS / "systems-pictures", tmp_path / "out") == []


def test_a_board_that_says_something_else_is_found(tmp_path):
    stored = RESULTS / "modules"
    for name, column in (("leaderboard", "value"), ("scores", "position_error_m"), ("contrasts", "difference")):
        table = pd.read_parquet(stored / f"{name}.parquet")
        table.loc[table[column].first_valid_index(), column] += 0.01
        table.to_parquet(tmp_path / f"{name}.parquet")
    figure, *columns = differences(stored, tmp_path)
    assert ", now " in figure
    assert columns == ["column position_error_m of scores.parquet", "column difference of contrasts.parquet"]


def test_results_are_small():
    assert sum(path.stat().st_size for path in RESULTS.rglob("*") if path.is_file()) < len(BOARDS) * MOST_BYTES


@pytest.mark.parametrize("name", BOARDS)
def test_all_controls_held(name):
    assert pd.read_parquet(RESULTS / name / "controls.parquet")["holds"].all()


@pytest.mark.parametrize("name", BOARDS)
def test_stored_truths_are_of_the_detectors_that_the_pipeline_names(name):
    """Truths of older boards have no column that would say so: they count as of the published one."""
    path = RESULTS / name / "truths.parquet"
    has_column = "detector" in pq.read_schema(path).names
    column = pq.read_table(path, columns=["detector"])["detector"].to_pylist() if has_column else [PUBLISHED]
    named = {detector for item in read_pipeline_file(find_pipeline_file(name)).task for detector in item.detectors}
    assert named <= set(column) <= named | {PUBLISHED}  # the controls of every board are of the published one


@pytest.fixture(scope="module")
def tables_of_pictures():
    """The lines that the programs of the page on pictures print of its boards."""
    program = runpy.run_path(str(RESULTS.parents[1] / "benchmarks" / "sim_to_real.py"))
    lines = []
    for board, matcher in (("aerial", "sasgeo"), ("aerial-soft", "raster_soft")):
        scores = program["read_scores"](RESULTS / board, 25.0, 5.0)
        suites = sorted(set(scores["suite"]) - {"real-image"})
        lines += [*program["by_evidence"](scores), *program["by_difference"](scores)]
        lines += program["by_suite"](scores, suites, matcher)
    program = runpy.run_path(str(RESULTS.parents[1] / "benchmarks" / "pictures.py"))
    for table in program["tables"](program["read_answers"](RESULTS / "pictures")):
        lines += table
    return {row.rstrip() for line in lines for row in line.splitlines()}


@pytest.fixture(scope="module")
def table_of_losses():
    """The lines that the program of the page on flights prints of its boards."""
    program = runpy.run_path(str(RESULTS.parents[1] / "benchmarks" / "lost_flights.py"))
    boards = (RESULTS / name for name in ("flights", "countries"))
    rows = [row for board in boards for row in program["lines"](program["flights_of"](board, "flight-real-age"))]
    return {*program["HEAD"].splitlines(), *rows}


@pytest.fixture(scope="module")
def table_of_systems():
    """The lines that the program of the paper's table prints of the board of systems."""
    program = runpy.run_path(str(RESULTS.parents[1] / "benchmarks" / "related_work.py"))
    return set(program["lines"](*program["read_board"](RESULTS / "systems")))


@pytest.fixture(scope="module")
def tables_of_claims():
    """The lines that the program of the pages of claims and of the experiment on places prints of its boards."""
    boards = [read_board(RESULTS / name) for name in ("places", "places-silent", "modules", "flights")]
    return {line for lines in tables(boards).values() for line in lines}


def test_no_table_of_the_experiment_is_missing_on_its_pages(tables_of_claims):
    text = "\n".join(TEXTS[RESULTS / f"{name}.md"] for name in ("README", "places"))
    assert [line for line in tables_of_claims if line and line not in text] == []


OF_ABSENT = re.compile(r"\| (matcher \| rejector|sasgeo|schmidt_segcorr) \|")  # rows of `benchmarks.absent_places`


def test_the_rows_of_the_page_of_claims_are_those_of_the_boards(tables_of_claims):
    rows = [row for name in ("README", "places") for row in ROW.findall(TEXTS[RESULTS / f"{name}.md"])]
    figures = [row for row in rows if not row.startswith(("| | |", "|:--", "| [")) and not OF_ABSENT.match(row)]
    assert len(figures) > 60
    assert [row for row in figures if row not in tables_of_claims] == []


@pytest.mark.slow
def test_the_rows_about_absent_places_are_those_of_their_program():
    words = absent_places.parsed([str(RESULTS / "places"), "--matchers", "sasgeo", "schmidt_segcorr"])
    rows = [row for row in ROW.findall(TEXTS[RESULTS / "places.md"]) if OF_ABSENT.match(row)]
    assert len(rows) == 11
    assert set(rows) <= set(absent_places.lines(words))


@pytest.mark.slow
def test_every_row_of_a_table_on_the_pages_stands_on_a_board(tables_of_pictures, table_of_losses, table_of_systems):
    boards = {line for path in RESULTS.glob("*/leaderboard.md") for line in path.read_text("utf-8").splitlines()}
    boards |= tables_of_pictures | table_of_losses | table_of_systems
    rows = {page.stem: ROW.findall(text) for page, text in TEXTS.items()}
    del rows[SEGMENTERS.name], rows["README"], rows["places"]  # held as wholes, below, and above
    assert sum(map(len, rows.values())) > 100
    assert {page: [row for row in some if row not in boards] for page, some in rows.items()} == {
        page: [] for page in rows
    }


def test_some_pages_have_programs():
    assert len([page for page, text in TEXTS.items() if PROGRAM.search(text)]) > 3


@pytest.mark.parametrize("page", [page for page in PAGES if PROGRAM.search(TEXTS[page])], ids=lambda path: path.stem)
def test_every_program_on_the_pages_prints_what_they_say(page, monkeypatch, capsys):
    monkeypatch.chdir(RESULTS.parents[1])
    for program, each in PROGRAM.findall(TEXTS[page]):
        exec(program, {})  # noqa: S102 - of our own page
        assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == each.splitlines()


@pytest.fixture(scope="module")
def segmenters():
    """The stored board of segmenters."""
    return SegmenterBoard.read(SEGMENTERS)


@pytest.fixture(scope="module")
def tables_of_segmenters(segmenters):
    """Its tables, as they stand on a page."""
    return page_tables(segmenters)


def test_the_tables_of_segmenters_are_those_of_their_board(segmenters, tables_of_segmenters):
    text = (SEGMENTERS / "leaderboard.md").read_text(encoding="utf-8")
    assert with_tables(text, segmenters) == text
    titles = re.findall("^## .*", tables_of_segmenters, re.MULTILINE)
    assert titles == re.findall("^## .*", text, re.MULTILINE)
    shown = [row for row in ROW.findall((RESULTS / "segmenters.md").read_text(encoding="utf-8")) if "[" in row]
    assert len(shown) > 10
    assert [row for row in shown if row not in tables_of_segmenters] == []


def test_figures_with_intervals_in_the_prose_about_segmenters_stand_in_its_tables(tables_of_segmenters):
    text = (RESULTS / "segmenters.md").read_text(encoding="utf-8")
    prose = " ".join(" ".join(line for line in text.splitlines() if not line.startswith("|")).split())
    found = re.findall(r"\d\.\d{3} \[\d\.\d{3}, \d\.\d{3}\]", prose)
    assert len(found) > 10
    assert [figure for figure in found if figure not in tables_of_segmenters] == []


def test_the_table_about_shares_among_the_concepts_is_of_the_board_of_segmenters(segmenters):
    text = (RESULTS.parent / "concepts" / "segmenters.md").read_text(encoding="utf-8")
    scores = segmenters.scores
    scores = scores[(scores["group"] == "all") & (scores["tested_on"] == "zanzibar")]
    found = scores.set_index(["segmenter", "learned_from", "shares", "metric"])["value"]
    columns = (
        ("plain", "auc"),
        ("plain", "iou"),
        ("plain", "ece"),
        ("picture", "iou"),
        ("flight", "iou"),
        ("flight", "ece"),
    )
    trials = {"-": "-", "rendered": "rendered", "zanzibar": "the other three blocks"}
    for segmenter, learned in (("colour_thresholds", "-"), ("pixel_forest", "rendered"), ("pixel_forest", "zanzibar")):
        figures = " | ".join(f"{found[segmenter, learned, shares, metric]:.3f}" for shares, metric in columns)
        assert f"| `{segmenter}` | {trials[learned]} | {figures} |" in text


def test_the_stored_board_of_segmenters_is_small_and_each_trial_has_a_profile(segmenters):
    assert sum(path.stat().st_size for path in SEGMENTERS.rglob("*.*") if path.is_file()) < 1_000_000
    assert len(segmenters.profiles) == len(segmenters.runs)
    for (segmenter, _, _), rows in segmenters.scores.groupby(["segmenter", "learned_from", "tested_on"]):
        assert {profile.segmenter for profile in segmenters.profiles.values()} >= {segmenter}
        assert set(rows.loc[rows["group"] == "all", "shares"]) == {"plain", "picture", "flight"}


@pytest.mark.parametrize(
    ("page", "board", "unsaid"),
    [
        ("pictures", "aerial-soft", set()),
        ("flights", "flights", set()),
    ],
)
def test_the_claims_on_a_page_are_the_differences_and_intervals_of_its_board(page, board, unsaid):
    text = " ".join((RESULTS / f"{page}.md").read_text(encoding="utf-8").split())
    found = pd.read_parquet(RESULTS / board / "contrasts.parquet").set_index("name")
    for name in set(found.index) - unsaid:
        row = found.loc[name]
        far = "" if pd.isna(row.get("lo_countries")) else "_countries"  # the interval that decides
        difference, lo, hi = (100 * row[column] for column in ("difference", f"lo{far}", f"hi{far}"))
        assert f"{difference:+.1f} points [{lo:.1f}, {hi:.1f}]" in text, name


def test_the_verdicts_that_the_pages_put_into_words_are_those_of_the_boards():
    outcomes = {
        board: pd.read_parquet(RESULTS / board / "contrasts.parquet").set_index("name")["outcome"] for board in BOARDS
    }
    values = {
        "places": {
            **dict.fromkeys(("scorer", "scorer-terms", "scorer-lure", "adaptive-lure", "rejection-natural"), "decided"),
            **dict.fromkeys(("scorer-twins", "geometry"), "cause open"),
            "adaptive-clean": "null",
            **dict.fromkeys(("graph-natural", "distinct"), "not decided"),
        },
        "places-silent": {"unknown": "null"},
        "modules": {
            **dict.fromkeys(("graph-junctions", "graph-instances"), "decided"),
            **dict.fromkeys(("graph-levels", "graph-warp", "learned-age", "prior-age", "prior-lure"), "not decided"),
            **dict.fromkeys(("age", "unknown", "correlation", "shift"), "not decided"),
            **dict.fromkeys(("rejection-alias", "rejection-absent"), "not decided"),
        },
        "flights": {
            **dict.fromkeys(("odometry", "stability"), "cause open"),
            **dict.fromkeys(("none", "age"), "not decided"),
            "odometry-stress": "decided",
            "diffusion": "null",
        },
    }
    for board, words in values.items():
        assert outcomes[board][list(words)].to_dict() == words
