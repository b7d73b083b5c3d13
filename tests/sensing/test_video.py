# SPDX-License-Identifier: Apache-2.0
"""Videos: times of frames at any rate, what heads say, and files that are none."""

from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.video import Video
from tests.videos import box, changed, lasting, made_at, number_of, numbered, turned_right, write_video


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "a.mp4", numbered(40))


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".avi", ".mkv"])
def test_frames_have_the_times_at_which_they_are_shown(tmp_path: Path, suffix: str) -> None:
    opened = Video.open(write_video(tmp_path / f"a{suffix}", numbered(40)))
    found = [(frame.time_s, number_of(frame.rgb)) for frame in opened.frames(1.0)]
    assert found == [(0.0, 0), (1.0, 10), (2.0, 20), (3.0, 30)]
    assert (opened.size_px, opened.is_cut_off) == ((96, 64), False)
    assert opened.length_s == pytest.approx(4.0, abs=0.1)


def test_times_are_those_of_the_file_where_its_rate_varies(video: Path) -> None:
    """After twenty frames at ten a second come ten that last a second each, and ten at ten a second."""
    marks: dict[str, bytes] = {}
    changed(video, {b"stts": lambda body: marks.setdefault("stts", body)})
    tick = int.from_bytes(marks["stts"][12:16], "big")  # of one frame
    changed(video, {b"stts": lasting([tick] * 20 + [10 * tick] * 10 + [tick] * 10), b"edts": lambda _: b""})
    found = [(round(frame.time_s, 2), number_of(frame.rgb)) for frame in Video.open(video).frames(3.0)]
    assert found == [(0.0, 0), (3.0, 21), (6.0, 24), (9.0, 27), (12.0, 30)]


def test_frames_that_are_not_wanted_are_passed_by(video: Path) -> None:
    asked: list[float] = []

    def is_wanted(time_s: float) -> bool:
        asked.append(round(time_s, 3))
        return time_s > 1.5

    found = [number_of(frame.rgb) for frame in Video.open(video).frames(1.0, is_wanted)]
    assert (asked, found) == ([0.0, 1.0, 2.0, 3.0], [20, 30])


def test_a_video_that_is_to_be_turned_comes_upright(tmp_path: Path) -> None:
    frame = np.zeros((64, 96, 3), dtype=np.uint8)
    frame[:, :32, 0] = 250  # red at the left, which the turn brings to the top
    opened = Video.open(changed(write_video(tmp_path / "a.mp4", [frame] * 3), {b"tkhd": turned_right}))
    rgb = next(opened.frames(1.0)).rgb
    assert (opened.size_px, rgb.shape) == ((64, 96), (96, 64, 3))
    assert rgb[:28, :, 0].min() > 150
    assert rgb[36:, :, 0].max() < 100


def test_the_head_says_when_it_was_made_and_whether_it_holds_text(video: Path) -> None:
    assert (Video.open(video).created_s, Video.open(video).has_subtitles) == (None, False)
    changed(video, {b"mvhd": made_at(1_777_629_600)})
    assert Video.open(video).created_s == 1_777_629_600
    text = box(b"hdlr", bytes(8) + b"text" + bytes(13))
    changed(video, {}, more=box(b"trak", box(b"mdia", text)))
    assert Video.open(video).has_subtitles
    changed(video, {b"mvhd": lambda body: b"\1" + body[1:4] + b"\xff" * 16 + body[12:] + bytes(12)})
    assert Video.open(video).created_s is None  # of a version that counts to the end of days


def test_a_video_that_is_cut_off_gives_the_frames_before(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    path = write_video(tmp_path / "a.avi", [rng.integers(0, 256, (64, 96, 3), dtype=np.uint8) for _ in range(60)])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    opened = Video.open(path)
    found = [frame.time_s for frame in opened.frames(1.0)]
    assert found[:2] == [0.0, 1.0]
    assert opened.is_cut_off
    assert 2.0 < opened.read_s < 4.0


def test_one_frame_at_a_time_is_held(video: Path) -> None:
    frames = Video.open(video).frames(0.1)
    assert [number_of(next(frames).rgb) for _ in range(3)] == [0, 1, 2]
    frames.close()  # type: ignore[attr-defined]


def test_what_is_no_video_is_refused_in_a_line(tmp_path: Path, video: Path, capfd) -> None:
    whole = video.read_bytes()
    faults = {
        "there.mp4": (None, "there is no video"),
        "text.mp4": (b"not a video at all", "is no video, whatever its name"),
        "list.mp4": (b"#EXTM3U\n#EXTINF:10,\na.mp4\n", "is no video, whatever its name"),
        "list.m3u8": (b"#EXTM3U\n#EXTINF:10,\na.mp4\n", "is no video, whatever its name"),
        "picture.mov": (b"\x89PNG\r\n\x1a\n" + bytes(400), "is no video, whatever its name"),
        "empty.mp4": (b"", "is no video, whatever its name"),
        "cut.mp4": (whole[: len(whole) // 2], "is cut off, and its head at the end is missing"),
        "sound.mp4": (whole.replace(b"vide", b"soun"), "holds no pictures"),
        "codec.mp4": (whole.replace(b"stsd", b"none"), "cannot be decoded: it is damaged, or of a codec"),
        "deep.mp4": (
            box(b"ftyp", b"isom") + box(b"moov", reduce(lambda body, _: box(b"trak", body), range(3000), b"")),
            "holds no pictures",
        ),
        "damaged.avi": (b"RIFF\0\0\0\0AVI " + b"\0" * 500, "cannot be decoded"),
    }
    for name, (data, hint) in faults.items():
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(ImageError, match=hint) as error:
            list(Video.open(path).frames(1.0))
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")  # of FFmpeg
