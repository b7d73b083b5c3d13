# SPDX-License-Identifier: Apache-2.0
"""Labelled views cut out of the imagery of a region: real pictures to learn from and to be scored on."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
import shapely

from sasgeo_bench.errors import ImageryError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import from_lonlat
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.imagery import Bounds, Imagery
from sasgeo_bench.regions.layers import OUTSIDE, Paint, burn_layers, make_paint
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.sensing.camera import Camera
from sasgeo_bench.sensing.image import AerialImage, LabelledImage
from sasgeo_bench.sensing.intrinsics import Intrinsics

LEAST_LABELLED: Final = 0.25  # fraction of a view; one that shows less of the mapped area is left out
_FAR_M: Final = 1000.0  # height of the camera of a mosaic, in which nothing leans


def part_bounds_m(spec: RegionFile, *, epsg: int) -> tuple[Bounds, ...]:
    """Return west, south, east, north of each part of the mapped area that a region file states, in its order.

    >>> from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
    >>> north, south = part_bounds_m(read_region_file(find_region_file("zanzibar")), epsg=32737)
    >>> [round(end - start) for start, end in zip(north, north[2:])]  # metres
    [608, 302]
    """
    to_map = from_lonlat(epsg)
    rings = [spec.coverage_lonlat] if spec.coverage_lonlat is not None else spec.coverage_parts_lonlat or []
    corners = [np.column_stack(to_map.transform(*np.array(ring).T)) for ring in rings]
    return tuple(tuple(shapely.LinearRing(ring).bounds) for ring in corners)


def split_bounds(bounds_m: Bounds, count: int) -> tuple[Bounds, ...]:
    """Return `count` equally wide blocks of a box, west first.

    >>> split_bounds((0.0, 0.0, 30.0, 10.0), 2)
    ((0.0, 0.0, 15.0, 10.0), (15.0, 0.0, 30.0, 10.0))
    """
    west, south, east, north = bounds_m
    edges = np.linspace(west, east, count + 1).tolist()
    return tuple((left, south, right, north) for left, right in pairwise(edges))


def region_views(
    region: Region, bounds_m: Bounds, *, place: str, gsd_m: float = 0.25, side_px: int = 400
) -> Iterator[LabelledImage]:
    """Yield square views of a part of a region, side by side, with the classes of its map as labels.

    Parameters
    ----------
    region : Region
        A region with imagery.
    bounds_m : tuple of float
        West, south, east, north of the part, metres in the region's CRS.
    place : str
        Place of the labelled images.
    gsd_m, side_px : float, int
        Width of a pixel on the ground, and pixels of a side. Views at the eastern and southern edge may be narrower, by
        half a side at most.

    Raises
    ------
    ImageryError
        If the region has no imagery.

    Notes
    -----
    Labels are burned from the features at the pixels of the view. They are UNKNOWN outside the mapped area and where
    the imagery has no data. Views of which less than `LEAST_LABELLED` is known are left out.

    Examples
    --------
    `list(region_views(read_region("out/regions/zanzibar"), bounds_m, place="zanzibar-north"))` holds views of 100 m.
    """
    if region.imagery is None:
        raise ImageryError(f"region {region.manifest.id} has no imagery: choose one whose region file names some")
    paint = make_paint(region.features, region.classes, region.coverage)
    whole = Grid.from_bounds(*bounds_m, cell_size_m=gsd_m, epsg=region.grid.epsg)
    for row, rows in _strips(whole.rows, side_px):
        for col, cols in _strips(whole.cols, side_px):
            view = _view(region.imagery, region.classes, paint, whole.window(row, col, rows, cols), place)
            if (view.labels != UNKNOWN).any(axis=0).mean() >= LEAST_LABELLED:
                yield view


def _strips(total: int, side: int) -> Iterator[tuple[int, int]]:
    """Yield start and length of the strips of an axis; the last one is left out if shorter than half a side."""
    for start in range(0, total, side):
        length = min(side, total - start)
        if 2 * length >= side:
            yield start, length


def _view(imagery: Imagery, classes: tuple[str, ...], paint: Paint, grid: Grid, place: str) -> LabelledImage:
    shown = imagery.read(grid.bounds_m, gsd_m=grid.cell_size_m)
    labels = burn_layers(paint, grid)
    labels[(labels == OUTSIDE) | ~shown.is_known] = UNKNOWN
    focal_px = _FAR_M / grid.cell_size_m
    lens = Intrinsics(
        width_px=grid.cols,
        height_px=grid.rows,
        focal_px=(focal_px, focal_px),
        centre_px=(grid.cols / 2, grid.rows / 2),
    )
    camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=_FAR_M, yaw_deg=0.0)
    image = AerialImage(rgb=np.ascontiguousarray(shown.rgb), camera=camera)
    return LabelledImage(image=image, classes=classes, labels=labels, place=place)
