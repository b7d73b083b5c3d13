# SPDX-License-Identifier: Apache-2.0
"""Videos: their frames with the times at which they are shown, one after the other, and what their heads say."""

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of

EVERY_S: Final = 2.0  # between frames that are looked at
SUFFIXES: Final = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".ts", ".mts", ".m2ts")

_MOST_PIXELS: Final = 200_000_000
_EPOCH_S: Final = 2_082_844_800  # from 1904, whence QuickTime counts, to 1970
_BOXES: Final = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")  # with which QuickTime and MP4 begin
_MOST_HEAD: Final = 64 * 2**20  # of a moov box: an hour at 60 frames a second has 3 MB
_CUT: Final = 0.95  # of the length that a head states; editors state a frame more or less
_WITHIN: Final = (b"trak", b"mdia")  # boxes of a moov that hold others which are read, each in the one before
_MOST_CREATED: Final = 2**32  # seconds since 1904, in 2040: more is no date


def is_video(path: Path) -> bool:
    """Return whether a path is named as a video is.

    >>> is_video(Path("DJI_0001.MP4")), is_video(Path("DJI_0001.JPG"))
    (True, False)
    """
    return path.suffix.lower() in SUFFIXES and not path.is_dir()


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFrame:
    """A frame: when it is shown, seconds from the begin of the video; its pixels, upright RGB of shape (H, W, 3)."""

    time_s: float
    rgb: NDArray[np.uint8]


@dataclass
class Due:
    """Takes the first of each so many seconds, out of times in order.

    >>> due = Due(2.0)
    >>> [time_s for time_s in (0.0, 1.9, 2.1, 3.9, 9.0, 9.9, 10.0) if due.is_now(time_s)]
    [0.0, 2.1, 9.0, 10.0]
    """

    every_s: float
    next_s: float = 0.0

    def is_now(self, time_s: float) -> bool:
        """Return whether a time is the first of its span; times of some containers are rounded to milliseconds."""
        if time_s < self.next_s - 1e-3:
            return False
        self.next_s = self.every_s * (math.floor((time_s + 1e-3) / self.every_s) + 1)
        return True


@dataclass(kw_only=True)
class Video:
    """A video file whose frames can be decoded.

    Parameters
    ----------
    path : Path
        Of the file.
    size_px : tuple of int
        Width and height of a frame as it is shown: turned as the file says.
    length_s : float, optional
        As the head states it.
    created_s : float, optional
        Seconds since 1970 at which it was made, as the head of an MP4 or MOV states it: UTC by the standard, the local
        time of many cameras. None where it states none.
    has_subtitles : bool
        Whether an MP4 or MOV holds a track of text, as drones write their places into.
    read_s : float
        Time of the last frame that was decoded.
    """

    path: Path
    size_px: tuple[int, int]
    length_s: float | None = None
    created_s: float | None = None
    has_subtitles: bool = False
    read_s: float = field(default=0.0, init=False)

    @classmethod
    def open(cls, path: Path) -> "Video":
        """Open a video.

        Raises
        ------
        ImageError
            If it is no video in a container that is read, is cut off before its head, or holds no picture.

        Examples
        --------
        >>> Video.open(Path("DJI_0001.MP4"))
        Traceback (most recent call last):
            ...
        sasgeo_bench.core.errors.ImageError: there is no video DJI_0001.MP4: check the path
        """
        if not path.is_file():
            raise ImageError(f"there is no video {path}: check the path")
        try:
            with plain_file(path).open("rb") as file:
                kind = _kind(file)
                head = _Head.read(file) if kind == "MP4" else _Head()
        except OSError as error:
            raise ImageError(f"{path} cannot be read ({message_of(error)}): check its rights") from error
        if not kind:
            raise ImageError(f"{path} is no video, whatever its name: MP4, MOV, AVI, MKV, WebM and TS are read")
        if head.fault:
            raise ImageError(f"{path} {head.fault}")
        capture = _opened(path)
        try:
            size_px = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
            rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        finally:
            capture.release()
        if not 0 < size_px[0] * size_px[1] <= _MOST_PIXELS:
            raise ImageError(f"{path} has frames of {size_px[0]} x {size_px[1]} pixels: scale it down first")
        stated_s = count / rate if rate > 0 and count > 0 else None
        return cls(
            path=path,
            size_px=size_px,
            length_s=head.length_s or stated_s,
            created_s=head.created_s,
            has_subtitles=head.has_subtitles,
        )

    @property
    def is_cut_off(self) -> bool:
        """Return whether frames ended long before the length that the head states; known after all were read."""
        return self.length_s is not None and self.read_s < _CUT * self.length_s - 1.0

    def frames(self, every_s: float, is_wanted: Callable[[float], bool] = lambda _: True) -> Iterator[VideoFrame]:
        """Yield the first frame of each so many seconds, in order; one at a time is held in memory.

        All frames are decoded on the way, so that times are those of the file, whatever its rate. `is_wanted` is asked
        with the time of a frame before its pixels are fetched.
        """
        capture = _opened(self.path)
        due = Due(every_s)
        self.read_s = 0.0
        try:
            while capture.grab():
                time_s = max(0.0, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
                self.read_s = max(self.read_s, time_s)
                if not (due.is_now(time_s) and is_wanted(time_s)):
                    continue
                is_sound, bgr = capture.retrieve()
                if is_sound and bgr is not None:
                    rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
                    yield VideoFrame(time_s=round(time_s, 3), rgb=rgb)
        finally:
            capture.release()


def _opened(path: Path) -> cv2.VideoCapture:
    """Open a file for FFmpeg alone, by an absolute path, so that no name is taken for an address."""
    # Read when the first video of a process is opened: what is wrong with a file is told by us, in a line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = getattr(cv2.utils, "logging", cv2)  # earlier releases have it in cv2 itself
    before = logging.setLogLevel(0)
    try:
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    finally:
        logging.setLogLevel(before)
    if not capture.isOpened():
        raise ImageError(
            f"{path} cannot be decoded: it is damaged, or of a codec that is not read; copy it again from the drone, "
            "or convert it (ffmpeg -i VIDEO -c:v libx264 NEW.mp4)"
        )
    return capture


def _kind(file: IO[bytes]) -> str:
    """Return the container that the first bytes tell; empty for none that is read: playlists name other files."""
    start = file.read(377)
    if start[4:8] in _BOXES:
        return "MP4"
    if start[:4] == b"RIFF" and start[8:12] == b"AVI ":
        return "AVI"
    if start[:4] == b"\x1aE\xdf\xa3":
        return "MKV"
    every = {188: 0, 192: 4}  # bytes of a packet of a transport stream, and before its first mark
    if any(len(start) > at + step and start[at] == 0x47 == start[at + step] for step, at in every.items()):
        return "TS"
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Head:
    """What the movie header of an MP4 or MOV says; nothing of other containers."""

    length_s: float | None = None
    created_s: float | None = None
    has_subtitles: bool = False
    fault: str = ""

    @classmethod
    def read(cls, file: IO[bytes]) -> "_Head":
        for name, start, size in _boxes(file):
            if name == b"moov" and size <= _MOST_HEAD:
                file.seek(start)
                return cls.of(file.read(size))
        return cls(fault="is cut off, and its head at the end is missing: copy it again from the drone")

    @classmethod
    def of(cls, moov: bytes) -> "_Head":
        length_s = created_s = None
        kinds = []
        for name, body in _inner(moov):
            if name == b"mvhd" and len(body) >= 32:
                wide = 8 if body[0] == 1 else 4  # bytes of a time, by the version
                sizes = (4, wide, wide, 4, wide)  # version and flags, made, changed, units of a second, length
                ends = np.cumsum(sizes).tolist()
                parts = [int.from_bytes(body[end - size : end], "big") for size, end in zip(sizes, ends, strict=True)]
                created_s = float(parts[1] - _EPOCH_S) if _EPOCH_S < parts[1] < _MOST_CREATED else None
                length_s = parts[4] / parts[3] if parts[3] and 0 < parts[4] < 2 ** (8 * wide) - 1 else None
            elif name == b"hdlr":
                kinds.append(body[8:12])
        fault = "" if b"vide" in kinds else "holds no pictures, as one of sound alone: name the video"
        has_subtitles = any(kind in kinds for kind in (b"text", b"sbtl", b"subt"))
        return cls(length_s=length_s, created_s=created_s, has_subtitles=has_subtitles, fault=fault)


def _boxes(file: IO[bytes]) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, begin of the body and its size of the boxes of a file."""
    file.seek(0, os.SEEK_END)
    end = file.tell()
    at = 0
    while at + 8 <= end:
        file.seek(at)
        head = file.read(16)
        size, start = int.from_bytes(head[:4], "big"), 8
        if size == 1:
            size, start = int.from_bytes(head[8:16], "big"), 16
        size = end - at if size == 0 else size
        if size < start:
            return
        yield head[4:8], at + start, min(size, end - at) - start
        at += size


def _inner(body: bytes, within: tuple[bytes, ...] = _WITHIN) -> Iterator[tuple[bytes, bytes]]:
    """Yield the boxes in a box, and those in its tracks."""
    at = 0
    while at + 8 <= len(body):
        size, name = int.from_bytes(body[at : at + 4], "big"), body[at + 4 : at + 8]
        if size < 8:
            return
        inside = body[at + 8 : at + size]
        if name in within[:1]:
            yield from _inner(inside, within[1:])
        else:
            yield name, inside
        at += size
