# SPDX-License-Identifier: Apache-2.0
"""Confusions of a segmenter: measured, written, read, and met again in the views that are drawn with them."""

from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError, MetricError
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.scoring.perception_profile import measure_profile
from sasgeo_bench.scoring.segmentation import PixelCounts
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import with_picture
from sasgeo_bench.tasks.perturbations.measured import MEASURED, MeasuredPerception
from sasgeo_bench.tasks.perturbations.perception_profile import read_profile, write_profile

CLASSES = ("building", "road_minor", "green")
SIDE = 160


def town():
    """Labels of houses, roads and a wood, shape (3, SIDE, SIDE)."""
    labels = np.zeros((3, SIDE, SIDE), dtype=np.uint8)
    building, road, green = labels
    for row in range(10, 100, 30):
        road[row + 16 : row + 21] = 1
        for col in range(5, 150, 24):
            building[row : row + 12, col : col + 14] = 1
    green[115:] = 1
    return labels


def seen_with(rates, rng):
    """What a segmenter sees that errs at each pixel alone, at known rates."""
    labels = town()
    building, road, green = labels.astype(bool)
    found = labels.astype(bool).copy()
    found[0] &= rng.random((SIDE, SIDE)) < rates["recall"]
    found[1] |= building & ~found[0] & (rng.random((SIDE, SIDE)) < rates["called"])
    found[2] |= road & (rng.random((SIDE, SIDE)) < rates["also"])
    found[0] |= ~(building | road | green) & (rng.random((SIDE, SIDE)) < rates["of_ground"])
    return found


@pytest.fixture(scope="module")
def profile():
    rng = np.random.default_rng(1)
    picture = with_picture(np.zeros((SIDE, SIDE, 3), dtype=np.uint8))
    labelled = LabelledImage(image=picture, classes=CLASSES, labels=town(), place="here")
    rates = {"recall": 0.8, "called": 0.5, "also": 0.2, "of_ground": 0.06}
    some = [
        PixelCounts.of(
            labelled,
            Segmentation(classes=CLASSES, probability_bytes=(seen_with(rates, rng) * 254).astype(np.uint8)),
            image=str(at),
        )
        for at in range(3)
    ]
    return measure_profile(some, segmenter="mine", learned_from="elsewhere")


def test_a_profile_has_the_rates_that_errors_were_made_with(profile):
    building, road = profile.classes["building"], profile.classes["road_minor"]
    assert building.recall == pytest.approx(0.8, abs=0.01)
    assert building.called == {"road_minor": pytest.approx(0.1, abs=0.01)}
    assert building.of_ground == pytest.approx(0.06, abs=0.01)
    assert building.also == {}
    assert (road.recall, road.of_ground, road.called) == (1.0, 0.0, {})
    assert road.also == {"green": pytest.approx(0.2, abs=0.02)}
    assert profile.tested_on == "here"


def test_a_profile_comes_back_from_its_file_up_to_its_digits(profile, tmp_path):
    write_profile(profile, tmp_path / "mine.toml")
    again = read_profile(tmp_path / "mine.toml")
    assert again.model_dump(exclude={"classes"}) == profile.model_dump(exclude={"classes"})
    for name, before in profile.classes.items():
        after = again.classes[name]
        for key in ("called", "also"):
            assert getattr(after, key) == pytest.approx(getattr(before, key), abs=1e-5)
        for key in ("pixels", "recall", "precision", "of_ground"):
            assert getattr(after, key) == pytest.approx(getattr(before, key), abs=1e-5)


def test_views_drawn_with_a_profile_have_its_rates(profile):
    view = Evidence(classes=CLASSES, cells=town(), cell_size_m=1.0)
    perception = MeasuredPerception(errors=profile.errors())
    after = [perception(view, np.random.default_rng(seed)).cells == PRESENT for seed in range(40)]
    building, road, green = town().astype(bool)
    ground = ~(building | road | green)

    def share(which, where):
        return np.mean([some[CLASSES.index(which)][where].mean() for some in after])

    assert share("building", building) == pytest.approx(0.8, abs=0.06)
    assert share("road_minor", building) == pytest.approx(0.1, abs=0.05)
    assert share("building", ground) == pytest.approx(0.06, abs=0.02)
    assert share("green", road) == pytest.approx(0.2, abs=0.08)
    assert share("road_minor", road) == pytest.approx(1.0, abs=0.01)


def test_without_a_profile_nothing_changes():
    view = Evidence(classes=CLASSES, cells=town(), cell_size_m=1.0)
    first, second = (
        some(view, np.random.default_rng(3)) for some in (MeasuredPerception(), MeasuredPerception(errors=MEASURED))
    )
    np.testing.assert_array_equal(first.cells, second.cells)


def test_a_file_that_is_no_profile_is_refused_in_one_line(tmp_path):
    wrong = tmp_path / "wrong.toml"
    with pytest.raises(ConfigError, match="cannot be read"):
        read_profile(wrong)
    head = 'segmenter = "a"\nlearned_from = "b"\ntested_on = "c"\nimages = 1\n'
    rates = "[class.water]\npixels = 9\nrecall = 0.9\nprecision = 0.9\nof_ground = 0.1\n"
    wrong.write_text(f"{head}{rates}called = {{ green = 0.4 }}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="more than 1"):
        read_profile(wrong)
    wrong.write_text(f"version = 9\n{head}{rates}", encoding="utf-8")
    with pytest.raises(ConfigError, match="measure the profile anew"):
        read_profile(wrong)


def test_a_profile_needs_images_that_label_the_same_classes():
    with pytest.raises(MetricError, match="one at least"):
        measure_profile([], segmenter="mine", learned_from="elsewhere")


@pytest.mark.parametrize("place", ["[class.castle]", "called", "also"])
def test_a_profile_of_a_class_that_is_none_is_refused(tmp_path, place):
    wrong = tmp_path / "wrong.toml"
    head = 'version = 1\nsegmenter = "a"\nlearned_from = "b"\ntested_on = "c"\nimages = 1\n'
    rates = "pixels = 9\nrecall = 0.9\nprecision = 0.9\nof_ground = 0.1\n"
    more = "" if place.startswith("[") else f"{place} = {{ castle = 0.05 }}\n"
    wrong.write_text(f"{head}{place if not more else '[class.water]'}\n{rates}{more}", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"has rates of castle, which is no class: choose of .*water"):
        read_profile(wrong)


def test_what_is_no_file_or_far_too_large_is_not_read_as_a_profile(tmp_path):
    large = tmp_path / "large.toml"
    large.write_bytes(b"#" * 2_000_000)
    for path in (tmp_path, large, Path("/dev/zero")):
        with pytest.raises(ConfigError, match="is no perception profile: expected a file of at most 1000000 bytes"):
            read_profile(path)
