# SPDX-License-Identifier: Apache-2.0
"""The conformance kit finds the one fault of each faulty matcher, in its own row, and none in a good one."""

import shutil
import tempfile
from dataclasses import replace
from math import hypot
from pathlib import Path

import pytest

from sasgeo_bench.running import sandbox, testing
from sasgeo_bench.running.testing import check_matcher, tiny_place

FAULTY = Path(__file__).parents[1] / "faulty.py"
ROWS = (
    "loads, and has a card",
    "prepares a map",
    "shapes, order and finite scores",
    "the same answer twice",
    "no more than top_k",
    "needs no more than its card says",
    "withholds where all is unknown",
    "answers where the place is absent",
    "a moved prior moves the answer",
    "equal candidates tie",
    "the same answers in any order",
    "time and memory",
    "kept to its scratch folder",
)
LEARNT = ("learns, the same text twice", "answers without training")  # rows of those that have a learn()
shut_in = pytest.mark.skipif(sandbox.landlock_version() == 0, reason="this kernel has no Landlock to refuse files with")


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """A good matcher is not too slow for the kit, however busy the machine is."""
    monkeypatch.setattr(testing, "_QUICK_S", 600.0)


@pytest.fixture
def own_place(tiny, tmp_path, monkeypatch):
    """A place of one's own, beside the faulty matchers that look for it there."""
    shutil.copy(FAULTY, tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return replace(tiny, folder=Path(shutil.copytree(tiny.folder, tmp_path / "place")))


@pytest.fixture
def table(tiny, monkeypatch, in_threads):  # noqa: ARG001
    """Rows of a faulty matcher by their names, without a process."""
    monkeypatch.syspath_prepend(str(FAULTY.parent))
    return lambda name, **options: by_name(check_matcher(f"faulty:{name}", **{"place": tiny, **options}))


def by_name(checks):
    return {check.name: check for check in checks}


def failed(rows):
    return [check.name for check in rows.values() if check.outcome == "fail"]


# --- matchers -------------------------------------------------------------------------------------------------------


def test_a_good_matcher_passes_every_row_and_may_write_to_its_scratch_folder(own_place) -> None:
    rows = by_name(check_matcher("faulty:WritesToScratch", place=own_place))
    assert [(name, check.outcome) for name, check in rows.items()] == [(name, "pass") for name in ROWS]
    assert rows["loads, and has a card"].found == "good 1"
    assert rows["equal candidates tie"].found == "2 queries"


@pytest.mark.parametrize(
    ("name", "row", "words"),
    [
        ("NoSuchClass", "loads, and has a card", "has no attribute 'NoSuchClass'"),
        ("NoCard", "loads, and has a card", "card is a NoneType, expected a sasgeo_bench.matching.matcher.MatcherCard"),
        ("RaisesInPrepare", "prepares a map", "ValueError: no index today"),
        ("ScoresNan", "shapes, order and finite scores", "score is nan, expected a finite number"),
        ("WorstFirst", "shapes, order and finite scores", "expected best first (2 of 6 queries)"),
        (
            "RaisesWithVectors",
            "shapes, order and finite scores",
            "crash: TypeError: what are these? (faulty.py:86) (2 of 6 queries)",
        ),
        ("Fickle", "the same answer twice", "has another answer the second time"),
        (
            "FailsAgain",
            "the same answer twice",
            "has none (crash: RuntimeError: again? (faulty.py:108)) the second time",
        ),
        ("TwoAtLeast", "no more than top_k", "returned 2 poses, expected at most top_k = 1"),
        ("WantsADisc", "needs no more than its card says", "without a disc: crash: TypeError"),
        ("WantsAHeading", "needs no more than its card says", "without a heading: crash: TypeError"),
        ("Boasts", "withholds where all is unknown", "return matcher.WITHHELD"),
        ("LostBeyondTheMap", "answers where the place is absent", "crash with a disc beyond the map: IndexError"),
        ("IgnoresThePrior", "a moved prior moves the answer", "the same answer in two discs that do not meet"),
        ("FirstIsBetter", "equal candidates tie", "two scores for one place: ["),
        ("LooksBack", "the same answers in any order", "has another answer after others"),
        ("BornWithChance", "the same answers in any order", "in a fresh process"),
    ],
)
def test_a_fault_is_reported_in_its_own_row_and_in_no_other(table, name, row, words) -> None:
    rows = table(name)
    assert failed(rows) == [row]
    assert words in rows[row].found
    assert "\n" not in rows[row].found


@pytest.mark.parametrize("name", ["Good", "SaysItWantsADisc", "Doubts", "RanksOnly"])
def test_what_a_matcher_may_do_is_no_fault(table, name) -> None:
    rows = table(name)
    assert failed(rows) == []
    assert tuple(rows) == ROWS


def test_a_matcher_that_learns_has_two_rows_more(table) -> None:
    rows = table("Learns")
    assert failed(rows) == []
    assert tuple(rows) == (ROWS[0], *LEARNT, *ROWS[1:])
    assert rows[LEARNT[0]].found.startswith("1 bytes from") or rows[LEARNT[0]].found.startswith("2 bytes from")
    rows = table("SaysItCannotWithout")
    assert failed(rows) == []
    assert rows[LEARNT[1]].outcome == "not applicable"


@pytest.mark.parametrize(
    ("name", "row", "words"),
    [
        ("LearnsByChance", 0, "another text the second time"),
        ("LearnsNothing", 0, "crash: ValueError: too hard"),
        ("CannotWithout", 1, "learned = None: crash: TypeError"),
    ],
)
def test_a_fault_of_learning_is_reported_in_its_own_row(table, name, row, words) -> None:
    rows = table(name)
    assert failed(rows) == [LEARNT[row]]
    assert words in rows[LEARNT[row]].found


def test_without_a_map_or_a_query_it_can_answer_a_matcher_is_asked_nothing(table) -> None:
    assert tuple(table("RaisesInPrepare")) == (*ROWS[:2], ROWS[-1])
    rows = table("WantsImages")
    assert tuple(rows) == (*ROWS[:2], "answers a query", ROWS[-1])
    assert rows["answers a query"].outcome == "not applicable"
    assert rows["answers a query"].found == "the card's needs leave no query"


def test_what_does_not_concern_a_matcher_is_not_applicable(table) -> None:
    rows = table("RanksOnly")
    apart = ["answers where the place is absent", "a moved prior moves the answer"]
    assert [check.name for check in rows.values() if check.outcome == "not applicable"] == apart
    # Without a sound answer there is nothing to hold another one against.
    rows = table("ScoresNan")
    assert {check.outcome for name, check in rows.items() if name in ROWS[3:-1]} == {"not applicable"}


def test_a_matcher_that_takes_too_long_fails_by_its_time_alone(table, monkeypatch) -> None:
    monkeypatch.setattr(testing, "_QUICK_S", 0.0)
    assert failed(table("Good")) == ["time and memory"]


@shut_in
def test_one_that_is_shut_in_fails_by_what_it_was_refused(own_place) -> None:
    rows = by_name(check_matcher("faulty:WritesAmongMaps", place=own_place))
    assert failed(rows) == ["shapes, order and finite scores", "kept to its scratch folder"]
    refused = rows["kept to its scratch folder"].found.removeprefix("was refused what it asked for: ")
    assert refused.startswith(("OSError: [Errno 30] Read-only", "PermissionError"))
    assert not (own_place.folder / "regions" / "mine.txt").exists()


def test_one_that_is_trusted_fails_by_what_it_left_behind(own_place) -> None:
    rows = by_name(check_matcher("faulty:WritesAmongMaps", place=own_place, is_sandboxed=False))
    assert failed(rows) == ["kept to its scratch folder"]
    assert rows["kept to its scratch folder"].found == "wrote among maps and tasks: regions/mine.txt"


def test_without_a_place_one_is_made_and_nothing_is_left_of_it(table, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert failed(table("Good", place=None)) == []
    assert list(tmp_path.iterdir()) == []


# --- the place ------------------------------------------------------------------------------------------------------


def test_every_query_of_a_tiny_place_has_its_truth_on_the_map(tiny) -> None:
    assert [truth.query_id for truth in tiny.truths] == [query.query_id for query in tiny.queries]
    west_m, south_m, east_m, north_m = tiny.region.grid.bounds_m
    for query, truth in zip(tiny.queries, tiny.truths, strict=True):
        pose = truth.pose
        assert west_m < pose.easting_m < east_m
        assert south_m < pose.northing_m < north_m
        if query.track == "retrieval":
            away_m = [
                hypot(item.easting_m - pose.easting_m, item.northing_m - pose.northing_m) for item in query.candidates
            ]
            assert len(away_m) > 2
            assert truth.candidate == away_m.index(min(away_m))


def test_a_tiny_place_is_the_same_wherever_and_whenever_it_is_made(tiny, tmp_path) -> None:
    for _ in range(2):
        other = tiny_place(tmp_path)
        assert other.folder == tmp_path
        assert [query.query_id for query in other.queries] == [query.query_id for query in tiny.queries]
        assert other.truths == tiny.truths
        assert other.region.manifest.fingerprint == tiny.region.manifest.fingerprint
