# SPDX-License-Identifier: Apache-2.0
"""Scenes are told by shares of the mapped ground, each by a threshold of its own."""

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely

from sasgeo_bench.osm.locate import find_extract
from sasgeo_bench.regions import scenes
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.regions.scenes import Ground, measure_ground, share_ground

NOTHING = Ground(built=0.0, fields=0.0, water=0.0, industry=0.0, wood=0.0, bare=0.0, drawn=1.0, is_coast=False)
HECTARE = shapely.box(0, 0, 1600, 1600)


def features(*rows):
    """Return features, each given as class and shape, and perhaps a width."""
    table = {"class": [row[0] for row in rows], "width_m": [row[2] if len(row) > 2 else np.nan for row in rows]}
    return gpd.GeoDataFrame(table | {"osm_type": "way", "is_visible": True}, geometry=[row[1] for row in rows])


@pytest.mark.parametrize(
    ("share", "least", "scene"),
    [
        ("built", scenes.URBAN, "urban"),
        ("built", scenes.SUBURBAN, "suburban"),
        ("fields", scenes.FIELDS, "agricultural"),
        ("water", scenes.WATER, "riverside"),
        ("water", scenes.SHORE, "shore"),
        ("industry", scenes.INDUSTRY, "industrial"),
        ("wood", scenes.WOOD, "forest"),
        ("bare", scenes.BARE, "desert"),
    ],
)
def test_a_scene_begins_at_its_threshold(share, least, scene):
    assert scene in replace(NOTHING, **{share: least}).scenes()
    assert scene not in replace(NOTHING, **{share: least - 1e-9}).scenes()


def test_ground_without_features_is_sparse_and_rural_and_a_built_shore_is_no_shore():
    assert replace(NOTHING, drawn=scenes.SPARSE - 1e-9).scenes() == ["rural", "sparse"]
    assert replace(NOTHING, drawn=scenes.SPARSE).scenes() == ["rural"]
    assert "shore" not in replace(NOTHING, water=0.5, built=scenes.SUBURBAN).scenes()
    assert replace(NOTHING, water=0.5, is_coast=True).scenes() == ["rural", "coastal", "shore"]


def test_areas_that_overlap_count_once_and_what_lies_beyond_the_map_or_is_hidden_does_not():
    half = shapely.box(0, 0, 800, 1600)
    table = features(("farmland", half), ("farmland", half), ("farmland", shapely.box(1600, 0, 9000, 9000)))
    assert share_ground(table, HECTARE).fields == pytest.approx(0.5)
    assert share_ground(table.assign(is_visible=False), HECTARE).drawn == 0.0


def test_a_line_covers_its_width_and_land_counts_by_its_kind():
    road = ("road_minor", shapely.LineString([(0, 800), (1600, 800)]), 160.0)
    land = {"industry": np.array([shapely.box(0, 0, 400, 1600)])}
    ground = share_ground(features(road), HECTARE, land=land)
    assert ground.drawn == pytest.approx(0.1)
    assert (ground.industry, ground.wood) == (pytest.approx(0.25), 0.0)


@pytest.mark.real
@pytest.mark.parametrize("name", ["oakland", "malbun", "cayococo", "nzoo"])
def test_a_shipped_region_has_the_scenes_that_are_measured(name, real_extracts):
    region = read_region_file(list_region_files()[name])
    extract = region.pick(None)
    path = find_extract(extract, folders=[real_extracts])
    assert region.scenes == measure_ground(path, region.grid(), at=extract.date).scenes()
