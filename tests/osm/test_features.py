# SPDX-License-Identifier: Apache-2.0
"""The feature table: its schema is checked, its fingerprint sees content and nothing else."""

import pandas as pd
import pytest
import shapely

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.osm.features import DTYPES, check_features, fingerprint, make_features


def two(**changes):
    columns = {
        "osm_type": ["way", "way"],
        "osm_id": [7, 9],
        "version": [1, 2],
        "timestamp": [pd.NaT, pd.Timestamp("2021-05-05")],
        "class": ["building", "water"],
        "level": [0, 0],
        "is_bridge": [False, False],
        "is_tunnel": [False, False],
        "is_visible": [True, True],
        "width_m": [float("nan"), float("nan")],
        "geometry": [shapely.box(0, 0, 10, 10), shapely.box(50, 50, 90, 95)],
    }
    return columns | changes


def table(**changes):
    return make_features(two(**changes), epsg=32632)


def test_the_fingerprint_does_not_see_the_order_of_the_rows_nor_less_than_a_millimetre():
    assert fingerprint(table()) == fingerprint(table().iloc[::-1].reset_index(drop=True))
    moved = [shapely.box(0, 0, 10, 10), shapely.box(50, 50, 90, 95.0001)]
    assert fingerprint(table()) == fingerprint(table(geometry=moved))


@pytest.mark.parametrize(
    "change",
    [
        {"osm_id": [7, 8]},
        {"version": [1, 3]},
        {"class": ["building", "green"]},
        {"geometry": [shapely.box(0, 0, 10, 10), shapely.box(50, 50, 90, 95.01)]},
    ],
)
def test_the_fingerprint_sees_each_change_of_content(change):
    assert fingerprint(table()) != fingerprint(table(**change))


def test_columns_have_the_types_of_the_schema_and_others_and_degrees_are_refused():
    assert {name: str(table()[name].dtype) for name in DTYPES} == DTYPES
    columns = two()
    del columns["level"]
    with pytest.raises(ShapeError, match="level"):
        make_features(columns, epsg=32632)
    with pytest.raises(ShapeError, match="has the columns"):
        check_features(table().assign(colour="red"))
    with pytest.raises(ShapeError, match="osm_id"):
        check_features(table().astype({"osm_id": "int32"}))
    with pytest.raises(ShapeError, match="projected"):
        check_features(table().to_crs(4326))
