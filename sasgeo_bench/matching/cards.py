# SPDX-License-Identifier: Apache-2.0
"""`card.toml`: the one description of a method, which its class, its submission and its row have."""

from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Strict

from sasgeo_bench.core import config
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import given_path, plain_file, read_bounded
from sasgeo_bench.core.plugins import CARD_FILE
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.matching.matcher import MOST_LEARNED_BYTES, MatcherCard, check_learned
from sasgeo_bench.matching.submission import NEWER, Card

_EXAMPLE: Final = "submit --example-card prints a sound one"
_MOST_BYTES: Final = 100_000


def read_card(module: str | Path) -> MatcherCard:
    """Return the card of a matcher or a tracker from `card.toml` beside its module.

    Parameters
    ----------
    module : str or Path
        `__file__` of the module.

    Returns
    -------
    MatcherCard
        `trained_on` holds the places of the file, then its `trained_elsewhere`.

    Raises
    ------
    StoreError
        If there is no such file, or it cannot be read.
    ConfigError
        If a field is missing or wrong; all faults on one line.
    MatchError
        If it names no tracks, or different training for the halves of a split, which only answers of a file can have.

    Examples
    --------
    >>> class MyMatcher:  # in matcher.py, with card.toml in the same folder
    ...     card = read_card(__file__)  # doctest: +SKIP
    """
    path = given_path(module).with_name(CARD_FILE)
    found = read_card_file(path)
    if found.is_by_half:
        raise MatchError(
            f"{path}: trained_on speaks of halves, and one class answers about both: list the places, or let the "
            "runner train it by a method 'learn'"
        )
    given = found.model_dump(exclude={"trained_on", "trained_elsewhere"})
    fields: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one or "" for name, one in given.items()}
    try:
        return MatcherCard(**fields, trained_on=(*found.places, *filter(None, [found.trained_elsewhere])))
    except MatchError as error:
        raise MatchError(f"{path}: {str(error).removeprefix('card: ')}") from error


def read_card_file(path: Path) -> Card:
    """Read a card that an author wrote.

    Raise StoreError if it cannot be read. Raise ConfigError if a field is wrong; all faults on one line.
    """
    noun = f"write a card there, or name one ({_EXAMPLE})"
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise StoreError(f"{path} is no plain file: {noun}")
    try:
        with plain_file(path).open("rb") as source:
            read = source.read(_MOST_BYTES + 1)
        text = read.decode("utf-8-sig")  # some editors write a byte order mark
    except (UnicodeDecodeError, OSError) as error:
        fault = error.strerror if isinstance(error, OSError) else "it is no UTF-8"
        raise StoreError(f"{path} cannot be read ({fault}): {noun}") from error
    if len(read) > _MOST_BYTES:
        raise StoreError(f"{path} has more than {_MOST_BYTES} bytes: {noun}")
    try:
        return config.parse_toml(text, Card, source=str(path))
    except ConfigError as error:
        mend = "" if NEWER in str(error) else f": correct it there ({_EXAMPLE})"
        raise ConfigError(f"{error}{mend}") from error


FOLDER: Final = "learned"  # next to the suites of a run
WHERE: Final = f"name a .json of out/runs/<matcher>/<hash>/{FOLDER}/"


Names = Annotated[list[str], Strict(strict=False)]  # which a tuple may give


class Record(BaseModel):
    """Part of `run.json`; a run of another version may state more."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True)


class TrainingRecord(Record):
    """Record of a training in `run.json`.

    `key` ties all rows to it (`task_files.answer_hash`); `file` is that of the learned text, relative to the folder of
    the run, None where training failed; `trained_on` names places, and `pairs` counts queries with their truths.
    """

    key: str
    file: str | None
    trained_on: Names
    pairs: int


class Learned(config.Record):
    """A training by the runner: the file that was learned, if any, and the tasks that were asked under it."""

    file: str | None
    trained_on: list[str]
    pairs: int
    asked: list[str]


def learned_path(run: Path, training_sha256: str) -> Path:
    """Return the file of the text that a matcher learned from a training set, below out/runs/<matcher>/<hash>."""
    return run / FOLDER / f"{training_sha256}.json"


def read_learned(path: Path) -> str | None:
    """Read the learned text; None if there is none, `StoreError` if it is no such file, or is damaged.

    Only a file of a run is reported as damaged: advice to remove it must not reach any other file or folder.
    """
    if path.is_dir():
        raise StoreError(f"{path} is a folder, not a learned text: {WHERE}")
    try:
        return check_learned(read_bounded(path, MOST_LEARNED_BYTES).decode())
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, MatchError) as error:
        fault = one_line(str(getattr(error, "strerror", None) or error))
        is_of_run = path.absolute().parent.name == FOLDER
        advice = f"is damaged ({fault}): remove this file and run again, which trains anew"
        raise StoreError(f"{path} {advice if is_of_run else f'is no learned text ({fault}): {WHERE}'}") from error


def write_learned(path: Path, text: str) -> None:
    """Write the learned text whole or not at all; raise `StoreError` if the folder cannot be written."""
    with fresh_file(path, mend="free some space and run again") as scratch:
        scratch.write_bytes(text.encode())
