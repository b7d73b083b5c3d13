# SPDX-License-Identifier: Apache-2.0
"""Perceived vectors lie in the view's frame, on the cells of the view, and keep what meets together."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.osm.features import DTYPES, make_features
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, Evidence, cell_offsets_m
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, folded_share, warped
from sasgeo_bench.tasks.suites.vectors import VECTOR_CLASSES, VectorNoise, perceive_vectors, smooth_shift
from sasgeo_bench.tasks.suites.views import bent
from sasgeo_bench.tasks.vectors import as_features, instances_of_mask, vector_table
from tests.made_up import query_of

EXACT = VectorNoise(missed_share=0.0, gap_share=0.0, shift_m=0.0)
EAST, NORTH = 5000.0, 7000.0


def table(*rows):
    base = {"osm_type": "way", "version": 1, "timestamp": pd.NaT, "level": 0, "width_m": 5.0}
    base |= {"is_bridge": False, "is_tunnel": False, "is_visible": True}
    full = [base | {"osm_id": number} | item for number, item in enumerate(rows)]
    return make_features({name: [item[name] for item in full] for name in (*DTYPES, "geometry")}, epsg=32632)


def row(name, geometry, **columns):
    placed = shapely.transform(geometry, lambda at: at + np.array((EAST, NORTH)))
    return {"class": name, "geometry": placed, **columns}


@pytest.fixture(scope="module")
def world(scene):
    """A state whose features a test draws itself, about (EAST, NORTH)."""
    state = scene("town-suburb").map
    return lambda *rows: replace(state, features=table(*rows))


def seen(state, yaw_deg=0.0, scale=1.0, *, noise=EXACT, side_m=192.0, seed=0):
    pose = Pose(easting_m=EAST, northing_m=NORTH, yaw_deg=yaw_deg, scale=scale)
    return perceive_vectors(state, pose, side_m=side_m, noise=noise, rng=np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("yaw_deg", "right_m", "up_m"),
    # A house 40 m north of the pose: heading north it is ahead, heading east on the left, south behind, west right.
    [(0, 0, 40), (90, -40, 0), (180, 0, -40), (270, 40, 0)],
)
def test_a_house_in_the_north_is_where_the_heading_has_it(world, yaw_deg, right_m, up_m):
    found = seen(world(row("building", shapely.box(-5, 35, 5, 45))), yaw_deg)
    (house,) = found.geometry
    assert (house.centroid.x, house.centroid.y) == pytest.approx((right_m, up_m), abs=0.06)
    assert house.area == pytest.approx(100, abs=2)


def test_the_scale_of_a_view_shrinks_what_it_sees(world):
    found = seen(world(row("road_minor", shapely.LineString([(-30, 20), (30, 20)]))), scale=1.25)
    assert shapely.get_coordinates(found.geometry) == pytest.approx(np.array([(-24, 16), (24, 16)]))


def test_without_noise_lines_are_exact_to_the_decimetre_and_cut_at_the_edge_of_the_view(world):
    road = shapely.LineString([(-300, 10.04), (0, 10.04), (13.31, 300)])
    found = seen(world(row("road_major", road, level=1, is_bridge=True), row("water", shapely.box(0, 0, 9, 9))))
    assert found["class"].tolist() == ["road_major"]  # water is an area that no detector draws as an object
    assert found["level"].tolist() == [1]
    assert found["is_bridge"].tolist() == [True]
    (line,) = found.geometry
    assert shapely.get_coordinates(line)[:2] == pytest.approx(np.array([(-96, 10.0), (0, 10.0)]))
    assert line.bounds[3] == pytest.approx(96, abs=0.05)


def test_what_is_hidden_from_above_is_not_perceived(world):
    hidden = row("building", shapely.box(0, 0, 9, 9), is_visible=False)
    assert len(seen(world(hidden, row("building", shapely.box(20, 0, 29, 9))))) == 1


@given(yaw_deg=st.floats(0, 360), scale=st.floats(0.9, 1.1), seed=st.integers(0, 99))
def test_vectors_lie_on_the_cells_of_the_view(scene, yaw_deg, scale, seed):
    state = scene("town-suburb").map
    west, south, east, north = state.grid.bounds_m
    place = np.random.default_rng(seed).uniform((west + 150, south + 150), (east - 150, north - 150))
    pose = Pose(easting_m=place[0], northing_m=place[1], yaw_deg=yaw_deg, scale=scale)
    vectors = perceive_vectors(state, pose, side_m=192.0, noise=EXACT, rng=np.random.default_rng(0))
    view = state.view(pose, size_cells=192, cell_size_m=1.0)
    hits = [hit for name in ("road_minor", "road_major", "building") for hit in on_cells(vectors, view, name)]
    # A point at the very edge of a road may fall on the cell beside it.
    assert hits.count(False) <= max(2, 0.03 * len(hits))


def on_cells(vectors, view, name):
    """Whether points along the lines, or within the areas, of a class lie on present cells of it."""
    chosen = vectors.geometry[(vectors["class"] == name).to_numpy()].to_numpy()
    is_area = shapely.get_dimensions(chosen) == 2
    lines = shapely.segmentize(chosen[~is_area], 3.0)
    points = np.vstack(
        (shapely.get_coordinates(lines), shapely.get_coordinates(shapely.point_on_surface(chosen[is_area])))
    )
    half = view.shape[0] / 2
    points = points[(np.abs(points) < half - 1).all(axis=1)]
    return (
        (view.layer(name)[np.floor(half - points[:, 1]).astype(int), np.floor(points[:, 0] + half).astype(int)])
        == PRESENT
    )


def test_about_as_many_objects_are_missed_as_the_share_says(world):
    houses = world(
        *(row("building", shapely.box(x, y, x + 8, y + 8)) for x in range(-80, 80, 16) for y in range(-80, 80, 16))
    )
    noise = replace(EXACT, missed_share=0.1)
    left = [len(seen(houses, noise=noise, seed=seed)) for seed in range(60)]
    assert np.mean(left) == pytest.approx(90, abs=1.6)
    assert np.std(left) == pytest.approx(3, rel=0.35)  # each by itself


def test_about_as_many_lines_have_a_gap_as_the_share_says_and_areas_have_none(world):
    roads = world(
        *(row("road_minor", shapely.LineString([(-90, y), (90, y)])) for y in range(-90, 91, 9)),
        row("building", shapely.box(-5, -5, 5, 5)),
    )
    noise = replace(EXACT, gap_share=0.15, gap_m=6.0)
    parts, lost_m = [], []
    for seed in range(60):
        found = seen(roads, noise=noise, seed=seed)
        lines = found.geometry[(found["class"] == "road_minor").to_numpy()]
        parts.append(len(lines))
        lost_m.append(21 * 180 - lines.length.sum())
        assert (found["class"] == "building").sum() == 1
    assert np.mean(lost_m) == pytest.approx(0.15 * 21 * 6.0, rel=0.2)
    assert np.mean(parts) == pytest.approx(21 * 1.15, abs=0.6)


@given(seed=st.integers(0, 9999), rms_m=st.floats(0.2, 3.0))
def test_a_smooth_shift_is_as_large_as_asked_and_smooth(seed, rms_m):
    at = np.random.default_rng(seed).uniform(-3000, 3000, (4000, 2))
    shift = smooth_shift(rms_m, np.random.default_rng(seed))
    moved = shift(at) - at
    assert np.sqrt((moved**2).mean(axis=0)) == pytest.approx([rms_m] * 2, rel=0.15)
    step = shift(at + np.array((1.0, 0.0))) - shift(at) - np.array((1.0, 0.0))
    assert np.abs(step).max() < 8 * rms_m * np.sqrt(2 / 8) * 2 * np.pi / 60  # all waves at their steepest


@given(seed=st.integers(0, 9999), yaw_deg=st.floats(0, 360))
def test_what_met_still_meets_after_the_shift(world, seed, yaw_deg):
    state = world(
        row("road_minor", shapely.LineString([(-300, 5), (10, 5), (60, 5), (300, 40)])),
        row("road_minor", shapely.LineString([(10, 5), (10, 300)])),
        row("road_major", shapely.LineString([(60, -300), (60, 5), (60, 300)])),
        row("path_track", shapely.LineString([(-300, -50), (300, -50)]), level=1),
    )
    vectors = seen(state, yaw_deg, noise=replace(EXACT, shift_m=2.0), seed=seed)
    nodes = build_graph(as_features(vectors)).nodes
    meeting = nodes[(nodes["kind"] == "intersection").to_numpy()]
    assert sorted(meeting["degree"]) == [3, 4]
    crossing = nodes[(nodes["kind"] == "crossing").to_numpy()]
    assert crossing["level_difference"].tolist() == [1]


def test_the_same_seed_gives_the_same_vectors_and_another_one_others(scene):
    state = scene("town-suburb").map
    west, south, _, _ = state.grid.bounds_m
    pose = Pose(easting_m=west + 400, northing_m=south + 500, yaw_deg=33.0)
    one, same, other = (
        perceive_vectors(state, pose, side_m=192.0, noise=VectorNoise(), rng=np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    assert one.geometry.geom_equals_exact(same.geometry, 0).all()
    assert one.to_wkt().to_numpy().tolist() == same.to_wkt().to_numpy().tolist()
    assert one.geometry.to_wkt().tolist() != other.geometry.to_wkt().tolist()
    assert set(one["class"]) <= set(VECTOR_CLASSES)


# Instances of a mask


def test_instances_of_a_mask_are_its_patches_where_they_are():
    cells = np.zeros((1, 20, 20), dtype=np.uint8)
    cells[0, 2:5, 3:9] = PRESENT
    cells[0, 12:14, 12:14] = PRESENT
    cells[0, 14, 12] = PRESENT  # touches the one above
    found = instances_of_mask(Evidence(classes=("building",), cells=cells, cell_size_m=2.0))
    assert sorted(shape.bounds for shape in found.geometry) == [(-14.0, 10.0, -2.0, 16.0), (4.0, -10.0, 8.0, -4.0)]
    assert sorted(found.geometry.area) == [20.0, 72.0]


@given(seed=st.integers(0, 999))
def test_instances_of_a_mask_tell_nothing_more_than_the_mask(seed):
    cells = (np.random.default_rng(seed).random((1, 12, 12)) < 0.3).astype(np.uint8)
    found = instances_of_mask(Evidence(classes=("building",), cells=cells, cell_size_m=1.0))
    points = shapely.points(cell_offsets_m((12, 12), 1.0))
    inside = (
        shapely.contains(shapely.union_all(found.geometry.to_numpy()), points) if len(found) else cells[0].ravel() > 1
    )
    np.testing.assert_array_equal(inside.reshape(12, 12), cells[0] == PRESENT)


def test_a_mask_with_nothing_in_it_has_no_instances():
    cells = np.full((1, 5, 5), ABSENT, dtype=np.uint8)
    assert len(instances_of_mask(Evidence(classes=("building",), cells=cells, cell_size_m=1.0))) == 0
    assert len(as_features(vector_table([]))) == 0


# A local warp bends both alike


@given(yaw_deg=st.floats(0, 360), seed=st.integers(0, 999))
def test_bent_lines_lie_on_the_cells_of_the_bent_view(scene, yaw_deg, seed):
    state = scene("town-suburb").map
    west, south, east, north = state.grid.bounds_m
    place = np.random.default_rng(seed).uniform((west + 150, south + 150), (east - 150, north - 150))
    pose = Pose(easting_m=place[0], northing_m=place[1], yaw_deg=yaw_deg)
    vectors = perceive_vectors(state, pose, side_m=192.0, noise=EXACT, rng=np.random.default_rng(0))
    view = state.view(pose, size_cells=192, cell_size_m=1.0)
    field = LocalWarp(rms_m=5.0).field(view.shape, 1.0, np.random.default_rng(seed))
    if folded_share(field, 1.0) > 0:
        return
    after, lines = warped(view, field), bent(vectors, field, 1.0)
    straight = [hit for name in ("road_minor", "road_major") for hit in on_cells(vectors, after, name)]
    curved = [hit for name in ("road_minor", "road_major") for hit in on_cells(lines, after, name)]
    if len(curved) > 60:
        assert np.mean(curved) > 0.85
        assert np.mean(curved) > np.mean(straight)


@pytest.mark.filterwarnings("ignore:invalid value encountered in linestrings")  # of shapely, on what is damaged
@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda vectors: vectors.drop(columns="level"), id="no level"),
        pytest.param(lambda vectors: vectors.set_geometry([None]), id="no geometry"),
        pytest.param(lambda vectors: vectors.set_geometry([shapely.LineString()]), id="empty"),
        pytest.param(lambda vectors: vectors.set_geometry([shapely.LineString([(0, np.nan), (1, 1)])]), id="nan"),
        pytest.param(lambda vectors: vectors.set_geometry([shapely.Point(1e300, 0)]), id="far beyond any view"),
    ],
)
def test_vectors_that_no_system_could_read_are_refused_with_the_query(damage):
    seen = Evidence(classes=("road_minor",), cells=np.zeros((1, 4, 4), np.uint8), cell_size_m=1.0)
    prior = Prior(center_m=(0.0, 0.0), radius_m=10.0, yaw_deg=0.0, yaw_sigma_deg=1.0, scale_sigma=0.0)
    query = query_of(seen, prior)
    sound = vector_table([("road_minor", 0, False, shapely.LineString([(0, 0), (1, 1)]))])
    assert replace(query, vectors=sound).vectors is sound
    with pytest.raises(ShapeError, match="vectors of query 'q' have columns class, level and is_bridge"):
        replace(query, vectors=damage(sound))
