# SPDX-License-Identifier: Apache-2.0
"""Templates of height layers, a regressed pose, and local features: worked by hand, properties, what is found."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.anyvisloc_pipeline import (
    GREYS,
    GROUND,
    AnyvislocPipeline,
    Drawing,
    drawn,
)
from sasgeo_baselines.maplocnet_regress import COARSE_M, MaplocnetRegress, Peak, examples, field_of, templates_of
from sasgeo_baselines.ubev_template import HEIGHTS, UbevTemplate, drawn_in, layers_of

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, Evidence
from sasgeo_bench.search.plan import Mode
from sasgeo_bench.search.shifts import Overlaps
from tests.baselines.worlds import PRIOR, things
from tests.made_up import HERE, error_m


@pytest.fixture(scope="module")
def region():
    return things().region


@pytest.fixture(scope="module")
def prepared(region):
    """A matcher by its kind, prepared once."""

    @cache
    def of_kind(kind):
        found = kind()
        found.prepare(region, None)
        return found

    return of_kind


def seen_from(made, region, pose):
    return made.view_of(region, pose, size_cells=160)


# Height layers


@given(st.integers(20, 60), st.sampled_from(HEIGHTS[1:]))
def test_a_roof_that_leans_outwards_is_drawn_back_onto_its_footprint(away, height):
    """A roof of height h is seen at r / (1 - h / H); the cell that is drawn in covers r."""
    seen = np.zeros((1, 201), dtype=np.float32)
    seen[0, 100 + round(away / (1 - height))] = 1
    ground = drawn_in(seen, height)[0]
    assert np.average(np.arange(201), weights=ground) - 100 == pytest.approx(away, abs=1.0)


def test_only_buildings_stand_up_and_the_rim_is_unknown_below_their_roofs():
    cells = np.full((2, 41, 41), PRESENT, dtype=np.uint8)
    seen = Evidence(classes=("building", "water"), cells=cells, cell_size_m=1.0)
    assert len(layers_of(seen, "water")) == 1
    layers = layers_of(seen, "building")
    known = [float(known.mean()) for _, known in layers]
    assert known == pytest.approx([(1 - height) ** 2 for height in HEIGHTS], abs=0.03)


def leaning(evidence, height):
    """A view in which all buildings have such a height."""
    rows, cols = evidence.shape
    grown = np.array([[1, 0, -height * (cols - 1) / 2], [0, 1, -height * (rows - 1) / 2]]) / (1 - height)
    cells = evidence.cells.copy()
    at = evidence.classes.index("building")
    cells[at] = cv2.warpAffine(cells[at], grown, (cols, rows), flags=cv2.INTER_NEAREST)
    return evidence.replace(cells)


def test_each_height_is_a_template_by_itself_and_the_sum_counts_as_one_class(made, region):
    """Over the map itself a flat view fits in its lowest layer, one of high roofs in its highest."""
    matcher = UbevTemplate()
    names = ("building", "water")
    flat = seen_from(made, region, HERE)
    layers = np.stack([*((flat.layer(name) == PRESENT) for name in names), np.ones(flat.shape)]).astype(np.float32)
    fits = {}
    for height in (0.0, HEIGHTS[-1]):
        seen = matcher.channels(leaning(flat, height), names)
        overlaps = Overlaps.of(seen, layers, places=(1, 1))
        sheets = len(HEIGHTS) + 1
        assert len(seen) == 2 * sheets + 1
        fits[height] = [over_of(seen[at], seen[sheets + at], layers[0]) for at in range(len(HEIGHTS))]
        score = float(matcher.score(overlaps, names)[0, 0])
        assert score == pytest.approx((np.mean(fits[height]) + 1.0) / 2, abs=1e-3)  # water is where it is mapped
    assert fits[0.0] == sorted(fits[0.0], reverse=True)
    assert fits[0.0][0] == pytest.approx(1.0, abs=1e-3)
    assert int(np.argmax(fits[HEIGHTS[-1]])) == len(HEIGHTS) - 1


def over_of(present, known, mapped):
    both = float((present * mapped).sum())
    return both / (float(present.sum()) + float((known * mapped).sum()) - both)


# Regression


def test_residuals_turn_with_the_surface():
    """The true place lies a cell to the east and half a step clockwise; turned counter-clockwise it lies north."""
    here = Pose(easting_m=100.0, northing_m=100.0, yaw_deg=355.0)
    part = np.zeros((3, 5, 5))
    part[1, 2, 3] = 1.0  # east of the middle
    found, residuals = examples(
        Peak(mode=Mode(pose=here, score=1.0), part=part), replace(here, easting_m=100.0 + COARSE_M, yaw_deg=0.0)
    )
    assert residuals.tolist() == [[1, 0, 0.5], [0, 1, 0.5], [-1, 0, 0.5], [0, -1, 0.5]]
    at = [np.unravel_index(int(row.argmax()), part.shape) for row in found]
    assert at == [(1, 2, 3), (1, 1, 2), (1, 2, 1), (1, 3, 2)]


def test_a_class_that_the_map_lacks_has_no_votes(region):
    seen = Evidence(
        classes=("railway", "building"), cells=np.array([[[PRESENT]], [[ABSENT]]], dtype=np.uint8), cell_size_m=1.0
    )
    votes, counts = templates_of(seen, region.classes)
    assert votes.weights[:, 0, 0].tolist() == [-1.0, 0.0, 0.0]
    assert counts.known.tolist() == [[1.0]]
    assert field_of(region).grid.cell_size_m == 4.0


@pytest.fixture(scope="module")
def training(made):
    """Views of another map, from places all over a coarse cell."""
    other, rng = made.region_of(made.textured(6)), np.random.default_rng(4)
    poses = poses_of(rng, 24)
    queries = [replace(query_from(made, other, pose), region="other") for pose in poses]
    truths = [SimpleNamespace(pose=pose) for pose in poses]
    return Training(regions={"other": other}, pairs=tuple(zip(queries, truths, strict=True)))


def poses_of(rng, count):
    return [
        Pose(easting_m=1210.0 + east, northing_m=8790.0 + north, yaw_deg=yaw)
        for east, north, yaw in rng.uniform((-60, -60, 0), (60, 60, 360), (count, 3)).tolist()
    ]


def query_from(made, region, pose):
    return made.query_of(seen_from(made, region, pose), replace(PRIOR, yaw_deg=pose.yaw_deg + 4.0))


def test_a_taught_pose_is_nearer_than_the_highest_cell(made, region, prepared, training):
    text = MaplocnetRegress().learn(training)
    assert text == MaplocnetRegress().learn(training)
    taught = MaplocnetRegress()
    taught.prepare(region, text)
    errors = {"taught": [], "coarse": []}
    for pose in poses_of(np.random.default_rng(5), 12):
        query = query_from(made, region, pose)
        errors["taught"].append(error_m(taught.match(query, top_k=5), pose))
        errors["coarse"].append(error_m(prepared(MaplocnetRegress).match(query, top_k=5), pose))
    assert np.median(errors["taught"]) < 0.9 * np.median(errors["coarse"])


# Local features


def test_later_classes_cover_earlier_ones_and_the_rest_is_ground():
    ones = np.ones((1, 1), dtype=bool)
    assert drawn(lambda _: ones, ("building", "green"), (1, 1)).item() == GREYS["building"]
    assert drawn(lambda _: ~ones, ("building", "green"), (1, 1)).item() == GROUND


def test_view_and_map_are_drawn_alike(made, region):
    """A view that faces north, with cells twice as small as those of the map."""
    pose = Pose(easting_m=1200.0, northing_m=8800.0, yaw_deg=0.0)
    view = made.view_of(region, pose, size_cells=160, cell_size_m=0.5)
    drawing = Drawing.of_view(view, 1.0)
    np.testing.assert_array_equal(drawing.grey, Drawing.of_map(region).grey[160:240, 160:240])
    assert drawing.is_known.all()


def test_inliers_are_told_and_a_heading_that_is_unlikely_is_dropped(made, region, prepared):
    matcher = prepared(AnyvislocPipeline)
    query = made.query_of(seen_from(made, region, HERE), PRIOR)
    found = matcher.match(query, top_k=5)
    assert found.diagnostics["inliers"] == found.scores[0] > 30
    assert found.scores[0] == int(found.scores[0])
    wrong = matcher.match(replace(query, prior=replace(PRIOR, yaw_deg=260.0)), top_k=5)
    assert wrong.diagnostics["inliers"] < 10
    assert wrong.scores[0] < found.scores[0] / 4
