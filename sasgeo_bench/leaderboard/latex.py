# SPDX-License-Identifier: Apache-2.0
"""A leaderboard as tables for a paper."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import pandas as pd

from sasgeo_bench.leaderboard.reproduction import seed_table
from sasgeo_bench.leaderboard.text import DAGGER, control_table, finding_table, tables_of
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.contrasts import Finding
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.texts import tex

_HEAD: Final = (
    r"% \usepackage{booktabs} for the rules. A table too wide for its column: table* spans two columns,",
    r"% \resizebox{\linewidth}{!}{...} (package graphicx) around a tabular shrinks it, sidewaystable (rotating)",
    r"% turns it; or leave out columns, the figures are all in leaderboard.parquet.",
)


def board_latex(
    board: pd.DataFrame,
    about: Mapping[str, Any],
    findings: Sequence[Finding] = (),
    verdicts: Sequence[Verdict] = (),
) -> str:
    """The tables of the board for a paper; needs the package booktabs.

    Parameters
    ----------
    board : pandas.DataFrame
        The leaderboard.
    about : mapping
        What `board.json` says.
    findings, verdicts : sequence
        Registered contrasts and controls; each a table where there are any.
    """
    lines = [f"% {tex(about['made_by'])}, scorer version {about['scorer_version']}; {ATTRIBUTION}", *_HEAD]
    if findings:
        lines += _table("Registered contrasts", "contrasts", finding_table(findings))
    seeds = seed_table(about)
    if len(seeds):
        lines += _table("Public and private seed", "seeds", seeds)
    for title, table in tables_of(board):
        lines += _table(title, title.partition(" (")[0], table)
    if verdicts:
        lines += _table("Controls", "controls", control_table(verdicts))
    return "\n".join(lines) + "\n"


def _table(title: str, name: str, table: pd.DataFrame) -> Iterator[str]:
    """One table; its label is its name in letters, digits and hyphens."""
    rows = [" & ".join(map(tex, row)) + r" \\" for row in table.itertuples(index=False)]
    dagger = f" {tex(DAGGER)} Wilson's interval over sites." if any(tex(DAGGER) in row for row in rows) else ""
    yield r"\begin{table}"
    yield rf"\caption{{{tex(title)}.{dagger} Data: {tex(ATTRIBUTION)}.}}"
    yield rf"\label{{tab:{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-')}}}"
    yield rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}"
    yield r"\toprule"
    yield " & ".join(map(tex, table.columns)) + r" \\"
    yield r"\midrule"
    yield from rows
    yield r"\bottomrule"
    yield r"\end{tabular}"
    yield r"\end{table}"
