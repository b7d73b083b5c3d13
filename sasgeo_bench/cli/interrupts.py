# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, also while libraries are imported; this file imports none."""

from typing import Final

EXIT_INTERRUPTED: Final = 130


def is_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is Ctrl-C, or what a library made of it while it was being imported.

    >>> error = RuntimeError("cannot be imported")
    >>> error.__cause__ = KeyboardInterrupt()
    >>> is_interrupt(error)
    True
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
