# SPDX-License-Identifier: Apache-2.0
"""What is drawn for one class depends on no other class: one more class changes no view of the others."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.osm.taxonomy import MeasuredErrors
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates, rates_by_hand
from sasgeo_bench.tasks.perturbations.measured import MEASURED, MeasuredPerception
from sasgeo_bench.tasks.perturbations.occlusion import CanopyAndShadow, FalseUnknown, Glare
from sasgeo_bench.tasks.perturbations.perception import ERRORS, Perception, silent_profile
from sasgeo_bench.tasks.perturbations.season import Season
from sasgeo_bench.tasks.perturbations.streams import Streams

NEW = "another"  # a class that no table knows but those of the test
RATES = rates_by_hand() | {NEW: Rates(vanish_per_year=0.05, appear_per_year=0.05)}
BY_CLASS = (
    Perception(error_factor=1.0),
    MeasuredPerception(error_factor=1.0),
    MeasuredPerception(error_factor=1.0, silence=silent_profile().perception().silence),
    Glare(share=0.2),
    FalseUnknown(share=0.2),
    CanopyAndShadow(share=0.6),
    *(Season(kind=kind, strength=0.6) for kind in ("leaf_on", "snow", "low_water", "harvest")),
    Ageing(years=10.0, rates=RATES, place="here"),
)
every = pytest.mark.parametrize("perturbation", BY_CLASS, ids=lambda item: getattr(item, "kind", type(item).__name__))


def picked(view, names):
    """A view of some of its classes, in the order of their names."""
    cells = np.stack([view.layer(name) for name in names])
    return dataclasses.replace(view, classes=tuple(names), cells=cells)


def seen(perturbation, view, seed=5):
    after = perturbation(view, np.random.default_rng(seed))
    return dict(zip(after.classes, after.cells, strict=True))


def assert_same(one, two, names):
    assert [name for name in names if not np.array_equal(one[name], two[name])] == []


@every
def test_one_more_class_changes_no_other_one(perturbation, view, monkeypatch):
    # The new class has errors, and lies where another class is, so that the ground beside it stays what it was.
    monkeypatch.setitem(ERRORS, NEW, ERRORS["parking"].model_copy(update={"confused_with": None, "confused": 0.0}))
    monkeypatch.setitem(MEASURED, NEW, MeasuredErrors(recall=0.7, precision=0.7))
    at = len(view.classes) // 2
    names = (*view.classes[:at], NEW, *view.classes[at:])
    more = dataclasses.replace(
        view, classes=names, cells=np.insert(view.cells, at, view.layer("green") & PRESENT, axis=0)
    )
    assert_same(seen(perturbation, view), seen(perturbation, more), view.classes)


@every
def test_the_order_of_the_classes_does_not_matter(perturbation, views):
    view = views[0]
    names = sorted(view.classes)
    if isinstance(perturbation, Ageing):  # new things of one class stand in the way of those of the next
        perturbation = dataclasses.replace(perturbation, rates={"building": RATES["building"], "green": RATES["green"]})
    assert_same(seen(perturbation, view), seen(perturbation, picked(view, names)), names)


@pytest.mark.parametrize("left_out", ["road_major", "building", "water", "parking", "field_boundary"])
def test_without_a_class_the_others_are_seen_alike_but_those_it_is_taken_for(left_out, view):
    names = [name for name in view.classes if name != left_out]
    other = {ERRORS[left_out].confused_with}
    one, two = (seen(Perception(), item) for item in (view, picked(view, names)))
    assert_same(one, two, [name for name in names if name not in other])


@settings(max_examples=20)
@given(st.lists(st.sampled_from("abcdef"), min_size=1, max_size=12), st.sampled_from("abcdef"), st.integers(0, 99))
def test_a_stream_goes_on_whatever_the_others_draw(asked, name, seed):
    alone, among = Streams(np.random.default_rng(seed)), Streams(np.random.default_rng(seed))
    drawn = [among.of(item).random() for item in asked]
    own = [value for item, value in zip(asked, drawn, strict=True) if item == name]
    assert own == [alone.of(name).random() for _ in own]


def test_streams_of_other_names_and_seeds_differ():
    firsts = {Streams(np.random.default_rng(seed)).of(name).random() for seed in range(20) for name in ("a", "b")}
    assert len(firsts) == 40
