# SPDX-License-Identifier: Apache-2.0
"""Writes a new plugin package into an empty folder."""

from collections.abc import Mapping
from pathlib import Path

from sasgeo_bench.errors import StoreError


def write_plugin(folder: Path, files: Mapping[str, str]) -> None:
    """Write every file of a package.

    Raises
    ------
    StoreError
        If the folder is there and not empty, or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        message = f"{folder} is there already and not empty: name another folder"
        raise StoreError(message)
    try:
        for path, text in files.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
    except OSError as error:
        message = f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        raise StoreError(message) from error
