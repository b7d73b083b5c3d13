# SPDX-License-Identifier: Apache-2.0
"""Suites of flights: each stress is what it says and all else is the control's; no view but the first tells a place."""

import math

import numpy as np
import pytest

from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.query import CONTROLS, flight_id, view_id
from sasgeo_bench.tasks.suites import flights
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE, FLIGHT_SUITES, SUITES
from sasgeo_bench.tasks.suites.flights import SPACING_M, START, UNEVEN

SAME_DRAWS = ("flight-gap", "flight-kidnap", "flight-alias", "flight-off-map")  # their falsifiers err as the control
FLOWN = [name for name in FLIGHT_SUITES if name != "flight-real-image"]  # over towns: that one needs imagery
SEEN = [name for name in FLOWN if name not in SAME_DRAWS and name != "flight-image"]  # by a model of perception
OWN_DRAWS = ("flight-clean", "flight-real-age", "flight-start", "flight-overconfident")  # of their falsifiers


def cells(pairs):
    return np.stack([query.evidence.cells for query, _ in pairs])


def poses(pairs):
    return np.array([(truth.pose.easting_m, truth.pose.northing_m, truth.pose.yaw_deg) for _, truth in pairs])


def steps(pairs):
    """What the odometer says, shape (N, 3), nan where it says nothing."""
    return np.array([query.step.increment or [math.nan] * 3 for query, _ in pairs])


def covariances(pairs):
    return np.array([query.step.covariance or [math.nan] * 9 for query, _ in pairs])


def true_steps(pairs):
    """The way from each view to the next, in the axes of the first of the two, and the turn."""
    east_m, north_m, yaw_deg = poses(pairs).T
    moved = (np.diff(east_m) + 1j * np.diff(north_m)) * np.exp(1j * np.radians(yaw_deg[:-1]))
    return np.column_stack([moved.real, moved.imag, wrap_deg(np.diff(yaw_deg))])


def seen(pairs):
    return np.array([truth.measured["is_seen"] == 1 for _, truth in pairs])


def test_flights_are_drawn_where_they_are_named_alone():
    assert not set(FLIGHT_SUITES) & {*SUITES, CONTROLS}
    assert set(FLIGHT_SUITES) < set(EVERY_SUITE)
    for suite in FLIGHT_SUITES.values():
        assert {track for variant in suite.variants for track in suite.tracks(variant)} == {"sequence"}
        assert [item.role for item in suite.variants].count("control") == 1
        assert [item.role for item in suite.variants].count("falsifier") == 1


@pytest.mark.parametrize("name", FLOWN)
def test_the_views_of_a_flight_come_in_order_and_only_the_first_one_has_a_prior_of_the_place(flown, name):
    made = flown(name)
    assert len({flight_id(pairs[0][0].query_id) for pairs in made.views.values()}) == len(made.views)
    assert len({len(pairs) for pairs in made.views.values()}) == 1
    for pairs in made.views.values():
        own = flight_id(pairs[0][0].query_id)
        for frame, (query, truth) in enumerate(pairs):
            assert query.query_id == truth.query_id == view_id(own, frame)
            assert (query.step.sequence_id, query.step.frame) == (own, frame)
            assert (query.track, query.candidates, query.vectors) == ("sequence", (), None)
            assert len(query.frames) == (name == "flight-image")
            assert truth.is_present or name == "flight-off-map"
            prior = query.prior
            assert prior.scale_sigma == 0.03
            if frame:
                assert (prior.center_m, prior.radius_m, prior.yaw_deg, prior.yaw_sigma_deg) == (None,) * 4
            elif prior.radius_m is not None:
                off_m = math.dist(prior.center_m, (truth.pose.easting_m, truth.pose.northing_m))
                assert off_m <= prior.radius_m
        assert pairs[0][0].step.increment is None
        assert len({query.prior_group for query, _ in pairs}) == 1


@pytest.mark.parametrize("name", FLOWN)
def test_a_site_is_one_flight_for_all_variants_and_shares_pair_block_and_scale(flown, name):
    made = flown(name)
    control = made.of("control")
    for variant, pairs in made.views.items():
        for own in ("pair_id", "block"):
            assert {getattr(truth, own) for _, truth in pairs} == {getattr(control[0][1], own)}
        assert {truth.pose.scale for _, truth in pairs} == {made.flight.scale}
        if not (name == "flight-kidnap" and variant.role == "stress"):
            np.testing.assert_array_equal(poses(pairs), poses(control))


@pytest.mark.parametrize("name", ["flight-clean", "flight-kidnap"])
def test_truths_say_when_each_view_was_taken_at_speeds_that_a_drone_flies(flown, name):
    for pairs in flown(name).views.values():
        time_s, distance_m = (np.array([truth.measured[key] for _, truth in pairs]) for key in ("time_s", "distance_m"))
        assert time_s[0] == 0
        assert np.diff(time_s).min() > 1
        assert 3 < distance_m[-1] / time_s[-1] < 12


@pytest.mark.parametrize("name", SEEN)
def test_control_and_stress_see_the_same_with_the_same_errors_and_a_falsifier_errs_anew(flown, name, root):
    made = flown(name, root)
    control = made.of("control")
    for variant, pairs in made.views.items():
        is_same = (cells(pairs) == cells(control)).all()
        assert is_same == (variant.role != "falsifier")


@pytest.mark.parametrize("name", OWN_DRAWS[1:])
def test_the_odometer_of_a_falsifier_drifts_otherwise(flown, name, root):
    control, falsifier = (flown(name, root).of(role) for role in ("control", "falsifier"))
    off_m = np.abs(steps(control)[1:] - steps(falsifier)[1:])
    assert (off_m > 1e-6).all()


@pytest.mark.parametrize("name", FLOWN)
def test_what_an_odometer_says_is_the_true_way_but_for_its_drift(flown, name):
    for variant, pairs in flown(name).views.items():
        given, true = steps(pairs)[1:], true_steps(pairs)
        is_own = ~np.isnan(given[:, 0])
        if variant.kind == flights.UNTOLD:
            is_own[len(pairs) // 2 - 1] = False
        off = np.hypot(*(given - true)[is_own, :2].T) / np.hypot(*true[is_own, :2].T)
        if name == "flight-clean" and variant.role != "stress":
            assert off.max() < 1e-9
        else:
            assert off.min() > 0
            assert 1e-3 < np.median(off) < 0.3


def test_views_are_so_unevenly_spaced_that_knowing_it_tells_no_odometers_scale(flown):
    assert SPACING_M[1] / SPACING_M[0] > 1.3
    made = flown("flight-clean")
    lengths_m = np.hypot(*true_steps(made.of("control"))[:, :2].T)
    assert lengths_m.max() <= made.flight.spacing_m * max(UNEVEN) + 1e-6
    assert lengths_m.std() / lengths_m.mean() > 0.12


def test_odometers_of_flight_clean_have_the_drift_of_their_profiles(flown, root):
    made = flown("flight-clean", root)
    kinds = [variant.kind for variant in sorted(made.views, key=lambda item: item.strength) if variant.role == "stress"]
    assert kinds == [f"F1 {name}" for name in flights.PROFILES]
    spreads = [np.median(covariances(made.of("stress", kind))[1:, 8]) for kind in kinds]
    assert min(spreads) > 1e4 * np.median(covariances(made.of("control"))[1:, 8])
    assert len(set(spreads)) == len(kinds)


def test_a_gap_hides_exactly_the_views_within_it_and_the_falsifier_as_many_that_are_scattered(flown, root):
    made = flown("flight-gap", root)
    control = made.of("control")
    assert seen(control).all()
    distance_m = made.flight.views.distance_m
    for gap_m in flights.GAPS_M:
        pairs = made.of("stress", strength=gap_m)
        within = np.abs(distance_m - distance_m[-1] / 2) <= gap_m / 2
        np.testing.assert_array_equal(~seen(pairs), within)
        assert 0.7 * gap_m < np.ptp(distance_m[within]) <= gap_m
        assert (cells(pairs)[within] == UNKNOWN).all()
        assert {truth.unknown_share for _, truth in pairs if not truth.measured["is_seen"]} == {1.0}
        np.testing.assert_array_equal(cells(pairs)[~within], cells(control)[~within])
        np.testing.assert_array_equal(steps(pairs), steps(control))
    falsifier = made.of("falsifier")
    hidden = np.flatnonzero(~seen(falsifier))
    assert len(hidden) == within.sum()
    assert np.diff(hidden).min() >= 2
    assert np.ptp(distance_m[hidden]) > distance_m[-1] / 2
    assert 0 not in hidden
    np.testing.assert_array_equal(cells(falsifier)[seen(falsifier)], cells(control)[seen(falsifier)])


def test_a_carried_drone_comes_from_as_far_as_said_and_goes_on_as_the_control(flown, root):
    made = flown("flight-kidnap", root)
    control, middle = made.of("control"), made.flight.middle
    for kind in (flights.TOLD, flights.UNTOLD):
        pairs = made.of("stress", kind)
        np.testing.assert_array_equal(poses(pairs)[middle:], poses(control)[middle:])
        np.testing.assert_array_equal(cells(pairs)[middle:], cells(control)[middle:])
        np.testing.assert_array_equal(steps(pairs)[middle + 1 :], steps(control)[middle + 1 :])
        np.testing.assert_array_equal(covariances(pairs)[middle + 1 :], covariances(control)[middle + 1 :])
        carried_m = math.hypot(*true_steps(pairs)[middle - 1, :2])
        assert {truth.measured["carried_m"] for _, truth in pairs} == {round(carried_m, 1)}
        assert 1000 / 1.25 <= carried_m <= 1250
        assert (np.hypot(*(poses(pairs) - poses(control))[:middle, :2].T) > 1).all()
        flown_m = np.diff([truth.measured["distance_m"] for _, truth in pairs])
        assert flown_m[middle - 1] == 0
        assert np.delete(flown_m, middle - 1).min() > 0
    given, untold = (steps(made.of("stress", kind)) for kind in (flights.TOLD, flights.UNTOLD))
    assert np.isnan(given[middle]).all()
    np.testing.assert_array_equal(np.delete(given, middle, axis=0), np.delete(untold, middle, axis=0))


def test_an_odometer_that_is_unaware_of_the_carrying_says_the_step_of_the_control(flown, root):
    made = flown("flight-kidnap", root)
    untold, control = (steps(made.of(*which)) for which in (("stress", flights.UNTOLD), ("control",)))
    np.testing.assert_array_equal(untold[made.flight.middle], control[made.flight.middle])
    assert not np.isnan(untold[1:]).any()


def test_the_falsifier_of_carrying_is_the_control_with_one_step_of_which_nothing_is_said(flown, root):
    made = flown("flight-kidnap", root)
    falsifier, control = made.of("falsifier"), made.of("control")
    np.testing.assert_array_equal(cells(falsifier), cells(control))
    is_lost = np.isnan(steps(falsifier)[1:, 0])
    assert np.flatnonzero(is_lost).tolist() == [made.flight.middle - 1]
    np.testing.assert_array_equal(steps(falsifier)[1:][~is_lost], steps(control)[1:][~is_lost])


def test_an_optimistic_odometer_says_the_same_and_believes_a_ninth_of_the_covariance(flown, root):
    made = flown("flight-overconfident", root)
    control, stress = made.of("control"), made.of("stress")
    np.testing.assert_array_equal(steps(stress), steps(control))
    np.testing.assert_allclose(9 * covariances(stress)[1:], covariances(control)[1:])


def test_less_and_less_is_known_of_a_start_and_the_rest_of_the_flight_is_the_same(flown, root):
    made = flown("flight-start", root)
    control, falsifier = made.of("control"), made.of("falsifier")
    assert control[0][0].prior == falsifier[0][0].prior
    assert (control[0][0].prior.radius_m, control[0][0].prior.yaw_sigma_deg) == (100.0, 5.0)
    for radius_m in flights.START_RADII_M:
        first, _ = made.of("stress", strength=radius_m)[0]
        assert (first.prior.radius_m, first.prior.yaw_sigma_deg) == (radius_m, 20.0)
    anywhere = made.of("stress", flights.ANYWHERE)
    assert anywhere[0][0].prior.center_m is None
    for variant, pairs in made.views.items():
        assert (np.nan_to_num(steps(pairs)) == np.nan_to_num(steps(control))).all() == (variant.role != "falsifier")
    assert FLIGHT_SUITES["flight-start"].refusal(START)


def test_ages_search_the_older_maps_with_the_same_views_and_odometry(flown, root):
    made = flown("flight-real-age", root)
    control, stresses = made.of("control"), [item for item in made.views if item.role == "stress"]
    assert {query.region for query, _ in control} == {"town-suburb"}
    assert {truth.changed_share for _, truth in control} == {0.0}
    assert len(stresses) == 2
    for variant in stresses:
        pairs = made.views[variant]
        (region,) = {query.region for query, _ in pairs}
        assert region.startswith("town-suburb@")
        (age_years,) = {truth.measured["age_years"] for _, truth in pairs}
        assert 0.8 <= age_years / variant.strength <= 5 / 3
        assert np.mean([truth.changed_share for _, truth in pairs]) > 0.01
        np.testing.assert_array_equal(steps(pairs), steps(control))
