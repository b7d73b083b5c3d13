# SPDX-License-Identifier: Apache-2.0
"""Classes of failure: each failure is in one, whatever else holds of it, and the same few are shown each time."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.boards.cases import (
    FAILURES,
    MOST_CASES,
    OPERATING,
    count_cases,
    find_cases,
    operating_rejector,
    sample_cases,
)
from sasgeo_bench.scoring.contrasts import Contrast
from tests.scoring.test_tables import scores


def row(error_m, **changes):
    """One scored row: a stress at a place without a double; a control at the same site is its `pair_id`'s."""
    table = scores([error_m], **{"alias_index": 0.5, "unknown_share": 0.0, "pair_id": "p", **changes})
    return table.assign(is_right=table["is_present"] & (table["position_error_m"] <= 25.0))


def asked(*rows):
    table = pd.concat(rows, ignore_index=True)
    return table.assign(query_id=[f"q{at}" for at in range(len(table))])


def classes(table, judged=None):
    found = find_cases(table, "m", judged)
    return dict(zip(found["query_id"], found["failure"], strict=True))


CONTROL = row(1.0, role="control", kind="control")


def said(table, accepted):
    return pd.DataFrame({"query_id": table["query_id"], OPERATING: accepted})


def test_a_wrong_answer_on_an_older_map_is_aged_if_its_control_is_right():
    table = asked(CONTROL, row(90.0, changed_share=0.3))
    assert classes(table) == {"q1": "aged"}
    assert classes(asked(CONTROL, row(90.0, changed_share=0.09))) == {"q1": "other"}  # hardly changed
    assert classes(asked(CONTROL, row(90.0, changed_share=0.3, view_cells=96))) == {"q1": "other"}  # of another size
    assert classes(asked(CONTROL, row(90.0, changed_share=0.3, pair_id="elsewhere"))) == {"q1": "other"}


@pytest.mark.parametrize("stress", [{"changed_share": 0.3}, {"unknown_share": 0.4}, {}])
def test_a_matcher_that_fails_the_control_too_has_not_failed_for_the_stress(stress):
    table = asked(row(90.0, role="control"), row(90.0, **stress))
    assert classes(table) == {"q0": "other", "q1": "also without the stress"}
    several = asked(CONTROL, row(np.inf, role="control"), row(90.0, **stress))
    assert classes(several)["q2"] == "also without the stress"


def test_a_wrong_answer_to_a_view_of_which_more_is_unknown_is_occluded_if_its_control_is_right():
    assert classes(asked(CONTROL, row(90.0, unknown_share=0.4))) == {"q1": "occluded"}
    assert classes(asked(CONTROL, row(90.0, unknown_share=0.04))) == {"q1": "other"}
    assert classes(asked(CONTROL, row(np.inf, unknown_share=0.4))) == {"q1": "occluded"}  # no answer


def test_a_wrong_answer_is_aliased_where_the_place_has_a_double_and_it_is_accepted():
    table = asked(row(90.0, alias_index=0.95), row(90.0, alias_index=0.85), row(90.0, suite="alias", alias_index=None))
    assert classes(table) == {"q0": "aliased", "q1": "other", "q2": "aliased"}
    assert classes(table, said(table, [False, True, True]))["q0"] == "other"  # it was not trusted
    assert classes(asked(row(np.inf, alias_index=0.95))) == {"q0": "other"}


def test_a_wrong_answer_where_the_map_holds_the_place_several_times_is_nobodys_fault():
    table = asked(row(90.0, ceiling=0.5, suite="instance-twins", role="control"), row(np.inf, ceiling=0.5))
    assert classes(table) == {"q0": "one of several", "q1": "also without the stress"}
    assert classes(table, said(table, [False, True]))["q0"] == "other"  # it was not trusted


def test_an_answer_of_an_absent_place_is_a_failure_unless_it_is_rejected():
    table = asked(*[row(90.0, is_present=False)] * 2, row(np.inf, is_present=False))
    assert classes(table) == {"q0": "absent accepted", "q1": "absent accepted"}
    assert classes(table, said(table, [True, False, False])) == {"q0": "absent accepted"}


def test_a_right_answer_is_a_failure_only_where_a_threshold_rejects_it():
    table = asked(row(1.0), row(1.0), row(1.0))
    assert classes(table) == {}
    assert classes(table, said(table, [False, True, np.nan])) == {"q0": "right but not accepted"}


def test_what_a_card_excludes_is_no_case():
    table = asked(row(np.inf), row(np.inf, is_present=False))
    assert classes(table.assign(status="not applicable")) == {}
    assert classes(table.assign(status="crash")) == {"q0": "other"}


def test_falsifiers_are_no_cases():
    assert classes(asked(row(90.0, role="falsifier"), row(90.0, role="falsifier", is_present=False))) == {}


def test_what_two_classes_claim_is_in_the_first_of_them():
    table = asked(CONTROL, row(90.0, changed_share=0.3, unknown_share=0.4, alias_index=0.99, suite="alias"))
    assert classes(table) == {"q1": "aged"}


def test_the_operating_rejector_is_that_of_a_contrast_then_the_first_then_the_own_word():
    known, nothing = pd.DataFrame({OPERATING: [True]}), pd.DataFrame({OPERATING: [np.nan]})
    judged = {("m", "own"): known, ("m", "margin"): known, ("m", "fitted"): known, ("n", "own"): nothing}
    contrast = Contrast(name="c", first="m x fitted", second="m x margin", suites=())
    assert operating_rejector(judged, "m", [contrast]) == "fitted"
    assert operating_rejector(judged, "m") == "margin"
    assert operating_rejector({("m", "own"): known, ("m", "margin"): nothing}, "m") == "own"
    assert operating_rejector(judged, "n") is None


cases = st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(FAILURES)), min_size=1, max_size=120)


@given(cases, st.integers(1, 5), st.randoms(use_true_random=False))
def test_a_sample_holds_at_most_so_many_of_each_and_hangs_on_no_order(drawn, each, random):
    table = pd.DataFrame(drawn, columns=["matcher", "failure"])
    table = table.assign(query_id=[f"q{at}" for at in range(len(table))]).sort_values("matcher", kind="stable")
    some = sample_cases(table, each=each)
    assert len(some) <= MOST_CASES
    assert some.groupby(["matcher", "failure"]).size().max() <= each
    wanted = table.groupby(["matcher", "failure"]).size().clip(upper=each)
    if wanted.sum() <= MOST_CASES:
        pd.testing.assert_series_equal(some.groupby(["matcher", "failure"]).size(), wanted)
    shuffled = table.sample(frac=1.0, random_state=random.randrange(1000)).sort_values("matcher", kind="stable")
    assert sample_cases(shuffled, each=each).to_dict() == some.to_dict()


def test_no_class_is_crowded_out_by_another():
    table = pd.DataFrame({"matcher": "m", "failure": ["other"] * 200 + ["aged"] * 2})
    table = table.assign(query_id=[f"q{at}" for at in range(len(table))])
    some = count_cases(sample_cases(table, each=100))
    assert (some["aged"], some["other"]) == (2, MOST_CASES - 2)


@pytest.mark.parametrize("count", [0, 1])
def test_every_class_is_counted_even_where_it_is_empty(count):
    assert count_cases(pd.DataFrame({"failure": ["aged"] * count})) == dict.fromkeys(FAILURES, 0) | {"aged": count}
