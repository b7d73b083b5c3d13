# SPDX-License-Identifier: Apache-2.0
"""Corruptions: each changes a picture, more at every severity, and none moves the ground that it shows."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.corruptions import COMPOUNDS, CORRUPTIONS, SEVERITIES, corrupt
from sasgeo_bench.tasks.frames import encode_webp

EVERY = (*CORRUPTIONS, *COMPOUNDS)
SHIFTS = ("packet loss", "rolling shutter")  # ground is somewhere else, though not on average


def ground(side_px: int = 240, *, rough: float = 6.0) -> np.ndarray:
    """Roofs, roads and grass that are rough at all scales, uint8 of shape (H, W, 3)."""
    rng = np.random.default_rng(3)
    picture = np.full((side_px, side_px, 3), (70, 95, 60), dtype=np.uint8)
    for _ in range(40):
        (x, y), (wide, high) = rng.integers(0, side_px, 2), rng.integers(side_px // 20, side_px // 7, 2)
        picture[y : y + high, x : x + wide] = rng.integers(60, 220, 3)
    picture[side_px // 3 : side_px // 3 + 7] = 130
    return np.clip(picture + rng.normal(0, rough, picture.shape), 0, 255).astype(np.uint8)


def rng_of(seed: int = 7) -> np.random.Generator:
    return np.random.default_rng(seed)


def difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(float) - other).mean())


def grey(picture: np.ndarray) -> np.ndarray:
    return picture.astype(np.float64).mean(axis=2)


def test_there_are_19_single_ones_of_four_families_and_8_compounds_of_different_families():
    assert len(CORRUPTIONS) == 19
    assert {one.family for one in CORRUPTIONS.values()} == {"weather", "motion", "sensor", "compression"}
    assert len(COMPOUNDS) == 8
    for parts in COMPOUNDS.values():
        families = [CORRUPTIONS[part].family for part in parts]
        order = [("weather", "motion", "sensor", "compression").index(name) for name in families]
        assert order == sorted(set(order))  # as light passes them
        assert len(families) in (2, 3)


@pytest.mark.parametrize("name", EVERY)
def test_each_changes_the_picture_more_at_every_severity_and_keeps_its_shape(name):
    picture = ground()
    before = picture.copy()
    found = [corrupt(picture, name, severity=severity, rng=rng_of()) for severity in (0, *SEVERITIES)]
    assert all(one.shape == picture.shape and one.dtype == np.uint8 for one in found)
    steps = [difference(one, picture) for one in found]
    assert steps[0] == 0
    assert all(low + 0.3 < high for low, high in pairwise(steps)), steps
    assert (picture == before).all()
    assert found[0] is not picture


def stored(picture: np.ndarray) -> np.ndarray:
    """A picture as a query holds it."""
    data = np.frombuffer(encode_webp(picture), dtype=np.uint8)
    return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@pytest.mark.parametrize("side_px", [480, 768])
@pytest.mark.parametrize("name", ["gaussian noise", "shot noise"])
def test_storage_takes_no_more_than_a_third_of_the_noise(name, side_px):
    picture = cv2.GaussianBlur(ground(side_px), (0, 0), 2)
    noisy = corrupt(picture, name, severity=3, rng=rng_of())
    made, kept = (float((one.astype(float) - picture).std()) for one in (noisy, stored(noisy)))
    assert 0.67 < kept / made < 0.9


@pytest.mark.parametrize("name", EVERY)
def test_a_picture_of_the_largest_size_is_stored_and_its_ladder_stays_one(name):
    picture = ground(768, rough=12.0)  # leaves of trees, and noise: at most 150 kB all the same
    steps = [difference(stored(corrupt(picture, name, severity=at, rng=rng_of())), picture) for at in (1, 3)]
    assert steps[0] < 0.9 * steps[1]


@pytest.mark.parametrize("name", EVERY)
def test_the_same_generator_gives_the_same_picture(name):
    picture = ground()
    one, again = (corrupt(picture, name, severity=2, rng=rng_of()) for _ in range(2))
    np.testing.assert_array_equal(one, again)


@pytest.mark.parametrize(
    "name", ["fog", "rain", "snow", "cloud shadow", "camera shake", "rolling shutter", "dead lines", "packet loss"]
)
def test_another_seed_puts_it_elsewhere(name):
    picture = ground()
    assert (corrupt(picture, name, severity=2, rng=rng_of()) != corrupt(picture, name, severity=2, rng=rng_of(8))).any()


@pytest.mark.parametrize("name", COMPOUNDS)
def test_a_compound_is_its_parts_one_after_another(name):
    picture = ground()
    for severity in SEVERITIES:
        rng, wanted = rng_of(), picture
        for part in name.split(" + "):
            wanted = corrupt(wanted, part, severity=severity, rng=rng)
        np.testing.assert_array_equal(corrupt(picture, name, severity=severity, rng=rng_of()), wanted)


@pytest.mark.parametrize("name", [name for name in CORRUPTIONS if name not in SHIFTS])
def test_the_ground_stays_where_it_is(name):
    """The picture fits best where it was, also against the clean one moved by two pixels or more."""
    picture = cv2.GaussianBlur(ground(), (0, 0), 1.5)
    changed = grey(corrupt(picture, name, severity=1, rng=rng_of()))[20:-20, 20:-20]

    def likeness(right, down):
        moved = np.roll(grey(picture), (down, right), axis=(0, 1))[20:-20, 20:-20]
        return np.corrcoef(moved.ravel(), changed.ravel())[0, 1]

    moves = {(right, down): likeness(right, down) for right in range(-4, 5) for down in range(-4, 5)}
    best = max(moves, key=moves.get)
    assert max(map(abs, best)) <= 1, best
    assert moves[best] > 0.5


@pytest.mark.parametrize("name", ["motion blur", "defocus blur", "camera shake", "rolling shutter"])
def test_a_pattern_loses_as_much_at_any_resolution(name):
    fine = cv2.GaussianBlur(ground(640), (0, 0), 4)
    coarse = cv2.resize(fine, (320, 320), interpolation=cv2.INTER_AREA)
    losses = [difference(corrupt(picture, name, severity=3, rng=rng_of()), picture) for picture in (fine, coarse)]
    assert losses[0] == pytest.approx(losses[1], rel=0.08)


def test_a_flight_smears_along_the_picture_and_not_across():
    stripes = np.zeros((240, 240, 3), dtype=np.uint8)
    stripes[:, ::12] = 240
    np.testing.assert_array_equal(corrupt(stripes, "motion blur", severity=3, rng=rng_of()), stripes)
    across = np.ascontiguousarray(stripes.transpose(1, 0, 2))
    assert np.ptp(corrupt(across, "motion blur", severity=3, rng=rng_of())) < 40
    # 0.025 of 240 pixels are 6: a running mean, by scipy
    dot = np.zeros((241, 241, 3), dtype=np.uint8)
    dot[120, 120] = 240
    seen = corrupt(dot, "motion blur", severity=2, rng=rng_of())[:, 120, 0].astype(float)
    wanted = uniform_filter1d(dot[:, 120, 0].astype(float), 6)
    assert seen.sum() == pytest.approx(wanted.sum(), rel=0.05)
    assert np.flatnonzero(seen).tolist() == list(range(117, 124))


def test_a_rolling_shutter_moves_rows_by_nothing_on_average():
    line = np.zeros((400, 400, 3), dtype=np.uint8)
    line[:, 198:203] = 255
    seen = grey(corrupt(line, "rolling shutter", severity=3, rng=rng_of()))
    middles = (seen * np.arange(400)).sum(axis=1) / seen.sum(axis=1) - 200
    assert abs(middles.mean()) < 0.1
    assert 3 < middles.std() < 8  # 0.016 of 400 pixels, as waves


def test_exposure_is_in_stops_of_light_and_cut_off_at_white():
    grey_card = np.full((8, 8, 3), 80, dtype=np.uint8)
    assert corrupt(grey_card, "overexposure", severity=3, rng=rng_of()).max() == 160  # two stops: four times the light
    assert corrupt(grey_card, "underexposure", severity=2, rng=rng_of()).max() == round(80 / 8**0.5)
    white = np.full((8, 8, 3), 200, dtype=np.uint8)
    assert corrupt(white, "overexposure", severity=3, rng=rng_of()).min() == 255


def test_noise_has_the_strength_that_its_levels_say():
    card = np.full((384, 384, 3), 128, dtype=np.uint8)
    sigma = CORRUPTIONS["gaussian noise"].levels[0]
    assert corrupt(card, "gaussian noise", severity=1, rng=rng_of()).std() == pytest.approx(255 * sigma, rel=0.02)
    photons = CORRUPTIONS["shot noise"].levels[1]
    wanted = 255 * np.sqrt(128 / 255 / photons)  # of Poisson
    assert corrupt(card, "shot noise", severity=2, rng=rng_of()).std() == pytest.approx(wanted, rel=0.05)
    share = CORRUPTIONS["impulse noise"].levels[2]
    hit = corrupt(card, "impulse noise", severity=3, rng=rng_of())[..., 0]
    assert (hit != 128).mean() == pytest.approx(share, rel=0.05)
    assert set(np.unique(hit)) == {0, 128, 255}
    assert (hit == 0).mean() == pytest.approx((hit == 255).mean(), rel=0.1)


def test_low_bits_leave_few_levels_and_video_few_frequencies():
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2).repeat(64, axis=0)
    assert len(np.unique(corrupt(ramp, "low bit depth", severity=3, rng=rng_of()))) == 4
    flat = np.full((50, 70, 3), 91, dtype=np.uint8)
    np.testing.assert_array_equal(corrupt(flat, "video blocks", severity=3, rng=rng_of()), flat)
    checks = np.indices((64, 64)).sum(axis=0)[..., None].repeat(3, axis=2) % 2 * 200
    smooth = corrupt(checks.astype(np.uint8), "video blocks", severity=1, rng=rng_of())
    assert np.ptp(smooth) < 40


def test_what_does_not_exist_is_refused_in_one_line():
    with pytest.raises(ImageError, match="there is no corruption 'smog': choose one of fog, rain, snow"):
        corrupt(ground(), "smog", severity=1, rng=rng_of())
    with pytest.raises(ImageError, match="a severity is 0, 1, 2 or 3, got 4"):
        corrupt(ground(), "fog", severity=4, rng=rng_of())
