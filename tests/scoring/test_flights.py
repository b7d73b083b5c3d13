# SPDX-License-Identifier: Apache-2.0
"""Scores of flights, against flights whose figures are worked by hand."""

import math
from dataclasses import replace
from itertools import accumulate

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards.text import warnings_of
from sasgeo_bench.core.errors import ConfigError, MetricError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.scoring.contrasts import Contrast, Pilot, check_contrasts, evaluate_contrasts
from sasgeo_bench.scoring.flights import (
    FLIGHT_COLUMNS,
    NEES_BAND,
    age_quantile,
    availability,
    continuity,
    score_flights,
)
from sasgeo_bench.scoring.metrics import means_of, primary_of, quantiles_of
from sasgeo_bench.scoring.score import COLUMNS, MISSING
from sasgeo_bench.scoring.tables import leaderboard
from sasgeo_bench.tasks.query import Head, Truth, view_id

STEP_M = 100.0
SURE = (25.0, 0.0, 0.0, 0.0, 25.0, 0.0, 0.0, 0.0, 4.0)  # 5 m, 5 m and 2 deg


def a_flight(count=11, flight="f0", *, steps_m=None, kind="no drift", unseen=(), absent=(), carried_m=None):
    """Return heads and truths of a flight due east, a view each 100 m; `carried_m` shifts its second half north."""
    ways = [0.0, *(steps_m or [STEP_M] * (count - 1))]
    heads, truths = [], []
    for frame, distance_m in enumerate(accumulate(ways)):
        north_m = carried_m if carried_m and frame >= count // 2 else 0.0
        heads.append(
            Head(
                query_id=view_id(flight, frame),
                track="sequence",
                suite="flight-clean",
                suite_version=1,
                part="test",
                region="town",
                prior_group="r500-weak-s3",
                view_cells=192,
                cell_size_m=1.0,
                sequence_id=flight,
                frame=frame,
                increment=(0.0, ways[frame], 0.0) if frame else None,
            )
        )
        truths.append(
            Truth(
                query_id=heads[-1].query_id,
                is_present=frame not in absent,
                pose=Pose(easting_m=distance_m, northing_m=north_m, yaw_deg=90.0),
                candidate=-1,
                pair_id=f"site of {flight}",
                role="control",
                kind=kind,
                strength=0.0,
                strength_unit="m",
                unknown_share=1.0 if frame in unseen else 0.0,
                changed_share=0.0,
                feature_density=0.5,
                alias_index=None,
                block=f"town/{flight}",
                scene="town",
                measured={"distance_m": distance_m, "time_s": distance_m / 10, "is_seen": float(frame not in unseen)},
            )
        )
    return heads, truths


def answers(truths, *, off_m=None, accepted=None, covariance=SURE, **changes):
    """Return predictions that lie `off_m[frame]` north of the truth; None is a view without an estimate."""
    found = {}
    for at, truth in enumerate(truths):
        error_m = 0.0 if off_m is None else off_m[at]
        pose = None if error_m is None else replace(truth.pose, northing_m=truth.pose.northing_m + error_m)
        found[truth.query_id] = Prediction(
            query_id=truth.query_id,
            candidates=() if pose is None else ((pose, 1.0),),
            is_accepted=pose is not None and (accepted is None or bool(accepted[at])),
            covariance=None if pose is None else covariance,
            latency_s=0.5,
            **changes,
        )
    return found


def score_of(heads, truths, predictions):
    """Return the row of the only flight."""
    (row,) = score_flights(heads, truths, predictions).flights.to_dict("records")
    return row


def test_a_flight_that_is_followed_exactly_has_the_best_of_every_figure():
    heads, truths = a_flight()
    row = score_of(heads, truths, answers(truths))
    assert (row["query_id"], row["track"], row["status"], row["is_answered"], row["is_right"]) == (
        *("f0", "sequence", "ok"),
        *(True, True),
    )
    assert (row["views"], row["length_m"], row["latency_s"]) == (11, 1000.0, 0.5)
    shares = [name for name in FLIGHT_COLUMNS if name.startswith(("distance_within", "reckoned"))]
    assert [row[name] for name in shares] == [1.0] * 7
    assert (row["accepted"], row["false_accepted"], row["inside_95"], row["divergences"]) == (1.0, 0.0, 1.0, 0)
    assert [row[name] for name in ("first_fix_m", "first_fix_s", "ate_m", "nees", "false_per_km")] == [0.0] * 5
    assert (row["right_per_km"], row["longest_without_fix_m"]) == (11.0, 100.0)
    assert math.isnan(row["reacquired_m"])


def test_a_view_stands_for_half_the_way_to_either_neighbour():
    heads, truths = a_flight(4, steps_m=[100.0, 300.0, 600.0])
    row = score_of(heads, truths, answers(truths, off_m=[0.0, 25.0, 25.1, 50.0]))
    assert row["distance_within_10m"] == pytest.approx(0.05)
    assert row["distance_within_25m"] == pytest.approx(0.25)  # 50 m of the first view and 200 m of the second
    assert row["distance_within_50m"] == pytest.approx(1.0)
    assert (row["error_p50_m"], row["error_p95_m"]) == (25.0, 50.0)
    assert row["ate_m"] == pytest.approx(math.sqrt((25**2 + 25.1**2 + 50**2) / 4))


def test_what_is_not_answered_stays_in_every_denominator():
    heads, truths = a_flight(5)
    mine = answers(truths, off_m=[0.0, None, None, None, 0.0])
    row = score_of(heads, truths, mine)
    assert row["distance_within_25m"] == pytest.approx(0.25)
    assert (row["accepted"], row["error_p50_m"], row["ate_m"]) == (0.4, math.inf, math.inf)
    assert row["longest_without_fix_m"] == 400.0
    lost = score_of(heads, truths, {})
    assert (lost["status"], lost["is_answered"], lost["distance_within_25m"]) == (MISSING, False, 0.0)
    assert (lost["first_fix_m"], lost["nees"], lost["inside_95"]) == (math.inf, math.inf, 0.0)
    assert lost["longest_without_fix_m"] == 400.0


def test_only_accepted_fixes_can_be_false_or_first():
    heads, truths = a_flight(11)
    off_m = [0.0, 30.0, 30.0, 30.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    row = score_of(heads, truths, answers(truths, off_m=off_m, accepted=[0, 1, 1, 0, 0, 1, 0, 0, 0, 0, 1]))
    assert (row["first_fix_m"], row["first_fix_s"]) == (500.0, 50.0)
    assert row["false_accepted"] == pytest.approx(2 / 11)
    assert (row["false_per_km"], row["right_per_km"], row["false_of_accepted"]) == (2.0, 2.0, 0.5)
    assert (row["accepted"], row["right_accepted"]) == (4 / 11, 2 / 11)
    assert row["longest_without_fix_m"] == 500.0


def test_a_divergence_is_a_long_stretch_of_accepted_fixes_that_are_far_off():
    heads, truths = a_flight(20)
    far = [0.0] * 5 + [150.0] * 8 + [0.0] * 7
    assert score_of(heads, truths, answers(truths, off_m=far))["divergences"] == 1
    # Withheld views between do not end one, and a stretch of 500 m is not more than 500 m.
    accepted = [at % 2 for at in range(20)]
    assert score_of(heads, truths, answers(truths, off_m=far, accepted=accepted))["divergences"] == 1
    short = [0.0] * 5 + [150.0] * 6 + [0.0] * 9
    assert score_of(heads, truths, answers(truths, off_m=short))["divergences"] == 0
    assert score_of(heads, truths, answers(truths, off_m=far, accepted=[0] * 20))["divergences"] == 0


@pytest.mark.parametrize("how", ["unseen", "absent"])
def test_reacquisition_begins_where_a_gap_ends(how):
    heads, truths = a_flight(11, **{how: range(3, 6)})
    right = [1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1]
    row = score_of(heads, truths, answers(truths, accepted=right))
    assert row["reacquired_m"] == 100.0  # from the first view after the gap to the second
    never = score_of(heads, truths, answers(truths, accepted=[1] * 6 + [0] * 5))
    assert never["reacquired_m"] == math.inf


def test_single_views_that_show_nothing_are_no_gap():
    heads, truths = a_flight(11, unseen=(3, 5, 7))
    assert math.isnan(score_of(heads, truths, answers(truths))["reacquired_m"])


def test_a_gap_that_never_ends_has_nothing_after_it():
    heads, truths = a_flight(11, unseen=range(6, 11))
    assert math.isnan(score_of(heads, truths, answers(truths))["reacquired_m"])


def test_being_carried_is_found_and_its_way_does_not_count():
    heads, truths = a_flight(11, carried_m=2000.0)
    late = [1] * 5 + [0, 0, 0, 1, 1, 1]
    row = score_of(heads, truths, answers(truths, accepted=late))
    assert row["length_m"] == 1000.0
    assert row["reacquired_m"] == 300.0


def test_covariances_are_held_against_errors():
    heads, truths = a_flight(4)
    row = score_of(heads, truths, answers(truths, off_m=[5.0, 10.0, 12.0, 20.0]))
    assert row["nees"] == pytest.approx(np.mean([1.0, 4.0, 5.76, 16.0]) / 3)
    assert row["inside_95"] == 0.75  # 2.45 of their standard deviations hold 95 % of a plane
    odd = score_of(heads, truths, answers(truths, covariance=(-1.0, *SURE[1:])))
    assert (odd["nees"], odd["inside_95"]) == (math.inf, 0.0)


def test_no_choice_of_covariances_flatters_them():
    heads, truths = a_flight(4)
    off_m = [5.0, 10.0, 12.0, 20.0]
    given = answers(truths, off_m=off_m)
    first = {name: replace(one, covariance=SURE if at == 0 else None) for at, (name, one) in enumerate(given.items())}
    some = score_of(heads, truths, first)
    assert (some["nees"], some["nees_off"], some["inside_95"]) == (math.inf, math.inf, 0.25)
    wide = score_of(heads, truths, answers(truths, off_m=off_m, covariance=tuple(1e4 * one for one in SURE)))
    assert wide["nees_off"] > 5.0 > score_of(heads, truths, given)["nees_off"]
    flat = score_of(heads, truths, answers(truths, off_m=off_m, covariance=(0.0,) * 9))
    assert (flat["nees"], flat["inside_95"]) == (math.inf, 0.0)


def test_false_fixes_do_not_shorten_the_stretch_without_a_right_one():
    heads, truths = a_flight(11)
    row = score_of(heads, truths, answers(truths, off_m=[0.0] + [30.0] * 9 + [0.0]))
    assert (row["accepted"], row["longest_without_fix_m"]) == (1.0, 1000.0)


def test_a_flight_that_never_moved_has_figures_and_a_task_without_flights_none():
    heads, truths = a_flight(3, steps_m=[0.0, 0.0])
    row = score_of(heads, truths, answers(truths, off_m=[0.0, 0.0, 30.0]))
    assert row["distance_within_25m"] == pytest.approx(2 / 3)
    assert (row["false_per_km"], row["right_per_km"], row["longest_without_fix_m"]) == (0.0, 0.0, 0.0)
    with pytest.raises(MetricError, match="a task holds no flight: make the queries again"):
        score_flights([], [], {})


def test_what_covers_part_of_a_flight_is_not_a_claim_that_it_does_not_apply():
    heads, truths = a_flight(3)
    claimed = answers(truths, status="not applicable")
    assert score_of(heads, truths, claimed)["status"] == "not applicable"
    mixed = claimed | {heads[0].query_id: replace(claimed[heads[0].query_id], status="ok")}
    assert score_of(heads, truths, mixed)["status"] == MISSING


def test_views_that_an_older_program_drew_are_refused():
    heads, truths = a_flight(3)
    old = replace(truths[1], measured={"distance_m": 100.0})
    with pytest.raises(MetricError, match="was drawn by an older program: remove its task and truths"):
        score_flights(heads, [truths[0], old, truths[2]], {})


def test_the_odometer_says_the_rest_between_fixes():
    """An odometer that turns 10 degrees too far at once strays by 17 m in each 100 m."""
    heads, truths = a_flight(11)
    heads[1] = replace(heads[1], increment=(0.0, STEP_M, 10.0))
    row = score_of(heads, truths, answers(truths))
    assert row["reckoned_250m"] == 1.0
    assert row["reckoned_2000m"] == pytest.approx(0.25)  # views 0, 1 and 2 are within 25 m
    first = score_of(heads, truths, answers(truths, accepted=[0] * 10 + [1]))
    assert first["reckoned_250m"] == pytest.approx(0.05)  # nothing is known before the first fix


def drift_of(increments, **more):
    heads, truths = a_flight(**more)
    lines = [replace(head, increment=one) for head, one in zip(heads, increments, strict=True)]
    return score_flights(lines, truths, {}).flights["odometer_drift"].item()


def test_drift_is_what_the_odometer_alone_errs_after_half_a_kilometre():
    exact = [None, *[(0.0, STEP_M, 0.0)] * 10]
    assert drift_of(exact) == pytest.approx(0.0, abs=1e-12)
    assert drift_of([None, *[(0.0, 1.02 * STEP_M, 0.0)] * 10]) == pytest.approx(0.02)
    # A turn of 90 degrees that was not flown, halfway: its error grows with what lies behind the turn.
    turned = [(0.0, STEP_M, 90.0 if at == 5 else 0.0) for at in range(1, 11)]
    after_m = np.array([0, 4, 3, 2, 1, 0]) * STEP_M  # of the stretches from views 0 to 5
    assert drift_of([None, *turned]) == pytest.approx(float(np.mean(np.sqrt(2) * after_m)) / 500, abs=1e-6)


def test_drift_is_measured_where_the_odometer_is_not_lost_and_the_drone_not_carried():
    way = [None, *[(0.0, 1.02 * STEP_M, 0.0)] * 10]
    assert drift_of([*way[:5], None, *way[6:]], count=11) == pytest.approx(0.02)
    assert drift_of([None, *[(0.0, 1.02 * STEP_M, 0.0)] * 12], count=13, carried_m=400.0) == pytest.approx(0.02)
    assert math.isnan(drift_of(way[:5], count=5))  # shorter than half a kilometre
    assert math.isnan(drift_of([None] * 11))


def test_flights_are_told_apart_by_the_drift_of_their_odometers():
    parts = [a_flight(flight=f"f{number}", kind="stress") for number in range(3)]
    heads = [
        replace(head, increment=None if head.frame == 0 else (0.0, STEP_M * scale, 0.0))
        for (some, _), scale in zip(parts, (1.005, 1.015, 1.03), strict=True)
        for head in some
    ]
    truths = [replace(truth, role="stress") for _, some in parts for truth in some]
    table = leaderboard({"mine": score_flights(heads, truths, {}).flights}, draws=20)
    counts = table[table["metric"] == primary_of("sequence").name].set_index("stratum")["n"]
    assert [counts[f"odometer_drift {part}"] for part in ("0-0.01", "0.01-0.02", "0.02-0.04")] == [1, 1, 1]


def test_two_flights_are_two_rows_in_the_order_of_their_ids():
    parts = [a_flight(5, name) for name in ("f1", "f0")]
    heads, truths = ([item for part in parts for item in part[at]] for at in (0, 1))
    found = score_flights(heads, truths, answers(truths), place_of={"town/f0": "here"}, country_of={"here": "LI"})
    assert list(found.flights.columns) == [*COLUMNS, *FLIGHT_COLUMNS]
    assert found.flights["query_id"].tolist() == ["f0", "f1"]
    assert found.flights[["place", "country"]].to_numpy().tolist() == [["here", "LI"], ["town", "town"]]
    assert found.views["sequence_id"].tolist() == ["f0"] * 5 + ["f1"] * 5
    assert found.views["place"].tolist() == ["here"] * 5 + ["town"] * 5


def test_answers_of_other_queries_and_lost_truths_are_refused():
    heads, truths = a_flight(3)
    with pytest.raises(MetricError, match="belongs to no query"):
        score_flights(heads[:2], truths, answers(truths))
    with pytest.raises(MetricError, match="has no truth"):
        score_flights(heads, truths[:2], {})
    with pytest.raises(MetricError, match="has no true pose"):
        score_flights(heads, [replace(truths[0], pose=None), *truths[1:]], {})


def test_a_board_of_flights_has_every_figure_of_their_track():
    parts = [a_flight(5, f"f{at}", steps_m=[1100.0] * 4, unseen=(1, 2)) for at in range(4)]
    heads, truths = ([item for part in parts for item in part[at]] for at in (0, 1))
    good = score_flights(heads, truths, answers(truths)).flights
    bad = score_flights(heads, truths, {}).flights
    table = leaderboard({"good": good, "bad": bad}, draws=100)
    whole = table[table["stratum"] == "all"].set_index(["matcher", "metric"])
    expected = {item.name for item in (*means_of("sequence"), *quantiles_of("sequence"))}
    assert set(table["metric"]) == expected
    first = primary_of("sequence").name
    assert (whole.loc[("good", first), "value"], whole.loc[("bad", first), "value"]) == (1.0, 0.0)
    assert whole.loc[("good", first), "n"] == 4
    assert whole.loc[("good", "reacquired_500m"), "value"] == 1.0
    assert whole.loc[("bad", "first_fix"), "value"] == math.inf
    assert math.isnan(whole.loc[("good", "right_per_km"), "lo"])  # four flights that are alike
    assert "bad: 4 flights lack a row for each view and count as misses." in warnings_of(table)
    assert not any(line.startswith("good") for line in warnings_of(table))


def test_a_contrast_by_false_fixes_is_won_by_the_side_with_fewer():
    def side(counts):
        rows = []
        for place, count in enumerate(counts):
            heads, truths = a_flight(5, f"f{place}")
            fixes = answers(truths, off_m=[90.0] * count + [0.0] * (5 - count))
            found = score_flights(heads, truths, fixes).flights
            rows.append(found.assign(place=f"p{place}", block=f"p{place}/0", country=f"p{place}", role="stress"))
        return pd.concat(rows, ignore_index=True)

    fields = {"first": "careful", "second": "rash", "suites": ("flight-clean",), "track": "sequence"}
    contrast = Contrast(name="none", metric="false_accepted", **fields)
    sides = {"careful": side([1, 1, 0, 1, 0, 1, 1, 0, 1, 1]), "rash": side([4, 3, 4, 5, 5, 4, 3, 4, 4, 5])}
    (found,) = evaluate_contrasts([contrast], sides, {}, draws=200)
    assert (found.first_value, found.second_value, found.best) == pytest.approx((0.14, 0.82, 0.0))
    assert (found.winner, found.is_lower_better, found.outcome) == ("careful", True, "decided")
    assert (found.first_only, found.second_only) == (3, 0)  # flights without a false fix


def test_a_registered_contrast_counts_flights_and_nobody_knows_how_many_false_fixes_there_will_be():
    heads, truths = a_flight(5)
    design = score_flights(heads, truths, {}).flights.assign(role="stress")
    fields = {"first": "a", "second": "b", "suites": ("flight-clean",), "track": "sequence"}
    (found,) = check_contrasts([Contrast(name="n", metric="false_accepted", **fields)], {}, design)
    assert (found.queries, found.best) == (1, 0.0)
    assert math.isnan(found.attainable)
    pilots = {"n": Pilot(second=0.02)}
    with pytest.raises(ConfigError, match=r"at most 0\.020 can be gained"):
        check_contrasts([Contrast(name="n", metric="false_accepted", **fields)], pilots, design)


def test_what_flights_can_show_follows_from_the_spread_of_their_differences_and_is_not_known_without():
    heads, truths = a_flight(5)
    one = score_flights(heads, truths, {}).flights.assign(role="stress")
    design = pd.concat([one.assign(place=f"p{place}", query_id=f"f{place}") for place in range(16)])
    contrast = Contrast(name="n", first="a", second="b", suites=("flight-clean",), track="sequence")

    def detectable(**pilot):
        return check_contrasts([contrast], {"n": Pilot(**pilot)}, design)[0].detectable

    assert detectable(spread=0.4) == pytest.approx((1.96 + 0.8416) * 0.4 / 4, rel=1e-3)
    assert math.isnan(detectable(discordant=0.5))


def ages_at(time_s, is_fix, moments):
    """Return the age of the last fix at each moment, and whether there was one; it counts from the start before."""
    fixes_s = time_s[is_fix]
    last = np.searchsorted(fixes_s, moments, side="right") - 1
    known = last >= 0
    return moments - np.where(known, fixes_s[np.maximum(last, 0)] if len(fixes_s) else 0.0, time_s[0]), known


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_ages_availability_and_continuity_are_those_of_moments_close_together(seed, share):
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(2.0, 20.0, 60))
    is_fix = rng.random(60) < share
    is_fix[30:40] = False
    moments = np.linspace(time_s[0], time_s[-1], 200_001)[:-1]
    age_s, known = ages_at(time_s, is_fix, moments)
    holds = known & (age_s <= 30.0)
    assert age_quantile(time_s, is_fix) == pytest.approx(np.quantile(age_s, 0.95), abs=0.05)
    assert availability(time_s, is_fix, 30.0) == pytest.approx(holds.mean(), abs=1e-3)
    step_s = moments[1] - moments[0]
    ahead = round(60.0 / step_s)
    ends = np.cumsum(~holds)
    lasts = holds[:-ahead] & (ends[ahead:] == ends[:-ahead])
    expected = lasts.sum() / max(1, holds[:-ahead].sum())
    assert continuity(time_s, is_fix, 30.0, 60.0) == pytest.approx(expected, abs=2e-3)


def test_a_flight_without_a_fix_is_as_old_as_it_is_long_and_one_after_another_gives_ages_right_or_not():
    heads, truths = a_flight(21)  # 2 km, 200 s
    row = score_of(heads, truths, answers(truths, accepted=[False] * 21))
    assert (row["fix_age_longest_s"], row["fix_age_longest_m"], row["duration_s"]) == (200.0, 2000.0, 200.0)
    assert (row["fix_age_p95_s"], row["fix_age_p95_m"]) == (pytest.approx(190.0), pytest.approx(1900.0))
    assert (row["available_30s"], row["continuity_60s"]) == (0.0, 0.0)
    row = score_of(heads, truths, answers(truths, off_m=[400.0] * 21))  # false, but accepted
    assert (row["fix_age_longest_s"], row["available_30s"], row["continuity_60s"]) == (10.0, 1.0, 1.0)
    assert row["longest_without_fix_m"] == 2000.0
    row = score_of(heads, truths, answers(truths, accepted=[at == 5 for at in range(21)]))
    assert (row["fix_age_longest_s"], row["available_30s"], row["continuity_60s"]) == (150.0, 0.15, 0.0)


def test_continuity_counts_no_flight_that_is_shorter_than_its_window_and_a_miss_of_any_other():
    (metric,) = (one for one in means_of("sequence") if one.name == "continuity_60s")
    rows = [
        score_of(*flight, answers(flight[1], accepted=[False] * len(flight[1])))
        for flight in (a_flight(6, "f0"), a_flight(11, "f1"))  # 50 s and 100 s
    ]
    table = pd.DataFrame(rows)
    assert metric.counts(table).tolist() == [False, True]
    assert metric.values(table)[1] == 0.0


def test_the_band_of_nees_is_that_of_one_view_and_takes_no_covariance_for_a_fault():
    squares = np.random.default_rng(0).chisquare(3, 200_000) / 3
    inside = (squares >= NEES_BAND[0]) & (squares <= NEES_BAND[1])
    assert inside.mean() == pytest.approx(0.95, abs=2e-3)
    heads, truths = a_flight()
    honest = score_of(heads, truths, answers(truths, off_m=[5.0, -5.0] * 5 + [5.0]))  # 1 of 3 degrees of freedom
    assert (honest["nees"], honest["nees_in_band"]) == (pytest.approx(1 / 3), True)
    assert score_of(heads, truths, answers(truths, off_m=[20.0] * 11))["nees_in_band"] is False
    assert score_of(heads, truths, answers(truths, covariance=None))["nees_in_band"] is False


def test_a_fix_is_confirmed_by_two_accepted_ones_before_it_that_agree_by_the_odometer():
    heads, truths = a_flight(12)
    off_m = [400.0, 0.0, 0.0, 0.0, 0.0, 400.0, 400.0, 400.0, 0.0, 20.0, 40.0, 65.1]
    row = score_of(heads, truths, answers(truths, off_m=off_m))
    # Views 3 and 4 close a row of three; 7 one of false fixes; 10 one that creeps away, and 11 is too far from 10.
    assert row["right_confirmed"] == pytest.approx(2 / 12)
    assert row["false_confirmed"] == pytest.approx(2 / 12)
    assert row["false_of_confirmed"] == 0.5
    assert (row["first_fix_m"], row["first_confirmed_m"]) == (100.0, 300.0)


def test_fixes_that_are_not_accepted_in_between_break_no_row_and_an_odometer_that_is_lost_does():
    heads, truths = a_flight(9)
    accepted = [at not in (1, 4) for at in range(9)]
    row = score_of(heads, truths, answers(truths, accepted=accepted))
    assert row["right_confirmed"] == pytest.approx(5 / 9)  # 3, 5, 6, 7, 8
    lost = [replace(head, increment=None) if head.frame == 5 else head for head in heads]
    row = score_of(lost, truths, answers(truths, accepted=accepted))
    assert row["right_confirmed"] == pytest.approx(3 / 9)  # 3, 7, 8
    hover, same = a_flight(9, steps_m=[100.0] * 4 + [0.0] + [100.0] * 3)
    assert score_of(hover, same, answers(same))["right_confirmed"] == pytest.approx(7 / 9)
    lost = [replace(head, increment=None) if head.frame == 5 else head for head in hover]
    assert score_of(lost, same, answers(same))["right_confirmed"] == pytest.approx(5 / 9)  # 2, 3, 4, 7, 8
    few = score_of(heads, truths, answers(truths, accepted=[at < 2 for at in range(9)]))
    assert (few["right_confirmed"], few["first_confirmed_m"]) == (0.0, math.inf)
    turned = a_flight(6)
    row = score_of(turned[0], turned[1], answers(turned[1]))
    assert row["right_confirmed"] == pytest.approx(4 / 6)
    odd = {
        name: replace(one, candidates=((replace(one.candidates[0][0], yaw_deg=0.0), 1.0),))
        for name, one in answers(turned[1]).items()
    }
    assert score_of(turned[0], turned[1], odd)["right_confirmed"] == 0.0  # its heading leads the odometer astray
