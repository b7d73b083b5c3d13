# SPDX-License-Identifier: Apache-2.0
"""Messages of views: what arrives, in how many bytes, and what their budgets leave out."""

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.telemetry import (
    TILE_CELLS,
    junctions,
    length_of,
    outlines,
    regions_of_interest,
    run_length,
    runs_of,
    whole,
)
from sasgeo_bench.tasks.vectors import vector_table

BUDGETS = (128, 256, 512, 1024)
NAMES = ("building", "road_minor")


def view_of(*boxes, size=96):
    """A view with boxes (class, state, top, bottom, left, right)."""
    cells = np.zeros((len(NAMES), size, size), dtype=np.uint8)
    for name, state, top, bottom, left, right in boxes:
        cells[NAMES.index(name), top:bottom, left:right] = state
    return Evidence(classes=NAMES, cells=cells, cell_size_m=1.0)


def read_runs(message):
    """Read runs back, as a receiver would."""
    values, number, shift = [], 0, 0
    for byte in message:
        number |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            values.append(number)
            number = shift = 0
    return np.concatenate([np.full(value // 4, value % 4, dtype=np.uint8) for value in values])


@given(st.lists(st.integers(0, 2), min_size=1, max_size=600))
def test_runs_hold_every_cell(states):
    cells = np.array(states, dtype=np.uint8)
    np.testing.assert_array_equal(read_runs(runs_of(cells)), cells)


def test_whole_views_and_runs_arrive_as_they_are_without_confidence(view):
    seen = view.replace(view.cells, np.full_like(view.cells, 200))
    for sent in (whole(seen), run_length(seen)):
        np.testing.assert_array_equal(sent.evidence.cells, seen.cells)
        assert sent.evidence.confidence is None
    assert run_length(view).bytes < whole(view).bytes < view.cells.size / 4


def test_a_message_is_deflated_only_where_that_is_shorter():
    assert length_of(bytes(1000)) < 30
    assert length_of(bytes([7, 200, 13])) == 4


def test_outlines_of_boxes_arrive_exactly_where_there_are_bytes_enough():
    seen = view_of(("building", PRESENT, 10, 30, 20, 50), ("road_minor", PRESENT, 60, 64, 0, 96))
    sent = outlines(seen, budget_bytes=1000)
    np.testing.assert_array_equal(sent.evidence.cells, seen.cells)
    assert sent.bytes < 60


def test_a_hole_and_unknown_ground_arrive():
    seen = view_of(("building", PRESENT, 10, 60, 10, 60), ("building", ABSENT, 25, 45, 25, 45))
    cells = seen.cells.copy()
    cells[:, 70:, :] = UNKNOWN
    cells[1, :20, 70:] = UNKNOWN  # of roads alone
    hidden = seen.replace(cells)
    np.testing.assert_array_equal(outlines(hidden, budget_bytes=1000).evidence.cells, cells)


@pytest.mark.parametrize("budget", BUDGETS)
def test_no_message_is_longer_than_its_budget(views, budget):
    for view in views[::4]:
        shares = (view.cells == PRESENT).mean(axis=(1, 2))
        for sent in (outlines(view, budget_bytes=budget), regions_of_interest(view, shares, budget_bytes=budget)):
            assert sent.bytes <= budget
            assert sent.evidence.shape == view.shape


def test_more_bytes_show_more(view):
    shares = (view.cells == PRESENT).mean(axis=(1, 2))
    lost = [
        [(of(budget).evidence.cells != view.cells).mean() for budget in BUDGETS]
        for of in (
            lambda budget: outlines(view, budget_bytes=budget),
            lambda budget: regions_of_interest(view, shares, budget_bytes=budget),
        )
    ]
    assert all(one == sorted(one, reverse=True) for one in lost)


def test_regions_of_interest_are_true_and_begin_where_most_is_said():
    """A house where houses are rare says more than a square of nothing, or of roads, which are common."""
    house = ("building", PRESENT, 40, 44, 40, 44)
    seen = view_of(house, ("road_minor", PRESENT, 80, 88, 0, 96))
    sent = regions_of_interest(seen, np.array([0.001, 0.3]), budget_bytes=16)
    cells = sent.evidence.cells
    known = cells != UNKNOWN
    np.testing.assert_array_equal(cells[known], seen.cells[known])
    assert known[:, 40:44, 40:44].all()
    assert known[0].sum() % TILE_CELLS**2 == 0
    assert known[0].sum() < seen.cells[0].size


FORK = vector_table(
    [
        ("road_minor", 0, False, shapely.LineString([(-40, 0), (0, 0), (40, 0)])),
        ("road_minor", 0, False, shapely.LineString([(0, 0), (0, 40)])),
    ]
)


def test_a_junction_arrives_with_its_arms_and_nothing_else_is_known():
    seen = view_of()
    sent = junctions(seen, FORK, budget_bytes=64)
    assert sent.bytes == 1 + 2 + 1 + 3
    ends = np.array([line.coords[-1] for line in sent.vectors.geometry])
    turns = np.degrees(np.arctan2(ends[:, 0], ends[:, 1])) % 360
    assert np.allclose(turns, [0, 90, 270], atol=3)
    assert (sent.evidence.cells[0] == UNKNOWN).all()
    road = sent.evidence.cells[1]
    assert set(np.unique(road)) == {PRESENT, UNKNOWN}
    rows, cols = np.nonzero(road == PRESENT)
    assert np.hypot(rows - 47.5, cols - 47.5).max() < 15


def test_a_square_that_crosses_itself_is_no_arm_and_stops_nothing():
    bow = shapely.Polygon([(-8, -8), (8, 8), (8, -8), (-8, 8)])
    squares = vector_table([("path_track", 0, False, bow), ("path_track", 0, False, shapely.box(2, 2, 9, 9))])
    with_squares = pd.concat([FORK, squares], ignore_index=True)
    plain, found = (junctions(view_of(), table, budget_bytes=64) for table in (FORK, with_squares))
    assert found.vectors.geometry.tolist() == plain.vectors.geometry.tolist()


def test_junctions_that_do_not_fit_are_left_out_and_no_junction_shows_nothing():
    assert len(junctions(view_of(), FORK, budget_bytes=3).vectors) == 0
    none = junctions(view_of(), FORK.iloc[:1], budget_bytes=64)
    assert none.bytes == 1
    assert (none.evidence.cells == UNKNOWN).all()
