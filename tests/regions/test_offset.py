# SPDX-License-Identifier: Apache-2.0
"""The offset of a picture against the map: found where houses are seen, not where they are not."""

from pathlib import Path

import numpy as np
import pytest
import rasterio.features
import shapely
from affine import Affine
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from shapely import affinity

from sasgeo_bench.core.folders import FileRecord
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.build import LEAST_TILES, REACH_M, measure_offset
from sasgeo_bench.regions.imagery import Imagery, OffsetRecord, OrthoRecord, PictureRecord
from tests.regions.imagery_place import write_picture

GRID = Grid.from_bounds(500_000.0, 5_210_000.0, 500_576.0, 5_210_576.0, cell_size_m=0.5, epsg=32632)
TILES = 36  # of 96 m
PICTURE = PictureRecord(
    file="made.tif",
    sha256="0" * 64,
    bytes=0,
    date="2024-01-01",
    licence="none",
    attribution="nobody",
    publish=False,
    source=None,
    gsd_m=GRID.cell_size_m,
)


def village(rng: np.random.Generator) -> list[shapely.Polygon]:
    """Houses of any size and heading, none beside another in the same way."""
    west, south, east, north = GRID.bounds_m
    return [
        affinity.rotate(shapely.box(x, y, x + rng.uniform(8, 20), y + rng.uniform(8, 16)), rng.uniform(0, 90))
        for x, y in rng.uniform((west + 12, south + 12), (east - 32, north - 28), (300, 2))
    ]


def photograph(houses: list[shapely.Polygon], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Roofs, dark and bright, on rough ground, shape (3, rows, cols)."""
    tones = [(house, float(tone)) for house, tone in zip(houses, rng.choice([30.0, 190.0], len(houses)), strict=True)]
    grey = rasterio.features.rasterize(
        tones, out_shape=GRID.shape, transform=Affine(*GRID.transform), fill=100.0, dtype="float32"
    )
    rough = gaussian_filter(rng.normal(0, 40, GRID.shape), 2) + rng.normal(0, 8, GRID.shape)
    return np.repeat(np.clip(grey + rough, 1, 254).astype(np.uint8)[None], 3, axis=0)


def measured(path: Path, bands: NDArray[np.uint8], houses: list[shapely.Polygon]) -> OffsetRecord | None:
    write_picture(path, bands, transform=Affine(*GRID.transform), crs=f"EPSG:{GRID.epsg}")
    imagery = Imagery(
        path=path,
        file=FileRecord(sha256="0" * 64, bytes=0),
        record=OrthoRecord.unmeasured((PICTURE,), GRID),
        epsg=GRID.epsg,
    )
    return measure_offset(imagery, np.array(houses, dtype=object), rng=np.random.default_rng(0))


@pytest.mark.parametrize("off_m", [(0.0, 0.0), (1.3, -0.7), (-7.5, 6.0)])
def test_a_known_shift_is_found_with_an_interval_around_it(off_m, tmp_path):
    rng = np.random.default_rng(3)
    houses = village(rng)
    seen = [affinity.translate(house, *off_m) for house in houses]
    offset = measured(tmp_path / "a.tif", photograph(seen, rng), houses)
    assert (offset.east_m, offset.north_m) == pytest.approx(off_m, abs=0.15)
    for (low, high), at_m in zip((offset.east_interval_m, offset.north_interval_m), off_m, strict=True):
        assert low - 0.1 <= at_m <= high + 0.1
    assert offset.of_tiles == TILES
    assert offset.tiles >= 0.9 * TILES
    assert offset.residual_90_m < 0.5


def test_noise_a_shift_beyond_the_reach_and_other_houses_have_none(tmp_path):
    rng = np.random.default_rng(4)
    houses, others = village(rng), village(rng)
    far = [affinity.translate(house, 2 * REACH_M, -2 * REACH_M) for house in houses]
    noise = rng.integers(1, 254, (3, *GRID.shape)).astype(np.uint8)
    for at, bands in enumerate((noise, photograph(far, rng), photograph(others, rng))):
        assert measured(tmp_path / f"{at}.tif", bands, houses) is None


def test_where_half_the_picture_has_no_edges_the_other_half_is_measured(tmp_path):
    rng = np.random.default_rng(5)
    houses = village(rng)
    bands = photograph([affinity.translate(house, -0.6, 1.1) for house in houses], rng)
    half = GRID.cols // 2
    bands[:, :, half:] = np.clip(rng.normal(100, 8, (3, GRID.rows, half)), 1, 254).astype(np.uint8)  # meadow
    offset = measured(tmp_path / "half.tif", bands, houses)
    assert (offset.east_m, offset.north_m) == pytest.approx((-0.6, 1.1), abs=0.2)
    assert 0.4 * TILES <= offset.tiles <= 0.6 * TILES
    assert offset.of_tiles == TILES


def test_tiles_that_are_off_otherwise_show_in_the_residual_and_hardly_move_the_offset(tmp_path):
    rng = np.random.default_rng(6)
    houses = village(rng)
    west, _, east, _ = GRID.bounds_m
    slope_m = west + 0.7 * (east - west)  # beyond it everything lies 5 m farther north
    seen = [affinity.translate(house, 0.5, 5.0 if house.centroid.x > slope_m else 0.0) for house in houses]
    offset = measured(tmp_path / "slope.tif", photograph(seen, rng), houses)
    assert (offset.east_m, offset.north_m) == pytest.approx((0.5, 0.0), abs=0.3)
    assert offset.residual_m < 0.5
    assert offset.residual_90_m == pytest.approx(5.0, abs=0.5)


def test_too_few_tiles_with_walls_have_none(tmp_path):
    rng = np.random.default_rng(7)
    west, south, _, _ = GRID.bounds_m
    corner = shapely.box(west, south, west + 96 * (LEAST_TILES - 1), south + 96)
    houses = [house for house in village(rng) if corner.contains(house)]
    assert measured(tmp_path / "corner.tif", photograph(houses, rng), houses) is None


def test_a_record_of_an_earlier_version_is_read_and_says_less():
    old = {
        "east_m": 0.31,
        "north_m": -0.12,
        "east_interval_m": [0.22, 0.39],
        "north_interval_m": [-0.2, -0.03],
        "residual_m": 0.24,
        "sharpness": 7.5,
        "tiles": 41,
    }
    record = OffsetRecord.model_validate(old)
    assert (record.residual_90_m, record.of_tiles) == (None, None)
    assert record.to_text().endswith("residual 0.24 m, n = 41")
    newer = record.model_copy(update={"residual_90_m": 0.8, "of_tiles": 60})
    assert newer.to_text().endswith("residual 0.24 m (90 % under 0.80), n = 41 of 60")
