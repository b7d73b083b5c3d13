# SPDX-License-Identifier: Apache-2.0
"""The packaged rates: what docs/ageing holds, pooled over places other than the one that is aged."""

import math
from pathlib import Path

import pandas as pd
import pytest

from sasgeo_bench.ageing.files import ratebook_text, read_ageing
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

MEASURED = Path(__file__).parents[2] / "docs" / "ageing"
FOLDERS = ("liechtenstein", "andorra", "monaco", "dreieich", "faroe")


RATES = ("vanish_per_year", "appear_per_year", "ground_lost_per_year", "ground_gained_per_year")


def seen(vanish, appear, *, n_from=100, n_to=100, **more):
    """A class whose ground is lost and gained twice as fast as its things."""
    rates = {name: {"best": best} for name, best in zip(RATES, (vanish, appear, 2 * vanish, 2 * appear), strict=True)}
    return ClassAgeing.model_validate({"years": 10.0, "n_from": n_from, "n_to": n_to} | rates | more)


def book(**places):
    made = [PlaceAgeing(name=name, area_km2=1.0, extracts=[], **{"class": found}) for name, found in places.items()]
    return RateBook(version=VERSION, attribution="", licence="", place=made)


# What is packaged is what was measured


@pytest.fixture(scope="module")
def measured():
    return [read_ageing(MEASURED / folder) for folder in FOLDERS]


def test_the_packaged_rates_hold_every_place_and_class_of_the_tables(measured):
    packaged = load_ratebook()
    assert packaged.names == tuple(ageing.place for ageing in measured)
    for ageing in measured:
        assert list(packaged[ageing.place].classes) == list(dict.fromkeys(ageing.table["class"]))
    assert packaged.attribution == "(c) OpenStreetMap contributors, ODbL"


def test_every_packaged_number_is_that_of_the_tables(measured):
    for ageing in measured:
        rows = ageing.table.set_index(["class", "span"])
        for name, found in load_ratebook()[ageing.place].classes.items():
            pooled, whole = rows.loc[(name, "pooled")], rows.loc[(name, "whole")]
            assert (found.n_from, found.n_to) == (pooled["n_from"], pooled["n_to"])
            assert found.years == pytest.approx(pooled["years"], abs=0.005)
            for column in RATES:
                rate = getattr(found, column)
                ends = {"": rate and rate.best, "_lo": rate and rate.lo, "_hi": rate and rate.hi}
                for end, value in ends.items():
                    same(value, pooled[f"{column}{end}"])
            for column in ("redrawn_share", "shift_median_m", "shift_p90_m"):
                same(getattr(found, column), whole[column])


def same(packaged, measured):
    assert packaged == measured or (packaged is None and pd.isna(measured))


def test_writing_the_rates_again_gives_the_packaged_file(measured):
    root = Path(__file__).parents[2]
    text = (root / "sasgeo_bench" / "ageing" / PACKAGED).read_text(encoding="utf-8")
    assert ratebook_text(measured) == text


# Reading


def test_a_rate_without_bound_and_one_without_interval_are_read_back():
    text = (
        f'version = {VERSION}\nattribution = ""\nlicence = ""\n[[place]]\nname = "a"\narea_km2 = 1.0\nextracts = []\n'
        "[place.class.water]\nyears = 2.0\nn_from = 1\nn_to = 2\n"
        "vanish_per_year = { best = 0.1, lo = 0.0, hi = inf }\nappear_per_year = { best = 0.2 }\n"
    )
    found = parse_toml(text, RateBook, source="book.toml")["a"].classes["water"]
    assert found.vanish_per_year.hi == math.inf
    assert found.appear_per_year.lo is None
    with pytest.raises(ConfigError, match="greater than or equal to 0"):
        parse_toml(text.replace("best = 0.1", "best = -0.1"), RateBook, source="book.toml")


@pytest.mark.parametrize(("version", "got"), [("", 1), ("version = 1\n", 1), ("version = 3\n", 3)])
def test_a_book_of_another_version_is_refused_in_one_line_that_says_how_to_mend_it(version, got):
    text = f'{version}attribution = ""\nlicence = ""\nplace = []\n'
    mend = "write the rate book anew with measure-ageing --compare --rates"
    with pytest.raises(ConfigError, match=rf"^book.toml: .*{mend}: this program reads version 2, got {got}$"):
        parse_toml(text, RateBook, source="book.toml")


def test_nowhere_does_ground_change_more_slowly_than_things():
    for place in load_ratebook().places:
        for name, found in place.classes.items():
            for things, ground in (("vanish", "ground_lost"), ("appear", "ground_gained")):
                slow, fast = (getattr(found, f"{what}_per_year") for what in (things, ground))
                assert slow is None or slow.best <= fast.best, (place.name, name)


# Pooling


def test_the_pooled_rate_is_the_median_of_the_other_places():
    rates = book(
        a={"water": seen(0.01, 0.1)}, b={"water": seen(0.02, 0.3)}, c={"water": seen(0.9, 0.2)}, d={"water": seen(0, 0)}
    )
    pooled = pool_rates(rates, exclude=["d"])
    assert pooled.places == ("a", "b", "c")
    assert (pooled.classes["water"].vanish_per_year, pooled.classes["water"].appear_per_year) == (0.02, 0.2)


def test_a_place_left_out_has_no_influence_on_any_number():
    packaged = load_ratebook()
    for name in packaged.names:
        rest = RateBook(
            version=VERSION, attribution="", licence="", place=[item for item in packaged.places if item.name != name]
        )
        assert pool_rates(packaged, exclude=[name]) == pool_rates(rest)


def test_a_place_with_few_things_has_no_say_in_what_they_tell():
    rates = book(
        a={"water": seen(0.01, 0.1)},
        b={"water": seen(0.5, 0.3, n_from=3)},
        c={"water": seen(0.5, 0.9, n_from=3, n_to=4), "bridge": seen(0.5, 0.9, n_from=3)},
    )
    pooled = pool_rates(rates).classes
    assert (pooled["water"].vanish_per_year, pooled["water"].appear_per_year) == (0.01, 0.2)
    assert "bridge" not in pooled


def test_what_no_place_tells_of_is_none_and_a_class_without_both_rates_is_left_out():
    rates = book(a={"water": seen(0.01, 0.1), "green": seen(0.0, math.inf)})
    pooled = pool_rates(rates).classes
    assert list(pooled) == ["water"]
    assert (pooled["water"].ground_lost_per_year, pooled["water"].ground_gained_per_year) == (0.02, 0.2)
    assert (pooled["water"].redrawn_share, pooled["water"].shift_median_m) == (None, None)
    assert pool_rates(book(a={"water": seen(0, 0, redrawn_share=0.5)})).classes["water"].redrawn_share == 0.5


def test_a_misspelt_place_is_refused_since_its_rates_would_stay_in():
    with pytest.raises(ConfigError, match=r"no place 'vaduz' to leave out .* known: Liechtenstein"):
        pool_rates(load_ratebook(), exclude=["vaduz"])


def test_every_shipped_region_of_a_measured_place_is_told_to_be_of_it():
    packaged = load_ratebook()
    found = {}
    for name, path in list_region_files().items():
        files = [extract.file for extract in read_region_file(path).extract if extract.file]
        found[name] = {packaged.place_of(file) for file in files}
    assert found["vaduz"] == found["balzers"] == {"Liechtenstein"}
    assert found["andorra-la-vella"] == {"Andorra"}
    assert found["dreieich"] == {"Dreieich"}
    assert found["dusseldorf"] == {None}
