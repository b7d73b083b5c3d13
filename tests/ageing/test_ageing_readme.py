# SPDX-License-Identifier: Apache-2.0
"""No number of docs/ageing/README.md is there that the tables do not hold."""

import re
import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "ageing"
REDRAW = "2021-05-05"


def of_causes(places, name, what, *causes):
    return [(place, name, "pooled", f"{what}_{cause}_share", 1) for place in places for cause in causes]


def bounds(places, name, what):
    return [(place, name, "pooled", f"{what}_{end}_per_year", 2) for place in places for end in ("least", "most")]


THREE = ("Liechtenstein", "Andorra", "Monaco")
# Place, class, span (of an interval: its first day), column, digits: in the order in which the page names them.
SAID = [
    *of_causes(("Liechtenstein", "Andorra", "Douglas", "Ramsey", "Monaco"), "building", "appeared", "mapping"),
    *bounds(THREE, "building", "vanish"),
    *bounds(THREE, "building", "appear"),
    ("Liechtenstein", "building", "pooled", "appear_per_year", 2),
    ("Liechtenstein", "building", "2013-08-03", "appear_per_year", 2),
    ("Liechtenstein", "building", "2022-12-15", "appear_per_year", 2),
    ("Klaksvik", "building", "2016-01-01", "appeared_share", 1),
    ("Runavik", "building", "2014-01-01", "appeared_share", 1),
    ("Runavik", "building", "2016-01-01", "appeared_share", 1),
    ("Neubrandenburg", "building", "2014-05-09", "vanished_share", 1),
    ("Neubrandenburg", "building", "2014-05-09", "vanished_world_share", 1),
    *of_causes(("Liechtenstein", "Andorra"), "road_minor", "vanished", "retagged", "redrawn"),
    *bounds(("Liechtenstein", "Andorra"), "road_minor", "vanish"),
    ("Liechtenstein", "building", REDRAW, "id_vanished_share", 1),
    ("Liechtenstein", "building", REDRAW, "vanished_share", 1),
    ("Liechtenstein", "building", REDRAW, "redrawn_share", 1),
    ("Andorra", "path_track", "whole", "id_vanished_share", 1),
    ("Andorra", "path_track", "whole", "vanished_share", 1),
    ("Liechtenstein", "green", "pooled", "appear_per_year", 2),
    *of_causes(("Liechtenstein", "Andorra"), "green", "appeared", "untold"),
    *(
        ("Liechtenstein", name, "pooled", column, 2)
        for name in ("building", "road_minor", "path_track")
        for column in ("ground_lost_per_year", "vanish_per_year")
    ),
    ("Andorra, a day apart, edges kept", "building", "whole", "vanished_share", 1),
    ("Andorra", "building", "whole", "vanished_share", 1),
    ("Andorra, a day apart", "building", "whole", "vanished_share", 1),
    ("Andorra, a day apart", "water", "whole", "vanished_share", 1),
]


@pytest.fixture(scope="module")
def tables():
    return {name: item.table for name, item in runpy.run_path(str(FOLDER / "measure.py"))["read_all"]().items()}


@pytest.fixture(scope="module")
def text():
    return (FOLDER / "README.md").read_text(encoding="utf-8")


def value(tables, place, name, span, column):
    rows = tables[place][tables[place]["class"] == name]
    rows = (
        rows[(rows["span"] == "interval") & (rows["date_from"] == span)] if "-" in span else rows[rows["span"] == span]
    )
    (found,) = rows[column]
    return 100 * found


def test_every_percentage_of_the_findings_is_that_of_the_tables_in_their_order(tables, text):
    findings = text.split("## What the data say")[1].split("## How far it can be trusted")[0]
    given = re.findall(r"(?<![\d.])\d+\.\d+(?=\s+%|\s+to\s+\d+\.\d+\s+%)", findings)
    assert given == [f"{value(tables, *where):.{digits}f}" for *where, digits in SAID]


def test_what_the_page_says_in_words_is_so(tables, text):
    assert f"{len(tables) - 2} places in seven countries" in text  # two are controls
    ramsey = tables["Ramsey"][(tables["Ramsey"]["class"] == "building") & (tables["Ramsey"]["span"] == "whole")].iloc[0]
    assert f"{ramsey['n_from']:,} buildings in 2018 and {ramsey['n_to']:,} three years later" in text
    assert value(tables, "Klaksvik", "building", "2014-01-01", "vanished_share") == 0
    for place in ("Klaksvik", "Runavik"):
        assert value(tables, place, "building", "2016-01-01", "vanished_share") == 0
    for place in ("Liechtenstein", "Andorra"):
        assert round(value(tables, place, "green", "pooled", "appeared_world_share"), 1) == 0


def test_every_column_of_the_tables_is_told_of(tables, text):
    given = set(re.findall(r"`([a-z0-9_*]+)`", text.split("## Columns")[1].split("##")[0]))
    patterns = [re.compile(name.replace("*", r"\w*")) for name in given]
    numbers = [name for name, kind in tables["Monaco"].dtypes.items() if kind.kind in "fi" and name != "years"]
    assert [name for name in numbers if not any(pattern.fullmatch(name) for pattern in patterns)] == []
