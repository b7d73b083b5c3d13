# SPDX-License-Identifier: Apache-2.0
"""Cost of answers: time, memory, map storage, and bytes to send for one fix."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.score import NOT_APPLICABLE

BYTES_PER_KB: Final = 1e3
BYTES_PER_MB: Final = 1e6
COLUMNS: Final = ("query_id", "track", "status", "is_answered", "latency_s", "block", "place")  # of the rows it reads


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Input of the cost metrics of one matcher.

    `scores` are its scored rows, `runs` the manifests of its runs; none for a file of predictions. `view_bytes`
    are by query: two bits per cell and class, one byte per confidence, WKB per vector. `area_km2` is the mapped area by
    region, where known.
    """

    scores: pd.DataFrame
    runs: Sequence[RunManifest]
    view_bytes: Mapping[str, int]
    area_km2: Mapping[str, float]


def latencies_s(scores: pd.DataFrame) -> Floats:
    """Return the latency of each scored row, or view of a flight, in seconds; NaN where unknown.

    A time-out is infinite: it took at least the limit, and leaving it out would make a slow matcher look fast.
    """
    return np.where(scores["status"] == "timeout", np.inf, scores["latency_s"].to_numpy(float))


def latency_quantile(costs: Costs, share: float) -> float:
    """Return the least latency in seconds that a share in (0, 1] of the timed queries does not exceed.

    Queries without a time (crashes, refusals, submissions without code) are left out. NaN if none is timed.
    """
    latency_s = latencies_s(costs.scores)
    timed_s = latency_s[~np.isnan(latency_s)]
    return float(np.quantile(timed_s, share, method="inverted_cdf")) if len(timed_s) else math.nan


def most(costs: Costs, measured: Callable[[RunManifest], float | None], unit: float = 1.0) -> float:
    """Return the largest value of a figure of runs over all maps, in a unit; NaN if no run states it."""
    values = [value / unit for run in costs.runs if (value := measured(run)) is not None]
    return max(values, default=math.nan)


def map_kb_per_km2(costs: Costs) -> float:
    """Return kilobytes of maps and the matcher's files for them per square kilometre; each map counts once."""
    stored = {run.region: run for run in costs.runs if run.region in costs.area_km2}
    size_kb = {
        name: 1e3 * (run.map_bytes / BYTES_PER_MB + (run.index_bytes or 0) / BYTES_PER_MB)
        for name, run in stored.items()
        if run.map_bytes is not None
    }
    area_km2 = sum(costs.area_km2[name] for name in size_kb)
    return float(sum(size_kb.values()) / area_km2) if area_km2 > 0 else math.nan


def cpu_s_per_fix(costs: Costs) -> float:
    """Return CPU-seconds of all queries per answered query; NaN if no run states it."""
    if not costs.runs:
        return math.nan
    spent_s = sum(math.nan if run.cpu_s is None else run.cpu_s for run in costs.runs)
    return per_fix(spent_s, int(costs.scores["is_answered"].sum()))


def sent_kb_per_fix(costs: Costs) -> float:
    """Return kilobytes of the views of all queries per answered query."""
    asked = costs.scores.loc[costs.scores["status"] != NOT_APPLICABLE, "query_id"]
    sent_kb = sum(costs.view_bytes[name] for name in asked) / BYTES_PER_KB
    return per_fix(sent_kb, int(costs.scores["is_answered"].sum()))


def per_fix(total: float, fixes: float) -> float:
    """Return the total cost of all queries, answered or not, per fix.

    Infinite for a cost without fixes; NaN for no cost and no fixes, or an unknown total. Raise MetricError if a number
    is negative.

    >>> per_fix(9000.0, 3), per_fix(9000.0, 0)
    (3000.0, inf)
    """
    if total < 0 or not fixes >= 0:
        raise MetricError(f"total and fixes are not negative, got {total!r} and {fixes!r}")
    if fixes > 0:
        return total / fixes
    return math.inf if total > 0 else math.nan
