# SPDX-License-Identifier: Apache-2.0
"""Measure rendering: views and crops a second of one core, and the peak memory of the process.

    .venv/bin/python benchmarks/rendering.py --out out
    .venv/bin/python benchmarks/rendering.py --out out --region vaduz --views 40    # a real place: SASGEO_EXTRACTS
    .venv/bin/python benchmarks/rendering.py --out out --crops 400

Builds the region where it is not in `--out`. One window is painted once; then views of 768 x 768 pixels are taken at
places, headings and heights (120 to 220 m) drawn for each, with drawn conditions (haze, exposure, blur, motion, noise,
JPEG; one season and one sun, as shadows belong to the painted scene). Crops, if asked for, are those of `drawn_crops`,
with all ingredients and with none, and of `real_crops` where the region has imagery; opening windows counts. OpenCV
runs on one thread. Seconds are of the processor, so that other load counts little; memory is the peak resident size
with imports and region (Linux).
"""

import argparse
import os
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.crops import Crop, drawn_crops, real_crops
from sasgeo_bench.sensing.rendering.conditions import Conditions, draw_conditions
from sasgeo_bench.sensing.rendering.scene import Scene, make_scene
from sasgeo_bench.sensing.rendering.view import render
from sasgeo_bench.sensing.rendering.wild import Ingredients

SIZE_M, CELL_SIZE_M = 400.0, 0.25
TILTS_DEG = (0.0, 20.0, 45.0)
WARM_UP = 40


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--region", default="town-riverside")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--crops", type=int, default=0, help="of each kind; default: none")
    parser.add_argument("--extracts", type=Path, default=Path(os.environ.get("SASGEO_EXTRACTS", ".")))
    said = parser.parse_args()
    cv2.setNumThreads(1)
    region = _region(said.region, said.out, said.extracts)
    west, south, east, north = region.grid.bounds_m
    middle = ((west + east) / 2, (south + north) / 2)
    window = Grid.around(*middle, size_m=(SIZE_M, SIZE_M), cell_size_m=CELL_SIZE_M, epsg=region.grid.epsg)
    start = time.process_time()
    scene = make_scene(region.features, region.classes, region.coverage, place=said.region, window=window)
    scene.painting("summer")
    print(f"{said.region}: {SIZE_M:g} m painted at {CELL_SIZE_M:g} m in {time.process_time() - start:.1f} CPU s")
    start = time.process_time()
    scene.light("summer", Conditions().sun)
    print(f"light and shadows of one sun: {time.process_time() - start:.2f} CPU s")
    for tilt_deg in TILTS_DEG:
        seconds = [_seconds(scene, middle, tilt_deg, number) for number in range(said.views)]
        median, slow = np.median(seconds), np.quantile(seconds, 0.9)
        print(f"tilt {tilt_deg:2g} deg: {1 / median:5.1f} views a CPU second (median; slowest tenth {1 / slow:.1f})")
    for title, crops in _kinds_of_crops(region) if said.crops else ():
        _measure_crops(title, crops, said.crops)
    print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6:.0f} MB")


def _kinds_of_crops(region: Region) -> Iterator[tuple[str, Iterator[Crop]]]:
    """Yield crops by title, those of a window that is painted and of imagery where there is some."""
    yield "drawn crops", drawn_crops([region], seed=1)
    yield "without ingredients", drawn_crops([region], seed=1, ingredients=Ingredients.none())
    if region.imagery is not None:
        yield "real crops", real_crops([region], seed=1)


def _measure_crops(title: str, crops: Iterator[Crop], count: int) -> None:
    """Take crops of 256 x 256 pixels after as many as open the first windows; print how many a second."""
    next(islice(crops, WARM_UP, WARM_UP), None)
    start = time.process_time()
    sides = {crop.rgb.shape[0] for crop in islice(crops, count)}
    print(f"{title}, {max(sides)} px: {count / (time.process_time() - start):5.1f} a CPU second")


def _region(name: str, out: Path, extracts: Path | None) -> Region:
    folder = out / "regions" / name
    if not folder.is_dir():
        spec = read_region_file(find_region_file(name))
        plan = plan_build(spec, out=out, date=None, extract_folders=[extracts] if extracts else [])
        build_region(plan)
    region = read_region(folder)
    len(region.features)
    return region


def _seconds(scene: Scene, middle: tuple[float, float], tilt_deg: float, number: int) -> float:
    """Take one view; return the processor's seconds."""
    rng = np.random.default_rng((20, number))
    lens = Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=768, height_px=768)
    camera = Camera.pointed(
        intrinsics=lens,
        east_m=middle[0] + rng.uniform(-120, 120),
        north_m=middle[1] + rng.uniform(-120, 120),
        height_m=rng.uniform(120, 220),
        yaw_deg=rng.uniform(0, 360),
        tilt_deg=tilt_deg,
    )
    conditions = replace(draw_conditions(rng, season="summer"), sun=Conditions().sun)
    start = time.process_time()
    render(scene, camera, conditions, rng)
    return time.process_time() - start


if __name__ == "__main__":
    main()
