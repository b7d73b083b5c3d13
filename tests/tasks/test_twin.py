# SPDX-License-Identifier: Apache-2.0
"""Twins: copies lie where they should, nothing stays under them, and each change does what it says and no more."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import DTYPES, make_features
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.tasks.twin import Paste, around, level_crossings, mirror, open_gaps, paste, split_long, stagger

CROSS = np.array([[0.0, 0.0]])


def row(name, geometry, **columns):
    return {"class": name, "geometry": geometry, **columns}


def line(name, *corners, **columns):
    return row(name, shapely.LineString(corners), **columns)


def table(*rows):
    base = {"osm_type": "way", "version": 1, "timestamp": pd.NaT, "level": 0, "width_m": np.nan}
    base |= {"is_bridge": False, "is_tunnel": False, "is_visible": True}
    full = [base | {"osm_id": number} | item for number, item in enumerate(rows)]
    return make_features({name: [item[name] for item in full] for name in (*DTYPES, "geometry")}, epsg=32632)


def of_class(features, name):
    return features.geometry[(features["class"] == name).to_numpy()].to_numpy()


def junctions(features):
    nodes = build_graph(features).nodes
    nodes = nodes[(nodes["kind"] == "intersection").to_numpy()]
    return sorted(zip(nodes["degree"].tolist(), nodes.geometry.x.round(1), nodes.geometry.y.round(1), strict=True))


def village():
    """A street with houses beside it, a pond, and far off another house on a road."""
    return table(
        line("road_minor", (-200, 0), (0, 0), (200, 0), width_m=5.0),
        *(row("building", shapely.box(x, 10, x + 8, 18)) for x in range(-60, 61, 12)),
        row("water", shapely.Point(0, -30).buffer(15)),
        row("building", shapely.box(495, 495, 505, 505)),
        line("road_major", (300, 500), (700, 500), width_m=9.0),
    )


# Pasting


@given(east_m=st.floats(300, 9000), north_m=st.floats(-9000, 9000))
def test_a_copy_lies_where_its_source_does_but_for_the_shift(east_m, north_m):
    target = (round(east_m, 3), round(north_m, 3))
    features = village()
    copied = around(paste(features, [Paste(source_m=(0, 0), target_m=target, radius_m=50.0)]), target, 49.9)
    source = around(features, (0, 0), 49.9)
    for name in ("road_minor", "building", "water"):
        back = affinity.translate(shapely.union_all(of_class(copied, name)), -target[0], -target[1])
        assert shapely.hausdorff_distance(back, shapely.union_all(of_class(source, name))) < 0.01


def test_nothing_stays_under_a_copy():
    target = (500.0, 500.0)
    item = Paste(source_m=(0, 1000), target_m=target, radius_m=50.0)  # from where there is nothing
    after = paste(village(), [item])
    assert len(around(after, target, 49.9)) == 0
    road = shapely.union_all(of_class(after, "road_major"))
    assert road.length == pytest.approx(400 - 2 * 50, abs=0.2)  # cut at the rim, and whole beyond it
    assert len(of_class(after, "building")) == len(of_class(village(), "building")) - 1


def test_a_copy_reaches_to_its_radius_and_no_farther():
    after = paste(village(), [Paste(source_m=(0, 0), target_m=(500, 500), radius_m=50.0)])
    copy = around(after, (500, 500), 80.0)
    reach_m = shapely.hausdorff_distance(shapely.Point(500, 500), shapely.union_all(of_class(copy, "road_minor")))
    assert reach_m == pytest.approx(50, abs=0.01)


@given(radius_m=st.floats(15, 150))
def test_pasted_onto_itself_a_place_is_the_same_and_cut_at_the_rim(radius_m):
    features = village()
    after = paste(features, [Paste(source_m=(3, 4), target_m=(3, 4), radius_m=radius_m)])
    for name in ("road_minor", "building", "water"):
        before, now = (shapely.union_all(of_class(item, name)) for item in (features, after))
        assert shapely.symmetric_difference(shapely.buffer(before, 0.5), shapely.buffer(now, 0.5)).area < 0.5
    parts = shapely.get_parts(of_class(after, "road_minor"))
    assert len(parts) == 3  # what is left outside on either side, and what is within
    assert shapely.length(parts).sum() == pytest.approx(400, abs=0.1)


def test_sources_are_read_from_the_table_as_given():
    places = ((0.0, 0.0), (500.0, 500.0))
    swapped = paste(
        village(),
        [
            Paste(source_m=places[0], target_m=places[1], radius_m=40.0),
            Paste(source_m=places[1], target_m=places[0], radius_m=40.0),
        ],
    )
    assert len(of_class(around(swapped, places[0], 39.0), "road_major")) == 1
    assert len(of_class(around(swapped, places[0], 39.0), "road_minor")) == 0
    assert len(of_class(around(swapped, places[1], 39.0), "water")) == 1


def test_a_change_edits_the_copy_and_leaves_its_source():
    def without_water(piece):
        return piece[(piece["class"] != "water").to_numpy()]

    after = paste(village(), [Paste(source_m=(0, 0), target_m=(500, 500), radius_m=50.0, change=without_water)])
    assert len(of_class(after, "water")) == 1
    assert of_class(after, "water")[0].equals(of_class(village(), "water")[0])


def test_no_paste_changes_nothing():
    features = village()
    assert paste(features, []) is features


def test_an_area_cut_at_the_rim_leaves_no_line_or_point():
    # The field's edge runs along the disc's own vertices to the east and west: cuts there leave points and lines.
    features = table(row("farmland", shapely.box(-50, 0, 50, 90)), row("green", shapely.box(50, -10, 90, 10)))
    found = around(features, (0, 0), 50.0)
    assert found["class"].tolist() == ["farmland"]
    assert set(found.geometry.geom_type) == {"Polygon"}


# Mirroring


@given(center_m=st.tuples(st.floats(-500, 500), st.floats(-500, 500)))
def test_mirroring_keeps_areas_and_lengths_and_what_it_is_not_asked_for(center_m):
    before = village()
    after = mirror(before, ["building", "water"], center_m)
    assert after.geometry.area.to_numpy() == pytest.approx(before.geometry.area.to_numpy(), abs=0.1)
    assert after.geometry.length.to_numpy() == pytest.approx(before.geometry.length.to_numpy(), abs=0.1)
    is_line = before["class"].str.startswith("road").to_numpy()
    assert after.geometry[is_line].geom_equals(before.geometry[is_line]).all()
    easts = [shapely.get_coordinates(shapely.centroid(item.geometry.to_numpy()))[~is_line] for item in (before, after)]
    assert easts[1][:, 0] == pytest.approx(2 * center_m[0] - easts[0][:, 0], abs=0.01)
    assert easts[1][:, 1] == pytest.approx(easts[0][:, 1], abs=0.01)


# Rows of houses


@given(
    turn_deg=st.floats(0, 360),
    size_m=st.tuples(st.floats(9, 70), st.floats(9, 70)),
    start=st.integers(0, 5),
    is_angled=st.booleans(),
)
def test_a_row_of_houses_is_the_hall_it_was_cell_by_cell(turn_deg, size_m, start, is_angled):
    width_m, depth_m = size_m
    west, south = 100.137, 100.0713  # off the lattice, so that no edge runs through the middles of cells
    hall = shapely.box(west, south, west + width_m, south + depth_m)
    if is_angled:
        hall = hall.difference(shapely.box(west, south, west + width_m / 2, south + depth_m / 2))
    hall = affinity.rotate(hall, turn_deg)
    ring = shapely.get_coordinates(hall)[:-1]
    hall = shapely.Polygon(np.roll(ring, start, axis=0))  # from whichever corner it was drawn
    features = table(row("building", hall), row("building", shapely.box(0, 0, 8, 8)))
    after = split_long(features, piece_m=7.0, least_area_m2=80.0)
    houses = of_class(after, "building")
    assert shapely.symmetric_difference(shapely.union_all(houses), shapely.union_all(features.geometry)).area < 1e-6
    assert shapely.area(houses).sum() == pytest.approx(features.geometry.area.sum())  # and none overlap
    assert len(houses) >= round(max(size_m) / 7.0)
    grid = Grid(epsg=32632, west_m=0.0, north_m=200.0, cell_size_m=1.0, rows=200, cols=200)
    masks = [
        burn_layers(make_paint(item, ("building",), shapely.box(0, 0, 200, 200)), grid) for item in (features, after)
    ]
    np.testing.assert_array_equal(*masks)


@given(turn_deg=st.floats(0, 360), shift_m=st.tuples(st.integers(-5000, 5000), st.integers(200, 5000)))
def test_a_pasted_row_of_houses_has_the_outline_of_the_hall(turn_deg, shift_m):
    hall = affinity.rotate(shapely.box(-20.137, -9.071, 23.4, 8.2), turn_deg)
    features = table(row("building", shapely.transform(hall, lambda at: at.round(3))))
    item = Paste(
        source_m=(0.3, 0.7),
        target_m=(0.3 + shift_m[0], 0.7 + shift_m[1]),
        radius_m=60.0,
        change=lambda piece: split_long(piece, piece_m=7.0, least_area_m2=160.0),
    )
    houses = of_class(paste(features, [item]), "building")[1:]
    assert len(houses) == 6
    back = shapely.transform(shapely.union_all(houses), lambda at: at - np.array(shift_m))
    assert shapely.symmetric_difference(back, features.geometry.iloc[0]).area < 1e-3


def test_only_large_buildings_are_split_and_into_pieces_as_long_as_asked():
    features = table(
        row("building", shapely.box(0, 0, 35, 10), osm_id=7),
        row("building", shapely.box(50, 0, 60, 10)),
        row("green", shapely.box(0, 50, 90, 90)),
    )
    after = split_long(features, piece_m=7.0, least_area_m2=160.0)
    pieces = after[(after["osm_id"] == 7).to_numpy()]
    assert sorted(pieces.geometry.area.round(6)) == [70.0] * 5
    assert len(after) == 7


# Junctions


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "roads",
    [
        [((-80, 0), (0, 0), (80, 0)), ((0, -80), (0, 0))],
        [((-80, 0), (0, 0), (80, 0)), ((0, -80), (0, 0), (0, 80))],
        [((-80, 0), (0, 0)), ((0, 0), (80, 0)), ((0, -80), (0, 0))],
    ],
    ids=["T", "X", "T of three ends"],
)
def test_a_gap_parts_one_road_from_the_others_by_what_was_asked(roads, seed):
    widths_m = (9.0, 5.0, 3.0)
    features = table(*(line("road_minor", *road, width_m=widths_m[at]) for at, road in enumerate(roads)))
    assert junctions(features)
    after = open_gaps(features, CROSS, gap_m=2.0, rng=np.random.default_rng(seed))
    assert junctions(after) == []
    touches = shapely.distance(after.geometry.to_numpy(), shapely.Point(0, 0)) < 0.01
    assert (~touches).sum() == 1
    bands = shapely.buffer(after.geometry.to_numpy(), after["width_m"].to_numpy() / 2)
    gap_m = shapely.distance(shapely.union_all(bands[~touches]), shapely.union_all(bands[touches]))
    assert gap_m == pytest.approx(2.0, abs=0.1)


def test_a_gap_opens_only_where_two_roads_meet():
    features = table(line("road_minor", (-80, 0), (80, 0), width_m=5.0), line("railway", (0, -80), (0, 80)))
    after = open_gaps(features, CROSS, gap_m=2.0, rng=np.random.default_rng(0))
    assert after.geometry.geom_equals(features.geometry).all()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "roads",
    [
        [((-80, 0), (0, 0), (80, 0)), ((0, -80), (0, 0), (0, 80))],
        [((-80, 0), (0, 0)), ((0, 0), (80, 0)), ((0, -80), (0, 0)), ((0, 0), (0, 80))],
        [((-80, 0), (0, 0), (80, 0)), ((0, 80), (0, 0)), ((0, -80), (0, 0))],
    ],
    ids=["two roads", "four ends", "one road and two ends"],
)
def test_staggering_makes_two_junctions_of_three_of_one_of_four(roads, seed):
    features = table(*(line("road_minor", *road, width_m=5.0) for road in roads))
    assert [item[0] for item in junctions(features)] == [4]
    after = stagger(features, CROSS, offset_m=5.0, rng=np.random.default_rng(seed))
    found = junctions(after)
    assert [item[0] for item in found] == [3, 3]
    assert np.hypot(found[0][1] - found[1][1], found[0][2] - found[1][2]) == pytest.approx(5.0)
    assert (0.0, 0.0) in [item[1:] for item in found]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("far_m", [80.0, 14.0])
def test_staggering_bends_the_first_metres_of_one_arm_and_nothing_else(far_m, seed):
    corners = (-far_m, 0), (0, 0), (far_m, 0)
    features = table(
        line("road_minor", *corners, width_m=5.0), line("road_minor", *((y, x) for x, y in corners), width_m=5.0)
    )
    after = stagger(features, CROSS, offset_m=5.0, rng=np.random.default_rng(seed))
    before, now = (shapely.union_all(item.geometry.to_numpy()) for item in (features, after))
    bent_m = 10.0 if far_m > 15 else far_m  # a short arm is moved whole
    off = shapely.difference(now, shapely.buffer(before, 0.01))
    assert not off.is_empty
    assert np.abs(shapely.get_coordinates(off)).max() <= bent_m + 0.01
    lost = shapely.difference(before, shapely.buffer(now, 0.01))
    assert np.abs(shapely.get_coordinates(lost)).max() <= bent_m + 0.01
    straight = shapely.intersection(now, shapely.buffer(before, 0.01)).length
    assert straight == pytest.approx(4 * far_m - bent_m, abs=0.2)


def test_staggering_leaves_a_t_junction_alone():
    features = table(
        line("road_minor", (-80, 0), (0, 0), (80, 0), width_m=5.0), line("road_minor", (0, -80), (0, 0), width_m=5.0)
    )
    after = stagger(features, CROSS, offset_m=5.0, rng=np.random.default_rng(0))
    assert after.geometry.geom_equals(features.geometry).all()


def test_on_the_ground_an_overpass_is_a_junction():
    features = table(
        line("road_major", (-80, 0), (80, 0), width_m=9.0),
        line("road_minor", (10, -80), (10, -20), width_m=5.0),
        line("road_minor", (10, -20), (10, 20), width_m=5.0, level=1, is_bridge=True),
        line("bridge", (10, -20), (10, 20), width_m=5.0, level=1, is_bridge=True),
        line("road_minor", (10, 20), (10, 80), width_m=5.0),
    )
    assert junctions(features) == []
    nodes = build_graph(features).nodes
    assert (nodes["level_difference"] != 0).any()
    after = level_crossings(features)
    assert junctions(after) == [(4, 10.0, 0.0)]
    assert not (build_graph(after).nodes["kind"] == "crossing").any()
    assert len(of_class(after, "bridge")) == 0
    assert not after["is_bridge"].any()
    roads, before = (shapely.union_all(item.geometry.to_numpy()) for item in (after, features))
    assert shapely.hausdorff_distance(roads, before) < 0.002  # the mask of the roads stays


def test_an_edited_table_is_a_feature_table():
    features = gpd.GeoDataFrame(pd.concat([village()], ignore_index=True), geometry="geometry", crs=32632)
    after = paste(features, [Paste(source_m=(0, 0), target_m=(900, 0), radius_m=60.0, change=level_crossings)])
    assert after.dtypes.to_dict() == village().dtypes.to_dict()


def test_a_square_that_is_a_road_stays_as_it_is_where_bridges_come_down():
    columns = {"class": "road_minor", "level": [0, 1, 0], "is_bridge": [False, True, False]}
    shapes = [
        shapely.LineString([(0, 0), (40, 0)]),
        shapely.LineString([(20, -20), (20, 20)]),
        shapely.box(10, -5, 30, 5),
    ]
    flat = level_crossings(gpd.GeoDataFrame(columns, geometry=shapes, crs=32632))
    assert flat.geometry.iloc[2].equals(shapes[2])
    assert len(flat.geometry.iloc[0].coords) == 3
