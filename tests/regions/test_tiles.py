# SPDX-License-Identifier: Apache-2.0
"""Aerial pictures in tiles: an MBTiles, a GeoPackage and folders give what a GeoTIFF of the same pixels gives."""

import hashlib
import math
import shutil
import sqlite3
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from affine import Affine
from numpy.typing import NDArray
from PIL import Image
from rasterio.warp import Resampling, reproject

from sasgeo_bench.core.errors import ImageryError
from sasgeo_bench.core.geotiff import open_database
from sasgeo_bench.regions import tiles
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.region_files import read_manifest
from tests import world
from tests.regions.imagery_place import Hamlet, make_hamlet, write_picture

ZOOM = 17  # pixels of 0.81 m on the ground
EDGE_M = 20_037_508.342789244  # of the world in Web Mercator
SIDE_M = 2 * EDGE_M / 2**ZOOM


@pytest.fixture(scope="module")
def hamlet(tmp_path_factory: pytest.TempPathFactory) -> Hamlet:
    """The place's files, and its picture cut into the tiles of one zoom in every container."""
    place = make_hamlet(tmp_path_factory.mktemp("hamlet"))
    folder = place.folder
    with rasterio.open(folder / "mosaic.tif") as source:
        west, _, east, _ = source.bounds
        cols = range(math.floor((west + EDGE_M) / SIDE_M), math.floor((east + EDGE_M) / SIDE_M) + 1)
        rows = range(
            math.floor((EDGE_M - source.bounds.top) / SIDE_M), math.floor((EDGE_M - source.bounds.bottom) / SIDE_M) + 1
        )
        transform = Affine(SIDE_M / 256, 0, cols[0] * SIDE_M - EDGE_M, 0, -SIDE_M / 256, EDGE_M - rows[0] * SIDE_M)
        rgba = np.zeros((4, 256 * len(rows), 256 * len(cols)), dtype=np.uint8)
        about = {"src_crs": source.crs, "dst_crs": source.crs, "dst_transform": transform}
        reproject(source.read(), rgba[:3], src_transform=source.transform, resampling=Resampling.nearest, **about)
    rgba[3] = np.where((rgba[:3] > 0).any(axis=0), 255, 0)
    write_picture(folder / "plain.tif", rgba, transform=transform, photometric="RGB", alpha="YES")
    cut = {
        (col, row): rgba[:, 256 * (row - rows[0]) :][:, :256, 256 * (col - cols[0]) :][:, :, :256]
        for col in cols
        for row in rows
    }
    save_tiles(folder / "xyz", cut)
    save_tiles(folder / "tms", {(col, 2**ZOOM - 1 - row): tile for (col, row), tile in cut.items()})
    save_mbtiles(folder / "a.mbtiles", folder / "tms")
    with rasterio.open(folder / "plain.tif") as source:
        profile = {"driver": "GPKG", "tile_format": "PNG", "tiling_scheme": "GoogleMapsCompatible"}
        for name, more in (("ONE", {}), ("TWO", {"append_subdataset": "YES"})):
            rasterio.shutil.copy(source, folder / "two.gpkg", raster_table=name, **profile, **more)
        rasterio.shutil.copy(source, folder / "a.gpkg", **profile)
    return place


def save_tiles(folder: Path, cut: dict[tuple[int, int], NDArray[np.uint8]], zoom: int = ZOOM) -> None:
    for (col, row), tile in cut.items():
        path = folder / str(zoom) / str(col) / f"{row}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.moveaxis(tile, 0, -1)).save(path)


def save_mbtiles(path: Path, tms: Path) -> None:
    """Write tiles as the specification says, without GDAL: rows from the south."""
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER, tile_data BLOB)")
        base.executemany("INSERT INTO metadata VALUES (?, ?)", [("name", "a"), ("format", "png")])
        for tile in sorted(tms.glob("*/*/*.png")):
            at = (int(tile.parts[-3]), int(tile.parts[-2]), int(tile.stem))
            base.execute("INSERT INTO tiles VALUES (?, ?, ?, ?)", (*at, tile.read_bytes()))
    base.close()


def built(hamlet: Hamlet, out: Path, picture: str, extra: str = "") -> Path:
    spec = hamlet.but(picture=picture, extra=extra).spec()
    return world.built(spec, out, extract_folders=[hamlet.folder], imagery_folders=[hamlet.folder])


def pixels(folder: Path) -> NDArray[np.uint8]:
    with rasterio.open(folder / ORTHO) as source:
        return np.concatenate([source.read(), source.dataset_mask()[None]])


@pytest.fixture(scope="module")
def expected(hamlet, tmp_path_factory) -> NDArray[np.uint8]:
    """What the GeoTIFF gives."""
    found = pixels(built(hamlet, tmp_path_factory.mktemp("plain"), "plain.tif"))
    assert (found[3] > 0).mean() > 0.9
    assert found[:3].std() > 20
    return found


@pytest.mark.parametrize(
    ("picture", "extra"),
    [
        ("xyz", ""),
        ("tms", "tms = true\n"),
        ("a.mbtiles", ""),
        ("a.gpkg", ""),
        ("two.gpkg", 'layer = "TWO"\n'),
    ],
)
def test_tiles_in_any_container_give_the_pixels_of_a_geotiff(picture, extra, hamlet, expected, tmp_path):
    folder = built(hamlet, tmp_path, picture, extra)
    assert np.abs(pixels(folder).astype(int) - expected).max() == 0
    (record,) = read_manifest(folder).imagery.pictures
    assert record.file == picture
    assert record.gsd_m == pytest.approx(SIDE_M / 256 * math.cos(math.radians(47.04)), rel=0.001)
    parts = list((hamlet.folder / picture).rglob("*.png")) or [hamlet.folder / picture]
    assert record.bytes == sum(path.stat().st_size for path in parts)


def test_the_hash_of_a_folder_is_that_of_the_list_that_sha256sum_writes(hamlet):
    folder = hamlet.folder / "xyz"
    tool = shutil.which("sha256sum")
    if tool is None:
        pytest.skip("sha256sum is not on this machine")
    names = sorted(f"./{path.relative_to(folder)}" for path in folder.rglob("*.png"))
    lines = subprocess.run([tool, *names], cwd=folder, check=True, capture_output=True).stdout  # noqa: S603 - our own
    assert tiles.record_of(folder).sha256 == hashlib.sha256(lines).hexdigest()


def refusal(hamlet: Hamlet, out: Path, picture: str, extra: str = "") -> str:
    with pytest.raises(ImageryError) as found:
        built(hamlet, out, picture, extra)
    assert "\n" not in str(found.value)
    assert not list(out.rglob("*.tif"))
    return str(found.value)


def test_rows_that_count_from_the_other_side_are_told(hamlet, tmp_path):
    assert "none in the region: its rows count from the other side: say tms = true" in refusal(hamlet, tmp_path, "tms")
    text = refusal(hamlet, tmp_path, "xyz", "tms = true\n")
    assert "its rows count from the other side: leave tms out" in text


def copied(hamlet: Hamlet, to: Path, picture: str = "xyz") -> Hamlet:
    """The place with a folder of tiles that a test may change."""
    shutil.copytree(hamlet.folder / picture, to / "cut")
    shutil.copy(hamlet.folder / "houses.geojson", to)
    return Hamlet(folder=to, houses=[], picture="cut")


def first(hamlet: Hamlet) -> Path:
    """A tile in the middle of the place."""
    found = sorted((hamlet.folder / "cut" / str(ZOOM)).glob("*/*.png"))
    return found[len(found) // 2]


def spoilt(kind: str, tile: Path) -> None:
    if kind == "virtual":
        tile.write_text("<VRTDataset rasterXSize='256' rasterYSize='256'></VRTDataset>")
    elif kind == "palette":
        Image.open(tile).convert("P").save(tile)
    elif kind == "small":
        Image.open(tile).resize((128, 128)).save(tile)
    else:
        shutil.rmtree(tile.parents[2])
        tile.parents[2].mkdir()


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("virtual", "is no PNG, JPEG or WebP"),
        ("palette", "is a picture of mode 'P', imagery is 8-bit red, green and blue"),
        ("small", "has tiles of 128 x 128, 256 x 256 pixels, expected 256 x 256 or 512 x 512 throughout"),
        ("none", "holds no tiles zoom/column/row.png"),
    ],
)
def test_a_tile_that_is_no_picture_is_named(kind, fault, hamlet, tmp_path):
    place = copied(hamlet, tmp_path)
    spoilt(kind, first(place))
    assert fault in refusal(place, tmp_path / "out", "cut")


def test_too_many_tiles_are_refused(hamlet, tmp_path, monkeypatch):
    monkeypatch.setattr(tiles, "MOST_TILES", 3)
    assert "tiles of zoom 17 in the region, the most is 3: say a coarser gsd_m" in refusal(hamlet, tmp_path, "xyz")


def test_a_missing_tile_is_unknown_ground_and_a_jpeg_hides_nothing(hamlet, expected, tmp_path):
    place = copied(hamlet, tmp_path)
    gone = first(place)
    gone.unlink()
    for tile in (place.folder / "cut").rglob("*.png"):
        Image.open(tile).convert("RGB").save(tile.with_suffix(".jpg"), quality=98, subsampling=0)
        tile.unlink()
    found = pixels(built(place, tmp_path / "out", "cut"))
    lost = (found[3] == 0) & (expected[3] > 0)
    assert lost.sum() * 0.5**2 == pytest.approx((256 * 0.8145) ** 2, rel=0.1)
    both = (found[3] > 0) & (expected[3] > 0)
    assert np.abs(found[:3, both].astype(int) - expected[:3, both]).mean() < 4


def test_a_coarser_zoom_is_read_where_it_is_fine_enough(hamlet, tmp_path):
    place = copied(hamlet, tmp_path)
    coarse = {}
    for tile in (place.folder / "cut" / str(ZOOM)).glob("*/*.png"):
        col, row = int(tile.parent.name), int(tile.stem)
        whole = coarse.setdefault((col // 2, row // 2), np.zeros((4, 256, 256), dtype=np.uint8))
        small = np.moveaxis(np.asarray(Image.open(tile).resize((128, 128))), -1, 0)
        whole[:, 128 * (row % 2) :][:, :128, 128 * (col % 2) :][:, :, :128] = small
    save_tiles(place.folder / "cut", coarse, zoom=ZOOM - 1)
    deep, shallow = (built(place, tmp_path / name, "cut", extra) for name, extra in (("a", ""), ("b", "gsd_m = 2.0\n")))
    assert read_manifest(deep).imagery.gsd_m == pytest.approx(0.5)
    assert read_manifest(shallow).imagery.gsd_m == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("picture", "extra", "fault"),
    [
        ("two.gpkg", "", "has 2 rasters (ONE, TWO): name one by layer"),
        ("two.gpkg", 'layer = "three"\n', "cannot be read"),
        ("a.mbtiles", 'layer = "one"\n', "is an MBTiles, which has no layers"),
        ("plain.tif", 'layer = "one"\n', "is no GeoPackage of rasters or folder of tiles: leave layer and tms out"),
    ],
)
def test_a_raster_that_is_not_there_is_refused(picture, extra, fault, hamlet, tmp_path):
    assert fault in refusal(hamlet, tmp_path, picture, extra)


@pytest.mark.parametrize("name", ["a.mbtiles", "a.gpkg"])
def test_what_lies_beside_a_database_is_passed_over(name, hamlet, tmp_path):
    path = Path(shutil.copy(hamlet.folder / name, tmp_path))
    domain = f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{tmp_path}/secret.tif</MDI></Metadata>'
    path.with_name(f"{name}.aux.xml").write_text(f"<PAMDataset>{domain}</PAMDataset>")
    with rasterio.open(path, driver="GPKG" if name == "a.gpkg" else "MBTiles") as source:
        assert len(source.files) == 2  # GDAL itself reads it
    with open_database(path) as source:
        assert source.files == [str(path)]
