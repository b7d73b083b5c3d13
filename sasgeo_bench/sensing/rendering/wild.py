# SPDX-License-Identifier: Apache-2.0
"""Draw aerial pictures of a sheet quickly, each in a look of its own: colours, light and sensor are drawn anew.

Meant to teach: what a network must not rely on changes from picture to picture, whether or not it looks real (domain
randomization; Tobin et al., IROS 2017). The careful pictures that queries are made of are drawn by `scene.py`.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.sensing.rendering.plan import Picture
from sasgeo_bench.sensing.rendering.roads import STREETS
from sasgeo_bench.sensing.rendering.sheet import BEYOND_M, INCHES, Sheet
from sasgeo_bench.sensing.rendering.texture import Field

Numbers = NDArray[np.int64]
Rng = np.random.Generator
Number = TypeVar("Number", np.int64, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ingredients:
    """What goes into drawn pictures; each can be left out, to measure what it teaches.

    `wild` is the share of classes whose colours are any at all, in place of likely ones; `missing` the share of mapped
    things that are not in the picture, and `off_m` how far, at most, it lies off the map. `roofs` have two faces,
    terraces, courtyards and plant; `streets` lanes and kerbs; `fields` stages and furrows; `ground` plots and yards
    where the map is empty; `unmapped` are sheds, car parks, paths, hedges and pools that no map has. `texture` is that
    of woods, grass and surfaces; `lean` shows the walls of tall buildings; `colour` mixes channels, haze and gamma;
    `sensor` blurs, resamples, sharpens, adds noise and packs as JPEG.

    >>> Ingredients(cars=False).cars, Ingredients.none().off_m
    (False, 0.0)
    """

    wild: float = 0.4
    missing: float = 0.03
    off_m: float = 3.0
    roofs: bool = True
    streets: bool = True
    cars: bool = True
    trees: bool = True
    fields: bool = True
    ground: bool = True
    unmapped: bool = True
    water: bool = True
    texture: bool = True
    shadows: bool = True
    lean: bool = True
    colour: bool = True
    sensor: bool = True

    def __post_init__(self) -> None:
        for name in ("wild", "missing"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} is a share, 0 to 1, got {getattr(self, name)!r}")
        if not 0 <= self.off_m <= _MOST_OFF_M:
            raise ConfigError(f"off_m must lie within 0 to {_MOST_OFF_M:g} metres, got {self.off_m!r}")

    @classmethod
    def none(cls) -> "Ingredients":
        """Return none of them: flat, likely colours in place, in even light."""
        off = {name: False for name in cls.__slots__ if isinstance(getattr(cls(), name), bool)}
        return cls(wild=0.0, missing=0.0, off_m=0.0, **off)


_MOST_OFF_M: Final = 20.0

# Rows of the table of what a pixel shows: plots of open ground, then stamps, then the sheet's own.
_PLOTS: Final = 48
_STAMPS: Final = 72
_SHED, _LOT, _TRACK, _HEDGE, _POOL, _CAR, _GLASS, _CROWN, _LIT, _PLANT = 0, 8, 12, 16, 20, 24, 40, 41, 53, 65
_SHOULDER: Final = 71
_CROWN_PX: Final = (4.0, 7.0, 12.0, 20.0, 34.0)  # widths of crowns of which there are textures
_COARSEST_M: Final = 1.2  # of a sensor
_GRASS: Final = ((92, 116, 58), (126, 134, 80), (70, 95, 45), (150, 145, 95), (110, 120, 75), (84, 92, 62))
_SOIL: Final = ((146, 124, 96), (172, 154, 124), (110, 90, 70), (170, 120, 85), (196, 182, 150), (128, 112, 92))
_PAVED: Final = ((116, 116, 118), (75, 75, 80), (165, 162, 155), (140, 136, 130), (192, 188, 178), (95, 92, 92))
_WOOD: Final = ((45, 65, 38), (60, 80, 45), (38, 52, 42), (75, 85, 50), (95, 85, 62), (52, 70, 30))
_CROPS: Final = ((85, 120, 50), (110, 140, 60), (60, 95, 45), (130, 150, 90), (100, 118, 80))
_RIPE: Final = ((190, 170, 110), (205, 185, 130), (160, 150, 80), (176, 160, 120), (214, 204, 168))
_WATER: Final = (
    *((40, 60, 55), (60, 80, 70), (30, 45, 70), (120, 105, 80), (80, 130, 140), (25, 30, 30), (165, 175, 180)),
    *((90, 100, 60), (150, 135, 105), (70, 95, 115), (110, 150, 160)),
)
_ROOFS: Final = (
    *((158, 92, 70), (126, 78, 64), (104, 76, 66), (88, 88, 94), (170, 174, 178), (225, 225, 222), (60, 60, 64)),
    *((80, 110, 160), (95, 130, 100), (146, 142, 134), (140, 95, 75), (190, 170, 140), (176, 110, 80), (120, 120, 122)),
)
_PATHS: Final = ((158, 144, 118), (190, 175, 145), (130, 130, 128), (110, 105, 80), (176, 130, 95))
_BALLAST: Final = ((120, 108, 98), (95, 88, 84), (140, 130, 120), (104, 92, 78))
_BARE: Final = ((150, 146, 138), (196, 182, 150), (170, 120, 80), (120, 116, 112))
_FENCE: Final = ((55, 75, 40), (150, 140, 130), (70, 84, 50), (96, 90, 80))
_CARS: Final = (
    (230, 230, 230),
    (30, 30, 34),
    (130, 134, 138),
    (190, 30, 30),
    (30, 60, 140),
    (180, 180, 184),
    (80, 84, 90),
)
_FLAT, _GABLE, _HIP = range(3)
_TILE_PX: Final = 768  # of the textures, which are made once


@dataclass(slots=True, kw_only=True, eq=False)
class _Table:
    """How each row looks: colour, strengths of textures, furrows (u, v: radians per cell), height."""

    colour: Field  # (R, 3), 0-255
    grain: Field
    mottle: Field
    crowns: Field
    furrow: Field
    lattice: Field
    along: Field  # (R, 2)
    height_m: Field

    @classmethod
    def empty(cls, rows: int) -> "_Table":
        def plain() -> Field:
            return np.zeros(rows, dtype=np.float32)

        return cls(
            colour=np.zeros((rows, 3), dtype=np.float32),
            grain=np.full(rows, 0.04, dtype=np.float32),
            mottle=np.full(rows, 0.05, dtype=np.float32),
            crowns=plain(),
            furrow=plain(),
            lattice=plain(),
            along=np.zeros((rows, 2), dtype=np.float32),
            height_m=plain(),
        )


class _Colours:
    """The colours of one picture: for each purpose a few that are usual in it, likely ones or any at all."""

    def __init__(self, rng: Rng, wild: float) -> None:
        self._rng, self._wild = rng, wild
        self._strange = any_colours(rng, 6)

    def draw(self, likely: tuple[tuple[int, int, int], ...], count: int, spread: float = 0.12) -> Field:
        """Return colours of a number of things, shape (count, 3)."""
        rng = self._rng
        tones = np.asarray(likely, dtype=np.float32)
        # A few of the likely tones prevail, here these and there those
        share = rng.gamma(0.6, size=len(tones)) + 1e-3
        picked = tones[rng.choice(len(tones), size=count, p=share / share.sum())]
        is_wild, how = rng.random() < self._wild, rng.uniform(0.3, 1.0)
        strange = self._strange[rng.integers(len(self._strange), size=count)]
        picked = np.where((rng.random((count, 1)) < how) & is_wild, strange, picked)
        bright = np.exp(spread * rng.standard_normal((count, 1)))
        return np.asarray(picked * bright + 40 * spread * rng.standard_normal((count, 3)), dtype=np.float32)


def any_colours(rng: Rng, count: int) -> Field:
    """Return any colours, weak ones more often than strong ones, shape (count, 3)."""
    bright = rng.uniform(20, 240, size=(count, 1))
    strong = rng.uniform(0, 0.4, size=(count, 1))
    return np.asarray(np.clip(bright * (1 + strong * rng.standard_normal((count, 3))), 4, 252), dtype=np.float32)


def draw_picture(
    sheet: Sheet, pose: Pose, *, side_px: int, pixel_m: float, ingredients: Ingredients, rng: Rng
) -> Picture:
    """Return a picture of a sheet from above, uint8 of shape (side_px, side_px, 3), the heading of the pose upwards.

    A pixel is `pixel_m` wide on the ground. All that the map does not say is drawn by `rng`.
    """
    return _Drawing(sheet, pose, side_px, pixel_m, ingredients, rng).picture()


class _Drawing:
    """One picture while it is drawn: `shows` holds the row of the table that each pixel shows."""

    def __init__(
        self, sheet: Sheet, pose: Pose, side_px: int, pixel_m: float, ingredients: Ingredients, rng: Rng
    ) -> None:
        self.sheet, self.px, self.side = sheet, pixel_m, side_px
        self.has, self.rng = ingredients, rng
        self.colours = _Colours(rng, ingredients.wild)
        self.middle, right, up = sheet.grid.to_uv(pose.to_map(np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])))
        # (u, v) = middle + turn @ (right, down), pixels from the middle of the picture
        self.turn = np.stack([right - self.middle, self.middle - up], axis=1) * pixel_m
        azimuth, self.elevation = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 1.15)
        self.sun = np.array([np.cos(azimuth), np.sin(azimuth)])  # towards the sun, right and down
        uv = self.turn @ self.sun
        self.sun_uv = (uv / np.hypot(*uv)).astype(np.float32)
        counts = (_PLOTS + _STAMPS, len(sheet.things), *(3 * [len(sheet.buildings)]))
        self.things_at, self.roofs_at, self.walls_at, self.yards_at, rows = np.cumsum(counts).tolist()
        self.table = _Table.empty(rows)
        self.tiles = _tiles()
        self.parks = np.zeros(0, dtype=np.int64)
        self.extra_m: Field | None = None

    def picture(self) -> Picture:
        self.lay_table()
        self.place()
        if self.has.unmapped:
            self.stamp_unmapped()
        if self.has.cars:
            self.stamp_cars()
        self.raise_buildings()
        if self.has.trees:
            self.stamp_trees()
        colour = self.table.colour.take(self.shows, axis=0)
        tone = self.texture()
        self.shape_roofs(colour, tone)
        if self.has.streets:
            self.mark_streets(colour, tone)
        if self.has.water:
            self.glint(tone)
        if self.has.shadows:
            tone *= self.shadow()
        colour *= tone[..., None]
        picture = self.develop(colour) if self.has.colour else np.clip(colour, 0, 255).astype(np.uint8)
        return self.sense(picture) if self.has.sensor else picture

    # The table: what each row looks like.

    def lay_table(self) -> None:
        rng, table = self.rng, self.table
        self.lay_ground(slice(0, _PLOTS), whole=not self.has.ground)
        self.lay_ground(slice(self.yards_at, None), whole=not self.has.ground)
        self.lay_stamps()
        looks = self.sheet.things.look
        for look in np.unique(looks[1:]):
            self.lay_things(str(look), np.flatnonzero(looks == look) + self.things_at)
        self.lay_buildings()
        if not self.has.texture:
            table.grain[:] = table.mottle[:] = table.crowns[:] = 0
        else:
            table.grain *= rng.uniform(0.4, 1.6)
            table.mottle *= rng.uniform(0.4, 2.0)

    def lay_ground(self, rows: slice, *, whole: bool) -> None:
        """Cover plots or yards with grass, soil, paving or shrubs."""
        rng, table = self.rng, self.table
        at = np.arange(len(table.colour))[rows]
        share = rng.gamma(0.5, size=4) * (1.0, 0.6, 0.4, 0.25) + 1e-3
        kind = np.zeros(len(at), dtype=int) if whole else rng.choice(4, size=len(at), p=share / share.sum())
        for number, tones in enumerate((_GRASS, _SOIL, _PAVED, _WOOD)):
            chosen = at[kind == number]
            table.colour[chosen] = self.colours.draw(tones, len(chosen), 0.02 if whole else rng.uniform(0.02, 0.2))
        table.mottle[at] = rng.uniform(0.03, 0.2)
        table.crowns[at[kind == 3]] = rng.uniform(0.3, 1.0)
        table.height_m[at[kind == 3]] = rng.uniform(0, 6)
        if self.has.fields and self.has.ground:
            self.furrow(at[rng.random(len(at)) < rng.uniform(0, 0.3)], 0.12)

    def furrow(self, rows: Numbers, most: float) -> None:
        """Draw furrows, each field in a direction of its own; some fields have rows of trees or vines."""
        rng, table = self.rng, self.table
        turn = rng.uniform(0, np.pi) + rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)], size=len(rows))
        period = np.exp(rng.uniform(np.log(1.5), np.log(14.0), size=len(rows))) / self.sheet.grid.cell_size_m
        period = np.maximum(period, 2.5 * self.px / self.sheet.grid.cell_size_m)  # finer ones are not seen
        table.along[rows] = (2 * np.pi / period * np.stack([np.cos(turn), np.sin(turn)])).T
        table.furrow[rows] = rng.uniform(0, most, size=len(rows)) * (rng.random(len(rows)) < 0.7)

    def lay_stamps(self) -> None:
        rng, table = self.rng, self.table

        def paint(first: int, last: int, tones: tuple[tuple[int, int, int], ...], height_m: float = 0.0) -> None:
            rows = slice(_PLOTS + first, _PLOTS + last)
            table.colour[rows] = self.colours.draw(tones, last - first)
            table.height_m[rows] = height_m * rng.uniform(0.6, 1.4, size=last - first)

        paint(_SHED, _LOT, _ROOFS, 3.0)
        paint(_LOT, _TRACK, _PAVED)
        paint(_TRACK, _HEDGE, (*_PATHS, *_SOIL))
        paint(_HEDGE, _POOL, _FENCE, 1.8)
        paint(_POOL, _CAR, ((80, 170, 200), (60, 140, 160), (40, 60, 70), (90, 190, 210)))
        paint(_CAR, _GLASS, _CARS, 1.4)
        paint(_GLASS, _CROWN, ((40, 44, 50),), 1.4)
        paint(_CROWN, _LIT, _WOOD, 7.0)
        paint(_PLANT, _SHOULDER, ((150, 150, 150), (90, 90, 92), (200, 200, 200), (60, 70, 90)), 1.0)
        paint(_SHOULDER, _STAMPS, (*_PAVED, *_SOIL))
        crown, lit = slice(_PLOTS + _CROWN, _PLOTS + _LIT), slice(_PLOTS + _LIT, _PLOTS + _PLANT)
        table.colour[lit] = table.colour[crown] * rng.uniform(1.1, 1.5)
        table.height_m[lit] = table.height_m[crown]
        table.crowns[crown] = table.crowns[lit] = rng.uniform(0.1, 0.5)

    def lay_things(self, look: str, rows: Numbers) -> None:
        rng, table, count = self.rng, self.table, len(rows)
        spread = rng.uniform(0.03, 0.25)
        table.mottle[rows] = rng.uniform(0.02, 0.12)
        if look in STREETS:
            table.colour[rows] = self.colours.draw((*_PAVED, *(_SOIL if rng.random() < 0.3 else ())), count, spread / 2)
        elif look == "parking":
            table.colour[rows] = self.colours.draw(_PAVED, count, spread)
        elif look == "path_track":
            table.colour[rows] = self.colours.draw(_PATHS, count, spread)
        elif look == "railway":
            table.colour[rows] = self.colours.draw(_BALLAST, count, spread)
            table.grain[rows] = 0.1
        elif look == "water":
            # Mostly of one colour: a river is mapped in pieces
            table.colour[rows] = self.colours.draw(_WATER, count if rng.random() < 0.3 else 1, spread)
            table.grain[rows], table.mottle[rows] = rng.uniform(0, 0.04), rng.uniform(0, 0.08)
        elif look == "green":
            self.lay_green(rows, spread)
        elif look == "farmland":
            self.lay_fields(rows, spread)
        elif look == "field_boundary":
            table.colour[rows] = self.colours.draw(_FENCE, count, spread)
            table.height_m[rows] = rng.uniform(0.5, 5.0, size=count)
        else:
            table.colour[rows] = self.colours.draw(_BARE, count, spread)

    def lay_green(self, rows: Numbers, spread: float) -> None:
        """Woods, parks, meadows or scrub: the map does not say which."""
        rng, table = self.rng, self.table
        kind = rng.choice(4, size=len(rows), p=(0.4, 0.15, 0.3, 0.15))
        is_wood, is_park, is_scrub = kind == 0, kind == 1, kind == 3
        table.colour[rows] = self.colours.draw(_GRASS, len(rows), spread)
        table.colour[rows[is_wood]] = self.colours.draw(_WOOD, int(is_wood.sum()), spread)
        table.crowns[rows] = np.select([is_wood, is_scrub], [rng.uniform(0.4, 1.3), rng.uniform(0.2, 0.6)], 0.0)
        table.height_m[rows] = np.select([is_wood, is_scrub], [rng.uniform(5, 18), 1.5], 0.0)
        table.mottle[rows] = rng.uniform(0.03, 0.25)
        self.parks = rows[is_park]

    def lay_fields(self, rows: Numbers, spread: float) -> None:
        rng, table, count = self.rng, self.table, len(rows)
        if not self.has.fields:
            table.colour[rows] = self.colours.draw(_CROPS, count, spread)
            return
        share = rng.gamma(0.7, size=3) + 1e-3
        kind = rng.choice(3, size=count, p=share / share.sum())
        for number, tones in enumerate((_SOIL, _CROPS, _RIPE)):
            chosen = rows[kind == number]
            table.colour[chosen] = self.colours.draw(tones, len(chosen), spread)
        table.mottle[rows] = rng.uniform(0.02, 0.2, size=count)
        table.grain[rows] = rng.uniform(0.01, 0.06, size=count)
        self.furrow(rows, 0.22)
        table.lattice[rows] = rng.uniform(0.2, 0.8, size=count) * (rng.random(count) < rng.choice([0.05, 0.3]))

    def lay_buildings(self) -> None:
        rng, table, houses = self.rng, self.table, self.sheet.buildings
        count, cell_m = len(houses), self.sheet.grid.cell_size_m
        area_m2 = 4 * houses.half.prod(axis=1) * cell_m**2
        usual_m = np.exp(rng.uniform(np.log(3.0), np.log(12.0)))
        height_m = usual_m * np.exp(0.35 * rng.standard_normal(count)) * np.clip(area_m2 / 120, 0.4, 1.6) ** 0.3
        roofs, walls = (slice(at, at + count) for at in (self.roofs_at, self.walls_at))
        table.colour[roofs] = self.colours.draw(_ROOFS, count, rng.uniform(0.05, 0.25))
        table.colour[walls] = self.colours.draw(
            ((214, 206, 190), (178, 150, 122), (204, 196, 196), (90, 90, 95)), count
        )
        table.height_m[roofs] = table.height_m[walls] = height_m
        table.mottle[roofs] = rng.uniform(0.0, 0.12)
        table.grain[roofs] = rng.uniform(0.0, 0.08)
        large = np.clip((np.log(np.maximum(area_m2, 1)) - np.log(300)) / np.log(6), 0, 0.9)
        is_flat = rng.random(count) < np.maximum(large, rng.choice([0.05, 0.3, 0.9], p=(0.5, 0.3, 0.2)))
        self.form = np.where(is_flat, _FLAT, np.where(rng.random(count) < 0.7, _GABLE, _HIP))
        has_court = (area_m2 > 500) & (rng.random(count) < 0.25)
        self.court = np.where(has_court, rng.uniform(0.2, 0.6, size=count), 0.0).astype(np.float32)
        long_m = houses.half[:, 0] * 2 * cell_m
        is_row = (long_m > 18) & (rng.random(count) < 0.4)
        unit_m = np.where(is_row, rng.uniform(5, 12, size=count), 1e6)
        self.unit = (unit_m / cell_m).astype(np.float32)

    # What stands where.

    def place(self) -> None:
        """Take the numbers under each pixel; the picture lies a little off the map."""
        rng, sheet = self.rng, self.sheet
        right, down = _offsets(self.side)
        (a, b), (c, d) = self.turn.astype(np.float32)
        u, v = (np.float32(at) for at in self.middle)
        u, v = u + a * right + b * down, v + c * right + d * down
        house_u, house_v = u, v
        if self.has.off_m:
            cells = self.has.off_m / sheet.grid.cell_size_m
            off = cells * rng.uniform(0, 0.7) * _direction(rng)
            bend = (off + 0.1 * cells * rng.standard_normal((5, 5, 2))).astype(np.float32)
            wave = cv2.resize(bend, (self.side, self.side))
            u, v = u + wave[..., 0], v + wave[..., 1]
            own = (0.25 * cells * rng.uniform(0, 1) * _direction(rng)).astype(np.float32)
            house_u, house_v = u + own[0], v + own[1]
        self.u, self.v = house_u, house_v
        half = np.float32(0.5)  # OpenCV counts from the middle of a cell
        ground = np.asarray(cv2.remap(sheet.ground, u - half, v - half, cv2.INTER_NEAREST), dtype=np.uint16)
        built = np.asarray(cv2.remap(sheet.built, house_u - half, house_v - half, cv2.INTER_NEAREST), dtype=np.uint16)
        self.kerb_m = ground[..., 1].astype(np.float32) / np.float32(INCHES) - np.float32(BEYOND_M)
        shown = self.rows_of(len(sheet.things), self.things_at, self.has.missing).take(ground[..., 0])
        self.house = self.rows_of(len(sheet.buildings), 0, self.has.missing).take(built[..., 0])
        yard = self.rows_of(len(sheet.buildings), self.yards_at, rng.uniform(0, 0.6)).take(built[..., 1])
        self.is_free = shown == 0
        open_ground = np.where(yard > 0, yard, self.plots()) if self.has.ground else np.zeros_like(shown)
        if self.has.streets and rng.random() < 0.6:
            beside = rng.uniform(-3.5, -0.8)
            open_ground[(self.kerb_m > beside) & (self.kerb_m <= 0)] = _PLOTS + _SHOULDER
        self.shows = np.where(self.is_free, open_ground, shown)

    def rows_of(self, count: int, first: int, missing: float) -> Numbers:
        """Return the row for each number, 0 for those that are left out."""
        rows = np.arange(first, first + count)
        rows[self.rng.random(count) < missing] = 0
        rows[0] = 0
        return rows

    def plots(self) -> Numbers:
        """Divide open ground into plots, more or less rectangular."""
        rng, (right, down) = self.rng, _offsets(self.side)
        turn = rng.uniform(0, np.pi)
        cos, sin = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        wide, deep = np.exp(rng.uniform(np.log(12.0), np.log(160.0), size=2)) / self.px
        bend = np.float32(rng.uniform(0, 0.8) * min(wide, deep)) * self.tile(self.tiles.mottle)
        across = (right * cos + down * sin + bend) / np.float32(wide) + np.float32(rng.uniform(0, 99))
        ahead = (down * cos - right * sin + bend) / np.float32(deep) + np.float32(rng.uniform(0, 99))
        return np.asarray((np.floor(across) * 7 + np.floor(ahead) * 13).astype(np.int64) % _PLOTS)

    def stamp_unmapped(self) -> None:
        """Draw what no map has, on open ground: car parks with cars, tracks, hedges, sheds, pools."""
        rng, layer = self.rng, np.zeros((self.side, self.side), dtype=np.int32)
        metre = 1 / self.px
        for number in range(rng.poisson(0.5)):
            lot = _Boxes.of(rng, 1, self.side, half=rng.uniform(8, 30, size=(1, 2)) * metre)
            lot.fill(layer, [_PLOTS + _LOT + number % 4])
            self.fill_lot(layer, lot)
        for number in range(rng.poisson(1.5)):
            row, wide = (_TRACK, rng.uniform(1.0, 4.0)) if rng.random() < 0.6 else (_HEDGE, rng.uniform(0.8, 3.0))
            bend = rng.uniform(-0.2, 1.2, size=2) * self.side + np.cumsum(
                self.side * rng.uniform(0.05, 0.3) * np.cumsum(rng.standard_normal((6, 2)), axis=0) / 2, axis=0
            )
            thick = max(1, round(wide * metre))
            cv2.polylines(
                layer, [bend.astype(np.int32)], isClosed=False, color=_PLOTS + row + number % 4, thickness=thick
            )
        for first, kinds, many, size in ((_SHED, 8, 6.0, (1.2, 6.0)), (_POOL, 4, 1.0, (1.5, 6.0))):
            count = rng.poisson(many * rng.uniform(0, 1.5))
            boxes = _Boxes.of(rng, count, self.side, half=rng.uniform(*size, size=(count, 2)) * metre)
            boxes.fill(layer, (_PLOTS + first + rng.integers(kinds, size=count)).tolist())
        self.shows = np.where((layer > 0) & self.is_free, layer, self.shows)

    def fill_lot(self, layer: NDArray[np.int32], lot: "_Boxes") -> None:
        """Park cars in rows on a rectangle."""
        rng, metre = self.rng, 1 / self.px
        if not self.has.cars or rng.random() < 0.2:
            return
        axis, (long, short) = lot.axis[0], lot.half[0]
        side = np.array([-axis[1], axis[0]])
        ahead, across = np.arange(2 * metre - long, long, 2.7 * metre), np.arange(3 * metre - short, short, 8 * metre)
        at = (ahead[:, None, None] * axis + across[None, :, None] * side).reshape(-1, 2) + lot.centre[0]
        at = at[rng.random(len(at)) < rng.uniform(0.1, 0.95)]
        self.draw_cars(layer, at, np.tile(side, (len(at), 1)))

    def stamp_cars(self) -> None:
        rng, metre = self.rng, 1 / self.px
        at, ahead, half = self.seen(self.sheet.roadside, rng.uniform(0, 0.7) ** 2)
        side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * rng.choice([-1.0, 1.0], size=(len(at), 1))
        lane = np.where(rng.random(len(at)) < 0.5, 0.45 * half, half - 0.9 * metre)
        stalls, across, _ = self.seen(self.sheet.stalls, rng.uniform(0, 1))
        places = np.concatenate([at + lane[:, None] * side, stalls])
        self.draw_cars(self.shows_as_int(), places, np.concatenate([ahead, across]))

    def shows_as_int(self) -> NDArray[np.int32]:
        self.shows = np.ascontiguousarray(self.shows, dtype=np.int32)
        return self.shows

    def draw_cars(self, layer: NDArray[np.int32], at: NDArray[np.float64], ahead: NDArray[np.float64]) -> None:
        rng, metre, count = self.rng, 1 / self.px, len(at)
        half = rng.uniform((1.9, 0.8), (2.5, 1.0), size=(count, 2)) * metre
        half[rng.random(count) < 0.06] *= (2.2, 1.3)  # vans and lorries
        cars = _Boxes(centre=at, axis=ahead, half=half)
        cars.fill(layer, (_PLOTS + _CAR + rng.integers(_GLASS - _CAR, size=count)).tolist())
        glass = _Boxes(centre=at + ahead * half[:, :1] * 0.3, axis=ahead, half=half * (0.16, 0.8))
        glass.fill(layer, [_PLOTS + _GLASS] * count)

    def seen(self, places: Field, share: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return some of the places that lie in the picture: pixels, directions and half widths in pixels."""
        back = np.linalg.inv(self.turn)
        at = (places[:, :2] - self.middle) @ back.T + self.side / 2
        chosen = np.flatnonzero(((at > 0) & (at < self.side)).all(axis=1) & (self.rng.random(len(at)) < share))
        ahead = places[chosen, 2:4] @ back.T
        ahead /= np.maximum(np.hypot(*ahead.T), 1e-9)[:, None]
        return at[chosen], ahead, places[chosen, 4] * self.sheet.grid.cell_size_m / self.px

    def raise_buildings(self) -> None:
        """Show buildings from a little aside, so that tall ones lean over and show a wall."""
        rng, house = self.rng, self.house
        count = len(self.sheet.buildings)
        lean = 0.4 * rng.beta(1.0, 2.5) / self.px if self.has.lean else 0.0
        ahead = _direction(rng)
        high = self.table.height_m[self.roofs_at : self.roofs_at + count] * lean  # pixels
        steps = min(8, math.ceil(float(high.max(initial=0.0)) / 1.5))
        step = max(1.5, float(high.max(initial=0.0)) / max(steps, 1))
        level = np.rint(high / step).astype(np.int64)
        level[0] = -1
        top, is_roof = house.copy(), level.take(house) == 0
        self.lifted = np.zeros(house.shape, dtype=np.int64)
        for number in range(1, steps + 1):
            right, down = np.rint(ahead * step * number).astype(int)
            moved = _moved(house, int(right), int(down))
            reach = level.take(moved)
            above = reach >= number
            np.copyto(top, moved, where=above)
            np.copyto(is_roof, reach == number, where=above)
            np.copyto(self.lifted, number, where=above)
        self.lift_uv = (self.turn @ (ahead * step)).astype(np.float32)
        self.top, self.is_roof = top, is_roof
        rows = np.where(is_roof, self.roofs_at, self.walls_at) + top
        self.shows = np.where(top > 0, rows, self.shows)
        if self.has.roofs:
            self.stamp_plant(ahead * step, level)

    def stamp_plant(self, lift: NDArray[np.float64], level: Numbers) -> None:
        """Put boxes on flat roofs: lift houses, vents, skylights."""
        rng, houses = self.rng, self.sheet.buildings
        at = (houses.centre - self.middle) @ np.linalg.inv(self.turn).T + self.side / 2
        inside = ((at > 0) & (at < self.side)).all(axis=1)
        chosen = np.flatnonzero(inside & (self.form == _FLAT) & (houses.half[:, 1] * self.sheet.grid.cell_size_m > 4))
        if not len(chosen):
            return
        chosen = chosen.repeat(rng.integers(0, 6, size=len(chosen)))
        half = houses.half[chosen] * self.sheet.grid.cell_size_m / self.px
        axis = houses.axis[chosen] @ np.linalg.inv(self.turn).T
        axis /= np.maximum(np.hypot(*axis.T), 1e-9)[:, None]
        side, where = np.stack([-axis[:, 1], axis[:, 0]], axis=1), rng.uniform(-0.8, 0.8, size=(len(chosen), 2)) * half
        centre = at[chosen] + where[:, :1] * axis + where[:, 1:] * side + level[chosen][:, None] * lift
        size = np.minimum(rng.uniform(0.4, 3.0, size=(len(chosen), 2)) / self.px, 0.4 * half)
        layer = np.zeros(self.shows.shape, dtype=np.int32)
        plant = (_PLOTS + _PLANT + rng.integers(_SHOULDER - _PLANT, size=len(chosen))).tolist()
        _Boxes(centre=centre, axis=axis, half=size).fill(layer, plant)
        here = (layer > 0) & self.is_roof
        raised = self.table.height_m.take(self.shows)
        self.shows = np.where(here, layer, self.shows)
        self.extra_m = np.where(here, raised, 0)

    def stamp_trees(self) -> None:
        """Put groves and single trees into yards, parks and open ground, and along streets, some over the road."""
        rng, layer, metre = self.rng, self.shows_as_int(), 1 / self.px
        grows = np.zeros(len(self.table.colour), dtype=bool)
        grows[:_PLOTS] = grows[self.yards_at :] = True
        grows[self.parks] = True
        if rng.random() < 0.7:
            dense = self.tile(self.tiles.mottle, int(rng.integers(2))) > rng.uniform(0.6, 2.2)
            if rng.random() < 0.5:  # within parks, yards and plots; else across whatever is not built
                dense &= grows.take(layer)
            layer[dense & (self.top == 0)] = _PLOTS + _CROWN + int(rng.integers(_LIT - _CROWN))
        count = rng.poisson(np.exp(rng.uniform(np.log(3.0), np.log(120.0))) * (self.side * self.px / 128) ** 2)
        at = rng.uniform(0, self.side, size=(count, 2))
        cells = layer[at[:, 1].astype(int), at[:, 0].astype(int)]
        at = at[grows[cells]]
        along_street, ahead, half = self.seen(self.sheet.roadside, rng.uniform(0, 0.8) ** 3)
        side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * rng.choice([-1.0, 1.0], size=(len(half), 1))
        at = np.concatenate([at, along_street + side * (half + rng.uniform(0, 4) * metre)[:, None]])
        radius = np.exp(rng.normal(np.log(rng.uniform(1.5, 4.0)), 0.35, size=len(at))) * metre
        kinds = rng.integers(_LIT - _CROWN, size=len(at))
        lit = at + 0.3 * radius[:, None] * self.sun
        for (x, y), (bright_x, bright_y), size, kind in zip(
            (at * 8).astype(int).tolist(),
            (lit * 8).astype(int).tolist(),
            (radius * 8).tolist(),
            kinds.tolist(),
            strict=True,
        ):
            cv2.circle(layer, (x, y), int(size), _PLOTS + _CROWN + kind, cv2.FILLED, cv2.LINE_8, 3)
            cv2.circle(layer, (bright_x, bright_y), int(0.62 * size), _PLOTS + _LIT + kind, cv2.FILLED, cv2.LINE_8, 3)

    # How it looks.

    def tile(self, tiles: tuple[Field, ...], size: int | None = None) -> Field:
        """Return a window of a texture, turned any way; of a given number among the tiles, or of any."""
        rng = self.rng
        whole = tiles[int(rng.integers(len(tiles))) if size is None else size]
        row, col = rng.integers(max(1, len(whole) - self.side + 1), size=2)
        part = whole[row : row + self.side, col : col + self.side]
        if part.shape != (self.side, self.side):  # a larger picture than the texture
            at = np.arange(self.side)
            part = whole.take(row + at, axis=0, mode="wrap").take(col + at, axis=1, mode="wrap")
        return np.asarray(part[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])])

    def texture(self) -> Field:
        """Return the brightness of each pixel, 1 on even ground."""
        table, shows = self.table, self.shows
        tone = 1 + table.mottle.take(shows) * self.tile(self.tiles.mottle)
        tone += table.grain.take(shows) * self.tile(self.tiles.grain)
        if table.crowns.any():
            crown_px = np.exp(self.rng.uniform(np.log(2.5), np.log(9.0))) / self.px
            size = int(np.abs(np.log(np.array(_CROWN_PX) / crown_px)).argmin())
            tone += table.crowns.take(shows) * self.tile(self.tiles.crowns, size)
        if table.furrow.any() or table.lattice.any():
            across_u, across_v = (part.take(shows) for part in table.along.T)
            wave = np.sin(across_u * self.u + across_v * self.v)
            tone += table.furrow.take(shows) * wave
            if table.lattice.any():
                rows = table.lattice.take(shows) * np.sin(across_v * self.u - across_u * self.v)
                tone += np.minimum(rows * wave, 0.1)
        return np.asarray(np.maximum(tone, 0.1), dtype=np.float32)

    def shape_roofs(self, colour: Field, tone: Field) -> None:
        """Give roofs two faces or four, terraces and courtyards."""
        at = np.flatnonzero(self.is_roof & (self.shows >= self.roofs_at))
        if not len(at) or not self.has.roofs:
            return
        rng, houses = self.rng, self.sheet.buildings
        house, lifted = self.top.ravel()[at], self.lifted.ravel()[at].astype(np.float32)
        u = self.u.ravel()[at] - lifted * self.lift_uv[0] - houses.centre[:, 0].take(house)
        v = self.v.ravel()[at] - lifted * self.lift_uv[1] - houses.centre[:, 1].take(house)
        axis_u, axis_v = (part.take(house) for part in houses.axis.T)
        long, short = (part.take(house) for part in houses.half.T)
        ahead, across = u * axis_u + v * axis_v, v * axis_u - u * axis_v
        form = self.form.take(house)
        is_end = (form == _HIP) & (long - np.abs(ahead) < short - np.abs(across))
        facing = np.where(is_end, axis_u * self.sun_uv[0] + axis_v * self.sun_uv[1], 0)
        sideways = axis_u * self.sun_uv[1] - axis_v * self.sun_uv[0]
        facing = np.where(is_end, facing * np.sign(ahead), sideways * np.sign(across))
        shade = 1 + np.float32(rng.uniform(0.1, 0.5)) * np.where(form == _FLAT, 0, facing)
        unit = self.unit.take(house)
        shade *= 1 + np.float32(0.25) * (np.modf(np.abs(np.floor(ahead / unit) * 0.618 + 0.3))[0] - 0.5) * (unit < 1e5)
        ridge = (np.abs(across) < 0.4 * self.px / self.sheet.grid.cell_size_m) & (form == _GABLE)
        shade[ridge] *= np.float32(rng.uniform(0.85, 1.25))
        rim = short - np.abs(across) < 1.2
        shade[rim & (form == _FLAT)] *= np.float32(rng.uniform(0.7, 1.3))
        tone.ravel()[at] *= shade
        court = self.court.take(house)
        is_court = (np.abs(ahead) < court * long) & (np.abs(across) < court * short)
        yard = at[is_court]
        self.shows.ravel()[yard] = self.yards_at + house[is_court]
        colour.reshape(-1, 3)[yard] = self.table.colour.take(self.yards_at + house[is_court], axis=0)

    def mark_streets(self, colour: Field, tone: Field) -> None:
        """Draw kerbs, lanes on wide streets, and rails."""
        rng, things = self.rng, self.sheet.things
        last = self.things_at + len(things)
        at = np.flatnonzero((self.kerb_m > 0) & (self.shows >= self.things_at) & (self.shows < last))
        if not len(at):
            return
        kerb_m, row = self.kerb_m.ravel()[at], self.shows.ravel()[at] - self.things_at
        wide_m = things.width_m.take(row)
        line_m = max(0.25, 0.6 * self.px)
        is_edge = (kerb_m < line_m) & (wide_m > 0)
        tone.ravel()[at[is_edge]] *= np.float32(rng.uniform(0.8, 1.3))
        if rng.random() < 0.25:
            return
        has_lanes = wide_m >= rng.uniform(5, 8)
        on_line = np.abs(kerb_m - wide_m / 2) < line_m / 2
        on_line |= (np.abs(kerb_m - wide_m / 4) < line_m / 2) & (wide_m > 10)
        dash = np.sin((self.u.ravel()[at] + 1.3 * self.v.ravel()[at]) * 0.5) > rng.choice([-2.0, -0.3, 0.2])
        is_rail = (things.look == "railway").take(row)
        on_rail = is_rail & (np.abs(np.abs(kerb_m - wide_m / 2) - 0.75) < max(0.2, self.px / 2))
        tone.ravel()[at[on_rail]] *= np.float32(rng.uniform(0.6, 1.5))
        marks = at[has_lanes & on_line & dash & ~is_rail]
        white = np.float32(rng.uniform(0.3, 0.95))
        pixels = colour.reshape(-1, 3)
        pixels[marks] += white * (np.float32(rng.uniform(190, 240)) - pixels[marks])

    def glint(self, tone: Field) -> None:
        """Let the sun sparkle on water, or ripples show, in some pictures."""
        rng, looks = self.rng, self.sheet.things.look
        is_water = np.zeros(len(self.table.colour), dtype=bool)
        is_water[self.things_at : self.roofs_at] = looks == "water"
        if rng.random() < 0.6 or not is_water.any():
            return
        wet = is_water.take(self.shows)
        sparkle = self.tile(self.tiles.grain) * np.float32(rng.uniform(0.05, 0.5))
        sheen = np.float32(rng.uniform(0, 1.5)) * np.maximum(self.tile(self.tiles.mottle), 0)
        tone += wet * (np.maximum(sparkle, -0.2) + sheen)

    def shadow(self) -> Field:
        """Return the light that each pixel has left where things stand between it and the sun."""
        rng, drop = self.rng, np.float32(np.tan(self.elevation) * self.px)
        high = self.table.height_m.take(self.shows)
        if self.extra_m is not None:
            high += self.extra_m
        shade = high
        for power in range(6):
            right, down = np.rint(-self.sun * 2**power).astype(int)
            shade = np.maximum(shade, _moved(shade, int(right), int(down)) - drop * np.float32(2**power))
        dark = np.asarray(cv2.blur((shade > high + np.float32(0.4)).astype(np.float32), (3, 3)))
        deep = rng.uniform(0.2, 0.75) if rng.random() < 0.85 else rng.uniform(0, 0.1)
        return np.asarray(1 - np.float32(deep) * dark)

    def develop(self, colour: Field) -> Picture:
        """Mix channels, and change light, haze and contrast."""
        rng = self.rng
        mix = np.eye(3) + rng.choice([0.03, 0.12, 0.3], p=(0.5, 0.35, 0.15)) * rng.standard_normal((3, 3))
        mix /= mix.sum(axis=1, keepdims=True).clip(0.5, 2)
        if rng.random() < 0.1:
            mix += rng.uniform(0.5, 1.0) * (np.full((3, 3), 1 / 3) - mix)  # little colour, or none
        gain = np.exp(rng.normal(0, (0.12, 0.12, 0.12))) * np.exp(rng.normal(0, 0.2))
        haze = rng.beta(1, 5) * 0.7
        veil = rng.uniform(120, 235) * np.exp(0.08 * rng.standard_normal(3))
        change = np.column_stack([mix * (gain * (1 - haze))[:, None], haze * veil])
        developed = np.asarray(cv2.transform(colour, change.astype(np.float32)), dtype=np.float32)
        if rng.random() < 0.3:
            light = 1 + np.float32(rng.uniform(0, 0.35)) * self.tile(self.tiles.mottle, len(self.tiles.mottle) - 1)
            developed *= light[..., None]
        level = float(developed[::8, ::8].mean())
        if rng.random() < 0.85:  # most are exposed so that they are neither dark nor bright
            developed *= np.float32(np.clip(level, 70, 165) / max(level, 1))
        levels = 255 * (np.arange(256) / 255) ** np.exp(rng.uniform(-0.35, 0.35))
        return np.asarray(cv2.LUT(np.clip(developed, 0, 255).astype(np.uint8), levels.astype(np.uint8)), dtype=np.uint8)

    def sense(self, picture: Picture) -> Picture:
        """Take the picture by some sensor: its resolution, sharpness, noise and compression."""
        rng, size = self.rng, (self.side, self.side)
        seen = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.4, 0.9))
        if rng.random() < 0.6:
            sensor_px = max(8, round(self.side / rng.uniform(1.0, max(1.01, _COARSEST_M / self.px))))
            small = cv2.resize(seen, (sensor_px, sensor_px), interpolation=cv2.INTER_AREA)
            seen = cv2.resize(small, size, interpolation=int(rng.choice([cv2.INTER_LINEAR, cv2.INTER_CUBIC])))
        if rng.random() < 0.25:  # pan-sharpened: colours are coarser than brightness
            fine = cv2.cvtColor(seen, cv2.COLOR_RGB2YCrCb)
            small = cv2.resize(fine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
            fine[..., 1:] = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)[..., 1:]
            seen = cv2.cvtColor(fine, cv2.COLOR_YCrCb2RGB)
        if rng.random() < 0.4:
            more, wide = rng.uniform(0.2, 1.8), rng.uniform(0.8, 2.0)
            seen = cv2.addWeighted(seen, 1 + more, cv2.GaussianBlur(seen, (0, 0), wide), -more, 0)
        if rng.random() < 0.6:
            noise = np.rint(np.float32(rng.uniform(0.5, 9.0)) * self.tile(self.tiles.grain, 0)).astype(np.int16)
            seen = np.clip(seen + noise[..., None], 0, 255).astype(np.uint8)
        if rng.random() < 0.6:
            packed = cv2.imencode(".jpg", seen, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))])[1]
            seen = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))
        return np.asarray(seen, dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Boxes:
    """Rotated rectangles in pixels: centre, axis along the long side, half sides; each of shape (N, 2)."""

    centre: NDArray[np.float64]
    axis: NDArray[np.float64]
    half: NDArray[np.float64]

    @classmethod
    def of(cls, rng: Rng, count: int, side_px: int, *, half: NDArray[np.float64]) -> "_Boxes":
        """Lay rectangles anywhere."""
        turn = rng.uniform(0, np.pi, size=count)
        axis = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return cls(centre=rng.uniform(0, side_px, size=(count, 2)), axis=axis, half=half)

    def fill(self, layer: NDArray[np.int32], values: list[int]) -> None:
        half = np.maximum(self.half - 0.4, 0.3)  # OpenCV fills the pixels of the outline, too
        ahead = self.axis * half[:, :1]
        left = np.stack([-self.axis[:, 1], self.axis[:, 0]], axis=1) * half[:, 1:]
        corners = self.centre[:, None] + np.stack([ahead + left, ahead - left, -ahead - left, left - ahead], axis=1)
        for box, value in zip(np.round((corners - 0.5) * 8).astype(np.int32), values, strict=True):
            cv2.fillConvexPoly(layer, box, value, lineType=cv2.LINE_8, shift=3)


@lru_cache(maxsize=4)
def _offsets(side_px: int) -> tuple[Field, Field]:
    """Return how far pixels lie right of and below the middle of a picture, shapes (1, W) and (H, 1)."""
    steps = np.arange(side_px, dtype=np.float32) + np.float32(0.5 - side_px / 2)
    return steps[None, :], steps[:, None]


def _direction(rng: Rng) -> NDArray[np.float64]:
    turn = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(turn), np.sin(turn)])


def _moved(values: NDArray[Number], right: int, down: int) -> NDArray[Number]:
    """Return a raster moved by whole pixels; 0 comes in at its edge."""
    rows, cols = values.shape
    moved = np.zeros_like(values)
    if abs(right) < cols and abs(down) < rows:
        to = np.s_[max(down, 0) : rows + min(down, 0), max(right, 0) : cols + min(right, 0)]
        moved[to] = values[max(-down, 0) : rows - max(down, 0), max(-right, 0) : cols - max(right, 0)]
    return moved


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tiles:
    """Textures of mean 0, each (_TILE_PX, _TILE_PX): fine noise, wide noise, and crowns of trees of some widths."""

    grain: tuple[Field, ...]
    mottle: tuple[Field, ...]
    crowns: tuple[Field, ...]


@lru_cache(maxsize=1)
def _tiles() -> _Tiles:
    rng = np.random.default_rng(0)

    def smooth(sigma: float) -> Field:
        white = rng.standard_normal((_TILE_PX, _TILE_PX), dtype=np.float32)
        found = cv2.GaussianBlur(white, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE) if sigma else white
        return np.asarray(found / found.std())

    fine, wide = [smooth(sigma) for sigma in (0.0, 0.7, 1.3)], [smooth(sigma) for sigma in (4.0, 10.0, 25.0, 60.0)]
    mottle = [wide[0] * 0.5 + wide[1], wide[1] * 0.6 + wide[2] + fine[2] * 0.3, wide[2] * 0.5 + wide[3]]
    return _Tiles(
        grain=tuple(fine),
        mottle=tuple(np.asarray(part / part.std()) for part in mottle),
        crowns=tuple(_crowns(rng, wide_px) for wide_px in _CROWN_PX),
    )


def _crowns(rng: Rng, wide_px: float) -> Field:
    """Return a canopy from above: domes about `wide_px` wide, each of a brightness of its own, dark between them."""
    steps = np.arange(0, _TILE_PX, wide_px)
    places = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    places = (places + rng.uniform(0, wide_px, size=places.shape)).astype(int).clip(0, _TILE_PX - 1)
    seeds = np.ones((_TILE_PX, _TILE_PX), dtype=np.uint8)
    seeds[places[:, 1], places[:, 0]] = 0
    away, tree = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    dome = np.sqrt(np.maximum(1 - (away / np.float32(0.75 * wide_px)) ** 2, 0))
    lit = cv2.Sobel(dome, cv2.CV_32F, 1, 1, ksize=3) * np.float32(0.1 * wide_px)
    own = rng.normal(0, 0.12, size=int(tree.max()) + 1).astype(np.float32)[tree]
    canopy = 0.7 * dome + np.clip(lit, -0.3, 0.3) + own
    return np.asarray(canopy - canopy.mean(), dtype=np.float32)
