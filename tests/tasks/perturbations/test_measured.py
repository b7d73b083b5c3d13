# SPDX-License-Identifier: Apache-2.0
"""The detector "measured": its views have the recall, the precision and the confusions that its table was made of."""

from collections import Counter

import numpy as np
import pytest

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import dilated, find_objects
from sasgeo_bench.tasks.perturbations.measured import MEASURED, YARD_M, MeasuredPerception
from sasgeo_bench.tasks.perturbations.perception import TOLERANCE_CELLS, Perception

BUILT = ("road_major", "road_minor", "building", "parking")
REPEATS = 6


def nothing(_):
    """Draw a class that is not there."""


def drawn(side=192, **layers):
    cells = np.zeros((len(layers), side, side), dtype=np.uint8)
    for layer, draw in zip(cells, layers.values(), strict=True):
        draw(layer)
    return Evidence(classes=tuple(layers), cells=cells, cell_size_m=1.0)


def seen_of(view, count, perception=MeasuredPerception):
    return [perception(error_factor=1.0)(view, np.random.default_rng(seed)) for seed in range(count)]


def share_seen_as(view, name, other, count=40):
    """Share of the cells of a class that are seen as another one, or as nothing (None)."""
    mask = view.layer(name) == PRESENT
    hits = [
        (after.layer(other) == PRESENT)[mask] if other else (after.cells != PRESENT).all(axis=0)[mask]
        for after in seen_of(view, count)
    ]
    return np.mean(hits)


@pytest.fixture(scope="module")
def pairs(views):
    """Views of towns with what the detector makes of them."""
    return [(view, after) for view in views for after in seen_of(view, REPEATS)]


def rates(pairs, name):
    """Recall and precision of a class, pooled; for line classes with a tolerance of one cell."""
    sums = Counter()
    for before, after in pairs:
        true, seen = before.layer(name) == PRESENT, after.layer(name) == PRESENT
        near = (dilated(mask, TOLERANCE_CELLS) if name in load_taxonomy().lines else mask for mask in (true, seen))
        near_true, near_seen = near
        sums += Counter(
            true=true.sum(), found=(true & near_seen).sum(), seen=seen.sum(), right=(seen & near_true).sum()
        )
    return sums["found"] / sums["true"], sums["right"] / sums["seen"]


@pytest.mark.parametrize("name", ["road_minor", "building", "water"])
def test_recall_and_precision_are_those_of_the_table(name, pairs):
    assert rates(pairs, name) == pytest.approx((MEASURED[name].recall, MEASURED[name].precision), abs=0.06)


@pytest.mark.parametrize(("names", "share"), [(("building",), 0.058), (("road_major", "road_minor"), 0.052)])
def test_of_the_empty_ground_beside_what_is_built_as_much_is_taken_for_it_as_was_measured(names, share, pairs):
    taken = []
    for before, after in pairs:
        built = np.any([before.layer(name) == PRESENT for name in BUILT], axis=0)
        yard = dilated(built, YARD_M) & (before.cells != PRESENT).all(axis=0)
        taken.append((np.any([after.layer(name) == PRESENT for name in names], axis=0)[yard].sum(), yard.sum()))
    hits, total = np.sum(taken, axis=0)
    assert hits / total == pytest.approx(share, abs=0.015)


def test_a_field_becomes_grass_or_nothing_as_often_as_measured():
    fields = drawn(farmland=lambda layer: layer.fill(1), green=nothing)
    assert share_seen_as(fields, "farmland", "green") == pytest.approx(0.37, abs=0.06)
    assert share_seen_as(fields, "farmland", None) == pytest.approx(1 - 0.47 - 0.37, abs=0.06)


def test_a_bridge_becomes_road_as_often_as_measured_and_then_as_a_whole():
    overpasses = drawn(
        road_minor=nothing,
        bridge=lambda layer: [layer[y : y + 6, x : x + 24].fill(1) for x in (9, 69, 129) for y in range(10, 180, 30)],
    )
    assert 0.07 <= share_seen_as(overpasses, "bridge", "road_minor") <= 0.13
    found = find_objects(overpasses.layer("bridge") == PRESENT)
    for after in seen_of(overpasses, 5):
        called = np.bincount(found.labels[after.layer("road_minor") == PRESENT], minlength=19)[1:]
        assert set((called / found.areas_cells).round(1)) <= {0.0, 1.0}


def test_pools_are_hardly_ever_seen_and_lakes_are():
    pools = drawn(water=lambda layer: [layer[y : y + 5, x : x + 9].fill(1) for x in (20, 90) for y in (20, 90)])
    lake = drawn(water=lambda layer: layer[40:150, 30:160].fill(1))
    assert share_seen_as(pools, "water", None) > 0.8
    assert share_seen_as(lake, "water", None) == pytest.approx(1 - MEASURED["water"].recall, abs=0.06)


def test_small_houses_are_missed_more_often_than_large_ones():
    sides = np.repeat([4, 14], 24)
    places = [(x, y) for x in range(6, 182, 24) for y in range(6, 150, 24)]

    def draw(layer):
        for side, (x, y) in zip(sides, places, strict=True):
            layer[y : y + side, x : x + side] = 1

    found = find_objects((town := drawn(building=draw)).layer("building") == PRESENT)
    left = [
        np.bincount(found.labels[after.layer("building") == PRESENT], minlength=len(sides) + 1)[1:]
        for after in seen_of(town, 20)
    ]
    missed = (np.array(left) == 0).mean(axis=0)
    assert missed[found.areas_cells < 20].mean() > 5 * missed[found.areas_cells > 100].mean()


def test_its_errors_lie_together_over_longer_stretches_than_those_of_the_published_detector():
    """Structure, not numbers: as many errors would still lie otherwise."""
    wood = drawn(green=lambda layer: layer.fill(1))
    sizes = []
    for perception in (Perception, MeasuredPerception):
        lost = [after.layer("green") != PRESENT for after in seen_of(wood, 8, perception)]
        areas = np.concatenate([find_objects(mask).areas_cells for mask in lost])
        sizes.append((areas**2).sum() / areas.sum())  # of the patch that a lost cell lies in
    assert sizes[1] > 3 * sizes[0]
