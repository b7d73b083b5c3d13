# SPDX-License-Identifier: Apache-2.0
"""Paint roads, paths, railways, bridges, car parks, fences and walls, and place the street lamps."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sensing.rendering.buildings import rectangles
from sasgeo_bench.sensing.rendering.plan import (
    CAR,
    ROAD,
    WALL,
    WATER,
    Canvas,
    Cells,
    Mask,
    Picture,
    Raster,
    Shapes,
    along,
    blurred,
    burn_numbers,
    fill_boxes,
    inside_m,
)
from sasgeo_bench.sensing.rendering.texture import Field, Numbers, bell, draw, fractal, grain, noise

# The larger ones last, which are painted over the smaller ones.
STREETS: Final = tuple(name for name in load_taxonomy().painted if name in load_taxonomy().having("street"))
_WHITE: Final = (206, 204, 198)
_BALLAST: Final = (122, 112, 102)
_LAMP_SPACING_M: Final = 34.0


def paint_roads(canvas: Canvas) -> None:
    """Paint everything that is driven or walked on, lowest level first."""
    surfaces: _Surfaces = {}
    _paint_parking(canvas, surfaces)
    _paint_tracks(canvas, surfaces)
    for level_is_low in (True, False):
        for name in STREETS:
            shapes = canvas.plan.of(name)
            own = shapes.part((shapes.level <= 0) == level_is_low)
            _paint_streets(canvas, own, surfaces, is_major=name == "road_major")
        if level_is_low:
            _paint_rails(canvas)
    _paint_parapets(canvas)
    canvas.lamps = _lamps(canvas)


def _soft(mask: Mask, canvas: Canvas, ragged: float, purpose: str) -> Field:
    """Return how much of each cell a surface covers; `ragged` breaks its edge up, metres."""
    soft = blurred(mask.astype(np.float32), max(0.3, 0.4 * ragged), canvas.grid)
    for strip, grid in canvas.strips():
        is_edge = (soft[strip] > 0.02) & (soft[strip] < 0.98)
        broken = soft[strip] + 0.5 * ragged * is_edge * noise(grid, 1.3, canvas.plan.seed(purpose))
        soft[strip] = np.clip((broken - 0.5) * 3 + 0.5, 0, 1)
    return soft


def _paint_streets(canvas: Canvas, shapes: Shapes, surfaces: "_Surfaces", *, is_major: bool) -> None:
    """Paint carriageways: asphalt or earth for each road, patches, wheel tracks, verges and markings."""
    if not len(shapes):
        return
    grid, plan, palette = canvas.grid, canvas.plan, canvas.plan.palette
    is_paved = (plan.chance("paved", shapes.key) < palette.paved_share) | is_major | shapes.is_bridge
    numbers = burn_numbers(shapes.areas(), grid)
    mask = numbers > 0
    # Paint pavements in built-up quarters and worn strips elsewhere
    beside = (burn_numbers(shapes.areas(2.2), canvas.grid) > 0) & ~mask & (canvas.kind != WATER)
    is_town = canvas.built > 0.13 / max(canvas.plan.palette.paved_share, 0.1)
    canvas.tint(beside & is_town, canvas.plan.palette.paving, 0.8)
    worn = np.clip(0.35 + 0.6 * noise(canvas.grid, 3.0, canvas.plan.seed("verge")), 0, 0.8)
    canvas.tint(beside & ~is_town, canvas.plan.palette.soil[1], np.asarray(worn, dtype=np.float32))
    tone = 1 + 0.1 * bell(plan.seed("asphalt"), shapes.key)
    paved = np.array(palette.asphalt) * tone[:, None]
    is_light = plan.chance("concrete", shapes.key) < 0.15
    paved = np.where(is_light[:, None], 0.5 * paved + 0.5 * np.array(palette.paving), paved)
    colour = np.where(is_paved[:, None], paved, np.array(palette.track) * tone[:, None])
    colour = np.vstack([colour[:1], colour])
    cover = _soft(mask, canvas, 0.35 if is_major else 0.3 + 0.5 * (1 - palette.paved_share), "edges")
    _tint_each(canvas, numbers, colour, cover)
    canvas.kind[mask] = ROAD
    _wear(canvas, mask, np.concatenate([[True], is_paved])[numbers], surfaces)
    # 5.8 m: narrower roads have no line in the middle
    lined = is_paved & (shapes.width_m >= 5.8) & (plan.chance("lines", shapes.key) < palette.markings)
    _paint_markings(canvas, shapes.part(lined))


def _tint_each(canvas: Canvas, numbers: Cells, colours: Numbers, cover: Field) -> None:
    grown = cv2.dilate(numbers.astype(np.uint16), np.ones((5, 5), np.uint8))
    for (strip, _), part in zip(canvas.strips(), canvas.parts(), strict=True):
        reach = cover[strip] > 0.02
        number = np.where(numbers[strip] > 0, numbers[strip], grown[strip])[reach]
        part.tint(reach, colours[number], cover[strip])


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """How uneven a strip of ground is, where a road runs over it: the same for all roads."""

    stains: Field
    is_patch: Mask
    is_crack: Mask
    grassy: Field

    @classmethod
    def of(cls, canvas: Canvas) -> "_Surface":
        grid, seed = canvas.grid, canvas.plan.seed("wear")
        return cls(
            stains=0.06 * fractal(grid, 9.0, seed)
            + 0.045 * grain(grid, 1 + canvas.plan.salt)
            + 0.045 * noise(grid, 1.0, seed + 4),
            is_patch=noise(grid, 5.0, seed + 5) > 0.72,
            is_crack=np.abs(noise(grid, 6.0, seed + 6)) < 0.018,
            grassy=np.clip(0.5 + noise(grid, 4.0, seed + 7), 0, 1),
        )


_Surfaces = dict[int, _Surface]  # by the first row of the strip
_KEPT_CELLS: Final = 4_000_000  # of a canvas whose surfaces are kept, ten bytes each


def _wear(canvas: Canvas, mask: Mask, is_paved: Mask, surfaces: _Surfaces) -> None:
    """Make a road uneven: long stains, repaired patches, cracks, wheel tracks, grass in the middle of earth roads."""
    edge_m = inside_m(mask, canvas.grid)
    for (strip, _), part in zip(canvas.strips(), canvas.parts(), strict=True):
        if mask[strip].any():
            surface = surfaces.get(strip.start) or _Surface.of(part)
            if mask.size <= _KEPT_CELLS:
                surfaces[strip.start] = surface
            _wear_part(part, mask[strip] & is_paved[strip], edge_m[strip], surface)
            _wear_earth(part, mask[strip] & ~is_paved[strip], edge_m[strip], surface)


def _wear_part(canvas: Canvas, paved: Mask, edge_m: Field, surface: _Surface) -> None:
    rough, patches = canvas.plan.palette.unevenness, np.where(surface.is_patch[paved], -0.09, 0.0)
    cracks = np.where(surface.is_crack[paved], -0.12, 0.0)
    uneven = 1 + rough * (surface.stains[paved] + patches + cracks)
    canvas.shade(paved, np.asarray(uneven + _wheels(edge_m[paved]), dtype=np.float32))


def _wear_earth(canvas: Canvas, earth: Mask, edge_m: Field, surface: _Surface) -> None:
    stains, wheels = canvas.plan.palette.unevenness * 1.6 * surface.stains[earth], _wheels(edge_m[earth])
    canvas.shade(earth, np.asarray(1 + stains + 1.5 * wheels, dtype=np.float32))
    middle = np.clip((edge_m - 1.1) * 2, 0, 1) * surface.grassy * 0.5
    canvas.tint(earth & (middle > 0.02), canvas.plan.palette.grass[1], np.asarray(middle, dtype=np.float32))


def _wheels(edge_m: Field) -> Field:
    return np.asarray(0.035 * np.cos(2 * np.pi * edge_m / 1.75))


def _paint_markings(canvas: Canvas, shapes: Shapes) -> None:
    """Paint dashed lines in the middle and lines along the edges of wide roads, worn in places."""
    drawn = np.zeros(canvas.grid.shape, dtype=np.uint8)
    for line, width_m in zip(shapes.geometry, shapes.width_m, strict=True):
        dashes = along(line, 9.0, 2.0)
        fill_boxes(drawn, _boxes(dashes, 1.6, 0.075), canvas.grid, np.full(len(dashes), 210))
        if width_m >= 7.5:
            middle = along(line, 2.0)
            for side in (-1, 1):
                edge = middle.copy()
                edge[:, :2] += side * (width_m / 2 - 0.35) * np.stack([-edge[:, 3], edge[:, 2]], axis=1)
                fill_boxes(drawn, _boxes(edge, 1.05, 0.06), canvas.grid, np.full(len(edge), 190))
    worn = np.clip(0.85 + 0.6 * noise(canvas.grid, 5.0, canvas.plan.seed("paint")), 0.15, 1)
    share = np.asarray(cv2.GaussianBlur(drawn, (0, 0), 0.6) * worn / 255, dtype=np.float32)
    canvas.tint(share > 0.02, _WHITE, share)


def _boxes(at: Numbers, half_long_m: float, half_wide_m: float) -> Numbers:
    """Return rectangles for `fill_boxes` at points with directions."""
    return np.column_stack([at, np.full(len(at), half_long_m), np.full(len(at), half_wide_m)])


def _paint_tracks(canvas: Canvas, surfaces: "_Surfaces") -> None:
    """Paint paths and tracks: earth, gravel or paving by feature, ragged, with grass between the wheels of tracks."""
    shapes, plan = canvas.plan.of("path_track"), canvas.plan
    if not len(shapes):
        return
    numbers = burn_numbers(shapes.areas(), canvas.grid)
    cover = _soft(numbers > 0, canvas, 0.7, "path edges")
    is_paved = plan.chance("path", shapes.key) < 0.55 * plan.palette.paved_share
    colour = np.where(is_paved[:, None], np.array(plan.palette.paving) * 0.92, np.array(plan.palette.track))
    colour = np.vstack([colour[:1], colour * (1 + 0.08 * bell(plan.seed("tone"), shapes.key))[:, None]])
    faint = np.clip(0.8 + 0.35 * noise(canvas.grid, 14.0, plan.seed("faint")), 0.35, 1)
    _tint_each(canvas, numbers, colour, np.asarray(cover * faint, dtype=np.float32))
    _wear(canvas, numbers > 0, np.zeros(canvas.grid.shape, dtype=bool), surfaces)
    canvas.kind[numbers > 0] = ROAD


def _paint_rails(canvas: Canvas) -> None:
    shapes = canvas.plan.of("railway")
    if not len(shapes):
        return
    bed = burn_numbers(shapes.areas(), canvas.grid) > 0
    stones = 0.06 * grain(canvas.grid, 1 + canvas.plan.salt) + 0.08 * noise(
        canvas.grid, 3.0, canvas.plan.seed("ballast")
    )
    canvas.tint(bed, _BALLAST, _soft(bed, canvas, 0.5, "ballast"))
    canvas.shade(bed, np.asarray(1 + stones, dtype=np.float32)[bed])
    canvas.kind[bed] = ROAD
    for line in shapes.geometry:
        sleepers = along(line, 0.65)
        fill_boxes(canvas.colour, _boxes(sleepers, 0.12, 1.25), canvas.grid, np.full((len(sleepers), 3), 96))
        for side in (-0.75, 0.75):
            rail = along(line, 1.0)
            rail[:, :2] += side * np.stack([-rail[:, 3], rail[:, 2]], axis=1)
            fill_boxes(canvas.colour, _boxes(rail, 0.55, 0.05), canvas.grid, np.tile([150, 146, 142], (len(rail), 1)))


def _paint_parking(canvas: Canvas, surfaces: "_Surfaces") -> None:
    """Paint car parks: one surface each, oil and seams; the bays are drawn with the cars."""
    shapes, plan = canvas.plan.of("parking"), canvas.plan
    if not len(shapes):
        return
    numbers = burn_numbers(shapes.areas(), canvas.grid)
    mask = numbers > 0
    is_paved = plan.chance("paved", shapes.key) < max(plan.palette.paved_share, 0.3)
    tone = (1 + 0.12 * bell(plan.seed("asphalt"), shapes.key))[:, None]
    colour = np.where(is_paved[:, None], np.array(plan.palette.asphalt) * tone, np.array(plan.palette.soil[1]) * tone)
    canvas.tint(mask, np.vstack([colour[:1], colour])[numbers[mask]], 0.95)
    _wear(canvas, mask, np.concatenate([[True], is_paved])[numbers], surfaces)
    canvas.kind[mask] = ROAD


def _paint_parapets(canvas: Canvas) -> None:
    """Raise parapets along bridges; the deck itself lies on the ground plane."""
    for name in load_taxonomy().of_graph("road"):
        shapes = canvas.plan.of(name)
        for line, width_m in zip(shapes.geometry[shapes.is_bridge], shapes.width_m[shapes.is_bridge], strict=True):
            for side in (-1, 1):
                at = along(line, 1.0, 0.5)
                at[:, :2] += (
                    side * (np.nan_to_num(width_m, nan=5.0) / 2 + 0.2) * np.stack([-at[:, 3], at[:, 2]], axis=1)
                )
                _raise(canvas, _boxes(at, 0.55, 0.17), 1.0, (176, 172, 166))


def _raise(canvas: Canvas, boxes: Numbers, height_m: float, colour: tuple[int, int, int]) -> None:
    fill_boxes(canvas.colour, boxes, canvas.grid, np.tile(colour, (len(boxes), 1)))
    fill_boxes(canvas.height_m, boxes, canvas.grid, np.full(len(boxes), height_m))
    fill_boxes(canvas.kind, boxes, canvas.grid, np.full(len(boxes), WALL))


def paint_barriers(canvas: Canvas, edge: Mask, yard: Cells) -> None:
    """Raise fences and walls along mapped boundaries and, for some houses, around their yards."""
    boundary, plan = canvas.plan.of("field_boundary"), canvas.plan
    thin = boundary.part(boundary.width_m < 1.0)
    for line, key, width_m in zip(thin.geometry, thin.key, thin.width_m, strict=True):
        luck = float(draw(plan.seed("fence"), np.array([key]))[0])
        colour = (158, 150, 138) if luck < 0.5 else (112, 98, 82)
        _raise(canvas, _boxes(along(line, 1.0, 0.5), 0.55, max(width_m / 2, 0.14)), 0.8 + luck, colour)
    fenced = draw(plan.seed("fenced"), np.concatenate([[0], plan.of("building").key]))
    walls = edge & (fenced[yard] < 0.16) & (yard > 0) & (canvas.kind == 0)
    canvas.colour[walls] = np.clip(np.array(plan.palette.paving) * 0.95, 0, 255)
    canvas.height_m[walls] = 1.3
    canvas.kind[walls] = WALL


def _lamps(canvas: Canvas) -> Picture:
    """Return the light of lamps along roads in built-up quarters: 210 below a lamp, nothing 25 m away."""
    lit = np.zeros(canvas.grid.shape, dtype=np.float32)
    for name in STREETS:
        for line in canvas.plan.of(name).geometry:
            if shapely.is_empty(line):
                continue
            cells = canvas.grid.to_cells(along(line, _LAMP_SPACING_M, 10.0)[:, :2])
            cells = cells[((cells >= 0) & (cells < canvas.grid.shape)).all(axis=1)]
            lit[cells[:, 0], cells[:, 1]] = canvas.built[cells[:, 0], cells[:, 1]] > 0.05
    sigma_m = 6.0
    spread = blurred(lit, sigma_m, canvas.grid) * np.float32(2 * np.pi * (sigma_m / canvas.grid.cell_size_m) ** 2)
    return np.asarray(np.minimum(spread, 1.2) * 210, dtype=np.uint8)


def street_points(canvas: Canvas, spacing_m: float, beside_m: float, names: tuple[str, ...]) -> NDArray[np.float64]:
    """Return points along both sides of streets: easting, northing, cos, sin, draw; shape (N, 5)."""
    found, seed = [np.zeros((0, 5))], canvas.plan.seed(f"street{spacing_m}")
    for name in names:
        shapes = canvas.plan.of(name)
        lines = zip(shapes.geometry, shapes.width_m, shapes.key, strict=True)
        for line, width_m, key in lines:
            if not np.isfinite(width_m):
                continue
            middle = along(line, spacing_m, spacing_m / 2)
            for side in (-1, 1):
                at = middle.copy()
                at[:, :2] += side * (width_m / 2 + beside_m) * np.stack([-at[:, 3], at[:, 2]], axis=1)
                luck = draw(seed, np.full(len(at), key), np.arange(len(at)) * side)
                found.append(np.column_stack([at, luck]))
    return np.concatenate(found)


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
