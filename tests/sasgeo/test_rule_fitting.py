# SPDX-License-Identifier: Apache-2.0
"""Rules of the graph are the statistics they stand for, with a weak prior."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.sasgeo.graph import START, Matching
from sasgeo_bench.sasgeo.nodes import INDEX, NODE_KINDS
from sasgeo_bench.sasgeo.rule_fitting import broadened, fit_rules

MANY = 20_000


def matching(count, *, seed=0, sigma_m=3.0, degrees=(0, 0, 0), links=(0, 0, 0)):
    """Nodes that are off by so much, and neighbours whose relative place has an error of 1 m and a tenth."""
    rng = np.random.default_rng(seed)
    length_m = rng.uniform(10, 80, count)
    error_m = np.hypot(*(rng.normal(size=(2, count)) * np.hypot(1.0, 0.1 * length_m)))
    kinds = np.zeros((4, len(NODE_KINDS)), dtype=np.int64)
    kinds[:, INDEX["building"]] = (count, 0.9 * count, count, 0.3 * count)
    mapped = rng.normal(4.0, 0.5, count)
    return Matching(
        offset_m=rng.normal(0, sigma_m, (count, 2)),
        common_m=rng.uniform(0, 10, count),
        arms_deg=np.abs(rng.normal(0, 5.0, count)),
        degrees=np.array(degrees),
        areas=np.column_stack((mapped + rng.normal(0, 0.1, count), mapped)),
        edges=np.column_stack((length_m, error_m)),
        links=np.array(links),
        kinds=kinds,
    )


def test_many_nodes_give_the_numbers_they_were_drawn_with():
    rules = fit_rules([matching(MANY)], [])
    assert rules.place_sigma_m == pytest.approx(3.0, rel=0.03)
    assert rules.gate_m == pytest.approx(3.0 * np.sqrt(-2 * np.log(0.05)), rel=0.03)
    assert rules.shift_m == pytest.approx(9.5, rel=0.03)
    assert rules.arm_sigma_deg == pytest.approx(5.0, rel=0.03)
    assert (rules.area_sigma, rules.area_spread) == pytest.approx((0.1, 0.5), rel=0.03)
    assert rules.edge_strain == pytest.approx(0.1, rel=0.05)
    assert rules.edge_sigma_m == pytest.approx(1.0, abs=0.5)
    assert rules.wander < 0.02  # beyond three standard deviations: 0.011 of a normal
    building = INDEX["building"]
    assert (rules.hit[building], rules.extra[building]) == pytest.approx((0.9, 0.3), abs=0.01)
    assert rules.hit[0] == START.hit[0]


def test_no_node_leaves_the_starting_values_and_a_few_stay_near_them():
    assert fit_rules([matching(0)], [matching(0)]) == START
    few = fit_rules([matching(3, sigma_m=0.5)], [])
    assert 3.0 < few.place_sigma_m < START.place_sigma_m


def test_ratios_are_frequencies_at_right_poses_over_those_at_wrong_ones():
    right, wrong = matching(9, degrees=(900, 90, 10), links=(80, 10, 10)), matching(9, degrees=(600, 300, 100))
    rules = fit_rules([right], [wrong])
    assert rules.degrees == pytest.approx(np.log([1.5, 0.3, 0.1]), abs=0.06)
    assert (rules.link, rules.false_link, rules.lost_link) == (START.link, START.false_link, START.lost_link)


def test_an_outcome_that_was_never_seen_keeps_its_starting_value_however_many_others_were():
    rules = fit_rules([matching(9, degrees=(80, 0, 0))], [matching(9, degrees=(9000, 0, 0))])
    assert rules.degrees[0] == pytest.approx(0.0, abs=0.01)
    assert rules.degrees[1:] == pytest.approx(START.degrees[1:], rel=0.1)


def test_assignments_are_no_narrower_in_the_second_round():
    strict = replace(START, gate_m=2.0, place_sigma_m=0.5)
    assert broadened(strict).gate_m == broadened(START).gate_m == 2 * START.gate_m
    assert broadened(strict).degrees == (0.0, 0.0, 0.0)
