# SPDX-License-Identifier: Apache-2.0
"""Learned text of a matcher on disk, and its record in `run.json`."""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import MatchError, StoreError
from sasgeo_bench.matching.matcher import check_learned

FOLDER: Final = "learned"  # beside the suites of a run


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingRecord:
    """Record of a training in `run.json`.

    Parameters
    ----------
    key : str
        What all rows are tied to besides what is asked (`task_rows.asked_under`).
    file : str, optional
        Of the text, from the folder of the run; None where learning failed.
    trained_on : tuple of str
        Places.
    pairs : int
        Queries with their truths.
    """

    key: str
    file: str | None
    trained_on: tuple[str, ...]
    pairs: int

    @classmethod
    def of(cls, about: Mapping[str, Any]) -> Self | None:
        """Read it out of what `run.json` says, which may be anyone's; None where nothing was learnt.

        Raises
        ------
        MatchError
            If what is said makes no sense.

        Examples
        --------
        >>> TrainingRecord.of({"learned": None}) is None
        True
        """
        said = about.get("learned")
        if said is None:
            return None
        places = said.get("trained_on") if isinstance(said, dict) else None
        is_sound = (
            isinstance(said, dict)
            and isinstance(said.get("key"), str)
            and "file" in said
            and isinstance(said["file"], str | None)
            and isinstance(places, list)
            and all(isinstance(place, str) for place in places)
            and type(said.get("pairs")) is int
        )
        if not is_sound:
            message = f"learned is {one_line(repr(said))}, expected key, file, trained_on and pairs"
            raise MatchError(message)
        return cls(key=said["key"], file=said["file"], trained_on=tuple(places or ()), pairs=said["pairs"])


def learned_path(run: Path, lesson_sha256: str) -> Path:
    """File of what a matcher has learnt from a lesson, below out/runs/<matcher>/<hash>."""
    return run / FOLDER / f"{lesson_sha256}.json"


def read_learned(path: Path) -> str | None:
    """Read the learned text; None where there is none.

    Raises
    ------
    StoreError
        If the file cannot be read, or holds no text that a matcher could have said.

    Examples
    --------
    >>> read_learned(Path("nowhere.json")) is None
    True
    """
    try:
        return check_learned(path.read_bytes().decode())
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, MatchError) as error:
        message = f"{path} is damaged ({one_line(str(error))}): remove it and run again, it is learnt anew"
        raise StoreError(message) from error


def write_learned(path: Path, text: str) -> None:
    """Keep what was learnt, whole or not at all.

    Raises
    ------
    StoreError
        If the folder cannot be written.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(text.encode())
        scratch.rename(path)
    except OSError as error:
        with suppress(OSError):
            scratch.unlink()
        message = f"{path} cannot be written ({error.strerror or error}): free some space and run again"
        raise StoreError(message) from error
