# SPDX-License-Identifier: Apache-2.0
"""A class of the map is a row of `taxonomy.toml`: no list stands elsewhere, and a row more changes no other."""

import ast
import subprocess
import sys
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import sasgeo_baselines
import sasgeo_paper
from sasgeo_baselines import anyvisloc_pipeline, polar, zilke_semantic_mi
from sasgeo_baselines.trackers import kinnari_mcl, swapf

import sasgeo_bench as sgb
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sasgeo import class_weights
from sasgeo_bench.sensing.rendering.roads import STREETS

PACKAGES = tuple(Path(one.__file__).parent for one in (sgb, sasgeo_baselines, sasgeo_paper))
# Files that name two classes or more in one literal, and why that is no list to be derived.
ALLOWED = {
    "ageing/causes.py": "rails and bridges are built as well, and no key says so",
    "osm/geojson.py": "keys of OSM, not classes",
    "osm/history.py": "keys of OSM, not classes",
    "osm/synthetic/town.py": "keys of OSM, not classes",
    "osm/taxonomy.py": "parts of a graph, two of which are called as classes are",
    "sensing/tiny_images.py": "drawn pictures, which never change",
    "scoring/segmenter_board.py": "the classes that a page shows by season and place",
    "tiles.py": "the five classes of the paper",
    "trials.py": "the five classes of the paper",
    "anyvisloc_pipeline.py": "greys of its drawing; RECIPES below holds whom they leave out",
    "segmenters/colour_thresholds.py": "the classes that it can tell",
    "segmenters/osm_unet.py": "the classes that its weights were taught",
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
# Keys of a class that the generator of queries reads, and the scorer may not, and the other way round.
OF_GENERATOR, OF_SCORER = {"published", "measured", "touched_by", "volatile"}, {"seen_share"}
# A class that no map has yet, drawn as a detector sees car parks; nothing in a town is one.
ANOTHER = f"""
[[class]]
id = {len(load_taxonomy().classes)}
name = "solar"
title = "field of solar panels"
kind = "area"
colour = "#101060"
persistence = {{ prior = 0.9, vanish_per_year = 0.01, appear_per_year = 0.05 }}
paint = 45
graph = "none"
group = "none"
cover = "none"
look = "none"
narrowest_m = 5.0
standing_m = 0.0
volatile = 3
traits = ["drawn", "compared", "built", "blocks_areas", "blocks_lines", "clears"]
seasons = {{ snow = "unknown" }}
seen_share = {{ snow = 0.5 }}
published = {{ recall = 0.7, precision = 0.7 }}
measured = {{ recall = 0.7, precision = 0.7 }}
rules = [{{ key = "power", geometry = "area", values = ["plant", "generator"] }}]
"""
# Draws queries of a town; `sys.argv` holds the root, and what the taxonomy has besides.
DRAW = """
import sys
from importlib import resources
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.osm import taxonomy
text = resources.files("sasgeo_bench.osm").joinpath("taxonomy.toml").read_text(encoding="utf-8")
known = parse_toml(text + sys.argv[2], taxonomy.Taxonomy, source="grown.toml")
taxonomy.load_taxonomy = lambda: known
import sasgeo_bench as sgb
sgb.make_tasks(suite=sys.argv[3:], regions=["town-riverside"], n=1, up_to=True, skip=True, out=sys.argv[1])
"""
SUITES = ("clean", "season", "synthetic-age")


def names_classes(node: ast.AST, classes: frozenset[str]) -> bool:
    """Whether a literal list, tuple, set or dictionary names two classes or more."""
    parts = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", ())
    return sum(isinstance(part, ast.Constant) and part.value in classes for part in parts) > 1


def test_lists_of_classes_are_derived_from_the_taxonomy():
    classes = frozenset(load_taxonomy().names)
    found = {
        path.relative_to(root).as_posix()
        for root in PACKAGES
        for path in root.rglob("*.py")
        if any(names_classes(node, classes) for node in ast.walk(ast.parse(path.read_bytes())))
    }
    assert found == set(ALLOWED), "derive the list from a key of taxonomy.toml, or give the reason in ALLOWED"


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_leaves_out_only_the_classes_that_it_says(name):
    taken, left_out = RECIPES[name]
    assert set(load_taxonomy().names) - set(taken) == set(left_out.split()), f"has {name} a place for the new class?"


@pytest.mark.parametrize(("folder", "keys"), [("sasgeo", OF_GENERATOR), ("tasks", OF_SCORER)])
def test_generator_and_scorer_read_no_key_of_each_other(folder, keys):
    for path in (PACKAGES[0] / folder).rglob("*.py"):
        read = {node.attr for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Attribute)}
        assert not read & keys, path


def test_pictures_paint_every_look():
    asked = {
        node.args[0].value
        for path in (PACKAGES[0] / "sensing" / "rendering").glob("*.py")
        for node in ast.walk(ast.parse(path.read_bytes()))
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", "") == "of"
        and isinstance(node.args[0], ast.Constant)
    }
    assert {item.look for item in load_taxonomy().classes} == {"none", *STREETS, *asked}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Queries and truths by suite, drawn by the taxonomy as it is, and by one with a class more."""

    def draw(more):
        out = tmp_path_factory.mktemp("out")
        subprocess.run([sys.executable, "-c", DRAW, str(out), more, *SUITES], check=True)  # noqa: S603
        where = [(name, out / "tasks" / name / "town-riverside") for name in SUITES]
        queries = {name: list(sgb.read_queries(folder)) for name, folder in where if folder.is_dir()}
        return queries, {name: list(sgb.read_truths(out / "truth" / name / "town-riverside")) for name in queries}

    return draw(""), draw(ANOTHER)


@pytest.mark.slow
def test_one_more_class_changes_no_query_in_which_it_is_not_drawn(drawn):
    (before, truths), (after, truths_after) = drawn
    assert set(before) == set(after) > {"clean"}
    plain = [
        [replace(one, measured={}, unknown_share=0.0) for one in chain(*each.values())]
        for each in (truths, truths_after)
    ]
    assert plain[0] == plain[1]  # the rest is a share of the cells of all classes
    for suite, queries in before.items():
        for one, two in zip(queries, after[suite], strict=True):
            assert two.evidence.classes == (*one.evidence.classes, "solar")
            np.testing.assert_array_equal(two.evidence.cells[:-1], one.evidence.cells)
            assert (one.query_id, one.prior, one.candidates) == (two.query_id, two.prior, two.candidates)
