# SPDX-License-Identifier: Apache-2.0
"""Toytown, and a grid around it."""

from pathlib import Path

import pytest

from sasgeo_bench.geometry.grid import Grid


@pytest.fixture(scope="session")
def toytown() -> Path:
    return Path(__file__).parents[1] / "data" / "toytown.osm"


@pytest.fixture(scope="session")
def toygrid() -> Grid:
    return Grid(epsg=32632, west_m=499_900.0, north_m=5_205_800.0, cell_size_m=1.0, rows=1200, cols=700)
