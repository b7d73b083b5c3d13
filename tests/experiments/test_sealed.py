# SPDX-License-Identifier: Apache-2.0
"""Sealed places: left out without their seed, opened with it, and the board says when and by which seed."""

import datetime as dt
import json
from dataclasses import replace
from pathlib import Path

import pytest

from sasgeo_bench.boards.board_files import read_board_manifest
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.pipeline_spec import LearningSpec, PipelineFile
from sasgeo_bench.boards.text import sealed_lines
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments import sealed
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import TrainingGroups, plan_pipeline
from sasgeo_bench.experiments.sealed import open_seal
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import ensure_tasks
from sasgeo_bench.tasks.private_seed import (
    Opening,
    PrivateSeed,
    SealedPlace,
    joined_openings,
    openings_file,
    read_openings,
    record_openings,
)
from sasgeo_bench.tasks.split import find_split
from tests.handmade import split_file

pytestmark = pytest.mark.usefixtures("in_threads", "without_drawings", "few_controls")

OPEN, SEALED = "town-suburb", "town-grid"
SEED, OTHER = (PrivateSeed(digits * 16, is_sealed=True) for digits in ("3f", "a1"))
FIRST, SECOND = dt.date(2026, 3, 1), dt.date(2026, 4, 1)
TEXT = """
id = "closed"
title = "Closed"
split = "SPLIT"
regions = ["town-suburb", "town-grid"]
matchers = ["random"]
draws = 100

[[task]]
suites = ["clean"]
sites = 1
views_cells = [192]
tracks = ["localization"]
"""


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    return split_file(tmp_path_factory.mktemp("split"), agricultural="train", suburb="test", grid="sealed test")


def plan_of(split, out, *, regions=None, **seeds):
    text = TEXT.replace("SPLIT", str(split))
    text = text if regions is None else text.replace('["town-suburb", "town-grid"]', json.dumps(regions))
    return plan_pipeline(parse_toml(text, PipelineFile, source="closed.toml"), out=out, **seeds)


def about_board(out):
    return read_board_manifest(out / "boards" / "closed")


@pytest.mark.slow
def test_a_sealed_place_is_left_out_then_opened_by_a_seed_and_the_board_records_it(split, tmp_path, lay_towns):
    out = lay_towns(tmp_path / "out", OPEN, SEALED)
    lines = []
    with reporting(lines.append):
        plan = plan_of(split, out)
    assert lines == [
        f"sealed places of split 'towns-alone' are left out: {SEALED} (leaderboard --sealed-seed-file opens them)"
    ]
    assert f"  sealed {SEALED}: left out, not opened (--sealed-seed-file opens it)" in plan.to_text().splitlines()
    board = run_pipeline(plan)
    assert {place for frame in board.scores.values() for place in frame["place"]} == {OPEN}
    assert [path for path in out.rglob("*") if SEALED in path.name and "regions" not in path.parts] == []
    assert about_board(out).sealed == {SEALED: SealedPlace(drawn_by=None, openings=[])}
    text = (out / "boards" / "closed" / "leaderboard.md").read_text(encoding="utf-8")
    assert f"- Sealed place {SEALED}: not opened, and so not on this board." in text

    plan = plan_of(split, out, sealed=SEED)
    assert f"  sealed {SEALED}: to be opened, by seed {SEED.commitment[:12]}" in plan.to_text().splitlines()
    board = run_pipeline(plan, opened=FIRST)
    assert {place for frame in board.scores.values() for place in frame["place"]} == {OPEN, SEALED}
    opened = SealedPlace(drawn_by=SEED.commitment, openings=[Opening.of(SEED, FIRST)])
    assert about_board(out).sealed == {SEALED: opened}
    about = task_files.read_task(out / "tasks" / "clean" / SEALED)
    assert about["sealed_seed"] == {"commitment": SEED.commitment, "bits": 128}
    assert "private_seed" not in about
    assert SEED.text not in "".join(path.read_text(errors="replace") for path in out.rglob("*.json"))

    # With the same seed nothing is asked twice, and the day of the opening stays; another seed is a second opening.
    same = plan_of(split, out, sealed=SEED).to_text()
    assert f"  sealed {SEALED}: opened on {Opening.of(SEED, FIRST).to_text()}" in same.splitlines()
    assert "answered, 0 to ask" in next(line for line in same.splitlines() if line.startswith("    random: "))
    again = plan_of(split, out, sealed=OTHER)
    assert "opened again, after 2026-03-01 by seed" in again.to_text()
    record = open_seal(again.seal, again.requests, opened=SECOND, stored=None)
    assert [item.opened for item in record[SEALED].openings] == [FIRST, SECOND]
    (line,) = sealed_lines(record)
    assert line.startswith(f"Sealed place {SEALED}: opened on 2026-04-01")
    assert "this is opening 2, after 2026-03-01" in line
    assert record == open_seal(again.seal, again.requests, opened=SECOND, stored=None)


@pytest.mark.parametrize(
    ("day", "words"),
    [
        ("2026-02-28", "is before the recorded opening of sealed place town-grid, on 2026-03-01"),
        ("2999-01-01", "not come"),
    ],
)
def test_no_opening_is_dated_before_an_earlier_one_or_into_the_future(split, tmp_path, day, words):
    record_openings(tmp_path, "towns-alone", [SEALED], Opening.of(SEED, FIRST))
    before = openings_file(tmp_path, "towns-alone").read_bytes()
    plan = plan_of(split, tmp_path, sealed=OTHER)
    with pytest.raises(ConfigError, match=words):
        open_seal(plan.seal, plan.requests, opened=dt.date.fromisoformat(day), stored=None)
    assert openings_file(tmp_path, "towns-alone").read_bytes() == before


def test_the_queries_of_a_sealed_place_depend_on_its_seed_alone(split, tmp_path, lay_towns):
    found = {}
    for name, seed in (("one", SEED), ("same", SEED), ("other", OTHER)):
        out = lay_towns(tmp_path / name, OPEN, SEALED)
        for request in plan_of(split, out, sealed=seed).requests:
            (folder,) = ensure_tasks(request)
            found[name, request.region.id] = task_files.Task.open(folder).asked
    assert found["one", SEALED] == found["same", SEALED]
    assert not found["one", SEALED].keys() & found["other", SEALED].keys()
    assert found["one", OPEN] == found["other", OPEN]


def test_what_is_sealed_never_trains():
    crossfit = find_split("crossfit")
    places = [item.model_copy(update={"sealed": item.name in {"porto", "town-grid"}}) for item in crossfit.spec.place]
    split = replace(crossfit, spec=crossfit.spec.model_copy(update={"place": places}))
    groups = TrainingGroups(split=split, controls=crossfit, learning=LearningSpec(suites=["clean"]))
    regions = split.spec.region_ids
    tasks = [Path("out/tasks/clean") / name for name in regions]
    for is_oracle in (False, True):
        found = groups.of(tasks, tasks, is_oracle=is_oracle)
        assert [item.name for item in found] == ["half a", "half b"]
        assert sorted(task for item in found for task in item.asked) == sorted(tasks)
        taught = {task.name for item in found for task in item.train}
        assert taught == set(regions) - {"porto", "town-grid"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sealed": SEED, "private": PrivateSeed("3f" * 16)}, "give --seed-file or --sealed-seed-file, not both"),
        ({"sealed": SEED, "regions": [OPEN]}, "no region of the pipeline is of a sealed place"),
        ({"regions": [SEALED]}, "sealed places of split 'towns-alone' are left out: town-grid"),
    ],
)
def test_a_seed_that_opens_nothing_or_too_much_is_refused_in_one_line(split, tmp_path, changes, words):
    with pytest.raises(ConfigError, match=words) as error:
        plan_of(split, tmp_path, **changes)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_the_command_opens_by_a_file_that_its_owner_alone_can_read(split, tmp_path, program):
    (tmp_path / "closed.toml").write_text(TEXT.replace("SPLIT", str(split)), encoding="utf-8")
    path = tmp_path / "places.seed"
    path.write_text(SEED.text, encoding="ascii")
    path.chmod(0o600)
    asked = ("leaderboard", "closed.toml", "--dry-run", "--sealed-seed-file", path)
    code, out, err = program(*asked)
    assert code == 0, err
    assert f"sealed {SEALED}: to be opened, by seed {SEED.commitment[:12]}" in out
    assert f"sealed places are drawn by a seed of 128 bits, commitment {SEED.commitment[:12]}" in err
    assert SEED.text not in out + err
    code, _, err = program(*asked, "--opened", "yesterday")
    assert (code, err.strip()) == (2, "sasgeo-bench: --opened must be a date as in 2021-10-28, got 'yesterday'")
    code, _, err = program(*asked, "--opened", "2999-01-01")
    assert (code, "2999-01-01 has not come yet" in err) == (2, True)
    code, _, err = program("leaderboard", "closed.toml", "--dry-run", "--opened", "2026-11-23")
    assert code == 2
    assert "give --sealed-seed-file, too, or leave it out" in err


def test_a_hold_out_whose_test_places_are_all_sealed_can_be_planned_and_not_run(tmp_path):
    split = split_file(tmp_path, agricultural="train", suburb="calibration", grid="sealed test")
    plan = plan_of(split, tmp_path / "out")
    assert "left out, not opened" in plan.to_text()
    with pytest.raises(ConfigError, match="every test place of split 'towns-alone' is sealed"):
        run_pipeline(plan)
    assert not (tmp_path / "out").exists()


def test_stored_results_keep_the_openings_of_another_root(split, tmp_path, monkeypatch):
    """Whoever opens a place again in an empty root does not lose the record of the board that is replaced."""
    place = SealedPlace(drawn_by=SEED.commitment, openings=[Opening.of(SEED, FIRST)])
    record = BoardManifest(scorer_version=1, entries=[], tasks=[], sealed={SEALED: place})
    (tmp_path / "stored").mkdir()
    (tmp_path / "stored" / "board.json").write_text("{}", encoding="utf-8")
    monkeypatch.setattr(sealed, "read_board_manifest", lambda _: record)
    plan = plan_of(split, tmp_path / "out", sealed=OTHER)
    found = open_seal(plan.seal, plan.requests, opened=SECOND, stored=tmp_path / "stored")
    assert [item.commitment for item in found[SEALED].openings] == [SEED.commitment, OTHER.commitment]


def test_the_order_of_openings_is_that_of_their_records():
    early, late = Opening.of(SEED, FIRST), Opening.of(OTHER, SECOND)
    assert joined_openings({"porto": (late,)}, {"porto": (early,)}) == {"porto": (late, early)}


def test_openings_are_kept_in_order_each_seed_once_and_a_damaged_file_is_refused(tmp_path):
    for seed, day in ((SEED, FIRST), (OTHER, SECOND), (SEED, SECOND)):
        record_openings(tmp_path, "mine", ["porto"], Opening.of(seed, day))
    assert [item.to_text()[:10] for item in read_openings(tmp_path, "mine")["porto"]] == ["2026-03-01", "2026-04-01"]
    openings_file(tmp_path, "mine").write_text('{"porto": [{"bits": 128}]}', encoding="utf-8")
    with pytest.raises(StoreError, match=r"mine\.json is damaged .*restore it from a copy"):
        read_openings(tmp_path, "mine")


def test_a_board_tells_of_a_place_that_was_opened_and_is_not_on_it():
    opening = Opening(commitment="ab" * 32, bits=128, opened=FIRST)
    (line,) = sealed_lines({"porto": SealedPlace(drawn_by=None, openings=[opening])})
    assert (
        line == "Sealed place porto: opened on 2026-03-01 by a seed of commitment abababababab, and not on this board."
    )
    assert sealed_lines({}) == []
