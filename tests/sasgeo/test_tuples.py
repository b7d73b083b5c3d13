# SPDX-License-Identifier: Apache-2.0
"""Poses from pairs of junctions: found with any heading and scale, held to a prior, and none where none can be."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sasgeo.mapped import JUNCTIONS, SECTORS, JunctionPairs, MappedGraph
from sasgeo_bench.sasgeo.nodes import nothing
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.sasgeo.reading import proposals
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.vectors import VectorNoise, perceive_vectors

EXACT = VectorNoise(missed_share=0.0, gap_share=0.0, shift_m=0.0)


@pytest.fixture(scope="module")
def region(tmp_path_factory):
    """A town whose streets are not all alike: in one of blocks every pair of junctions is like many others."""
    plan = plan_build(read_region_file(find_region_file("town-old-town")), out=tmp_path_factory.mktemp("old-town"))
    build_region(plan)
    return read_region(plan.folder)


@pytest.fixture(scope="module")
def mapped(region):
    return MappedGraph.of(region)


@pytest.fixture(scope="module")
def views(region, mapped):
    """Noise-free views between two junctions, and where they were taken."""
    state, rng, made = State.of(region), np.random.default_rng(3), []
    pairs = mapped.junction_pairs[JUNCTIONS[0]][0]
    chosen = np.flatnonzero((pairs.length_m > 40) & (pairs.length_m < 170))
    for at in mapped.nodes.places_m[pairs.ends[chosen]].mean(axis=1)[::4][:6]:
        pose = Pose(
            easting_m=at[0], northing_m=at[1], yaw_deg=float(rng.uniform(0, 360)), scale=float(rng.uniform(0.9, 1.1))
        )
        view = state.view(pose, size_cells=256, cell_size_m=1.0)
        vectors = perceive_vectors(state, pose, side_m=256.0, noise=EXACT, rng=rng)
        made.append((ObservedGraph.make(view, vectors), pose))
    return made


def is_near(one, other):
    apart_m = np.hypot(one.easting_m - other.easting_m, one.northing_m - other.northing_m)
    return apart_m < 10 and abs(wrap_deg(one.yaw_deg - other.yaw_deg)) < 8 and abs(one.scale - other.scale) < 0.08


@pytest.mark.slow
def test_most_places_are_proposed_with_heading_and_scale_unknown(views, mapped):
    found = [
        any(is_near(one.pose, pose) for one in proposals(seen, mapped, count=10, scales=(0.85, 1.15)))
        for seen, pose in views
    ]
    assert len(found) == 6
    assert sum(found) >= 5


def test_proposals_come_in_order_apart_and_no_more_than_asked_for(views, mapped):
    seen, _ = views[0]
    found = proposals(seen, mapped, count=5, scales=(0.85, 1.15))
    assert 0 < len(found) <= 5
    votes = [votes for _, votes in found]
    assert votes == sorted(votes, reverse=True)
    assert not any(is_near(one.pose, two.pose) for at, one in enumerate(found) for two in found[:at])
    assert all(0.84 < pose.scale < 1.16 for pose, _ in found)
    assert proposals(seen, mapped, count=0) == []


def test_a_prior_holds_place_and_heading(views, mapped):
    seen, pose = views[0]
    disc = {"center_m": (pose.easting_m, pose.northing_m), "radius_m": 60.0}
    prior = Prior(**disc, yaw_deg=pose.yaw_deg, yaw_sigma_deg=5.0, scale_sigma=0.1)
    found = proposals(seen, mapped, count=10, scales=(0.85, 1.15), prior=prior)
    assert is_near(found[0].pose, pose)
    for one, _ in found:
        assert np.hypot(one.easting_m - pose.easting_m, one.northing_m - pose.northing_m) < 80
        assert abs(wrap_deg(one.yaw_deg - pose.yaw_deg)) < 16
    turned = replace(prior, yaw_deg=pose.yaw_deg + 180.0)
    assert not any(is_near(one.pose, pose) for one in proposals(seen, mapped, count=10, prior=turned))


def test_without_junctions_nothing_is_proposed_and_scales_that_are_no_range_are_refused(views, mapped):
    cells = np.full((1, 64, 64), UNKNOWN, dtype=np.uint8)
    blind = ObservedGraph.make(Evidence(classes=("road_minor",), cells=cells, cell_size_m=1.0))
    assert proposals(blind, mapped, count=5) == []
    for scales in ((0.0, 1.0), (1.1, 0.9), (1.0, np.inf)):
        with pytest.raises(ConfigError, match="scales are the least and the greatest scale"):
            proposals(views[0][0], mapped, count=1, scales=scales)


def test_pairs_read_from_the_other_end_lead_the_other_way(mapped):
    pairs = mapped.junction_pairs[JUNCTIONS[0]][0]
    there, back = pairs, pairs.turned().turned()
    np.testing.assert_array_equal(there.arms, back.arms)
    np.testing.assert_array_equal(there.ends, back.ends)
    assert int(there.arms.max()) < 1 << SECTORS
    assert (np.diff(there.length_m) >= 0).all()
    assert len(JunctionPairs.of(nothing(), JUNCTIONS[0], range_m=(1.0, 9.0)).ends) == 0
