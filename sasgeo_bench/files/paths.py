# SPDX-License-Identifier: Apache-2.0
"""Paths that a caller gives to a public function."""

from pathlib import Path

from sasgeo_bench.errors import StoreError
from sasgeo_bench.texts import one_line


def given_path(value: object) -> Path:
    """Return a path that was given as a text or a path; raise `StoreError` for anything else.

    >>> given_path("out/boards/demo").name
    'demo'
    >>> given_path(5)
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: 5 is no path: name a folder or a file, as a text or a Path
    """
    if not isinstance(value, str | Path) or "\0" in str(value) or value == "":
        message = f"{one_line(repr(value))} is no path: name a folder or a file, as a text or a Path"
        raise StoreError(message)
    return Path(value)
