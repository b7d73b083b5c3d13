# SPDX-License-Identifier: Apache-2.0
"""Risk and coverage where fixes are accepted by Eq. 14, for declared costs and shares of absent places of one kind.

A threshold that is set for one share of absent places says little where there are more of them, or of another kind. So
each kind of absence is mixed with all present places in declared shares; the chances are corrected for the share on
calibration places (`decisions.at_share`), and Eq. 14 decides.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Bools, Floats, codes_of
from sasgeo_bench.scoring.controls import EVERY
from sasgeo_bench.scoring.decisions import COST_RATIOS, Fixes, accept_by_cost
from sasgeo_bench.scoring.draws import seed_of_text
from sasgeo_bench.scoring.frames import MATCHER, PRIOR_GROUP, REJECTOR, TRACK, Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import BoardDraws, BoardInterval
from sasgeo_bench.scoring.rejection_rows import SLOW_DRAWS, Share, answers_of, mixtures_of, share_intervals


@dataclass(frozen=True, slots=True, kw_only=True)
class Accepted:
    """What Eq. 14 accepts of a matcher's answers at one kind of absence, mixture and cost ratio."""

    matcher: Annotated[str, MATCHER]
    rejector: Annotated[str, REJECTOR]
    track: Annotated[str, TRACK]
    prior_group: Annotated[str, PRIOR_GROUP]
    mixture: Annotated[str, "Share of present places, as drawn or as declared"]
    absence: Annotated[str, Shown("Kind of absent places, suite: kind; all: all of them")]
    cost_ratio: Annotated[float, "Cost of a false fix, in costs of a place without an accepted fix"]
    n: Annotated[int, "Queries"]
    absent: Annotated[int, Shown("Absent places among the queries")]
    places: Annotated[int, "Places of the queries"]
    coverage: Annotated[
        BoardInterval, Shown("Share of queries with an accepted fix, where absent places have the share named")
    ]
    risk: Annotated[
        BoardInterval,
        Shown(
            "Share of false fixes among the accepted ones, where absent places have the share named", "risk of fixes"
        ),
    ]
    right_present: Annotated[BoardInterval, "Share of present places that are rightly accepted"]
    absent_accepted: Annotated[BoardInterval, "Share of absent places with an accepted fix"]


ACCEPTANCE_SCHEMA: Final = Schema("acceptance", row_columns(Accepted))


def acceptance_frame(matcher: str, rejector: str, judged: pd.DataFrame) -> pd.DataFrame:
    """Return what Eq. 14 accepts of a matcher's answers, a row for each kind of absence, mixture and cost ratio.

    `judged` are rows of `rejection.judge` or `own_confidence` with chances, all suites together. The kinds of absence
    are "all" and each "suite: kind" with absent places; each is mixed with all present places of its track and prior
    group, as drawn and at the declared shares. Without present or absent places there is no row, nor where the
    calibration cannot correct chances for a share.

    Shares are in [0, 1], each with its 95 % interval by places. `risk` is NaN where nothing is accepted.

    The SASGeo paper, Eqs. (12)-(14).
    """
    return ACCEPTANCE_SCHEMA.frame(
        row
        for (track, prior_group), part in judged.groupby(["track", "prior_group"], sort=True)
        for pool in _pools(part)
        for row in _rows(pool, matcher=matcher, rejector=rejector, track=str(track), prior_group=str(prior_group))
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pool:
    """Present places, and the absent ones of a kind."""

    absence: str
    rows: pd.DataFrame


def _pools(part: pd.DataFrame) -> Iterator[_Pool]:
    """Yield all absent places, then each kind of them, with all present ones."""
    present: Bools = part["is_present"].to_numpy(bool)
    if present.all() or not present.any():
        return
    kinds = (part["suite"].astype(str) + ": " + part["kind"].astype(str)).to_numpy()
    yield _Pool(absence=EVERY, rows=part)
    for kind in sorted(set(kinds[~present])):
        yield _Pool(absence=kind, rows=part[present | (kinds == kind)])


def _rows(pool: _Pool, *, matcher: str, rejector: str, track: str, prior_group: str) -> Iterator[Accepted]:
    part = pool.rows
    place, block, site = (codes_of(part[name]) for name in ("place", "block", "pair_id"))
    drawn = BoardDraws.of(
        place, block, site, seed=seed_of_text(f"{track}/{prior_group}/{pool.absence}"), draws=SLOW_DRAWS
    )
    plain = answers_of(part)
    cases = [
        (mixture, cost_ratio, _shares(answers, mass, cost_ratio))
        for mixture, mass in mixtures_of(plain, is_pooled=True)
        if _is_complete(plain, answers := answers_of(part, mixture))
        for cost_ratio in COST_RATIOS
    ]
    intervals = iter(share_intervals([share for *_, shares in cases for share in shares], site, drawn))
    for mixture, cost_ratio, _ in cases:
        yield Accepted(
            matcher=matcher,
            rejector=rejector,
            track=track,
            prior_group=prior_group,
            mixture=mixture,
            absence=pool.absence,
            cost_ratio=cost_ratio,
            n=len(part),
            absent=int((~part["is_present"].astype(bool)).sum()),
            places=len(set(place)),
            coverage=next(intervals),  # in the order of `_shares`
            risk=next(intervals),
            right_present=next(intervals),
            absent_accepted=next(intervals),
        )


def _is_complete(plain: Fixes, shifted: Fixes) -> bool:
    """Return whether no answer lost its chance to the correction, as where one calibration place lacks absent ones."""
    lost = np.isnan(shifted.confidence) & ~np.isnan(plain.confidence)
    return not lost.any() and not np.isnan(plain.confidence[plain.is_answered]).all()


def _shares(answers: Fixes, mass: Floats, cost_ratio: float) -> list[Share]:
    """Return coverage, risk, and what is accepted of present and of absent places."""
    accepted = accept_by_cost(answers, cost_ratio).astype(float)
    right, present = answers.is_right.astype(float), answers.is_present.astype(float)
    return [
        Share(counted=accepted, mass=mass),
        Share(counted=1.0 - right, mass=mass * accepted),
        Share(counted=accepted * right, mass=mass * present),
        Share(counted=accepted, mass=mass * (1.0 - present)),
    ]
