# SPDX-License-Identifier: Apache-2.0
"""Falsifiers: where the stress is taken away the arms of a contrast should not differ, and if they do it is told."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards.board_tables import falsifier_table
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.scoring.contrasts import Contrast, mean_finding
from sasgeo_bench.scoring.controls import FALSIFIER_SCHEMA, evaluate_falsifiers
from tests.scoring.test_tables import scores

CONTRAST = Contrast(name="graph", first="with", second="without", suites=("occlusion",), kinds=("U2",))
COUNT = 600


def right(share, seed=1):
    """Errors of which a share is right."""
    return np.where(np.random.default_rng(seed).random(COUNT) < share, 1.0, 99.0)


def table(errors, *, roles, kinds, blocks=60, **columns):
    return scores(errors, blocks=blocks).assign(role=roles, kind=kinds, **columns)


ROLES = np.array(["stress", "control", "falsifier"])[np.arange(COUNT) % 3]
KINDS = np.where(ROLES == "stress", "U2 30 %", np.where(ROLES == "control", "control", "none"))


def held(first, second, **columns):
    tables = {
        name: table(errors, roles=ROLES, kinds=KINDS, **columns)
        for name, errors in (("with", first), ("without", second))
    }
    return evaluate_falsifiers([CONTRAST], tables, draws=400)


def test_a_gain_under_stress_alone_is_none_without_it():
    worse = right(0.5)
    better = np.where(ROLES == "stress", 1.0, worse)
    found = held(better, worse)
    assert [(item.suite, item.kind) for item in found] == [
        ("all", "all"),
        ("occlusion", "control"),
        ("occlusion", "none"),
    ]
    assert {item.verdict for item in found} == {"no gain shown"}
    assert [item.finding.n for item in found] == [400, 200, 200]


def test_a_gain_without_the_stress_is_told():
    worse = right(0.5)
    better = np.where(KINDS == "none", 1.0, worse)
    found = {item.kind: item for item in held(better, worse)}
    assert found["none"].verdict == "GAIN without the stress"
    assert found["none"].finding.difference == pytest.approx((worse[KINDS == "none"] > 25).mean())
    assert found["control"].verdict == "no gain shown"
    lost = {item.kind: item for item in held(worse, better)}
    assert lost["none"].verdict == "loss without the stress"


def test_what_is_told_of_them_is_what_a_contrast_on_the_same_rows_would_tell():
    worse = right(0.5)
    better = np.where(KINDS == "none", 1.0, worse)
    both = [table(errors, roles=ROLES, kinds=KINDS) for errors in (better, worse)]
    for item in held(better, worse)[1:]:
        tested = mean_finding(CONTRAST, *(rows[rows["kind"] == item.kind] for rows in both), 400)
        assert np.isfinite(tested.p_places)
        told, expected = (FALSIFIER_SCHEMA.frame([replace(item, finding=one)]) for one in (item.finding, tested))
        pd.testing.assert_frame_equal(told, expected, check_exact=True)
        assert item.finding.countries == tested.countries


def test_views_that_are_all_unknown_and_absent_places_do_not_count():
    unknown = np.where(KINDS == "none", 1.0, 0.2)
    found = held(right(0.5), right(0.5), unknown_share=unknown)
    assert [item.kind for item in found] == ["control"]
    absent = held(right(0.5), right(0.5), is_present=KINDS != "control")
    assert [item.kind for item in absent] == ["none"]


def test_few_places_decide_nothing():
    found = held(np.ones(COUNT), np.full(COUNT, 99.0), blocks=5)
    assert {item.verdict for item in found} == {"not decided: 5 places"}


def test_a_contrast_by_risk_has_none_and_an_unknown_arm_is_refused():
    risk = Contrast(name="rejection", first="a x b", second="a x c", suites=("alias",), metric="aurc")
    assert evaluate_falsifiers([risk], {}) == ()
    with pytest.raises(ConfigError, match="names 'with', which is not on the board"):
        evaluate_falsifiers([CONTRAST], {})


def test_both_tables_have_a_row_for_each():
    found = held(right(0.5), right(0.5))
    assert len(FALSIFIER_SCHEMA.frame(found)) == len(falsifier_table(found).rows) == 3
