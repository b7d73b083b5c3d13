# SPDX-License-Identifier: Apache-2.0
"""What stands where in one window of a region: shapes by class, each with a seed of its own, before any paint."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
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
        """Multiply the colour of the chosen cells by a raster."""
        for strip, _ in self.strips():
            at = np.flatnonzero(cells[strip])
            here = self.colour[strip].reshape(-1, 3)
            here[at] = np.clip(here[at] * factor[strip].ravel()[at][:, None].astype(np.float32), 0, 255)


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
    kept = np.flatnonzero(~(shapely.is_empty(geometry) | shapely.is_missing(geometry)))
    if not len(kept):
        return np.zeros(grid.shape, dtype=np.int32)
    pairs = [(geometry[number], int(number) + 1) for number in kept]
    burnt = rasterio.features.rasterize(pairs, grid.shape, transform=Affine(*grid.transform), fill=0, dtype=np.int32)
    return np.asarray(burnt, dtype=np.int32)


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
