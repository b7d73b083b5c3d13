# SPDX-License-Identifier: Apache-2.0
"""What answers cost: time, memory, map storage, and what has to be sent for one fix."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import ArrayLike

from sasgeo_bench.errors import MetricError
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.regions.evidence import pack
from sasgeo_bench.scoring.base import Floats, Metric, weighted_quantile
from sasgeo_bench.tasks.query import Query

BYTES_PER_KB: Final = 1e3
BYTES_PER_MB: Final = 1e6


def latencies(predictions: Sequence[Prediction]) -> Floats:
    """Seconds of `match` alone, one for each query that was timed.

    Parameters
    ----------
    predictions : sequence of Prediction
        Of one run.

    Returns
    -------
    ndarray of float, shape (M,)
        Infinite for a time-out: it took at least the limit, and leaving it out would make a slow matcher look fast.
        Other queries without a time (crashes, refusals, submissions without code) are left out; the counts of statuses
        tell how many.

    Examples
    --------
    >>> quick = Prediction(query_id="a", latency_s=0.25)
    >>> latencies([quick, Prediction(query_id="b", status="timeout"), Prediction(query_id="c")]).tolist()
    [0.25, inf]
    """
    timed = [
        math.inf if item.status == "timeout" else item.latency_s
        for item in predictions
        if item.status == "timeout" or item.latency_s is not None
    ]
    return np.array(timed, dtype=np.float64)


def latency_quantile(latency_s: ArrayLike, share: float, weights: ArrayLike | None = None) -> float:
    """Least latency that at least a share of the timed queries does not exceed.

    Parameters
    ----------
    latency_s : array_like, shape (M,)
        From `latencies`.
    share : float
        In (0, 1]: 0.5, 0.95.
    weights : array_like, shape (M,), optional
        Not negative.

    Returns
    -------
    float
        Seconds; NaN where none was timed.

    Examples
    --------
    >>> latency_quantile([0.1, 0.2, 0.9], 0.5), latency_quantile([0.1, 0.2, np.inf], 0.95)
    (0.2, inf)
    """
    return weighted_quantile(latency_s, share, weights)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunCost:
    """What a run took on one map; NaN where `run.json` does not say.

    Parameters
    ----------
    prepare_s : float
        Seconds of `prepare`, apart from answers.
    peak_rss_mb : float
        Peak memory of the matcher's process and all that came from it (1 MB = 10^6 bytes).
    index_mb : float
        What the matcher added to the map on disk.
    map_mb : float
        The region's files.
    cpu_s : float
        CPU-seconds of all answers together.
    """

    prepare_s: float
    peak_rss_mb: float
    index_mb: float
    map_mb: float
    cpu_s: float


def run_cost(about: Mapping[str, Any]) -> RunCost:
    """Read the costs out of what `run.json` says.

    Parameters
    ----------
    about : mapping
        The content of `run.json`; empty for a submission without code.

    Returns
    -------
    RunCost
        In seconds and megabytes.

    Raises
    ------
    MetricError
        If an entry is no number.

    Examples
    --------
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
    if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
        message = f"{name} of a run is {value!r}, expected a number that is not negative"
        raise MetricError(message)
    return float(value)


def bytes_per_km2(stored_bytes: float, area_km2: float) -> float:
    """Storage of a map, with whatever a matcher adds to it, for each square kilometre.

    Parameters
    ----------
    stored_bytes : float
        On disk.
    area_km2 : float
        Mapped area, positive.

    Returns
    -------
    float
        Bytes.

    Raises
    ------
    MetricError
        If the area is not positive.

    Examples
    --------
    >>> bytes_per_km2(3_000_000, 36.0).__round__()
    83333
    """
    if not area_km2 > 0:
        message = f"area_km2 must be positive, got {area_km2!r}"
        raise MetricError(message)
    return stored_bytes / area_km2


def observation_bytes(query: Query) -> int:
    """Bytes of what was seen, if it were sent as it is stored.

    Parameters
    ----------
    query : Query
        With its evidence, and vectors where it has any.

    Returns
    -------
    int
        Two bits for each cell and class, one byte for each confidence, WKB for each vector; nothing is compressed, so
        that the figure does not depend on a library's version. `task_files.read_view_bytes` gives the same of all
        queries of a task without unpacking one.
    """
    evidence = query.evidence
    total = len(pack(evidence.cells))
    total += 0 if evidence.confidence is None else evidence.confidence.nbytes
    if query.vectors is not None:
        total += sum(len(shape) for shape in shapely.to_wkb(query.vectors.geometry.to_numpy()))
    return total


def per_fix(total: float, fixes: float) -> float:
    """What one fix costs, all queries paid for: bytes that were sent, CPU-seconds.

    Parameters
    ----------
    total : float
        Of all queries, those without a fix too.
    fixes : float
        How many fixes came of them; say whether accepted or right ones.

    Returns
    -------
    float
        Infinite where all was in vain, NaN where nothing was paid and nothing came, or the total is not known.

    Raises
    ------
    MetricError
        If a number is negative.

    Examples
    --------
    >>> per_fix(9000.0, 3), per_fix(9000.0, 0)
    (3000.0, inf)
    """
    if total < 0 or not fixes >= 0:
        message = f"total and fixes are not negative, got {total!r} and {fixes!r}"
        raise MetricError(message)
    if fixes > 0:
        return total / fixes
    return math.inf if total > 0 else math.nan


METRICS: Final = tuple(
    Metric(
        name=f"latency_p{100 * share:g}_s",
        unit="s",
        better="lower",
        bounds=(0.0, math.inf),
        compute=partial(latency_quantile, share=share),
        source="time of match alone, a time-out is infinite",
    )
    for share in (0.5, 0.95)
)
