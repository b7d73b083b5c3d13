# SPDX-License-Identifier: Apache-2.0
"""A leaderboard as tables for a paper."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import pandas as pd

from sasgeo_bench.region import ATTRIBUTION
from sasgeo_bench.report.contrasts import Finding
from sasgeo_bench.report.controls import Verdict
from sasgeo_bench.report.reproduction import seed_table
from sasgeo_bench.report.text import DAGGER, control_table, finding_table, tables_of

_ESCAPED: Final = {
    **{letter: rf"\{letter}" for letter in "_%&#${}"},
    "<": "$<$",
    ">": "$>$",
    "|": "$|$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
    DAGGER: r"$^\dagger$",
}
_LAST_LATIN: Final = 0x17F  # of Latin Extended-A
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
    lines = [f"% {about['made_by']}, scorer version {about['scorer_version']}; {ATTRIBUTION}", *_HEAD]
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
    rows = [" & ".join(map(_tex, row)) + r" \\" for row in table.itertuples(index=False)]
    dagger = f" {_tex(DAGGER)} Wilson's interval over sites." if any(_tex(DAGGER) in row for row in rows) else ""
    yield r"\begin{table}"
    yield rf"\caption{{{_tex(title)}.{dagger} Data: {_tex(ATTRIBUTION)}.}}"
    yield rf"\label{{tab:{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-')}}}"
    yield rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}"
    yield r"\toprule"
    yield " & ".join(map(_tex, table.columns)) + r" \\"
    yield r"\midrule"
    yield from rows
    yield r"\bottomrule"
    yield r"\end{tabular}"
    yield r"\end{table}"


def _tex(text: object) -> str:
    """Any text as TeX; letters that pdfTeX has no glyph of by their number, for it stops at them."""
    said = "".join(letter if ord(letter) <= _LAST_LATIN else f"[U+{ord(letter):04X}]" for letter in _known(str(text)))
    return "{}" + said if said.startswith(("[", "*")) else said  # which belong to the end of the row before, else


def _known(text: str) -> Iterator[str]:
    for letter in text:
        yield from _ESCAPED.get(letter, letter)
