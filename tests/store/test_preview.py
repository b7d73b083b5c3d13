# SPDX-License-Identifier: Apache-2.0
"""The preview: a PNG that shows the map, its colours, and what is not mapped."""

import numpy as np
import pytest
from matplotlib import image

from sasgeo_bench.build import build_region, plan_build
from sasgeo_bench.layers import OUTSIDE, PRESENT
from sasgeo_bench.region import ATTRIBUTION
from sasgeo_bench.store.catalog import find_region_file, read_region_file
from sasgeo_bench.store.preview import write_preview
from sasgeo_bench.taxonomy import load_taxonomy


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    spec = read_region_file(find_region_file("town-suburb"))
    plan = plan_build(spec, out=tmp_path_factory.mktemp("out"))
    return build_region(plan, tell=lambda _: None, with_preview=False)


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


def test_the_manifest_carries_the_attribution_that_is_drawn(manifest):
    assert manifest.attribution == ATTRIBUTION
