# SPDX-License-Identifier: Apache-2.0
"""The program `sasgeo-bench`: a file for each family of commands."""

import gc
import os
import sys

from sasgeo_bench.cli.interrupts import exit_interrupted, interrupted_by_signals, is_interrupt


def main() -> None:
    """Run the program; an interrupt while it is still being imported is one line as well."""
    with interrupted_by_signals():
        # Arrow's own pool keeps what was freed: 25 to 50 MB of a build.
        os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
        gc.disable()  # until a command is imported (`program.load`), of which nothing is garbage
        # A command makes hundreds of thousands of objects that stay: to look for cycles among them took a tenth of it.
        gc.set_threshold(100_000)
        try:
            from sasgeo_bench.cli import program  # noqa: PLC0415 - takes a third of a second, in which users press Ctrl-C

            program.main()
        except BaseException as error:
            if not is_interrupt(error):
                raise
            sys.stderr.write("sasgeo-bench: interrupted before it began; run it again\n")
            sys.exit(exit_interrupted())
        finally:
            # As it ends, the interpreter looks for cycles among all modules: a tenth of a build, which frees nothing.
            gc.freeze()
