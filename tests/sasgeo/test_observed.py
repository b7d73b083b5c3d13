# SPDX-License-Identifier: Apache-2.0
"""The graph of a view: from vectors, from masks, and what unknown ground and the border make of it."""

import numpy as np
import pytest
import shapely

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.sasgeo.nodes import INDEX, NODE_KINDS
from sasgeo_bench.sasgeo.observed import ObservedGraph, bridged, lines_of_mask, middle_lines
from sasgeo_bench.tasks.vectors import vector_table

CLASSES = ("road_minor", "railway", "waterway", "building", "water")


def view(**boxes):
    """A view of 120 m with boxes (top, bottom, left, right) of cells present."""
    cells = np.zeros((len(CLASSES), 120, 120), dtype=np.uint8)
    for name, several in boxes.items():
        for top, bottom, left, right in several:
            cells[CLASSES.index(name), top:bottom, left:right] = PRESENT
    return Evidence(classes=CLASSES, cells=cells, cell_size_m=1.0)


def found(graph):
    """Names and rounded places of the nodes."""
    places = graph.nodes.places_m.round().astype(int).tolist()
    return sorted((NODE_KINDS[kind].name, *place) for kind, place in zip(graph.nodes.kind, places, strict=True))


FORK = {"road_minor": [(57, 63, 0, 120), (0, 60, 77, 83)]}


def test_a_fork_in_a_mask_is_one_node_with_three_arms():
    graph = ObservedGraph.make(view(**FORK))
    [(name, right_m, up_m)] = found(graph)
    assert name == "mask intersection"
    assert np.hypot(right_m - 20, up_m - 0) <= 3
    arms = np.sort(graph.nodes.arms_deg[0][:3])
    assert arms == pytest.approx([0, 90, 270], abs=15) or arms == pytest.approx([90, 270, 360], abs=15)


def test_a_road_that_ends_in_the_view_is_an_end_but_not_at_unknown_ground_or_the_border():
    ending = view(road_minor=[(57, 63, 0, 70)])
    assert [name for name, *_ in found(ObservedGraph.make(ending))] == ["mask dead_end"]
    cells = ending.cells.copy()
    cells[:, :, 64:] = UNKNOWN
    assert found(ObservedGraph.make(ending.replace(cells))) == []
    assert found(ObservedGraph.make(view(road_minor=[(57, 63, 0, 120)]))) == []


def test_crossings_of_classes_and_patches_come_from_masks():
    graph = ObservedGraph.make(
        view(road_minor=[(57, 63, 0, 120)], waterway=[(0, 120, 30, 33)], building=[(80, 92, 70, 90)])
    )
    names = [name for name, *_ in found(graph)]
    assert names == ["building patch", "mask water crossing"]
    assert np.nanmax(graph.nodes.area_m2) == 240


def test_a_patch_that_the_border_cuts_is_marked():
    graph = ObservedGraph.make(view(building=[(0, 12, 40, 60), (50, 60, 40, 60)]))
    assert sorted(zip(graph.nodes.places_m[:, 1].tolist(), graph.is_cut.tolist(), strict=True)) == [
        (5.0, False),
        (54.0, True),
    ]


def test_each_family_is_taken_from_the_vectors_if_they_hold_it_and_else_from_the_mask():
    house = vector_table([("building", 0, False, shapely.box(0, 0, 10, 10))])
    graph = ObservedGraph.make(view(building=[(80, 92, 70, 90)], **FORK), house)
    assert [name for name, *_ in found(graph)] == ["building", "mask intersection"]
    assert graph.asked[INDEX["building"]]
    assert not graph.asked[INDEX["building patch"]]
    assert not graph.asked[INDEX["intersection"]]


def test_vectors_tell_a_bridge_from_a_junction():
    over, under = shapely.from_wkt(["LINESTRING (-58 0, 58 0)", "LINESTRING (0 -58, 0 58)"])
    at_grade = shapely.from_wkt(["LINESTRING (-58 0, 0 0, 58 0)", "LINESTRING (0 -58, 0 0, 0 58)"])
    bridge = vector_table([("road_minor", 1, True, over), ("road_minor", 0, False, under)])
    junction = vector_table([("road_minor", 0, False, shape) for shape in at_grade])
    assert found(ObservedGraph.make(view(), bridge)) == [("crossing", 0, 0)]
    assert found(ObservedGraph.make(view(), junction)) == [("intersection", 0, 0)]


def test_short_gaps_of_a_detector_are_closed_and_longer_ones_are_not():
    def halves(gap_m):
        wkt = [f"LINESTRING (-58 0, {-gap_m / 2} 0)", f"LINESTRING ({gap_m / 2} 0, 58 0)"]
        return vector_table([("road_minor", 0, False, shape) for shape in shapely.from_wkt(wkt)])

    assert len(bridged(halves(6.0))) == 3
    assert len(bridged(halves(9.0))) == 2
    assert found(ObservedGraph.make(view(), halves(6.0))) == []
    assert [name for name, *_ in found(ObservedGraph.make(view(), halves(9.0)))] == ["dead_end", "dead_end"]


def test_an_empty_or_unknown_view_has_no_nodes_and_no_lines():
    assert len(ObservedGraph.make(view()).nodes) == 0
    blind = view(**FORK)
    assert len(ObservedGraph.make(blind.replace(np.full_like(blind.cells, UNKNOWN))).nodes) == 0
    assert len(middle_lines(np.zeros((9, 9), dtype=bool), 1.0)) == len(lines_of_mask(view())) == 0


# Thinned masks


def test_a_mask_is_thinned_to_its_middle_line_and_a_crossroads_to_four_without_a_spur():
    [line] = middle_lines(view(road_minor=[(57, 63, 0, 120)]).layer("road_minor") == PRESENT, 1.0)
    assert line.length == pytest.approx(120, abs=8)
    assert np.abs(shapely.get_coordinates(line)[:, 1]).max() <= 1.5
    cross = view(road_minor=[(57, 63, 0, 120), (0, 120, 57, 63)])
    lines = lines_of_mask(cross)
    assert sorted(shapely.length(lines.geometry.to_numpy()).round(-1).tolist())[-4:] == [60.0] * 4
    assert len(lines) <= 5  # where the middle lines meet in two forks there is a short piece between
