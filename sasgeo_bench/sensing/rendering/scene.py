# SPDX-License-Identifier: Apache-2.0
"""Scene: one window of a region, ready to be looked at from any camera in any season and light."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.layers import burn, burn_class, make_paint
from sasgeo_bench.sensing.rendering.buildings import Buildings, paint_buildings, style_buildings
from sasgeo_bench.sensing.rendering.conditions import Light, Sun, cast_light
from sasgeo_bench.sensing.rendering.ground import PARK, ROUGH, WOOD, Cover, paint_ground
from sasgeo_bench.sensing.rendering.palettes import PALETTES, Family
from sasgeo_bench.sensing.rendering.plan import (
    GROUND,
    ROAD,
    ROOF,
    WATER,
    Canvas,
    Cells,
    HeightPyramid,
    Mask,
    Picture,
    Plan,
    burn_numbers,
    inside_m,
    shapes_of,
)
from sasgeo_bench.sensing.rendering.roads import paint_barriers, paint_cars, paint_roads
from sasgeo_bench.sensing.rendering.seasons import GROWTH, Season
from sasgeo_bench.sensing.rendering.texture import Numbers, draw, fractal, noise, seed_of
from sasgeo_bench.sensing.rendering.trees import hedge_trees, make_trees, paint_trees, scatter

if TYPE_CHECKING:
    import geopandas as gpd

MARGIN_M: Final = 24.0  # painted around the window asked for, so that its edge looks like its middle
_SNOW: Final = (232, 236, 242)
_MOST_CELLS: Final = 40_000_000
_MOST_CLASSES: Final = 31
_MOST_SALT: Final = 2**31 - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Painting:
    """A scene in one season: colours in even light, shape (rows, cols, 3), each level half as fine; heights; kinds.

    `owner` is the number of the building that a cell belongs to, from 1 on, or 0.
    """

    colours: tuple[Picture, ...]
    heights: HeightPyramid
    kind: Picture
    owner: Cells
    lamps: Picture


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One window of a region: what stands there, in what style, and where each class of the map is.

    `grid` is the lattice of the paint; `class_bits`, uint32 of its shape, has bit k set where class k of `classes` is
    present; `is_mapped` is False beyond the mapped area. Nothing is shown taller than `below_m`: a camera must stand
    above all there is. Paintings and lights are made when first needed; the last two and the last one are kept.
    """

    plan: Plan
    buildings: Buildings
    classes: tuple[str, ...]
    class_bits: NDArray[np.uint32]
    is_mapped: Mask
    below_m: float = math.inf
    _paintings: dict[Season, Painting] = field(default_factory=dict, init=False, repr=False)
    _lights: dict[tuple[Season, Sun], Light] = field(default_factory=dict, init=False, repr=False)

    @property
    def grid(self) -> Grid:
        """Return the lattice of the paint: the window that was asked for and a margin."""
        return self.plan.grid

    def painting(self, season: Season) -> Painting:
        """Return the scene as it looks in a season."""
        if season not in self._paintings:
            while len(self._paintings) > 1:
                self._paintings.pop(next(iter(self._paintings)))
            self._paintings[season] = paint(self.plan, self.buildings, season, self.below_m)
        return self._paintings[season]

    def light(self, season: Season, sun: Sun) -> Light:
        """Return the light on the scene; the sun's place is rounded to half a degree."""
        near = Sun(elevation_deg=round(sun.elevation_deg * 2) / 2, azimuth_deg=round(sun.azimuth_deg * 2) / 2)
        if (season, near) not in self._lights:
            self._lights.clear()
            heights = self.painting(season).heights.height_m
            self._lights[season, near] = cast_light(heights, self.grid.cell_size_m, near)
        return self._lights[season, near]


def make_scene(
    features: "gpd.GeoDataFrame",
    classes: tuple[str, ...],
    coverage: shapely.Geometry,
    *,
    place: str,
    window: Grid,
    family: Family = "train",
    relief: float = 1.0,
) -> Scene:
    """Return the scene of one window of a region: `make_scene(region.features, region.classes, region.coverage, ...)`.

    Parameters
    ----------
    features, classes, coverage
        Those of a `Region` of any state of the map.
    place : str
        Seeds all styles together with the identity of each feature: the same place looks the same at every date.
        With a slash, as in "vaduz/survey", it is another look of a place, which shares no draw with that of the place
        alone: other roofs, crops, heights, trees, cars and grain.
    window : Grid
        Ground and cell size (0.25 to 0.5 m) of the paint; a margin of 24 m is added on every side.
    family : {"train", "calibration", "test", "shifted"}
        Palette and materials.
    relief : float
        Multiplies the heights of buildings: 0 for flat ones, 2 for tall ones.

    Raises
    ------
    ShapeError
        If the window is too large to paint, or lies in another CRS.
    """
    _check(features, classes, window)
    more = round(MARGIN_M / window.cell_size_m)
    grid = window.window(-more, -more, window.rows + 2 * more, window.cols + 2 * more)
    west, south, east, north = grid.bounds_m
    box = shapely.box(west - 80, south - 80, east + 80, north + 80)
    salt = seed_of(place) % _MOST_SALT + 1 if "/" in place else 0
    plan = Plan(
        grid=grid,
        place=place,
        palette=PALETTES[family],
        shapes=shapes_of(features, box, salt=salt),
        salt=salt,
        corner_m=(float(features.total_bounds[0]), float(features.total_bounds[3])) if salt and len(features) else None,
    )
    paint_areas = make_paint(features[shapely.intersects(features.geometry.to_numpy(), box)], classes, coverage)
    bits = np.zeros(grid.shape, dtype=np.uint32)
    for number in range(len(classes)):
        seen = burn_class(paint_areas, number, grid)
        if seen is not None:
            bits[seen] |= np.uint32(1 << number)
    return Scene(
        plan=plan,
        buildings=style_buildings(plan, relief),
        classes=classes,
        class_bits=bits,
        is_mapped=burn(paint_areas.coverage, grid),
    )


def _check(features: "gpd.GeoDataFrame", classes: tuple[str, ...], window: Grid) -> None:
    if window.rows * window.cols > _MOST_CELLS:
        raise ShapeError(
            f"a scene has at most {_MOST_CELLS:,} cells, got {window.rows:,} x {window.cols:,}: take a smaller window, "
            "or larger cells"
        )
    if features.crs is None or features.crs.to_epsg() != window.epsg:
        raise ShapeError(
            f"window lies in EPSG:{window.epsg}, the features in {features.crs!r}: give both in the region's CRS"
        )
    if len(classes) > _MOST_CLASSES:
        raise ShapeError(f"a scene holds at most {_MOST_CLASSES} classes, got {len(classes)}")


def paint(plan: Plan, buildings: Buildings, season: Season, below_m: float = math.inf) -> Painting:
    """Paint a plan in a season: ground first, then what lies on it, then what stands on it."""
    shape = plan.grid.shape
    canvas = Canvas(
        plan=plan,
        season=season,
        colour=np.zeros((*shape, 3), dtype=np.uint8),
        height_m=np.zeros(shape, dtype=np.float32),
        kind=np.zeros(shape, dtype=np.uint8),
        owner=np.zeros(shape, dtype=np.int32),
    )
    numbers = burn_numbers(plan.of("building").geometry, plan.grid)
    cover = paint_ground(canvas, numbers)
    paint_roads(canvas)
    paint_barriers(canvas, cover.edge, cover.yard)
    paint_buildings(canvas, buildings)
    if GROWTH[season].snow:
        _paint_snow(canvas)
    paint_cars(canvas)
    _paint_greenery(canvas, cover)
    np.minimum(canvas.height_m, np.float32(below_m), out=canvas.height_m)
    colours = [canvas.colour]
    for _ in range(4):
        half = cv2.resize(colours[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        colours.append(np.asarray(half, dtype=np.uint8))
    heights = HeightPyramid(canvas.height_m)
    return Painting(colours=tuple(colours), heights=heights, kind=canvas.kind, owner=canvas.owner, lamps=canvas.lamps)


def _paint_snow(canvas: Canvas) -> None:
    """Cover ground and roofs with snow; roads are half cleared, some roofs have let it slide off."""
    seed = canvas.plan.seed("snow")
    slid = draw(seed, np.concatenate([[0], canvas.plan.of("building").key])) < 0.15
    for strip, grid in canvas.strips():
        kind = canvas.kind[strip]
        share = np.full(grid.shape, GROWTH[canvas.season].snow, dtype=np.float32)
        share[kind == ROAD] = np.clip(0.4 + 0.7 * fractal(grid, 8.0, seed), 0.05, 0.9)[kind == ROAD]
        share[(kind == ROOF) & slid[canvas.owner[strip]]] = 0.25
        share[kind == WATER] = 0.0
        share *= np.clip(1.02 + 0.16 * noise(grid, 1.4, seed + 9), 0, 1)
        white = np.array(_SNOW, dtype=np.float32) * (1 + 0.03 * fractal(grid, 12.0, seed + 5))[..., None]
        old = canvas.colour[strip].astype(np.float32)
        canvas.colour[strip] = np.clip(old + share[..., None] * (white - old), 0, 255)


def _paint_greenery(canvas: Canvas, cover: Cover) -> None:
    """Plant woods, parks, yards, streets, hedges and single trees where no road, roof, water or bare ground is."""
    grid, plan, dense = canvas.grid, canvas.plan, canvas.plan.palette.tree_density
    is_bare = burn_numbers(plan.of("bare").areas(), grid) > 0
    room = cv2.erode(((canvas.kind == GROUND) & ~is_bare).astype(np.uint8), np.ones((5, 5), np.uint8))
    wall_m = inside_m(canvas.kind != ROOF, grid)
    clumps = fractal(grid, 45.0, plan.seed("clumps"))
    field_numbers = burn_numbers(plan.of("farmland").areas(), grid)

    def sown(purpose: str, chance: Callable[..., Numbers]) -> Numbers:
        """Return the places of a scatter that are taken by a chance of green, yard, orchard, field, edge, clump."""
        points, cells = scatter(grid, plan.seed(purpose))
        at = (cells[:, 0], cells[:, 1])
        clump = np.clip(0.55 + 1.6 * clumps[at], 0, 1.6)
        share = chance(
            cover.green[at], cover.yard[at] > 0, cover.orchard[at], field_numbers[at] > 0, cover.edge[at], clump
        )
        away = np.clip(wall_m[at] - 2.5, 0, 1) if purpose == "single" else 1.0
        return points[points[:, 3] < share * away * room[at]]

    wood = sown("wood", lambda green, *_: np.where(green == WOOD, 0.95, 0.0))
    single = sown("single", lambda *about: _single_trees(*about, dense=dense))
    bushes = sown("bush", lambda *about: _bushes(*about, dense=dense))
    groups = (
        make_trees(canvas, wood, size=(2.0, 4.4), is_wood=True),
        make_trees(canvas, single, size=(1.6, 4.6)),
        make_trees(canvas, bushes, size=(0.6, 1.3)),
        hedge_trees(canvas),
    )
    paint_trees(canvas, groups)


def _single_trees(
    green: NDArray[np.int8], yard: Mask, orchard: Mask, field: Mask, _edge: Mask, clump: Numbers, *, dense: float
) -> Numbers:
    """Return the chance of a tree at each place: in yards, parks, open country; in rows of an orchard nearly always."""
    country = np.where(yard, 0.085 * dense, 0.035 * dense)
    kinds = np.select([green == PARK, green == ROUGH, green >= 0], [0.07, 0.12, 0.015], country)
    return np.where(orchard, 0.45, np.where(field, 0.0, kinds * clump))


def _bushes(
    green: NDArray[np.int8], yard: Mask, _orchard: Mask, field: Mask, edge: Mask, clump: Numbers, *, dense: float
) -> Numbers:
    """Return the chance of a bush at each place: between yards, in yards, on rough ground."""
    country = np.where(yard | (green == ROUGH), 0.16 * dense, 0.03 * dense * clump**2)
    return np.where(field, 0.0, np.where(edge, 0.55 * min(dense, 1.2), country))
