# SPDX-License-Identifier: Apache-2.0
"""What is added to a draft tells nothing of the answer: priors, candidates and ids are the same for all variants."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sasgeo_bench.draw import CANDIDATES, Drawer, make_prior
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.pose import Pose
from sasgeo_bench.query import PriorGroup
from sasgeo_bench.split import SplitFile, blocks_of, make_split
from sasgeo_bench.suites.mining import STRIDE_M

SITES = 3
GROUP = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03)


@pytest.fixture(scope="module")
def drawn(carried):
    """A suite on its town, the drawer, and queries and truths at its first sites."""

    @cache
    def of_suite(name):
        made = carried(name)
        grid = made.scene.map.grid
        spec = SplitFile.model_validate(
            {
                "id": "mine",
                "title": "Mine",
                "kind": "crossfit",
                "buffer_m": 0.0,
                "place": [{"name": name, "regions": [name]} for name in ("here", "there")],
            }
        )
        far = replace(grid, west_m=grid.west_m + 50_000)
        split = make_split(spec, {"here": grid, "there": far})
        scene = replace(made.scene, blocks=blocks_of(made.plain.blocks[0].region, grid))
        drawer = Drawer(suite=made.suite, scene=scene, seeds=made.seeds, group=made.suite.card.group, split=split)
        jobs = [job for job in drawer.jobs(made.sites[:SITES]) if drawer.can_draw(job)]
        return made, drawer, [drawer.draw(job) for job in jobs]

    return of_suite


def by_site(drafts):
    pairs = {}
    for query, truth in drafts:
        pairs.setdefault(truth.pair_id, []).append((query, truth))
    return pairs.values()


@pytest.mark.parametrize("name", ["occlusion", "alias", "instance-twins", "growth"])
def test_control_stress_and_falsifier_of_a_site_share_pose_and_prior(drawn, name):
    _, _, drafts = drawn(name)
    for pair in by_site(drafts):
        assert len({truth.role for _, truth in pair}) > 1
        assert len({truth.pose for _, truth in pair}) == 1
        assert len({query.prior for query, _ in pair}) == 1
        assert len({query.prior_group for query, _ in pair}) == 1


def test_only_without_priors_the_prior_differs_and_the_falsifier_has_that_of_the_control(drawn):
    _, _, drafts = drawn("no-priors")
    for pair in by_site(drafts):
        priors = {(truth.role, query.evidence.shape): query.prior for query, truth in pair}
        assert priors["falsifier", (192, 192)] == priors["control", (192, 192)]
        assert priors["stress", (192, 192)].center_m is None
        assert priors["stress", (192, 192)].yaw_deg is None
        assert priors["control", (192, 192)].scale_sigma == priors["stress", (192, 192)].scale_sigma


def test_candidates_are_as_many_and_the_same_but_for_what_the_stress_does_to_them(drawn):
    _, _, drafts = drawn("alias")
    for pair in by_site(drafts):
        places = {truth.kind: (query.candidates, truth) for query, truth in pair if query.candidates}
        plain = places["no copies"][0]
        assert len(plain) <= max(CANDIDATES)
        assert places["R3 pooled"][0] == plain
        assert len(places["R1 truth removed"][0]) == len(plain)
        assert places["R1 truth removed"][1].candidate == -1
        for kind in ("no copies", "R3 pooled", "R4 identical blocks"):
            candidates, truth = places[kind]
            right = candidates[truth.candidate]
            apart = np.array([right.easting_m - truth.pose.easting_m, right.northing_m - truth.pose.northing_m])
            assert np.abs(apart).max() <= STRIDE_M / 2 + 0.01
        candidates, truth = places["R2 neighbours"]
        right = candidates[truth.candidate]
        assert (right.easting_m, right.northing_m) == pytest.approx(
            (truth.pose.easting_m, truth.pose.northing_m), abs=0.01
        )


def test_copies_are_candidates_only_where_the_suite_says_so(drawn):
    made, _, drafts = drawn("alias")
    for query, truth in drafts:
        site = next(site for site in made.sites if site.pose == truth.pose)
        twins = np.array(made.scene.twins[site.index])
        places = np.array([(pose.easting_m, pose.northing_m) for pose in query.candidates])
        near = np.abs(twins[:, None] - places[None]).max(axis=2).min(axis=1) <= STRIDE_M / 2 + 0.01
        if truth.kind.startswith(("R1", "R4")):
            assert near.all()
        elif not truth.kind.startswith("R2"):
            assert not near.any()


def test_ids_say_nothing_and_do_not_depend_on_how_many_sites_there_are(drawn):
    made, drawer, drafts = drawn("growth")
    ids = [query.query_id for query, _ in drafts]
    assert ids == sorted(ids)
    assert len(set(ids)) == len(ids)
    assert {job.query_id for job in drawer.jobs(made.sites[:1])} < set(ids)


# Priors


def test_the_truth_lies_anywhere_within_the_disc():
    pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=350.0)
    priors = [make_prior(pose, GROUP, away_m=0.0, rng=np.random.default_rng(seed)) for seed in range(2000)]
    apart_m = np.hypot(*np.array([prior.center_m for prior in priors]).T)
    assert apart_m.max() <= 500.1
    assert np.mean(apart_m < 250) == pytest.approx(0.25, abs=0.04)  # by area
    off_deg = (np.array([prior.yaw_deg for prior in priors]) - 350 + 180) % 360 - 180
    assert off_deg.std() == pytest.approx(20, rel=0.06)
    assert off_deg.mean() == pytest.approx(0, abs=1.5)


def test_outside_means_that_the_disc_ends_that_far_away():
    pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    prior = make_prior(pose, GROUP, away_m=384.0, rng=np.random.default_rng(0))
    assert np.hypot(*prior.center_m) - 500 == pytest.approx(384, abs=0.2)


def test_nothing_is_outside_a_disc_that_is_not_there():
    pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    with pytest.raises(ConfigError, match="searches the whole map, so no place on it is outside"):
        make_prior(pose, replace(GROUP, radius_m=None), away_m=384.0, rng=np.random.default_rng(0))
