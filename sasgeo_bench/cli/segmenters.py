# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of segmenters."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.matchers import end_with_checks, lay_package
from sasgeo_bench.matching.segmenter_scaffold import segmenter_files
from sasgeo_bench.running.segmenter_testing import check_segmenter


def new_segmenter_command(
    name: Annotated[str, typer.Argument(help="of the segmenter, as in my-segmenter")],
    folder: Annotated[Path | None, typer.Option("--into", help="an empty folder; default: one of that name")] = None,
) -> None:
    """Write a plugin package that passes check-segmenter at once, for you to put your method into."""
    lay_package(name, folder, segmenter_files(name), check="check-segmenter")


def check_segmenter_command(
    segmenter: Annotated[str, typer.Argument(help="name from list-segmenters, or module:Class")],
    *,
    trusted: Annotated[bool, typer.Option("--trusted", help="do not shut the segmenter in")] = False,
) -> None:
    """Try a segmenter on a few small images and say, row by row, whether it keeps to what all of them keep to."""
    end_with_checks(segmenter, check_segmenter(segmenter, is_shut_in=not trusted))
