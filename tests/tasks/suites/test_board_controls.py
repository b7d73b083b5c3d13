# SPDX-License-Identifier: Apache-2.0
"""The controls of a board: views of the right map, of wrong ones, of one of two places, and of nothing."""

import numpy as np
import pytest

from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.query import BLIND, NOISE_FREE, SHUFFLED, TURNED, TWINS
from sasgeo_bench.tasks.sampling import Drawer
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.suites.board_controls import shuffled


@pytest.fixture(scope="module")
def made(carried):
    return carried("controls")


def drafts(made, kind):
    variant = next(item for item in made.suite.variants if item.kind == kind)
    return [(site, variant, made.draw(site, variant)) for site in made.sites]


def at_site(made, site, variant):
    return made.scene.map.view(site.pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)


@pytest.mark.parametrize("kind", [NOISE_FREE, TWINS])
def test_a_view_without_error_is_the_map(made, kind):
    for site, variant, draft in drafts(made, kind):
        np.testing.assert_array_equal(draft.evidence.cells, at_site(made, site, variant).cells)
        assert draft.is_present


def test_what_is_blind_shows_nothing_and_has_no_place(made):
    for _, _, draft in drafts(made, BLIND):
        assert (draft.evidence.cells == UNKNOWN).all()
        assert not draft.is_present
        assert draft.is_removed


@pytest.mark.parametrize("kind", [SHUFFLED, TURNED])
def test_a_wrong_map_shows_another_place_and_claims_its_own(made, kind):
    for site, variant, draft in drafts(made, kind):
        here = at_site(made, site, variant)
        assert (draft.evidence.cells != here.cells).any()
        assert draft.changed_share > 0.5
        assert draft.is_present
        assert draft.pose is None  # that of the site
        assert draft.evidence.unknown_share == 0


def test_twins_are_the_same_cell_by_cell(made):
    variant = next(item for item in made.suite.variants if item.kind == TWINS)
    for site in made.sites:
        (easting_m, northing_m), *others = made.scene.twins[site.index]
        assert not others
        pose = type(site.pose)(
            easting_m=easting_m, northing_m=northing_m, yaw_deg=site.pose.yaw_deg, scale=site.pose.scale
        )
        there = made.scene.map.view(pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
        np.testing.assert_array_equal(at_site(made, site, variant).cells, there.cells)


def test_shuffling_keeps_what_there_is_and_moves_it(made):
    world = made.scene.world
    mixed = shuffled(world, np.random.default_rng(3))
    before, after = world.bits.bits, mixed.bits.bits
    np.testing.assert_array_equal(np.sort(before, axis=None), np.sort(after, axis=None))
    assert (before != after).mean() > 0.1
    again = shuffled(world, np.random.default_rng(3))
    np.testing.assert_array_equal(after, again.bits.bits)


def test_twins_are_asked_for_among_candidates_alone_and_the_twin_is_one_of_them(made):
    split = Split.__new__(Split)  # never asked: jobs need no parts
    drawer = Drawer(suite=made.suite, scene=made.scene, seeds=made.seeds, group=made.suite.card.group, split=split)
    jobs = drawer.jobs(made.sites)
    assert {job.track for job in jobs if job.variant.kind == TWINS} == {"retrieval"}
    assert {job.track for job in jobs if job.variant.kind == NOISE_FREE} == {"retrieval", "localization"}
    for kind, is_there in ((TWINS, True), (NOISE_FREE, False), (SHUFFLED, False)):
        job = next(job for job in jobs if job.variant.kind == kind and job.track == "retrieval")
        state = made.scene.map
        draft = made.draw(job.site, job.variant)
        prior = type("Prior", (), {"yaw_deg": 0.0})()
        poses, right = drawer._candidates(job, draft, state, prior)
        twin = np.array(made.scene.twins[job.site.index][0])
        near = [np.hypot(pose.easting_m - twin[0], pose.northing_m - twin[1]) < 60 for pose in poses]
        assert any(near) == is_there
        assert right >= 0
