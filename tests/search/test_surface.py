# SPDX-License-Identifier: Apache-2.0
"""The surface of scores holds, cell by cell and heading by heading, what a single pose scores."""

import math

import numpy as np
import pytest

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.search.dense import LevelView, surface
from sasgeo_bench.search.field import FULL, Field, Template
from sasgeo_bench.search.find import score_at

SIDE = 160
GRID = Grid(epsg=32632, west_m=1000.0, north_m=2000.0, cell_size_m=2.0, rows=SIDE, cols=SIDE)
MIDDLE_M = (1160.0, 1840.0)


@pytest.fixture(scope="module")
def town():
    """Blobs of two classes, with ground that the map does not know in one corner."""
    rng = np.random.default_rng(4)
    layers = (rng.random((2, SIDE // 4, SIDE // 4)) < 0.2).repeat(4, axis=1).repeat(4, axis=2)
    known = np.full((SIDE, SIDE), FULL, dtype=np.uint8)
    known[:30, :30] = 0
    return Field.of(grid=GRID, layers=np.where(known > 0, FULL * layers, 0).astype(np.uint8), known=known)


@pytest.fixture(scope="module")
def view(town):
    """41 x 31 cells at (1171, 1829), heading east: the top of the view is the east of the map."""
    row, col = GRID.to_cells(np.array([(1171.0, 1829.0)]))[0]
    under = town.layers[:, row - 15 : row + 16, col - 20 : col + 21] / np.float32(FULL)
    seen = np.rot90(under, axes=(1, 2))
    return Template(weights=1.4 * seen - 0.4, known=-0.6 * seen.sum(axis=0), cell_size_m=2.0)


def poses_of(scored, *, count, seed=0):
    """Some cells and headings of a surface: pose and score of each."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yaw, row, col = (int(rng.integers(side)) for side in scored.scores.shape)
        east_m, north_m = scored.grid.to_centres_m(np.array([(row, col)]))[0]
        pose = Pose(easting_m=east_m, northing_m=north_m, yaw_deg=float(scored.yaws_deg[yaw]))
        yield pose, float(scored.scores[yaw, row, col])


def test_a_score_is_that_of_the_pose_but_for_how_cells_are_interpolated(town, view):
    scored = surface(town, view, center_m=MIDDLE_M, radius_m=60.0, yaws_deg=[270, 0, 90, 180])
    for pose, score in poses_of(scored, count=40):
        assert score == pytest.approx(score_at(town, view, pose), abs=0.02)
    scored = surface(town, view, center_m=MIDDLE_M, radius_m=60.0, yaws_deg=np.arange(5.0, 360.0, 15.0))
    got, asked = np.array([(score, score_at(town, view, pose)) for pose, score in poses_of(scored, count=80)]).T
    assert np.std(got - asked) < 0.05 * np.std(asked)


def test_on_larger_cells_a_score_is_about_that_of_the_level(town, view):
    scored = surface(town, view, center_m=MIDDLE_M, radius_m=60.0, yaws_deg=np.arange(0.0, 360.0, 30.0), factor=2)
    of_level = LevelView.of(town, view, 2)
    got, asked = np.array([(score, of_level.score(pose)) for pose, score in poses_of(scored, count=80)]).T
    assert scored.grid.cell_size_m == 2 * GRID.cell_size_m
    assert np.corrcoef(got, asked)[0, 1] > 0.97


@pytest.mark.parametrize("factor", [1, 2])
def test_a_view_is_found_where_it_was_taken_with_its_top_ahead(town, view, factor):
    scored = surface(town, view, center_m=MIDDLE_M, radius_m=60.0, yaws_deg=np.arange(0.0, 360.0, 10.0), factor=factor)
    best = scored.best.pose
    assert best.yaw_deg == 90.0
    assert math.dist((best.easting_m, best.northing_m), (1171.0, 1829.0)) <= GRID.cell_size_m * factor


def test_the_cells_are_those_of_the_map_that_cover_the_disc(town, view):
    scored = surface(town, view, center_m=MIDDLE_M, radius_m=31.0, yaws_deg=[0.0])
    west_m, south_m, east_m, north_m = scored.grid.bounds_m
    assert max(west_m - 1129.0, south_m - 1809.0) <= 0 <= min(east_m - 1191.0, north_m - 1871.0)
    assert (np.array([west_m, north_m]) - (GRID.west_m, GRID.north_m)).tolist() == [128.0, -128.0]


def test_at_the_edge_of_the_map_the_square_is_cut_and_the_ground_beyond_is_unknown(town, view):
    scored = surface(town, view, center_m=(1310.0, 1690.0), radius_m=40.0, yaws_deg=[0.0, 90.0])
    assert scored.grid.bounds_m == (1270.0, 1680.0, 1320.0, 1730.0)
    for pose, score in poses_of(scored, count=20):
        assert score == pytest.approx(score_at(town, view, pose), abs=0.02)


def test_squares_wider_than_one_transform_are_joined(view):
    rng = np.random.default_rng(0)
    grid = Grid(epsg=32632, west_m=0.0, north_m=0.0, cell_size_m=2.0, rows=8, cols=600)
    layers = np.where(rng.random((2, *grid.shape)) < 0.2, FULL, 0).astype(np.uint8)
    long = Field.of(grid=grid, layers=layers, known=np.full(grid.shape, FULL, dtype=np.uint8))
    scored = surface(long, view, center_m=(600.0, -8.0), radius_m=600.0, yaws_deg=[0.0])
    assert scored.scores.shape == (1, 8, 600)
    for pose, score in poses_of(scored, count=20):
        assert score == pytest.approx(score_at(long, view, pose), abs=0.02)


@pytest.mark.parametrize("yaws_deg", [[350.0, 355.0, 0.0, 5.0, 10.0], [12.5], [0.0, 90.0, 45.0, 200.0], [30.0, 30.0]])
def test_each_heading_scores_alike_whatever_others_are_asked_for(town, view, yaws_deg):
    together = surface(town, view, center_m=MIDDLE_M, radius_m=20.0, yaws_deg=yaws_deg)
    assert together.yaws_deg.tolist() == yaws_deg
    for yaw, score in zip(yaws_deg, together.scores, strict=True):
        alone = surface(town, view, center_m=MIDDLE_M, radius_m=20.0, yaws_deg=[yaw])
        np.testing.assert_allclose(score, alone.scores[0], atol=0.2)


def test_what_cannot_be_scored_is_refused_and_a_view_that_says_nothing_scores_0(town, view):
    with pytest.raises(PoseError, match="does not meet the map"):
        surface(town, view, center_m=(0.0, 0.0), radius_m=10.0, yaws_deg=[0.0])
    with pytest.raises(PoseError, match="at least one finite heading"):
        surface(town, view, center_m=MIDDLE_M, radius_m=10.0, yaws_deg=[])
    with pytest.raises(PoseError, match="scale positive"):
        surface(town, view, center_m=MIDDLE_M, radius_m=10.0, yaws_deg=[0.0], scale=0.0)
    blank = Template(weights=np.zeros((2, 9, 9), np.float32), known=np.zeros((9, 9), np.float32), cell_size_m=2.0)
    assert not surface(town, blank, center_m=MIDDLE_M, radius_m=20.0, yaws_deg=[0.0]).scores.any()
