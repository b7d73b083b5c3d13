# SPDX-License-Identifier: Apache-2.0
"""The mapped area: estimated from the data, bounded by the header, overruled by the region file."""

import numpy as np
import shapely
from scipy import ndimage

from sasgeo_bench.osm.coverage import _closed, _largest, _opened, choose_coverage, estimate_coverage

M_PER_DEG = 111_320.0
COS_LATITUDE = float(np.cos(np.radians(47.0)))


def lonlat_of(metres):
    """Metres around 9 E, 47 N -> longitude and latitude."""
    east, north = np.asarray(metres, dtype=float).T
    return np.column_stack((9.0 + east / M_PER_DEG / COS_LATITUDE, 47.0 + north / M_PER_DEG))


def metres_of(geometry):
    return shapely.transform(geometry, lambda at: (at - [9.0, 47.0]) * [M_PER_DEG * COS_LATITUDE, M_PER_DEG])


def scattered(shape, count=6000, seed=1):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-6000, 6000, (count * 3, 2))
    return lonlat_of(points[shapely.contains_xy(shape, points)])


COUNTRY = shapely.Polygon([(-4000, -3000), (3000, -4000), (4500, 1000), (0, 4000), (-4500, 2000)])


def test_the_estimate_follows_an_outline_within_two_cells():
    found = metres_of(estimate_coverage(scattered(COUNTRY)))
    assert shapely.contains(found, shapely.buffer(COUNTRY, -300))
    assert shapely.contains(shapely.buffer(COUNTRY, 300), found)


def test_a_lake_within_is_covered_and_a_road_kept_whole_beyond_the_edge_and_leftovers_far_away_are_not():
    lake = shapely.Point(0, 0).buffer(1200)
    road = lonlat_of([(4000 + step, 500) for step in range(0, 4000, 40)])
    found = metres_of(estimate_coverage(np.concatenate((scattered(COUNTRY - lake), road))))
    assert shapely.contains_xy(found, 0, 0)
    assert not shapely.contains_xy(found, 7000, 500)
    island = lonlat_of([(20_000 + 40 * step, 40 * step) for step in range(5)])
    found = estimate_coverage(np.concatenate((scattered(COUNTRY), island)))
    assert metres_of(found).bounds[2] < 6000
    assert estimate_coverage(np.zeros((0, 2))).is_empty


def test_cells_are_closed_opened_and_told_apart_as_by_distances():
    rng = np.random.default_rng(0)
    disc = np.hypot(*np.ogrid[-1:2, -1:2]) < 2
    for share in np.repeat([0.003, 0.02, 0.1, 0.4], 20):
        cells = np.pad(rng.random(rng.integers(9, 60, size=2)) < share, 4)
        cells[5, 5] = True
        near = ndimage.distance_transform_edt(~cells) <= 3  # cells: half of 600 m
        closed = ndimage.binary_fill_holes(ndimage.distance_transform_edt(near) > 3)
        assert (_closed(cells) == closed).all()
        opened = ndimage.binary_opening(closed, disc)
        assert (_opened(closed) == (opened if opened.any() else closed)).all()
        labels, count = ndimage.label(closed)
        sizes = ndimage.sum_labels(closed, labels, np.arange(1, count + 1))
        assert (_largest(closed) == np.isin(labels, 1 + np.flatnonzero(sizes >= 0.02 * sizes.max()))).all()


def test_of_an_extract_cut_along_a_border_the_header_is_only_the_frame():
    triangle = shapely.Polygon([(-4000, -4000), (4000, -4000), (4000, 4000)])
    west, south = lonlat_of([(-4000, -4000)])[0]
    east, north = lonlat_of([(4000, 4000)])[0]
    area, source = choose_coverage(scattered(triangle), stated=None, header=shapely.box(west, south, east, north))
    assert source == "estimated"
    assert not shapely.contains_xy(metres_of(area), -2500, 2500)
    assert shapely.contains(shapely.box(west, south, east, north), area)


def test_a_place_on_both_sides_of_the_antimeridian_is_estimated_side_by_side():
    rng = np.random.default_rng(2)
    lonlat = rng.uniform((-0.05, -17.05), (0.05, -16.95), (20_000, 2))
    lonlat[:, 0] = np.where(lonlat[:, 0] < 0, lonlat[:, 0] + 180, lonlat[:, 0] - 180)
    west, _, east, _ = estimate_coverage(lonlat).bounds
    assert west < -179.94
    assert east > 179.94
    assert 0.007 < estimate_coverage(lonlat).area < 0.013
