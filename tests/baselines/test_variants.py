# SPDX-License-Identifier: Apache-2.0
"""The paper's variants: each differs from the one before by its own switch alone."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sasgeo_baselines.raster import (
    BETA,
    FullUnknown,
    GraphCheck,
    RasterGraph,
    RasterGraphStability,
    RasterUniform,
    blended,
)

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.controls.fft_vote import FftVote, PoseCheck
from sasgeo_bench.matching.matcher import check_match
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence

VARIANTS = (RasterUniform, RasterGraph, RasterGraphStability, FullUnknown)
HERE = Pose(easting_m=1170.0, northing_m=8800.0, yaw_deg=40.0)
NEAR_HERE = Prior(center_m=(1190.0, 8790.0), radius_m=60.0, yaw_deg=43.0, yaw_sigma_deg=3.0, scale_sigma=0.0)
PLACES = (
    Pose(easting_m=1290.0, northing_m=8870.0, yaw_deg=43.0),
    Pose(easting_m=1176.0, northing_m=8795.0, yaw_deg=43.0),
    Pose(easting_m=1240.0, northing_m=8720.0, yaw_deg=43.0),
)
KNOWN_YAW = Prior(center_m=None, radius_m=None, yaw_deg=43.0, yaw_sigma_deg=3.0, scale_sigma=0.0)
HOUSES = ((4, 4), (4, 34), (34, 4), (36, 36))  # of 10 by 10 cells in a view of 48


@pytest.fixture(scope="module")
def view(made):
    """A perfect view of a textured map."""
    return made.view_of(made.region_of(made.textured(1)), HERE, size_cells=64)


def half_hidden(view: Evidence, state: int) -> Evidence:
    """The view with its left half in one state."""
    hidden = view.cells.copy()
    hidden[:, :, : hidden.shape[2] // 2] = state
    return view.replace(hidden)


def answer(made, variant, view: Evidence):
    """Poses and scores of the candidates on the textured map."""
    matcher = variant()
    matcher.prepare(made.region_of(made.textured(1)), None)
    found = matcher.match(made.query_of(view, KNOWN_YAW, candidates=PLACES), top_k=3)
    return list(found.poses), list(found.scores)


# Switches


# Unknown


@pytest.mark.parametrize("variant", VARIANTS[:3])
def test_what_is_unknown_is_taken_for_absent(made, view, variant) -> None:
    assert answer(made, variant, half_hidden(view, UNKNOWN)) == answer(made, variant, half_hidden(view, ABSENT))


@pytest.mark.parametrize("variant", [FftVote, FullUnknown])
def test_what_is_unknown_is_silent(made, view, variant) -> None:
    unknown, absent = (answer(made, variant, half_hidden(view, state)) for state in (UNKNOWN, ABSENT))
    assert unknown[1][0] > absent[1][0]


def test_full_unknown_without_anything_unknown_is_the_variant_before_it(made, view) -> None:
    assert answer(made, FullUnknown, view) == answer(made, RasterGraphStability, view)
    assert answer(made, FullUnknown, half_hidden(view, UNKNOWN)) != answer(
        made, RasterGraphStability, half_hidden(view, UNKNOWN)
    )


# Graph


def scene(houses, *, size=48, tall=10) -> np.ndarray:
    """Layers with houses, 10 cells wide, and nothing else."""
    layers = np.zeros((3, size, size), dtype=np.uint8)
    for row, col in houses:
        layers[0, row : row + tall, col : col + 10] = PRESENT
    return layers


def test_neither_side_of_the_graph_is_described_where_the_other_is_unknown(made) -> None:
    chart = RasterUniform().read(made.region_of(scene(HOUSES)))
    here = Pose(easting_m=1024.0, northing_m=8976.0, yaw_deg=0.0)

    def distance(pose, seen) -> float:
        bands = np.arange(len(seen))
        return GraphCheck(check=PoseCheck(chart=chart, bands=bands, seen=seen, cell_size_m=1.0)).distance(pose)

    assert distance(here, scene(HOUSES)) == 0.0
    assert distance(replace(here, easting_m=9000.0), scene(HOUSES)) == 0.0  # beyond the map
    half = scene(HOUSES)
    half[:, :, :24] = UNKNOWN  # hides two houses of four
    view = Evidence(classes=tuple(map(str, range(len(half)))), cells=half, cell_size_m=1.0)
    missed, silent = (distance(here, variant().seen(view).cells[:1]) for variant in (RasterGraphStability, FullUnknown))
    # 2 against 4 counts 2 / 7, and their distances differ; 2 against the same 2 is nothing.
    assert missed > (2 / 7) / 2
    assert silent == 0.0


def three_places(made, first: np.ndarray, second: np.ndarray, **region):
    """A map with a scene at two of three places, 100 m apart, and a third that is empty; their poses."""
    layers = np.zeros((len(first), 100, 400), dtype=np.uint8)
    for start, found in ((76, first), (176, second)):
        layers[:, 26:74, start : start + 48] = found
    places = tuple(Pose(easting_m=1000.0 + east_m, northing_m=8950.0, yaw_deg=0.0) for east_m in (300, 100, 200))
    return made.region_of(layers, **region), places


def ranks(made, variant, region, places, view: Evidence) -> dict[float, float]:
    """Score by easting."""
    matcher = variant()
    matcher.prepare(region, None)
    north = Prior(center_m=None, radius_m=None, yaw_deg=0.0, yaw_sigma_deg=0.8, scale_sigma=0.0)
    query = made.query_of(view, north, candidates=places)
    match = check_match(matcher.match(query, top_k=3), query, top_k=3)
    return {pose.easting_m: score for pose, score in zip(match.poses, match.scores, strict=True)}


def test_two_houses_of_four_and_the_halves_of_all_tie_in_the_raster_and_not_in_the_graph(made) -> None:
    region, places = three_places(made, scene(HOUSES[:2]), scene(HOUSES, tall=5))
    view = Evidence(classes=made.classes, cells=scene(HOUSES), cell_size_m=1.0)
    uniform, graph = (ranks(made, variant, region, places, view) for variant in VARIANTS[:2])
    assert uniform[1100.0] == uniform[1200.0]
    assert graph[1100.0] < graph[1200.0]


def test_the_graph_ranks_the_modes_of_the_raster_and_finds_none(made, view) -> None:
    region = made.region_of(made.textured(1))
    found = []
    for variant in VARIANTS[:2]:
        matcher = variant()
        matcher.prepare(region, None)
        found.append(matcher.match(made.query_of(view, NEAR_HERE), top_k=20))
    uniform, graph = found
    assert len(uniform.poses) > 3
    assert sorted(map(repr, uniform.poses)) == sorted(map(repr, graph.poses))
    assert list(uniform.scores) != list(graph.scores)


@given(
    count=st.integers(2, 60),
    distances=st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).random(60) ** 9),
)
def test_what_stands_alone_in_the_raster_is_not_overturned(count, distances) -> None:
    scores = np.zeros(count)
    scores[-1] = 1e-3
    assert np.argmax(blended(scores, distances[:count], beta=BETA)) == count - 1


@given(arrays(np.int64, 6, elements=st.integers(0, 99)), arrays(np.int64, 6, elements=st.integers(0, 99)))
def test_equals_tie_and_a_better_graph_wins_among_equals(scores, distances) -> None:
    scores[1], distances[1] = scores[0], distances[0]
    scores[2], distances[2] = scores[0], distances[0] + 10
    found = blended(scores / 100, distances / 100)
    assert found[0] == found[1] > found[2]


# Stability


def test_of_a_field_and_a_house_of_one_shape_the_house_weighs_more_by_stability_alone(made) -> None:
    classes = ("building", "farmland", "water")
    seen = np.zeros((3, 48, 48), dtype=np.uint8)
    seen[0, 8:20, 8:20] = seen[1, 28:40, 28:40] = PRESENT
    field, house = (seen * np.array(kept, dtype=np.uint8)[:, None, None] for kept in ((0, 1, 1), (1, 0, 1)))
    region, places = three_places(made, field, house, classes=classes)
    view = Evidence(classes=classes, cells=seen, cell_size_m=1.0)
    graph, stable = (ranks(made, variant, region, places, view) for variant in VARIANTS[1:3])
    assert graph[1100.0] == pytest.approx(graph[1200.0], abs=1e-9)
    assert stable[1100.0] < stable[1200.0]


# What is told besides


def test_a_mode_that_is_alone_has_no_margin(made, view) -> None:
    matcher = RasterUniform()
    matcher.prepare(made.region_of(made.textured(1)), None)
    alone = matcher.match(made.query_of(view, KNOWN_YAW, candidates=PLACES[:1]), top_k=3)
    assert alone.diagnostics["margin"] == 0.0
    several = matcher.match(made.query_of(view, KNOWN_YAW, candidates=PLACES), top_k=3)
    assert several.diagnostics["margin"] == several.scores[0] - several.scores[1] > 0


@pytest.mark.parametrize("variant", [FftVote, *VARIANTS])
def test_a_perfect_view_agrees_in_all_classes_and_stands_out(made, variant) -> None:
    region = made.region_of(made.textured(1))
    view = made.view_of(region, HERE, size_cells=96)
    matcher = variant()
    matcher.prepare(region, None)
    for candidates in ((), PLACES):
        prior = KNOWN_YAW if candidates else NEAR_HERE
        diagnostics = matcher.match(made.query_of(view, prior, candidates=candidates), top_k=3).diagnostics
        assert diagnostics["class_agreement"] > 0.8
        assert diagnostics["null_score"] > 3
        assert diagnostics["margin"] > 0
        assert ("graph_distance" in diagnostics) == ("graph" in variant.card.name or variant is FullUnknown)
        assert 0 <= diagnostics.get("graph_distance", 0) < 0.1


def test_agreement_is_the_mean_over_classes_of_both_over_either(made) -> None:
    # Houses: two of three cells in common; roads: seen in vain; water: one cell, where nothing was seen.
    layers = np.zeros((3, 1, 5), dtype=np.uint8)
    layers[0, 0, :3] = layers[2, 0, 4] = PRESENT
    seen = np.zeros((3, 1, 5), dtype=np.uint8)
    seen[0, 0, 1:3] = seen[1, 0, 0] = PRESENT
    seen[2, 0, 4] = UNKNOWN
    chart = FftVote().read(made.region_of(layers))
    check = PoseCheck(chart=chart, bands=np.arange(3), seen=seen, cell_size_m=1.0)
    assert check.agreement(Pose(easting_m=1002.5, northing_m=8999.5, yaw_deg=0.0)) == pytest.approx((2 / 3 + 0) / 2)
