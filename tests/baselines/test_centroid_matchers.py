# SPDX-License-Identifier: Apache-2.0
"""Matchers of the centres of objects: cases worked by hand, the property that each must have, and what they find."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.stfm_centroids import Patterns, StfmCentroids, clear_m
from sasgeo_baselines.triangle_rsim import TriangleRsim, Triangles, differences, shapes_of

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import WITHHELD, check_match
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.sasgeo.nodes import INDEX
from sasgeo_bench.tasks.vectors import as_features, vector_table
from tests.made_up import HERE, error_m

PRIOR = Prior(center_m=(1240.0, 8760.0), radius_m=100.0, yaw_deg=80.0, yaw_sigma_deg=5.0, scale_sigma=0.03)
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
SIDE, VIEW = 420, 176
MATCHERS = (TriangleRsim, StfmCentroids)


def houses_of(seed, *, count=110):
    """Rows, columns and sides of houses of many sizes, none of which touch."""
    rng = np.random.default_rng(seed)
    kept = []
    for _ in range(count * 4):
        row, col = rng.integers(4, SIDE - 40, 2).tolist()
        house = (row, col, *rng.integers(7, 26, 2).tolist())
        if all(_apart(house, other) for other in kept) and len(kept) < count:
            kept.append(house)
    return kept


def _apart(house, other, gap=4):
    row, col, height, width = house
    other_row, other_col, other_height, other_width = other
    return (
        row + height + gap <= other_row
        or other_row + other_height + gap <= row
        or col + width + gap <= other_col
        or other_col + other_width + gap <= col
    )


@pytest.fixture(scope="module")
def region(made):
    """A map of houses alone."""
    layers = np.zeros((3, SIDE, SIDE), dtype=np.uint8)
    shapes = []
    for row, col, height, width in houses_of(1):
        layers[0, row : row + height, col : col + width] = 1
        shapes.append(shapely.box(1000 + col, 9000 - row - height, 1000 + col + width, 9000 - row))
    found = made.region_of(layers)
    found.features = as_features(vector_table([("building", 0, False, shape) for shape in shapes]))
    found.graph = build_graph(found.features)
    return found


@pytest.fixture(scope="module", params=MATCHERS, ids=lambda kind: kind.card.name)
def matcher(request, region):
    found = request.param()
    found.prepare(region, None)
    return found


@pytest.fixture
def query(made, region):
    return made.query_of(made.view_of(region, HERE, size_cells=VIEW), PRIOR)


def hidden(query, cols):
    """The same view with some columns unknown."""
    cells = query.evidence.cells.copy()
    cells[:, :, cols] = UNKNOWN
    return replace(query, evidence=query.evidence.replace(cells))


def test_a_view_is_found(query, matcher):
    answer = check_match(matcher.match(query, top_k=5), query, top_k=5)
    assert error_m(answer) < 3
    assert abs(answer.poses[0].yaw_deg - HERE.yaw_deg) < 3
    assert answer == check_match(matcher.match(query, top_k=5), query, top_k=5)


def test_a_view_is_found_with_no_prior_and_a_part_unknown(query, matcher):
    asked = replace(hidden(query, slice(36)), prior=ANYWHERE)
    assert error_m(matcher.match(asked, top_k=1)) < 5


def test_candidates_are_ranked_and_copies_tie(query, matcher):
    places = tuple(replace(HERE, easting_m=HERE.easting_m + off_m) for off_m in (70.0, 5.0, -60.0, 5.0))
    asked = replace(query, candidates=places, track="retrieval", prior=replace(PRIOR, center_m=None, radius_m=None))
    answer = check_match(matcher.match(asked, top_k=4), asked, top_k=4)
    assert [pose.easting_m for pose in answer.poses[:2]] == [HERE.easting_m + 5.0] * 2
    assert answer.scores[0] == answer.scores[1]
    assert len(answer.scores) == 2 or answer.scores[1] > answer.scores[2]


def test_a_view_of_few_whole_houses_is_withheld(query, matcher):
    assert matcher.match(hidden(query, slice(VIEW)), top_k=1) == WITHHELD
    assert matcher.match(hidden(query, slice(30, VIEW)), top_k=1) == WITHHELD


def test_a_place_without_houses_is_withheld(made, query, matcher):
    bare = made.region_of(np.zeros((3, SIDE, SIDE), dtype=np.uint8))
    bare.features = as_features(vector_table([]))
    bare.graph = build_graph(bare.features)
    lost = type(matcher)()
    lost.prepare(bare, None)
    assert lost.match(query, top_k=1) == WITHHELD


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


def test_an_object_whose_neighbours_may_be_out_of_sight_says_nothing(query, region):
    """Half of the view is hidden: no object that speaks has its farthest neighbour beyond the edge of what is known."""
    matcher = StfmCentroids()
    matcher.prepare(region, None)
    whole, half = matcher.look(query), matcher.look(hidden(query, slice(60)))
    assert len(half.patterns.kind) < len(whole.patterns.kind)
    right_m = half.patterns.corners_m[:, 0, 0] - half.patterns.reach_m
    assert right_m.min() > 60 - VIEW / 2
    clear = clear_m(hidden(query, slice(60)).evidence, np.array([[0.0, 0.0]]))
    assert clear.tolist() == pytest.approx([28.0], abs=1.0)


def test_a_class_that_a_view_does_not_read_and_one_of_no_object_hide_nothing():
    cells = np.zeros((3, 100, 100), dtype=np.uint8)
    cells[1] = UNKNOWN  # buildings, which the detector does not read
    cells[2, :, :50] = UNKNOWN  # no object is made of bridges
    view = Evidence(classes=("road_minor", "building", "bridge"), cells=cells, cell_size_m=1.0)
    assert clear_m(view, np.array([[0.5, 0.5]])).tolist() == [50.0]
    hiding = cells.copy()
    hiding[0, :, :50] = UNKNOWN
    assert clear_m(view.replace(hiding), np.array([[20.5, 0.5]])).tolist() == pytest.approx([21.0], abs=1.0)
