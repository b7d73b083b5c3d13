# SPDX-License-Identifier: Apache-2.0
"""The taxonomy: exact values only, one label a class, and a file whose faults are told."""

import pytest

from sasgeo_bench.config import parse_toml
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.osm.taxonomy import Rule, Taxonomy, classify, load_taxonomy
from sasgeo_bench.regions.preview import PAINT_ORDER
from sasgeo_bench.sensing.birdseye import WIDTHS_M
from sasgeo_bench.tasks.perturbations.measured import MEASURED
from sasgeo_bench.tasks.perturbations.perception import ERRORS

WANTED = {
    *("road_major", "road_minor", "path_track", "railway", "building", "water", "waterway", "coastline"),
    *("green", "farmland", "field_boundary", "bridge", "parking", "bare"),
}
ONE_CLASS = """
[[class]]
id = {id}
name = "{name}"
title = "A class"
kind = "area"
colour = "#101010"
persistence = {{ prior = 0.5, vanish_per_year = 0.0, appear_per_year = 0.0 }}
rules = [{{ key = "building", geometry = "area", values = ["yes"] }}]
"""


def line_classes(**tags):
    return [label.class_name for label in classify(tags, load_taxonomy()).line]


def area_classes(**tags):
    return [label.class_name for label in classify(tags, load_taxonomy()).area]


def test_every_class_that_the_benchmark_promises_is_there():
    assert set(load_taxonomy().names) >= WANTED


def test_every_class_is_drawn_and_has_the_errors_of_a_detector():
    names = set(load_taxonomy().names)
    assert set(PAINT_ORDER) == names, "PAINT_ORDER in regions/preview.py: docs/howto/class.md"
    assert set(ERRORS) == names, "ERRORS in tasks/perturbations/perception.py: docs/howto/class.md"
    assert set(MEASURED) == names, "MEASURED in tasks/perturbations/measured.py: docs/howto/class.md"
    assert set(WIDTHS_M) == names, "WIDTHS_M in sensing/birdseye.py: docs/howto/class.md"


def test_no_tag_makes_two_classes_of_one_geometry():
    rules = [(item.name, rule) for item in load_taxonomy().classes for rule in item.rules]
    tags = [
        (rule.key, value, rule.geometry, name) for name, rule in rules for value in {*(rule.values or ()), *rule.widths}
    ]
    by_tag = {}
    for *tag, name in tags:
        by_tag.setdefault(tuple(tag), []).append(name)
    assert {tag: names for tag, names in by_tag.items() if len(names) > 1} == {}


@pytest.mark.parametrize(
    ("tags", "wanted"),
    [
        ({"highway": "motorway_link"}, ["road_major"]),
        ({"highway": "residential"}, ["road_minor"]),
        ({"highway": "footway"}, ["path_track"]),
        ({"highway": "primary", "bridge": "viaduct"}, ["road_major", "bridge"]),
        ({"railway": "rail"}, ["railway"]),
        ({"waterway": "stream"}, ["waterway"]),
        ({"natural": "coastline"}, ["coastline"]),
        ({"barrier": "hedge"}, ["field_boundary"]),
    ],
)
def test_lines_get_the_class_their_tags_say(tags, wanted):
    assert line_classes(**tags) == wanted


@pytest.mark.parametrize(
    "tags",
    [
        *({"natural": value} for value in ("bare_rock", "rock", "scree", "shingle", "sand", "beach")),
        {"landuse": "quarry", "name": "Old quarry"},
    ],
)
def test_ground_on_which_nothing_grows_is_bare(tags):
    assert area_classes(**tags) == ["bare"]
    assert line_classes(**tags) == []


def test_ids_of_older_classes_stay():
    older = ("road_major", "road_minor", "path_track", "railway", "building", "water", "waterway", "coastline")
    assert load_taxonomy().names[:14] == (
        *older,
        *("green", "farmland", "field_boundary", "bridge", "parking", "bare"),
    )


def test_a_value_is_matched_whole():
    assert line_classes(highway="primary_") == []
    assert line_classes(highway="xprimary") == []
    assert line_classes(bridge="no", highway="primary") == ["road_major"]
    assert area_classes(building="no") == []
    assert area_classes(building="anything else") == ["building"]


def test_what_no_rule_knows_is_named():
    assert classify({"railway": "razed", "name": "x"}, load_taxonomy()).unknown == ("railway=razed",)


def test_a_rule_needs_values_or_widths():
    with pytest.raises(ValueError, match="either values or widths"):
        Rule(key="highway", geometry="line")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (ONE_CLASS.format(id=1, name="a"), "count up from 0"),
        (ONE_CLASS.format(id=0, name="a") + ONE_CLASS.format(id=1, name="a"), "unique"),
        (ONE_CLASS.format(id=0, name="Big"), "name"),
        (ONE_CLASS.format(id=0, name="a").replace("kind", 'covered_by = "sky"\nkind'), "covered_by names a class"),
    ],
)
def test_a_taxonomy_with_a_fault_is_refused(text, fault):
    with pytest.raises(ConfigError, match=fault):
        parse_toml(text, Taxonomy, source="taxonomy.toml")
