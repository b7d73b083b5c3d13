# SPDX-License-Identifier: Apache-2.0
"""What rejectors made of the answers of an entry, kept in files, so that a board is scored again without the fits.

The name of a file is the hash of all that its content follows from.
"""

import hashlib
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple, Self

import pandas as pd
import psutil
import pyarrow as pa

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.plugins import SHIPPED_MODULES
from sasgeo_bench.core.room import Room, touch
from sasgeo_bench.running.kept import installed
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.tasks.split import Split

_SUFFIX: Final = ".rejection"
_ID: Final = "query_id"


class Judgement(NamedTuple):
    """Rows of `rejection.judge` of one entry and rejector, and those of the board and of acceptance."""

    judged: pd.DataFrame
    figures: pd.DataFrame
    acceptance: pd.DataFrame


@dataclass(frozen=True, kw_only=True)
class KeptJudgements:
    """Judgements of one entry in a folder.

    `entry` is the SHA-256 of what all of them follow from, `scores` are its rows, of which judgements have some.
    """

    folder: Path
    entry: bytes
    scores: pd.DataFrame

    @classmethod
    def of(
        cls,
        folder: Path,
        matcher: str,
        scores: pd.DataFrame,
        answers: StoredAnswers,
        split: Split | None,
        *,
        is_taught: bool,
    ) -> Self | None:
        """Return those of an entry's scored rows, all its answers and the split; None while the program changes."""
        if (programs := _programs()) is None:
            return None
        digest = hashlib.sha256(programs + repr((matcher, split, is_taught)).encode())
        for part in _parts(scores, answers):
            digest.update(hashlib.sha256(part).digest())
        return cls(folder=folder, entry=digest.digest(), scores=scores)

    def read(self, rejector: str, code: str) -> Judgement | None:
        """Return what is kept of a rejector; None if there is nothing, or it is damaged."""
        path = self._path(rejector, code)
        if path is None:
            return None
        try:
            data = memoryview(plain_file(path).read_bytes())
            touch(path)
        except OSError:
            return None
        if hashlib.sha256(data[32:]).digest() != data[:32]:
            return None
        source = pa.BufferReader(data[32:])
        own, figures, acceptance = (pa.ipc.open_stream(source).read_pandas() for _ in Judgement._fields)
        at = pd.Index(self.scores[_ID]).get_indexer(own.pop(_ID))
        judged = self.scores.iloc[at].reset_index(drop=True).assign(**{name: own[name] for name in own})
        return Judgement(judged, figures, acceptance)

    def write(self, rejector: str, code: str, found: Judgement) -> None:
        """Keep a judgement, if it can be written and there is room."""
        path = self._path(rejector, code)
        if path is None or not self.scores[_ID].is_unique:
            return
        own = found.judged[[_ID, *found.judged.columns.difference(self.scores.columns, sort=False)]]
        parts = (pa.Table.from_pandas(frame, preserve_index=False) for frame in (own, *found[1:]))
        data = b"".join(_bytes_of(part, compression="zstd") for part in parts)
        with suppress(OSError, StoreError):
            Room(self.folder.parent).make(len(data))
            with fresh_file(path, mend="") as scratch:
                scratch.write_bytes(hashlib.sha256(data).digest() + data)

    def _path(self, rejector: str, code: str) -> Path | None:
        """Return the file of a rejector by its module:Class; None of one whose code is not among what was hashed."""
        if code.partition(".")[0] not in SHIPPED_MODULES:
            return None
        return self.folder / f"{hashlib.sha256(self.entry + repr((rejector, code)).encode()).hexdigest()}{_SUFFIX}"


def _parts(scores: pd.DataFrame, answers: StoredAnswers) -> Iterator[pa.Buffer]:
    yield _bytes_of(pa.Table.from_pandas(scores))
    yield from map(_bytes_of, answers.tables())


def _bytes_of(table: pa.Table, *, compression: str | None = None) -> pa.Buffer:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as stream:
        stream.write_table(table)
    return sink.getvalue()


def _programs() -> bytes | None:
    """Return the SHA-256 of the packages that ship, of Python and all that is installed, and of the machine.

    None if a file of theirs has changed since this process began, which may run what it was before.
    """
    roots = [Path(str(sys.modules[name].__file__)).parent for name in SHIPPED_MODULES if name in sys.modules]
    found = (path for root in roots for path in root.rglob("*") if path.parent.name != "__pycache__")
    with suppress(FileNotFoundError):  # it went meanwhile, as what an editor writes
        about = tuple((path, path.stat().st_mtime_ns) for path in sorted(found) if path.is_file())
        if max(changed_ns for _, changed_ns in about) < psutil.Process().create_time() * 1e9:
            return _digest(about)
    return None


@cache
def _digest(files: tuple[tuple[Path, int], ...]) -> bytes:
    """Return the SHA-256 of files as they were at some time, and of what is below them."""
    digest = hashlib.sha256(repr(installed()).encode())
    for path, _ in files:
        digest.update(repr(str(path)).encode() + hashlib.sha256(plain_file(path).read_bytes()).digest())
    return digest.digest()
