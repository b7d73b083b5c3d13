# SPDX-License-Identifier: Apache-2.0
"""Paint open ground: country between the mapped things, yards around houses, green areas, fields, rock, water."""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.sensing.rendering.buildings import rectangles
from sasgeo_bench.sensing.rendering.plan import WATER, Canvas, Cells, Mask, Shapes, blurred, burn_numbers, inside_m
from sasgeo_bench.sensing.rendering.seasons import GROWTH
from sasgeo_bench.sensing.rendering.texture import Field, Numbers, bell, draw, fractal, grain, noise

WOOD, PARK, MEADOW, ROUGH = range(4)
_YARD_M: Final = 16.0  # from a wall to the end of its ground
_PARCEL_EDGE_M: Final = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cover:
    """What grows where, shape (rows, cols): kind of green by number (-1 none), orchards, and whose yard a cell is."""

    green: NDArray[np.int8]
    orchard: Mask
    yard: Cells
    edge: Mask


def paint_ground(canvas: Canvas, numbers: Cells) -> Cover:
    """Paint what lies flat and is neither road nor roof; `numbers` are those of the buildings, 0 elsewhere."""
    canvas.built = blurred((numbers > 0).astype(np.float32), 28.0, canvas.grid)
    soil = _paint_country(canvas)
    yard, edge = _paint_yards(canvas, numbers, soil)
    green = np.concatenate([_paint_green(part) for part in canvas.parts()])
    orchard = np.concatenate([_paint_fields(part) for part in canvas.parts()])
    for part in canvas.parts():
        _paint_bare(part)
    _roughen(canvas)
    _paint_water(canvas)
    return Cover(green=green, orchard=orchard, yard=np.where(green >= 0, 0, yard), edge=edge & (green < 0) & ~orchard)


def _roughen(canvas: Canvas) -> None:
    """Make the ground uneven: grain, tufts and wide patches."""
    seed, rough = canvas.plan.seed("ground"), canvas.plan.palette.unevenness
    for strip, grid in canvas.strips():
        fine = (
            0.075 * grain(grid, 1 + canvas.plan.salt)
            + 0.08 * noise(grid, 0.7, seed)
            + 0.06 * noise(grid, 1.7, seed + 1)
        )
        tufts = -0.2 * np.clip(fractal(grid, 3.0, seed + 5) * (1 + noise(grid, 30.0, seed + 6)) - 0.3, 0, 0.7)
        factor = 1 + rough * (fine + tufts + 0.07 * fractal(grid, 35.0, seed + 2))
        for band in range(3):
            canvas.colour[strip][..., band] = np.clip(canvas.colour[strip][..., band] * factor, 0, 255)


def _grass(canvas: Canvas) -> tuple[Numbers, Numbers]:
    growth = GROWTH[canvas.season]
    fresh, dry = (np.array(colour) for colour in canvas.plan.palette.grass)
    return tuple(colour + growth.grass_share * (np.array(growth.grass) - colour) for colour in (fresh, dry))


def _paint_country(canvas: Canvas) -> Field:
    """Paint grass, fresh and dry, with bare patches; return where soil shows, 0 to 1."""
    palette, seed = canvas.plan.palette, canvas.plan.seed("country")
    fresh, dry = (colour.astype(np.float32) for colour in _grass(canvas))
    dark, light = (np.array(colour, dtype=np.float32) for colour in palette.soil)
    found = np.empty(canvas.grid.shape, dtype=np.float32)
    for strip, grid in canvas.strips():
        wide, near = fractal(grid, 60.0, seed, octaves=4), fractal(grid, 7.0, seed + 10, octaves=4)
        dryness = np.clip(0.45 + 0.7 * wide + 0.5 * near, 0, 1)
        soil = near + 0.6 * wide + 1.05 * canvas.built[strip] - 0.62 + 0.22 * palette.unevenness
        found[strip] = np.clip(soil * 2.2, 0, 1)
        part = np.clip(0.5 + fractal(grid, 18.0, seed + 20), 0, 1)
        plots = _plots(canvas, grid)
        for band in range(3):
            ground = fresh[band] + dryness * (dry[band] - fresh[band])
            ground += found[strip] * (dark[band] + part * (light[band] - dark[band]) - ground)
            ground *= plots.tone
            ground += plots.tilled * (plots.soil[band] - ground)
            canvas.colour[strip][..., band] = np.clip(ground, 0, 255)
        np.maximum(found[strip], np.float32(0.5), out=found[strip], where=plots.is_tilled)
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plots:
    """Changes of open ground by plot: a tone to multiply by, and the share and the colour of tilled soil."""

    tone: Field
    is_tilled: Mask
    tilled: Field
    soil: Field


def _plots(canvas: Canvas, grid: Grid) -> _Plots:
    """Return the plots of open ground: what is on no map still belongs to somebody, who mows, sows or lets it lie."""
    seed, palette = canvas.plan.seed("plots"), canvas.plan.palette
    bend = 22 * noise(grid, 170.0, seed), 22 * noise(grid, 170.0, seed + 1)
    turn = np.pi * draw(seed, np.array([0]))[0]
    east, north = ground_m(grid, canvas.plan.corner_m)
    east, north = east[None, :] + bend[0], north[:, None] + bend[1]
    across, down = east * np.cos(turn) + north * np.sin(turn), north * np.cos(turn) - east * np.sin(turn)
    luck, use = _drawn_by_plot((np.floor(across / 34), np.floor(down / 52)), (seed + 2, seed + 3))
    is_tilled = use < 0.22 * palette.patchwork
    tilled, at = np.zeros(grid.shape, dtype=np.float32), np.nonzero(is_tilled)
    row_m = np.where(luck[at] < 0.5, across[at], down[at]) * 2 * np.pi / (1.2 + 0.8 * luck[at])
    tilled[at] = 0.45 + 0.25 * np.sin(row_m)
    return _Plots(
        tone=1 + 0.28 * palette.patchwork * (luck - 0.5),
        is_tilled=is_tilled,
        tilled=tilled,
        soil=np.array(palette.soil[int(turn * 10) % 2], dtype=np.float32),
    )


def _drawn_by_plot(plot: tuple[Field, Field], seeds: tuple[int, int]) -> tuple[Field, Numbers]:
    """Return two draws for the plot (column, row) of each cell, which are drawn once for each plot."""
    first = [int(part.min()) for part in plot]
    across, down = (np.arange(low, int(part.max()) + 1) for low, part in zip(first, plot, strict=True))
    cells = (plot[0] - first[0]).astype(np.int32) * np.int32(len(down)) + (plot[1] - first[1]).astype(np.int32)
    luck, use = (draw(seed, across[:, None], down[None, :]).ravel() for seed in seeds)
    return luck.astype(np.float32).take(cells), use.take(cells)


def _paint_yards(canvas: Canvas, numbers: Cells, soil: Field) -> tuple[Cells, Mask]:
    """Give each house the ground next to it; return whose ground each cell is (0 none) and where two grounds meet."""
    # Distances are those of every second cell, which is exact enough for a garden.
    grid, plan = canvas.grid, canvas.plan
    if not numbers.any():
        return np.zeros(grid.shape, dtype=np.int32), np.zeros(grid.shape, dtype=bool)
    away, owner, edge = _nearest_house(numbers[::2, ::2], 2 * grid.cell_size_m)
    keys = np.concatenate([[0], plan.of("building").key])
    style = np.searchsorted(np.cumsum(plan.palette.yards) / sum(plan.palette.yards), draw(plan.seed("yard"), keys))
    reach_m = np.array([_YARD_M, _YARD_M, 6.0, _YARD_M, _YARD_M])  # paving ends near the house
    has_terrace = draw(5, keys) < 0.3
    yard = np.zeros(grid.shape, dtype=np.int32)
    for (strip, part_grid), part in zip(canvas.strips(), canvas.parts(), strict=True):
        away_m, near = (_whole(values, strip, grid.cols) for values in (away, owner))
        ragged_m = _YARD_M * (0.75 + 0.25 * noise(part_grid, 9.0, plan.seed("ragged")))
        mine = np.where((away_m < ragged_m) & (numbers[strip] == 0), near, 0)
        yard[strip] = mine
        _paint_yard_styles(part, np.where(away_m < reach_m[style[mine]], mine, 0), style, soil[strip])
        worn = np.clip(1.3 - away_m / (1.0 + 2.0 * plan.palette.unevenness), 0, 1) * np.clip(0.6 + soil[strip], 0, 1)
        part.tint((mine > 0) & (worn > 0.03), plan.palette.soil[1], np.asarray(worn * 0.7, dtype=np.float32))
        terrace = (away_m < 3.4) & has_terrace[mine] & (mine > 0)
        part.tint(terrace & (noise(part_grid, 7.0, plan.seed("terrace")) > 0.05), plan.palette.paving, 0.85)
    whole = np.concatenate([_whole(edge, strip, grid.cols) for strip, _ in canvas.strips()])
    return yard, whole & (yard > 0)


def _nearest_house(numbers: Cells, cell_size_m: float) -> tuple[Field, Cells, Mask]:
    outside = np.ascontiguousarray(numbers == 0).astype(np.uint8)
    away, nearest = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owners = np.zeros(int(nearest.max()) + 1, dtype=np.int32)
    owners[nearest[numbers > 0]] = numbers[numbers > 0]
    owner = owners[nearest]
    away_m = np.asarray(away, dtype=np.float32) * np.float32(cell_size_m)
    edge = np.zeros(owner.shape, dtype=bool)
    edge[1:] |= owner[1:] != owner[:-1]
    edge[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    return away_m, owner, edge & (away_m > 1.5)


def _whole(values: NDArray[Any], strip: slice, cols: int) -> NDArray[Any]:
    """Return a strip of rows of a raster of which only every second cell is known."""
    half = values[strip.start // 2 : (strip.stop + 1) // 2]
    return np.repeat(np.repeat(half, 2, axis=0), 2, axis=1)[: strip.stop - strip.start, :cols]


def _paint_yard_styles(canvas: Canvas, yard: Cells, style: NDArray[np.int64], soil: Field) -> None:
    palette, grid, seed = canvas.plan.palette, canvas.grid, canvas.plan.seed("beds")
    fresh, dry = _grass(canvas)
    kind = np.where(yard > 0, style[yard] + 1, 0)
    near = np.clip(0.5 + fractal(grid, 5.0, seed), 0, 1)
    lawn = fresh * 1.05 + 0.35 * bell(seed, yard[kind == 1].astype(np.int64))[:, None] * (dry - fresh)
    canvas.tint(kind == 1, lawn, 0.75)
    canvas.tint(kind == 2, palette.soil[1], np.asarray(0.35 + 0.6 * near, dtype=np.float32))
    canvas.tint(kind == 3, palette.paving, np.asarray(0.6 + 0.35 * near, dtype=np.float32))
    beds = (kind == 4) & (noise(grid, 11.0, seed + 5) > -0.1)
    rows = np.zeros(grid.shape, dtype=bool)
    rows[beds] = np.sin(2 * np.pi * _stripe_m(canvas, yard, beds) / 1.7) > 0.1
    canvas.tint(rows, np.array(fresh) * 0.85, 0.75)
    canvas.tint(beds & ~rows, palette.soil[0], np.asarray(0.4 + 0.3 * soil, dtype=np.float32))


def _stripe_m(canvas: Canvas, numbers: Cells, chosen: Mask) -> Field:
    """Return the distance across rows whose direction belongs to each number, metres, of the N chosen cells."""
    row, col = np.nonzero(chosen)
    turn = np.pi * draw(canvas.plan.seed("rows"), np.arange(int(numbers.max(initial=0)) + 1))
    cos, sin = (part.astype(np.float32)[numbers[row, col]] for part in (np.cos(turn), np.sin(turn)))
    east, north = ground_m(canvas.grid, canvas.plan.corner_m)
    return np.asarray(cos * east[col] - sin * north[row], dtype=np.float32)


def ground_m(grid: Grid, corner_m: tuple[float, float] | None = None) -> tuple[Field, Field]:
    """Return eastings (cols,) and northings (rows,) of cell centres, metres.

    They count from a corner that is fixed to the ground, so that windows agree, and near enough for float32: the one
    given, or that of the squares of 5 km, at whose edges windows do not agree.
    """
    west_m, north_m = grid.west_m % 5000, grid.north_m % 5000
    if corner_m is not None:
        west_m, north_m = grid.west_m - corner_m[0], grid.north_m - corner_m[1]
    east = (np.arange(grid.cols) + 0.5) * grid.cell_size_m + west_m
    north = north_m - (np.arange(grid.rows) + 0.5) * grid.cell_size_m
    return east.astype(np.float32), north.astype(np.float32)


def green_kinds(shapes: Shapes, seed: int) -> NDArray[np.int8]:
    """Return wood, park, meadow or rough ground for each green area: the map's class tells no more than "green".

    Large areas are mostly woods and meadows, small ones lawns with trees.
    """
    hectares = shapely.area(shapes.geometry) / 1e4
    luck = draw(seed, shapes.key)
    wood = np.clip(0.12 + 0.22 * np.log10(np.maximum(hectares, 0.01) / 0.3), 0.08, 0.7)
    park = np.clip(0.6 - 0.25 * np.log10(np.maximum(hectares, 0.01) / 0.2), 0.1, 0.8)
    park = np.minimum(park, 1 - wood)
    return np.where(luck < wood, WOOD, np.where(luck < wood + park, PARK, np.where(luck < 0.9, MEADOW, ROUGH))).astype(
        np.int8
    )


def _paint_green(canvas: Canvas) -> NDArray[np.int8]:
    shapes = canvas.plan.of("green")
    found = np.full(canvas.grid.shape, -1, dtype=np.int8)
    if not len(shapes):
        return found
    shapes = shapes.part(
        np.argsort(-shapely.area(shapes.geometry), kind="stable").astype(np.int64)
    )  # a pitch within a park
    numbers = burn_numbers(shapes.areas(), canvas.grid)
    kinds = np.concatenate([[-1], green_kinds(shapes, canvas.plan.seed("green"))]).astype(np.int8)
    found = kinds[numbers]
    fresh, dry = _grass(canvas)
    tone = bell(canvas.plan.seed("tone"), np.concatenate([[0], shapes.key]))
    patches = np.clip(0.5 + fractal(canvas.grid, 14.0, canvas.plan.seed("meadow")), 0, 1)
    for kind, dryness, share in ((PARK, 0.1, 0.8), (MEADOW, 0.4, 0.7), (ROUGH, 0.6, 0.4)):
        cells = found == kind
        mixed = np.clip(dryness + 0.5 * (patches[cells] - 0.5) + 0.12 * tone[numbers[cells]], 0, 1)[:, None]
        canvas.tint(cells, (fresh * (1 - mixed) + dry * mixed) * (1 + 0.05 * tone[numbers[cells]])[:, None], share)
    # By its place in the window, as pictures of published tasks are; another look is painted window by window.
    which = np.concatenate([[0], shapes.key]) if canvas.plan.salt else np.arange(len(kinds))
    mown = (found == PARK) & (draw(3, which) < 0.4)[numbers]
    stripes = np.sign(np.sin(np.pi * _stripe_m(canvas, numbers, mown) / 2.4)) * 0.035
    canvas.shade(mown, np.asarray(1 + stripes, dtype=np.float32))
    floor = np.array(canvas.plan.palette.soil[0]) * 0.55 + fresh * 0.2
    canvas.tint(found == WOOD, floor, 0.75)
    return found


def _paint_fields(canvas: Canvas) -> Mask:
    """Paint fields: a crop for each, rows along its longer side, tractor tracks; return where orchards stand."""
    shapes, plan = canvas.plan.of("farmland"), canvas.plan
    if not len(shapes):
        return np.zeros(canvas.grid.shape, dtype=bool)
    numbers = burn_numbers(shapes.areas(), canvas.grid)
    growth, palette, luck = GROWTH[canvas.season], plan.palette, plan.chance("crop", shapes.key)
    crops, ripe, soil = (np.array(part) for part in (palette.crops, palette.ripe, palette.soil))
    colour = crops[(luck * 977 % 1 * len(crops)).astype(int)]
    state = luck * 331 % 1
    is_bare, is_ripe = state < growth.ploughed_share, state > 1 - growth.ripe_share
    colour = np.where(is_bare[:, None], soil[(luck * 577 % 1 * 2).astype(int)] * 0.92, colour)
    colour = np.where(is_ripe[:, None], ripe[(luck * 757 % 1 * len(ripe)).astype(int)], colour)
    colour = colour * (1 + 0.07 * bell(plan.seed("field"), shapes.key))[:, None]
    colour = np.vstack([np.zeros((1, 3)), colour])
    cells = numbers > 0
    if not cells.any():
        return cells
    own = numbers[cells]
    canvas.tint(
        cells,
        colour[own],
        np.asarray(0.82 + 0.12 * noise(canvas.grid, 12.0, 5 + plan.salt), dtype=np.float32),
    )
    # Distance across the rows of each field, which run along its longer side, metres
    axis = np.vstack([[1.0, 0.0], rectangles(shapes.geometry)[1]]).astype(np.float32)[own]
    (east, north), (row, col) = ground_m(canvas.grid, canvas.plan.corner_m), np.nonzero(cells)
    across = axis[:, 0] * north[row] - axis[:, 1] * east[col]
    pitch = np.concatenate([[1.0], 0.75 + 1.6 * luck])[own]
    wander = 0.5 * noise(canvas.grid, 25.0, plan.seed("wander"))[cells]
    rows = 0.06 * np.sin(2 * np.pi * (across + wander) / pitch)
    tracks = np.where(np.mod(across + wander, 18.0) < 0.7, -0.13, 0.0)
    patches = 0.12 * fractal(canvas.grid, 40.0, plan.seed("growth"), octaves=4)[cells]
    canvas.shade(cells, np.asarray(1 + rows + tracks + patches, dtype=np.float32))
    is_orchard = np.concatenate([[False], (luck * 131 % 1 < 0.16) & (shapely.area(shapes.geometry) < 4e4)])
    return np.asarray(is_orchard[numbers])


def _paint_bare(canvas: Canvas) -> None:
    """Paint ground on which nothing grows: rock and rubble, or sand, for each area."""
    shapes, plan = canvas.plan.of("bare"), canvas.plan
    if not len(shapes):
        return
    numbers, seed = burn_numbers(shapes.areas(), canvas.grid), plan.seed("rubble")
    cells = numbers > 0
    if not cells.any():
        return
    is_rock = plan.chance("bare", shapes.key) < 0.6
    rock, sand = (np.array(colour) for colour in plan.palette.bare)
    colour = np.where(is_rock[:, None], rock, sand) * (1 + 0.06 * bell(seed, shapes.key))[:, None]
    canvas.tint(cells, np.vstack([np.zeros((1, 3)), colour])[numbers[cells]], 0.93)
    rough = np.concatenate([[0.0], np.where(is_rock, 0.2, 0.05)]).astype(np.float32)[numbers[cells]]
    rubble = (fractal(canvas.grid, 3.0, seed + 1) + fractal(canvas.grid, 14.0, seed + 2))[cells]
    canvas.shade(cells, np.asarray(1 + rough * rubble, dtype=np.float32))


def _paint_water(canvas: Canvas) -> None:
    """Paint standing and running water and the sea: darker where deep, with a wet or stony edge."""
    grid, palette, seed = canvas.grid, canvas.plan.palette, canvas.plan.seed("water")
    water = burn_numbers(canvas.plan.of("water").areas(), grid) > 0
    if not water.any():
        return
    depth_m, bank_m = inside_m(water, grid), inside_m(~water, grid)
    deep, shallow = (np.array(colour, dtype=np.float32) for colour in palette.water)
    for (strip, strip_grid), part in zip(canvas.strips(), canvas.parts(), strict=True):
        here = water[strip]
        bank = ~here & (bank_m[strip] < 1.2 + 1.5 * noise(strip_grid, 6.0, seed))
        part.tint(bank, np.array(palette.soil[0]) * 0.8, 0.6)
        share = np.exp(-depth_m[strip] / 4.0) + 0.25 * fractal(strip_grid, 25.0, seed + 3)
        share = np.clip(share, 0, 1)[here][:, None]
        ripples = (1 + 0.04 * noise(strip_grid, 1.6, seed + 7) + 0.03 * grain(strip_grid, 5 + canvas.plan.salt))[here][
            :, None
        ]
        part.tint(here, (deep * (1 - share) + shallow * share) * ripples)
        part.kind[here] = WATER
