# SPDX-License-Identifier: Apache-2.0
"""A leaderboard as tables for a paper."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import pandas as pd

from sasgeo_bench.leaderboard.tables import DAGGER, Table, text_of
from sasgeo_bench.leaderboard.text import tables_of
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.texts import tex

_HEAD: Final = (
    r"% \usepackage{booktabs} for the rules. A table too wide for its column: table* spans two columns,",
    r"% \resizebox{\linewidth}{!}{...} (package graphicx) around a tabular shrinks it, sidewaystable (rotating)",
    r"% turns it; or leave out columns, the figures are all in leaderboard.parquet.",
)


def board_latex(board: pd.DataFrame, about: Mapping[str, Any], **more: Any) -> str:  # noqa: ANN401 - see tables_of
    """Return the tables of a board for a paper, which needs the package booktabs; arguments as of `text.tables_of`."""
    head = f"% {tex(about['made_by'])}, scorer version {about['scorer_version']}; {ATTRIBUTION}"
    tables = tables_of(board, about, **more)
    return "\n".join((head, *_HEAD, *(line for table in tables for line in _lines(table)))) + "\n"


def _lines(table: Table) -> Iterator[str]:
    """Yield one table; its label is its name."""
    rows = [" & ".join(tex(text_of(cell)) for cell in row.cells) + r" \\" for row in table.rows]
    dagger = f" {tex(DAGGER)} Wilson's interval over sites." if any(tex(DAGGER) in row for row in rows) else ""
    yield r"\begin{table}"
    yield rf"\caption{{{tex(table.title)}.{dagger} Data: {tex(ATTRIBUTION)}.}}"
    yield rf"\label{{tab:{table.name}}}"
    yield rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}"
    yield r"\toprule"
    yield " & ".join(tex(column.name) for column in table.columns) + r" \\"
    yield r"\midrule"
    yield from rows
    yield r"\bottomrule"
    yield r"\end{tabular}"
    yield r"\end{table}"
