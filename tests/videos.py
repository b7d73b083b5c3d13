# SPDX-License-Identifier: Apache-2.0
"""Small videos, and what their heads say: written by OpenCV, and changed box by box."""

import struct
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

RATE = 10.0
EPOCH_S = 2_082_844_800  # from 1904 to 1970
Rgb = NDArray[np.uint8]
Change = Callable[[bytes], bytes]


def write_video(path: Path, frames: Iterable[Rgb], *, rate: float = RATE) -> Path:
    """Write frames as MPEG-4, or as JPEGs in an AVI."""
    writer, code = None, cv2.VideoWriter.fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    for rgb in frames:
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, rate, rgb.shape[1::-1])
        writer.write(rgb[..., ::-1])
    assert writer is not None
    writer.release()
    return path


def numbered(count: int, *, size: tuple[int, int] = (96, 64)) -> list[Rgb]:
    """Frames that tell their number by their grey: 6 of 256 each, which no codec mistakes."""
    return [np.full((size[1], size[0], 3), 6 * at + 12, dtype=np.uint8) for at in range(count)]


def number_of(rgb: Rgb) -> int:
    return round((float(rgb.mean()) - 11) / 6)


def changed(path: Path, changes: dict[bytes, Change], *, more: bytes = b"") -> Path:
    """Change the bodies of boxes of an MP4 whose head is at its end, so that no pixels move; add one to its head."""
    data, at, out = path.read_bytes(), 0, b""
    while at < len(data):
        size, name = struct.unpack(">I4s", data[at : at + 8])
        body = data[at : at + size]
        out += box(name, _within(body[8:], changes) + more) if name == b"moov" else body
        at += size
    path.write_bytes(out)
    return path


def _within(body: bytes, changes: dict[bytes, Change]) -> bytes:
    at, out = 0, b""
    while at < len(body):
        size, name = struct.unpack(">I4s", body[at : at + 8])
        inside = body[at + 8 : at + size]
        if name in (b"trak", b"mdia", b"minf", b"stbl"):
            inside = _within(inside, changes)
        out += box(name, changes[name](inside) if name in changes else inside)
        at += size
    return out


def box(name: bytes, body: bytes) -> bytes:
    """A box of an MP4."""
    return struct.pack(">I4s", len(body) + 8, name) + body


def lasting(ticks: list[int]) -> Change:
    """Times to samples, each lasting so many units of its track."""
    entries = b"".join(struct.pack(">II", 1, one) for one in ticks)
    return lambda _: struct.pack(">II", 0, len(ticks)) + entries


def made_at(time_s: float) -> Change:
    """A movie header of version 0 that was made then, UTC."""
    return lambda body: body[:4] + struct.pack(">I", int(time_s) + EPOCH_S) + body[8:]


def turned_right(body: bytes) -> bytes:
    """A track header of version 0 whose picture is to be turned by 90 degrees clockwise to be shown."""
    return body[:40] + struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30) + body[76:]
