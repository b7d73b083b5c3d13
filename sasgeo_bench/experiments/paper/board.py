# SPDX-License-Identifier: Apache-2.0
"""What a board holds of the paper's experiment besides its own files: the order of the steps."""

from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.experiments.paper.plots import draw_ablation, draw_example, draw_risk, draw_robustness
from sasgeo_bench.experiments.paper.tables import (
    example_of,
    risk_frame,
    robustness_frame,
    summary_frame,
    trials_frame,
)
from sasgeo_bench.experiments.paper.task import DATA, SUITE
from sasgeo_bench.experiments.paper.text import paper_markdown
from sasgeo_bench.experiments.paper.windows import CANDIDATES
from sasgeo_bench.leaderboard.board_files import Extra
from sasgeo_bench.leaderboard.build import Board
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.panels import panels
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.sheet import Panel

KINDS: Final = ("png", "svg")
CAPTIONS: Final = {
    "example": "example query with its mask and hardest decoy",
    "ablation": "Recall@1 of each variant beside the paper's",
    "robustness": "Recall@1 against map-change probability",
    "risk-coverage": "risk against coverage of every variant",
}


def paper_extra(board: Board, *, root: Path) -> Extra:
    """Table beside the paper's, all trials, and figures.

    Parameters
    ----------
    board : Board
        With the paper's trials among what was scored.
    root : Path
        Where tasks/, truth/ and regions/ are.
    """
    scores = {name: frame[frame["suite"] == SUITE].reset_index(drop=True) for name, frame in board.scores.items()}
    regions = [str(about["region"]) for about in board.tasks if about["suite"] == SUITE]
    truths = {region: list(task_files.read_truths(root / "truth" / SUITE / region)) for region in regions}
    by_id = {truth.query_id: truth for found in truths.values() for truth in found}
    trials = trials_frame(scores, board.predictions, by_id)
    summary = summary_frame(trials, board.table[board.table["suite"] == SUITE])
    seeds = sorted(set(trials["seed"]))
    about = {"trials": _in_words(seeds, len(by_id)), "made_by": f"sasgeo-bench {version('sasgeo-bench')}", "data": DATA}
    return Extra(
        tables={"paper": summary, "trials": trials},
        texts={
            "paper.md": paper_markdown(
                summary, board.findings, about, {f"{name}.svg": caption for name, caption in CAPTIONS.items()}
            )
        },
        figures={
            f"{name}.{kind}": draw
            for name, draw in {
                "example": partial(draw_example, panel=_example(regions[0], truths[regions[0]], root), data=DATA),
                "ablation": partial(draw_ablation, summary=_ablation(summary), chance=1 / CANDIDATES, data=DATA),
                "robustness": partial(draw_robustness, table=robustness_frame(trials), data=DATA),
                "risk-coverage": partial(draw_risk, table=risk_frame(trials), data=DATA),
            }.items()
            for kind in KINDS
        },
    )


def _in_words(seeds: list[int], trials: int) -> str:
    listed = ", ".join(map(str, seeds))
    return (
        f"{trials} trials of seed {listed}" if len(seeds) == 1 else f"{trials} trials of {len(seeds)} seeds ({listed})"
    )


def _example(region: str, truths: list[Truth], root: Path) -> Panel:
    folder, hidden = (root / kind / SUITE / region for kind in ("tasks", "truth"))
    (panel,) = panels(folder, hidden, out=root, query_id=example_of(truths).query_id)
    return panel


def _ablation(summary: pd.DataFrame) -> pd.DataFrame:
    """Rows of the ablation: over seeds where there are several, else as if trials were independent."""
    rows = summary[(summary["metric"] == "recall_1") & ~summary["matcher"].map(is_unranked) & summary["value"].notna()]
    if (rows["cluster"] == "tile").all():
        return rows.assign(how="Wilson's 95 % intervals, trials taken for independent")
    how = f"95 % intervals by resampling {rows['clusters'].max()} seeds, then trials within each"
    return rows.assign(lo=rows["cluster_lo"], hi=rows["cluster_hi"], how=how)
