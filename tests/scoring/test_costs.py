# SPDX-License-Identifier: Apache-2.0
"""Costs on a board: each map counts once, and every query that was asked is paid for."""

import math

import pytest

from sasgeo_bench.scoring.costs import cost_rows
from sasgeo_bench.scoring.rows import to_frame
from tests.scoring.test_tables import scores

RUNS = (
    {"region": "vaduz", "map_bytes": 2_000_000, "index_bytes": 1_000_000, "cpu_s": 6.0},
    {"region": "vaduz", "map_bytes": 2_000_000, "index_bytes": 1_000_000, "cpu_s": 2.0},  # another suite
    {"region": "monaco", "map_bytes": 1_000_000, "index_bytes": None, "cpu_s": 0.0},
    {"region": "elsewhere", "map_bytes": 9_000_000, "cpu_s": 0.0},  # of an area that is not known
)


def costs(runs=RUNS, table=None, sizes=1000):
    table = scores([1.0, 99.0, math.inf, 1.0, math.inf]) if table is None else table
    view_bytes = dict.fromkeys(table["query_id"], sizes)
    rows = cost_rows("mine", table, runs, view_bytes=view_bytes, area_km2={"vaduz": 10.0, "monaco": 2.5})
    return to_frame(list(rows)).set_index("metric")["value"]


def test_storage_is_that_of_maps_and_what_was_added_over_their_area():
    assert costs()["map_per_km2"] == pytest.approx((3000 + 1000) / 12.5)
    assert math.isnan(costs(RUNS[3:])["map_per_km2"])


def test_a_fix_pays_for_what_was_sent_in_vain():
    assert costs()["observation_per_fix"] == pytest.approx(5 / 3)
    assert costs()["cpu_per_fix"] == pytest.approx(8 / 3)
    assert costs(table=scores([math.inf]))["observation_per_fix"] == math.inf


def test_what_a_matcher_cannot_was_not_sent_to_it():
    table = scores([1.0, math.inf], status=["ok", "not applicable"])
    assert costs(table=table)["observation_per_fix"] == 1.0


def test_a_file_of_predictions_tells_only_what_was_sent():
    found = costs(runs=())
    assert found["observation_per_fix"] == pytest.approx(5 / 3)
    assert found[["prepare", "peak_memory", "map", "map_per_km2", "cpu_per_fix"]].isna().all()
