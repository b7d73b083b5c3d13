# SPDX-License-Identifier: Apache-2.0
"""Scores of segmenters: held against scikit-learn and against hand-worked counts; silence, ties and intervals."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.metrics import brier_score_loss, jaccard_score, precision_score, recall_score, roc_auc_score

from sasgeo_bench.core.errors import MetricError, StoreError
from sasgeo_bench.core.parquet import write_frame
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.scoring import segmentation as scoring
from sasgeo_bench.scoring.segmentation import (
    PixelCounts,
    error_over_coverage,
    read_counts,
    reliability,
    segmentation_scores,
    write_counts,
)
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation
from sasgeo_bench.sensing.tiny_images import with_picture

CLASSES = ("building", "water")


def labelled(labels, *, place="here", season=""):
    labels = np.asarray(labels, dtype=np.uint8)
    picture = replace(with_picture(np.zeros((*labels.shape[1:], 3), dtype=np.uint8)), season=season)
    return LabelledImage(image=picture, classes=CLASSES[: len(labels)], labels=labels, place=place)


def said(bytes_):
    bytes_ = np.asarray(bytes_, dtype=np.uint8)
    return Segmentation(classes=CLASSES[: len(bytes_)], probability_bytes=bytes_)


def drawn(seed, *, place="here", season="", shape=(12, 15)):
    """Counts of a random picture, with its labels and bytes."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, (2, *shape), dtype=np.uint8)
    bytes_ = np.clip(rng.normal(90 + 70 * labels, 60), 0, CERTAIN).astype(np.uint8)
    counts = PixelCounts.of(labelled(labels, place=place, season=season), said(bytes_), image=f"{place}/{seed}")
    return counts, labels, bytes_


def table_of(frame, metric, class_name="building", group="all"):
    one = frame[(frame["metric"] == metric) & (frame["class"] == class_name) & (frame["group"] == group)]
    return one.iloc[0]


def test_figures_are_those_of_scikit_learn_where_all_is_said():
    counts, labels, bytes_ = drawn(1)
    truth, chances = labels[0].ravel(), bytes_[0].ravel() / CERTAIN
    seen, table = chances >= 0.5, counts.of_class("building").astype(float)
    assert scoring.auc(table) == pytest.approx(roc_auc_score(truth, chances))
    assert scoring.brier(table) == pytest.approx(brier_score_loss(truth, chances))
    assert scoring.iou(table) == pytest.approx(jaccard_score(truth, seen))
    assert scoring.recall(table) == pytest.approx(recall_score(truth, seen))
    assert scoring.precision(table) == pytest.approx(precision_score(truth, seen))
    assert scoring.error_where_known(table) == pytest.approx((seen != truth).mean())
    assert scoring.share_gap(table) == pytest.approx(chances.mean() - truth.mean())


def test_silence_costs_recall_and_is_forgiven_where_only_what_is_said_counts():
    counts = PixelCounts.of(labelled([[[1, 1, 1, 0, 0]]]), said([[[254, SILENT, 254, 0, SILENT]]]), image="1")
    table = counts.of_class("building").astype(float)
    found = {metric.name: float(metric.compute(table)) for metric in scoring.PIXEL_METRICS}
    assert found["recall"] == pytest.approx(2 / 3)
    assert found["iou"] == pytest.approx(2 / 3)
    assert found["recall_where_known"] == found["auc"] == found["precision"] == 1
    assert found["silent"] == pytest.approx(0.4)
    assert found["error"] == found["brier"] == found["ece"] == 0
    assert np.isnan(found["error_80"])  # only 60 % is said


def test_to_make_the_least_sure_fifth_unknown_takes_its_errors_away():
    labels = [[[1] * 8 + [1, 0]]]
    table = PixelCounts.of(labelled(labels), said([[[250] * 8 + [120, 130]]]), image="1").of_class("building")
    assert scoring.error_where_known(table.astype(float)) == pytest.approx(0.2)
    assert scoring.error_of_most_confident(table.astype(float)) == 0


def test_what_nobody_has_labelled_counts_nowhere():
    counts, labels, bytes_ = drawn(2)
    more = np.concatenate((labels, np.full_like(labels, UNKNOWN)), axis=1)
    again = PixelCounts.of(labelled(more), said(np.concatenate((bytes_, bytes_), axis=1)), image=counts.image)
    for name in ("pixels", "instead", "besides", "asked"):
        np.testing.assert_array_equal(getattr(again, name), getattr(counts, name))


def test_confusions_tell_ground_and_other_classes_apart():
    labels = [[[1, 1, 1, 0, 0, 0]], [[0, 0, 0, 1, 0, 0]]]
    bytes_ = [[[0, 254, 254, 0, 254, 0]], [[254, 254, 0, SILENT, 0, 0]]]
    counts = PixelCounts.of(labelled(labels), said(bytes_), image="1")
    assert counts.asked.tolist() == [[0, 3], [0, 0], [2, 2]]  # of water nothing is said
    assert counts.instead.tolist() == [[0, 1], [0, 0], [1, 0]]
    assert counts.besides.tolist() == [[0, 1], [0, 0], [0, 0]]


def test_ground_is_where_no_labelled_class_is_though_another_one_was_not_looked_for():
    labels = [[[1, 0, 0]], [[UNKNOWN, UNKNOWN, UNKNOWN]]]
    counts = PixelCounts.of(labelled(labels), said(np.full((2, 1, 3), 254)), image="1")
    assert counts.asked[-1].tolist() == [2, 0]
    assert counts.instead[-1].tolist() == [2, 0]


def test_a_class_that_the_segmenter_does_not_tell_has_no_row():
    picture = labelled(np.ones((2, 3, 3)))
    counts = PixelCounts.of(picture, said(np.zeros((1, 3, 3))), image="1")
    assert set(segmentation_scores([counts])["class"]) == {"building"}


def test_a_segmentation_of_another_picture_is_refused():
    with pytest.raises(MetricError, match="shape"):
        PixelCounts.of(labelled(np.ones((1, 3, 3))), said(np.ones((1, 3, 4))), image="1")


def test_scores_stand_for_all_images_each_place_and_each_season():
    some = [drawn(seed, place="ab"[seed % 2], season=("", "snow")[seed > 3])[0] for seed in range(6)]
    frame = segmentation_scores(some, draws=50, segmenter="mine")
    assert frame.columns[0] == "segmenter"
    groups = frame[["group", "name"]].drop_duplicates().to_numpy().tolist()
    assert groups == [["all", ""], ["place", "a"], ["place", "b"], ["season", "snow"]]
    pooled = np.sum([one.of_class("building") for one in some], axis=0).astype(float)
    assert table_of(frame, "auc")["value"] == pytest.approx(float(scoring.auc(pooled)))


def test_intervals_draw_places_and_then_images_and_one_place_says_nothing_of_others():
    some = [drawn(seed, place="abc"[seed % 3])[0] for seed in range(9)]
    frame = segmentation_scores(some, draws=200)
    whole, one = table_of(frame, "iou"), table_of(frame, "iou", group="place")
    assert whole["lo"] < whole["value"] < whole["hi"]
    assert whole["lo_images"] < whole["value"] < whole["hi_images"]
    assert (whole["images"], whole["places"]) == (9, 3)
    assert np.isnan(one["lo"])
    assert one["lo_images"] < one["value"] < one["hi_images"]
    assert np.isnan(table_of(segmentation_scores(some[:1]), "iou")["lo_images"])


def test_places_that_differ_widen_the_interval_of_places_alone():
    poor = PixelCounts.of(labelled(np.ones((1, 9, 9)), place="b"), said(np.zeros((1, 9, 9))), image="poor")
    good = PixelCounts.of(labelled(np.ones((1, 9, 9)), place="a"), said(np.full((1, 9, 9), 254)), image="good")
    some = [replace(one, image=f"{one.image}{at}") for one in (good, poor) for at in range(20)]
    row = table_of(segmentation_scores(some, draws=400), "recall")
    assert (row["lo"], row["hi"]) == (0, 1)
    assert 0.3 < row["lo_images"] < 0.5 < row["hi_images"] < 0.7


def test_the_order_of_images_changes_no_value():
    some = [drawn(seed, shape=(4, 5))[0] for seed in range(5)]
    first, second = (segmentation_scores(part, draws=1) for part in (some, some[::-1]))
    np.testing.assert_allclose(first["value"], second["value"])


def test_tables_of_reliability_and_coverage_add_up():
    some = [drawn(seed)[0] for seed in range(4)]
    bins = reliability(some, segmenter="mine")
    bins = bins[bins["class"] == "building"]
    weights = bins["pixels"] / bins["pixels"].sum()
    pooled = np.sum([one.of_class("building") for one in some], axis=0).astype(float)
    gap = (weights * (bins["probability"] - bins["present"]).abs()).sum()
    assert gap == pytest.approx(float(scoring.calibration_error(pooled)))
    curve = error_over_coverage(some)
    curve = curve[curve["class"] == "building"]
    assert curve["coverage"].is_monotonic_increasing
    assert curve["recall"].is_monotonic_increasing
    assert curve["confidence"].between(0.5, 1.0).all()
    last = curve.iloc[-1]
    assert last["coverage"] == pytest.approx(1)
    assert last["error"] == pytest.approx(float(scoring.error_where_known(pooled)))


def test_counts_come_back_from_their_file(tmp_path):
    some = [drawn(seed, place="ab"[seed % 2], season="snow")[0] for seed in range(3)]
    write_counts(some, tmp_path / "counts.parquet")
    for before, after in zip(some, read_counts(tmp_path / "counts.parquet"), strict=True):
        assert (before.image, before.place, before.season, before.classes) == (
            *(after.image, after.place, after.season),
            after.classes,
        )
        for name in ("pixels", "instead", "besides", "asked"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))


def test_another_table_is_no_file_of_counts(tmp_path):
    some = [drawn(1)[0]]
    frame = reliability(some)
    write_frame(frame, tmp_path / "other.parquet", attrs={})
    with pytest.raises(StoreError, match="no counts of segmented images"):
        read_counts(tmp_path / "other.parquet")
