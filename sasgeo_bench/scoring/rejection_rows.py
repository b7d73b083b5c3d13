# SPDX-License-Identifier: Apache-2.0
"""Integrity metrics of a matcher with a rejector, on each suite, as rows of the board."""

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Floats, Ints, codes_of, weighted_mean
from sasgeo_bench.scoring.decisions import PRESENT_SHARES, Curve, Fixes, presence_weights
from sasgeo_bench.scoring.intervals import (
    BoardDraws,
    BoardInterval,
    ClusterDraws,
    distinct_columns,
    effective_count,
    intervals_of_columns,
    seed_of_text,
    share_interval,
)
from sasgeo_bench.scoring.metric import RejectionMetric, ThresholdMetric
from sasgeo_bench.scoring.metrics import REJECTION, THRESHOLDS
from sasgeo_bench.scoring.rows import ALL_SUITES, GroupKey, Row, RowKey, bare, in_threads

AS_DRAWN: Final = "as drawn"
SLOW_DRAWS: Final = 1000  # for metrics that are no means: each draw sorts again


def answers_of(judged: pd.DataFrame, mixture: str = AS_DRAWN) -> Fixes:
    """Return rows of `judge` as `decisions.Fixes`, with the chances that hold in a mixture of `mixtures_of`."""
    column = "p_right" if mixture == AS_DRAWN else f"p_right_{mixture}"
    return Fixes(
        confidence=judged[column].to_numpy(float),
        is_answered=judged["is_answered"].to_numpy(bool),
        is_right=judged["is_right"].to_numpy(bool),
        is_present=judged["is_present"].to_numpy(bool),
    )


def shifted_column(present_share: float) -> str:
    """Return the column with chances of a right fix where present places have a declared share."""
    return f"p_right_{mixture_name(present_share)}"


def integrity_rows(matcher: str, rejector: str, rows: pd.DataFrame, *, is_calibrated: bool = True) -> Iterator[Row]:
    """Yield every integrity metric of a matcher with a rejector, from rows of `rejection.judge` or `own_confidence`.

    They cover each suite, track and prior group, and all suites of a track and prior group together. The latter also
    come with present places reweighted to a share of 0.9, 0.7 and 0.5. Without `is_calibrated`, skip metrics that need
    probabilities.
    """
    names = {"matcher": matcher, "rejector": rejector, "stratum": AS_DRAWN}
    parts = [
        (RowKey.of(part, GroupKey(str(suite), str(track), str(prior_group)), **names), part)
        for (track, prior_group), whole in rows.groupby(["track", "prior_group"], sort=True)
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]
    ]
    metrics = [metric for metric in REJECTION if is_calibrated or not metric.needs_chances]
    yield from in_threads(lambda item: _rows(*item, metrics), parts)


def _rows(key: RowKey, part: pd.DataFrame, metrics: Sequence[RejectionMetric]) -> Iterator[Row]:
    some = answers_of(part)
    # The seed depends on the queries alone, so that all rejectors share draws.
    seed = seed_of_text(f"{key.suite}/{key.track}/{key.prior_group}")
    names = (codes_of(part[name]) for name in ("place", "block", "pair_id"))
    place, block, site = names
    drawn = BoardDraws.of(place, block, site, seed=seed, draws=SLOW_DRAWS)
    is_pooled = key.suite == ALL_SUITES
    mixtures = dict(mixtures_of(some, is_pooled=is_pooled))
    areas = [_drawn_areas(some, mixtures, one) if is_pooled else {} for one in drawn.both]
    shares = {stratum: list(_shares(part, mass)) for stratum, mass in mixtures.items()}
    every = iter(share_intervals([share for listed in shares.values() for _, share in listed], site, drawn))
    for stratum, mass in mixtures.items():
        mine, trials = replace(key, stratum=stratum), effective_count(site, mass)
        shifted = answers_of(part, stratum)
        for metric in metrics:
            value = metric.compute(shifted if metric.needs_chances else some, weights=mass)
            if not (is_pooled and metric.has_interval):
                yield mine.row(metric, bare(value))
                continue
            most = metric.bounds[1]  # an area is a mean risk: scale it to [0, 1] and back
            by_place, by_block = (one.get((stratum, metric.name), np.empty(0)) / most for one in areas)
            found = share_interval(value / most, (by_place, by_block), trials)
            yield mine.row(metric, found.mapped(partial(operator.mul, most), value))
        for threshold, _ in shares[stratum]:
            yield mine.row(threshold, next(every))


def _drawn_areas(
    answers: Fixes, mixtures: Mapping[str, Floats], drawn: ClusterDraws
) -> Mapping[tuple[str, str], Floats]:
    """Return every draw of the areas that have intervals, by mixture and name; nothing for a single cluster."""
    found: dict[tuple[str, str], list[Floats]] = {}
    if drawn.units_count < 2:  # one place cannot differ from itself
        return {}
    curve, present = Curve.of(answers, is_merged=True), answers.is_present
    factors = {
        stratum: {"present": mass[present].max(initial=0.0), "absent": mass[~present].max(initial=0.0)}
        for stratum, mass in mixtures.items()
    }
    for masses in drawn.sums(curve.sides):
        for stratum, both in factors.items():
            for name, area in asdict(curve.areas(masses, **both)).items():
                found.setdefault((stratum, name), []).append(area)
    return {key: np.concatenate(listed) for key, listed in found.items()}


def mixture_name(present_share: float) -> str:
    """Return the stratum of a declared share of present places, as "present 0.7"."""
    return f"present {present_share:g}"


def mixtures_of(some: Fixes, *, is_pooled: bool) -> Iterator[tuple[str, Floats]]:
    """Yield names and weights: as drawn, and for pooled suites the declared mixtures of present and absent places."""
    yield AS_DRAWN, np.ones(len(some))
    if is_pooled and some.is_present.any() and not some.is_present.all():
        for share in PRESENT_SHARES:
            yield mixture_name(share), presence_weights(some.is_present, share)


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A weighted share of the queries, as the coverage of a threshold; each column has shape (N,)."""

    counted: Floats
    mass: Floats


def _shares(part: pd.DataFrame, mass: Floats) -> Iterator[tuple[ThresholdMetric, Share]]:
    """Yield the shares that thresholds chosen on calibration places reach here.

    Skip thresholds that some rows lack: the coverage of the others would not be that of these queries.
    """
    right, present = (part[name].to_numpy(float) for name in ("is_right", "is_present"))
    for metric in THRESHOLDS:
        column = part[metric.accepted]
        if column.isna().any():
            continue
        accepted = column.to_numpy(float)
        counted, counts = {
            "covered": (accepted, mass),
            "risk": (1.0 - right, mass * accepted),
            "right": (accepted * right, mass * present),
            "absent": (accepted, mass * (1.0 - present)),
        }[metric.what]
        if counts.any() or not metric.is_of_absent:
            yield metric, Share(counted=counted, mass=counts)


def share_intervals(shares: Sequence[Share], sites: Ints, drawn: BoardDraws) -> list[BoardInterval]:
    """Return each share with its intervals; `sites` are those of the queries, shape (N,)."""
    by_place, by_block = (_drawn_shares(shares, one) for one in drawn.both)
    values = [weighted_mean(share.counted, share.mass) for share in shares]
    return intervals_of_columns(values, (by_place, by_block), [effective_count(sites, share.mass) for share in shares])


def _drawn_shares(shares: Sequence[Share], drawn: ClusterDraws) -> Floats:
    """Return all shares in every draw, shape (D, shares); NaN where a draw has no weight.

    For fewer than two clusters there are no draws.
    """
    if not shares or drawn.units_count < 2:  # one place cannot differ from itself
        return np.empty((0, len(shares)))
    columns = [share.counted * share.mass for share in shares] + [share.mass for share in shares]
    table, code = distinct_columns(np.column_stack(columns))  # masses are shared
    top, bottom = np.hsplit(np.vstack(list(drawn.sums(table)))[:, code], 2)
    return np.asarray(np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0))
