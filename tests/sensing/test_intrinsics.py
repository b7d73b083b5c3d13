# SPDX-License-Identifier: Apache-2.0
"""Lenses: from slopes to pixels and back, against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.sensing.camera import Intrinsics

LENS = (-0.12, 0.03, 0.001, -0.0005, -0.004)


def lens_of(distortion=LENS, width_px=800, height_px=600):
    return Intrinsics(
        width_px=width_px, height_px=height_px, focal_px=(700.0, 690.0), centre_px=(410.0, 295.0), distortion=distortion
    )


def test_pixels_are_those_of_opencv_half_a_pixel_on():
    slopes = np.random.default_rng(1).uniform(-0.6, 0.6, (200, 2))
    points = np.column_stack([slopes, np.ones(200)]) * 7
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens_of().matrix, np.array(LENS))[0].reshape(-1, 2)
    np.testing.assert_allclose(lens_of().to_pixels(slopes), expected + 0.5, atol=1e-9)


@example(k1=0.0, k2=2e-311, p1=0.0, at=(0.0, 0.0))
@given(
    k1=st.floats(-0.2, 0.2),
    k2=st.floats(-0.05, 0.05),
    p1=st.floats(-0.003, 0.003),
    at=st.tuples(st.floats(0, 800), st.floats(0, 600)),
)
def test_a_pixel_and_its_ray_belong_together(k1, k2, p1, at):
    lens = lens_of((k1, k2, p1, -p1, 0.0))
    point = np.array([at])
    np.testing.assert_allclose(lens.to_pixels(lens.to_slopes(point)), point, atol=1e-3)


def test_what_the_lens_would_fold_into_the_picture_gets_no_pixel_and_what_lies_beyond_no_ray():
    barrel = lens_of((-0.3, 0.0, 0.0, 0.0, 0.0))  # grows up to a slope of 1 / sqrt(0.9)
    folded = barrel.to_pixels(np.array([[1.0, 0.0], [1.2, 0.0], [1.8, 0.0]]))
    assert np.isnan(folded).all(axis=1).tolist() == [False, True, True]
    assert np.isnan(barrel.to_slopes(np.array([[2000.0, 300.0]]))).all()
    assert barrel.to_pixels(np.empty((0, 2))).shape == barrel.to_slopes(np.empty((0, 2))).shape == (0, 2)


def test_a_matrix_and_a_field_of_view_come_back_and_the_border_runs_once_around_the_picture():
    lens = lens_of()
    assert Intrinsics.from_matrix(lens.matrix, width_px=800, height_px=600, distortion=LENS) == lens
    lens = Intrinsics.from_field_of_view(horizontal_deg=70.0, width_px=801, height_px=600)
    assert lens.centre_px == (400.5, 300.0)
    assert lens.horizontal_deg == pytest.approx(70.0)
    border = lens_of().border_px(4)
    assert border[[0, 4, 8, 12]].tolist() == [[0, 0], [800, 0], [800, 600], [0, 600]]


@pytest.mark.parametrize(
    ("fault", "hint"),
    [
        ({"width_px": 0}, "pixels a side"),
        ({"height_px": 10**9}, "pixels a side"),
        ({"focal_px": (3.6, 3.6)}, "millimetres"),
        ({"focal_px": (-700.0, 700.0)}, "positive"),
        ({"focal_px": (float("nan"), 700.0)}, "finite"),
        ({"centre_px": (float("inf"), 0.0)}, "finite"),
        ({"distortion": (0.1, 0.1)}, "five"),
    ],
)
def test_an_absurd_lens_is_refused_on_one_line(fault, hint):
    good = {"width_px": 800, "height_px": 600, "focal_px": (700.0, 700.0), "centre_px": (400.0, 300.0)}
    with pytest.raises(CameraError, match=hint):
        Intrinsics(**(good | fault))


def test_an_absurd_field_of_view_or_matrix_is_refused():
    for degrees in (0.0, -3.0, 180.0, float("nan")):
        with pytest.raises(CameraError, match="field of view"):
            Intrinsics.from_field_of_view(horizontal_deg=degrees, width_px=800, height_px=600)
    for matrix in (np.eye(2), np.array([[9.0, 1, 4], [0, 9, 3], [0, 0, 1]]), np.ones((3, 3))):  # the second has skew
        with pytest.raises(CameraError, match="camera matrix"):
            Intrinsics.from_matrix(matrix, width_px=8, height_px=6)
