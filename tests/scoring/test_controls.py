# SPDX-License-Identifier: Apache-2.0
"""Verdicts on controls: what must be at chance, perfect or withheld, and that each can fail."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from sasgeo_bench.boards.text import control_lines
from sasgeo_bench.scoring.controls import (
    at_least,
    chances,
    evaluate_controls,
    failed_controls,
    hits,
    reason_implausible,
)
from sasgeo_bench.tasks.query import BLIND, NOISE_FREE, SHUFFLED, TURNED, TWINS


def rows(kind, right, *, track="retrieval", pool=10, **changes):
    """Rows of one kind, one for each of `right`: 1 where right, 0 where wrong, a half where tied."""
    count = len(right)
    right = np.array(right, dtype=float)
    error_m = np.where(right > 0, 3.0, 400.0)
    table = {
        "query_id": [f"{kind}{track}{at}" for at in range(count)],
        "track": track,
        "suite": "controls",
        "prior_group": "rnone-weak-s3" if track == "retrieval" else "r500-weak-s3",
        "pool": pool if track == "retrieval" else 0,
        "kind": kind,
        "status": "ok",
        "is_present": kind != BLIND,
        "is_answered": True,
        "above": np.where(right > 0, 0, 3),
        "tied": np.where(right == 0.5, 2, 1),
        "right": 1,
        "position_error_m": error_m,
        "yaw_error_deg": 0.0,
        "log_scale_error": 0.0,
    }
    return pd.DataFrame(table | changes)


def held(frame, matcher="mine"):
    return {item.control: item for item in evaluate_controls({matcher: frame})}


def test_at_least_is_the_binomial_tail_and_poissons():
    for count in range(8):
        assert at_least(count, np.full(7, 0.3)) == pytest.approx(stats.binom.sf(count - 1, 7, 0.3))
    assert at_least(1, np.array([0.1, 0.5])) == pytest.approx(1 - 0.9 * 0.5)
    assert at_least(0, np.array([0.1])) == 1
    assert at_least(0, np.zeros(0)) == 1


def test_chance_is_that_of_a_guess_among_candidates_or_in_the_disc():
    frame = pd.concat((rows(SHUFFLED, [0, 0], pool=4), rows(SHUFFLED, [0], track="localization")), ignore_index=True)
    assert chances(frame).tolist() == [0.25, 0.25, pytest.approx((25 / 500) ** 2)]
    whole = rows(SHUFFLED, [0], track="localization", prior_group="rnone-weak-s3")
    assert chances(whole).tolist() == [0.0]


def test_hits_count_ties_by_their_chance_whatever_the_order_of_rows():
    frame = pd.concat((rows(TWINS, [1, 0.5, 0]), rows(SHUFFLED, [1, 0], track="localization")), ignore_index=True)
    assert hits(frame).tolist() == [1.0, 0.5, 0.0, 1.0, 0.0]
    assert hits(frame.iloc[::-1]).tolist() == [0.0, 1.0, 0.0, 0.5, 1.0]
    assert len(hits(frame.iloc[:0])) == 0


@pytest.mark.parametrize("kind", [SHUFFLED, TURNED])
def test_a_wrong_map_fails_whoever_finds_the_place_all_the_same(kind):
    (honest,) = held(rows(kind, [1, 0, 0, 0, 0, 0, 0, 0])).values()
    assert honest.holds
    assert honest.found == 1
    assert honest.expected == pytest.approx(0.8)
    (leak,) = held(rows(kind, [1] * 6 + [0] * 2)).values()
    assert not leak.holds
    assert leak.p < 1e-4


def test_twins_fail_whoever_tells_them_apart():
    assert held(rows(TWINS, [1, 0] * 12))["identical twins tie"].holds
    assert held(rows(TWINS, [0.5] * 24))["identical twins tie"].holds
    assert held(rows(TWINS, [0] * 24))["identical twins tie"].holds  # not found at all: nothing to tell
    assert not held(rows(TWINS, [1] * 23 + [0]))["identical twins tie"].holds


def test_a_blind_view_must_be_withheld():
    assert not held(rows(BLIND, [0, 0]))["blind views withheld"].holds
    silent = held(rows(BLIND, [0, 0], is_answered=False))["blind views withheld"]
    assert silent.holds
    assert silent.n == 2


def test_only_the_reference_must_find_views_without_error():
    frame = rows(NOISE_FREE, [1] * 17 + [0] * 3)
    assert held(frame) == {}
    (verdict,) = held(frame, "fft_vote").values()
    assert not verdict.holds
    assert held(rows(NOISE_FREE, [1] * 19 + [0]), "fft_vote")["views without error found, at least"].holds


def test_the_oracle_must_be_perfect_on_every_suite():
    good = pd.concat((rows("U1", [1, 1], suite="occlusion"), rows(BLIND, [0], is_answered=False)), ignore_index=True)
    assert all(item.holds for item in held(good, "oracle_pose").values())
    assert not held(rows("U1", [1, 0], suite="occlusion"), "oracle_pose")["oracle always right"].holds
    assert not held(rows(BLIND, [0]), "oracle_pose")["oracle withholds absent places"].holds
    # Given the truth it finds a place whatever it is shown.
    for name in ("oracle_pose", "oracle_pose 1 (c85212)"):
        assert "shuffled map at chance" not in held(rows(SHUFFLED, [1] * 8), name)
        assert held(rows(SHUFFLED, [1] * 8), name)["oracle always right"].holds


def test_a_matcher_without_rows_or_that_cannot_has_no_verdict():
    assert held(rows(SHUFFLED, [0, 0], status="missing", is_answered=False)) == {}
    assert held(rows(BLIND, [0, 0], status="not applicable", is_answered=False)) == {}
    crashed = rows(SHUFFLED, [0, 0], status="crash", is_answered=False)
    assert held(crashed)["shuffled map at chance"].n == 2


def test_what_is_no_control_has_no_verdict():
    assert held(rows(SHUFFLED, [1] * 20, suite="clean")) == {}


def test_lines_say_what_failed_first():
    verdicts = evaluate_controls({"random": rows(SHUFFLED, [1] * 8), "other": rows(SHUFFLED, [0] * 8)})
    assert [item.holds for item in verdicts] == [False, True]
    first, second = control_lines(verdicts)
    assert first == "CONTROLS FAILED, 1 of 2: do not trust this board."
    assert second.startswith("shuffled map at chance: FAILED by random, 8 of 8 where 0.8 are expected (p 1e-08)")
    assert control_lines(verdicts[1:]) == ["Controls: all 1 held."]
    assert "none were drawn" in control_lines([])[0]


def test_a_rival_that_fails_a_control_spoils_its_own_rows_alone():
    verdicts = evaluate_controls(
        {
            "mine": rows(SHUFFLED, [1] * 8),
            "yours 2 (ab12cd)": rows(BLIND, [0] * 4),
            "fft_vote": rows(SHUFFLED, [0] * 8),
        }
    )
    first, *rest = control_lines(verdicts)
    assert first == (
        "Controls: 1 of 3 held. Do not trust the rows of yours 2 (ab12cd), mine; if these share no code, the queries "
        "may reveal the truth:"
    )
    assert [line.partition(":")[0] for line in rest] == ["blind views withheld", "shuffled map at chance"]
    assert control_lines([item for item in verdicts if item.matcher != "mine"])[0] == (
        "Controls: 1 of 2 held. Do not trust the rows of yours 2 (ab12cd):"
    )
    assert [item.control for item in failed_controls(verdicts, "mine")] == ["shuffled map at chance"]
    assert failed_controls(verdicts, "fft_vote") == ()
    # To answer a view that shows nothing is unwise; to find the place on a shuffled map is to know it from elsewhere.
    assert reason_implausible(verdicts, "mine") == (
        'right 8 of 8 times at the control "shuffled map at chance", where guessing is right 0.8 times'
    )
    assert reason_implausible(verdicts, "yours 2 (ab12cd)") is None
