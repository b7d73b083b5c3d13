# SPDX-License-Identifier: Apache-2.0
"""What the figures of a board show, as tables: one row for each point, bar or cell that is drawn."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Floats, Ints
from sasgeo_bench.scoring.calibration import Stanford, equal_mass_bins, stanford
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.decisions import PRESENT_SHARES, Answers, presence_weights
from sasgeo_bench.scoring.integrity_metric import aurc, risk_coverage
from sasgeo_bench.scoring.intervals import effective_count, wilson
from sasgeo_bench.scoring.protection import ProtectionLevels
from sasgeo_bench.scoring.rejection import answers_of
from sasgeo_bench.scoring.rows import ALL_SUITES, is_apart, is_unranked
from sasgeo_bench.scoring.strata import ALL, CONTROL, GROUP, STRESS, primary_rows

MOST_MATCHERS: Final = 8  # more are not told apart at a glance
ARMS: Final = ("uniform", "hand", "oracle")  # parts of names of what contrasts are seen beside
AS_DRAWN: Final = "as drawn"
AGE: Final = "age_years"  # as truths say that it was measured
_MOST_POINTS: Final = 80  # of a curve: more cannot be seen, and make a file large
_CELLS_PER_DECADE: Final = 8
LEAST_M: Final = 0.1  # what is less is drawn here
MOST_M: Final = 1000.0  # what is more, or infinite, is drawn beyond
BEYOND_M: Final = 1500.0


def shown_matchers(table: pd.DataFrame, contrasts: Sequence[Contrast]) -> tuple[str, ...]:
    """Matchers that figures show: all but controls and what is set apart; of many those of contrasts, and a few beside.

    Parameters
    ----------
    table : pandas.DataFrame
        The leaderboard.
    contrasts : sequence of Contrast
        Those that were registered.

    Returns
    -------
    tuple of str
        Those of contrasts first, each before what is held against it.

    Examples
    --------
    >>> board = pd.DataFrame({"matcher": ["b", "a", "oracle_pose"], "rejector": "", "stratum": "all", "value": 0.5})
    >>> shown_matchers(board.assign(metric="success_25m"), [Contrast(name="x", first="b", second="a", suites=())])
    ('a', 'b')
    """
    ranked = table.loc[~is_apart(table), "matcher"]
    there = [name for name in dict.fromkeys(ranked) if not is_unranked(name)]
    sides = [side.partition(" x ")[0] for item in contrasts for side in (item.second, item.first)]
    named = [name for name in dict.fromkeys(sides) if name in there]
    if len(there) <= MOST_MATCHERS:
        return tuple(dict.fromkeys((*named, *sorted(there))))
    if not named:
        rows = table[(table["stratum"] == ALL) & table["metric"].isin(["success_25m", "recall_1"])]
        means = rows.groupby("matcher")["value"].mean()
        named = sorted(there, key=lambda name: (-means.get(name, 0.0), name))[:MOST_MATCHERS]
    beside = sorted(name for name in there if any(part in name for part in ARMS))
    return tuple(dict.fromkeys((*named, *beside)))


# --- success by what was done -----------------------------------------------------------------------------------------


def ages_frame(steps: pd.DataFrame, queries: pd.DataFrame, measured: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Those steps that are ages of a map, with the ages that the maps really had.

    Parameters
    ----------
    steps : pandas.DataFrame
        From `steps_frame`.
    queries : pandas.DataFrame
        From `queries_of`.
    measured : mapping of str to mapping
        What truths say that was done, by query id.

    Returns
    -------
    pandas.DataFrame
        As `steps`, with age_years, the mean over the queries of a step, and the least and the largest of them.
    """
    ages = [measured.get(name, {}).get(AGE, np.nan) for name in queries["query_id"]]
    known = queries.assign(age_years=ages)
    known = known[known["age_years"].notna() & known["is_present"].to_numpy(bool)]
    known = known[known["role"].isin([CONTROL, STRESS])]
    found = known.groupby([*GROUP, "strength", "view_cells"])["age_years"].agg(["mean", "min", "max"]).reset_index()
    names = {"mean": "age_years", "min": "age_least", "max": "age_most"}
    keys = [*GROUP, "strength", "view_cells"]
    found = found.rename(columns=names).astype({name: steps[name].dtype for name in keys})  # of no steps: no type yet
    return steps.merge(found, on=keys, how="inner")


def age_names(ages: pd.DataFrame) -> dict[tuple[Any, ...], str]:
    """From which to which age the maps of each step are, by suite, track, prior group, strength and size of view.

    Parameters
    ----------
    ages : pandas.DataFrame
        From `ages_frame`.

    Examples
    --------
    >>> step = {"suite": "real-age", "track": "localization", "prior_group": "r500-weak-s3", "strength": 5.0}
    >>> list(age_names(pd.DataFrame([step | {"view_cells": 192, "age_least": 3.58, "age_most": 6.0}])).values())
    ['3.6 to 6.0 years']
    """
    columns = [ages[name] for name in (*GROUP, "strength", "view_cells", "age_least", "age_most")]
    spans = {tuple(key): (f"{least:.1f}", f"{most:.1f}") for *key, least, most in zip(*columns, strict=True)}
    return {key: f"{' to '.join(dict.fromkeys(ends))} years" for key, ends in spans.items()}


def stress_frame(table: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """The figure that matchers are ranked by on the stresses of each suite: rows of the leaderboard."""
    rows = table[(table["rejector"] == "") & table["matcher"].isin(list(shown)) & table["value"].notna()]
    return primary_rows(rows[rows["stratum"] == STRESS])


# --- what is known of the answers -------------------------------------------------------------------------------------


def risk_frame(judged: Mapping[tuple[str, str], pd.DataFrame], shown: Sequence[str]) -> pd.DataFrame:
    """Risk against coverage of matcher x rejector: of each suite with absent places, and of all suites together.

    Parameters
    ----------
    judged : mapping of (matcher, rejector) to pandas.DataFrame
        From `rejection.judge` and `rejection.own_confidence`.
    shown : sequence of str
        Matchers.

    Returns
    -------
    pandas.DataFrame
        suite, track, prior_group, mixture, matcher, rejector, n, answered, aurc, coverage, risk: points of a curve by
        growing coverage. All suites together also in the declared mixtures of present and absent places.
    """
    rows: list[dict[str, Any]] = []
    for (matcher, rejector), frame in judged.items():
        if matcher not in shown:
            continue
        for (track, prior_group), whole in frame.groupby(["track", "prior_group"], sort=True):
            said = {"track": track, "prior_group": prior_group, "matcher": matcher, "rejector": rejector}
            for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]:
                is_pooled = suite == ALL_SUITES
                if is_pooled or not part["is_present"].to_numpy(bool).all():
                    rows += _curves({"suite": suite, **said}, answers_of(part), is_pooled=is_pooled)
    columns = [*GROUP, "mixture", "matcher", "rejector", "n", "answered", "aurc", "coverage", "risk"]
    return pd.DataFrame(rows, columns=columns)


def _curves(said: Mapping[str, Any], some: Answers, *, is_pooled: bool) -> Iterator[dict[str, Any]]:
    mixtures = {AS_DRAWN: np.ones(len(some))}
    if is_pooled and some.is_present.any() and not some.is_present.all():
        mixtures |= {f"present {share:g}": presence_weights(some.is_present, share) for share in PRESENT_SHARES}
    for mixture, mass in mixtures.items():
        curve = risk_coverage(some, mass)
        about = {**said, "mixture": mixture, "n": len(some), "answered": int(some.is_answered.sum())}
        about["aurc"] = aurc(some, mass)
        for at in _thinned(curve.coverage):
            yield {**about, "coverage": curve.coverage[at], "risk": curve.risk[at]}


def _thinned(coverage: Floats) -> Ints:
    """Return which points of a curve are drawn: all of a few, else those nearest to even steps, first and last."""
    if len(coverage) <= _MOST_POINTS:
        return np.arange(len(coverage))
    wanted = np.linspace(0.0, coverage[-1], _MOST_POINTS)
    return np.unique([0, len(coverage) - 1, *np.minimum(np.searchsorted(coverage, wanted), len(coverage) - 1)])


def reliability_frame(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> pd.DataFrame:
    """Return how often answers are false by stated chance, over all suites of a track and prior group.

    Parameters
    ----------
    judged : mapping of (matcher, rejector) to pandas.DataFrame
        From `rejection.judge` and `rejection.own_confidence`.
    calibrated : collection of (matcher, rejector)
        Those that give probabilities.
    shown : sequence of str
        Matchers.

    Returns
    -------
    pandas.DataFrame
        track, prior_group, matcher, rejector, predicted, observed, lo, hi, n, sites: bins of equal mass, of the answers
        alone. Wilson's intervals of as many trials as there are sites.
    """
    rows: list[dict[str, Any]] = []
    for said, part in calibrated_parts(judged, calibrated, shown):
        answered = part[part["is_answered"].to_numpy(bool)]
        p_false = 1.0 - answered["p_right"].to_numpy(float)
        if len(answered) and not np.isnan(p_false).any():
            rows += [{**said, **one} for one in _bins(answered, p_false)]
    columns = ["track", "prior_group", "matcher", "rejector", "predicted", "observed", "lo", "hi", "n", "sites"]
    return pd.DataFrame(rows, columns=columns)


def calibrated_parts(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Yield the answers with probabilities by track and prior group, with their keys."""
    for (matcher, rejector), frame in judged.items():
        if matcher in shown and (matcher, rejector) in calibrated:
            for (track, prior_group), part in frame.groupby(["track", "prior_group"], sort=True):
                said = {"track": track, "prior_group": prior_group, "matcher": matcher, "rejector": rejector}
                yield said, part


def _bins(answered: pd.DataFrame, p_false: Floats) -> Iterator[dict[str, float]]:
    is_false = ~answered["is_right"].to_numpy(bool)
    sites = np.unique(answered["pair_id"], return_inverse=True)[1]
    at = equal_mass_bins(1.0 - p_false)
    for number in np.unique(at):
        mine = at == number
        share, trials = float(is_false[mine].mean()), effective_count(sites[mine])
        found = wilson(min(share * trials, trials), trials)
        yield {
            "predicted": float(p_false[mine].mean()),
            "observed": share,
            "lo": found.lo,
            "hi": found.hi,
            "n": int(mine.sum()),
            "sites": trials,
        }


# --- protection levels ------------------------------------------------------------------------------------------------


def stanford_cells(told: ProtectionLevels) -> pd.DataFrame:
    """Queries counted in cells of error and level, eight to a decade on each side.

    Returns
    -------
    pandas.DataFrame
        error_m, level_m (middles of cells; `BEYOND_M` for what exceeds `MOST_M`) and n.
    """
    cells = pd.DataFrame({"error_m": _middles(told.error_m), "level_m": _middles(told.level_m)})
    return cells.groupby(["error_m", "level_m"]).size().rename("n").reset_index()


def _middles(values_m: Floats) -> Floats:
    """Middle of the cell of each value."""
    within = np.log10(np.clip(values_m, LEAST_M, MOST_M))
    step = np.minimum(np.floor(within * _CELLS_PER_DECADE), round(np.log10(MOST_M) * _CELLS_PER_DECADE) - 1)
    middles = 10 ** ((step + 0.5) / _CELLS_PER_DECADE)
    return np.asarray(np.where(values_m > MOST_M, BEYOND_M, middles))


def stanford_areas(told: ProtectionLevels, limit_m: float) -> dict[str, int]:
    """Count queries that are available, unavailable, misleading and hazardously misleading.

    Misleading ones are those within the alert limit, so that the four add up.

    >>> levels = {"level_m": np.array([5.0, 5.0, 5.0, 99.0]), "error_m": np.array([1.0, 9.0, 60.0, 1.0])}
    >>> some = ProtectionLevels(prior_group="r", method="gauss", risk=0.01, sites=np.array(["a"] * 4), **levels)
    >>> stanford_areas(some, 25.0)
    {'available': 1, 'unavailable': 1, 'misleading': 1, 'hazardous': 1}
    """
    areas: Stanford = stanford(told.level_m, told.error_m, limit_m)
    return {
        "available": int(areas.nominal.sum()),
        "unavailable": int((areas.unavailable | areas.unavailable_misleading).sum()),
        "misleading": int(areas.misleading.sum()),
        "hazardous": int(areas.hazardous.sum()),
    }
