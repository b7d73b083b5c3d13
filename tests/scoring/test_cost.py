# SPDX-License-Identifier: Apache-2.0
"""Costs: a time-out is not fast, what a run does not say is not zero, and all that was sent is paid for."""

import math

import numpy as np
import pytest

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.scoring.cost import Costs, latency_quantile, map_kb_per_km2, per_fix
from sasgeo_bench.scoring.tables import cost_figures
from tests.scoring.test_tables import scores

RUNS = (
    RunManifest(region="vaduz", map_bytes=2_000_000, index_bytes=1_000_000, cpu_s=6.0),
    RunManifest(region="vaduz", map_bytes=2_000_000, index_bytes=1_000_000, cpu_s=2.0),  # another suite
    RunManifest(region="monaco", map_bytes=1_000_000, index_bytes=None, cpu_s=0.0),
    RunManifest(region="elsewhere", map_bytes=9_000_000, cpu_s=0.0),  # of an area that is not known
)


def costs_of(runs=RUNS, table=None, **more):
    table = scores([1.0, 99.0, math.inf, 1.0, math.inf]) if table is None else table
    values = {"view_bytes": dict.fromkeys(table["query_id"], 1000), "area_km2": {"vaduz": 10.0, "monaco": 2.5}, **more}
    return Costs(scores=table, runs=runs, **values)


def costs(runs=RUNS, table=None):
    return cost_figures("mine", costs_of(runs, table)).set_index("metric")["value"]


def timed(latency_s, status):
    return costs_of(table=scores([1.0] * len(status)).assign(latency_s=latency_s, status=status))


def test_a_timeout_is_slower_than_every_answer_and_a_crash_was_not_timed():
    some = timed([0.3, 0.1, 0.2, math.nan, math.nan], ["ok", "ok", "ok", "timeout", "crash"])
    assert latency_quantile(some, 0.5) == 0.2
    assert latency_quantile(some, 0.75) == 0.3
    assert latency_quantile(some, 0.95) == math.inf
    assert math.isnan(latency_quantile(timed([math.nan], ["crash"]), 0.5))


def test_a_run_without_a_figure_has_no_cost():
    cost = costs([RunManifest(prepare_s=1.5, peak_bytes=250_000_000, index_bytes=None, map_bytes=4_000_000)])
    assert cost[["prepare", "peak_memory", "map"]].tolist() == [1.5, 250.0, 4.0]
    assert cost[["index", "cpu_per_fix"]].isna().all()
    for wrong in ("fast", True, -1.0, math.nan):
        with pytest.raises(ValueError, match="prepare_s of a run is"):
            RunManifest(prepare_s=wrong)


def test_a_fix_pays_for_the_queries_without_one():
    assert per_fix(1000.0, 4) == 250.0
    assert per_fix(1000.0, 0) == math.inf
    assert math.isnan(per_fix(0.0, 0))
    assert math.isnan(per_fix(math.nan, 3))
    with pytest.raises(MetricError, match="not negative"):
        per_fix(1.0, -1)


def test_storage_is_that_of_maps_and_what_was_added_over_their_area():
    assert costs()["map_per_km2"] == pytest.approx((3000 + 1000) / 12.5)
    assert math.isnan(costs(RUNS[3:])["map_per_km2"])
    assert math.isnan(map_kb_per_km2(costs_of(area_km2={"vaduz": 0.0})))


def test_a_fix_pays_for_what_was_sent_in_vain():
    assert costs()["observation_per_fix"] == pytest.approx(5 / 3)
    assert costs()["cpu_per_fix"] == pytest.approx(8 / 3)
    assert costs(table=scores([math.inf]))["observation_per_fix"] == math.inf


def test_what_a_matcher_cannot_was_not_sent_to_it():
    table = scores([1.0, math.inf], status=["ok", "not applicable"])
    assert costs(table=table)["observation_per_fix"] == 1.0


def test_a_file_of_predictions_has_only_the_cost_of_what_was_sent():
    found = costs(runs=())
    assert found["observation_per_fix"] == pytest.approx(5 / 3)
    assert found[["prepare", "peak_memory", "map", "map_per_km2", "cpu_per_fix"]].isna().all()


def test_latencies_are_of_a_track_and_all_else_of_the_matcher():
    table = scores([1.0]).assign(latency_s=np.array([0.5]))
    rows = cost_figures("mine", costs_of(table=table)).set_index("metric")["track"].to_dict()
    assert {name for name, track in rows.items() if track != "all"} == {"latency_p50", "latency_p95"}
