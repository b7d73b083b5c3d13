# SPDX-License-Identifier: Apache-2.0
"""The places with maps of several dates that docs/ageing/places.py lists, and what is said of them."""

import re
import runpy
from pathlib import Path

import pytest

from sasgeo_bench.tasks.split import find_split

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def places():
    return runpy.run_path(str(ROOT / "docs" / "ageing" / "places.py"))


@pytest.fixture(scope="module")
def split():
    return find_split("places")


def test_a_row_names_country_half_and_dates_of_a_place(places, split):
    specs = dict(places["dated_places"](split))
    found = places["facts_of"](split, "canillo", specs["canillo"])
    assert found == ["canillo", "andorra", "a", "8", "2013-05-28", "2025-01-19", "11.6"]
    assert "town-grid" not in specs  # made up
    assert "london" not in specs  # one date


def test_ten_places_of_three_countries_have_maps_eight_years_apart(places, split):
    found, countries = map(int, re.search(r"8 years \| (\d+) \| (\d+)", places["summary"](split)).groups())
    assert found >= 10
    assert countries >= 3
    message = " ".join((ROOT / "splits" / "README.md").read_text(encoding="utf-8").split())
    assert f"{len(dict(places['dated_places'](split)))} real places" in message
    assert f"of which {found} have maps at least eight years apart" in message
