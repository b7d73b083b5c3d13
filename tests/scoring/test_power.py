# SPDX-License-Identifier: Apache-2.0
"""Power by simulation: what is certain is found certain, equality included, and places of a country may be alike."""

import numpy as np
import pandas as pd
import pytest

from benchmarks import power
from benchmarks.power import Asked, ends, likeness, line, outcome, ranked_places, simulated, swapped
from sasgeo_bench.tasks.split import find_split_file, read_split_file

CRITICAL = 1.96
UNITS = ("country", "place", "block")
COUNTRIES = [f"country-{at // 2}" for at in range(20)]


def gaps(*values, views=10, sites=10):
    return [Asked(np.full(views, value), sites) for value in values]


@pytest.mark.parametrize(("value", "word"), [(1.0, "shown"), (-1.0, "shown"), (0.0, "equal"), (0.02, "shown")])
def test_what_every_place_says_is_found(value, word):
    assert outcome(gaps(*[value] * 20), COUNTRIES, 0.03, CRITICAL, np.random.default_rng(0)) == word


@pytest.mark.parametrize(("sites", "word"), [(1, "open"), (10, "equal")])
def test_equality_takes_sites_where_no_view_differs(sites, word):
    same = gaps(*[0.0] * 80, sites=sites)
    countries = [f"country-{at // 3}" for at in range(80)]
    assert outcome(same, countries, 0.03, CRITICAL, np.random.default_rng(0)) == word


def test_equal_sides_of_which_no_view_differs_get_one_each_way():
    found = [one.gaps for one in swapped(gaps(*[0.0] * 5), np.random.default_rng(0))]
    assert sorted(np.abs(gap).sum() for gap in found) == [0, 0, 0, 1, 1]
    lost = [one.gaps.sum() for one in swapped(gaps(*[1.0] * 40), np.random.default_rng(0))]
    assert set(lost) == {10.0, -10.0}


def test_places_that_disagree_leave_it_open():
    some = gaps(*[1.0, -1.0] * 10)
    assert outcome(some, [str(at) for at in range(20)], 0.03, CRITICAL, np.random.default_rng(0)) == "open"


def test_countries_that_differ_are_more_uncertain_than_their_places():
    some = gaps(*[float(at // 2 % 2) for at in range(20)])
    rng = np.random.default_rng(0)
    by_place, by_country = ends(some, [str(at) for at in range(20)], rng), ends(some, COUNTRIES, rng)
    assert by_country[0] < by_place[0] < 0.5 < by_place[1] < by_country[1]


def test_alike_places_of_a_country_take_from_one_pilot_place():
    pilot, rng = gaps(0.0, 1.0, 2.0, views=3), np.random.default_rng(1)
    drawn = simulated(pilot, COUNTRIES, rng, times=2, alike=True)
    assert {(len(one.gaps), one.sites) for one in drawn} == {(6, 20)}
    first = [float(one.gaps[0]) for one in drawn]
    assert first[::2] == first[1::2]
    apart = [float(one.gaps[0]) for one in simulated(pilot, COUNTRIES, rng, times=1, alike=False)]
    assert apart[::2] != apart[1::2]


def test_likeness_is_one_where_places_alone_differ_and_none_where_views_do():
    assert likeness([one.gaps for one in gaps(0.0, 1.0, 0.0, 1.0)]) == pytest.approx(1.0)
    assert likeness([np.array([0.0, 1.0] * 5)] * 4) == 0.0


def test_test_places_alone_are_asked_and_old_maps_where_there_are_some():
    split = read_split_file(find_split_file("world"))
    every, dated = ranked_places(split, ["clean"]), ranked_places(split, ["real-age"])
    assert len(every) == sum(place.part == "test" for place in split.place)
    assert set(dated) < set(every)
    assert "triesen" in dated
    assert "dhaka" not in dated


def test_a_row_of_a_pilot_in_which_one_side_always_wins():
    same = {"suite": "clean", "track": "localization", "detector": "published", "yaw_error_deg": 0.0, "role": "stress"}
    same |= {"is_present": True, "pair_id": "s", "view_cells": 192, "kind": "perception", "strength": 1.0}
    sides = {"one": 1.0, "two": 99.0}
    rows = [
        same
        | {"query_id": f"{at}", "matcher": side, "position_error_m": error_m}
        | dict.fromkeys(UNITS, "abcd"[at // 3])
        for at in range(12)
        for side, error_m in sides.items()
    ]
    contrast = {"name": "all", "first": "one", "second": "two", "suites": ["clean"], "kinds": [], "detectors": []}
    contrast |= {"metric": "primary", "track": "localization", "min_effect": 0.03}
    split = read_split_file(find_split_file("world"))
    found = line(contrast, pd.DataFrame(rows), split, CRITICAL)
    of_one = line(contrast, pd.DataFrame([row for row in rows if row["place"] == "a"]), split, CRITICAL)
    assert of_one == "| all | 3, 1 | - | | | | | | |"
    assert of_one.count("|") == found.count("|")
    assert found == "| all | 12, 4 | +100.0 | 249, 83 (27) | 1.00, 1.00 | 0.00, 0.00 | 0.00 | 1.00 | 0.00 |"


def test_no_sites_are_refused_in_a_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["power", "nowhere", "--sites", "0"])
    with pytest.raises(SystemExit):
        power.main()
    assert "--sites must be at least 1, got 0" in capsys.readouterr().err
