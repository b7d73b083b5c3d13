# SPDX-License-Identifier: Apache-2.0
"""The places with maps of several dates: those that are measured, and those of the splits."""

import re
import runpy
import tomllib
from pathlib import Path

import pytest

from sasgeo_bench.tasks.split import find_split

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def docs():
    return runpy.run_path(str(ROOT / "docs" / "ageing" / "measure.py"))


def test_the_page_of_places_is_what_the_program_writes(docs):
    text = (ROOT / "docs" / "ageing" / "places.md").read_text(encoding="utf-8")
    assert text == docs["places_text"]()
    assert "| canillo | andorra | calibration | a | 8 | 2013-05-28 | 2025-01-19 | 11.6 |" in text
    assert "town-grid" not in text  # made up
    assert "| london |" not in text  # one date


def test_places_of_the_split_of_the_boards_have_maps_eight_years_apart(docs):
    split = find_split("places")
    found, countries = map(int, re.search(r"8 years \| (\d+) \| (\d+)", docs["counts"](split)).groups())
    assert found >= 10
    assert countries >= 3
    message = " ".join((ROOT / "splits" / "README.md").read_text(encoding="utf-8").split())
    assert f"{len(dict(docs['dated_places'](split)))} real places" in message
    assert f"of which {found} have maps at least eight years apart" in message


def test_every_country_that_is_measured_is_named_as_in_the_split(docs):
    known = set(find_split("world").country_of.values())
    assert {place.country for place in docs["list_places"]().place} <= known


@pytest.mark.real
def test_every_place_of_the_manifest_with_two_dates_is_measured_on_all_of_them(docs, real_extracts):
    manifest = real_extracts / "manifest.toml"
    if not manifest.is_file():
        pytest.skip("the folder of real extracts has no manifest.toml")
    by_place = {}
    for item in tomllib.loads(manifest.read_text(encoding="utf-8"))["extract"]:
        by_place.setdefault(item["place"], set()).add(item["file"])
    measured = [set(place.files) for place in docs["list_places"]().place]
    for place, files in by_place.items():
        dated = files if any(".osh." in file for file in files) or len(files) > 1 else set()
        newer = {file for file in dated if not re.search(r"-2014-01-01\.osm", file)}  # the history has that day, too
        assert not dated or any(newer <= own for own in measured), place
