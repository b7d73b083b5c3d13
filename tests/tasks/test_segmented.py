# SPDX-License-Identifier: Apache-2.0
"""Segmented pictures show the class that is drawn on top, silence and doubt apart, and come back as written."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.regions.painting import PAINT_ORDER
from sasgeo_bench.sensing.segmentation import SILENT, Segmentation
from sasgeo_bench.tasks.segmented import MOST_PX, NOTHING, Segmented, read_segmented, segmented_file, write_segmented


def seen(*planes, classes=("road_major", "green")):
    return Segmentation(classes=classes, probability_bytes=np.array(planes, dtype=np.uint8))


def test_roads_lie_over_woods_and_a_class_less_likely_than_not_is_not_drawn():
    drawn = Segmented.of(seen([[200, 126, 126]], [[200, 200, 126]])).drawn[0]
    assert [PAINT_ORDER[at - 1] for at in drawn[:2]] == ["road_major", "green"]
    assert drawn[2] == NOTHING


def test_silence_of_all_classes_is_kept_and_of_one_is_not_taken_for_it():
    drawn = Segmented.of(seen([[SILENT, SILENT]], [[SILENT, 200]]))
    assert drawn.drawn[0, 0] == SILENT
    assert drawn.classes == ("green",)


def test_a_large_picture_is_reduced_and_laid_over_the_whole_of_it():
    found = Segmented.of(seen(np.full((768, 500), 200), np.zeros((768, 500))))
    assert max(found.drawn.shape) <= MOST_PX
    over = found.over(np.full((768, 500, 3), 40, dtype=np.uint8))
    assert over.shape == (768, 500, 3)
    assert (over.std(axis=2) > 0).all()


def test_what_is_written_is_read_and_a_query_without_a_picture_has_none(tmp_path):
    path = segmented_file(tmp_path, "0" * 64)
    assert read_segmented(path, "a") is None
    own = Segmented.of(seen([[200, 0, SILENT]], [[0, 200, SILENT]]))
    write_segmented(path, {"a": own})
    again = read_segmented(path, "a")
    np.testing.assert_array_equal(again.drawn, own.drawn)
    assert read_segmented(path, "b") is None


def test_a_damaged_file_is_refused_with_what_to_do(tmp_path):
    path = segmented_file(tmp_path, "0" * 64)
    path.parent.mkdir(parents=True)
    path.write_bytes(b"PAR1")
    with pytest.raises(StoreError, match="segment the pictures again"):
        read_segmented(path, "a")
