# SPDX-License-Identifier: Apache-2.0
"""Self-training: labels turn with their picture, the question is as vague as it says, and who teaches in which way."""

import numpy as np
import pytest
from sasgeo_baselines.segmenters.osm_unet import CLASSES

import sasgeo_bench as sgb
from benchmarks import self_train
from benchmarks.segmenter_lessons import SIDE_PX, Source, batches
from benchmarks.self_train import Answered, Fixes, asked, evidence_of, key_of, placed, ways_of
from sasgeo_bench.regions.evidence import PRESENT, LayerBits, observe
from sasgeo_bench.regions.region_files import read_region
from tests import world
from tests.regions.imagery_place import make_hamlet

POSE = sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)


@pytest.fixture(scope="module")
def hamlet(tmp_path_factory):
    root, place = tmp_path_factory.mktemp("out"), make_hamlet(tmp_path_factory.mktemp("hamlet"))
    world.built(place.spec(), root, extract_folders=[place.folder], imagery_folders=[place.folder])
    return read_region(root / "regions" / "hamlet")


def answered(chance=1.0, *, is_right=True):
    """A picture whose first class is where it is bright under the truth, and nowhere under the answer."""
    bright = np.random.default_rng(1).random((SIDE_PX + 40, SIDE_PX + 40)) < 0.3
    truth = np.stack([bright, np.zeros_like(bright)]).astype(np.uint8)
    return Answered(
        rgb=np.repeat(bright[..., None] * np.uint8(255), 3, axis=2),
        classes=("building", "water"),
        answer=np.zeros_like(truth),
        truth=truth,
        pose=POSE,
        chance=chance,
        is_right=is_right,
    )


def test_labels_turn_with_their_picture():
    rng, seen = np.random.default_rng(2), set()
    for _ in range(40):
        crop = answered().crop(rng, is_true=True)
        np.testing.assert_array_equal(crop.rgb[..., 0] == 255, crop.labels[0] == PRESENT)
        assert crop.rgb.shape == (SIDE_PX, SIDE_PX, 3)
        seen.add(crop.rgb.tobytes())
    assert len(seen) > 35
    assert not answered().crop(rng, is_true=False).labels.any()


def test_an_answered_view_teaches_as_a_picture_does():
    fixes = Fixes(views=(answered(),), share=1.0, is_true=True)
    planes, wanted, weights = next(batches([fixes], 0, 2, steps=1))
    assert planes.shape == (2, 3, SIDE_PX, SIDE_PX)
    building = CLASSES.index("building")
    assert 0.2 < wanted[:, building].mean() < 0.4
    assert weights[:, building].all()


def test_each_way_asks_its_teachers_once_in_all():
    views = [answered(0.95), answered(0.9, is_right=False), answered(0.5)]
    before = [Source((), 0.7), Source((), 0.3)]
    ways = ways_of(views, 0.9, before)
    assert list(ways) == ["teachers", "accepted", "all", "true"]
    for sources in ways.values():
        assert sum(one.share for one in sources) == pytest.approx(1)
    assert {way: len(sources[-1].views) for way, sources in ways.items() if way != "teachers"} == {
        "accepted": 2,
        "all": 3,
        "true": 3,
    }
    assert [ways[way][-1].is_true for way in ("accepted", "all", "true")] == [False, False, True]


def test_a_kept_state_is_known_by_all_that_it_was_taught_by(tmp_path):
    begin, other = tmp_path / "a.pt", tmp_path / "b.pt"
    begin.write_bytes(b"a")
    other.write_bytes(b"b")
    fixes = [Fixes(views=(answered(chance),), share=0.5) for chance in (0.9, 0.9, 0.8)]
    keys = [key_of([one], begin, 500, 1e-3) for one in fixes]
    assert keys[0] == keys[1]
    assert len({*keys, key_of(fixes[:1], other, 500, 1e-3), key_of(fixes[:1], begin, 500, 1e-4)}) == 4


def test_the_prior_is_off_by_as_much_as_it_says(hamlet):
    seen = evidence_of(sgb.Segmentation.of_probabilities(("building",), np.full((1, 8, 8), 0.25, dtype=np.float32)))
    rng = np.random.default_rng(3)
    priors = [asked(hamlet, seen, POSE, rng).prior for _ in range(200)]
    far_m = np.array([np.hypot(*prior.center_m) for prior in priors])
    assert far_m.max() <= self_train.RADIUS_M
    assert np.median(far_m) == pytest.approx(self_train.RADIUS_M / np.sqrt(2), rel=0.1)  # even over the disc
    turned = (np.array([prior.yaw_deg for prior in priors]) + 180) % 360 - 180
    assert np.std(turned) == pytest.approx(self_train.YAW_SIGMA_DEG, rel=0.15)


def test_evidence_is_the_mean_of_its_pixels():
    chances = np.random.default_rng(4).random((2, 6, 8))
    seen = evidence_of(sgb.Segmentation.of_probabilities(("building", "water"), chances))
    assert (seen.shape, seen.cell_size_m) == ((3, 4), 1.0)
    np.testing.assert_allclose(seen.probabilities(), chances.reshape(2, 3, 2, 4, 2).mean(axis=(2, 4)), atol=2 / 255)


def test_a_view_lies_where_its_middle_is_said_to_be(hamlet, monkeypatch):
    monkeypatch.setattr(self_train, "VIEW_PX", 64)
    bits, off_m, count = LayerBits.of(hamlet.layers), np.array(hamlet.imagery.off_m), 0
    for view, middle_m in placed(hamlet, (0.0, 1.0, 0.0, 1.0)):
        east_m, north_m = (middle_m - off_m).tolist()
        pose = sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=0.0)
        mapped = observe(bits, hamlet.grid, pose, size_cells=64, cell_size_m=0.5)
        is_known = (view.labels <= PRESENT) & (mapped <= PRESENT)
        assert (view.labels == mapped)[is_known].mean() > 0.97  # cells of a metre against pixels of half of one
        count += 1
    assert count > 2
