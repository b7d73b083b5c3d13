# SPDX-License-Identifier: Apache-2.0
"""Tilt out of the borders of roads."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.road_tilt import SCENES, trial
from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.tilt import join_parallel, refine_tilt, road_borders

LENS = Intrinsics.from_field_of_view(horizontal_deg=70.0, width_px=768, height_px=768)
# Borders of streets on the ground: two to the north, 60 m apart, and two to the east.
NORTH = np.array([[[-30.0, -40], [-30, 40]], [[30, -40], [30, 40]]])
EAST = NORTH[:, :, ::-1]


def camera_of(*, yaw_deg=20.0, tilt_deg=10.0):
    return Camera.pointed(intrinsics=LENS, east_m=0.0, north_m=0.0, height_m=120.0, yaw_deg=yaw_deg, tilt_deg=tilt_deg)


def seen_by(camera, lines_m):
    return camera.project(np.pad(lines_m.reshape(-1, 2), ((0, 0), (0, 1)))).reshape(lines_m.shape)


def off_deg(first, second):
    cosine = (np.trace(first.matrix @ second.matrix.T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@settings(max_examples=12)  # each is a fit
@given(pitch=st.floats(-10, 10), roll=st.floats(-10, 10), yaw=st.floats(0, 360), tilt=st.floats(0, 25))
def test_streets_of_two_directions_give_the_tilt_back(pitch, roll, yaw, tilt):
    true = camera_of(yaw_deg=yaw, tilt_deg=tilt)
    roads = [seen_by(true, NORTH), seen_by(true, EAST)]
    fit = refine_tilt(true.turned(Attitude(pitch_deg=pitch, roll_deg=roll)), roads, attitude_sigma_deg=10.0)
    # A turn about the optical axis is left, since borders do not say where north is.
    assert np.degrees(np.arccos(np.clip(fit.camera.matrix[2] @ true.matrix[2], -1, 1))) < 0.35
    assert fit.after_deg < 0.1


def test_one_direction_corrects_the_tilt_along_it_alone():
    true = camera_of(yaw_deg=0.0, tilt_deg=0.0)
    believed = true.turned(Attitude(pitch_deg=4.0, roll_deg=4.0))
    fit = refine_tilt(believed, [seen_by(true, NORTH)], attitude_sigma_deg=5.0)
    assert fit.pitch_deg == pytest.approx(-4.0, abs=0.3)
    assert abs(fit.roll_deg) < 0.5
    assert fit.pitch_sigma_deg < 1.0
    assert fit.roll_sigma_deg > 4.0


def test_a_narrow_road_says_less_than_a_wide_one():
    true = camera_of()
    fits = [
        refine_tilt(true, [seen_by(true, NORTH * (share, 1.0))], attitude_sigma_deg=5.0) for share in (0.1, 0.5, 1.0)
    ]
    sigmas = [min(fit.pitch_sigma_deg, fit.roll_sigma_deg) for fit in fits]
    assert sigmas == sorted(sigmas, reverse=True)


def test_without_roads_or_with_borders_above_the_horizon_the_camera_is_about_the_believed_one():
    fit = refine_tilt(camera_of(), [], attitude_sigma_deg=3.0)
    assert off_deg(fit.camera, camera_of()) == pytest.approx(0.0, abs=1e-5)
    assert (fit.before_deg, fit.pitch_sigma_deg) == (0.0, pytest.approx(3.0))
    level = camera_of(tilt_deg=85.0)
    sky = np.array([[[100.0, 10.0], [200, 12]], [[100, 50], [200, 52]]])
    assert np.isfinite(refine_tilt(level, [sky], attitude_sigma_deg=2.0).camera.tilt_deg)


def test_a_road_that_widens_pulls_little():
    true = camera_of()
    funnel = seen_by(true, np.array([[[-10.0, -40], [-30, 40]], [[10, -40], [30, 40]]]))
    streets = [seen_by(true, NORTH), seen_by(true, EAST)]
    fit = refine_tilt(true, [*streets, funnel], attitude_sigma_deg=5.0)
    assert off_deg(fit.camera, true) < 2.0  # of 28 degrees between its borders


def mask_of(camera, rings):
    mask = np.zeros((768, 768), dtype=np.uint8)
    for ring in rings:
        pixels = seen_by(camera, np.array(ring, dtype=float))
        cv2.fillPoly(mask, [np.rint(pixels).astype(np.int32)], 1)
    return mask.astype(bool)


def test_borders_of_roads_are_found_and_joined_by_direction_and_houses_are_not():
    camera = camera_of()
    road = [(-4, -60), (4, -60), (4, 60), (-4, 60)]
    house = [(20, 20), (30, 20), (30, 32), (20, 32)]
    (borders,) = road_borders(mask_of(camera, [road, house]))
    ground = camera.unproject(borders.reshape(-1, 2), Plane())[:, 0]
    assert np.sort(ground) == pytest.approx([-4, -4, 4, 4], abs=0.4)
    true = camera_of()
    roads = [seen_by(true, NORTH), seen_by(true, EAST), seen_by(true, NORTH + np.array([10.0, 0.0]))]
    assert [len(lines) for lines in join_parallel(true, roads, within_deg=3.0)] == [4, 2]


def test_masks_without_roads_have_no_borders():
    field = mask_of(camera_of(), [[(-50, -60), (50, -60), (50, 60), (-50, 60)]])
    for mask in (field, np.zeros((50, 50), dtype=bool), np.ones((50, 50), dtype=bool), np.eye(50, dtype=bool)):
        assert road_borders(mask) == []


@pytest.mark.parametrize("error_deg", [2.0, 5.0, 10.0])
def test_a_wrong_tilt_over_a_grid_of_streets_shrinks(error_deg):
    left_deg, _, found = trial(SCENES[-1], 0.0, error_deg, seed=1)
    assert found >= 3
    assert left_deg < error_deg / 2


@pytest.mark.parametrize(
    ("roads", "how"),
    [
        ([], {"attitude_sigma_deg": 0.0}),
        ([], {"attitude_sigma_deg": 1.0, "end_sigma_px": float("nan")}),
        ([np.zeros((1, 2, 2))], {"attitude_sigma_deg": 1.0}),
        ([np.zeros((4, 2))], {"attitude_sigma_deg": 1.0}),
    ],
)
def test_absurd_borders_and_sigmas_are_refused(roads, how):
    with pytest.raises(CameraError, match=r"positive|shape"):
        refine_tilt(camera_of(), roads, **how)
