# SPDX-License-Identifier: Apache-2.0
"""The program `sasgeo-bench`: parses, calls, prints. Results go to stdout, everything else to stderr."""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final, TextIO

import typer
from rich.table import Table

from sasgeo_bench.cli.ageing import compare_ageing_command, measure_ageing_command
from sasgeo_bench.cli.boards import leaderboard_command, score_command
from sasgeo_bench.cli.console import EXIT_USER, ExtractFolders, Out, print_table, tell
from sasgeo_bench.cli.looking import inspect_command, verify_command
from sasgeo_bench.cli.matchers import (
    check_matcher_command,
    list_matchers_command,
    list_rejectors_command,
    new_matcher_command,
)
from sasgeo_bench.cli.publishing import publish_command
from sasgeo_bench.cli.queries import list_suites_command, make_queries_command
from sasgeo_bench.cli.regions import build_region_command, list_regions_command
from sasgeo_bench.cli.releasing import release_command
from sasgeo_bench.cli.runs import merge_command, run_command
from sasgeo_bench.cli.submissions import submit_command, validate_command
from sasgeo_bench.cli.weights import lookalike_command, weights_command
from sasgeo_bench.doctor import examine
from sasgeo_bench.errors import SasgeoError
from sasgeo_bench.results import one_line

EXIT_INTERRUPTED: Final = 130


def doctor_command(extracts: ExtractFolders = None, out: Out = Path("out")) -> None:
    """Say which versions, folders and extracts are found, and what is missing."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, finding in examine(extracts or (), out=out):
        table.add_row(name, finding)
    print_table(table)


# In the order of the work, as --help shows them.
COMMANDS: Final[dict[str, Callable[..., None]]] = {
    "doctor": doctor_command,
    "list-regions": list_regions_command,
    "build-region": build_region_command,
    "measure-ageing": measure_ageing_command,
    "compare-ageing": compare_ageing_command,
    "list-suites": list_suites_command,
    "make-queries": make_queries_command,
    "inspect": inspect_command,
    "verify": verify_command,
    "weights": weights_command,
    "lookalike": lookalike_command,
    "list-matchers": list_matchers_command,
    "list-rejectors": list_rejectors_command,
    "new-matcher": new_matcher_command,
    "check-matcher": check_matcher_command,
    "run": run_command,
    "merge": merge_command,
    "validate": validate_command,
    "submit": submit_command,
    "score": score_command,
    "leaderboard": leaderboard_command,
    "publish": publish_command,
    "release": release_command,
}

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False, help=__doc__)
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning as one line, without where it came from."""
    del category, filename, lineno, file, line
    tell(f"sasgeo-bench: warning: {one_line(str(message))}")


def main() -> None:
    """Run the program: 0 done, 2 the user's mistake or the disk's refusal on one line, 1 our bug with a traceback."""
    warnings.showwarning = _warn
    try:
        app()
    except SasgeoError as error:
        tell(f"sasgeo-bench: {error}")
        sys.exit(EXIT_USER)
    except OSError as error:  # whatever nobody has put in words of their own, as of a name that is too long
        said = f"{error.strerror or error}; check the path, your rights and the free space: {error.filename or ''}"
        tell(f"sasgeo-bench: {one_line(said)}")
        sys.exit(EXIT_USER)
    except SystemExit as leaving:
        if leaving.code == EXIT_INTERRUPTED:  # typer turns Ctrl-C into this exit without a word
            tell("sasgeo-bench: interrupted; what was finished is kept, nothing is half-written: run it again")
        raise
