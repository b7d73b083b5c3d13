# SPDX-License-Identifier: Apache-2.0
"""Four pictures of an embedded town for the page on rendering: .venv/bin/python docs/figures/rendered.py --out out."""

import argparse
from pathlib import Path

import cv2
import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.rendering.conditions import Conditions, Sun
from sasgeo_bench.sensing.rendering.palettes import Family
from sasgeo_bench.sensing.rendering.scene import make_scene
from sasgeo_bench.sensing.rendering.view import render

QUALITY = 62
SIDE_PX = 400
# Family, tilt and conditions of each picture.
VIEWS: tuple[tuple[Family, float, Conditions], ...] = (
    ("train", 0.0, Conditions()),
    ("shifted", 0.0, Conditions(cloud=0.5)),
    ("train", 45.0, Conditions(season="snow", sun=Sun(elevation_deg=18.0, azimuth_deg=190.0))),
    ("train", 45.0, Conditions(season="autumn", sun=Sun(elevation_deg=12.0, azimuth_deg=230.0), visibility_m=4000.0)),
)


def main() -> None:
    """Write docs/figures/rendered.webp; the town is in OUT, built before."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    region = read_region(parser.parse_args().out / "regions" / "town-riverside")
    west, south, east, north = region.grid.bounds_m
    middle = (west + 0.35 * (east - west), south + 0.52 * (north - south))
    window = Grid.around(*middle, size_m=(400.0, 400.0), cell_size_m=0.25, epsg=region.grid.epsg)
    lens = Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=SIDE_PX, height_px=SIDE_PX)
    pictures = []
    for family, tilt_deg, conditions in VIEWS:
        scene = make_scene(
            region.features, region.classes, region.coverage, place="town-riverside", window=window, family=family
        )
        camera = Camera.pointed(
            intrinsics=lens,
            east_m=middle[0],
            north_m=middle[1] - (60.0 if tilt_deg else 0.0),
            height_m=110.0,
            yaw_deg=15.0,
            tilt_deg=tilt_deg,
        )
        pictures.append(render(scene, camera, conditions, np.random.default_rng(1)))
    sheet = np.hstack(pictures)
    target = Path(__file__).with_name("rendered.webp")
    cv2.imwrite(str(target), sheet[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
