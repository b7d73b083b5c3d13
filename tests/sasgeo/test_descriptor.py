# SPDX-License-Identifier: Apache-2.0
"""The paper's own graph descriptor: blind to turns, specks and what is not known."""

import numpy as np
import pytest

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.sasgeo.descriptor import GraphDescriptor, descriptor_score


def houses(*corners, shape=(64, 64)):
    cells = np.zeros((1, *shape), dtype=np.uint8)
    for row, col in corners:
        cells[0, row : row + 6, col : col + 6] = PRESENT
    return cells


HERE = houses((4, 4), (4, 40), (30, 20), (50, 50))


def test_a_turn_changes_nothing():
    turned = np.ascontiguousarray(np.rot90(HERE, axes=(1, 2)))
    assert descriptor_score(HERE, turned, cell_size_m=1.0) == pytest.approx(1.0)


def test_other_counts_and_other_distances_are_told():
    fewer, nearer = houses((4, 4), (4, 40)), houses((4, 4), (4, 14), (14, 4), (14, 14))
    assert descriptor_score(HERE, fewer, cell_size_m=1.0) < 0.9
    assert descriptor_score(HERE, nearer, cell_size_m=1.0) < 0.9


def test_what_either_side_does_not_know_and_specks_are_left_out():
    hidden, speck = houses((4, 4), (4, 40), (30, 20)), HERE.copy()
    hidden[0, 46:, 46:] = UNKNOWN
    speck[0, 20, 2] = PRESENT
    assert descriptor_score(hidden, HERE, cell_size_m=1.0) == 1.0
    assert descriptor_score(HERE, hidden, cell_size_m=1.0) == 1.0
    assert descriptor_score(speck, HERE, cell_size_m=1.0) == 1.0


def test_nothing_is_like_nothing():
    none = np.zeros((2, 8, 8), dtype=np.uint8)
    assert descriptor_score(none, none, cell_size_m=1.0) == 1.0
    assert GraphDescriptor.of(none, cell_size_m=1.0).distances.sum() == 0
