# SPDX-License-Identifier: Apache-2.0
"""Alarms over a receiver that is led astray: as soon as geometry says, as rare as chance says."""

import math

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.scoring.gnss_check import STARTS, Fixes, Monitor, check_gnss

SQUARED = 13.815510557964274  # the 99.9 % point of chi-square with two degrees of freedom


def flight(*, count=400, step_s=2.0, spread_m=5.0, off_m=0.0, accepted=None, seed=0):
    """Views along a line, with fixes that are off by noise that their covariance tells, and by more at some."""
    rng = np.random.default_rng(seed)
    true_m = np.column_stack([10.0 * step_s * np.arange(count), np.zeros(count)])
    found_m = true_m + rng.normal(0, spread_m, (count, 2))
    found_m[:, 1] += off_m
    names = [f"{at:024d}" for at in range(count)]
    is_accepted = np.ones(count, dtype=bool) if accepted is None else accepted
    covariance = tuple(np.diag([max(spread_m, 0.1) ** 2, max(spread_m, 0.1) ** 2, 1.0]).ravel().tolist())
    views = pd.DataFrame(
        {
            "query_id": names,
            "frame": np.arange(count),
            "time_s": step_s * np.arange(count),
            "is_accepted": is_accepted,
            "true_east_m": true_m[:, 0],
            "true_north_m": true_m[:, 1],
            "east_m": found_m[:, 0],
            "north_m": found_m[:, 1],
        }
    )
    answers = {
        name: Prediction(
            query_id=name,
            candidates=((Pose(easting_m=x, northing_m=y, yaw_deg=0.0), 1.0),),
            covariance=covariance,
            is_accepted=bool(taken),
        )
        for name, (x, y), taken in zip(names, found_m.tolist(), is_accepted, strict=True)
    }
    return views, answers


def test_a_pull_off_is_noticed_when_it_leaves_the_ellipse_and_stays_out():
    views, answers = flight(spread_m=0.0)
    monitor = Monitor(sigma_m=3.0, in_a_row=3)
    found = check_gnss(views, answers, monitor=monitor, pull_mps=0.5, draws_noise=False)
    assert found.alarms_s == ()
    assert found.fixes == 400
    reach_m = math.sqrt(SQUARED * (3.0**2 + 0.1**2))
    for start_s, noticed_s in zip(np.linspace(0, 798 * 2 / 3, STARTS), found.noticed_s, strict=True):
        first_s = 2.0 * math.ceil((start_s + reach_m / 0.5) / 2.0)  # the first view outside, of one every 2 s
        assert noticed_s == pytest.approx(first_s + 2 * 2.0 - start_s, abs=1e-6)


def test_alarms_by_chance_are_as_rare_as_the_ellipse_says():
    views, answers = flight(count=20_000, seed=1)  # other noise than the receiver's
    single = check_gnss(views, answers, monitor=Monitor(sigma_m=4.0, in_a_row=1))
    # 20 of 20,000 are due; a run of two by chance begins once
    assert 8 <= len(single.alarms_s) <= 36
    assert check_gnss(views, answers, monitor=Monitor(sigma_m=4.0)).alarms_s == ()
    # a receiver without noise, which is believed to have none, leaves the fixes' own
    exact = check_gnss(views, answers, monitor=Monitor(sigma_m=0.1, in_a_row=1), draws_noise=False)
    assert 8 <= len(exact.alarms_s) <= 36


def test_one_false_fix_is_no_alarm_and_what_is_not_accepted_is_not_asked():
    off_m = np.zeros(400)
    off_m[[50, 150, 151]] = 300.0
    assert check_gnss(*flight(off_m=off_m), monitor=Monitor()).alarms_s == ()
    off_m[200:210] = 300.0
    (begin,) = check_gnss(*flight(off_m=off_m), monitor=Monitor()).alarms_s
    assert begin == 2.0 * 202
    accepted = off_m == 0
    found = check_gnss(*flight(off_m=off_m, accepted=accepted), monitor=Monitor())
    assert (found.alarms_s, found.fixes) == ((), int(accepted.sum()))


def test_without_a_fix_or_a_covariance_nothing_is_noticed():
    views, answers = flight(count=10, accepted=np.zeros(10, dtype=bool))
    found = check_gnss(views, answers, monitor=Monitor(), pull_mps=5.0)
    assert found.fixes == 0
    assert set(found.noticed_s) == {math.inf}
    views, answers = flight(count=10)
    bare = {
        name: Prediction(query_id=name, candidates=one.candidates, is_accepted=True) for name, one in answers.items()
    }
    assert len(Fixes.of(views, bare)[0].time_s) == 0


@pytest.mark.parametrize("wrong", [{"sigma_m": 0.0}, {"in_a_row": 0}, {"share": 1.0}])
def test_numbers_that_make_no_monitor_are_refused(wrong):
    with pytest.raises(ConfigError, match="within"):
        Monitor(**wrong)
