# SPDX-License-Identifier: Apache-2.0
"""Power by simulation: what is certain is found certain, equality included, and places of a country may be alike."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.power import ends, likeness, line, outcome, ranked_places, simulated
from sasgeo_bench.tasks.split import find_split_file, read_split_file

CRITICAL = 1.96
UNITS = ("country", "place", "block")
COUNTRIES = [f"country-{at // 2}" for at in range(20)]


def gaps(*values, views=10):
    return [np.full(views, value) for value in values]


@pytest.mark.parametrize(("value", "word"), [(1.0, "shown"), (-1.0, "shown"), (0.0, "equal"), (0.02, "shown")])
def test_what_every_place_says_is_found(value, word):
    assert outcome(gaps(*[value] * 20), COUNTRIES, 0.03, CRITICAL, np.random.default_rng(0)) == word


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
    drawn = [float(gap[0]) for gap in simulated(pilot, COUNTRIES, rng, alike=True)]
    assert drawn[::2] == drawn[1::2]
    apart = [float(gap[0]) for gap in simulated(pilot, COUNTRIES, rng, alike=False)]
    assert apart[::2] != apart[1::2]


def test_likeness_is_one_where_places_alone_differ_and_none_where_views_do():
    assert likeness(gaps(0.0, 1.0, 0.0, 1.0)) == pytest.approx(1.0)
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
