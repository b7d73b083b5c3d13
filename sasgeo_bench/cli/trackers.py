# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of trackers."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.matchers import end_with_checks, lay_package
from sasgeo_bench.matching.tracker_scaffold import tracker_files
from sasgeo_bench.running.tracker_testing import check_tracker


def new_tracker_command(
    name: Annotated[str, typer.Argument(help="of the tracker, as in my-tracker")],
    folder: Annotated[Path | None, typer.Option("--into", help="an empty folder; default: one of that name")] = None,
) -> None:
    """Write a plugin package that passes check-tracker at once, for you to put your method into."""
    lay_package(name, folder, tracker_files(name), check="check-tracker")


def check_tracker_command(
    tracker: Annotated[str, typer.Argument(help="name from list-trackers or list-matchers, or module:Class")],
    *,
    trusted: Annotated[bool, typer.Option("--trusted", help="do not shut the tracker in")] = False,
) -> None:
    """Try a tracker on short flights over a tiny town and say, row by row, whether it keeps to what all keep to."""
    end_with_checks(tracker, check_tracker(tracker, is_shut_in=not trusted))
