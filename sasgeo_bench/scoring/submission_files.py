# SPDX-License-Identifier: Apache-2.0
"""Submissions on disk: `submission.json` and one file of predictions, by authors who are not trusted.

Cheap checks come first: names, links, sizes, then hashes, then the shape of the table.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa

from sasgeo_bench.config import check_document
from sasgeo_bench.errors import SasgeoError, StoreError
from sasgeo_bench.files.folders import check_known, file_record, fresh_folder, is_ours, locked
from sasgeo_bench.files.json import read_json
from sasgeo_bench.files.parquet import open_table, write_table
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.matching.submission import SCHEMA_VERSION, Submission, SubmittedFile
from sasgeo_bench.running.prediction_files import (
    FLOWN_SCHEMA,
    PREDICTION_SCHEMA,
    RUN_SCHEMA,
    check_lengths,
    prediction_row,
    schema_of,
)
from sasgeo_bench.tasks.task_files import ASKED
from sasgeo_bench.texts import json_text

SUBMISSION: Final = "submission.json"
PREDICTIONS: Final = "predictions"
README: Final = "README.md"  # may lie among submissions
MOST_BYTES: Final = 20_000_000  # of the predictions
_MOST_SUBMISSION_BYTES: Final = 5_000_000
_LEVEL: Final = 19


def predictions_name(name: str) -> str:
    """Return the path of the predictions inside a submission."""
    return f"{PREDICTIONS}/{name}.parquet"


def check_submission_folder(folder: Path, name: str) -> None:
    """Raise StoreError if a submission of this name cannot be written to a folder: other things would be lost."""
    if folder.name != name:
        raise StoreError(f"{folder} must be named as the card is, {name!r}: name another folder")
    is_free = not os.path.lexists(folder) or (folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir()))
    if is_free:
        return
    if folder.is_symlink() or not is_ours(folder / SUBMISSION):
        raise StoreError(f"{folder} holds something else than a submission, which would be lost: name another folder")
    check_known(folder, {SUBMISSION, predictions_name(name)}, "a submission")


def write_submission(
    folder: Path, submission: Submission, predictions: Sequence[Prediction], asked: Mapping[str, str]
) -> Submission:
    """Write a submission completely or not at all, and return it with its files; the same answers give the same bytes.

    The folder has the name of the card; an older submission there is replaced. `asked` holds the hash of each answered
    query, by query id. Raise StoreError if the folder holds something else or has another name, the predictions are too
    large, or writing fails; the folder is then unchanged.
    """
    check_submission_folder(folder, submission.card.name)
    rows = [
        {**prediction_row(item), ASKED: asked[item.query_id]}
        for item in sorted(predictions, key=lambda item: item.query_id)
    ]
    name = predictions_name(submission.card.name)
    try:
        with locked(folder), fresh_folder(folder) as scratch:
            (scratch / PREDICTIONS).mkdir()
            schema = schema_of(predictions).append(pa.field(ASKED, pa.string()))
            table = pa.Table.from_pylist(rows, schema=schema)
            write_table(table, scratch / name, compression_level=_LEVEL, write_statistics=False)
            record = file_record(scratch / name)
            _check_bytes(folder / name, record.bytes)
            whole = submission.model_copy(
                update={"files": {name: SubmittedFile(sha256=record.sha256, bytes=record.bytes)}}
            )
            text = json_text(whole.model_dump(mode="json"))
            (scratch / SUBMISSION).write_text(text, encoding="utf-8")
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        ) from error
    return whole


def _check_bytes(path: Path, size: int) -> None:
    if size > MOST_BYTES:
        raise StoreError(
            f"{path} has {size / 1e6:.1f} MB, {MOST_BYTES / 1e6:g} MB at most: give fewer "
            "candidates to each query (run --top-k)"
        )


def is_submission(folder: Path) -> bool:
    """Return True if a folder holds a `submission.json`."""
    return os.path.lexists(folder / SUBMISSION)


def list_submissions(folder: Path) -> tuple[Path, ...]:
    """Return a submission itself, or all that lies in a folder of them, without hidden files and the README.

    Those of a board may lie in a folder of their own, as in submissions/<board>/<name>. A stray entry beside them is
    returned, too: `read_submission` refuses it. Raise StoreError if there is no such folder, or nothing in it is a
    submission.
    """
    if is_submission(folder):
        return (folder,)
    inner = _visible(folder)
    found = None if inner is None else tuple(path for one in inner for path in _of_board(one) or (one,))
    if found is None or (found and not any(map(is_submission, found))):
        raise StoreError(f"{folder} is no folder of submissions: name one, or a submission itself")
    return found


def _visible(folder: Path) -> list[Path] | None:
    """Return what lies in a folder, without hidden files and the README; None if it is no folder that can be listed."""
    try:
        return [path for path in sorted(folder.iterdir()) if not path.name.startswith(".") and path.name != README]
    except OSError:
        return None


def _of_board(folder: Path) -> list[Path]:
    """Return what lies in a folder of submissions; nothing of any other folder, of a link, or of a file."""
    inner = [] if folder.is_symlink() or is_submission(folder) else _visible(folder) or []
    return inner if any(map(is_submission, inner)) else []


def read_submission(folder: Path) -> Submission:
    """Read a submission after checking its folder.

    Raise StoreError if a file is missing, unknown, a link, too large, differs from its hash, or holds no predictions.
    Raise ConfigError if a field of `submission.json` is wrong; all faults on one line.
    """
    if not is_submission(folder):
        raise StoreError(f"{folder} is no submission, for it holds no {SUBMISSION}: remove it, or make it by 'submit'")
    _check_names(folder, {SUBMISSION, PREDICTIONS})
    submission = _read_document(folder / SUBMISSION)
    name = predictions_name(submission.card.name)
    if folder.resolve().name != submission.card.name:
        raise StoreError(f"{folder} holds the submission {submission.card.name!r}: name the folder so")
    if list(submission.files) != [name]:
        listed = ", ".join(submission.files) or "none"
        raise StoreError(f"{folder / SUBMISSION} lists the files {listed}, expected {name}: submit again")
    _check_names(folder / PREDICTIONS, {Path(name).name})
    _check_file(folder / name, submission.files[name])
    _check_table(folder / name)
    return submission


def _check_names(folder: Path, expected: set[str]) -> None:
    """Refuse a folder with other names than expected, and every link: it may lead anywhere."""
    if folder.is_symlink() or not folder.is_dir():
        raise StoreError(f"{folder} is no folder of a submission: make it by 'submit'")
    with os.scandir(folder) as entries:
        found = {entry.name: _is_plain(entry) for entry in entries}
    odd = next((name for name, is_plain in sorted(found.items()) if not is_plain), None)
    if odd is not None:
        raise StoreError(f"{folder / odd} is a link, or no plain file: a submission holds files alone")
    wrong = sorted(set(found) ^ expected)
    if wrong:
        fault = "is missing" if wrong[0] in expected else "is no part of a submission"
        raise StoreError(f"{folder / wrong[0]} {fault}: a submission is made by 'submit', and nothing is added to it")


def _is_plain(entry: os.DirEntry[str]) -> bool:
    """Return True for a file or the predictions folder, False for a link, pipe or device."""
    is_folder = entry.name == PREDICTIONS
    return entry.is_dir(follow_symlinks=False) if is_folder else entry.is_file(follow_symlinks=False)


def _read_document(path: Path) -> Submission:
    content = read_json(path, mend="submit again", most_bytes=_MOST_SUBMISSION_BYTES)
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        stated = "states no schema version" if version is None else f"has schema version {version!r}"
        raise StoreError(f"{path} {stated}, this version reads {SCHEMA_VERSION}: submit again")
    return check_document(content, Submission, source=str(path))


def _check_file(path: Path, expected: SubmittedFile) -> None:
    _check_bytes(path, path.stat().st_size)
    found = file_record(path)
    if (found.sha256, found.bytes) != (expected.sha256, expected.bytes):
        raise StoreError(
            f"{path} is not what {SUBMISSION} says: {found.bytes} bytes, SHA-256 {found.sha256}, "
            f"expected {expected.bytes} bytes, {expected.sha256}: submit again"
        )


def _check_table(path: Path) -> None:
    """Refuse a table of another shape, and one that unpacks to overlong lists or texts."""
    with open_table(path, mend="submit again") as source:
        _check_schema(path, source.schema_arrow)
    check_lengths(path, mend="submit again")


def _check_schema(path: Path, schema: pa.Schema) -> None:
    plain = pa.schema(
        [
            field.with_type(field.type.value_type) if pa.types.is_dictionary(field.type) else field
            for field in schema.remove_metadata()
        ]
    )
    asked = pa.field(ASKED, pa.string())
    allowed = [known.append(asked).remove_metadata() for known in (PREDICTION_SCHEMA, FLOWN_SCHEMA)]
    if plain not in allowed:
        wrong = sorted(set(plain.names) ^ set(RUN_SCHEMA.names)) or ["the types of its columns"]
        raise StoreError(
            f"{path} holds no predictions as 'submit' writes them ({wrong[0]} is not as it must be): submit again"
        )
