# SPDX-License-Identifier: Apache-2.0
"""Pairs of shapes that overlap are found in bounded memory, or refused with a count."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import shapely

import sasgeo_bench
from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry import pairs
from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm import read
from sasgeo_bench.regions.layers import groups_within, touching_pairs

CODE = Path(sasgeo_bench.__file__).parent
# How many trees are asked otherwise: for what is near single places, a tile or the sides of a box, or the nearest
# alone; or about what was looked at by `overlapping` when its region was built.
APART = {
    "geometry/pairs.py": 1,
    **dict.fromkeys(("osm/read.py", "osm/mapped.py", "osm/synthetic/sketch.py", "regions/build.py"), 1),
    **dict.fromkeys(("ageing/compare.py", "sasgeo/nodes.py", "tasks/duplicates.py"), 1),
    **{f"tasks/suites/{name}.py": 1 for name in ("twins", "vectors", "ages", "mining")},
}


def test_one_shape_drawn_many_times_is_refused_with_a_count_and_many_that_overlap_few_are_not(monkeypatch):
    monkeypatch.setattr(pairs, "MOST_PAIRS", 1000)
    monkeypatch.setattr(pairs, "_AT_ONCE", 3000)  # several steps
    same = np.full(60, shapely.box(0, 0, 9, 9))
    row = shapely.box(np.arange(600) * 8.0, 0, np.arange(600) * 8.0 + 9, 9)
    for find in (touching_pairs, lambda given: groups_within(given, 1.0), lambda given: overlapping(given, given)):
        with pytest.raises(ShapeError, match=r"more than 3000 pairs of 60 and 60 shapes overlap.*drawn many times"):
            find(same)
        find(row)
    assert touching_pairs(row).tolist() == [[at, at + 1] for at in range(599)]
    both = overlapping(row, row[::2], predicate="intersects")
    assert sorted(both.T.tolist()) == np.argwhere(abs(np.arange(600)[:, None] - np.arange(0, 600, 2)) < 2).tolist()


def test_memory_for_shapes_that_overlap_grows_with_their_number_alone():
    same = np.full(20_000, shapely.box(0, 0, 9, 9))
    tracemalloc.start()
    with pytest.raises(ShapeError, match="more than 5000000 pairs of 20000 and 20000 shapes"):
        touching_pairs(same)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000_000  # all pairs of them would take 6.4 GB
    tracemalloc.stop()


def test_ends_of_ways_and_probes_in_many_areas_are_refused_too(monkeypatch):
    monkeypatch.setattr(pairs, "MOST_PAIRS", 1000)
    same, box = np.full(60, shapely.box(0, 0, 1e5, 1e5)), shapely.box(0, 0, 1e5, 1e5)
    lines = np.full(30, shapely.LineString([(2e4, 2e4), (5e4, 5e4)]))
    ends = np.concatenate([shapely.get_point(lines, at) for at in (0, -1)])
    nothing = shapely.Polygon()
    for find in (
        lambda: read._ends_inside(lines, ends, same, area=nothing, box=box),
        lambda: read._filled_share(same, nothing, box, nothing),
    ):
        with pytest.raises(ShapeError, match="shapes overlap: is one thing drawn many times"):
            find()


def test_all_others_that_pair_shapes_of_a_map_do_it_by_the_bounded_way():
    texts = {path.relative_to(CODE).as_posix(): path.read_text() for path in CODE.rglob("*.py")}
    assert {name: text.count("STRtree(") for name, text in texts.items() if "STRtree(" in text} == APART
