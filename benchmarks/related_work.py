# SPDX-License-Identifier: Apache-2.0
"""Print the paper's table of related work with every cell measured: what each system does where an ability is needed.

    .venv/bin/python -m benchmarks.related_work docs/results/systems

Reads a board of `pipelines/systems.toml`. A cell is a share in percent, and in brackets how it differs (95 %) from what
the same system does on the same places without the difficulty:

- dense: views found within 25 m of suite `clean`, by detectors that err;
- graph: views found where a place and its twin differ in their vectors alone, against the same without vectors;
- persistence: views found on a map ten years old, against the map of the day;
- unknown: views found that are partly hidden (`occlusion`), against the whole view;
- temporal: share of the way within 25 m on flights over maps of all ages, against dead reckoning on the same flights,
  of which the interval of the share itself is given;
- rejection: how often a right answer is more confident than a false one (area under ROC; 50 is chance; the brackets are
  the interval of the figure itself), by the system's own confidence, or by `margin` where it has none; views of all
  suites with a disc of 500 m and a heading known to 20 degrees.

No answer is a miss. Intervals draw places, then blocks and sites in them; a difference that is seen at fewer than six
places has an interval no narrower than that of Wilson's for views won and lost. `-` is not applicable, or too few to
say.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from benchmarks.sim_to_real import estimate, line
from sasgeo_bench.errors import SasgeoError
from sasgeo_bench.leaderboard.board_files import read_board as read_table
from sasgeo_bench.leaderboard.board_files import read_scores
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
    """A column: which stressed views show it, and whether their controls are what they are compared with."""

    name: str
    is_shown: Callable[[pd.DataFrame], pd.Series]
    is_compared: bool = True


ABILITIES = (
    Ability("Dense", lambda rows: rows["suite"] == "clean", is_compared=False),
    Ability("Graph", lambda rows: rows["suite"].isin(TWINS)),
    Ability("Persistence", lambda rows: (rows["suite"] == "real-age") & (rows["strength"] == 10)),  # noqa: PLR2004 - years
    Ability("Unknown", lambda rows: rows["suite"] == "occlusion"),
)
HEAD = "| Row of the paper, or system | Dense | Graph | Temporal | Persistence | Unknown | Rejection |"
RULE = "|---|---:|---:|---:|---:|---:|---:|"


def read_board(board: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return scores of views and flights, with `hit` and `is_control`, and the leaderboard's rows about rejection."""
    _, rows = read_table(board)
    scores = read_scores(board)
    scores = scores.reindex(columns=scores.columns.union([WAY]))  # a board without flights has none
    text = {name: scores[name].astype(str) for name in ("matcher", "place", "block", "pair_id", "role", "kind")}
    is_control = scores["matcher"].isin(rows.loc[rows["is_control"], "matcher"])
    hit = (scores["position_error_m"] <= 25.0).astype(float)  # noqa: PLR2004 - the radius
    scores = scores.assign(hit=hit, is_control=is_control, **text)
    wanted = {"metric": "auroc", "suite": "all suites", "stratum": "as drawn", "track": "localization"}
    wanted["prior_group"] = PRIOR
    return scores, rows[(rows[list(wanted)] == pd.Series(wanted)).all(axis=1)]


def views_of(scores: pd.DataFrame, matcher: str, ability: Ability) -> pd.DataFrame:
    """Return the views that show an ability, with `gain` over the control of the same site and size."""
    own = scores[(scores["matcher"] == matcher) & (scores["track"] == "localization") & scores["is_present"]]
    shown = own[(own["role"] == "stress") & ability.is_shown(own)]
    if not ability.is_compared:
        return shown.assign(gain=shown["hit"])
    site = ["suite", "pair_id", "view_cells"]
    control = own[own["role"] == "control"].groupby(site)["hit"].mean().rename("without")
    found = shown.join(control, on=site, how="inner")
    return found.assign(gain=found["hit"] - found["without"])


def flights_of(scores: pd.DataFrame, tracker: str) -> pd.DataFrame:
    """Return the flights of a tracker, with `gain` over dead reckoning on the same flight."""
    flown = scores[(scores["track"] == SEQUENCE) & (scores["role"] != "falsifier")]
    bare = flown[flown["matcher"] == DEAD].set_index("query_id")[WAY].rename("without")
    own = flown[flown["matcher"] == tracker].join(bare, on="query_id", how="inner")
    return own.assign(hit=own[WAY], gain=own[WAY] - (0.0 if tracker == DEAD else own["without"]))


def cell(rows: pd.DataFrame, *, is_compared: bool) -> str:
    """Return a share in percent and the interval of the difference, or of the share itself where none is compared."""
    if rows.empty:
        return "-"
    _, lo, hi = estimate(rows, rows["gain"])
    places = rows.loc[rows["gain"] != 0, "place"].nunique()
    if is_compared and places < LEAST_CLUSTERS:  # draws of so few say too little
        won, lost = (rows["gain"].mul(sign).clip(lower=0).mean() for sign in (1, -1))
        wide = difference_interval(*(wilson_share(share, rows["pair_id"].nunique()) for share in (won, lost)))
        lo, hi = min(lo, 100 * wide.lo), max(hi, 100 * wide.hi)
    signed = f"{lo:+.0f} to {hi:+.0f}" if is_compared else f"{lo:.0f} to {hi:.0f}"
    return f"{100 * rows['hit'].mean():.0f} ({signed})"


def rejection(rows: pd.DataFrame, matcher: str) -> str:
    """Return the area under ROC in percent and its interval, of a matcher's own confidence or else of `margin`."""
    own = rows[(rows["matcher"] == matcher) & rows["value"].notna()].set_index("rejector")
    name = next((name for name in REJECTORS if name in own.index), None)
    if name is None:
        return "-"
    row = own.loc[name]
    return f"{100 * row['value']:.0f} ({100 * row['lo']:.0f} to {100 * row['hi']:.0f})"


def lines(scores: pd.DataFrame, rejectors: pd.DataFrame) -> Iterator[str]:
    """Yield the table: systems of the paper in its order, SASGeo last of them, then all others by name."""
    systems = {tracker: matcher for matcher, tracker in TRACKS.items()}
    is_listed = ~scores["is_control"] | (scores["matcher"] == DEAD)
    asked = sorted({systems.get(name, name) for name in scores.loc[is_listed, "matcher"].unique()})
    yield HEAD
    yield RULE
    for matcher in (*(name for name in PAPER if name in asked), *(name for name in asked if name not in PAPER)):
        named = " and ".join(f"`{name}`" for name in (matcher, TRACKS.get(matcher)) if name)
        cells = [cell(views_of(scores, matcher, each), is_compared=each.is_compared) for each in ABILITIES]
        flown = cell(flights_of(scores, TRACKS.get(matcher, matcher)), is_compared=matcher != DEAD)
        name = f"{PAPER[matcher]}: {named}" if matcher in PAPER else named
        yield line(name, *cells[:2], flown, *cells[2:], rejection(rejectors, matcher))


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
