# SPDX-License-Identifier: Apache-2.0
"""Frames of a video as photos: what their files say, which are left out, and each fault in a line."""

import datetime as dt
import json
import math
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sasgeo_bench.core.errors import ConfigError, FlightError, ImageError, SasgeoError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.observing.pictures import list_pictures, open_picture, see
from sasgeo_bench.observing.posed_pictures import Heights, pose_pictures
from sasgeo_bench.observing.video import VideoRequest, video_photos
from sasgeo_bench.sensing.photos import read_head, read_photo
from sasgeo_bench.sensing.video import is_video
from tests.flights.test_log_subtitles import block
from tests.observing.test_video_motion import STEP_S, log_of, seen_frames, straight, winding
from tests.videos import box, changed, made_at, number_of, numbered, write_video

LON, LAT = 9.52, 47.14
SAYS = (
    "2026-05-01 12:00:{:06.3f}\n[focal_len: 24.00] [dzoom_ratio: 1.00], [latitude: {:.6f}] [longitude: {:.6f}] "
    "[rel_alt: {:.3f} abs_alt: 560.000] [gb_yaw: {:.1f} gb_pitch: {:.1f} gb_roll: 0.0]"
)
Made = Callable[..., VideoRequest]


def said(time_s: float, *, height_m: float = 60.0, pitch_deg: float = -90.0) -> str:
    """A flight to the north at 11 m/s that turns by 2 degrees a second, through north."""
    yaw_deg = (-8.0 + 2 * time_s + 180) % 360 - 180
    return SAYS.format(time_s, LAT + 1e-4 * time_s, LON, height_m, yaw_deg, pitch_deg)


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Write a video of 4 s at ten frames a second, with a subtitle for each."""

    def make(text: Callable[[float], str] = said, *, subtitles: int = 40, **how: object) -> VideoRequest:
        path = write_video(tmp_path / "DJI_0001.MP4", numbered(40, size=(128, 72)))
        srt = "".join(block(at + 1, text(at / 10), step_ms=100) for at in range(subtitles))
        if subtitles:
            path.with_suffix(".SRT").write_text(srt, encoding="utf-8")
        return VideoRequest(path=path, out=tmp_path / "out", **({"every_s": 1.0} | how))  # type: ignore[arg-type]

    return make


def quiet(request: VideoRequest) -> tuple[Path, list[str]]:
    lines: list[str] = []
    with reporting(lines.append):
        folder = video_photos(request)
    return folder, lines


def test_each_frame_is_a_photo_with_what_its_subtitle_says(made: Made) -> None:
    folder, lines = quiet(made())
    paths = list_pictures(folder)
    assert [path.name for path in paths] == [f"DJI_0001_{at:05d}.000s.jpg" for at in range(4)]
    for at, path in enumerate(paths):
        photo = read_photo(path)
        assert photo.lon_deg == pytest.approx(LON, abs=1e-9)
        assert photo.lat_deg == pytest.approx(LAT + 1e-4 * at, abs=1e-9)
        assert (photo.height_m, photo.altitude_m, photo.is_ellipsoidal) == (60.0, 560.0, False)
        assert photo.gimbal is not None
        assert (photo.gimbal.yaw_deg, photo.gimbal.pitch_deg) == pytest.approx((-8.0 + 2 * at, -90.0))
        assert photo.taken_at == dt.datetime(2026, 5, 1, 12, 0, at)  # noqa: DTZ001 - the drone names no zone
        with Image.open(path) as image:
            assert number_of(np.asarray(image)) == 10 * at
        picture = open_picture(path)
        # 24 mm on film of 24 x 36, of a sensor of 4 : 3 that is as wide as the picture
        focal_px = 24.0 * math.hypot(128, 96) / math.hypot(24, 36)
        assert picture.camera is not None
        assert picture.camera.intrinsics.focal_px == pytest.approx((focal_px, focal_px), rel=1e-4)
        assert see(picture).side_m == pytest.approx(72 * 60.0 / focal_px, abs=0.05)
    assert any("24 mm on 35 mm film" in line for line in lines)
    assert lines[-1].startswith("4 frames of DJI_0001.MP4, one every 1 s, as photos in ")


def test_exiftool_reads_the_same(made: Made) -> None:
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool is not installed")
    path = list_pictures(quiet(made(fov_deg=70.0))[0])[3]
    text = subprocess.run(["exiftool", "-json", "-n", str(path)], check=True, capture_output=True, text=True).stdout  # noqa: S603, S607
    tags = json.loads(text)[0]
    assert (tags["GPSLatitude"], tags["GPSLongitude"]) == pytest.approx((LAT + 3e-4, LON), abs=1e-9)
    assert float(tags["GimbalYawDegree"]) == pytest.approx(-2.0)
    assert float(tags["RelativeAltitude"]) == 60.0
    assert float(tags["CalibratedFocalLength"]) == pytest.approx(64 / math.tan(math.radians(35)), abs=1e-3)
    assert (tags["DateTimeOriginal"], str(tags["SubSecTimeOriginal"])) == ("2026:05:01 12:00:03", "000")
    assert "Warning" not in tags


def test_fractions_of_a_second_tell_frames_apart(made: Made) -> None:
    paths = list_pictures(quiet(made(every_s=0.5))[0])
    assert [path.name[-11:-5] for path in paths[:3]] == ["00.000", "00.500", "01.000"]
    first, second = (read_photo(path).taken_at for path in paths[:2])
    assert first is not None
    assert second is not None
    assert (second - first).total_seconds() == 0.5


def test_a_heading_between_two_subtitles_takes_the_shortest_turn(made: Made) -> None:
    """Subtitles a second apart, frames between them, and a yaw of 179 that becomes -179."""
    request = made(subtitles=0, every_s=0.5)
    texts = [SAYS.format(at, LAT + 1e-4 * at, 179.99999 if at % 2 == 0 else -179.99999, 60.0, yaw, -90.0)
             for at, yaw in enumerate((179.0, -179.0, -175.0))]  # fmt: skip
    request.path.with_suffix(".srt").write_text("".join(block(at, text) for at, text in enumerate(texts, start=1)))
    photo = read_photo(list_pictures(quiet(request)[0])[1])
    assert photo.gimbal is not None
    assert abs(photo.gimbal.yaw_deg) == pytest.approx(180.0)
    assert photo.lon_deg is not None
    assert abs(photo.lon_deg) == pytest.approx(180.0, abs=1e-6)
    assert photo.lat_deg == pytest.approx(LAT + 5e-5, abs=1e-8)


def test_frames_that_cannot_be_used_are_left_out_and_counted(made: Made) -> None:
    """On the ground, then looking ahead, then down; the subtitles end before the video."""
    request = made(
        lambda time_s: said(
            time_s, height_m=0.4 if time_s < 0.7 else 60.0, pitch_deg=-15.0 if 0.7 <= time_s < 1.7 else -80.0
        ),
        subtitles=28,
        every_s=0.5,
    )
    folder, lines = quiet(request)
    assert [path.name[-11:-5] for path in list_pictures(folder)] == ["02.000", "02.500", "03.000", "03.500"]
    assert "left out: 2 frames less than 5 m above take-off" in lines
    assert "left out: 2 frames that look more than 60 degrees away from straight down" in lines
    request = made(subtitles=22, every_s=0.5)
    assert "left out: 1 frame that the track does not cover" in quiet(request)[1]  # 3.5 s: a second after its last


def test_a_track_of_another_video_is_told(made: Made) -> None:
    def told(request: VideoRequest) -> list[str]:
        return [line for line in quiet(request)[1] if "may be of another video" in line]

    assert not told(made())
    assert not told(made(subtitles=22))  # within three seconds
    assert told(made(subtitles=90)) == [
        "DJI_0001.SRT may be of another video than DJI_0001.MP4: it ends at 9 s, the video at 4 s"
    ]
    request = made()
    other = request.path.with_name("DJI_0002.SRT")
    request.path.with_suffix(".SRT").rename(other)
    (line,) = told(replace(request, track=other))
    assert line == "DJI_0002.SRT may be of another video than DJI_0001.MP4: another number in its name"
    subtitles = other.rename(other.with_name("subtitles.srt"))
    assert not told(replace(request, track=subtitles))  # taken out of the video by ffmpeg, by any name


def test_a_second_call_finds_the_frames_and_one_with_other_words_makes_them_anew(made: Made) -> None:
    request = made()
    folder, first = quiet(request)
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    again, second = quiet(replace(request, needs_track=False))  # as of another command
    assert again == folder
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert second[:-1] == first[:-1]
    assert second[-1].endswith(", of an earlier call")
    assert len(list_pictures(quiet(made(every_s=0.5))[0])) == 8
    srt = request.path.with_suffix(".SRT")
    srt.write_text(srt.read_text().replace("rel_alt: 60.000", "rel_alt: 70.000"))
    assert read_photo(list_pictures(quiet(made(lambda time_s: said(time_s, height_m=70.0)))[0])[0]).height_m == 70.0


def test_nothing_is_half_written(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    request = made()
    written = Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        if self.name.endswith("02.000s.jpg"):
            raise OSError(28, os.strerror(28))
        return written(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SasgeoError, match=r"cannot be written .*: free some space"):
        video_photos(request)
    assert list((request.out / "frames").iterdir()) == []


def test_places_of_four_decimals_are_worth_less(made: Made) -> None:
    request = made(lambda time_s: f"GPS({LON + time_s * 1e-3:.4f},{LAT:.4f},14) BAROMETER:60.0", fov_deg=70.0)
    folder, lines = quiet(request)
    sigma_m = math.hypot(3.3, 1e-4 * 111_195 / math.sqrt(12))
    assert any(f"places are rounded, good to {sigma_m:.1f} m" in line for line in lines)
    head = read_head(list_pictures(folder)[0])
    assert float(head.gps[31]) == pytest.approx(sigma_m, abs=0.01)  # GPSHPositioningError
    assert any("no angles of the camera: taken as looking straight down" in line for line in lines)


def test_the_bodys_heading_stands_in_for_a_camera_that_looks_down(made: Made) -> None:
    request = made(lambda time_s: f"GPS(9.52000{int(time_s)}, 47.14, 14), H 60m, F.PRY (-5.0, 2.0, 28.0)", fov_deg=70)
    folder, lines = quiet(request)
    gimbal = read_photo(list_pictures(folder)[0]).gimbal
    assert gimbal is not None
    assert (gimbal.yaw_deg, gimbal.pitch_deg, gimbal.roll_deg) == (28.0, -90.0, 0.0)
    assert any("taken as looking straight down, its up as the drone heads" in line for line in lines)


def test_frames_of_a_flight_are_posed_as_its_photos_are(made: Made) -> None:
    found = pose_pictures(quiet(made())[0], None, epsg=32632, heights=Heights())
    assert [round((one.time_s or 0.0) % 60, 3) for one in found.pictures] == [0.0, 1.0, 2.0, 3.0]
    steps_m = np.diff([one.position_m[1] for one in found.pictures])
    assert steps_m == pytest.approx(11.1, abs=0.1)
    assert not found.left_out


def test_without_a_track_frames_have_no_place(made: Made) -> None:
    request = made(subtitles=0, needs_track=False, fov_deg=60.0)
    changed(request.path, {b"mvhd": made_at(1_777_629_600)})
    folder, lines = quiet(request)
    photo = read_photo(list_pictures(folder)[1])
    assert (photo.lon_deg, photo.height_m, photo.gimbal) == (None, None, None)
    assert photo.taken_at == dt.datetime(2026, 5, 1, 10, 0, 1)  # noqa: DTZ001 - as the head says it
    assert any("frames have no place" in line for line in lines)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty seconds of a winding flight from its second 33.3 on, four frames a second."""
    frames = seen_frames(winding, 33.3, 40.0)
    return write_video(tmp_path_factory.mktemp("filmed") / "own.mp4", frames, rate=1 / STEP_S)


def gpx(path: Path, log, start: dt.datetime) -> Path:
    """The track of a log by UTC."""
    points = [
        f'<trkpt lat="{lat:.8f}" lon="{lon:.8f}"><time>{(start + dt.timedelta(seconds=at)).isoformat()}</time></trkpt>'
        for at, lon, lat in zip(log.time_s.tolist(), log.lon_deg, log.lat_deg, strict=True)
    ]
    path.write_text(f"<gpx><trk><trkseg>{''.join(points)}</trkseg></trk></gpx>")
    return path


@pytest.mark.parametrize(
    ("clock_s", "hint"),
    [
        (30.0, r"begins at 33.\d s of it \(\+-0.\d\), by the motion that it shows; 3.\d s later than by the clocks"),
        (36.0, "2.. s earlier than by the clocks"),
        (7233.0, r"clocks disagree: by them it is 7233.0 s \(many cameras write local time as if UTC\)"),
    ],
)
def test_a_track_by_its_own_clock_is_joined_by_the_motion_seen(filmed: Path, tmp_path, clock_s, hint) -> None:
    start = dt.datetime(2026, 5, 1, 10, tzinfo=dt.UTC)
    path = tmp_path / "own.mp4"
    shutil.copy(filmed, path)
    changed(path, {b"mvhd": made_at(start.timestamp() + clock_s)})
    log = log_of(winding, 150.0)
    request = VideoRequest(
        path=path, out=tmp_path, track=gpx(tmp_path / "own.gpx", log, start), every_s=10.0, fov_deg=70.0
    )
    folder, lines = quiet(request)
    assert any(re.search(hint, line) for line in lines), lines
    for at, photo in enumerate(map(read_photo, list_pictures(folder))):
        assert photo.lat_deg == pytest.approx(np.interp(33.3 + 10 * at, log.time_s, log.lat_deg), abs=3e-5)
        assert photo.gimbal is not None
        off_deg = (photo.gimbal.yaw_deg - winding(33.3 + 10 * at)[2] + 180) % 360 - 180
        assert (off_deg, photo.gimbal.pitch_deg) == (pytest.approx(0.0, abs=6.0), -90.0)
        assert photo.taken_at is not None
        off_s = photo.taken_at.replace(tzinfo=dt.UTC) - start
        assert off_s.total_seconds() == pytest.approx(33.3 + 10 * at, abs=0.5)
    assert at == 3


def test_an_offset_that_is_said_is_taken(filmed: Path, tmp_path: Path) -> None:
    track = gpx(tmp_path / "own.gpx", log_of(straight, 150.0), dt.datetime(2026, 5, 1, 10, tzinfo=dt.UTC))
    request = VideoRequest(path=filmed, out=tmp_path, track=track, every_s=10.0, fov_deg=70.0, offset_s=125.0)
    folder, lines = quiet(request)
    assert len(list_pictures(folder)) == 3  # the log ends at 149 s, and holds for a second more
    assert "left out: 1 frame that the track does not cover" in lines
    assert "own.gpx: the video begins at 125 s of it, as --offset says" in lines


def test_each_fault_is_one_line(made: Made, filmed: Path, tmp_path: Path) -> None:
    plain = made(subtitles=0)
    empty, tum, text = tmp_path / "empty.srt", tmp_path / "a.tum", tmp_path / "text.mp4"
    for path in (empty, tum):
        path.write_text("")
    text.write_text("no video")
    table = tmp_path / "table.csv"
    table.write_text("time_s,lat,lon,height\n0,47.1,9.5,80\n1,47.1001,9.5,80\n")
    line = tmp_path / "line.kml"
    line.write_text("<kml><LineString><coordinates>9.5,47.1 9.6,47.1</coordinates></LineString></kml>")
    other = gpx(tmp_path / "other.gpx", log_of(straight, 150.0), dt.datetime(2026, 5, 1, 10, tzinfo=dt.UTC))
    path, out = plain.path, tmp_path / "out"
    faults: list[tuple[dict[str, object], type[SasgeoError], str]] = [
        ({"path": path}, FlightError, r"no track, such as DJI_0001.SRT beside it: say --track"),
        ({"path": path, "track": empty}, FlightError, r"empty\.srt: empty: copy it anew"),
        ({"path": path, "track": tmp_path / "none.gpx"}, FlightError, "there is no flight log"),
        ({"path": path, "track": tum}, FlightError, "no longitude and latitude"),
        ({"path": path, "track": line}, FlightError, "has no times"),
        ({"path": path, "track": table}, FlightError, "name it as in height_m; the latter, since units of a video's"),
        ({"path": path, "track": other}, ConfigError, "say --fov"),
        ({"path": filmed, "track": other, "fov_deg": 70}, FlightError, "fits no one time"),
        ({"path": text, "needs_track": False}, ImageError, "is no video"),
        ({"path": path, "needs_track": False}, ConfigError, "nothing says the lens of DJI_0001.MP4: say --fov"),
        ({"path": filmed, "track": other, "fov_deg": 70, "offset_s": 900}, ImageError, "4 frames that the track does"),
    ]
    for words, kind, hint in faults:
        with pytest.raises(kind, match=hint) as error:
            video_photos(VideoRequest(out=out, every_s=10.0, **words))  # type: ignore[arg-type]
        assert "\n" not in str(error.value)
    assert not list((out / "frames").glob("*"))
    with pytest.raises(ConfigError, match="counts from the video's begin: leave out --offset"):
        video_photos(made(offset_s=3.0))
    for name, value in (("every_s", 0.0), ("every_s", math.nan), ("fov_deg", 180.0), ("offset_s", math.inf)):
        with pytest.raises(ConfigError, match=f"--{name.partition('_')[0]}"):
            made(**{name: value})


def test_a_video_that_holds_subtitles_says_how_to_take_them_out(made: Made) -> None:

    request = made(subtitles=0)
    text = box(b"hdlr", bytes(8) + b"sbtl" + bytes(13))
    changed(request.path, {}, more=box(b"trak", box(b"mdia", text)))
    with pytest.raises(FlightError, match=r"ffmpeg -i DJI_0001.MP4 -map 0:s:0 DJI_0001.SRT"):
        video_photos(request)


def test_a_folder_of_videos_says_that_each_is_named_by_itself(made: Made) -> None:
    folder = made().path.parent
    (folder / "DJI_0001.SRT").unlink()
    with pytest.raises(ImageError, match="name a folder that does, or one of its videos"):
        list_pictures(folder)
    assert is_video(folder / "DJI_0001.MP4")
    assert not is_video(folder)
