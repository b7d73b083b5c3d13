# SPDX-License-Identifier: Apache-2.0
"""No number of docs/ageing/README.md is there that the tables do not hold."""

import re
from pathlib import Path

import pytest

from sasgeo_bench.ageing.files import read_ageing
from sasgeo_bench.ageing.ratebook import load_ratebook, pool_rates
from sasgeo_bench.osm.taxonomy import load_taxonomy

FOLDER = Path(__file__).parents[2] / "docs" / "ageing"
PLACES = ("liechtenstein", "andorra", "monaco", "dreieich", "faroe")
REDRAW = "2021-05-05"
# Place, class, span (of an interval: its first day), column, digits: in the order in which the page names them.
SAID = [
    ("liechtenstein", "building", REDRAW, "id_vanished_share", 1),
    ("liechtenstein", "building", REDRAW, "vanished_share", 1),
    ("liechtenstein", "building", REDRAW, "redrawn_share", 1),
    ("andorra", "path_track", "whole", "id_vanished_share", 1),
    ("andorra", "path_track", "whole", "vanished_share", 1),
    ("liechtenstein", "building", "2013-08-03", "appear_per_year", 2),
    ("liechtenstein", "building", "2022-12-15", "appear_per_year", 2),
    ("liechtenstein", "building", "pooled", "appear_per_year", 2),
    ("monaco", "building", "pooled", "appear_per_year", 2),
    ("dreieich", "building", "pooled", "appear_per_year", 2),
    *((place, "building", "pooled", "appeared_untold_share", 1) for place in PLACES),
    *((place, "building", "pooled", "vanished_world_share", 1) for place in ("liechtenstein", "andorra", "monaco")),
    ("dreieich", "building", "pooled", "vanished_world_share", 1),
    ("min", "path_track", "pooled", "appear_per_year", 2),
    ("max", "path_track", "pooled", "appear_per_year", 2),
    ("min", "field_boundary", "pooled", "appear_per_year", 2),
    ("max", "field_boundary", "pooled", "appear_per_year", 2),
    ("min", "building", "pooled", "vanish_per_year", 2),
    ("max", "building", "pooled", "vanish_per_year", 2),
    *(
        (place, "road_minor", "pooled", "vanished_retagged_share", 1)
        for place in ("liechtenstein", "andorra", "monaco", "faroe", "dreieich")
    ),
    ("andorra-control-edges", "building", "whole", "vanished_share", 1),
    ("andorra", "building", "whole", "vanished_share", 1),
    ("andorra-control", "building", "whole", "vanished_share", 1),
    ("andorra-control", "water", "whole", "vanished_share", 1),
    ("set by hand", "field_boundary", "", "appear_per_year", 2),
    ("min", "field_boundary", "pooled", "appear_per_year", 2),
    *(
        (place, "building", "whole", column, 1)
        for place in ("liechtenstein", "faroe")
        for column in ("appeared_number_share", "appeared_share")
    ),
    *(
        ("liechtenstein", name, "pooled", column, 2)
        for name in ("building", "road_minor", "path_track")
        for column in ("ground_lost_per_year", "vanish_per_year")
    ),
]


@pytest.fixture(scope="module")
def tables():
    return {path.parent.name: read_ageing(path.parent).table for path in FOLDER.glob("*/ageing.parquet")}


@pytest.fixture(scope="module")
def text():
    return (FOLDER / "README.md").read_text(encoding="utf-8")


def value(tables, place, name, span, column):
    if place == "set by hand":
        return 100 * getattr(load_taxonomy()[name].persistence, column)
    if place in ("min", "max"):
        known = [value(tables, item, name, span, column) for item in PLACES if name in set(tables[item]["class"])]
        return {"min": min, "max": max}[place](known)
    rows = tables[place][tables[place]["class"] == name]
    rows = (
        rows[(rows["span"] == "interval") & (rows["date_from"] == span)] if "-" in span else rows[rows["span"] == span]
    )
    (found,) = rows[column]
    return 100 * found


def test_every_percentage_of_the_findings_is_that_of_the_tables_in_their_order(tables, text):
    findings = text.split("## What the data say")[1].split("## Using the rates")[0]
    given = re.findall(r"(?<![\d.])\d+\.\d+(?=\s+%|\s+to\s+\d+\.\d+\s+%)", findings)
    assert given == [f"{value(tables, *where):.{digits}f}" for *where, digits in SAID]


def test_as_many_classes_grow_faster_than_was_set_by_hand_as_the_page_says(tables, text):
    measured = {name for place in PLACES for name in tables[place]["class"]}
    classes = [item for item in load_taxonomy().classes if item.name in measured]
    slow = [
        item.name
        for item in classes
        if item.persistence.appear_per_year * 100 < value(tables, "min", item.name, "pooled", "appear_per_year")
    ]
    assert f"For {len(slow)} of {len(classes)} classes the taxonomy's rate of appearance lies below" in text


def test_every_place_stands_on_the_page_as_in_the_summary(text):
    summary = (FOLDER / "summary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \w[^|]* \| [\d.,]+ \| \d+ \| \d{4}-[^|]* \| [^|]* \|", summary, flags=re.MULTILINE)
    assert len(rows) == 7
    assert [row for row in rows if row in text] == rows[: len(PLACES)]


def test_every_column_of_the_tables_is_told_of(tables, text):
    given = set(re.findall(r"`([a-z0-9_*]+)`", text.split("## Columns")[1].split("##")[0]))
    patterns = [re.compile(name.replace("*", r"\w*")) for name in given]
    numbers = [name for name, kind in tables["monaco"].dtypes.items() if kind.kind in "fi" and name != "years"]
    assert [name for name in numbers if not any(pattern.fullmatch(name) for pattern in patterns)] == []


def test_ground_is_lost_two_to_four_times_as_fast_as_buildings_roads_and_paths_vanish():
    """Finding 9, of the medians over the places, which the generator takes."""
    pooled = pool_rates(load_ratebook()).classes
    for name in ("building", "road_minor", "path_track"):
        assert 2 <= pooled[name].ground_lost_per_year / pooled[name].vanish_per_year <= 4
