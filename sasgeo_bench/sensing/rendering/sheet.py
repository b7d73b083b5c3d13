# SPDX-License-Identifier: Apache-2.0
"""Sheet: one window of a map as rasters of numbers, made once, from which many unlike pictures are drawn quickly."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.sensing.rendering.buildings import rectangles
from sasgeo_bench.sensing.rendering.plan import Mask, Shapes, along, burn_numbers, inside_m, no_shapes, shapes_of
from sasgeo_bench.sensing.rendering.roads import STREETS
from sasgeo_bench.sensing.rendering.texture import Field, Numbers

if TYPE_CHECKING:
    import geopandas as gpd

Codes = NDArray[np.uint16]

YARD_M: Final = 22.0  # from a wall to the end of its ground
INCHES: Final = 32  # steps of a metre in which the distance from a kerb is kept
BEYOND_M: Final = 8.0  # how far beyond a kerb it is kept
_MOST_THINGS: Final = 65_000
_STALL_M: Final = (2.7, 5.4)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Things:
    """Numbered things of a sheet, row 0 stands for none: the look of each, and the rectangle around it, cells.

    `centre` (u, v), `axis` along its long side (u, v) and `half` (long, short) have shape (N, 2); `width_m` is that of
    a line, 0 of an area.
    """

    look: NDArray[np.str_]
    centre: Field
    axis: Field
    half: Field
    width_m: Field

    def __len__(self) -> int:
        return len(self.look)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sheet:
    """A window of a map: its layers, and what stands where.

    `ground`, uint16 of shape (rows, cols, 2), holds the number of the uppermost thing that is no building, and how far
    the cell is inside a street or railway, plus `BEYOND_M`, in `INCHES` of a metre. `built`, of that shape, holds the
    number of the building, and of the one whose yard the cell may be. `roadside` are places along the axes of streets,
    and `stalls` those of car parks, rows of (u, v, direction u, direction v, half width), cells.
    """

    grid: Grid
    bits: LayerBits
    ground: Codes
    built: Codes
    things: Things
    buildings: Things
    roadside: Field
    stalls: Field


def make_sheet(
    features: "gpd.GeoDataFrame", classes: tuple[str, ...], coverage: shapely.Geometry, window: Grid
) -> Sheet:
    """Burn the features near a window; `classes` and `coverage` are those of the region."""
    box = shapely.box(*window.bounds_m)
    shapes = shapes_of(features, box)
    margin = shapely.buffer(box, 2 * YARD_M)
    near = features[shapely.intersects(features.geometry.to_numpy(), margin)]
    bits = LayerBits.of(burn_layers(make_paint(near, classes, coverage), window))
    order = sorted(load_taxonomy().classes, key=lambda item: item.paint)
    looks = [look for look in dict.fromkeys(item.look for item in order) if look in shapes]
    flat = [(look, shapes[look]) for look in looks if look not in ("building", "none")]
    # Areas of a look hide its lines: a river has no stream in it
    flat = [(name, part.part(np.argsort(np.isnan(part.width_m), kind="stable"))) for name, part in flat]
    look = np.repeat([name for name, _ in flat], [len(part) for _, part in flat]).astype(str)
    areas = np.concatenate([*(part.areas() for _, part in flat), _NONE])
    number = burn_numbers(areas, window)
    houses = shapes["building"] if "building" in shapes else no_shapes()
    house = burn_numbers(houses.areas(), window)
    is_way = np.isin(np.concatenate([["none"], look]), (*STREETS, "railway"))[number]
    parked = shapes["parking"] if "parking" in shapes else no_shapes()
    return Sheet(
        grid=window,
        bits=bits,
        ground=np.stack([number, _kerb(is_way, window)], axis=-1).clip(0, _MOST_THINGS).astype(np.uint16),
        built=np.stack([house, _yards(house, window)], axis=-1).clip(0, _MOST_THINGS).astype(np.uint16),
        things=_things(look, areas, np.concatenate([*(part.width_m for _, part in flat), np.zeros(0)]), window),
        buildings=_things(np.repeat("building", len(houses)), houses.geometry, houses.width_m, window),
        roadside=_roadside([part for name, part in flat if name in STREETS], window),
        stalls=_stalls(parked, window),
    )


_NONE: Final = np.zeros(0, dtype=object)


def _things(look: NDArray[np.str_], geometry: NDArray[np.object_], width_m: Numbers, grid: Grid) -> Things:
    centre_m, axis, half_m = rectangles(geometry)
    empty = np.zeros((1, 2))
    return Things(
        look=np.concatenate([["none"], look]),
        centre=np.concatenate([empty, grid.to_uv(centre_m)]).astype(np.float32),
        axis=np.concatenate([[[1.0, 0.0]], axis * (1, -1)]).astype(np.float32),
        half=np.concatenate([empty, half_m / grid.cell_size_m]).astype(np.float32),
        width_m=np.concatenate([[0.0], np.nan_to_num(width_m)]).astype(np.float32),
    )


def _kerb(is_way: Mask, grid: Grid) -> NDArray[np.int32]:
    """Return how far each cell is inside a way, or outside of it, from `BEYOND_M` outside on."""
    if not is_way.any():
        return np.zeros(grid.shape, dtype=np.int32)
    kerb_m = inside_m(is_way, grid) - inside_m(~is_way, grid)
    return np.asarray((kerb_m + np.float32(BEYOND_M)) * INCHES, dtype=np.int32)


def _yards(house: NDArray[np.int32], grid: Grid) -> NDArray[np.int32]:
    """Return the number of the nearest building, 0 beyond its yard."""
    if not house.any():
        return house
    away, nearest = cv2.distanceTransformWithLabels(
        (house == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, dtype=np.int32)
    owner[nearest[house > 0]] = house[house > 0]
    return np.where(away < YARD_M / grid.cell_size_m, owner[nearest], 0)


def _roadside(streets: list[Shapes], grid: Grid) -> Field:
    rows = [np.zeros((0, 5))]
    box = shapely.box(*grid.bounds_m)
    for shapes in streets:
        is_line = np.isfinite(shapes.width_m)
        for line, width_m in zip(shapes.geometry[is_line], shapes.width_m[is_line], strict=True):
            at = along(shapely.intersection(line, box), 7.0, 3.0)
            rows.append(np.column_stack([at, np.full(len(at), width_m / 2)]))
    return _in_cells(np.concatenate(rows), grid)


def _stalls(parking: Shapes, grid: Grid) -> Field:
    """Return the places of rows of cars within areas, in rows along the long side of each."""
    rows = [np.zeros((0, 5))]
    wide_m, deep_m = _STALL_M
    outlines = shapely.get_parts(shapely.intersection(parking.areas(), shapely.box(*grid.bounds_m)))
    outlines = outlines[shapely.area(outlines) > 2 * wide_m * deep_m]
    for outline, centre, axis, half in zip(outlines, *rectangles(outlines), strict=True):
        side = np.array([-axis[1], axis[0]])
        ahead = np.arange(-half[0] + 2, half[0] - 1, wide_m)
        across = np.arange(-half[1] + 3, half[1] - 2.9, 1.6 * deep_m)  # a lane between each two rows
        places = centre + (ahead[:, None, None] * axis + across[None, :, None] * side).reshape(-1, 2)
        places = places[shapely.contains_xy(outline, *places.T)]
        more = np.array([*side, deep_m / 2])
        rows.append(np.column_stack([places, np.tile(more, (len(places), 1))]))
    return _in_cells(np.concatenate(rows), grid)


def _in_cells(rows: Numbers, grid: Grid) -> Field:
    uv = grid.to_uv(rows[:, :2])
    return np.column_stack([uv, rows[:, 2], -rows[:, 3], rows[:, 4] / grid.cell_size_m]).astype(np.float32)
