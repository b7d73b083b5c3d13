# SPDX-License-Identifier: Apache-2.0
"""Segmentations: bytes and probabilities, new shares without labels, and bytes from anywhere."""

import json
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation, calibration_tables

PLANES = arrays(np.uint8, array_shapes(min_dims=3, max_dims=3, max_side=6))


def seen(planes: np.ndarray) -> Segmentation:
    return Segmentation(classes=tuple(f"c{at}" for at in range(len(planes))), probability_bytes=planes)


@given(PLANES)
def test_bytes_become_probabilities_and_the_same_bytes_again(planes: np.ndarray) -> None:
    first = seen(planes)
    again = Segmentation.of_probabilities(first.classes, first.probabilities())
    np.testing.assert_array_equal(again.probability_bytes, planes)
    assert first.probabilities().dtype == np.float32
    np.testing.assert_array_equal(np.isnan(first.probabilities()), planes == SILENT)


@given(PLANES)
def test_a_segmentation_written_to_bytes_is_read_again(planes: np.ndarray) -> None:
    first = seen(planes)
    again = Segmentation.from_bytes(first.to_bytes(), shape=first.shape)
    assert again.classes == first.classes
    np.testing.assert_array_equal(again.probability_bytes, planes)


@given(arrays(np.uint8, (1, 8, 8)), st.floats(0, 1))
def test_new_shares_are_met_keep_the_order_and_leave_silence_alone(planes: np.ndarray, share: float) -> None:
    result = planes != SILENT
    moved = seen(planes).with_shares({"c0": share})
    np.testing.assert_array_equal(moved.probability_bytes == SILENT, ~result)
    if result.any():
        assert moved.shares()["c0"] == pytest.approx(share, abs=1 / 508 + 1e-9)
    order = np.argsort(planes[result], kind="stable")
    assert (np.diff(moved.probability_bytes[result][order].astype(int)) >= 0).all()


def test_odds_change_by_one_factor_and_classes_without_a_new_share_stay() -> None:
    moved = seen(np.array([[[51, 127, 203]]], np.uint8)).with_shares({"c0": 0.3})
    before, after = (item / (1 - item) for item in (np.array([51, 127, 203]) / 254, moved.probabilities()[0, 0]))
    np.testing.assert_allclose(after / before, (after / before)[1], rtol=0.05)
    first = seen(np.array([[[10, 200]], [[10, 200]]], np.uint8))
    moved = first.with_shares({"c1": 1.0})
    assert moved.probability_bytes.tolist() == [[[10, 200]], [[254, 254]]]
    assert first.probability_bytes.tolist() == [[[10, 200]], [[10, 200]]]


def test_shares_of_the_training_place_are_replaced_by_those_of_the_new_one() -> None:
    """A calibrated segmenter of a place with 50 % roofs, asked in one with 10 %, is calibrated there again."""
    rng = np.random.default_rng(3)
    is_roof = rng.random(200_000) < 0.1
    look = rng.normal(np.where(is_roof, 1.0, -1.0))
    trained = 1 / (1 + np.exp(-2 * look))  # P(roof | look) where roofs cover one half
    raw = Segmentation.of_probabilities(("roof",), trained.reshape(1, 400, 500))
    moved = raw.with_shares({"roof": 0.1})
    right = 1 / (1 + 9 * np.exp(-2 * look))
    assert np.abs(moved.probabilities().ravel() - right).max() < 0.02
    assert np.abs(raw.probabilities().ravel() - right).max() > 0.4


@pytest.mark.parametrize(
    ("shares", "fault"), [({"roof": 0.1}, "no class 'roof'"), ({"c0": 1.5}, "0..1, got 1.5"), ({"c0": np.nan}, "nan")]
)
def test_unknown_classes_and_impossible_shares_and_probabilities_are_refused(shares, fault) -> None:
    with pytest.raises(ImageError, match=fault):
        seen(np.zeros((1, 2, 2), np.uint8)).with_shares(shares)
    with pytest.raises(ImageError, match=r"0..1, got 0\.\.1\.2"):
        Segmentation.of_probabilities(("a",), np.array([[[0.0, 1.2]]]))


@pytest.mark.parametrize(
    ("classes", "planes", "fault"),
    [
        (("a",), np.zeros((2, 2, 2), np.uint8), r"got uint8 of shape \(2, 2, 2\)"),
        (("a",), np.zeros((1, 2, 2)), "got float64"),
        (("a",), np.zeros((1, 0, 2), np.uint8), "a pixel at least"),
        (("a", "a"), np.zeros((2, 2, 2), np.uint8), "each once"),
    ],
)
def test_a_segmentation_has_planes_of_bytes(classes: tuple[str, ...], planes: np.ndarray, fault: str) -> None:
    with pytest.raises(ImageError, match=fault):
        Segmentation(classes=classes, probability_bytes=planes)


def packed(head: object, planes: bytes) -> bytes:
    text = json.dumps(head).encode()
    return b"SGSEG\x01" + struct.pack("!I", len(text)) + text + zlib.compress(planes)


SOUND = {"classes": ["a"], "shape": [2, 2]}


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b"", "not a segmentation"),
        (b"SGSEG\x01" + struct.pack("!I", 2**31) + b"{}", "not a segmentation"),
        (packed({"classes": ["a"]}, bytes(4)), "head of a segmentation is damaged"),
        (packed({"classes": ["a"], "shape": [2, -2]}, bytes(4)), "head of a segmentation is damaged"),
        (packed({"classes": ["a"], "shape": [2, True]}, bytes(4)), "head of a segmentation is damaged"),
        (packed({"classes": ["a"], "shape": [10**9, 10**9]}, bytes(4)), "too large"),
        (packed({"classes": ["a", "a"], "shape": [2, 2]}, bytes(8)), "each once"),
        (packed(SOUND, bytes(3)), "does not hold the 4 bytes"),
        (packed(SOUND, bytes(10**6)), "does not hold the 4 bytes"),
        (packed(SOUND, bytes(4))[:-3], "does not hold the 4 bytes"),
        (packed(SOUND, bytes(4)).replace(b"\x78\x9c", b"\xff\xff"), "bytes of a segmentation are damaged"),
        (packed({"classes": ["a"], "shape": [4, 1]}, bytes(4)), r"shape \(4, 1\), expected \(2, 2\)"),
    ],
)
def test_bytes_that_are_none_of_a_picture_are_refused_in_one_line(data: bytes, fault: str) -> None:
    with pytest.raises(ImageError, match=fault):
        Segmentation.from_bytes(data, shape=(2, 2))


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (0.5, -1.0), (1.6, 0.8)])
def test_calibration_finds_the_odds_that_pixels_were_drawn_with_and_keeps_their_order(
    scale: float, shift: float
) -> None:
    said = (np.arange(SILENT) / CERTAIN).clip(1e-3, 1 - 1e-3)
    true = 1 / (1 + np.exp(-(scale * np.log(said / (1 - said)) + shift)))
    counts = np.zeros((2, 256), dtype=np.int64)
    counts[:, :SILENT] = np.rint(40_000 * np.stack((1 - true, true)))
    table = calibration_tables({"building": counts})["building"]
    assert table[SILENT] == SILENT
    assert (np.diff(table[:SILENT].astype(int)) >= 0).all()
    inner = slice(10, 245)
    assert np.abs(table[:SILENT][inner] / CERTAIN - true[inner]).max() < 0.01


def test_calibration_leaves_out_a_class_of_which_one_label_is_missing_and_few_pixels_change_little() -> None:
    few = np.zeros((2, 256), dtype=np.int64)
    few[0, 127] = 9
    assert calibration_tables({"water": few}) == {}
    few[1, 127] = 1
    assert abs(int(calibration_tables({"water": few})["water"][127]) - 127) < 5
