# SPDX-License-Identifier: Apache-2.0
"""Ground that two maps share is found wherever it lies and however it is turned; two different places share none.

Blocks of ten buildings are alike only if their outlines are, each in its place: equal footprints alone are nothing.
"""

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.locate import find_extract
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.regions.region_files import read_features
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.tasks.duplicates import (
    ALIKE_M,
    BLOCK,
    LEAST_ALIKE,
    LEAST_AREA_M2,
    NEIGHBOURS,
    Arrangements,
    constellations,
    find_alike,
    find_duplicate,
    search_look_alikes,
    search_split,
)
from sasgeo_bench.tasks.split import SplitFile, find_split_file, make_split, read_split_file


def houses(count=80, *, seed=1, side_m=500.0):
    """Outlines of houses of several sizes, anywhere in a square."""
    rng = np.random.default_rng(seed)
    at, width_m, depth_m = rng.uniform(0, side_m, (count, 2)), rng.uniform(7, 18, count), rng.uniform(7, 18, count)
    return shapely.box(at[:, 0], at[:, 1], at[:, 0] + width_m, at[:, 1] + depth_m)


def table(outlines, *, name="building", is_visible=True):
    return gpd.GeoDataFrame({"class": name, "is_visible": is_visible}, index=range(len(outlines)), geometry=outlines)


def turned(shapes, turn_deg, shift_m, middle=(0.0, 0.0)):
    angle = np.radians(turn_deg)
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return shapely.transform(np.asarray(shapes), lambda at: (at - middle) @ matrix.T + middle + shift_m)


moves = st.tuples(st.floats(0, 360), st.tuples(st.floats(-3e5, 3e5), st.floats(-3e5, 3e5)), st.integers(0, 10_000))


@given(moves)
def test_keys_do_not_change_when_the_map_is_turned_and_moved(move):
    turn_deg, shift_m, seed = move
    outlines = houses(40, seed=seed)
    one, two = constellations(table(outlines)), constellations(table(turned(outlines, turn_deg, shift_m)))
    assert len(one.keys) == len(two.keys) > 0
    # A number on the edge of a step may fall to its other side by the last bit.
    assert (one.keys != two.keys).sum() <= 1


@settings(max_examples=20)
@given(moves)
def test_a_map_that_is_turned_and_moved_is_found_and_its_middle_with_it(move):
    turn_deg, shift_m, seed = move
    outlines = houses(seed=seed)
    found = find_duplicate(constellations(table(outlines)), constellations(table(turned(outlines, turn_deg, shift_m))))
    assert found.count >= 70
    at = shapely.get_coordinates(turned([shapely.Point(found.first_m)], turn_deg, shift_m))[0]
    np.testing.assert_allclose(at, found.second_m, atol=2.0)


@given(st.integers(0, 10_000))
def test_of_a_mirrored_map_no_more_than_a_line_of_houses_lies_alike(seed):
    outlines = houses(seed=seed)
    mirrored = shapely.transform(outlines, lambda at: at * (-1, 1))
    found = find_duplicate(constellations(table(outlines)), constellations(table(mirrored)))
    assert found is None or found.count < 20


@given(st.integers(0, 10_000))
def test_two_different_places_share_nothing(seed):
    maps = [constellations(table(houses(seed=seed + extra))) for extra in (0, 1)]
    assert find_duplicate(*maps) is None


def test_a_patch_that_two_maps_share_is_found_among_what_they_do_not():
    shared = houses(40, seed=3, side_m=300.0)
    first = [*shared, *turned(houses(200, seed=4, side_m=900.0), 0, (600.0, 0.0))]
    second = [*turned(shared, 77.0, (40_000.0, 9.0)), *turned(houses(200, seed=5, side_m=900.0), 0, (41_000.0, 0.0))]
    found = find_duplicate(constellations(table(first)), constellations(table(second)))
    assert 25 <= found.count <= 40
    assert 0 < found.first_m[0] < 300


def test_fewer_alike_than_a_patch_needs_are_none():
    few = houses(LEAST_ALIKE - 1, seed=6, side_m=100.0)
    one, two = constellations(table(few)), constellations(table(turned(few, 10.0, (9.0, 9.0))))
    assert len(one.keys) == LEAST_ALIKE - 1
    assert find_duplicate(one, two) is None


def test_a_row_of_equal_houses_is_no_sign_of_the_same_ground():
    rows = [[shapely.box(x, y, x + 9.1, y + 8.3) for x in range(0, 600, 20) for y in range(0, 600, 30)], []]
    rows[1] = list(turned(rows[0], 30.0, (7000.0, 0.0)))
    assert find_duplicate(*(constellations(table(row)) for row in rows)) is None


def test_huts_what_is_hidden_and_what_is_no_building_do_not_count():
    side_m = np.sqrt(LEAST_AREA_M2) * 0.99
    huts = [shapely.box(x, 0, x + side_m, side_m) for x in range(0, 200, 20)]
    for given_table in (
        table(huts),
        table(houses(), name="water"),
        table(houses(), is_visible=False),
        table(houses(NEIGHBOURS)),
        table(np.array([], dtype=object)),
    ):
        found = constellations(given_table)
        assert found.en_m.shape == (0, 2)
        assert len(found.keys) == 0


def test_a_house_that_stands_alone_is_no_constellation():
    lonely = [*houses(20, side_m=100.0), shapely.box(5000, 5000, 5010, 5010)]
    found = constellations(table(lonely))
    assert len(found.keys) == 20
    assert found.en_m.max() < 1000


def test_a_town_is_found_again_turned_and_shifted_and_two_towns_are_not_taken_for_one(towns):
    features = {name: read_features(towns / "regions" / name) for name in ("town-riverside", "town-grid")}
    river, grid = (constellations(item) for item in features.values())
    assert find_duplicate(river, grid) is None
    frame = features["town-riverside"]
    middle = shapely.get_coordinates(frame.geometry.union_all().centroid)[0]
    moved = frame.set_geometry(
        gpd.GeoSeries(turned(frame.geometry, 133.0, (20_000.0, -3000.0), middle), index=frame.index, crs=frame.crs)
    )
    found = find_duplicate(river, constellations(moved))
    assert found.count > 0.3 * len(river.keys)


def split_of(parts, kind="holdout"):
    """Regions of two kilometres, 20 km apart, and their parts; a region has four blocks."""
    grids = {
        name: Grid(epsg=32632, west_m=20_000.0 * at, north_m=2000.0, cell_size_m=2.0, rows=1000, cols=1000)
        for at, name in enumerate(parts)
    }
    places = [
        {"name": name, "regions": [name]} | ({"part": part} if kind == "holdout" else {"half": part})
        for name, part in parts.items()
    ]
    spec = SplitFile.model_validate({"id": "x", "title": "X", "kind": kind, "buffer_m": 0.0, "place": places})
    return make_split(spec, grids)


@pytest.fixture(scope="module")
def copies():
    """Maps of three regions; `a` and `c` hold the same houses, in their north-east and south-west."""
    ground = houses(seed=9)
    return {
        "a": constellations(table(turned(ground, 0.0, (1300.0, 1300.0)))),
        "b": constellations(table(turned(houses(seed=10), 0.0, (20_500.0, 500.0)))),
        "c": constellations(table(turned(ground, 0.0, (40_100.0, 100.0)))),
    }


def test_shared_ground_of_two_parts_is_named_by_its_blocks(copies):
    (found,) = search_split(split_of({"a": "train", "b": "train", "c": "test"}), copies)
    assert (found.first, found.second) == ("a/0-1", "c/1-0")
    assert found.count >= 70


def test_one_part_may_hold_the_same_ground_twice_and_a_cross_fit_may_not(copies):
    assert search_split(split_of({"a": "train", "b": "test", "c": "train"}), copies) == ()
    assert len(search_split(split_of(dict(zip("abcd", "aabb", strict=True)), kind="crossfit"), copies)) == 1


def test_a_region_that_is_not_built_is_not_searched(copies):
    split = split_of({"a": "train", "b": "train", "c": "test"})
    assert search_split(split, {name: copies[name] for name in "ab"}) == ()
    assert search_split(split, {}) == ()


def tract(count=40, *, seed=1, jitter_m=12.0, size_m=(9.0, 12.0), first_id=0):
    """Equal houses on a street grid, each anywhere on its plot, as a table with ids."""
    plots = np.indices((-(-count // 5), 5)).reshape(2, -1).T[:count] * 30.0
    at = plots + np.random.default_rng(seed).uniform(0, jitter_m, (count, 2))
    outlines = shapely.box(at[:, 0], at[:, 1], at[:, 0] + size_m[0], at[:, 1] + size_m[1])
    return table(outlines).assign(osm_type="way", osm_id=range(first_id, first_id + count))


def moved(features, turn_deg=77.0, shift_m=(40_000.0, 9.0), *, ids_from=1000):
    outlines = turned(features.geometry, turn_deg, shift_m)
    return features.assign(geometry=outlines, osm_id=range(ids_from, ids_from + len(features)))


def pairs(one, two, **changes):
    found = find_alike(Arrangements.of(one), Arrangements.of(two), **changes)
    return set(zip(found.first.tolist(), found.second.tolist(), strict=True))


@settings(max_examples=20)
@given(moves)
def test_blocks_of_a_copy_are_found_wherever_it_lies_and_however_it_is_turned(move):
    turn_deg, shift_m, seed = move
    town = tract(seed=seed)
    found = find_alike(Arrangements.of(town), Arrangements.of(moved(town, turn_deg, shift_m)))
    assert len(found.first) >= 39  # of two neighbours that are equally far another may come first by the last bit
    assert found.apart_m.max() < 1e-3


def test_equal_footprints_in_another_arrangement_are_not_alike():
    assert pairs(tract(seed=1), tract(seed=2, first_id=1000)) == set()


def test_an_equal_arrangement_of_other_footprints_is_not_alike():
    assert pairs(tract(size_m=(9.0, 12.0)), tract(size_m=(12.0, 9.0), first_id=1000)) == set()


def test_a_mirrored_copy_is_not_alike():
    town = tract()
    mirrored = shapely.transform(town.geometry.to_numpy(), lambda at: at * (-1, 1))
    assert pairs(town, moved(town.assign(geometry=mirrored))) == set()


@pytest.mark.parametrize(("share", "is_found"), [(0.3, True), (1.5, False)])
def test_blocks_are_alike_up_to_a_tolerance_of_their_outlines(share, is_found):
    town = tract(BLOCK, jitter_m=8.0)
    copy = moved(town)
    shifts = np.random.default_rng(5).choice([-1.0, 1.0], (BLOCK, 2)) * share * ALIKE_M / np.sqrt(2)
    copy = copy.assign(geometry=[turned([one], 0, by)[0] for one, by in zip(copy.geometry, shifts, strict=True)])
    assert bool(pairs(town, copy)) is is_found


def test_a_block_that_is_copied_into_another_town_is_found_there():
    block = tract(BLOCK, seed=7, jitter_m=8.0)
    around = tract(60, seed=8, first_id=500).translate(400.0, 0.0)
    first = [*block.geometry, *around]
    second = [*turned(block.geometry, 133.0, (9000.0, 0.0)), *tract(60, seed=9).translate(9400.0, 300.0)]
    maps = [
        table(side).assign(osm_type="way", osm_id=range(at, at + len(side))) for side, at in ((first, 0), (second, 99))
    ]
    found = pairs(*maps)
    assert found
    assert all(one < BLOCK and one == two for one, two in found)


def test_a_regular_grid_of_equal_houses_looks_alike_everywhere():
    grid = tract(60, jitter_m=0.0)
    inner = {row for row in range(60) if row % 5 == 2 and 10 <= row < 50}
    assert inner <= {one for one, _ in pairs(grid, moved(grid))}


def test_units_that_touch_are_one_building_unless_they_are_taken_as_they_are_drawn():
    units = shapely.box(np.arange(0, 60, 3.0), 0, np.arange(3, 63, 3.0), 6)
    garages = table(units).assign(osm_type="way", osm_id=range(20))
    assert len(Arrangements.of(garages)) == 0
    one, two = (Arrangements.of(side, as_drawn=True) for side in (garages, moved(garages)))
    assert len(one) == 20
    assert len(find_alike(one, two).first) > 0


def test_a_row_does_not_lie_over_itself():
    units = shapely.box(np.arange(0, 60, 5.0), 0, np.arange(3, 63, 5.0), 6)
    row = table(units).assign(osm_type="way", osm_id=range(12))
    assert pairs(row, row) == set()  # any two blocks of twelve houses share one


def test_fewer_than_ten_buildings_are_no_block():
    assert len(Arrangements.of(tract(BLOCK - 1))) == 0
    assert len(Arrangements.of(tract(BLOCK))) == BLOCK
    assert pairs(tract(BLOCK - 1), tract()) == pairs(tract(), tract(BLOCK - 1)) == set()


def test_buildings_with_one_middle_are_in_their_own_blocks():
    towers = table([shapely.box(-side, -side, side, side).boundary.buffer(0.1) for side in range(2, 26, 2)])
    found = Arrangements.of(towers.assign(osm_type="way", osm_id=range(12)))
    assert found.blocks[:, 0].tolist() == list(range(12))
    assert all(len(set(block)) == BLOCK for block in found.blocks.tolist())


def test_look_alikes_of_two_parts_are_named_by_their_blocks_and_those_of_one_part_are_not():
    town = tract()
    copies = {"a": town.translate(1300, 1300), "b": town.translate(20_100, 1300), "c": town.translate(40_100, 100)}
    maps = {
        name: Arrangements.of(town.assign(geometry=at, osm_id=range(100 * number, 100 * number + 40)))
        for number, (name, at) in enumerate(copies.items())
    }
    (found,) = search_look_alikes(split_of({"a": "train", "b": "train", "c": "test"}), {k: maps[k] for k in "ac"})
    assert {found.first, found.second} == {"a/0-1", "c/1-0"}
    assert found.count == 40
    assert search_look_alikes(split_of({"a": "train", "b": "train"}), maps) == ()
    assert len(search_look_alikes(split_of({"a": "train", "b": "train", "c": "test"}), maps)) == 2


@pytest.mark.real
@pytest.mark.slow
def test_no_block_of_ten_buildings_stands_in_two_parts_of_the_world(real_extracts):
    spec = read_split_file(find_split_file("world"))
    regions = {name: read_region_file(list_region_files()[name]) for name in spec.region_ids}
    maps = {}
    for name, region in regions.items():
        extract = region.pick(None)
        path = find_extract(extract, folders=[real_extracts])
        maps[name] = Arrangements.of(read_extract(path, region.grid(), at=extract.date).features)
    assert sum(map(len, maps.values())) > 300_000
    assert search_look_alikes(make_split(spec, {name: region.grid() for name, region in regions.items()}), maps) == ()
