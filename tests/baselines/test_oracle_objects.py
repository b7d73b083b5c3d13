# SPDX-License-Identifier: Apache-2.0
"""Yardsticks of matchers of objects: what they are shown, and that nothing else than it makes their answers."""

import json
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely
from sasgeo_baselines import oracle_objects
from sasgeo_baselines.oracle_objects import OracleObjects, objects_at

from sasgeo_bench.core.plugins import YARDSTICK
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.tasks.task_files import read_queries, read_truths
from tests.slow import rest_slow

SIZE_M = (192.0, 192.0)
REPEATED = ("oracle_liu_object_graph", "oracle_road_2rit")  # to these, streets of a grid are alike
YARDSTICKS = {
    made.card.name: made
    for made in vars(oracle_objects).values()
    if isinstance(made, type) and issubclass(made, OracleObjects) and made is not OracleObjects
}


@pytest.fixture(scope="module")
def region(town_tasks):
    return read_region(town_tasks / "regions" / "town-grid")


@pytest.fixture(scope="module")
def pairs(town_tasks):
    """Views of 192 m by the worst detector, with their truths."""
    truths = {item.query_id: item for item in read_truths(town_tasks / "truth" / "clean" / "town-grid")}
    queries = read_queries(town_tasks / "tasks" / "clean" / "town-grid")
    found = [(query, truths[query.query_id]) for query in queries if query.evidence.shape[0] == 192]
    return [(query, truth) for query, truth in found if truth.role == "stress" and truth.strength == 4.0]


def of_map(region, pose):
    """The visible features of a map within a view, cut at its border."""
    corners_m = np.array([[-96.0, -96.0], [96.0, -96.0], [96.0, 96.0], [-96.0, 96.0]])
    outline = shapely.Polygon(pose.to_map(corners_m))
    features = region.features[region.features["is_visible"]]
    return gpd.clip(features.set_geometry(shapely.make_valid(features.geometry.to_numpy())), outline)


@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_the_objects_are_those_of_the_map_in_the_frame_of_the_view(region, scale):
    west, south, east, north = region.grid.bounds_m
    pose = Pose(easting_m=(west + east) / 2, northing_m=(south + north) / 2, yaw_deg=30.0, scale=scale)
    shown, there = objects_at(region, pose, SIZE_M), of_map(region, pose)
    assert np.abs(shown.total_bounds).max() <= 96.0 + 1e-6
    for name in ("building", "road_minor"):
        mine, theirs = shown[shown["class"] == name], there[there["class"] == name]
        assert len(theirs) > 2
        assert mine.area.sum() == pytest.approx(theirs.area.sum() / scale**2)
        assert mine.length.sum() == pytest.approx(theirs.length.sum() / scale)
        back = shapely.union_all(shapely.transform(mine.geometry.to_numpy(), pose.to_map))
        assert back.buffer(1e-3).covers(shapely.union_all(theirs.geometry.to_numpy()))
    assert len(objects_at(region, replace(pose, easting_m=west - 5000.0), SIZE_M)) == 0


def test_each_yardstick_is_of_a_matcher_and_says_that_it_knows_too_much():
    assert len(YARDSTICKS) == 5
    for name, made in YARDSTICKS.items():
        assert name == YARDSTICK + made.inner.card.name
        assert "never ranked" in made.card.limits
        assert made.card.source == made.inner.card.source


@pytest.mark.parametrize("name", rest_slow(YARDSTICKS))
def test_untaught_it_answers_as_its_matcher_and_a_damaged_text_is_refused(name, region, pairs):
    matcher, plain = YARDSTICKS[name](), YARDSTICKS[name].inner()
    with pytest.raises(RuntimeError, match="prepare"):
        matcher.match(pairs[0][0], top_k=1)
    for one in (matcher, plain):
        one.prepare(region, None)
    query, _ = pairs[0]
    assert matcher.match(query, top_k=3) == plain.match(query, top_k=3)
    for text in ("x", "null", '{"q": [0]}'):
        with pytest.raises(ValueError, match=f"^{name}: the learned text is damaged.*learn again$"):
            matcher.prepare(region, text)


@pytest.mark.parametrize("name", rest_slow(YARDSTICKS, but=2))
def test_taught_it_answers_where_nothing_was_perceived(name, region, pairs):
    query, _ = next((query, truth) for query, truth in pairs if query.track == "localization")
    west, south, east, north = region.grid.bounds_m
    pose = Pose(easting_m=(west + east) / 2, northing_m=(south + north) / 2, yaw_deg=query.prior.yaw_deg)
    prior = replace(query.prior, center_m=(pose.easting_m + 60.0, pose.northing_m - 80.0))
    bare = replace(query, evidence=query.evidence.replace(np.zeros_like(query.evidence.cells)), prior=prior)
    matcher, plain = YARDSTICKS[name](), YARDSTICKS[name].inner()
    truth = replace(pairs[0][1], query_id=bare.query_id, pose=pose)
    matcher.prepare(region, matcher.learn(Training(regions={"town-grid": region}, pairs=[(bare, truth)])))
    plain.prepare(region, None)
    assert not plain.match(bare, top_k=1).poses
    best = matcher.match(bare, top_k=1).poses[0]
    away_m = np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m)
    assert away_m < 1.0 or name in REPEATED


def test_it_learns_the_poses_of_present_places_alone(region, pairs):
    absent = [(query, replace(truth, is_present=False, pose=None)) for query, truth in pairs[:1]]
    training = Training(regions={"town-grid": region}, pairs=[*absent, *pairs[1:]])
    for made in YARDSTICKS.values():
        assert set(json.loads(made().learn(training))) == {query.query_id for query, _ in pairs[1:]}
