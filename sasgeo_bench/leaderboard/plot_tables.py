# SPDX-License-Identifier: Apache-2.0
"""The tables behind the figures of a board: one row for each point, bar or cell that is drawn."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Floats, Ints, codes_of
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.decisions import Fixes, equal_mass_bins, stanford
from sasgeo_bench.scoring.integrity_metric import aurc, risk_coverage
from sasgeo_bench.scoring.intervals import effective_count, wilson_share
from sasgeo_bench.scoring.metrics import TRACKS, primary_of
from sasgeo_bench.scoring.protection import ProtectionLevels
from sasgeo_bench.scoring.rejection_rows import answers_of, mixtures_of
from sasgeo_bench.scoring.rows import ALL_SUITES, is_apart, is_unranked
from sasgeo_bench.scoring.strata import ALL, CONTROL, GROUP, STRESS, primary_rows
from sasgeo_bench.tasks.query import SEQUENCE

MOST_MATCHERS: Final = 8  # more cannot be distinguished at a glance
ARMS: Final = ("uniform", "hand", "oracle")  # parts of names of matchers that are shown with those of contrasts
AGE: Final = "age_years"  # as measured by truths
_MOST_POINTS: Final = 80  # of a curve: more cannot be seen, and make a file large
_CELLS_PER_DECADE: Final = 8
LEAST_M: Final = 0.1  # what is less is drawn here
MOST_M: Final = 1000.0  # what is more, or infinite, is drawn beyond
BEYOND_M: Final = 1500.0


def ranked_matchers(table: pd.DataFrame) -> list[str]:
    """Return the matchers that are neither controls nor set apart, in the order of the table."""
    return [name for name in dict.fromkeys(table.loc[~is_apart(table), "matcher"]) if not is_unranked(name)]


def shown_matchers(table: pd.DataFrame, contrasts: Sequence[Contrast]) -> tuple[str, ...]:
    """Return the matchers that figures show, those of contrasts first, the second of each before the first.

    Controls and entries that are set apart are not shown. Of more than `MOST_MATCHERS` only those of contrasts are, or
    without contrasts the best on single views and the best on flights, and the `ARMS`.

    >>> board = pd.DataFrame({"matcher": ["b", "a", "oracle_pose"], "rejector": "", "stratum": "all", "value": 0.5})
    >>> shown_matchers(board.assign(metric="success_25m"), [Contrast(name="x", first="b", second="a", suites=())])
    ('a', 'b')
    """
    there = ranked_matchers(table)
    sides = [side.partition(" x ")[0] for item in contrasts for side in (item.second, item.first)]
    named = [name for name in dict.fromkeys(sides) if name in there]
    if len(there) <= MOST_MATCHERS:
        return tuple(dict.fromkeys((*named, *sorted(there))))
    if not named:
        flown = primary_of(SEQUENCE).name
        single = {primary_of(track).name for track in TRACKS} - {flown}
        named = [*_best(table, there, single), *_best(table, there, {flown})]
    related = sorted(name for name in there if any(part in name for part in ARMS))
    return tuple(dict.fromkeys((*named, *related)))


def _best(table: pd.DataFrame, there: Sequence[str], metrics: Collection[str]) -> list[str]:
    """Return the matchers that are best by some metrics in the mean of all suites; who has none of them is left out."""
    rows = table[(table["stratum"] == ALL) & table["metric"].isin(metrics)]
    means = rows.groupby("matcher")["value"].mean()
    return sorted((name for name in there if name in means), key=lambda name: (-means[name], name))[:MOST_MATCHERS]


# --- success by what was done -----------------------------------------------------------------------------------------


def ages_frame(steps: pd.DataFrame, queries: pd.DataFrame, measured: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Return the steps that are ages of a map, with age_years, the mean over their queries, and age_least and age_most.

    `steps` is from `steps_frame`, `queries` from `queries_of`, `measured` the measurements of truths by query id.
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
    """Return the range of ages of each step of `ages_frame`, by suite, track, prior group, strength and size of view.

    >>> step = {"suite": "real-age", "track": "localization", "prior_group": "r500-weak-s3", "strength": 5.0}
    >>> list(age_names(pd.DataFrame([step | {"view_cells": 192, "age_least": 3.58, "age_most": 6.0}])).values())
    ['3.6 to 6.0 years']
    """
    columns = [ages[name] for name in (*GROUP, "strength", "view_cells", "age_least", "age_most")]
    spans = {tuple(key): (f"{least:.1f}", f"{most:.1f}") for *key, least, most in zip(*columns, strict=True)}
    return {key: f"{' to '.join(dict.fromkeys(ends))} years" for key, ends in spans.items()}


def stress_frame(table: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """Return the rows of the primary metric on the stresses of each suite."""
    rows = table[(table["rejector"] == "") & table["matcher"].isin(list(shown)) & table["value"].notna()]
    return primary_rows(rows[rows["stratum"] == STRESS])


# --- what is known of the answers -------------------------------------------------------------------------------------


class JudgedKey(NamedTuple):
    """Whose answers, of which queries, by which rejector."""

    track: str
    prior_group: str
    matcher: str
    rejector: str


def risk_frame(judged: Mapping[tuple[str, str], pd.DataFrame], shown: Sequence[str]) -> pd.DataFrame:
    """Return risk against coverage by matcher and rejector, of each suite with absent places and of all together.

    `judged` is from `rejection.judge` and `rejection.own_confidence`. The columns are suite, track, prior_group,
    mixture, matcher, rejector, n, answered, aurc, coverage and risk: points of a curve by growing coverage. All suites
    together also come in the declared mixtures of present and absent places.
    """
    rows: list[tuple[str | float, ...]] = []
    for key, whole in _parts(judged, shown):
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]:
            is_pooled = suite == ALL_SUITES
            if is_pooled or not part["is_present"].to_numpy(bool).all():
                rows += _curves(str(suite), key, answers_of(part), is_pooled=is_pooled)
    columns = [*GROUP, "mixture", "matcher", "rejector", "n", "answered", "aurc", "coverage", "risk"]
    return pd.DataFrame(rows, columns=columns)


def _curves(suite: str, key: JudgedKey, some: Fixes, *, is_pooled: bool) -> Iterator[tuple[str | float, ...]]:
    """Yield rows of `risk_frame`."""
    for mixture, mass in mixtures_of(some, is_pooled=is_pooled):
        curve = risk_coverage(some, mass)
        about = (suite, key.track, key.prior_group, mixture, key.matcher, key.rejector)
        figures = (len(some), int(some.is_answered.sum()), aurc(some, mass))
        for at in _thinned(curve.coverage):
            yield (*about, *figures, curve.coverage[at], curve.risk[at])


def _thinned(coverage: Floats) -> Ints:
    """Return which points of a curve are drawn: all of a few, else those nearest to even steps, first and last."""
    if len(coverage) <= _MOST_POINTS:
        return np.arange(len(coverage))
    even = np.linspace(0.0, coverage[-1], _MOST_POINTS)
    return np.unique([0, len(coverage) - 1, *np.minimum(np.searchsorted(coverage, even), len(coverage) - 1)])


def reliability_frame(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> pd.DataFrame:
    """Return how often answers are false by stated chance, over all suites of a track and prior group.

    `judged` is as for `risk_frame`, `calibrated` names the matchers and rejectors that give probabilities. The columns
    are track, prior_group, matcher, rejector, predicted, observed, lo, hi, n and sites: bins of equal mass, of the
    answers alone, with Wilson's intervals of as many trials as there are sites.
    """
    rows: list[tuple[str | float, ...]] = []
    for key, part in calibrated_parts(judged, calibrated, shown):
        answered = part[part["is_answered"].to_numpy(bool)]
        p_false = 1.0 - answered["p_right"].to_numpy(float)
        if len(answered) and not np.isnan(p_false).any():
            rows.extend((*key, *one) for one in _bins(answered, p_false))
    return pd.DataFrame(rows, columns=[*JudgedKey._fields, "predicted", "observed", "lo", "hi", "n", "sites"])


def calibrated_parts(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> Iterator[tuple[JudgedKey, pd.DataFrame]]:
    """Yield the answers with probabilities by track and prior group, with their keys."""
    yield from _parts({key: frame for key, frame in judged.items() if key in calibrated}, shown)


def _parts(
    judged: Mapping[tuple[str, str], pd.DataFrame], shown: Sequence[str]
) -> Iterator[tuple[JudgedKey, pd.DataFrame]]:
    for (matcher, rejector), frame in judged.items():
        if matcher in shown:
            for (track, prior_group), part in frame.groupby(["track", "prior_group"], sort=True):
                yield JudgedKey(str(track), str(prior_group), matcher, rejector), part


def _bins(answered: pd.DataFrame, p_false: Floats) -> Iterator[tuple[float, ...]]:
    """Yield predicted, observed, lo, hi, n and sites of each bin."""
    is_false = ~answered["is_right"].to_numpy(bool)
    sites = codes_of(answered["pair_id"])
    at = equal_mass_bins(1.0 - p_false)
    for number in np.unique(at):
        mine = at == number
        share, trials = float(is_false[mine].mean()), effective_count(sites[mine])
        found = wilson_share(share, trials)
        predicted = float(p_false[mine].mean())
        yield predicted, share, found.lo, found.hi, int(mine.sum()), trials


# --- protection levels ------------------------------------------------------------------------------------------------


def stanford_cells(levels: ProtectionLevels) -> pd.DataFrame:
    """Count queries in cells of error_m and level_m, eight to a decade on each side; n of each middle of a cell.

    Values that exceed `MOST_M` are at `BEYOND_M`.
    """
    cells = pd.DataFrame({"error_m": _middles(levels.error_m), "level_m": _middles(levels.level_m)})
    return cells.groupby(["error_m", "level_m"]).size().rename("n").reset_index()


def _middles(values_m: Floats) -> Floats:
    """Return the middle of the cell of each value."""
    within = np.log10(np.clip(values_m, LEAST_M, MOST_M))
    step = np.minimum(np.floor(within * _CELLS_PER_DECADE), round(np.log10(MOST_M) * _CELLS_PER_DECADE) - 1)
    middles = 10 ** ((step + 0.5) / _CELLS_PER_DECADE)
    return np.asarray(np.where(values_m > MOST_M, BEYOND_M, middles))


def stanford_areas(levels: ProtectionLevels, limit_m: float) -> dict[str, int]:
    """Count queries that are available, unavailable, misleading and hazardously misleading.

    Misleading ones are those within the alert limit, so that the four add up.
    """
    areas = stanford(levels.level_m, levels.error_m, limit_m)
    return {
        "available": int(areas.nominal.sum()),
        "unavailable": int((areas.unavailable | areas.unavailable_misleading).sum()),
        "misleading": int(areas.misleading.sum()),
        "hazardous": int(areas.hazardous.sum()),
    }
