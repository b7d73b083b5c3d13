# SPDX-License-Identifier: Apache-2.0
"""Schema of classified geometry: a GeoDataFrame with one row per OSM object and semantic class."""

import hashlib
from typing import TYPE_CHECKING, Final

import shapely

from sasgeo_bench.core.errors import ShapeError

if TYPE_CHECKING:
    import geopandas as gpd

SEA: Final = "coastline"  # `osm_type` of sea: no object of OSM, but ground to the right of its coastlines
# Column -> pandas dtype; `geometry` comes last. `width_m` is the drawn width of a line, NaN for an area.
# `is_visible` is False for what lies under ground or in a tunnel: it keeps its place in the graph, never in a layer.
DTYPES: Final = {
    "osm_type": "str",
    "osm_id": "int64",
    "version": "int32",
    "timestamp": "datetime64[ms, UTC]",
    "class": "str",
    "level": "int16",
    "is_bridge": "bool",
    "is_tunnel": "bool",
    "is_visible": "bool",
    "width_m": "float32",
}


def make_features(columns: dict[str, object], *, epsg: int) -> "gpd.GeoDataFrame":
    """Build a checked feature table from one array for each column of `DTYPES` and `geometry`, metres in CRS `epsg`.

    Raise `ShapeError` if a column is missing.
    """
    import geopandas as gpd  # noqa: PLC0415 - only tables of geometry need it
    import pandas as pd  # noqa: PLC0415

    missing = [name for name in (*DTYPES, "geometry") if name not in columns]
    if missing:
        raise ShapeError(f"a feature table needs the columns {missing!r} too")
    times = pd.to_datetime(pd.Series(columns["timestamp"], dtype="datetime64[ms]"), utc=True)
    table = pd.DataFrame({name: columns[name] if name != "timestamp" else times for name in DTYPES})
    table = table.astype(dict(DTYPES))
    return check_features(gpd.GeoDataFrame(table, geometry=gpd.GeoSeries(columns["geometry"], crs=epsg)))


def check_features(features: "gpd.GeoDataFrame") -> "gpd.GeoDataFrame":
    """Return a feature table unchanged; raise `ShapeError` if columns, types or CRS (projected, metres) are wrong."""
    expected = [*DTYPES, "geometry"]
    if list(features.columns) != expected:
        raise ShapeError(
            f"a feature table has the columns {expected!r}, got {list(features.columns)!r}: build it with make_features"
        )
    wrong = {name: str(features[name].dtype) for name, kind in DTYPES.items() if str(features[name].dtype) != kind}
    if wrong:
        raise ShapeError(f"columns of another type than the schema says: {wrong!r}; build the table with make_features")
    if features.crs is None or not features.crs.is_projected:
        raise ShapeError(f"features must lie in a projected CRS in metres, got {features.crs!r}")
    return features


def fingerprint(features: "gpd.GeoDataFrame") -> str:
    """Hash types, ids, versions, classes and centroids of a table, whatever the order of its rows.

    Coordinates are rounded to a millimetre, so that another version of PROJ gives the same fingerprint.
    """
    centres = shapely.get_coordinates(shapely.centroid(features.geometry.array)).round(3) + 0.0
    columns = [features[name].to_numpy().tolist() for name in ("osm_type", "osm_id", "version", "class")]
    rows = sorted(zip(*columns, centres[:, 0].tolist(), centres[:, 1].tolist(), strict=True))
    return hashlib.sha256("\n".join(map(repr, rows)).encode() if rows else b"").hexdigest()
