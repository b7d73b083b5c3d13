# SPDX-License-Identifier: Apache-2.0
"""Measure matchers that look at pictures: success within 10 m, latency, and bytes of what they keep of a map.

    .venv/bin/python benchmarks/image_matchers.py out/regions/zanzibar                    # a built region with imagery
    .venv/bin/python benchmarks/image_matchers.py out/regions/zanzibar --views 20 --radius 250

    .venv/bin/python benchmarks/image_matchers.py out/regions/vaduz --suite aerial        # rendered views of its task

Views of 128 m are cut from the region's own imagery at drawn places, headings and scales (3 %), made darker, flatter
and noisier, and searched within a disc of `--radius` metres that holds the place, with the heading known to 5 degrees.
View and map are one picture: the figures bound from above what a flight on another day would give. Latency is processor
time of `match`; bytes are those of the matcher's arrays after `prepare`.

With `--suite` the queries are those of a task of the region, drawn before, and right is within 25 m: first of all, then
by kind and strength of the stress. Intervals are Wilson's over queries; sites are fewer, and are printed too.
"""

import argparse
import datetime as dt
import math
import os
import time
from dataclasses import fields, is_dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

import sasgeo_bench as sgb
from sasgeo_bench.scoring.intervals import wilson
from sasgeo_bench.tasks.frames import encode_webp

MATCHERS = ("ncc_gradient", "ncc_gradient_masked", "hog_colour", "orb_vlad", "orb_homography", "orb_homography_masked")
SIDE_M, PICTURE_PX, HEIGHT_M, GSD_M = 128.0, 512, 100.0, 0.3
NEAR_M, NEAR_TASK_M = 10.0, 25.0

Asked = list[tuple[sgb.Query, sgb.Pose, str, str]]  # with what the truth says: kind with strength, and site


def main() -> None:
    """Print what each matcher finds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("region", type=Path)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--radius", type=float, default=250.0)
    parser.add_argument("--suite", default="")
    parser.add_argument("--matchers", nargs="+", default=MATCHERS)
    said = parser.parse_args()
    cv2.setNumThreads(1)
    region = sgb.read_region(said.region)
    if region.imagery is None:
        raise SystemExit(f"{said.region} has no imagery: sasgeo-bench render-imagery makes some")
    print(f"{said.region.name}: {region.imagery.record.to_text()}", flush=True)
    near_m = NEAR_TASK_M if said.suite else NEAR_M
    asked = of_task(said.region, said.suite) if said.suite else of_imagery(region, said.radius, said.views)
    for name in said.matchers:
        measure(name, region, asked, near_m=near_m)


def of_imagery(region: sgb.Region, radius_m: float, count: int) -> Asked:
    """Return views cut from the imagery itself."""
    found = [drawn(region, radius_m, np.random.default_rng((22, number))) for number in range(count)]
    return [(query, pose, "", str(number)) for number, (query, pose) in enumerate(found)]


def of_task(region: Path, suite: str) -> Asked:
    """Return the localization queries of a task that have a right answer."""
    root = region.resolve().parents[1]
    truths = {item.query_id: item for item in sgb.read_truths(root / "truth" / suite / region.name)}
    queries = sgb.read_queries(root / "tasks" / suite / region.name)
    known = [(query, truths[query.query_id]) for query in queries if query.track == "localization"]
    return [
        (query, truth.pose, f"{truth.kind} {truth.strength:g}", truth.pair_id)
        for query, truth in known
        if truth.is_present and truth.pose is not None
    ]


def measure(name: str, region: sgb.Region, asked: Asked, *, near_m: float) -> None:
    """Print what a matcher finds, what it costs, and for a task its successes by kind."""
    matcher = sgb.load_matcher(name)
    start = time.process_time()
    matcher.prepare(region, None)
    ready_s = time.process_time() - start
    seconds, errors_m = [], []
    for query, truth, *_ in asked:
        start = time.process_time()
        poses = matcher.match(query, top_k=5).poses
        seconds.append(time.process_time() - start)
        errors_m.append(away_m(poses[0], truth) if poses else math.inf)
    sites, held_mb = len({item[3] for item in asked}), held_bytes(vars(matcher)) / 1e6
    print(
        f"{name}: {shown(errors_m, near_m)} within {near_m:g} m, {sites} sites (median error "
        f"{np.median(errors_m):.1f} m), {np.median(seconds):.2f} CPU s a view, map {held_mb:.1f} MB in {ready_s:.1f} s",
        flush=True,
    )
    kinds = sorted({item[2] for item in asked})
    for kind in kinds if len(kinds) > 1 else ():
        own = [error for error, item in zip(errors_m, asked, strict=True) if item[2] == kind]
        print(f"    {kind}: {shown(own, near_m)}", flush=True)


def shown(errors_m: list[float], near_m: float) -> str:
    """Return successes of trials with their interval."""
    right = sum(error <= near_m for error in errors_m)
    found = wilson(right, len(errors_m))
    return f"{right} of {len(errors_m)} [{found.lo:.2f}, {found.hi:.2f}]"


def drawn(region: sgb.Region, radius_m: float, rng: np.random.Generator) -> tuple[sgb.Query, sgb.Pose]:
    """Draw a place whose view the imagery shows wholly; return the question and its answer."""
    west_m, south_m, east_m, north_m = region.imagery.record.bounds_m
    reach_m = SIDE_M
    for _ in range(1000):
        pose = sgb.Pose(
            easting_m=rng.uniform(west_m + reach_m, east_m - reach_m),
            northing_m=rng.uniform(south_m + reach_m, north_m - reach_m),
            yaw_deg=rng.uniform(0, 360),
            scale=float(np.clip(rng.normal(1, 0.03), 0.94, 1.06)),
        )
        x, y = pose.easting_m, pose.northing_m
        window = region.imagery.read((x - reach_m, y - reach_m, x + reach_m, y + reach_m), gsd_m=GSD_M)
        if window.is_known.all():
            return asked_of(window, pose, radius_m, rng), pose
    raise SystemExit("no view of 128 m lies wholly on the imagery: take a larger region")


def asked_of(window: sgb.ImageryWindow, pose: sgb.Pose, radius_m: float, rng: np.random.Generator) -> sgb.Query:
    """Return the question about a view of a window."""
    wide_deg = 2 * math.degrees(math.atan(0.55 * SIDE_M / HEIGHT_M))
    lens = sgb.Intrinsics.from_field_of_view(horizontal_deg=wide_deg, width_px=PICTURE_PX, height_px=PICTURE_PX)
    camera = sgb.Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=HEIGHT_M, yaw_deg=0.0)
    middles = np.arange(PICTURE_PX) + 0.5
    pixels = np.column_stack([axis.ravel() for axis in np.meshgrid(middles, middles)])
    places_m = pose.to_map(camera.unproject(pixels, sgb.Plane())[:, :2])
    at = (window.grid.to_uv(places_m) - 0.5).astype(np.float32).reshape(PICTURE_PX, PICTURE_PX, 2)
    seen = cv2.remap(window.rgb, at, None, cv2.INTER_LINEAR).astype(np.float64)
    rgb = np.clip(0.8 * seen + 15 + rng.normal(0, 6, seen.shape), 0, 255).astype(np.uint8)
    turn, away = rng.uniform(0, 2 * math.pi), radius_m * math.sqrt(rng.random())
    prior = sgb.Prior(
        center_m=(pose.easting_m + away * math.cos(turn), pose.northing_m + away * math.sin(turn)),
        radius_m=radius_m,
        yaw_deg=pose.yaw_deg + float(np.clip(rng.normal(0, 5), -12, 12)),
        yaw_sigma_deg=5.0,
        scale_sigma=0.03,
    )
    cells = np.full((1, int(SIDE_M), int(SIDE_M)), sgb.UNKNOWN, dtype=np.uint8)
    return sgb.Query(
        query_id="view",
        track="localization",
        suite="cut",
        suite_version=1,
        part="test",
        region="",
        evidence=sgb.Evidence(classes=("building",), cells=cells, cell_size_m=1.0),
        observed_on=dt.date(2025, 1, 1),
        season="",
        prior=prior,
        prior_group="r250-known-s3",
        frames=(sgb.Frame(picture=encode_webp(rgb), camera=camera),),
    )


def away_m(pose: sgb.Pose, truth: sgb.Pose) -> float:
    """Return how far a pose is from the truth."""
    return math.hypot(pose.easting_m - truth.easting_m, pose.northing_m - truth.northing_m)


def held_bytes(held: object) -> int:
    """Return the bytes of all arrays that an object holds."""
    if isinstance(held, np.ndarray):
        return held.nbytes
    if isinstance(held, dict):
        return sum(held_bytes(item) for item in held.values())
    if is_dataclass(held):
        return sum(held_bytes(getattr(held, item.name)) for item in fields(held))
    return 0


if __name__ == "__main__":
    main()
