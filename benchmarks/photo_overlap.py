# SPDX-License-Identifier: Apache-2.0
"""How well neighbouring photos of a flight agree on the ground, by ORB features that both show.

Both photos are projected to level ground by the pose in their files alone. `offset` is the median distance of the same
feature in both, as the poses say; a similarity fitted to them (RANSAC) says what of it is turn, scale and shift, and
`rest` is the root mean square that it leaves: relief, the lens, features found a little beside.

    python benchmarks/photo_overlap.py FOLDER [--focal-px 2286]
"""

import argparse
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.photos import Photo, read_photo

REDUCED = 4  # photos are matched at a quarter of their size
FEATURES = 6000
RATIO = 0.8  # of the distances of the best and the second feature
SAME_M = 1.0  # a feature farther off after the fit is a wrong match

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Two photos on the ground."""

    overlap: float
    features: int
    offset_m: float
    turn_deg: float
    scale: float
    rest_m: float


def camera_of(photo: Photo, focal_px: float | None) -> Camera:
    """The camera of a photo, with another focal length if one is given."""
    if focal_px is None:
        return photo.camera()
    centre_px = (photo.width_px / 2, photo.height_px / 2)
    lens = Intrinsics(
        width_px=photo.width_px, height_px=photo.height_px, focal_px=(focal_px, focal_px), centre_px=centre_px
    )
    return photo.camera(intrinsics=lens)


def matches_px(first: Path, second: Path) -> tuple[Points, Points]:
    """Pixels of features that two photos share, shape (N, 2) each, in the photos at full size."""
    orb = cv2.ORB_create(FEATURES)
    found = [
        orb.detectAndCompute(cv2.imread(str(path), cv2.IMREAD_REDUCED_GRAYSCALE_4), None) for path in (first, second)
    ]
    (points, words), (others, other_words) = found
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(words, other_words, k=2)
    best = [pair[0] for pair in pairs if len(pair) > 1 and pair[0].distance < RATIO * pair[1].distance]
    at = np.array([points[match.queryIdx].pt for match in best]).reshape(-1, 2)
    on = np.array([others[match.trainIdx].pt for match in best]).reshape(-1, 2)
    return (at + 0.5) * REDUCED, (on + 0.5) * REDUCED


def agreement(cameras: tuple[Camera, Camera], pixels: tuple[Points, Points]) -> Agreement:
    """How two photos agree on level ground."""
    ground = Plane()
    outlines = [camera.footprint(ground) for camera in cameras]
    origin = cameras[0].position_m[:2]
    here, there = (camera.unproject(at, ground)[:, :2] - origin for camera, at in zip(cameras, pixels, strict=True))
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
    )


def compare(folder: Path, focal_px: float | None = None) -> list[tuple[str, Agreement]]:
    """The agreement of each photo of a folder with the next one, in the order of their names."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    cameras = [camera_of(read_photo(path), focal_px) for path in paths]
    return [
        (f"{first.stem} {second.stem}", agreement((here, there), matches_px(first, second)))
        for (first, here), (second, there) in pairwise(zip(paths, cameras, strict=True))
    ]


def main() -> None:
    """Print a row for each pair of neighbours."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="photos of one flight, in the order of their names")
    parser.add_argument("--focal-px", type=float, help="focal length, instead of the one in the photos")
    arguments = parser.parse_args()
    print("| Photos | Overlap | Features | Offset, m | Turn, deg | Scale | Rest, m |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    try:
        rows = compare(arguments.folder, arguments.focal_px)
    except SasgeoError as error:
        sys.exit(str(error))
    for name, pair in rows:
        print(
            f"| {name} | {pair.overlap:.2f} | {pair.features} | {pair.offset_m:.2f} | {pair.turn_deg:+.2f} | "
            f"{pair.scale:.4f} | {pair.rest_m:.2f} |"
        )


if __name__ == "__main__":
    main()
