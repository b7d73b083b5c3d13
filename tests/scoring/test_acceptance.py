# SPDX-License-Identifier: Apache-2.0
"""What Eq. 14 accepts, by the kind of absence: shares by hand, declared shares of absent places, and who has no row."""

import numpy as np
import pytest

from sasgeo_bench.boards.board_tables import acceptance_tables
from sasgeo_bench.scoring.decisions import COST_RATIOS
from sasgeo_bench.scoring.rejection import acceptance_frame
from tests.scoring.test_tables import scores

PRESENT, ABSENT = 120, 80


def judged(**changes):
    """Half of 80 absent places are "wrong place", half "removed"; of 120 present ones every third fix is false.

    Chances: 0.99 for the right fixes and for every fourth "wrong place", 0.9 for the rest.
    """
    at = np.arange(PRESENT + ABSENT)
    is_present = at < PRESENT
    is_right = is_present & (at % 3 > 0)
    is_wrong = ~is_present & (at % 2 == 0)
    sure = np.where(is_right | (is_wrong & (at % 4 == 0)), 0.99, 0.9)
    table = scores(
        np.where(is_right, 1.0, 99.0),
        blocks=20,
        suite=np.where(is_present, "clean", "absent"),
        kind=np.where(is_present, "control", np.where(is_wrong, "wrong place", "removed")),
        is_present=is_present,
    )
    # Where one place in ten is absent, all fixes are surer; at the other shares nothing is known.
    columns = {"p_right": sure, "p_right_present 0.9": np.where(sure == 0.9, 0.97, 0.99)}
    nothing = {f"p_right_present {share}": np.nan for share in (0.7, 0.5)}
    return table.assign(**columns, **nothing, **changes)


def one(frame, **keys):
    for name, value in keys.items():
        frame = frame[frame[name] == value]
    assert len(frame) == 1
    return frame.iloc[0]


def test_shares_are_those_counted_by_hand():
    found = acceptance_frame("mine", "sure", judged())
    assert set(found["absence"]) == {"all", "absent: removed", "absent: wrong place"}
    assert set(found["mixture"]) == {"as drawn", "present 0.9"}
    assert set(found["cost_ratio"]) == set(COST_RATIOS)
    row = one(found, absence="all", mixture="as drawn", cost_ratio=20.0)  # 0.99 alone: P(false) below 1 / 21
    right, wrong = 80, 20
    assert (row["n"], row["absent"], row["places"]) == (200, 80, 20)
    assert row["coverage"] == pytest.approx((right + wrong) / 200)
    assert row["risk"] == pytest.approx(wrong / (right + wrong))
    assert row["right_present"] == pytest.approx(right / PRESENT)
    assert row["absent_accepted"] == pytest.approx(wrong / ABSENT)
    assert row["risk_lo"] < row["risk"] < row["risk_hi"]


def test_each_kind_of_absence_is_mixed_with_all_present_places():
    found = acceptance_frame("mine", "sure", judged())
    removed = one(found, absence="absent: removed", mixture="as drawn", cost_ratio=20.0)
    assert (removed["n"], removed["absent"], removed["risk"], removed["absent_accepted"]) == (160, 40, 0.0, 0.0)
    wrong = one(found, absence="absent: wrong place", mixture="as drawn", cost_ratio=20.0)
    assert wrong["absent_accepted"] == 0.5
    assert wrong["risk"] == pytest.approx(20 / 100)


def test_a_declared_share_has_its_chances_and_its_weights():
    found = acceptance_frame("mine", "sure", judged())
    row = one(found, absence="all", mixture="present 0.9", cost_ratio=20.0)
    assert row["coverage"] == pytest.approx(1.0)  # 0.97 is sure enough, too
    assert row["risk"] == pytest.approx(0.9 / 3 + 0.1)
    strict = one(found, absence="all", mixture="present 0.9", cost_ratio=100.0)  # 1 / 101: none is
    assert strict["coverage"] == 0.0
    assert np.isnan(strict["risk"])


def test_without_absent_or_present_places_there_is_no_row():
    table = judged()
    present = table["is_present"].to_numpy(bool)
    for some in (table[present], table[~present], table[:0]):
        assert acceptance_frame("mine", "sure", some).empty
    assert not list(acceptance_tables(acceptance_frame("mine", "sure", table[:0])))


def test_the_table_shows_one_cost_and_no_control():
    found = acceptance_frame("mine", "sure", judged())
    (table,) = acceptance_tables(found)
    assert [row.cells[2].text for row in table.rows] == ["absent: removed", "absent: wrong place", "all"]
    assert [column.name for column in table.columns][-4:] == [
        *("risk, 30 % absent", "coverage, 30 % absent"),
        *("risk, 50 % absent", "coverage, 50 % absent"),
    ]
    assert table.rows[-1].cells[4].text.startswith("0.200")
    assert table.rows[-1].cells[-1].text == "-"
    assert not list(acceptance_tables(found.assign(matcher="random")))
