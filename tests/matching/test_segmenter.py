# SPDX-License-Identifier: Apache-2.0
"""The door of segmenters: cards, trainings, answers and learned texts that are not sound are refused in one line."""

import sys

import numpy as np
import pytest

from sasgeo_bench.core.errors import ImageError, MatchError
from sasgeo_bench.core.plugins import (
    ORACLE_SEGMENTER,
    SEGMENTERS,
    check_card_name,
    check_names,
    list_entry_points,
    shipped_names,
)
from sasgeo_bench.matching.plugins import load_segmenter
from sasgeo_bench.matching.segmenter import (
    MOST_TEXT_BYTES,
    ImageTraining,
    LearningSegmenter,
    Segmenter,
    SegmenterCard,
    check_segmentation,
    check_text,
)
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images

SAID = {"name": "mine", "version": "1", "title": "T", "source": "original", "ours": "all", "licence": "MIT"}
MODULE = """
from sasgeo_bench.matching.segmenter import SegmenterCard


class Mine:
    card = SegmenterCard(name="mine", version="1", title="T", source="original", ours="all", licence="MIT")

    def segment(self, image, *, learned):
        return None


class Learns(Mine):
    def learn(self, training):
        return ""
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a distribution with segmenters on the import path."""

    def put(name: str, **points: str) -> None:
        about = tmp_path / name / f"{name}-1.0.dist-info"
        about.mkdir(parents=True)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [f"[{SEGMENTERS}]", *(f"{point} = {value}" for point, value in points.items())]
        (about / "entry_points.txt").write_text("\n".join(lines) + "\n")
        (tmp_path / name / "segmenter_of_the_test.py").write_text(MODULE)
        monkeypatch.syspath_prepend(str(tmp_path / name))

    yield put
    sys.modules.pop("segmenter_of_the_test", None)


def test_a_segmenter_is_found_by_its_name_or_its_class(install) -> None:
    install("x_own", mine="segmenter_of_the_test:Mine", learns="segmenter_of_the_test:Learns")
    assert {"mine", "learns"} <= {*list_entry_points(SEGMENTERS)}
    for spec, learns in (
        ("mine", False),
        ("segmenter_of_the_test:Learns", True),
        ("segmenter_of_the_test:Mine", False),
    ):
        made = load_segmenter(spec)
        assert isinstance(made, Segmenter)
        assert isinstance(made, LearningSegmenter) == learns
    check_names(segmenters=["mine", "any.module:Class", ORACLE_SEGMENTER])
    with pytest.raises(MatchError, match=r"no segmenter 'mime', did you mean 'mine'\? \(list segmenters shows all"):
        check_names(segmenters=["mime"])


def test_the_name_of_the_control_is_reserved(install) -> None:
    install("x_own", oracle_segmenter="segmenter_of_the_test:Mine")
    with pytest.warns(UserWarning, match="'oracle_segmenter' is the name of a control of the runner"):
        assert ORACLE_SEGMENTER not in list_entry_points(SEGMENTERS)
    assert ORACLE_SEGMENTER in shipped_names(SEGMENTERS)
    assert ORACLE_SEGMENTER not in shipped_names()
    with pytest.raises(MatchError, match="as a segmenter that ships: rename it"):
        check_card_name("x:Mine", ORACLE_SEGMENTER, group=SEGMENTERS)
    with pytest.raises(MatchError, match="names that begin with oracle_ are of oracles"):
        check_card_name("x:Mine", "oracle_roofs", group=SEGMENTERS)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"licence": " "}, "card: licence is empty"),
        ({"name": "My segmenter"}, "card: name 'My segmenter' may hold lower-case letters"),
        ({"classes": ("building", "volcano")}, "card: classes holds 'volcano', known are road_major, "),
        ({"needs": ("position",)}, "card: needs holds 'position', known are training"),
        ({"trained_on": ("here\nthere",)}, "card: trained_on must be one line"),
    ],
)
def test_a_card_without_the_facts_is_refused(changes, fault) -> None:
    with pytest.raises(MatchError, match=fault):
        SegmenterCard(**SAID | changes)


@pytest.mark.parametrize(
    ("found", "classes", "fault"),
    [
        (None, (), "returned NoneType, expected sasgeo_bench.sensing.segmentation.Segmentation"),
        (np.zeros((1, 96, 128)), (), "returned ndarray"),
        (("building", (1, 9, 9)), (), r"shape \(9, 9\), the picture has \(96, 128\)"),
        (("volcano", (1, 96, 128)), (), "the class 'volcano', the taxonomy has road_major"),
        (("water", (1, 96, 128)), ("building",), "the class 'water', the card names building"),
    ],
)
def test_an_answer_that_is_none_of_the_image_is_refused(found, classes, fault) -> None:
    if isinstance(found, tuple):
        found = Segmentation(classes=(found[0],), probability_bytes=np.zeros(found[1], dtype=np.uint8))
    with pytest.raises(MatchError, match=fault):
        check_segmentation(found, tiny_images()[0].image, classes=classes)


def test_learned_texts_end_somewhere_a_training_has_images_and_a_sound_answer_may_be_silent() -> None:
    assert len(check_text("x" * MOST_TEXT_BYTES)) == MOST_TEXT_BYTES
    with pytest.raises(MatchError, match=f"expected at most {MOST_TEXT_BYTES}"):
        check_text("x" * (MOST_TEXT_BYTES + 1))
    with pytest.raises(MatchError, match="returned bytes, expected a text"):
        check_text(b"trees")
    with pytest.raises(ImageError, match="no image to learn from"):
        ImageTraining(images=[])
    silent = Segmentation(classes=("water",), probability_bytes=np.full((1, 96, 128), 255, dtype=np.uint8))
    assert check_segmentation(silent, tiny_images()[0].image) is silent


def test_tiny_images_show_every_class_they_label_and_are_the_same_each_time() -> None:
    images, again = tiny_images(), tiny_images()
    assert len({each.place for each in images}) == 2
    for one, other in zip(images, again, strict=True):
        np.testing.assert_array_equal(one.image.rgb, other.image.rgb)
        np.testing.assert_array_equal(one.labels, other.labels)
        assert {int(state) for state in np.unique(one.labels)} == {0, 1, 2}
        assert all((plane == 1).any() for plane in one.labels)
