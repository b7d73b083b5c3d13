# SPDX-License-Identifier: Apache-2.0
"""Make folders of drone photos out of the pictures of regions, and say how often `locate` is right about them.

    .venv/bin/python benchmarks/own_photos.py out chateaugiron-ortho koeln-ortho --into photos --count 30
    .venv/bin/python benchmarks/own_photos.py out chateaugiron-ortho --into tilted --tilt 20 --ground any

Needs exiftool, and regions that are built with imagery. A photo of 4 : 3 is what a pinhole camera sees of the mosaic
from a height at which its shorter side shows `--side` metres (drawn between 0.75 and 1.25 times that), at any place
that the mosaic shows whole and any heading. Its EXIF and XMP, written by exiftool, hold the true position, and height
and heading that are off by 5 % and 5 degrees (standard deviations). `--elsewhere N` takes N photos of each region and
writes the positions of the next one into them: they are of no place that is searched. Found is within 25 m and 5 deg.
The photos are not for publication beyond the licences of the mosaics; the folder is yours to delete.
"""

import argparse
import csv
import math
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from PIL import Image

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.geometry.projection import to_grid, to_lonlat
from sasgeo_bench.observing.fixes import Fix, LocateRequest
from sasgeo_bench.observing.locate import locate
from sasgeo_bench.scoring.intervals import wilson_share
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane

FILM_MM: Final = 24.0
SHAPE_PX: Final = (1024, 768)  # width, height
HEIGHT_OFF, YAW_OFF_DEG = 0.05, 5.0  # standard deviations of what the files say
FOUND_M, FOUND_DEG = 25.0, 5.0
LEAST_BUILT: Final = 0.04  # share of the ground under roofs, of built and mixed ground
BINS: Final = (0.0, 0.05, 0.2, 0.5, 0.9, 1.0)
TAGS: Final = (
    *("SourceFile", "GPSLatitude", "GPSLatitudeRef", "GPSLongitude", "GPSLongitudeRef", "FocalLengthIn35mmFormat"),
    *("DateTimeOriginal", "XMP-drone-dji:RelativeAltitude", "XMP-drone-dji:GimbalPitchDegree"),
    *("XMP-drone-dji:GimbalYawDegree", "XMP-drone-dji:GimbalRollDegree", "Make", "Model"),
)


@dataclass(frozen=True, kw_only=True)
class Taken:
    """A photo: its file, and where its camera truly stood, on the map of the region (metres, degrees of true north)."""

    file: str
    east_m: float
    north_m: float
    heading_deg: float
    is_elsewhere: bool


def lens() -> Intrinsics:
    """Return the pinhole that EXIF's focal length on film stands for."""
    width, height = SHAPE_PX
    focal_px = FILM_MM * math.hypot(width, height) / math.hypot(36.0, 24.0)
    return Intrinsics(
        width_px=width, height_px=height, focal_px=(focal_px, focal_px), centre_px=(width / 2, height / 2)
    )


def photo_of(region: sgb.Region, camera: Camera) -> np.ndarray | None:
    """Return what a camera over the map sees of the mosaic, (H, W, 3); None where that is not all of a picture."""
    width, height = camera.intrinsics.width_px, camera.intrinsics.height_px
    cols, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ground = camera.unproject(np.stack([cols, rows], axis=-1).reshape(-1, 2), Plane())[:, :2]
    if not np.isfinite(ground).all():
        return None
    seen = ground + region.imagery.off_m  # of a thing on the map, where the mosaic shows it
    west, south, east, north = region.imagery.record.bounds_m
    low, high = seen.min(axis=0), seen.max(axis=0)
    if low[0] < west or low[1] < south or high[0] > east or high[1] > north:
        return None
    window = region.imagery.read((*low.tolist(), *high.tolist()))
    at = (window.grid.to_uv(seen) - 0.5).reshape(*cols.shape, 2).astype(np.float32)
    known = cv2.remap(window.is_known.astype(np.uint8), at[..., 0], at[..., 1], cv2.INTER_NEAREST)
    if known.mean() < 0.999:
        return None
    return cv2.remap(window.rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR)


def built_share(region: sgb.Region, east_m: float, north_m: float, side_m: float) -> float:
    """Return the share of mapped ground under roofs around a place; 0 where a part is not mapped."""
    layer = region.layers[region.classes.index("building")]
    half = side_m / 2
    ends = region.grid.to_cells(np.array([(east_m - half, north_m + half), (east_m + half, north_m - half)]))
    (top, left), (bottom, right) = np.clip(ends, 0, [region.grid.rows, region.grid.cols]).tolist()
    part = layer[top:bottom, left:right]
    return 0.0 if part.size == 0 or (part > 1).mean() > 0.05 else float((part == 1).mean())


def take(region: sgb.Region, folder: Path, given: argparse.Namespace, other: sgb.Region | None) -> list[Taken]:
    """Take photos over a region into a folder, with their metadata; those of `other` get positions of the region."""
    rng = np.random.default_rng([given.seed, int(other is not None)])
    over = region if other is None else other
    wanted = given.count if other is None else given.elsewhere
    west, south, east, north = over.imagery.record.bounds_m
    found: list[Taken] = []
    rows: list[Sequence[object]] = []
    for _ in range(400 * wanted):
        if len(found) == wanted:
            break
        side_m = given.side * rng.uniform(0.75, 1.25)
        height_m = lens().focal_px[1] * side_m / SHAPE_PX[1]
        east_m, north_m, yaw_deg = rng.uniform(west, east), rng.uniform(south, north), rng.uniform(0, 360)
        if given.ground == "built" and built_share(over, east_m, north_m, side_m) < LEAST_BUILT:
            continue
        camera = Camera.pointed(
            intrinsics=lens(), east_m=east_m, north_m=north_m, height_m=height_m, yaw_deg=yaw_deg, tilt_deg=given.tilt
        )
        rgb = photo_of(over, camera)
        if rgb is None:
            continue
        if other is not None:  # told to be at a place of the region that is asked
            r_west, r_south, r_east, r_north = region.imagery.record.bounds_m
            east_m, north_m = rng.uniform(r_west, r_east), rng.uniform(r_south, r_north)
        lon, lat = to_lonlat(region.grid.epsg).transform(east_m, north_m)
        heading_deg = (yaw_deg - to_grid(lon, lat, region.grid.epsg)[2]) % 360
        name = f"{'elsewhere' if other is not None else 'photo'}_{len(found):03}.jpg"
        Image.fromarray(rgb).save(folder / name, quality=92)
        said_m = height_m * (1 + HEIGHT_OFF * rng.standard_normal())
        said_deg = (heading_deg + YAW_OFF_DEG * rng.standard_normal() + 180) % 360 - 180
        place = (f"{abs(lat):.8f}", "N" if lat >= 0 else "S", f"{abs(lon):.8f}", "E" if lon >= 0 else "W")
        when = f"2025:07:01 12:{len(found) // 60:02}:{len(found) % 60:02}"
        gimbal = (f"{said_m:+.2f}", f"{given.tilt - 90:+.2f}", f"{said_deg:+.2f}", "+0.00")
        rows.append((str(folder / name), *place, f"{FILM_MM:g}", when, *gimbal, "DJI", "FC3582"))
        found.append(
            Taken(file=name, east_m=east_m, north_m=north_m, heading_deg=heading_deg, is_elsewhere=other is not None)
        )
    table = folder / "tags.csv"
    with table.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([TAGS, *rows])
    subprocess.run(["exiftool", "-q", "-overwrite_original", f"-csv={table}", *(row[0] for row in rows)], check=True)  # noqa: S603, S607
    table.unlink()
    return found


def is_right(fix: Fix, taken: Taken) -> bool:
    """Return whether a fix is where the camera stood."""
    if taken.is_elsewhere or fix.x_m is None or fix.y_m is None or fix.heading_deg is None:
        return False
    off_m = math.hypot(fix.x_m - taken.east_m, fix.y_m - taken.north_m)
    return off_m <= FOUND_M and abs((fix.heading_deg - taken.heading_deg + 180) % 360 - 180) <= FOUND_DEG


def table(rows: Sequence[tuple[str, Fix, Taken]]) -> Iterator[str]:
    """Yield what is found and accepted at each place, then how often fixes are false by stated chance."""
    yield "| Region | n | Found | 95 %, % | Accepted | False of them | Of another place | Accepted of them | s each |"
    yield "|---|---:|---:|---|---:|---:|---:|---:|---:|"
    for region in dict.fromkeys(row[0] for row in rows):
        here = [(fix, taken) for name, fix, taken in rows if name == region]
        own = [(fix, taken) for fix, taken in here if not taken.is_elsewhere]
        absent = [fix for fix, taken in here if taken.is_elsewhere]
        right = [is_right(fix, taken) for fix, taken in own]
        taken_on = [is_right(fix, taken) for fix, taken in own if fix.is_accepted]
        limits = wilson_share(float(np.mean(right)), len(own))
        accepted = sum(fix.is_accepted for fix in absent)
        seconds = float(np.median([fix.seconds for fix, _ in here]))
        yield (
            f"| {region} | {len(own)} | {sum(right)} | {100 * limits.lo:.0f} to {100 * limits.hi:.0f} | "
            f"{len(taken_on)} | {len(taken_on) - sum(taken_on)} | {len(absent)} | {accepted} | "
            f"{seconds:.1f} |"
        )
    yield ""
    yield "| P(false fix) | n | Stated, % | False, % |\n|---|---:|---:|---:|"
    known = [(fix.p_false, not is_right(fix, taken)) for _, fix, taken in rows if fix.p_false is not None]
    for low, high in pairwise(BINS):
        some = [(p, false) for p, false in known if low <= p < high or (high == 1.0 and p == 1.0)]
        if some:
            stated, false = np.mean(some, axis=0)
            yield f"| {low:g} to {high:g} | {len(some)} | {100 * stated:.0f} | {100 * false:.0f} |"


def main() -> None:
    """Make the photos, locate them, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("regions", nargs="+")
    parser.add_argument("--into", type=Path, required=True, help="folder of the photos and of what is said of them")
    parser.add_argument("--count", type=int, default=30, help="photos of each region")
    parser.add_argument("--elsewhere", type=int, default=0, help="photos of the next region at positions of each")
    parser.add_argument("--side", type=float, default=192.0, help="metres along the shorter side, on average")
    parser.add_argument("--tilt", type=float, default=0.0, help="of the camera, degrees from straight down")
    parser.add_argument("--ground", choices=("built", "any"), default="built")
    parser.add_argument("--segmenter", default="osm_unet_held_out")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    regions = {name: sgb.read_region(given.out / "regions" / name) for name in given.regions}
    if given.elsewhere and len(regions) < 2:
        raise SystemExit("--elsewhere takes photos of the next region: name two at least")
    rows: list[tuple[str, Fix, Taken]] = []
    names = list(regions)
    for number, name in enumerate(names):
        folder = given.into / name / "photos"
        folder.mkdir(parents=True, exist_ok=True)
        taken = take(regions[name], folder, given, None)
        if given.elsewhere:
            taken += take(regions[name], folder, given, regions[names[(number + 1) % len(names)]])
        request = LocateRequest(
            pictures=folder,
            out=given.out,
            into=given.into / name / "located",
            region=given.out / "regions" / name,
            segmenter=given.segmenter,
        )
        fixes = {fix.file: fix for fix in locate(request).fixes}
        rows += [(name, fixes[one.file], one) for one in taken]
    print("\n".join(table(rows)))


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
