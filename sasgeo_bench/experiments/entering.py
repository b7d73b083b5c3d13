# SPDX-License-Identifier: Apache-2.0
"""A matcher enters a published board: the board's queries are drawn, it is asked, and a submission is written."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Final

from sasgeo_bench.config import LONGEST_LINE
from sasgeo_bench.errors import ConfigError, StoreError, counted
from sasgeo_bench.experiments.pipeline import ask, draw_all
from sasgeo_bench.experiments.pipeline_plan import PipelinePlan, Run, plan_pipeline, plan_runs
from sasgeo_bench.leaderboard.board import Board
from sasgeo_bench.leaderboard.board_files import read_board, read_scores
from sasgeo_bench.leaderboard.pipeline_spec import PipelineFile, find_pipeline_file, read_pipeline_file
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.submission import NONE, Card
from sasgeo_bench.progress import Progress, Tell
from sasgeo_bench.publishing.archive import laid_tasks, stored_settings
from sasgeo_bench.publishing.archive_folder import is_pack
from sasgeo_bench.publishing.submissions import FOLDER, SubmitRequest, check_card, make_submission, with_submissions
from sasgeo_bench.scoring.contestants import AskedTask
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.scoring.submission_files import check_submission_folder, is_submission, read_card, read_submission
from sasgeo_bench.tasks.private_seed import PrivateSeed
from sasgeo_bench.tasks.query import TASK_VERSION, base_of
from sasgeo_bench.tasks.split import HALVES, Split

_MAP_MB: Final = 2  # of a built map, on average over the shipped regions and their dates
_HOUR_S: Final = 3600.0


@dataclass(frozen=True, kw_only=True)
class EntryRequest:
    """A request to enter a board.

    `stored` are the results of the board, `matcher` is a name or module:Class, `out` the root of what is built.
    `pipeline` is the file that made the board, the shipped one of its name unless given. The rest is as in
    `plan_pipeline`.
    """

    stored: Path
    matcher: str
    out: Path
    pipeline: Path | None = None
    extract_folders: tuple[Path, ...] = ()
    region_folders: tuple[Path, ...] = ()
    sealed: PrivateSeed | None = None


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A matcher that is to be asked what a published board asked: `plan` has the board's queries and it alone."""

    stored: Path
    plan: PipelinePlan
    matcher: str

    @property
    def board(self) -> str:
        """Return the id of the board."""
        return self.plan.spec.id


def plan_entry(request: EntryRequest, *, tell: Tell) -> Entry:
    """Plan to ask a matcher all queries of a published board; only files of settings are read.

    Raises
    ------
    StoreError
        If there are no stored results, or they are damaged.
    ConfigError
        If the pipeline or the seed of sealed places is another one than that of the board, or it cannot be drawn here.
    MatchError
        If there is no such matcher.
    """
    stored = request.stored
    if not is_pack(stored):
        message = f"{stored} holds no stored results: name those of a board, as docs/results/systems"
        raise StoreError(message)
    made_by = stored_settings([stored]).pipeline
    if not made_by.get("id"):
        message = f"{stored} are stored results of no pipeline, so nobody knows how its queries are drawn"
        raise ConfigError(message)
    spec = read_pipeline_file(request.pipeline or find_pipeline_file(str(made_by["id"])))
    if spec.identity != dict(made_by):
        message = (
            f"{stored} was made by another text of the pipeline {made_by['id']!r} than this one: take the version of "
            "the program that made it, or name the file by --pipeline"
        )
        raise ConfigError(message)
    _check_seed(stored, request.sealed)
    plan = plan_pipeline(
        _asking(spec, request.matcher),
        out=request.out,
        tell=tell,
        extract_folders=request.extract_folders,
        region_folders=request.region_folders,
        sealed=request.sealed,
    )
    return Entry(stored=stored, plan=plan, matcher=request.matcher)


def _check_seed(stored: Path, seed: PrivateSeed | None) -> None:
    """Refuse a seed that did not draw the sealed places of the board: none of their queries would be the same."""
    opened = read_board(stored)[0].get("sealed", {})
    if seed is not None and all(one.get("drawn_by") != seed.commitment for one in opened.values()):
        message = (
            f"{stored} was not drawn by this seed of sealed places, of commitment {seed.commitment[:12]}: take the "
            "seed that was published with the board, or none"
        )
        raise ConfigError(message)


def _asking(spec: PipelineFile, matcher: str) -> PipelineFile:
    """Return a pipeline that asks one matcher all of its queries, and compares nothing."""
    tasks = [task.model_copy(update={"matchers": []}) for task in spec.task]
    return spec.model_copy(update={"matchers": [matcher], "task": tasks, "contrast": [], "rejectors": []})


def cost_lines(entry: Entry) -> Iterator[str]:
    """Yield what it costs to enter: queries, time as of those on the board, maps and their disk.

    Times are those of the fastest and the slowest row of the board, on the machine where it was made.
    """
    with laid_tasks([entry.stored]) as folders:
        tasks = [AskedTask.of(folder) for folder in folders]
    count = sum(len(task.asked) for task in tasks)
    maps = len({task.about["region"] for task in tasks})
    yield f"{entry.board}: {counted(count, 'query', 'queries')} in {counted(len(tasks), 'task')}"
    scores = read_scores(entry.stored)
    ranked = scores[~scores["matcher"].map(is_unranked).astype(bool)]
    means = sorted((float(some.mean()), str(name)) for name, some in ranked.groupby("matcher")["latency_s"])
    if means and means[-1][0] > 0:
        (fast_s, fast), (slow_s, slow) = means[0], means[-1]
        yield (
            f"  asking took {_duration(count * fast_s)} at the speed of {fast}, {_duration(count * slow_s)} at that of "
            f"{slow}; --jobs divides it"
        )
    yield (
        f"  {counted(maps, 'map')} to build where they are missing, about {maps * _MAP_MB} MB on disk; drawing and "
        "scoring take time, too"
    )
    about, seal = read_board(entry.stored)[0], entry.plan.seal
    if about.get("task_version") != TASK_VERSION:
        yield (
            f"  the board is of task version {about.get('task_version')}, and this program draws version "
            f"{TASK_VERSION}: queries that changed in between count as misses (CHANGELOG.md says which)"
        )
    closed = set(about.get("sealed", {})) if seal is None or seal.seed is None else set()
    lost = sum(len(task.asked) for task in tasks if base_of(task.about["region"]) in closed)
    if lost:
        yield f"  {lost} of the queries are of sealed places, and count as misses without --sealed-seed-file"
    yield from (f"  {line.strip()}" for line in (() if entry.plan.seal is None else entry.plan.seal.lines()))


def _duration(seconds: float) -> str:
    """Return a duration in words.

    >>> _duration(20), _duration(600), _duration(5000)
    ('20 s', '10 minutes', '1.4 hours')
    """
    if seconds < 100:  # noqa: PLR2004
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} minutes" if seconds < _HOUR_S else f"{seconds / _HOUR_S:.1f} hours"


def enter(
    entry: Entry, *, card: Path | None = None, into: Path | None = None, tell: Tell, progress: Progress | None = None
) -> tuple[Path, Board]:
    """Draw the queries of a board, ask the matcher, write the submission, and score it beside the stored answers.

    `card` is a TOML file that says more than the matcher's own card, as authors and code. What was drawn or answered
    before is not done again. Return the folder of the submission (`into`, or submissions/<name>) and the board of both,
    which is written to out/boards/<board>-<name>/.

    Raises
    ------
    ConfigError
        If the name is taken, none of the board's queries can be drawn here, or the card does not fit.
    MatchError, StoreError
        As a run and a submission do; `into` is looked at before anything is asked.
    """
    plan = entry.plan
    tasks, controls = draw_all(plan, tell=tell, progress=progress)
    runs = plan_runs(plan, entry.matcher, [*tasks, *controls])
    planned = runs[0].plan
    said = _card_of(planned.card, runs, plan.split) if card is None else read_card(card)
    check_card(said, entry.stored, source=entry.matcher if card is None else str(card))
    check_submission_folder(into or FOLDER / said.name, said.name)
    _check_same_board(into or FOLDER / said.name, entry.board)
    for line in _held(entry, [*tasks, *controls]):
        tell(line)
    ask(entry.matcher, runs, tell=tell, progress=progress)
    asked = SubmitRequest(predictions=planned.run_folder, card=said, board=entry.stored, into=into)
    folder = make_submission(asked, tell=tell)
    both = plan.out / "boards" / f"{entry.board}-{said.name}"
    board = with_submissions(entry.stored, [folder], both, tell=tell, root=plan.out, jobs=plan.jobs)
    return folder, board


def _check_same_board(folder: Path, board: str) -> None:
    """Refuse to replace answers to another board."""
    other = read_submission(folder).board if is_submission(folder) else board
    if other != board:
        message = (
            f"{folder} holds answers to the board {other!r}, which would be lost: name another folder, as in --into "
            f"submissions/{board}/{folder.name}"
        )
        raise StoreError(message)


def _held(entry: Entry, tasks: Sequence[Path]) -> Iterator[str]:
    """Yield how many of the board's queries were drawn, and are the same; refuse if none are."""
    drawn = {name: asked for task in tasks for name, asked in AskedTask.of(task).asked.items()}
    with laid_tasks([entry.stored]) as folders:
        board = {name: asked for folder in folders for name, asked in AskedTask.of(folder).asked.items()}
    same = sum(drawn.get(name) == asked for name, asked in board.items())
    if not same:
        message = (
            f"none of the {len(board)} queries of {entry.stored} is drawn here as it was: they were drawn by another "
            "version of the program, or from other extracts; take the version that made the board"
        )
        raise ConfigError(message)
    yield f"{same} of {counted(len(board), 'query', 'queries')} of the board are drawn as they were"
    if same < len(board):
        yield f"  {len(board) - same} are not, and count as misses"


def _line(text: str) -> str:
    """Return a line of a matcher's card as one of a submission's, which is no longer than `LONGEST_LINE`."""
    return shorten(text, LONGEST_LINE, placeholder=" ...")


def _card_of(card: MatcherCard, runs: Sequence[Run], split: Split | None) -> Card:
    """Return the card of a submission from that of the matcher, with the places that taught its runs."""
    known = () if split is None else split.blocks
    own, others = ([name for name in card.trained_on if (name in known) == is_own] for is_own in (True, False))
    places = {run.name: run.plan.training_set.places if run.plan.training_set else () for run in runs}
    taught = {name: sorted({*some, *own}) for name, some in places.items()}
    by_half = {half: taught.get(f"half {half}", sorted(own)) for half in HALVES}
    is_by_half = by_half[HALVES[0]] != by_half[HALVES[1]]
    places_of_all = sorted({place for some in taught.values() for place in some})
    trained_on: str | list[str] | dict[str, list[str]] = places_of_all or NONE
    if is_by_half:
        trained_on = {str(half): some for half, some in by_half.items()}
    return Card(
        name=card.name,
        version=card.version,
        title=_line(card.title),
        source=_line(card.source),
        ours=_line(card.ours),
        licence=card.licence,
        trained_on=trained_on,
        trained_elsewhere=_line("; ".join(others)) or None,
        needs=list(card.needs),
        limits=_line(card.limits) or None,
    )
