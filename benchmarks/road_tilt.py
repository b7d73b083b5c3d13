# SPDX-License-Identifier: Apache-2.0
"""What is left of a wrong tilt after it was refined by the borders of roads.

Made-up scenes of straight roads, 6 to 10 m wide, are drawn into masks of the true camera (120 m high, 70 degrees wide,
768 pixels), as a segmenter would find them: outlines waver by about a pixel, and each side of a road is off its bearing
by 0.2 degrees (1 sigma, --skew-deg). The believed camera is turned by 2, 5 or 10 degrees in a random direction of roll
and pitch. Printed are medians and 90th percentiles of the angle that is left, and of how far the picture's middle is
off on the ground; "none" is the share of scenes where no pair of borders was found and nothing changes.

    python benchmarks/road_tilt.py [--scenes 60] [--skew-deg 0.2]
"""

import argparse
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.tilt import join_parallel, refine_tilt, road_borders

HEIGHT_M, SIDE_PX, WIDE_DEG = 120.0, 768, 70.0
HALF_LENGTH_M, WIDTHS_M = 90.0, (6.0, 10.0)  # so that no end lies behind the camera
WAVER_PX = 1.0
ERRORS_DEG = (2.0, 5.0, 10.0)
TILTS_DEG = (0.0, 30.0)
MIDDLE = np.array([[SIDE_PX / 2, SIDE_PX / 2]])
FINE = 4  # bits of a pixel in which OpenCV draws


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Roads by bearing and offset from the middle of the view."""

    name: str
    roads: tuple[tuple[float, float], ...]
    is_grid: bool = False


SCENES = (
    Scene(name="one road", roads=((10.0, 0.0),)),
    Scene(name="two that cross", roads=((10.0, 15.0), (85.0, -10.0))),
    Scene(name="four, no two parallel", roads=((10.0, 35.0), (35.0, -25.0), (80.0, 30.0), (120.0, -30.0))),
    Scene(name="streets of a grid", roads=((20.0, -35.0), (20.0, 35.0), (110.0, -35.0), (110.0, 35.0)), is_grid=True),
)


def mask_of(scene: Scene, camera: Camera, skew_deg: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The roads of a scene in a picture, as a segmenter would find them."""
    mask = np.zeros((SIDE_PX, SIDE_PX), dtype=np.uint8)
    middle = camera.unproject(MIDDLE, Plane())[0, :2]
    for bearing_deg, offset_m in scene.roads:
        angles = np.radians(bearing_deg + skew_deg * rng.standard_normal(2))
        width_m = rng.uniform(*WIDTHS_M)
        ends = []
        for angle, side_m in zip(angles, (-width_m / 2, width_m / 2), strict=True):
            along, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
            foot = middle + (offset_m + side_m) * across
            ends.append([foot - HALF_LENGTH_M * along, foot + HALF_LENGTH_M * along])
        ring = np.array([ends[0][0], ends[0][1], ends[1][1], ends[1][0]])
        pixels = camera.project(np.column_stack([ring, np.zeros(4)])) - 0.5
        cv2.fillPoly(mask, [np.rint(pixels * 2**FINE).astype(np.int32)], 1, shift=FINE)
    inside_px, outside_px = (cv2.distanceTransform(part, cv2.DIST_L2, 5) for part in (mask, 1 - mask))
    noise = cv2.GaussianBlur(rng.standard_normal(mask.shape), (0, 0), 3.0)
    return np.asarray(inside_px - outside_px + noise / noise.std() * WAVER_PX > 0)


def residual(true: Camera, found: Camera) -> tuple[float, float]:
    """Angle between two cameras, degrees, and distance between what their middles show, metres."""
    cosine = (np.trace(found.matrix @ true.matrix.T) - 1) / 2
    here, there = (camera.unproject(MIDDLE, Plane())[0, :2] for camera in (true, found))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(np.linalg.norm(here - there))


def trial(
    scene: Scene, tilt_deg: float, error_deg: float, seed: int, skew_deg: float = 0.2
) -> tuple[float, float, int]:
    """What is left of one error: degrees, metres, and the number of roads found."""
    rng = np.random.default_rng([seed, round(tilt_deg), round(error_deg), len(scene.roads), scene.is_grid])
    lens = Intrinsics.from_field_of_view(horizontal_deg=WIDE_DEG, width_px=SIDE_PX, height_px=SIDE_PX)
    yaw_deg = rng.uniform(0, 360)
    true = Camera.pointed(
        intrinsics=lens, east_m=0.0, north_m=0.0, height_m=HEIGHT_M, yaw_deg=yaw_deg, tilt_deg=tilt_deg
    )
    direction = rng.uniform(0, 2 * np.pi)
    wrong = Attitude(pitch_deg=error_deg * np.cos(direction), roll_deg=error_deg * np.sin(direction))
    believed = true.turned(wrong)
    roads = road_borders(mask_of(scene, true, skew_deg, rng))
    groups = join_parallel(believed, roads, within_deg=8.0) if scene.is_grid else roads
    fit = refine_tilt(believed, groups, attitude_sigma_deg=error_deg / np.sqrt(2))
    return (*residual(true, fit.camera), len(roads))


def main() -> None:
    """Print a row for each scene, tilt and error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=60, help="scenes for each row")
    parser.add_argument(
        "--skew-deg", type=float, default=0.2, help="standard deviation of a road's side off its bearing"
    )
    arguments = parser.parse_args()
    seeds = range(arguments.scenes)
    print("| Roads | Tilt, deg | Error, deg | Left, deg: median | p90 | Middle off, m: median | p90 | None |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for scene in SCENES:
        for tilt_deg in TILTS_DEG:
            for error_deg in ERRORS_DEG:
                rows = np.array([trial(scene, tilt_deg, error_deg, seed, arguments.skew_deg) for seed in seeds])
                left, off_m = (np.percentile(rows[:, column], (50, 90)) for column in (0, 1))
                print(
                    f"| {scene.name} | {tilt_deg:g} | {error_deg:g} | {left[0]:.2f} | {left[1]:.2f} | "
                    f"{off_m[0]:.1f} | {off_m[1]:.1f} | {np.mean(rows[:, 2] == 0):.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
