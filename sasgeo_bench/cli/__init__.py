# SPDX-License-Identifier: Apache-2.0
"""The program `sasgeo-bench`: a file for each family of commands."""

import sys
from typing import Final

EXIT_INTERRUPTED: Final = 130


def main() -> None:
    """Run the program; an interrupt while it is still being imported is one line as well."""
    try:
        from sasgeo_bench.cli import program  # noqa: PLC0415 - takes a third of a second, in which users press Ctrl-C

        program.main()
    except BaseException as error:
        if not is_interrupt(error):
            raise
        sys.stderr.write("sasgeo-bench: interrupted before it began; run it again\n")
        sys.exit(EXIT_INTERRUPTED)


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
