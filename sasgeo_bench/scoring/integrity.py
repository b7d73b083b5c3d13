# SPDX-License-Identifier: Apache-2.0
"""Rows of a board for matcher x rejector: how well it is known which answers are false."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Floats, weighted_mean
from sasgeo_bench.scoring.calibration import brier, calibration_error
from sasgeo_bench.scoring.decisions import COST_RATIOS, PRESENT_SHARES, Answers, decision_cost, presence_weights
from sasgeo_bench.scoring.draws import ClusterDraws
from sasgeo_bench.scoring.integrity_metric import augrc, aurc, drawn_areas, excess_aurc, false_fix_rate
from sasgeo_bench.scoring.intervals import Interval, effective_count, share_interval
from sasgeo_bench.scoring.rejection import RISKS, answers_of
from sasgeo_bench.scoring.rows import ALL_SUITES, Better, Row, Told, bare, side_by_side

AS_DRAWN: Final = "as drawn"
COVERAGES: Final = (0.5, 0.8)
_CACHED: Final = 2**16  # numbers that a core keeps at hand: larger tables take twice the time
SLOW_DRAWS: Final = 1000  # for figures that are no means: each draw sorts anew

_AREAS: Final = {"aurc": 1.0, "augrc": 0.5}  # figures that have intervals, and how large they can be
_OF_CHANCES: Final = ("brier", "ece", "cost_")  # how figures begin that take a confidence for a probability
_NO_DRAWS: Final = np.empty(0)

Figure = Callable[[Answers, Floats], float]

_FIGURES: Final[tuple[tuple[str, Figure], ...]] = (
    ("aurc", aurc),
    ("e_aurc", excess_aurc),
    ("augrc", augrc),
    *(
        (f"false_fix_at_coverage_{share:g}", lambda some, mass, share=share: false_fix_rate(some, share, mass))
        for share in COVERAGES
    ),
    ("brier", brier),
    ("ece", calibration_error),
    *((f"cost_{ratio:g}", lambda some, mass, ratio=ratio: decision_cost(some, ratio, mass)) for ratio in COST_RATIOS),
    *(
        (
            f"cost_{ratio:g}_place",
            lambda some, mass, ratio=ratio: decision_cost(some, ratio, mass, charged="place"),
        )
        for ratio in COST_RATIOS
    ),
)


def integrity_rows(matcher: str, rejector: str, judged: pd.DataFrame, *, is_calibrated: bool = True) -> Iterator[Row]:
    """Every integrity figure of a matcher with a rejector.

    Parameters
    ----------
    matcher, rejector : str
        Their names.
    judged : pandas.DataFrame
        From `rejection.judge` or `rejection.own_word`.
    is_calibrated : bool
        Whether it gives probabilities; without, there are no figures that judge them.

    Yields
    ------
    Row
        For each suite, track and prior group, and for all suites of a track and prior group together; there also with
        present and absent places reweighted to 0.9, 0.7 and 0.5 present.
    """
    parts = [
        (
            Told.of(
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
        for (track, prior_group), whole in judged.groupby(["track", "prior_group"], sort=True)
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]
    ]
    figures = [item for item in _FIGURES if is_calibrated or not item[0].startswith(_OF_CHANCES)]
    yield from side_by_side(lambda item: _rows(*item, figures), parts)


def _rows(told: Told, part: pd.DataFrame, figures: Sequence[tuple[str, Figure]]) -> Iterator[Row]:
    some = answers_of(part)
    # Of the queries alone, so that two rejectors are drawn alike.
    text = f"{told.suite}/{told.track}/{told.prior_group}"
    seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")
    sites = np.unique(part["pair_id"], return_inverse=True)[1]
    drawn = ClusterDraws(blocks=part["block"].tolist(), sites=sites, seed=seed, draws=SLOW_DRAWS)
    is_pooled = told.suite == ALL_SUITES
    mixtures = dict(_mixtures(some, is_pooled=is_pooled))
    areas = _drawn_areas(some, mixtures, drawn) if is_pooled and drawn.blocks_count > 1 else {}
    shares = {stratum: list(_shares(part, mass)) for stratum, mass in mixtures.items()}
    drawn_shares = iter(_drawn_shares([share for listed in shares.values() for share in listed], drawn))
    for stratum, mass in mixtures.items():
        mine, trials = replace(told, stratum=stratum), effective_count(sites, mass)
        for name, figure in figures:
            value, most = figure(some, mass), _AREAS.get(name)
            if is_pooled and most is not None:
                found, how = _area_interval(value, areas.get((stratum, name), _NO_DRAWS), trials, most)
                yield mine.row(name, "1", "lower", found, how)
            else:
                yield mine.row(name, "1", "lower", bare(value))
        for share in shares[stratum]:
            value = weighted_mean(share.counted, share.mass)
            found, how = share_interval(value, next(drawn_shares), effective_count(sites, share.mass))
            yield mine.row(share.name, "1", share.better, found, how)


def _area_interval(value: float, draws: Floats, trials: float, most: float) -> tuple[Interval, str]:
    """Interval of an area that can be as large as `most`: it is a mean risk, and told as a share of that."""
    found, how = share_interval(value / most, draws / most, trials)
    return Interval(value=value, lo=found.lo * most, hi=found.hi * most), how


def _drawn_areas(
    answers: Answers, mixtures: Mapping[str, Floats], drawn: ClusterDraws
) -> Mapping[tuple[str, str], Floats]:
    """The figures that have intervals, by mixture and name, of every draw."""
    found: dict[tuple[str, str], list[Floats]] = {}
    parts = (part for some in drawn.weights() for part in np.array_split(some, 1 + some.size // _CACHED))
    for weights in parts:
        for stratum, mass in mixtures.items():
            areas = drawn_areas(answers, weights * mass)
            found.setdefault((stratum, "aurc"), []).append(areas.aurc)
            found.setdefault((stratum, "augrc"), []).append(areas.augrc)
    return {key: np.concatenate(listed) for key, listed in found.items()}


def _mixtures(some: Answers, *, is_pooled: bool) -> Iterator[tuple[str, Floats]]:
    """Present and absent places as drawn; pooled also in the declared mixtures, where both are there."""
    yield AS_DRAWN, np.ones(len(some))
    if is_pooled and some.is_present.any() and not some.is_present.all():
        for share in PRESENT_SHARES:
            yield f"present {share:g}", presence_weights(some.is_present, share)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Share:
    """A share of the queries by mass, as the coverage of a threshold; each column has shape (N,)."""

    name: str
    better: Better
    counted: Floats
    mass: Floats


def _shares(part: pd.DataFrame, mass: Floats) -> Iterator[_Share]:
    """Coverage at the thresholds chosen on calibration places, and the risk that was really reached.

    Nothing where some row has no threshold: the coverage of the others would not be that of the queries told.
    """
    is_false = (~part["is_right"].to_numpy(bool)).astype(float)
    for risk in RISKS:
        column = part[f"accepted_{risk:g}"]
        if not column.isna().any():
            accepted = column.to_numpy(float)
            yield _Share(name=f"coverage_at_risk_{risk:g}", better="higher", counted=accepted, mass=mass)
            yield _Share(name=f"risk_reached_at_{risk:g}", better="lower", counted=is_false, mass=mass * accepted)


def _drawn_shares(shares: Sequence[_Share], drawn: ClusterDraws) -> Iterator[Floats]:
    """Each share in every draw, all by one pass over the draws; NaN where a draw holds nothing that counts.

    No draws for fewer than two blocks: one says nothing of others.
    """
    if not shares or drawn.blocks_count < 2:  # noqa: PLR2004 - one block cannot differ from itself
        yield from (np.empty(0) for _ in shares)
        return
    columns = [share.counted * share.mass for share in shares] + [share.mass for share in shares]
    top, bottom = np.hsplit(np.vstack(list(drawn.sums(np.column_stack(columns)))), 2)
    yield from np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0).T
