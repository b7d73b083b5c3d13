# SPDX-License-Identifier: Apache-2.0
"""What stands where in one window of a region: shapes by class, each with a seed of its own, before any paint."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import rasterio.features
import shapely
from affine import Affine
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import SEA
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.rendering.palettes import Palette
from sasgeo_bench.sensing.rendering.seasons import Colour, Season
from sasgeo_bench.sensing.rendering.texture import Field, Numbers, draw, seed_of

if TYPE_CHECKING:
    import geopandas as gpd

Cells = NDArray[np.int32]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]
Raster = NDArray[np.integer] | NDArray[np.floating]

# What a cell shows. A higher number hides a lower one.
GROUND, ROAD, WATER, CAR, CROWN, WALL, ROOF = range(7)
_STRIP_ROWS: Final = 256
_KINDS: Final = {"way": 0, "relation": 1, SEA: 2}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shapes:
    """Visible features of one class: geometry in the CRS of the region, and arrays of shape (N,).

    `width_m` is NaN for areas; `key` is the identity of a feature as a number, for `draw`.
    """

    geometry: NDArray[np.object_]
    width_m: Numbers
    key: NDArray[np.int64]
    level: NDArray[np.int64]
    is_bridge: Mask
    is_sea: Mask

    def __len__(self) -> int:
        return len(self.geometry)

    def part(self, chosen: Mask | NDArray[np.int64]) -> "Shapes":
        """Return the chosen features."""
        names = ("geometry", "width_m", "key", "level", "is_bridge", "is_sea")
        return Shapes(**{name: getattr(self, name)[chosen] for name in names})

    def areas(self, more_m: float = 0.0) -> NDArray[np.object_]:
        """Return lines buffered to their width and areas as they are, each grown by `more_m` on every side."""
        half_m = np.nan_to_num(self.width_m) / 2 + more_m
        return np.asarray(shapely.buffer(self.geometry, half_m, quad_segs=3, cap_style="flat"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """One window of a region, a palette, and the seed of the place.

    `salt` is 0, or that of another look of the place: it changes every draw that no `seed` decides.
    `corner_m` is where plots and stripes of another look are counted from, None for squares of 5 km.
    """

    grid: Grid
    place: str
    palette: Palette
    shapes: dict[str, Shapes]
    salt: int = 0
    corner_m: tuple[float, float] | None = None

    def of(self, look: str) -> Shapes:
        """Return the features of all classes that look like this one; there may be none."""
        return self.shapes[look] if look in self.shapes else no_shapes()

    def seed(self, purpose: str) -> int:
        """Return the seed of the place for one purpose."""
        return seed_of(self.place, purpose)

    def chance(self, purpose: str, key: NDArray[np.int64]) -> Numbers:
        """Return a number in [0, 1) for each feature, always the same for one place, feature and purpose."""
        return draw(self.seed(purpose), key)


@dataclass(slots=True, kw_only=True, eq=False)
class Canvas:
    """Rasters on the plan's grid while they are painted, shape (rows, cols): colour (x 3), height, kind, owner.

    `height_m` is above the ground plane; `owner` is the number of a building from 1 on, or 0; `lamps` is the light of
    street lamps; `built` is the share of built ground around each cell.
    """

    plan: Plan
    season: Season
    colour: Picture
    height_m: Field
    kind: Picture
    owner: Cells
    lamps: Picture = field(default_factory=lambda: np.zeros((1, 1), dtype=np.uint8))
    built: Field = field(default_factory=lambda: np.zeros((1, 1), dtype=np.float32))

    @property
    def grid(self) -> Grid:
        """Return the lattice."""
        return self.plan.grid

    def strips(self) -> Iterator[tuple[slice, Grid]]:
        """Yield strips of rows with their lattice: what is computed strip by strip needs little memory."""
        for row in range(0, self.grid.rows, _STRIP_ROWS):
            rows = min(_STRIP_ROWS, self.grid.rows - row)
            yield slice(row, row + rows), self.grid.window(row, 0, rows, self.grid.cols)

    def parts(self) -> Iterator["Canvas"]:
        """Yield the canvas in strips of rows, each a canvas that paints into this one."""
        for strip, grid in self.strips():
            is_whole = self.built.shape == self.grid.shape
            yield Canvas(
                plan=replace(self.plan, grid=grid),
                season=self.season,
                colour=self.colour[strip],
                height_m=self.height_m[strip],
                kind=self.kind[strip],
                owner=self.owner[strip],
                built=self.built[strip] if is_whole else self.built,
            )

    def tint(self, cells: Mask, colour: NDArray[np.floating] | Colour, share: Field | float = 1.0) -> None:
        """Mix a colour (one, or one for each chosen cell) into the chosen cells by a share (one, or a raster)."""
        colours, used = np.asarray(colour, dtype=np.float32), 0
        for strip, _ in self.strips():
            at = np.flatnonzero(cells[strip])
            if not len(at):
                continue
            here = self.colour[strip].reshape(-1, 3)
            old = here[at].astype(np.float32)
            part = share[strip].ravel()[at][:, None] if isinstance(share, np.ndarray) else np.float32(share)
            new = colours if colours.ndim == 1 else colours[used : used + len(at)]
            old += part * (new - old)
            here[at] = np.clip(old, 0, 255)
            used += len(at)

    def shade(self, cells: Mask, factor: Field) -> None:
        """Multiply the colour of the chosen cells, one factor for each of them."""
        used = 0
        for strip, _ in self.strips():
            at = np.flatnonzero(cells[strip])
            here = self.colour[strip].reshape(-1, 3)
            here[at] = np.clip(here[at] * factor[used : used + len(at), None], 0, 255)
            used += len(at)


def no_shapes() -> Shapes:
    """Return a class without features."""
    none = np.zeros(0)
    return Shapes(
        geometry=np.zeros(0, dtype=object),
        width_m=none,
        key=none.astype(np.int64),
        level=none.astype(np.int64),
        is_bridge=none.astype(bool),
        is_sea=none.astype(bool),
    )


def shapes_of(features: "gpd.GeoDataFrame", box: shapely.Geometry, *, salt: int = 0) -> dict[str, Shapes]:
    """Return the visible features that reach into a box, by the look of their class, ordered by level and identity.

    `salt` changes the keys, and with them all that is drawn for a feature; the order stays.
    """
    near = features[features["is_visible"].to_numpy() & shapely.intersects(features.geometry.to_numpy(), box)]
    kind = near["osm_type"].map(_KINDS).fillna(3).to_numpy(dtype=np.int64)
    key = near["osm_id"].to_numpy(dtype=np.int64) * 4 + kind
    looks = {item.name: item.look for item in load_taxonomy().classes}
    names, level = near["class"].map(looks).to_numpy(), near["level"].to_numpy(dtype=np.int64)
    order = np.lexsort((key, level))
    found = {}
    for name in sorted(set(names)):
        chosen = order[names[order] == name]
        found[str(name)] = Shapes(
            geometry=near.geometry.to_numpy()[chosen],
            width_m=near["width_m"].to_numpy(dtype=np.float64)[chosen],
            key=key[chosen] ^ salt,
            level=level[chosen],
            is_bridge=near["is_bridge"].to_numpy()[chosen],
            is_sea=kind[chosen] == _KINDS[SEA],
        )
    return found


def burn_numbers(geometry: NDArray[np.object_], grid: Grid) -> Cells:
    """Return the number from 1 on of the last area that covers each cell's centre, shape (rows, cols); else 0."""
    west, south, east, north = grid.bounds_m
    bounds = shapely.bounds(geometry).reshape(-1, 4)
    is_near = (bounds[:, 0] < east) & (bounds[:, 2] > west) & (bounds[:, 1] < north) & (bounds[:, 3] > south)
    kept = np.flatnonzero(is_near)  # bounds of what is empty or missing are NaN
    if not len(kept):
        return np.zeros(grid.shape, dtype=np.int32)
    pairs = [(_as_geojson(geometry[number]), int(number) + 1) for number in kept]
    burnt = rasterio.features.rasterize(pairs, grid.shape, transform=Affine(*grid.transform), fill=0, dtype=np.int32)
    return np.asarray(burnt, dtype=np.int32)


def _as_geojson(geometry: shapely.Geometry) -> Mapping[str, object]:
    """Return what `geometry.__geo_interface__` does, which takes ten times as long for a polygon."""
    if shapely.get_type_id(geometry) != shapely.GeometryType.POLYGON:
        return dict(geometry.__geo_interface__)
    rings = shapely.get_rings(geometry)
    return {"type": "Polygon", "coordinates": [shapely.get_coordinates(ring).tolist() for ring in rings]}


def inside_m(mask: Mask, grid: Grid) -> Field:
    """Return how far each cell of a mask is from its edge, metres; 0 outside."""
    found = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(found * np.float32(grid.cell_size_m), dtype=np.float32)


def blurred(values: Field, sigma_m: float, grid: Grid) -> Field:
    """Return a raster blurred by a Gaussian of a width in metres; wide ones are made on coarser cells."""
    factor = max(1, int(sigma_m / grid.cell_size_m / 4))
    small = values
    if factor > 1:
        size = (max(1, grid.cols // factor), max(1, grid.rows // factor))
        small = np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    sigma = sigma_m / grid.cell_size_m / factor
    wide = cv2.GaussianBlur(small, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    if factor > 1:
        wide = cv2.resize(wide, (grid.cols, grid.rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, dtype=np.float32)


def along(line: shapely.Geometry, spacing_m: float, offset_m: float = 0.0) -> Numbers:
    """Return points along a line with the direction there: easting, northing, cos, sin; shape (N, 4).

    The first point lies `offset_m` from the start. Rings of areas count as lines.
    """
    found = [np.zeros((0, 4))]
    for part in shapely.get_parts(line):
        path = shapely.get_exterior_ring(part) if shapely.get_type_id(part) == 3 else part
        at = np.arange(offset_m, shapely.length(path), spacing_m)
        if not len(at):
            continue
        here = shapely.get_coordinates(shapely.line_interpolate_point(path, at))
        ahead = shapely.get_coordinates(shapely.line_interpolate_point(path, at + 0.5))
        behind = shapely.get_coordinates(shapely.line_interpolate_point(path, np.maximum(at - 0.5, 0.0)))
        step = ahead - behind
        found.append(np.column_stack([here, step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]]))
    return np.concatenate(found)


def fill_boxes(target: Raster, boxes_m: Numbers, grid: Grid, values: Raster) -> None:
    """Fill rotated rectangles, rows of (easting, northing, cos, sin, half length, half width), each with its value."""
    west, south, east, north = grid.bounds_m
    near = (boxes_m[:, 0] > west) & (boxes_m[:, 0] < east) & (boxes_m[:, 1] > south) & (boxes_m[:, 1] < north)
    boxes, kept = boxes_m[near], values[near].tolist()
    ahead, left = boxes[:, 2:4] * boxes[:, 4:5], np.stack([-boxes[:, 3], boxes[:, 2]], axis=1) * boxes[:, 5:6]
    corners = boxes[:, None, :2] + np.stack([ahead + left, ahead - left, -ahead - left, left - ahead], axis=1)
    points = np.round((grid.to_uv(corners.reshape(-1, 2)) - 0.5) * 8).astype(np.int32).reshape(-1, 4, 2)
    for box, value in zip(points, kept, strict=True):
        cv2.fillConvexPoly(target, box, value, lineType=cv2.LINE_8, shift=3)


_STRIDE: Final = 8  # pixels between the rays for which the highest thing is looked up
_STRIP_PX: Final = 96  # a multiple of the stride
_STEP_CELLS: Final = 0.9
_LOW_M: Final = 0.05  # what is lower casts no ray off its way
_CHUNK: Final = 32_768  # rays followed at a time, so that they stay in the cache
_AT_ONCE: Final = 4  # steps
_AHEAD: Final = np.arange(_AT_ONCE, dtype=np.float32)[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hits:
    """First surfaces that the pixels of a picture see, all of shape (H, W), float32.

    `col` and `row` are continuous cells of the scene (pixel-is-area), `z_m` the height there, `cells_px` how many cells
    a pixel is wide on the ground, `fall` how steeply a ray falls (sine). `is_side` marks walls and flanks of crowns;
    `is_ground` is False above the horizon. `ahead` (2, H, W) is the direction of the ray in plan, cells (col, row)
    per metre of fall.
    """

    col: Field
    row: Field
    z_m: Field
    cells_px: Field
    fall: Field
    ahead: Field
    is_side: Mask
    is_ground: Mask


class HeightPyramid:
    """A height raster and, for each level, the highest cell in and around every block of 2 ** level cells.

    The raster is taken over, not copied; its border is made level ground.
    """

    def __init__(self, height_m: Field) -> None:
        height_m[[0, -1]] = 0
        height_m[:, [0, -1]] = 0
        self.height_m = height_m
        level = height_m
        levels: list[Field] = []
        while max(level.shape) > 4 or not levels:
            level = _halved(level)
            levels.append(np.asarray(cv2.dilate(level, np.ones((3, 3), np.uint8)), dtype=np.float32))
        self._rows, self._cols = (np.array([1, *(part.shape[axis] for part in levels)], np.int32) for axis in (0, 1))
        self._start = np.cumsum([0, 0, *(part.size for part in levels)], dtype=np.int32)
        self._blocks = np.concatenate([part.ravel() for part in levels])
        self.highest_m = float(levels[-1].max())

    def highest_within(self, col: Field, row: Field, radius: Field) -> Field:
        """Return at least the highest cell within a radius (cells) of each point; far outside, that of the edge."""
        # The exponent of a float32 x in [1, inf), counted as `frexp` does, is the least n with x < 2 ** n.
        exponent = (np.maximum(radius, np.float32(1)).view(np.int32) >> 23) - 126
        level = np.minimum(exponent, len(self._rows) - 1)
        rows, cols = self._rows[level], self._cols[level]
        at_row = np.minimum(np.maximum(row, 0).astype(np.int32) >> level, rows - 1)
        at_col = np.minimum(np.maximum(col, 0).astype(np.int32) >> level, cols - 1)
        found = self._blocks.take(self._start[level] + at_row * cols + at_col)
        return np.where(radius <= np.float32(2.0) ** (len(self._rows) - 1), found, np.float32(self.highest_m))


def _halved(values: Field) -> Field:
    if values.shape[0] % 2 or values.shape[1] % 2:
        values = np.pad(values, [(0, count % 2) for count in values.shape])
    rows = np.maximum(values[::2], values[1::2])
    return np.maximum(rows[:, ::2], rows[:, 1::2])


@lru_cache(maxsize=4)
def _slopes(lens: Intrinsics) -> NDArray[np.float32]:
    """Return the slopes of all pixel centres, shape (2, H, W)."""
    down, right = np.mgrid[0 : lens.height_px, 0 : lens.width_px].astype(np.float64) + 0.5
    found = lens.to_slopes(np.stack([right.ravel(), down.ravel()], axis=1))
    slopes = np.ascontiguousarray(found.T.reshape(2, lens.height_px, lens.width_px), dtype=np.float32)
    slopes.flags.writeable = False
    return slopes


def strips(camera: Camera) -> Iterator[slice]:
    """Yield strips of a picture's rows: what is computed strip by strip stays in the cache of a core."""
    for row in range(0, camera.intrinsics.height_px, _STRIP_PX):
        yield slice(row, min(row + _STRIP_PX, camera.intrinsics.height_px))


def trace_down(pixels: Grid, grid: Grid) -> Hits:
    """Return what vertical rays through the pixels of one lattice see of a raster on another; heights are left at 0."""
    rows, cols = np.indices(pixels.shape).reshape(2, -1)
    uv = grid.to_uv(pixels.to_centres_m(np.column_stack([rows, cols])))
    col, row = uv.astype(np.float32).T.reshape(2, *pixels.shape)
    flat = np.zeros_like(col)
    return Hits(
        col=col,
        row=row,
        z_m=flat,
        cells_px=np.full_like(col, pixels.cell_size_m / grid.cell_size_m),
        fall=np.ones_like(col),
        ahead=np.zeros((2, *col.shape), dtype=np.float32),
        is_side=np.zeros(col.shape, dtype=bool),
        is_ground=np.ones(col.shape, dtype=bool),
    )


def trace(camera: Camera, grid: Grid, heights: HeightPyramid, rows: slice) -> Hits:
    """Return what some rows of pixels see of a height raster on a grid; the ground plane is at 0.

    Notes
    -----
    A point of a ray is linear in its height z. For blocks of 8 x 8 pixels a pyramid of maxima bounds the highest thing
    that their rays can meet; from there rays go down in steps of about a cell (or of a pixel, if that is wider) until
    the raster is above them. Rays over open ground need no step at all.
    """
    right, down = _slopes(camera.intrinsics)[:, rows]
    matrix = camera.matrix.astype(np.float32)
    east, north, up = (right * matrix[0, axis] + down * matrix[1, axis] + matrix[2, axis] for axis in range(3))
    flat = np.hypot(east, north)
    is_ground = up < -0.035 * np.maximum(flat, 1e-6)  # 0.035: a ray that falls less than this per metre sees no ground
    falling = np.where(is_ground, -up, 1.0).astype(np.float32)
    cell = np.float32(grid.cell_size_m)
    ahead = np.stack([east / falling / cell, -north / falling / cell])
    fall = falling / np.sqrt(flat * flat + up * up)
    at = grid.to_uv(np.array([[camera.east_m, camera.north_m]]))[0]
    height = np.float32(camera.height_m)
    col, row = (np.float32(at[axis]) + ahead[axis] * height for axis in (0, 1))
    col, row = (np.clip(part, -1e6, 1e6) for part in (col, row))
    return _march(
        Hits(
            col=col,
            row=row,
            z_m=np.zeros_like(col),
            cells_px=_pixel_cells(col, row),
            fall=fall,
            ahead=ahead,
            is_side=np.zeros(col.shape, dtype=bool),
            is_ground=is_ground,
        ),
        heights,
    )


def _pixel_cells(col: Field, row: Field) -> Field:
    """Return the width of a pixel on the ground plane in cells: the mean of its two sides."""
    small = [
        cv2.resize(part, None, fx=1 / _STRIDE, fy=1 / _STRIDE, interpolation=cv2.INTER_NEAREST) for part in (col, row)
    ]
    if min(small[0].shape) < 2:
        return np.ones_like(col)
    down, right = (np.hypot(np.gradient(small[0], axis=axis), np.gradient(small[1], axis=axis)) for axis in (0, 1))
    size = ((down + right) / 2 / _STRIDE).astype(np.float32)
    return np.asarray(cv2.resize(size, (col.shape[1], col.shape[0]), interpolation=cv2.INTER_LINEAR))


def _ceiling(hits: Hits, heights: HeightPyramid) -> Field:
    """Return a height above everything that the ray of each pixel can meet, shape (H, W)."""
    middle = np.s_[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    if min(hits.col.shape) <= _STRIDE:
        return np.full_like(hits.col, heights.highest_m)
    col, row, size = hits.col[middle], hits.row[middle], hits.cells_px[middle]
    ahead = hits.ahead[:, *middle]
    run = np.hypot(ahead[0], ahead[1])
    ceiling = np.full(col.shape, heights.highest_m, dtype=np.float32)
    for _ in range(4):
        half = ceiling / 2
        radius = 0.8 * _STRIDE * size + run * half
        ceiling = np.minimum(ceiling, heights.highest_within(col - ahead[0] * half, row - ahead[1] * half, radius))
    whole = np.repeat(np.repeat(ceiling, _STRIDE, axis=0), _STRIDE, axis=1)
    rows, cols = hits.col.shape
    return np.pad(whole, ((0, max(0, rows - whole.shape[0])), (0, max(0, cols - whole.shape[1]))), mode="edge")[
        :rows, :cols
    ]


def _march(hits: Hits, heights: HeightPyramid) -> Hits:
    """Follow the rays that may meet something down to it; fill in column, row, height and side of what they meet."""
    ceiling = np.where(hits.is_ground, _ceiling(hits, heights), 0)
    pixel = np.flatnonzero(ceiling > _LOW_M)
    top = ceiling.ravel()[pixel]
    for part in (0.0, 0.5, 0.5):  # now for each ray alone: its whole way, then the upper half of it
        col, row, ahead_col, ahead_row = _rays(hits, pixel)
        middle, half = top * np.float32((1 + part) / 2), top * np.float32((1 - part) / 2)
        radius = np.hypot(ahead_col, ahead_row) * half + 1
        found = heights.highest_within(col - ahead_col * middle, row - ahead_row * middle, radius)
        top = np.clip(found, top * np.float32(part), top)
        if not part:
            pixel, top = pixel[top > _LOW_M], top[top > _LOW_M]
    for start in range(0, len(pixel), _CHUNK):
        _follow(hits, heights.height_m, pixel[start : start + _CHUNK], top[start : start + _CHUNK])
    return hits


def _rays(hits: Hits, pixel: NDArray[np.int64]) -> tuple[Field, Field, Field, Field]:
    """Return where rays meet the ground plane, column and row, and how far they go per metre of fall."""
    ahead_col, ahead_row = hits.ahead[0].ravel()[pixel], hits.ahead[1].ravel()[pixel]
    return hits.col.ravel()[pixel], hits.row.ravel()[pixel], ahead_col, ahead_row


def _follow(hits: Hits, raster: Field, pixel: NDArray[np.int64], top: Field) -> None:
    """Follow some rays down from a height, a few steps at a time."""
    ground_col, ground_row, ahead_col, ahead_row = _rays(hits, pixel)
    size = np.maximum(_STEP_CELLS, 0.75 * hits.cells_px.ravel()[pixel])
    fall = top / (np.ceil(np.hypot(ahead_col, ahead_row) * top / size) + 1)
    rays = np.stack([ground_col, ground_row, ahead_col, ahead_row, top, fall])
    scratch = _Scratch(len(pixel))
    while len(pixel):
        z_m, found = scratch.look(raster, rays)
        above = found < z_m
        for step in range(1, _AT_ONCE):  # `logical_and.accumulate` takes each cell by itself
            above[step] &= above[step - 1]
        chosen, left = np.flatnonzero(~above[-1]), np.flatnonzero(above[-1])
        ended = rays.take(chosen, axis=1)
        # The first step that met something, of each ray that did
        cell = np.add.reduce(above[:-1].view(np.uint8), axis=0, dtype=np.uint8).take(chosen) * np.int64(len(pixel))
        cell += chosen
        here_m = np.maximum(z_m.ravel().take(cell), 0)  # the ground plane, where the last step went below it
        at = pixel[chosen]
        hits.col.ravel()[at] = ended[0] - ended[2] * here_m
        hits.row.ravel()[at] = ended[1] - ended[3] * here_m
        hits.z_m.ravel()[at] = here_m
        # 0.6 m: higher above the point that a ray meets, a cell shows its flank there
        hits.is_side.ravel()[at] = found.ravel().take(cell) - here_m > ended[5] + np.float32(0.6)
        pixel, rays = pixel[left], rays.take(left, axis=1)
        rays[4] -= _AT_ONCE * rays[5]


class _Scratch:
    """Memory for the steps of at most `count` rays, used again for each few steps: fresh memory costs as much."""

    def __init__(self, count: int) -> None:
        self._fields = np.empty((3, _AT_ONCE * count), dtype=np.float32)
        self._numbers = np.empty((2, _AT_ONCE * count), dtype=np.int32)

    def look(self, raster: Field, rays: Field) -> tuple[Field, Field]:
        """Return heights of the next steps of rays, shape (steps, N), and the heights of the cells under them."""
        # Beyond the raster those are 0, as its border is level ground.
        (rows, cols), count = raster.shape, rays.shape[1]
        z_m, col, row = self._fields[:, : _AT_ONCE * count].reshape(3, _AT_ONCE, count)
        cell, at_col = self._numbers[:, : _AT_ONCE * count].reshape(2, _AT_ONCE, count)
        ground_col, ground_row, ahead_col, ahead_row, top, fall = rays
        np.multiply(_AHEAD, fall, out=z_m)
        np.subtract(top, z_m, out=z_m)
        np.multiply(ahead_col, z_m, out=col)
        np.subtract(ground_col, col, out=col)
        np.multiply(ahead_row, z_m, out=row)
        np.subtract(ground_row, row, out=row)
        if col.min() < 0 or row.min() < 0 or col.max() >= cols or row.max() >= rows:
            np.clip(col, 0, cols - 1, out=col)
            np.clip(row, 0, rows - 1, out=row)
        np.copyto(cell, row, casting="unsafe")
        np.copyto(at_col, col, casting="unsafe")
        cell *= np.int32(cols)
        cell += at_col
        return z_m, raster.ravel().take(cell, out=col, mode="clip")  # "clip" spares numpy a copy: all cells are inside
