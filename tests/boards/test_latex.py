# SPDX-License-Identifier: Apache-2.0
"""Tables for a paper as a TeX that is installed sets them; skipped where there is none."""

import shutil
import subprocess
from pathlib import Path

import pytest

from sasgeo_bench.boards.text import Contents, board_latex
from sasgeo_bench.scoring.tables import leaderboard
from tests.core.test_texts import NASTY
from tests.handmade import about_of, asked

TEX = next(filter(None, map(shutil.which, ("pdflatex", "lualatex", "xelatex", "tectonic"))), None)
RESULTS = Path(__file__).parents[2] / "docs" / "results"
PAPER = r"""\documentclass{article}
\usepackage{booktabs,graphicx}
\begin{document}
\input{tables}
\end{document}
"""

pytestmark = pytest.mark.skipif(TEX is None, reason="no TeX is installed: Debian has texlive-latex-recommended")


def paper_of(tables: str, folder: Path) -> Path:
    """Set a paper that holds nothing but some tables."""
    # As the head of the file tells: whoever sets tables too wide shrinks them; and one page for each, as floats.
    shrunk = tables.replace(r"\begin{tabular}", r"\resizebox{\linewidth}{!}{\begin{tabular}")
    shrunk = shrunk.replace(r"\end{tabular}", r"\end{tabular}}").replace(r"\end{table}", "\\end{table}\n\\clearpage")
    (folder / "tables.tex").write_text(shrunk, encoding="utf-8")
    (folder / "paper.tex").write_text(PAPER, encoding="utf-8")
    flags = [] if Path(str(TEX)).name == "tectonic" else ["-interaction=nonstopmode", "-halt-on-error"]
    done = subprocess.run(  # noqa: S603 - the TeX that is installed, on our own tables
        [str(TEX), *flags, "paper.tex"], cwd=folder, capture_output=True, text=True, errors="replace", check=False
    )
    assert done.returncode == 0, done.stdout[-3000:]
    return folder / "paper.pdf"


def test_a_board_compiles_whatever_its_matchers_are_called(tmp_path: Path) -> None:
    names = (
        "plain",
        r"<script>alert(1)</script> & 100 % #1 $x$ {y} ~ ^ \end{table}",
        "café §2",
        "".join(map(chr, range(0xA1, 0x180))),
        *(text[:200] for text in NASTY if text.isprintable()),
        "匹配器 🛰",
        "[2] x",
        "*",
    )
    board = leaderboard({name: asked(0.5, count=8) for name in names}, draws=100)
    assert paper_of(board_latex(about_of([]), Contents(leaderboard=board)), tmp_path).is_file()


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*/leaderboard.tex")), ids=lambda path: path.parent.name)
def test_stored_results_compile(path: Path, tmp_path: Path) -> None:
    assert paper_of(path.read_text(encoding="utf-8"), tmp_path).is_file()
