# SPDX-License-Identifier: Apache-2.0
"""Visual odometry, held against pictures of a plane that are drawn without our cameras."""

import math
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics
from sasgeo_bench.sensing.image import AerialImage
from sasgeo_bench.sensing.visual_odometry import Motion, match_images, relative_motion

SIDE_PX, FOCAL_PX, HEIGHT_M = 480, 480.0, 60.0  # a picture is as wide as it is far away
TEXEL_M = 0.125
LENS = Intrinsics(
    width_px=SIDE_PX, height_px=SIDE_PX, focal_px=(FOCAL_PX, FOCAL_PX), centre_px=(SIDE_PX / 2, SIDE_PX / 2)
)


@cache
def texture(seed):
    """Return ground of 250 m a side as grey texels, north up, its middle at (0, 0)."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.standard_normal((2000, 2000)), (0, 0), sigma) * sigma for sigma in (1.5, 4.0, 12.0)]
    grey = cv2.normalize(sum(layers), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def picture(stand, ground=None):
    """Return what a pinhole sees of the ground, by a homography made of its place, heading and tilts."""
    east_m, north_m, height_m, yaw_deg, pitch_deg, roll_deg = stand
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    up = np.array([math.sin(yaw), math.cos(yaw), 0.0])
    below = np.array([0.0, 0.0, -1.0])
    ahead, up = math.cos(pitch) * below + math.sin(pitch) * up, math.cos(pitch) * up - math.sin(pitch) * below
    ahead, right = math.cos(roll) * ahead - math.sin(roll) * right, math.cos(roll) * right + math.sin(roll) * ahead
    axes = np.stack([right, -up, ahead])
    centre = np.array([east_m, north_m, height_m])
    pixel_of_m = np.array([[FOCAL_PX, 0, SIDE_PX / 2 - 0.5], [0, FOCAL_PX, SIDE_PX / 2 - 0.5], [0, 0, 1.0]]) @ (
        np.column_stack([axes[:, 0], axes[:, 1], -axes @ centre])
    )
    m_of_texel = np.array([[TEXEL_M, 0, -999.5 * TEXEL_M], [0, -TEXEL_M, 999.5 * TEXEL_M], [0, 0, 1]])
    shown = texture(1) if ground is None else ground
    return cv2.warpPerspective(shown, pixel_of_m @ m_of_texel, (SIDE_PX, SIDE_PX), flags=cv2.INTER_LINEAR)


def believed(
    rgb, *, height_m=HEIGHT_M, yaw_deg=0.0, tilt_deg=0.0, sigmas=(0.05, 1.0), off=(0.0, 0.0), place=(0.0, 0.0)
):
    """Return a picture with what is believed of its camera; `sigmas` of the height, as a fraction, and of angles."""
    camera = Camera.pointed(
        intrinsics=LENS, east_m=place[0], north_m=place[1], height_m=height_m, yaw_deg=yaw_deg, tilt_deg=tilt_deg
    ).turned(Attitude(pitch_deg=off[0], roll_deg=off[1]))
    return AerialImage(rgb=rgb, camera=camera, height_sigma_m=sigmas[0] * height_m, attitude_sigma_deg=sigmas[1])


def true_motion(before, after):
    east_m, north_m = after[0] - before[0], after[1] - before[1]
    yaw = math.radians(before[3])
    right_m = east_m * math.cos(yaw) - north_m * math.sin(yaw)
    up_m = east_m * math.sin(yaw) + north_m * math.cos(yaw)
    return np.array([right_m, up_m, wrap_deg(after[3] - before[3])])


def error_of(motion, before, after):
    """Return the errors of a motion: metres, metres, degrees."""
    right_m, up_m, turn_deg = numbers(motion) - true_motion(before, after)
    return np.array([right_m, up_m, wrap_deg(turn_deg)])


def numbers(motion):
    return np.array([motion.right_m, motion.up_m, motion.turn_deg])


def covariance(motion):
    return np.reshape(motion.covariance, (3, 3))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((0.0, 0.0, 60.0, 0.0, 0.0, 0.0), (0.0, 15.0, 60.0, 0.0, 0.0, 0.0)),
        ((-10.0, 0.0, 60.0, 90.0, 0.0, 0.0), (5.0, 4.0, 66.0, 70.0, 0.0, 0.0)),
        ((0.0, 10.0, 60.0, 200.0, 0.0, 0.0), (3.0, -2.0, 57.0, 20.0, 0.0, 0.0)),
        ((0.0, -10.0, 60.0, 350.0, 25.0, 0.0), (0.0, 5.0, 60.0, 10.0, 20.0, 0.0)),
    ],
    ids=["ahead", "turning and climbing", "back on a line", "tilted"],
)
def test_the_motion_is_found(before, after):
    seen = [believed(picture(one), height_m=one[2], tilt_deg=one[4], sigmas=(0.01, 0.1)) for one in (before, after)]
    motion = relative_motion(*seen)
    off = error_of(motion, before, after)
    assert np.hypot(*off[:2]) < 0.15
    assert abs(off[2]) < 0.1
    assert motion.inliers > 50


def test_place_and_heading_of_the_cameras_are_not_used():
    rgb = [picture((0.0, 0.0, 60.0, 30.0, 10.0, 0.0)), picture((5.0, 12.0, 60.0, 60.0, 10.0, 0.0))]
    plain = relative_motion(*(believed(one, tilt_deg=10.0) for one in rgb))
    there, here = ((700.0, -40.0), (-900.0, 3.0))
    wrong = relative_motion(
        believed(rgb[0], tilt_deg=10.0, yaw_deg=123.0, place=there),
        believed(rgb[1], tilt_deg=10.0, yaw_deg=311.0, place=here),
    )
    np.testing.assert_allclose(numbers(plain), numbers(wrong), atol=1e-6)
    np.testing.assert_allclose(covariance(plain), covariance(wrong), rtol=1e-4, atol=1e-9)


def test_the_same_pictures_give_the_same_motion_whatever_state_opencv_is_in():
    seen = [believed(picture((0.0, 0.0, 60.0, 0.0, 0.0, 0.0))), believed(picture((0.0, 20.0, 60.0, 5.0, 0.0, 0.0)))]
    cv2.setRNGSeed(1)
    first = relative_motion(*seen)
    cv2.setRNGSeed(99)
    assert relative_motion(*seen) == first


def test_the_way_is_as_long_as_the_height_says():
    rgb = [picture((0.0, 0.0, 60.0, 0.0, 0.0, 0.0)), picture((0.0, 15.0, 60.0, 0.0, 0.0, 0.0))]
    motion = relative_motion(*(believed(one, height_m=66.0) for one in rgb))
    assert motion.up_m == pytest.approx(16.5, abs=0.1)
    assert covariance(motion)[1, 1] ** 0.5 > 0.04 * 15.0  # of a height that is known to 5 %


def test_tilts_that_are_believed_wrongly_are_found_out():
    before, after = (0.0, 0.0, 60.0, 0.0, 0.0, 0.0), (0.0, 15.0, 60.0, 0.0, 0.0, 0.0)
    seen = [
        believed(picture(before), off=(1.0, -1.0), sigmas=(0.01, 1.0)),
        believed(picture(after), off=(-1.0, 0.5), sigmas=(0.01, 1.0)),
    ]
    off = error_of(relative_motion(*seen), before, after)
    assert math.radians(2.0) * HEIGHT_M > 2.0  # metres that a difference of two degrees moves the view
    assert np.hypot(*off[:2]) < 0.4


@pytest.mark.slow
def test_standard_deviations_cover_the_errors_and_are_not_vast():
    rng = np.random.default_rng(3)
    far = []
    for _ in range(12):
        stands = [
            (*(rng.uniform(-8, 8, 2) + 30.0 * at), 60.0, rng.uniform(0, 360), *rng.normal(0, 1.0, 2)) for at in (0, 0.3)
        ]
        bias = 1 + rng.normal(0, 0.03)
        seen = [believed(picture(one), height_m=60.0 * bias, sigmas=(0.03, 1.0)) for one in stands]
        motion = relative_motion(*seen)
        off = error_of(motion, *stands)
        far.append(off @ np.linalg.solve(covariance(motion), off))
    assert np.mean(np.array(far) < 7.81) >= 0.8  # 95 % of three degrees of freedom
    assert np.mean(far) > 0.3  # 3 where they are exact


def test_pictures_that_share_too_little_have_no_motion():
    before = believed(picture((0.0, 0.0, 60.0, 0.0, 0.0, 0.0)))
    assert relative_motion(before, believed(picture((0.0, 58.0, 60.0, 0.0, 0.0, 0.0)))) is None
    assert relative_motion(before, believed(picture((0.0, 0.0, 60.0, 0.0, 0.0, 0.0), texture(2)))) is None


def test_pictures_without_features_have_no_motion():
    grey = believed(np.full((SIDE_PX, SIDE_PX, 3), 128, dtype=np.uint8))
    assert match_images(grey, grey) is None
    assert relative_motion(grey, grey) is None


def test_cameras_that_see_only_far_ground_have_no_motion():
    rgb = picture((0.0, 0.0, 60.0, 0.0, 0.0, 0.0))
    level = believed(rgb, tilt_deg=115.0)
    assert relative_motion(level, level) is None


def test_a_camera_on_the_ground_has_no_motion():
    rgb = picture((0.0, 0.0, 60.0, 0.0, 0.0, 0.0))
    assert relative_motion(believed(rgb), believed(rgb)).up_m == pytest.approx(0.0, abs=1e-6)
    assert relative_motion(believed(rgb), believed(rgb, height_m=0.0)) is None


def test_larger_pictures_are_matched_when_made_smaller():
    stands = [(0.0, 0.0, 60.0, 0.0, 0.0, 0.0), (3.0, 12.0, 60.0, 8.0, 0.0, 0.0)]
    large = []
    for one in stands:
        lens = replace(LENS, width_px=1440, height_px=1440, focal_px=(1440.0,) * 2, centre_px=(720.0, 720.0))
        rgb = cv2.resize(picture(one), (1440, 1440), interpolation=cv2.INTER_CUBIC)
        camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=60.0, yaw_deg=0.0)
        large.append(AerialImage(rgb=rgb, camera=camera, height_sigma_m=0.6, attitude_sigma_deg=0.1))
    off = error_of(relative_motion(*large), *stands)
    assert np.hypot(*off[:2]) < 0.15


def test_points_beside_the_cameras_move_as_poses_do():
    before, after = (
        Pose(easting_m=5.0, northing_m=7.0, yaw_deg=40.0),
        Pose(easting_m=9.0, northing_m=1.0, yaw_deg=310.0),
    )
    way = true_motion((5.0, 7.0, 0.0, 40.0), (9.0, 1.0, 0.0, 310.0))
    motion = Motion(right_m=way[0], up_m=way[1], turn_deg=way[2], covariance=(0.0,) * 8 + (4.0,), inliers=20)
    points = (3.0, 20.0), (-2.0, 30.0)
    moved = motion.of_points(*points)
    there, here = before.to_map(np.array([points[0]]))[0], after.to_map(np.array([points[1]]))[0]
    expected = true_motion((*there, 0.0, 40.0), (*here, 0.0, 310.0))
    np.testing.assert_allclose(numbers(moved), expected, atol=1e-9)
    turned = replace(motion, turn_deg=motion.turn_deg + 1e-5).of_points(*points)
    slope = (numbers(turned) - numbers(moved)) / 1e-5
    np.testing.assert_allclose(covariance(moved), 4.0 * np.outer(slope, slope), rtol=1e-3)
