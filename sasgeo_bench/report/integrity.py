# SPDX-License-Identifier: Apache-2.0
"""Rows of a board for matcher x rejector: how well it is known which answers are false."""

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.metrics.base import Floats, weighted_mean
from sasgeo_bench.metrics.calibration import brier, calibration_error
from sasgeo_bench.metrics.decisions import COST_RATIOS, PRESENT_SHARES, Answers, decision_cost, presence_weights
from sasgeo_bench.metrics.integrity import augrc, aurc, excess_aurc, false_fix_rate
from sasgeo_bench.metrics.intervals import ClusterDraws, mean_interval, statistic_interval
from sasgeo_bench.report.rejection import RISKS, answers_of
from sasgeo_bench.report.rows import ALL_SUITES, Row, Told, bare

AS_DRAWN: Final = "as drawn"
COVERAGES: Final = (0.5, 0.8)
SLOW_DRAWS: Final = 1000  # for figures that are no means: each draw sorts anew

Figure = Callable[[Answers, Floats], float]

# name, which way is good, figure, whether its interval is drawn
_FIGURES: Final[tuple[tuple[str, Figure, bool], ...]] = (
    ("aurc", aurc, True),
    ("e_aurc", excess_aurc, False),
    ("augrc", augrc, True),
    *(
        (f"false_fix_at_coverage_{share:g}", lambda some, mass, share=share: false_fix_rate(some, share, mass), False)
        for share in COVERAGES
    ),
    ("brier", brier, False),
    ("ece", calibration_error, False),
    *(
        (f"cost_{ratio:g}", lambda some, mass, ratio=ratio: decision_cost(some, ratio, mass), False)
        for ratio in COST_RATIOS
    ),
)


def integrity_rows(matcher: str, rejector: str, judged: pd.DataFrame) -> Iterator[Row]:
    """Every integrity figure of a matcher with a rejector.

    Parameters
    ----------
    matcher, rejector : str
        Their names.
    judged : pandas.DataFrame
        From `rejection.judge`.

    Yields
    ------
    Row
        For each suite, track and prior group, and for all suites of a track and prior group together; there also with
        present and absent places reweighted to 0.9, 0.7 and 0.5 present.
    """
    for (track, prior_group), whole in judged.groupby(["track", "prior_group"], sort=True):
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]:
            told = Told.of(
                part,
                matcher=matcher,
                rejector=rejector,
                suite=str(suite),
                track=str(track),
                prior_group=str(prior_group),
                stratum=AS_DRAWN,
            )
            yield from _rows(told, part)


def _rows(told: Told, part: pd.DataFrame) -> Iterator[Row]:
    some = answers_of(part, part["p_false"].to_numpy(float))
    # Of the queries alone, so that two rejectors are drawn alike.
    text = f"{told.suite}/{told.track}/{told.prior_group}"
    seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")
    drawn = ClusterDraws(blocks=part["block"].tolist(), seed=seed, draws=SLOW_DRAWS)
    is_pooled = told.suite == ALL_SUITES
    for stratum, mass in _mixtures(some, is_pooled=is_pooled):
        mine = replace(told, stratum=stratum)
        for name, figure, is_drawn in _FIGURES:
            if is_drawn and is_pooled:
                found = statistic_interval(partial(figure, some), drawn, mass)
            else:
                found = bare(figure(some, mass))
            yield mine.row(name, "1", "lower", found, "blocks")
        yield from _operating_rows(mine, part, mass, drawn)


def _mixtures(some: Answers, *, is_pooled: bool) -> Iterator[tuple[str, Floats]]:
    """Present and absent places as drawn; pooled also in the declared mixtures, where both are there."""
    yield AS_DRAWN, np.ones(len(some))
    if is_pooled and some.is_present.any() and not some.is_present.all():
        for share in PRESENT_SHARES:
            yield f"present {share:g}", presence_weights(some.is_present, share)


def _operating_rows(told: Told, part: pd.DataFrame, mass: Floats, drawn: ClusterDraws) -> Iterator[Row]:
    """Coverage at the thresholds chosen on calibration places, and the risk that was really reached."""
    is_false = ~part["is_right"].to_numpy(bool)
    for risk in RISKS:
        accepted = part[f"accepted_{risk:g}"].to_numpy(bool)
        yield told.row(f"coverage_at_risk_{risk:g}", "1", "higher", mean_interval(accepted, drawn, mass), "blocks")
        taken = mass * accepted
        reached = weighted_mean(is_false, taken)
        found = bare(reached) if math.isnan(reached) else mean_interval(is_false, drawn, taken)
        yield told.row(f"risk_reached_at_{risk:g}", "1", "lower", found, "blocks")
