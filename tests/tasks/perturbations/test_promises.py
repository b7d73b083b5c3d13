# SPDX-License-Identifier: Apache-2.0
"""Every perturbation keeps the contract of perturbations, and refuses parameters out of range."""

import dataclasses

import numpy as np
import pytest

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.perturbations.ageing import Ageing, rates_by_hand
from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, RowJitter, Tilt
from sasgeo_bench.tasks.perturbations.measured import MeasuredPerception
from sasgeo_bench.tasks.perturbations.occlusion import (
    AdversarialMask,
    Border,
    CanopyAndShadow,
    CentralCrop,
    FalseUnknown,
    Glare,
    Rectangles,
    TiltWedge,
)
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.perturbations.season import Season

RATES = rates_by_hand()
ALL = (
    Perception(error_factor=1.0),
    MeasuredPerception(error_factor=1.0),
    Rectangles(share=0.3),
    Border(share=0.3),
    TiltWedge(share=0.3),
    Glare(share=0.2),
    CanopyAndShadow(share=0.6),
    AdversarialMask(share=0.3),
    FalseUnknown(share=0.2),
    LocalWarp(rms_m=10.0),
    RowJitter(rms_m=10.0),
    Tilt(rms_m=10.0),
    CentralCrop(share=0.3),
    Season(kind="leaf_on", strength=0.6),
    Season(kind="snow", strength=0.6),
    Season(kind="low_water", strength=0.6),
    Season(kind="harvest", strength=0.6),
    Ageing(years=10.0, rates=RATES, place="here"),
)
DETERMINISTIC = (AdversarialMask, CentralCrop)
MOVES = (LocalWarp, RowJitter, Tilt)
STRENGTH = {Season: "strength", Ageing: "years"}  # of the others: share
STRENGTH |= dict.fromkeys((Perception, MeasuredPerception), "error_factor") | dict.fromkeys(MOVES, "rms_m")
every = pytest.mark.parametrize("perturbation", ALL, ids=lambda item: getattr(item, "kind", type(item).__name__))


def strength_of(perturbation):
    return STRENGTH.get(type(perturbation), "share")


def check_perturbation(perturbation, evidence, seed=0):
    """Hold a perturbation to the contract of all perturbations, on one view."""
    kept = evidence.cells.copy()
    first, second = (perturbation(evidence, np.random.default_rng(seed)) for _ in range(2))
    neutral = dataclasses.replace(perturbation, **{strength_of(perturbation): 0.0})
    assert np.array_equal(evidence.cells, kept), "changes its input"
    assert first.classes == evidence.classes
    assert first.cells.shape == kept.shape
    assert first.cell_size_m == evidence.cell_size_m
    assert (first.confidence is None) == (evidence.confidence is None)
    assert np.array_equal(first.cells, second.cells), "differs for equal seeds"
    if not isinstance(perturbation, MOVES):
        assert (first.cells[kept == UNKNOWN] == UNKNOWN).all(), "makes an unknown cell known"
    assert np.array_equal(neutral(evidence, np.random.default_rng(seed)).cells, kept), "changes a cell at strength 0"


@every
def test_the_same_seed_gives_the_same_view_and_another_one_another(perturbation, view):
    first, second, other = (perturbation(view, np.random.default_rng(seed)).cells for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any() == (type(perturbation) not in DETERMINISTIC)


@every
def test_it_keeps_its_promises_on_every_view(perturbation, views, half_known):
    for view in (*views[::3], half_known):
        check_perturbation(perturbation, view)


@every
def test_it_does_something_and_no_more_than_half_of_the_view(perturbation, views, view):
    changed = [share_changed(item, perturbation(item, np.random.default_rng(4))) for item in (*views[::2], view, view)]
    assert 0.0001 < np.mean(changed) < 0.5


@every
def test_views_of_one_class_one_cell_and_of_any_shape_are_taken(perturbation, view):
    one_class = dataclasses.replace(view, classes=view.classes[4:5], cells=view.cells[4:5, :50, :70].copy())
    check_perturbation(perturbation, one_class)
    for rows, cols in ((1, 1), (1, 40), (40, 3)):
        check_perturbation(perturbation, view.replace(view.cells[:, :rows, :cols].copy()))


@every
def test_a_view_that_is_unknown_all_over_stays_so(perturbation, view):
    blank = view.replace(np.full_like(view.cells, UNKNOWN))
    assert perturbation(blank, np.random.default_rng(0)).unknown_share == 1.0


@every
@pytest.mark.parametrize("value", [-99.0, float("nan"), float("inf"), "much", None, True])
def test_a_strength_that_is_none_is_refused_in_one_line(perturbation, value):
    name = strength_of(perturbation)
    with pytest.raises(PerturbError, match=f"{type(perturbation).__name__}: {name} lies between") as caught:
        dataclasses.replace(perturbation, **{name: value})
    assert "\n" not in str(caught.value)
