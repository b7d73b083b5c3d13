# SPDX-License-Identifier: Apache-2.0
"""Matchers of buildings: rays and votes of shapes worked by hand, what they must keep, and what they find."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.building_votes import Mixture, Seen, Town, headings, mixture_of
from sasgeo_baselines.instance_rays import REACH_M, STEP_M, BuildingMap, cast
from sasgeo_baselines.ouyang_shape_votes import OuyangShapeVotes, credibility
from sasgeo_baselines.vojir_instance_rays import (
    LEAST_SPREAD,
    RAYS,
    WAVES,
    Profiles,
    VojirInstanceRays,
    differences,
    open_ground,
)

from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.search.plan import Disc
from tests.baselines.worlds import suburb
from tests.made_up import error_m

HERE, PRIOR = suburb().here, suburb().prior


@pytest.fixture(scope="module")
def region():
    return suburb().region


@pytest.fixture(scope="module")
def seen():
    return suburb().seen(192)


# Rays


def yard():
    """Open ground with a wall of 4 m, 20 m ahead of the middle, and what is not known on the left of it."""
    states = np.zeros((200, 200), dtype=np.uint8)
    states[76:80, 90:110] = PRESENT
    states[:, :60] = UNKNOWN
    return states


def test_rays_by_hand():
    found = cast(yard(), np.array([[100.0, 100.0]]), RAYS, cell_m=1.0)
    assert found.range_m[0, 0] == pytest.approx(20.0, abs=0.8)
    assert found.range_m[0, 20] == pytest.approx(20.0 / np.cos(np.radians(20)), abs=0.8)
    hits = np.flatnonzero(found.building[0])
    assert (hits.min(), hits.max()) == (0, 359)
    assert len(hits) == 2 * int(np.degrees(np.arctan(10 / 20))) + 1  # 26 to each side, and straight ahead
    assert np.flatnonzero(found.is_censored[0]).tolist() == list(range(210 + 1, 330))  # 40 of 80 m: 60 degrees
    assert (found.range_m[0, found.building[0] == 0] == REACH_M).all()


def test_rays_of_a_lattice_are_those_of_its_places(region):
    buildings = BuildingMap.of(region)
    places_m, rays = next(iter(buildings.lattice(40, 120)))
    again = buildings.rays(places_m, 120)
    off_m = np.abs(rays.range_m - again.range_m)
    assert len(places_m) > 100
    assert np.quantile(off_m, 0.9) <= STEP_M
    assert ((rays.building > 0) == (again.building > 0)).mean() > 0.97
    assert (rays.is_censored == again.is_censored).mean() > 0.97
    assert again.is_censored.any()  # beyond the map nothing is known


@given(quarter=st.integers(0, 3), censors=st.booleans())
def test_waves_do_not_turn_with_a_view_and_differences_say_by_how_much(quarter, censors):
    states = yard()
    states[120:130, 130:135] = PRESENT
    one, other = (
        Profiles.of(cast(cells, np.array([[100.0, 100.0]]), RAYS, cell_m=1.0), censors=censors)
        for cells in (states, np.ascontiguousarray(np.rot90(states, -quarter)))  # clockwise, as on a map
    )
    np.testing.assert_allclose(one.magnitudes(), other.magnitudes(), atol=0.01)
    assert one.magnitudes().shape == (1, 3 * WAVES)
    found = differences(one, other, np.arange(RAYS), blur=5)[0]
    assert found.argmin() == 90 * quarter
    assert found.min() < 0.02


def test_rays_that_are_left_out_change_nothing_and_too_few_say_nothing():
    states = yard()
    whole = states.copy()
    whole[:, :60] = ABSENT
    whole[90:110, 40:50] = PRESENT  # a house that the view cannot see
    half, full = (cast(cells, np.array([[100.0, 100.0]]), RAYS, cell_m=1.0) for cells in (states, whole))
    faithful, left_out = (
        differences(*(Profiles.of(rays, censors=censors) for rays in (half, full)), np.array([0]), blur=5)[0, 0]
        for censors in (False, True)
    )
    assert left_out < 0.02 < faithful
    blind = cast(np.full_like(states, UNKNOWN), np.array([[100.0, 100.0]]), RAYS, cell_m=1.0)
    seen = Profiles.of(blind, censors=True)
    assert differences(seen, Profiles.of(full, censors=True), np.array([0]), blur=5)[0, 0] == np.inf


def test_rays_begin_in_the_open():
    states = np.full((64, 64), PRESENT, dtype=np.uint8)
    assert open_ground(states, cell_m=1.0, within_m=16.0) is None
    states[:, 58:] = ABSENT  # beyond the reach of the middle: the nearest of it
    assert open_ground(states, cell_m=1.0, within_m=16.0)[0] == 58.5
    states[20:41, 20:41] = ABSENT
    assert open_ground(states, cell_m=1.0, within_m=16.0).tolist() == [30.5, 30.5]
    assert np.hypot(*(open_ground(states, cell_m=1.0, within_m=16.0) - 32.0)) <= 16.0


def test_whitening_is_learned_from_other_maps(made, region, seen):
    query = replace(made.query_of(seen, PRIOR), region="made-up")
    training = Training(regions={"made-up": region}, pairs=((query, SimpleNamespace(pose=HERE)),))
    text = VojirInstanceRays().learn(training)
    assert text == VojirInstanceRays().learn(training)
    spread = np.array(json.loads(text)["spread"])
    assert spread.shape == (3 * WAVES,)
    assert (spread >= LEAST_SPREAD).all()
    taught = VojirInstanceRays()
    taught.prepare(region, text)
    assert error_m(taught.match(query, top_k=1), HERE) < 6


# Votes of shapes


@given(
    places=st.lists(st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(0.1, 9)), min_size=1, max_size=8),
    moved=st.floats(-1e4, 1e4),
)
def test_credibility_is_a_share_and_does_not_depend_on_where_all_lie(places, moved):
    rows = np.array(sorted(places, key=lambda row: -row[2]))
    mixture = Mixture(
        place_m=rows[:, :2], yaw_deg=np.zeros(len(rows)), sigma_m=np.full(len(rows), 8.0), height=rows[:, 2]
    )
    found = credibility(mixture, 500.0)
    assert 0 <= found <= rows[0, 2] / rows[:, 2].sum()
    assert credibility(replace(mixture, place_m=mixture.place_m + moved), 500.0) == pytest.approx(found, abs=1e-6)
    assert credibility(mixture, 1000.0) >= found


def test_components_are_the_answer_and_their_heights_the_scores(made, region, seen):
    matcher = OuyangShapeVotes()
    matcher.prepare(region, None)
    known = replace(PRIOR, yaw_deg=HERE.yaw_deg, yaw_sigma_deg=1.0)
    answer = matcher.match(made.query_of(seen, known), top_k=5)
    disc = Disc(center_m=PRIOR.center_m, radius_m=PRIOR.radius_m)
    votes = Town.of(region).votes(Seen.of(seen), disc, yaws_deg=headings(HERE.yaw_deg, 1.0))
    bandwidth_m = matcher.numbers["bandwidth_m"]
    inside = votes[np.hypot(*(votes[:, :2] - PRIOR.center_m).T) <= PRIOR.radius_m + bandwidth_m]
    mixture = mixture_of(inside, bandwidth_m=bandwidth_m)
    assert answer.scores[0] == mixture.height[0]
    assert [answer.poses[0].easting_m, answer.poses[0].northing_m] == mixture.place_m[0].tolist()
    assert answer.diagnostics["credibility"] == credibility(mixture, PRIOR.radius_m)
    assert 0 < answer.diagnostics["credibility"] < 1
