# SPDX-License-Identifier: Apache-2.0
"""A detector's errors: as many as its F1 score says, lying together, and none that is unlike a detector's."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.detector import Agreement, ClassErrors, PerceptionSettings, agreement, measured_f1
from sasgeo_bench.tasks.perturbations.fields import eroded
from sasgeo_bench.tasks.perturbations.objects import find_objects
from sasgeo_bench.tasks.perturbations.perception import Perception

USUAL = PerceptionSettings().classes


def pooled(perception, views, name, repeats=5):
    counts = Agreement()
    for index, view in enumerate(views):
        for repeat in range(repeats):
            counts += agreement(view, perception(view, np.random.default_rng((index, repeat))), name)
    return counts


def scene(name, draw):
    cells = np.zeros((1, 128, 128), dtype=np.uint8)
    draw(cells[0])
    return Evidence(classes=(name,), cells=cells, cell_size_m=1.0)


def neighbour_agreement(errors):
    """Chance that the cell to the right of, or below, an error is one too, over the share of errors."""
    pairs = (errors[:, 1:] & errors[:, :-1]).sum() + (errors[1:] & errors[:-1]).sum()
    return pairs / (2 * errors.sum()) / errors.mean()


@pytest.mark.parametrize("error_factor", [1.0, 1.5])
@pytest.mark.parametrize("name", ["building", "road_minor", "road_major", "water", "green"])
def test_over_many_views_the_f1_score_is_the_one_asked_for(name, error_factor, views, view):
    least = USUAL[name].usual_share / 3
    shown = [item for item in (*views, view) if (item.layer(name) == PRESENT).mean() > least]
    target = 1 - error_factor * (1 - USUAL[name].f1)
    assert pooled(Perception(error_factor=error_factor), shown, name, 40 // len(shown)).f1 == pytest.approx(
        target, abs=0.06
    )


def test_more_error_is_a_lower_score(views):
    scores = [pooled(Perception(error_factor=factor), views, "building", 1).f1 for factor in (0.0, 0.5, 1.0, 2.0, 4.0)]
    assert scores[0] == 1.0
    assert scores == sorted(scores, reverse=True)


def test_errors_lie_together_and_are_no_single_flips(views):
    perception = Perception(error_factor=1.0)
    for index, view in enumerate(views[:4]):
        seen = perception(view, np.random.default_rng(index))
        for name in ("building", "road_minor", "green"):
            errors = seen.layer(name) != view.layer(name)
            if errors.sum() > 50:
                assert neighbour_agreement(errors) > 8  # cells flipped one by one have 1
                assert find_objects(errors).areas_cells.mean() > 3


def test_whole_houses_are_missed_but_not_all_that_is_lost_is(views):
    lost_whole = houses = 0
    for index, view in enumerate(views):
        seen = Perception(error_factor=1.5)(view, np.random.default_rng(index)).layer("building") == PRESENT
        found = find_objects(view.layer("building") == PRESENT)
        left = np.bincount(found.labels[seen], minlength=len(found.areas_cells) + 1)[1:]
        lost_whole += (left == 0).sum()
        houses += len(left)
    assert 0.02 < lost_whole / houses < 0.2


def test_a_road_gets_gaps_rather_than_a_thinner_band():
    road = scene("road_minor", lambda layer: layer[:, 60:65].fill(1))
    seen = Perception(error_factor=1.0, settings=PerceptionSettings(spread=0.0))(road, np.random.default_rng(0))
    widths = (seen.layer("road_minor")[:, 57:68] == PRESENT).sum(axis=1)
    assert ((widths == 0) | (widths >= 3)).mean() > 0.8
    assert 5 <= (widths == 0).sum() <= 50


def test_edges_are_off_by_no_more_than_two_cells_where_nothing_else_goes_wrong():
    errors = {"water": ClassErrors(f1=0.9, dropped=0.0, frayed=1.0, usual_share=0.0)}
    lake = scene("water", lambda layer: layer[30:100, 30:100].fill(1))
    settings = PerceptionSettings(classes=errors, spread=0.0)
    seen = Perception(error_factor=0.5, settings=settings)(lake, np.random.default_rng(2))
    wrong = seen.layer("water") != lake.layer("water")
    inner = eroded(lake.layer("water") == PRESENT, 2 * 1.5)
    assert wrong.sum() > 50
    assert wrong[inner].sum() <= 0.01 * wrong.sum()  # thresholds come from a sample, so a cell or so may be left over


def test_what_one_class_loses_another_one_gains():
    cells = np.zeros((2, 128, 128), dtype=np.uint8)
    cells[0, :, :64] = cells[1, :, 64:] = 1
    fields = Evidence(classes=("green", "farmland"), cells=cells, cell_size_m=1.0)
    taken = [
        ((seen.cells[0] != PRESENT) & (seen.cells[1] == PRESENT) & (cells[0] == 1)).sum()
        for seen in (Perception(error_factor=2.0)(fields, np.random.default_rng(seed)) for seed in range(10))
    ]
    assert np.mean(taken) > 100


def test_a_class_without_settings_is_seen_without_error(view):
    settings = PerceptionSettings(classes={"water": ClassErrors(f1=0.5)})
    seen = Perception(error_factor=1.0, settings=settings)(view, np.random.default_rng(0))
    for name in view.classes:
        assert (seen.layer(name) == view.layer(name)).all() == (name != "water")


def test_every_class_has_errors_and_is_taken_for_a_class_there_is():
    names = load_taxonomy().names
    assert set(USUAL) == set(names)
    assert {item.confused_with for item in USUAL.values()} <= {*names, None}


@given(factor=st.floats(0, 20), seed=st.integers(0, 2**32), cell_size_m=st.floats(0.2, 10))
def test_any_view_stays_a_view_of_known_cells(factor, seed, cell_size_m):
    rng = np.random.default_rng(seed)
    cells = (rng.random((3, 24, 31)) < rng.random((3, 1, 1))).astype(np.uint8)
    noisy = Evidence(classes=("building", "road_minor", "green"), cells=cells, cell_size_m=cell_size_m)
    seen = Perception(error_factor=factor)(noisy, rng)
    assert seen.cells.shape == cells.shape
    assert seen.unknown_share == 0.0


def test_a_thin_class_has_one_cell_of_tolerance_and_an_area_none():
    cells = np.zeros((1, 9, 9), dtype=np.uint8)
    cells[0, :, 4] = 1
    for name, score in (("road_minor", 1.0), ("green", 0.0)):
        line = Evidence(classes=(name,), cells=cells.copy(), cell_size_m=1.0)
        assert measured_f1(line, line.replace(np.roll(cells, 1, axis=2)), name) == score
        assert measured_f1(line, line.replace(np.roll(cells, 2, axis=2)), name) == 0.0


def test_f1_without_anything_to_see_is_no_number():
    assert np.isnan(Agreement().f1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PerceptionSettings.with_f1(castle=0.5), "no class 'castle'"),
        (lambda: PerceptionSettings.with_f1(road_minor=1.5), "f1 lies between 0 and 1, got 1.5"),
        (lambda: PerceptionSettings(patch_m=0.0), "patch_m lies between"),
        (lambda: PerceptionSettings(classes={"a": ClassErrors(f1=1.0, confused_with="a")}), "taken for itself"),
        (lambda: dataclasses.replace(USUAL["water"], frayed=2.0), "frayed lies between"),
    ],
)
def test_settings_that_cannot_be_are_refused(make, words):
    with pytest.raises(PerturbError, match=words):
        make()
