# SPDX-License-Identifier: Apache-2.0
"""Sizes and hashes of files, and folders of unknown origin compared with a list of known files."""

import hashlib
import os
import stat
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Final

from pydantic import ConfigDict, Field

from sasgeo_bench.bounds import one_line
from sasgeo_bench.config import Document
from sasgeo_bench.errors import StoreError, named
from sasgeo_bench.files.json import read_json


class FileRecord(Document):
    """Size and SHA-256 of one file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)

    sha256: str
    bytes: Annotated[int, Field(ge=0)]


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal, read in pieces."""
    with path.open("rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()


def file_record(path: Path) -> FileRecord:
    """Return size and hash of a file."""
    return FileRecord(sha256=sha256_of(path), bytes=path.stat().st_size)


SITE: Final = "site"
SITE_MANIFEST: Final = "site.json"  # without it a folder is no site, and is not replaced
SITE_FOLDERS: Final = (SITE, f".{SITE}.partial", f".{SITE}.replaced")  # the last two if publishing was killed
IMAGES: Final = (".webp", ".png", ".jpg", ".jpeg")
FIGURE_FILES: Final = ("figures/*.svg", "figures/*.svg.gz")
PICTURE_FILES: Final = ("pictures/pictures.json", *(f"pictures/*{kind}" for kind in IMAGES))
_OLD_SITE: Final = ("*.html", "site.css", "site.js", "files/*", *FIGURE_FILES, *PICTURE_FILES)  # listed no files


def resolve_link(path: Path) -> Path:
    """Return the target of a symbolic link, any other path unchanged; raise `StoreError` if links form a circle."""
    try:
        return path.resolve() if path.is_symlink() else path
    except (OSError, RuntimeError) as error:
        message = f"{path} is a link that leads in a circle: name a folder"
        raise StoreError(message) from error


def _walk(folder: Path, without: Collection[str]) -> Iterator[tuple[str, Path]]:
    """Yield everything below a folder except folders, by relative path; links are not followed."""
    for parent, folders, files in os.walk(folder):
        if Path(parent) == folder:
            folders[:] = [name for name in folders if name not in without]
        links = [name for name in folders if (Path(parent) / name).is_symlink()]
        for name in (*links, *files):
            path = Path(parent) / name
            yield path.relative_to(folder).as_posix(), path


def list_files(folder: Path, *, without: Collection[str] = ()) -> list[str]:
    """Return the paths of all files in a folder, sorted, without the folders named in `without`.

    Raise `StoreError` if one is a link, which could lead to any file of this machine, or a pipe or a device.
    """
    found = []
    for name, path in _walk(folder, without):
        if not stat.S_ISREG(path.lstat().st_mode):
            message = f"{path} is a link, or no file: put a plain file there, or remove it"
            raise StoreError(message)
        found.append(name)
    return sorted(found)


def hashes_of(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the SHA-256 of some files of a folder, by path."""
    return {name: sha256_of(folder / name) for name in names}


def first_difference(folder: Path, recorded: Mapping[str, str], *, without: Collection[str] = ()) -> str | None:
    """Describe the first missing, unlisted or changed file of a folder, or return None."""
    there = list_files(folder, without=without)
    missing = sorted(set(recorded) - set(there))
    if missing:
        return f"{missing[0]} is missing"
    more = sorted(set(there) - set(recorded))
    if more:
        return f"{more[0]} is not in its list"
    return next((f"{name} differs" for name in there if sha256_of(folder / name) != recorded[name]), None)


def check_known(
    folder: Path, known: Collection[str], what: str, *, patterns: Sequence[str] = (), without: Collection[str] = ()
) -> None:
    """Refuse to replace a folder that holds somebody else's files; raise `StoreError` naming the first few.

    `known` holds the paths of our own files, and `patterns` further ones as in a shell; folders in `without` are
    skipped. `what` names what the files belong to, as in "a site".
    """
    other = sorted(
        name
        for name, _ in _walk(folder, without)
        if name not in known and not any(fnmatchcase(name, pattern) for pattern in patterns)
    )
    if other:
        message = (
            f"{folder} holds {one_line(named(other, 'file'))} that would be lost and are not part of {what}: "
            "move that away, or name another folder"
        )
        raise StoreError(message)


def check_site(folder: Path) -> None:
    """Refuse to replace a site that holds somebody else's files; raise `StoreError` naming them."""
    try:
        known = read_json(folder / SITE_MANIFEST, mend="publish again")["files"]
    except (StoreError, KeyError, TypeError):
        known = None
    if isinstance(known, list):
        check_known(folder, {SITE_MANIFEST, *map(str, known)}, "a site")
    else:
        check_known(folder, {SITE_MANIFEST}, "a site", patterns=_OLD_SITE)


def check_room(folder: Path) -> None:
    """Raise `StoreError` if a folder cannot be made or replaced: the work to fill it may take an hour."""
    there = next(path for path in (folder.parent, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        message = f"{folder} cannot be written, for {there} is a file: name another folder"
        raise StoreError(message)
    try:
        with tempfile.TemporaryDirectory(prefix=".sasgeo-bench-", dir=there):
            pass
        if folder.is_dir() and not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        message = f"{folder} cannot be written ({error.strerror or error}): check your rights, or name another folder"
        raise StoreError(message) from error
