# SPDX-License-Identifier: Apache-2.0
"""The taxonomy: exact values only, one label a class, and a file whose faults are told."""

import re

import pytest

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import Rule, SemanticClass, Taxonomy, classify, load_taxonomy

ONE_CLASS = """
[[class]]
id = {id}
name = "{name}"
title = "A class"
kind = "area"
colour = "#101010"
persistence = {{ prior = 0.5, vanish_per_year = 0.0, appear_per_year = 0.0 }}
paint = 1{id}
graph = "none"
group = "none"
cover = "none"
look = "none"
narrowest_m = 1.0
standing_m = 0.0
volatile = 0
traits = []
seasons = {{}}
seen_share = {{}}
published = {{ recall = 0.5, precision = 0.5 }}
measured = {{ recall = 0.5, precision = 0.5 }}
rules = [{{ key = "building", geometry = "area", values = ["yes"] }}]
"""


def line_classes(**tags):
    return [label.class_name for label in classify(tags, load_taxonomy()).line]


def area_classes(**tags):
    return [label.class_name for label in classify(tags, load_taxonomy()).area]


@pytest.mark.parametrize("key", [name for name, field in SemanticClass.model_fields.items() if field.is_required()])
def test_a_class_that_leaves_anything_open_is_refused(key):
    text = re.sub(rf"^{key} = .*$", "", ONE_CLASS.format(id=0, name="a"), flags=re.MULTILINE)
    with pytest.raises(ConfigError, match=f"'class.0.{key}' is missing"):
        parse_toml(text, Taxonomy, source="taxonomy.toml")


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
        ({"highway": "footway"}, ["path_track"]),
        ({"highway": "primary", "bridge": "viaduct"}, ["road_major", "bridge"]),
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
    older += ("green", "farmland", "field_boundary", "bridge", "parking", "bare")
    assert load_taxonomy().names[:14] == older


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('kind = "area"', 'kind = "area"\ncovered_by = "sky"', "covered_by names a class"),
        ('look = "none"', 'look = "sky"', "look names a class"),
        ("published = { ", 'published = { confused_with = "sky", ', "confused_with names a class"),
        ("measured = { ", "measured = { called = { sky = 0.1 }, ", "called names a class"),
        ("traits = []", 'traits = ["shiny"]', "traits"),
        ("volatile = 0", "volatile = 7", "volatile"),
        ("id = 0", "id = 1", "count up from 0"),
        ('name = "a"', 'name = "Big"', "name"),
        ("", ONE_CLASS.format(id=1, name="a"), "unique"),
        ("", ONE_CLASS.format(id=1, name="b").replace("paint = 11", "paint = 10"), "paint is a rank of each class"),
    ],
)
def test_a_taxonomy_with_a_fault_is_refused(old, new, fault):
    text = ONE_CLASS.format(id=0, name="a")
    with pytest.raises(ConfigError, match=fault):
        parse_toml(text.replace(old, new) if old else text + new, Taxonomy, source="taxonomy.toml")


def test_a_value_is_matched_whole_and_what_no_rule_knows_is_named():
    assert line_classes(highway="primary_") == []
    assert line_classes(highway="xprimary") == []
    assert line_classes(bridge="no", highway="primary") == ["road_major"]
    assert area_classes(building="no") == []
    assert area_classes(building="anything else") == ["building"]
    assert classify({"railway": "razed", "name": "x"}, load_taxonomy()).unknown == ("railway=razed",)
    with pytest.raises(ValueError, match="either values or widths"):
        Rule(key="highway", geometry="line")
