# SPDX-License-Identifier: Apache-2.0
"""Rare configurations weigh more, turning changes nothing, and a map of nothing weighs alike."""

import numpy as np
import pytest

from sasgeo_bench.sasgeo.class_weights import LEAST, MOST, Rarity

CLASSES = ("road_minor", "building")


@pytest.fixture(scope="module")
def streets():
    """Parallel streets with houses along them, one crossroads."""
    layers = np.zeros((2, 480, 480), dtype=np.uint8)
    for row in range(40, 480, 80):
        layers[0, row - 3 : row + 3] = 1
        for col in range(20, 480, 30):
            layers[1, row + 10 : row + 20, col : col + 10] = 1
    layers[0, :, 237:243] = 1
    return layers


def test_a_crossroads_weighs_more_than_a_street_and_the_mean_over_what_is_drawn_is_one(streets):
    rarity, again = (Rarity.of(streets, CLASSES, cell_size_m=1.0) for _ in range(2))
    nu = rarity.weights(streets, CLASSES, cell_size_m=1.0)
    assert nu.shape == streets.shape[1:]
    assert nu[200, 240] > nu[200, 100]
    assert ((nu >= LEAST) & (nu <= MOST)).all()
    assert nu[streets.any(axis=0)].mean() == pytest.approx(1.0, abs=0.15)
    assert (rarity.words == again.words).all()
    assert (rarity.weight == again.weight).all()


def test_turning_a_view_turns_its_weights_and_classes_the_map_does_not_have_weigh_one(streets):
    rarity = Rarity.of(streets, CLASSES, cell_size_m=1.0)
    view = streets[:, 120:312, 144:336]
    nu = rarity.weights(view, CLASSES, cell_size_m=1.0)
    turned = rarity.weights(np.ascontiguousarray(np.rot90(view, 1, (1, 2))), CLASSES, cell_size_m=1.0)
    assert (np.rot90(nu) == turned).mean() > 0.98
    rarity = Rarity.of(streets, CLASSES, cell_size_m=1.0)
    strange = rarity.weights(np.ones((1, 96, 96), dtype=np.uint8), ("lava",), cell_size_m=1.0)
    assert (strange == 1.0).all()


@pytest.mark.parametrize("value", [0, 255])
def test_where_nothing_is_drawn_or_known_all_weigh_one(value):
    nothing = np.full((2, 64, 64), value, dtype=np.uint8)
    rarity = Rarity.of(nothing, CLASSES, cell_size_m=1.0)
    assert (rarity.weights(nothing, CLASSES, cell_size_m=1.0) == 1.0).all()
