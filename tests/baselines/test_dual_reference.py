# SPDX-License-Identifier: Apache-2.0
"""Map and imagery as one reference: each alone, their sum, and the share that is learned."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sasgeo_baselines.image import hu_dual_reference
from sasgeo_baselines.image.hu_dual_reference import (
    MOST_EXAMPLES,
    SHARES,
    HuDualReference,
    HuImageryOnly,
    HuMapOnly,
    centred,
    examples,
)

import sasgeo_bench as sgb
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence, LayerBits, observe
from tests.baselines.test_image_matchers import PICTURE_PX, TRUTH, off_m, picture, query_of, region, window

__all__ = ["region", "window"]  # fixtures
NOISE = np.random.default_rng(1).normal(120, 40, (PICTURE_PX, PICTURE_PX, 3)).clip(0, 255).astype(np.uint8)
ELSEWHERE = replace(TRUTH, easting_m=TRUTH.easting_m - 70.0, yaw_deg=58.0)


@pytest.fixture(scope="module")
def seen(region):
    """A function from a pose to what a perfect detector sees."""
    bits = LayerBits.of(region.layers)

    def of(pose):
        cells = observe(bits, region.grid, pose, size_cells=112, cell_size_m=1.0)
        return Evidence(classes=region.classes, cells=cells, cell_size_m=1.0)

    return of


def prepared(kind, region, learned=None):
    made = kind()
    made.prepare(region, learned)
    return made


def test_the_sum_finds_what_either_reference_shows(region, window, seen):
    matcher = prepared(HuDualReference, region)
    shown = query_of(picture(window, TRUTH))
    for query in (shown, query_of(NOISE, evidence=seen(TRUTH)), replace(shown, evidence=seen(TRUTH))):
        assert off_m(matcher.match(query, top_k=1).poses[0]) < 5.0


def test_a_half_looks_at_its_own_reference_alone(region, window, seen):
    query = query_of(picture(window, TRUTH), evidence=seen(ELSEWHERE))
    on_map, on_imagery = (prepared(kind, region).match(query, top_k=1).poses[0] for kind in (HuMapOnly, HuImageryOnly))
    assert off_m(on_map, ELSEWHERE) < 5.0
    assert off_m(on_imagery, TRUTH) < 5.0
    for learned, best in (('{"share": 0.0}', on_map), ('{"share": 1.0}', on_imagery)):
        assert prepared(HuDualReference, region, learned).match(query, top_k=1).poses[0] == best


def test_a_half_neither_learns_nor_reads_the_other(region, window, seen, monkeypatch):
    """Parts of a region that are missing here would raise."""
    assert [isinstance(kind(), sgb.Learner) for kind in (HuDualReference, HuMapOnly, HuImageryOnly)] == [
        True,
        False,
        False,
    ]
    query = query_of(picture(window, TRUTH), evidence=seen(TRUTH))
    of_imagery = SimpleNamespace(grid=region.grid, classes=region.classes, imagery=region.imagery)
    assert off_m(prepared(HuImageryOnly, of_imagery).match(query, top_k=1).poses[0]) < 5.0
    monkeypatch.delattr(hu_dual_reference, "view_image")
    of_map = SimpleNamespace(grid=region.grid, classes=region.classes, known=region.known, layer=region.layer)
    assert off_m(prepared(HuMapOnly, of_map).match(query, top_k=1).poses[0]) < 5.0


def test_what_shows_nothing_is_withheld(region, window, seen):
    blank = seen(TRUTH).replace(np.full_like(seen(TRUTH).cells, UNKNOWN))
    query = replace(query_of(picture(window, TRUTH), evidence=blank), frames=())
    assert prepared(HuMapOnly, region).match(query, top_k=1) == sgb.WITHHELD
    assert prepared(HuDualReference, region).match(query, top_k=1) == sgb.WITHHELD


@pytest.mark.parametrize("rgb_is_noise", [True, False])
def test_the_share_that_is_right_most_often_is_learned(region, window, seen, rgb_is_noise):
    """Where pictures are noise the map is all, where the view is of another place the imagery."""
    pairs = []
    for east_m in (-20.0, 20.0):
        pose = replace(TRUTH, easting_m=TRUTH.easting_m + east_m)
        rgb = NOISE if rgb_is_noise else picture(window, pose)
        query = query_of(rgb, evidence=seen(pose if rgb_is_noise else ELSEWHERE))
        pairs.append((query, SimpleNamespace(pose=pose)))
    learned = json.loads(HuDualReference().learn(sgb.Training(regions={"hamlet": region}, pairs=pairs)))
    assert learned["share"] in SHARES
    assert learned["share"] < 0.5 if rgb_is_noise else learned["share"] >= 0.5


def test_a_class_counts_the_same_however_rare_it_is():
    known = np.ones((10, 10), dtype=bool)
    layers = [np.zeros((10, 10), dtype=np.float32) for _ in range(2)]
    layers[0][:5], layers[1][0, 0] = 1, 1
    channels = centred(layers, known).channels
    assert np.allclose((channels**2).sum(axis=(1, 2)), 100)
    assert np.allclose(channels.sum(axis=(1, 2)), 0, atol=1e-4)


def test_a_class_says_nothing_where_it_is_unknown_and_others_are_known():
    """Buildings are unknown in the left half; on the right they are where water is."""
    cells = np.zeros((2, 112, 112), dtype=np.uint8)
    cells[:, ::8] = cells[:, 1::8] = sgb.PRESENT
    cells[0, :, :56] = UNKNOWN
    view = Evidence(classes=("building", "water"), cells=cells, cell_size_m=1.0)
    drawn = hu_dual_reference._Drawn.of(query_of(NOISE, evidence=view), view.classes, gsd_m=2.0)
    turned = drawn.turned(replace(TRUTH, yaw_deg=0.0, scale=1.0), 56)
    assert turned.is_known.all()
    assert not turned.channels[0, :, :28].any()
    assert np.allclose(turned.channels[0, :, 28:], turned.channels[1, :, 28:])


def test_lessons_are_pairs_with_pictures_taken_evenly():
    shown, blind = (SimpleNamespace(track="localization", frames=frames) for frames in ((NOISE,), ()))
    pairs = [(blind if at % 10 else shown, SimpleNamespace(pose=TRUTH)) for at in range(600)]
    assert len(examples(sgb.Training(regions={}, pairs=pairs))) == MOST_EXAMPLES
    assert len(examples(sgb.Training(regions={}, pairs=[pairs[0]] * 119))) == MOST_EXAMPLES


@pytest.mark.parametrize("text", ["x", "{}", "null", '{"share": 3}', '{"share": NaN}'])
def test_a_damaged_share_is_refused_in_one_line(region, text):
    with pytest.raises(ValueError, match="hu_dual_reference: the learned text"):
        prepared(HuDualReference, region, text)
