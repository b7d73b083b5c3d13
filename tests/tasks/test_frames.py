# SPDX-License-Identifier: Apache-2.0
"""Frames: pictures fit into their bytes, cameras and labels come back, and odometry is laid back from the newest."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import CameraError, ImageError, ShapeError, StoreError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.sensing.accumulation import steps_between
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.frame_evidence import evidence_of, poses_before
from sasgeo_bench.tasks.frame_files import LABELS, frame_of, frame_row, read_labels
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from tests.tasks.test_task_files import ABOUT, one_query, one_truth

LENS = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=40, height_px=40)
CLASSES = ("building", "water")


def camera(height_m=20.0, **stands):
    given = {"east_m": 0.0, "north_m": 0.0, "yaw_deg": 0.0} | stands
    return Camera.pointed(intrinsics=LENS, height_m=height_m, **given)


def picture(value=120):
    return encode_webp(np.full((40, 40, 3), value, dtype=np.uint8))


def frame(**fields):
    return Frame(**{"picture": picture(), "camera": camera()} | fields)


def seen(rows):
    """A segmentation in which the rows named are buildings, and nothing is water."""
    planes = np.zeros((2, 40, 40), dtype=np.float32)
    planes[0, rows] = 1.0
    return Segmentation.of_probabilities(CLASSES, planes)


def test_noise_fits_into_the_bytes_of_a_picture_by_losing_quality():
    noise = np.random.default_rng(0).integers(0, 255, (256, 256, 3)).astype(np.uint8)
    large, small = encode_webp(noise), encode_webp(noise, most_bytes=40_000)
    assert len(small) <= 40_000 < len(large) <= 150_000
    with pytest.raises(ImageError, match="256 x 256 pixels does not fit into 1000 bytes"):
        encode_webp(noise, most_bytes=1000)


def test_a_frame_comes_back_from_its_row_and_its_picture_is_decoded():
    before = frame(camera=camera(east_m=3.0, yaw_deg=7.0), height_sigma_m=0.6, yaw_sigma_deg=0.2)
    after = frame_of(frame_row(before))
    assert after == before
    image = after.image(season="snow")
    assert (image.shape, image.season) == ((40, 40), "snow")
    assert (image.camera.east_m, image.camera.height_m) == (0.0, 20.0)
    assert abs(int(image.rgb.mean()) - 120) < 4


@pytest.mark.parametrize(
    ("fields", "error", "words"),
    [
        ({"picture": b"x" * 150_001}, ImageError, "at most 150000 bytes"),
        ({"height_sigma_m": -1.0}, ImageError, "height_sigma_m must be finite and not negative"),
        ({"yaw_sigma_deg": float("nan")}, ImageError, "yaw_sigma_deg"),
    ],
)
def test_a_frame_that_cannot_be_is_refused_in_a_line(fields, error, words):
    with pytest.raises(error, match=words):
        frame(**fields)


def test_damaged_bytes_of_a_picture_or_a_camera_are_refused_in_a_line():
    with pytest.raises(ImageError, match="no JPEG, PNG, WebP or TIFF"):
        frame(picture=b"nothing").image()
    with pytest.raises(CameraError, match="right-handed rotation"):
        frame_of(frame_row(frame()) | {"rotation": [0.0] * 9})


def test_labels_come_back_in_the_order_of_the_queries_and_lie_beside_the_truths_alone(tmp_path):
    labels = np.random.default_rng(1).integers(0, 3, (2, 40, 40)).astype(np.uint8)
    found = (FrameLabels.of(CLASSES, labels), FrameLabels.of(CLASSES, np.zeros_like(labels)))
    names = [f"{number:024x}" for number in range(10)]
    pairs = (
        (one_query(query_id=name, frames=(frame(), frame())), one_truth(query_id=name, labels=found)) for name in names
    )
    folders = (tmp_path / "tasks", tmp_path / "truth")
    for folder in folders:
        folder.mkdir()
    task_files.write_task(*folders, pairs, ABOUT)
    assert task_files.read_task(folders[0])["frames"] == 20
    assert sorted(path.name for path in folders[0].iterdir()) == ["queries.parquet", "task.json"]
    rows = list(read_labels(folders[1]))
    assert [row[:2] for row in rows] == [(name, number) for name in names for number in (0, 1)]
    np.testing.assert_array_equal(rows[0][2].labels, labels)
    assert [len(query.frames) for query in task_files.read_queries(folders[0])] == [2] * 10
    assert next(task_files.read_truths(folders[1])).labels == ()


def test_labels_that_are_missing_or_do_not_fit_are_refused(tmp_path):
    with pytest.raises(StoreError, match=LABELS):
        list(read_labels(tmp_path))
    sound = FrameLabels.of(CLASSES, np.zeros((2, 4, 4), dtype=np.uint8))
    with pytest.raises(ShapeError):
        _ = replace(sound, rows=40).labels


def test_odometry_is_laid_back_from_the_newest_frame():
    flown = [Pose(easting_m=east, northing_m=north, yaw_deg=yaw) for east, north, yaw in ((0, 0, 0), (0, 30, 90))]
    back = poses_before(steps_between(flown))
    # Seen from the last frame, which heads east, the first one lies 30 m to its right and heads to its left.
    assert (round(back[0].easting_m, 6), round(back[0].northing_m, 6), back[0].yaw_deg % 360) == (30.0, 0.0, 270.0)
    assert (back[1].easting_m, back[1].northing_m, back[1].yaw_deg) == (0.0, 0.0, 0.0)


def test_the_upper_half_of_a_picture_is_the_upper_half_of_the_evidence_and_beyond_it_nothing_is_known():
    found = evidence_of([frame()], [seen(slice(0, 20))], size_cells=80, cell_size_m=1.0)
    cells = found.layer("water")
    assert (cells[20:60, 20:60] == ABSENT).mean() > 0.5
    assert (cells[:19] == UNKNOWN).all()
    assert (cells[:, :19] == UNKNOWN).all()
    buildings = found.layer("building")
    assert (buildings[22:36, 22:58] == PRESENT).any()
    assert (buildings[44:58, 22:58] == ABSENT).all()
    assert found.confidence.shape == found.cells.shape


def test_an_older_frame_adds_the_ground_that_it_saw_and_a_failed_one_adds_nothing():
    older = frame(camera=camera(north_m=-30.0))
    alone = evidence_of([frame()], [seen(slice(0, 0))], size_cells=120, cell_size_m=1.0)
    both = evidence_of([older, frame()], [seen(slice(0, 0))] * 2, size_cells=120, cell_size_m=1.0)
    failed = evidence_of([older, frame()], [None, seen(slice(0, 0))], size_cells=120, cell_size_m=1.0)
    assert both.unknown_share < alone.unknown_share - 0.05
    np.testing.assert_array_equal(failed.cells, alone.cells)
    assert evidence_of([older, frame()], [seen(slice(0, 0)), None], size_cells=120, cell_size_m=1.0) is None


def test_what_odometry_declares_makes_unknown_grow():
    def cells(sigma_m):
        older = frame(camera=camera(north_m=-30.0), position_sigma_m=sigma_m)
        houses = Segmentation.of_probabilities(CLASSES, np.kron(np.eye(2), np.ones((20, 20)))[None].repeat(2, axis=0))
        return evidence_of([older, frame()], [houses] * 2, size_cells=120, cell_size_m=1.0)

    assert cells(6.0).unknown_share > cells(0.0).unknown_share
