# SPDX-License-Identifier: Apache-2.0
"""Descriptors of `deep_retrieval`, and what it says in a line; tests/baselines/test_image_matchers.py asks it."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from sasgeo_baselines.image import deep_retrieval
from sasgeo_baselines.image.deep_retrieval import DeepRetrieval
from sasgeo_baselines.image.view_image import Ortho
from sasgeo_baselines.segmenters.features import ColourBalance, lab_planes

from sasgeo_bench.geometry.grid import Grid

RNG = np.random.default_rng


def with_weights(path, name="mine") -> DeepRetrieval:
    """One of a class of one's own, as a user writes it."""
    return type("Mine", (DeepRetrieval,), {"card": replace(DeepRetrieval.card, name=name), "weights": path})()


@pytest.mark.usefixtures("without_torch")
def test_the_matcher_says_in_one_line_that_torch_is_missing(drawn_file):
    with pytest.raises(RuntimeError, match=r"^mine needs PyTorch.*sasgeo-baselines\[torch\]'$"):
        with_weights(drawn_file).prepare(SimpleNamespace(imagery=None), None)


def test_the_matcher_says_in_one_line_that_it_has_no_weights():
    with pytest.raises(ValueError, match=r"^deep_retrieval has no weights: name their file") as caught:
        DeepRetrieval().prepare(SimpleNamespace(imagery=None), None)
    assert "\n" not in str(caught.value)


def speckled(rows: int, cols: int) -> np.ndarray:
    """Ground with patches of many sizes and colours."""
    fine, coarse = (RNG(4).normal(0, 1, (rows // step, cols // step, 3)) for step in (4, 16))
    parts = [cv2.resize(part, (cols, rows), interpolation=cv2.INTER_CUBIC) for part in (fine, coarse)]
    return np.clip(120 + 30 * sum(parts), 0, 255).astype(np.uint8)


@pytest.mark.usefixtures("torch")
def test_blocks_of_a_map_are_those_of_a_part_of_it(drawn_file, monkeypatch):
    """Descriptors depend on what lies around a block, not on where tiles begin."""
    rgb = speckled(400, 560)
    grid = Grid(epsg=32632, west_m=0.0, north_m=0.0, cell_size_m=0.5, rows=400, cols=560)
    ortho = Ortho(grid=grid, rgb=rgb, is_known=np.ones((400, 560), dtype=bool))
    encoder = deep_retrieval.Encoder.of(drawn_file, name="mine")
    tiled = deep_retrieval.described(encoder, ortho).astype(np.float32)
    assert tiled.shape == (25, 35, 96 + 128)
    monkeypatch.setattr(deep_retrieval, "_TILE_PX", 1024)
    whole = deep_retrieval.described(encoder, ortho).astype(np.float32)
    cosines = (tiled * whole).sum(axis=2) / 2  # two levels, each of length 1
    assert np.median(cosines) > 0.95


@pytest.mark.usefixtures("torch")
def test_what_is_not_known_has_no_descriptor(drawn_file):
    is_known = np.ones((256, 256), dtype=bool)
    is_known[:, 100:] = False
    encoder = deep_retrieval.Encoder.of(drawn_file, name="mine")
    rgb = speckled(256, 256)
    blocks = encoder.blocks(rgb, is_known, ColourBalance.of(lab_planes(rgb)))
    assert blocks.shape == (16, 16, 224)
    assert blocks[:, :5].any(axis=2).all()
    assert not blocks[:, 9:].any()
