# SPDX-License-Identifier: Apache-2.0
"""Matchers that learn: once for a training set, from far places alone; the result belongs to what was asked."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.matching.matcher import check_learned
from sasgeo_bench.running import prediction_files, sandbox, training
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.training_tasks import Lessons, _Pair, check_apart, plan_training, spread
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.scoring.submission_files import count_excluded, validate
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.split import SplitFile, make_split

CLEAN = Path("clean") / "town-riverside"
PATIENT = Limits(match_s=600.0)  # what answers is never late, however busy the machine is
HAS_LANDLOCK = sandbox.landlock_version() > 0


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.fixture
def request_of(tasks, tmp_path):
    """A run that asks one town after learning from another."""

    def made(name="Counts", **changes):
        (train,) = (tasks / "tasks" / "alias").glob("town-grid*")
        request = RunRequest(
            spec=f"learners:{name}",
            tasks=(tasks / "tasks" / CLEAN,),
            out=tmp_path,
            limits=PATIENT,
            limit=2,
            train=(train,),
        )
        return replace(request, **changes)

    return made


def carry_out(request):
    plan = plan_run(request)
    report = run(plan)
    (part,) = plan.parts
    return plan, report, part.folder


def answers(request, folder):
    (task,) = request.tasks
    return prediction_files.Answers.open(folder, task_files.Task.open(task).asked).found


def told(request, folder):
    return {item.diagnostics["pairs"] for item in answers(request, folder).values()}


@pytest.mark.usefixtures("in_threads")
def test_what_was_learnt_reaches_every_answer_and_is_kept_where_people_can_read_it(request_of):
    request = request_of()
    lines = plan_run(request).to_text().splitlines()
    plan, report, folder = carry_out(request)
    count = plan.training_set.count
    assert lines[1] == f"  to be trained on {count} queries of 1 place (town-grid)"
    assert report.counts == {"ok": 2}
    assert told(request, folder) == {float(count)}
    result = RunManifest.open(folder).learned
    assert (result.trained_on, result.pairs) == (["town-grid"], count)
    text = (plan.run_folder / result.file).read_text(encoding="utf-8")
    assert json.loads(text)["suites"] == ["alias"]
    assert plan_run(request).to_text().splitlines()[1].startswith("  trained on ")
    assert next(
        validate(folder, [*map(task_files.Task.open, request.tasks)])
    ).is_missing_row  # the rest was not asked, and no row is strange
    assert count_excluded(folder, [*map(task_files.Task.open, request.tasks)]) == 0
    merged = prediction_files.merge_runs(
        [folder], folder / "merged.parquet", asked=task_files.Task.open(request.tasks[0]).asked
    )
    assert merged == 2


@pytest.mark.usefixtures("in_threads")
def test_what_was_learnt_is_used_again_and_learnt_anew_from_something_else(request_of, monkeypatch):
    request = request_of()
    first, _, folder = carry_out(request)
    learn = training._learn
    monkeypatch.setattr(training, "_learn", None)
    assert carry_out(request)[1].counts == {}
    assert carry_out(replace(request, limit=3))[1].counts == {"ok": 1}
    monkeypatch.setattr(training, "_learn", learn)
    other = replace(request, most_trained=3, limit=3)
    assert plan_run(other).parts[0].excluded == 3
    second, report, same = carry_out(other)
    assert (same, report.counts, second.training_set.count) == (folder, {"ok": 3}, 3)
    assert first.training_set.sha256 != second.training_set.sha256
    assert told(request, folder) == {3.0}
    assert count_excluded(folder, [*map(task_files.Task.open, request.tasks)]) == 3
    # Back again, nothing is asked, and the answers under the first training are those that count.
    monkeypatch.setattr(training, "_learn", None)
    assert carry_out(replace(request, limit=3))[1].counts == {}
    assert told(request, folder) == {float(first.training_set.count)}
    untaught = replace(request, train=())
    assert carry_out(untaught)[1].counts == {"ok": 2}
    assert told(request, folder) == {-1.0}


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("RaisesInLearn", "crash", "while learning: ValueError: nothing to see"),
        ("HangsInLearn", "timeout", "while learning: no answer within 1 s"),
        ("LearnsBytes", "invalid", "while learning: learn() returned bytes, expected a text"),
    ],
)
def test_whoever_fails_to_learn_loses_its_rows_and_nothing_else(request_of, request, name, status, words):
    limits = PATIENT
    if name == "HangsInLearn":  # which a process alone can be ended for
        limits = replace(PATIENT, learn_s=1.0)
    else:
        request.getfixturevalue("in_threads")
    asked = request_of(name, limits=limits)
    _, report, folder = carry_out(asked)
    assert report.counts == {status: 2}
    assert report.messages[status].startswith(words)
    assert RunManifest.open(folder).learned.file is None
    assert {item.status for item in answers(asked, folder).values()} == {status}
    assert plan_run(asked).parts[0].left == ()  # asked and answered, if badly: --again asks once more
    assert len(plan_run(replace(asked, again=(status,))).parts[0].left) == 2


@pytest.mark.usefixtures("in_threads")
def test_a_card_that_needs_training_is_not_applicable_without(request_of):
    request = request_of("NeedsTraining")
    plan, report, folder = carry_out(request)
    assert report.counts == {"ok": 2}
    assert told(request, folder) == {float(plan.training_set.count)}
    _, report, _ = carry_out(replace(request, train=()))
    assert (report.counts, report.messages) == ({"not applicable": 2}, {"not applicable": "no training"})


@pytest.mark.usefixtures("in_threads")
def test_a_matcher_that_does_not_learn_passes_the_training_over(request_of):
    plan, report, folder = carry_out(request_of(spec="hostile:Plain"))
    assert (plan.training_set, report.counts) == (None, {"ok": 2})
    assert "has no learn()" in plan.to_text()
    assert RunManifest.open(folder).learned is None


@pytest.mark.skipif(not HAS_LANDLOCK, reason="this kernel has no Landlock to refuse files with")
def test_truths_travel_by_the_wire_and_cannot_be_read(request_of):
    request = request_of("ReadsTruth")
    _, _, folder = carry_out(request)
    assert told(request, folder) == {0.0}


@pytest.mark.parametrize(
    ("learned", "fault"),
    [
        (b"x", "returned bytes, expected a text"),
        ("x" * (2**20 + 1), "returned 1048577 bytes, expected at most 1048576"),
        ("", "returned 0 bytes, expected a text"),
        ("\ud800", "returned a text that is no UTF-8"),
    ],
)
def test_what_cannot_be_kept_is_nothing_that_was_learnt(learned, fault):
    with pytest.raises(MatchError, match=fault):
        check_learned(learned)


# --- the training set -----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("in_threads")
def test_nobody_learns_from_what_is_asked(request_of, tasks):
    absent = tasks / "tasks" / "absent" / "town-riverside"
    with pytest.raises(
        ConfigError, match=r"is of region 'town-riverside', and so is .*, which is asked: leave one out"
    ):
        plan_run(request_of(train=(absent,)))


def test_a_task_without_truths_or_queries_teaches_nothing(tasks, tmp_path):
    out = tmp_path / "other"
    for kind in ("tasks", "regions"):
        shutil.copytree(tasks / kind, out / kind)
    with pytest.raises(StoreError, match=r"holds no truths of .*: make the queries here, or leave it out"):
        plan_training([out / "tasks" / CLEAN], asked=[], split=None, most=5)


def test_two_maps_of_one_name_are_refused(tasks, tmp_path):
    out = Path(shutil.copytree(tasks, tmp_path / "other"))
    train = [tasks / "tasks" / CLEAN, out / "tasks" / "absent" / "town-riverside"]
    with pytest.raises(ConfigError, match=r"another task on .*: leave one of them out"):
        plan_training(train, asked=[], split=None, most=5)


def test_a_training_set_is_the_same_whatever_order_its_tasks_are_named_in(tasks):
    train = sorted((tasks / "tasks").glob("*/town*"))
    found = [plan_training(order, asked=[], split=None, most=7) for order in (train, train[::-1], [*train, *train])]
    assert len({(one.sha256, one.places, one.taken) for one in found}) == 1
    assert found[0].count == 7
    assert found[0].places == ("town-grid", "town-riverside")
    assert plan_training(train, asked=[], split=None, most=8).sha256 != found[0].sha256


def test_another_draw_of_a_training_set_is_as_even_and_holds_other_views(tasks):
    train = sorted((tasks / "tasks").glob("*/town*"))
    found = [plan_training(train, asked=[], split=None, most=7, lessons=Lessons(draw=draw)) for draw in (0, 1, 2)]
    assert found[0] == plan_training(train, asked=[], split=None, most=7)
    assert len({one.sha256 for one in found}) == 3
    assert {(one.count, one.places) for one in found} == {(7, ("town-grid", "town-riverside"))}
    whole = [plan_training(train, asked=[], split=None, most=2000, lessons=Lessons(draw=draw)) for draw in (0, 1)]
    assert whole[0] == whole[1]  # there is but one choice of all


def test_matchers_learn_under_stress_from_some_kinds_alone(tasks):
    (task,) = (tasks / "tasks" / "alias").glob("town-grid*")
    truths = task_files.Task.open(task).truths
    kind = next(truth.kind for truth in truths if truth.role == "stress")
    count = sum(truth.role != "stress" or truth.kind.startswith(kind) for truth in truths)
    found = plan_training([task], asked=[], split=None, most=2000, lessons=Lessons(kinds=(kind,)))
    assert found.count == count
    calm = plan_training([task], asked=[], split=None, most=2000, lessons=Lessons(kinds=("no such kind",)))
    assert calm.count == sum(truth.role != "stress" for truth in truths)


def test_matchers_learn_from_the_views_of_one_detector(tasks, tmp_path):
    out = Path(shutil.copytree(tasks, tmp_path / "other"))
    task, truths = out / "tasks" / CLEAN, out / "truth" / CLEAN / task_files.TRUTH
    table = pq.read_table(truths)
    detectors = ["measured" if at % 3 == 0 else "published" for at in range(len(table))]
    at = table.column_names.index("detector")
    pq.write_table(table.set_column(at, "detector", pa.array(detectors)), truths)
    counts = Counter(detectors)
    for detector, count in counts.items():
        found = plan_training([task], asked=[], split=None, most=2000, lessons=Lessons(detector=detector))
        assert found.count == count
    assert plan_training([task], asked=[], split=None, most=2000).count == counts["published"]
    pq.write_table(table.set_column(at, "detector", pa.array(["measured"] * len(table))), truths)
    with pytest.raises(ConfigError, match="holds no queries of detector 'published'"):
        plan_training([task], asked=[], split=None, most=2000)


@given(st.lists(st.tuples(*(st.sampled_from("abc") for _ in range(3))), min_size=1, max_size=40), st.randoms())
def test_every_beginning_is_spread_over_places_then_suites_and_knows_no_order(drawn, chance):
    pairs = [
        _Pair(place=place, suite=suite, site=site, query_id=str(at), task=Path(), hashes=("", ""))
        for at, (place, suite, site) in enumerate(drawn)
    ]
    by = (lambda pair: pair.place, lambda pair: pair.suite, lambda pair: pair.site)
    found = spread(pairs, by)
    assert sorted(found, key=lambda pair: int(pair.query_id)) == pairs
    chance.shuffle(pairs)
    assert spread(pairs, by) == found
    all_of = Counter(pair.place for pair in pairs)
    for most in range(1, len(pairs)):
        taken = Counter(pair.place for pair in found[:most])
        # Nobody has two more than another one who has some left.
        assert all(taken[one] <= taken[other] + 1 for one in all_of for other in all_of if taken[other] < all_of[other])


def two_parts(apart_m, **changes):
    grids = {
        name: Grid(epsg=32632, west_m=5e5 + at * (1000 + apart_m), north_m=5.2e6, cell_size_m=1.0, rows=1000, cols=1000)
        for at, name in enumerate(("here", "there", "beyond"))
    }
    places = [
        {"name": "one", "regions": ["here"], "part": "train"},
        {"name": "two", "regions": ["there", "beyond"], "part": "train"},
    ]
    values = {"id": "near", "title": "Near", "kind": "holdout", "buffer_m": 1000.0, "reach_m": 100.0, "place": places}
    return make_split(SplitFile.model_validate(values | changes), grids)


def test_regions_of_one_place_and_blocks_within_the_buffer_are_refused():
    task = Path("out/tasks/clean/x")
    with pytest.raises(ConfigError, match="is of place 'two', and so is"):
        check_apart({"there": task}, {"beyond": task}, two_parts(5000.0))
    with pytest.raises(
        ConfigError, match=r"blocks here/0-0 and there/0-0, .* are 1199 m apart, split 'near' needs 1200 m"
    ):
        check_apart({"here": task}, {"there": task}, two_parts(1199.0))
    check_apart({"here": task}, {"there": task}, two_parts(1200.0))
    check_apart({"here": task}, {"there": task}, None)
    sealed = {"name": "two", "regions": ["there", "beyond"], "part": "test", "sealed": True}
    split = two_parts(5000.0, place=[{"name": "one", "regions": ["here"], "part": "train"}, sealed])
    with pytest.raises(ConfigError, match="is of the sealed place 'two', which never trains: leave it out"):
        check_apart({"beyond": task}, {}, split)
