# SPDX-License-Identifier: Apache-2.0
"""The figures that a board has, by name: what there are data for is drawn, and of the rest a line says why not."""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.boards.board_files import AdditionalFiles
from sasgeo_bench.boards.flight_plots import (
    distance_frame,
    draw_distance,
    draw_drift,
    draw_intervals,
    drift_frame,
    interval_frame,
    kinds_of,
)
from sasgeo_bench.boards.plots import (
    ages_frame,
    draw_ages,
    draw_bars,
    draw_forest,
    draw_reliability,
    draw_risk,
    draw_stanford,
    draw_steps,
    ranked_matchers,
    reliability_frame,
    risk_frame,
    shown_matchers,
    stress_frame,
)
from sasgeo_bench.boards.pooled_plots import (
    COSTS,
    ablation_frame,
    cost_frame,
    draw_ablation,
    draw_costs,
    draw_errors,
    draw_prices,
    draw_recall,
    errors_frame,
    price_frame,
    recall_frame,
)
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.core.progress import tell
from sasgeo_bench.scoring.contrasts import Contrast, by_place
from sasgeo_bench.scoring.protection import ProtectionLevels, protection_levels
from sasgeo_bench.scoring.score import FIX_M, single_views
from sasgeo_bench.scoring.strata import GROUP, queries_of, steps_frame
from sasgeo_bench.tasks.split import Split

Draw = Callable[[Path], object]
Named = Iterator[tuple[tuple[str, ...], Draw]]  # parts of the name of a file, and what draws it
MOST_STANFORD: Final = 5  # matchers
FIGURES: Final = {  # kinds by how the names of their files begin, in the order in which a site shows them
    "contrast": "registered contrasts, place by place",
    "stress": "success under stress",
    "age": "success against the age of the map",
    "strength": "success against strength",
    "distance": "error along the way",
    "interval": "how far the odometer carries a fix",
    "risk": "risk against coverage",
    "reliability": "reliability",
    "stanford": "protection levels against errors",
    "ablation": "arms side by side",
    "recall": "recall against K",
    "errors": "the distribution of errors",
    "price": "success against cost",
    "cost": "the cost of decisions",
    "drift": "success against the drift of odometers",
}
OTHERS: Final = ("ablation", "recall", "errors", "price", "cost", "drift")  # stand together on a site
_PLAIN: Final = re.compile(r"[^A-Za-z0-9.]+")


def figures_extra(scored: Scored, *, contrasts: Sequence[Contrast] = (), split: Split | None = None) -> AdditionalFiles:
    """Return the figures of a board, as SVG.

    Report the kinds of figures that lack data. `contrasts` are the registered ones; `split` assigns the
    places that calibrate conformal protection levels.
    """
    table, scores = scored.board.leaderboard, scored.scores
    shown = shown_matchers(table, contrasts)
    queries = queries_of(scores)
    alone = {name: single_views(frame) for name, frame in scores.items()}
    steps = steps_frame(table, queries, shown)
    if steps.empty:  # a table without a row does not know its types, by which it is held against others
        steps = steps.astype({name: queries[name].dtype for name in ("strength", "view_cells")})
    ages = ages_frame(steps, queries, scored.measured)
    # An age is no other strength: where maps have ages, those are the axis.
    others = steps[~steps["suite"].isin(set(ages["suite"]))]
    chances = table[table["metric"] == "ece"]  # of the matchers x rejectors that give probabilities
    calibrated = set(zip(chances["matcher"], chances["rejector"], strict=True))
    judged, groups = scored.judged, GROUP[1:]

    def each(rows: pd.DataFrame, columns: Sequence[str], draw: Callable[..., object]) -> Named:
        """Yield a figure for each group of rows; prior groups are never together."""
        for key, part in rows.groupby(list(columns), sort=True):
            yield tuple(map(str, key)), partial(draw, rows=part, shown=shown)

    kinds: dict[str, Callable[[], Named]] = {
        "contrast": lambda: _forests(scored, contrasts),
        "stress": lambda: each(stress_frame(table, shown), groups, draw_bars),
        "age": lambda: each(ages, GROUP, draw_ages),
        "strength": lambda: each(others, GROUP, draw_steps),
        "distance": lambda: each(distance_frame(scored.views, scores, shown), GROUP, draw_distance),
        "interval": lambda: each(interval_frame(table, kinds_of(scores), shown), GROUP, draw_intervals),
        "risk": lambda: each(risk_frame(judged, shown), GROUP, draw_risk),
        "reliability": lambda: each(reliability_frame(judged, calibrated, shown), groups, draw_reliability),
        "stanford": lambda: _stanfords(scored, shown, split),
        "ablation": lambda: each(ablation_frame(scores, contrasts, shown), groups, draw_ablation),
        "recall": lambda: each(recall_frame(alone, scored.predictions, scored.truths, shown), groups, draw_recall),
        "errors": lambda: each(errors_frame(alone, table, shown), groups, draw_errors),
        "price": lambda: each(_priced(scored), groups, draw_prices),
        "cost": lambda: each(cost_frame(judged, calibrated, shown), groups, draw_costs),
        "drift": lambda: each(drift_frame(table, shown), groups, draw_drift),
    }
    drawn: dict[str, Draw] = {}
    empty = []
    for stem, what in FIGURES.items():
        with scored.failures.of(f"figures of {what}"):
            found = {_file_name(stem, *names): draw for names, draw in kinds[stem]()}
            drawn |= found
            empty += [] if found else [what]
    if empty:
        tell(f"figures left out, for nothing on this board is seen in them: {'; '.join(empty)}")
    return AdditionalFiles(figures=drawn)


def _file_name(*parts: str) -> str:
    return f"{_PLAIN.sub('-', '-'.join(parts)).strip('-').lower()}.svg"


def _priced(scored: Scored) -> pd.DataFrame:
    """Return the ranked matchers with some known cost, for who is cheap need not be among the few that are shown."""
    rows = price_frame(scored.board.leaderboard, scored.scores, ranked_matchers(scored.board.leaderboard))
    known: pd.DataFrame = rows[np.isfinite(rows[list(COSTS.values())].to_numpy(float)).any(axis=1)]
    return known


def _forests(scored: Scored, contrasts: Sequence[Contrast]) -> Named:
    for contrast, finding in zip(contrasts, scored.board.findings, strict=True):
        places = by_place(contrast, scored.scores, scored.judged) if finding.n else ()
        if places:
            yield (contrast.name,), partial(draw_forest, contrast=contrast, finding=finding, places=places)


def _stanfords(scored: Scored, shown: Sequence[str], split: Split | None) -> Named:
    """Yield a panel for each matcher and method, of few matchers, those of contrasts first."""
    found: dict[tuple[str, float], dict[tuple[str, str], ProtectionLevels]] = {}
    for matcher in (name for name in shown if name in scored.scores):
        for item in protection_levels(scored.scores[matcher], scored.predictions[matcher].lean(), split):
            key = item.prior_group, item.risk
            rows = {name for name, _ in found.get(key, ())} | {matcher}
            if len(item.level_m) and len(rows) <= MOST_STANFORD:
                found.setdefault(key, {})[matcher, item.method] = item
    for (prior_group, risk), levels in sorted(found.items()):
        yield (f"{risk:g}", prior_group), partial(draw_stanford, levels=levels, limit_m=FIX_M)
