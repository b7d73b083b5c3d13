# SPDX-License-Identifier: Apache-2.0
"""Manifest of a run, `run.json`: which matcher was asked which queries, under which limits, and what it cost."""

from pathlib import Path
from typing import Any, Final, Self

from pydantic import ValidationError, ValidationInfo, ValidatorFunctionWrapHandler, field_validator

from sasgeo_bench import config
from sasgeo_bench.errors import StoreError
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.files.json import read_json
from sasgeo_bench.matching.learned_file import Names, Record, TrainingRecord
from sasgeo_bench.tasks.task_files import tie_key
from sasgeo_bench.texts import json_text, one_line

RUN: Final = "run.json"
PACKED: Final = "packed.json"  # beside it where answers came packed: they were not asked here, whatever `run.json` says
_MEND: Final = "remove it and run again, its parts are kept"
_MOST: Final = 1e18  # seconds or bytes of a run: more is no measurement

_EXPECTED: Final = {
    "learned": "key, file, trained_on and pairs",
    "rendered_imagery": "a hash",
    "follower": "settings with a hash",
}

Number = int | float | None


class CardRecord(config.Record):
    """Card of a matcher as boards and pages show it; a card of an older version may lack some texts."""

    name: str = ""
    version: str = ""
    title: str | None = None
    source: str | None = None
    ours: str | None = None
    licence: str | None = None
    tracks: Names | None = None
    needs: Names | None = None
    limits: str | None = None
    trained_on: Names | dict[str, list[str] | str] | str | None = None


class FollowerRecord(Record):
    """How a matcher of single views was asked about flights: settings, and the hash of these and of the code."""

    hash: str


class RunManifest(Record):
    """Content of `run.json`; what a run does not state is empty, and is not written again.

    `learned` records the training by the runner; `rendered_imagery` is the hash of imagery that the matcher looked at.
    `prepare_s`, `index_bytes` and `peak_bytes` are the largest of all processes, `cpu_s` is that of all answers
    together. `packed` is True where the answers came in an archive.

    >>> run = RunManifest(hash="ab", cpu_s=1.5)
    >>> run.suite, run.cpu_s, run.key
    ('', 1.5, None)
    """

    schema_version: int | None = None
    matcher: CardRecord = CardRecord()
    spec: str | None = None
    hash: str = ""
    suite: str = ""
    region: str = ""
    task_version: int | None = None
    queries_sha256: str = ""
    map_fingerprint: str | None = None
    top_k: int | None = None
    limits: dict[str, int | float] | None = None
    warm_up: str | None = None
    learned: TrainingRecord | None = None
    rendered_imagery: str | None = None
    follower: FollowerRecord | None = None
    map_bytes: Number = None
    prepare_s: Number = None
    index_bytes: Number = None
    cpu_s: Number = None
    peak_bytes: Number = None
    isolation: dict[str, str] | None = None
    licence: str | None = None
    attribution: str | None = None
    packed: bool = False

    @field_validator("matcher", *_EXPECTED, mode="wrap")
    @classmethod
    def _check_record(cls, value: object, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> object:
        """Refuse a record as a whole, which its author wrote as a whole."""
        try:
            return handler(value)
        except ValidationError as error:
            name = str(info.field_name)
            if name in _EXPECTED:
                raise ValueError(f"{name} is {one_line(repr(value))}, expected {_EXPECTED[name]}") from error
            if isinstance(value, dict):
                raise
            raise ValueError("matcher.name is None") from error

    @field_validator("map_bytes", "prepare_s", "index_bytes", "cpu_s", "peak_bytes", mode="before")
    @classmethod
    def _check_number(cls, value: object, info: ValidationInfo) -> object:
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= _MOST
        if value is not None and not is_number:
            raise ValueError(f"{info.field_name} of a run is {value!r}, expected a number from 0 to {_MOST:.0e}")
        return value

    @property
    def key(self) -> str | None:
        """Return what rows are tied to besides their queries: training, rendered imagery, how flights are followed."""
        training, follower = self.learned, self.follower
        return tie_key(
            None if training is None else training.key,
            self.rendered_imagery,
            None if follower is None else follower.hash,
        )

    @classmethod
    def open(cls, folder: Path) -> Self | None:
        """Read `run.json` of a folder; None if there is no run. Raise `StoreError` if it is damaged."""
        path = folder / RUN
        if not path.is_file():
            return None
        content = read_json(path, mend=_MEND)
        if not isinstance(content, dict):
            raise damaged(path, f"it holds {str(content)[:40]!r}")
        if (folder / PACKED).exists():
            content["packed"] = True
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            first = error.errors()[0]
            field = "" if first["type"] == "value_error" else ".".join(map(str, first["loc"]))  # ours name the field
            where = f"{field} is {first['input']!r}: " if field else ""
            raise damaged(path, where + first["msg"].removeprefix("Value error, ")) from error

    def save(self, folder: Path) -> None:
        """Write `run.json` in place of an older one; raise `StoreError` if the folder cannot be written."""
        with fresh_file(folder / RUN, mend="check your rights and the free space") as scratch:
            scratch.write_text(json_text(self.content()), encoding="utf-8")

    def content(self) -> dict[str, Any]:
        """Return what `run.json` states, for a writer of JSON."""
        return self.model_dump(mode="json", exclude_unset=True)


def damaged(path: Path, fault: str) -> StoreError:
    """Return the error of a `run.json` with a fault."""
    return StoreError(f"{path} is damaged ({one_line(fault)}): {_MEND}")


def mark_packed(folder: Path, sha256: str) -> None:
    """Mark the answers of a run for good as such that came in an archive of this hash.

    The mark has a file of its own: `run.json` is written anew when more is asked, and may be removed.
    """
    (folder / PACKED).write_text(json_text({"archive_sha256": sha256}), encoding="utf-8")
