# SPDX-License-Identifier: Apache-2.0
"""The conformance kit finds the one fault of each faulty segmenter, in its own row, and none in a good one."""

import tempfile
from dataclasses import replace
from pathlib import Path

import pytest

from sasgeo_bench.running import sandbox, testing
from sasgeo_bench.running.segmenter_testing import check_segmenter
from sasgeo_bench.running.testing import LEARNS
from sasgeo_bench.sensing.tiny_images import tiny_images

ROWS = (
    "loads, and has a card",
    "shapes, known classes, and an unchanged picture",
    "the same answer twice",
    "the same classes everywhere",
    "small and odd pictures",
    "a crop gives what the whole gives",
    "the same answers in any order",
    "time and memory",
    "kept to its scratch folder",
)
UNTAUGHT = "answers without training"
shut_in = pytest.mark.skipif(sandbox.landlock_version() == 0, reason="this kernel has no Landlock to refuse files with")


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """A good segmenter is not too slow for the kit, however busy the machine is."""
    monkeypatch.setattr(testing, "_QUICK_S", 600.0)
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.fixture
def table(in_threads):  # noqa: ARG001
    """Rows of a segmenter by their names, without a process."""
    return lambda name: by_name(check_segmenter(f"segmenters:{name}"))


def by_name(checks):
    return {check.name: check for check in checks}


def failed(rows):
    return [check.name for check in rows.values() if check.outcome == "fail"]


def test_a_good_segmenter_passes_every_row_in_its_own_process() -> None:
    rows = by_name(check_segmenter("segmenters:Good"))
    assert [(name, check.outcome) for name, check in rows.items()] == [(name, "pass") for name in ROWS]
    assert rows[ROWS[0]].found == "good 1"
    assert rows[ROWS[1]].found.startswith("4 images, building, green; silent at ")
    assert rows[ROWS[4]].found == "7 images"


@pytest.mark.parametrize("name", ["SaysNothing", "Good"])
def test_what_a_segmenter_may_do_is_no_fault(table, name) -> None:
    rows = table(name)
    assert failed(rows) == []
    assert tuple(rows) == ROWS


@pytest.mark.parametrize(
    ("name", "row", "words"),
    [
        ("NoSuchClass", 0, "has no attribute 'NoSuchClass'"),
        ("NoCard", 0, "card is a NoneType"),
        ("Imitates", 0, "named 'oracle_segmenter', as a segmenter that ships: rename it"),
        ("WrongShape", 1, "image 0: invalid: segment() returned a segmentation of shape (4, 4)"),
        ("UnknownClass", 1, "returned the class 'volcano'"),
        ("NotOnItsCard", 1, "(4 of 4 images)"),
        ("PaintsOver", 1, "changed the picture that it was given"),
        ("Fickle", 2, "image 0 has another answer the second time"),
        ("OtherClasses", 3, ", the first one "),
        ("WantsRoom", 4, "one pixel (1 x 1): crash: ValueError: the picture is smaller than the filter"),
        ("SeesTheFrame", 5, "a crop of image 0 (72 x 96) has probabilities that differ by 0.2"),
        ("LooksBack", 6, "has another answer after others, in a fresh process"),
    ],
)
def test_a_fault_is_reported_in_its_own_row(table, name, row, words) -> None:
    rows = table(name)
    assert failed(rows)[0] == ROWS[row]
    assert words in rows[ROWS[row]].found
    assert "\n" not in rows[ROWS[row]].found


def test_a_segmenter_that_learns_has_two_rows_more(table) -> None:
    rows = table("Learns")
    assert failed(rows) == []
    assert tuple(rows) == (ROWS[0], LEARNS, UNTAUGHT, *ROWS[1:])
    assert " bytes from 4 images, " in rows[LEARNS].found
    rows = table("NeedsTraining")
    assert failed(rows) == []
    assert rows[UNTAUGHT].outcome == "not applicable"


@pytest.mark.parametrize(
    ("name", "row", "words"),
    [
        ("LearnsNothing", LEARNS, "crash: ValueError: too few roofs"),
        ("LearnsTooMuch", LEARNS, "expected at most 33554432"),
        ("CannotWithout", UNTAUGHT, "learned = None: image 0: crash: TypeError"),
    ],
)
def test_a_fault_of_learning_is_reported_in_its_own_row(table, name, row, words) -> None:
    rows = table(name)
    assert failed(rows) == [row]
    assert words in rows[row].found


def test_one_that_needs_what_it_does_not_learn_is_asked_nothing(table) -> None:
    rows = table("NeedsWhatItCannotLearn")
    assert tuple(rows) == (ROWS[0], "answers an image", ROWS[-1])
    assert failed(rows) == []


@shut_in
def test_one_that_asks_the_network_fails_by_what_it_was_refused() -> None:
    rows = by_name(check_segmenter("segmenters:Connects"))
    assert failed(rows) == [ROWS[1], ROWS[-1]]
    assert rows[ROWS[-1]].found.startswith("was refused what it asked for: ")


@pytest.mark.usefixtures("in_threads")
def test_it_is_tried_on_images_of_ones_own_and_nothing_is_left_behind(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    images = [replace(tiny_images()[0], place="home")]
    rows = by_name(check_segmenter("segmenters:Good", images=images))
    assert failed(rows) == []
    assert rows["the same answer twice"].found == "1 image"
    assert list(tmp_path.iterdir()) == []
