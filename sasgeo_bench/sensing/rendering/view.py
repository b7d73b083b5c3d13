# SPDX-License-Identifier: Apache-2.0
"""The picture of a scene that a camera takes, and what each of its pixels shows of the map."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.sensing.camera import Camera
from sasgeo_bench.sensing.rendering.conditions import Conditions, Exposure, Light, expose, expose_sensor
from sasgeo_bench.sensing.rendering.plan import CROWN, ROOF, WATER, Hits, Mask, Picture, strips, trace, trace_down
from sasgeo_bench.sensing.rendering.scene import Painting, Scene
from sasgeo_bench.sensing.rendering.seasons import Season
from sasgeo_bench.sensing.rendering.texture import Field, draw

_GLASS: Final = np.array([54, 62, 70], dtype=np.float32)
_WAVES: Final = 256  # cells of a tile of rippled water
_STRIP_ROWS: Final = 128
_RIM_PX: Final = 8  # rendered around a lattice, for the blur


def render(scene: Scene, camera: Camera, conditions: Conditions, rng: np.random.Generator) -> Picture:
    """Return the picture that a camera takes of a scene, uint8 of shape (H, W, 3), RGB.

    The camera is in the CRS of the scene, its height above the ground plane. Beyond the scene's window the ground
    shows the mirrored paint of the scene, laid flat, with its light and shadows; above the horizon is sky. `rng` draws
    the noise of the sensor alone: all else belongs to the place. Raise `CameraError` for a camera that is not above
    the scene.
    """
    exposed = _exposed(scene, conditions)
    seen = np.empty((*_shape(camera), 3), dtype=np.float32)
    for rows, hits in _traced(scene, camera, conditions.season):
        _expose_rows(exposed, camera, hits, seen[rows])
    return expose_sensor(seen, conditions, exposed.exposure.dark, rng)


def render_labelled(
    scene: Scene, camera: Camera, conditions: Conditions, rng: np.random.Generator
) -> tuple[Picture, Picture]:
    """Return `render` and `labels` of one view: its rays are traced once, which is up to half of the work of each."""
    exposed = _exposed(scene, conditions)
    seen = np.empty((*_shape(camera), 3), dtype=np.float32)
    found = np.full((len(scene.classes), *_shape(camera)), UNKNOWN, dtype=np.uint8)
    for rows, hits in _traced(scene, camera, conditions.season):
        _expose_rows(exposed, camera, hits, seen[rows])
        _label(scene, exposed.painting, hits, found[:, rows])
    return expose_sensor(seen, conditions, exposed.exposure.dark, rng), found


def labels(scene: Scene, camera: Camera, *, season: Season = "summer") -> Picture:
    """Return what each pixel shows, uint8 of shape (C, H, W): ABSENT, PRESENT or UNKNOWN, classes as in the scene.

    A pixel shows the surface that its ray meets first. A roof shows the classes of the ground under it, a wall shows
    "building" alone. Under a crown, a class of the ground that the map has there is UNKNOWN, as it is hidden; beyond
    the mapped area, outside the scene and above the horizon all is UNKNOWN.
    """
    found = np.full((len(scene.classes), *_shape(camera)), UNKNOWN, dtype=np.uint8)
    for rows, hits in _traced(scene, camera, season):
        _label(scene, scene.painting(season), hits, found[:, rows])
    return found


def render_ortho(scene: Scene, grid: Grid, conditions: Conditions, rng: np.random.Generator) -> Picture:
    """Return a scene seen straight down everywhere, on a lattice in its CRS, uint8 of shape (rows, cols, 3).

    An ideal orthophoto: nothing leans, no wall is seen, no haze or vignette darkens it, so that tiles fit together.
    The lattice should lie within the scene.
    """
    wide = grid.window(-_RIM_PX, -_RIM_PX, grid.rows + 2 * _RIM_PX, grid.cols + 2 * _RIM_PX)
    exposed = _exposed(scene, conditions)
    seen = np.empty((*wide.shape, 3), dtype=np.float32)
    for row in range(0, wide.rows, _STRIP_ROWS):
        part = wide.window(row, 0, min(_STRIP_ROWS, wide.rows - row), wide.cols)
        hits = trace_down(part, scene.grid)
        seen[row : row + part.rows] = _shaded(exposed, hits)
        _reflect(exposed, hits, seen[row : row + part.rows])
    picture = expose_sensor(seen, conditions, exposed.exposure.dark, rng, is_flat=True)
    return picture[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Exposed:
    """A scene under some conditions."""

    scene: Scene
    conditions: Conditions
    painting: Painting
    light: Light
    exposure: Exposure


def _exposed(scene: Scene, conditions: Conditions) -> _Exposed:
    return _Exposed(
        scene=scene,
        conditions=conditions,
        painting=scene.painting(conditions.season),
        light=scene.light(conditions.season, conditions.sun),
        exposure=expose(conditions),
    )


def _shape(camera: Camera) -> tuple[int, int]:
    return camera.intrinsics.height_px, camera.intrinsics.width_px


def _traced(scene: Scene, camera: Camera, season: Season) -> Iterator[tuple[slice, Hits]]:
    """Yield strips of a picture's rows with what they see; raise `CameraError` for a camera not above the scene."""
    heights = scene.painting(season).heights
    if camera.height_m <= heights.highest_m:
        raise CameraError(
            f"the highest thing of the scene ends at {heights.highest_m:.1f} m, got height_m {camera.height_m!r}: "
            "fly higher"
        )
    for rows in strips(camera):
        yield rows, trace(camera, scene.grid, heights, rows)


def _expose_rows(exposed: _Exposed, camera: Camera, hits: Hits, seen: Field) -> None:
    """Fill in the light that some rows of pixels get, linear, shape (H, W, 3)."""
    seen[...] = _shaded(exposed, hits)
    _reflect(exposed, hits, seen)
    _add_air(seen, camera, hits, exposed)


def _shaded(exposed: _Exposed, hits: Hits) -> Field:
    """Return the light that comes from each hit, linear, float32 of shape (H, W, 3)."""
    painting, light, exposure = exposed.painting, exposed.light, exposed.exposure
    # Light of sun and sky at each hit, float32 of shape (H, W, 2), 0-1
    albedo, shares = _sampled(painting.colours, hits), _linear(light.shares, hits) * np.float32(1 / 255)
    if hits.is_side.any():
        _paint_sides(exposed, hits, albedo, shares)
    seen = np.asarray(cv2.transform(shares, np.stack([exposure.sun, exposure.sky], axis=1)), dtype=np.float32)
    if exposure.lamp.any():
        seen += cv2.transform(_linear(painting.lamps, hits), exposure.lamp[:, None] * np.float32(0.9 / 255))
    cv2.multiply(seen, albedo, dst=seen)
    cv2.multiply(seen, albedo, dst=seen, scale=1 / 65025)  # colours are stored as the square root of what they reflect
    return seen


def _label(scene: Scene, painting: Painting, hits: Hits, found: Picture) -> None:
    """Fill in what each hit shows, uint8 of shape (C, H, W)."""
    at = _clipped(hits.row, hits.col, scene.grid.shape)
    known = _inside(hits, scene.grid.shape) & scene.is_mapped[at]
    bits, kind = scene.class_bits[at], painting.kind[at]
    is_wall, is_crown = hits.is_side & (kind == ROOF), kind == CROWN
    for number, name in enumerate(scene.classes):
        is_there = (bits & np.uint32(1 << number)) != 0
        np.copyto(is_there, name == "building", where=is_wall)
        band = np.where(is_there, np.uint8(PRESENT), np.uint8(ABSENT))
        if name != "green":
            np.copyto(band, UNKNOWN, where=is_crown & is_there)
        np.copyto(found[number], band, where=known)


def _inside(hits: Hits, shape: tuple[int, ...]) -> Mask:
    """Return which hits lie on the scene, shape (H, W)."""
    rows, cols = shape
    return hits.is_ground & (hits.row >= 0) & (hits.col >= 0) & (hits.row < rows) & (hits.col < cols)


def _maps(hits: Hits, level: int = 0) -> tuple[Field, Field]:
    """Return columns and rows for cv2.remap, which counts from cell centres, on a coarser level of a raster."""
    factor = np.float32(1 / 2**level)
    return hits.col * factor - np.float32(0.5), hits.row * factor - np.float32(0.5)


def _linear(values: Field | Picture, hits: Hits, level: int = 0) -> Field:
    col, row = _maps(hits, level)
    found = cv2.remap(values, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(found, dtype=np.float32)


def _sampled(colours: tuple[Picture, ...], hits: Hits) -> Field:
    """Return the colour at each hit, float32 of shape (H, W, 3), 0-255, from the level as fine as the pixel."""
    level = np.clip(np.log2(np.maximum(hits.cells_px, 0.25)) + 0.3, 0, len(colours) - 1)
    first, last = int(np.floor(level.min() + 0.2)), int(np.ceil(level.max() - 0.2))
    found = _linear(colours[first], hits, first)
    for number in range(first + 1, last + 1):
        share = np.clip(level - (number - 1), 0, 1)[..., None]
        finer = _linear(colours[number], hits, number)
        finer -= found
        finer *= share
        found += finer
    return found


def _paint_sides(exposed: _Exposed, hits: Hits, albedo: Field, shares: Field) -> None:
    """Give walls their paint, windows and own light, and darken the flanks of crowns towards the ground."""
    painting, light = exposed.painting, exposed.light
    side = np.nonzero(hits.is_side)
    col, row, z_m = hits.col[side], hits.row[side], hits.z_m[side]
    at = _clipped(row, col, painting.owner.shape)
    owner = painting.owner[at]
    is_wall = (owner > 0) & (painting.kind[at] == ROOF)
    normal = _normals(painting.heights.height_m, row, col)
    east, north, _ = light.sun.direction
    facing = np.maximum(normal[0] * east + normal[1] * north, 0)
    outside = _clipped(row - 2.5 * normal[1], col + 2.5 * normal[0], painting.owner.shape)
    is_lit = light.shade_m[outside] < z_m + 0.3
    high = painting.heights.height_m[at]
    leaves = draw(11, *(np.floor(part).astype(np.int64) for part in (row / 2, col / 2, z_m * 2.5)))
    deep = (0.55 + 0.45 * z_m / np.maximum(high, 0.5)) * (0.72 + 0.5 * leaves).astype(np.float32)
    paint = albedo[side] * deep[:, None]
    walls = np.flatnonzero(is_wall)
    paint[walls] = _wall_paint(exposed.scene, owner[walls] - 1, row[walls], col[walls], z_m[walls])
    albedo[side] = paint
    sun, sky = shares[..., 0], shares[..., 1]
    sun[side] = facing * is_lit * np.where(is_wall, 1.0, 0.7)
    sky[side] = 0.55 + 0.2 * np.minimum(z_m / 8, 1)


def _clipped(row: Field, col: Field, shape: tuple[int, ...]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    return np.clip(row, 0, shape[0] - 1).astype(np.int32), np.clip(col, 0, shape[1] - 1).astype(np.int32)


def _normals(height_m: Field, row: Field, col: Field) -> Field:
    """Return unit vectors (east, north) out of a wall, shape (2, N), from the heights on four sides."""
    shape, reach = height_m.shape, 3.0
    east = height_m[_clipped(row, col - reach, shape)] - height_m[_clipped(row, col + reach, shape)]
    north = height_m[_clipped(row + reach, col, shape)] - height_m[_clipped(row - reach, col, shape)]
    normal = np.stack([east, north])
    return np.asarray(normal / np.maximum(np.hypot(east, north), 1e-3))


def _wall_paint(scene: Scene, owner: NDArray[np.int32], row: Field, col: Field, z_m: Field) -> Field:
    """Return the colour of points on walls, shape (N, 3): plaster with rows of windows, darker at the foot."""
    buildings, cell = scene.buildings, np.float32(scene.grid.cell_size_m)
    axis = buildings.axis[owner].astype(np.float32)
    east, north = col * cell, -row * cell
    # Along a wall that follows one of the building's axes, this changes by a metre for each metre.
    along_m = east * (axis[:, 0] - axis[:, 1]) + north * (axis[:, 1] + axis[:, 0])
    paint = buildings.wall[owner].astype(np.float32) * (0.82 + 0.18 * np.minimum(z_m / 2.5, 1))[:, None]
    storey = np.float32(scene.plan.palette.storey_m)
    up, across = np.mod((z_m - 0.2) / storey, 1), np.mod(along_m / 2.7, 1)
    is_glass = (up > 0.32) & (up < 0.78) & (across < 0.45) & (z_m < buildings.eave_m[owner] - 0.4)
    is_glass &= draw(7, owner.astype(np.int64), np.floor(along_m / 2.7).astype(np.int64)) < 0.8
    paint[is_glass] = _GLASS
    return np.asarray(paint, dtype=np.float32)


@lru_cache(maxsize=1)
def _waves() -> tuple[Field, Field]:
    """Return the slopes of rippled water to the east and north, each a tile of 85 m that repeats."""
    rng, tiles = np.random.default_rng(3), []
    for _ in range(2):
        rough = np.pad(rng.standard_normal((_WAVES, _WAVES)).astype(np.float32), 16, mode="wrap")
        smooth = np.asarray(cv2.GaussianBlur(rough, (0, 0), 1.6), dtype=np.float32)[16:-16, 16:-16]
        tiles.append(np.asarray(0.045 * smooth / smooth.std(), dtype=np.float32))
    return tiles[0], tiles[1]


def _reflect(exposed: _Exposed, hits: Hits, seen: Field) -> None:
    """Mirror sky and sun in water that ripples."""
    exposure = exposed.exposure
    col, row = _maps(hits)
    found = cv2.remap(exposed.painting.kind, col, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    at = np.flatnonzero((np.asarray(found, dtype=np.uint8) == WATER) & hits.is_ground)
    if not len(at):
        return
    cell = np.float32(exposed.scene.grid.cell_size_m)
    place = [(part.ravel()[at] * cell * 3).astype(np.int32) % _WAVES for part in (hits.row, hits.col)]
    wave_e, wave_n = (tile[place[0], place[1]] for tile in _waves())
    fall = hits.fall.ravel()[at]
    scale = fall * cell
    ray = (hits.ahead[0].ravel()[at] * scale, -hits.ahead[1].ravel()[at] * scale, -fall)
    cosine = fall - ray[0] * wave_e - ray[1] * wave_n  # of a normal that leans by the waves
    share = 0.02 + 0.98 * np.maximum(1 - cosine, 0) ** 5
    sun = [np.float32(part) for part in exposed.conditions.sun.direction]
    toward = (
        ray[0] * sun[0] + ray[1] * sun[1] + ray[2] * sun[2] + 2 * cosine * (wave_e * sun[0] + wave_n * sun[1] + sun[2])
    )
    glint = np.maximum(toward, 0)
    for _ in range(8):  # to the power of 256
        glint *= glint
    light = seen.reshape(-1, 3)
    mirrored = cv2.transform(
        np.stack([share, 54 * share * glint], axis=1)[None], np.stack([1.1 * exposure.air, exposure.sun], axis=1)
    )[0]
    light[at] = cv2.multiply(light[at], cv2.merge([1 - share] * 3)[:, 0]) + mirrored


def _add_air(seen: Field, camera: Camera, hits: Hits, exposed: _Exposed) -> None:
    """Mix haze in by distance (Koschmieder's law: contrast falls to 2 % at the visibility), and paint the sky."""
    extinction = -math.log(0.02) / exposed.conditions.visibility_m
    away_m = (np.float32(camera.height_m) - hits.z_m) / np.maximum(hits.fall, 1e-3)
    clear = np.exp(-np.float32(extinction) * away_m)
    clear[~hits.is_ground] = 0
    cv2.multiply(seen, cv2.merge([clear, clear, clear]), dst=seen)
    seen += cv2.transform(1 - clear, exposed.exposure.air[:, None])
