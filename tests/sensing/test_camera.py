# SPDX-License-Identifier: Apache-2.0
"""From the ground to the picture and back."""

import cv2
import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics, Mount
from sasgeo_bench.sensing.ground import Dem, Plane

WIDE = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=800, height_px=600)
BENT = Intrinsics.from_field_of_view(
    horizontal_deg=70.0, width_px=800, height_px=600, distortion=(-0.1, 0.02, 0.001, -0.002, 0.0)
)
MIDDLE = np.array([[400.0, 300.0]])

angles = st.floats(-180.0, 180.0)
tilts = st.floats(0.0, 60.0)


def camera_of(lens=WIDE, *, east_m=0.0, north_m=0.0, height_m=100.0, yaw_deg=0.0, tilt_deg=0.0, roll_deg=0.0):
    body, mount = Attitude(yaw_deg=yaw_deg), Mount(tilt_deg=tilt_deg, roll_deg=roll_deg)
    return Camera.mounted(intrinsics=lens, east_m=east_m, north_m=north_m, height_m=height_m, body=body, mount=mount)


def mounted(body, mount=None):
    mount = mount or Mount()
    return Camera.mounted(intrinsics=WIDE, east_m=0.0, north_m=0.0, height_m=100.0, body=body, mount=mount)


def test_a_pointed_camera_is_a_mounted_one_and_roll_comes_first_in_the_body_and_yaw_last():
    place = {"intrinsics": WIDE, "east_m": 3.0, "north_m": 4.0, "height_m": 100.0}
    pointed = Camera.pointed(**place, yaw_deg=33.0, tilt_deg=25.0)
    assert pointed == Camera.mounted(**place, body=Attitude(yaw_deg=33.0), mount=Mount(tilt_deg=25.0))
    # Right side down by 90, then nose up by 30: forward is up by 30, right points straight down along the new axes.
    forward, right, _ = Attitude(roll_deg=90.0, pitch_deg=30.0).matrix.T
    np.testing.assert_allclose(forward, [np.cos(np.pi / 6), 0, -0.5], atol=1e-12)
    np.testing.assert_allclose(right, [0.5, 0, np.cos(np.pi / 6)], atol=1e-12)


@given(yaw=angles, tilt=tilts, roll=st.floats(-20, 20), lens=st.sampled_from([WIDE, BENT]), seed=st.integers(0, 99))
def test_projection_is_that_of_opencv(yaw, tilt, roll, lens, seed):
    camera = camera_of(lens, east_m=30.0, north_m=-20.0, yaw_deg=yaw, tilt_deg=tilt, roll_deg=roll)
    near = camera.unproject(np.random.default_rng(seed).uniform(0, 600, (20, 2)), Plane())
    points = near[np.isfinite(near).all(axis=1)] + (0.0, 0.0, 3.0)
    assume(len(points))
    turn, shift = Rotation.from_matrix(camera.matrix).as_rotvec(), -camera.matrix @ camera.position_m
    expected = cv2.projectPoints(points, turn, shift, lens.matrix, np.array(lens.distortion))[0].reshape(-1, 2) + 0.5
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-5)


@given(
    yaw=angles, tilt=tilts, roll=st.floats(-20, 20), height=st.floats(5, 3000), lens=st.sampled_from([WIDE, BENT]),
    at=st.tuples(st.floats(0, 800), st.floats(0, 600)),
)  # fmt: skip
def test_from_the_picture_to_the_ground_and_back_is_identity(yaw, tilt, roll, height, lens, at):
    camera = camera_of(lens, height_m=height, yaw_deg=yaw, tilt_deg=tilt, roll_deg=roll)
    ground = camera.unproject(np.array([at]), Plane(height_m=2.0))
    assume(np.isfinite(ground).all() and np.abs(ground).max() < 1e5)
    assert ground[0, 2] == 2.0
    np.testing.assert_allclose(camera.project(ground), [at], atol=1e-3)


@given(yaw=st.floats(0, 359.99), tilt=st.floats(0, 89))
def test_the_angles_of_a_pointed_camera_come_back(yaw, tilt):
    camera = camera_of(yaw_deg=yaw, tilt_deg=tilt)
    assert abs((camera.yaw_deg - yaw + 180) % 360 - 180) < 1e-4
    assert camera.tilt_deg == pytest.approx(tilt, abs=1e-5)


# Views worked by hand: 800 x 600, focal length 400, 100 m high, so 4 pixels a metre straight down.
@pytest.mark.parametrize(
    ("how", "point", "pixel"),
    [
        ({}, (0, 0, 0), (400, 300)),
        ({}, (10, 0, 0), (440, 300)),  # east is right
        ({}, (0, 10, 0), (400, 260)),  # north is up
        ({}, (10, 0, 50), (480, 300)),  # half as far: leans away from the middle
        ({"yaw_deg": 90.0}, (10, 0, 0), (400, 260)),  # heading east, east is up
        ({"yaw_deg": 180.0}, (0, 10, 0), (400, 340)),
        ({"tilt_deg": 45.0}, (0, 100, 0), (400, 300)),  # as far ahead as it is high
        ({"tilt_deg": 45.0}, (0, 0, 0), (400, 700)),  # what is beneath lies 45 degrees under the axis
        ({"tilt_deg": 45.0, "yaw_deg": 270.0}, (-100, 0, 0), (400, 300)),
        ({"tilt_deg": 90.0}, (0, 100, 100), (400, 300)),  # level
        ({"tilt_deg": 90.0}, (25, 100, 125), (500, 200)),
        ({"tilt_deg": 90.0, "roll_deg": 90.0}, (0, 100, 125), (300, 300)),  # right side down: the sky is to the left
        ({"roll_deg": 90.0}, (10, 0, 0), (400, 260)),  # looking down, roll adds to yaw
    ],
)
def test_hand_worked_views(how, point, pixel):
    np.testing.assert_allclose(camera_of(**how).project(np.array([point], dtype=float)), [pixel], atol=1e-9)


def test_behind_the_camera_there_is_no_pixel_and_above_the_horizon_no_ground():
    level = camera_of(tilt_deg=90.0)
    assert np.isnan(level.project(np.array([[0.0, -50.0, 100.0], [0.0, 0.0, 100.0]]))).all()
    seen = level.unproject(np.array([[400.0, 299.0], [400.0, 300.0], [400.0, 500.0]]), Plane())
    assert np.isnan(seen).all(axis=1).tolist() == [True, True, False]
    np.testing.assert_allclose(seen[2], [0.0, 200.0, 0.0], atol=1e-9)


# A fixed camera takes part in what its vehicle does; a gimbal follows the heading alone.
@pytest.mark.parametrize(
    ("body", "middle"),
    [
        (Attitude(pitch_deg=45.0), (0, 100)),  # nose up: the view goes ahead
        (Attitude(pitch_deg=-45.0), (0, -100)),
        (Attitude(roll_deg=45.0), (-100, 0)),  # right side down: the view goes to the left
        (Attitude(pitch_deg=45.0, yaw_deg=90.0), (100, 0)),
        (Attitude(roll_deg=45.0, yaw_deg=90.0), (0, 100)),
    ],
)
def test_a_fixed_camera_looks_where_the_body_points(body, middle):
    np.testing.assert_allclose(mounted(body).unproject(MIDDLE, Plane())[0, :2], middle, atol=1e-9)
    steady = mounted(body, Mount(is_stabilized=True))
    np.testing.assert_allclose(steady.unproject(MIDDLE, Plane())[0, :2], (0, 0), atol=1e-9)
    assert steady.yaw_deg == pytest.approx(body.yaw_deg)


def test_a_turned_mounted_or_moved_camera_looks_where_that_says():
    for error, middle in ((Attitude(pitch_deg=45.0), (0, 100)), (Attitude(roll_deg=45.0), (-100, 0))):
        np.testing.assert_allclose(camera_of().turned(error).unproject(MIDDLE, Plane())[0, :2], middle, atol=1e-9)
    assert camera_of(yaw_deg=20.0).turned(Attitude(yaw_deg=15.0)).yaw_deg == pytest.approx(35.0)
    side = mounted(Attitude(), Mount(tilt_deg=45.0, yaw_deg=90.0))
    np.testing.assert_allclose(side.unproject(MIDDLE, Plane())[0, :2], (100, 0), atol=1e-9)
    moved = side.moved(east_m=5.0, north_m=-2.0, up_m=3.0)
    assert (moved.position_m.tolist(), moved.rotation) == ([5.0, -2.0, 103.0], side.rotation)


def test_the_footprint_of_a_tilted_view_is_a_trapezoid_that_holds_what_its_pixels_show():
    outline = camera_of(tilt_deg=45.0).footprint(Plane())
    # Up and down the picture spans +-atan(300 / 400) = 36.87 degrees around 45.
    near, far = 100 * np.tan(np.radians(45 - 36.8699)), 100 * np.tan(np.radians(45 + 36.8699))
    assert outline.bounds[1] == pytest.approx(near, abs=0.01)
    assert outline.bounds[3] == pytest.approx(far, abs=0.1)
    assert outline.is_valid
    for lens in (WIDE, BENT):
        camera = camera_of(lens, yaw_deg=33.0, tilt_deg=25.0, roll_deg=5.0)
        inside = np.random.default_rng(0).uniform((5, 5), (795, 595), (50, 2))
        ground = camera.unproject(inside, Plane())
        assert shapely.contains_xy(camera.footprint(Plane()), ground[:, 0], ground[:, 1]).all()
    camera = camera_of(tilt_deg=60.0)  # slant 200 m: 200 / 400 across, and twice that along the ground
    assert camera.gsd_m(MIDDLE, Plane())[0] == pytest.approx(1.0, rel=1e-3)
    assert np.isnan(camera.gsd_m(np.array([[400.0, 0.0]]), Plane()))[0]


def test_a_view_with_the_horizon_in_it_ends_at_its_reach_and_one_of_the_sky_has_no_footprint():
    outline = camera_of(tilt_deg=80.0).footprint(Plane(), reach_m=500.0)
    assert shapely.Point(0, 0).hausdorff_distance(outline) == pytest.approx(500.0, rel=0.01)
    assert outline.contains(shapely.Point(0, 400))
    assert not outline.contains(shapely.Point(0, -10))
    assert camera_of(tilt_deg=170.0).footprint(Plane()).is_empty
    assert camera_of(height_m=-5.0).footprint(Plane()).is_empty


def test_hills_end_the_footprint_where_their_heights_end():
    grid = Grid(epsg=32632, west_m=-400.0, north_m=400.0, cell_size_m=10.0, rows=80, cols=80)
    cells = np.add.outer(np.arange(80), np.arange(80)).astype(np.float32) / 8
    ground = Dem(grid=grid, cells_m=cells)
    camera = camera_of(yaw_deg=40.0, tilt_deg=30.0)
    outline = camera.footprint(ground)
    assert outline.is_valid
    assert outline.area > 10_000
    pixels = np.random.default_rng(0).uniform((5, 5), (795, 595), (50, 2))
    seen = camera.unproject(pixels, ground)
    seen, pixels = seen[np.isfinite(seen).all(axis=1)], pixels[np.isfinite(seen).all(axis=1)]
    np.testing.assert_allclose(camera.project(seen), pixels, atol=1e-4)
    np.testing.assert_allclose(ground.heights_m(seen[:, :2]), seen[:, 2], atol=1e-4)


@pytest.mark.parametrize(
    ("fault", "hint"),
    [({"height_m": float("nan")}, "finite"), ({"height_m": 1e9}, "within"), ({"east_m": 1e12}, "within")],
)
def test_an_absurd_camera_is_refused_on_one_line(fault, hint):
    with pytest.raises(CameraError, match=hint) as caught:
        camera_of(**fault)
    assert "\n" not in str(caught.value)
    with pytest.raises(CameraError, match="rotation"):
        Camera(intrinsics=WIDE, east_m=0.0, north_m=0.0, height_m=1.0, rotation=(1.0, 0, 0, 0, 1.0, 0, 0, 0, -1.0))
