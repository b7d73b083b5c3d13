# SPDX-License-Identifier: Apache-2.0
"""A detector of vectors: lines and outlines of a view, with their own errors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.regions.evidence import footprint
from sasgeo_bench.tasks.perturbations.streams import Streams
from sasgeo_bench.tasks.query import PUBLISHED
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Shot
from sasgeo_bench.tasks.suites.measured_vectors import MeasuredVectorNoise, perceive_coarsely
from sasgeo_bench.tasks.vectors import VECTOR_CLASSES, vector_table

if TYPE_CHECKING:
    import geopandas as gpd

_LEAST_M: Final = 2.0
_WAVES: Final = 8
_WAVELENGTHS_M: Final = (60.0, 150.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorNoise:
    """Errors of perceived vectors.

    Fractions of missed objects and of lines with a gap of `gap_m`; root mean square `shift_m` of a smooth shift of all
    coordinates, each axis, which keeps junctions.
    """

    missed_share: float = 0.10
    gap_share: float = 0.15
    gap_m: float = 6.0
    shift_m: float = 1.0


def perceive_vectors(
    state: State, pose: Pose, *, side_m: float, noise: VectorNoise, rng: np.random.Generator
) -> "gpd.GeoDataFrame":
    """Return the vectors of the visible features in a view of a state.

    Columns are `class`, `level`, `is_bridge` and `geometry`: (right, up) from the middle of the view, metres. `side_m`
    is the side of the view for scale 1.
    """
    outline = footprint(pose, size_m=(side_m, side_m))
    features = state.features
    near = features.sindex.query(outline, predicate="intersects")
    table = features.iloc[np.sort(near)]
    table = table[table["is_visible"].to_numpy() & table["class"].isin(VECTOR_CLASSES).to_numpy()]
    clipped = shapely.intersection(shapely.make_valid(table.geometry.to_numpy()), outline)
    back = inverse(pose)
    local = shapely.transform(clipped, back.to_map)
    streams = Streams(rng)
    local = shapely.transform(local, smooth_shift(noise.shift_m, streams.view))
    missed, gap, places = streams.chances(table["class"].to_numpy(dtype=object), 3)
    seen, gaps = missed >= noise.missed_share, gap < noise.gap_share
    rows = []
    for at, (shape, (_, row)) in enumerate(zip(local, table.iterrows(), strict=True)):
        if seen[at]:
            parts = _parts(shape, cut_m=noise.gap_m if gaps[at] else 0.0, place=float(places[at]))
            rows += [(row["class"], int(row["level"]), bool(row["is_bridge"]), part) for part in parts]
    return vector_table(rows)


def site_vectors(shot: Shot, pose: Pose | None = None) -> "gpd.GeoDataFrame":
    """Perceive the vectors of a shot with its detector, at its site unless another pose is given."""
    world, place, side_m = shot.scene.world, pose or shot.site.pose, shot.variant.side_m
    rng = shot.rng("vectors", *shot.draw)
    if shot.variant.detector == PUBLISHED:
        return perceive_vectors(world, place, side_m=side_m, noise=VectorNoise(), rng=rng)
    return perceive_coarsely(world, place, side_m=side_m, noise=MeasuredVectorNoise(), rng=rng)


def smooth_shift(rms_m: float, rng: np.random.Generator) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Draw a smooth field of shifts, a sum of plane waves, as a function of points of shape (N, 2), metres."""
    turns = rng.uniform(0, 2 * np.pi, _WAVES)
    waves = (
        np.column_stack((np.cos(turns), np.sin(turns))) * (2 * np.pi / rng.uniform(*_WAVELENGTHS_M, _WAVES))[:, None]
    )
    phases = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    scale_m = rms_m * np.sqrt(2 / _WAVES)

    def shifted(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (N, 2) moved by the field of waves."""
        angle = points @ waves.T
        return np.asarray(points + scale_m * np.column_stack([np.cos(angle + phase).sum(axis=1) for phase in phases]))

    return shifted


def round_vectors(vectors: "gpd.GeoDataFrame", shapes: NDArray[np.object_]) -> "gpd.GeoDataFrame":
    """Return the same vectors with other shapes, rounded."""
    columns = (vectors[name].to_list() for name in ("class", "level", "is_bridge"))
    return vector_table(list(zip(*columns, shapes, strict=True)))


def _parts(shape: shapely.Geometry, *, cut_m: float, place: float) -> list[shapely.Geometry]:
    """Return lines and polygons of a shape; cut a gap into its first line."""
    parts = [
        part for part in shapely.get_parts(shapely.get_parts(shape)) if part.geom_type in ("LineString", "Polygon")
    ]
    if cut_m and parts and parts[0].geom_type == "LineString" and parts[0].length > 2 * cut_m:
        middle = shapely.line_interpolate_point(parts[0], place * parts[0].length)
        parts = [*shapely.get_parts(shapely.difference(parts[0], middle.buffer(cut_m / 2))), *parts[1:]]
    return [part for part in parts if part.length >= _LEAST_M]
