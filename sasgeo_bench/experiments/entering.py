# SPDX-License-Identifier: Apache-2.0
"""A matcher enters a published board: the board's queries are drawn, it is asked, and a submission is written."""

import difflib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import Final, NamedTuple

from sasgeo_bench.boards.archive_file import read_pack
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.core.config import LONGEST_LINE, check_document
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError, counted
from sasgeo_bench.core.plugins import check_registered
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.exchange.submissions import (
    SubmitRequest,
    beside_stored,
    check_card,
    default_folder,
    make_submission,
)
from sasgeo_bench.experiments import entry_cost
from sasgeo_bench.experiments.board_queries import BoardRequest, asked_tasks, plan_board, same_queries
from sasgeo_bench.experiments.pipeline import ask, draw_all
from sasgeo_bench.experiments.pipeline_plan import PipelinePlan, Run, plan_runs
from sasgeo_bench.matching.matcher import SOUND, MatcherCard, Prediction
from sasgeo_bench.matching.submission import NONE, Card
from sasgeo_bench.running.plan import RunPlan
from sasgeo_bench.running.prediction_files import begin_round, end_round, open_round, read_predictions
from sasgeo_bench.scoring.submission_files import check_submission_folder, is_submission, read_submission
from sasgeo_bench.tasks.split import HALVES, Split

_WITHOUT: Final = "; or leave their regions out by --without, which counts as misses"
_LIKE: Final = 0.7  # names that are more alike are taken for a slip of the pen
_LONGEST_MESSAGE: Final = 120  # characters of an example
_MOST_KINDS: Final = 5  # of errors that are shown


@dataclass(frozen=True, kw_only=True)
class EntryRequest(BoardRequest):
    """A request to enter a board.

    `matcher` is a name or module:Class; `without` are regions whose queries are not asked and count as misses. With
    `is_again`, queries that were answered before are asked, too; if that was cut off, it goes on where it was.
    """

    matcher: str
    is_again: bool = False


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A matcher that is to be asked what a published board asked: `plan` has the board's queries and it alone."""

    stored: Path
    plan: PipelinePlan
    matcher: str
    is_again: bool = False

    @property
    def board(self) -> str:
        """Return the id of the board."""
        return self.plan.spec.id


def plan_entry(request: EntryRequest) -> Entry:
    """Plan to ask a matcher all queries of a published board; raise as `plan_board` does."""
    plan = plan_board(request, matchers=[request.matcher])
    return Entry(stored=request.stored, plan=plan, matcher=request.matcher, is_again=request.is_again)


class CheckedEntry(NamedTuple):
    """An entry that can be made: the folder of its submission, and the plan of the matcher's runs, without tasks."""

    folder: Path
    run: RunPlan


def cost_lines(entry: Entry, run: RunPlan | None = None) -> Iterator[str]:
    """Yield what it costs to enter, which queries will be misses, and which extracts are missing.

    `run` is that of `check_entry`: what it has answered is not asked again.
    """
    tasks = asked_tasks(entry.stored)
    yield from entry_cost.cost_lines(entry.plan, entry.stored, tasks, run, is_again=entry.is_again)
    yield from entry_cost.lost_lines(entry.plan, entry.stored, tasks)
    missing = entry_cost.missing_extracts(entry.plan)
    if missing:
        yield f"  {entry_cost.missing_text(missing)} (those with an address are downloaded where it answers)"


def check_entry(entry: Entry, *, into: Path | None = None) -> CheckedEntry:
    """Return the folder of the submission and the run, after checking all that can be checked before drawing.

    The matcher is loaded in its own process. Raise `MatchError` if it cannot be, or its name is one that ships;
    `ConfigError` if its name is on the board, or its card is no card of a submission; `StoreError` if `into` holds
    something else, or answers to another board.
    """
    check_registered(read_pack(entry.stored).rejectors, source=str(entry.stored))
    found = plan_runs(entry.plan, entry.matcher, [])[0].plan
    card = _card_of(found.card, [], entry.plan.split, source=entry.matcher)
    check_card(card, entry.stored, source=entry.matcher)
    folder = into or default_folder(entry.board, card.name)
    check_submission_folder(folder, card.name)
    _check_same_board(folder, entry.board)
    return CheckedEntry(folder, found)


def enter(entry: Entry, *, into: Path | None = None) -> tuple[Path, Scored]:
    """Draw the queries of a board, ask the matcher, write the submission, and score it beside the stored answers.

    What was drawn or answered before is not done again. Return the folder of the submission (`into`, or
    submissions/<board>/<name>) and the board of both, which is written to out/boards/<board>-<name>/.

    Raises
    ------
    ConfigError
        If extracts are missing, or none of the board's queries can be drawn here; and as `check_entry` does, which
        comes first.
    MatchError
        If the matcher failed on every query; a submission that was there is as it was. And as `check_entry` does.
    StoreError
        As `check_entry`, a run and a submission do.
    """
    folder, run = check_entry(entry, into=into)
    entry_cost.fetch_extracts(entry.plan, mend=_WITHOUT)
    tasks, controls = draw_all(entry.plan)
    same = same_queries(entry.stored, [*tasks, *controls])
    since_ns = (begin_round if entry.is_again else open_round)(run.run_folder)
    plan = replace(entry.plan, only=same, since_ns=since_ns)
    runs = plan_runs(plan, entry.matcher, [*tasks, *controls])
    planned = runs[0].plan
    for line in _changed(planned):
        tell(line)
    ask(entry.matcher, runs)
    end_round(run.run_folder)
    _check_answered(planned, same, folder)
    card = _card_of(planned.card, runs, plan.split, source=entry.matcher)
    make_submission(SubmitRequest(predictions=planned.run_folder, card=card, board=entry.stored, into=folder))
    both = plan.out / "boards" / f"{entry.board}-{card.name}"
    scored = beside_stored(entry.stored, folder, both, root=plan.out, jobs=plan.jobs)
    if card.trained_elsewhere:
        tell(f"{card.name}: trained elsewhere than in the places of the split, not set apart: {card.trained_elsewhere}")
    return folder, scored


def _check_answered(plan: RunPlan, asked: Collection[str], folder: Path) -> None:
    """Refuse to make a submission of failures alone: it would take the place of an earlier one."""
    answers = [item for item in read_predictions(plan.run_folder) if item.query_id in asked]
    if answers and all(item.status not in SOUND for item in answers):
        raise MatchError(
            f"{plan.card.name} failed on all {counted(len(answers), 'query', 'queries')} "
            f"({'; '.join(failure_lines(answers))}): mend it, raise its version and enter again; {folder} is as it was"
        )


def _changed(plan: RunPlan) -> Iterator[str]:
    """Yield that a matcher is asked anew because its code or settings are not those of its earlier answers."""
    before = sorted(path.name for path in plan.run_folder.parent.glob("*") if path.is_dir() and path != plan.run_folder)
    if before and not plan.run_folder.is_dir():
        yield (
            f"{plan.card.name}: its code, version or limits are not those of its run {', '.join(before)}: all is asked "
            f"anew, as {plan.hash}; raise its version whenever answers change"
        )


def failure_lines(predictions: Iterable[Prediction]) -> Iterator[str]:
    """Yield how many queries ended in each way but a sound one, with the first message of each kind of error.

    >>> messages = ["ValueError: no road", "ValueError: no sea", "KeyError: 'x'"]
    >>> lost = [Prediction(query_id=one, status="crash", message=one, candidates=()) for one in messages]
    >>> for line in failure_lines(lost):
    ...     print(line)
    2 ended as crash, the first with the message 'ValueError: no road'
    1 ended as crash, the first with the message "KeyError: 'x'"
    """
    failed: dict[tuple[str, str], list[str]] = {}
    for item in predictions:
        if item.status not in SOUND:
            failed.setdefault((item.status, item.message.partition(":")[0]), []).append(item.message)
    for (status, _), messages in sorted(failed.items(), key=lambda one: -len(one[1]))[:_MOST_KINDS]:
        first = shorten(one_line(messages[0]), _LONGEST_MESSAGE, placeholder=" ...")
        yield f"{len(messages)} ended as {status}, the first with the message {first!r}"


def _check_same_board(folder: Path, board: str) -> None:
    """Refuse to replace answers to another board."""
    other = read_submission(folder).board if is_submission(folder) else board
    if other != board:
        raise StoreError(
            f"{folder} holds answers to the board {other!r}, which would be lost: name another folder, as in --into "
            f"submissions/{board}/{folder.name}"
        )


def _line(text: str) -> str:
    """Return a line of a matcher's card as one of a submission's, which is no longer than `LONGEST_LINE`."""
    return shorten(text, LONGEST_LINE, placeholder=" ...")


def _card_of(card: MatcherCard, runs: Sequence[Run], split: Split | None, *, source: str) -> Card:
    """Return the card of a submission from that of the matcher, with the places that taught its runs.

    Raise `ConfigError`, naming `source`, if a field is too long for a submission, or a place is nearly one of the
    split: by such a slip a row would escape being set apart.
    """
    known = () if split is None else split.blocks
    own, others = ([name for name in card.trained_on if (name in known) == is_own] for is_own in (True, False))
    for name in others:
        for near in difflib.get_close_matches(name, known, n=1, cutoff=_LIKE):
            raise ConfigError(
                f"the card of {source}: trained_on names {name!r}, no place of the split: did you mean {near!r}?"
            )
    places = {run.name: run.plan.training_set.places if run.plan.training_set else () for run in runs}
    taught = {name: sorted({*some, *own}) for name, some in places.items()}
    by_half = {half: taught.get(f"half {half}", sorted(own)) for half in HALVES}
    is_by_half = by_half[HALVES[0]] != by_half[HALVES[1]]
    places_of_all = sorted({place for some in taught.values() for place in some})
    trained_on: str | list[str] | dict[str, list[str]] = places_of_all or NONE
    if is_by_half:
        trained_on = {str(half): some for half, some in by_half.items()}
    fields = {
        **{name: getattr(card, name) for name in ("name", "version", "licence")},
        **{name: list(getattr(card, name)) for name in ("tracks", "needs", "uses", "authors")},
        **{name: _line(getattr(card, name)) or None for name in ("title", "source", "ours", "limits", "contact")},
        "code": card.code or None,
        "trained_on": trained_on,
        "trained_elsewhere": _line("; ".join(others)) or None,
    }
    return check_document(fields, Card, source=f"the card of {source}")
