# SPDX-License-Identifier: Apache-2.0
"""The search by PyTorch finds what the search of one view finds."""

import doctest
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError, ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.search import plan as plan_module
from sasgeo_bench.search import torch_search
from sasgeo_bench.search.field import FULL, Field, Template, between, pooled, warped
from sasgeo_bench.search.find import Search, score_at, search
from sasgeo_bench.search.plan import Found, Null, Plan
from sasgeo_bench.search.shifts import Correlation
from sasgeo_bench.search.torch_search import BatchSearch, search_batch

ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
NOTHING = Found(modes=(), null=Null(best=0.0, mean=0.0, deviation=0.0, places=0))
SIDE = 224
TIE = 5e-3  # of the deviation of scores among all places
needs_torch = pytest.mark.usefixtures("torch")


@pytest.fixture(scope="session")
def torch():
    """PyTorch with one thread; the test is skipped without it."""
    found = pytest.importorskip("torch", reason="PyTorch, the extra [torch], is not installed (make test-torch)")
    found.set_num_threads(1)
    return found


@pytest.fixture(scope="module")
def town():
    """A made-up place: roads, houses, a wood; its last column is unknown."""
    rng = np.random.default_rng(0)
    layers = np.zeros((3, SIDE, SIDE), dtype=np.uint8)
    for _ in range(8):
        ends = [tuple(rng.integers(0, SIDE, 2).tolist()) for _ in range(2)]
        cv2.line(layers[0], *ends, color=FULL, thickness=3)
    for row, col in rng.integers(0, SIDE, (90, 2)):
        layers[1, row : row + 6, col : col + 9] = FULL
    layers[2, 40:80, 120:190] = FULL
    layers[:, :, -8:] = 0
    known = np.full((SIDE, SIDE), FULL, np.uint8)
    known[:, -8:] = 0
    return Field.of(
        grid=Grid(epsg=32632, west_m=1000.0, north_m=9000.0, cell_size_m=1.0, rows=SIDE, cols=SIDE),
        layers=layers,
        known=known,
    )


def view_of(town, pose, rows=64, cols=64):
    """What is seen from a pose, 2 % of it wrong."""
    frame = Grid(epsg=0, west_m=-cols / 2, north_m=rows / 2, cell_size_m=1.0, rows=rows, cols=cols)
    to_map = between(frame, pose, town.grid)
    seen = np.stack([warped(layer, to_map, frame.shape) for layer in town.layers]) > FULL // 2
    seen = (seen ^ (np.random.default_rng(1).random(seen.shape) < 0.02)).astype(np.float32)
    return Template(weights=1.6 * seen - 0.4 * (1 - seen), known=-0.6 * seen.sum(axis=0), cell_size_m=1.0)


def some_poses(town, count, seed=3):
    west, south, east, north = town.grid.bounds_m
    at = np.random.default_rng(seed).uniform((west + 40, south + 40, 0), (east - 40, north - 40, 360), (count, 3))
    return [Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg) for east_m, north_m, yaw_deg in at.tolist()]


def is_near(one, other, near_m, near_deg):
    metres = math.hypot(one.easting_m - other.easting_m, one.northing_m - other.northing_m)
    return metres <= near_m and abs(float(wrap_deg(one.yaw_deg - other.yaw_deg))) <= near_deg


def check_same(found, wanted, *, share=0.8):
    """The best pose within half a cell and half a degree, its score within 0.5 %; most of the other modes."""
    assert bool(found.modes) == bool(wanted.modes)
    assert found.null.places == wanted.null.places
    for name in ("best", "mean", "deviation"):
        assert getattr(found.null, name) == pytest.approx(getattr(wanted.null, name), rel=5e-3, abs=1e-3)
    if wanted.modes:
        mine, theirs = found.modes[0], wanted.modes[0]
        assert is_near(mine.pose, theirs.pose, 0.5, 0.5)
        assert mine.pose.scale == pytest.approx(theirs.pose.scale, abs=0.01)
        assert mine.score == pytest.approx(theirs.score, rel=5e-3, abs=TIE * wanted.null.deviation)
        there = [any(is_near(mode.pose, other.pose, 1.0, 1.0) for other in found.modes) for mode in wanted.modes]
        assert sum(there) >= share * len(there)


@needs_torch
def test_a_batch_finds_what_each_search_finds(town):
    views = [view_of(town, pose) for pose in some_poses(town, 4)]
    found = search_batch(town, views, [ANYWHERE] * 4)
    for view, mine in zip(views, found, strict=True):
        check_same(mine, search(town, view, ANYWHERE))
        best = mine.modes[0]
        assert best.score == pytest.approx(score_at(town, view, best.pose), rel=5e-3, abs=TIE * mine.null.deviation)


@needs_torch
def test_each_view_has_its_own_prior_shape_and_scale(town):
    one, two, three = some_poses(town, 3, seed=5)
    near = Prior(
        center_m=(one.easting_m + 10, one.northing_m),
        radius_m=30.0,
        yaw_deg=one.yaw_deg,
        yaw_sigma_deg=8.0,
        scale_sigma=0.0,
    )
    scaled = replace(ANYWHERE, yaw_deg=two.yaw_deg, yaw_sigma_deg=5.0, scale_sigma=0.06)
    views = [view_of(town, one), view_of(town, replace(two, scale=1.1)), view_of(town, three, 50, 77)]
    priors = [near, scaled, replace(ANYWHERE, center_m=(three.easting_m, three.northing_m), radius_m=0.01)]
    for view, prior, mine in zip(views, priors, search_batch(town, views, priors), strict=True):
        check_same(mine, search(town, view, prior), share=0.6)
        assert all(
            is_near(
                mode.pose,
                replace(mode.pose, easting_m=prior.center_m[0], northing_m=prior.center_m[1]),
                prior.radius_m + 1,
                1,
            )
            for mode in mine.modes
            if prior.center_m
        )


@needs_torch
def test_finer_headings_and_tiles_are_those_of_the_search(town, monkeypatch):
    monkeypatch.setattr(plan_module, "_MOST_PLACES", 40)
    view = view_of(town, some_poses(town, 1)[0])
    (mine,) = BatchSearch(field=town, yaw_step_deg=3.0).places([view], [ANYWHERE], count=5)
    wanted = Search(field=town, template=view, prior=ANYWHERE, plan=Plan(), yaw_step_deg=3.0)
    assert len(wanted.turns.bases) * wanted.turns.quarters == 120
    check_same(mine, wanted.places(5, ()))


@needs_torch
def test_parts_and_repetitions_change_nothing(town, monkeypatch):
    views = [view_of(town, pose) for pose in some_poses(town, 3)]
    whole = search_batch(town, views, [ANYWHERE] * 3)
    assert search_batch(town, views, [ANYWHERE] * 3) == whole
    monkeypatch.setitem(torch_search.MOST_BYTES, "cpu", 2**23)
    monkeypatch.setattr(torch_search, "_AT_ONCE", 2)
    for one, other in zip(search_batch(town, views, [ANYWHERE] * 3), whole, strict=True):
        check_same(one, other, share=1.0)


@needs_torch
def test_scores_of_a_level_are_those_of_the_correlation(town):
    view = view_of(town, some_poses(town, 1)[0], 60, 64)
    template = replace(view, weights=view.weights * np.float32([1, 1, 0])[:, None, None])
    job = Search(field=town, template=template, prior=ANYWHERE, plan=Plan())
    level, (tile,) = town.level(job.factor), job.tiles
    views = torch_search.Views.of([template], "cpu")
    assert views.active == [0, 1, 3]
    for pool in (1, 3):
        bands, frame = views.pooled(level, pool)
        wanted, wanted_frame = pooled(template, level, pool)
        np.testing.assert_allclose(bands[0], wanted, rtol=1e-5, atol=1e-5)
        assert frame == wanted_frame
    cells = torch_search.torch.tensor(np.stack([level.cells.band(at) for at in views.active]).astype(np.float32) / FULL)
    coarse = torch_search.Coarse.of(cells=cells, level=level, views=views, turns=job.turns, most_bytes=2**24)
    lay, board = coarse.lay(job.turns.bases), torch_search.Board.of(coarse, tile)
    scores = board.scores(lay.laid(coarse.bands))[:, 0].transpose(0, 1)[..., : tile.allowed.shape[1]] / board.size
    votes = Correlation.of(level, template, [tile], job.turns)
    for base in job.turns.bases[::5]:
        for _, pose, wanted in votes.scores(base):
            at = lay.turned[:, 0].tolist().index(pose.yaw_deg)
            np.testing.assert_allclose(scores[at], wanted, atol=0.01 * np.abs(wanted).max())


@needs_torch
def test_a_map_without_content_is_searched_all_the_same(town):
    empty = replace(town, layers=np.zeros_like(town.layers))
    (found,) = search_batch(empty, [view_of(town, some_poses(town, 1)[0])], [ANYWHERE], count=3)
    assert len(found.modes) == 3


@needs_torch
def test_nothing_is_found_where_there_is_nothing(town):
    view = view_of(town, some_poses(town, 1)[0])
    blind = Template(weights=np.zeros((3, 64, 64), np.float32), known=np.zeros((64, 64), np.float32), cell_size_m=1.0)
    far = replace(ANYWHERE, center_m=(0.0, 0.0), radius_m=50.0)
    found = search_batch(town, [blind, view, view], [ANYWHERE, far, ANYWHERE])
    assert found[:2] == [NOTHING, NOTHING]
    assert found[2].modes
    assert search_batch(town, [blind], [ANYWHERE]) == [NOTHING]
    assert search_batch(town, [view], [far]) == [NOTHING]
    assert search_batch(town, [], []) == []


@needs_torch
def test_what_does_not_fit_is_refused(town):
    view = view_of(town, some_poses(town, 1)[0])
    with pytest.raises(ShapeError, match="2 templates and 1 priors"):
        search_batch(town, [view, view], [ANYWHERE])
    with pytest.raises(ShapeError, match=r"templates\[1\] has 2 classes, the map 3"):
        search_batch(town, [view, replace(view, weights=view.weights[:2])], [ANYWHERE] * 2)
    with pytest.raises(ConfigError, match=r"^device must be one of cpu, cuda, got 'tpu'$"):
        search_batch(town, [view], [ANYWHERE], device="tpu")


@needs_torch
def test_a_missing_gpu_is_named_with_its_mend(town, torch, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"^PyTorch finds no GPU for device 'cuda': use 'cpu', or install"):
        search_batch(town, [], [], device="cuda")


def test_a_missing_pytorch_is_named_with_its_mend(town, monkeypatch):
    monkeypatch.setattr(torch_search, "torch", None)
    with pytest.raises(ConfigError, match=r"^search_batch needs PyTorch.*: pip install 'sasgeo-bench\[torch\]'$"):
        search_batch(town, [], [])


@needs_torch
def test_of_ranked_items_the_first_stays(torch):
    rng = np.random.default_rng(0)
    at, valid = rng.uniform(0, 10, (5, 60)), rng.random((5, 60)) < 0.9
    near = np.abs(at[:, :, None] - at[:, None]) < 0.4
    kept = torch_search.first_come(torch.tensor(near), torch.tensor(valid)).numpy()
    for beside, is_valid, mine in zip(near, valid, kept, strict=True):
        chosen = []
        for index in np.flatnonzero(is_valid):
            if not beside[index, chosen].any():
                chosen.append(index)
        assert np.flatnonzero(mine).tolist() == chosen


@needs_torch
def test_the_examples_of_the_docstrings_hold():
    ran = 0
    for module in (torch_search, torch_search):
        for case in doctest.DocTestFinder(exclude_empty=True).find(module, globs=vars(module).copy()):
            for example in case.examples:
                example.options.clear()  # they are skipped where they are collected, since PyTorch may be missing
            result = doctest.DocTestRunner().run(case)
            assert result.failed == 0
            ran += result.attempted
    assert ran > 10


@needs_torch
def test_a_gpu_finds_the_same(town, torch):
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    poses = some_poses(town, 4)
    views = [view_of(town, pose) for pose in poses] + [view_of(town, poses[0], 50, 77)]
    found = search_batch(town, views, [ANYWHERE] * 5, device="cuda")
    assert search_batch(town, views, [ANYWHERE] * 5, device="cuda") == found
    for view, mine in zip(views, found, strict=True):
        check_same(mine, search(town, view, ANYWHERE))
