# SPDX-License-Identifier: Apache-2.0
"""Which extract covers a dataset: areas, region files, regional extracts."""

from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.exchange.importers.kinds import read_dataset
from sasgeo_bench.exchange.importers.reader import find_extents
from tests.exchange.importers import writers

REGION = """
id = "campus"
title = "A campus"
scenes = ["urban"]
bounds_lonlat = [{west}, 30.28, 120.45, 30.36]
cell_size_m = 2.0
[[extract]]
file = "campus.osm.pbf"
date = 2024-01-01
sha256 = ["0000000000000000000000000000000000000000000000000000000000000000"]
"""


def dense(tmp_path, places):
    return read_dataset(writers.write_dense(tmp_path / "set", places), "dense-uav")


def write_region(tmp_path: Path, west: float) -> Path:
    return writers.put(tmp_path / "regions" / "campus.toml", REGION.format(west=west)).parent


def test_items_far_apart_lie_in_areas_of_their_own(tmp_path):
    places = {"000000": (120.30, 30.3), "000001": (120.34, 30.3), "000002": (120.38, 30.3), "000003": (121.5, 31.2)}
    first, second = find_extents(dense(tmp_path, places))
    assert (first.items, second.items) == (12, 4)  # steps of 3.8 km join three, 7.7 km apart as the ends are
    assert first.width_km == pytest.approx(7.7 + 1.0, abs=0.1)
    assert second.width_km == pytest.approx(1.0, abs=0.01)
    assert second.height_km == pytest.approx(1.0, abs=0.01)


def test_a_margin_of_half_a_kilometre_lies_around_an_area(tmp_path):
    (extent,) = find_extents(dense(tmp_path, {"000000": (120.0, 30.0)}))
    east_m = (extent.box.east_deg - 120.0) * 111_320 * np.cos(np.radians(30.0))
    north_m = (extent.box.north_deg - 30.0) * 111_320
    assert (east_m, north_m) == pytest.approx((500.0, 500.0))


def test_a_region_file_covers_an_area_or_meets_it_in_part(tmp_path):
    dataset = dense(tmp_path, {"000000": (120.38, 30.32)})
    (covered,) = find_extents(dataset, folders=[write_region(tmp_path, 120.30)])
    assert (covered.covered_by, covered.touched_by) == (("campus",), ())
    (touched,) = find_extents(dataset, folders=[write_region(tmp_path, 120.38)])
    assert (touched.covered_by, touched.touched_by) == ((), ("campus",))


def test_a_shipped_region_is_known_and_a_made_up_town_is_not_and_flights_are_named(tmp_path):
    (vaduz,) = find_extents(dense(tmp_path / "vaduz", {"000000": (9.522, 47.15)}))
    (town,) = find_extents(dense(tmp_path / "town", {"000000": (11.05, 48.05)}))
    assert vaduz.covered_by == ("liechtenstein", "vaduz")
    assert (town.covered_by, town.touched_by) == ((), ())
    assert (vaduz.extracts[0], vaduz.extracts[-1]) == ("europe/liechtenstein", "europe")
    (flown,) = find_extents(read_dataset(writers.write_visloc(tmp_path), "uav-visloc"))
    assert flown.groups == ("01", "07")


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ((120.386, 30.322), "zhejiang"),  # Hangzhou
        ((116.40, 39.90), "beijing"),
        ((121.47, 31.23), "shanghai"),
        ((87.62, 43.83), "xinjiang"),
    ],
)
def test_a_place_in_china_is_led_to_its_province(place, name, tmp_path):
    (extent,) = find_extents(dense(tmp_path, {"000000": place}))
    assert f"asia/china/{name}" in extent.extracts
    assert "asia/china" in extent.extracts
    assert extent.extracts[-1] == "asia"


def test_a_set_without_coordinates_lies_nowhere(tmp_path):
    dataset = read_dataset(writers.write_university(tmp_path), "university-1652")
    with pytest.raises(DatasetError, match="University-1652 has no coordinates"):
        find_extents(dataset)
