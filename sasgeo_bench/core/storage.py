# SPDX-License-Identifier: Apache-2.0
"""Folders in object storage: sent whole, fetched whole, each file held against its hash.

All work happens on local disks, where a folder can be renamed at once. Storage holds finished folders: regions, tasks,
truths, runs, boards, or all of an `out`. A list with the hash of each file is written last: without it there is nothing
to fetch. What was cut goes on where it was. Nothing is removed from storage.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from shutil import copyfile
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, named
from sasgeo_bench.core.folders import (
    FileRecord,
    absolute,
    check_known,
    check_room,
    file_record,
    list_files,
    locked,
    remove_tree,
    replace_folder,
    sha256_of,
)
from sasgeo_bench.core.json import MOST_BYTES, parse_json
from sasgeo_bench.core.paths import given_path, plain_file, read_bounded
from sasgeo_bench.core.texts import json_text, one_line

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

LIST: Final = "sent.json"  # in storage; in a folder that is being fetched, of whose files it is
_SENDING: Final = "sending.json"  # the same of the files so far, while others are sent
_MADE_BY: Final = "sasgeo-bench send"
_MOST_LIST_BYTES: Final = 500_000_000
_FILES_AT_ONCE: Final = 64  # sent before the list of those so far is written again
_CONTENT: Final = {"region.json": ("id",), "task.json": ("suite", "region"), "run.json": ("hash", "suite", "region")}
_SECRET: Final = re.compile(r"(?<=://)[^/@]*@|\?.*$", re.DOTALL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """Files and bytes of a folder, how many of the files had to be moved, and how many hidden ones were left out."""

    files: int
    bytes: int
    moved: int
    hidden: int = 0


def send(folder: str | Path, url: str) -> Moved:
    """Copy a folder into storage, over an older copy of it.

    `url` names the place of the folder itself, as in s3://bucket/regions/vaduz; fsspec knows the protocols, and reads
    credentials from its own configuration and environment. Hidden files are left out. Two programs that send to one
    place at once spoil each other's files, which `fetch` notices.

    Raise `StoreError` if the folder holds no file, a link, or a name that cannot be sent, if the storage refuses, or
    holds another region, task or run there, or files that the folder lacks; `ConfigError` if nothing is known of such
    an URL.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> (folder / "region.json").write_text("{}")
    2
    >>> send(folder, "memory://doc/vaduz").moved, send(folder, "memory://doc/vaduz").moved
    (1, 0)
    """
    folder = given_path(folder)
    names, hidden = _names_of(folder)
    records, content = {name: file_record(folder / name) for name in names}, _content_of(folder)
    with _storage(url) as (system, root):
        _check_apart(folder, system, root)
        system.invalidate_cache()
        known = _read_list(system, root, LIST, url) or _read_list(system, root, _SENDING, url) or _Sent()
        sizes = {path.removeprefix(f"{root}/"): size for path, size in _sizes(system, root).items()}
        others = sorted(name for name in sizes if name not in records and name not in {LIST, _SENDING})
        others += sorted(name for name in records if name in sizes and name not in known.names)
        _check_same(known.content, content, shown(url), "another place, or empty that one")
        if others:
            raise StoreError(
                f"{shown(url)} holds {one_line(named(others, 'file'))} of another folder, which would be lost: name "
                "another place, or empty that one"
            )
        there = {
            name: one for name, one in records.items() if known.files.get(name) == one and sizes.get(name) == one.bytes
        }
        left = [name for name in names if name not in there]
        if left:
            _write_list(system, root, _SENDING, _Sent(there, frozenset(names), content))
            _remove(system, f"{root}/{LIST}")
        for at, name in enumerate(left, start=1):
            _put(system, folder / name, f"{root}/{name}")
            there[name] = records[name]
            if at % _FILES_AT_ONCE == 0:
                _write_list(system, root, _SENDING, _Sent(there, frozenset(names), content))
        _write_list(system, root, LIST, _Sent(records, frozenset(names), content))
        _remove(system, f"{root}/{_SENDING}")
    return Moved(files=len(names), bytes=_bytes_of(records), moved=len(left), hidden=hidden)


def fetch(url: str, folder: str | Path) -> Moved:
    """Copy a folder that was sent from storage, over an older copy of it; whole or not at all.

    Arguments and errors are as of `send`; files that a fetch that was cut has brought are kept beside the folder. Raise
    `StoreError`, too, if nothing was sent there, or not all, a file is not what was sent, or the folder is a link, or
    holds files that would be lost.
    """
    target = absolute(given_path(folder))
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise StoreError(f"{target} is a link, or no folder, and would be lost: name another folder")
    check_room(target)
    with _storage(url) as (system, root), locked(target):
        sent = _read_list(system, root, LIST, url)
        if sent is None:
            is_cut = _read_list(system, root, _SENDING, url) is not None
            cut, nothing = "was not sent to its end: send it again", "holds no folder that was sent: check the URL"
            raise StoreError(f"{shown(url)} {cut if is_cut else nothing}")
        records = sent.files
        _check_same(_content_of(target), sent.content, str(target), "another folder")
        check_known(target, set(records), "the folder that was sent")
        scratch, moved = _begun(target, sent), 0
        for name, record in sorted(records.items()):
            path = scratch / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if not _is_there(path, record):
                if _is_there(target / name, record):
                    copyfile(target / name, path)
                else:
                    system.get_file(f"{root}/{name}", str(path))
                    moved += 1
            if not _is_there(path, record):
                path.unlink(missing_ok=True)
                raise StoreError(
                    f"{shown(url)}/{one_line(name)} is not what was sent: remove that file there, and send the folder "
                    "again"
                )
        whole = _whole(target)
        scratch.rename(whole)  # first, so that a folder without its list still tells by its name what it is
        (whole / LIST).unlink()
        replace_folder(whole, target)
    return Moved(files=len(records), bytes=_bytes_of(records), moved=moved)


def _bytes_of(records: Mapping[str, FileRecord]) -> int:
    return sum(one.bytes for one in records.values())


def _names_of(folder: Path) -> tuple[list[str], int]:
    """Return the files of a folder to send, and the number of hidden ones, which are not."""
    if not folder.is_dir():
        fault = "is no folder" if folder.exists() else "does not exist"
        raise StoreError(f"{folder} {fault}: name the folder of a region, a task, a run or a board")
    every = list_files(folder)
    names = [name for name in every if not any(part.startswith(".") for part in PurePosixPath(name).parts)]
    odd = next((name for name in names if not _is_within(name)), None)
    if odd is not None:
        raise StoreError(
            f"{folder} holds {one_line(odd)!r}, a name that no storage keeps, or that this program needs: rename it"
        )
    if not names:
        raise StoreError(f"{folder} holds no file to send: name the folder of a region, a task, a run or a board")
    return names, len(every) - len(names)


def _check_apart(folder: Path, system: "AbstractFileSystem", root: str) -> None:
    if "file" not in (system.protocol if isinstance(system.protocol, tuple) else (system.protocol,)):
        return
    here, there = folder.resolve(), Path(root).resolve()
    if here.is_relative_to(there) or there.is_relative_to(here):
        raise StoreError(f"{folder} would be sent into itself: name a place outside of it")


def _content_of(folder: Path) -> str:
    """Return what a region, a task or a run says that it is; empty for another folder, or a damaged one."""
    for name, keys in _CONTENT.items():
        with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
            about: Any = parse_json(read_bounded(folder / name, MOST_BYTES))
            return "/".join(str(about[key]) for key in keys)
    return ""


def _check_same(there: str, content: str, where: str, elsewhere: str) -> None:
    """Refuse to put one region, task or run over another one: their files have the same names."""
    if there and content and there != content:
        raise StoreError(f"{where} holds {one_line(there)}, and {one_line(content)} would replace it: name {elsewhere}")


def _begun(target: Path, sent: "_Sent") -> Path:
    """Return the folder beside another one that its files are fetched into: one that was begun, or a new one."""
    scratch = target.with_name(f".{target.name}.fetched")
    data = _list_bytes(sent)
    mark, whole = scratch / LIST, _whole(target)
    if whole.is_dir() and not whole.is_symlink():
        if scratch.exists() or not set(list_files(whole)) - {LIST} <= sent.files.keys():
            remove_tree(whole)
        else:
            whole.rename(scratch)
            if not mark.is_file():
                mark.write_bytes(data)
    if scratch.is_dir() and not scratch.is_symlink() and mark.is_file():
        if plain_file(mark).read_bytes() == data:
            return scratch
        remove_tree(scratch)  # of another folder, or an older copy
    try:
        scratch.mkdir()
    except FileExistsError as error:
        raise StoreError(f"{scratch} stands in the way, and is no fetch that was cut: move it away") from error
    mark.write_bytes(data)
    return scratch


def _whole(target: Path) -> Path:
    return target.with_name(f".{target.name}.whole")


def _is_there(path: Path, record: FileRecord) -> bool:
    is_file = path.is_file() and not path.is_symlink()
    return is_file and path.stat().st_size == record.bytes and sha256_of(path) == record.sha256


def shown(url: str) -> str:
    """Return an URL as a line may show it: without what may be secret.

    >>> shown("ftp://me:secret@host/vaduz?token=secret")
    'ftp://host/vaduz'
    """
    return one_line(_SECRET.sub("", url))


@contextmanager
def _storage(url: str) -> Iterator[tuple["AbstractFileSystem", str]]:
    """Yield the file system of an URL, and the path of its place there; turn its refusals into a line."""
    try:
        import fsspec  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        raise ConfigError("object storage needs the package fsspec: pip install 'sasgeo-bench[storage]'") from error
    try:
        system, root = fsspec.url_to_fs(url)
        yield system, _place(url, root)
    except SasgeoError:
        raise
    except ImportError as error:
        raise ConfigError(
            f"{shown(url)} needs a package for such a storage ({one_line(str(error))}): install it"
        ) from error
    except Exception as error:  # whatever the file system of others raises
        fault = one_line(str(error).replace(url, shown(url)) or repr(error))
        raise StoreError(
            f"{shown(url)} cannot be reached ({fault}): check the URL, your rights and the free space"
        ) from error


def _place(url: str, root: str) -> str:
    """Return the path of a place in its storage; raise `ConfigError` if it is that of all of it."""
    if not (url.strip() and root.strip(":./")):
        raise ConfigError(f"{shown(url)!r} names no place in a storage: give an URL, as s3://bucket/regions/vaduz")
    return re.sub("/{2,}", "/", root).rstrip("/")


def _sizes(system: "AbstractFileSystem", root: str) -> dict[str, int]:
    """Return the bytes of all files below a place; a marker of a folder holds nothing, and is none."""
    found = dict(system.find(root, detail=True)) if system.exists(root) else {}
    # Ends of keys without bytes that consoles and Hadoop make for a folder
    sizes = {path: about["size"] for path, about in found.items()}
    return {path: size for path, size in sizes.items() if size or not path.endswith(("/", "_$folder$"))}


def _put(system: "AbstractFileSystem", path: Path, there: str) -> None:
    try:
        system.makedirs(there.rpartition("/")[0], exist_ok=True)
        system.put_file(str(path), there)
    except FileNotFoundError as error:
        if path.is_file():
            raise
        raise StoreError(f"{path} went away while its folder was sent: send the folder again") from error


@dataclass(frozen=True, slots=True)
class _Sent:
    """A list of files, the names of all that were to be sent, and what their folder says that it is."""

    files: Mapping[str, FileRecord] = field(default_factory=dict)
    names: frozenset[str] = frozenset()
    content: str = ""


def _read_list(system: "AbstractFileSystem", root: str, name: str, url: str) -> _Sent | None:
    """Read a list of files; None without one. Its names may come from anybody: none may lead out of the folder."""
    path = f"{root}/{name}"
    if not system.exists(path):
        return None
    try:
        content: Any = parse_json(system.cat_file(path)) if system.size(path) <= _MOST_LIST_BYTES else {}
        found = {str(file): FileRecord.model_validate(record) for file, record in content["files"].items()}
        names = frozenset(map(str, (*found, *content.get("begun", ()))))
        is_ours = content["made_by"] == _MADE_BY
    except (ValueError, ValidationError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise StoreError(
            f"{shown(url)}/{name} is no list of files that were sent: empty that place, and send the folder again"
        ) from error
    odd = next((file for file in found if not _is_within(file)), _both(found))
    if odd is not None or not is_ours or (name == LIST and not found):
        what = "nothing that was sent" if odd is None else f"{one_line(odd)[:60]!r}, which is no file of a folder"
        raise StoreError(f"{shown(url)}/{name} lists {what}: empty that place, and send the folder again")
    return _Sent(found, names, str(content.get("content", "")))


def _is_within(name: str) -> bool:
    """Return whether a name is a plain path below a folder, which storage and every disk can keep."""
    is_plain = "\\" not in name and "\0" not in name and name not in {LIST, _SENDING}
    parts = name.split("/")
    sizes = (len(part.encode(errors="replace")) for part in parts)
    # 255 bytes of a name of a file or folder
    return is_plain and all(
        part and not part.startswith(".") and size <= 255 for part, size in zip(parts, sizes, strict=True)
    )


def _both(names: Iterable[str]) -> str | None:
    """Return a name that is a file and a folder of others; None if there is none."""
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    return next((name for name in names if name in folders), None)


def _list_bytes(sent: _Sent) -> bytes:
    files = {file: one.model_dump() for file, one in sorted(sent.files.items())}
    begun = sorted(sent.names) if sent.names - set(files) else []
    return json_text({"made_by": _MADE_BY, "content": sent.content, "files": files, "begun": begun}).encode()


def _write_list(system: "AbstractFileSystem", root: str, name: str, sent: _Sent) -> None:
    system.makedirs(root, exist_ok=True)
    system.pipe_file(f"{root}/{name}", _list_bytes(sent))


def _remove(system: "AbstractFileSystem", path: str) -> None:
    with suppress(FileNotFoundError):
        system.rm_file(path)
