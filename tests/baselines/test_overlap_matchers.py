# SPDX-License-Identifier: Apache-2.0
"""Matchers by overlap: scores worked by hand, the property that each must have, and what they find."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sasgeo_baselines.schmidt_segcorr import SchmidtSegcorr
from sasgeo_baselines.vecmap_phasecorr import VecmapPhasecorr, phases, signed
from sasgeo_baselines.zilke_semantic_mi import LABELS, NAMES, ZilkeSemanticMi

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.search.shifts import Overlaps
from tests.baselines.worlds import PRIOR, things
from tests.made_up import error_m


def overlaps_of(matcher, evidence, layers, names):
    """Lay a view once on a map of the same size; the last channel of the map says where it is known."""
    return Overlaps.of(matcher.channels(evidence, names), layers.astype(np.float32), places=(1, 1))


def test_intersection_over_union_by_hand():
    """Of houses 2 cells are seen and mapped and 2 more are on either side, of water 1 and 1: (2 / 4 + 1 / 2) / 2."""
    seen = np.zeros((2, 3, 4), dtype=np.uint8)
    seen[0, 0, :3], seen[1, 2, 0] = PRESENT, PRESENT
    mapped = np.zeros((3, 3, 4))
    mapped[0, 0, 1:4], mapped[1, 2, :2], mapped[2] = 1, 1, 1
    view = Evidence(classes=("building", "water"), cells=seen, cell_size_m=1.0)
    matcher = SchmidtSegcorr()
    score = matcher.score(overlaps_of(matcher, view, mapped, view.classes), view.classes)
    assert score[0, 0] == pytest.approx(0.5, abs=1e-5)
    hidden = seen.copy()
    hidden[0, 0, 0] = UNKNOWN  # one seen cell less, which was not mapped
    score = matcher.score(overlaps_of(matcher, view.replace(hidden), mapped, view.classes), view.classes)
    assert score[0, 0] == pytest.approx((2 / 3 + 1 / 2) / 2, abs=1e-5)
    sure = np.full(seen.shape, 255, dtype=np.uint8)
    half = matcher.channels(view.replace(seen, sure // 2), view.classes)
    np.testing.assert_array_equal(
        matcher.channels(view.replace(seen, sure), view.classes), matcher.channels(view, view.classes)
    )
    assert half[0, 0, 0] == pytest.approx(127 / 255)  # a cell counts by how sure the detector is of it
    mapped[:, :, :3] = 0  # the map knows a quarter
    assert matcher.score(overlaps_of(matcher, view, mapped, view.classes), view.classes)[0, 0] == -np.inf


def labelled(seed):
    """A view of houses, roads and water that tells of each cell one label or the rest."""
    labels = np.random.default_rng(seed).integers(0, 4, (6, 6))
    names = ("building", "road_major", "water")
    cells = np.stack([np.where(labels == at, PRESENT, ABSENT) for at in range(3)]).astype(np.uint8)
    return labels, Evidence(classes=names, cells=cells, cell_size_m=1.0)


def information(matcher, evidence, labels):
    layers = np.stack([*(labels == at for at in range(4)), np.ones(labels.shape)])
    names = tuple(NAMES[at] for at in (0, 1, 3, 5))
    return float(matcher.score(overlaps_of(matcher, evidence, layers, names), names)[0, 0])


def test_mutual_information_ignores_what_labels_are_called_and_is_2_at_most():
    labels, view = labelled(0)
    matcher = ZilkeSemanticMi()
    assert information(matcher, view, labels) == pytest.approx(2.0, abs=1e-4)
    other, _ = labelled(1)
    mixed = information(matcher, view, other)
    assert 1.0 < mixed < 1.5
    assert information(matcher, view, np.array([2, 0, 3, 1])[other]) == pytest.approx(mixed, abs=1e-4)
    assert information(matcher, view, np.zeros_like(labels)) == pytest.approx(1.0, abs=1e-4)


def test_mutual_information_by_hand():
    """Half of the view is houses; the map has them in a quarter, all of it within: H 1 and 0.811, joint 1.5 bits."""
    cells = np.zeros((1, 4, 4), dtype=np.uint8)
    cells[0, :2] = PRESENT
    mapped = np.zeros((4, 4), dtype=int) + 3
    mapped[0] = 0
    view = Evidence(classes=("building",), cells=cells, cell_size_m=1.0)
    quarter = -(0.25 * np.log2(0.25) + 0.75 * np.log2(0.75))
    assert information(ZilkeSemanticMi(), view, mapped) == pytest.approx((1 + quarter) / 1.5, abs=1e-4)


def test_a_cell_has_one_label_the_first_of_its_classes():
    assert len({name for group in LABELS for name in group}) == sum(map(len, LABELS))
    cells = np.array([[[1, 0, 0, 2]], [[1, 1, 0, 0]]], dtype=np.uint8)
    found = ZilkeSemanticMi().channels(Evidence(classes=("building", "green"), cells=cells, cell_size_m=1.0), NAMES)
    assert found[:, 0].argmax(axis=0)[:3].tolist() == [0, 4, 5]
    assert found[:, 0, 3].sum() == 0  # not known whether it is a house


def test_phase_correlation_ignores_a_constant_and_the_contrast_of_the_map():
    rng = np.random.default_rng(0)
    town = rng.random((2, 40, 40)).astype(np.float32)
    seen = town[:, 11:31, 7:27] - town[:, 11:31, 7:27].mean(axis=(1, 2), keepdims=True)
    found = phases(Overlaps.of(seen, town, places=(21, 21)), [1.0, 1.0], whitening=1.0)
    assert np.unravel_index(int(found.argmax()), found.shape) == (11, 7)
    darker = phases(Overlaps.of(seen, np.float32(0.5) * town, places=(21, 21)), [1.0, 1.0], whitening=1.0)
    np.testing.assert_allclose(darker, found, atol=1e-5)
    alone = phases(Overlaps.of(seen, town, places=(21, 21)), [1.0, 0.0], whitening=1.0)
    np.testing.assert_allclose(
        alone, phases(Overlaps.of(seen[:1], town[:1], places=(21, 21)), [1.0], whitening=1.0), atol=1e-6
    )


def test_signed_distances_are_truncated_and_even_where_nothing_is_known():
    present, known = np.zeros((1, 100), dtype=bool), np.ones((1, 100), dtype=bool)
    present[0, :50], known[0, 90:] = True, False
    found = signed(present, known, 2.0, reach_m=16.0)[0]
    assert found[:42].min() == 255
    assert found[58:90].max() == 0
    assert found[95] == round(float(found[:90].mean()))


def test_weights_are_learned_from_where_classes_stand_out(made):
    """Water is removed from the map and drawn anew at random: it says nothing."""
    region, rng = things().region, np.random.default_rng(7)
    poses = [
        Pose(easting_m=1210.0 + rng.uniform(-60, 60), northing_m=8790.0 + rng.uniform(-60, 60), yaw_deg=yaw)
        for yaw in (10.0, 100.0, 250.0)
    ]
    views = [made.view_of(region, pose, size_cells=128) for pose in poses]
    layers = region.layers.copy()
    layers[2] = made.textured(99)[2]
    queries = [replace(made.query_of(view, PRIOR), region="made-up") for view in views]
    truths = [SimpleNamespace(pose=pose) for pose in poses]
    training = Training(regions={"made-up": made.region_of(layers)}, pairs=tuple(zip(queries, truths, strict=True)))
    text = VecmapPhasecorr().learn(training)
    weights = json.loads(text)
    assert weights["water"] < 0.5 * min(weights["building"], weights["road_minor"])
    assert text == VecmapPhasecorr().learn(training)
    taught = VecmapPhasecorr()
    taught.prepare(training.regions["made-up"], text)
    assert error_m(taught.match(things().query(128), top_k=1)) < 3
