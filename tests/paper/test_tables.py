# SPDX-License-Identifier: Apache-2.0
"""The paper's experiment: its protocol measured on what was made, the same bytes again, and nothing that tells."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
import shapely
from sasgeo_paper import made_paper_task, make_paper_task, task
from sasgeo_paper.task import VERSION, region_name
from sasgeo_paper.tiles import (
    CANDIDATES,
    CLASSES,
    GAP_M,
    MARGIN_M,
    STEP_M,
    TILE_M,
    TILES,
    WINDOW_CELLS,
    WINDOW_M,
    Windows,
    draw_tile,
    mosaic_grid,
    tile_centre_m,
)
from sasgeo_paper.trials import (
    CHANGE_FACTORS,
    Transformation,
    draw_crops,
    draw_view,
    map_change,
    rectangle,
)

from sasgeo_bench.core.errors import ConfigError, PerturbError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.regions.layers import OUTSIDE
from sasgeo_bench.regions.region import DATA_VERSION, SCHEMA_VERSION
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import check_task
from sasgeo_bench.tasks.query import TASK_VERSION, PriorGroup
from sasgeo_bench.tasks.sheet import panels_of
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Seeds

FEW = 4
DRAWS = 3000


def make(out, seed=42, trials=FEW):
    return make_paper_task(seed=seed, out=out, trials=trials)


def content(out, *kinds):
    """Every file below some folders of a root, locks left out."""
    found = (path for kind in kinds for path in sorted((out / kind).rglob("*")) if path.is_file())
    return {str(path.relative_to(out)): path.read_bytes() for path in found if path.suffix != ".lock"}


def pairs_of(out, seed=42, suite="paper-poc"):
    name = region_name(seed)
    queries = task_files.read_queries(out / "tasks" / suite / name)
    truths = task_files.read_truths(out / "truth" / suite / name)
    return list(zip(queries, truths, strict=True))


def places_m(query):
    return np.array([(pose.easting_m, pose.northing_m) for pose in query.candidates])


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    root = tmp_path_factory.mktemp("paper") / "out"
    make(root, trials=220)
    return root


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    root = tmp_path_factory.mktemp("other") / "out"
    make(root, seed=43)
    return root


@pytest.fixture(scope="module")
def pairs(out):
    return pairs_of(out)


@pytest.fixture(scope="module")
def region(out):
    return region_files.read_region(out / "regions" / "paper-poc-42")


@pytest.fixture(scope="module")
def windows(region):
    return Windows.of(region)


@pytest.fixture(scope="module")
def drawn(windows):
    """Candidates of many trials, without their views."""
    return [draw_crops(windows, np.random.default_rng(seed)) for seed in range(DRAWS)]


def tile_layers(region, tile):
    """The five layers of one tile and the ring of a cell around it."""
    row, col = region.grid.to_cells(np.array([tile_centre_m(tile)]))[0].tolist()
    half = int(TILE_M) // 2
    stack = np.stack([region.layer(name) for name in CLASSES])
    return stack[:, row - half - 1 : row + half + 1, col - half - 1 : col + half + 1]


# --- the protocol ---------------------------------------------------------------------------------------------------


def test_there_are_220_trials_of_96_cells_with_ten_candidates_and_five_layers(pairs):
    assert len(pairs) == 220
    for query, truth in pairs:
        assert query.query_id == truth.query_id
        assert query.track == "retrieval"
        assert query.evidence.cells.shape == (5, 96, 96)
        assert query.evidence.classes == ("road_major", "building", "water", "road_minor", "field_boundary")
        assert query.evidence.cell_size_m == 1.0
        assert len(set(query.candidates)) == 10
        assert (truth.role, truth.kind, truth.is_present) == ("stress", "trial", True)
    assert len({truth.pair_id for _, truth in pairs}) == 220


def test_what_is_known_before_is_neither_place_nor_heading_and_a_scale_within_two_sigmas(pairs):
    group = PriorGroup.parse("rnone-unknown-s15")
    for query, truth in pairs:
        assert query.prior_group == group.name
        assert query.prior.center_m is None
        assert query.prior.yaw_deg is None
        assert abs(truth.pose.scale - 1) <= 2 * query.prior.scale_sigma


def test_every_rotation_scale_and_crop_of_the_paper_is_drawn_about_as_often_as_the_others(pairs):
    sets = {"rotation_deg": {0, 30, 60, 90}, "scale": {0.85, 1.0, 1.15}, "crop_fraction": {0.70, 0.85, 1.0}}
    for name, values in sets.items():
        drawn = [truth.measured[name] for _, truth in pairs]
        assert set(drawn) == values
        assert min(drawn.count(value) for value in values) > 220 / len(values) * 0.6
    assert all(truth.pose.yaw_deg == truth.measured["rotation_deg"] for _, truth in pairs)
    assert all(truth.pose.scale == truth.measured["scale"] for _, truth in pairs)


def test_occlusion_and_change_fill_their_ranges_and_do_not_leave_them(pairs):
    for name, most in (("occlusion_share", 0.24), ("change_probability", 0.32)):
        drawn = np.array([truth.measured[name] for _, truth in pairs])
        assert drawn.min() < 0.1 * most
        assert 0.9 * most < drawn.max() <= most
        assert abs(drawn.mean() - most / 2) < 0.1 * most
    assert all(truth.strength == truth.measured["change_probability"] for _, truth in pairs)


def test_what_is_unknown_is_what_was_cropped_or_occluded_for_all_classes_alike(pairs):
    for query, truth in pairs:
        unknown = query.evidence.cells == UNKNOWN
        assert (unknown == unknown[0]).all()
        lost = 1 - truth.measured["retained_share"]
        assert abs(lost - (1 - truth.measured["crop_fraction"])) < 0.012  # a ring of cells is 4 % of the view at most
        hidden = truth.measured["occlusion_share"]
        assert max(lost, hidden) - 1e-9 <= truth.unknown_share <= lost + hidden + 1e-9
        assert truth.unknown_share == truth.measured["unknown_share"] == unknown.mean()
        side = round(WINDOW_CELLS * np.sqrt(1 - lost))
        ring = (WINDOW_CELLS - side) // 2
        assert unknown[0, :ring].all()
        assert unknown[0, :, :ring].all()


def test_more_change_asked_for_is_more_change_seen(pairs):
    asked = np.array([truth.strength for _, truth in pairs])
    found = np.array([truth.measured["changed_share"] for _, truth in pairs])
    assert np.corrcoef(asked, found)[0, 1] > 0.4
    assert found[asked > 0.24].mean() > 2 * found[asked < 0.08].mean()


def test_classes_change_by_their_factors_the_most_volatile_by_what_was_drawn():
    rates = map_change(0.32).rates
    assert max(CHANGE_FACTORS.values()) == 1.0
    for name, factor in CHANGE_FACTORS.items():
        assert 1 - np.exp(-rates[name].vanish_per_year) == pytest.approx(0.32 * factor)
    assert set(rates) == set(CLASSES)


def test_no_two_candidates_share_ground(pairs):
    for query, _ in pairs:
        apart = np.abs(places_m(query)[:, None] - places_m(query)[None]).max(axis=2)
        assert (apart[~np.eye(10, dtype=bool)] >= WINDOW_M).all()


def test_the_ten_are_those_nearest_to_one_of_them_by_the_shares_of_the_classes(pairs, region):
    points, counts = all_windows(region)
    for query, _ in pairs[::10]:
        given = {tuple(point) for point in places_m(query)}
        assert any(nearest_ten(points, counts, anchor) == given for anchor in places_m(query))


def all_windows(region):
    """Every allowed window and its cells of each class, written down a second time: tile by tile, from its corner."""
    layers = np.stack([region.layer(name) == PRESENT for name in CLASSES])
    steps = np.arange(-48.0, 49.0, 16.0)
    centres = [tile_centre_m(tile) for tile in range(TILES)]
    points = [(east_m + step, north_m - down) for east_m, north_m in centres for down in steps for step in steps]
    counts = []
    for east_m, north_m in points:
        row, col = round(region.grid.north_m - north_m), round(east_m - region.grid.west_m)
        counts.append(layers[:, row - 48 : row + 48, col - 48 : col + 48].sum(axis=(1, 2)))
    return np.array(points), np.array(counts, dtype=np.int64)


def nearest_ten(points, counts, anchor):
    """An anchor's nearest, one after the other, none on the ground of one taken before; the first of equals."""
    here = int(np.flatnonzero((points == anchor).all(axis=1))[0])
    squared = ((counts - counts[here]) ** 2).sum(axis=1)
    squared[here] = -1
    taken = []
    for index in np.argsort(squared, kind="stable"):
        if len(taken) < 10 and all(np.abs(points[index] - points[old]).max() >= 96 for old in taken):
            taken.append(index)
    return {tuple(point) for point in points[taken]}


def tile_of(point):
    return int(np.argmin([np.hypot(*np.subtract(point, tile_centre_m(tile))) for tile in range(TILES)]))


def test_decoys_are_far_more_alike_than_windows_are_at_large_and_come_from_all_tiles(pairs, windows):
    shares = windows.counts / WINDOW_CELLS**2
    number = {tuple(point): index for index, point in enumerate(windows.points_m)}
    near, tiles = [], set()
    for query, truth in pairs:
        at = [number[tuple(point)] for point in places_m(query)]
        near.append(np.linalg.norm(shares[at] - shares[at[truth.candidate]], axis=1).sum() / 9)
        tiles |= set(windows.tile[at].tolist())
    at_large = np.linalg.norm(shares[::7, None] - shares[None, ::11], axis=2).mean()
    assert np.mean(near) < 0.4 * at_large
    assert tiles == set(range(TILES))


# --- readings of the crop -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["absent", "smaller"])
def reading(request, out):
    """The first trials under another reading of the crop, each with the same trial of the experiment."""
    make_paper_task(seed=42, out=out, trials=12, crop=request.param)
    first = {truth.pair_id: (query, truth) for query, truth in pairs_of(out)}
    found = pairs_of(out, suite=f"paper-poc-crop-{request.param}")
    return request.param, [(*pair, *first[pair[1].pair_id]) for pair in found]


def test_another_reading_asks_the_same_trials_and_changes_cropped_cells_alone(reading):
    crop, trials = reading
    assert len(trials) == 12
    assert {truth.measured["crop_fraction"] for _, truth, _, _ in trials} == {0.70, 0.85, 1.0}
    for query, truth, before, truth_before in trials:
        assert query.query_id != before.query_id
        assert (query.candidates, query.prior, truth.pose) == (before.candidates, before.prior, truth_before.pose)
        assert {**truth.measured, "unknown_share": 0} == {**truth_before.measured, "unknown_share": 0}
        assert truth.changed_share == truth_before.changed_share
        ring = round(WINDOW_CELLS * (1 - np.sqrt(truth.measured["retained_share"])) / 2)
        inner = slice(ring, WINDOW_CELLS - ring)
        kept, seen = before.evidence.cells[:, inner, inner], query.evidence.cells
        if crop == "smaller":
            np.testing.assert_array_equal(seen, kept)
            continue
        np.testing.assert_array_equal(seen[:, inner, inner], kept)
        outside = np.ones(seen.shape, dtype=bool)
        outside[:, inner, inner] = False
        assert not (seen[outside] == PRESENT).any()
        assert ring == 0 or (seen[outside] == ABSENT).mean() > 0.5
        assert query.evidence.unknown_share <= truth.measured["occlusion_share"] + 1e-9  # the crop hides nothing


def test_another_reading_is_up_to_date_by_itself(out, reading):
    crop, _ = reading
    found = made_paper_task(seed=42, out=out, trials=12, crop=crop)
    assert found == out / "tasks" / f"paper-poc-crop-{crop}" / "paper-poc-42"
    assert check_task(task_files.Task.open(found)) == []
    assert made_paper_task(seed=42, out=out) is not None  # whose region was made again, the same to the byte
    assert len(panels_of(task_files.Task.open(found), count=2)) == 2


def test_the_request_of_the_experiment_has_the_hash_that_it_had_before_there_were_readings(out):
    record = {
        "suite": ["paper-poc", 1, TASK_VERSION],
        "region": [SCHEMA_VERSION, DATA_VERSION, load_taxonomy().of_maps()],
        "seed": 42,
        "trials": 220,
        "made_by": version("sasgeo-bench"),
    }
    hidden = task_files.TruthManifest.read(out / "truth" / "paper-poc" / "paper-poc-42")
    assert hidden.request_sha256 == hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def test_query_ids_of_the_experiment_are_those_of_its_first_release(pairs):
    ids = "".join(query.query_id for query, _ in pairs)
    assert (
        hashlib.sha256(ids.encode()).hexdigest() == "36a0d1d2b0e316c9f9298815066ffe7a68cde0ad5763a9f210772f7efc0dcca6"
    )


# --- what is up to date ---------------------------------------------------------------------------------------------


def test_what_was_made_by_the_same_request_is_found_without_drawing_it(out, other):
    assert made_paper_task(seed=42, out=out) == out / "tasks" / "paper-poc" / "paper-poc-42"
    assert made_paper_task(seed=43, out=other, trials=FEW) is not None


def test_another_number_of_trials_seed_or_version_is_to_be_drawn(out, monkeypatch):
    assert made_paper_task(seed=42, out=out, trials=219) is None
    assert made_paper_task(seed=43, out=out) is None
    monkeypatch.setattr(task, "VERSION", VERSION + 1)
    assert made_paper_task(seed=42, out=out) is None


@pytest.mark.parametrize(
    "name",
    [
        "tasks/paper-poc/paper-poc-43/queries.parquet",
        "truth/paper-poc/paper-poc-43/truth.parquet",
        "truth/paper-poc/paper-poc-43/truth.json",
        "regions/paper-poc-43/layers.tif",
    ],
)
def test_what_was_touched_or_lost_is_not_up_to_date(other, name):
    path = other / name
    data = path.read_bytes()
    try:
        path.write_bytes(data[:-20])
        assert made_paper_task(seed=43, out=other, trials=FEW) is None
        path.unlink()
        assert made_paper_task(seed=43, out=other, trials=FEW) is None
    finally:
        path.write_bytes(data)
    assert made_paper_task(seed=43, out=other, trials=FEW) is not None


# --- the regions ----------------------------------------------------------------------------------------------------


def test_the_region_and_the_task_are_as_their_manifests_say(out, region):
    assert region_files.differing_files(out / "regions" / "paper-poc-42") == []
    assert check_task(task_files.Task.open(out / "tasks" / "paper-poc" / "paper-poc-42")) == []
    assert region.grid == mosaic_grid()
    assert "procedural, seed 42" in region.manifest.warnings[0]
    assert region.manifest.extract.bytes == 0


def test_thirty_tiles_of_256_cells_are_mapped_and_nothing_else(region):
    for tile in range(TILES):
        layers = tile_layers(region, tile)
        assert (layers[:, 1:-1, 1:-1] != OUTSIDE).all()
        assert layers[:, 1:-1, 1:-1].shape == (5, 256, 256)
        ring = np.ones(layers.shape[1:], dtype=bool)
        ring[1:-1, 1:-1] = False
        assert (layers[:, ring] == OUTSIDE).all()
    assert (region.layers[0] != OUTSIDE).sum() == 30 * 256 * 256
    for name in set(region.classes) - set(CLASSES):
        assert not (region.layer(name) == PRESENT).any()


def test_all_tiles_differ_and_hold_roads_buildings_and_hedges(region):
    tiles = [tile_layers(region, tile)[:, 1:-1, 1:-1] for tile in range(TILES)]
    assert len({layers.tobytes() for layers in tiles}) == TILES
    turned = {np.rot90(layers, turns, axes=(1, 2)).tobytes() for layers in tiles for turns in range(4)}
    assert len(turned) == 4 * TILES
    for layers in tiles:
        share = dict(zip(CLASSES, (layers == PRESENT).mean(axis=(1, 2)), strict=True))
        assert 0.015 < share["road_major"] < 0.10
        assert 0.01 < share["road_minor"] < 0.15
        assert 0.01 < share["building"] < 0.15
        assert 0.005 < share["field_boundary"] < 0.08
        assert share["water"] < 0.15
    wet = [(layers[CLASSES.index("water")] == PRESENT).any() for layers in tiles]
    assert sum(wet) > TILES / 2


def test_the_widest_view_from_an_allowed_place_sees_its_own_tile_alone(region, windows):
    state = State.of(region)
    assert WINDOW_M * 1.15 * np.sqrt(0.5) < MARGIN_M
    assert GAP_M > 0
    for tile in (0, 29):
        points = windows.points_m[windows.tile == tile]
        for point in points[[0, 6, 42, 48]]:
            for yaw_deg in (30.0, 45.0, 60.0, 90.0):
                done = Transformation(rotation_deg=yaw_deg, scale=1.15)
                view = draw_view(state, tuple(point.tolist()), done, Seeds(root=0, names=()))
                assert (view.evidence.cells != UNKNOWN).all()


def test_a_trial_to_which_nothing_is_done_sees_exactly_what_the_map_holds(region, windows):
    state = State.of(region)
    for index in range(0, len(windows.tile), 97):
        point = windows.points_m[index]
        view = draw_view(state, tuple(point.tolist()), Transformation(), Seeds(root=0, names=()))
        row, col = round(region.grid.north_m - point[1]), round(point[0] - region.grid.west_m)
        mapped = np.stack([region.layer(name) for name in CLASSES])[:, row - 48 : row + 48, col - 48 : col + 48]
        np.testing.assert_array_equal(view.evidence.cells, mapped)
        assert (view.occlusion_share, view.retained_share) == (0.0, 1.0)
        assert (view.evidence.cells == PRESENT).sum(axis=(1, 2)).tolist() == windows.counts[index].tolist()


def test_a_rectangle_covers_no_more_than_its_share_and_lies_in_the_view_whole():
    rng = np.random.default_rng(5)
    for share in (0.0, 0.001, 0.01, 0.1, 0.24):
        for _ in range(50):
            covered = rectangle((96, 96), share, rng)
            assert share - 0.012 < covered.mean() <= share
            rows, cols = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
            assert covered.sum() == len(rows) * len(cols)


# --- the same bytes -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_another_process_makes_the_same_bytes_and_fewer_trials_are_the_first_of_more(out, tmp_path):
    code = "import sys; from pathlib import Path; from sasgeo_paper import make_paper_task as make\n"
    code += f"make(seed=42, out=Path(sys.argv[1]), trials={FEW})"
    environment = os.environ | {"PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1", "GDAL_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, env=environment)  # noqa: S603 - our own code
    # The map knows nothing of the trials, and what changes in them is the world.
    assert content(tmp_path, "regions") == content(out, "regions")
    whole, few = (
        {query.query_id: (task_files.query_bytes(query), truth) for query, truth in pairs_of(root)}
        for root in (out, tmp_path)
    )
    assert len(few) == FEW
    assert all(whole[name] == pair for name, pair in few.items())
    again = content(tmp_path, "tasks", "truth")
    make(tmp_path)
    assert content(tmp_path, "tasks", "truth") == again


def test_another_seed_makes_other_tiles_and_other_trials(out, other, region):
    theirs = region_files.read_region(other / "regions" / "paper-poc-43")
    for tile in range(TILES):
        assert (tile_layers(region, tile) != tile_layers(theirs, tile)).any()
    ours, others = ({query.query_id for query, _ in pairs_of(*pair)} for pair in ((out, 42), (other, 43)))
    assert not ours & others


def test_a_tile_does_not_depend_on_those_drawn_before_it(region):
    seeds = Seeds(root=42, names=("paper-poc", str(VERSION)))
    for tile in (0, 17, 29):
        ways = draw_tile(seeds.rng("tile", tile))
        box = shapely.box(*np.subtract(tile_centre_m(tile), 128), *np.add(tile_centre_m(tile), 128))
        assert shapely.intersects(region.features.geometry.to_numpy(), box).sum() == len(ways)


# --- nothing tells --------------------------------------------------------------------------------------------------


def test_candidates_are_whole_metres_on_one_lattice_with_one_heading_and_scale(pairs):
    for query, truth in pairs:
        for pose in query.candidates:
            assert (pose.yaw_deg, pose.scale) == (0.0, 1.0)
            east_m, north_m = np.subtract((pose.easting_m, pose.northing_m), tile_centre_m(tile_of(places_m_of(pose))))
            assert max(abs(east_m), abs(north_m)) <= TILE_M / 2 - MARGIN_M
            assert (east_m % STEP_M, north_m % STEP_M) == (0.0, 0.0)
        true = query.candidates[truth.candidate]
        assert places_m_of(true) == places_m_of(truth.pose)


def places_m_of(pose):
    return (pose.easting_m, pose.northing_m)


def test_the_true_one_stands_at_every_number_about_as_often(pairs, drawn):
    counts = np.bincount([truth.candidate for _, truth in pairs], minlength=CANDIDATES)
    assert counts.min() > 5
    assert counts.max() < 45
    assert abs(np.bincount([crops.true for crops in drawn]) - DRAWS / 10).max() < 4.5 * np.sqrt(DRAWS * 0.09)


def blind_scores(windows, at):
    """What anyone could rank ten candidates by without a look at the query; the name of each, and its scores."""
    points, counts = windows.points_m[at], windows.counts[at].astype(float)
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 1e9 * np.eye(len(at))
    off = points - np.array([tile_centre_m(tile) for tile in windows.tile[at]])
    unlike = np.linalg.norm(counts[:, None] - counts[None], axis=2)
    return {
        "nearest to the mean descriptor": -np.linalg.norm(counts - counts.mean(axis=0), axis=1),
        "most alike to the others": -unlike.sum(axis=1),
        "most alike to one other": -(unlike + 1e9 * np.eye(len(at))).min(axis=1),
        "loneliest": apart.min(axis=1),
        "most others in its tile": (windows.tile[at][:, None] == windows.tile[at]).sum(axis=1),
        "middle of its tile": -np.abs(off).max(axis=1),
        "middle of all": -np.linalg.norm(points - points.mean(axis=0), axis=1),
        "easternmost": points[:, 0],
        "northernmost": points[:, 1],
        "fullest": counts.sum(axis=1),
        "first": -np.arange(len(at), dtype=float),
    }


def test_no_ranking_without_a_look_at_the_query_finds_the_true_one(windows, drawn):
    hits: dict[str, list[bool]] = {}
    ranks: dict[str, list[float]] = {}
    for crops in drawn:
        for name, score in blind_scores(windows, crops.windows).items():
            hits.setdefault(name, []).append(int(np.argmax(score)) == crops.true)
            beaten, level = (score > score[crops.true]).sum(), (score == score[crops.true]).sum() - 1
            ranks.setdefault(name, []).append(float(beaten + level / 2))
    for name, found in hits.items():
        assert abs(np.mean(found) - 0.1) < 4.5 * np.sqrt(0.09 / DRAWS), name
    for name, found in ranks.items():
        assert abs(np.mean(found) - 4.5) < 4.5 * 2.9 / np.sqrt(DRAWS), name


def test_a_window_is_true_as_often_as_its_place_among_candidates_says(windows, drawn):
    shown, true = np.zeros(len(windows.tile)), np.zeros(len(windows.tile))
    for crops in drawn:
        shown[crops.windows] += 1
        true[crops.windows[crops.true]] += 1
    often = shown >= np.quantile(shown, 0.9)
    assert true[often].sum() / shown[often].sum() == pytest.approx(0.1, abs=0.01)


def test_what_is_hidden_and_changed_does_not_depend_on_the_place(pairs):
    number = [truth.candidate for _, truth in pairs]
    for name in ("rotation_deg", "scale", "crop_fraction", "occlusion_share", "change_probability"):
        drawn = [truth.measured[name] for _, truth in pairs]
        assert abs(np.corrcoef(drawn, number)[0, 1]) < 0.25


def test_the_public_files_say_nothing_of_the_truths(out, pairs):
    assert [query.query_id for query, _ in pairs] == sorted(query.query_id for query, _ in pairs)
    text = (out / "tasks" / "paper-poc" / "paper-poc-42" / "task.json").read_text(encoding="utf-8")
    for word in ("seed", "candidate_index", "measured", *(truth.pair_id for _, truth in pairs)):
        assert word not in text
    for query, truth in pairs:
        assert (query.season, query.part, query.vectors) == ("", "test", None)
        assert truth.block == f"paper-poc-42/{tile_of(places_m_of(truth.pose))}"


# --- what else ------------------------------------------------------------------------------------------------------


def test_strata_are_filled(pairs):
    for _, truth in pairs:
        assert 0 < truth.feature_density < 1
        assert 0 < truth.alias_index < 1
        assert truth.scene == "suburban,agricultural"
        assert truth.strength_unit == "map-change probability"
    assert len({truth.block for _, truth in pairs}) > 20


def test_a_contact_sheet_shows_the_five_layers(out):
    folder = out / "tasks" / "paper-poc" / "paper-poc-42"
    found = panels_of(task_files.Task.open(folder), count=3)
    assert len(found) == 3
    assert all(panel.at_truth.classes == panel.at_decoy.classes == CLASSES for panel in found)


@pytest.mark.parametrize(("changes", "line"), [({"seed": -1}, "0 or more, got -1"), ({"trials": 0}, "at least one")])
def test_a_request_that_makes_no_sense_is_refused_in_one_line(tmp_path, changes, line):
    with pytest.raises(ConfigError, match=line):
        make(tmp_path, **changes)
    assert not list(tmp_path.iterdir())


def test_a_transformation_beyond_the_paper_is_refused():
    with pytest.raises(PerturbError, match=r"occlusion_share lies between 0 and 0\.24"):
        replace(Transformation(), occlusion_share=0.3)
