# SPDX-License-Identifier: Apache-2.0
"""Rows of a board that say what answers cost: time, memory, bytes."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.cost import BYTES_PER_KB, bytes_per_km2, per_fix, run_cost
from sasgeo_bench.scoring.rows import ALL_SUITES, Row, Told, bare
from sasgeo_bench.scoring.score import NOT_APPLICABLE


def cost_rows(
    matcher: str,
    scores: pd.DataFrame,
    runs: Sequence[Mapping[str, Any]],
    *,
    view_bytes: Mapping[str, int],
    area_km2: Mapping[str, float],
) -> Iterator[Row]:
    """What the answers of one matcher took.

    Parameters
    ----------
    matcher : str
        Its name.
    scores : pandas.DataFrame
        Its scored rows, all suites.
    runs : sequence of mapping
        What each `run.json` says; none for a file of predictions.
    view_bytes : mapping of str to int
        By query: what was seen, in bytes as it travels (`cost.observation_bytes`).
    area_km2 : mapping of str to float
        Mapped area by region, where it is known.

    Yields
    ------
    Row
        For each track the latency of answers (a time-out has none, and is no quick answer: it counts as infinite); over
        all tracks what is measured by run: the largest of preparing, memory and bytes, storage of a square kilometre,
        and processor seconds and bytes a fix.
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
    yield _row(matcher, "all", "map_per_km2", "kB/km2", _map_per_km2(runs, area_km2), scores)
    fixes = int(scores["is_answered"].sum())
    spent_s = [cost.cpu_s for cost in costs]
    yield _row(matcher, "all", "cpu_per_fix", "s", per_fix(sum(spent_s), fixes) if spent_s else math.nan, scores)
    asked = scores.loc[scores["status"] != NOT_APPLICABLE, "query_id"]
    sent_kb = sum(view_bytes[name] for name in asked) / BYTES_PER_KB
    yield _row(matcher, "all", "observation_per_fix", "kB", per_fix(sent_kb, fixes), scores)


def _map_per_km2(runs: Sequence[Mapping[str, Any]], area_km2: Mapping[str, float]) -> float:
    """Kilobytes of maps, with what the matcher added to them, for each square kilometre; each map counts once."""
    stored = {about["region"]: run_cost(about) for about in runs if about["region"] in area_km2}
    sizes = {name: 1e3 * (cost.map_mb + np.nan_to_num(cost.index_mb)) for name, cost in stored.items()}
    known = [name for name, size in sizes.items() if not math.isnan(size)]
    if not known:
        return math.nan
    return bytes_per_km2(sum(sizes[name] for name in known), sum(area_km2[name] for name in known))


def _row(matcher: str, track: str, metric: str, unit: str, value: float, part: pd.DataFrame) -> Row:
    told = Told.of(part, matcher=matcher, suite=ALL_SUITES, track=track, prior_group="all", stratum="all")
    return told.row(metric, unit, "lower", bare(value))
