# SPDX-License-Identifier: Apache-2.0
"""The table of metrics: each row computes what it is named after, and says what a reader needs."""

import math

import numpy as np
import pytest

from sasgeo_bench.scoring.decisions import Fixes, augrc, aurc, excess_aurc
from sasgeo_bench.scoring.metric import MeanMetric
from sasgeo_bench.scoring.metrics import METRICS, REJECTION, means_of, primary_of, quantiles_of, within_metric
from sasgeo_bench.tasks.query import TRUTH_SIGMA
from tests.scoring.test_tables import scores

SOME = Fixes(confidence=[0.9, 0.8, 0.1, 0.0], is_answered=[1] * 4, is_right=[1, 0, 1, 1], is_present=[1] * 4)


def test_every_metric_has_a_name_of_its_own_a_meaning_and_a_source():
    assert len({metric.name for metric in METRICS}) == len(METRICS) > 30
    for metric in METRICS:
        assert metric.bounds[0] < metric.bounds[1]
        assert metric.source
        assert metric.meaning
        assert not metric.meaning.endswith(".")
        assert metric.worst == metric.bounds[metric.better == "lower"]


@pytest.mark.parametrize("track", ["localization", "retrieval"])
def test_each_track_has_one_primary_metric(track):
    assert [metric for metric in means_of(track) if metric.is_primary] == [primary_of(track)]


def test_means_compute_what_they_are_named_after():
    table = scores([1.0, 7.0, 20.0, math.inf])
    found = {metric.name: float(metric.values(table).mean()) for metric in means_of("localization")}
    assert [found[f"success_{name}m"] for name in (5, 10, 25)] == [0.25, 0.5, 0.75]
    assert found["within_25m"] == 0.75
    assert found["success_auc_50m"] == pytest.approx((0.98 + 0.86 + 0.6) / 4)
    assert all(isinstance(metric, MeanMetric) for metric in means_of("retrieval"))


def test_places_and_headings_are_also_counted_by_themselves_and_an_answer_that_is_missing_is_beyond():
    errors_deg = [180.0, 5.0, 0.0, 5.1, math.inf]
    table = scores([5.0, 7.0, 20.0, 4.0, math.inf]).assign(yaw_error_deg=errors_deg)
    found = {metric.name: metric.values(table).tolist() for metric in means_of("localization")}
    assert found["within_5m"] == [1.0, 0.0, 0.0, 1.0, 0.0]
    assert found["within_10m"] == [1.0, 1.0, 0.0, 1.0, 0.0]
    assert found["within_5deg"] == [0.0, 1.0, 1.0, 0.0, 0.0]
    assert found["within_25m"] == [1.0, 1.0, 1.0, 1.0, 0.0]
    both = within_metric(10.0, 5.0)
    assert (both.name, both.values(table).tolist()) == ("success_10m", found["success_10m"])


def test_success_is_not_scored_within_less_than_two_deviations_of_the_truth():
    table = scores([1.0, 7.0, 20.0]).assign(strength=[2.0, 5.0, 2.0], strength_unit=["views", TRUTH_SIGMA, TRUTH_SIGMA])
    counts = {metric.name: metric.counts(table).tolist() for metric in means_of("localization")}
    assert counts["success_25m"] == counts["success_10m"] == [True, True, True]  # 10 m are two of 5 m
    assert counts["success_5m"] == counts["within_5m"] == [True, False, True]
    assert counts["within_5deg"] == [True, True, True]
    table = table.assign(strength=[2.0, 20.0, 5.1])
    counts = {metric.name: metric.counts(table).tolist() for metric in means_of("localization")}
    assert (counts["success_25m"], counts["success_10m"]) == ([True, False, True], [True, False, False])
    assert (counts["within_25m"], counts["answered"]) == ([True, False, True], [True, True, True])


def test_quantiles_name_their_share():
    for metric in quantiles_of("localization"):
        assert metric.name.rpartition("_")[2] == ("median" if metric.share == 0.5 else f"p{100 * metric.share:g}")
    assert {metric.share for metric in quantiles_of("sequence")} == {0.5}
    assert quantiles_of("retrieval") == ()


def test_rejection_metrics_compute_what_they_are_named_after():
    found = {metric.name: metric.compute(SOME, weights=np.ones(4)) for metric in REJECTION}
    assert found["aurc"] == aurc(SOME)
    assert found["e_aurc"] == excess_aurc(SOME)
    assert found["augrc"] == augrc(SOME)
    assert found["false_fix_at_coverage_0.5"] == 0.5
    assert found["false_fix_at_coverage_0.8"] == pytest.approx(1 / 3.2)
    assert found["brier"] == pytest.approx((0.01 + 0.64 + 0.81 + 1.0) / 4)
    assert (found["cost_20"], found["cost_20_place"]) == (0.75, 1.0)  # none is sure enough to be accepted
