# SPDX-License-Identifier: Apache-2.0
"""Offset of imagery against the map: cross-correlation of the edges of buildings with those of the picture."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.imagery import Imagery, OffsetRecord
from sasgeo_bench.regions.layers import burn

TILE_M: Final = 64.0
REACH_M: Final = 6.0  # offsets up to this one are found
LEAST_TILES: Final = 4
_SMOOTH_M: Final = 0.5
_LEVEL_PERCENT: Final = 95.0

Complex = NDArray[np.complex128]
Surface = NDArray[np.float64]


def measure_offset(
    imagery: Imagery, buildings: NDArray[np.object_], mapped: shapely.Geometry, *, rng: np.random.Generator
) -> OffsetRecord | None:
    """Return the offset of imagery against building outlines, or None where edges are too few or do not agree.

    `buildings` are polygons in the region's CRS, `mapped` the ground where all buildings are mapped. A wall counts by
    its direction, so that it agrees with an edge along it, dark to bright or bright to dark, and edges of crowns in all
    directions cancel. Each tile of 64 m gives a surface of correlation over offsets of up to 6 m; their sum is highest
    at the offset. Intervals come from tiles drawn anew with replacement.

    Roofs lean away from the middle of a photo: in a mosaic that is not a true orthophoto the offset is that of roofs.
    """
    step_m = max(0.25, imagery.record.gsd_m)  # m: step of the correlation, or the pixel of a coarser picture
    parts = shapely.get_parts(buildings)
    outlines = shapely.orient_polygons(parts[~shapely.is_empty(parts)], exterior_cw=False)
    surfaces = np.array(list(_surfaces(imagery, outlines, mapped, step_m)))
    if len(surfaces) < LEAST_TILES:
        return None
    total = surfaces.sum(axis=0)
    sharpness = float((total.max() - total.mean()) / max(float(total.std()), 1e-12))
    east_m, north_m = _peak_m(total, step_m)
    # 5: sharpness in standard deviations: chance alone reaches about 4 in so many offsets
    if sharpness < 5.0 or max(abs(east_m), abs(north_m)) > REACH_M - step_m:
        return None
    weights = rng.multinomial(len(surfaces), np.full(len(surfaces), 1 / len(surfaces)), size=500)
    drawn = np.array([_peak_m(np.tensordot(weight, surfaces, axes=1), step_m) for weight in weights])
    tail = (100 - _LEVEL_PERCENT) / 2
    low, high = np.percentile(drawn, (tail, 100 - tail), axis=0).round(3).tolist()
    single = np.array([_peak_m(surface, step_m) for surface in surfaces])
    return OffsetRecord(
        east_m=round(east_m, 3),
        north_m=round(north_m, 3),
        east_interval_m=(low[0], high[0]),
        north_interval_m=(low[1], high[1]),
        residual_m=round(float(np.median(np.hypot(*(single - (east_m, north_m)).T))), 3),
        sharpness=round(sharpness, 2),
        tiles=len(surfaces),
    )


def _surfaces(
    imagery: Imagery, outlines: NDArray[np.object_], mapped: shapely.Geometry, step_m: float
) -> Iterator[Surface]:
    """Yield the correlation of each tile that holds walls, shape (2 R + 1, 2 R + 1), row down to the south."""
    tree, walls = shapely.STRtree(outlines), shapely.boundary(outlines)
    side = round(TILE_M / step_m)
    reach = round(REACH_M / step_m)
    lattice = Grid.from_bounds(*imagery.record.bounds_m, cell_size_m=step_m, epsg=imagery.epsg)
    shapely.prepare(mapped)
    for _, _, tile in lattice.windows(side):
        box = shapely.box(*tile.bounds_m)
        near = tree.query(box)
        if tile.shape != (side, side) or not shapely.contains(mapped, box) or len(near) == 0:
            continue
        # 40 m of walls in a tile: with fewer its own offset says little
        if shapely.length(shapely.intersection(walls[near], box)).sum() < 40.0:
            continue
        around = tile.window(-reach, -reach, side + 2 * reach, side + 2 * reach)
        view = imagery.read(around.bounds_m, gsd_m=step_m)
        if view.is_known.mean() >= 0.9:  # of a tile that the picture shows
            yield _correlation(_Edges.of_map(outlines[near], tile), _Edges.of_picture(view.rgb, view.is_known, step_m))


@dataclass(frozen=True, kw_only=True)
class _Edges:
    """Edges as complex numbers of twice their angle: opposite directions agree, perpendicular ones cancel."""

    field: Complex

    @classmethod
    def of_map(cls, outlines: NDArray[np.object_], tile: Grid) -> "_Edges":
        roofs = burn(outlines, tile).astype(np.float32)
        return cls(field=_doubled(roofs, tile.cell_size_m))

    @classmethod
    def of_picture(cls, rgb: NDArray[np.uint8], is_known: NDArray[np.bool_], step_m: float) -> "_Edges":
        """Return the edges of a picture, strong ones cut, without those along the rim of what it shows."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        rim = 2 * round(2 * _SMOOTH_M / step_m) + 1
        inside = cv2.erode(is_known.view(np.uint8), np.ones((rim, rim), np.uint8), borderValue=1) > 0
        found = _doubled(grey, step_m) * inside
        strength = np.abs(found)
        most = float(np.percentile(strength[inside], _LEVEL_PERCENT)) if inside.any() else 0.0
        return cls(field=found * np.minimum(1.0, most / np.maximum(strength, 1e-9)))


def _doubled(values: NDArray[np.float32], step_m: float) -> Complex:
    smooth = cv2.GaussianBlur(values, (0, 0), _SMOOTH_M / step_m, borderType=cv2.BORDER_REPLICATE)
    across, down = cv2.Sobel(smooth, cv2.CV_64F, 1, 0), cv2.Sobel(smooth, cv2.CV_64F, 0, 1)
    slope = across + 1j * down
    return np.asarray(slope**2 / np.maximum(np.abs(slope), 1e-9))


def _correlation(on_map: _Edges, seen: _Edges) -> Surface:
    """Return the sum of products for each offset; the picture is larger than the map by the reach on each side."""
    template, picture = on_map.field, seen.field
    shape = tuple(fft.next_fast_len(size) for size in picture.shape)
    product = fft.fft2(picture, shape) * np.conj(fft.fft2(template, shape))
    count = picture.shape[0] - template.shape[0] + 1
    return np.asarray(fft.ifft2(product)[:count, :count].real)


def _peak_m(surface: Surface, step_m: float) -> tuple[float, float]:
    row, col = (int(at) for at in np.unravel_index(np.argmax(surface), surface.shape))
    reach = surface.shape[0] // 2
    down = row - reach + _vertex(surface[:, col], row)
    right = col - reach + _vertex(surface[row], col)
    return float(right * step_m), float(-down * step_m)


def _vertex(line: Surface, at: int) -> float:
    """Return where a parabola through three points is highest, -0.5 to 0.5 from the middle one; 0 at an end."""
    if not 0 < at < len(line) - 1:
        return 0.0
    before, here, after = line[at - 1 : at + 2]
    bend = before - 2 * here + after
    return float(np.clip((before - after) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
