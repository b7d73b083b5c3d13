# SPDX-License-Identifier: Apache-2.0
"""Evidence of an answer: worked by hand, the same whatever the order of rivals and classes, and none made up."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.core.texts import MOST_DIAGNOSTICS
from sasgeo_bench.sasgeo.conformal import PROTECTION, levels_of
from sasgeo_bench.sasgeo.integrity import EVIDENCE, EVIDENCE_NAMES, evidence_of
from sasgeo_bench.search.plan import Null
from tests.sasgeo.simulated import modes_of

OF_MODES = ("margin_nats", "posterior_entropy_nats", "modes_above", "spread_m", "class_agreement")


def drawn(seed, count=5):
    rng = np.random.default_rng(seed)
    by_class = rng.normal(0, 2, (count, 3))
    return rng.uniform(0, 300, (count, 2)), by_class[np.argsort(-by_class.sum(axis=1))]


def test_names_are_said_once_fit_into_an_answer_and_others_are_refused():
    names = [item.name for item in (*EVIDENCE, *PROTECTION)]
    assert len(set(names)) == len(names) < MOST_DIAGNOSTICS
    assert all(item.meaning and item.unit for item in (*EVIDENCE, *PROTECTION))
    with pytest.raises(ShapeError, match="'margin' is no evidence that a matcher supplies"):
        evidence_of(modes_of([[0, 0]], [[1.0]]), margin=2.0)


def test_evidence_by_hand():
    # The second mode lies 20 m from the first and is the same answer; the third is the rival.
    modes = modes_of([[0, 0], [20, 0], [300, 400]], [[4, 1], [3, 1.5], [1, 2]])
    found = evidence_of(modes, null=Null(best=9.0, mean=3.0, deviation=2.0, places=50), map_age_years=4.0)
    mass = np.exp([5, 4.5, 3, 0])
    mass /= mass.sum()
    assert tuple(found) == tuple(name for name in EVIDENCE_NAMES if name in {*OF_MODES, "null_z", "map_age_years"})
    assert found["margin_nats"] == pytest.approx(2.0)
    assert found["posterior_entropy_nats"] == pytest.approx(-(mass * np.log(mass)).sum())
    assert found["modes_above"] == 2.0
    assert found["class_agreement"] == pytest.approx(3 / 4)  # the first class says +3, the second -1
    assert found["null_z"] == 3.0
    assert found["map_age_years"] == 4.0
    weights = mass[:3] / mass[:3].sum()
    middle = weights @ modes.positions_m
    assert found["spread_m"] == pytest.approx(math.sqrt(weights @ ((modes.positions_m - middle) ** 2).sum(axis=1)))


def test_a_mode_alone_is_held_against_none_being_right_and_what_is_not_known_is_left_out():
    found = evidence_of(modes_of([[5, 5]], [[3, -1]], none_nats=0.5))
    assert found["margin_nats"] == 1.5
    assert found["modes_above"] == 1.0
    assert found["spread_m"] == 0.0
    assert found["class_agreement"] == 0.75
    flat = Null(best=1.0, mean=1.0, deviation=0.0, places=1)
    found = evidence_of(modes_of([[0, 0]], [[0, 0]]), null=flat, unknown_share=None, map_age_years=math.nan)
    assert set(found) == set(OF_MODES) - {"class_agreement"}


@given(seed=st.integers(0, 50), order=st.permutations([1, 2, 3, 4]), classes=st.permutations([0, 1, 2]))
def test_evidence_and_levels_know_no_order_of_rivals_or_classes_and_no_place(seed, order, classes):
    positions_m, by_class = drawn(seed)
    at = [0, *order]
    first = modes_of(positions_m, by_class)
    other = modes_of(positions_m[at] + 5e6, by_class[at][:, classes])
    assert evidence_of(other) == pytest.approx(evidence_of(first), rel=1e-6, abs=1e-6)
    assert levels_of(other) == pytest.approx(levels_of(first), rel=1e-6)


@given(seed=st.integers(0, 50), more=st.floats(0.1, 20))
def test_a_larger_lead_is_a_larger_margin_and_no_more_entropy(seed, more):
    positions_m, by_class = drawn(seed)
    by_class[:, 0] -= by_class.sum(axis=1)[0]  # the chosen mode has score 0, as none of them being right
    led = by_class.copy()
    led[0, 0] += more
    less, larger = (evidence_of(modes_of(positions_m, one)) for one in (by_class, led))
    assert larger["margin_nats"] == pytest.approx(less["margin_nats"] + more)
    assert larger["posterior_entropy_nats"] <= less["posterior_entropy_nats"] + 1e-9
    assert larger["modes_above"] <= less["modes_above"]


@pytest.mark.parametrize(
    ("positions_m", "by_class", "changes", "words"),
    [
        (np.zeros((0, 2)), np.zeros((0, 3)), {}, "at least one mode"),
        ([[0, 0]], [[1.0], [2.0]], {}, r"by_class \(2, 1\)"),
        ([[0, 0, 0]], [[1.0]], {}, r"shape \(1, 3\)"),
        ([[0, 0]], [[math.nan]], {}, "not finite"),
        ([[0, 0]], [[1.0]], {"sigma_m": 0.0}, "sigma_m 0.0"),
    ],
)
def test_what_is_no_list_of_modes_is_refused(positions_m, by_class, changes, words):
    with pytest.raises(ShapeError, match=words):
        modes_of(positions_m, by_class, **changes)
