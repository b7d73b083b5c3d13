# SPDX-License-Identifier: Apache-2.0
"""Evidence of a query from what a segmenter says of its pictures: onto the ground, frame by frame, then together."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.sensing.accumulation import Errors, accumulate, steps_between
from sasgeo_bench.sensing.birdseye import Reading, see_ground
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.frames import Frame

_M_PER_KM: Final = 1000.0


def evidence_of(
    frames: Sequence[Frame],
    seen: Sequence[Segmentation | None],
    *,
    size_cells: int,
    cell_size_m: float,
    reading: Reading | None = None,
) -> Evidence | None:
    """Return the evidence of all frames in the view's frame: that of the last camera, as it is believed.

    Parameters
    ----------
    frames : sequence of Frame
        Pictures with their cameras, oldest first.
    seen : sequence of Segmentation or None
        What a segmenter says of each; None where it failed, which costs that frame alone.
    size_cells, cell_size_m : int, float
        Cells a side of the square view, and their side, metres.
    reading : Reading, optional
        Thresholds, widths and heights of the classes.

    Returns
    -------
    Evidence or None
        None if the segmenter failed at the last frame.

    Notes
    -----
    Ground is a plane at the height of take-off. Frames are put together by odometry as Eq. (4) of the SASGeo paper
    says; the errors that the frames declare make unknown grow.
    """
    last = frames[-1].camera
    if seen[-1] is None:  # it is the frame that the query is about
        return None
    views, poses = [], []
    for frame, found in zip(frames, seen, strict=True):
        if found is None:
            continue
        camera = frame.camera
        east_m, north_m = camera.east_m - last.east_m, camera.north_m - last.north_m
        poses.append(Pose(easting_m=east_m, northing_m=north_m, yaw_deg=camera.yaw_deg))
        views.append(
            see_ground(
                found,
                camera,
                Plane(),
                size_cells=size_cells,
                cell_size_m=cell_size_m,
                pose=poses[-1],
                reading=reading,
            )
        )
    together = views[0]
    if len(views) > 1:
        together = accumulate(views, steps_between(poses), errors=_errors(frames), height_m=last.height_m)
    return together.to_evidence(reading)


@lru_cache(maxsize=32)
def unseen(classes: tuple[str, ...], size_cells: int, cell_size_m: float) -> Evidence:
    """Return evidence that is all unknown, shared by all views: many are in memory at once."""
    cells = np.full((len(classes), size_cells, size_cells), UNKNOWN, dtype=np.uint8)
    return Evidence(classes=classes, cells=cells, cell_size_m=cell_size_m)


def for_classes(found: Evidence | None, empty: Evidence) -> Evidence:
    """Return evidence for the classes of a map, in their order: unknown where a segmenter tells nothing of one."""
    cells = np.full(empty.cells.shape, UNKNOWN, dtype=np.uint8)
    confidence = np.zeros(empty.cells.shape, dtype=np.uint8)
    for index, name in enumerate(empty.classes):
        if found is not None and found.confidence is not None and name in found.classes:
            at = found.classes.index(name)
            cells[index], confidence[index] = found.cells[at], found.confidence[at]
    return empty.replace(cells, confidence)


def _errors(frames: Sequence[Frame]) -> Errors:
    """Return the errors that frames declare, as accumulation takes them."""
    last = frames[-1]
    far_m = [
        math.hypot(one.camera.east_m - last.camera.east_m, one.camera.north_m - last.camera.north_m) for one in frames
    ]
    moved = [(frame, distance_m) for frame, distance_m in zip(frames, far_m, strict=True) if distance_m > 1.0]
    return Errors(
        attitude_deg=last.attitude_sigma_deg,
        height_share=0.0,  # one error for a flight: the scale of the view, which the prior declares
        position_share=max((frame.position_sigma_m / distance_m for frame, distance_m in moved), default=0.0),
        yaw_deg_per_km=max(
            (frame.yaw_sigma_deg / math.sqrt(distance_m / _M_PER_KM) for frame, distance_m in moved), default=0.0
        ),
    )


def poses_before(steps: Sequence[Pose]) -> list[Pose]:
    """Return where frames stood in the axes of the last one, from odometry, oldest first.

    `steps` are the poses of each frame in the axes (right, up) of the one before.

    >>> [pose.northing_m for pose in poses_before([Pose(easting_m=0.0, northing_m=40.0, yaw_deg=0.0)] * 2)]
    [-80.0, -40.0, 0.0]
    """
    at = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    found = [at]
    for step in reversed(steps):
        before = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=at.yaw_deg - step.yaw_deg)
        east_m, north_m = before.to_map(np.array([(step.easting_m, step.northing_m)]))[0].tolist()
        at = Pose(easting_m=at.easting_m - east_m, northing_m=at.northing_m - north_m, yaw_deg=before.yaw_deg)
        found.append(at)
    return found[::-1]
