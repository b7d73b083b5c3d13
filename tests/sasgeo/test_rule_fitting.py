# SPDX-License-Identifier: Apache-2.0
"""Rules of the graph are the statistics they stand for, with a weak prior; tolerances stay as they are."""

import numpy as np
import pytest

from sasgeo_bench.sasgeo.graph import START, Matching
from sasgeo_bench.sasgeo.nodes import INDEX, NODE_KINDS
from sasgeo_bench.sasgeo.rule_fitting import fit_rules

MANY = 20_000


def matching(count, *, degrees=(0, 0, 0), links=(0, 0, 0)):
    """Buildings of which nine in ten are seen, and three in ten of those seen are not mapped."""
    kinds = np.zeros((4, len(NODE_KINDS)), dtype=np.int64)
    kinds[:, INDEX["building"]] = (count, 0.9 * count, count, 0.3 * count)
    return Matching(degrees=np.array(degrees), links=np.array(links), kinds=kinds)


def test_many_nodes_give_the_shares_they_were_drawn_with_and_tolerances_stay():
    rules = fit_rules([matching(MANY)], [])
    building = INDEX["building"]
    assert (rules.hit[building], rules.extra[building]) == pytest.approx((0.9, 0.3), abs=0.01)
    assert rules.hit[0] == START.hit[0]
    assert (rules.gate_m, rules.place_sigma_m, rules.shift_m) == (START.gate_m, START.place_sigma_m, START.shift_m)


def test_no_node_leaves_the_starting_values_and_an_outcome_never_seen_keeps_its_own():
    assert fit_rules([matching(0)], [matching(0)]) == START
    few = fit_rules([matching(10)], [])
    assert START.hit[INDEX["building"]] < few.hit[INDEX["building"]] < 0.88
    rules = fit_rules([matching(9, degrees=(80, 0, 0))], [matching(9, degrees=(9000, 0, 0))])
    assert rules.degrees[0] == pytest.approx(0.0, abs=0.01)
    assert rules.degrees[1:] == pytest.approx(START.degrees[1:], rel=0.1)


def test_ratios_are_frequencies_at_right_poses_over_those_at_wrong_ones():
    right, wrong = matching(9, degrees=(900, 90, 10), links=(80, 10, 10)), matching(9, degrees=(600, 300, 100))
    rules = fit_rules([right], [wrong])
    assert rules.degrees == pytest.approx(np.log([1.5, 0.3, 0.1]), abs=0.06)
    assert (rules.link, rules.false_link, rules.lost_link) == (START.link, START.false_link, START.lost_link)
