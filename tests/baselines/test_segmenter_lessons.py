# SPDX-License-Identifier: Apache-2.0
"""What `osm_unet` is taught: shares and weights of cells by hand, other sensors, and how often each source is asked."""

import argparse
from itertools import islice

import numpy as np
import pytest
from sasgeo_baselines.segmenters.osm_unet import CLASSES, normalized

from benchmarks.real_pictures import part_of
from benchmarks.segmenter_lessons import Part, Source, batches, lesson, shade, shares, sources_of, varied
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sensing.crops import Crop, drawn_crops, real_crops
from sasgeo_bench.sensing.rendering.wild import Ingredients
from tests import world
from tests.regions.imagery_place import make_hamlet

SIDE = 16  # pixels; 8 cells of 2 pixels


def taught(**layers):
    """Shares and weights by class of a crop whose layers are present in these rows and columns, pixels."""
    labels = np.zeros((len(layers), SIDE, SIDE), dtype=np.uint8)
    for layer, (rows, cols) in zip(labels, layers.values(), strict=True):
        layer[rows, cols] = PRESENT
    return of_labels(tuple(layers), labels)


def of_labels(classes, labels):
    pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    rgb = np.zeros((*labels.shape[1:], 3), dtype=np.uint8)
    wanted, weights = lesson(Crop(rgb=rgb, classes=classes, labels=labels, pixel_m=0.5, region="made-up", pose=pose))
    assert wanted.shape == weights.shape == (len(CLASSES), SIDE // 2, SIDE // 2)
    return dict(zip(CLASSES, wanted, strict=True)), dict(zip(CLASSES, weights, strict=True))


ALL, NONE = slice(None), slice(0, 0)


def columns(*values):
    """The same values in each row of cells."""
    return np.tile(values, (SIDE // 2, 1))


def test_a_cell_has_its_share_and_weighs_less_where_an_edge_runs_by():
    wanted, weights = taught(building=(ALL, slice(0, 7)))  # the fourth cell is covered by half
    np.testing.assert_allclose(wanted["building"], columns(1, 1, 1, 0.5, 0, 0, 0, 0))
    np.testing.assert_allclose(weights["building"], columns(1, 1, 0.4, 0.4, 0.4, 1, 1, 1))


def test_a_class_that_the_map_does_not_have_teaches_nothing():
    wanted, weights = taught(building=(ALL, slice(0, 7)))
    for name in set(CLASSES) - {"building"}:
        assert not wanted[name].any()
        assert not weights[name].any()


def test_unknown_ground_weighs_nothing_in_any_class():
    labels = np.zeros((2, SIDE, SIDE), dtype=np.uint8)
    labels[0, 4, 9] = UNKNOWN  # a single pixel of cell (2, 4)
    _, weights = of_labels(("building", "road_minor"), labels)
    expected = np.ones((SIDE // 2, SIDE // 2))
    expected[2, 4] = 0
    for name in ("building", "road_minor"):
        np.testing.assert_array_equal(weights[name], expected)


def test_the_absence_of_an_area_weighs_less_where_the_map_has_nothing_at_all():
    wanted, weights = taught(green=(ALL, NONE), building=(ALL, slice(0, 7)), water=(ALL, NONE))
    assert not wanted["green"].any()
    np.testing.assert_allclose(weights["green"], columns(1, 1, 1, 1 - 0.75 / 2, 0.25, 0.25, 0.25, 0.25))
    np.testing.assert_allclose(weights["water"], np.ones((8, 8)))  # water is mapped; nobody leaves it out
    _, weights = taught(green=(ALL, slice(0, 8)))
    np.testing.assert_allclose(weights["green"], columns(1, 1, 1, 0.4, 0.4 * 0.25, 0.25, 0.25, 0.25))


def test_a_stream_that_is_mapped_as_a_line_is_neither_water_nor_land():
    wanted, weights = taught(water=(ALL, slice(0, 4)), waterway=(slice(8, 10), ALL))
    np.testing.assert_allclose(wanted["water"], columns(1, 1, 0, 0, 0, 0, 0, 0))
    expected = columns(1, 0.4, 0.4, 1, 1, 1, 1, 1).astype(float)
    expected[4, 2:] = 0
    np.testing.assert_allclose(weights["water"], expected)


def test_the_share_of_a_cell_is_the_mean_of_its_pixels():
    mask = np.random.default_rng(1).random((SIDE, SIDE)) < 0.4
    np.testing.assert_allclose(shares(mask, SIDE // 2), mask.reshape(8, 2, 8, 2).mean(axis=(1, 3)))


def patchwork(side=96):
    """Blocks of grey and of colour."""
    blocks = np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    return np.kron(blocks, np.ones((side // 8, side // 8, 1), dtype=np.uint8))


def test_a_seed_varies_a_picture_alike_and_keeps_its_form():
    rgb = patchwork()
    before = rgb.copy()
    first, again, other = (varied(rgb, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.shape == rgb.shape
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5
    np.testing.assert_array_equal(rgb, before)


def test_what_a_varied_picture_shows_stays_where_the_labels_say():
    rgb = patchwork()
    grey = rgb.mean(axis=2).ravel()
    alike = [
        np.corrcoef(varied(rgb, np.random.default_rng(seed)).mean(axis=2).ravel(), grey)[0, 1] for seed in range(40)
    ]
    assert np.median(alike) > 0.8
    assert np.mean(np.array(alike) < 0.5) < 0.1


def test_shade_covers_a_side_of_the_picture():
    covers = np.stack([shade(64, np.random.default_rng(seed)) for seed in range(30)])
    assert covers.dtype == np.float32
    assert covers.shape == (30, 64, 64)
    assert covers.min() >= 0
    assert covers.max() <= 1
    assert 0.3 < covers.mean() < 0.7
    assert np.mean((covers > 0.1) & (covers < 0.9)) < 0.4  # most is in the shade or in the sun


# Parts and sources


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("banepa", Part("banepa", (0, 1, 0, 1))),
        ("pardubice-ortho:0,1,0.8,1", Part("pardubice-ortho", (0, 1, 0.8, 1))),
    ],
)
def test_a_part_is_read_as_it_is_written(text, part):
    assert Part.parse(text) == part
    assert str(part) == text


@pytest.mark.parametrize(
    "text", ["", ":0,1,0,1", "a:", "a:0,1,0", "a:0,1,0,x", "a:1,0,0,1", "a:0,1,0,1.2", "a:0,nan,0,1"]
)
def test_what_is_no_part_is_refused_in_one_line(text):
    with pytest.raises(argparse.ArgumentTypeError, match=r"give NAME or NAME:WEST,EAST,NORTH,SOUTH") as error:
        Part.parse(text)
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def out(tmp_path_factory, lay_towns):
    """Two towns, and a made-up place with a picture."""
    root = lay_towns(tmp_path_factory.mktemp("out"), "town-riverside", "town-grid")
    hamlet = make_hamlet(tmp_path_factory.mktemp("hamlet"))
    world.built(hamlet.spec(), root, extract_folders=[hamlet.folder], imagery_folders=[hamlet.folder])
    return root


TOWNS = ("town-riverside", "town-grid")
WHOLE, QUARTER = Part("hamlet"), Part("hamlet", (0.0, 0.5, 0.0, 0.5))


def test_sources_share_all_crops_and_pictures_theirs_by_the_roots_of_their_areas(out):
    whole, quarter, drawn = sources_of(TOWNS, [WHOLE, QUARTER], 0.3, out)
    assert (whole.share, quarter.share, drawn.share) == pytest.approx((0.7 * 2 / 3, 0.7 / 3, 0.3))
    assert (whole.box, quarter.box, drawn.box) == (WHOLE.box, QUARTER.box, None)
    assert [region.manifest.id for region in drawn.regions] == list(TOWNS)


def test_one_kind_of_source_alone_gives_all_crops(out):
    assert [one.share for one in sources_of(TOWNS, [], 0.3, out)] == [1]
    assert [one.share for one in sources_of([], [WHOLE], 0.3, out)] == [1]


def test_a_place_that_is_not_built_is_named_in_one_line(out):
    with pytest.raises(SystemExit, match=r"^elsewhere is not built: sasgeo-bench build-region elsewhere --out "):
        sources_of(["elsewhere"], [], 0.3, out)


def test_a_part_of_a_picture_is_counted_from_its_north_west():
    record = argparse.Namespace(bounds_m=(100.0, 1000.0, 300.0, 1400.0))
    region = argparse.Namespace(imagery=argparse.Namespace(record=record))
    assert part_of(region, (0.0, 0.5, 0.75, 1.0)) == (100.0, 1000.0, 200.0, 1100.0)


def planes_of(crops):
    """What a network is given of crops, stacked."""
    return [np.stack(some) for some in zip(*((normalized(crop.rgb), *lesson(crop)) for crop in crops), strict=True)]


def test_drawn_crops_are_taught_as_they_are_drawn(out):
    town, look = read_region(out / "regions" / "town-grid"), Ingredients.none()
    (step,) = batches([Source((town,), 1.0, look=look)], 3, 2, steps=1)
    crops = list(islice(drawn_crops([town], seed=3, side_px=256, pixel_m=0.5, zoom=1.4, ingredients=look), 2))
    for found, expected in zip(step, planes_of(crops), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_real_crops_are_varied_and_their_labels_are_not(out):
    hamlet = read_region(out / "regions" / "hamlet")
    sources = [Source((hamlet,), 1.0, WHOLE.box)]
    (step,) = batches(sources, 2, 3, steps=1)
    crops = list(islice(real_crops([hamlet], seed=2, side_px=256, pixel_m=0.5, zoom=1.4), 3))
    planes, wanted, weights = planes_of(crops)
    assert (step[0] != planes).mean() > 0.9
    np.testing.assert_array_equal(step[1], wanted)
    np.testing.assert_array_equal(step[2], weights)
    again, other = (next(batches(sources, part, 3)) for part in (2, 3))
    np.testing.assert_array_equal(again[0], step[0])
    assert (other[1] != step[1]).any()
