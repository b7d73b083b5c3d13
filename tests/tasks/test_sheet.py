# SPDX-License-Identifier: Apache-2.0
"""Contact sheets and maps of splits: the colours say what they must, the pictures have the size they should."""

import datetime as dt
from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

from sasgeo_bench.core.canvas import DPI
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.painting import GROUND, HIDDEN
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.tasks.query import TRUTH_SIGMA, Query, Truth
from sasgeo_bench.tasks.sheet import (
    AGREE,
    DECOY,
    ONLY_MAPPED,
    ONLY_SEEN,
    TWIN,
    Panel,
    paint_difference,
    settled,
    sheet_figure,
    write_sheet,
)
from sasgeo_bench.tasks.split import find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.split_map import COLOURS, colour_of, write_split_map
from sasgeo_bench.tasks.vectors import vector_table

CLASSES = ("road_major", "building")
cells = arrays(np.uint8, (2, 4, 5), elements=st.integers(0, 2))


def sight(values, classes=CLASSES):
    return Evidence(classes=classes, cells=np.array(values, dtype=np.uint8), cell_size_m=1.0)


def panel(*, has_map=True, has_vectors=False, **changes):
    seen = sight(np.eye(6, dtype=np.uint8)[None].repeat(2, axis=0))
    house = ("building", 0, False, shapely.Polygon([(0, 0), (2, 0), (2, 2)]))
    bridge = ("road_major", 1, True, shapely.LineString([(-3, 0), (3, 0)]))
    query = Query(
        query_id="0123456789abcdef",
        track="localization",
        suite="clean",
        suite_version=1,
        part="test",
        region="here",
        evidence=seen,
        observed_on=dt.date(2025, 1, 1),
        season="",
        prior=Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.1),
        prior_group="rnone-unknown-s10",
        vectors=vector_table([house, bridge]) if has_vectors else None,
    )
    truth = {
        "query_id": query.query_id,
        "is_present": True,
        "pose": Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0),
        "candidate": -1,
        "pair_id": "p",
        "role": "control",
        "kind": "control",
        "strength": 0.0,
        "strength_unit": "none",
        "unknown_share": 0.0,
        "changed_share": 0.0,
        "feature_density": 0.1,
        "alias_index": 0.2,
        "block": "here/0-0",
        "scene": "urban",
    }
    mapped = seen if has_map else None
    return Panel(query=query, truth=Truth(**truth | changes), at_truth=mapped, at_decoy=mapped)


@given(cells, cells)
def test_where_view_and_map_agree_does_not_depend_on_which_is_which(one, two):
    there, back = paint_difference(sight(one), sight(two)), paint_difference(sight(two), sight(one))
    for colour in (AGREE, GROUND, HIDDEN):
        shown = [(picture == np.array(to_rgb(colour))).all(axis=2) for picture in (there, back)]
        np.testing.assert_array_equal(*shown)


def test_a_difference_is_shown_class_by_class():
    one, two = sight([[[1, 1, 0, 0, UNKNOWN]]], ("road_major",)), sight([[[1, 0, 1, 0, 1]]], ("road_major",))
    expected = [to_rgb(colour) for colour in (AGREE, ONLY_SEEN, ONLY_MAPPED, GROUND, HIDDEN)]
    np.testing.assert_allclose(paint_difference(one, two)[0], expected)


def test_one_of_two_classes_agrees_with_a_map_of_either_and_with_no_other():
    roads = ("road_major", "road_minor")
    seen = sight([[[1, 1, 1, 0]], [[1, 1, 1, 0]]], roads)
    seen = seen.replace(seen.cells, np.zeros_like(seen.cells))  # as likely as not
    mapped = sight([[[1, 0, 0, 1]], [[0, 1, 0, 0]]], roads)
    expected = [to_rgb(colour) for colour in (AGREE, AGREE, ONLY_SEEN, ONLY_MAPPED)]
    np.testing.assert_allclose(paint_difference(settled(seen, mapped), mapped)[0], expected)
    sure = seen.replace(seen.cells, np.full_like(seen.cells, 254))  # both are there, as a road on another
    np.testing.assert_allclose(paint_difference(settled(sure, mapped), mapped)[0, :3], [to_rgb(ONLY_SEEN)] * 3)


def test_an_own_picture_is_no_control_and_classes_that_nobody_looks_for_hide_nothing():
    seen = sight([[[1, 0]], [[UNKNOWN, UNKNOWN]]], ("building", "water"))
    own = panel(kind="own picture", strength=5.0, strength_unit=TRUTH_SIGMA)
    drawn = sheet_figure("mine", [replace(own, query=replace(own.query, evidence=seen), at_truth=seen)])
    texts = "\n".join(text.get_text() for text in drawn.texts)
    assert "control" not in texts
    assert "place known to 5 m" in texts
    picture = drawn.axes[0].images[0].get_array()
    np.testing.assert_allclose(picture[0, 1], to_rgb(GROUND))


def test_a_moment_is_shown_as_a_date():
    drawn = sheet_figure("mine", [panel(measured={"utc_s": 1718353855.75, "height_m": 120.4})])
    texts = " ".join(text.get_text() for text in drawn.texts).replace("\n", " ")
    assert "utc_s 2024-06-14 08:30:55, height_m 120" in texts


@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("has_vectors", [False, True])
def test_a_sheet_has_a_row_for_each_query_and_a_column_more_for_vectors(rows, has_vectors):
    figure = sheet_figure("Some", [panel(has_vectors=has_vectors)] * rows)
    assert len(figure.axes) == rows * (5 if has_vectors else 4)


def test_the_words_of_a_sheet_are_large_enough_to_read_and_end_before_the_pictures():
    figure = sheet_figure("Some", [panel(measured={"unknown_added": 0.3, "cells_moved_m": 1.25})])
    draw = FigureCanvasAgg(figure).get_renderer()
    words = next(text for text in figure.texts if text.get_text().startswith("control"))
    assert words.get_fontsize() >= 10
    assert words.get_window_extent(draw).x1 < min(chart.get_window_extent(draw).x0 for chart in figure.axes)
    assert words.get_window_extent(draw).y0 > 0


def test_a_sheet_names_what_its_last_map_is_of():
    names = [axes.get_title() for axes in sheet_figure("Some", [replace(panel(), rival=TWIN), panel()]).axes]
    assert names[3] == f"{TWIN} / {DECOY}"
    assert sheet_figure("Some", [panel()]).axes[3].get_title() == DECOY


def test_a_sheet_says_how_old_a_map_is_and_not_how_old_it_was_to_be():
    aged = panel(role="stress", kind="S1", strength=5.0, strength_unit="years", measured={"age_years": 3.58})
    words = " ".join(text.get_text() for text in sheet_figure("Some", [aged]).texts)
    assert "map 3.6 years old (step 5)" in words
    assert "5 (years)" not in words


def test_a_sheet_shows_a_query_without_a_place_and_is_the_same_each_time(tmp_path):
    paths = [tmp_path / name for name in ("one.png", "two.png")]
    for path in paths:
        write_sheet(path, title="Some", panels=[panel(has_map=False, pose=None, is_present=False)])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert b"OpenStreetMap contributors" in paths[0].read_bytes()


@pytest.mark.parametrize("name", ["holdout", "crossfit"])
def test_the_map_of_a_split_has_a_panel_for_each_place_in_the_colours_of_the_parts(name, tmp_path):
    grids = {region: read_region_file(path).grid() for region, path in list_region_files().items()}
    split = make_split(read_split_file(find_split_file(name)), grids)
    write_split_map(tmp_path / "map.png", split)
    picture = cv2.imread(str(tmp_path / "map.png"))[..., ::-1]
    rows = -(-len(split.spec.place) // 6)
    for pixels, count in zip(picture.shape, (rows, 6), strict=False):
        assert DPI * 2.0 * count < pixels < DPI * (2.5 * count + 2.0)
    found = {tuple(pixel) for pixel in picture.reshape(-1, 3)[::7].tolist()}
    parts = {colour_of(split, place) for place in split.blocks}
    for part in parts:
        assert tuple(round(255 * value) for value in to_rgb(COLOURS[part])) in found
