# SPDX-License-Identifier: Apache-2.0
"""Fly over the pictures of regions, and say how far visual odometry is off, beside other ways to the same motion.

    .venv/bin/python benchmarks/visual_odometry.py out chateaugiron-ortho koeln-ortho zanzibar

A flight is 30 photos as `own_photos.py` takes them (their shorter side shows `--side` metres, or as much as the mosaic
has), with an overlap of 60, 70 and 80 %, straight ahead until the mosaic ends, where it turns. Cameras sway by
2 degrees of pitch and roll, 3 of heading and 2 % of height. Believed are angles that are off by 1 degree in each photo,
and heights that are off by `--height` over the flight and by 1 % in each photo (standard deviations). Each photo has
its own brightness (10 %), noise (4 levels) and JPEG. A mosaic is flat: nothing stands up in these photos.

Errors are those of single steps, and of segments of at least 100 m as each way adds them up; medians.
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from benchmarks.own_photos import SHAPE_PX, lens, photo_of
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.flights.drift_profile import load_profile
from sasgeo_bench.flights.odometry import draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import bearing_deg, reckon, rotation, wrap_deg
from sasgeo_bench.sensing.camera import Attitude, Camera
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.image import AerialImage
from sasgeo_bench.sensing.visual_odometry import Matches, match_images, relative_motion

Floats = NDArray[np.float64]
FRAMES: Final = 30
OVERLAPS: Final = (0.6, 0.7, 0.8)
SWAY_DEG, SWAY_YAW_DEG, SWAY = 2.0, 3.0, 0.02
OFF_DEG, OFF = 1.0, 0.01
GAIN, NOISE, QUALITY = 0.1, 4.0, 92
TURNS_DEG: Final = (0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180)
SEGMENT_M: Final = 100.0
LEAST: Final = 20  # matches that agree, of the other ways
WITHIN: Final = 7.81  # squared distance that holds 95 % of three numbers
Moved = tuple[float, float, float]
Moves = dict[str, list[Moved | None]]


@dataclass(frozen=True, kw_only=True)
class Shot:
    """Where a camera was, and the photo with what is believed of it."""

    camera: Camera
    image: AerialImage


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera, and what it sees of the mosaic."""

    camera: Camera
    rgb: NDArray[np.uint8]


def fly(region: sgb.Region, side_m: float, overlap: float, tilt_deg: float, rng: np.random.Generator) -> list[View]:
    """Return the views of a flight that sees the mosaic alone."""
    height_m = lens().focal_px[1] * side_m / SHAPE_PX[1]
    west, south, east, north = region.imagery.record.bounds_m

    def view(east_m: float, north_m: float, yaw_deg: float) -> View | None:
        stood = Camera.pointed(
            intrinsics=lens(),
            east_m=east_m,
            north_m=north_m,
            height_m=height_m * (1 + SWAY * rng.standard_normal()),
            yaw_deg=yaw_deg + SWAY_YAW_DEG * rng.standard_normal(),
            tilt_deg=tilt_deg,
        )
        pitch, roll = SWAY_DEG * rng.standard_normal(2)
        stood = stood.turned(Attitude(pitch_deg=pitch, roll_deg=roll))
        rgb = photo_of(region, stood)
        return None if rgb is None else View(camera=stood, rgb=rgb)

    for _ in range(3000):
        yaw_deg = rng.uniform(0, 360)
        flown = [view(rng.uniform(west, east), rng.uniform(south, north), yaw_deg)]
        while flown[-1] is not None and len(flown) < FRAMES:
            last = flown[-1]
            for turn in TURNS_DEG:
                course = math.radians(yaw_deg + turn)
                step_m = (1 - overlap) * side_m * np.array([math.sin(course), math.cos(course)])
                found = view(*(last.camera.position_m[:2] + step_m).tolist(), yaw_deg + turn)
                if found is not None:
                    break
            yaw_deg += turn + rng.standard_normal()
            flown.append(found)
        if flown[-1] is not None:
            return [one for one in flown if one is not None]
    raise SystemExit(f"no flight of {FRAMES} photos fits: say a smaller --side")


def shots(flown: Sequence[View], height_off: float, rng: np.random.Generator) -> Iterator[Shot]:
    """Yield photos with what is believed of their cameras."""
    bias = math.exp(height_off * rng.standard_normal())
    for view in flown:
        camera, rgb = view.camera, view.rgb
        seen = rgb * (1 + GAIN * rng.standard_normal()) + NOISE * rng.standard_normal(rgb.shape)
        _, encoded = cv2.imencode(".jpg", seen.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        pitch, roll = OFF_DEG * rng.standard_normal(2)
        believed = camera.turned(Attitude(pitch_deg=pitch, roll_deg=roll)).above_origin()
        said_m = camera.height_m * bias * math.exp(OFF * rng.standard_normal())
        image = AerialImage(
            rgb=cv2.imdecode(encoded, cv2.IMREAD_COLOR),
            camera=believed.moved(up_m=said_m - believed.height_m),
            height_sigma_m=math.hypot(height_off, OFF) * said_m,
            attitude_sigma_deg=OFF_DEG,
        )
        yield Shot(camera=camera, image=image)


def of_rotation(turn: Floats, centre: Floats, camera: Camera) -> Moved:
    """Return the motion of a camera whose axes turn, seen from the first, to a centre, heights."""
    level = camera.above_origin().matrix
    right, up, _ = level.T @ centre * camera.height_m
    down = (turn @ level)[1]
    return float(right), float(up), float(bearing_deg(-down[0], -down[1]))


def by_essential(before: AerialImage, matches: Matches) -> Moved | None:
    """Return the motion of the essential matrix; its scale is the median height above what it triangulates."""
    near = 2 * matches.pixel
    found, agrees = cv2.findEssentialMat(matches.before, matches.after, np.eye(3), cv2.RANSAC, 0.9999, near)
    if found is None or found.shape != (3, 3):
        return None
    _, turn, way, agrees, points = cv2.recoverPose(
        found, matches.before, matches.after, np.eye(3), distanceThresh=1e3, mask=agrees
    )
    is_in = agrees.ravel() > 0
    if is_in.sum() < LEAST:
        return None
    above = -np.median((before.camera.matrix.T @ (points[:3] / points[3])[:, is_in])[2])
    return of_rotation(turn, -turn.T @ way.ravel() / above, before.camera) if above > 0 else None


def by_homography(before: AerialImage, matches: Matches) -> Moved | None:
    """Return the motion of the homography of the ground: of its decompositions that whose ground is most level."""
    near = 2 * matches.pixel
    found, agrees = cv2.findHomography(
        matches.before, matches.after, cv2.RANSAC, near, maxIters=5000, confidence=0.9999
    )
    if found is None or agrees.sum() < LEAST:
        return None
    _, turns, ways, normals = cv2.decomposeHomographyMat(found, np.eye(3))
    best = int(np.argmax([normal.ravel() @ before.camera.matrix @ [0.0, 0.0, -1.0] for normal in normals]))
    return of_rotation(turns[best], -turns[best].T @ ways[best].ravel(), before.camera)


def by_rigid(before: AerialImage, after: AerialImage, matches: Matches) -> Moved | None:
    """Return the rigid motion of matches laid on the ground by lens, tilt and height, without a fit of these."""
    there, here = (
        Plane().meet(camera.position_m, np.column_stack([slopes, np.ones(len(slopes))]) @ camera.matrix)[:, :2]
        for camera, slopes in ((before.camera, matches.before), (after.camera, matches.after))
    )
    is_known = np.isfinite(np.column_stack([there, here])).all(axis=1)
    near_m = before.camera.height_m * (5 * matches.pixel + math.radians(OFF_DEG) / 2)
    found, agrees = cv2.estimateAffinePartial2D(
        here[is_known], there[is_known], ransacReprojThreshold=near_m, maxIters=5000, confidence=0.9999
    )
    if found is None or agrees.sum() < LEAST:
        return None
    return float(found[0, 2]), float(found[1, 2]), math.degrees(math.atan2(found[0, 1], found[0, 0]))


@dataclass(kw_only=True)
class Errors:
    """Errors of one way to odometry: of steps (fraction, degrees), of segments, and how many steps it lost."""

    steps: list[tuple[float, float]] = field(default_factory=list)
    segments: list[tuple[float, float]] = field(default_factory=list)
    lost: int = 0

    def add(self, flown: Sequence[Camera], moves: Sequence[Moved | None]) -> None:
        """Compare the steps of a flight with where the cameras were."""
        places = np.array([camera.position_m[:2] for camera in flown])
        yaws = [camera.yaw_deg for camera in flown]

        def off(first: int, last: int) -> tuple[float, float]:
            taken = [move for move in moves[first:last] if move is not None]
            led_m = reckon(places[first], yaws[first], taken)[-1]
            way_m = np.linalg.norm(np.diff(places[first : last + 1], axis=0), axis=1).sum()
            turned = yaws[first] + sum(move[2] for move in taken)
            return float(math.dist(led_m, places[last]) / way_m), abs(float(wrap_deg(turned - yaws[last])))

        self.lost += sum(move is None for move in moves)
        self.steps += [off(at, at + 1) for at, move in enumerate(moves) if move is not None]
        ways_m = np.concatenate([[0.0], np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum()])
        for first in range(len(moves)):
            last = int(np.searchsorted(ways_m, ways_m[first] + SEGMENT_M))
            if last < len(ways_m) and None not in moves[first:last]:
                self.segments.append(off(first, last))

    def row(self) -> str:
        """Return the cells of a table."""
        count = self.lost + len(self.steps)
        step, turn = np.median(self.steps, axis=0) if self.steps else (math.nan, math.nan)
        part, heading = np.median(self.segments, axis=0) if self.segments else (math.nan, math.nan)
        cells = (f"{100 * self.lost / count:.1f}", f"{100 * step:.1f}", f"{turn:.2f}", f"{100 * part:.1f}")
        return " | ".join([str(count), *cells, f"{heading:.2f}"])


def drawn(flown: Sequence[Camera], rng: np.random.Generator) -> list[Moved | None]:
    """Return what the profile vio-mono draws of a flight."""
    way = Trajectory.of_angles(
        time_s=np.arange(len(flown), dtype=np.float64),
        position_m=[camera.position_m for camera in flown],
        yaw_deg=[camera.yaw_deg for camera in flown],
    )
    steps = draw_odometry(way, load_profile("vio-mono"), rng=rng)
    return list(zip(steps.right_m.tolist(), steps.up_m.tolist(), steps.yaw_deg.tolist(), strict=True))


WAYS: Final[dict[str, Callable[[AerialImage, AerialImage, Matches], Moved | None]]] = {
    "essential matrix": lambda before, _, matches: by_essential(before, matches),
    "homography, decomposed": lambda before, _, matches: by_homography(before, matches),
    "rigid on the ground": by_rigid,
}
OURS: Final = "rigid, then fitted (`relative_motion`)"


def follow(flown: Sequence[View], height_off: float, rng: np.random.Generator) -> tuple[Moves, list[bool]]:
    """Return the steps of a flight by each way, and which of ours lie within the ellipsoid that they state."""
    moves: Moves = {way: [] for way in (*WAYS, OURS)}
    covered: list[bool] = []
    for before, after in pairwise(shots(flown, height_off, rng)):
        matches = match_images(before.image, after.image)
        for way, find in WAYS.items():
            moves[way].append(None if matches is None else find(before.image, after.image, matches))
        motion = relative_motion(before.image, after.image)
        if motion is None:
            moves[OURS].append(None)
            continue
        moves[OURS].append((motion.right_m, motion.up_m, motion.turn_deg))
        apart_m = after.camera.position_m[:2] - before.camera.position_m[:2]
        turn_deg = after.camera.yaw_deg - before.camera.yaw_deg
        off = np.array([motion.right_m, motion.up_m, wrap_deg(motion.turn_deg - turn_deg)])
        off[:2] -= apart_m @ rotation(before.camera.yaw_deg)
        covered.append(bool(off @ np.linalg.solve(np.reshape(motion.covariance, (3, 3)), off) < WITHIN))
    moves["drawn, `vio-mono`"] = drawn([view.camera for view in flown], rng)
    return moves, covered


def main() -> None:
    """Fly, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("regions", nargs="+")
    parser.add_argument("--side", type=float, default=120.0, help="metres along the shorter side of a photo")
    parser.add_argument("--tilt", type=float, nargs="+", default=[0.0, 20.0], help="degrees from straight down")
    parser.add_argument("--height", type=float, default=0.05, help="by which heights of a flight are off, a fraction")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print("| Region | Tilt, deg | Odometry | Steps | Lost, % | Step, % | Turn, deg | 100 m, % | Heading, deg |")
    print("|---|---:|---|---:|---:|---:|---:|---:|---:|")
    covered: list[bool] = []
    for name, tilt_deg in product(given.regions, given.tilt):
        region = sgb.read_region(given.out / "regions" / name)
        errors: defaultdict[str, Errors] = defaultdict(Errors)
        for overlap in OVERLAPS:
            rng = np.random.default_rng([given.seed, int(tilt_deg), int(100 * overlap)])
            flown = fly(region, given.side, overlap, tilt_deg, rng)
            moves, within = follow(flown, given.height, rng)
            covered += within
            for way, found in moves.items():
                errors[way].add([view.camera for view in flown], found)
        for way, found_errors in errors.items():
            print(f"| {name} | {tilt_deg:g} | {way} | {found_errors.row()} |", flush=True)
    print(f"\nWithin its 95 % ellipsoid: {100 * np.mean(covered):.0f} % of {len(covered)} steps of {OURS}")


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
