# SPDX-License-Identifier: Apache-2.0
"""Print the paper's table of related work with every cell measured: what each system does where an ability is needed.

    .venv/bin/python -m benchmarks.related_work docs/results/systems

Reads a board of `pipelines/systems.toml`. Cells are percent. Two columns are figures of the board with their intervals:

- dense: views found within 25 m of suite `clean`, by detectors that err;
- rejection: how often a right answer is more confident than a false one (area under ROC; 50 is chance), by the system's
  own confidence, or by `margin` where it has none; views of all suites with a disc of 500 m and a heading known to 20
  degrees.

The others are a share, what it is more or less than the same system has on the same places without the difficulty, and
the interval of this difference (95 %):

- graph: views found within 25 m where a place and its twin differ in their vectors alone, against the same without;
- persistence: views found on a map ten years old, against the map of the day;
- unknown: views found that are partly hidden (`occlusion`), against the whole view;
- temporal: share of the way within 25 m on flights over maps of all ages, against dead reckoning on the same flights.

No answer is a miss. Intervals of differences draw places, then blocks and sites in them; one that is seen at fewer than
six places is no narrower than Wilson's for views won and lost, and none reaches beyond what can be. `-` is not
applicable, or too few to say.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.sim_to_real import estimate, line
from sasgeo_bench.boards.board_files import MEND, SCHEMAS, read_board_manifest, read_leaderboard, read_scores
from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.texts import markdown_code
from sasgeo_bench.scoring.intervals import LEAST_CLUSTERS, difference_interval, wilson_share

PAPER = {
    "vojir_instance_rays": "Vojir 2020",
    "zhou_smc": "Zhou 2021",
    "ouyang_shape_votes": "Ouyang 2024",
    "hu_map_only": "Hu 2024 (map alone)",
    "vecmap_phasecorr": "VecMapLocNet 2025",
    "zhang_hier_consensus": "Zhang 2025",
    "liu_object_graph": "Liu 2025",
    "swapf": "SWA-PF 2025",
    "schmidt_segcorr": "Schmidt 2025",
    "zilke_semantic_mi": "Zilke 2025",
    "popov_roadplane": "Popov 2026",
    "u1652_instance_retrieval": "University-1652",
    "sues_multi_height": "SUES-200",
    "lcm_balanced": "LCM 2021",
    "vio_dead_reckoning": "VINS-Mono (its odometry alone)",
    "sasgeo": "SASGeo",
}
TRACKS = {"ouyang_shape_votes": "ouyang_cfbvm_pf", "sasgeo": "sasgeo_track"}  # tracker of the same system
TWINS = ("topology-twins", "instance-twins", "grade-separation")
SEQUENCE = "sequence"
DEAD = "dead_reckoning"
WAY = "distance_within_25m"
PRIOR = "r500-weak-s3"  # a disc of 500 m, heading to 20 degrees, scale to 3 %: that of nearly all views
REJECTORS = ("own", "margin")  # the first that a system has


@dataclass(frozen=True, slots=True)
class Ability:
    """A column of differences: which stressed views show it."""

    name: str
    is_shown: Callable[[pd.DataFrame], pd.Series]


ABILITIES = (
    Ability("Graph", lambda rows: rows["suite"].isin(TWINS)),
    Ability("Persistence", lambda rows: (rows["suite"] == "real-age") & (rows["strength"] == 10)),  # years
    Ability("Unknown", lambda rows: rows["suite"] == "occlusion"),
)
DENSE = {"metric": "within_25m", "suite": "clean", "stratum": "stress", "rejector": ""}
REJECTION = {"metric": "auroc", "suite": "all suites", "stratum": "as drawn"}
HEAD = "| Row of the paper, or system | Dense | Graph | Temporal | Persistence | Unknown | Rejection |"
RULE = "|---|---:|---:|---:|---:|---:|---:|"
TEXTS = ("block", "pair_id")
NUMBERS = {"strength": np.inf, "view_cells": np.inf, "position_error_m": np.inf, WAY: 1.0}  # at most


def read_board(board: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return scores of views and flights, with `hit` and `is_control`, and the leaderboard's rows of two columns."""
    read_board_manifest(board)  # which says in a line where there is no board
    rows = read_leaderboard(board)
    SCHEMAS["leaderboard"].check(rows)
    scores = read_scores(board)
    scores = scores.reindex(columns=scores.columns.union([WAY]))  # a board without flights has none
    text = ("matcher", "suite", "track", "kind", "role", "place", *TEXTS)
    scores = scores.astype({name: object for name in text if name in scores})
    SCHEMAS["scores"].check(scores)
    check_columns(scores)
    is_control = scores["matcher"].isin(rows.loc[rows["is_control"], "matcher"])
    hit = (scores["position_error_m"] <= 25.0).astype(float)  # the radius
    own = (rows["track"] == "localization") & (rows["prior_group"] == PRIOR)
    of_column = [(rows[list(wanted)] == pd.Series(wanted)).all(axis=1) for wanted in (DENSE, REJECTION)]
    found = rows[own & np.logical_or(*of_column)]
    if found.duplicated(["matcher", "metric", "rejector"]).any():
        raise StoreError(f"{board}: leaderboard.parquet says one figure twice: {MEND}")
    return scores.assign(hit=hit, is_control=is_control), found


def check_columns(scores: pd.DataFrame) -> None:
    """Refuse scores whose columns, beyond those of any board, do not hold what the table needs.

    A missing number is no answer.
    """
    if scores.empty:
        raise StoreError(f"scores.parquet holds no view and no flight: {MEND}")
    for name in (*TEXTS, *NUMBERS):
        if name not in scores:
            raise StoreError(f"scores.parquet has no column {name!r}: {MEND}")
        values = scores[name]
        if name in TEXTS:
            is_right = values.map(lambda one: isinstance(one, str)).all()
        else:
            is_right = pd.api.types.is_numeric_dtype(values) and not ((values < 0) | (values > NUMBERS[name])).any()
        if not is_right:
            raise StoreError(f"scores.parquet: {name} holds something else than it should, or nothing: {MEND}")


def views_of(scores: pd.DataFrame, matcher: str, ability: Ability) -> pd.DataFrame:
    """Return the views that show an ability, with `without`, what the controls of the same site and size have."""
    own = scores[(scores["matcher"] == matcher) & (scores["track"] == "localization") & scores["is_present"]]
    shown = own[(own["role"] == "stress") & ability.is_shown(own)]
    site = ["suite", "pair_id", "view_cells"]
    control = own[own["role"] == "control"].groupby(site)["hit"].mean().rename("without")
    return shown.join(control, on=site, how="inner")


def flights_of(scores: pd.DataFrame, tracker: str) -> pd.DataFrame:
    """Return the flights of a tracker, with `without`, what dead reckoning has on the same flight."""
    flown = scores[(scores["track"] == SEQUENCE) & (scores["role"] != "falsifier")]
    flown = flown.assign(hit=flown[WAY].fillna(0.0))  # no answer is a miss
    bare = flown[flown["matcher"] == DEAD].set_index("query_id")["hit"].rename("without")
    return flown[flown["matcher"] == tracker].join(bare, on="query_id", how="inner")


def cell(rows: pd.DataFrame) -> str:
    """Return a share, its difference from `without`, and the interval of this difference, in percent."""
    if rows.empty:
        return "-"
    gain, least = rows["hit"] - rows["without"], -100 * rows["without"].mean()
    value, lo, hi = estimate(rows, gain)
    if rows.loc[gain != 0, "place"].nunique() < LEAST_CLUSTERS:  # draws of so few say too little
        won, lost = (gain.mul(sign).clip(lower=0).mean() for sign in (1, -1))
        wide = difference_interval(*(wilson_share(share, rows["pair_id"].nunique()) for share in (won, lost)))
        lo, hi = min(lo, 100 * wide.lo), max(hi, 100 * wide.hi)
    lo, hi = max(lo, least) + 0.0, min(hi, 100 + least)  # no "-0"
    return f"{100 * rows['hit'].mean():.0f}, {value:+.0f} ({lo:+.0f} to {hi:+.0f})"


def figure(rows: pd.DataFrame, matcher: str, metric: str, rejectors: Sequence[str] = ("",)) -> str:
    """Return a figure of the board and its interval in percent, of the first of some rejectors that has one."""
    own = rows[(rows["matcher"] == matcher) & (rows["metric"] == metric)].set_index("rejector")
    own = own[np.isfinite(own[["value", "lo", "hi"]]).all(axis=1)]
    name = next((name for name in rejectors if name in own.index), None)
    if name is None:
        return "-"
    value, lo, hi = (100 * own.loc[name, each] for each in ("value", "lo", "hi"))
    return f"{value:.0f} ({lo:.0f} to {hi:.0f})"


def lines(scores: pd.DataFrame, figures: pd.DataFrame) -> Iterator[str]:
    """Yield the table: systems of the paper in its order, SASGeo last of them, then all others by name."""
    systems = {tracker: matcher for matcher, tracker in TRACKS.items()}
    asked = set(scores.loc[~scores["is_control"] | (scores["matcher"] == DEAD), "matcher"])
    listed = sorted({systems.get(name, name) for name in asked})
    yield HEAD
    yield RULE
    for matcher in (*(name for name in PAPER if name in listed), *(name for name in listed if name not in PAPER)):
        tracker = TRACKS.get(matcher, matcher)
        named = " and ".join(markdown_code(name) for name in dict.fromkeys((matcher, tracker)) if name in asked)
        graph, *others = (cell(views_of(scores, matcher, each)) for each in ABILITIES)
        flights = flights_of(scores, tracker)
        flown = f"{100 * flights['hit'].mean():.0f}" if matcher == DEAD and len(flights) else cell(flights)
        name = f"{PAPER[matcher]}: {named}" if matcher in PAPER else named
        dense = figure(figures, matcher, DENSE["metric"])
        yield line(name, dense, graph, flown, *others, figure(figures, matcher, REJECTION["metric"], REJECTORS))


def main(words: Sequence[str] | None = None) -> None:
    """Print the table of a board."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board", type=Path)
    options = parser.parse_args(words)
    try:
        table = list(lines(*read_board(options.board)))
    except SasgeoError as error:
        parser.error(str(error))
    print(*table, sep="\n")


if __name__ == "__main__":
    main()
