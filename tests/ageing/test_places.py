# SPDX-License-Identifier: Apache-2.0
"""docs/ageing/places.md lists the places with maps of several dates that the split and the region files hold."""

import re
import runpy
from pathlib import Path

import pytest

from sasgeo_bench.tasks.split import find_split

FOLDER = Path(__file__).parents[2] / "docs" / "ageing"


@pytest.fixture(scope="module")
def places():
    return runpy.run_path(str(FOLDER / "places.py"))


@pytest.fixture(scope="module")
def split():
    return find_split("places")


def cells(text, width):
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [row for row in rows if len(row) == width and row[0] not in ("---", "place")]


def test_the_page_lists_every_place_with_its_dates_and_country(places, split):
    rows = cells((FOLDER / "places.md").read_text(encoding="utf-8"), 9)
    wanted = [places["facts_of"](split, place, spec) for place, spec in places["dated_places"](split)]
    assert [row[:7] for row in rows] == wanted


def test_no_listed_map_is_nearly_empty_at_its_newest_date():
    for row in cells((FOLDER / "places.md").read_text(encoding="utf-8"), 9):
        buildings, roads_km = (float(cell.split(" to ")[1].replace(",", "")) for cell in row[7:])
        assert buildings >= 30, row
        assert roads_km >= 10, row


def test_ten_places_of_three_countries_have_maps_eight_years_apart(places, split):
    text = places["summary"](split)
    assert text in (FOLDER / "places.md").read_text(encoding="utf-8")
    found, countries = map(int, re.search(r"8 years \| (\d+) \| (\d+)", text).groups())
    assert found >= 10
    assert countries >= 3
    said = (FOLDER.parents[1] / "splits" / "README.md").read_text(encoding="utf-8")
    assert re.search(rf"are {len(list(places['dated_places'](split)))}, of which {found} have", " ".join(said.split()))
