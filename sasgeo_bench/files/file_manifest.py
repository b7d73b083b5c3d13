# SPDX-License-Identifier: Apache-2.0
"""Folders that anybody may have made: their files listed, hashed, and held against those that are known as ours."""

import os
import stat
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import StoreError, named
from sasgeo_bench.files.hashes import sha256_of
from sasgeo_bench.files.json import read_json

SITE: Final = "site"
SITE_SAYS: Final = "site.json"  # without it a folder is no site, and is not replaced
SITE_FOLDERS: Final = (SITE, f".{SITE}.partial", f".{SITE}.replaced")  # the latter two where publishing was killed
IMAGES: Final = (".webp", ".png", ".jpg", ".jpeg")
FIGURE_FILES: Final = ("figures/*.svg", "figures/*.svg.gz")
PICTURE_FILES: Final = ("pictures/pictures.json", *(f"pictures/*{kind}" for kind in IMAGES))
_OLD_SITE: Final = ("*.html", "site.css", "site.js", "files/*", *FIGURE_FILES, *PICTURE_FILES)  # listed no files


def led_to(path: Path) -> Path:
    """Where a symbolic link leads; any other path as it is.

    Raises
    ------
    StoreError
        If links lead in a circle.

    Examples
    --------
    >>> led_to(Path("nowhere"))
    PosixPath('nowhere')
    """
    try:
        return path.resolve() if path.is_symlink() else path
    except (OSError, RuntimeError) as error:
        message = f"{path} is a link that leads in a circle: name a folder"
        raise StoreError(message) from error


def _walk(folder: Path, without: Collection[str]) -> Iterator[tuple[str, Path]]:
    """Everything below a folder that is no folder itself, by its path in there; links are not followed."""
    for parent, folders, files in os.walk(folder):
        if Path(parent) == folder:
            folders[:] = [name for name in folders if name not in without]
        links = [name for name in folders if (Path(parent) / name).is_symlink()]
        for name in (*links, *files):
            path = Path(parent) / name
            yield path.relative_to(folder).as_posix(), path


def list_files(folder: Path, *, without: Collection[str] = ()) -> list[str]:
    """Paths of all files in a folder, sorted.

    Parameters
    ----------
    folder : Path
        Of files alone.
    without : collection of str
        Folders in it that are passed over.

    Raises
    ------
    StoreError
        If one is a link, which could lead to any file of this machine, or a pipe or a device.

    Examples
    --------
    >>> list_files(Path("nowhere"))
    []
    """
    found = []
    for name, path in _walk(folder, without):
        if not stat.S_ISREG(path.lstat().st_mode):
            message = f"{path} is a link, or no file: put a plain file there, or remove it"
            raise StoreError(message)
        found.append(name)
    return sorted(found)


def hashes_of(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """SHA-256 of some files of a folder, by their paths."""
    return {name: sha256_of(folder / name) for name in names}


def differing(folder: Path, said: Mapping[str, str], *, without: Collection[str] = ()) -> str | None:
    """The first file of a folder that is missing, is more than was said, or has another hash; None where all is well.

    Raises
    ------
    StoreError
        As `list_files` does.

    Examples
    --------
    >>> differing(Path("nowhere"), {"a.txt": "ff"})
    'a.txt is missing'
    """
    there = list_files(folder, without=without)
    missing = sorted(set(said) - set(there))
    if missing:
        return f"{missing[0]} is missing"
    more = sorted(set(there) - set(said))
    if more:
        return f"{more[0]} is not in its list"
    return next((f"{name} differs" for name in there if sha256_of(folder / name) != said[name]), None)


def check_known(
    folder: Path, known: Collection[str], what: str, *, patterns: Sequence[str] = (), without: Collection[str] = ()
) -> None:
    """Refuse to put something in place of a folder that holds files of somebody else.

    Parameters
    ----------
    folder : Path
        To be replaced.
    known : collection of str
        Paths in it of files that are ours.
    what : str
        What they are part of, as in "a site".
    patterns : sequence of str
        Further ones, as for a shell.
    without : collection of str
        Folders in it that are passed over.

    Raises
    ------
    StoreError
        Naming the first few.
    """
    other = sorted(
        name
        for name, _ in _walk(folder, without)
        if name not in known and not any(fnmatchcase(name, pattern) for pattern in patterns)
    )
    if other:
        message = (
            f"{folder} holds {one_line(named(other, 'file'))} that would be lost, for nothing of it is part of {what}: "
            "move that away, or name another folder"
        )
        raise StoreError(message)


def check_site(folder: Path) -> None:
    """Refuse to replace a site into which somebody has put files of their own; one that is not there is no site.

    Raises
    ------
    StoreError
        Naming them.

    Examples
    --------
    >>> check_site(Path("nowhere"))
    """
    try:
        known = read_json(folder / SITE_SAYS, mend="publish again")["files"]
    except (StoreError, KeyError, TypeError):
        known = None
    if isinstance(known, list):
        check_known(folder, {SITE_SAYS, *map(str, known)}, "a site")
    else:
        check_known(folder, {SITE_SAYS}, "a site", patterns=_OLD_SITE)


def check_room(folder: Path) -> None:
    """Refuse a folder that cannot be made or replaced: what would be written there is an hour's work.

    Raises
    ------
    StoreError
        If a file stands in its way, or there is no right to write.
    """
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
