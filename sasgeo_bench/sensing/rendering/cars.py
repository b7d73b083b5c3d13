# SPDX-License-Identifier: Apache-2.0
"""Cars: in the lanes, along the kerb in built-up quarters, and in the bays of car parks."""

from typing import Final

import numpy as np
import shapely

from sasgeo_bench.sensing.rendering.buildings import rectangles
from sasgeo_bench.sensing.rendering.plan import CAR, ROAD, Canvas, Raster, fill_boxes
from sasgeo_bench.sensing.rendering.roads import STREETS, street_points
from sasgeo_bench.sensing.rendering.texture import Numbers, draw

_PAINTS: Final = np.array(
    [
        (222, 222, 222),
        (40, 42, 46),
        (148, 150, 154),
        (96, 100, 106),
        (190, 190, 188),
        (128, 36, 34),
        (44, 66, 112),
        (188, 180, 160),
    ]
)
_WEIGHTS: Final = np.cumsum([0.28, 0.18, 0.16, 0.14, 0.1, 0.05, 0.06, 0.03])
_BAY_M: Final = (2.6, 5.2)
_LINE: Final = 196


def paint_cars(canvas: Canvas) -> None:
    """Paint cars on roads and in car parks; they stand 1.5 m high."""
    streets = street_points(canvas, 7.0, -1.1, STREETS)
    built = _sample(canvas.built, canvas, streets)
    parked = streets[streets[:, 4] < canvas.plan.palette.cars * np.clip(built * 1.6 - 0.06, 0.004, 0.28)]
    moving = street_points(canvas, 31.0, -1.9, STREETS[::-1])
    moving = moving[moving[:, 4] < 0.1 * canvas.plan.palette.cars]
    for cars in (parked, moving, _parked_in_bays(canvas)):
        _paint(canvas, cars)


def _sample(values: Raster, canvas: Canvas, points: Numbers) -> Numbers:
    """Return the values of a raster at points; 0 outside."""
    cells = canvas.grid.to_cells(points[:, :2])
    inside = np.asarray(((cells >= 0) & (cells < canvas.grid.shape)).all(axis=1))
    safe = np.where(inside[:, None], cells, 0)
    return np.where(inside, values[safe[:, 0], safe[:, 1]], 0).astype(np.float64)


def _parked_in_bays(canvas: Canvas) -> Numbers:
    """Draw the lines of bays into car parks; return the cars in them: easting, northing, cos, sin, draw."""
    shapes, plan = canvas.plan.of("parking"), canvas.plan
    centre_m, axis, half_m = rectangles(shapes.geometry)
    fullness = plan.chance("fullness", shapes.key)
    found = [np.zeros((0, 5))]
    for number, area in enumerate(shapes.geometry):
        across = np.arange(-half_m[number, 1] + 3.0, half_m[number, 1] - 2.0, 16.4)
        along_m = np.arange(-half_m[number, 0] + 2.0, half_m[number, 0] - 1.5, _BAY_M[0])
        rows = np.concatenate([across, across + _BAY_M[1]])
        u, v = (part.ravel() for part in np.meshgrid(along_m, rows[np.abs(rows) < half_m[number, 1] - 2.6]))
        at = centre_m[number] + u[:, None] * axis[number] + v[:, None] * (axis[number][::-1] * (-1, 1))
        inside = shapely.contains_xy(shapely.buffer(area, -2.2), at[:, 0], at[:, 1]) & (
            _sample(canvas.kind, canvas, at) == ROAD
        )
        at = at[inside]
        heading = np.tile(axis[number][::-1] * (-1, 1), (len(at), 1))
        side = at - (_BAY_M[0] / 2) * axis[number]
        lines = np.column_stack([side, heading, np.full(len(at), _BAY_M[1] / 2 - 0.2), np.full(len(at), 0.06)])
        if draw(5, shapes.key[number : number + 1])[0] < plan.palette.markings:
            fill_boxes(canvas.colour, lines, canvas.grid, np.full((len(at), 3), _LINE))
        luck = draw(int(shapes.key[number]) & 0xFFFFFFFF, np.arange(len(at)))
        cars = np.column_stack([at, heading, luck])
        found.append(cars[luck < 0.15 + 0.7 * fullness[number]])
    return np.concatenate(found)


def _paint(canvas: Canvas, cars: Numbers) -> None:
    """Paint bodies, windows and roofs; a car that would stand off the road is left out."""
    cars = cars[_sample(canvas.kind, canvas, cars) == ROAD]
    if not len(cars):
        return
    key = (cars[:, 4] * 2**40).astype(np.int64)
    paint = _PAINTS[np.searchsorted(_WEIGHTS / _WEIGHTS[-1], draw(1, key)).clip(0, len(_PAINTS) - 1)]
    is_van = draw(2, key) < 0.12
    long_m, wide_m = np.where(is_van, 2.8, 2.05 + 0.3 * draw(3, key)), np.where(is_van, 1.0, 0.88)
    side = np.stack([-cars[:, 3], cars[:, 2]], axis=1)
    at = cars[:, :2] + 0.3 * (draw(4, key) - 0.5)[:, None] * side
    body = np.column_stack([at, cars[:, 2:4], long_m, wide_m])
    fill_boxes(canvas.height_m, body, canvas.grid, np.where(is_van, 2.1, 1.25))
    fill_boxes(canvas.colour, body, canvas.grid, paint)
    fill_boxes(canvas.kind, body, canvas.grid, np.full(len(cars), CAR))
    glass = np.column_stack([at - 0.15 * cars[:, 2:4], cars[:, 2:4], long_m * 0.62, wide_m * 0.8])
    fill_boxes(canvas.colour, glass, canvas.grid, np.where(is_van[:, None], paint, np.array([46, 52, 58])))
    top = np.column_stack([at - 0.2 * cars[:, 2:4], cars[:, 2:4], long_m * 0.36, wide_m * 0.76])
    fill_boxes(canvas.colour, top, canvas.grid, np.clip(paint * 1.04, 0, 255))
    fill_boxes(canvas.height_m, top, canvas.grid, np.where(is_van, 2.1, 1.5))
