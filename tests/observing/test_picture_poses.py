# SPDX-License-Identifier: Apache-2.0
"""Poses of pictures: their CRS, their angles, what rows are left out, and which row belongs to a picture."""

from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.observing.picture_poses import (
    PicturePose,
    PoseFacts,
    PoseTable,
    attitude_of,
    checked,
    convergence_deg,
    is_rotation,
    picture_heading_deg,
)
from sasgeo_bench.sensing.camera import Attitude
from tests.pose_files import body, camera

BALI = (115.46, -8.29)


def poses_at(*places, **more):
    return [PicturePose(name=f"{at}.jpg", place=place, **more) for at, place in enumerate(places)]


@given(st.floats(0, 360), st.floats(-90, 89), st.floats(-180, 180))
def test_an_attitude_comes_back_from_its_matrix_with_three_different_angles(yaw, pitch, roll):
    found = attitude_of(camera(yaw, pitch, roll))
    np.testing.assert_allclose(body(found.yaw_deg, found.pitch_deg, found.roll_deg), body(yaw, pitch, roll), atol=1e-7)


@given(st.floats(0, 359.9), st.floats(-89.9, -10), st.floats(-60, 60))
def test_the_heading_of_a_picture_is_where_its_up_points(yaw, pitch, roll):
    east, north, _ = -camera(yaw, pitch, roll)[1]
    off = picture_heading_deg(Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)) - np.degrees(
        np.arctan2(east, north)
    )
    assert abs((off + 180) % 360 - 180) < 1e-6


def test_a_matrix_that_mirrors_or_stretches_is_no_rotation():
    turn = camera(37.0, -63.0, 11.0)
    assert is_rotation(turn)
    assert not is_rotation(-turn)
    assert not is_rotation(turn * 1.01)
    assert not is_rotation(np.zeros((3, 3)))


@pytest.mark.parametrize(("lon", "lat"), [(115.46, -8.29), (9.9, 47.0), (6.1, 60.0)])
def test_true_north_leans_to_the_meridian_of_a_zone(lon, lat):
    epsg = (32600 if lat > 0 else 32700) + int((lon + 180) // 6) + 1
    factors = pyproj.Proj(epsg).get_factors(lon, lat)
    assert convergence_deg(np.array([[lon, lat]]), epsg)[0] == pytest.approx(-factors.meridian_convergence, abs=1e-5)
    assert convergence_deg(np.array([[lon, lat]]), 4326)[0] == 0


def test_a_place_goes_straight_from_one_datum_to_another():
    """By way of EPSG:4326, GDA94 to GDA2020 loses the 1.5 m to 1.8 m by which Australia has drifted."""
    pose = PicturePose(name="a.jpg", place=(151.2, -33.87), epsg=4283)
    straight = pyproj.Transformer.from_crs(4283, 7844, always_xy=True).transform(*pose.place)
    assert pose.in_crs(7844) == pytest.approx(straight, abs=1e-10)
    over = pyproj.Transformer.from_crs(4326, 7844, always_xy=True).transform(*pose.lonlat)
    assert pyproj.Geod(ellps="WGS84").inv(*straight, *over)[2] > 1.0


def test_impossible_missing_and_far_places_are_left_out_by_reason():
    near = [(115.46 + step / 1000, -8.29) for step in range(5)]
    odd = [(325.0, 250.0), (0.0, 0.0), (2.35, 48.85), (-8.29, 115.46), (48.0, 115.0)]
    good, left_out = checked(poses_at(*near, *odd), {"without a position": ["z.jpg"]})
    assert [pose.name for pose in good] == [f"{at}.jpg" for at in range(5)]
    assert left_out == {
        "without a position": ("z.jpg",),
        "with a place that is nowhere on earth": ("5.jpg",),
        "at 0, 0, where no receiver had a fix": ("6.jpg",),
        "more than 50 km from the others": ("7.jpg",),
        "whose longitude and latitude are swapped": ("8.jpg", "9.jpg"),
    }


def test_a_row_that_is_near_when_turned_round_is_swapped():
    places = [(8.5, 47.0)] * 5 + [(47.0, 8.5), (8.5, 46.6), (8.5, 46.5)]
    good, left_out = checked(poses_at(*places), {})
    assert [pose.name for pose in good] == [f"{at}.jpg" for at in (0, 1, 2, 3, 4, 6)]  # 44 km; 56 km are too far
    assert left_out["whose longitude and latitude are swapped"] == ("5.jpg",)
    assert left_out["more than 50 km from the others"] == ("7.jpg",)


def test_a_survey_over_the_date_line_is_one_place():
    good, left_out = checked(poses_at((179.999, -17.0), (-179.999, -17.0), (179.998, -17.001)), {})
    assert (len(good), left_out) == (3, {})


def test_rows_of_a_projected_crs_are_measured_on_earth():
    good, left_out = checked(
        poses_at((330_000.0, 9_083_000.0), (330_100.0, 9_083_000.0), (330_000.0, 9_183_000.0), epsg=32750), {}
    )
    assert len(good) == 2
    assert left_out == {"more than 50 km from the others": ("2.jpg",)}


def test_cameras_that_look_level_or_up_are_left_out():
    angles = [Attitude(pitch_deg=pitch) for pitch in (-90.0, -6.0, -4.0, 0.0, 30.0)]
    good, left_out = checked([PicturePose(name=f"{-a.pitch_deg:g}", place=BALI, attitude=a) for a in angles], {})
    assert [pose.name for pose in good] == ["90", "6"]
    assert left_out == {"whose camera looks level or up": ("4", "-0", "-30")}


def test_rows_of_one_name_are_all_left_out():
    twice = [*poses_at(BALI, BALI), PicturePose(name="0.jpg", place=(115.47, -8.29))]
    good, left_out = checked(twice, {})
    assert [pose.name for pose in good] == ["1.jpg"]
    assert left_out == {"share their name with another (keep one row of each)": ("0.jpg", "0.jpg")}


def table_of(*names):
    return PoseTable(path=Path("t.csv"), kind="CSV", poses=tuple(PicturePose(name=name, place=BALI) for name in names))


@pytest.mark.parametrize(
    ("names", "picture", "found"),
    [
        (("a.jpg", "b.jpg"), "b.jpg", "b.jpg"),
        (("a.JPG",), "photos/a.jpg", "a.JPG"),
        (("a", "b"), "photos/b.tif", "b"),
        (("C:/x/100MEDIA/a.jpg", "C:/x/101MEDIA/a.jpg"), "y/101media/a.jpg", "C:/x/101MEDIA/a.jpg"),
        (("a.jpg",), "c.jpg", None),
        (("may/a.jpg",), "june/a.jpg", None),
        (("may/a.jpg",), "a.jpg", "may/a.jpg"),
        (("a.jpg",), "a.tif", None),
    ],
)
def test_the_pose_of_a_picture_is_found_by_name_and_folder(names, picture, found):
    pose = table_of(*names).find(picture)
    assert (pose and pose.name) == found


def test_a_picture_that_two_rows_may_mean_is_refused():
    with pytest.raises(PoseError, match=r"a\.jpg may be x/a\.jpg or y/a\.jpg of t\.csv: keep the folders"):
        table_of("x/a.jpg", "y/a.jpg").find("a.jpg")


def test_a_report_counts_each_reason_and_names_the_first_rows():
    table = table_of("a.jpg")
    table.left_out.update({"without a position": tuple(f"{at}.jpg" for at in range(5))})
    assert table.lines() == ["t.csv (CSV): 1 pose", "left out: 5 rows (0.jpg, 1.jpg, 2.jpg, ...) without a position"]


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"epsg": 999999}, "EPSG:999999 is no CRS that is known"),
        ({"epsg": 4978}, "has no longitudes or eastings"),
        ({"epsg": 32750, "origin": (115.0, -8.0, 0.0)}, "one frame"),
        ({"origin": (-8.0, 115.0, 0.0)}, "an origin is longitude, latitude and height"),
        ({"pitch_zero": "up"}, "pitch_zero is down or horizon, got 'up'"),
    ],
)
def test_facts_that_cannot_be_are_refused(facts, words):
    with pytest.raises(PoseError) as caught:
        PoseFacts(**facts)
    assert words in str(caught.value)
