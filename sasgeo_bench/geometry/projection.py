# SPDX-License-Identifier: Apache-2.0
"""From one coordinate reference system to another: each way is set up once, which takes longer than most of its uses.

Transformers of pyproj may be shared by threads since version 3.1.
"""

from functools import lru_cache
from typing import Final

import pyproj

WGS84: Final = 4326  # EPSG code of longitude and latitude


@lru_cache(maxsize=256)
def between(source_epsg: int, target_epsg: int) -> pyproj.Transformer:
    """Return what turns coordinates of one CRS into those of another; x or longitude comes first."""
    return pyproj.Transformer.from_crs(source_epsg, target_epsg, always_xy=True)


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
