# SPDX-License-Identifier: Apache-2.0
"""Print the tables of the page of claims (`docs/results/README.md`) from stored boards, and draw its figure.

    python -m benchmarks.claims docs/results/places docs/results/places-silent docs/results/modules \
        docs/results/flights --figure docs/figures/claims.svg

The first board is that of the experiment; the others have contrasts that it did not ask again. Tables are of Markdown,
figures in hundredths ("points") with intervals of 95 %: by countries where there are six, else by places. Verdicts are
the board's: *yes* (where the first side is better without the stress, too, the stress is not shown to be the cause),
*no* (the other side is better), *equal* (the interval lies within what was registered to matter), *smaller than
matters*, or *not decided*. Scenes, sealed places and places that were tried before are described, without a test.
"""

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.boards.archive_file import is_pack
from sasgeo_bench.boards.board import Board, read_board
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.scoring.compare import Finding

SCORER, BEFORE, PLAIN = "sasgeo", "sasgeo_gains", "sasgeo_raster"
OWN: Final = "sasgeo"  # names of variants begin with it
FOUND: Final = "success_25m"
TRIED: Final = ("krems", "london", "vaduz")  # the scorer was tried there before its numbers were chosen on train places
SEARCHED: Final = ("clean", "volatile-lure")  # suites of which it is told what the search leaves to the score
LEAST_VIEWS: Final = 20  # of a scene
# Pairs that no contrast asks: suite, kinds of views, and the two.
BESIDE: Final = (
    ("natural-twins", ("N1",), SCORER, "schmidt_segcorr"),
    ("natural-twins", ("N1 vectors",), SCORER, "schmidt_segcorr"),
    ("natural-twins", ("N1 vectors",), SCORER, "raster_soft"),
    ("natural-twins", ("unrivalled N1 vectors",), SCORER, "sasgeo_no_graph"),
    ("natural-twins", ("N1 vectors", "unrivalled N1 vectors"), SCORER, "sasgeo_no_graph"),
    ("local-warp", ("G1 rows", "G1 tilt"), SCORER, "sasgeo_no_graph"),
    ("volatile-lure", ("S2",), SCORER, "sasgeo_even"),
    ("clean", ("perception",), SCORER, PLAIN),
    ("absent", ("feature-poor",), SCORER, "schmidt_segcorr"),
    ("occlusion", ("U4 adversarial",), SCORER, "schmidt_segcorr"),
)
POOR: Final = 0.05  # share of a view that is mapped


@dataclass(frozen=True, slots=True)
class Goal:
    """A goal that was set beforehand: rows of the leaderboard, and the figure to reach."""

    what: str
    suite: str
    stratum: str
    wanted: float


GOALS: Final = (
    Goal("clean views at 0.5 to 4 times the error", "clean", "perception", 0.844),
    Goal("maps of ten years", "real-age", "S1 10, 192 cells", 0.874),
    Goal("lures with today's fields and sheds", "volatile-lure", "S2", 0.713),
)
TWINS, AHEAD = ("natural-twins", "N1 vectors"), 0.1  # over the best system that compares layers


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim of the paper, the registered contrast that asks it, and what would change the answer."""

    what: str
    board: str
    contrast: str
    change: str


CLAIMS: Final = (
    Claim(
        "Dense geometry (with the terms of version 6) finds what a global description does not",
        "places",
        "geometry",
        "a description that is more than shares of classes",
    ),
    Claim("The scorer finds more than plain correlation, on clean views", "places", "scorer", "views of other errors"),
    Claim("- against lures with today's fields and sheds", "places", "scorer-lure", "lures that exist"),
    Claim("- among real look-alikes", "places", "scorer-twins", "more look-alikes"),
    Claim("- and more than it found before version 6", "places", "scorer-terms", "views of other errors"),
    Claim(
        "The graph tells apart places that are copies but for junctions",
        "modules",
        "graph-junctions",
        "copies that exist",
    ),
    Claim("- but for the number of buildings", "modules", "graph-instances", "copies that exist"),
    Claim("The graph tells apart real look-alikes", "places", "graph-natural", "more of them; vectors by a network"),
    Claim("The graph helps where views are bent", "modules", "graph-warp", "a map that bends as real ones do"),
    Claim("Distinctive configurations should weigh more (Eq. 6)", "places", "distinct", "more look-alikes"),
    Claim(
        "Overlap of areas should yield to lines that are seen (one weight of Eq. 11), where areas lie",
        "places",
        "adaptive-lure",
        "lures that exist",
    ),
    Claim("- and cost nothing on clean views", "places", "adaptive-clean", "views of other errors"),
    Claim("Classes that last should weigh more, on old maps", "modules", "prior-age", "twice the places with old maps"),
    Claim("- and against lures", "modules", "prior-lure", "the same at more places"),
    Claim("Knowing the age of the map helps", "modules", "age", "twice the places with old maps"),
    Claim("Unknown is more than absent, where things hide the view", "modules", "unknown", "the same at more places"),
    Claim(
        "- and where a detector is silent as real ones were", "places-silent", "unknown", "silence measured elsewhere"
    ),
    Claim(
        "More features than the margin order answers better, by E-AURC, kinds of absence pooled",
        "places",
        "rejection-natural",
        "more countries to be fitted on",
    ),
    Claim("Motion makes a tracker of single views", "flights", "odometry", "flights that were flown"),
)


def claims(boards: Mapping[str, Board]) -> list[str]:
    """Return the table of claims, of boards by name; a claim whose board is not there has no row."""
    lines = begun(
        ["claim", "holds?", "views, places (countries)", "gain, points", "asked by", "what would change this"]
    )
    for claim in CLAIMS:
        findings = {found.name: found for found in boards[claim.board].findings} if claim.board in boards else {}
        found = findings.get(claim.contrast)
        if found is not None:
            where = f"{found.n}, {found.places} ({found.countries})"
            lines.append(
                f"| {claim.what} | **{verdict(found)}** | {where} | {points(found.difference, *found.ends)} | "
                f"`{claim.board}` | {claim.change} |"
            )
    return lines


def points(value: float, lo: float, hi: float) -> str:
    """Return a difference in points with its interval.

    >>> points(0.1804, 0.088, 0.28)
    '+18.0 [8.8, 28.0]'
    """
    return f"{100 * value:+.1f} [{100 * lo:.1f}, {100 * hi:.1f}]"


def share(row: "pd.Series | None") -> str:
    """Return a share with its interval; a dash without a row."""
    return "-" if row is None else f"{row['value']:.3f} [{row['lo']:.2f}, {row['hi']:.2f}]"


def verdict(found: Finding) -> str:
    """Return what a contrast says, in words of the page."""
    within = f"equal within {100 * found.least:g} points"
    words = {
        "decided": "yes",
        "cause open": "yes, without the stress, too",
        "null": within,
        "equal": within,
        "decided, small": "smaller than matters",
    }
    word = words.get(found.outcome, "not decided")
    return "no: the second is better" if word.startswith("yes") and found.winner == found.second else word


def contrast_rows(board: Board) -> Iterator[str]:
    """Yield a row for each registered contrast."""
    for found in board.findings:
        lo, hi = found.ends
        where = f"{found.places} ({found.countries})" if found.countries else str(found.places)
        only = f"{found.first_only}, {found.second_only}" if found.first_only + found.second_only else "-"
        p = "below 0.001" if found.p_holm < 0.001 else f"{found.p_holm:.3f}"
        yield (
            f"| {found.name} | `{found.first}`: {found.first_value:.3f} | `{found.second}`: {found.second_value:.3f} | "
            f"{points(found.difference, lo, hi)} | {only} | {found.n} | {where} | {p} | "
            f"**{verdict(found)}** |"
        )


def contrasts(board: Board) -> list[str]:
    """Return the table of registered contrasts."""
    head = ["contrast", "first", "second", "gain, points", "won, lost", "views", "places (countries)", "p (Holm)", ""]
    return [*begun(head), *contrast_rows(board)]


def begun(head: Sequence[str]) -> list[str]:
    """Return the first two lines of a table."""
    return [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]


def rows_of(board: Board, suite: str, stratum: str) -> pd.DataFrame:
    """Return rows of the leaderboard of what was found in a suite, by matcher; controls are left out."""
    table = board.leaderboard
    chosen = table[(table["suite"] == suite) & (table["stratum"] == stratum) & (table["metric"] == FOUND)]
    return chosen[(chosen["rejector"] == "") & ~chosen["is_control"].astype(bool)].set_index("matcher")


def one_of(rows: pd.DataFrame, matcher: str) -> "pd.Series | None":
    """Return the row of a matcher, if it was asked."""
    return rows.loc[matcher] if matcher in rows.index else None


def suites(board: Board) -> list[str]:
    """Return the table of what is found under stress in each suite, beside the best rival and the raster alone."""
    lines = begun(
        ["suite", "views, places", "`sasgeo`", "its rank", "best of other systems", "`sasgeo_gains`", "`sasgeo_raster`"]
    )
    for suite in dict.fromkeys(board.leaderboard["suite"]):
        rows = rows_of(board, suite, "stress")
        mine = one_of(rows, SCORER)
        if mine is None or math.isnan(mine["value"]):
            continue
        others = rows[~rows.index.str.startswith(OWN)].sort_values("value", ascending=False)
        best = f"`{others.index[0]}`: {share(others.iloc[0])}" if len(others) else "-"
        rank = "-" if pd.isna(mine["rank_best"]) else ranks(int(mine["rank_best"]), int(mine["rank_worst"]), len(rows))
        lines.append(
            f"| {suite} | {mine['n']}, {mine['places']} | {share(mine)} | {rank} | {best} | "
            f"{share(one_of(rows, BEFORE))} | {share(one_of(rows, PLAIN))} |"
        )
    return lines


def ranks(best: int, worst: int, count: int) -> str:
    """Return the set of ranks that a matcher may have.

    >>> ranks(1, 3, 9), ranks(2, 2, 9)
    ('1-3 of 9', '2 of 9')
    """
    return f"{best} of {count}" if best == worst else f"{best}-{worst} of {count}"


def steps(board: Board, suite: str) -> list[str]:
    """Return the table of what is found at each step of a suite, by matcher, the best first."""
    table = board.leaderboard
    names = list(dict.fromkeys(table.loc[(table["suite"] == suite), "stratum"]))
    every = {name: rows_of(board, suite, name) for name in names if name.endswith("192 cells")}
    every = {name: rows for name, rows in every.items() if len(rows)}
    asked = rows_of(board, suite, "stress").sort_values("value", ascending=False).index
    counts = [int(rows["n"].max()) for rows in every.values()]
    head = [f"{name.removesuffix(', 192 cells')}, n = {count}" for name, count in zip(every, counts, strict=True)]
    lines = begun(["matcher", *head])
    return lines + [
        f"| `{name}` | {' | '.join(share(one_of(rows, name)) for rows in every.values())} |" for name in asked
    ]


def goals(board: Board) -> list[str]:
    """Return the table of goals."""
    lines = begun(["goal", "wanted", "`sasgeo`", ""])
    for goal in GOALS:
        mine = one_of(rows_of(board, goal.suite, goal.stratum), SCORER)
        if mine is not None:
            word = met(mine["value"], goal.wanted)
            lines.append(f"| {goal.what} | {goal.wanted:.3f} | {share(mine)} of {mine['n']} | {word} |")
    rows = rows_of(board, *TWINS)
    mine, others = one_of(rows, SCORER), rows.loc[~rows.index.str.startswith(OWN), "value"].sort_values()
    if mine is not None and len(others):
        wanted = others.iloc[-1] + AHEAD
        what = f"natural twins with perceived vectors, {100 * AHEAD:g} points over `{others.index[-1]}`"
        lines.append(f"| {what} | {wanted:.3f} | {share(mine)} of {mine['n']} | {met(mine['value'], wanted)} |")
    return lines


def met(value: float, wanted: float) -> str:
    """Return whether a goal is reached, by the figure alone."""
    return "reached" if value >= wanted else "missed"


def views(board: Board, *, unrivalled: bool = False) -> pd.DataFrame:
    """Return the views under stress of a board, with whether each was found; `unrivalled` ones, too, if wanted."""
    scores = board.scores
    rows = scores[(scores["role"] == "stress") & scores["is_present"] & (scores["track"] == "localization")]
    rows = rows if unrivalled else rows[~rows["kind"].str.startswith("unrivalled")]
    return rows.assign(found=(rows["position_error_m"] <= 25) & (rows["yaw_error_deg"] <= 5))


def listed(board: Board, matchers: Sequence[str]) -> list[str]:
    """Return the table of how often a right pose is among those that a matcher lists: what its search leaves to rank.

    A right one lies within 25 m and 5 degrees of the truth. Of stored boards alone, which have the answers.
    """
    rows = views(board)
    rows = rows[rows["suite"].isin(SEARCHED) & rows["matcher"].isin(matchers)]
    answers = pd.read_parquet(
        board.folder / "predictions.parquet",
        columns=["query_id", "matcher", "candidates"],
        filters=[("matcher", "in", list(matchers)), ("query_id", "in", sorted(set(rows["query_id"])))],
    )
    truths = pd.read_parquet(
        board.folder / "truths.parquet", columns=["query_id", "easting_m", "northing_m", "yaw_deg"]
    )
    poses = rows[["query_id", "matcher"]].astype(str).merge(answers, on=["query_id", "matcher"]).explode("candidates")
    poses = poses[poses["candidates"].notna()].merge(truths, on="query_id")
    guess = pd.DataFrame(poses["candidates"].tolist(), index=poses.index)
    off_m = np.hypot(guess["easting_m"] - poses["easting_m"], guess["northing_m"] - poses["northing_m"])
    off_deg = (guess["yaw_deg"] - poses["yaw_deg"] + 180) % 360 - 180
    there = poses.assign(listed=(off_m <= 25) & (off_deg.abs() <= 5)).groupby(["query_id", "matcher"])["listed"].any()
    keys = pd.MultiIndex.from_frame(rows[["query_id", "matcher"]].astype(str))
    rows = rows.assign(listed=there.reindex(keys).fillna(value=False).to_numpy(bool))
    lines = begun(["suite", "views", *(f"`{name}`: listed, found" for name in matchers)])
    for suite, step in rows.groupby("suite", observed=True):
        for strength, mine in step.groupby("strength", observed=True):
            by = mine.groupby("matcher", observed=True)[["listed", "found"]].mean()
            cells = (
                f"{by.loc[name, 'listed']:.3f}, {by.loc[name, 'found']:.3f}" if name in by.index else "-"
                for name in matchers
            )
            count = int((mine["matcher"] == matchers[0]).sum())
            lines.append(f"| {suite}, {strength:g} | {count} | {' | '.join(cells)} |")
    return lines


def scenes(board: Board, matchers: Sequence[str]) -> list[str]:
    """Return the table of what is found of clean views by scene, and in country that is poor of features."""
    rows = views(board)
    rows = rows[(rows["suite"] == "clean") & rows["matcher"].isin(matchers)]
    poor = rows[rows["feature_density"] < POOR].assign(scene=f"poor of features (under {100 * POOR:g} % mapped)")
    both = pd.concat([rows.assign(scene=rows["scene"].astype(str).str.split(",")).explode("scene"), poor])
    lines = begun(["scene", "views, places", *(f"`{name}`" for name in matchers)])
    for scene, mine in both.groupby("scene", observed=True):
        first = mine[mine["matcher"] == matchers[0]]
        if len(first) >= LEAST_VIEWS:
            figures = (f"{mine.loc[mine['matcher'] == name, 'found'].mean():.3f}" for name in matchers)
            lines.append(f"| {scene} | {len(first)}, {first['place'].nunique()} | {' | '.join(figures)} |")
    return lines


def apart(board: Board) -> list[str]:
    """Return the table of contrasts by success at the sealed places, and without those that were tried before."""
    rows, sealed = views(board), set(board.about.sealed)
    groups = {
        "sealed": rows[rows["place"].isin(sealed)],
        "without " + ", ".join(TRIED): rows[~rows["place"].isin(TRIED)],
    }
    lines = begun(["contrast", *(f"{name}: gain, points; views, places" for name in groups)])
    for found, contrast in zip(board.findings, board.about.contrasts, strict=True):
        if contrast.metric != "primary":
            continue
        cells = []
        for some in groups.values():
            chosen = some[some["suite"].isin(contrast.suites) & some["kind"].str.startswith(contrast.kinds or "")]
            if contrast.detectors:
                chosen = chosen[chosen["detector"].isin(contrast.detectors)]
            pair = pair_of(chosen, found.first, found.second)
            gain = 100 * (pair[found.first] - pair[found.second]).mean()
            cells.append(f"{gain:+.1f}; {len(pair)}, {pair['place'].nunique()}" if len(pair) else "-")
        lines.append(f"| {found.name} | {' | '.join(cells)} |")
    return lines


def pair_of(rows: pd.DataFrame, first: str, second: str) -> pd.DataFrame:
    """Return whether each of two found the views that both were asked, by query and place; empty without any."""
    rows = rows[rows["matcher"].isin((first, second))]
    found = rows.pivot_table(index=["query_id", "place"], columns="matcher", values="found")
    return found.reindex(columns=[first, second]).dropna().astype(float).reset_index()


def beside(board: Board) -> list[str]:
    """Return the table of pairs that no contrast asks: described, without a test."""
    lines = begun(["views of", "first", "second", "gain, points", "won, lost", "views, places"])
    rows = views(board, unrivalled=True)
    for suite, kinds, first, second in BESIDE:
        pair = pair_of(rows[(rows["suite"] == suite) & rows["kind"].isin(kinds)], first, second)
        if len(pair):
            gain = pair[first] - pair[second]
            lines.append(
                f"| {suite}: {', '.join(kinds)} | `{first}`: {pair[first].mean():.3f} | `{second}`: "
                f"{pair[second].mean():.3f} | {100 * gain.mean():+.1f} | {(gain > 0).sum()}, {(gain < 0).sum()} | "
                f"{len(pair)}, {pair['place'].nunique()} |"
            )
    return lines


def tables(boards: Sequence[Board]) -> dict[str, list[str]]:
    """Return every table of the page, by name."""
    first = boards[0]
    there, asked = set(first.scores["suite"]), set(first.scores["matcher"])
    named = [name for name in (SCORER, BEFORE, "raster_soft", "schmidt_segcorr", PLAIN) if name in asked]
    return {
        "claims": claims({board.folder.name: board for board in boards}),
        "contrasts": contrasts(first),
        "suites": suites(first),
        "goals": goals(first),
        **{suite: steps(first, suite) for suite in ("clean", "real-age") if suite in there},
        **({"listed": listed(first, named)} if is_pack(first.folder) else {}),
        "scenes": scenes(first, named),
        "apart": apart(first),
        "beside": beside(first),
        **{
            f"{board.folder.name}: {name}": make(board)
            for board in boards[1:]
            if board.about.split == first.about.split
            for name, make in (("contrasts", contrasts), ("apart", apart))
        },
    }


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("boards", type=Path, nargs="+", help="folders of boards, that of the experiment first")
    parser.add_argument("--figure", type=Path, help="file for the contrasts of the first board, as SVG, PDF or PNG")
    asked = parser.parse_args()
    try:
        boards = [read_board(path) for path in asked.boards]
    except SasgeoError as error:
        parser.error(str(error))
    for name, lines in tables(boards).items():
        print(f"{name}\n", *lines, "", sep="\n")
    if asked.figure is not None:
        boards[0].plot_contrasts().savefig(asked.figure)


if __name__ == "__main__":
    main()
