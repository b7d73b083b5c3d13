# SPDX-License-Identifier: Apache-2.0
"""Confusions of a segmenter: measured, written, read, and met again in the views that are drawn with them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError, MetricError
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.scoring.perception_profile import measure_profile
from sasgeo_bench.scoring.segmentation import PixelCounts
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import with_picture
from sasgeo_bench.tasks.perturbations.measured import MEASURED, MeasuredPerception, Silence
from sasgeo_bench.tasks.perturbations.perception import perception_of, silent_profile
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
    perception = profile.perception()
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


@pytest.fixture(scope="module")
def answers():
    """Labels of two classes, some unknown, and what a segmenter says of them: more on what is there, some nothing."""
    rng = np.random.default_rng(2)
    labels = rng.choice([0, 1, UNKNOWN], p=[0.6, 0.3, 0.1], size=(2, 40, 50)).astype(np.uint8)
    bytes_ = np.clip(rng.normal(90 + 60 * (labels == PRESENT), 40), 0, 254).astype(np.uint8)
    bytes_[1, :3] = 255
    return labels, bytes_


def measured_silence(answers, silence):
    labels, bytes_ = answers
    picture = with_picture(np.zeros((*labels.shape[1:], 3), dtype=np.uint8))
    labelled = LabelledImage(image=picture, classes=CLASSES[:2], labels=labels, place="here")
    counts = PixelCounts.of(labelled, Segmentation(classes=CLASSES[:2], probability_bytes=bytes_), image="1")
    return measure_profile([counts], segmenter="mine", learned_from="elsewhere", silence=silence)


@pytest.mark.parametrize("silence", [0.001, 0.05, 0.2, 0.5, 0.99])
def test_what_is_withheld_is_what_one_limit_on_all_answers_leaves_out(answers, silence):
    labels, bytes_ = answers
    answered = (labels != UNKNOWN) & (bytes_ != 255)
    sure = np.abs(bytes_.astype(int) - 127)
    limit = next(at for at in range(128) if (sure[answered] <= at).mean() >= silence)
    withheld, seen = sure <= limit, bytes_ >= 127
    found = measured_silence(answers, silence)
    assert found.silence == silence
    for at, name in enumerate(CLASSES[:2]):
        for key, is_there, is_seen in (("found", 1, 1), ("missed", 1, 0), ("alarm", 0, 1), ("absent", 0, 0)):
            where = answered[at] & ((labels[at] == PRESENT) == is_there) & (seen[at] == is_seen)
            assert getattr(found.classes[name].silent, key) == pytest.approx(withheld[at][where].mean()), (name, key)


def test_rates_are_of_all_answers_with_silence_and_without_it(answers):
    silent, plain = measured_silence(answers, 0.3), measured_silence(answers, 0.0)
    assert "silent" not in str(plain.model_dump())
    for name, found in plain.classes.items():
        assert silent.classes[name].model_dump(exclude={"silent"}) == found.model_dump()


def test_answers_that_never_came_are_never_given():
    half = np.full((3, SIDE, SIDE), 130, dtype=np.uint8)
    picture = with_picture(np.zeros((SIDE, SIDE, 3), dtype=np.uint8))
    labelled = LabelledImage(image=picture, classes=CLASSES, labels=town(), place="here")
    half[0] = 200
    counts = PixelCounts.of(labelled, Segmentation(classes=CLASSES, probability_bytes=half), image="1")
    profile = measure_profile([counts], segmenter="mine", learned_from="elsewhere", silence=0.1)
    assert profile.classes["building"].silent == Silence(found=0.0, missed=1.0, alarm=0.0, absent=1.0)
    assert profile.classes["green"].silent == Silence(found=1.0, missed=1.0, alarm=1.0, absent=1.0)


@pytest.mark.parametrize("silence", [-0.1, 1.0, float("nan")])
def test_a_share_to_withhold_that_is_none_is_refused(answers, silence):
    with pytest.raises(MetricError, match="silence is a share of the answers, at least 0 and below 1, got"):
        measured_silence(answers, silence)


@pytest.fixture(scope="module")
def quiet(profile):
    """The same profile, silent on buildings and roads."""
    shares = {
        "building": Silence(found=0.4, missed=0.5, alarm=0.8, absent=0.03),
        "road_minor": Silence(found=0.1, missed=0.0, alarm=0.6, absent=0.0),
    }
    classes = {name: profile.classes[name].model_copy(update={"silent": each}) for name, each in shares.items()}
    return profile.model_copy(update={"silence": 0.05, "classes": classes})


def test_views_are_silent_in_the_shares_of_the_profile_and_have_the_errors_they_have_without(quiet):
    view = Evidence(classes=CLASSES, cells=town(), cell_size_m=1.0)
    spoken = dataclasses.replace(quiet.perception(), silence={})
    pairs = [
        (spoken(view, np.random.default_rng(seed)).cells, quiet.perception()(view, np.random.default_rng(seed)).cells)
        for seed in range(20)
    ]
    for before, after in pairs:
        np.testing.assert_array_equal(after[after != UNKNOWN], before[after != UNKNOWN])
    was, now = (np.stack(some, axis=1) for some in zip(*pairs, strict=True))
    for at, name in enumerate(CLASSES[:2]):
        there, seen, silent = town()[at] == PRESENT, was[at] == PRESENT, now[at] == UNKNOWN
        for key, where in (
            ("found", there & seen),
            ("missed", there & ~seen),
            ("alarm", ~there & seen),
            ("absent", ~there & ~seen),
        ):
            if where.any():
                assert silent[where].mean() == pytest.approx(getattr(quiet.classes[name].silent, key), abs=0.01)
    assert (now[2] == UNKNOWN).all()  # it has no rates of green


def test_silence_lies_along_the_outlines_of_what_is_seen(quiet):
    cells = np.zeros((1, 120, 120), dtype=np.uint8)
    cells[0, 20:100, 20:100] = 1
    view = Evidence(classes=("building",), cells=cells, cell_size_m=1.0)
    inner = np.zeros((120, 120), dtype=bool)
    inner[40:80, 40:80] = True
    silent = [quiet.perception()(view, np.random.default_rng(seed)).cells[0] == UNKNOWN for seed in range(10)]
    outer = ~inner & (cells[0] == PRESENT)
    assert np.mean([some[inner].mean() for some in silent]) < 0.3 * np.mean([some[outer].mean() for some in silent])


def test_what_is_unknown_before_stays_so_and_counts_in_no_share(quiet):
    cells = town()
    cells[:, :, :80] = UNKNOWN
    view = Evidence(classes=CLASSES, cells=cells, cell_size_m=1.0)
    spoken = dataclasses.replace(quiet.perception(), silence={})
    for seed in range(5):
        before, after = (some(view, np.random.default_rng(seed)).cells for some in (spoken, quiet.perception()))
        assert (after[:, :, :80] == UNKNOWN).all()
        absent = (cells[0] == 0) & (before[0] == 0)
        assert (after[0][absent] == UNKNOWN).mean() == pytest.approx(0.03, abs=0.01)


def test_a_perfect_detector_is_not_silent(quiet):
    view = Evidence(classes=CLASSES, cells=town(), cell_size_m=1.0)
    assert quiet.perception(error_factor=0.0)(view, np.random.default_rng(1)) is view


def test_silence_comes_back_from_its_file(quiet, tmp_path):
    write_profile(quiet, tmp_path / "quiet.toml")
    again = read_profile(tmp_path / "quiet.toml")
    assert again.silence == quiet.silence
    assert {name: each.silent for name, each in again.classes.items()} == {
        name: each.silent for name, each in quiet.classes.items()
    }
    text = (tmp_path / "quiet.toml").read_text(encoding="utf-8")
    for old, new in (("silence = 0.05\n", ""), ("alarm = 0.8", "alarm = 1.8")):
        (tmp_path / "wrong.toml").write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(ConfigError, match=r"silence needs the shares 'silent'|building\.silent\.alarm") as caught:
            read_profile(tmp_path / "wrong.toml")
        assert "\n" not in str(caught.value)


def test_stored_profiles_without_silence_keep_their_bytes(tmp_path):
    stored = sorted(Path("docs/results/segmenters/profiles").glob("*.toml"))
    for path in stored:
        write_profile(read_profile(path), tmp_path / path.name)
    assert stored
    assert [path.name for path in stored if (tmp_path / path.name).read_bytes() != path.read_bytes()] == []


def test_the_detector_silent_draws_with_the_profile_that_ships():
    view = Evidence(classes=(*CLASSES, "waterway"), cells=np.concatenate((town(), town()[1:2])), cell_size_m=1.0)
    after = perception_of("silent")(view, np.random.default_rng(1))
    expected = silent_profile().perception()(view, np.random.default_rng(1))
    np.testing.assert_array_equal(after.cells, expected.cells)
    assert (after.layer("waterway") == UNKNOWN).all()  # its segmenter does not tell waterways
    assert 0.01 < (after.layer("building") == UNKNOWN).mean() < 0.3


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
