# SPDX-License-Identifier: Apache-2.0
"""Files of a board for the paper's experiment besides its own: the order of the steps."""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.boards.board_files import AdditionalFiles
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.boards.tables import p_text
from sasgeo_bench.boards.text import markdown_table
from sasgeo_bench.scoring.compare import Finding
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks.sheet import Panel, panels_of
from sasgeo_bench.tasks.task_files import Task
from sasgeo_paper.plots import draw_ablation, draw_example, draw_risk, draw_robustness
from sasgeo_paper.readings import CROPS, TITLES, held_lines, with_gaps
from sasgeo_paper.tables import (
    METRICS,
    PUBLISHED,
    example_of,
    risk_frame,
    robustness_frame,
    summary_frame,
    trials_frame,
    used_interval,
)
from sasgeo_paper.task import DATA, SUITE
from sasgeo_paper.tiles import CANDIDATES


def paper_markdown(
    summary: pd.DataFrame, findings: Sequence[Finding], about: Mapping[str, str], figures: Mapping[str, str]
) -> str:
    """Return the summary as a document in Markdown.

    `summary` is from `summary_frame`, with the columns of `with_gaps` where the crop has several readings; `findings`
    are contrasts of the suite, `about` holds "trials" in words, "made_by" and "data", `figures` the caption of each
    file.
    """
    every = summary
    if "crop" in summary:
        summary = summary[summary["crop"] == "unknown"]
    known = [item.matcher for item in PUBLISHED if item.matcher in set(summary["matcher"])]
    others = [name for name in dict.fromkeys(summary["matcher"]) if name not in known]
    source = f"{about['trials']}. Made by {about['made_by']}. Data: {about['data']}."
    lines = ["# The paper's experiment", "", source, "", _interval_note(summary), ""]
    if known:
        lines += ["## Beside the paper's Table II", "", *_table(_beside(summary, known)), ""]
        lines += ["## Each difference", "", *(f"- {line}" for line in difference_lines(summary)), ""]
    steps = _steps(findings)
    if len(steps):
        lines += ["## From variant to variant", "", *_table(steps), ""]
    if len(every) > len(summary):
        lines += ["## Readings of the crop", "", _READINGS, "", *_table(_readings(every, known)), ""]
        lines += [*(f"- {line}" for line in held_lines(every)), ""]
    if others:
        lines += ["## Controls and other matchers", "", *_table(_beside(summary, others)), ""]
    lines += ["## Figures", "", *(f"- [{caption}](figures/{name})" for name, caption in figures.items()), ""]
    return "\n".join(lines)


def _table(table: pd.DataFrame) -> Iterator[str]:
    return markdown_table(map(str, table.columns), (map(str, row) for row in table.itertuples(index=False)))


def _interval_note(summary: pd.DataFrame) -> str:
    """Explain the intervals and their limits."""
    first = summary.iloc[0]
    if first["cluster"] == "tile":
        return (
            "Intervals are 95 %: Wilson's, which take trials for independent, as the paper's do. They are not: those "
            f"of one seed share its tiles. `by tiles` resamples the {first['clusters']} tiles, then trials within "
            "each, and is never narrower. One seed says nothing of others."
        )
    return (
        f"Intervals are 95 %: {first['clusters']} seeds are resampled, then trials within each, and no interval is "
        "narrower than Wilson's. `Wilson` takes trials for independent; they are not, for those of one seed share its "
        "tiles."
    )


def _beside(summary: pd.DataFrame, matchers: Sequence[str]) -> pd.DataFrame:
    """Return a row for each matcher: each figure of the paper and ours; for Recall@1 the other interval too."""
    rows = []
    for matcher in matchers:
        by_metric = _by_metric(summary, matcher)
        row = {"method": by_metric["recall_1"]["title"]}
        for metric, title in METRICS.items():
            one = by_metric[metric]
            if not math.isnan(one["paper"]):
                row[f"{title}, paper"] = shown(one["paper"], one["paper_lo"], one["paper_hi"])
            wilson, clusters = (one["lo"], one["hi"]), (one["cluster_lo"], one["cluster_hi"])
            row[f"{title}, ours"] = shown(
                one["value"], *used_interval(one["cluster"], wilson=wilson, clusters=clusters)
            )
            if metric == "recall_1":
                is_tile = one["cluster"] == "tile"
                other = clusters if is_tile else wilson
                row["by tiles" if is_tile else "Wilson"] = shown(one["value"], *other).partition(" ")[2] or "-"
        rows.append(row | {"n": str(by_metric["recall_1"]["n"])})
    return pd.DataFrame(rows).fillna("-")


_READINGS: Final = (
    "The same trials, with the cells that a crop cuts away unknown, absent, or not in the view. `against unknown` is "
    "the paired difference in Recall@1 with its 95 % interval over clusters; `won and lost` counts trials that are "
    "right under one reading alone."
)


def _readings(every: pd.DataFrame, known: Sequence[str]) -> pd.DataFrame:
    """Return the paper's variants under each reading, and what the reading changes."""
    tables = []
    for crop, summary in every.groupby("crop", sort=False):
        gaps = summary[summary["metric"] == "recall_1"].set_index("matcher").loc[list(known)]
        table = _beside(summary, known)
        table.insert(0, "cropped cells", TITLES[str(crop)])
        table["against unknown"] = [
            "-" if math.isnan(row["gap"]) else f"{row['gap']:+.3f} [{row['gap_lo']:+.3f}, {row['gap_hi']:+.3f}]"
            for row in gaps.to_dict("records")
        ]
        table["won and lost"] = "-" if crop == "unknown" else [f"{row.won} and {row.lost}" for row in gaps.itertuples()]
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def _by_metric(summary: pd.DataFrame, matcher: str) -> dict[str, pd.Series]:
    """Return the rows of one matcher by metric."""
    return {str(row["metric"]): row for _, row in summary[summary["matcher"] == matcher].iterrows()}


def shown(value: float, lo: float = math.nan, hi: float = math.nan) -> str:
    """Return a figure as the paper prints it.

    >>> shown(0.586, 0.52, 0.649), shown(1.0)
    ('0.586 [0.520, 0.649]', '1.000')
    """
    if math.isnan(value):
        return "-"
    return f"{value:.3f}" if math.isnan(lo) else f"{value:.3f} [{lo:.3f}, {hi:.3f}]"


def difference_lines(summary: pd.DataFrame) -> Iterator[str]:
    """Yield a line for each of the paper's variants: the distance of each figure from the paper's."""
    for item in PUBLISHED:
        by_metric = _by_metric(summary, item.matcher)
        if by_metric:
            parts = [f"{title} {_difference(by_metric[metric])}" for metric, title in METRICS.items()]
            yield f"**{item.title}**: {'; '.join(parts)}."


def _difference(row: pd.Series) -> str:
    ours, paper = shown(row["value"]), shown(row["paper"])
    if ours == paper:
        return f"{ours}, as in the paper"
    gap = float(ours) - float(paper)  # of the figures as they are printed
    start = f"{ours} is {abs(gap):.3f} {'above' if gap > 0 else 'below'} the paper's {paper}, which lies "
    if row["is_within"]:
        return f"{start}inside our interval"
    if math.isnan(row["paper_lo"]):
        return f"{start}outside our interval"
    clusters = (row["cluster_lo"], row["cluster_hi"])
    lo, hi = used_interval(row["cluster"], wilson=(row["lo"], row["hi"]), clusters=clusters)
    meet = lo <= row["paper_hi"] and row["paper_lo"] <= hi
    return f"{start}outside our interval, {'though the two overlap' if meet else 'and the two do not overlap'}"


def _steps(findings: Sequence[Finding]) -> pd.DataFrame:
    """Compare consecutive variants: the paper's difference in Recall@1 and ours, paired."""
    rows = []
    for before, after in pairwise(PUBLISHED):
        one = next((item for item in findings if (item.first, item.second) == (after.matcher, before.matcher)), None)
        if one is not None:
            rows.append(
                {
                    "step": f"{before.title} -> {after.title}",
                    "paper": f"{after.recall_1 - before.recall_1:+.3f}",
                    "ours, paired": f"{one.difference:+.3f}"
                    + ("" if math.isnan(one.lo) else f" [{one.lo:+.3f}, {one.hi:+.3f}]"),
                    "won and lost": f"{one.first_only} and {one.second_only} of {one.n}",
                    "p (Holm)": p_text(one.p_holm),
                    "verdict": one.verdict,
                }
            )
    return pd.DataFrame(rows)


KINDS: Final = ("png", "svg")
CAPTIONS: Final = {
    "example": "example query with its mask and hardest decoy",
    "ablation": "Recall@1 of each variant and in the paper",
    "robustness": "Recall@1 against map-change probability",
    "risk-coverage": "risk against coverage of every variant",
}


def extra(board: Scored, *, root: Path) -> AdditionalFiles:
    """Return the table next to the paper's, all trials, and figures; `root` holds tasks/, truth/ and regions/."""
    tasks = [Task.of(about, root) for about in board.tasks if about.suite == SUITE]
    by_id = {truth.query_id: truth for task in tasks for truth in task.truths}
    trials = trials_frame(_of_suite(board, SUITE), board.predictions, by_id)
    summary = _summaries(board, trials)
    seeds = sorted(set(trials["seed"]))
    about = {"trials": _in_words(seeds, len(by_id)), "made_by": f"sasgeo-bench {version('sasgeo-bench')}", "data": DATA}
    return AdditionalFiles(
        tables={"paper": summary, "trials": trials},
        texts={
            "paper.md": paper_markdown(
                summary, board.board.findings, about, {f"{name}.svg": caption for name, caption in CAPTIONS.items()}
            )
        },
        figures={
            f"{name}.{kind}": draw
            for name, draw in {
                "example": partial(draw_example, panel=_example(tasks[0]), data=DATA),
                "ablation": partial(draw_ablation, summary=_ablation(summary), chance=1 / CANDIDATES, data=DATA),
                "robustness": partial(draw_robustness, table=robustness_frame(trials), data=DATA),
                "risk-coverage": partial(draw_risk, table=risk_frame(trials), data=DATA),
            }.items()
            for kind in KINDS
        },
    )


def _of_suite(board: Scored, suite: str) -> dict[str, pd.DataFrame]:
    """Return the scored rows of a suite by matcher."""
    return {name: frame[frame["suite"] == suite].reset_index(drop=True) for name, frame in board.scores.items()}


def _summaries(board: Scored, trials: pd.DataFrame) -> pd.DataFrame:
    """Return the summary of the suite; below it, where there are some, those of other readings of the crop."""
    drawn = {about.suite for about in board.tasks}
    summaries = []
    for suite, crop in CROPS.items():
        if suite in drawn:
            rows = _of_suite(board, suite)
            own = trials if suite == SUITE else trials_frame(rows, board.predictions, board.truths)
            summary = summary_frame(own, board.board.leaderboard[board.board.leaderboard["suite"] == suite])
            summaries.append(with_gaps(summary, crop, rows, _of_suite(board, SUITE)))
    return pd.concat(summaries, ignore_index=True)


def _in_words(seeds: list[int], trials: int) -> str:
    listed = ", ".join(map(str, seeds))
    return (
        f"{trials} trials of seed {listed}" if len(seeds) == 1 else f"{trials} trials of {len(seeds)} seeds ({listed})"
    )


def _example(task: Task) -> Panel:
    (panel,) = panels_of(task, query_id=example_of(task.truths).query_id)
    return panel


def _ablation(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the ablation: over seeds where there are several, else as if trials were independent."""
    is_shown = ~summary["matcher"].map(is_unranked) & summary["value"].notna() & (summary["crop"] == "unknown")
    rows = summary[(summary["metric"] == "recall_1") & is_shown]
    if (rows["cluster"] == "tile").all():
        return rows.assign(how="Wilson's 95 % intervals, trials taken for independent")
    how = f"95 % intervals by resampling {rows['clusters'].max()} seeds, then trials within each"
    return rows.assign(lo=rows["cluster_lo"], hi=rows["cluster_hi"], how=how)
