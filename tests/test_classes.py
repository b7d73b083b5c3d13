# SPDX-License-Identifier: Apache-2.0
"""A class of the map is a row of `taxonomy.toml`: no list of classes stands elsewhere, and a row more changes no other."""

import ast
import os
import subprocess
import sys
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import sasgeo_baselines
from sasgeo_baselines import anyvisloc_pipeline, polar, zilke_semantic_mi
from sasgeo_baselines.trackers import kinnari_mcl, swapf

import sasgeo_bench
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sasgeo import class_weights

PACKAGES = tuple(Path(one.__file__).parent for one in (sasgeo_bench, sasgeo_baselines))
# Files that name two classes or more in one literal, and why that is no list to be derived.
ALLOWED = {
    "osm/geojson.py": "keys of OSM, not classes",
    "osm/history.py": "keys of OSM, not classes",
    "osm/synthetic/town.py": "keys of OSM, not classes",
    "osm/taxonomy.py": "parts of a graph, two of which are called as classes are",
    "sensing/tiny_images.py": "drawn pictures, which never change",
    "scoring/segmenter_tables.py": "the classes that a page shows by season and place",
    "experiments/paper/tiles.py": "the five classes of the paper",
    "experiments/paper/trials.py": "the five classes of the paper",
    "anyvisloc_pipeline.py": "greys of its drawing; RECIPES below holds whom they leave out",
    "segmenters/colour_thresholds.py": "the classes that it can tell",
}
# Recipes that take classes together, and the classes that they leave out, as is said.
RECIPES = {
    "anyvisloc_pipeline": (anyvisloc_pipeline.GREYS, ""),
    "class_weights": (chain(*class_weights.GROUPS), "bare parking"),
    "kinnari_mcl": (chain(*kinnari_mcl.GROUPS), "bare"),
    "polar": (chain(*polar.GROUPS), "bare bridge parking"),
    "swapf": (chain(*swapf.GROUPS), "bare coastline water waterway"),
    "zilke_semantic_mi": (chain(*zilke_semantic_mi.LABELS), "bare"),
}
# Keys of a class that belong to the generator of queries, and to the scorer, which learns of the other's by nothing.
OF_GENERATOR, OF_SCORER = ("published", "measured", "seasons", "touched_by", "volatile"), ("seen_share", "prior")


def named(node: ast.AST) -> set[str]:
    """The classes that a literal list, tuple, set or dictionary names."""
    parts = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", ())
    return {part.value for part in parts if isinstance(part, ast.Constant)} & set(load_taxonomy().names)


def test_lists_of_classes_are_derived_from_the_taxonomy():
    found = {
        path.relative_to(root).as_posix(): path
        for root in PACKAGES
        for path in root.rglob("*.py")
        if any(len(named(node)) > 1 for node in ast.walk(ast.parse(path.read_bytes())))
    }
    assert set(found) == set(ALLOWED), "derive the list from a key of taxonomy.toml, or give the reason in ALLOWED"


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_leaves_out_only_the_classes_that_it_says(name):
    taken, left_out = RECIPES[name]
    assert set(load_taxonomy().names) - set(taken) == set(left_out.split()), f"has {name} a place for the new class?"


def test_generator_and_scorer_read_no_key_of_each_other():
    package = PACKAGES[0]
    keys = {
        path.relative_to(package).as_posix(): {
            node.attr for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Attribute)
        }
        for path in package.rglob("*.py")
    }
    scorer = [path for path, found in keys.items() if path.startswith("sasgeo/") and found & {*OF_GENERATOR[:4]}]
    generator = [path for path, found in keys.items() if path.startswith("tasks/") and found & {*OF_SCORER}]
    assert scorer == [] == generator
