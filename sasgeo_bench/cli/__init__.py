# SPDX-License-Identifier: Apache-2.0
"""The program `sasgeo-bench`: a file for each family of commands."""

from sasgeo_bench.cli.program import main

__all__ = ["main"]
