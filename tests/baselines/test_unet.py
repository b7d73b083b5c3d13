# SPDX-License-Identifier: Apache-2.0
"""The segmenter `unet`: what it learns, keeps and refuses; without PyTorch it says so in a line."""

import base64
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from sasgeo_baselines.segmenters import network, unet
from sasgeo_baselines.segmenters.unet import UNet
from sklearn.metrics import roc_auc_score

import sasgeo_bench as sgb
from sasgeo_bench.sensing.tiny_images import PLACES, tiny_images, with_picture

PICTURES = tiny_images()
TAUGHT = [one for one in PICTURES if one.place == PLACES[0]]
ASKED = [one for one in PICTURES if one.place == PLACES[1]]
CROPS = 480
RNG = np.random.default_rng


@pytest.fixture(scope="module")
def learned(torch):
    """What two drawn pictures teach in a few steps."""
    del torch
    return small_unet().learn(sgb.ImageTraining(images=TAUGHT))


def small_unet(most_crops: int = CROPS) -> UNet:
    made = UNet()
    made.most_crops = most_crops
    return made


def with_weights(path, name="mine") -> UNet:
    """One of a class of one's own, as a user writes it."""
    return type("Mine", (UNet,), {"card": replace(UNet.card, name=name), "weights": path})()


# Where torch is missing


@pytest.mark.usefixtures("without_torch")
def test_the_unet_says_in_one_line_that_torch_is_missing():
    for ask in (
        lambda: UNet().learn(sgb.ImageTraining(images=TAUGHT)),
        lambda: UNet().segment(ASKED[0].image, learned="{}"),
    ):
        with pytest.raises(RuntimeError, match=r"^unet needs PyTorch.*pip install 'sasgeo-baselines\[torch\]'$"):
            ask()


# Texts and files of weights, which need no torch


def test_a_text_of_weights_is_read_back_as_half_precision():
    weights = network.drawn_weights(2, RNG(0))
    classes, again = network.weights_of(network.weights_text(("water", "green"), weights))
    assert classes == ("water", "green")
    assert again.keys() == weights.keys()
    for name, values in weights.items():
        np.testing.assert_array_equal(again[name], values.astype(np.float16).astype(np.float32))


def damaged() -> dict[str, str]:
    whole = json.loads(network.weights_text(("water",), network.drawn_weights(1, RNG(0))))
    arrays = whole["arrays"]
    wild = np.full(4, np.inf, dtype="<f2").tobytes()
    return {
        "cut off": json.dumps(whole)[:1000],
        "a list": "[]",
        "nested": "[" * 100_000,
        "another format": json.dumps(whole | {"format": "unet 0"}),
        "an array too short": json.dumps(whole | {"arrays": {**arrays, "head.shift": "AAAA"}}),
        "no base64": json.dumps(whole | {"arrays": {**arrays, "head.shift": "!!"}}),
        "infinite": json.dumps(whole | {"arrays": {**arrays, "head.shift": base64.b64encode(wild).decode()}}),
        "more classes": json.dumps(whole | {"classes": ["water", "green"]}),
    }


@pytest.mark.parametrize("fault", damaged())
def test_a_damaged_text_is_refused_in_one_line(fault):
    with pytest.raises(ValueError, match=r"learn again$") as caught:
        network.weights_of(damaged()[fault])
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_an_encoder_is_read_out_of_an_archive_and_out_of_a_learned_text(drawn_file, tmp_path):
    text = tmp_path / "unet.json"
    text.write_text(network.weights_text(("water",), network.drawn_weights(1, RNG(0))), encoding="utf-8")
    exact, rounded = network.read_encoder(drawn_file), network.read_encoder(text)
    assert exact.keys() == rounded.keys() == network.encoder_shapes().keys()
    for name, values in exact.items():
        np.testing.assert_allclose(rounded[name], values, rtol=1e-3, atol=1e-6)


def test_pickled_objects_in_an_archive_are_never_loaded(tmp_path):
    path = tmp_path / "encoder.npz"
    np.savez(path, **{"encoder.0.0.kernel": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(ValueError, match="holds no weights"):
        network.read_encoder(path)


def test_the_version_of_a_card_names_the_file_of_weights(drawn_file, tmp_path):
    other = tmp_path / "other.npz"
    other.write_bytes(drawn_file.read_bytes() + b"more")
    versions = [with_weights(path).card.version for path in (drawn_file, other, drawn_file)]
    assert versions[0] == versions[2] != versions[1]
    assert all(version.startswith("1+") for version in versions)
    with pytest.raises(ValueError, match=r"^mine: the file of its weights cannot be read"):
        with_weights(tmp_path / "none.npz")


# Crops, which need no torch


def test_a_crop_holds_the_labels_of_what_it_shows():
    rgb = np.zeros((300, 300, 3), dtype=np.uint8)
    rgb[100:200, 120:260] = 200
    labels = (rgb[None, :, :, 0] > 0).astype(np.uint8)
    picture = unet.LearningPicture(rgb=rgb, labels=labels, sample=rgb.reshape(-1, 3)[::20])
    for seed in range(5):
        planes, found = unet.Crops(pictures=[picture], classes=(0,)).batch(2, RNG(seed), is_by_class=True)
        assert planes.shape == (2, network.BANDS, unet.CROP_PX, unet.CROP_PX)
        bright, truth = planes[1, 0], found[1, 0]
        assert (truth == sgb.PRESENT).any()
        known = truth != sgb.UNKNOWN
        assert np.corrcoef(bright[known], truth[known])[0, 1] > 0.9


def test_beyond_a_picture_nothing_is_labelled():
    rgb = np.full((20, 20, 3), 90, dtype=np.uint8)
    picture = unet.LearningPicture(rgb=rgb, labels=np.zeros((1, 20, 20), dtype=np.uint8), sample=rgb[0])
    _, found = unet.Crops(pictures=[picture], classes=(0,)).batch(4, RNG(0), is_by_class=False)
    assert (found == sgb.UNKNOWN).mean() > 0.9
    assert (found == sgb.ABSENT).any()


def test_of_many_or_large_pictures_a_part_is_kept():
    large = with_picture(np.zeros((700, 900, 3), dtype=np.uint8))
    labelled = sgb.LabelledImage(image=large, classes=("water",), labels=np.zeros((1, 700, 900), np.uint8), place="x")
    kept = unet.LearningPicture.of(labelled, most_px=50, rng=RNG(0))
    assert kept.rgb.shape[:2] == kept.labels.shape[1:] == (50, 50)
    assert len(kept.sample) == 4000  # of the whole picture


@pytest.mark.parametrize("shape", [(1, 1), (33, 700), (512, 513), (1100, 40)])
def test_tiles_cover_a_picture_once_and_name_their_place_in_their_surroundings(shape):
    plane = RNG(0).random((1, *shape)).astype(np.float32)
    again = np.full_like(plane, np.nan)
    for inner, outer, cut in unet._tiles(*shape):
        assert np.isnan(again[:, *inner]).all()
        again[:, *inner] = unet._padded(plane[:, *outer])[:, *cut]
    np.testing.assert_array_equal(again, plane)


# With torch


def ranked(labelled, found, name):
    """Area under the ROC curve of a class where labels are known."""
    truth = labelled.labels[labelled.classes.index(name)]
    chances = found.probabilities()[found.classes.index(name)]
    known = truth != sgb.UNKNOWN
    return roc_auc_score(truth[known], chances[known])


@pytest.mark.usefixtures("torch")
def test_the_unet_tells_classes_of_a_place_that_it_has_not_seen(learned):
    for labelled in ASKED:
        found = UNet().segment(labelled.image, learned=learned)
        assert found.classes == labelled.classes
        assert found.shape == labelled.image.shape
        for name in ("building", "green"):
            assert ranked(labelled, found, name) > 0.8  # after 45 steps on two pictures


@pytest.mark.usefixtures("torch")
def test_the_same_pictures_teach_the_unet_the_same_text():
    texts = {small_unet(16).learn(sgb.ImageTraining(images=TAUGHT)) for _ in range(2)}
    assert len(texts) == 1


def test_what_nobody_has_labelled_teaches_nothing(torch):
    """Labels that are unknown leave the gradient alone, whatever the network says there."""
    odds = torch.zeros((1, 1, 2, 2), requires_grad=True)
    labels = torch.tensor([[[[sgb.PRESENT, sgb.UNKNOWN], [sgb.ABSENT, sgb.UNKNOWN]]]], dtype=torch.uint8)
    loss = unet._loss(torch, odds, labels)
    loss.backward()
    assert loss.item() == pytest.approx(math.log(2))
    np.testing.assert_allclose(odds.grad.numpy()[0, 0], [[-0.25, 0], [0.25, 0]])


@pytest.mark.usefixtures("torch")
def test_the_unet_refuses_in_one_line_what_it_cannot_use():
    picture = ASKED[0].image
    with pytest.raises(ValueError, match="needs training"):
        UNet().segment(picture, learned=None)
    with pytest.raises(ValueError, match="learn again"):
        UNet().segment(picture, learned='{"format": "another"}')
    unlabelled = sgb.LabelledImage(
        image=picture, classes=("water",), labels=np.full((1, *picture.shape), sgb.UNKNOWN, np.uint8), place="here"
    )
    with pytest.raises(ValueError, match="no class"):
        UNet().learn(sgb.ImageTraining(images=[unlabelled]))


@pytest.mark.usefixtures("torch")
def test_the_unet_is_silent_on_holes(learned):
    rgb = ASKED[0].image.rgb.copy()
    rgb[:, :40] = 0  # 35 m wide
    silent = np.isnan(UNet().segment(with_picture(rgb), learned=learned).probabilities()).all(axis=0)
    assert silent[:, :38].all()
    assert not silent[:, 42:].any()


@pytest.mark.usefixtures("torch")
def test_the_unet_begins_with_the_encoder_of_a_file(drawn_file):
    mine = with_weights(drawn_file)
    mine.most_crops = 8
    _, weights = network.weights_of(mine.learn(sgb.ImageTraining(images=TAUGHT)))
    given = network.read_encoder(drawn_file)["encoder.2.0.kernel"]
    assert np.corrcoef(weights["encoder.2.0.kernel"].ravel(), given.ravel())[0, 1] > 0.99
    mine.weights = drawn_file.with_name("none.npz")
    with pytest.raises(ValueError, match="holds no weights"):
        mine.learn(sgb.ImageTraining(images=TAUGHT))
