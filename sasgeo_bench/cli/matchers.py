# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of matchers."""

import shlex
import shutil
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sasgeo_bench.cli.console import EXIT_USER, complain, print_table, say, tell
from sasgeo_bench.errors import counted
from sasgeo_bench.matching.scaffold import plugin_files, write_plugin
from sasgeo_bench.running.checks import Check
from sasgeo_bench.running.testing import check_matcher


def new_matcher_command(
    name: Annotated[str, typer.Argument(help="of the matcher, as in my-matcher")],
    folder: Annotated[Path | None, typer.Option("--into", help="an empty folder; default: one of that name")] = None,
) -> None:
    """Write a plugin package that passes check-matcher at once, for you to put your method into."""
    lay_package(name, folder, plugin_files(name), check="check-matcher")
    entry = f"sasgeo-bench enter docs/results/systems-objects --matcher {name}"
    tell(f"later: {entry} (docs/howto/matcher.md walks the path)")


def lay_package(name: str, folder: Path | None, files: Mapping[str, str], *, check: str) -> Path:
    """Write the files of a package, say how to go on with the command `check`, and return its folder."""
    target = folder or Path(name)
    write_plugin(target, files)
    install = f"{_pip()} install -e {shlex.quote(str(target))}"
    say(f"{target}: {len(files)} files; next: {install} && sasgeo-bench {check} {name}")
    return target


def _pip() -> str:
    """The pip of this environment: another one, first on the user's path, would install where nothing finds it."""
    mine = Path(sys.executable).with_name("pip")
    if shutil.which("pip") == str(mine):
        return "pip"
    here = Path.cwd()
    return shlex.quote(str(mine.relative_to(here) if mine.is_relative_to(here) else mine))


def check_matcher_command(
    matcher: Annotated[str, typer.Argument(help="name from list-matchers, or module:Class")],
    *,
    trusted: Annotated[bool, typer.Option("--trusted", help="do not shut the matcher in")] = False,
) -> None:
    """Try a matcher on a tiny town and say, row by row, whether it keeps to what all of them keep to."""
    end_with_checks(matcher, check_matcher(matcher, is_shut_in=not trusted))


def end_with_checks(plugin: str, checks: Iterable[Check]) -> None:
    """Print a conformance table, and end with the user's status if a check failed."""
    table = Table("check", "outcome", "found", box=None, pad_edge=False)
    failed = 0
    for check in checks:
        failed += check.outcome == "fail"
        table.add_row(check.name, check.outcome, check.found)
    print_table(table)
    if failed:
        complain(f"{plugin}: {counted(failed, 'check')} failed")
        raise typer.Exit(EXIT_USER)
