# SPDX-License-Identifier: Apache-2.0
"""The conformance kit finds the one fault of each faulty tracker, in its own row, and none in a good one."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from sasgeo_bench.matching.scaffold import package_files, write_plugin
from sasgeo_bench.matching.tracker import check_fix
from sasgeo_bench.running import testing
from sasgeo_bench.running.tracker_testing import TinyFlights, check_tracker, odd_flights, tiny_flights

ROWS = (
    "loads, and has a card",
    "prepares a map",
    "follows a flight",
    "a covariance for every estimate",
    "the same answers twice",
    "forgets the flight before",
    "the same answers to a flight that is cut short, in a fresh process",
    "bears views that show nothing",
    "bears steps that the odometer lost",
    "bears an odometer without errors",
    "bears a flight off the map",
    "bears a prior without a place",
    "bears a flight of one view",
    "accepts nothing where nothing is seen",
    "time and memory",
    "kept to its scratch folder",
)
VIEWS = 8


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> TinyFlights:
    """The flights of the kit, cut short."""
    whole = tiny_flights(tmp_path_factory.mktemp("flights"))
    return replace(whole, flights=tuple(views[:VIEWS] for views in whole.flights))


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """A good tracker is not too slow for the kit, however busy the machine is."""
    monkeypatch.setattr(testing, "_QUICK_S", 600.0)
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.fixture
def table(in_threads, made):  # noqa: ARG001
    """Rows of a tracker by their names, without a process."""
    return lambda spec: {check.name: check for check in check_tracker(spec, made=made)}


def failed(rows):
    return [check.name for check in rows.values() if check.outcome == "fail"]


def test_a_good_tracker_passes_every_row_in_its_own_process(made) -> None:
    rows = {check.name: check for check in check_tracker("dead_reckoning", made=made)}
    assert [(name, check.outcome) for name, check in rows.items()] == [(name, "pass") for name in ROWS]
    assert rows[ROWS[2]].found == f"{VIEWS} views: 0 within 25 m, 0 accepted, 0 of these farther away"


def test_a_matcher_of_single_views_is_tried_as_it_follows(table) -> None:
    rows = table("prior_centre")
    assert tuple(rows) == ROWS
    assert failed(rows) == []
    assert rows[ROWS[2]].found == f"{VIEWS} views: 0 within 25 m, {VIEWS} accepted, {VIEWS} of these farther away"


@pytest.mark.parametrize(
    ("name", "row", "words"),
    [
        ("NoSuchClass", 0, "has no attribute 'NoSuchClass'"),
        ("Imitates", 0, "named 'dead_reckoning', as a tracker that ships: rename it"),
        ("Unprepared", 1, "ValueError: no map today"),
        ("Singular", 2, "frame 0 of 0 to 7: invalid: covariance is not symmetric and positive definite"),
        ("SometimesSure", 3, "4 of 8 estimates have none"),
        ("Fickle", 4, "frame 0 has another answer"),
        ("Remembers", 5, "frame 0 has another answer"),
        ("LooksHard", 7, "frame 5 of 0 to 7: crash: ValueError: nothing to see"),
        ("AlwaysSure", 13, "8 of 8 views accepted: odometry alone does not tell the place"),
    ],
)
def test_a_fault_is_reported_in_its_own_row(table, name, row, words) -> None:
    rows = table(f"straying:{name}")
    assert failed(rows)[0] == ROWS[row]
    assert words in rows[ROWS[row]].found
    assert "\n" not in rows[ROWS[row]].found


def test_odd_flights_change_only_what_they_say(made) -> None:
    views = made.flights[0]
    found = odd_flights(views)
    assert set(found) == set(ROWS[7:13])
    lost = found[ROWS[8]]
    assert [query.step.increment is None for query in lost] == [True, *[False] * 4, True, True, True]
    assert all(query.evidence is old.evidence for query, old in zip(lost, views, strict=True))
    exact = found[ROWS[9]]
    assert {query.step.covariance for query in exact} == {None, (0.0,) * 9}


def test_a_tracker_of_ordinary_flights_alone_fails_at_each_odd_one(table) -> None:
    rows = table("straying:Brittle")
    assert failed(rows) == list(ROWS[8:12])
    assert rows[ROWS[8]].found.startswith("frame 5 of 0 to 7: crash: ValueError: cannot reshape")
    assert "frame 1 of 0 to 7: crash: LinAlgError" in rows[ROWS[9]].found
    assert "frame 5 of 0 to 7: crash: IndexError: off the map" in rows[ROWS[10]].found
    assert "frame 0 of 0 to 7: crash: TypeError" in rows[ROWS[11]].found


def test_what_new_tracker_writes_finds_its_way(made, tmp_path) -> None:
    write_plugin(tmp_path / "plugin", package_files("tracker", "my-tracker"))
    module = tmp_path / "plugin" / "src" / "my_tracker" / "tracker.py"
    found: dict[str, object] = {"__file__": str(module)}
    exec(module.read_text(), found)  # noqa: S102 - our own text
    tracker, views = found["MyTracker"](), made.flights[0]
    tracker.prepare(made.region, None)
    tracker.start(views[0].prior)
    fixes = [check_fix(tracker.step(query), top_k=1) for query in views]
    truths = [made.truths[query.query_id].pose for query in views]
    away_m = [
        math.dist((fix.pose.easting_m, fix.pose.northing_m), (truth.easting_m, truth.northing_m))
        for fix, truth in zip(fixes, truths, strict=True)
    ]
    assert max(away_m[2:]) < 10.0
    assert [fix.is_accepted for fix in fixes] == [False, False, *[True] * (VIEWS - 2)]
