# SPDX-License-Identifier: Apache-2.0
"""Write folders whole or not at all, by one run at a time; remove them; compare their files with listed hashes."""

import errno
import gc
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from filelock import FileLock, Timeout
from pydantic import Field

from sasgeo_bench.core.config import JsonDocument
from sasgeo_bench.core.errors import SasgeoError, StoreError, named
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line

if sys.platform != "win32":
    import fcntl


def remove_tree(folder: Path) -> None:
    """Remove a folder with all its content, whatever a plugin has made there; raise nothing, follow no link.

    It goes down and up again folder by folder, with one of them open at a time: depth, long names and missing rights do
    not stop it. What the system refuses to remove stays; the folder need not exist.
    """
    if sys.platform == "win32":  # opens no folders
        shutil.rmtree(folder, ignore_errors=True)
        return
    with suppress(OSError):
        here = _opened(str(folder), None)
        try:
            above: list[_Above] = []
            left = os.listdir(here)  # noqa: PTH208 - no path is short enough
            while left or above:
                if not left:
                    name, left, known = above.pop()
                    here = _instead(here, os.open("..", os.O_RDONLY | os.O_DIRECTORY, dir_fd=here))
                    if not os.path.samestat(os.fstat(here), known):
                        return  # moved meanwhile: this is another folder
                    with suppress(OSError):
                        os.rmdir(name, dir_fd=here)
                elif (below := _unlinked(left[-1], here)) is None:
                    left.pop()
                else:
                    above.append(_Above(left.pop(), left, os.fstat(here)))
                    here, left = _instead(here, below), os.listdir(below)  # noqa: PTH208
        finally:
            os.close(here)
        folder.rmdir()


class _Above(NamedTuple):
    """A folder while it is emptied: the entry being emptied, the other entries left, and the identity of the folder."""

    name: str
    left: list[str]
    known: os.stat_result


def _instead(old: int, new: int) -> int:
    os.close(old)
    return new


def _unlinked(name: str, parent: int) -> int | None:
    """Remove a file or link; open a folder instead, if possible."""
    with suppress(OSError):
        os.unlink(name, dir_fd=parent)
        return None
    with suppress(OSError):
        return _opened(name, parent)
    return None


def _opened(name: str, parent: int | None) -> int:
    """Open a folder with all rights given to its owner; follow no link."""
    flags = os.O_DIRECTORY | os.O_NOFOLLOW
    if hasattr(os, "O_PATH"):  # opens without the right to read: exactly this folder gets the rights
        known = os.open(name, flags | os.O_PATH, dir_fd=parent)
        try:
            with suppress(OSError):
                Path(f"/proc/self/fd/{known}").chmod(0o700)
        finally:
            os.close(known)
    return os.open(name, flags | os.O_RDONLY, dir_fd=parent)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; a second run says so and waits. Raise `StoreError` if the lock cannot be made.

    The file of the lock is removed while it is still held. Whoever waits for it then holds a file without a name, sees
    that, and tries again by the name (`filelock`, which removes none itself since 3.30).
    """
    folder = absolute(folder)
    lock = FileLock(folder.parent / f".{folder.name}.lock")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            check_room(folder)  # where no file can be made, it is not locked
            tell(f"{folder} is being written by another run, waiting for it")
            lock.acquire()
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):
            Path(lock.lock_file).unlink()
        lock.release()


@contextmanager
def fresh_file(path: Path, *, mend: str) -> Iterator[Path]:
    """Yield a scratch file next to `path` that replaces it if the block succeeds, and is removed otherwise.

    Raise `StoreError`, with the advice `mend`, if it cannot be written.
    """
    scratch = path.parent / f".{path.name}.{os.getpid()}.partial"
    try:
        check_no_folder(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield scratch
            _flush(scratch)
            scratch.replace(path)
        finally:  # also of an interrupt; once it is renamed there is none
            with suppress(OSError):
                scratch.unlink()
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(f"{path} cannot be written ({error.strerror or error}): {mend}") from error


def check_free(path: Path, text: str) -> bool:
    """Return whether a text can be written to a path: False if it is there already, with a line.

    Raise `StoreError` if anything else is there.
    """
    if not os.path.lexists(path):
        return True
    with suppress(OSError, UnicodeDecodeError):
        if plain_file(path).read_text(encoding="utf-8") == text:
            tell(f"{path} is there already")
            return False
    raise StoreError(f"{path} is there, and says something else: remove it, or choose another name or folder (--into)")


def check_no_folder(path: Path) -> None:
    """Raise `OSError` if a folder, "." included, has the path that a file is to get."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))


@contextmanager
def fresh_folder(target: Path) -> Iterator[Path]:
    """Yield an empty folder next to `target` that replaces it if the block succeeds, and is removed otherwise.

    Call it under `locked`: leftovers of a build that was killed are removed first.
    """
    target = absolute(target)
    scratch = target.parent / f".{target.name}.partial"
    replaced = target.parent / f".{target.name}.replaced"
    if replaced.exists() and not target.exists():
        replaced.rename(target)  # killed between the two renames below: the old region is still whole
    for leftover in (scratch, replaced):
        _clear(leftover)
    scratch.mkdir(parents=True)
    try:
        yield scratch
        replace_folder(scratch, target)
    finally:
        _clear(scratch)
        _clear(replaced)


def replace_folder(scratch: Path, target: Path) -> None:
    """Give a folder that is complete the name of another one, which is removed; call it under `locked`."""
    replaced = target.parent / f".{target.name}.replaced"
    for path in scratch.rglob("*"):
        _flush(path)
    if os.path.lexists(target):  # true also for a broken link
        _clear(replaced)
        target.rename(replaced)
    scratch.rename(target)
    _clear(replaced)


def _clear(path: Path) -> None:
    """Remove a folder, or a file or link in its place; the target of a link stays."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    else:
        remove_tree(path)


def _flush(path: Path) -> None:
    is_windows = sys.platform == "win32"  # which flushes no folder, and no file that cannot be written
    if is_windows and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if is_windows else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class FileRecord(JsonDocument):
    """Size and SHA-256 of one file."""

    sha256: str
    bytes: Annotated[int, Field(ge=0)]


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal, read in pieces."""
    with plain_file(path).open("rb") as source:
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
        raise StoreError(f"{path} is a link that leads in a circle: name a folder") from error


def absolute(path: Path) -> Path:
    """Return a path from the root, which has a name also where it was given as "." or ".."; links stay.

    >>> absolute(Path("/data/maps/..")).name
    'data'
    """
    return Path(os.path.abspath(path))  # noqa: PTH100 - Path.resolve follows links, Path.absolute keeps ".."


def _walk(folder: Path, without: Collection[str]) -> Iterator[tuple[str, Path]]:
    """Yield everything below a folder except folders, by relative path; links are not followed."""

    # Raise `StoreError` for a folder that cannot be looked into: its content is unknown.
    def refuse(error: OSError) -> None:
        """Name the folder; of what is not there, or no folder, the caller speaks."""
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            return
        raise StoreError(
            f"{error.filename} cannot be looked into ({error.strerror}): check your rights, or move it away"
        ) from error

    for parent, folders, files in os.walk(folder, onerror=refuse):
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
            raise StoreError(f"{path} is a link, or no file: put a plain file there, or remove it")
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
        raise StoreError(
            f"{folder} holds {one_line(named(other, 'file'))} that would be lost and are not part of {what}: "
            "move that away, or name another folder"
        )


def is_ours(record: Path) -> bool:
    """Return whether the JSON file that a folder is known by was written by this program: others use such names, too.

    >>> is_ours(Path("nowhere/release.json"))
    False
    """
    try:
        return str(read_json(record, mend="")["made_by"]).startswith("sasgeo-bench")
    except (StoreError, KeyError, TypeError):
        return False


def check_site(folder: Path) -> None:
    """Refuse to replace a site that holds somebody else's files; raise `StoreError` naming them."""
    try:
        about = read_json(folder / SITE_MANIFEST, mend="publish again")
        known = about["files"] if "OpenStreetMap" in about["attribution"] else []  # else it is another program's file
    except (StoreError, KeyError, TypeError):
        known = None
    if isinstance(known, list):
        check_known(folder, {SITE_MANIFEST, *map(str, known)}, "a site")
    else:
        check_known(folder, {SITE_MANIFEST}, "a site", patterns=_OLD_SITE)


def check_room(folder: Path) -> None:
    """Raise `StoreError` if a folder cannot be made or replaced: the work to fill it may take an hour."""
    folder = absolute(folder)
    there = next((path for path in folder.parents if path.exists()), folder)
    if not there.is_dir():
        raise StoreError(f"{folder} cannot be written, for {there} is a file: name another folder")
    if os.path.ismount(folder):
        raise StoreError(f"{folder} is a mount point, which cannot be replaced as a whole: name a folder in it")
    try:
        with tempfile.TemporaryDirectory(prefix=".sasgeo-bench-", dir=there):
            pass
        if folder.is_dir() and not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check your rights, or name another folder"
        ) from error


PREFIX: Final = "sasgeo-scratch-"
_NEW: Final = ".sasgeo-new-"  # until it is locked: no process sweeps a folder of this name


@contextmanager
def scratch_folder(what: str, *, within: Path | None = None) -> Iterator[Path]:
    """Yield an empty resolved folder, and remove it at the end, whatever is in it then.

    The folder is locked while its program lives: an unlocked one is a leftover, and is removed when another program
    makes its first one there. `what` is a word of the name, and `within` a folder other than the system's.
    """
    root = Path(tempfile.gettempdir() if within is None else within).resolve()
    if sys.platform == "win32":  # locks no folder, so nothing is swept
        folder = Path(tempfile.mkdtemp(prefix=f"{_NEW}{what}-", dir=root))
        try:
            yield folder
        finally:
            remove_tree(folder)
        return
    _sweep_once(root)
    folder = Path(tempfile.mkdtemp(prefix=f"{_NEW}{what}-", dir=root))
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with suppress(OSError):  # where a file system locks no folder, nothing is swept
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            folder = folder.rename(folder.with_name(PREFIX + folder.name.removeprefix(_NEW)))
        yield folder
    finally:
        remove_tree(folder)
        os.close(lock)


def sweep(root: Path) -> int:
    """Remove the scratch folders of programs that were killed; return how many. Those of other users stay."""
    swept = 0
    for folder in sorted(root.glob(f"{PREFIX}*")) if sys.platform != "win32" else ():
        with suppress(OSError):  # a link, a file, another user's, locked, or gone meanwhile
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                if os.fstat(lock).st_uid != os.geteuid():
                    continue
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_tree(folder)
                swept += 1
            finally:
                os.close(lock)
    return swept


@cache
def _sweep_once(root: Path) -> int:
    return sweep(root)


@contextmanager
def uncollected() -> Iterator[None]:
    """Stop the cyclic garbage collector while lists of objects grow: a tenth of a scan, half of reading answers.

    >>> with uncollected():
    ...     gc.isenabled()
    False
    >>> gc.isenabled()
    True
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
