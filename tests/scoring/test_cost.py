# SPDX-License-Identifier: Apache-2.0
"""Costs: a time-out is not fast, what is not told is not zero, and all that was sent is paid for."""

import datetime as dt
import math

import geopandas as gpd
import numpy as np
import pytest
import shapely

from sasgeo_bench.errors import MetricError
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.scoring.cost import (
    METRICS,
    bytes_per_km2,
    latencies,
    latency_quantile,
    observation_bytes,
    per_fix,
    run_cost,
)
from sasgeo_bench.tasks.query import Query


def query(*, confidence: np.ndarray | None = None, vectors: gpd.GeoDataFrame | None = None) -> Query:
    evidence = Evidence(
        classes=("building", "water"), cells=np.zeros((2, 5, 3), dtype=np.uint8), cell_size_m=1.0, confidence=confidence
    )
    return Query(
        query_id="q",
        track="localization",
        suite="clean",
        suite_version=1,
        part="test",
        region="r",
        evidence=evidence,
        observed_on=dt.date(2025, 9, 1),
        season="",
        prior=Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03),
        prior_group="rnone-unknown-s3",
        vectors=vectors,
    )


def test_a_timeout_is_slower_than_every_answer_and_a_crash_was_not_timed() -> None:
    rows = [Prediction(query_id=str(at), latency_s=seconds) for at, seconds in enumerate((0.3, 0.1, 0.2))]
    rows += [Prediction(query_id="t", status="timeout"), Prediction(query_id="c", status="crash")]
    seconds = latencies(rows)
    assert seconds.tolist() == [0.3, 0.1, 0.2, math.inf]
    assert latency_quantile(seconds, 0.5) == 0.2
    assert latency_quantile(seconds, 0.75) == 0.3
    assert latency_quantile(seconds, 0.95) == math.inf


def test_quantiles_of_latency_are_those_of_numpy() -> None:
    seconds = np.random.default_rng(1).random(101)
    for share in (0.5, 0.95):
        assert latency_quantile(seconds, share) == np.quantile(seconds, share, method="inverted_cdf")
    assert math.isnan(latency_quantile(latencies([]), 0.5))


def test_what_a_run_does_not_tell_is_not_known() -> None:
    cost = run_cost({"prepare_s": 1.5, "peak_bytes": 250_000_000, "index_bytes": None, "map_bytes": 4_000_000})
    assert (cost.prepare_s, cost.peak_rss_mb, cost.map_mb) == (1.5, 250.0, 4.0)
    assert math.isnan(cost.index_mb)
    assert math.isnan(cost.cpu_s)
    for wrong in ("fast", True, -1.0, math.nan):
        with pytest.raises(MetricError, match="prepare_s"):
            run_cost({"prepare_s": wrong})


def test_storage_is_told_for_each_square_kilometre() -> None:
    assert bytes_per_km2(8e6, 4.0) == 2e6
    with pytest.raises(MetricError, match="area_km2"):
        bytes_per_km2(8e6, 0.0)


def test_an_observation_is_as_large_as_what_is_stored_of_it() -> None:
    # 30 cells of 2 bits are 8 bytes; confidences take 30; a point in WKB has 1 + 4 + 16.
    assert observation_bytes(query()) == 8
    assert observation_bytes(query(confidence=np.zeros((2, 5, 3), dtype=np.uint8))) == 38
    vectors = gpd.GeoDataFrame({"class": ["building"] * 2}, geometry=[shapely.Point(0, 0), shapely.Point(1, 1)])
    assert observation_bytes(query(vectors=vectors)) == 8 + 2 * 21


def test_a_fix_pays_for_the_queries_without_one() -> None:
    assert per_fix(1000.0, 4) == 250.0
    assert per_fix(1000.0, 0) == math.inf
    assert math.isnan(per_fix(0.0, 0))
    assert math.isnan(per_fix(math.nan, 3))
    with pytest.raises(MetricError, match="not negative"):
        per_fix(1.0, -1)


def test_declared_figures_compute_what_they_are_named_after() -> None:
    seconds = np.arange(1.0, 101.0)
    assert {metric.name: metric.compute(seconds) for metric in METRICS} == {
        "latency_p50_s": 50.0,
        "latency_p95_s": 95.0,
    }
