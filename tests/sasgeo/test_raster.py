# SPDX-License-Identifier: Apache-2.0
"""A map and a view in the linear form: what is read, what is left out, and the parts that make up a score."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from affine import Affine
from rasterio.features import rasterize

from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.sasgeo.raster import (
    REPEATED,
    RasterView,
    burnt,
    likeness_by_hand,
    line_width_m,
    read_field,
    store_field,
    with_unknown_margins,
)
from sasgeo_bench.sasgeo.rates import hand_rates
from sasgeo_bench.sasgeo.weights import STRATA, even_gains, likelihood_gains
from sasgeo_bench.search import stored
from sasgeo_bench.search.field import FULL
from sasgeo_bench.search.find import score_at, search
from sasgeo_bench.tasks.vectors import vector_table


def gains_of(region):
    shares = zip(region.classes, (region.layers == PRESENT).mean(axis=(1, 2)), strict=True)
    return likelihood_gains([replace(hand_rates(name), mapped=share) for name, share in shares], age_years=0.0)


def test_a_map_is_read_in_larger_cells_and_lines_fade(tiny, field):
    assert field.grid.cell_size_m == 2.0
    assert field.known.min() == FULL
    road, house = (tiny.region.classes.index(name) for name in ("road_minor", "building"))
    assert np.mean((field.layers[road] > 0) & (field.layers[road] < FULL)) > 0
    plain = read_field(tiny.region, np.eye(1, 5).repeat(len(tiny.region.classes), axis=0))
    assert (field.layers[house] == plain.layers[house]).all()
    assert (field.layers[road] >= plain.layers[road]).all()


def test_the_parts_by_class_make_up_the_score_levelled_or_not(tiny, field, asked):
    for query, pose in asked[:4]:
        plain = RasterView.of(query.evidence, tiny.region.classes, gains_of(tiny.region))
        for view in (plain, plain.levelled()):
            whole = score_at(field, view.template(), pose)
            assert view.by_class(field, [pose]).sum() == pytest.approx(whole, rel=1e-3, abs=1.0)


def test_noise_free_views_are_found_on_a_town(tiny, field):
    pairs = zip(tiny.queries, tiny.truths, strict=True)
    whole = [(query, truth.pose) for query, truth in pairs if truth.kind in {"control", "no error"} and truth.pose]
    whole = [(query, pose) for query, pose in whole if query.track == "localization" and query.evidence.shape[0] >= 192]
    assert len(whole) >= 3
    for query, pose in whole:
        seen = with_unknown_margins(query.evidence)
        view = RasterView.of(seen, tiny.region.classes, even_gains(np.ones(len(tiny.region.classes))))
        best = search(field, view.template(), query.prior).modes[0].pose
        assert (
            np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m) < 3.0
        )  # fields: scale and place trade


def test_a_line_of_the_map_beside_a_seen_one_is_no_miss():
    row = np.zeros((2, 1, 30), dtype=np.uint8)
    row[:, 0, 10] = PRESENT
    open_ = with_unknown_margins(Evidence(classes=("railway", "building"), cells=row, cell_size_m=1.0))
    assert np.flatnonzero(open_.layer("railway")[0] == UNKNOWN).tolist() == [*range(2, 10), *range(11, 19)]
    assert (open_.layer("building") == row[1]).all()


def test_classes_that_one_side_lacks_are_left_out(tiny, asked):
    query, _ = asked[0]
    seen = query.evidence
    gains = gains_of(tiny.region)
    fewer = Evidence(classes=seen.classes[:3], cells=seen.cells[:3].copy(), cell_size_m=seen.cell_size_m)
    view = RasterView.of(fewer, tiny.region.classes, gains)
    assert set(np.flatnonzero(view.weights.any(axis=(1, 2)))) <= {0, 1, 2}
    strange = Evidence(classes=("lava", *seen.classes[1:]), cells=seen.cells.copy(), cell_size_m=seen.cell_size_m)
    assert not RasterView.of(strange, tiny.region.classes, gains).weights[0].any()


def test_exponents_scale_each_class(tiny, field, asked):
    query, pose = asked[0]
    view = RasterView.of(query.evidence, tiny.region.classes, gains_of(tiny.region))
    scaling = np.linspace(0.1, 1.0, len(tiny.region.classes))
    parts = view.scaled(scaling).by_class(field, [pose])
    assert parts == pytest.approx(view.by_class(field, [pose]) * scaling, rel=1e-4, abs=1e-3)


def raster_view(weights, known):
    return RasterView(weights=np.float32(weights)[None], known=np.float32(known)[None], cell_size_m=1.0)


def test_levelled_where_a_class_lies_counts_and_unknown_cells_and_a_class_everywhere_say_nothing():
    cells = np.zeros((120, 120))
    cells[40:60, 30:90] = 2.0
    unknown = np.zeros_like(cells, dtype=bool)
    unknown[:, 100:] = True
    gains = np.where(unknown, 0.0, np.where(cells > 0, 2.0, -0.5))
    level = raster_view(gains, np.where(unknown, 0.0, 0.25)).levelled()
    assert not level.weights[0][unknown].any()
    assert not level.known[0][unknown].any()
    assert level.weights[0][(cells > 0) & ~unknown].min() > 0.5  # the rectangle stands out from the ground around it
    assert level.weights[0][(cells == 0) & ~unknown].max() < 0
    wide = raster_view(gains[:, :100], np.full((120, 100), 0.25)).levelled()  # what is unknown moves no mean by much
    assert np.abs(wide.weights[0] - level.weights[0][:, :100]).max() < 0.1
    level = raster_view(np.full((60, 80), 3.0), np.full((60, 80), -1.0)).levelled()
    assert np.abs(level.weights).max() < 1e-5
    assert np.abs(level.known).max() < 1e-5


def test_damped_much_of_a_class_says_little_more_than_some_whatever_the_size_of_the_cells():
    few, many = (raster_view(np.full((side, side), 1.0), np.full((side, side), -0.5)) for side in (10, 1000))
    few, many = (view.damped() for view in (few, many))
    share = few.known.sum() / few.weights.sum(), many.known.sum() / many.weights.sum()
    assert share == pytest.approx((-0.5, -0.5))
    assert few.weights.sum() == pytest.approx(100, rel=0.04)
    assert many.weights.sum() == pytest.approx(REPEATED, rel=0.04)
    coarse = replace(raster_view(np.full((500, 500), 4.0), np.zeros((500, 500))), cell_size_m=2.0)
    assert coarse.damped().weights.sum() == pytest.approx(many.weights.sum(), rel=1e-4)


# Vectors burnt as a view

VECTORS = vector_table(
    [
        ("railway", 0, False, shapely.LineString([(-9, -7), (3, 2), (9, 2)])),
        ("building", 0, False, shapely.Point(1, -3).buffer(4).difference(shapely.Point(1, -3).buffer(1.5))),
    ]
)
BLANK = Evidence(classes=("water", "building", "railway"), cells=np.zeros((3, 20, 20), dtype=np.uint8), cell_size_m=1.0)


def test_vectors_are_burnt_by_the_rule_of_gdal_with_the_width_of_their_class():
    drawn = burnt(VECTORS, BLANK)
    assert drawn.classes == ("building", "railway")
    line, house = VECTORS.geometry
    shapes = {"railway": line.buffer(line_width_m("railway") / 2, quad_segs=2), "building": house}
    for name, shape in shapes.items():
        cells = rasterize([shape], out_shape=(20, 20), transform=Affine(1, 0, -10, 0, -1, 10))
        assert (drawn.layer(name) == cells).all()


def test_burnt_vectors_say_nothing_where_the_view_is_unknown_or_lacks_their_class():
    cells = BLANK.cells.copy()
    cells[2, :, 10:] = UNKNOWN
    drawn = burnt(VECTORS, BLANK.replace(cells))
    assert (drawn.layer("railway")[:, 10:] == UNKNOWN).all()
    assert (drawn.layer("railway")[:, :10] != UNKNOWN).all()
    water = Evidence(classes=("water",), cells=BLANK.cells[:1].copy(), cell_size_m=1.0)
    assert burnt(VECTORS, water) is None
    assert burnt(vector_table([]), BLANK) is None


def test_a_perceived_river_is_no_line_where_the_view_shows_water():
    cells = np.zeros((2, 20, 20), dtype=np.uint8)
    cells[0, :, 12:] = PRESENT
    view = Evidence(classes=("water", "waterway"), cells=cells, cell_size_m=1.0)
    river = burnt(vector_table([("waterway", 0, False, shapely.LineString([(-10, 0), (10, 0)]))]), view)
    assert river.classes == ("waterway",)
    assert np.flatnonzero((river.cells[0] == PRESENT).any(axis=0)).tolist() == [*range(12)]


def test_lines_say_whether_they_are_on_a_bridge_where_the_view_does_not():
    lines = [shapely.LineString([(-9, 0), (9, 0)]), shapely.LineString([(0, -9), (0, 9)])]
    cells = np.stack([np.zeros((20, 20), dtype=np.uint8), np.full((20, 20), UNKNOWN, dtype=np.uint8)])
    view = Evidence(classes=("road_minor", "bridge"), cells=cells, cell_size_m=1.0)
    level, over = (
        burnt(vector_table([("road_minor", 0, False, lines[0]), ("road_minor", up, up > 0, lines[1])]), view)
        for up in (0, 1)
    )
    roads = level.layer("road_minor") == PRESENT
    assert (over.layer("road_minor") == level.layer("road_minor")).all()
    assert (level.layer("bridge") == np.where(roads, ABSENT, UNKNOWN)).all()
    assert (over.layer("bridge") == PRESENT).sum() > 50
    assert (over.layer("bridge")[~roads] == UNKNOWN).all()
    assert (over.layer("bridge")[9:11, 1:5] == ABSENT).all()  # the road below it


def test_a_view_beside_itself_weighs_as_much_as_alone(tiny, asked):
    query, _ = asked[0]
    view = RasterView.of(query.evidence, tiny.region.classes, gains_of(tiny.region))
    both = np.ones(len(tiny.region.classes), dtype=bool)
    assert (view.halved_with(view, both).weights == view.weights).all()
    assert (view.halved_with(view, both).known == view.known).all()
    other = replace(view, weights=np.zeros_like(view.weights), known=np.zeros_like(view.known))
    alone = view.halved_with(other, np.arange(len(both)) == 0)
    assert (alone.weights[0] == view.weights[0] / 2).all()
    assert (alone.weights[1:] == view.weights[1:]).all()


@pytest.mark.parametrize("is_stamped", [False, True])
def test_a_map_on_disk_is_the_one_read_into_memory(tiny, tmp_path, monkeypatch, is_stamped):
    monkeypatch.setattr(stored, "WINDOW_CELLS", 192)
    near = likeness_by_hand(tiny.region.classes)
    trust = np.linspace(0.2, 1.0, len(near) * STRATA).reshape(len(near), STRATA) if is_stamped else None
    whole = read_field(tiny.region, near, trust=trust)
    found = store_field(tiny.folder / "regions" / tiny.region.manifest.id, tmp_path / "map", near, trust=trust)
    assert found.grid == whole.grid
    assert found.grid.rows > 2 * 192
    for factor in (1, 16):
        np.testing.assert_array_equal(found.level(factor).cells.fours, whole.level(factor).cells.fours)
    again = store_field(tiny.folder / "regions" / tiny.region.manifest.id, tmp_path / "map", near, trust=trust)
    assert again == found
