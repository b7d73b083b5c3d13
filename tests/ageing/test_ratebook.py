# SPDX-License-Identifier: Apache-2.0
"""The packaged rates: what docs/ageing holds, pooled over places other than the one that is aged."""

import math
import runpy
from dataclasses import replace
from pathlib import Path

import pytest

from sasgeo_bench.ageing.files import ratebook_text
from sasgeo_bench.ageing.ratebook import (
    PACKAGED,
    VERSION,
    ClassAgeing,
    PlaceAgeing,
    RateBook,
    load_ratebook,
    pool_rates,
)
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file

MEASURE = Path(__file__).parents[2] / "docs" / "ageing" / "measure.py"
RATES = tuple(f"{what}{of}_per_year" for what in ("vanish", "appear") for of in ("", "_least", "_most"))


def seen(vanish, appear, *, n_from=100, n_to=100, **more):
    """A class of which half of what changes is the world at most, and a tenth at least."""
    best = [rate * share for rate in (vanish, appear) for share in (2.0, 0.2, 1.0)]
    rates = {name: {"best": value} for name, value in zip(RATES, best, strict=True)}
    return ClassAgeing.model_validate({"years": 10.0, "n_from": n_from, "n_to": n_to} | rates | more)


def book(**places):
    """Places by name, each in the country of its first letter."""
    made = [
        PlaceAgeing(name=name, country=name[0], area_km2=1.0, extracts=[], **{"class": found})
        for name, found in places.items()
    ]
    return RateBook(version=VERSION, attribution="", licence="", place=made)


# What is packaged is what was measured


@pytest.fixture(scope="module")
def measured():
    docs = runpy.run_path(str(MEASURE))
    found = docs["read_all"]()
    return docs["of_countries"]([found[place.name] for place in docs["list_places"]().place])


def test_the_packaged_rates_hold_every_place_and_class_of_the_tables(measured):
    packaged = load_ratebook()
    assert packaged.names == tuple(ageing.place for ageing in measured)
    for ageing in measured:
        assert list(packaged[ageing.place].classes) == list(dict.fromkeys(ageing.table["class"]))
        assert packaged[ageing.place].country == ageing.country != ""
    assert packaged.attribution == "(c) OpenStreetMap contributors, ODbL"


def test_writing_the_rates_again_gives_the_packaged_file(measured):
    root = Path(__file__).parents[2]
    text = (root / "sasgeo_bench" / "ageing" / PACKAGED).read_text(encoding="utf-8")
    assert ratebook_text(measured) == text


def test_a_place_without_a_country_is_in_no_rate_book(measured):
    with pytest.raises(ConfigError, match="the country of 'Monaco' is unknown: measure it again with --country"):
        ratebook_text([replace(item, country="") for item in measured if item.place == "Monaco"])


# Reading


def test_a_rate_without_bound_and_one_without_interval_are_read_back():
    text = (
        f'version = {VERSION}\nattribution = ""\nlicence = ""\n'
        '[[place]]\nname = "a"\ncountry = "a"\narea_km2 = 1.0\nextracts = []\n'
        "[place.class.water]\nyears = 2.0\nn_from = 1\nn_to = 2\n"
        "vanish_per_year = { best = 0.1, lo = 0.0, hi = inf }\nappear_per_year = { best = 0.2 }\n"
    )
    found = parse_toml(text, RateBook, source="book.toml")["a"].classes["water"]
    assert found.vanish_per_year.hi == math.inf
    assert found.appear_per_year.lo is None
    with pytest.raises(ConfigError, match="greater than or equal to 0"):
        parse_toml(text.replace("best = 0.1", "best = -0.1"), RateBook, source="book.toml")


@pytest.mark.parametrize(("version", "got"), [("", 1), ("version = 1\n", 1), ("version = 4\n", 4)])
def test_a_book_of_another_version_is_refused_in_one_line_that_says_how_to_mend_it(version, got):
    text = f'{version}attribution = ""\nlicence = ""\nplace = []\n'
    mend = "write the rate book anew with measure-ageing --compare --rates"
    with pytest.raises(ConfigError, match=rf"^book.toml: .*{mend}: this program reads version 3, got {got}$"):
        parse_toml(text, RateBook, source="book.toml")


def test_the_world_changes_no_faster_than_the_map_and_causes_add_up():
    for place in load_ratebook().places:
        for name, found in place.classes.items():
            for what in ("vanish", "appear"):
                rates = [getattr(found, f"{what}{of}_per_year") for of in ("_least", "_most", "")]
                best = [rate.best for rate in rates if rate is not None]
                assert best == sorted(best), (place.name, name)
            for shares in (found.vanished, found.appeared):
                assert not shares or sum(shares.values()) == pytest.approx(1.0, abs=1e-4)


# Pooling


def test_the_pooled_rate_is_the_median_of_the_other_countries_and_that_of_a_country_the_median_of_its_places():
    rates = book(
        a1={"water": seen(0.01, 0.1)},
        a2={"water": seen(0.03, 0.3)},
        b={"water": seen(0.05, 0.7)},
        c={"water": seen(0.9, 0.2)},
        d={"water": seen(0, 0)},
    )
    pooled = pool_rates(rates, exclude=["d", "nowhere"])
    assert pooled.countries == ("a", "b", "c")
    assert (pooled.classes["water"].vanish_per_year, pooled.classes["water"].appear_per_year) == (0.05, 0.2)


def test_a_country_left_out_has_no_influence_on_any_number():
    packaged = load_ratebook()
    for country in packaged.countries:
        left = [item for item in packaged.places if item.country != country]
        rest = RateBook(version=VERSION, attribution="", licence="", place=left)
        assert pool_rates(packaged, exclude=[country]) == pool_rates(rest)
        assert pool_rates(packaged, exclude=[country.replace("-", " ").title()]) == pool_rates(rest)  # as on a map


def test_a_place_with_few_things_or_without_bound_has_no_say_in_what_they_tell():
    rates = book(
        a={"water": seen(0.01, 0.1)},
        b={"water": seen(0.5, 0.3, n_from=3)},
        c={"water": seen(0.5, 0.9, n_from=3, n_to=4), "bridge": seen(0.5, 0.9, n_from=3)},
        d={"water": seen(0.01, math.inf), "green": seen(0.0, math.inf)},
    )
    pooled = pool_rates(rates).classes
    assert list(pooled) == ["water"]
    assert (pooled["water"].vanish_per_year, pooled["water"].appear_per_year) == (0.01, 0.2)


def test_every_shipped_region_of_a_measured_place_is_told_to_be_of_its_country():
    packaged = load_ratebook()
    found = {}
    for name, path in list_region_files().items():
        files = [extract.file for extract in read_region_file(path).extract if extract.file]
        found[name] = {packaged.country_of(file) for file in files}
    assert found["vaduz"] == found["balzers"] == {"liechtenstein"}
    assert found["andorra-la-vella"] == {"andorra"}
    assert found["tvoroyri"] == {"faroe-islands"}
    assert found["dreieich"] == {"germany"}
    assert found["dusseldorf"] == {None}
