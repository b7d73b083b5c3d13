# SPDX-License-Identifier: Apache-2.0
"""Fly a video over the picture of a region, and say how often `locate` is right about its frames.

    .venv/bin/python -m benchmarks.own_video out chateaugiron-ortho --into video

Needs a region that is built with imagery. The camera looks straight down (`--tilt`: ahead by so much) at 16 : 9 and
flies legs with turns at a changing speed; its MP4, 5 frames a second, is what a pinhole sees of the mosaic. Beside it
lies an SRT as a DJI writes it, and a GPX track of the same flight by a clock of its own, which begins `--late` seconds
before the video. Heights are off by 5 % and headings by 5 degrees throughout. Printed is what `locate` finds by the
SRT, and when the video began by the GPX and the motion seen. Right is within 10 m, false is more than 25 m off.
The video is not for publication beyond the licence of the mosaic; the folder is yours to delete.
"""

import argparse
import datetime as dt
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

import sasgeo_bench as sgb
from benchmarks.own_photos import FILM_MM, photo_of
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.flights.logs import read_log
from sasgeo_bench.geometry.projection import to_grid, to_lonlat
from sasgeo_bench.observing.video_motion import STEP_S, MotionSeen, find_begin
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.video import Video

SIZE_PX: Final = (1280, 720)
RATE: Final = 5.0
HEIGHT_OFF, YAW_OFF_DEG = 1.05, 5.0
FOUND_M, FALSE_M = 10.0, 25.0
START: Final = dt.datetime(2025, 7, 1, 10, tzinfo=dt.UTC)
BLOCK: Final = """{number}
{begin} --> {end}
<font size="28">FrameCnt: {number}, DiffTime: 200ms
{clock}
[iso: 100] [focal_len: {film:.2f}] [dzoom_ratio: 1.00], [latitude: {lat:.6f}] [longitude: {lon:.6f}] \
[rel_alt: {height:.3f} abs_alt: {altitude:.3f}] [gb_yaw: {yaw:.1f} gb_pitch: {pitch:.1f} gb_roll: 0.0] </font>

"""


@dataclass(frozen=True, kw_only=True)
class Stood:
    """Where the camera truly was: seconds of the flight, metres of the map's grid, degrees of true north."""

    time_s: float
    east_m: float
    north_m: float
    yaw_deg: float
    heading_deg: float
    lonlat: tuple[float, float]


def lens() -> Intrinsics:
    """Return the pinhole of a video that is as wide as the sensor of 4 : 3 whose diagonal the focal length is for."""
    width, height = SIZE_PX
    focal_px = FILM_MM * math.hypot(width, width * 3 / 4) / math.hypot(36.0, 24.0)
    return Intrinsics(
        width_px=width, height_px=height, focal_px=(focal_px, focal_px), centre_px=(width / 2, height / 2)
    )


def flown(region: sgb.Region, seconds: float, reach_m: float, rng: np.random.Generator) -> list[Stood]:
    """Return a flight that stays on the mosaic: speeds of 4 to 14 m/s, and turns towards drawn places."""
    west, south, east, north = region.imagery.record.bounds_m
    # Over the inner half of the mosaic, which is the town that it was taken of.
    margin = np.maximum(reach_m, np.array([east - west, north - south]) / 4)
    low, high = np.array([west, south]) + margin, np.array([east, north]) - margin

    place, goal, yaw, speed = rng.uniform(low, high), rng.uniform(low, high), rng.uniform(0, 360), 8.0
    found = []
    for at in range(round(seconds * RATE)):
        if np.hypot(*(goal - place)) < 60:
            goal = rng.uniform(low, high)
        wish = math.degrees(math.atan2(*(goal - place)))
        yaw += float(np.clip((wish - yaw + 180) % 360 - 180, -25.0, 25.0)) / RATE
        speed = float(np.clip(speed + 0.2 * (9.0 - speed) / RATE + 2.0 * rng.normal() / RATE**0.5, 4.0, 14.0))
        place = np.clip(
            place + speed / RATE * np.array([math.sin(math.radians(yaw)), math.cos(math.radians(yaw))]), low, high
        )
        lon, lat = to_lonlat(region.grid.epsg).transform(*place)
        heading = (yaw - to_grid(lon, lat, region.grid.epsg)[2]) % 360
        found.append(
            Stood(
                time_s=at / RATE,
                east_m=float(place[0]),
                north_m=float(place[1]),
                yaw_deg=yaw,
                heading_deg=heading,
                lonlat=(float(lon), float(lat)),
            )
        )
    return found


def clock_text(seconds: float) -> str:
    """Return a time as subtitles have it."""
    whole, milli = divmod(round(seconds * 1000), 1000)
    return f"{whole // 3600:02}:{whole // 60 % 60:02}:{whole % 60:02},{milli:03}"


def write(region: sgb.Region, path: Path, flight: list[Stood], given: argparse.Namespace) -> list[Stood]:
    """Write video and subtitles of the flight from `--late` seconds on, a GPX of all of it; return what was filmed."""
    shown = [one for one in flight if one.time_s >= given.late]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), RATE, SIZE_PX)
    blocks, begin_s = [], shown[0].time_s
    for number, one in enumerate(shown, start=1):
        camera = Camera.pointed(
            intrinsics=lens(),
            east_m=one.east_m,
            north_m=one.north_m,
            height_m=given.height,
            yaw_deg=one.yaw_deg,
            tilt_deg=given.tilt,
        )
        rgb = photo_of(region, camera)
        writer.write(np.zeros((*SIZE_PX[::-1], 3), np.uint8) if rgb is None else rgb[..., ::-1])
        time_s = one.time_s - begin_s
        local = START + dt.timedelta(hours=2, seconds=one.time_s)
        blocks.append(
            BLOCK.format(
                number=number,
                begin=clock_text(time_s),
                end=clock_text(time_s + 1 / RATE),
                clock=local.strftime("%Y-%m-%d %H:%M:%S.%f")[:-3],
                film=FILM_MM,
                lat=one.lonlat[1],
                lon=one.lonlat[0],
                height=given.height * HEIGHT_OFF,
                altitude=given.height + 60.0,
                yaw=(one.heading_deg + YAW_OFF_DEG + 180) % 360 - 180,
                pitch=given.tilt - 90.0,
            )
        )
    writer.release()
    path.with_suffix(".SRT").write_text("".join(blocks), encoding="utf-8")
    points = [
        f'<trkpt lat="{one.lonlat[1]:.7f}" lon="{one.lonlat[0]:.7f}">'
        f"<time>{(START + dt.timedelta(seconds=one.time_s)).isoformat().replace('+00:00', 'Z')}</time></trkpt>"
        for one in flight[:: round(RATE)]
    ]
    gpx = f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'
    path.with_suffix(".gpx").write_text(gpx, encoding="utf-8")
    return shown


def main() -> None:
    """Make the video, locate it, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("region")
    parser.add_argument("--into", type=Path, required=True, help="folder of the video and of what is said of it")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--every", type=float, default=4.0, help="seconds between frames that are located")
    parser.add_argument("--height", type=float, default=180.0, help="of the camera above the ground, metres")
    parser.add_argument("--tilt", type=float, default=0.0, help="of the camera, degrees from straight down")
    parser.add_argument("--late", type=float, default=20.0, help="seconds of the GPX before the video begins")
    parser.add_argument("--segmenter", default="osm_unet_held_out")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    region = sgb.read_region(given.out / "regions" / given.region)
    given.into.mkdir(parents=True, exist_ok=True)
    path = given.into / f"{given.region}.mp4"
    reach_m = given.height * (1.0 + math.tan(math.radians(given.tilt)))
    flight = flown(region, given.seconds + given.late, reach_m, np.random.default_rng(given.seed))
    stood = write(region, path, flight, given)
    seen = MotionSeen()
    for frame in Video.open(path).frames(STEP_S):
        seen.add(frame.time_s, frame.rgb)
    begin = find_begin(seen, read_log(path.with_suffix(".gpx")), "the GPX")
    print(f"the video begins at {given.late:g} s of the GPX; by the motion seen at {begin.time_s} +-{begin.sigma_s} s")
    words = {"region": given.region, "every": given.every, "segmenter": given.segmenter, "tell": print}
    found = sgb.locate(path, out=given.out, into=given.into / "located", **words)
    right, taken = 0, [fix for fix in found.fixes if fix.status != "failed"]
    off_m = []
    for fix in taken:
        time_s = float(fix.file.rpartition("_")[2].removesuffix("s.jpg"))
        one = stood[min(len(stood) - 1, round(time_s * RATE))]
        off_m.append(math.hypot((fix.x_m or 0.0) - one.east_m, (fix.y_m or 0.0) - one.north_m))
        right += off_m[-1] <= FOUND_M
    accepted = sum(fix.is_accepted for fix in taken)
    false = sum(fix.is_accepted and away > FALSE_M for fix, away in zip(taken, off_m, strict=True))
    print(f"{right} of {len(taken)} frames within {FOUND_M:g} m (median {np.median(off_m):.1f} m)")
    print(f"{accepted} accepted, {false} of them false")


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
