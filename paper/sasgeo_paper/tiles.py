# SPDX-License-Identifier: Apache-2.0
"""The 30 procedural regions, side by side; their windows, global descriptors, and similar candidates."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Self

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import make_features
from sasgeo_bench.osm.synthetic.sketch import Line, Sketch, Way, curve, house, join_streets, wobble
from sasgeo_bench.osm.taxonomy import classify, load_taxonomy
from sasgeo_bench.regions.layers import PRESENT
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.suites.base import Seeds

CLASSES: Final = ("road_major", "building", "water", "road_minor", "field_boundary")
TILES: Final = 30
TILE_M: Final = 256.0
CELL_M: Final = 1.0
GAP_M: Final = 64.0  # unmapped, between tiles and around them
ACROSS: Final = 6  # tiles from west to east
EPSG: Final = 32631
CORNER_M: Final = (500_000.0, 102_000.0)  # west and north of the mosaic, in the Gulf of Guinea: it must lie somewhere

_DOWN: Final = TILES // ACROSS
_HALF_M: Final = TILE_M / 2
_BEYOND: Final = 1.5 * _HALF_M  # lines are drawn so far from the middle, so that they cross the tile at any heading
_SHORTEST_M: Final = 8.0  # of a piece of street or hedge
_DECIMALS: Final = 3  # as in `extract.read`

Point = tuple[float, float]


def mosaic_grid() -> Grid:
    """Return the lattice that holds all tiles."""
    rows, cols = (round((count * (TILE_M + GAP_M) + GAP_M) / CELL_M) for count in (_DOWN, ACROSS))
    return Grid(epsg=EPSG, west_m=CORNER_M[0], north_m=CORNER_M[1], cell_size_m=CELL_M, rows=rows, cols=cols)


def tile_centre_m(tile: int) -> Point:
    """Return easting and northing of the middle of a tile; tiles are counted from the north-west, row by row.

    >>> tile_centre_m(0), tile_centre_m(1)
    ((500192.0, 101808.0), (500512.0, 101808.0))
    """
    down, right = divmod(tile, ACROSS)
    first_m = GAP_M + _HALF_M
    return CORNER_M[0] + first_m + right * (TILE_M + GAP_M), CORNER_M[1] - first_m - down * (TILE_M + GAP_M)


def tile_boxes() -> NDArray[np.object_]:
    """Return outlines of all tiles: the mapped area."""
    centres = np.array([tile_centre_m(tile) for tile in range(TILES)])
    return np.asarray(shapely.box(*(centres - _HALF_M).T, *(centres + _HALF_M).T))


@lru_cache(maxsize=8)  # readings of one seed share its tiles
def make_tiles(seeds: Seeds) -> gpd.GeoDataFrame:
    """Draw all tiles, each from its own random stream, as a feature table; no feature leaves its tile.

    Whoever asks again for the same tiles gets the same table: do not write to it.
    """
    taxonomy = load_taxonomy()
    rows: list[tuple[str, float, shapely.Geometry]] = []
    for tile in range(TILES):
        centre_m = tile_centre_m(tile)
        for way in draw_tile(seeds.rng("tile", tile)):
            labels = classify(way.tags, taxonomy)
            label = (labels.line or labels.area)[0]
            shape = shapely.linestrings(way.line) if labels.line else shapely.polygons(way.line)
            width_m = float("nan") if label.width_m is None else label.width_m
            rows.append((label.class_name, width_m, _moved(shape, centre_m)))
    rows.sort(key=lambda row: taxonomy.names.index(row[0]))  # stable: within a class by tile, then as drawn
    count = len(rows)
    return make_features(
        {
            "osm_type": ["way"] * count,
            "osm_id": np.arange(1, count + 1),
            "version": np.ones(count, dtype=np.int32),
            "timestamp": np.full(count, "NaT", dtype="datetime64[ms]"),
            "class": [name for name, _, _ in rows],
            "level": np.zeros(count, dtype=np.int16),
            "is_bridge": np.zeros(count, dtype=bool),
            "is_tunnel": np.zeros(count, dtype=bool),
            "is_visible": np.ones(count, dtype=bool),
            "width_m": np.array([width_m for _, width_m, _ in rows], dtype=np.float32),
            "geometry": np.array([shape for _, _, shape in rows], dtype=object),
        },
        epsg=EPSG,
    )


def _moved(shape: shapely.Geometry, centre_m: Point) -> shapely.Geometry:
    return shapely.transform(shape, lambda at: (at + centre_m).round(_DECIMALS) + 0.0)


def draw_tile(rng: np.random.Generator) -> list[Way]:
    """Draw one tile around (0, 0): main road, river or ponds, streets with houses, fields on the rest."""
    sketch = Sketch(half_m=_HALF_M, rng=rng)
    heading = float(rng.uniform(0, np.pi))
    main = _main_roads(sketch, heading)
    wet = _water(sketch, heading, main)
    village = shapely.Point(*rng.uniform(-60, 60, 2)).buffer(float(rng.uniform(75, 115)))
    streets = _streets(sketch, heading, village, wet)
    for line in (*main, *streets):
        _houses(sketch, line, village)
    _barns(sketch, village)
    _hedges(sketch, heading + float(rng.uniform(-0.3, 0.3)), village, wet)
    return join_streets(sketch.ways)


def _turned(points: list[Point] | Line, heading: float) -> Line:
    """Turn points (across, along) of a heading, clockwise from north in radians, into points (east, north)."""
    across, along = np.asarray(points, dtype=np.float64).T
    sin, cos = np.sin(heading), np.cos(heading)
    return np.column_stack((across * cos + along * sin, along * cos - across * sin))


def _crossing(sketch: Sketch, heading: float, offset_m: float, sway_m: float) -> Line:
    """Return a bent line from edge to edge of the tile."""
    across = offset_m + sketch.rng.uniform(-sway_m, sway_m, 4)
    along = np.linspace(-_BEYOND, _BEYOND, 4)
    return curve(_turned(np.column_stack((across, along)), heading).tolist())


def _inside(sketch: Sketch, line: Line) -> list[Line]:
    """Return the parts of a line within the tile."""
    return _pieces(shapely.intersection(shapely.linestrings(line), sketch.square))


def _pieces(shape: shapely.Geometry) -> list[Line]:
    """Return the longer lines of a geometry."""
    parts = shapely.get_parts(shapely.line_merge(shape) if shape.geom_type == "MultiLineString" else shape)
    return [
        shapely.get_coordinates(part) for part in parts if part.geom_type == "LineString" and part.length >= _SHORTEST_M
    ]


def _main_roads(sketch: Sketch, heading: float) -> list[Line]:
    """Return a main road through the middle part; in one tile of three another one across it."""
    rng = sketch.rng
    lines = [_crossing(sketch, heading, float(rng.uniform(-45, 45)), 14.0)]
    if rng.random() < 1 / 3:
        lines.append(_crossing(sketch, heading + float(rng.uniform(1.1, 2.0)), float(rng.uniform(-70, 70)), 10.0))
    found = [part for line in lines for part in _inside(sketch, line)]
    for part in found:
        sketch.street(part, highway="secondary")
    return found


def _water(sketch: Sketch, heading: float, main: list[Line]) -> shapely.Geometry:
    """Return a river along the valley or, in every other tile, some ponds; nothing is built there."""
    rng = sketch.rng
    shapes: list[shapely.Geometry] = []
    ponds = int(rng.integers(0, 2))
    if rng.random() < 0.5:  # one tile of two
        side = float(rng.choice((-1.0, 1.0)))
        line = _crossing(sketch, heading + float(rng.uniform(-0.4, 0.4)), side * float(rng.uniform(30, 85)), 22.0)
        shapes.append(shapely.buffer(shapely.linestrings(line), float(rng.uniform(5, 9))))
    else:
        ponds += 2
    roads = shapely.union_all([shapely.linestrings(line) for line in main])
    for _ in range(ponds):
        spot = shapely.Point(*rng.uniform(-105, 105, 2)).buffer(float(rng.uniform(8, 16)), quad_segs=5)
        pond = affinity.rotate(affinity.scale(spot, 1.0, float(rng.uniform(0.5, 1.0))), float(rng.uniform(0, 180)))
        if shapely.distance(pond, roads) > 6:  # metres
            shapes.append(pond)
    # Each by itself: a union may have a hole, and what has one is no way.
    for part in shapely.get_parts(shapely.intersection(np.array(shapes, dtype=object), sketch.square)):
        sketch.ground(part, is_free=False, natural="water")
    wet = shapely.union_all(shapes) if shapes else shapely.Polygon()
    if not wet.is_empty:
        sketch.keep_free(wet.buffer(3))
    return wet


def _streets(sketch: Sketch, heading: float, village: shapely.Geometry, wet: shapely.Geometry) -> list[Line]:
    """Return a loose net of streets in the village, some pieces missing, and a lane or two into the fields."""
    rng = sketch.rng
    net_heading = heading + float(rng.uniform(-0.15, 0.15))
    ground = shapely.difference(shapely.intersection(village, sketch.square), wet.buffer(6))
    found: list[Line] = []
    for turn, least_m, most_m in ((0.0, 46.0, 62.0), (np.pi / 2, 62.0, 90.0)):
        for offset_m in _offsets(rng, least_m, most_m):
            line = wobble(_crossing(sketch, net_heading + turn, offset_m, 3.0), 1.0, rng)
            for part in _pieces(shapely.intersection(shapely.linestrings(line), ground)):
                if rng.random() < 0.85:  # of the streets are there
                    found.append(part)  # noqa: PERF401 - each draws its chance
    centre = shapely.get_coordinates(village.centroid)[0]
    for number in rng.permutation(len(found))[: int(rng.integers(1, 3))]:
        start = max(found[number][[0, -1]], key=lambda end: float(np.hypot(*(end - centre))))
        ahead = (start - centre) / max(float(np.hypot(*(start - centre))), 1.0)
        bend = float(rng.uniform(-0.3, 0.3)) * np.array((ahead[1], -ahead[0]))
        lane = shapely.linestrings(curve([start, start + 60 * (ahead + bend), start + 220 * ahead]))
        found += _pieces(shapely.intersection(shapely.difference(lane, wet.buffer(6)), sketch.square))[:1]
    for part in found:
        sketch.street(part, highway="residential")
    return found


def _offsets(rng: np.random.Generator, least_m: float, most_m: float) -> list[float]:
    """Return offsets of parallel lines, from one side of the tile to the other."""
    offsets = -_BEYOND + np.cumsum(rng.uniform(least_m, most_m, 2 * round(_BEYOND / least_m)))
    return [float(offset) for offset in offsets if offset < _BEYOND]


def _houses(sketch: Sketch, line: Line, village: shapely.Geometry) -> None:
    """Draw houses on both sides of a road where it runs through the village."""
    for part in _pieces(shapely.intersection(shapely.linestrings(line), village)):
        sketch.houses_along(part, spacing_m=16.0, setback_m=7.5, size_m=(11.0, 9.0), chance=0.8)


def _barns(sketch: Sketch, village: shapely.Geometry) -> None:
    """Draw some larger buildings in and around the village."""
    rng = sketch.rng
    centre = shapely.get_coordinates(village.centroid)[0]
    for _ in range(int(rng.integers(4, 9))):
        spot = centre + rng.uniform(-120, 120, 2)
        long_m, short_m, turn = (float(rng.uniform(*span)) for span in ((16, 34), (12, 18), (0, np.pi)))
        shape = house((float(spot[0]), float(spot[1])), long_m, short_m, turn, rng)
        sketch.build(shape, building="barn")


def _hedges(sketch: Sketch, heading: float, village: shapely.Geometry, wet: shapely.Geometry) -> None:
    """Draw borders of fields outside the village, broken by roads, water and houses, some of them removed."""
    rng = sketch.rng
    taken = shapely.union_all([village.buffer(-12), wet.buffer(2), *sketch.taken])
    for turn, least_m, most_m in ((0.0, 30.0, 52.0), (np.pi / 2, 55.0, 95.0)):
        for offset_m in _offsets(rng, least_m, most_m):
            line = _crossing(sketch, heading + turn, offset_m, 5.0)
            free = shapely.difference(shapely.intersection(shapely.linestrings(line), sketch.square), taken)
            for part in _pieces(free):
                if rng.random() < 0.85:  # of the borders are hedged
                    sketch.line(part, barrier="hedge")


WINDOW_CELLS: Final = 96
WINDOW_M: Final = WINDOW_CELLS * CELL_M
MARGIN_M: Final = 80.0  # from a window's middle to the edge of its tile: half a diagonal at scale 1.15 is 78.1 m
STEP_M: Final = 16.0
CANDIDATES: Final = 10


@dataclass(frozen=True, kw_only=True)
class Windows:
    """All candidate crops.

    `points_m` is the middle of each, easting and northing, shape (N, 2), `tile` the number of its tile, and `counts`,
    shape (N, 5), its global semantic descriptor: the number of its cells in which each of `CLASSES` is present.
    Another descriptor may take its place.
    """

    points_m: NDArray[np.float64]
    tile: NDArray[np.int64]
    counts: NDArray[np.int64] | NDArray[np.float64]

    @classmethod
    def of(cls, region: Region) -> Self:
        """Describe every window of a region made of tiles."""
        points_m, tile = lattice_m()
        rows, cols = np.rint(region.grid.to_uv(points_m)[:, ::-1]).astype(np.int64).T
        half = WINDOW_CELLS // 2
        counts = np.empty((len(points_m), len(CLASSES)), dtype=np.int64)
        for into, name in zip(counts.T, CLASSES, strict=True):
            below = np.zeros(np.add(region.grid.shape, 1), dtype=np.int64)
            below[1:, 1:] = (region.layer(name) == PRESENT).cumsum(axis=0).cumsum(axis=1)
            top, bottom, left, right = rows - half, rows + half, cols - half, cols + half
            into[:] = below[bottom, right] - below[top, right] - below[bottom, left] + below[top, left]
        return cls(points_m=points_m, tile=tile, counts=counts)

    def alike(self, anchor: int, count: int = CANDIDATES) -> NDArray[np.int64]:
        """Return a window and those with the nearest descriptors, no two of which overlap; nearest first.

        >>> row = np.array([(0.0, 0.0), (16.0, 0.0), (96.0, 0.0), (192.0, 0.0)])
        >>> counts = np.array([[10], [10], [30], [20]])
        >>> Windows(points_m=row, tile=np.zeros(4, dtype=np.int64), counts=counts).alike(0, 3).tolist()
        [0, 3, 2]
        """
        # Squares of whole numbers: no rounding decides which of two windows is nearer.
        squared = ((self.counts - self.counts[anchor]) ** 2).sum(axis=1)
        squared[anchor] = -1  # before a window that is quite alike
        found: list[int] = []
        for index in np.argsort(squared, kind="stable").tolist():
            if not self.meets(index, found).any():
                found.append(index)
            if len(found) == count:
                break
        return np.array(found, dtype=np.int64)

    def meets(self, index: int, others: list[int]) -> NDArray[np.bool_]:
        """Return whether a window overlaps each of some others."""
        apart_m = np.abs(self.points_m[others] - self.points_m[index]).max(axis=1)
        return np.asarray(apart_m < WINDOW_M)


def lattice_m() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the middles of all windows, tile by tile, shape (N, 2), metres, and the tile of each."""
    reach_m = TILE_M / 2 - MARGIN_M
    steps_m = np.arange(-reach_m, reach_m + STEP_M / 2, STEP_M)
    offsets_m = np.stack(np.meshgrid(steps_m, -steps_m), axis=-1).reshape(-1, 2)
    centres_m = np.array([tile_centre_m(tile) for tile in range(TILES)])
    points_m = (centres_m[:, None] + offsets_m).reshape(-1, 2)
    return points_m, np.repeat(np.arange(TILES), len(offsets_m))
