# SPDX-License-Identifier: Apache-2.0
"""The layer file: what was burnt is what is read, in a cloud-optimized layout."""

import ast
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.errors import RasterioIOError
from rio_cogeo.cogeo import cog_validate
from tifffile import TiffFile

import sasgeo_bench
from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions import layers
from sasgeo_bench.regions.imagery import read_window
from sasgeo_bench.regions.layers import (
    OUTSIDE,
    Paint,
    burn_layers,
    burn_mapped,
    cog_faults,
    overview_factors,
    read_bits,
    read_layers,
    read_overview,
    shown_factor,
    write_layers,
)
from sasgeo_bench.sensing.dem import read_dem

LATTICE = Grid(epsg=32632, west_m=8.0, north_m=-8.0, cell_size_m=2.0, rows=16, cols=16)
CLASSES = ("building", "water", "bridge")
GRID = Grid(epsg=32632, west_m=500_000.0, north_m=5_200_000.0, cell_size_m=2.0, rows=2300, cols=4700)


def paint() -> Paint:
    west, south, east, north = GRID.bounds_m
    rng = np.random.default_rng(1)
    houses = [
        shapely.box(x, y, x + 31, y + 23)
        for x, y in zip(rng.uniform(west, east, 400), rng.uniform(south, north, 400), strict=True)
    ]
    lake = shapely.Point((west + east) / 2, (south + north) / 2).buffer(1500)
    areas = [np.array(houses, dtype=object), np.array([lake], dtype=object), np.array([], dtype=object)]
    mapped = shapely.box(west, south, east - 1000, north)
    return Paint(
        classes=CLASSES,
        areas=tuple(shapely.orient_polygons(shapes) for shapes in areas),
        coverage=shapely.orient_polygons(np.array([mapped], dtype=object)),
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("layers") / "layers.tif"
    drawn = paint()
    write_layers(path, GRID, CLASSES, lambda _: lambda window: burn_layers(drawn, window))
    return path


def test_what_is_read_is_what_was_burnt_and_a_window_is_read_alone(written):
    assert (read_layers(written) == burn_layers(paint(), GRID)).all()
    found = read_layers(written, window=(100, 200, 50, 60))
    assert (found == burn_layers(paint(), GRID)[:, 100:150, 200:260]).all()
    assert not found.flags.writeable


def test_each_level_can_be_read_once_it_is_filled_the_coarsest_first(tmp_path, written):
    path, drawn, found = tmp_path / "layers.tif", paint(), {}

    def filled(factor):
        longest = max(GRID.shape) // factor
        found[factor] = read_overview(path, longest_cells=longest)

    write_layers(path, GRID, CLASSES, lambda _: lambda window: burn_mapped(drawn, window), filled=filled)
    assert list(found) == [*overview_factors(GRID)[::-1], 1]
    for factor, level in found.items():
        assert shown_factor(max(GRID.shape), overview_factors(GRID), longest_cells=max(GRID.shape) // factor) == factor
        assert (level == burn_layers(drawn, GRID.coarsen(factor))).all()
    assert path.read_bytes() == written.read_bytes()


def test_ground_that_is_not_mapped_is_not_stored_and_reads_as_unknown(tmp_path):
    west, south, east, north = GRID.bounds_m
    half = shapely.orient_polygons(np.array([shapely.box(west, south, east - 4000.0, north)], dtype=object))
    drawn, stored = replace(paint(), coverage=half), []

    def burnt(window):
        found = burn_mapped(drawn, window)
        stored.append(found is not None)
        return found

    write_layers(tmp_path / "sparse.tif", GRID, CLASSES, lambda _: burnt)
    assert not all(stored)
    assert (read_layers(tmp_path / "sparse.tif") == burn_layers(drawn, GRID)).all()


def test_only_blocks_with_mapped_ground_are_in_the_file(tmp_path):
    west, _, _, north = GRID.bounds_m
    corner = shapely.orient_polygons(np.array([shapely.box(west, north - 100.0, west + 100.0, north)], dtype=object))
    drawn = replace(paint(), coverage=corner)
    write_layers(tmp_path / "corner.tif", GRID, CLASSES, lambda _: lambda window: burn_mapped(drawn, window))
    with TiffFile(tmp_path / "corner.tif") as file:
        stored = [sum(size > 0 for size in page.databytecounts) for page in file.pages]
    assert stored == [len(CLASSES)] * 3


def test_a_file_of_more_than_4_gib_has_its_own_layout(tmp_path, monkeypatch):
    monkeypatch.setattr(layers, "_BIGTIFF_CELLS", 1)
    drawn = paint()
    write_layers(tmp_path / "big.tif", GRID, CLASSES, lambda _: lambda window: burn_layers(drawn, window))
    assert (tmp_path / "big.tif").read_bytes()[:4] == b"II+\x00"
    assert (read_layers(tmp_path / "big.tif") == burn_layers(drawn, GRID)).all()
    with rasterio.open(tmp_path / "big.tif", overview_level=1) as source:
        assert (source.read() == burn_layers(drawn, GRID.coarsen(16))).all()


def test_a_fault_while_a_level_is_painted_or_burnt_is_the_fault_of_the_build(tmp_path):
    with pytest.raises(ZeroDivisionError):
        write_layers(tmp_path / "a.tif", GRID, CLASSES, lambda _: lambda window: window.rows // 0)
    with pytest.raises(KeyError, match="16"):
        write_layers(tmp_path / "b.tif", GRID, CLASSES, {}.__getitem__)


def test_the_layout_is_that_of_a_cloud_optimized_file(written):
    assert cog_validate(written, quiet=True)[0]
    with rasterio.open(written) as source:
        assert source.descriptions == CLASSES
        assert source.nodata == OUTSIDE
        assert source.crs.to_epsg() == 32632
        assert tuple(source.transform)[:6] == GRID.transform
        assert source.overviews(1) == [4, 16]
        assert source.tags()["attribution"] == "(c) OpenStreetMap contributors, ODbL"
        assert source.block_shapes[0] == (512, 512)


@pytest.mark.parametrize("level", [0, 1])
def test_an_overview_is_the_same_map_at_a_coarser_cell(level, written):
    grid = GRID.coarsen((4, 16)[level])
    with rasterio.open(written, overview_level=level) as source:
        assert (source.read() == burn_layers(paint(), grid)).all()
        assert source.tags()["attribution"] == "(c) OpenStreetMap contributors, ODbL"
        assert source.tags()["TIFFTAG_COPYRIGHT"] == "(c) OpenStreetMap contributors, ODbL"


def test_the_overview_for_a_picture_is_the_finest_that_fits_and_a_small_raster_needs_none(written):
    shapes = {1200: (3, 575, 1175), 100: (3, 144, 294), 9000: (3, 2300, 4700)}
    assert {most: read_overview(written, longest_cells=most).shape for most in shapes} == shapes
    assert overview_factors(replace(GRID, rows=512, cols=1024)) == ()


def test_a_file_that_cannot_be_written_or_read_is_told(tmp_path):
    with pytest.raises(StoreError, match="cannot be written"):
        write_layers(
            tmp_path / "none" / "layers.tif", GRID, CLASSES, lambda _: lambda window: burn_layers(paint(), window)
        )
    (tmp_path / "layers.tif").write_bytes(b"no raster")
    with pytest.raises(StoreError, match="cannot be read"):
        read_layers(tmp_path / "layers.tif")


VIRTUAL = """<VRTDataset rasterXSize="{size}" rasterYSize="{size}"><SRS>EPSG:32632</SRS>
<GeoTransform>0, 1, 0, 0, 0, -1</GeoTransform><VRTRasterBand dataType="Byte" band="1"><SimpleSource>
<SourceFilename>{path}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"""


@pytest.mark.parametrize(
    "read",
    [
        read_layers,
        read_bits,
        partial(read_overview, longest_cells=8),
        cog_faults,
        lambda path: read_window(path, LATTICE, is_coarser=False),
        lambda path: read_window(path, LATTICE, is_coarser=True),
        lambda path: read_dem(path, LATTICE),
    ],
)
def test_a_raster_that_only_names_another_file_is_not_opened(tmp_path, read):
    secret, path = tmp_path / "secret.tif", tmp_path / "layers.tif"
    profile = {"driver": "GTiff", "width": 64, "height": 64, "count": 1, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(secret, "w", **profile, transform=rasterio.Affine(1, 0, 0, 0, -1, 64)) as target:
        target.write(np.full((1, 64, 64), 7, dtype=np.uint8))
    path.write_text(VIRTUAL.format(path=secret, size=64))
    with rasterio.open(path) as source:
        assert source.read().max() == 7  # GDAL itself follows it
    with pytest.raises(SasgeoError, match=r"layers\.tif"):
        read(path)


@pytest.mark.parametrize("beside", ["layers.tif.ovr", "layers.tif.msk", "layers.tif.aux.xml"])
def test_what_lies_beside_a_raster_reads_no_other_file(tmp_path, beside):
    profile = {"driver": "GTiff", "width": 64, "height": 64, "count": 1, "dtype": "uint8", "crs": "EPSG:32632"}
    path, secret = tmp_path / "layers.tif", tmp_path / "elsewhere" / "secret.tif"
    secret.parent.mkdir()
    for name, size, value in ((path, 64, 1), (secret, 32, 7)):
        with rasterio.open(name, "w", **profile | {"width": size, "height": size}) as target:
            target.write(np.full((1, size, size), value, dtype=np.uint8))
    text = f'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{secret}</MDI></Metadata></PAMDataset>'
    virtual = VIRTUAL.format(path=secret, size=32 if beside.endswith("ovr") else 64)
    (tmp_path / beside).write_text(text if beside.endswith("xml") else virtual)
    with rasterio.open(path, driver="GTiff") as source:
        assert str(secret) in source.files  # GDAL itself follows it
    with open_geotiff(path) as source:
        assert (source.files, source.overviews(1), source.dataset_mask().min()) == ([str(path)], [], 255)
    with (
        pytest.raises(RasterioIOError, match=r"reads secret\.tif, which is none of its own"),
        open_geotiff(path, has_more=True),
    ):
        pass


def test_what_belongs_to_a_raster_may_lie_beside_it(tmp_path):
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", width=64, height=64, count=1, dtype="uint8") as target:
        target.write(np.full((1, 64, 64), 1, dtype=np.uint8))
    (tmp_path / "a.tfw").write_text("2\n0\n0\n-2\n100\n200\n")
    with open_geotiff(path, has_more=True) as source:
        assert source.transform[:6] == (2, 0, 99, 0, -2, 201)


def test_every_reader_of_rasters_and_pictures_names_the_formats_that_it_takes():
    """Rasters by `open_geotiff` and `open_database` alone."""
    root = Path(sasgeo_bench.__file__).parent
    loose = []
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "open"):
                continue
            is_raster = ast.unparse(node.func.value) == "rasterio" and path.name != "geotiff.py"
            is_written = any(isinstance(one, ast.Constant) and one.value == "w" for one in node.args)
            is_written |= "driver='VRT'" in ast.unparse(node)  # a view of ours of a file that is open
            is_picture = ast.unparse(node.func.value) == "Image"
            if (is_raster and not is_written) or (is_picture and "formats" not in {one.arg for one in node.keywords}):
                loose.append(f"{path.relative_to(root)}:{node.lineno}")
    assert not loose
