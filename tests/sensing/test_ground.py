# SPDX-License-Identifier: Apache-2.0
"""Planes and heights out of GeoTIFFs: where rays meet them, and what is refused."""

import os
import shutil
import subprocess

import numpy as np
import pytest
import rasterio
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.sensing import dem as dems
from sasgeo_bench.sensing.dem import read_dem
from sasgeo_bench.sensing.ground import Dem, Plane

GRID = Grid(epsg=32632, west_m=500_000.0, north_m=5_200_100.0, cell_size_m=10.0, rows=10, cols=12)


def slope_of(grid=GRID, rise=0.2):
    """Ground that rises to the east."""
    columns = (np.arange(grid.cols) + 0.5) * grid.cell_size_m * rise
    return Dem(grid=grid, cells_m=np.tile(columns, (grid.rows, 1)).astype(np.float32))


def write_dem(path, dem, *, crs="EPSG:32632", dtype="float32", nodata=None, count=1):
    transform = rasterio.Affine(*dem.grid.transform)
    with rasterio.open(
        path, "w", driver="GTiff", height=dem.grid.rows, width=dem.grid.cols, count=count, dtype=dtype, crs=crs,
        transform=transform, nodata=nodata,
    ) as file:  # fmt: skip
        for band in range(count):
            file.write(dem.cells_m.astype(dtype), band + 1)
    return path


@given(east=st.floats(20, 100), north=st.floats(10, 90), right=st.floats(-0.8, 0.8), up=st.floats(-0.8, 0.8))
def test_a_ray_to_a_slope_meets_it_where_geometry_says(east, north, right, up):
    dem = slope_of().relative_to(GRID.west_m, GRID.north_m - 100.0)
    origin, direction = np.array([east, north, 60.0]), np.array([right, up, -1.0])
    along = (60.0 - 0.2 * east) / (1 + 0.2 * right)  # 60 - t = 0.2 (east + t right)
    expected = origin + along * direction
    met = dem.meet(origin, direction[None])[0]
    inside = 5 <= expected[0] <= 115 and 0 <= expected[1] <= 100
    if inside:
        assert np.allclose(met, expected, rtol=1e-7, atol=1e-4)
    elif not (-0.1 <= expected[0] <= 120.1 and -0.1 <= expected[1] <= 100.1):
        assert np.isnan(met).all()


@pytest.mark.parametrize("kind", ["Area", "Point"])
def test_heights_lie_where_gdal_says_whether_a_pixel_is_an_area_or_a_point(kind, tmp_path):
    """Of a point the tie is the middle of the first pixel: half a pixel to the south-east of its corner."""
    path, first = tmp_path / "a.tif", np.arange(120, dtype=np.float32).reshape(10, 12)
    program = shutil.which("gdal_translate")
    if program is None:
        pytest.skip("gdal_translate is not on this machine")
    write_dem(tmp_path / "raw.tif", Dem(grid=GRID, cells_m=first))
    tie = [f"{GRID.west_m}", f"{GRID.north_m}", f"{GRID.west_m + 120}", f"{GRID.north_m - 100}"]
    options = ["-a_ullr", *tie, "-mo", f"AREA_OR_POINT={kind}", str(tmp_path / "raw.tif"), str(path)]
    subprocess.run([program, *options], check=True, capture_output=True)  # noqa: S603 - our own arguments
    with tifffile.TiffFile(path) as file:  # the tag as it is stored, and the point that is tied
        told = file.pages[0].tags["GeoKeyDirectoryTag"].value
        tied_m = file.pages[0].tags["ModelTiepointTag"].value
    raster_type = next(told[at + 3] for at in range(4, len(told), 4) if told[at] == 1025)
    assert raster_type == (2 if kind == "Point" else 1)
    half_m = 5.0 if kind == "Point" else 0.0
    assert tied_m[3:5] == (GRID.west_m + half_m, GRID.north_m - half_m)
    inner = Grid(epsg=32632, west_m=GRID.west_m + 20, north_m=GRID.north_m - 20, cell_size_m=10.0, rows=4, cols=4)
    np.testing.assert_allclose(read_dem(path, inner).cells_m, first[2:6, 2:6])


def test_a_ray_stops_at_the_hill_in_front_and_a_camera_under_ground_sees_none():
    cells = np.zeros((10, 12), dtype=np.float32)
    cells[:, 6] = 30.0
    hill = Dem(grid=GRID, cells_m=cells).relative_to(GRID.west_m, GRID.north_m - 100.0)
    met = hill.meet(np.array([5.0, 50.0, 40.0]), np.array([[1.0, 0.0, -0.4]]))[0]
    assert 50 < met[0] < 65
    assert met[2] == pytest.approx(40 - 0.4 * (met[0] - 5))
    assert np.isnan(slope_of().meet(np.array([500_060.0, 5_200_050.0, 1.0]), np.array([[0.0, 0.0, -1.0]]))).all()


def test_heights_are_read_and_brought_onto_the_lattice(tmp_path):
    path = write_dem(tmp_path / "dem.tif", slope_of(), nodata=-9999.0)
    inner = Grid(epsg=32632, west_m=500_020.0, north_m=5_200_080.0, cell_size_m=5.0, rows=8, cols=8)
    dem = read_dem(path, inner)
    points = np.array([[500_030.0, 5_200_060.0], [500_042.5, 5_200_050.0]])
    np.testing.assert_allclose(dem.heights_m(points), [6.0, 8.5], atol=1e-4)


def test_heights_in_whole_metres_without_nodata_are_read_and_their_edge_is_noticed(tmp_path):
    path = write_dem(tmp_path / "dem.tif", slope_of(rise=1.0), dtype="int16")
    assert read_dem(path, GRID).cells_m[0, :2].tolist() == [5.0, 15.0]
    with pytest.raises(CameraError, match="does not cover"):
        read_dem(path, Grid(epsg=32632, west_m=499_900.0, north_m=5_200_100.0, cell_size_m=10.0, rows=4, cols=20))


def test_heights_in_degrees_are_reprojected(tmp_path):
    grid = Grid(epsg=4326, west_m=8.99, north_m=46.96, cell_size_m=0.001, rows=30, cols=30)  # in degrees
    path = write_dem(
        tmp_path / "dem.tif", Dem(grid=grid, cells_m=np.full((30, 30), 400.0, np.float32)), crs="EPSG:4326"
    )
    middle = Grid(epsg=32632, west_m=500_000.0, north_m=5_199_300.0, cell_size_m=10.0, rows=10, cols=10)
    assert read_dem(path, middle).heights_m(np.array([[500_050.0, 5_199_250.0]])).tolist() == [400.0]


@pytest.mark.parametrize(
    ("unit", "scale", "offset", "unit_m"),
    [("metre", 0.1, 100.0, 1.0), ("ft", 1.0, 0.0, 0.3048), ("US survey foot", 2.0, -3.0, 1200 / 3937)],
)
def test_scale_offset_and_unit_of_heights_are_heeded(unit, scale, offset, unit_m, tmp_path):
    path = write_dem(tmp_path / "dem.tif", slope_of(rise=1.0), dtype="int16", nodata=-32768)
    with rasterio.open(path, "r+") as file:
        file.units, file.scales, file.offsets = (unit,), (scale,), (offset,)
    expected = (slope_of(rise=1.0).cells_m * scale + offset) * unit_m
    np.testing.assert_allclose(read_dem(path, GRID).cells_m, expected, rtol=1e-6)
    path = write_dem(tmp_path / "feet.tif", slope_of(), crs="EPSG:32632+8228")  # NAVD88 height (ft)
    np.testing.assert_allclose(read_dem(path, GRID).cells_m, slope_of().cells_m * 0.3048, rtol=1e-6)


@pytest.mark.parametrize("turn", [(slice(None, None, -1), slice(None)), (slice(None), slice(None, None, -1))])
def test_heights_of_rows_in_any_direction_are_the_same(turn, tmp_path):
    rows, cols = turn
    grid, dem = GRID, slope_of()
    west_m, south_m, east_m, north_m = grid.bounds_m
    to_north, to_west = rows.step == -1, cols.step == -1
    transform = rasterio.Affine(
        -10.0 if to_west else 10.0, 0, east_m if to_west else west_m,
        0, 10.0 if to_north else -10.0, south_m if to_north else north_m,
    )  # fmt: skip
    path = write_dem(tmp_path / "dem.tif", Dem(grid=grid, cells_m=np.ascontiguousarray(dem.cells_m[turn])))
    with rasterio.open(path, "r+") as file:
        file.transform = transform
    np.testing.assert_allclose(read_dem(path, GRID).cells_m, dem.cells_m, rtol=1e-6)


@pytest.mark.parametrize(
    ("how", "hint"),
    [
        ({"crs": None}, "no CRS"),
        (
            {"crs": rasterio.crs.CRS.from_wkt('LOCAL_CS["a site",UNIT["metre",1]]')},
            "no way leads to EPSG:32632: write the",
        ),
        ({"count": 3, "dtype": "uint8"}, "no file of heights"),
        ({"nodata": 1.0}, "does not cover"),
        ({"crs": "EPSG:5773"}, "no way leads to EPSG:32632"),  # heights alone
    ],
)
def test_a_file_that_is_no_ground_is_refused_on_one_line(tmp_path, how, hint):
    path = write_dem(tmp_path / "dem.tif", slope_of(), **how)
    with pytest.raises(CameraError, match=hint) as caught:
        read_dem(path, GRID)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_raster_or_of_an_unknown_unit_or_place_is_refused(tmp_path, monkeypatch):
    (tmp_path / "dem.tif").write_bytes(b"no heights")
    os.mkfifo(tmp_path / "pipe.tif")
    for name in ("dem.tif", "none.tif", "pipe.tif"):
        with pytest.raises(CameraError, match="cannot be read"):
            read_dem(tmp_path / name, GRID)
    path = write_dem(tmp_path / "dem.tif", slope_of())
    with rasterio.open(path, "r+") as file:
        file.units = ("dBZ",)
    with pytest.raises(CameraError, match="heights in 'dbz', metres or feet"):
        read_dem(path, GRID)
    monkeypatch.setattr(dems, "_check_source", lambda *_: None)  # asks a library with tables of its own
    path = write_dem(tmp_path / "dem.tif", slope_of(), crs="IAU_2015:30100")
    with pytest.raises(CameraError, match="cannot be transformed to EPSG:32632"):
        read_dem(path, GRID)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Dem(grid=GRID, cells_m=np.full((10, 12), -32768.0, dtype=np.float32)), "nodata"),
        (lambda: Dem(grid=GRID, cells_m=np.zeros((3, 3), dtype=np.float32)), "shape"),
        (lambda: Plane(height_m=float("nan")), "ground lies"),
        (lambda: Plane(height_m=1e9), "ground lies"),
    ],
)
def test_ground_that_cannot_be_is_refused(make, words):
    with pytest.raises(CameraError, match=words):
        make()


def test_heights_in_a_crs_that_leaves_the_datum_open_are_refused(tmp_path):
    path = write_dem(tmp_path / "dem.tif", slope_of(), crs="+proj=utm +zone=32 +ellps=bessel")
    with pytest.raises(CameraError, match="leaves the datum open"):
        read_dem(path, GRID)
