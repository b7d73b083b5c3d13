# SPDX-License-Identifier: Apache-2.0
"""Folders in object storage: sent whole, fetched whole, each file held against its hash.

All work happens on local disks, where a folder can be renamed at once. Storage holds finished folders: regions, tasks,
truths, runs, boards, or all of an `out`. A list with the hash of each file is written last: without it there is nothing
to fetch. What was cut goes on where it was.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.files.folders import (
    FileRecord,
    absolute,
    check_known,
    check_room,
    file_record,
    list_files,
    locked,
    replace_folder,
    sha256_of,
)
from sasgeo_bench.files.json import parse_json
from sasgeo_bench.texts import json_text, one_line

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

LIST: Final = "sent.json"  # in storage alone
_SENDING: Final = "sending.json"  # the same of the files so far, while others are sent
_MADE_BY: Final = "sasgeo-bench send"
_MOST_LIST_BYTES: Final = 500_000_000
_FILES_AT_ONCE: Final = 64  # sent before the list of those so far is written again


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Files and bytes of a folder, and how many of the files had to be moved: the others were there."""

    files: int
    bytes: int
    moved: int


def send(folder: Path, url: str) -> Moved:
    """Copy a folder into storage, in place of an older copy of it.

    `url` names the place of the folder itself, as in s3://bucket/regions/vaduz; fsspec knows the protocols, and reads
    credentials from its own configuration and environment. Hidden files are left out. Raise `StoreError` if the folder
    holds no file, or a link, or the storage holds something else there or refuses; `ConfigError` if nothing is known of
    such an URL.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> (folder / "region.json").write_text("{}")
    2
    >>> send(folder, "memory://doc/vaduz").moved, send(folder, "memory://doc/vaduz").moved
    (1, 0)
    """
    names = [name for name in list_files(folder) if not any(part.startswith(".") for part in PurePosixPath(name).parts)]
    if not names:
        message = f"{folder} holds no file to send: name the folder of a region, a task, a run or a board"
        raise StoreError(message)
    records = {name: file_record(folder / name) for name in names}
    with _storage(url) as (system, root):
        known = _read_list(system, root, LIST, url) or _read_list(system, root, _SENDING, url)
        if known is None and system.exists(root) and system.ls(root):
            message = f"{url} holds something else than a folder that was sent, which would be lost: name another place"
            raise StoreError(message)
        there = {name: one for name, one in (known or {}).items() if records.get(name) == one}
        left = [name for name in names if name not in there]
        if left or known != records:
            _write_list(system, root, _SENDING, there)
            _remove(system, f"{root}/{LIST}")
        for at, name in enumerate(left, start=1):
            system.makedirs(f"{root}/{PurePosixPath(name).parent}", exist_ok=True)
            system.put_file(str(folder / name), f"{root}/{name}")
            there[name] = records[name]
            if at % _FILES_AT_ONCE == 0:
                _write_list(system, root, _SENDING, there)
        for name in set(known or {}) - set(records):
            _remove(system, f"{root}/{name}")
        _write_list(system, root, LIST, records)
        _remove(system, f"{root}/{_SENDING}")
    return Moved(files=len(names), bytes=sum(one.bytes for one in records.values()), moved=len(left))


def fetch(url: str, folder: Path) -> Moved:
    """Copy a folder that was sent from storage, in place of an older copy of it; whole or not at all.

    Arguments and errors are as of `send`; files that a fetch that was cut has brought are kept beside the folder. Raise
    `StoreError`, too, if nothing was sent there, or not all, a file is not what was sent, or the folder holds files
    that would be lost.
    """
    check_room(folder)
    with _storage(url) as (system, root), locked(folder, tell=lambda _: None):
        records = _read_list(system, root, LIST, url)
        if records is None:
            is_cut = _read_list(system, root, _SENDING, url) is not None
            fault = (
                "was not sent to its end: send it again" if is_cut else "holds no folder that was sent: check the URL"
            )
            message = f"{url} {fault}"
            raise StoreError(message)
        check_known(folder, set(records), "the folder that was sent")
        target = absolute(folder)
        scratch = target.with_name(f".{target.name}.fetched")
        moved = 0
        for name, record in sorted(records.items()):
            path = scratch / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if not _is_there(path, record):
                if _is_there(target / name, record):
                    path.write_bytes((target / name).read_bytes())
                else:
                    system.get_file(f"{root}/{name}", str(path))
                    moved += 1
            if not _is_there(path, record):
                path.unlink(missing_ok=True)
                message = f"{url}/{name} is not what was sent: send it again"
                raise StoreError(message)
        for name in set(list_files(scratch)) - set(records):
            (scratch / name).unlink()
        replace_folder(scratch, target)
    return Moved(files=len(records), bytes=sum(one.bytes for one in records.values()), moved=moved)


def _is_there(path: Path, record: FileRecord) -> bool:
    is_file = path.is_file() and not path.is_symlink()
    return is_file and path.stat().st_size == record.bytes and sha256_of(path) == record.sha256


@contextmanager
def _storage(url: str) -> Iterator[tuple["AbstractFileSystem", str]]:
    """Yield the file system of an URL, and the path of its place there; turn its refusals into a `StoreError`."""
    try:
        import fsspec  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        message = "object storage needs the package fsspec: pip install 'sasgeo-bench[storage]'"
        raise ConfigError(message) from error
    try:
        system, root = fsspec.url_to_fs(url)
    except (ValueError, ImportError) as error:
        message = (
            f"{one_line(url)!r} names no storage ({one_line(str(error))}): give an URL, as s3://bucket/regions/vaduz"
        )
        raise ConfigError(message) from error
    if not root.strip("/"):
        message = f"{one_line(url)!r} names no place in the storage: add a folder to it"
        raise ConfigError(message)
    try:
        yield system, root.rstrip("/")
    except StoreError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        message = (
            f"{one_line(url)} cannot be reached ({one_line(str(error) or repr(error))}): check the URL and your rights"
        )
        raise StoreError(message) from error


def _read_list(system: "AbstractFileSystem", root: str, name: str, url: str) -> dict[str, FileRecord] | None:
    """Read a list of files; None without one. Its names may come from anybody: none may lead out of the folder."""
    path = f"{root}/{name}"
    if not system.exists(path):
        return None
    try:
        content: Any = parse_json(system.cat_file(path)) if system.size(path) <= _MOST_LIST_BYTES else {}
        is_ours = content.get("made_by") == _MADE_BY
        files = content["files"] if is_ours else {}
        found = {str(file): FileRecord.model_validate(record) for file, record in files.items()}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        message = f"{url}/{name} is no list of files that were sent ({one_line(str(error))}): send the folder again"
        raise StoreError(message) from error
    if not is_ours:
        message = f"{url}/{name} was made by another program, or is too large: name another place"
        raise StoreError(message)
    odd = next((file for file in found if not _is_within(file)), None)
    if odd is not None:
        message = f"{url}/{name} lists {one_line(odd)!r}, which is no file of a folder: send the folder again"
        raise StoreError(message)
    return found


def _is_within(name: str) -> bool:
    """Return whether a name is a plain path below a folder.

    >>> [_is_within(name) for name in ("layers/a.tif", "../a", "/a", "a//b", ".a")]
    [True, False, False, False, False]
    """
    parts = name.split("/")
    return "\\" not in name and "\0" not in name and all(part and not part.startswith(".") for part in parts)


def _write_list(system: "AbstractFileSystem", root: str, name: str, records: Mapping[str, FileRecord]) -> None:
    files = {file: one.model_dump() for file, one in sorted(records.items())}
    system.makedirs(root, exist_ok=True)
    system.pipe_file(f"{root}/{name}", json_text({"made_by": _MADE_BY, "files": files}).encode())


def _remove(system: "AbstractFileSystem", path: str) -> None:
    with suppress(FileNotFoundError):
        system.rm_file(path)
