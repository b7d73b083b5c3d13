# SPDX-License-Identifier: Apache-2.0
"""Buildings as blocks with a roof: heights, forms and materials estimated from outline and surroundings.

Features keep no tags beyond their class, so `building:levels` and `height` are not at hand: storeys follow from the
area of the outline and from how densely the ground around is built, with a spread drawn for each building.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.sensing.rendering.palettes import Cover, Palette, Roofing
from sasgeo_bench.sensing.rendering.plan import ROOF, Canvas, Mask, Plan, Shapes, burn_numbers, inside_m
from sasgeo_bench.sensing.rendering.texture import Field, Numbers, bell, draw, fractal, grain, noise, seed_of

FLAT, GABLE, HIP = range(3)
COVERS: Final[tuple[Cover, ...]] = ("tiles", "slates", "sheets", "membrane", "gravel", "thatch")

_BLOCK_M: Final = 60.0  # cells in which built ground is summed, three by three
_MOST_RISE_M: Final = 7.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Buildings:
    """Arrays of N buildings: the rectangle around each (centre, axis along its ridge, half sides), heights, materials.

    `eave_m` is the height of the walls; a roof rises by `pitch` from there. `cover` counts in `COVERS`.
    """

    shapes: Shapes
    centre_m: Numbers
    axis: Numbers
    half_m: Numbers
    eave_m: Numbers
    pitch: Numbers
    form: NDArray[np.uint8]
    cover: NDArray[np.uint8]
    roof: Numbers
    wall: Numbers
    rust: Numbers

    def __len__(self) -> int:
        return len(self.eave_m)


def style_buildings(plan: Plan, relief: float) -> Buildings:
    """Return the buildings of a plan; `relief` multiplies all heights (0 lays every building flat on the ground)."""
    shapes = plan.of("building")
    centre_m, axis, half_m = rectangles(shapes.geometry)
    area_m2 = shapely.area(shapes.geometry)
    key = shapes.key
    storeys = estimate_storeys(area_m2, crowding(shapes.geometry), seed=plan.seed("storeys"), key=key)
    fill = area_m2 / np.maximum(4 * half_m.prod(axis=1), 1e-6)
    # Flat, gabled or hipped: what is large, high or small is flat, what is no rectangle is hipped
    is_large = np.clip((np.log(np.maximum(area_m2, 1)) - np.log(350)) / np.log(4), 0, 1) * 0.85
    flat = np.maximum(plan.palette.flat_share, np.where(storeys > 6, 1.0, is_large))
    is_flat = (plan.chance("flat", key) < flat) | ((area_m2 < 30) & (plan.chance("shed", key) < 0.5))
    is_gable = (fill > 0.86) & (plan.chance("gable", key) < 0.78)
    form = np.where(is_flat, FLAT, np.where(is_gable, GABLE, HIP)).astype(np.uint8)
    low, high = plan.palette.roof_pitch
    pitch = np.where(form == FLAT, 0.0, low + (high - low) * plan.chance("pitch", key))
    pitch = np.minimum(pitch, _MOST_RISE_M / np.maximum(half_m[:, 1], 1e-6))
    roof, cover, rust = _materials(plan, key, form == FLAT)
    walls = np.array(plan.palette.walls)
    wall = (
        walls[(plan.chance("wall", key) * len(walls)).astype(int)] * (1 + 0.1 * bell(plan.seed("paint"), key))[:, None]
    )
    eave_m = plan.palette.storey_m * storeys * (1 + 0.06 * bell(plan.seed("eave"), key)) + 0.3
    return Buildings(
        shapes=shapes,
        centre_m=centre_m,
        axis=axis,
        half_m=half_m,
        eave_m=eave_m * relief,
        pitch=pitch * relief,
        form=form,
        cover=cover,
        roof=roof,
        wall=wall,
        rust=rust,
    )


def rectangles(outlines: NDArray[np.object_]) -> tuple[Numbers, Numbers, Numbers]:
    """Return centre (N, 2), direction of the long side (N, 2) and half sides (N, 2) of the rectangle around each."""
    if not len(outlines):
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2))
    boxes = shapely.oriented_envelope(outlines)
    corners = np.stack([shapely.get_coordinates(box)[:4] for box in boxes])
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]
    lengths = np.stack([np.hypot(*first.T), np.hypot(*second.T)], axis=1)
    is_first = lengths[:, 0] >= lengths[:, 1]
    axis = np.where(is_first[:, None], first, second) / np.maximum(lengths.max(axis=1), 1e-6)[:, None]
    half_m = np.stack([lengths.max(axis=1), lengths.min(axis=1)], axis=1) / 2
    return corners.mean(axis=1), axis, half_m


def crowding(outlines: NDArray[np.object_]) -> Numbers:
    """Return the share of built ground within about 90 m of each outline, shape (N,)."""
    if not len(outlines):
        return np.zeros(0)
    blocks = np.floor(shapely.get_coordinates(shapely.centroid(outlines)) / _BLOCK_M).astype(int)
    blocks -= blocks.min(axis=0) - 1
    built_m2 = np.zeros(blocks.max(axis=0) + 2)
    np.add.at(built_m2, tuple(blocks.T), shapely.area(outlines))
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    around = np.sum([built_m2[blocks[:, 0] + i, blocks[:, 1] + j] for i, j in steps], axis=0)
    return np.asarray(around / (9 * _BLOCK_M**2))


def estimate_storeys(area_m2: Numbers, crowded: Numbers, *, seed: int, key: NDArray[np.int64]) -> Numbers:
    """Return a likely number of storeys, at least 0.8, for buildings of an area on ground built to a share.

    Sheds have one storey, houses one or two, blocks in dense quarters three to seven, halls one or two high ones;
    one in 25 of the middling buildings of a dense quarter is a tower.

    >>> area_m2, crowded = np.array([12.0, 120.0, 600.0]), np.array([0.1, 0.1, 0.4])
    >>> estimate_storeys(area_m2, crowded, seed=1, key=np.arange(3)).round(1).tolist()
    [0.8, 2.2, 4.5]
    """
    dense = np.clip((crowded - 0.12) / 0.25, 0.0, 1.0)
    house = np.clip(0.9 + (area_m2 - 30) / 90, 0.8, 2.2) + 1.2 * dense * (area_m2 > 60)
    block = 2.2 + 3.4 * dense
    hall = 2.0 + 1.8 * dense
    size = np.clip((np.log(np.maximum(area_m2, 1.0)) - np.log(250)) / np.log(2), 0.0, 1.0)
    large = np.clip((np.log(np.maximum(area_m2, 1.0)) - np.log(1200)) / np.log(2), 0.0, 1.0)
    middle = (1 - size) * house + size * block
    storeys = ((1 - large) * middle + large * hall) * (1 + 0.18 * bell(seed, key))
    is_tower = (area_m2 > 250) & (area_m2 < 1600) & (dense > 0.25) & (draw(seed + 1, key) < 0.04)
    storeys = np.where(is_tower, 8 + 9 * draw(seed + 2, key), storeys)
    return np.where(area_m2 < 30, 0.8, np.maximum(storeys, 0.9))


def _materials(plan: Plan, key: NDArray[np.int64], is_flat: Mask) -> tuple[Numbers, NDArray[np.uint8], Numbers]:
    """Return colour (N, 3), cover (N,) and share of rust (N,) of each roof; each place prefers some of the kinds."""
    colour, cover, rust = np.zeros((len(key), 3)), np.zeros(len(key), dtype=np.uint8), np.zeros(len(key))
    for chosen, roofings in ((~is_flat, plan.palette.pitched), (is_flat, plan.palette.flat)):
        edges = np.cumsum(_preferred(plan.palette, plan.place, roofings))
        pick = np.searchsorted(edges / edges[-1], plan.chance("roof", key), side="right").clip(0, len(roofings) - 1)
        for number, roofing in enumerate(roofings):
            mine = np.flatnonzero(chosen & (pick == number))
            tone = 1 + roofing.spread * bell(plan.seed("tone"), key[mine])
            hue = 0.016 * np.stack([bell(plan.seed(f"hue{band}"), key[mine]) for band in range(3)], axis=1)
            colour[mine] = np.array(roofing.colour) * (tone[:, None] + hue)
            cover[mine] = COVERS.index(roofing.cover)
            rust[mine] = roofing.rust * plan.chance("rust", key[mine])
    return np.clip(colour, 12, 250), cover, rust


def _preferred(palette: Palette, place: str, roofings: tuple[Roofing, ...]) -> Numbers:
    """Return the weights of kinds of roof at a place: some villages are red, some grey."""
    taste = draw(seed_of(palette.family, place, "taste"), np.arange(len(roofings)))
    return np.array([roofing.weight for roofing in roofings]) * (0.25 + 1.75 * taste)


_RUST: Final = np.array([128.0, 74.0, 50.0])
_MOSS: Final = np.array([86.0, 88.0, 62.0])
_PANEL: Final = np.array([34.0, 42.0, 64.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cells:
    """The N cells under roofs: where they are, whose they are, and where they lie on the building.

    `u_m` runs along the ridge and `v_m` across, from the middle; `edge_m` is the distance to the outline.
    """

    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    owner: NDArray[np.int64]
    key: NDArray[np.int64]
    u_m: Numbers
    v_m: Numbers
    edge_m: Numbers


def paint_buildings(canvas: Canvas, buildings: Buildings) -> None:
    """Paint all buildings on a canvas and set their heights."""
    numbers = burn_numbers(buildings.shapes.geometry, canvas.grid)
    if not numbers.any():
        return
    canvas.owner[...] = numbers
    inner = numbers > 0
    for axis in (0, 1):  # the line between two houses of a row is an edge of both
        inner &= (numbers == np.roll(numbers, 1, axis=axis)) | (numbers == 0)
    edge_m = inside_m(inner, canvas.grid)
    for (strip, _), part in zip(canvas.strips(), canvas.parts(), strict=True):
        _paint_part(part, buildings, edge_m[strip])


def _paint_part(canvas: Canvas, buildings: Buildings, edge_m: Field) -> None:
    """Paint the roofs of one strip; `edge_m` is the distance of each cell to the outline of its building."""
    rows, cols = np.nonzero(canvas.owner)
    if not len(rows):
        return
    cells = _cells(canvas, buildings, edge_m, rows, cols)
    canvas.kind[rows, cols] = ROOF
    colour = buildings.roof[cells.owner]
    height_m = _heights(buildings, cells)
    colour *= _weather(canvas, buildings, cells)[:, None]
    colour = _aged(canvas, buildings, cells, colour)
    _add_panels(canvas, buildings, cells, colour)
    height_m += _add_plant(buildings, cells, colour)
    height_m += _add_chimneys(canvas, buildings, cells, colour)
    canvas.colour[rows, cols] = np.clip(colour, 0, 255).astype(np.uint8)
    canvas.height_m[rows, cols] = height_m


def _luck(buildings: Buildings, cells: _Cells, seed: int) -> Numbers:
    """Return for each cell what is drawn once for its building."""
    return draw(seed, buildings.shapes.key)[cells.owner]


def _heights(buildings: Buildings, cells: _Cells) -> Numbers:
    """Return the height of each roof cell: a gable falls from its ridge, a hip rises from its outline."""
    own, form = cells.owner, buildings.form[cells.owner]
    half = buildings.half_m[own, 1]
    inward = np.where(form == HIP, np.minimum(cells.edge_m, half), np.clip(half - np.abs(cells.v_m), 0, None))
    height_m = buildings.eave_m[own] + buildings.pitch[own] * inward
    parapet = (form == FLAT) & (cells.edge_m < 0.45) & (buildings.half_m[own, 1] > 3)
    has = _luck(buildings, cells, 17) < 0.75
    return np.asarray(height_m + np.where(parapet & has, 0.12 * np.minimum(buildings.eave_m[own], 5.0), 0.0))


def _cells(
    canvas: Canvas, buildings: Buildings, edge_m: Field, rows: NDArray[np.int64], cols: NDArray[np.int64]
) -> _Cells:
    owner = canvas.owner[rows, cols].astype(np.int64) - 1
    at = canvas.grid.to_centres_m(np.stack([rows, cols], axis=1)) - buildings.centre_m[owner]
    axis_u = buildings.axis[owner]
    return _Cells(
        rows=rows,
        cols=cols,
        owner=owner,
        key=buildings.shapes.key[owner],
        u_m=at[:, 0] * axis_u[:, 0] + at[:, 1] * axis_u[:, 1],
        v_m=at[:, 1] * axis_u[:, 0] - at[:, 0] * axis_u[:, 1],
        edge_m=edge_m[rows, cols].astype(np.float64),
    )


def _weather(canvas: Canvas, buildings: Buildings, cells: _Cells) -> Numbers:
    """Return the brightness of each cell: courses or sheets, stains by patches, darker gutters, brighter ridges."""
    rough = canvas.plan.palette.unevenness
    cover = buildings.cover[cells.owner]
    at = (cells.rows, cells.cols)
    patches = fractal(canvas.grid, 5.0, canvas.plan.seed("stains"))[at]
    fine = noise(canvas.grid, 0.9, canvas.plan.seed("fine"))[at]
    # Sheets of metal lie in strips down the slope, each with its own age; tiles in courses along it.
    strip = bell(3, cells.key, np.floor(cells.u_m / 1.05).astype(np.int64), np.floor(cells.v_m / 3.2).astype(np.int64))
    course = bell(5, cells.key, np.floor(cells.v_m / 0.6).astype(np.int64))
    lumps = bell(6, np.floor(cells.u_m / 0.7).astype(np.int64), np.floor(cells.v_m / 0.7).astype(np.int64), cells.key)
    is_sheet = cover == COVERS.index("sheets")
    is_tile = (cover == COVERS.index("tiles")) | (cover == COVERS.index("slates"))
    pattern = np.where(is_sheet, 0.045 * strip, np.where(is_tile, 0.03 * course + 0.03 * lumps, 0.025 * lumps))
    stained = (
        (0.08 + 0.1 * _luck(buildings, cells, 29)) * patches
        + 0.05 * fine
        + 0.045 * grain(canvas.grid, 1 + canvas.plan.salt)[at]
    )
    edge = np.where(cells.edge_m < 0.4, np.where(buildings.form[cells.owner] == FLAT, 0.1, -0.12), 0.0)
    return np.asarray(1 + rough * (pattern + stained) + edge)


def _aged(canvas: Canvas, buildings: Buildings, cells: _Cells, colour: Numbers) -> Numbers:
    """Mix rust into sheets, one by one and in streaks, and moss into tiles."""
    cover, at = buildings.cover[cells.owner], (cells.rows, cells.cols)
    streaks = fractal(canvas.grid, 3.0, canvas.plan.seed("rust"))[at]
    rust = buildings.rust[cells.owner]
    whole = draw(9, cells.key, np.floor(cells.u_m / 2.1).astype(np.int64), (cells.v_m > 0).astype(np.int64))
    share = np.where(whole < rust * 0.7, 0.75 + 0.25 * streaks, np.clip(streaks * 1.6 + 2.2 * rust - 1.5, 0, 0.8))
    share = np.where(cover == COVERS.index("sheets"), np.clip(share, 0, 1) * (rust > 0), 0.0)
    colour = colour + share[:, None] * (_RUST - colour)
    moss = np.where(
        cover == COVERS.index("tiles"), np.clip(streaks + 0.8 * _luck(buildings, cells, 31) - 0.5, 0, 0.45), 0.0
    )
    return np.asarray(colour + moss[:, None] * (_MOSS - colour))


def _add_panels(canvas: Canvas, buildings: Buildings, cells: _Cells, colour: Numbers) -> None:
    """Lay solar panels and roof windows on one side of some roofs."""
    half = buildings.half_m[cells.owner]
    has = (_luck(buildings, cells, 41) < 0.14 / canvas.plan.palette.unevenness) & (cells.edge_m > 0.9)
    start = -half[:, 0] * (0.2 + 0.6 * _luck(buildings, cells, 43))
    end = start + half[:, 0] * (0.5 + _luck(buildings, cells, 47))
    inside = (cells.u_m > start) & (cells.u_m < end) & (cells.v_m > 0.12 * half[:, 1]) & (cells.v_m < 0.72 * half[:, 1])
    seam = (np.mod(cells.u_m, 1.05) < 0.22) | (np.mod(cells.v_m, 1.7) < 0.2)
    colour[has & inside] = _PANEL
    colour[has & inside & seam] = _PANEL * 1.7
    is_window = (_luck(buildings, cells, 53) < 0.4) & (cells.edge_m > 1)
    is_window &= (np.mod(cells.u_m, 3.1) < 0.9) & (np.mod(cells.v_m, 2.6) < 1.2) & ~(has & inside)
    lots = (
        np.floor(part[is_window] / size_m).astype(np.int64) for part, size_m in ((cells.u_m, 3.1), (cells.v_m, 2.6))
    )
    is_window[is_window] = draw(59, cells.key[is_window], *lots) < 0.22
    colour[is_window] = (62, 70, 80)


def _lots(cells: _Cells, size_m: float, seed: int, among: Mask) -> tuple[Mask, Numbers]:
    """Return which cells lie in the middle of their lot, and the luck of this; of all but some cells, none and 0."""
    u_m, v_m, key = cells.u_m[among], cells.v_m[among], cells.key[among]
    lots = np.floor(u_m / size_m).astype(np.int64), np.floor(v_m / size_m).astype(np.int64)
    middle = [0.5 + 0.35 * (draw(seed + part, key, *lots) - 0.5) for part in (1, 2)]
    half = [0.1 + 0.2 * draw(seed + part, key, *lots) for part in (3, 4)]
    off_u = np.abs(np.mod(u_m / size_m, 1) - middle[0])
    off_v = np.abs(np.mod(v_m / size_m, 1) - middle[1])
    inside, luck = np.zeros(len(among), dtype=bool), np.zeros(len(among))
    inside[among], luck[among] = (off_u < half[0]) & (off_v < half[1]), draw(seed, key, *lots)
    return inside, luck


def _add_plant(buildings: Buildings, cells: _Cells, colour: Numbers) -> Numbers:
    """Put machines, skylights and stairheads on flat roofs; return how much higher each cell becomes."""
    is_flat = (buildings.form[cells.owner] == FLAT) & (cells.edge_m > 1.2) & (buildings.half_m[cells.owner, 1] > 3.5)
    inside, luck = _lots(cells, 6.5, 71, is_flat)
    chosen = inside & (luck < 0.35 * _luck(buildings, cells, 73))
    tone = 95 + 140 * draw(79, cells.key[chosen], np.floor(cells.u_m[chosen] / 6.5).astype(np.int64))
    colour[chosen] = tone[:, None]
    stairs, luck = _lots(cells, 13.0, 83, is_flat)
    stairs &= (luck < 0.3) & (buildings.eave_m[cells.owner] > 5)
    colour[stairs] = buildings.wall[cells.owner[stairs]] * 0.95
    stands = np.minimum(buildings.eave_m[cells.owner], 3.0) / 3.0
    return np.asarray(np.where(stairs, 2.4, np.where(chosen, 0.4 + luck * 2.5, 0.0)) * stands)


def _add_chimneys(canvas: Canvas, buildings: Buildings, cells: _Cells, colour: Numbers) -> Numbers:
    """Put a chimney beside the ridge of most pitched roofs; return how much higher each cell becomes."""
    half = buildings.half_m[cells.owner]
    at_u, at_v = (
        half[:, 0] * (1.2 * _luck(buildings, cells, 89) - 0.6),
        half[:, 1] * (0.5 * _luck(buildings, cells, 97) - 0.25),
    )
    has = (_luck(buildings, cells, 101) < 0.8 / canvas.plan.palette.unevenness**2) & (
        buildings.form[cells.owner] != FLAT
    )
    has &= (half[:, 1] > 2.5) & (np.abs(cells.u_m - at_u) < 0.4) & (np.abs(cells.v_m - at_v) < 0.35)
    colour[has] = buildings.wall[cells.owner[has]] * 0.7
    return np.where(has & (buildings.eave_m[cells.owner] > 0.5), 1.1, 0.0)
