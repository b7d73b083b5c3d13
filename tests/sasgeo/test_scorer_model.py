# SPDX-License-Identifier: Apache-2.0
"""What was learnt goes to text and back; what no class can have is refused in a line."""

import json

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.sasgeo.joint import Blend
from sasgeo_bench.sasgeo.rates import FAR, hand_rates
from sasgeo_bench.sasgeo.scorer_model import ScorerModel


def learnt(**changes):
    record = json.loads(ScorerModel.by_hand(["railway", "water"]).to_text())
    for name, value in changes.items():
        record["classes"]["water"][name] = value
    return json.dumps(record)


def drawn(**changes):
    record = json.loads(ScorerModel.by_hand(["water"]).to_text())
    record["graph"].update(changes)
    return json.dumps(record)


def test_text_keeps_six_digits_and_comes_back_with_the_rules_of_the_graph():
    text = learnt(temper=0.00123456789, vanish_per_year=1 / 3)
    first = ScorerModel.from_text(text)
    again = ScorerModel.from_text(first.to_text())
    assert again == first
    assert first.scaling.tolist() == [0.01, 0.00123456789]
    assert again.rates[1].vanish_per_year == pytest.approx(1 / 3, rel=1e-5)
    given = ScorerModel.from_text(drawn(gate_m=7.5, degrees=[0.1, -0.2, -0.3]))
    assert (given.rules.gate_m, given.rules.degrees) == (7.5, (0.1, -0.2, -0.3))
    assert ScorerModel.from_text(given.to_text()).rules == given.rules
    assert given.of_classes(["railway"]).rules == given.rules


def test_classes_are_put_in_the_order_of_a_map_and_unknown_ones_are_by_hand():
    given = ScorerModel.from_text(learnt(temper=0.5))
    mine = given.of_classes(["building", "water"])
    assert mine.classes == ("building", "water")
    assert mine.scaling.tolist() == [0.01, 0.5]
    assert mine.rates[0] == hand_rates("building")
    assert mine.likeness.shape == (2, FAR + 1)
    assert mine.blend == Blend()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "cannot be read"),
        ("[]", "cannot be read"),
        ('{"version": 3}', "'classes'"),
        ('{"version": 1, "classes": {}}', "version 1, this program reads 3"),
        (drawn(gate_m=-1.0), "gate_m of the graph is out of range"),
        (drawn(wander=1.0), "wander of the graph is out of range"),
        (drawn(degrees=[0.0]), "ratios of degrees"),
        (drawn(hit={}), "cannot be read"),
        (drawn(colour="red"), "cannot be read"),
        (learnt(temper=-1.0), "negative or not finite"),
        (learnt(temper=float("nan")), "negative or not finite"),
        (learnt(likeness=[1.0, 2.0, 0.0, 0.0, 0.0]), "within 0..1"),
        (learnt(likeness=[1.0]), "cannot be read"),
        (learnt(seasons=[1.0]), "cannot be read"),
        (learnt(seasons=[1.0, 1.0, 1.0, 2.0]), "a season is not within 0..1"),
        (learnt(hit=1.5), "hit is a share"),
        (learnt(vanish_per_year=-0.1), "vanish_per_year is a rate"),
        (learnt(colour="red"), "cannot be read"),
    ],
)
def test_text_that_says_no_such_thing_is_refused_in_a_line(text, fault):
    with pytest.raises(ConfigError, match=fault) as caught:
        ScorerModel.from_text(text)
    assert "\n" not in str(caught.value)


def test_equal_by_what_is_said():
    one, same = ScorerModel.by_hand(["water"]), ScorerModel.by_hand(["water"])
    assert one == same
    assert hash(one) == hash(same)
    assert one != ScorerModel.by_hand(["railway"])
    assert one != "water"
    assert np.isfinite(one.scaling).all()
