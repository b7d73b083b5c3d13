# SPDX-License-Identifier: Apache-2.0
"""Folders of photos made out of real mosaics, from end to end; and a drone's own photos over no map at hand."""

import argparse
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import sasgeo_bench as sgb
from benchmarks.own_photos import is_right, take
from benchmarks.own_video import RATE, Stood, flown, write
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.flights.logs import read_log
from sasgeo_bench.observing.fixes import Fix, LocateRequest
from sasgeo_bench.observing.locate import locate
from sasgeo_bench.observing.pictures import list_pictures, open_picture, see
from sasgeo_bench.observing.video import VideoRequest, video_photos
from sasgeo_bench.observing.video_motion import STEP_S, MotionSeen, find_begin
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sensing.photos import read_photo
from sasgeo_bench.sensing.video import Video
from tests.sensing.test_photos import brighton_beach

pytestmark = [pytest.mark.real, pytest.mark.slow]
MOSAICS = ("pardubice-ortho", "chateaugiron-ortho", "andorra-la-vella-ortho")


def built(name: str, extracts: Path, out: Path) -> sgb.Region:
    """A region with imagery, built of the data at hand; the test is skipped where a part is not."""
    spec = read_region_file(find_region_file(name))
    try:
        plan = plan_build(spec, out=out, extract_folders=(extracts,), imagery_folders=())
        build_region(plan)
    except SasgeoError as error:
        pytest.skip(f"{name}: {error}")
    return sgb.read_region(plan.folder)


@pytest.mark.parametrize("name", MOSAICS)
@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_photos_of_a_mosaic_are_found_or_withheld(real_extracts: Path, tmp_path: Path, name: str, tilt: float) -> None:
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool is not installed")
    region = built(name, real_extracts, tmp_path)
    photos = tmp_path / "photos"
    photos.mkdir()
    how = argparse.Namespace(count=4, elsewhere=0, side=220.0, tilt=tilt, ground="built", seed=3)
    taken = {one.file: one for one in take(region, photos, how, None)}
    assert len(taken) == 4
    found = locate(LocateRequest(pictures=photos, out=tmp_path, into=tmp_path / "located")).fixes
    assert [fix.status for fix in found if fix.status == "failed"] == []
    right = [is_right(fix, taken[fix.file]) for fix in found]
    assert sum(right) >= (1 if "andorra" in name else 3)
    wrong = [fix.file for fix, is_found in zip(found, right, strict=True) if fix.is_accepted and not is_found]
    assert wrong == []


def test_frames_of_a_video_are_found_and_become_tasks(real_extracts: Path, tmp_path: Path) -> None:
    region = built("chateaugiron-ortho", real_extracts, tmp_path)
    how = argparse.Namespace(late=12.0, height=180.0, tilt=0.0)
    flight = flown(region, 36.0, 190.0, np.random.default_rng(1))
    video = tmp_path / "flight.mp4"
    stood = write(region, video, flight, how)
    found = sgb.locate(video, out=tmp_path, into=tmp_path / "located", every=4.0)
    off_m = [off(fix, stood) for fix in found.fixes]
    assert len(off_m) == 6
    assert sum(value <= 10.0 for value in off_m) >= 4
    assert [fix.file for fix, value in zip(found.fixes, off_m, strict=True) if fix.is_accepted and value > 25.0] == []
    # Subtitles count from the video's begin, which the motion seen confirms.
    seen = MotionSeen()
    for frame in Video.open(video).frames(STEP_S):
        seen.add(frame.time_s, frame.rgb)
    assert find_begin(seen, read_log(video.with_suffix(".SRT")), "SRT").time_s == pytest.approx(0.0, abs=0.2)
    # The same flight by a track of its own clock, which the motion seen joins to the video.
    lines: list[str] = []
    request = VideoRequest(path=video, out=tmp_path, track=video.with_suffix(".gpx"), every_s=4.0, fov_deg=71.6)
    with reporting(lines.append):
        photos = video_photos(request)
    begins = re.search(r"begins at ([0-9.]+) s of it", "".join(lines))
    assert begins is not None
    assert float(begins[1]) == pytest.approx(12.0, abs=0.3)
    for path in list_pictures(photos):
        photo, one = read_photo(path), stood[round(float(path.stem.rpartition("_")[2].removesuffix("s")) * RATE)]
        assert photo.gimbal is not None
        assert (photo.gimbal.yaw_deg - one.heading_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=8.0)
    tasks = sgb.import_photos(video, region="chateaugiron-ortho", every=2.0, out=tmp_path)
    assert [task.manifest.queries for task in tasks] == [12, 12]
    assert tasks[1].manifest.suite == "photos-flights"


def off(fix: Fix, stood: list[Stood]) -> float:
    """How far a fix is from where the camera was at the time that the frame's name says."""
    one = stood[round(float(fix.file.rpartition("_")[2].removesuffix("s.jpg")) * RATE)]
    return math.inf if fix.x_m is None else math.dist((fix.x_m, fix.y_m or 0.0), (one.east_m, one.north_m))


def test_a_drones_own_photos_say_where_and_how_they_were_taken() -> None:
    folder = brighton_beach()
    if folder is None:
        pytest.skip("the photos of Brighton Beach are not here")
    paths = list_pictures(folder)
    assert len(paths) == 6
    for path in paths:
        picture = open_picture(path)
        assert picture.position_by == "EXIF"
        assert picture.lonlat is not None
        assert picture.height_m is not None
        sight = see(picture)
        assert 16 < sight.side_m < 384
        assert sight.image.camera.tilt_deg < 60
