# SPDX-License-Identifier: Apache-2.0
"""The matcher `orienternet_template`: what it learns and finds, its posterior, and what it says in a line."""

import base64
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sasgeo_baselines import learned_template, orienternet_template
from sasgeo_baselines.learned_template import (
    CHANNELS,
    FULL,
    MARGIN,
    Encoders,
    TrainingExample,
    agreement,
    drawn_weights,
    shapes,
    surprise,
    transformed,
    turned,
    usual_shares,
    weights_of,
    weights_text,
)
from sasgeo_baselines.orienternet_template import (
    FeatureMap,
    OrienternetTemplate,
    Posterior,
    Surface,
    examples_of,
    map_planes,
    view_planes,
)

import sasgeo_bench as sgb
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import MOST_LEARNED_BYTES, WITHHELD, Training, check_match
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from tests.made_up import CLASSES, HERE, MadeUp, error_m, region_of, textured

PRIOR = Prior(center_m=(1240.0, 8760.0), radius_m=100.0, yaw_deg=80.0, yaw_sigma_deg=5.0, scale_sigma=0.03)
RNG = np.random.default_rng


class Town(MadeUp):
    """A made-up map that is cut as a region is."""

    def cuts(self, boxes):
        """Parts of the map, within its edges."""
        rows, cols = self.grid.shape
        for top, left, height, width in boxes:
            first, last = max(top, 0), max(left, 0)
            grid = self.grid.window(first, last, min(top + height, rows) - first, min(left + width, cols) - last)
            layers = self.layers[:, first : first + grid.rows, last : last + grid.cols]
            yield Town(layers=layers, grid=grid, classes=self.classes)


def town_of(seed: int) -> Town:
    return Town(**vars(region_of(textured(seed))))


@pytest.fixture(scope="module")
def town():
    return town_of(5)


def drawn_text(classes=CLASSES) -> str:
    """Weights that nothing was learned for, but for the usual shares of a made-up town."""
    weights = drawn_weights(len(classes))
    weights["usual"] = np.array([[0.2] * len(classes), [0.4] * len(classes)], dtype=np.float32)
    return weights_text(classes, weights)


def seen_from(made, region, pose):
    return made.view_of(region, pose, size_cells=128)


# Without torch


@pytest.mark.usefixtures("without_torch")
def test_the_matcher_says_in_one_line_that_torch_is_missing(town):
    for ask in (
        lambda: OrienternetTemplate().learn(Training(regions={}, pairs=())),
        lambda: OrienternetTemplate().prepare(town, drawn_text()),
    ):
        with pytest.raises(RuntimeError, match=r"^orienternet_template needs PyTorch.*sasgeo-baselines\[torch\]'$"):
            ask()


def test_the_matcher_says_in_one_line_that_it_must_be_taught_and_prepared(made, town):
    with pytest.raises(ValueError, match=r"^orienternet_template needs training: .*--train\)$"):
        OrienternetTemplate().prepare(town, None)
    with pytest.raises(RuntimeError, match="prepare"):
        OrienternetTemplate().match(made.query_of(seen_from(made, town, HERE), PRIOR), top_k=1)


def test_weights_are_read_back_as_half_precision_and_fit_into_a_learned_text():
    names = tuple(f"class_{number}" for number in range(24))
    weights = drawn_weights(len(names))
    text = weights_text(names, weights)
    assert len(text) < MOST_LEARNED_BYTES / 4
    classes, again = weights_of(text)
    assert classes == names
    assert again.keys() == weights.keys() == shapes(len(names)).keys()
    for name, values in weights.items():
        np.testing.assert_array_equal(again[name], values.astype(np.float16).astype(np.float32))


def damaged() -> dict[str, str]:
    whole = json.loads(drawn_text())
    arrays = whole["arrays"]
    wild = base64.b64encode(np.full(2, np.inf, dtype="<f2").tobytes()).decode()
    return {
        "cut off": json.dumps(whole)[:1000],
        "another format": json.dumps(whole | {"format": "unet 1"}),
        "an array too short": json.dumps(whole | {"arrays": arrays | {"sharpness": "AAA="}}),
        "no base64": json.dumps(whole | {"arrays": arrays | {"sharpness": "!!"}}),
        "infinite": json.dumps(whole | {"arrays": arrays | {"sharpness": wild}}),
        "no spread": json.dumps(whole | {"arrays": arrays | {"usual": base64.b64encode(bytes(12)).decode()}}),
        "more classes": json.dumps(whole | {"classes": ["water", *whole["classes"]]}),
    }


@pytest.mark.parametrize("fault", damaged())
def test_a_damaged_learned_text_is_refused_in_one_line(town, fault):
    with pytest.raises(ValueError, match=r"^orienternet_template: the learned text is damaged, .*: learn again$"):
        OrienternetTemplate().prepare(town, damaged()[fault])


def test_views_and_maps_are_shares_of_cells_of_four_metres():
    cells = np.full((2, 8, 8), UNKNOWN, dtype=np.uint8)
    cells[0, :4, :4], cells[0, :2, :4] = ABSENT, PRESENT
    planes, cells_m = view_planes(Evidence(classes=("water", "road"), cells=cells, cell_size_m=1.0), ("house", "water"))
    assert (planes.shape, cells_m) == ((4, 2, 2), (4.0, 4.0))
    assert planes[:, 0, 0].tolist() == [0, 128, 0, 128]
    assert not planes.reshape(4, 4)[:, 1:].any()
    layers = np.zeros((2, 8, 8), dtype=np.uint8)
    layers[1, :1, :4], layers[:, 4:, 4:] = 1, 255
    mapped, has, grid = map_planes(region_of(layers, classes=("road", "water")), ("house", "water"))
    assert (grid.cell_size_m, has.tolist()) == (4.0, [0.0, 1.0])
    assert mapped.tolist() == [[[0, 0], [0, 0]], [[64, 0], [0, 0]], [[255, 255], [255, 0]]]


def test_usual_shares_are_those_of_known_cells():
    mapped = np.array([[[255, 0, 255]], [[0, 0, 0]], [[255, 255, 0]]], dtype=np.uint8)
    has = np.array([1.0, 0.0], dtype=np.float32)
    example = TrainingExample(
        name="", view=mapped, cells_m=(4.0, 4.0), mapped=mapped, step_m=4.0, has=has, place=(0.0, 0.0), yaw_deg=0.0
    )
    np.testing.assert_allclose(usual_shares([example]), [[0.5, 0.0], [0.5, 0.01]], rtol=1e-5)


def test_the_mass_of_a_mode_is_that_of_all_places_near_it():
    """Places every 20 m: the next ones count for a mode, those at 40 m do not, and are the next mode."""
    likelihood = np.array([[8.0, 1.0, 4.0, 0.0, 2.0, 1.0]])
    grid = Grid(epsg=0, west_m=0.0, north_m=20.0, cell_size_m=20.0, rows=1, cols=6)
    with np.errstate(divide="ignore"):
        logs = np.log(likelihood).astype(np.float32)
    parts = [
        Surface(
            grid=grid.window(0, at, 1, 3),
            top=logs[:, at : at + 3],
            which=np.ones((1, 3), int),
            mass=logs[:, at : at + 3],
        )
        for at in (0, 3)
    ]
    posterior = Posterior(surfaces=parts, yaws_deg=[0.0, 90.0])
    peaks = posterior.peaks(9)
    assert [peak.pose.easting_m for peak in peaks] == [10.0, 50.0, 90.0]
    assert [peak.mass for peak in peaks] == pytest.approx([9 / 16, 5 / 16, 3 / 16])
    assert [peak.score for peak in peaks] == pytest.approx([math.log(8 / 16), math.log(4 / 16), math.log(2 / 16)])
    assert {peak.pose.yaw_deg for peak in peaks} == {90.0}
    shares = likelihood[likelihood > 0] / 16
    assert posterior.entropy_bits == pytest.approx(-(shares * np.log2(shares)).sum())


def marked_example(place=(100.25, 80.5), yaw_deg=30.0) -> TrainingExample:
    """A landmark 40 m north-east of the place, on the map, and in the view, which is 4 m out at most."""
    bearing = math.radians(45.0 - yaw_deg)
    view = np.zeros((2, 33, 33), dtype=np.uint8)
    view[1] = FULL
    row, col = 16 - round(10 * math.cos(bearing)), 16 + round(10 * math.sin(bearing))
    view[:, row - 1 : row + 2, col - 1 : col + 2] = np.array([FULL, 0])[:, None, None]
    mapped = np.zeros((2, 200, 180), dtype=np.uint8)
    mapped[1] = FULL
    row, col = round(place[0] - 7.07), round(place[1] + 7.07)
    mapped[0, row - 1 : row + 2, col - 1 : col + 2] = FULL
    return TrainingExample(
        name="marked",
        view=view,
        cells_m=(4.0, 4.0),
        mapped=mapped,
        step_m=4.0,
        has=np.ones(1, dtype=np.float32),
        place=place,
        yaw_deg=yaw_deg,
    )


@pytest.mark.parametrize("seed", range(6))
def test_a_turned_and_mirrored_scene_is_still_seen_from_its_pose(torch, seed):
    """The landmark of the view, laid on the map at the true place and heading, meets that of the map."""
    scene = marked_example().scene(RNG(seed), places=40)
    scene = replace(scene, view=np.where(scene.view.any(axis=0), scene.view, 0))
    assert scene.places == 40
    laid = turned(torch, torch.from_numpy(scene.view.copy()), scene.cells_m, [scene.yaw_deg], step_m=4.0)[0, 0].numpy()
    if laid.max() < 0.9:  # the hole hides it
        return
    row, col = (MARGIN + round(at) for at in scene.place)
    under = scene.mapped[0, row : row + len(laid), col : col + len(laid)]
    middles_m = [4.0 * np.average(np.argwhere(one > 0.5), axis=0) for one in (laid, under)]
    assert math.dist(*middles_m) < 8


def test_a_part_of_a_map_is_all_that_a_view_is_taught_on(made, town):
    taught = {}
    for pose in (HERE, replace(HERE, easting_m=1004.0)):
        query = made.query_of(seen_from(made, town, pose), PRIOR, query_id=f"{pose.easting_m}")
        (example,) = examples_of(town, [(query, SimpleNamespace(pose=pose))], CLASSES)
        taught[pose.easting_m] = example
        row, col = example.place
        assert col == pytest.approx((pose.easting_m - 1000.0) / 4 - 0.5)
        assert row == pytest.approx((9000.0 - pose.northing_m) / 4 - 0.5)
    off = replace(HERE, easting_m=900.0)
    query = made.query_of(seen_from(made, town, HERE), PRIOR)
    assert not list(examples_of(town, [(query, SimpleNamespace(pose=off))], CLASSES))
    assert not list(examples_of(town, [(query, SimpleNamespace(pose=HERE))], ("green",)))


# With torch


def test_a_landmark_in_the_east_is_at_the_top_of_a_view_that_heads_east(torch):
    view = torch.zeros((1, 5, 5))
    view[0, 0, 2] = 1.0  # 8 m ahead
    for yaw_deg, (north, east) in {0.0: (2, 0), 90.0: (0, 2), 180.0: (-2, 0), 270.0: (0, -2)}.items():
        laid = turned(torch, view, (4.0, 4.0), [yaw_deg], step_m=4.0)[0, 0].numpy()
        middle = len(laid) // 2
        assert laid[middle - north, middle + east] == pytest.approx(1.0, abs=1e-4)


def test_agreement_by_hand(torch):
    """At the place where three known cells lie on the map, two of which agree, it is 2 / 3; a step aside 1 / 2."""
    seen = np.zeros((1, CHANNELS + 1, 1, 3), dtype=np.float32)
    seen[0, 2, 0] = 1.0, 1.0, 1.0
    seen[0, CHANNELS, 0] = 1.0
    mapped = np.zeros((CHANNELS + 1, 2, 4), dtype=np.float32)
    mapped[2, 0] = 1.0, 1.0, 0.0, 7.0
    mapped[CHANNELS, 0] = 1.0, 1.0, 1.0, 0.0
    mapped[2, 0, 3] = 0.0  # unknown: as `Encoders.features` leaves it
    size = 4
    planes = (transformed(torch, torch.from_numpy(one), size) for one in (seen, mapped))
    means, known = agreement(torch, *planes, 2)
    np.testing.assert_allclose(known[0, 0].numpy(), [3.0, 2.0], atol=1e-5)
    np.testing.assert_allclose(means[0, 0].numpy(), [2 / 3, 1 / 2], atol=1e-5)


def test_poses_that_are_all_alike_surprise_by_the_logarithm_of_their_number(torch):
    weights = drawn_weights(1)
    weights["sharpness"][:] = -30.0, 0.0
    scene = marked_example().scene(RNG(0), places=40)
    found = surprise(Encoders.of(torch, ("house",), weights), scene, torch.ones(1), RNG(0))
    assert float(found) == pytest.approx(math.log(40 * 40 * learned_template._HEADINGS), abs=1e-4)


def test_what_is_unknown_is_no_part_of_a_template_and_a_class_that_a_map_lacks_tells_nothing(torch):
    encoders = Encoders.of(torch, CLASSES, weights_of(drawn_text())[1])
    view = RNG(1).random((6, 12, 12)).astype(np.float32) / 2
    view[:, :, :5] = 0
    template = encoders.template(torch.from_numpy(view)).numpy()
    assert not template[:, :, :5].any()
    assert template[CHANNELS, :, 5:].all()
    mapped = RNG(2).random((4, 12, 12)).astype(np.float32)
    mapped[3] = 1.0
    without = torch.tensor([1.0, 0.0, 1.0])
    first = encoders.features(torch.from_numpy(mapped * np.float32([1, 0, 1, 1])[:, None, None]), without).numpy()
    assert np.isfinite(first).all()
    mapped[1] = np.float32(weights_of(drawn_text())[1]["usual"][0, 1])  # the usual share of it
    usual = encoders.features(torch.from_numpy(mapped), torch.ones(3)).numpy()
    np.testing.assert_allclose(first, usual, atol=1e-3)


def test_a_map_that_is_encoded_in_pieces_is_that_of_one_piece(torch, town, monkeypatch):
    encoders = Encoders.of(torch, CLASSES, weights_of(drawn_text())[1])
    planes = map_planes(town, CLASSES)
    whole = FeatureMap.of(encoders, *planes).layers
    monkeypatch.setattr(orienternet_template, "_ENCODED", 40)
    np.testing.assert_allclose(FeatureMap.of(encoders, *planes).layers, whole, atol=1e-2)


def prepared_with(text, region) -> OrienternetTemplate:
    matcher = OrienternetTemplate()
    matcher.prepare(region, text)
    return matcher


@pytest.fixture(scope="module")
def drawn(torch, town):
    del torch
    return prepared_with(drawn_text(), town)


def test_the_posterior_sums_to_one_however_the_places_are_cut(made, town, drawn, monkeypatch):
    anywhere = replace(PRIOR, center_m=None, radius_m=None)
    view = drawn.look(made.query_of(seen_from(made, town, HERE), anywhere))
    disc = sgb.Disc(center_m=None, radius_m=0.0)
    whole = drawn.posterior(view, list(drawn._map.squares(disc)))
    monkeypatch.setattr(orienternet_template, "_TILE", 31)
    monkeypatch.setattr(orienternet_template, "_HEADINGS_KEPT", 3)
    tiled = drawn.posterior(view, list(drawn._map.squares(disc)))
    assert len(tiled.surfaces) > 1 == len(whole.surfaces)
    for posterior in (whole, tiled):
        total = sum(np.exp(one.mass.astype(np.float64) - posterior.total).sum() for one in posterior.surfaces)
        assert total == pytest.approx(1.0)
    assert tiled.total == pytest.approx(whole.total, abs=1e-3)
    assert tiled.entropy_bits == pytest.approx(whole.entropy_bits, abs=1e-2)
    for one, other in zip(whole.peaks(3), tiled.peaks(3), strict=True):
        assert one.pose == other.pose
        assert other.mass == pytest.approx(one.mass, abs=1e-3)


def test_answers_are_modes_with_their_probability(made, town, drawn):
    query = made.query_of(seen_from(made, town, HERE), PRIOR)
    answer = check_match(drawn.match(query, top_k=5), query, top_k=5)
    assert error_m(answer) < 5
    assert abs(answer.poses[0].yaw_deg - HERE.yaw_deg) < 5
    assert answer.confidence == answer.diagnostics["posterior_mass"]
    assert math.exp(answer.scores[0]) <= answer.confidence <= 1.0
    assert answer.diagnostics["entropy_bits"] > 0
    apart = [math.dist(*((one.easting_m, one.northing_m) for one in answer.poses[:2]))]
    assert min(apart) >= 25
    assert answer == check_match(drawn.match(query, top_k=5), query, top_k=5)


def test_what_tells_nothing_or_lies_off_the_map_is_withheld_and_a_view_of_one_cell_is_borne(made, town, drawn):
    seen = seen_from(made, town, HERE)
    blank = seen.replace(np.full_like(seen.cells, UNKNOWN))
    alien = Evidence(classes=("railway", "green", "coastline"), cells=seen.cells, cell_size_m=1.0)
    for evidence in (blank, alien):
        assert drawn.match(made.query_of(evidence, PRIOR), top_k=1) == WITHHELD
    far = replace(PRIOR, center_m=(9000.0, 9000.0))
    assert drawn.match(made.query_of(seen, far), top_k=1) == WITHHELD
    query = made.query_of(seen.replace(seen.cells[:, 64:65, 64:65].copy()), PRIOR)
    check_match(drawn.match(query, top_k=5), query, top_k=5)


# Learning


def contrary(evidence: Evidence) -> Evidence:
    """A view whose detector sees houses where there are none, and none where there are."""
    cells = evidence.cells.copy()
    cells[0] = np.where(cells[0] == PRESENT, ABSENT, PRESENT)
    return evidence.replace(cells)


def asked_of(made, region, name, count, seed):
    """Views with their truths, and priors that are off."""
    pairs = []
    for number, (east, north, yaw) in enumerate(RNG(seed).uniform((-60, -60, 0), (60, 60, 360), (count, 3)).tolist()):
        pose = Pose(easting_m=1210.0 + east, northing_m=8790.0 + north, yaw_deg=yaw)
        prior = replace(PRIOR, yaw_deg=yaw + 4.0)
        query = made.query_of(contrary(made.view_of(region, pose, size_cells=96)), prior, query_id=f"{name} {number}")
        pairs.append((replace(query, region=name), SimpleNamespace(pose=pose, is_present=True)))
    return pairs


@pytest.fixture
def quick(monkeypatch):
    """Learning of a few seconds."""
    monkeypatch.setattr(learned_template, "_PLACES", 32)
    monkeypatch.setattr(learned_template, "_HEADINGS", 6)

    def looks(count):
        monkeypatch.setattr(learned_template, "_MOST_LOOKS", count)
        monkeypatch.setattr(learned_template, "_LOOKS_EACH", count)

    return looks


@pytest.mark.usefixtures("torch")
def test_learning_finds_views_that_drawn_encoders_miss(made, quick):
    quick(200)
    regions = {name: town_of(seed) for name, seed in (("first", 6), ("second", 7))}
    pairs = [pair for name in regions for pair in asked_of(made, regions[name], name, 12, 3)]
    absent = (pairs[0][0], SimpleNamespace(pose=None, is_present=False))
    learned = OrienternetTemplate().learn(Training(regions=regions, pairs=[*pairs, absent]))
    assert len(learned) < MOST_LEARNED_BYTES
    other = town_of(5)
    asked = asked_of(made, other, "other", 10, 4)
    right = {}
    for name, text in (("drawn", drawn_text()), ("learned", learned)):
        matcher = prepared_with(text, other)
        right[name] = sum(error_m(matcher.match(query, top_k=1), truth.pose) < 25 for query, truth in asked)
    assert right["learned"] >= 8
    assert right["drawn"] <= 3


@pytest.mark.usefixtures("torch")
def test_the_same_views_teach_the_same_text(made, town, quick):
    quick(8)
    pairs = asked_of(made, town, "town", 4, 3)
    training = Training(regions={"town": town}, pairs=pairs)
    assert OrienternetTemplate().learn(training) == OrienternetTemplate().learn(training)


@pytest.mark.usefixtures("torch")
def test_where_no_view_lies_on_its_map_learning_says_so_in_one_line(made, town):
    query, _ = asked_of(made, town, "town", 1, 3)[0]
    nowhere = Training(regions={"town": town}, pairs=[(query, SimpleNamespace(pose=None, is_present=False))])
    with pytest.raises(ValueError, match=r"^orienternet_template: no view of training lies on its map") as caught:
        OrienternetTemplate().learn(nowhere)
    assert "\n" not in str(caught.value)
