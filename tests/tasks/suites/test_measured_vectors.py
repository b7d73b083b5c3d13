# SPDX-License-Identifier: Apache-2.0
"""The second family of perceived vectors: each of its errors is there, and what meets still meets."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.tasks.query import PUBLISHED
from sasgeo_bench.tasks.suites.base import ViewRequest
from sasgeo_bench.tasks.suites.vectors import (
    MeasuredVectorNoise,
    VectorNoise,
    perceive_coarsely,
    perceive_vectors,
    site_vectors,
)
from sasgeo_bench.tasks.vectors import VECTOR_CLASSES, as_features
from tests.tasks.suites.test_vectors import EAST, NORTH, row, table

NONE = MeasuredVectorNoise(
    small_m2=1e-9,
    short_m=1e-9,
    hidden_share=0.0,
    coarse_m=0.0,
    merged_share=0.0,
    false_share=0.0,
    bridge_missed=0.0,
    lean_m=0.0,
    shift_m=0.0,
)


@pytest.fixture(scope="module")
def world(scene):
    """A state whose features a test draws itself, about (EAST, NORTH)."""
    state = scene("town-suburb").map
    return lambda *rows: replace(state, features=table(*rows))


def seen(state, noise=NONE, seed=0, **changes):
    pose = Pose(easting_m=EAST, northing_m=NORTH, yaw_deg=0.0)
    noise, rng = replace(noise, **changes), np.random.default_rng(seed)
    return perceive_coarsely(state, pose, side_m=192.0, noise=noise, rng=rng)


def houses(side_m, gap_m, count=10):
    return [row("building", shapely.box(x, 0, x + side_m, 8)) for x in np.arange(count) * (side_m + gap_m) - 80]


def test_without_errors_all_is_where_it_is(world):
    road = shapely.LineString([(-90, 10), (13, 10), (50, 90)])
    found = seen(world(row("road_major", road, is_bridge=True, level=1), *houses(9.0, 3.0)))
    assert sorted(found["class"]) == ["building"] * 10 + ["road_major"]
    assert found.loc[found["class"] == "road_major", ["level", "is_bridge"]].to_numpy().tolist() == [[1, True]]
    assert found.geometry[(found["class"] == "road_major").to_numpy()].iloc[0].equals(road)


def test_junctions_stay_where_curves_are_simplified_and_shifted(world):
    bend = shapely.LineString([(-90, 0), (-40, 1), (0, 0), (40, 1), (90, 0)])
    state = world(row("road_minor", bend), row("road_minor", shapely.LineString([(40, 1), (40, 90)])))
    found = seen(state, coarse_m=3.0, shift_m=2.0)
    assert sorted(map(shapely.get_num_coordinates, found.geometry)) == [2, 3]  # the corner of the junction is left
    nodes = build_graph(as_features(found)).nodes
    assert nodes["degree"][(nodes["kind"] == "intersection").to_numpy()].tolist() == [3]


def test_small_buildings_are_missed_more_often(world):
    left = [
        np.mean([len(seen(world(*houses(side_m, 3.0)), small_m2=40.0, seed=seed)) for seed in range(20)])
        for side_m in (2.0, 13.0)
    ]
    assert left[0] < 4
    assert left[1] > 7


def test_neighbours_become_one_where_they_touch_and_not_where_they_do_not(world):
    row_of, apart = world(*houses(9.0, 0.0)), world(*houses(9.0, 3.0))
    counts = [len(seen(row_of, merged_share=0.5, seed=seed)) for seed in range(20)]
    assert np.mean(counts) == pytest.approx(10 - 9 * 0.5, abs=1)
    assert sum(seen(row_of, merged_share=1.0).area) == pytest.approx(720, rel=0.02)
    assert len(seen(apart, merged_share=1.0)) == 10


def test_lines_break_where_trees_hide_them(world):
    roads = [row("road_minor", shapely.LineString([(-90, y), (90, y)])) for y in range(-80, 81, 10)]
    wood = row("green", shapely.box(-200, 0, 200, 200))
    lost = {"wood": 0.0, "open": 0.0}
    for seed in range(10):
        found = seen(world(wood, *roads), hidden_share=0.06, seed=seed)
        for name, low in (("wood", 5.0), ("open", -85.0)):
            lost[name] += (
                8 * 180 - shapely.intersection(found.geometry, shapely.box(-96, low, 96, low + 80)).length.sum()
            )
    assert lost["wood"] > 3 * max(lost["open"], 1.0)


def test_bridges_are_taken_for_roads(world):
    bridges = [
        row("road_minor", shapely.LineString([(-90, y), (90, y)]), is_bridge=True, level=1) for y in range(-90, 91, 4)
    ]
    found = seen(world(*bridges), bridge_missed=0.15)
    assert 0.05 < 1 - found["is_bridge"].mean() < 0.3
    assert (found["level"] == found["is_bridge"]).all()


def test_things_appear_that_are_not_there(world):
    state = world(*houses(5.0, 10.0), row("road_major", shapely.LineString([(-90, 40), (90, 40)])))
    found = [seen(state, false_share=0.5, seed=seed)["class"].value_counts() for seed in range(20)]
    assert np.mean([counts["building"] for counts in found]) > 12
    assert np.mean([counts.get("road_minor", 0) for counts in found]) == pytest.approx(0.5, abs=0.35)


def test_a_site_is_drawn_by_the_detector_of_the_variant_and_alike_each_time(carried):
    made = carried("local-warp")
    site, plain = made.sites[0], made.suite.variants[0]
    shots = [
        ViewRequest(
            scene=made.scene,
            site=site,
            variant=replace(plain, detector=detector),
            seeds=made.seeds.under("site", site.index),
        )
        for detector in (PUBLISHED, "measured", "measured")
    ]
    one, two, again = (site_vectors(shot).to_wkt() for shot in shots)
    assert two.equals(again)
    assert not two.equals(one)
    assert set(two["class"]) <= set(VECTOR_CLASSES)
    cells = [shot.perceived().cells for shot in shots]
    assert (cells[1] == cells[2]).all()
    assert (cells[0] != cells[1]).any()


@pytest.mark.parametrize("perceive", [perceive_vectors, perceive_coarsely])
def test_a_class_more_or_less_changes_the_vectors_of_no_other_one(world, perceive):
    noise = MeasuredVectorNoise(false_share=0.5) if perceive is perceive_coarsely else VectorNoise()
    lines = [row(name, shapely.LineString([(-90, y), (90, y + 9)])) for name, y in (("road_minor", 0), ("railway", 40))]
    square = row("road_minor", shapely.box(-60, -60, -20, -30))
    most = (*houses(9.0, 3.0, count=6), *lines, square, row("waterway", shapely.LineString([(-90, -70), (90, -80)])))

    def vectors(*left_out):
        state = world(*(item for item in most if item["class"] not in left_out))
        pose, rng = Pose(easting_m=EAST, northing_m=NORTH, yaw_deg=0.0), np.random.default_rng(3)
        found = perceive(state, pose, side_m=192.0, noise=noise, rng=rng)
        return {name: sorted(shape.wkt for shape in part.geometry) for name, part in found.groupby("class")}

    whole = vectors()
    for left_out in whole:
        found = vectors(left_out)
        same = [name for name in whole if name not in (left_out, "road_minor")]  # false drives branch off any line
        assert {name: found[name] for name in same} == {name: whole[name] for name in same}
