# SPDX-License-Identifier: Apache-2.0
"""Matchers of objects: cases worked by hand, the property that each must have, and what they find."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.object_matcher import Pairs, PreparedView, fitted
from sasgeo_baselines.spatial_graph_clique import SpatialGraphClique, largest_clique
from scipy.spatial.distance import pdist

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.search.plan import Disc
from tests.baselines.worlds import PRIOR, MadeUpMap, nodes
from tests.made_up import HERE

DISC = Disc(center_m=PRIOR.center_m, radius_m=100.0)


def scattered(count, *, half_m=90.0, seed=1):
    return np.random.default_rng(seed).uniform(-half_m, half_m, (count, 2))


def test_peaks_lie_apart_so_that_no_place_takes_the_turn_of_another():
    seen = nodes(scattered(12))
    town = nodes(np.concatenate([HERE.to_map(seen.places_m), np.array(PRIOR.center_m) + scattered(40, half_m=200.0)]))
    pairs = Pairs.of_kind(PreparedView(nodes=seen, prior=PRIOR), town, np.arange(len(town)))
    peaks = pairs.peaks(DISC, [67.0, 72.0, 77.0, 82.0, 87.0], count=12)
    places_m = np.array([(mode.pose.easting_m, mode.pose.northing_m) for mode in peaks])
    assert len(peaks) > 6
    assert pdist(places_m).min() >= 25.0


def test_only_objects_of_one_kind_pair_and_a_rare_kind_weighs_more():
    seen = nodes([[0, 0], [10, 0]], ["building patch", "mask intersection"])
    town = nodes([[0, 0], [5, 5], [9, 9], [10, 0]], ["building patch"] * 3 + ["mask intersection"])
    pairs = Pairs.of_kind(PreparedView(nodes=seen, prior=PRIOR), town, np.arange(4))
    assert list(zip(pairs.seen.tolist(), pairs.mapped.tolist(), strict=True)) == [(0, 0), (0, 1), (0, 2), (1, 3)]
    assert pairs.weight[3] == pytest.approx(np.log(1 + 4))
    assert pairs.weight[0] == pytest.approx(np.log(1 + 4 / 3))


@given(st.floats(0, 360), st.integers(2, 9))
def test_a_fit_is_exact_and_does_not_depend_on_order(yaw_deg, count):
    seen_m = scattered(count)
    here = Pose(easting_m=7.0, northing_m=-3.0, yaw_deg=yaw_deg)
    pose, error_m = fitted(seen_m, here.to_map(seen_m))
    turned, _ = fitted(seen_m[::-1], here.to_map(seen_m)[::-1])
    assert error_m < 1e-6
    assert np.allclose(pose.to_map(seen_m), here.to_map(seen_m), atol=1e-6)
    assert np.allclose(turned.to_map(seen_m), here.to_map(seen_m), atol=1e-6)


@given(st.integers(0, 12), st.integers(0, 50))
def test_a_clique_never_shrinks_when_pairs_are_added(count, seed):
    rng = np.random.default_rng(seed)
    seen_m = rng.uniform(0, 60, (count, 2))
    mapped_m = seen_m + rng.uniform(-5.0, 5.0, (count, 2))
    owner = rng.integers(0, max(1, count), (count, 2))
    sizes = [
        len(largest_clique(seen_m[:part], mapped_m[:part], owner[:part], agree_m=5.0)) for part in range(count + 1)
    ]
    assert sizes == sorted(sizes)


def test_an_object_belongs_to_one_pair_of_a_clique():
    seen_m = np.array([[0.0, 0.0], [0.0, 0.0], [40.0, 0.0]])
    mapped_m = seen_m + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    found = largest_clique(seen_m, mapped_m, np.array([[0, 0], [0, 1], [1, 2]]), agree_m=5.0)
    assert len(found) == 2
    assert 2 in found


def test_the_largest_clique_is_the_pose():
    """Nine of twelve objects are mapped where they were seen; the rest of the map is another town."""
    matcher = SpatialGraphClique()
    seen = nodes(scattered(12))
    lost = HERE.to_map(seen.places_m) + np.array([[0.0, 0.0]] * 9 + [[30.0, 0.0], [0.0, 30.0], [-30.0, 0.0]])
    matcher.mapped = MadeUpMap(nodes=nodes([*lost, *(np.array(PRIOR.center_m) + scattered(30, half_m=200.0))]))
    first, *rest = matcher.modes(PreparedView(nodes=seen, prior=PRIOR), DISC, count=3)
    assert int(first.score) == 9
    assert np.hypot(first.pose.easting_m - HERE.easting_m, first.pose.northing_m - HERE.northing_m) < 1e-6
    assert first.pose.yaw_deg == pytest.approx(HERE.yaw_deg)
    assert all(mode.score < first.score for mode in rest)
