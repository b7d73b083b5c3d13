# SPDX-License-Identifier: Apache-2.0
"""Members of tar archives that may come from anybody: plain files and folders of known names alone."""

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from tarfile import AREGTYPE, REGTYPE, TarFile, TarInfo

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.texts import one_line


def plain_members(
    archive: Path, packed: TarFile, *, is_known: Callable[[PurePosixPath, bool], bool], most: int, mend: str
) -> Iterator[tuple[str, TarInfo]]:
    """Yield the files of an archive with their paths; nothing is unpacked.

    Parameters
    ----------
    archive : Path
        Its file, which an error names.
    packed : tarfile.TarFile
        The archive, opened.
    is_known : callable
        Takes a path and whether it is of a file (or else of a folder), and returns whether it may be there.
    most : int
        Files and folders at most.
    mend : str
        Advice of the error.

    Raises
    ------
    StoreError
        For a link, a device, a sparse file, a path that is not known or is there twice, or one too many.
    """
    seen: set[str] = set()
    for count, member in enumerate(packed, start=1):
        path = PurePosixPath(member.name)
        is_plain = member.type in {REGTYPE, AREGTYPE} and member.sparse is None
        fault = None
        if count > most:
            fault = f"more than {most} files and folders"
        elif not (is_plain or member.isdir()) or str(path) in seen:
            fault = f"{one_line(member.name)[:80]!r}, which is no plain file, or is there twice"
        elif not is_known(path, is_plain):
            fault = f"{one_line(member.name)[:80]!r}"
        if fault is not None:
            raise StoreError(f"{archive} holds {fault}: {mend}")
        if is_plain:
            seen.add(str(path))
            yield str(path), member
