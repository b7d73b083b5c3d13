# SPDX-License-Identifier: Apache-2.0
"""Rows of a board for matcher x rejector: how well confidences separate right from false fixes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Floats, weighted_mean
from sasgeo_bench.scoring.decisions import PRESENT_SHARES, Answers, presence_weights
from sasgeo_bench.scoring.draws import ClusterDraws, seed_of_text
from sasgeo_bench.scoring.integrity_metric import drawn_areas
from sasgeo_bench.scoring.intervals import Interval, effective_count, share_interval
from sasgeo_bench.scoring.metrics import REJECTION, THRESHOLDS, RejectionMetric, ThresholdMetric
from sasgeo_bench.scoring.rejection import answers_of
from sasgeo_bench.scoring.rows import ALL_SUITES, Row, RowKey, bare, in_threads

AS_DRAWN: Final = "as drawn"
_CACHED: Final = 2**16  # numbers that fit a core's cache: larger tables take twice the time
SLOW_DRAWS: Final = 1000  # for metrics that are no means: each draw sorts again
_NO_DRAWS: Final = np.empty(0)


def integrity_rows(matcher: str, rejector: str, rows: pd.DataFrame, *, is_calibrated: bool = True) -> Iterator[Row]:
    """Yield every integrity metric of a matcher with a rejector, from rows of `rejection.judge` or `own_confidence`.

    They cover each suite, track and prior group, and all suites of a track and prior group together. The latter also
    come with present places reweighted to a share of 0.9, 0.7 and 0.5. Without `is_calibrated`, skip metrics that need
    probabilities.
    """
    parts = [
        (
            RowKey.of(
                part,
                matcher=matcher,
                rejector=rejector,
                suite=str(suite),
                track=str(track),
                prior_group=str(prior_group),
                stratum=AS_DRAWN,
            ),
            part,
        )
        for (track, prior_group), whole in rows.groupby(["track", "prior_group"], sort=True)
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]
    ]
    metrics = [metric for metric in REJECTION if is_calibrated or not metric.needs_chances]
    yield from in_threads(lambda item: _rows(*item, metrics), parts)


def _rows(key: RowKey, part: pd.DataFrame, metrics: Sequence[RejectionMetric]) -> Iterator[Row]:
    some = answers_of(part)
    # The seed depends on the queries alone, so that all rejectors share draws.
    seed = seed_of_text(f"{key.suite}/{key.track}/{key.prior_group}")
    sites = np.unique(part["pair_id"], return_inverse=True)[1]
    drawn = ClusterDraws(blocks=part["block"].tolist(), sites=sites, seed=seed, draws=SLOW_DRAWS)
    is_pooled = key.suite == ALL_SUITES
    mixtures = dict(_mixtures(some, is_pooled=is_pooled))
    areas = _drawn_areas(some, mixtures, drawn) if is_pooled and drawn.blocks_count > 1 else {}
    shares = {stratum: list(_shares(part, mass)) for stratum, mass in mixtures.items()}
    drawn_shares = iter(_drawn_shares([share for listed in shares.values() for share in listed], drawn))
    for stratum, mass in mixtures.items():
        mine, trials = replace(key, stratum=stratum), effective_count(sites, mass)
        for metric in metrics:
            value = metric.compute(some, weights=mass)
            if is_pooled and metric.has_interval:
                drawn_values = areas.get((stratum, metric.name), _NO_DRAWS)
                found, how = _area_interval(value, drawn_values, trials, metric.bounds[1])
                yield mine.row(metric, found, how)
            else:
                yield mine.row(metric, bare(value))
        for share in shares[stratum]:
            value = weighted_mean(share.counted, share.mass)
            found, how = share_interval(value, next(drawn_shares), effective_count(sites, share.mass))
            yield mine.row(share.metric, found, how)


def _area_interval(value: float, draws: Floats, trials: float, most: float) -> tuple[Interval, str]:
    """Return the interval of an area in [0, `most`]: it is a mean risk, so scale it to [0, 1] and back."""
    found, how = share_interval(value / most, draws / most, trials)
    return Interval(value=value, lo=found.lo * most, hi=found.hi * most), how


def _drawn_areas(
    answers: Answers, mixtures: Mapping[str, Floats], drawn: ClusterDraws
) -> Mapping[tuple[str, str], Floats]:
    """Return every draw of the areas that have intervals, by mixture and name."""
    found: dict[tuple[str, str], list[Floats]] = {}
    parts = (part for some in drawn.weights() for part in np.array_split(some, 1 + some.size // _CACHED))
    for weights in parts:
        for stratum, mass in mixtures.items():
            areas = drawn_areas(answers, weights * mass)
            found.setdefault((stratum, "aurc"), []).append(areas.aurc)
            found.setdefault((stratum, "augrc"), []).append(areas.augrc)
    return {key: np.concatenate(listed) for key, listed in found.items()}


def _mixtures(some: Answers, *, is_pooled: bool) -> Iterator[tuple[str, Floats]]:
    """Yield names and weights: as drawn, and for pooled suites the declared mixtures of present and absent places."""
    yield AS_DRAWN, np.ones(len(some))
    if is_pooled and some.is_present.any() and not some.is_present.all():
        for share in PRESENT_SHARES:
            yield f"present {share:g}", presence_weights(some.is_present, share)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Share:
    """A weighted share of the queries, as the coverage of a threshold; each column has shape (N,)."""

    metric: ThresholdMetric
    counted: Floats
    mass: Floats


def _shares(part: pd.DataFrame, mass: Floats) -> Iterator[_Share]:
    """Yield the coverage at thresholds chosen on calibration places, and the risk reached here.

    Skip thresholds that some rows lack: the coverage of the others would not be that of these queries.
    """
    is_false = (~part["is_right"].to_numpy(bool)).astype(float)
    for metric in THRESHOLDS:
        column = part[f"accepted_{metric.risk:g}"]
        if not column.isna().any():
            accepted = column.to_numpy(float)
            counted, counts = (is_false, mass * accepted) if metric.is_of_accepted else (accepted, mass)
            yield _Share(metric=metric, counted=counted, mass=counts)


def _drawn_shares(shares: Sequence[_Share], drawn: ClusterDraws) -> Iterator[Floats]:
    """Yield each share in every draw, with one pass over the draws; NaN where a draw has no weight.

    For fewer than two blocks the draws are empty.
    """
    if not shares or drawn.blocks_count < 2:  # noqa: PLR2004 - one block cannot differ from itself
        yield from (np.empty(0) for _ in shares)
        return
    columns = [share.counted * share.mass for share in shares] + [share.mass for share in shares]
    top, bottom = np.hsplit(np.vstack(list(drawn.sums(np.column_stack(columns)))), 2)
    yield from np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0).T
