# SPDX-License-Identifier: Apache-2.0
"""Bird's-eye views: what a picture says of the ground, and where it says nothing."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.core.errors import CameraError, ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.sensing.birdseye import BirdsEye, Reading, SoftView, rectify, see_ground, to_evidence
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Dem, Plane

LENS = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=400, height_px=400)
FLAT = Reading(widths_m={}, standing_m={})


@dataclass
class Planes:
    classes: tuple[str, ...]
    values: np.ndarray

    def probabilities(self):
        return self.values


def camera_of(*, height_m=100.0, yaw_deg=0.0, tilt_deg=0.0, east_m=0.0, north_m=0.0):
    return Camera.pointed(
        intrinsics=LENS, east_m=east_m, north_m=north_m, height_m=height_m, yaw_deg=yaw_deg, tilt_deg=tilt_deg
    )


def picture_of(camera, is_there, ground=None, classes=("water",)):
    """Probabilities of a world where `is_there(east, north)` says what is where on the ground."""
    rows, cols = np.mgrid[0:400, 0:400] + 0.5
    points = camera.unproject(np.column_stack([cols.ravel(), rows.ravel()]), ground or Plane())
    there = is_there(points[:, 0], points[:, 1]).astype(np.float32).reshape(400, 400)
    return Planes(classes, np.repeat(there[None], len(classes), axis=0))


def disc(east, north, radius=12.0):
    return lambda e, n: np.hypot(e - east, n - north) < radius


@settings(max_examples=15)  # each unprojects a whole picture
@given(yaw=st.floats(0, 359), tilt=st.floats(0, 50), bearing=st.floats(0, 359))
def test_what_lies_on_the_ground_is_found_there(yaw, tilt, bearing):
    camera = camera_of(yaw_deg=yaw, tilt_deg=tilt, east_m=1000.0, north_m=2000.0)
    east, north = 1000 + 30 * np.sin(np.radians(bearing)), 2000 + 30 * np.cos(np.radians(bearing))
    seen = picture_of(camera, disc(east, north))
    evidence = to_evidence(seen, camera, Plane(), size_cells=96, cell_size_m=2.0, reading=FLAT)
    pose = Pose(easting_m=1000.0, northing_m=2000.0, yaw_deg=camera.yaw_deg)
    rows, cols = np.nonzero(evidence.cells[0] == PRESENT)
    if tilt < 10:
        assert len(rows) > 90
    if len(rows) > 90:  # else most of the disc may lie outside the picture
        right_up = np.column_stack([cols + 0.5 - 48, 48 - rows - 0.5]) * 2.0
        found = pose.to_map(right_up)
        assert np.hypot(found[:, 0] - east, found[:, 1] - north).max() < 14.5


def test_outside_the_picture_and_where_the_segmenter_says_nothing_nothing_is_known():
    camera = camera_of(height_m=50.0)
    seen = picture_of(camera, lambda e, _: e > 0)
    seen.values[0, :200] = np.nan
    cells = to_evidence(seen, camera, Plane(), size_cells=80, cell_size_m=2.0, reading=FLAT).cells[0]
    is_known = np.zeros((80, 80), dtype=bool)
    is_known[40:65, 15:65] = True  # +-50 m, of which the northern half says nothing
    assert ((cells != UNKNOWN) == is_known).all()


def test_a_class_narrower_than_a_pixel_on_the_ground_is_unknown_far_away():
    camera = camera_of(tilt_deg=50.0)
    seen = picture_of(camera, disc(0, 60), classes=("path", "road"))
    reading = Reading(widths_m={"path": 2.0, "road": 50.0}, standing_m={})
    pose = Pose(easting_m=0.0, northing_m=150.0, yaw_deg=0.0)
    evidence = to_evidence(seen, camera, Plane(), size_cells=150, cell_size_m=2.0, pose=pose, reading=reading)
    path, road = (evidence.cells == UNKNOWN).mean(axis=(1, 2))
    assert path > road + 0.05
    # Along the middle the path ends where a pixel is 2 m long: slant^2 / (100 m * 200 px) = 2 m, so 173 m ahead.
    known = np.flatnonzero(evidence.layer("path")[:, 75] != UNKNOWN)
    assert 300 - 2 * known.min() == pytest.approx(173, abs=5)


def boxes_seen_from(camera, *, low, high, top_m):
    """A picture of one box on the ground, by the rays that hit it."""
    rows, cols = np.mgrid[0:400, 0:400] + 0.5
    rays = camera.rays(np.column_stack([cols.ravel(), rows.ravel()]))
    hit = np.zeros(len(rays), dtype=bool)
    for level in np.linspace(0.0, top_m, 25):
        points = Plane(height_m=float(level)).meet(camera.position_m, rays)
        hit |= ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
    return Planes(("building", "road_minor"), np.stack([hit, ~hit]).reshape(2, 400, 400).astype(np.float32))


@pytest.mark.parametrize(
    ("tilt", "low", "high"), [(0.0, (50.0, 10.0), (70.0, 40.0)), (35.0, (-15.0, 60.0), (15.0, 80.0))]
)
def test_behind_a_house_nothing_is_known_and_its_foot_stays(tilt, low, high):
    camera = camera_of(tilt_deg=tilt)
    seen = boxes_seen_from(camera, low=low, high=high, top_m=12.0)
    lattice = {"size_cells": 240, "cell_size_m": 1.0}
    naive = to_evidence(seen, camera, Plane(), **lattice, reading=FLAT)
    aware = to_evidence(seen, camera, Plane(), **lattice, reading=Reading(widths_m={}, standing_m={"building": 12.0}))
    east, north = np.meshgrid(np.arange(240) - 119.5, 119.5 - np.arange(240))
    foot = (east > low[0]) & (east < high[0]) & (north > low[1]) & (north < high[1])
    assert (naive.layer("building")[~foot] == PRESENT).sum() > 150  # the roof leans out
    assert (aware.layer("building")[~foot] == PRESENT).sum() < 90  # the rim of a cell
    assert (aware.layer("building")[foot] == PRESENT).mean() > 0.9
    leaned = (naive.layer("building") == PRESENT) & (aware.layer("building") == UNKNOWN)
    assert (aware.layer("road_minor")[leaned] == UNKNOWN).all()


def test_a_house_as_high_as_the_camera_and_all_that_a_camera_to_the_sky_sees_are_unknown():
    camera = camera_of(height_m=10.0)
    seen = picture_of(camera, disc(0, 0, 3.0), classes=("building",))
    reading = Reading(widths_m={}, standing_m={"building": 9.0})
    cells = to_evidence(seen, camera, Plane(), size_cells=16, cell_size_m=1.0, reading=reading).cells
    assert (cells != PRESENT).all()
    camera = camera_of(tilt_deg=180.0)
    evidence = to_evidence(
        Planes(("water",), np.ones((1, 400, 400), np.float32)), camera, Plane(), size_cells=8, cell_size_m=1.0
    )
    assert (evidence.cells == UNKNOWN).all()


def test_behind_a_hill_nothing_is_known():
    grid = Grid(epsg=32632, west_m=-200.0, north_m=400.0, cell_size_m=5.0, rows=120, cols=80)
    cells = np.zeros(grid.shape, dtype=np.float32)
    cells[66:70] = 30.0  # a ridge 50 to 70 m ahead
    hill = Dem(grid=grid, cells_m=cells)
    camera = camera_of(tilt_deg=45.0, height_m=60.0)
    seen = picture_of(camera, lambda e, _: np.isfinite(e), ground=hill)
    pose = Pose(easting_m=0.0, northing_m=80.0, yaw_deg=0.0)
    view = see_ground(seen, camera, hill, size_cells=80, cell_size_m=2.0, pose=pose, reading=FLAT)
    middle = view.probabilities[0, :, 40]  # north to south, 160 m to 0
    north_m = 160 - 2 * np.arange(80) - 1.0
    assert np.isnan(middle[(north_m > 80) & (north_m < 115)]).all()
    assert np.isfinite(middle[(north_m > 5) & (north_m < 48)]).all()
    assert np.isfinite(middle[north_m > 150]).all()


def test_straight_down_the_view_is_the_picture_averaged():
    rng = np.random.default_rng(0)
    fine = rng.uniform(0, 1, (1, 400, 400)).astype(np.float32)
    camera = camera_of()  # a pixel is half a metre, a cell 2 m
    view = see_ground(Planes(("water",), fine), camera, Plane(), size_cells=100, cell_size_m=2.0, reading=FLAT)
    np.testing.assert_allclose(view.probabilities[0], fine[0].reshape(100, 4, 100, 4).mean(axis=(1, 3)), atol=2e-3)


def test_thresholds_leave_the_undecided_unknown_and_confidence_says_how_sure():
    soft = SoftView(classes=("water",), probabilities=np.array([[[0.0, 0.4, 0.9, np.nan]]]), cell_size_m=1.0)
    evidence = soft.to_evidence(Reading(present_at=0.8, absent_at=0.2))
    assert evidence.cells.tolist() == [[[ABSENT, UNKNOWN, PRESENT, UNKNOWN]]]
    assert evidence.confidence.tolist() == [[[255, 0, 204, 0]]]


def test_a_picture_is_rectified_and_black_beyond():
    picture = np.zeros((400, 400, 3), dtype=np.uint8)
    picture[:200] = (200, 100, 50)
    above = rectify(picture, camera_of(yaw_deg=90.0), Plane(), size_cells=150, cell_size_m=2.0)
    assert above[30, 75].tolist() == [200, 100, 50]
    assert above[120, 75].tolist() == [0, 0, 0]
    assert above[2, 2].tolist() == [0, 0, 0]


def test_absurd_lattices_and_readings_and_probabilities_of_another_picture_are_refused():
    for size in (1, 100_000):
        with pytest.raises(CameraError, match="cells a side"):
            BirdsEye.of(camera_of(), Plane(), size_cells=size, cell_size_m=1.0)
    for how in ({"present_at": 0.2}, {"absent_at": -1.0}, {"widths_m": {"water": -1.0}}):
        with pytest.raises(CameraError, match=r"present_at|negative"):
            Reading(**how)
    small = Planes(("water",), np.zeros((1, 9, 9), np.float32))
    with pytest.raises(ShapeError, match="400 x 400"):
        to_evidence(small, camera_of(), Plane(), size_cells=9, cell_size_m=1)
    with pytest.raises(ShapeError, match="another size"):
        rectify(np.zeros((9, 9, 3), np.uint8), camera_of(), Plane(), size_cells=9, cell_size_m=1.0)
