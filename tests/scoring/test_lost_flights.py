# SPDX-License-Identifier: Apache-2.0
"""How far a tracker gets before it is lost, as the program beside the boards counts it."""

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

PROGRAM = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "lost_flights.py"))
WAY_M = np.arange(0.0, 2100.0, 100.0)


def kept(off_m, accepted=None):
    off_m = np.asarray(off_m, dtype=float)
    found = PROGRAM["kept"](WAY_M, off_m, np.ones(len(off_m), dtype=bool) if accepted is None else accepted)
    return found.is_found, found.kept_m, found.is_lost


def test_a_flight_is_followed_from_its_first_right_fix_to_its_end():
    assert kept(np.where(WAY_M < 500, 400.0, 5.0)) == (True, 1500.0, False)


def test_a_flight_that_nobody_finds_is_not_lost():
    assert kept(np.full(len(WAY_M), 30.0)) == (False, 0.0, False)
    assert kept(np.zeros(len(WAY_M)), np.zeros(len(WAY_M), dtype=bool)) == (False, 0.0, False)


@pytest.mark.parametrize(("views", "is_lost"), [(6, False), (7, True)])
def test_more_than_500_m_far_off_is_a_loss_and_the_way_ends_where_it_begins(views, is_lost):
    off_m = np.zeros(len(WAY_M))
    off_m[8 : 8 + views] = 101.0  # 6 views are 500 m, from the first of them to the last
    assert kept(off_m) == (True, 800.0 if is_lost else 2000.0, is_lost)


def test_a_view_without_an_estimate_is_off_and_one_near_enough_is_not():
    off_m = np.full(len(WAY_M), 99.0)
    off_m[0] = 0.0
    assert kept(off_m) == (True, 2000.0, False)
    off_m[5:] = np.inf
    assert kept(off_m) == (True, 500.0, True)


def test_losses_are_counted_over_what_was_flown_and_none_leaves_room_for_three():
    rows = [
        {"matcher": name, "flight": f"f{at}", "place": f"p{at}", "role": "stress", "kind": "F2", "strength": 5.0}
        | {"found": True, "kept_m": 2500.0, "lost": name == "rash" and at < 4}
        for name in ("calm", "rash")
        for at in range(8)
    ]
    calm, rash = PROGRAM["lines"](pd.DataFrame(rows))
    assert calm == "| calm | 5 | 8 | 100 | 20 | 0 | 0.0 | 0 to 15.0 |"
    assert rash.startswith("| rash | 5 | 8 | 100 | 20 | 4 | 20.0 | ")
    low, high = map(float, rash.split("|")[-2].split(" to "))
    assert 0 < low < 20 < high


@pytest.mark.parametrize(
    ("board", "suite", "fault"),
    [
        ("nowhere", "flight-real-age", "nowhere/scores.parquet cannot be read"),
        (
            "docs/results/modules",
            "flight-real-age",
            "no flights of suite 'flight-real-age': it has no suite of flights",
        ),
        ("docs/results/countries", "flight-gap", "no flights of suite 'flight-gap': it has flight-real-age"),
    ],
)
def test_what_holds_no_such_flights_is_reported_in_one_line_before_anything_is_printed(board, suite, fault, capsys):
    folder = Path(__file__).parents[2] / board
    with pytest.raises(SystemExit):
        PROGRAM["main"]([str(folder), "--suite", suite])
    out = capsys.readouterr()
    assert (out.out, fault in out.err) == ("", True)
