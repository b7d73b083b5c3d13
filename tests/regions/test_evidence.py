# SPDX-License-Identifier: Apache-2.0
"""Three-state evidence: packed and back exactly, one rotation convention, silence where nothing is known."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import (
    PRESENT,
    UNKNOWN,
    Evidence,
    LayerBits,
    cell_offsets_m,
    footprint,
    observe,
    pack,
    unpack,
)
from sasgeo_bench.regions.layers import OUTSIDE

GRID = Grid(epsg=32632, west_m=1000.0, north_m=2100.0, cell_size_m=1.0, rows=100, cols=100)
states = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=1, max_dims=3, max_side=13), elements=st.integers(0, 2))


def at(u, v, yaw_deg=0.0, scale=1.0):
    return Pose(easting_m=1000.0 + u, northing_m=2100.0 - v, yaw_deg=yaw_deg, scale=scale)


def landmark(row, col):
    layers = np.zeros((1, 100, 100), dtype=np.uint8)
    layers[0, row, col] = PRESENT
    return layers


@given(states)
def test_packing_and_unpacking_gives_the_same_cells_in_two_bits_each(cells):
    packed = pack(cells)
    assert len(packed) == -(-cells.size // 4)
    assert (unpack(packed, cells.shape) == cells).all()


def test_damaged_bytes_are_refused():
    with pytest.raises(ShapeError, match="take 2 bytes, got 1"):
        unpack(b"\0", (5,))
    with pytest.raises(ShapeError, match="damaged"):
        unpack(b"\xff", (4,))


@pytest.mark.parametrize(
    ("yaw_deg", "row", "col"),
    # The landmark lies 20 m east and 10 m north of the centre. A view that heads north has it right and above; one
    # that heads east ahead (up) and to the left; south left and below; west behind (down) and to the right.
    [(0.0, 10, 40), (90.0, 0, 10), (180.0, 30, 0), (270.0, 40, 30)],
)
def test_a_landmark_lies_where_the_heading_says(yaw_deg, row, col):
    seen = observe(LayerBits.of(landmark(40, 70)), GRID, at(50.5, 50.5, yaw_deg), size_cells=41, cell_size_m=1.0)
    assert np.argwhere(seen[0] == PRESENT).tolist() == [[row, col]]


def test_a_larger_scale_sees_more_ground():
    pose = at(50.5, 50.5, scale=2.0)
    seen = observe(LayerBits.of(landmark(30, 50)), GRID, pose, size_cells=41, cell_size_m=1.0)
    assert [10, 20] in np.argwhere(seen[0] == PRESENT).tolist()
    assert footprint(pose, size_m=(41.0, 41.0)).area == pytest.approx(82.0**2)


@given(
    st.floats(30, 70),
    st.floats(30, 70),
    st.floats(0, 359.9),
    st.floats(0.9, 1.1),
    st.integers(0, 40),
    st.integers(0, 40),
)
def test_what_a_view_shows_lies_on_the_map_where_the_pose_puts_it(u, v, yaw_deg, scale, row, col):
    rng = np.random.default_rng(7)
    layers = rng.integers(0, 2, (2, 100, 100), dtype=np.uint8)
    pose = at(u, v, yaw_deg, scale)
    seen = observe(LayerBits.of(layers), GRID, pose, size_cells=41, cell_size_m=1.0)
    point = pose.to_map(cell_offsets_m((41, 41), 1.0)[[row * 41 + col]])
    from_edge = np.abs(GRID.to_uv(point) - np.rint(GRID.to_uv(point)))
    assume(from_edge.min() > 1e-6)  # on an edge the last digit decides which cell it is
    map_row, map_col = GRID.to_cells(point)[0]
    assert (seen[:, row, col] == layers[:, map_row, map_col]).all()


def test_beyond_the_map_and_beyond_what_is_mapped_all_is_unknown():
    layers = np.full((2, 100, 100), PRESENT, dtype=np.uint8)
    layers[:, :, 60:] = OUTSIDE
    seen = observe(LayerBits.of(layers), GRID, at(0.0, 50.0), size_cells=200, cell_size_m=1.0)
    assert (seen[:, :, :100] == UNKNOWN).all()
    assert (seen[:, 60:140, 100:160] == PRESENT).all()
    assert (seen[:, :, 160:] == UNKNOWN).all()


@pytest.mark.parametrize("size_cells", [96, 192, 384])
@pytest.mark.parametrize("cell_size_m", [0.5, 1.0, 2.0, 4.0])
def test_every_view_and_cell_size_shows_the_middle_of_the_map_in_its_middle(size_cells, cell_size_m):
    layers = np.zeros((1, 100, 100), dtype=np.uint8)
    layers[0, 30:70, 30:70] = PRESENT
    seen = observe(LayerBits.of(layers), GRID, at(50.3, 49.8, 33.0), size_cells=size_cells, cell_size_m=cell_size_m)
    assert seen.shape == (1, size_cells, size_cells)
    assert (seen == PRESENT).sum() * cell_size_m**2 == pytest.approx(1600.0, rel=0.1)
    rows, cols = np.nonzero(seen[0] == PRESENT)
    assert rows.mean() == pytest.approx(size_cells / 2 - 0.5, abs=1.0)
    assert cols.mean() == pytest.approx(size_cells / 2 - 0.5, abs=1.0)


def test_evidence_cannot_be_changed_and_says_what_is_wrong_with_it():
    seen = Evidence(classes=("a",), cells=np.zeros((1, 2, 2), dtype=np.uint8), cell_size_m=1.0)
    with pytest.raises(ValueError, match="read-only"):
        seen.cells[0, 0, 0] = PRESENT
    with pytest.raises(ShapeError, match="2 classes"):
        Evidence(classes=("a", "b"), cells=np.zeros((1, 2, 2), dtype=np.uint8), cell_size_m=1.0)
    with pytest.raises(ShapeError, match="0 absent"):
        Evidence(classes=("a",), cells=np.full((1, 2, 2), 3, dtype=np.uint8), cell_size_m=1.0)
    with pytest.raises(ShapeError, match="cell_size_m"):
        Evidence(classes=("a",), cells=np.zeros((1, 2, 2), dtype=np.uint8), cell_size_m=float("nan"))
    with pytest.raises(ShapeError, match="confidence"):
        seen.__class__(
            classes=("a",), cells=seen.cells, cell_size_m=1.0, confidence=np.zeros((1, 2, 3), dtype=np.uint8)
        )


def test_a_cell_unknown_in_one_class_is_unknown_in_all_whatever_the_others_say():
    layers = np.array([[[UNKNOWN, PRESENT, 0]], [[PRESENT, UNKNOWN, PRESENT]]], dtype=np.uint8)
    assert LayerBits.of(layers).bits.tolist() == [[1 << 31, 1 << 31, 2]]


@given(hnp.arrays(np.float64, (2, 3, 4), elements=st.floats(0, 1) | st.just(np.nan)))
def test_probabilities_come_back_to_half_a_step_and_their_states_and_log_odds_follow(chances):
    seen = Evidence.of_probabilities(("a", "b"), chances, cell_size_m=1.0)
    back, is_known = seen.probabilities(), np.isfinite(chances)
    assert (np.isfinite(back) == is_known).all()
    assert np.abs(back - chances)[is_known].max(initial=0) <= 0.5 / 510 + 1e-12
    assert ((seen.cells == UNKNOWN) == ~is_known).all()
    assert ((seen.cells == PRESENT) == (np.nan_to_num(chances) >= 0.5)).all()
    odds = seen.log_odds()
    inner = is_known & (back > 0) & (back < 1)
    assert np.allclose(odds[inner], np.log(back[inner] / (1 - back[inner])))
    assert (odds[~is_known] == 0).all()
    assert np.isfinite(odds).all()
    assert (np.isfinite(back) == (seen.levels() <= 510)).all()


def test_evidence_without_confidence_is_certain():
    cells = np.array([[[0, 1, 2]]], dtype=np.uint8)
    seen = Evidence(classes=("a",), cells=cells, cell_size_m=1.0)
    assert seen.levels().tolist() == [[[0, 510, 511]]]
    assert seen.probabilities()[0, 0, :2].tolist() == [0.0, 1.0]
    sure = seen.replace(cells, np.array([[[255, 255, 0]]], dtype=np.uint8))
    assert (sure.levels() == seen.levels()).all()
    assert seen.is_certain
    assert sure.is_certain
    assert not seen.replace(cells, np.array([[[255, 254, 0]]], dtype=np.uint8)).is_certain


def test_undecided_probabilities_are_unknown_and_others_beyond_0_to_1_are_refused():
    chances = np.array([[[0.2, 0.5, 0.8]]])
    seen = Evidence.of_probabilities(("a",), chances, cell_size_m=1.0, present_at=0.7, absent_at=0.3)
    assert seen.cells.tolist() == [[[0, UNKNOWN, PRESENT]]]
    with pytest.raises(ShapeError, match=r"got -0\.1"):
        Evidence.of_probabilities(("a",), np.array([[[0.5, -0.1]]]), cell_size_m=1.0)


@pytest.mark.parametrize("at", [0.3, 0.7])
def test_no_threshold_turns_a_probability_over(at):
    chances = np.array([[[0.1, 0.35, 0.45, 0.55, 0.65, 0.9]]])
    seen = Evidence.of_probabilities(("a",), chances, cell_size_m=1.0, present_at=at, absent_at=at)
    np.testing.assert_array_equal(seen.cells == PRESENT, chances >= at)
    found = seen.probabilities()
    assert ((found - 0.5) * (chances - 0.5) >= 0).all()
    assert (found[(found - 0.5) * (chances - 0.5) == 0] == 0.5).all()
    assert np.abs(found - chances)[found != 0.5] == pytest.approx(0, abs=1 / 510)


def test_unknown_cells_as_absent_are_certain_and_the_others_stay():
    seen = Evidence.of_probabilities(("a",), np.array([[[0.9, np.nan, 0.3]]]), cell_size_m=1.0)
    assert seen.without_unknown().levels().tolist() == [[[459, 0, 153]]]
    assert seen.replace(seen.cells).without_unknown().levels().tolist() == [[[510, 0, 0]]]
