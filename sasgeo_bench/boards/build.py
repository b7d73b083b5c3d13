# SPDX-License-Identifier: Apache-2.0
"""A request -> a board with its texts, figures and pictures: score, draw, save."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from sasgeo_bench.boards.board_figures import figures_extra
from sasgeo_bench.boards.board_files import AdditionalFiles, read_board_manifest
from sasgeo_bench.boards.board_pictures import pictures_extra
from sasgeo_bench.boards.plots import age_names, ages_frame
from sasgeo_bench.boards.score import score_board
from sasgeo_bench.boards.scored import Scored, ScoreRequest
from sasgeo_bench.boards.text import LATEX, MARKDOWN, Contents, board_latex, board_markdown
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import SITE
from sasgeo_bench.core.progress import tell
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.scoring.strata import queries_of, steps_frame


def make_board(request: ScoreRequest, extras: Sequence[Callable[[Scored], AdditionalFiles]] = ()) -> Scored:
    """Score everything, draw what `extras` make of it, and write the board; return it with what it was made of.

    Raise as `score_board` does, or StoreError if the board cannot be written; nothing is written then.
    """
    scored = score_board(request)
    _tell_what_goes(request.board, scored)
    drawn = make_extras(scored, extras)
    board = scored.board.with_failures(scored.failures.found)
    texts = board_texts(replace(scored, board=board))
    return replace(scored, board=board.save([texts, *drawn], failed=scored.failures.found))


def drawings(request: ScoreRequest, *, has_cases: bool = True) -> tuple[Callable[[Scored], AdditionalFiles], ...]:
    """Return what draws the figures and the pictures of a board; `has_cases` shows failed queries with their truths."""
    return (
        partial(figures_extra, contrasts=request.contrasts, split=request.split),
        partial(
            pictures_extra,
            root=request.root,
            contrasts=request.contrasts,
            split=request.split,
            has_cases=has_cases,
            jobs=request.jobs,
        ),
    )


def _tell_what_goes(folder: Path, scored: Scored) -> None:
    """Tell which rows and pages of an older board go: authors may look for their rows."""
    try:
        before = {entry.name for entry in read_board_manifest(folder).entries}
    except StoreError:
        before = set()
    gone = sorted(before - {entry.name for entry in scored.entries})
    if gone:
        tell(f"{folder} had rows of {', '.join(gone)}, which this board has not; their answers are where they were")
    if (folder / SITE).is_dir():
        tell(f"{folder / SITE} is of the older board and is removed with it: publish again")


def make_extras(scored: Scored, extras: Sequence[Callable[[Scored], AdditionalFiles]]) -> list[AdditionalFiles]:
    """Return the additional files; leave out what cannot be made, and figures that cannot be drawn."""
    if extras:
        tell("drawing figures and pictures")
    found: list[AdditionalFiles] = []
    for make in extras:
        with scored.failures.of("more of the board"):
            extra = make(scored)
            guarded = {name: partial(_draw, draw, name, scored.failures) for name, draw in extra.figures.items()}
            found.append(replace(extra, figures=guarded))
    return found


def _draw(draw: Callable[[Path], object], name: str, failures: Failures, path: Path) -> None:
    """Draw a figure; of one that fails nothing is left."""
    with failures.of(f"figure {name}"):
        draw(path)
        return
    path.unlink(missing_ok=True)


def board_texts(scored: Scored) -> AdditionalFiles:
    """Return the tables of a board as a document and for a paper."""
    board, queries = scored.board, queries_of(scored.scores)
    steps = steps_frame(board.leaderboard, queries, sorted(scored.scores))
    of = Contents(
        leaderboard=board.leaderboard,
        entries=board.about.entries,
        metrics=board.about.metrics,
        within=board.about.within,
        require=board.about.require,
        requirements=board.requirements,
        findings=board.findings,
        falsifiers=scored.falsifiers,
        verdicts=board.verdicts,
        acceptance=board.acceptance,
        steps=steps,
        ages=age_names(ages_frame(steps, queries, scored.measured)),
    )
    return AdditionalFiles(texts={MARKDOWN: board_markdown(board.about, of), LATEX: board_latex(board.about, of)})
