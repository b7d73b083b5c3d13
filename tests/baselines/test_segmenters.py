# SPDX-License-Identifier: Apache-2.0
"""The segmenters: what they learn and say, what they pass over in silence, and what pictures may differ in."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from sasgeo_baselines.segmenters import features as lib
from sasgeo_baselines.segmenters.colour_thresholds import ColourThresholds
from sasgeo_baselines.segmenters.pixel_forest import PixelForest, _Drawn
from sklearn.metrics import roc_auc_score

import sasgeo_bench as sgb
from sasgeo_bench.sensing.tiny_images import PLACES, tiny_images, with_picture

PROJECT = tomllib.loads((Path(__file__).parents[2] / "baselines" / "pyproject.toml").read_text(encoding="utf-8"))
REGISTERED = PROJECT["project"]["entry-points"]["sasgeo_bench.segmenters"]
PICTURES = tiny_images()
TAUGHT = [one for one in PICTURES if one.place == PLACES[0]]
ASKED = [one for one in PICTURES if one.place == PLACES[1]]


@pytest.fixture(scope="module")
def learned():
    return PixelForest().learn(sgb.ImageTraining(images=TAUGHT))


def ranked(labelled, said, name):
    """Area under the ROC curve of a class where labels are known."""
    truth = labelled.labels[labelled.classes.index(name)]
    chances = said.probabilities()[said.classes.index(name)]
    known = truth != sgb.UNKNOWN
    return roc_auc_score(truth[known], chances[known])


@pytest.mark.parametrize(("name", "spec"), REGISTERED.items())
def test_every_segmenter_is_found_by_the_name_on_its_card(name, spec):
    found = sgb.load_segmenter(name)
    assert found.card.name == name
    assert type(found).__name__ == spec.split(":")[1]


def test_the_forest_tells_classes_of_a_place_that_it_has_not_seen(learned):
    for labelled in ASKED:
        given = PixelForest().segment(labelled.image, learned=learned)
        assert given.classes == labelled.classes
        assert given.shape == labelled.image.shape
        for name in ("building", "water", "green"):
            assert ranked(labelled, given, name) > 0.9


def test_the_same_pictures_teach_the_same_text(learned):
    assert PixelForest().learn(sgb.ImageTraining(images=TAUGHT)) == learned


def test_a_class_that_no_picture_shows_is_not_told():
    dry = [
        sgb.LabelledImage(
            image=one.image,
            classes=one.classes,
            labels=np.where(np.arange(4)[:, None, None] == 2, np.minimum(one.labels, 0), one.labels).astype(np.uint8),
            place=one.place,
        )
        for one in TAUGHT
    ]
    text = PixelForest().learn(sgb.ImageTraining(images=dry))
    assert "water" not in PixelForest().segment(ASKED[0].image, learned=text).classes


def test_the_forest_says_what_is_wrong_in_one_line():
    picture = ASKED[0].image
    with pytest.raises(ValueError, match="needs training"):
        PixelForest().segment(picture, learned=None)
    with pytest.raises(ValueError, match="learn again"):
        PixelForest().segment(picture, learned='{"format": "another"}')
    unlabelled = sgb.LabelledImage(
        image=picture, classes=("water",), labels=np.full((1, *picture.shape), sgb.UNKNOWN, np.uint8), place="here"
    )
    with pytest.raises(ValueError, match="no class"):
        PixelForest().learn(sgb.ImageTraining(images=[unlabelled]))


def test_pixels_are_drawn_so_that_weights_give_back_the_shares_of_classes():
    drawn = _Drawn.of(TAUGHT[0], 0)
    truth = TAUGHT[0].labels
    known = (truth != sgb.UNKNOWN).all(axis=0)
    shares = (truth[:, known] == sgb.PRESENT).mean(axis=1)
    found = ((drawn.labels == sgb.PRESENT) * drawn.weights[:, None]).sum(axis=0) / drawn.weights.sum()
    assert found == pytest.approx(shares, abs=0.02)
    assert ((drawn.labels == sgb.PRESENT).mean(axis=0) > shares).sum() >= 3  # rare classes are drawn more often


def test_haze_and_exposure_change_normalized_colours_little():
    rgb = ASKED[0].image.rgb
    hazy = np.round(60 + 0.55 * rgb.astype(float)).astype(np.uint8)
    before, after = lib.normalized(rgb), lib.normalized(hazy)
    for band in range(2):
        assert np.corrcoef(before[band].ravel(), after[band].ravel())[0, 1] > 0.97
        assert after[band].std() == pytest.approx(before[band].std(), rel=0.15)


def test_a_picture_of_one_colour_has_no_features_but_its_colour():
    names, planes = lib.features(np.full((40, 50, 3), 128, dtype=np.uint8), 0.5)
    assert np.isfinite(planes).all()
    relative = [not name.startswith("plain_") for name in names]
    assert np.abs(planes[relative]).max() < 1e-3


def test_features_are_metres_of_ground_and_have_no_heading():
    rgb = ASKED[0].image.rgb
    fine = cv2.resize(rgb, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    names, coarse = lib.features(rgb, 1.0)
    _, finer = lib.features(fine, 0.5)
    small = np.stack([cv2.resize(plane, rgb.shape[1::-1], interpolation=cv2.INTER_AREA) for plane in finer])
    for name in ("light_4", "green_red_8", "light_spread_4"):
        at = names.index(name)
        assert np.corrcoef(coarse[at].ravel(), small[at].ravel())[0, 1] > 0.98
    _, turned = lib.features(np.ascontiguousarray(np.rot90(rgb)), 1.0)
    np.testing.assert_allclose(np.rot90(turned, -1, axes=(1, 2)), coarse, atol=0.05, rtol=0.05)


def test_a_fine_picture_is_worked_on_at_half_a_metre_and_a_coarse_one_as_it_is():
    fine, coarse = (with_picture(np.zeros((60, cols, 3), dtype=np.uint8)) for cols in (1120, 112))
    assert lib.ground_pixel_m(fine) == pytest.approx(0.1, rel=0.01)
    rows, cols, pixel_m = lib.working_size(fine)
    assert (rows, cols, pixel_m) == (12, 224, pytest.approx(0.5, rel=0.01))
    assert lib.working_size(coarse)[:2] == (60, 112)


@pytest.mark.parametrize("colour", [0, 255])
def test_a_hole_in_a_mosaic_is_passed_over_in_silence_and_an_overexposed_roof_is_not(colour, learned):
    rgb = ASKED[0].image.rgb.copy()
    rgb[:, :40] = colour  # 35 m wide
    rgb[40:48, 80:90] = colour
    for segmenter in (ColourThresholds(), PixelForest()):
        silent = np.isnan(segmenter.segment(with_picture(rgb), learned=learned).probabilities()).all(axis=0)
        assert silent[:, :38].all()
        assert not silent[:, 42:].any()


def test_thresholds_know_grass_from_ponds_and_need_no_training():
    for labelled in PICTURES:
        given = ColourThresholds().segment(labelled.image, learned=None)
        assert given.classes == ColourThresholds.card.classes
        assert ranked(labelled, given, "green") > 0.8
        assert ranked(labelled, given, "water") > 0.8
