# SPDX-License-Identifier: Apache-2.0
"""Matchers of the centres of objects: cases worked by hand, the property that each must have, and what they find."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.stfm_centroids import Patterns, StfmCentroids, clear_m
from sasgeo_baselines.triangle_rsim import Triangles, differences, shapes_of

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.sasgeo.nodes import INDEX
from tests.baselines.worlds import hidden, houses

VIEW = 176


def test_a_triangle_by_hand():
    """Sides of 30, 40 and 50 m: the corner at the right angle lies opposite to the longest one."""
    places_m, area_m2 = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]]), np.array([100.0, 200.0, 100.0])
    found = Triangles.of(places_m, area_m2)
    assert found.corners.tolist() == [[1, 2, 0]]
    ratios, log_areas = found.shape[0, :2], found.shape[0, 3:5]
    assert ratios.tolist() == pytest.approx([0.6, 0.8])
    assert log_areas.tolist() == pytest.approx([np.log(2.0), 0.0])


@given(st.floats(0, 359), st.integers(0, 20), st.permutations(range(7)))
def test_triangles_do_not_depend_on_heading_or_order(yaw_deg, seed, order):
    rng = np.random.default_rng(seed)
    places_m, area_m2 = rng.uniform(-60, 60, (7, 2)), rng.uniform(50, 500, 7)
    here = Pose(easting_m=1000.0, northing_m=50.0, yaw_deg=yaw_deg)
    first, second = Triangles.of(places_m, area_m2), Triangles.of(here.to_map(places_m)[order], area_m2[order])
    names = [np.array(order)[corners].tolist() for corners in second.corners]
    assert sorted(names) == sorted(first.corners.tolist())
    by_name = dict(zip(map(tuple, names), second.shape, strict=True))
    for corners, shape in zip(first.corners.tolist(), first.shape, strict=True):
        np.testing.assert_allclose(by_name[tuple(corners)], shape, atol=1e-6)


def test_a_mirror_image_and_another_size_are_not_alike():
    places_m, area_m2 = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]]), np.full(3, 100.0)
    corners = np.array([[1, 2, 0]])
    own, may_differ = shapes_of(places_m, area_m2, corners), differences(ratio=0.15, log_area=1.0)
    for other_m in (places_m * (-1, 1), places_m * 1.25):
        assert np.linalg.norm((own - shapes_of(other_m, area_m2, corners)) / may_differ) > 1
    assert np.linalg.norm((own - shapes_of(places_m * 1.05, area_m2, corners)) / may_differ) < 1


def test_houses_on_one_line_make_triangles_of_neighbours_and_two_make_none():
    line_m = np.column_stack([np.zeros(4), [0.0, 10.0, 25.0, 45.0]])
    assert len(Triangles.of(line_m, np.full(4, 100.0)).corners) == 4
    assert len(Triangles.of(line_m[:2], np.full(2, 100.0)).corners) == 0


def test_a_pattern_by_hand():
    """Four houses around one and a junction beyond: houses come first, the nearest before; all turns are quarters."""
    places_m = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 0.0], [0.0, -30.0], [-40.0, 0.0], [0.0, 50.0]])
    house, junction = INDEX["building patch"], INDEX["mask intersection"]
    found = Patterns.of(places_m, np.array([house] * 5 + [junction]), neighbours=5)
    assert junction < house  # so that it comes first in the order of labels
    assert found.corners_m[0, 1:].tolist() == [places_m[at].tolist() for at in (5, 1, 2, 3, 4)]
    assert found.reach_m[0] == 50.0
    ratio, cosine, sine = np.split(found.vector[0, : 3 * 5], 3)
    assert ratio.tolist() == pytest.approx([1.0, 0.2, 0.4, 0.6, 0.8])
    assert (2 * cosine).tolist() == pytest.approx([0.0, 1.0, 0.0, 0.0, 0.0], abs=1e-9)
    assert (2 * sine).tolist() == pytest.approx([1.0, 0.0, 1.0, 1.0, 1.0], abs=1e-9)


def test_patterns_with_another_label_are_1_apart():
    places_m = np.random.default_rng(0).uniform(-50, 50, (6, 2))
    kinds = np.full((2, 6), INDEX["building patch"])
    kinds[1, np.argmax(np.hypot(*(places_m - places_m[0]).T))] = INDEX["water patch"]  # the last in either order
    one, other = (Patterns.of(places_m, kind, neighbours=5).vector[0] for kind in kinds)
    assert np.linalg.norm(one - other) == pytest.approx(1.0)


@given(st.floats(0, 359), st.floats(0.5, 2.0), st.integers(0, 20))
def test_patterns_do_not_depend_on_heading_and_scale(yaw_deg, scale, seed):
    rng = np.random.default_rng(seed)
    places_m, kind = rng.uniform(-60, 60, (9, 2)), rng.integers(0, 3, 9)
    here = Pose(easting_m=1000.0, northing_m=50.0, yaw_deg=yaw_deg, scale=scale)
    one, other = (Patterns.of(at_m, kind, neighbours=5) for at_m in (places_m, here.to_map(places_m)))
    np.testing.assert_allclose(other.vector, one.vector, atol=1e-6)
    np.testing.assert_allclose(other.reach_m, scale * one.reach_m)


def test_a_class_that_a_view_does_not_read_and_one_of_no_object_hide_nothing():
    cells = np.zeros((3, 100, 100), dtype=np.uint8)
    cells[1] = UNKNOWN  # buildings, which the detector does not read
    cells[2, :, :50] = UNKNOWN  # no object is made of bridges
    view = Evidence(classes=("road_minor", "building", "bridge"), cells=cells, cell_size_m=1.0)
    assert clear_m(view, np.array([[0.5, 0.5]])).tolist() == [50.0]
    hiding = cells.copy()
    hiding[0, :, :50] = UNKNOWN
    assert clear_m(view.replace(hiding), np.array([[20.5, 0.5]])).tolist() == pytest.approx([21.0], abs=1.0)


def test_an_object_whose_neighbours_may_be_out_of_sight_says_nothing():
    """Half of the view is hidden: no object that speaks has its farthest neighbour beyond the edge of what is known."""
    matcher, query = StfmCentroids(), houses().query(VIEW)
    matcher.prepare(houses().region, None)
    whole, half = matcher.look(query), matcher.look(hidden(query, slice(60)))
    assert len(half.patterns.kind) < len(whole.patterns.kind)
    right_m = half.patterns.corners_m[:, 0, 0] - half.patterns.reach_m
    assert right_m.min() > 60 - VIEW / 2
    clear = clear_m(hidden(query, slice(60)).evidence, np.array([[0.0, 0.0]]))
    assert clear.tolist() == pytest.approx([28.0], abs=1.0)
