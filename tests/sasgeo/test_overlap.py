# SPDX-License-Identifier: Apache-2.0
"""A view held against the map: what both hold, what only one does, and what the map explains."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence, LayerBits, cell_offsets_m, observe
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.overlap import INDEPENDENT, SEARCHED, UNLIKE_M2, Compared, overlap_of, overlap_weights
from sasgeo_bench.sasgeo.raster import likeness_by_hand, read_field
from sasgeo_bench.sasgeo.reading import Reader
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.search.field import FULL, Field, Template
from sasgeo_bench.search.find import score_at


@pytest.fixture(scope="module")
def widest(asked):
    """The view that shows most, and its place."""
    return max(asked, key=lambda pair: pair[0].evidence.shape)


def faint(query, region, pose, *, noise=0.1):
    """The map under a pose as probabilities that nowhere reach a half, with errors."""
    seen = observe(LayerBits.of(region.layers), region.grid, pose, size_cells=query.evidence.shape[0], cell_size_m=1.0)
    chances = 0.1 + 0.3 * (seen == PRESENT) + np.random.default_rng(1).normal(0, noise, seen.shape)
    chances[seen == UNKNOWN] = np.nan
    return Evidence.of_probabilities(region.classes, chances.clip(0, 1), cell_size_m=1.0)


def test_what_the_map_explains_is_the_correlation_of_its_cells(tiny, field, widest):
    query, pose = widest
    view = faint(query, tiny.region, pose)
    found = Compared.of(view, tiny.region.classes, field, [pose]).explained[0]
    pooled = view.probabilities().reshape(len(view.classes), view.shape[0] // 2, 2, view.shape[1] // 2, 2)
    offsets_m = cell_offsets_m((view.shape[0] // 2, view.shape[1] // 2), 2.0)
    cols, rows = field.grid.to_uv(pose.to_map(offsets_m.reshape(-1, 2))).T - 0.5
    for number, one in enumerate(pooled.mean(axis=(2, 4))):
        under = map_coordinates(field.layers[number].astype(float) / FULL, [rows, cols], order=1)
        of_seen, of_map = (layer - layer.mean() for layer in (one.ravel(), under))
        spreads = (of_seen @ of_seen + 2) * (of_map @ of_map + 2)  # two cells' worth
        by_hand = -INDEPENDENT / 2 * np.log(1 - max(of_seen @ of_map, 0) ** 2 / spreads)
        assert found[number] == pytest.approx(by_hand, rel=0.03, abs=0.01)
    assert (found > 1).sum() > 1


def test_more_that_is_mapped_and_not_seen_explains_less(tiny, field, widest):
    query, pose = widest
    view = faint(query, tiny.region, pose)
    clearest = Compared.of(view, tiny.region.classes, field, [pose]).explained[0].argmax()
    crowded = field.layers
    crowded[clearest, ::3] = FULL
    fields = (field, Field.of(grid=field.grid, layers=crowded, known=field.known))
    before, after = (Compared.of(view, tiny.region.classes, each, [pose]).explained[0, clearest] for each in fields)
    assert after < 0.7 * before


def test_unknown_cells_and_classes_that_the_map_lacks_explain_nothing(tiny, field, widest):
    query, pose = widest
    view = faint(query, tiny.region, pose)
    chances = view.probabilities()
    chances[:, :, view.shape[1] // 2 :] = np.nan
    half = Evidence.of_probabilities(view.classes, chances, cell_size_m=1.0)
    chances[:, :, view.shape[1] // 2 :] = np.random.default_rng(2).random(chances[:, :, view.shape[1] // 2 :].shape)
    noisy = Evidence.of_probabilities(view.classes, chances, cell_size_m=1.0)
    of_half, of_noisy = (
        Compared.of(each, tiny.region.classes, field, [pose]).explained.sum() for each in (half, noisy)
    )
    assert of_half > 1.5 * of_noisy
    none = Evidence.of_probabilities(("tram",), np.full((1, 8, 8), 0.5), cell_size_m=1.0)
    silent = Evidence.of_probabilities(view.classes, np.full(chances.shape, np.nan), cell_size_m=1.0)
    for each in (none, silent):
        assert not Compared.of(each, tiny.region.classes, field, [pose]).explained.any()


def test_by_hand_a_view_and_a_map_that_share_a_third():
    grid = Grid(epsg=0, west_m=-8.0, north_m=8.0, cell_size_m=2.0, rows=8, cols=8)
    mapped, known = np.zeros((1, 8, 8), dtype=np.uint8), np.full((8, 8), FULL, dtype=np.uint8)
    mapped[0, :, 2:6] = FULL
    cells = np.zeros((1, 16, 16), dtype=np.uint8)
    cells[0, :, 8:] = PRESENT
    view = Evidence(classes=("water",), cells=cells, cell_size_m=1.0)
    here = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    found = Compared.of(view, ("green", "water"), Field.of(grid=grid, layers=mapped.repeat(2, 0), known=known), [here])
    assert not found.known[:, 0].any()  # a class that the view lacks
    assert not found.overlaps[:, 0].any()
    areas = (found.known, found.seen, found.mapped, found.both, found.seen_twice, found.mapped_twice)
    assert [one[0, 1] for one in areas] == [256.0, 128.0, 128.0, 64.0, 128.0, 128.0]
    assert found.overlaps[0, 1] == pytest.approx(1 / 3)
    assert found.unlike[0, 1] == 0
    assert found.explained[0, 1] == 0  # as much as by chance
    half = np.where(known, np.arange(8) < 4, 0).astype(np.uint8) * np.uint8(FULL)
    less = Compared.of(view, ("green", "water"), Field.of(grid=grid, layers=mapped.repeat(2, 0), known=half), [here])
    assert [less.known[0, 1], less.seen[0, 1], less.mapped[0, 1], less.both[0, 1]] == [128.0, 0.0, 64.0, 0.0]
    assert less.unlike[0, 1] == pytest.approx(64 / (64 + UNLIKE_M2))


def test_terms_of_a_certain_view_and_of_a_faint_one(tiny, widest):
    query, pose = widest
    count = len(tiny.region.classes)
    model = ScorerModel.by_hand(tiny.region.classes)
    seen = replace(query, evidence=faint(query, tiny.region, pose))
    alone = {"correlates": "never"}
    for switches, of_certain, of_faint in (
        (Switches(), count + 4, 2 * count + 2),
        (Switches(reads_probabilities=False), count + 4, count + 4),
        (Switches(**alone), count, count),
    ):
        reader = Reader.of(tiny.region, model, switches)
        for view, columns in ((query, of_certain), (seen, of_faint)):
            reading = reader.read(view)
            terms = reading.terms([pose], None)
            assert terms.shape == (1, columns)
            assert (terms[:, :count] == reading.by_class([pose]) * model.scaling).all()
            is_ours = columns == count + 4
            assert (reading.searched is not reading.template) == is_ours
            assert reading.beside([pose]).any() == is_ours
            if is_ours:
                assert (terms[:, count:] == reading.beside([pose]) * model.blend.beside).all()


@pytest.mark.parametrize(
    ("changed", "left_out"),
    [
        ({"weighs_prior": False}, [0, 1]),
        ({"weighs_amounts": False}, [2]),
        ({"weighs_overlap": "never"}, [3]),
        ({"weighs_amounts": False, "weighs_overlap": "never"}, [2, 3]),
    ],
)
def test_each_term_is_left_out_by_its_own_switch(tiny, widest, changed, left_out):
    query, pose = widest
    off = replace(pose, yaw_deg=pose.yaw_deg + 9.0, scale=pose.scale * 1.02)
    whole, part = (
        Reader.of(tiny.region, ScorerModel.by_hand(tiny.region.classes), switches).read(query).beside([pose, off])
        for switches in (Switches(), Switches(**changed))
    )
    kept = [at for at in range(4) if at not in left_out]
    assert not part[:, left_out].any()
    assert (part[:, kept] == whole[:, kept]).all()


def test_the_overlap_of_a_faded_map_is_that_of_the_map_itself(tiny, widest):
    query, pose = widest
    classes, tables = tiny.region.classes, likeness_by_hand(tiny.region.classes)
    bare = tables.copy()
    bare[:, 1:] = 0
    found = [
        Compared.of(query.evidence, classes, read_field(tiny.region, one), [pose], near=one[:, 1])
        for one in (tables, bare)
    ]
    for name in ("mapped", "both"):
        faded, plain = (getattr(one, name)[0] for one in found)
        assert faded == pytest.approx(plain, rel=0.06, abs=8.0)
    assert found[0].overlaps == pytest.approx(found[1].overlaps, abs=0.03)


def test_places_that_overlap_score_more_in_the_search(tiny, field, widest):
    query, pose = widest
    weights = overlap_weights(query.evidence, tiny.region.classes)
    view = Template(weights=weights, known=np.zeros(query.evidence.shape, np.float32), cell_size_m=1.0)
    away = [replace(pose, easting_m=pose.easting_m + east_m) for east_m in (-90.0, 70.0, 130.0)]
    assert score_at(field, view, pose) > max(score_at(field, view, one) for one in away)
    assert score_at(field, view, pose) < SEARCHED * len(tiny.region.classes)


def test_areas_say_as_much_as_lines_are_badly_seen():
    lines, areas = np.array([0.6, 0.0]), np.array([0.0, 0.6])
    says = []
    for share in (1.0, 0.4, 0.1):
        both = 100.0 * np.column_stack((share * lines, areas))
        flat = np.full((2, 2), 60.0)
        some = Compared(known=flat, seen=flat, mapped=flat, both=both, seen_twice=flat, mapped_twice=flat)
        says.append(overlap_of(some, np.array([True, False]))[1])
        assert overlap_of(some, np.array([True, False]), is_gated=False)[1] == some.overlaps[1, 1]
    assert says[0] < 0.01 < says[1] < says[2] < some.overlaps[1, 1]
