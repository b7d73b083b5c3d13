# SPDX-License-Identifier: Apache-2.0
"""The preview: a PNG that shows the map, its colours, and what is not mapped."""

import numpy as np
import pytest
import shapely
from matplotlib import image
from matplotlib.colors import to_rgb

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import preview
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.layers import OUTSIDE, PRESENT
from sasgeo_bench.regions.painting import GROUND, HIDDEN, paint_evidence
from sasgeo_bench.regions.preview import write_preview
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    spec = read_region_file(find_region_file("town-suburb"))
    plan = plan_build(spec, out=tmp_path_factory.mktemp("out"))
    return build_region(plan)


def drawn(tmp_path, manifest, overview):
    path = tmp_path / "preview.png"
    write_preview(path, manifest=manifest, overview=overview)
    return (image.imread(path)[..., :3] * 255).round().astype(int)


def shares(picture, colour):
    wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    return float((np.abs(picture - wanted).max(axis=2) <= 2).mean())


def test_a_class_that_fills_the_map_fills_the_picture_with_its_colour(tmp_path, manifest):
    taxonomy = load_taxonomy()
    overview = np.zeros((len(taxonomy.names), 300, 300), dtype=np.uint8)
    before = shares(drawn(tmp_path, manifest, overview), taxonomy["water"].colour)
    overview[taxonomy["water"].id] = PRESENT
    after = shares(drawn(tmp_path, manifest, overview), taxonomy["water"].colour)
    assert before < 0.02
    assert after > 0.4


def test_what_is_not_mapped_does_not_look_like_empty_land(tmp_path, manifest):
    empty = np.zeros((len(load_taxonomy().names), 300, 300), dtype=np.uint8)
    land = drawn(tmp_path, manifest, empty)
    beyond = drawn(tmp_path, manifest, np.full_like(empty, OUTSIDE))
    assert (land != beyond).any(axis=2).mean() > 0.4


@pytest.mark.parametrize("shape", [(40, 900), (900, 40), (8, 8)])
def test_narrow_and_tiny_regions_are_drawn_too(tmp_path, manifest, shape):
    picture = drawn(tmp_path, manifest, np.zeros((len(load_taxonomy().names), *shape), dtype=np.uint8))
    assert min(picture.shape[:2]) > 200


def test_a_map_of_more_cells_than_pixels_is_averaged_and_a_part_of_it_is_drawn_too(tmp_path, manifest):
    taxonomy, (west, south, *_) = load_taxonomy(), manifest.bounds_m
    bounds = {"bounds_m": (west, south, west + 1500, south + 1500), "rows": 1500, "cols": 1500, "cell_size_m": 1.0}
    manifest = manifest.model_copy(update=bounds)
    overview = np.zeros((len(taxonomy.names), 1500, 1500), dtype=np.uint8)
    overview[taxonomy["water"].id, :, :750] = PRESENT
    picture = drawn(tmp_path, manifest, overview)
    water, ground = (shares(picture, colour) for colour in (taxonomy["water"].colour, GROUND))
    assert abs(water - ground) < 0.002  # the legend has a key of each class
    figure = preview._drawn(manifest, overview)
    figure.axes[0].set(xlim=(west, west + 10), ylim=(south, south + 10))
    figure.savefig(tmp_path / "part.png")
    part = (image.imread(tmp_path / "part.png")[..., :3] * 255).round().astype(int)
    assert shares(part, taxonomy["water"].colour) > 0.4


def test_the_axes_are_those_of_the_crs(manifest):
    empty = np.zeros((len(manifest.classes), manifest.rows, manifest.cols), np.uint8)
    chart = preview._drawn(manifest, empty).axes[0]
    west, south, east, north = manifest.bounds_m
    assert (chart.get_xlim(), chart.get_ylim()) == ((west, east), (south, north))
    assert chart.images[0].get_extent() == (west, east, south, north)
    assert f"EPSG:{manifest.epsg}" in chart.get_xlabel()
    chart.figure.canvas.draw()
    ticks = {label.get_text(): at for label, at in zip(chart.get_xticklabels(), chart.get_xticks(), strict=True)}
    assert all(float(text) == at for text, at in ticks.items())  # whole coordinates, no offset
    assert sum(west <= at <= east for at in ticks.values()) >= 2


def test_the_edge_of_what_is_mapped_is_drawn_and_nothing_covers_the_map(tmp_path, manifest):
    west, south, east, north = manifest.bounds_m
    empty = np.zeros((len(load_taxonomy().names), 300, 300), dtype=np.uint8)
    whole = drawn(tmp_path, manifest, empty)
    half = shapely.box(west, south, (west + east) / 2, north)
    coverage = manifest.coverage.model_copy(update={"wkt": shapely.to_wkt(half), "share": 0.5})
    parted = drawn(tmp_path, manifest.model_copy(update={"coverage": coverage}), empty)
    # Within the map every pixel has the colour of the ground: no arrow, scale or box lies on it.
    ground = np.abs(whole - whole[whole.shape[0] // 2, 200]).max(axis=2) <= 2
    rows, cols = np.flatnonzero(ground.mean(axis=1) > 0.5), np.flatnonzero(ground.mean(axis=0) > 0.5)
    inside = np.s_[rows[5] : rows[-5], cols[5] : cols[-5]]
    assert ground[inside].all()
    edge = np.abs(parted - whole).max(axis=2)[inside] > 60
    assert edge.any(axis=1).all()
    assert 1 <= edge.any(axis=0).sum() <= 5


def test_a_view_is_painted_in_the_colours_of_its_classes():
    colours = {item.name: to_rgb(item.colour) for item in load_taxonomy().classes}
    cells = np.array([[[1, 0, UNKNOWN]], [[0, 0, UNKNOWN]]], dtype=np.uint8)
    picture = paint_evidence(Evidence(classes=("road_major", "building"), cells=cells, cell_size_m=1.0))
    assert picture.shape == (1, 3, 3)
    np.testing.assert_allclose(picture[0], [colours["road_major"], to_rgb(GROUND), to_rgb(HIDDEN)])
