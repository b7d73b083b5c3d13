# SPDX-License-Identifier: Apache-2.0
"""Splits: blocks tile a region, parts keep their distance in metres, and every fault names the pair."""

import hashlib
import re
from itertools import combinations, product
from typing import get_args

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import footprint
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.tasks.split import (
    HALVES,
    Part,
    SplitFile,
    blocks_of,
    find_split_file,
    make_split,
    nearest_blocks,
    nearest_pair,
    read_split_file,
)


def grid(west_m=500_000.0, north_m=5_200_000.0, side_m=2000, epsg=32632):
    return Grid(epsg=epsg, west_m=west_m, north_m=north_m, cell_size_m=2.0, rows=side_m // 2, cols=side_m // 2)


def spec(places, kind="holdout", **changes):
    base = {"id": "mine", "title": "Mine", "kind": kind, "buffer_m": 1000.0, "reach_m": 100.0, "place": places}
    return SplitFile.model_validate(base | changes)


TWO = [
    {"name": "a", "regions": ["a"], "part": "train"},
    {"name": "b", "regions": ["b"], "part": "test"},
]


def halved(halves):
    """A place of its own for each letter, in that half."""
    return [{"name": name, "regions": [name], "half": half} for name, half in zip("abcdefgh", halves, strict=False)]


@given(st.integers(100, 6000), st.integers(100, 6000), st.floats(150, 3000))
def test_blocks_tile_a_region_without_gap_or_overlap(rows, cols, block_m):
    lattice = Grid(epsg=32632, west_m=7.0, north_m=9000.0, cell_size_m=1.0, rows=rows, cols=cols)
    blocks = blocks_of("x", lattice, block_m=block_m)
    outlines = [block.polygon() for block in blocks]
    assert sum(outline.area for outline in outlines) == pytest.approx(rows * cols)
    assert shapely.union_all(outlines).area == pytest.approx(rows * cols)
    assert len({block.id for block in blocks}) == len(blocks)


def test_parts_that_are_far_enough_apart_are_taken_and_their_distance_is_measured():
    split = make_split(spec(TWO), {"a": grid(), "b": grid(west_m=503_500.0)})
    near = nearest_pair(split)
    assert near.gap_m == pytest.approx(1500.0)
    assert {near.first[0], near.second[0]} == {"a", "b"}


def test_parts_that_come_nearer_than_the_buffer_are_refused_with_the_pair_named():
    with pytest.raises(ConfigError, match=r"blocks a/\d-1 and b/\d-0 .* 1100 m apart"):
        make_split(spec(TWO), {"a": grid(), "b": grid(west_m=503_100.0)})


def test_the_reach_of_the_footprints_counts():
    grids = {"a": grid(), "b": grid(west_m=503_500.0)}
    assert make_split(spec(TWO, reach_m=250.0), grids).blocks
    with pytest.raises(ConfigError, match="footprints reach 251 m"):
        make_split(spec(TWO, reach_m=251.0), grids)


def test_distance_holds_across_two_zones():
    # 12 E is the edge of zones 32 and 33: the two regions meet there although their coordinates differ by far.
    west, east = grid(west_m=722_000.0, north_m=5_322_000.0), grid(west_m=278_000.0, north_m=5_322_000.0, epsg=32633)
    with pytest.raises(ConfigError, match="of different parts"):
        make_split(spec(TWO, buffer_m=5000.0), {"a": west, "b": east})


def test_blocks_of_one_region_may_stand_in_different_parts_if_the_buffer_holds():
    places = [
        {"name": "west", "blocks": ["a/0-0", "a/1-0"], "part": "train"},
        {"name": "east", "blocks": ["a/0-3", "a/1-3"], "part": "test"},
    ]
    region = {"a": Grid(epsg=32632, west_m=0.0, north_m=2000.0, cell_size_m=1.0, rows=2000, cols=4000)}
    split = make_split(spec(places, buffer_m=1800.0), region)
    assert nearest_pair(split).gap_m == pytest.approx(2000.0)
    assert [split.part_in_task(block) for block in split.blocks_in("a")] == ["train", "test", "train", "test"]
    with pytest.raises(ConfigError, match="a/0-0"):
        make_split(spec(places, buffer_m=1801.0), region)


@pytest.mark.parametrize(
    ("places", "fault"),
    [
        ([TWO[0], {"name": "b", "regions": ["nowhere"], "part": "test"}], "unknown region 'nowhere'"),
        ([TWO[0], {"name": "b", "blocks": ["b/9-9"], "part": "test"}], "unknown block 'b/9-9'"),
        ([TWO[0], TWO[1] | {"blocks": ["a/0-0"]}], "stands in"),
    ],
)
def test_what_is_not_there_is_named(places, fault):
    with pytest.raises(ConfigError, match=fault):
        make_split(spec(places), {"a": grid(), "b": grid(west_m=600_000.0)})


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("buffer_m = -1.0\n", "greater than or equal"),
        ("bufer_m = 5.0\n", "did you mean 'buffer_m'"),
    ],
)
def test_a_split_file_with_a_fault_is_refused(text, fault):
    whole = 'id = "x"\ntitle = "X"\nkind = "crossfit"\n' + text
    with pytest.raises(ConfigError, match=fault):
        parse_toml(whole, SplitFile, source="x.toml")


@pytest.mark.parametrize(
    ("places", "kind", "fault"),
    [
        ([TWO[0], TWO[0]], "holdout", "place 'a' is listed twice"),
        ([TWO[0], TWO[1] | {"regions": ["a"]}], "holdout", "region 'a' is listed twice"),
        ([TWO[0], {"name": "b", "regions": ["b"]}], "holdout", "needs a part"),
        (TWO, "crossfit", "must not have a part"),
        ([*halved("aabb")[:3], {"name": "d", "regions": ["d"]}], "crossfit", "place 'd' needs a half"),
        (halved("aaab"), "crossfit", "half 'b' needs two places at least: one is tested, and another one calibrates"),
        (
            [place | {"country": f"land-{place['half']}"} for place in halved("aabb")],
            "crossfit",
            "half 'a' needs places of two countries",
        ),
        ([TWO[0], TWO[1] | {"half": "a"}], "holdout", "place 'b' must not have a half in a hold-out"),
        ([TWO[0], {"name": "b", "part": "test"}], "holdout", "needs regions or blocks"),
        ([TWO[0] | {"sealed": True}, TWO[1]], "holdout", "place 'a' is sealed, and its part is 'train'"),
        (
            [TWO[0], {"name": "b", "blocks": ["b/0-0"], "part": "test", "sealed": True}],
            "holdout",
            "a sealed place needs whole regions",
        ),
        (
            [*halved("aabb")[:3], {"name": "d", "regions": ["d"], "half": "b", "sealed": True}],
            "crossfit",
            "half 'b' needs two places that are not sealed at least",
        ),
        (
            [place | {"country": "lowland"} if place["name"] in "ac" else place for place in halved("aabb")],
            "crossfit",
            "country 'lowland' is in half a and, with 'c', in half b",
        ),
    ],
)
def test_places_that_contradict_each_other_are_refused(places, kind, fault):
    with pytest.raises(ValueError, match=fault):
        spec(places, kind)


def test_a_split_without_sealed_places_has_the_hash_it_had_before_there_were_any():
    """Tasks hold the hash of their split: it may not change with a key that a file leaves out."""
    known = {
        "crossfit": "b06f638a5b7f4126c4954f43800ada650a852354825897f94ad1414e32a43863",
        "holdout": "cb8e4b705c81f7c437c7ed2965f0a4cdc1fef5780c348eb9b6d0159a5734af91",
    }
    for name, before in known.items():
        shipped = read_split_file(find_split_file(name))
        assert hashlib.sha256(shipped.model_dump_json().encode()).hexdigest() == before
    assert spec([TWO[0], TWO[1] | {"sealed": True}]).model_dump_json() != spec(TWO).model_dump_json()


def test_a_sealed_place_is_tested_in_its_fold_and_in_no_other():
    places = [item | {"sealed": item["name"] == "c"} for item in halved("aaabb")]
    split = make_split(
        spec(places, "crossfit"), {name: grid(500_000.0 + 20_000 * at) for at, name in enumerate("abcde")}
    )
    for fold in split.folds:
        assert fold.part_of.get("c") == ("test" if fold.held_out == "c" else None)
    assert (split.sealed, split.sealed_place("c"), split.sealed_place("a")) == (("c",), "c", None)
    assert [line.split()[2] for line in split.to_text().splitlines() if line.endswith(" (sealed)")] == ["c"]


@given(st.integers(0, 2**32 - 1), st.floats(0, 800), st.integers(0, 1500))
def test_footprints_of_different_parts_never_meet(seed, buffer_m, apart_m):
    rng = np.random.default_rng(seed)
    grids = {"a": grid(), "b": grid(west_m=502_000.0 + apart_m, north_m=5_200_000.0 + float(rng.integers(-900, 900)))}
    try:
        split = make_split(spec(TWO, buffer_m=buffer_m, reach_m=136.0), grids)
    except ConfigError:
        return
    prints = {
        place: [
            footprint(Pose(easting_m=x, northing_m=y, yaw_deg=rng.uniform(0, 360)), size_m=(192.0, 192.0))
            for block in blocks
            for x, y in rng.uniform(block.bounds_m[:2], block.bounds_m[2:], (6, 2))
        ]
        for place, blocks in split.blocks.items()
    }
    gap_m = min(shapely.distance(one, two) for one in prints["a"] for two in prints["b"])
    assert gap_m >= buffer_m - 1e-6
    assert gap_m > 0 or buffer_m == 0


def shipped(name):
    grids = {region: read_region_file(path).grid() for region, path in list_region_files().items()}
    return make_split(read_split_file(find_split_file(name)), grids)


OF_IMAGERY = {"banepa", "zanzibar"}  # of buildings alone, in a split of their own
OF_DEMO = {name for name in list_region_files() if name.startswith("demo-")}  # have a split of their own
COUNTRIES = {"andorra", "liechtenstein"}  # for flights; their towns are regions, too
OF_WORLD = {name for name, path in list_region_files().items() if read_region_file(path).provenance.country}


@pytest.mark.parametrize("name", ["crossfit", "holdout"])
def test_the_shipped_splits_by_country_hold_the_same_regions_five_kilometres_apart(name):
    split = shipped(name)
    towns = {"canillo", "fuglafjordur", "runavik", "soldeu", "sorvagur", "tvoroyri", "vestmanna"}
    assert set(split.spec.region_ids) == set(list_region_files()) - towns - OF_IMAGERY - COUNTRIES - OF_DEMO - OF_WORLD
    assert nearest_pair(split).gap_m >= 5000.0


def test_the_split_of_flights_has_two_countries_in_place_of_their_towns():
    flights, countries = shipped("flights"), shipped("crossfit")
    towns = {region for region in countries.spec.region_ids if countries.places_in(region)[0] in COUNTRIES}
    assert set(flights.spec.region_ids) == set(countries.spec.region_ids) - towns | COUNTRIES
    assert flights.half_of == countries.half_of
    assert nearest_pair(flights).gap_m >= 5000.0


def test_the_split_by_towns_holds_every_shipped_region_and_their_views_never_meet():
    split = shipped("places")
    assert set(split.spec.region_ids) == set(list_region_files()) - OF_IMAGERY - COUNTRIES - OF_DEMO - OF_WORLD
    assert nearest_pair(split).gap_m >= 2 * split.spec.reach_m + 800.0


@pytest.fixture(scope="module")
def world():
    return shipped("world")


def test_the_split_of_the_world_holds_every_real_region_and_no_made_up_one(world):
    made_up = {name for name in list_region_files() if name.startswith(("demo-", "town-"))}
    too_small = {"minsk", "quito", "sofia"}  # for two views side by side
    assert set(world.spec.region_ids) == set(list_region_files()) - made_up - OF_IMAGERY - COUNTRIES - too_small
    assert nearest_pair(world).gap_m >= 30_000.0


def test_no_country_of_the_world_stands_in_two_parts_and_each_part_has_what_it_needs(world):
    parts = {part: [place for place in world.spec.place if place.part == part] for part in get_args(Part)}
    countries = {part: {place.country for place in places} for part, places in parts.items()}
    assert None not in set().union(*countries.values())
    assert not any(one & other for one, other in combinations(countries.values(), 2))
    least = {"train": (30, 12), "calibration": (15, 7), "test": (65, 24)}
    assert all(len(parts[part]) >= places for part, (places, _) in least.items())
    assert all(len(countries[part]) >= number for part, (_, number) in least.items())
    assert {"nepal", "czechia", "germany", "equatorial-guinea"} <= countries["train"]
    assert "andorra" in countries["calibration"]
    assert {"france", "faroe-islands", "isle-of-man", "liechtenstein", "monaco"} <= countries["test"]


def test_a_place_of_the_world_lies_in_the_country_that_its_regions_state(world):
    for place in world.spec.place:
        stated = {read_region_file(list_region_files()[region]).provenance.country for region in place.regions}
        names = {re.sub("[^a-z]+", "-", name.lower().replace("'", "")).strip("-") for name in stated if name}
        assert names <= {place.country}, place.name


def test_one_test_place_of_the_world_in_four_is_sealed_by_the_rule_of_its_file(world):
    tests = [place for place in world.spec.place if place.part == "test"]
    order = sorted(tests, key=lambda place: hashlib.sha256(f"sealed/{place.name}".encode()).hexdigest())
    assert {place.name for place in world.spec.place if place.sealed} == {one.name for one in order[: len(tests) // 4]}


def test_places_of_the_world_share_no_ground(world):
    outlines = {
        place: [(block.epsg, block.polygon()) for block in blocks] for place, blocks in world.blocks.items() if blocks
    }
    shared = {
        frozenset((one, two))
        for (one, ours), (two, theirs) in combinations(outlines.items(), 2)
        if any(
            epsg == other_epsg and shape.intersection(other).area > 1
            for (epsg, shape), (other_epsg, other) in product(ours, theirs)
        )
    }
    assert not shared


def test_no_view_of_a_sealed_place_of_the_world_shows_ground_that_is_asked_openly(world):
    sides = {"sealed": [], "open": []}
    for place in world.spec.place:
        if place.part == "test":
            sides["sealed" if place.sealed else "open"] += world.blocks[place.name]
    assert nearest_blocks(sides).gap_m >= 2 * world.spec.reach_m


def test_the_split_of_the_demo_holds_its_towns_and_each_half_as_many_kinds():
    split = shipped("demo")
    assert set(split.spec.region_ids) == OF_DEMO
    assert len(split.blocks) == 36
    assert sum(half == "a" for half in split.half_of.values()) == 18
    assert nearest_pair(split).gap_m >= 5000.0


def test_towns_stand_in_the_half_of_their_country_and_cluster_by_it():
    towns, countries = shipped("places"), shipped("crossfit")
    assert {place: towns.country_of[place] for place in ("vaduz", "soldeu", "porto", "lauf")} == {
        "vaduz": "liechtenstein",
        "soldeu": "andorra",
        "porto": "porto",  # a place without a country is its own
        "lauf": "germany",
    }
    half_of = countries.half_of | {"germany": "b", "united-states": "a"}
    assert all(half == half_of[towns.country_of[place]] for place, half in towns.half_of.items())
    assert set(countries.country_of.items()) == {(name, name) for name in countries.blocks}


@pytest.fixture(scope="module")
def crossfit():
    """The shipped cross-fit, and its region files."""
    files = {region: read_region_file(path) for region, path in list_region_files().items()}
    grids = {region: file.grid() for region, file in files.items()}
    return make_split(read_split_file(find_split_file("crossfit")), grids), files


def test_in_a_cross_fit_every_place_tests_once_and_never_teaches_itself(crossfit):
    split, _ = crossfit
    tested = [place for fold in split.folds for place, part in fold.part_of.items() if part == "test"]
    assert sorted(tested) == sorted(split.blocks)
    for fold in split.folds:
        assert set(fold.part_of.values()) == {"train", "calibration", "test"}
        assert fold.part_of[fold.held_out] == "test"
        assert len(fold.part_of) == len(split.blocks)


def test_what_is_learnt_for_a_place_comes_from_places_that_neither_test_nor_calibrate_it(crossfit):
    split, _ = crossfit
    taught = set()
    for fold in split.folds:
        train = frozenset(place for place, part in fold.part_of.items() if part == "train")
        own = split.half_of[fold.held_out]
        assert train == {place for place, half in split.half_of.items() if half != own}
        assert {place for place, part in fold.part_of.items() if part != "train"} == set(split.half_of) - train
        taught.add(train)
    assert len(taught) == 2  # learning is done twice, not once for each place


def test_the_halves_of_the_shipped_cross_fit_are_alike(crossfit):
    split, files = crossfit
    blocks, towns, dated = (dict.fromkeys(HALVES, 0) for _ in range(3))
    for place in split.spec.place:
        blocks[place.half] += len(split.blocks[place.name])
        towns[place.half] += any(files[region].pick(None).town is not None for region in place.regions)
        dated[place.half] += any(
            files[region].pick(None).town is None and len(files[region].extract) > 1 for region in place.regions
        )
    assert blocks["a"] == pytest.approx(blocks["b"], rel=0.1)
    assert towns["a"] == towns["b"]
    assert min(dated.values()) >= 2


@given(st.permutations("aaabbb"))
def test_adding_a_place_to_a_cross_fit_leaves_what_the_others_are_for(halves):
    grids = {name: grid(west_m=500_000.0 + 20_000 * at) for at, name in enumerate("abcdefg")}
    small, large = (make_split(spec(halved(letters), "crossfit"), grids) for letters in (halves, [*halves, "a"]))
    for before, after in zip(small.folds, large.folds, strict=False):
        assert after.part_of == before.part_of | {
            "g": "calibration" if small.half_of[before.held_out] == "a" else "train"
        }


def test_places_of_a_region_are_those_that_hold_its_blocks(crossfit):
    split, _ = crossfit
    assert split.places_in("vaduz") == ("liechtenstein",)
    assert split.places_in("atlantis") == ()


def test_groups_of_blocks_that_are_no_parts_of_a_split_have_a_distance_too():
    blocks = {name: blocks_of(name, grid(west_m=west_m)) for name, west_m in (("a", 500_000.0), ("b", 503_000.0))}
    assert nearest_blocks(blocks).gap_m == pytest.approx(1000.0)
    assert nearest_blocks(blocks, within_m=999.0) is None
