# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of matchers."""

import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sasgeo_bench.cli.console import EXIT_USER, print_table, say, tell
from sasgeo_bench.errors import counted
from sasgeo_bench.matching.scaffold import plugin_files, write_plugin
from sasgeo_bench.running.testing import check_matcher


def new_matcher_command(
    name: Annotated[str, typer.Argument(help="of the matcher, as in my-matcher")],
    folder: Annotated[Path | None, typer.Option("--into", help="an empty folder; default: one of that name")] = None,
) -> None:
    """Write a plugin package that passes check-matcher at once, for you to put your method into."""
    files = plugin_files(name)
    target = folder or Path(name)
    write_plugin(target, files)
    install = f"{_pip()} install -e {shlex.quote(str(target))}"
    say(f"{target}: {len(files)} files; next: {install} && sasgeo-bench check-matcher {name}")
    tell(f"later: run it, score it, and submit --card {target / 'card.toml'} (docs/howto/matcher.md walks the path)")


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
    table = Table("check", "outcome", "found", box=None, pad_edge=False)
    failed = 0
    for check in check_matcher(matcher, is_shut_in=not trusted):
        failed += check.outcome == "fail"
        table.add_row(check.name, check.outcome, check.found)
    print_table(table)
    if failed:
        tell(f"{matcher}: {counted(failed, 'check')} failed")
        raise typer.Exit(EXIT_USER)
