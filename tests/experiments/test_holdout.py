# SPDX-License-Identifier: Apache-2.0
"""A hold-out: learn on train places once, fit rejectors on calibration places, rank test places alone."""

import json
from pathlib import Path

import pytest

from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments import pipeline_plan
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import plan_pipeline
from tests.handmade import split_file

pytestmark = pytest.mark.usefixtures("in_threads", "without_drawings", "few_controls")

TRAIN, CALIBRATION, TEST = "town-agricultural", "town-grid", "town-suburb"
TEXT = """
id = "held"
title = "Held out"
split = "SPLIT"
regions = ["town-agricultural", "town-grid", "town-suburb"]
matchers = ["learners:Counts", "learners:Oracle", "prior_centre"]
rejectors = ["margin"]
draws = 100

[[task]]
suites = ["clean"]
sites = 1
views_cells = [192]
tracks = ["localization"]

[learning]
suites = ["clean"]
most = 5
oracles = ["learners:Oracle"]
"""


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "running"))


@pytest.fixture
def plan_of(tmp_path):
    """Plan the pipeline with changes of its text; the split names the part of each town unless it is given."""

    def made(split=None, **changes):
        split = split or split_file(tmp_path, agricultural="train", grid="calibration", suburb="test")
        text = TEXT.replace("SPLIT", str(split))
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        return plan_pipeline(parse_toml(text, PipelineFile, source="held.toml"), out=tmp_path / "out")

    return made


def requests_of(plan):
    return [(item.suite, item.region.id) for item in plan.requests]


@pytest.mark.slow
def test_train_places_teach_calibration_places_fit_rejectors_and_test_places_are_ranked(plan_of, lay_towns, tmp_path):
    lay_towns(tmp_path / "out", TRAIN, CALIBRATION, TEST)
    plan = plan_of()
    lines = plan.to_text().splitlines()
    learning = lines.index(
        "  learning: calibration and test places are asked after learning from train places (clean, at most 5 queries)"
    )
    assert lines[learning + 1 : learning + 5] == [
        f"    train: 1 place ({TRAIN})",
        f"    calibration: 1 place ({CALIBRATION})",
        f"    test: 1 place ({TEST})",
        "    learners:Oracle: from calibration and test places themselves, never ranked",
    ]
    board = run_pipeline(plan)
    about = json.loads((tmp_path / "out" / "boards" / "held" / "board.json").read_text(encoding="utf-8"))
    learned = {entry["name"]: entry["learned"] for entry in about["entries"]}
    (counts,), (oracle,) = learned["counts"], learned["oracle_counts"]
    assert counts["trained_on"] == [TRAIN]
    assert oracle["trained_on"] == [CALIBRATION, TEST]
    assert (
        counts["asked"]
        == oracle["asked"]
        == [
            f"clean/{CALIBRATION}",
            f"clean/{TEST}",
            f"controls/{TEST}+controls",
        ]
    )
    # Nobody was asked where a matcher learned, nothing of it is on the board, and figures are of the test place alone.
    assert [path for path in (tmp_path / "out" / "runs").rglob("run.json") if TRAIN in str(path)] == []
    assert not any(TRAIN in task["region"] for task in about["tasks"])
    assert {place for frame in board.scores.values() for place in frame["place"]} == {TEST}
    assert {place for frame in board.with_calibration.values() for place in frame["place"]} == {CALIBRATION, TEST}
    judged = [frame for (_, rejector), frame in board.judged.items() if rejector == "margin"]
    assert {place for frame in judged for place in frame["place"]} == {TEST}
    assert "      held out: trained on 5 queries of 1 place (town-agricultural)" in plan.to_text().splitlines()


def test_on_train_places_only_suites_to_learn_from_are_drawn(plan_of):
    found = requests_of(plan_of(**{"[learning]": '[[task]]\nsuites = ["alias"]\nsites = 1\n\n[learning]'}))
    assert ("alias", TRAIN) not in found
    assert ("clean", TRAIN) in found
    assert [name for suite, name in found if suite == "alias"] == [CALIBRATION, TEST]


def test_without_learning_train_places_are_left_out_in_one_line(plan_of):
    lines = []
    text = TEXT[TEXT.index("[learning]") :]
    with reporting(lines.append):
        found = requests_of(plan_of(**{text: "", '"learners:Counts", "learners:Oracle", ': ""}))
    assert {name for _, name in found} == {CALIBRATION, TEST}
    assert lines == [f"nothing learns, so train places are left out: {TRAIN}"]


PICTURES = """[[task]]
suites = ["aerial"]
sites = 1
kinds = ["P1"]
segmenters = ["pixel_forest"]
detectors = ["DETECTOR"]

"""


@pytest.mark.parametrize(("detector", "is_drawn"), [("rendered", True), ("shifted", False)])
def test_pictures_of_train_places_are_drawn_for_segmenters_to_learn_from(plan_of, detector, is_drawn):
    pictures = PICTURES.replace("DETECTOR", detector)
    text = TEXT[TEXT.index("[learning]") :]
    found = requests_of(plan_of(**{text: pictures, '"learners:Counts", "learners:Oracle", ': ""}))
    assert (("aerial", TRAIN) in found) == is_drawn
    assert ("clean", TRAIN) not in found


def test_a_matcher_learns_from_what_a_segmenter_saw_on_train_places(plan_of):
    learning = '[learning]\nsuites = ["aerial+pixel_forest"]\ndetector = "shifted"\n'
    pictures = PICTURES.replace("DETECTOR", "shifted")
    found = requests_of(plan_of(**{'[learning]\nsuites = ["clean"]\n': pictures + learning}))
    assert ("aerial", TRAIN) in found
    assert ("clean", TRAIN) not in found


def test_controls_are_drawn_where_nothing_trains(plan_of, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline_plan, "CONTROL_REGIONS", ("town-riverside", TRAIN))
    assert {item.region.id for item in plan_of().controls} == {"town-riverside"}
    monkeypatch.setattr(pipeline_plan, "CONTROL_REGIONS", (TRAIN,))
    (control,) = plan_of().controls
    assert control.region.id.startswith("town-")
    assert control.region.id != TRAIN
    every = dict.fromkeys(("agricultural", "grid", "industrial", "old_town", "riverside"), "train")
    split = split_file(tmp_path, **every, suburb="sealed test")
    with pytest.raises(ConfigError, match="controls need one: free one"):
        plan_of(split)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({'"town-agricultural", ': ""}, r"\[learning\] has no region of a train place of the hold-out 'towns-alone'"),
        ({', "town-suburb"]': "]"}, "no region is of a test place of the hold-out 'towns-alone'"),
    ],
)
def test_a_hold_out_without_a_place_to_learn_from_or_to_rank_is_refused_in_one_line(plan_of, changes, words):
    with pytest.raises(ConfigError, match=words) as error:
        plan_of(**changes)
    assert "\n" not in str(error.value)


def test_a_region_that_trains_and_tests_is_refused_where_something_learns(plan_of, tmp_path):
    split = split_file(tmp_path, agricultural="train", grid="calibration", suburb="test")
    text = split.read_text(encoding="utf-8").replace("5000.0", "0.0\nblock_m = 100.0\nreach_m = 0.0")
    blocks = 'blocks = ["town-suburb/{}-{}"]'
    whole = 'regions = ["town-suburb"]'
    text = text.replace(whole, blocks.format(0, 0))
    text += f'[[place]]\nname = "near"\npart = "train"\n{blocks.format(5, 5)}\n'
    split.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="region 'town-suburb' has blocks of the parts test and train of split"):
        plan_of(split)
