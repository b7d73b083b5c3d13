# SPDX-License-Identifier: Apache-2.0
"""The packages in docs/examples: what a stranger enters, whole and small, and their cards fit a submission."""

import math
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import sasgeo_bench as sgb
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.matching.submission import Card
from tests.slow import rest_slow

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
MATCHERS = {"patch-neighbour": "PatchNeighbour", "plain-template": "PlainTemplate"}


@pytest.fixture
def load(monkeypatch):
    def of(name):
        module = name.replace("-", "_")
        monkeypatch.syspath_prepend(str(EXAMPLES / name / "src"))
        try:
            return getattr(import_module(f"{module}.matcher"), MATCHERS[name])
        finally:
            for one in (module, f"{module}.matcher"):
                sys.modules.pop(one, None)

    return of


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("**/card.toml")), ids=lambda path: path.parent.name)
def test_each_card_is_that_of_a_submission_under_the_name_of_its_folder(path):
    card = parse_toml(path.read_text(encoding="utf-8"), Card, source=str(path))
    assert card.name == path.relative_to(EXAMPLES).parts[0]
    assert card.licence == "Apache-2.0"


def seen_exactly(region, query, pose):
    """A query with the map as its view, without an error."""
    seen = query.evidence
    order = [region.classes.index(name) for name in seen.classes]
    layers = sgb.LayerBits.of(region.layers)
    cells = sgb.observe(layers, region.grid, pose, size_cells=seen.shape[0], cell_size_m=seen.cell_size_m)[order]
    return replace(query, evidence=replace(seen, cells=cells))


def exact_views(tiny):
    """Queries whose view is the map, without an error, with their poses."""
    pairs = [(query, truth.pose) for query, truth in zip(tiny.queries, tiny.truths, strict=True) if truth.pose]
    known = [pair for pair in pairs if not pair[0].candidates and pair[0].prior.yaw_deg is not None]
    return [(seen_exactly(tiny.region, query, pose), pose) for query, pose in known]


def test_a_view_without_errors_is_found_by_the_template(tiny, load):
    matcher = load("plain-template")()
    matcher.prepare(tiny.region, None)
    away_m = []
    for query, pose in exact_views(tiny)[:4]:
        best = matcher.match(query, top_k=3).poses[0]
        away_m.append(math.dist(*((one.easting_m, one.northing_m) for one in (best, pose))))
    assert min(away_m) <= 25, away_m  # of a disc of 500 m


def test_the_patch_of_a_view_without_errors_is_that_of_the_map_at_its_place(tiny, load):
    """The fields of this place are too alike to be told apart, so the right patch need not be the nearest."""
    matcher = load("patch-neighbour")()
    matcher.prepare(tiny.region, None)
    for query, pose in exact_views(tiny):
        known, share = matcher.patch(query.evidence, pose.yaw_deg)
        ((right, down),) = matcher.grid.to_uv(np.array([(pose.easting_m, pose.northing_m)]))
        there = matcher.patches[round(down - 4), round(right - 4)].ravel()  # half of eight blocks
        assert (there * known) @ share / math.sqrt(there**2 @ known * (known @ share**2)) > 0.8


@pytest.mark.parametrize("name", MATCHERS)
def test_it_withholds_where_nothing_is_known(tiny, load, name):
    matcher = load(name)()
    matcher.prepare(tiny.region, None)
    query = next(query for query in tiny.queries if query.track == "localization")
    evidence = replace(query.evidence, cells=np.full_like(query.evidence.cells, sgb.UNKNOWN))
    blind = replace(query, evidence=evidence)
    assert matcher.match(blind, top_k=3) == sgb.WITHHELD


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("name", rest_slow(MATCHERS, but=0))
def test_it_conforms(tiny, monkeypatch, name):
    monkeypatch.syspath_prepend(str(EXAMPLES / name / "src"))
    checks = sgb.check_matcher(f"{name.replace('-', '_')}.matcher:{MATCHERS[name]}", place=tiny)
    assert [check.name for check in checks if check.outcome == "fail"] == []
