# SPDX-License-Identifier: Apache-2.0
"""Trackers: views come in order and one at a time, a flight is asked whole, and a failure costs its flight alone."""

import shutil
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import pytest

from sasgeo_bench.matching import follower
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.tasks import flight_sampling, task_files
from sasgeo_bench.tasks.query import flight_id
from tests.slow import rest_slow
from tests.world import drawn

pytestmark = pytest.mark.usefixtures("small_flight_views")

TOWN = "town-riverside"
PATIENT = Limits(match_s=600.0)  # what answers is never late, however busy the machine is


@pytest.fixture(scope="module")
def flown(tmp_path_factory, lay_towns):
    """A task of three short flights, and the trackers beside it."""
    root = tmp_path_factory.mktemp("flights")
    lay_towns(root / "out", TOWN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))
        drawn(root / "out", "flight-overconfident", TOWN, seed=4, may_be_fewer=True)
    shutil.copy(Path(__file__).with_name("wayward.py"), root / "wayward.py")
    return root


@pytest.fixture
def task(flown, monkeypatch):
    monkeypatch.chdir(flown)
    monkeypatch.syspath_prepend(str(flown))
    return flown / "out" / "tasks" / "flight-overconfident" / TOWN


def run_of(task, out, name, **changes):
    """Run a tracker; return its rows by flight, in the order of views."""
    spec = name if name.islower() else f"wayward:{name}"
    request = replace(RunRequest(spec=spec, tasks=(task,), out=out, limits=PATIENT), **changes)
    plan = plan_run(request)
    run(plan)
    found = defaultdict(list)
    for item in sorted(prediction_files.read_predictions(plan.parts[0].folder), key=lambda item: item.query_id):
        found[flight_id(item.query_id)].append(item)
    return dict(found)


def views_of(rows):
    return [int(item.diagnostics["views"]) for item in rows]


@pytest.fixture(scope="module")
def counted(flown, tmp_path_factory):
    """The rows of a tracker that counts what it is given, asked by two processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(flown)
        patch.syspath_prepend(str(flown))
        task = flown / "out" / "tasks" / "flight-overconfident" / TOWN
        return run_of(task, tmp_path_factory.mktemp("counted"), "Holding", jobs=2)


def test_views_of_a_flight_come_in_order_to_one_process(task, counted):
    assert len(counted) == 3
    assert sum(map(len, counted.values())) == len(task_files.Task.open(task).ids())
    for rows in counted.values():
        assert views_of(rows) == list(range(1, len(rows) + 1))
        assert len({item.diagnostics["process"] for item in rows}) == 1
        assert {item.diagnostics["has_place"] for item in rows} == {1.0}


@pytest.mark.usefixtures("in_threads")
def test_what_a_tracker_learnt_reaches_every_step(task, tasks, tmp_path):
    (train,) = (tasks / "tasks" / "alias").glob("town-grid*")
    flights = run_of(task, tmp_path, "Taught", train=(train,))
    lessons = {item.diagnostics["lessons"] for rows in flights.values() for item in rows}
    (count,) = lessons
    assert 0 < count <= len(task_files.Task.open(train).ids())
    untaught = run_of(task, tmp_path, "Taught")
    assert {item.diagnostics["lessons"] for rows in untaught.values() for item in rows} == {-1.0}


def test_no_view_to_come_is_in_the_process_of_a_tracker(counted):
    rows = [item for rows in counted.values() for item in rows]
    assert {item.diagnostics["held"] for item in rows} == {1.0}


def test_nothing_of_another_flight_is_known(task, tmp_path):
    rows = [item for rows in run_of(task, tmp_path, "Remembers").values() for item in rows]
    assert {item.diagnostics["known"] for item in rows} == {1.0}
    assert len({item.diagnostics["kept"] for item in rows}) == 1


def test_a_tracker_reads_neither_the_views_to_come_nor_the_truths(task):
    rows = [item for rows in run_of(task, task.parents[2], "ReadsAhead").values() for item in rows]
    assert {(item.status, item.diagnostics.get("read")) for item in rows} <= {("ok", 0.0), ("refused", None)}


def test_a_fix_is_stored_with_its_covariance_and_modes(counted):
    row = next(iter(counted.values()))[0]
    assert row.is_accepted is True
    assert row.covariance == (4.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0)
    assert [score for _, score in row.candidates] == [1.0, 0.5]


@pytest.mark.parametrize(
    ("way", "status", "expected"),
    [
        ("hangs", "timeout", "no answer within"),
        ("dies", "crash", "exit status 3"),
        *rest_slow(
            [
                ("raises", "crash", "no more today"),
                ("singular", "invalid", "not symmetric and positive definite"),
                ("text", "invalid", "step() returned str"),
            ],
            but=0,
        ),
    ],
)
def test_a_failure_costs_the_rest_of_its_flight_and_no_other(task, flown, tmp_path, request, way, status, expected):
    if way not in ("hangs", "dies"):  # what its process does not live through
        request.getfixturevalue("in_threads")
    first = flight_id(min(task_files.Task.open(task).ids()))
    (flown / "fails").write_text(f"{first} {way}", encoding="utf-8")
    flights = run_of(task, tmp_path, "Failing", limits=replace(PATIENT, match_s=5.0 if way == "hangs" else 600.0))
    failed = flights.pop(first)
    assert [item.status for item in failed] == ["ok", "ok"] + [status] * (len(failed) - 2)
    assert expected in failed[2].message
    assert all("since frame 2 of the flight: " in item.message for item in failed[3:])
    for rows in flights.values():
        assert {item.status for item in rows} == {"ok"}
        assert views_of(rows) == list(range(1, len(rows) + 1))


@pytest.mark.usefixtures("in_threads")
def test_a_flight_that_was_cut_off_is_asked_from_its_first_view(task, tmp_path):
    """Rows of a whole flight stay; the other begins anew, since a tracker needs what came before."""
    ids = sorted(task_files.Task.open(task).ids())
    whole = [name for name in ids if flight_id(name) == flight_id(ids[0])]
    request = RunRequest(spec="wayward:Counting", tasks=(task,), out=tmp_path, limits=PATIENT, limit=len(whole) + 5)
    run(plan_run(request))
    plan = plan_run(replace(request, limit=None))
    assert plan.parts[0].left == tuple(name for name in ids if name not in whole)
    flights = run_of(task, tmp_path, "Counting")
    assert all(views_of(rows) == list(range(1, len(rows) + 1)) for rows in flights.values())


@pytest.mark.usefixtures("in_threads")
def test_shards_hold_whole_flights_and_all_of_them(task, tmp_path):
    request = RunRequest(spec="dead_reckoning", tasks=(task,), out=tmp_path, limits=PATIENT)
    parts = [plan_run(replace(request, shard=(number, 2))).parts[0].left for number in (1, 2)]
    assert not {flight_id(name) for name in parts[0]} & {flight_id(name) for name in parts[1]}
    assert sorted([*parts[0], *parts[1]]) == sorted(task_files.Task.open(task).ids())


@pytest.mark.usefixtures("in_threads")
def test_odometry_alone_begins_at_the_prior_and_drifts_and_the_start_alone_stays(task, tmp_path):
    reckoned = run_of(task, tmp_path, "dead_reckoning")
    stayed = run_of(task, tmp_path, "prior_only")
    queries = {query.query_id: query for query in task_files.read_queries(task)}
    for flight, rows in reckoned.items():
        prior = queries[rows[0].query_id].prior
        begin, end = rows[0].candidates[0][0], rows[-1].candidates[0][0]
        assert (begin.easting_m, begin.northing_m) == prior.center_m
        assert {item.candidates[0][0] for item in stayed[flight]} == {begin}
        assert end != begin
        assert rows[-1].covariance[0] > rows[0].covariance[0] == pytest.approx(prior.radius_m**2 / 4, rel=1e-6)
        assert {item.is_accepted for item in rows} == {False}


@pytest.mark.usefixtures("in_threads")
def test_merged_answers_of_a_tracker_keep_what_only_fixes_have(task, tmp_path):
    flights = run_of(task, tmp_path, "Counting", limit=4)
    into = tmp_path / "merged.parquet"
    for _ in range(2):  # the second time in place of the first
        prediction_files.merge_runs([tmp_path / "runs"], into)
        found = {item.query_id: item for item in prediction_files.read_predictions(into)}
        rows = [item for rows in flights.values() for item in rows]
        assert found == {item.query_id: replace(item, matcher_s=None) for item in rows}
        assert {(item.is_accepted, item.covariance[0]) for item in found.values()} == {(True, 4.0)}


@pytest.mark.usefixtures("in_threads")
def test_a_matcher_of_single_views_follows_flights_and_its_run_says_how(task, tmp_path, monkeypatch):
    flights = run_of(task, tmp_path, "prior_centre", limit=4)
    rows = [item for rows in flights.values() for item in rows]
    assert {(item.status, item.is_accepted) for item in rows} == {("ok", True)}
    assert {item.covariance[0] for item in rows} == {25.0}
    assert flights == run_of(task, tmp_path, "prior_centre", limit=4)
    plan = plan_run(RunRequest(spec="prior_centre", tasks=(task,), out=tmp_path, limits=PATIENT, limit=4))
    about = RunManifest.open(plan.parts[0].folder)
    assert about.follower.gate == 3.5
    assert "on flights, of sasgeo-bench" in about.matcher.ours
    assert not plan.parts[0].left
    monkeypatch.setattr(follower, "_VERSION", 0)
    again = plan_run(plan.request)
    assert again.hash == plan.hash
    assert (len(again.parts[0].left), again.parts[0].excluded) == (4, 4)
    with pytest.raises(ValueError, match="follower is 7, expected settings with a hash"):
        RunManifest.model_validate({"follower": 7})


@pytest.mark.usefixtures("in_threads")
def test_the_oracle_follows_flights_and_a_matcher_that_only_ranks_does_not(task, tmp_path):
    truths = {
        item.query_id: item.pose for item in task_files.read_truths(task.parents[2] / "truth" / task.parent.name / TOWN)
    }
    rows = [item for rows in run_of(task, tmp_path, "oracle_pose").values() for item in rows]
    assert all(item.candidates[0][0] == truths[item.query_id] and item.is_accepted for item in rows)
    rows = [item for rows in run_of(task, tmp_path, "Ranks").values() for item in rows]
    assert {(item.status, item.message) for item in rows} == {("not applicable", "track sequence")}
