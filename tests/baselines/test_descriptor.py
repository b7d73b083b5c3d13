# SPDX-License-Identifier: Apache-2.0
"""The graph descriptor: what it tells apart, what it must not, and the map under a pose that it is made of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sasgeo_baselines.global_descriptor import BINS, LEAST_M2, MOST_THINGS, Descriptor, components
from sasgeo_baselines.raster import REACH_M, THIN

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, LayerBits, observe
from sasgeo_bench.search.view import Chart

PLACES = arrays(np.float64, st.tuples(st.integers(0, 9), st.just(2)), elements=st.floats(-40, 40))
REACH = 120.0


def described(layer: np.ndarray) -> Descriptor:
    """One class."""
    return Descriptor.of([components(layer, cell_size_m=1.0)], reach_m=float(np.hypot(*layer.shape)))


def one_hall() -> np.ndarray:
    layer = np.zeros((64, 64), dtype=np.uint8)
    layer[20:40, 20:40] = 1
    return layer


def four_houses() -> np.ndarray:
    layer = np.zeros((64, 64), dtype=np.uint8)
    for row, col in ((8, 8), (8, 40), (40, 8), (44, 44)):
        layer[row : row + 10, col : col + 10] = 1
    return layer


def test_one_hall_is_told_from_four_houses_of_the_same_area() -> None:
    assert one_hall().sum() == four_houses().sum()
    # Counts 1 and 4: 3 / 6; no pair against six: half of a whole histogram; the mean of both.
    assert described(one_hall()).distance(described(four_houses())) == pytest.approx((3 / 6 + 1 / 2) / 2)


def test_a_row_of_houses_is_told_from_a_ring_of_as_many() -> None:
    row, ring = np.zeros((64, 64), dtype=np.uint8), four_houses()
    for start in (2, 18, 34, 50):
        row[30:40, start : start + 10] = 1
    one, other = described(row), described(ring)
    assert one.counts.tolist() == other.counts.tolist() == [4.0]
    assert one.distance(other) > 0.1


@given(places=PLACES, yaw_deg=st.floats(0, 360), east_m=st.floats(-500, 500))
def test_the_histogram_is_that_of_things_turned_and_moved(places, yaw_deg, east_m) -> None:
    moved = Pose(easting_m=east_m, northing_m=7.0, yaw_deg=yaw_deg).to_map(places)
    one, other = (Descriptor.of([things], reach_m=REACH) for things in (places, moved))
    np.testing.assert_allclose(other.spread, one.spread, atol=1e-9)


@given(one=PLACES, other=PLACES)
def test_unlikeness_is_the_same_both_ways_and_nothing_to_itself(one, other) -> None:
    first, second = (Descriptor.of([things, things[:2]], reach_m=REACH) for things in (one, other))
    assert first.distance(first) == 0.0
    assert 0.0 <= first.distance(second) == second.distance(first) <= 1.0


@given(places=PLACES, shift=st.floats(0, 1))
def test_a_small_move_is_a_small_difference(places, shift) -> None:
    moved = places.copy()
    moved[:1] += shift
    one, other = (Descriptor.of([things], reach_m=REACH) for things in (places, moved))
    assert one.distance(other) <= np.hypot(shift, shift) * (BINS - 1) / REACH + 1e-9


def test_specks_are_no_things_and_a_view_of_noise_has_an_end() -> None:
    layer = np.zeros((32, 32), dtype=np.uint8)
    layer[:3, :3] = layer[10:12, 10:14] = 1  # 9 and 8 cells
    assert LEAST_M2 == 9.0
    assert components(layer, cell_size_m=1.0).tolist() == [[1.5, 1.5]]
    assert len(components(layer, cell_size_m=2.0)) == 2
    dots = np.zeros((400, 400), dtype=np.uint8)
    dots[::4, ::4] = 1
    assert len(components(dots, cell_size_m=4.0)) == MOST_THINGS


@given(
    east_m=st.floats(-260, 260),
    north_m=st.floats(-260, 260),
    yaw_deg=st.floats(0, 359),
    scale=st.floats(0.8, 1.2),
    size=st.sampled_from((1, 16, 33)),
    cell_size_m=st.sampled_from((0.5, 1.0, 3.0)),
)
def test_what_a_chart_shows_under_a_pose_is_what_is_seen_from_there(
    made, east_m, north_m, yaw_deg, scale, size, cell_size_m
) -> None:
    layers = made.textured(1)
    layers[:, 200:230, 100:160] = 255
    region = made.region_of(layers)
    chart = Chart.of(region, thin=THIN, reach_m=REACH_M)
    pose = Pose(easting_m=1210.0 + east_m, northing_m=8790.0 + north_m, yaw_deg=yaw_deg, scale=scale)
    expected = observe(LayerBits.of(layers), region.grid, pose, size_cells=size, cell_size_m=cell_size_m)
    shown = chart.under(pose, (size, size), np.arange(3), cell_size_m=cell_size_m)
    # A centre that lies on the edge of two map cells to the last bit may fall to either side.
    assert (shown != expected).any(axis=0).sum() <= 2 * size
    assert set(np.unique(shown)) <= {0, 1, UNKNOWN}
