# SPDX-License-Identifier: Apache-2.0
"""Matchers of tiles by a learned embedding: parts worked by hand, what kinds of examples teach, what they find."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sasgeo_baselines.embedding import NUMBERS, STRIDE, Embedding, Ground, fitted
from sasgeo_baselines.lcm_balanced import LcmBalanced
from sasgeo_baselines.polar import CELL_M, described
from sasgeo_baselines.sues_multi_height import SuesMultiHeight
from sasgeo_baselines.u1652_instance_retrieval import U1652InstanceRetrieval

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import MOST_LEARNED_BYTES, Training, check_match
from tests.baselines.worlds import PRIOR, things
from tests.made_up import error_m

MATCHERS = (U1652InstanceRetrieval, SuesMultiHeight, LcmBalanced)
WITHIN_M = STRIDE * CELL_M * 0.71  # half a diagonal of the lattice


@pytest.fixture(scope="module")
def region():
    return things().region


@pytest.fixture(scope="module")
def ground(region):
    return Ground.of(region)


@pytest.fixture(scope="module")
def training(made):
    """Three places of another map, each seen from two headings."""
    other = made.region_of(made.textured(6))
    places = [(1150.0, 8850.0), (1230.0, 8750.0), (1290.0, 8830.0)]
    poses = [Pose(easting_m=e, northing_m=n, yaw_deg=yaw) for e, n in places for yaw in (20.0, 200.0)]
    queries = [replace(made.query_of(seen_from(made, other, pose), PRIOR), region="other") for pose in poses]
    truths = [SimpleNamespace(pose=pose) for pose in poses]
    return Training(regions={"other": other}, pairs=tuple(zip(queries, truths, strict=True)))


@pytest.fixture(scope="module")
def learned(training):
    """What each kind learns, with few locations that no view shows."""
    return {kind: small(kind).learn(training) for kind in MATCHERS}


def small(kind, *, others=36):
    matcher = kind()
    matcher.others = others
    matcher.made_up = min(kind.made_up, 12)
    matcher.copies = min(kind.copies, 12)
    return matcher


def seen_from(made, region, pose):
    return made.view_of(region, pose, size_cells=192)


def test_a_tile_on_the_lattice_is_what_the_gallery_has_there(region, ground):
    rows = list(described(region, stride=STRIDE))
    row, col = 8, 5
    place = Pose(easting_m=1000.0 + col * STRIDE * CELL_M, northing_m=9000.0 - row * STRIDE * CELL_M, yaw_deg=0.0)
    np.testing.assert_allclose(ground.tiles([place])[0], rows[row][col], atol=0.003)


def test_beyond_the_map_nothing_is(ground):
    far = Pose(easting_m=9000.0, northing_m=0.0, yaw_deg=0.0)
    assert not ground.tiles([far]).any()
    assert ground.tiles([]).shape == (0, NUMBERS)


def test_a_feature_by_hand():
    """Two numbers differ from the mean by 3 and 16, 3 and 8 spreads; one is doubled; what is unknown adds nothing."""
    mean, spread, weights = np.zeros(NUMBERS), np.ones(NUMBERS), np.zeros((NUMBERS, 128))
    mean[:2], spread[1], weights[0, 0], weights[1, 1] = 1.0, 2.0, 2.0, 1.0
    row = mean.copy()
    row[:3] = 4.0, 17.0, np.nan
    found = Embedding(mean=mean, spread=spread, weights=weights).features(row[None])[0]
    assert found[:3].tolist() == pytest.approx([0.6, 0.8, 0.0])
    plain = Embedding(mean=mean, spread=spread)
    assert plain.features(row[None])[0, :3].tolist() == pytest.approx([3 / 73**0.5, 8 / 73**0.5, 0.0])
    assert not plain.features(mean[None]).any()


def examples(rng, count):
    """Made-up locations of nine descriptors each; in 20 directions these differ more than locations do."""
    across = np.linalg.qr(np.random.default_rng(1).normal(size=(NUMBERS, 20)))[0].T
    own = rng.normal(0.5, 0.1, (count, 1, NUMBERS)) + rng.normal(0.0, 2.0, (count, 9, len(across))) @ across
    return list((own + rng.normal(0.0, 0.02, own.shape)).astype(np.float16))


def test_taught_it_ranks_new_locations_better_than_untaught():
    rng = np.random.default_rng(2)
    known, new = examples(rng, 150), np.stack(examples(rng, 60))
    taught = fitted(known, shrinkage=0.3, size=128)
    plain = replace(taught, weights=None)
    likest = [(made.features(new[:, 1]) @ made.features(new[:, 0]).T).argmax(axis=1) for made in (taught, plain)]
    right_taught, right_plain = ((rows == np.arange(len(new))).sum() for rows in likest)
    assert right_taught > 50
    assert right_plain < 20


@pytest.mark.parametrize(("shrinkage", "size"), [(0.1, 64), (0.9, 128)])
def test_directions_are_discriminants_whose_signs_are_decided(shrinkage, size):
    """Directions tell apart no more than the means of locations do, and of like variance within locations."""
    known = examples(np.random.default_rng(3), 70)
    found = fitted(known, shrinkage=shrinkage, size=size)
    assert found.weights.shape == (NUMBERS, min(size, len(known) - 1))
    assert (found.weights.max(axis=0) == np.abs(found.weights).max(axis=0)).all()
    parts = [found.standard(rows) for rows in known]
    within = np.concatenate([rows - rows.mean(axis=0) for rows in parts])
    shrunk = within.T @ within / len(within)
    shrunk += shrinkage * np.trace(shrunk) / NUMBERS * np.eye(NUMBERS)
    np.testing.assert_allclose(found.weights.T @ shrunk @ found.weights, np.eye(found.weights.shape[1]), atol=1e-3)
    means = np.stack([rows.mean(axis=0) for rows in parts]) @ found.weights
    between = np.cov(means, rowvar=False)
    assert (np.diff(np.diag(between)) <= 1e-3).all()
    assert np.abs(between - np.diag(np.diag(between))).max() < 1e-3 * between[0, 0]


def test_locations_that_are_all_alike_teach_something_finite():
    found = fitted([np.full((3, NUMBERS), 0.5, dtype=np.float16)] * 4, shrinkage=0.1, size=64)
    assert np.isfinite(Embedding.read(found.to_text(), name="x").weights).all()


@pytest.mark.parametrize("kind", MATCHERS)
def test_a_view_is_found_on_another_map_than_those_of_training(region, learned, kind):
    matcher = kind()
    matcher.prepare(region, learned[kind])
    query = things().query(192)
    answer = check_match(matcher.match(query, top_k=5), query, top_k=5)
    assert error_m(answer) < WITHIN_M
    assert answer == check_match(matcher.match(query, top_k=5), query, top_k=5)


def test_the_same_training_gives_the_same_text_and_it_is_small(training, learned):
    for kind, text in learned.items():
        assert len(text.encode()) < MOST_LEARNED_BYTES / 3
        assert Embedding.read(text, name="x").weights.shape == (NUMBERS, 38)  # of 39 locations
        first, again = (small(kind, others=4).learn(training) for _ in range(2))
        assert first == again != text


def test_training_without_a_place_teaches_nothing(training):
    nowhere = Training(
        regions=training.regions, pairs=[(query, SimpleNamespace(pose=None)) for query, _ in training.pairs]
    )
    with pytest.raises(ValueError, match=r"^lcm_balanced: training shows 0 locations, expected two at least$"):
        LcmBalanced().learn(nowhere)


@pytest.mark.parametrize("damage", ["cut", "changed", "other", "no JSON", "list"])
def test_a_damaged_text_is_refused_in_one_line(region, learned, damage):
    text = learned[U1652InstanceRetrieval]
    saved = json.loads(text)
    numbers = saved["numbers"]
    broken = {
        "cut": json.dumps(saved | {"numbers": numbers[:-10]}),
        "changed": json.dumps(saved | {"numbers": numbers[:70] + ("1" if numbers[70] == "0" else "0") + numbers[71:]}),
        "other": json.dumps(saved | {"format": "embedding 0"}),
        "no JSON": text[:-1],
        "list": "[]",
    }[damage]
    with pytest.raises(ValueError, match=r"^u1652_instance_retrieval: the learned text is damaged, .*: learn again$"):
        U1652InstanceRetrieval().prepare(region, broken)


def likeness(text, one, other):
    """Mean cosine of pairs of descriptors, less that of descriptors of different places."""
    first, second = (Embedding.read(text, name="x").features(rows) for rows in (one, other))
    cosine = first @ second.T
    return np.diag(cosine).mean() - cosine[~np.eye(len(cosine), dtype=bool)].mean()


def test_turned_copies_teach_to_bear_turns_and_heights_to_bear_heights(ground, learned):
    rng = np.random.default_rng(3)
    poses = [
        Pose(easting_m=1210.0 + east, northing_m=8790.0 + north, yaw_deg=0.0)
        for east, north in rng.uniform(-110.0, 110.0, (20, 2)).tolist()
    ]
    upright = ground.tiles(poses)
    turned = ground.tiles([replace(pose, yaw_deg=90.0) for pose in poses])
    higher = ground.tiles([replace(pose, scale=1.4) for pose in poses])
    plain = learned[U1652InstanceRetrieval]
    assert likeness(learned[LcmBalanced], upright, turned) > 2 * likeness(plain, upright, turned)
    assert likeness(learned[SuesMultiHeight], upright, higher) > 1.1 * likeness(plain, upright, higher)
