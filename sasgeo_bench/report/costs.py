# SPDX-License-Identifier: Apache-2.0
"""Rows of a board that say what answers cost: time, memory, bytes."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sasgeo_bench.metrics.cost import per_fix, run_cost
from sasgeo_bench.report.rows import ALL_SUITES, Row, Told, bare


def cost_rows(matcher: str, scores: pd.DataFrame, runs: Sequence[Mapping[str, Any]]) -> Iterator[Row]:
    """What the answers of one matcher took.

    Parameters
    ----------
    matcher : str
        Its name.
    scores : pandas.DataFrame
        Its scored rows, all suites.
    runs : sequence of mapping
        What each `run.json` says; none for a file of predictions.

    Yields
    ------
    Row
        For each track the latency of answers (a time-out has none, and is no quick answer: it counts as infinite); over
        all tracks what is measured by run: the largest of preparing, memory and bytes, and processor seconds a fix.
    """
    for track, part in scores.groupby("track", sort=True):
        latency_s = np.where(part["status"] == "timeout", np.inf, part["latency_s"].to_numpy(float))
        latency_s = latency_s[~np.isnan(latency_s)]
        for name, share in (("latency_p50", 0.5), ("latency_p95", 0.95)):
            value = math.nan
            if len(latency_s):
                value = float(np.quantile(latency_s, share, method="inverted_cdf"))
            yield _row(matcher, str(track), name, "s", value, part)
    costs = [run_cost(about) for about in runs]
    for name, unit, attribute in (
        ("prepare", "s", "prepare_s"),
        ("peak_memory", "MB", "peak_rss_mb"),
        ("index", "MB", "index_mb"),
        ("map", "MB", "map_mb"),
    ):
        found = [getattr(cost, attribute) for cost in costs if not math.isnan(getattr(cost, attribute))]
        yield _row(matcher, "all", name, unit, max(found, default=math.nan), scores)
    spent_s = [cost.cpu_s for cost in costs]
    value = per_fix(sum(spent_s), int(scores["is_answered"].sum())) if spent_s else math.nan
    yield _row(matcher, "all", "cpu_per_fix", "s", value, scores)


def _row(matcher: str, track: str, metric: str, unit: str, value: float, part: pd.DataFrame) -> Row:
    told = Told.of(part, matcher=matcher, suite=ALL_SUITES, track=track, prior_group="all", stratum="all")
    return told.row(metric, unit, "lower", bare(value))
