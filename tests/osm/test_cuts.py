# SPDX-License-Identifier: Apache-2.0
"""Extracts cut out of larger ones: where their ways lack nodes the ground is unknown, and the build says so."""

import datetime as dt
import hashlib

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.progress import reporting
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.coverage import LONGEST_M, ground_within_reach
from sasgeo_bench.osm.mapped import CUT
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.layers import OUTSIDE
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import RegionFile, find_region_file, read_region_file

FRAME = shapely.box(0, 0, 2000, 2000)
GRID = Grid(epsg=32632, west_m=499_700.0, north_m=5_205_450.0, cell_size_m=2.0, rows=300, cols=300)


def reach(*gaps):
    return ground_within_reach(np.array(gaps, dtype=object), FRAME)


@given(st.floats(1, 1999), st.floats(1, 1999))
def test_a_way_that_leaves_straight_to_the_nearest_edge_runs_over_unknown_ground(x, y):
    tip = shapely.Point(x, y)
    way_out = shapely.shortest_line(tip, shapely.boundary(FRAME))
    known = shapely.difference(way_out, shapely.buffer(reach(tip), 0.5))
    assert known.length == pytest.approx(max(way_out.length - LONGEST_M - 0.5, 0), abs=0.5)


def test_between_the_gap_of_a_closed_way_and_the_edge_all_is_unknown_and_a_node_on_it_makes_nothing_so():
    along = reach(shapely.LineString([(10, 500), (10, 900)]))
    assert along.contains(shapely.box(1, 510, 9, 890))
    assert not shapely.contains_xy(along, 30, 700)
    corner = reach(shapely.LineString([(5, 1700), (400, 1995)]))
    assert shapely.contains_xy(corner, 5, 1995)
    assert not shapely.contains_xy(corner, 300, 1700)
    assert reach(shapely.Point(0, 500)).is_empty
    assert reach(shapely.Point(-30, 500)).is_empty


def cut_file(tmp_path, *, nodes_kept=True):
    """Forty streets across a town; the header's box ends between their last two nodes, and two have no node at all."""
    rows = [(-280 + 14 * number, number) for number in range(40)]
    nodes, ways = [], []
    for y, number in rows:
        for step in range(12):
            x = -280 + 50 * step
            if nodes_kept or x < 260:
                nodes.append(
                    f'<node id="{number * 20 + step + 1}" lat="{47 + y / 111_175:.7f}" lon="{9 + x / 76_030:.7f}"/>'
                )
        refs = "".join(f'<nd ref="{number * 20 + step + 1}"/>' for step in range(12))
        ways.append(f'<way id="{number + 1}">{refs}<tag k="highway" v="residential"/></way>')
    ways += [
        f'<way id="{90 + k}"><nd ref="{9000 + k}"/><nd ref="{9100 + k}"/><tag k="highway" v="path"/></way>'
        for k in (0, 1)
    ]
    up, right = 285 / 111_175, 1 / 76_030
    box = f"minlat='{47 - up}' minlon='{9 - 285 * right}' maxlat='{47 + up}' maxlon='{9 + 260 * right}'"
    path = tmp_path / "cut.osm"
    path.write_text(f"<osm version='0.6'><bounds {box}/>" + "\n".join(nodes + ways) + "</osm>")
    return path


def test_a_town_cut_out_of_a_larger_extract_is_unknown_where_its_streets_were_cut_and_a_whole_one_nowhere(tmp_path):
    reading = read_extract(cut_file(tmp_path, nodes_kept=False), GRID)
    assert reading.coverage_source == "header box"
    assert reading.cuts == {"ways that lack some nodes": 40, "ways that lack all nodes": 2}
    # The last node of each street stands 40 m from the edge: 80 m of ground over 560 m of streets, and the round ends.
    assert reading.unknown_m2[CUT] == pytest.approx(80 * 40 * 14, rel=0.2)
    assert not shapely.contains_xy(reading.coverage, 500_240, 5_205_164)
    assert shapely.contains_xy(reading.coverage, 500_100, 5_205_164)
    reading = read_extract(cut_file(tmp_path), GRID)
    assert CUT not in reading.unknown_m2
    assert "ways that lack some nodes" not in reading.cuts


def test_the_build_says_in_a_line_what_is_unknown_and_the_region_holds_it(tmp_path):
    path = cut_file(tmp_path, nodes_kept=False)
    extract = {
        "file": path.name,
        "date": dt.date(2020, 1, 1),
        "sha256": [hashlib.sha256(path.read_bytes()).hexdigest()],
    }
    text = {"id": "cut", "title": "Cut", "scenes": ["urban"], "center_lonlat": (9.0, 47.0), "size_m": (512, 512)}
    spec = RegionFile(**text, cell_size_m=1.0, extract=[extract])
    plan = plan_build(spec, out=tmp_path / "out", extract_folders=[tmp_path])
    lines = []
    with reporting(lines.append):
        manifest = build_region(plan)
    (line,) = [line for line in lines if "mapped" in line]
    assert "(header box)" in line
    assert "ways that lack some nodes 40, ways that lack all nodes 2" in line
    assert f"{manifest.coverage.unknown_m2[CUT]:,.0f} m2 unknown {CUT}" in line
    outside = read_region(plan.folder).layers[0] == OUTSIDE
    assert outside.sum() == pytest.approx(manifest.coverage.unknown_m2[CUT], rel=0.02)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "cut", "most"),
    [("helsinki", 407, 0.1), ("lauf", 170, 0.12), pytest.param("prague-west", 535, 0.1, marks=pytest.mark.slow)],
)
def test_real_extracts_that_were_cut_lose_a_rim_of_their_box(name, cut, most, real_extracts, tmp_path):
    spec = read_region_file(find_region_file(name))
    plan = plan_build(spec, out=tmp_path, extract_folders=[real_extracts])
    reading = read_extract(plan.source, spec.grid())
    assert reading.coverage_source == "header box"
    assert reading.cuts["ways that lack some nodes"] == cut
    assert 0 < reading.unknown_m2[CUT] < most * spec.grid().rows * spec.grid().cols * spec.grid().cell_size_m ** 2
