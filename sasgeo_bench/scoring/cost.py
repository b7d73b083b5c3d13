# SPDX-License-Identifier: Apache-2.0
"""Cost of answers: time, memory, map storage, and bytes to send for one fix."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.score import NOT_APPLICABLE

BYTES_PER_KB: Final = 1e3
BYTES_PER_MB: Final = 1e6
COLUMNS: Final = ("query_id", "track", "status", "is_answered", "latency_s", "block", "place")  # of the rows it reads
_MOST: Final = 1e18  # seconds or bytes of a run: more is no measurement


@dataclass(frozen=True, slots=True, kw_only=True)
class RunCost:
    """Cost of a run on one map; NaN where `run.json` does not state it.

    `prepare_s` excludes answers, `peak_rss_mb` includes child processes (1 MB = 10^6 bytes), `index_mb` are the
    matcher's files and `map_mb` the region's, `cpu_s` is that of all answers together.
    """

    prepare_s: float
    peak_rss_mb: float
    index_mb: float
    map_mb: float
    cpu_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Input of the cost metrics of one matcher.

    `scores` are its scored rows, `runs` the contents of each `run.json`; none for a file of predictions. `view_bytes`
    are by query: two bits per cell and class, one byte per confidence, WKB per vector. `area_km2` is the mapped area by
    region, where known.
    """

    scores: pd.DataFrame
    runs: Sequence[Mapping[str, Any]]
    view_bytes: Mapping[str, int]
    area_km2: Mapping[str, float]


def run_cost(about: Mapping[str, Any]) -> RunCost:
    """Read the cost of a run from the content of `run.json`, empty for a submission without code.

    Raise MetricError if an entry is no number.

    >>> cost = run_cost({"prepare_s": 2.5, "peak_bytes": 3_000_000})
    >>> cost.prepare_s, cost.peak_rss_mb, cost.cpu_s
    (2.5, 3.0, nan)
    """
    return RunCost(
        prepare_s=_number(about, "prepare_s"),
        peak_rss_mb=_number(about, "peak_bytes") / BYTES_PER_MB,
        index_mb=_number(about, "index_bytes") / BYTES_PER_MB,
        map_mb=_number(about, "map_bytes") / BYTES_PER_MB,
        cpu_s=_number(about, "cpu_s"),
    )


def _number(about: Mapping[str, Any], name: str) -> float:
    value = about.get(name)
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= _MOST:
        raise MetricError(f"{name} of a run is {value!r}, expected a number from 0 to {_MOST:.0e}")
    return float(value)


def latency_quantile(costs: Costs, share: float) -> float:
    """Return the least latency in seconds that a share in (0, 1] of the timed queries does not exceed.

    A time-out is infinite: it took at least the limit, and leaving it out would make a slow matcher look fast. Other
    queries without a time (crashes, refusals, submissions without code) are left out. NaN if none is timed.
    """
    latency_s = np.where(costs.scores["status"] == "timeout", np.inf, costs.scores["latency_s"].to_numpy(float))
    timed_s = latency_s[~np.isnan(latency_s)]
    return float(np.quantile(timed_s, share, method="inverted_cdf")) if len(timed_s) else math.nan


def most(costs: Costs, name: str) -> float:
    """Return the largest value of a field of `RunCost` over all maps; NaN if no run states it."""
    values = [getattr(run_cost(about), name) for about in costs.runs]
    return max((value for value in values if not math.isnan(value)), default=math.nan)


def map_kb_per_km2(costs: Costs) -> float:
    """Return kilobytes of maps and the matcher's files for them per square kilometre; each map counts once."""
    stored = {about["region"]: run_cost(about) for about in costs.runs if about["region"] in costs.area_km2}
    size_kb = {name: 1e3 * (cost.map_mb + np.nan_to_num(cost.index_mb)) for name, cost in stored.items()}
    known = [name for name, size in size_kb.items() if not math.isnan(size)]
    area_km2 = sum(costs.area_km2[name] for name in known)
    return float(sum(size_kb[name] for name in known) / area_km2) if area_km2 > 0 else math.nan


def cpu_s_per_fix(costs: Costs) -> float:
    """Return CPU-seconds of all queries per answered query; NaN if no run states it."""
    if not costs.runs:
        return math.nan
    return per_fix(sum(run_cost(about).cpu_s for about in costs.runs), int(costs.scores["is_answered"].sum()))


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
