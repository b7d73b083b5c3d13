# SPDX-License-Identifier: Apache-2.0
"""Matchers by consensus of patches and of objects: cases by hand, the property that each must have, what they find."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines import liu_object_graph
from sasgeo_baselines.liu_object_graph import (
    complete_iou,
    edge_weights,
    local_features,
    node_features,
    posed,
    sinkhorn,
)
from sasgeo_baselines.spatial_graph_clique import SpatialGraphClique
from sasgeo_baselines.zhang_hier_consensus import (
    Patches,
    ZhangHierConsensus,
    consensus,
    correlation,
    matches,
    mutual,
    similarity,
    soft_mutual,
)

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.search.plan import Disc
from tests.baselines import worlds
from tests.baselines.worlds import ANYWHERE, PRIOR, LiuOnMadeUp, nodes
from tests.made_up import HERE, error_m

# Patches


def scores_of(seed, shape=(3, 4, 5, 6)):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


@given(st.integers(0, 50))
def test_consensus_treats_both_sides_alike(seed):
    scores = scores_of(seed)
    turned = consensus(scores.transpose(2, 3, 0, 1)).transpose(2, 3, 0, 1)
    np.testing.assert_allclose(consensus(scores), turned, rtol=1e-5)
    turned = soft_mutual(scores.transpose(2, 3, 0, 1)).transpose(2, 3, 0, 1)
    np.testing.assert_allclose(soft_mutual(scores), turned, rtol=1e-5)


def test_neighbours_decide_between_two_patches_alike():
    """A patch has two twins on the map; its neighbour has one partner, beside the second twin."""
    scores = np.zeros((1, 2, 1, 6), dtype=np.float32)
    scores[0, 0, 0, [0, 3]] = 1.0
    scores[0, 1, 0, 4] = 1.0
    assert mutual(scores)[1].tolist() == [0, 4]
    assert mutual(consensus(scores))[1].tolist() == [3, 4]


def test_a_pair_is_mutual_and_patches_without_a_score_have_none():
    scores = np.array([[0.9, 0.0], [0.8, 0.0], [0.0, 0.0]], dtype=np.float32).reshape(3, 1, 2, 1)
    mine, theirs = mutual(scores)
    assert (mine.tolist(), theirs.tolist()) == ([0], [0])


def test_a_view_matches_itself_and_what_is_unknown_matches_nothing(made):
    cells = made.textured(3, side=96)
    whole = Patches.of(cells, 1.0)
    seen_m, mapped_m = matches(whole, whole, rounds=2)
    assert (seen_m == mapped_m).all(axis=1).mean() > 0.95
    hidden = cells.copy()
    hidden[:, :48] = UNKNOWN
    scores = correlation(Patches.of(hidden, 1.0), whole)
    assert (scores[:6] == 0).all()
    assert scores[6:].max() > 0.9


def test_a_patch_is_described_by_the_cells_that_are_known():
    cells = np.zeros((1, 8, 8), dtype=np.uint8)
    cells[0, :2], cells[0, 4:] = PRESENT, UNKNOWN
    found = Patches.of(cells, 1.0)
    assert found.values[0, 0, 0] == pytest.approx(0.5)
    assert found.known.min() == 1
    cells[0, 3:] = UNKNOWN
    assert Patches.of(cells, 1.0).known.max() == 0


def test_a_similarity_needs_four_matches_that_agree():
    crop = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    seen_m = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0]])
    assert similarity(seen_m, seen_m, crop, near_m=8.0) == (None, 0)
    assert similarity(np.zeros((6, 2)), np.zeros((6, 2)), crop, near_m=8.0)[0] is None


# Zhang


# Liu


def test_weights_of_edges_by_hand():
    """Squares of 10 m, 30 m apart, lie in a box of 40 m x 10 m: 0.6 (0 - 900 / 1700) + 0.2 + 0.3."""
    houses = nodes([[0, 0], [0, 30]])
    edges = edge_weights(houses, local_features(houses))
    assert edges[0, 1] == edges[1, 0] == pytest.approx(0.6 * -900 / 1700 + 0.5)
    assert edges.diagonal().tolist() == [0.0, 0.0]
    touching = complete_iou(np.array([[5.0]]), np.array([5.0]))  # half of each lies in the other
    assert touching[0, 0] == pytest.approx(50 / 150 - 25 / (15**2 + 10**2))


@given(st.floats(0, 360), st.integers(0, 20))
def test_features_do_not_depend_on_heading_or_order(yaw_deg, seed):
    rng = np.random.default_rng(seed)
    names = ["building patch"] * 5 + ["green patch"] * 3
    town = nodes(rng.uniform(-90, 90, (8, 2)), names, areas_m2=rng.uniform(30, 900, 8))
    turned = replace(town, places_m=replace(HERE, yaw_deg=yaw_deg).to_map(town.places_m))
    np.testing.assert_allclose(node_features(town), node_features(turned), atol=1e-9)
    order = rng.permutation(8)
    mixed = nodes(town.places_m[order], areas_m2=town.area_m2[order], kind=town.kind[order])
    np.testing.assert_allclose(node_features(town)[order], node_features(mixed), atol=1e-9)


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 20))
def test_no_object_is_matched_more_than_once(rows, cols, seed):
    partners = sinkhorn(np.random.default_rng(seed).random((rows, cols)), slack=0.5)
    assert partners.min() >= 0
    assert partners.sum(axis=1).max() < 1.1  # rows converge last
    assert partners.sum(axis=0).max() <= 1 + 1e-9


def test_wrong_matches_do_not_move_the_pose():
    rng = np.random.default_rng(0)
    seen_m = rng.uniform(-90, 90, (12, 2))
    mapped_m = HERE.to_map(seen_m)
    mapped_m[8:] += rng.uniform(40, 80, (4, 2))
    pose, inliers = posed(seen_m, mapped_m, np.ones(12))
    assert inliers == 8
    assert pose.easting_m == pytest.approx(HERE.easting_m)
    assert pose.yaw_deg == pytest.approx(HERE.yaw_deg)
    assert posed(seen_m[:2], mapped_m[:2], np.ones(2)) == (None, 0)


@pytest.fixture(scope="module")
def village():
    return worlds.village()


@pytest.fixture(scope="module")
def liu(village):
    found = LiuOnMadeUp()
    found.prepare(village.region, None)
    return found


def test_of_too_many_tiles_those_with_the_mix_of_kinds_are_looked_at(made, liu, village, monkeypatch):
    query = made.query_of(village.drawn, ANYWHERE)
    whole = liu.match(query, top_k=1)
    assert error_m(whole) < 2
    monkeypatch.setattr(liu_object_graph, "MOST_TILES", 40)
    view = liu.look(query)
    assert len({tile.pose.easting_m for tile in liu.tiles(view, Disc(center_m=None, radius_m=0.0))}) <= 40
    assert error_m(liu.match(query, top_k=1)) < 2


# Clique


class CliqueOnMadeUp(SpatialGraphClique):
    """The matcher on a map of nodes alone."""

    def read(self, region, learned):
        del learned
        self.mapped = region


def test_how_many_objects_agree_is_told_as_inliers(made, village, liu):
    matcher = CliqueOnMadeUp()
    matcher.prepare(village.region, None)
    assert liu.match(made.query_of(village.drawn, PRIOR), top_k=5).diagnostics["inliers"] >= 12
    answer = matcher.match(made.query_of(village.drawn, PRIOR), top_k=3)
    assert answer.diagnostics["inliers"] == int(answer.scores[0]) >= 12
    candidates = made.query_of(village.drawn, PRIOR, candidates=(HERE,))
    assert matcher.match(candidates, top_k=1).diagnostics["inliers"] >= 12


def test_a_view_of_another_place_has_few_inliers(made):
    zhang = ZhangHierConsensus()
    zhang.prepare(worlds.things().region, None)
    other = made.view_of(made.region_of(made.textured(77)), HERE, size_cells=160)
    wrong, right = (
        zhang.match(made.query_of(view, PRIOR), top_k=3).diagnostics for view in (other, worlds.things().seen(160))
    )
    assert wrong["inlier_ratio"] < right["inlier_ratio"] / 2
    assert wrong["inliers"] < right["inliers"] / 2
    assert right["inlier_ratio"] > 0.5
