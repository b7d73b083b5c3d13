# SPDX-License-Identifier: Apache-2.0
"""Matchers by rings, sectors and grids, and the rejector of their test: by hand, what they keep, what they find."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.brm_grid import APART_M, SIDE, BrmGrid, RatioMap, grid_shares
from sasgeo_baselines.polar import GROUPS
from sasgeo_baselines.polar_vsc import (
    RINGS,
    SECTORS,
    STEP_DEG,
    Context,
    ContextMap,
    PolarVsc,
    Shares,
    correlations,
    ring_p_values,
)
from sasgeo_baselines.rejectors.ks_gate import KsGate
from scipy import special

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction, check_p_false
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.search.plan import Disc
from tests.baselines.worlds import PRIOR, things
from tests.made_up import HERE

ALL = np.ones(len(GROUPS), dtype=bool)


@pytest.fixture(scope="module")
def region():
    return things().region


@pytest.fixture(scope="module")
def described(region):
    return ContextMap.of(region)


@pytest.fixture(scope="module")
def seen():
    return things().seen(192)


# Rings and sectors


@pytest.mark.parametrize("quarter", range(4))
def test_a_view_is_described_as_the_map_is_under_it(made, region, described, quarter):
    east_m, north_m = 1208.0, 8792.0  # a corner of cells of 4 m
    view = made.view_of(region, Pose(easting_m=east_m, northing_m=north_m, yaw_deg=90.0 * quarter), size_cells=192)
    found = Context.of_view(view, described.is_used)
    mapped = described.at(np.array([[east_m, north_m]]))
    used = described.is_used
    assert used.sum() == 3
    np.testing.assert_allclose(found.rings.value[used], mapped.rings.value[0, used], atol=0.02)
    turned = np.roll(mapped.sectors.value[0, used], -quarter * SECTORS // 4, axis=-1)
    np.testing.assert_allclose(found.sectors.value[used], turned, atol=0.05)
    assert not found.rings.known[~used].any()
    heading = correlations(found.sectors, mapped.sectors, described.mean)[0]
    assert heading.argmax() * STEP_DEG == 90.0 * quarter
    assert heading.max() > 0.99


def test_rings_of_the_lattice_are_those_of_its_places(described):
    rows = np.arange(0, len(described.places_m), 97)
    whole, single = described.rings_at(rows), described.at(described.places_m[rows]).rings
    both = (whole.known > 0) & (single.known > 0)
    assert both.mean() > 0.8
    assert np.abs(whole.value - single.value)[np.broadcast_to(both, whole.value.shape)].max() < 0.02


def test_what_is_unknown_is_not_compared(made, region, described):
    here = Pose(easting_m=1208.0, northing_m=8792.0, yaw_deg=90.0)
    seen = made.view_of(region, here, size_cells=192)
    cells = seen.cells.copy()
    cells[:, :, :96] = UNKNOWN
    half = Context.of_view(seen.replace(cells), described.is_used)
    assert not half.sectors.known[:, :, SECTORS // 2 + 1 : -1].any()
    place_m = np.array([[here.easting_m, here.northing_m]])
    found = correlations(half.sectors, described.at(place_m).sectors, described.mean)[0]
    assert found.argmax() == SECTORS // 4
    assert found.max() > 0.99
    nothing = ContextMap.of(made.region_of(np.full_like(region.layers, 255))).at(place_m)  # a map that knows nothing
    assert not np.isfinite(correlations(half.sectors, nothing.sectors, described.mean)).any()
    assert np.isnan(ring_p_values(half.rings, nothing.rings, patch_m=8.0)).all()


def rings(*values):
    """Rings of one place that are known, of two groups of classes."""
    found = np.zeros((len(values), 2, RINGS), dtype=np.float32)
    found[:] = np.array(values, dtype=np.float32)[:, :, None]
    return Shares(value=found, known=np.ones((len(values), 1, RINGS), dtype=np.float32))


def test_the_test_of_rings_by_hand():
    """The last ring has 23 pi patches on both sides; cumulative shares are 0.5, 0.7 and 0.1, 0.7: 0.4 apart."""
    seen = Shares(value=rings((0.5, 0.2)).value[0], known=np.ones((2, RINGS), dtype=np.float32))
    found = ring_p_values(seen, rings((0.1, 0.6), (0.5, 0.2)), patch_m=8.0)
    assert found[0, -1] == pytest.approx(special.kolmogorov(np.sqrt(23 * np.pi / 2) * 0.4), rel=1e-4)
    assert found[0, 0] == pytest.approx(special.kolmogorov(np.sqrt(np.pi / 2) * 0.4), rel=1e-4)
    assert found[0, -1] < 0.01 < found[0, 0]  # a small ring says little
    assert (found[1] == 1).all()
    half = replace(seen, known=seen.known / 2)  # fewer patches are seen: 11.5 pi of them
    effective = 23 * np.pi * 11.5 / 34.5
    assert ring_p_values(half, rings((0.1, 0.6)), patch_m=8.0)[0, -1] == pytest.approx(
        special.kolmogorov(np.sqrt(effective) * 0.4), rel=1e-4
    )


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), min_size=2, max_size=4))
def test_p_values_are_even_and_one_for_equals(values):
    one, *others = values
    seen = Shares(value=rings(one).value[0], known=np.ones((2, RINGS), dtype=np.float32))
    found = ring_p_values(seen, rings(one, *others), patch_m=8.0)
    assert (found[0] == 1).all()
    assert ((found >= 0) & (found <= 1)).all()
    back = Shares(value=rings(others[0]).value[0], known=seen.known)
    np.testing.assert_allclose(ring_p_values(back, rings(one), patch_m=8.0)[0], found[1])
    assert (np.diff(found, axis=1) <= 1e-12).all()  # the same difference counts more in larger rings


def test_rings_of_which_little_is_known_are_not_judged(made, region, seen):
    cells = np.full_like(seen.cells, UNKNOWN)
    cells[:, :96, 70:122] = seen.cells[:, :96, 70:122]  # ahead, at most a fifth of a ring
    cells[:, 56:, :] = UNKNOWN
    matcher = PolarVsc()
    matcher.prepare(region, None)
    diagnostics = matcher.match(made.query_of(seen.replace(cells), PRIOR), top_k=2).diagnostics
    assert (diagnostics["ks_share"], diagnostics["ks_p"]) == (0.0, 1.0)


# Building ratios


@given(quarter=st.integers(0, 3), seed=st.integers(0, 9))
def test_a_grid_turns_against_the_view(quarter, seed):
    cells = np.random.default_rng(seed).integers(0, 2, (1, 128, 128), dtype=np.uint8)
    view = Evidence(classes=("building",), cells=cells, cell_size_m=1.0)
    found = grid_shares(view, 90.0 * quarter).reshape(SIDE, SIDE)
    # What lies ahead of a view that heads east lies in the east: the picture turns clockwise.
    expected = np.rot90(cells[0], -quarter).reshape(SIDE, 32, SIDE, 32).mean(axis=(1, 3))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_parts_that_are_not_known_are_not_compared():
    cells = np.zeros((1, 128, 128), dtype=np.uint8)
    cells[0, :32, :25], cells[0, :16, 32:64], cells[0, 16:32, 32:48] = UNKNOWN, UNKNOWN, PRESENT
    found = grid_shares(Evidence(classes=("building",), cells=cells, cell_size_m=1.0), 0.0)
    assert np.isnan(found[0])  # of which 7 of 32 columns are known
    assert found[1] == 0.5
    assert (found[2:] == 0).all()


def test_windows_are_ranked_by_the_ratios_that_are_known():
    ratios = RatioMap(
        places_m=np.array([[0.0, 0.0], [30.0, 0.0], [60.0, 0.0], [900.0, 0.0]]),
        shares=np.array([[0.0, 0.9], [0.4, 0.0], [0.2, 0.5], [0.2, 0.5]]),
        spread=np.array([0.1, 0.5]),
    )
    disc = Disc(center_m=(0.0, 0.0), radius_m=100.0)
    assert ratios.best(np.array([[0.2, 0.5]]), disc, count=50)[:, 0].tolist() == [60.0, 0.0, 30.0]
    assert ratios.best(np.array([[0.35, np.nan]]), disc, count=50)[:, 0].tolist() == [30.0, 60.0, 0.0]
    assert ratios.best(np.array([[0.2, 0.5], [0.4, 0.0]]), disc, count=50)[:, 0].tolist() == [30.0, 60.0, 0.0]
    assert len(ratios.best(np.full((1, 2), np.nan), disc, count=50)) == 0


def test_answers_of_building_ratios_lie_in_the_disc_and_apart(made, region, seen):
    matcher = BrmGrid()
    matcher.prepare(region, None)
    poses = matcher.match(made.query_of(seen, PRIOR), top_k=10).poses
    places_m = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
    assert 2 <= len(poses) <= 50
    assert (np.hypot(*(places_m - PRIOR.center_m).T) <= PRIOR.radius_m).all()
    away_m = np.hypot(*(places_m[:, None] - places_m).T)
    assert away_m[~np.eye(len(poses), dtype=bool)].min() >= APART_M


# The rejector


def answer(**diagnostics):
    return Prediction(query_id="q", candidates=((HERE, 1.0),), diagnostics=diagnostics)


def test_the_gate_by_hand():
    gate = KsGate()
    gate.fit([], np.zeros(0, dtype=bool))
    found = check_p_false(
        gate.p_false([answer(ks_share=1.0, ks_p=0.2), answer(ks_share=0.75, ks_p=0.004), answer(), WITHHELD_ANSWER]), 4
    )
    assert found.tolist() == pytest.approx([0.4, 1 - 0.754 / 2, 0.5, 1.0])
    assert gate.p_false([answer(ks_share=float("nan"), ks_p=0.2), answer(ks_p=0.2)]).tolist() == [0.5, 0.5]
    assert not gate.card.is_calibrated


@given(failing=st.integers(1, RINGS), low=st.floats(0, 0.01, exclude_max=True), high=st.floats(0.01, 1))
def test_the_gate_parts_answers_whose_rings_all_pass_from_others(failing, low, high):
    passing, failed = KsGate().p_false(
        [answer(ks_share=1.0, ks_p=high), answer(ks_share=1 - failing / RINGS, ks_p=low)]
    )
    assert passing < 0.5 < failed


WITHHELD_ANSWER = Prediction(query_id="withheld")
