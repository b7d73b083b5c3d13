# SPDX-License-Identifier: Apache-2.0
"""How well neighbouring photos of a flight agree on the ground, by ORB features that both show.

Both photos are projected to level ground by the pose in their files alone. `offset` is the median distance of the same
feature in both, as the poses say; a similarity fitted to them (RANSAC) says what of it is turn, scale and shift, and
`rest` is the root mean square that it leaves: relief, the lens, features found a little beside. `seen` is the way by
`sensing.visual_odometry`, which knows neither place nor heading, with its standard deviation, where heights are off by
10 % and angles by a degree; `file` is the way by the poses.

    python benchmarks/photo_overlap.py FOLDER [--focal-px 2286]
"""

import argparse
import math
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.image import AerialImage, decode_image
from sasgeo_bench.sensing.photos import Photo, read_photo
from sasgeo_bench.sensing.visual_odometry import Matches, Motion, match_images, relative_motion

HEIGHT_OFF, ATTITUDE_OFF_DEG = 0.10, 1.0  # of what the files say, as `import-photos` takes them
SAME_M = 1.0  # a feature farther off after the fit is a wrong match


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Two photos on the ground."""

    overlap: float
    features: int
    offset_m: float
    turn_deg: float
    scale: float
    rest_m: float
    file_m: tuple[float, float]  # right and up in the first photo
    seen: Motion | None


def camera_of(photo: Photo, focal_px: float | None) -> Camera:
    """The camera of a photo, with another focal length if one is given."""
    if focal_px is None:
        return photo.camera()
    centre_px = (photo.width_px / 2, photo.height_px / 2)
    lens = Intrinsics(
        width_px=photo.width_px, height_px=photo.height_px, focal_px=(focal_px, focal_px), centre_px=centre_px
    )
    return photo.camera(intrinsics=lens)


def image_of(path: Path, focal_px: float | None) -> AerialImage:
    """A photo with its camera over the map."""
    camera = camera_of(read_photo(path), focal_px)
    return AerialImage(
        rgb=decode_image(path.read_bytes(), name=path.name),
        camera=camera,
        height_sigma_m=HEIGHT_OFF * camera.height_m,
        attitude_sigma_deg=ATTITUDE_OFF_DEG,
    )


def on_ground(camera: Camera, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where rays of a camera meet level ground, easting and northing."""
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ camera.matrix
    return Plane().meet(camera.position_m, rays)[:, :2]


def agreement(images: tuple[AerialImage, AerialImage], matches: Matches) -> Agreement:
    """How two photos agree on level ground."""
    cameras = [image.camera for image in images]
    outlines = [camera.footprint(Plane()) for camera in cameras]
    origin = cameras[0].position_m[:2]
    here, there = on_ground(cameras[0], matches.before) - origin, on_ground(cameras[1], matches.after) - origin
    fit, inliers = cv2.estimateAffinePartial2D(there, here, method=cv2.RANSAC, ransacReprojThreshold=SAME_M)
    kept = inliers.ravel().astype(bool)
    moved = there[kept] @ fit[:, :2].T + fit[:, 2]
    return Agreement(
        overlap=outlines[0].intersection(outlines[1]).area / outlines[0].area,
        features=int(kept.sum()),
        offset_m=float(np.median(np.hypot(*(here - there)[kept].T))),
        turn_deg=float(np.degrees(np.arctan2(fit[0, 1], fit[0, 0]))),
        scale=float(np.hypot(fit[0, 0], fit[0, 1])),
        rest_m=float(np.sqrt(np.mean(np.sum((here[kept] - moved) ** 2, axis=1)))),
        file_m=tuple(((cameras[1].position_m[:2] - origin) @ rotation(cameras[0].yaw_deg)).tolist()),
        seen=relative_motion(*images),
    )


def compare(folder: Path, focal_px: float | None = None) -> list[tuple[str, Agreement]]:
    """The agreement of each photo of a folder with the next one, in the order of their names."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    images = pairwise(image_of(path, focal_px) for path in paths)
    return [
        (f"{first.stem} {second.stem}", agreement(pair, matches))
        for (first, second), pair in zip(pairwise(paths), images, strict=True)
        if (matches := match_images(*pair)) is not None
    ]


def way_of(motion: Motion | None) -> str:
    """How long a way is, and its standard deviation; metres."""
    if motion is None:
        return "lost"
    way = np.array([motion.right_m, motion.up_m])
    spread = way @ np.reshape(motion.covariance, (3, 3))[:2, :2] @ way / (way @ way)
    return f"{np.linalg.norm(way):.1f} +- {math.sqrt(spread):.1f}"


def main() -> None:
    """Print a row for each pair of neighbours."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="photos of one flight, in the order of their names")
    parser.add_argument("--focal-px", type=float, help="focal length, instead of the one in the photos")
    arguments = parser.parse_args()
    print("| Photos | Overlap | Features | Offset, m | Turn, deg | Scale | Rest, m | File, m | Seen, m |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    try:
        rows = compare(arguments.folder, arguments.focal_px)
    except SasgeoError as error:
        sys.exit(str(error))
    for name, pair in rows:
        print(
            f"| {name} | {pair.overlap:.2f} | {pair.features} | {pair.offset_m:.2f} | {pair.turn_deg:+.2f} | "
            f"{pair.scale:.4f} | {pair.rest_m:.2f} | {math.hypot(*pair.file_m):.1f} | {way_of(pair.seen)} |"
        )


if __name__ == "__main__":
    main()
