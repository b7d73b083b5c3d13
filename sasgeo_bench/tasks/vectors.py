# SPDX-License-Identifier: Apache-2.0
"""Perceived vectors: lines and outlines in the view's frame, as a table and as features of a graph."""

from typing import TYPE_CHECKING, Final

import lazy_loader  # type: ignore[import-untyped, unused-ignore]
import numpy as np
import shapely

from sasgeo_bench.osm.features import DTYPES, make_features
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, Evidence, cell_offsets_m

if TYPE_CHECKING:
    import geopandas as gpd
else:  # loaded when a table is made
    gpd = lazy_loader.load("geopandas")

VECTOR_CLASSES: Final = load_taxonomy().of_graph("road", "rail", "building", "water")
COLUMNS: Final = ("class", "level", "is_bridge", "geometry")
_DECIMALS: Final = 1  # decimetres: finer than any detector, and far smaller on disk


def vector_table(rows: list[tuple[str, int, bool, shapely.Geometry]]) -> "gpd.GeoDataFrame":
    """Return a table of perceived vectors, with coordinates rounded to a decimetre; polygons stay valid.

    An outline that rounding would turn over itself is cut there, and its largest part stays; one that vanishes is
    dropped.

    >>> lap = shapely.Polygon([(0, 0), (4, 0), (4, 0.06), (0.04, 0.04), (4, 3), (0, 3)])
    >>> vector_table([("building", 0, False, lap)]).geometry.is_valid.tolist()
    [True]
    """
    shapes = np.array([row[3] for row in rows], dtype=object)
    rounded = shapely.transform(shapes, lambda at: at.round(_DECIMALS) + 0.0) if len(rows) else shapes
    is_outline = shapely.get_dimensions(shapes) == 2  # polygons
    for at in np.flatnonzero(is_outline & ~shapely.is_valid(rounded)).tolist():
        parts = shapely.get_parts(shapely.set_precision(shapely.make_valid(shapes[at]), 10.0**-_DECIMALS))
        parts = parts[shapely.area(parts) > 0]
        rounded[at] = max(parts, key=lambda part: part.area, default=None)
    kept = [at for at, shape in enumerate(rounded) if shape is not None]
    return gpd.GeoDataFrame(
        {
            "class": np.array([rows[at][0] for at in kept], dtype=object),
            "level": np.array([rows[at][1] for at in kept], dtype=np.int16),
            "is_bridge": np.array([rows[at][2] for at in kept], dtype=bool),
        },
        geometry=gpd.GeoSeries(rounded[kept], dtype="geometry"),
    )


def instances_of_mask(evidence: Evidence, class_name: str = "building") -> "gpd.GeoDataFrame":
    """Return an instance for each connected patch of a class, which adds nothing to the mask."""
    from rasterio.features import shapes as polygons_of  # noqa: PLC0415 - suites are listed without it

    mask = (evidence.layer(class_name) == PRESENT).astype(np.uint8)
    corners = cell_offsets_m(evidence.shape, evidence.cell_size_m)
    step_m = evidence.cell_size_m
    west_m, north_m = corners[:, 0].min() - step_m / 2, corners[:, 1].max() + step_m / 2
    transform = (step_m, 0.0, west_m, 0.0, -step_m, north_m)
    found = [shapely.geometry.shape(shape) for shape, _ in polygons_of(mask, mask=mask == 1, transform=transform)]
    return vector_table([(class_name, 0, False, shape) for shape in found])


def as_features(vectors: "gpd.GeoDataFrame") -> "gpd.GeoDataFrame":
    """Return perceived vectors as a feature table, from which `graph.build_graph` makes a graph."""
    count = len(vectors)
    columns: dict[str, object] = {
        "osm_type": ["way"] * count,
        "osm_id": np.arange(count),
        "version": np.ones(count, dtype=int),
        "timestamp": [None] * count,
        "class": vectors["class"].to_numpy(),
        "level": vectors["level"].to_numpy(),
        "is_bridge": vectors["is_bridge"].to_numpy(),
        "is_tunnel": np.zeros(count, dtype=bool),
        "is_visible": np.ones(count, dtype=bool),
        "width_m": np.where(shapely.get_dimensions(vectors.geometry.to_numpy()) == 1, 4.0, np.nan),
        "geometry": vectors.geometry.to_numpy(),
    }
    # 32632: any projected CRS: the view's frame lies nowhere
    return make_features({name: columns[name] for name in (*DTYPES, "geometry")}, epsg=32632)
