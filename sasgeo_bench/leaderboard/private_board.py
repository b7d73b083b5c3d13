# SPDX-License-Identifier: Apache-2.0
"""A public board held against one of a private seed of the same pipeline: which rows are reproduced."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.leaderboard.board_files import read_board, read_scores
from sasgeo_bench.leaderboard.reproduction import compare_seeds, said_of, verdict_of
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.running.sandbox import keeps_truth
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.rows import RUN_HERE, name_alone
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.private_seed import REPRODUCING_BITS
from sasgeo_bench.tasks.query import TASK_VERSION

_VERSIONS: Final = {"scorer_version": SCORER_VERSION, "task_version": TASK_VERSION, "data_version": DATA_VERSION}
_WHOSE: Final = ("version", "hash")
_TASK: Final = ("suite", "region", "map_date")


@dataclass(frozen=True, kw_only=True)
class OnPrivate:
    """Results of a private board for the rows of a public one.

    `seed` are commitment and bits, `rows` what `board.json` is to say of each entry, by name; a board that nobody held
    against a private one has neither.
    """

    seed: Mapping[str, Any] | None = None
    rows: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def how(self, entry: Entry) -> str:
        """Return how an entry's answers were made, and how they fared on the private seed."""
        return str(self.rows[entry.name]["verdict"]) if entry.name in self.rows else entry.how


def seed_of(tasks: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Commitment and bits of the private seed that tasks were drawn by; None of public tasks.

    Raises
    ------
    ConfigError
        If they are of several seeds, or some are public.

    Examples
    --------
    >>> seed_of([{"suite": "clean"}]) is None
    True
    """
    found: list[dict[str, Any] | None] = []
    for about in tasks:
        said = about.get(task_files.PRIVATE)
        if said not in found:
            found.append(said)
    if len(found) > 1:
        message = "these tasks are drawn by several seeds, and one is private: draw them by one, and score those alone"
        raise ConfigError(message)
    return found[0] if found else None


def check_public(seed: Mapping[str, Any] | None, what: str) -> None:
    """Refuse to publish what is of a private seed: once its queries or truths are out, it vouches for nothing.

    Raises
    ------
    ConfigError
        Naming what.

    Examples
    --------
    >>> check_public(None, "out/boards/mine")
    """
    if seed is not None:
        message = (
            f"{what} is of a private seed, and holds queries, truths and answers: nothing of it is published but "
            "figures (score --private puts them on the public board)"
        )
        raise ConfigError(message)


def hold_private(
    folder: Path,
    *,
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    tasks: Sequence[Mapping[str, Any]],
    pipeline: Mapping[str, str],
    draws: int,
    tell: Callable[[str], None],
) -> OnPrivate:
    """Hold the rows of a public board against a board of a private seed.

    Parameters
    ----------
    folder : Path
        The private board.
    entries, scores, tasks : sequence of Entry, mapping of str to pandas.DataFrame, sequence of mapping
        Of the public one: contestants, their scored rows, what each `task.json` says.
    pipeline : mapping
        Its id and hash.
    draws : int
        Of the bootstrap.
    tell : callable
        Gets a line for what the two boards do not share.

    Raises
    ------
    ConfigError
        If the folder holds no board of a private seed, or one of another pipeline or version, or the public one is
        itself of a private seed.
    StoreError
        If it holds no sound board.
    """
    about = read_private(folder, pipeline)
    if seed_of(tasks) is not None:
        message = "the rows to be held against a private seed are of a private seed themselves: name a public board"
        raise ConfigError(message)
    both = {_task(item) for item in tasks} & {_task(item) for item in about["tasks"]}
    alone = len(tasks) - len(both)
    if alone:
        tell(f"{folder}: {counted(alone, 'task')} of this board {'is' if alone == 1 else 'are'} not on the private one")
    named = {tuple(item[:2]) for item in both}
    theirs = read_scores(folder)
    theirs = theirs[_is_of(theirs, named)]
    known = {_whose(entry["name"], entry): entry for entry in about["entries"]}
    rows = {}
    for entry in entries:
        if not entry.runs:
            continue
        other = known.get(_whose(entry.name, {"version": entry.version, "hash": entry.hash}))
        why = _lack(other, about[task_files.PRIVATE])
        if other is None or why:
            rows[entry.name] = said_of(RUN_HERE, why)
            continue
        mine, frame = scores[entry.name], theirs[theirs["matcher"] == other["name"]]
        figures = compare_seeds(mine[_is_of(mine, named)], frame, draws=draws)
        rows[entry.name] = said_of(*verdict_of(figures), figures)
    return OnPrivate(seed=about[task_files.PRIVATE], rows=rows)


def read_private(folder: Path, pipeline: Mapping[str, str]) -> dict[str, Any]:
    """Read the `board.json` of a private board that rows of a pipeline are compared with.

    Raises
    ------
    ConfigError, StoreError
        As `hold_private` does.

    Examples
    --------
    >>> read_private(Path("nowhere"), {})
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: nowhere holds no board: score some runs first
    """
    about, _ = read_board(folder)
    if not about.get(task_files.PRIVATE):
        message = f"{folder} is a board of a public seed: name one that 'leaderboard --seed-file' has made"
        raise ConfigError(message)
    if not pipeline or about.get("pipeline") != dict(pipeline):
        message = (
            f"{folder} is of another pipeline file, or of other --matcher, than this board: run both with the same"
        )
        raise ConfigError(message)
    stale = next((name for name, number in _VERSIONS.items() if about.get(name) != number), None)
    if stale is not None:
        message = f"{folder} has {stale} {about.get(stale)}, this program {_VERSIONS[stale]}: run the seed again"
        raise ConfigError(message)
    return about


def _task(about: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(about.get(name)) for name in _TASK)


def _is_of(scores: pd.DataFrame, named: set[tuple[str, ...]]) -> "pd.Series[bool]":
    keys = zip(scores["suite"], scores["region"], strict=True)
    return pd.Series([key in named for key in keys], index=scores.index, dtype=bool)


def _whose(name: str, said: Mapping[str, Any]) -> tuple[str, ...]:
    """Return name, version, and hash of code and settings, which identify an entry on both boards."""
    return (name_alone(name), *(str(said.get(item)) for item in _WHOSE))


def _lack(entry: Mapping[str, Any] | None, seed: Mapping[str, Any]) -> str:
    """Return why a private board vouches for nobody's row, or not for this one; empty where it can."""
    if seed["bits"] < REPRODUCING_BITS:
        return f"the private seed has {seed['bits']} bits, {REPRODUCING_BITS} are needed"
    if entry is None:
        return "this version, code and settings are not on the private board"
    isolation = entry.get("isolation") or {}
    if keeps_truth(isolation):
        return ""
    return f"on the private seed its truths were not kept from it ({isolation.get('truth', 'not protected')})"


def kept_private(about: Mapping[str, Any], entries: Sequence[Entry], root: Path) -> OnPrivate:
    """Return what stored results keep of a private seed, for entries whose answers all come from them.

    Parameters
    ----------
    about : mapping
        `board.json` of the stored results.
    entries : sequence of Entry
        Those that are scored.
    root : Path
        Where the stored results are laid out.

    Examples
    --------
    >>> kept_private({"entries": []}, [], Path("out")).rows
    {}
    """
    if not about.get("private"):
        return OnPrivate()
    known = {_whose(entry["name"], entry): entry.get("private") for entry in about["entries"]}
    rows = {}
    for entry in entries:
        said = known.get(_whose(entry.name, {"version": entry.version, "hash": entry.hash}))
        if entry.runs and said and all(source.is_relative_to(root) for source in entry.sources):
            rows[entry.name] = said
    return OnPrivate(seed=about["private"], rows=rows)
