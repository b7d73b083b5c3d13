# SPDX-License-Identifier: Apache-2.0
"""Bends, long sides, groups and neighbours: properties first, then cases drawn by hand."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from sasgeo_bench.regions.layers import (
    _components,
    delaunay_pairs,
    find_bends,
    groups_within,
    long_sides,
    touching_pairs,
)

RULES = {"step_m": 10.0, "smoothing_m": 60.0, "window_m": 120.0, "turn_deg": 45.0}
cells = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=12, unique=True)


def bends_of(*corners: tuple[float, float], **rules: float) -> list[list[float]]:
    en_m = np.array(corners, dtype=float)
    at_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(en_m, axis=0), axis=1)))
    return find_bends(en_m, at_m, np.array([0, len(en_m)]), **RULES | rules).en_m.round(6).tolist()


def polar(turn_deg: float, reach_m: float) -> tuple[float, float]:
    return reach_m * np.cos(np.radians(turn_deg)), reach_m * np.sin(np.radians(turn_deg))


@given(turn_deg=st.floats(-170, 170).filter(lambda turn: abs(abs(turn) - 45) > 0.5))
def test_a_corner_is_a_bend_if_it_turns_enough_to_either_side(turn_deg: float) -> None:
    found = bends_of((-200, 0), (0, 0), polar(turn_deg, 200))
    assert found == ([[0.0, 0.0]] if abs(turn_deg) > 45 else [])


def test_a_wide_curve_a_short_line_and_noise_are_no_bends() -> None:
    def arc(radius_m: float) -> list[tuple[float, float]]:
        return [polar(angle, radius_m) for angle in range(0, 181, 3)]

    assert bends_of(*arc(400)) == []
    assert len(bends_of((60, -200), *arc(60), (-60, -200))) >= 1
    assert bends_of((0, 0), (50, 0), (50, 50)) == []
    assert bends_of(*[(20.0 * i, 4.0 * (-1) ** i) for i in range(40)]) == []


@given(cells=cells)
def test_neighbours_have_no_place_inside_the_circle_over_them_and_every_gabriel_pair_is_kept(cells: list) -> None:
    en_m = np.array(cells, dtype=float).reshape(-1, 2)
    pairs = {tuple(pair) for pair in delaunay_pairs(en_m, 1e9).tolist()}
    for left in range(len(en_m)):
        for right in range(left + 1, len(en_m)):
            # The Gabriel graph, which is unique, is a part of every Delaunay triangulation.
            corner = ((en_m[left] - en_m) * (en_m[right] - en_m)).sum(axis=1)
            others = np.delete(corner, [left, right])
            if (others > 0).all():
                assert (left, right) in pairs


@settings(deadline=None)
@given(cells=cells, random=st.randoms(use_true_random=False))
def test_neighbours_do_not_depend_on_the_order_or_the_turn(cells: list, random) -> None:
    def named(places: list, turn: int) -> set:
        en_m = np.array(places, dtype=float).reshape(-1, 2) @ np.array([[turn, 1 - turn], [turn - 1, turn]])
        return {frozenset((places[a], places[b])) for a, b in delaunay_pairs(en_m, 4.0)}

    assert named(cells, 1) == named(random.sample(cells, len(cells)), 0)


@pytest.mark.parametrize("doubles", [0, 2])
def test_neighbours_are_the_edges_of_the_triangles_of_qhull(doubles: int) -> None:
    for seed in range(20):
        en_m = np.random.default_rng(seed).normal(size=(80, 2)) * 100
        en_m[:doubles] = en_m[40]  # houses drawn twice
        corners = Delaunay(en_m - en_m.mean(axis=0)).simplices
        edges = np.unique(np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0)
        assert delaunay_pairs(en_m, 1e9).tolist() == edges.tolist()


@given(links=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), max_size=40))
def test_groups_are_numbered_by_their_first_shapes(links: list) -> None:
    left, right = np.array(links, dtype=np.int64).reshape(-1, 2).T
    table = coo_array((np.ones(len(left)), (left, right)), shape=(31, 31))
    assert _components(31, left, right).tolist() == connected_components(table, directed=False)[1].tolist()


@pytest.mark.parametrize(("longest_m", "pairs"), [(5.0, [[0, 2]]), (7.0, [[0, 2], [1, 2]]), (1.0, [])])
def test_places_on_a_line_are_next_to_the_next(longest_m: float, pairs: list) -> None:
    assert delaunay_pairs(np.array([[0.0, 0.0], [9.0, 0.0], [3.0, 0.0]]), longest_m).tolist() == pairs


@given(cells=cells, gap_m=st.sampled_from([0.4, 1.1, 1.5]))
def test_groups_are_joined_by_gaps_no_wider_than_asked(cells: list, gap_m: float) -> None:
    shapes = np.array([shapely.box(2 * x, 2 * y, 2 * x + 1, 2 * y + 1) for x, y in cells], dtype=object)
    group = groups_within(shapes, gap_m)
    blobs = shapely.get_parts(shapely.union_all(shapely.buffer(shapes, gap_m / 2 + 1e-3)))
    assert len(set(group.tolist())) == len(blobs)
    assert all(len(set(group[shapely.intersects(shapes, blob)].tolist())) == 1 for blob in blobs)


def test_shapes_that_overlap_or_share_a_corner_touch_and_one_without_a_rectangle_has_no_long_side() -> None:
    shapes = np.array(
        [shapely.box(0, 0, 5, 5), shapely.box(4, 4, 6, 6), shapely.box(6, 6, 9, 9), shapely.box(7, 0, 9, 5)]
    )
    assert touching_pairs(shapes).tolist() == [[0, 1], [1, 2]]
    assert touching_pairs(shapes[:0]).tolist() == []
    shapes = np.array([shapely.box(0, 0, 9, 3), shapely.Polygon()])
    np.testing.assert_allclose(np.abs(long_sides(shapes)), [[9, 0], [np.nan, np.nan]], atol=1e-9)


def test_neighbours_in_a_row_beside_others_make_flat_triangles_and_no_noise():
    row = [(-25.0, -36.0), (-28.5, -31.5), (-31.3, -27.9), (-32.0, -27.0)]
    pairs = delaunay_pairs(np.array([*row, (18.0, -41.0), (54.0, 0.0), (-55.0, 46.0)]), 200.0).tolist()
    assert all(pair in pairs for pair in ([0, 1], [1, 2], [2, 3]))
