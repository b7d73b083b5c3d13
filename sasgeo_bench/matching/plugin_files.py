# SPDX-License-Identifier: Apache-2.0
"""Writes a new plugin package into an empty folder."""

from collections.abc import Mapping
from pathlib import Path

from sasgeo_bench.errors import StoreError


def write_plugin(folder: Path, files: Mapping[str, str]) -> None:
    """Write every file of a package, or leave things as they were.

    Raises
    ------
    StoreError
        If the folder is there and not empty, or cannot be written.
    """
    if not _is_free(folder):
        message = f"{folder} is there already and not empty: name another folder"
        raise StoreError(message)
    made: list[Path] = []
    try:
        for name, text in files.items():
            target = folder / name
            missing = [parent for parent in target.parents if not parent.exists()]
            for parent in reversed(missing):
                parent.mkdir()
                made.append(parent)
            made.append(target)
            target.write_text(text, encoding="utf-8")
    except OSError as error:
        for path in reversed(made):
            _remove(path)
        message = f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        raise StoreError(message) from error


def _is_free(folder: Path) -> bool:
    try:
        return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    except OSError as error:
        message = f"{folder} cannot be read ({error.strerror or error}): check your rights, or name another folder"
        raise StoreError(message) from error


def _remove(path: Path) -> None:
    """Remove a file or an empty folder; what cannot be removed stays."""
    try:
        path.rmdir() if path.is_dir() else path.unlink(missing_ok=True)
    except OSError:
        return
