# SPDX-License-Identifier: Apache-2.0
"""A segmenter works in a process of its own, sees no labels, and whatever it does costs one image alone."""

import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import ImageError, MatchError
from sasgeo_bench.core.plugins import ORACLE_SEGMENTER
from sasgeo_bench.running import sandbox
from sasgeo_bench.running.segmenting import LoadedSegmenter, SegmenterRun, SegmentRequest, load_card, train_segmenter
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.sensing.image import LabelledFiles, LabelledImage, write_labelled
from sasgeo_bench.sensing.tiny_images import tiny_images, with_picture

PATIENT = Limits(match_s=600.0, memory_bytes=2 * 10**9)
shut_in = pytest.mark.skipif(sandbox.landlock_version() == 0, reason="this kernel has no Landlock to refuse files with")


@pytest.fixture
def request_of(tmp_path, monkeypatch):
    """A request for one of the segmenters beside this file."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.chdir(tmp_path)
    return lambda name, **changes: replace(
        SegmentRequest(spec=f"segmenters:{name}", out=tmp_path / "out", limits=PATIENT), **changes
    )


def loaded(request):
    """What loading tells of a segmenter, without a process for it."""
    card = getattr(import_module("segmenters"), request.spec.partition(":")[2]).card
    return LoadedSegmenter(card=card, code="", learns=False)


def told(request, *images, learned=None):
    """Replies to some images, one after the other."""
    with SegmenterRun(request, loaded(request), learned=learned) as run:
        return [run.segment(image) for image in images]


def test_images_are_answered_with_what_the_plugin_itself_would_say(request_of) -> None:
    from segmenters import Good  # noqa: PLC0415 - beside this file

    images = tiny_images()[:2]
    replies = told(request_of("Good"), *images)
    assert [reply.status for reply in replies] == ["ok", "ok"]
    for labelled, reply in zip(images, replies, strict=True):
        right = Good().segment(labelled.image, learned=None)
        assert reply.found.classes == right.classes
        np.testing.assert_array_equal(reply.found.probability_bytes, right.probability_bytes)
        assert 0 < reply.own_s <= reply.seconds


@pytest.mark.usefixtures("in_threads")
def test_a_segmenter_that_hangs_on_ten_images_in_a_row_is_given_up(request_of) -> None:
    request = request_of("Hangs", limits=replace(PATIENT, match_s=0.01))
    replies = told(request, *[tiny_images()[0]] * 12)
    assert {reply.status for reply in replies} == {"timeout"}
    assert [reply.message.startswith("given up after 10 images in a row") for reply in replies] == [False] * 10 + [
        True
    ] * 2


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("WrongShape", "invalid", r"shape \(4, 4\), the picture has \(96, 128\)"),
        ("UnknownClass", "invalid", "the class 'volcano', the taxonomy has road_major"),
        ("NotOnItsCard", "invalid", "the class 'water', the card names building, green"),
        ("ReturnsAnArray", "invalid", "returned ndarray, expected sasgeo_bench.sensing.segmentation.Segmentation"),
        ("PaintsOver", "invalid", "changed the picture that it was given"),
        ("AnswersGarbage", "invalid", "an answer that is none: these bytes are not a segmentation"),
        ("AnswersAnotherShape", "invalid", r"an answer that is none: .*shape \(2000, 2000\)"),
        ("AnswersAnotherClass", "invalid", "an answer that is none: .*volcano"),
        ("AnswersWithoutEnd", "crash", "an answer of 2000.* bytes"),
    ],
)
@pytest.mark.usefixtures("in_threads")
def test_whatever_a_segmenter_answers_becomes_a_status_and_a_line(request_of, name, status, words) -> None:
    (reply,) = told(request_of(name), tiny_images()[0])
    assert reply.status == status, reply.message
    assert re.search(words, reply.message), reply.message
    assert "\n" not in reply.message
    assert reply.found is None


@pytest.mark.parametrize(
    ("name", "limits", "status", "words"),
    [
        ("Segfaults", PATIENT, "crash", "died by SIGSEGV"),
        ("Hangs", replace(PATIENT, match_s=2.0), "timeout", "no answer within 2 s"),
    ],
)
def test_a_segmenter_that_does_not_answer_is_ended(request_of, name, limits, status, words) -> None:
    (reply,) = told(request_of(name, limits=limits), tiny_images()[0])
    assert (reply.status, reply.message) == (status, words)


def test_a_crash_costs_its_own_image_and_the_next_one_has_a_fresh_process(request_of) -> None:
    bright, dark = (with_picture(np.full((8, 8, 3), value, dtype=np.uint8)) for value in (200, 10))
    replies = told(request_of("Exits"), bright, dark, bright)
    assert [reply.status for reply in replies] == ["ok", "crash", "ok"]
    assert replies[1].message == "ended with exit status 3: last words"


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("name", ["Learns", "NeedsTraining"])
def test_what_was_learned_goes_to_every_process_that_is_asked(request_of, name) -> None:
    images = tiny_images()
    request = request_of(name)
    result = train_segmenter(request, images)
    assert '"places": ["drawn-east", "drawn-west"]' in result.learned
    taught, untaught = (told(request, images[0], learned=text)[0] for text in (result.learned, None))
    assert taught.status == "ok"
    at = images[0].classes.index("building")
    is_roof, is_none = (images[0].labels[at] == label for label in (1, 0))
    roof = taught.found.probabilities()[0]
    assert roof[is_roof].mean() > 0.5 > 2 * roof[is_none].mean()
    assert untaught.status == ("ok" if name == "Learns" else "not applicable")
    assert untaught.message == ("" if name == "Learns" else "no training")


def test_learning_reads_files_where_they_lie_and_the_same_images_give_the_same_text(request_of, tmp_path) -> None:
    files = LabelledFiles(write_labelled(tmp_path / "out" / "tasks" / "images", tiny_images()))
    texts = {train_segmenter(request_of("Learns"), images).learned for images in (files, tiny_images())}
    assert len(texts) == 1
    assert None not in texts


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("LearnsNothing", "crash", "while learning: ValueError: too few roofs"),
        ("Forgets", "invalid", "while learning: learn.. returned int, expected a text"),
        ("LearnsTooMuch", "invalid", "while learning: learn.. returned 33554433 bytes"),
        ("Good", "invalid", "while learning: good has no learn"),
    ],
)
def test_a_failed_training_is_a_result_with_its_cause(request_of, name, status, words) -> None:
    result = train_segmenter(request_of(name), tiny_images()[:1])
    assert (result.learned, result.status) == (None, status)
    assert re.search(words, result.message), result.message


def test_images_that_label_other_classes_are_refused_before_anything_starts(request_of) -> None:
    first, second = tiny_images()[:2]
    other = LabelledImage(image=second.image, classes=("building",), labels=second.labels[:1].copy(), place="x")
    with pytest.raises(ImageError, match="image 1 labels building, the first one road_minor, building, water, green"):
        train_segmenter(request_of("Learns"), [first, other])


@shut_in
def test_a_segmenter_sees_no_labels_of_what_it_is_asked(request_of, tmp_path) -> None:
    for folder in ("out/truth/images", "out/tasks/images", "mine/test"):
        write_labelled(tmp_path / folder, tiny_images())
    (reply,) = told(request_of("LooksForLabels"), tiny_images()[0])
    assert int(reply.found.probability_bytes.max()) == 0
    (reply,) = told(request_of("LooksForLabels", is_sandboxed=False), tiny_images()[0])
    assert int(reply.found.probability_bytes.min()) == 12


@shut_in
def test_a_segmenter_that_learns_sees_no_labels_but_those_it_learns_from(request_of, tmp_path) -> None:
    folders = ("out/tasks/train", "mine/train", "out/tasks/test", "mine/test")
    own, mine, *_ = (LabelledFiles(write_labelled(tmp_path / folder, tiny_images())) for folder in folders)
    for given in (own, mine):
        assert train_segmenter(request_of("CountsLabels"), given).learned == "0 beside 4"
    assert train_segmenter(request_of("CountsLabels", is_sandboxed=False), own).learned == "12 beside 4"


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("NoCard", "card is a NoneType, expected a sasgeo_bench.matching.segmenter.SegmenterCard"),
        ("NoVerb", "NoVerb is not a segmenter, it has no segment"),
        ("NoSuchClass", "cannot be imported"),
        ("Imitates", "its card is named 'oracle_segmenter', as a segmenter that ships: rename it"),
    ],
)
def test_what_is_no_segmenter_is_refused_in_one_line(request_of, name, words) -> None:
    with pytest.raises(MatchError, match=words) as refused:
        load_card(request_of(name))
    assert "\n" not in str(refused.value)


def test_the_control_answers_with_the_labels_and_starts_no_process(request_of) -> None:
    request = request_of("Good", spec=ORACLE_SEGMENTER)
    labelled = tiny_images()[0]
    with SegmenterRun(request, load_card(request)) as run:
        found = run.segment(labelled).found
        assert run.isolation == {"truth": "given, as this control needs it"}
        with pytest.raises(MatchError, match="answers with labels, and this image has none"):
            run.segment(labelled.image)
        assert run.peak_bytes == 0
    given = found.probabilities()
    np.testing.assert_array_equal(np.isnan(given), labelled.labels == 2)
    np.testing.assert_array_equal(given == 1, labelled.labels == 1)


def test_an_error_of_our_own_costs_one_image_and_is_logged(request_of, tmp_path, monkeypatch) -> None:
    def fail(*_, **__):
        raise RuntimeError("no such thing")

    request = request_of("Good")
    monkeypatch.setattr("sasgeo_bench.running.segmenter_process.image_bytes", fail)
    with SegmenterRun(request, loaded(request)) as run:
        reply = run.segment(tiny_images()[0])
    assert reply.status == "crash"
    assert "not its own process failed, but ours: RuntimeError: no such thing" in reply.message
    assert "no such thing" in (tmp_path / "out" / "failures.log").read_text()
