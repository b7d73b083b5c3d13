# SPDX-License-Identifier: Apache-2.0
"""The door of rejectors: what is no rejector, and what is no probability, is refused in one line."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.matching.matcher import Prediction, Rejector, RejectorCard, check_p_false
from sasgeo_bench.matching.plugins import load_rejector

SAID = {"name": "half", "version": "1", "title": "Half", "source": "original", "ours": "all", "licence": "MIT"}
BAD_LINES = ("two\nlines", "\x1b[31mred", "x" * 4001)


class Half:
    """Says one half of everything."""

    card = RejectorCard(**SAID)

    def fit(self, predictions, is_false):
        assert len(predictions) == len(is_false)

    def p_false(self, predictions):
        return np.full(len(predictions), 0.5)


class NoVerbs:
    card = RejectorCard(**SAID)


class NoCard:
    card = None

    def fit(self, predictions, is_false): ...

    def p_false(self, predictions): ...


class Raises:
    def __init__(self):
        raise ValueError("first line\nsecond line")


def test_a_rejector_is_found_by_module_and_class_and_an_unknown_name_says_where_the_names_are():
    rejector = load_rejector(f"{__name__}:Half")
    assert isinstance(rejector, Rejector)
    rejector.fit([Prediction(query_id="a")], np.array([True]))
    assert check_p_false(rejector.p_false([Prediction(query_id="a")]), 1).tolist() == [0.5]
    with pytest.raises(MatchError, match=r"there is no rejector 'halv'.*list rejectors shows all"):
        load_rejector("halv")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("NoVerbs", "NoVerbs is not a rejector, it has no fit and no p_false"),
        ("NoCard", "card is a NoneType, expected a sasgeo_bench.matching.matcher.RejectorCard"),
        ("Raises", "cannot be made .*ValueError: first line second line"),
        ("Missing", "cannot be imported"),
    ],
)
def test_what_is_no_rejector_is_refused(name, words):
    with pytest.raises(MatchError, match=words):
        load_rejector(f"{__name__}:{name}")


@pytest.mark.parametrize(
    ("field", "value"),
    [("licence", " "), ("source", ""), ("name", "Half"), ("name", "a b"), *(("title", one) for one in BAD_LINES)],
)
def test_a_card_that_does_not_say_enough_in_printable_lines_is_refused(field, value):
    with pytest.raises(MatchError, match=f"card: {field}"):
        RejectorCard(**(SAID | {field: value}))


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ([0.5], r"shape \(1,\), expected \(2,\)"),
        ([[0.5, 0.5]], r"shape \(1, 2\), expected \(2,\)"),
        ([0.5, 1.5], "1.5 in place 1, expected 0..1"),
        ([-0.1, 0.5], "-0.1 in place 0"),
        ([0.5, float("nan")], "nan in place 1"),
        (None, "returned NoneType, expected 2 numbers"),
        (0.5, r"shape \(\), expected \(2,\)"),
        (["0.5", "0.5"], "returned list, expected 2 numbers"),
        ([0, 10**400], "returned list, expected 2 numbers"),
        (["a", "b"], "returned list, expected 2 numbers"),
    ],
)
def test_what_is_no_probability_is_refused_with_found_and_expected(found, words):
    with pytest.raises(MatchError, match=words):
        check_p_false(found, 2)
