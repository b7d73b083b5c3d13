# SPDX-License-Identifier: Apache-2.0
"""The segmenter with weights: what it sees of a picture, its tiles, its scale, and what it passes over."""

import cv2
import numpy as np
import pytest
from sasgeo_baselines.segmenters import osm_unet
from sasgeo_baselines.segmenters.osm_unet import (
    CLASSES,
    HELD_OUT_WEIGHTS,
    WEIGHTS,
    Exposure,
    OsmUNet,
    OsmUNetHeldOut,
    normalized,
)

import sasgeo_bench as sgb
from sasgeo_bench.running.segmenter_testing import check_segmenter
from sasgeo_bench.sensing.camera import Camera, Intrinsics

RNG = np.random.default_rng


def seen_from(height_m, rgb):
    rows, cols = rgb.shape[:2]
    lens = Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=cols, height_px=rows)
    camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=height_m, yaw_deg=0.0)
    return sgb.AerialImage(rgb=rgb, camera=camera)


def ortho(rgb, gsd_m):
    """A picture whose pixels are so wide on the ground."""
    return seen_from(gsd_m * rgb.shape[1] / 2 / np.tan(np.radians(30)), rgb)


def patchwork(side=320):
    """Blurred noise: something to see everywhere."""
    noise = RNG(1).integers(0, 256, (side // 8, side // 8, 3), dtype=np.uint8)
    return cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)


def chances(image):
    return OsmUNet().segment(image, learned=None).probabilities()


def test_the_weights_are_small_and_the_cards_name_what_taught_them():
    assert max(path.stat().st_size for path in (WEIGHTS, HELD_OUT_WEIGHTS)) <= 3e6
    assert OsmUNet.card.classes == OsmUNetHeldOut.card.classes == CLASSES
    assert set(OsmUNet.card.trained_on) > set(OsmUNetHeldOut.card.trained_on)


@pytest.mark.parametrize("name", ["osm_unet", "osm_unet_held_out"])
def test_the_kit_finds_no_fault(name):
    faults = [check for check in check_segmenter(name) if check.outcome == "fail"]
    assert not faults


def test_what_was_kept_back_changes_what_is_seen():
    image = ortho(patchwork(256), 0.5)
    first, second = (kind().segment(image, learned=None).probabilities() for kind in (OsmUNet, OsmUNetHeldOut))
    assert 0.01 < np.abs(first - second).mean() < 0.2


def test_exposure_haze_and_holes_change_nothing_that_the_network_sees():
    rgb = np.asarray(patchwork() // 2, dtype=np.uint8)
    plain = normalized(rgb)
    assert plain.mean(axis=(1, 2)) == pytest.approx(np.zeros(3), abs=1e-4)
    assert np.sqrt((plain**2).mean()) == pytest.approx(1, abs=1e-4)
    brighter = np.asarray(rgb + np.array([5, 40, 90]), dtype=np.uint8)
    np.testing.assert_allclose(normalized(brighter), plain, atol=1e-4)
    holed = np.concatenate([rgb, np.zeros_like(rgb)])
    is_known = np.arange(len(holed)) < len(rgb)
    seen = normalized(holed, Exposure.of(holed[is_known].reshape(-1, 3)))
    np.testing.assert_allclose(seen[:, : len(rgb)], plain, atol=1e-4)


def test_tiles_give_what_the_whole_gives(monkeypatch):
    image = ortho(patchwork(1000)[:, :840].copy(), 0.5)
    whole = chances(image)
    monkeypatch.setattr(osm_unet, "_TILE_PX", 256)
    np.testing.assert_allclose(chances(image), whole, atol=1.5 / 254)


def test_a_finer_picture_of_the_same_ground_gives_nearly_the_same():
    coarse = patchwork(256)
    fine = cv2.resize(coarse, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    found = chances(ortho(fine, 0.5 / 3))
    assert found.shape[1:] == fine.shape[:2]
    small = np.stack([cv2.resize(plane, (256, 256), interpolation=cv2.INTER_AREA) for plane in found])
    assert np.abs(small - chances(ortho(coarse, 0.5))).mean() < 0.02


def test_it_turns_with_the_picture():
    rgb = patchwork(256)
    found = chances(ortho(rgb, 0.5))
    turned = chances(ortho(np.ascontiguousarray(np.rot90(rgb)), 0.5))
    back = np.rot90(turned, -1, axes=(1, 2))
    assert np.abs(back - found).mean() < 0.1  # it was taught at all headings, and has none built in
    assert np.abs(turned - found).mean() > 1.5 * np.abs(back - found).mean()


def test_holes_are_silent():
    rgb = patchwork()
    rgb[:, :120] = 0
    found = chances(ortho(rgb, 0.5))
    assert np.isnan(found[:, :, :110]).all()
    assert np.isfinite(found[:, :, 130:]).all()


def test_with_its_mirror_image_a_picture_gives_what_its_mirror_image_gives():
    rgb = patchwork(256)
    segmenter = OsmUNet(is_mirrored=True)
    first, second = (
        segmenter.segment(ortho(one, 0.5), learned=None).probabilities()
        for one in (rgb, np.ascontiguousarray(rgb[:, ::-1]))
    )
    np.testing.assert_allclose(second[:, :, ::-1], first, atol=1.5 / 254)
    assert np.abs(first - chances(ortho(rgb, 0.5))).max() > 0.02


def test_exposure_is_that_of_the_picture_unless_another_is_given():
    rgb = patchwork(256)
    image = ortho(rgb, 0.5)
    own = OsmUNet(exposure=Exposure.of(rgb.reshape(-1, 3))).segment(image, learned=None)
    np.testing.assert_array_equal(own.probability_bytes, OsmUNet().segment(image, learned=None).probability_bytes)
    brighter = Exposure.of(np.asarray(rgb // 2 + 120, dtype=np.uint8).reshape(-1, 3))
    other = OsmUNet(exposure=brighter).segment(image, learned=None)
    assert (other.probability_bytes != own.probability_bytes).any()
