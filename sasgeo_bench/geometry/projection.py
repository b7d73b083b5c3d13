# SPDX-License-Identifier: Apache-2.0
"""From one coordinate reference system to another: each way is set up once, which takes longer than most of its uses.

Transformers of pyproj may be shared by threads since version 3.1.
"""

import math
import re
from functools import lru_cache
from typing import Final

import numpy as np
import pyproj
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import bearing_deg

_STEP_DEG: Final = 1e-4  # to the north, by which the grid's north is found
WGS84: Final = 4326  # EPSG code of longitude and latitude
_OPEN_DATUM: Final = re.compile(r"^(D_)?(unknown|not[ _]specified)", re.IGNORECASE)
_WGS84_SIZE_M: Final = 6_378_137.0  # half the longer axis of the ellipsoid


@lru_cache(maxsize=256)
def between(source_epsg: int, target_epsg: int) -> pyproj.Transformer:
    """Return what turns coordinates of one CRS into those of another; x or longitude comes first."""
    return pyproj.Transformer.from_crs(source_epsg, target_epsg, always_xy=True)


def has_open_datum(crs: pyproj.CRS) -> bool:
    """Return whether a CRS names an ellipsoid alone, which PROJ then takes for one about the centre of WGS 84.

    Datums of one ellipsoid lie a hundred metres apart. Those of the size of WGS 84 lie within metres and are not open,
    nor is a CRS that brings its own way to WGS 84 (TOWGS84).

    >>> [has_open_datum(pyproj.CRS(f"+proj=utm +zone=32 +ellps={name}")) for name in ("bessel", "GRS80")]
    [True, False]
    """
    while crs.is_compound:
        crs = crs.sub_crs_list[0]
    if crs.is_bound or crs.datum is None or crs.ellipsoid is None:
        return False
    return bool(_OPEN_DATUM.search(crs.datum.name)) and crs.ellipsoid.semi_major_metre != _WGS84_SIZE_M


def from_lonlat(epsg: int) -> pyproj.Transformer:
    """Return what turns longitude and latitude, degrees, into easting and northing of a CRS, metres.

    >>> [round(float(value)) for value in from_lonlat(32632).transform(9.0, 0.0)]
    [500000, 0]
    """
    return between(WGS84, epsg)


def to_lonlat(epsg: int) -> pyproj.Transformer:
    """Return what turns easting and northing of a CRS, metres, into longitude and latitude, degrees.

    >>> [round(float(value), 6) for value in to_lonlat(32632).transform(500000.0, 0.0)]
    [9.0, 0.0]
    """
    return between(epsg, WGS84)


def true_north_deg(lon_deg: NDArray[np.float64], lat_deg: NDArray[np.float64], epsg: int) -> NDArray[np.float64]:
    """Return the bearing of true north in the grid of a projected CRS, shape (N,), degrees of -180 to 180.

    >>> true_north_deg(np.array([10.0]), np.array([47.0]), 32632).round(2).tolist()
    [-0.73]
    """
    step = np.where(lat_deg < 0, _STEP_DEG, -_STEP_DEG)  # never over a pole
    here, there = (np.stack(from_lonlat(epsg).transform(lon_deg, lat_deg + more)) for more in (0.0, step))
    east, north = np.sign(step) * (there - here)
    return np.asarray((bearing_deg(east, north) + 180.0) % 360.0 - 180.0)


def to_grid(lon_deg: float, lat_deg: float, epsg: int) -> tuple[float, float, float]:
    """Return easting and northing of a place, metres, and the bearing of true north there, degrees.

    A bearing against true north plus this one is a bearing in the grid. All three are infinite beyond the projection.

    >>> [round(value, 2) for value in to_grid(10.0, 47.0, 32632)]
    [576025.31, 5205649.35, -0.73]
    """
    east_m, north_m = from_lonlat(epsg).transform(lon_deg, lat_deg)
    if not (math.isfinite(east_m) and math.isfinite(north_m)):
        return math.inf, math.inf, math.inf
    return float(east_m), float(north_m), float(true_north_deg(np.array([lon_deg]), np.array([lat_deg]), epsg)[0])
