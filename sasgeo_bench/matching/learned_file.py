# SPDX-License-Identifier: Apache-2.0
"""Learned text of a matcher on disk, and its record in `run.json`."""

from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Strict

from sasgeo_bench.errors import MatchError, StoreError
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.files.paths import read_bounded
from sasgeo_bench.matching.matcher import MOST_LEARNED_BYTES, check_learned
from sasgeo_bench.texts import one_line

FOLDER: Final = "learned"  # next to the suites of a run
WHERE: Final = f"name a .json of out/runs/<matcher>/<hash>/{FOLDER}/"


Names = Annotated[list[str], Strict(strict=False)]  # which a tuple may give


class Record(BaseModel):
    """Part of `run.json`; a run of another version may state more."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True)


class TrainingRecord(Record):
    """Record of a training in `run.json`.

    `key` ties all rows to it (`task_files.asked_under`); `file` is that of the learned text, relative to the folder of
    the run, None where training failed; `trained_on` names places, and `pairs` counts queries with their truths.
    """

    key: str
    file: str | None
    trained_on: Names
    pairs: int


def learned_path(run: Path, training_sha256: str) -> Path:
    """Return the file of the text that a matcher learned from a training set, below out/runs/<matcher>/<hash>."""
    return run / FOLDER / f"{training_sha256}.json"


def read_learned(path: Path) -> str | None:
    """Read the learned text; None if there is none, `StoreError` if it is no such file, or is damaged.

    Only a file of a run is said to be damaged: advice to remove it must not reach any other file or folder.
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
