# SPDX-License-Identifier: Apache-2.0
"""The command that examines the set-up."""

from pathlib import Path

from rich.table import Table

from sasgeo_bench.cli.console import print_table
from sasgeo_bench.cli.environment import examine
from sasgeo_bench.cli.options import ExtractFolders, Out


def doctor_command(extracts: ExtractFolders = None, out: Out = Path("out")) -> None:
    """Say which versions, folders and extracts are found, and what is missing."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, finding in examine(extracts or (), out=out):
        table.add_row(name, finding)
    print_table(table)
