# SPDX-License-Identifier: Apache-2.0
"""Say which pictures are found: by place, ground and size of the view, before and after, with perfect masks beside.

    sasgeo-bench leaderboard pictures --out out
    .venv/bin/python benchmarks/pictures.py out
    .venv/bin/python benchmarks/pictures.py out --figure out/pictures.svg
    .venv/bin/python benchmarks/pictures.py out --chances
    .venv/bin/python benchmarks/pictures.py docs/results/pictures

Scores the answers of `pipelines/pictures.toml` in `out`, or reads those of a stored board, which ranks test places
alone: Andorra calibrates. Found is within 25 m and 5 deg; no answer is a miss.
Intervals (95 %) are Wilson's of as many sites as there are, and say nothing of other places; those of all test places
draw places. A way that was not asked has a dash. `--chances` scores the answers to real pictures of `osm_unet_held_out`
alone, so that P(false fix) is fitted on Andorra's and read off at the test places.
"""

import argparse
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.sim_to_real import estimate, line, read_scores
from sasgeo_bench.boards.archive import request_of
from sasgeo_bench.boards.score import score_board
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.scoring.intervals import wilson_share
from sasgeo_bench.tasks.query import RECALIBRATED

SPLIT: Final = "pictures"
SUITES: Final = ("real-image", "aerial", "corrupted-real")
SEGMENTER: Final = "osm_unet_held_out"
TOWN: Final = ("R1 built", "R1 mixed")
SIDES_M: Final = (384.0, 256.0, 192.0, 128.0, 96.0)
CALIBRATES: Final = "andorra-la-vella-ortho"
AGAIN: Final = "koeln-ortho-osm"  # the views of koeln-ortho on a map without buildings
REJECTOR: Final = "sasgeo_logistic"
BINS: Final = (0.0, 0.05, 0.2, 0.5, 0.8, 1.0)  # of P(false fix)


class Way(NamedTuple):
    """A segmenter with a matcher that reads it."""

    title: str
    segmenter: str
    matcher: str


PERFECT: Final = Way("perfect masks", "oracle_segmenter", "sasgeo")
BEFORE: Final = Way("before: states", "pixel_forest", "sasgeo_hard")
BEFORE_SOFT: Final = Way("before: raster_soft", "pixel_forest", "raster_soft")
AFTER: Final = Way("after", SEGMENTER, "sasgeo")
SAME_READER: Final = Way("pixel_forest: sasgeo", "pixel_forest", "sasgeo")  # asked of drawn pictures alone
ADAPTED: Final = Way("by the map's shares", f"{SEGMENTER}{RECALIBRATED}", "sasgeo")
WAYS: Final = (
    AFTER,
    BEFORE,
    BEFORE_SOFT,
    Way("osm_unet: states", SEGMENTER, "sasgeo_hard"),
    Way("osm_unet: raster_soft", SEGMENTER, "raster_soft"),
    PERFECT,
)


def of_way(scores: pd.DataFrame, way: Way) -> pd.DataFrame:
    """Return the rows of a way."""
    return scores[(scores["segmenter"] == way.segmenter) & (scores["matcher"] == way.matcher)]


def percent(rows: pd.DataFrame) -> str:
    """Return what is found of some rows, percent; a dash for none."""
    return f"{100 * rows['hit'].mean():.0f}" if len(rows) else "-"


def with_limits(rows: pd.DataFrame) -> str:
    """Return what is found of some rows with its interval by places, percent; a dash for none."""
    if rows.empty:
        return "-"
    value, lo, hi = estimate(rows, rows["hit"])
    return f"{value:.0f} [{lo:.0f}, {hi:.0f}]"


def interval(rows: pd.DataFrame) -> str:
    """Return Wilson's interval of what is found, of as many sites as the rows have, percent."""
    found = wilson_share(float(rows["hit"].mean()), rows["pair_id"].nunique())
    return f"{100 * found.lo:.0f} to {100 * found.hi:.0f}"


def by_place(real: pd.DataFrame) -> Iterator[str]:
    """Yield what is found of single views, by region, ground, size and disc."""
    first, *others = WAYS
    yield line("Region", "Ground", "View, m", "Disc, m", "n", first.title, "95 %", *(way.title for way in others))
    yield line(*["---"] * 2, *["---:"] * 4, "---", *["---:"] * len(others))
    views = real[real["kind"].str.startswith("R1")]
    for region in dict.fromkeys(views["region"]):
        for ground, kinds in (("built, mixed", TOWN), ("all", None)):
            own = views[(views["region"] == region) & (views["kind"].isin(kinds) if kinds else True)]
            for side_m in SIDES_M:
                for radius_m in (250, 500):
                    rows = own[(own["side_m"] == side_m) & (own["radius_m"] == radius_m)]
                    after = of_way(rows, AFTER)
                    if after.empty:
                        continue
                    shares = [percent(of_way(rows, way)) for way in others]
                    labels = (region, ground, f"{side_m:g}", radius_m, len(after))
                    yield line(*labels, percent(after), interval(after), *shares)


def over_places(real: pd.DataFrame, regions: Sequence[str]) -> Iterator[str]:
    """Yield what is found of the single views of some regions together, with intervals by places."""
    yield line("View, m", "Disc, m", "n", "Places", *(f"{way.title} [95 %]" for way in WAYS))
    yield line(*["---:"] * 4, *["---"] * len(WAYS))
    views = real[real["kind"].str.startswith("R1") & real["region"].isin(regions)]
    for side_m in SIDES_M:
        for radius_m in (250, 500):
            rows = views[(views["side_m"] == side_m) & (views["radius_m"] == radius_m)]
            if rows.empty:
                continue
            after = of_way(rows, AFTER)
            cells = [with_limits(of_way(rows, way)) for way in WAYS]
            yield line(f"{side_m:g}", radius_m, len(after), after["place"].nunique(), *cells)


def by_step(real: pd.DataFrame) -> Iterator[str]:
    """Yield what is found under the other steps: worse and older maps, several frames, the turned picture."""
    yield line("Region", "Step", "View, m", "n", *(way.title for way in WAYS))
    yield line(*["---"] * 3, *["---:"] * (1 + len(WAYS)))
    steps = real[~real["kind"].str.startswith("R1")]
    for (region, kind, strength, side_m), rows in steps.groupby(
        ["region", "kind", "strength", "side_m"], observed=True, sort=True
    ):
        step = kind if kind == "control" else f"{kind} {strength:g}" if kind.startswith("R5") else kind
        found = [percent(of_way(rows, way)) for way in WAYS]
        yield line(region, step, f"{side_m:g}", len(of_way(rows, AFTER)), *found)


def adapted(real: pd.DataFrame) -> Iterator[str]:
    """Yield what is found of single views as they are, and recalibrated by the shares of the map."""
    yield line("Region", "View, m", "Disc, m", "n", AFTER.title, ADAPTED.title, "gained", "lost")
    yield line("---", *["---:"] * 7)
    views = real[real["kind"].str.startswith("R1")]
    same = ["region", "side_m", "radius_m"]
    key = [*same, "kind", "pair_id"]
    both = of_way(views, AFTER).merge(of_way(views, ADAPTED), on=key, suffixes=("", "_adapted"), validate="1:1")
    for (region, side_m, radius_m), rows in both.groupby(same, sort=True):
        change = rows["hit_adapted"] - rows["hit"]
        shares = (f"{100 * rows[name].mean():.0f}" for name in ("hit", "hit_adapted"))
        yield line(region, f"{side_m:g}", f"{radius_m:g}", len(rows), *shares, (change > 0).sum(), (change < 0).sum())


def spoilt(scores: pd.DataFrame) -> Iterator[str]:
    """Yield what is found of pictures with faults, by family and severity, beside the pictures without."""
    yield line("Faults", "Severity", "n", f"{AFTER.title}, %")
    yield line("---", *["---:"] * 3)
    own = of_way(scores[scores["suite"] == "corrupted-real"], AFTER)
    own = own[own["role"] != "falsifier"]
    families = own["kind"].str.partition(" ")[0]  # as in "weather fog"
    for (family, strength), rows in own.groupby([families, "strength"], observed=True, sort=True):
        yield line(family, f"{strength:g}", len(rows), percent(rows))


def drawn(scores: pd.DataFrame) -> Iterator[str]:
    """Yield what is found of drawn pictures, by look and size of the view, with intervals by places."""
    ways = [*(way for way in WAYS if way.segmenter != PERFECT.segmenter), SAME_READER]
    yield line("Look", "View, m", "n", "Places", *(f"{way.title} [95 %]" for way in ways))
    yield line("---", *["---:"] * 3, *["---"] * len(ways))
    aerial = scores[(scores["suite"] == "aerial") & (scores["role"] != "falsifier")]
    for (look, side_m), rows in aerial.groupby(["detector", "side_m"], observed=True, sort=True):
        cells = [with_limits(of_way(rows, way)) for way in ways]
        after = of_way(rows, AFTER)
        yield line(look, f"{side_m:g}", len(after), after["place"].nunique(), *cells)


def check_run(out: Path) -> None:
    """End with one line if the answers of the pipeline are not in a folder."""
    if not all((out / "runs" / way.matcher).is_dir() for way in WAYS):
        raise SystemExit(f"{out} holds no answers of `pictures`: sasgeo-bench leaderboard pictures --out {out}")


def scored(out: Path, matchers: Sequence[str], suites: Sequence[str], rejectors: Sequence[str] = ()) -> Scored:
    """Score the answers of some matchers to the tasks of some suites that lie in a folder."""
    with TemporaryDirectory() as scratch:
        runs = [out / "runs" / name for name in matchers]
        request = request_of(runs, board=Path(scratch) / "board", root=out, split=SPLIT, rejectors=rejectors)
        found = score_board(replace(request, tasks=[task for name in suites for task in tasks_of(out, name)]))
    check_names(found.with_calibration, matchers, out)
    return found


def check_names(names: Collection[str], matchers: Collection[str], out: Path) -> None:
    """End with one line if a folder has answers of several versions of a matcher, which have names of their own."""
    if others := sorted(set(names) - set(matchers)):
        raise SystemExit(
            f"{out / 'runs'} holds answers of {', '.join(others)}: move all but one version of each out of it"
        )


def tasks_of(out: Path, suite: str) -> list[Path]:
    """Return the folders of a suite's tasks."""
    return sorted(path for path in (out / "tasks" / suite).glob("*") if (path / "task.json").is_file())


def judged(out: Path) -> pd.DataFrame:
    """Return the answers of the way of today to real pictures at test places, with P(false fix) fitted on Andorra's."""
    check_run(out)
    found = scored(out, [AFTER.matcher], [f"real-image+{SEGMENTER}"], [REJECTOR])
    if (AFTER.matcher, REJECTOR) not in found.judged:
        raise SystemExit(
            f"{AFTER.matcher} has not answered every task of {SEGMENTER}: sasgeo-bench leaderboard pictures"
        )
    rows = found.judged[AFTER.matcher, REJECTOR]
    is_again = rows["region"].astype(str).str.startswith(AGAIN)
    return rows[(rows["role"] != "falsifier") & ~is_again]


def chances(answers: pd.DataFrame) -> Iterator[str]:
    """Yield how often answers are false by stated chance, and what a threshold of 5 % keeps and lets through."""
    some = answers[answers["is_answered"]]
    p_false = 1 - some["p_right"]
    yield line("P(false fix)", "n", "Stated, %", "False, %", "95 %")
    yield line("---", *["---:"] * 3, "---")
    for low, high in pairwise(BINS):
        rows = some[(p_false >= low) & ((p_false < high) | (high == 1.0))]
        if len(rows):
            false = float((~rows["is_right"]).mean())
            found = wilson_share(false, rows["pair_id"].nunique())
            stated = 100 * float((1 - rows["p_right"]).mean())
            limits = f"{100 * found.lo:.0f} to {100 * found.hi:.0f}"
            yield line(f"{low:g} to {high:g}", len(rows), f"{stated:.0f}", f"{100 * false:.0f}", limits)
    yield ""
    yield line(
        "Region", "n", "Right, %", "Half of the right kept: false among accepted", "Another town refused, %", "n"
    )
    yield line("---", *["---:"] * 5)
    for region, rows in answers.groupby("region", observed=True):
        present = rows[rows["is_present"] & (rows["role"] != "falsifier")]
        absent = rows[~rows["is_present"]]
        right = present.loc[present["is_right"], "p_right"].to_numpy(float)
        least = float(np.median(right)) if len(right) else np.nan
        taken = present[present["p_right"] >= least]
        false = "-" if taken.empty else f"{100 * (~taken['is_right']).mean():.0f} % of {len(taken)}"
        refused = "-" if absent.empty else f"{100 * (~(absent['p_right'] >= least)).mean():.0f}"
        yield line(region, len(present), f"{100 * present['is_right'].mean():.0f}", false, refused, len(absent))


def draw(real: pd.DataFrame, path: Path) -> None:
    """Draw what is found against the size of the view, before and after, a panel for each region."""
    import matplotlib as mpl  # noqa: PLC0415 - slow to import, and wanted for the figure alone

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    mpl.rcParams["svg.hashsalt"] = "pictures"
    views = real[real["kind"].str.startswith("R1") & (real["radius_m"] == 250)]
    regions = list(dict.fromkeys(views["region"]))
    figure, panels = plt.subplots(1, len(regions), figsize=(2.2 * len(regions), 2.7), sharey=True, squeeze=False)
    styles = (
        (PERFECT, "#999999", ":", "o", 3),
        (AFTER, "#0072b2", "-", "o", 5),
        (BEFORE_SOFT, "#e69f00", "-.", "s", 3),
        (BEFORE, "#d55e00", "--", "^", 3),
    )
    for panel, region in zip(panels[0], regions, strict=True):
        for way, colour, style, marker, size in styles:
            rows = of_way(views[views["region"] == region], way)
            means = rows.groupby("side_m")["hit"].mean()
            panel.plot(means.index, 100 * means, style, color=colour, marker=marker, markersize=size, label=way.title)
        counts = sorted(rows.groupby("side_m").size())
        numbers = f"{counts[0]}" if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
        panel.set_title(f"{region.removesuffix('-ortho')}\nn = {numbers} a point", fontsize=8)
        panel.set_xscale("log")
        panel.set_xticks(SIDES_M, [f"{side_m:g}" for side_m in SIDES_M], fontsize=7)
        panel.minorticks_off()
        panel.set_xlim(0.9 * min(SIDES_M), 1.1 * max(SIDES_M))
        panel.set_ylim(-3, 103)
        panel.grid(alpha=0.3)
    panels[0][0].set_ylabel("found, %")
    figure.supxlabel("side of the view, m", fontsize=9)
    figure.legend(
        *panels[0][0].get_legend_handles_labels(), loc="upper center", ncols=len(styles), fontsize=8, frameon=False
    )
    figure.tight_layout(rect=(0, 0, 1, 0.92))
    figure.savefig(path, metadata={"Date": None})


def read_answers(folder: Path) -> pd.DataFrame:
    """Return the rows of present places with `hit`, the segmenter, and the sides of the view and of the disc.

    Of a run, places that calibrate are among them; a stored board holds test places alone.
    """
    if (folder / "scores.parquet").is_file():
        scores = read_scores(folder, 25.0, 5.0)
        if of_way(scores, AFTER).empty:
            raise SystemExit(f"{folder} is no board of `pictures`: name the folder of the run, or of that board")
        return with_sides(scores)
    check_run(folder)
    frames = []
    for matcher in dict.fromkeys(way.matcher for way in WAYS):
        asked = {way.segmenter for way in (*WAYS, ADAPTED, SAME_READER) if way.matcher == matcher}
        suites = [f"{suite}+{segmenter}" for suite in SUITES for segmenter in asked]
        found = scored(folder, [matcher], [name for name in suites if (folder / "tasks" / name).is_dir()])
        frames += [frame.assign(matcher=name) for name, frame in found.with_calibration.items()]
    with TemporaryDirectory() as scratch:
        pd.concat(frames).to_parquet(Path(scratch) / "scores.parquet")
        return with_sides(read_scores(Path(scratch), 25.0, 5.0))


def with_sides(scores: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the sides of the view and of the disc, metres."""
    radius_m = scores["prior_group"].astype(str).str.extract(r"r(\d+)", expand=False).astype(float)
    return scores.assign(side_m=scores["view_cells"] * scores["cell_size_m"], radius_m=radius_m)


def tables(scores: pd.DataFrame) -> Iterator[Iterator[str]]:
    """Yield the lines of each table, of the rows of `read_answers`."""
    real = scores[scores["suite"] == "real-image"]
    tests = [name for name in dict.fromkeys(real["region"]) if name not in (CALIBRATES, AGAIN)]
    yield by_place(real)
    yield over_places(real, tests)
    yield by_step(real)
    yield adapted(real)
    yield drawn(scores)
    yield spoilt(scores)


def main() -> None:
    """Print the tables, or draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="of the run, or of the stored board")
    parser.add_argument("--figure", type=Path, help="draw it instead of printing")
    parser.add_argument("--chances", action="store_true", help="print P(false fix) instead")
    given = parser.parse_args()
    if given.chances:
        print("\n".join(chances(judged(given.folder))))
        return
    scores = read_answers(given.folder)
    if given.figure is not None:
        draw(scores[scores["suite"] == "real-image"], given.figure)
        return
    for table in tables(scores):
        print("\n".join(table), end="\n\n")


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
