# SPDX-License-Identifier: Apache-2.0
"""Tables of features that are drawn by hand: what a row does not say is as of most ways."""

import geopandas as gpd
import pandas as pd

from sasgeo_bench.osm.features import DTYPES, make_features

USUAL = {"osm_type": "way", "version": 1, "timestamp": pd.NaT, "level": 0, "width_m": float("nan")}
USUAL |= {"is_bridge": False, "is_tunnel": False, "is_visible": True}


def features_of(*rows: dict, **usual: object) -> gpd.GeoDataFrame:
    """Features by their class and geometry, numbered from 0 unless they say their id."""
    full = [USUAL | {"osm_id": at} | usual | row for at, row in enumerate(rows)]
    return make_features({name: [row[name] for row in full] for name in (*DTYPES, "geometry")}, epsg=32632)
