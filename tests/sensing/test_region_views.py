# SPDX-License-Identifier: Apache-2.0
"""Labelled views of a region with imagery: side by side, with what is mapped as labels, and unknown elsewhere."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import shapely

from sasgeo_bench.core.errors import ImageryError
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.imagery import OffsetRecord
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sensing.reference_imagery import part_bounds_m, region_views, split_bounds
from tests import world
from tests.regions.imagery_place import EPSG, GSD_M, SIDE_M, SOUTH, WEST, make_hamlet

SIDE_PX = 128  # 64 m


@pytest.fixture(scope="module")
def hamlet(tmp_path_factory):
    return make_hamlet(tmp_path_factory.mktemp("hamlet"))


def built(place, out):
    folders = {"extract_folders": [place.folder], "imagery_folders": [place.folder]}
    return read_region(world.built(place.spec(), out, **folders))


@pytest.fixture(scope="module")
def region(hamlet, tmp_path_factory):
    return built(hamlet, tmp_path_factory.mktemp("out"))


def views(region, bounds_m):
    return list(region_views(region, bounds_m, place="hamlet", gsd_m=GSD_M, side_px=SIDE_PX))


def test_views_lie_side_by_side_and_show_their_labels(region):
    inside = (WEST + 64.0, SOUTH + 64.0, WEST + 320.0, SOUTH + 320.0)
    found = views(region, inside)
    assert [one.image.shape for one in found] == [(SIDE_PX, SIDE_PX)] * 16
    rgb = np.concatenate([one.image.rgb.reshape(-1, 3) for one in found]).mean(axis=1)
    labels = np.concatenate([one.labels[0].ravel() for one in found])
    assert (labels != UNKNOWN).all()
    # Roofs of the made-up mosaic are 90 brighter than the ground; a shift of labels would bring the means together.
    assert rgb[labels == PRESENT].mean() - rgb[labels != PRESENT].mean() > 80


def test_labels_are_what_is_mapped_at_each_pixel_of_the_view(region, hamlet):
    west, south = WEST + 64.0, SOUTH + 64.0
    (one,) = views(region, (west, south, west + 64.0, south + 64.0))
    east_m = west + GSD_M * (np.arange(SIDE_PX) + 0.5)
    north_m = south + 64.0 - GSD_M * (np.arange(SIDE_PX) + 0.5)
    house = shapely.union_all(hamlet.houses)
    is_house = shapely.contains_xy(house, *np.meshgrid(east_m, north_m))
    assert ((one.labels[0] == PRESENT) == is_house).mean() > 0.99


def test_the_measured_offset_of_the_imagery_is_taken_off_the_labels(region):
    inside = (WEST + 64.0, SOUTH + 64.0, WEST + 320.0, SOUTH + 320.0)
    off = OffsetRecord(
        east_m=2.0, north_m=-1.0, east_interval_m=(2.0, 2.0), north_interval_m=(-1.0, -1.0), residual_m=0.0, tiles=9
    )
    plain, moved = (
        np.block([[one.labels[0] for one in row] for row in np.array_split(np.array(views(one, inside)), 4)])
        for one in (with_offset(region, None), with_offset(region, off))
    )
    down, right = round(1.0 / GSD_M), round(2.0 / GSD_M)
    assert (moved[down:, right:] == plain[:-down, :-right]).all()
    assert (moved != plain).any()


def with_offset(region, offset):
    """Return a region whose imagery says that it is off its map."""
    record = region.imagery.record.model_copy(update={"offset": offset})
    return replace(region, imagery=replace(region.imagery, record=record))


def test_beyond_the_mapped_area_labels_are_unknown_and_views_of_nothing_are_left_out(region):
    found = views(region, (WEST, SOUTH, WEST + 64.0, SOUTH + 64.0))  # mapped from 20 m on
    assert (found[0].labels == UNKNOWN).mean() == pytest.approx(1 - (44 / 64) ** 2, abs=0.05)
    assert views(region, (WEST - 200.0, SOUTH, WEST - 136.0, SOUTH + 64.0)) == []
    with pytest.raises(ImageryError, match="has no imagery"):
        views(replace(region, imagery=None), (WEST, SOUTH, WEST + 64.0, SOUTH + 64.0))


def test_where_the_imagery_has_no_data_labels_are_unknown(hamlet, tmp_path):
    place = hamlet.but(folder=tmp_path / "place", extra="empty_rgb = [255, 255, 255]\n")
    shutil.copytree(hamlet.folder, place.folder)
    with rasterio.open(place.folder / "mosaic.tif", "r+") as mosaic:
        bands = mosaic.read()
        bands[:, 300:400, 300:400] = 255
        mosaic.write(bands)
    found = views(built(place, tmp_path / "out"), (WEST + 64.0, SOUTH + 64.0, WEST + 320.0, SOUTH + 320.0))
    unknown = sum(int((one.labels == UNKNOWN).sum()) for one in found)
    assert unknown == pytest.approx(100 * 100, rel=0.06)
    assert all((one.image.rgb[one.labels[0] == UNKNOWN] == 0).all() for one in found)


def test_a_strip_shorter_than_half_a_view_is_left_out_and_a_longer_one_is_narrower(region):
    shapes = [
        [one.image.shape for one in views(region, (WEST + 64.0, SOUTH + 64.0, WEST + 64.0 + width, SOUTH + 128.0))]
        for width in (90.0, 100.0)
    ]
    assert shapes == [[(SIDE_PX, SIDE_PX)], [(SIDE_PX, SIDE_PX), (SIDE_PX, 72)]]


def test_parts_of_a_region_file_are_where_its_rings_are(hamlet):
    (part,) = part_bounds_m(hamlet.spec(), epsg=EPSG)
    assert part == pytest.approx((WEST + 20, SOUTH + 20, WEST + SIDE_M - 20, SOUTH + SIDE_M - 20), abs=0.01)
    west, east = split_bounds(part, 2)
    assert west[2] == east[0] == pytest.approx(WEST + SIDE_M / 2, abs=0.01)
