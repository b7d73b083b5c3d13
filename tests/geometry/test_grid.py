# SPDX-License-Identifier: Apache-2.0
"""Cells and metres, there and back."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sasgeo_bench.core.errors import GridError
from sasgeo_bench.geometry.grid import Grid, utm_epsg

cell_sizes = st.floats(0.1, 50.0)
metres = st.floats(-1e6, 1e6)


def grid_of(cell_size_m: float = 1.0, rows: int = 9, cols: int = 7) -> Grid:
    return Grid(epsg=32632, west_m=5e5, north_m=5.3e6, cell_size_m=cell_size_m, rows=rows, cols=cols)


@given(en_m=arrays(np.float64, (5, 2), elements=metres), cell_size_m=cell_sizes)
def test_map_to_raster_and_back_is_identity(en_m, cell_size_m):
    grid = grid_of(cell_size_m)
    np.testing.assert_allclose(grid.to_en_m(grid.to_uv(en_m)), en_m, atol=1e-6)


@given(rows=st.integers(0, 50), cols=st.integers(0, 50), cell_size_m=cell_sizes)
def test_the_centre_of_a_cell_lies_in_that_cell(rows, cols, cell_size_m):
    cells = np.array([[rows, cols]])
    grid = grid_of(cell_size_m)
    assert (grid.to_cells(grid.to_centres_m(cells)) == cells).all()
    assert grid_of(2.0).to_centres_m(np.array([[0, 0]])).tolist() == [[500001.0, 5299999.0]]


@given(
    west=metres,
    south=metres,
    width=st.floats(1, 1e4),
    height=st.floats(1, 1e4),
    cell_size_m=st.sampled_from([0.5, 1, 2, 4]),
)
def test_a_grid_from_bounds_covers_them_and_no_more_than_a_cell_beyond(west, south, width, height, cell_size_m):
    east, north = west + width, south + height
    grid = Grid.from_bounds(west, south, east, north, cell_size_m=cell_size_m, epsg=32632)
    found = grid.bounds_m
    slack = 1e-5 * cell_size_m
    assert found[0] <= west + slack
    assert found[1] <= south + slack
    assert found[2] >= east - slack
    assert found[3] >= north - slack
    assert max(west - found[0], south - found[1], found[2] - east, found[3] - north) < cell_size_m + slack


@given(rows=st.integers(1, 40), cols=st.integers(1, 40), size=st.integers(1, 50))
def test_windows_tile_the_grid_once(rows, cols, size):
    seen = np.zeros((rows, cols), dtype=int)
    for row, col, window in grid_of(rows=rows, cols=cols).windows(size):
        seen[row : row + window.rows, col : col + window.cols] += 1
    assert (seen == 1).all()


@given(rows=st.integers(1, 99), cols=st.integers(1, 99), factor=st.integers(1, 20))
def test_a_coarser_grid_covers_the_finer_one(rows, cols, factor):
    fine, coarse = grid_of(rows=rows, cols=cols), grid_of(rows=rows, cols=cols).coarsen(factor)
    assert coarse.bounds_m[0] == fine.bounds_m[0]
    assert coarse.bounds_m[3] == fine.bounds_m[3]
    assert coarse.bounds_m[1] <= fine.bounds_m[1]
    assert coarse.bounds_m[2] >= fine.bounds_m[2]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        *((partial(grid_of, size_m), repr(size_m)) for size_m in (0.0, -1.0, float("nan"), float("inf"))),
        (lambda: Grid.from_bounds(9.0, 0.0, 1.0, 5.0, cell_size_m=1.0, epsg=32632), "west to east"),
        (lambda: utm_epsg(0.0, 85.0), "84"),
    ],
)
def test_a_grid_that_cannot_be_is_refused_with_what_is_wrong(make, words):
    with pytest.raises(GridError, match=words):
        make()


@pytest.mark.parametrize(("lon", "lat", "epsg"), [(-180.0, 10.0, 32601), (180.0, 10.0, 32660), (5.99, -1.0, 32731)])
def test_zones_at_the_edges(lon, lat, epsg):
    assert utm_epsg(lon, lat) == epsg
