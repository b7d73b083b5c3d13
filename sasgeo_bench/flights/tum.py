# SPDX-License-Identifier: Apache-2.0
"""Trajectories as text in the TUM format: one pose a line, `time x y z qx qy qz qw`, plain or gzipped."""

import gzip
import io
import math
import zlib
from array import array
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.errors import FlightError
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.files.paths import plain_file
from sasgeo_bench.flights.axes import Axes, in_axes
from sasgeo_bench.flights.trajectory import Trajectory

MOST_BYTES: Final = 300_000_000  # of text, unpacked
MOST_POSES: Final = 2_000_000
_COLUMNS: Final = 8
_KITTI: Final = 12  # numbers of a 3 x 4 matrix
_GZIP: Final = b"\x1f\x8b"
_FORM: Final = "a line is 'time_s x y z qx qy qz qw', 8 numbers with spaces between"


def read_tum(path: Path, *, axes: Axes | None = None) -> Trajectory:
    r"""Read a trajectory from a TUM file, whole or not at all.

    Parameters
    ----------
    path : Path
        Text, or gzipped text, which is told by its first bytes. Lines that begin with "#" and empty lines are skipped.
        `MOST_BYTES` of unpacked text and `MOST_POSES` are read at most.
    axes : {"up", "camera"}, optional
        Axes of the file: third axis up, or right, down and ahead of a camera, as KITTI and ORB-SLAM have them. By
        default third axis up; a path that shows another is refused (`sasgeo_bench.flights.axes`).

    Returns
    -------
    Trajectory
        Times in seconds as in the file; the file's frame, or that with its third axis up.

    Raises
    ------
    FlightError
        If the file is missing, damaged or too large, or a line has no pose: the message names file, line and mend.

    Notes
    -----
    Format of the TUM RGB-D benchmark (Sturm et al., IROS 2012): metres, and a quaternion from the body to the frame
    with its real part last.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "run.txt"
    ...     _ = path.write_text("# time x y z qx qy qz qw\n0.0 0 0 80 0 0 0 1\n0.5 5 0 80 0 0 0 1\n")
    ...     read_tum(path).distance_m.tolist()
    [0.0, 5.0]
    """
    table = array("d")
    last_s = -math.inf
    for number, content in enumerate(io.BytesIO(_content_of(path)), start=1):
        line = _decoded(content, f"{path}, line {number}")
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = _pose(line, f"{path}, line {number}")
        if values[0] <= last_s:
            raise FlightError(
                f"{path}, line {number}: time {values[0]!r} does not increase: sort the lines, keep one of a time"
            )
        if len(table) == MOST_POSES * _COLUMNS:
            raise FlightError(
                f"{path}, line {number}: more than {MOST_POSES} poses: keep every second one, or cut the file"
            )
        table.extend(values)
        last_s = values[0]
    if not table:
        raise FlightError(f"{path} holds no pose: {_FORM}")
    poses = np.frombuffer(table).reshape(-1, _COLUMNS)
    flown = Trajectory(time_s=poses[:, 0], position_m=poses[:, 1:4], quaternion_xyzw=poses[:, 4:])
    return in_axes(flown, axes, path)


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory as plain TUM text, to 1 us and 0.1 mm; raise `StoreError` if it cannot be written."""
    with fresh_file(path, mend="name another place, or free some space") as scratch, scratch.open("w") as out:
        out.write("# time_s x y z qx qy qz qw\n")
        for time, place, turn in zip(trajectory.time_s, trajectory.position_m, trajectory.quaternion_xyzw, strict=True):
            out.write(" ".join([f"{time:.6f}", *(f"{x:.4f}" for x in place), *(f"{x:.9f}" for x in turn)]) + "\n")


def _content_of(path: Path) -> bytes:
    try:
        with plain_file(path).open("rb") as file:
            is_packed = file.read(2) == _GZIP
            file.seek(0)
            content = (gzip.GzipFile(fileobj=file) if is_packed else file).read(MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        text = getattr(error, "strerror", None) or str(error)
        raise FlightError(
            f"{path} cannot be read as a trajectory ({text}): name a TUM file, plain or gzipped, that is whole"
        ) from error
    if len(content) > MOST_BYTES:
        raise FlightError(f"{path} holds more than {MOST_BYTES} bytes of text: cut the file, or leave out poses")
    return content


def _decoded(line: bytes, where: str) -> str:
    try:
        return line.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        raise FlightError(f"{where}: no text: {_FORM}") from error


def _pose(line: str, where: str) -> list[float]:
    """Return the eight numbers of a line; raise `FlightError` if they are no pose."""
    words = line.split(maxsplit=_KITTI)  # a line may be as long as the file
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != _COLUMNS or "_" in line or not all(map(math.isfinite, values)):
        count = f"{len(words)} words" if len(words) < _COLUMNS else "more than 8 words"
        if len(words) == _KITTI:
            count = "12 numbers, a pose of KITTI without its time (join times.txt, then --axes camera)"
        found = count if len(words) != _COLUMNS else "words that are no finite numbers"
        raise FlightError(f"{where}: {found}: {_FORM}")
    if max(map(abs, values)) >= 1e12:  # seconds or metres: what is larger has another unit
        raise FlightError(f"{where}: a number of {max(map(abs, values)):g}: give times in seconds, positions in metres")
    length = math.hypot(*values[4:])
    if abs(length - 1) > 1e-3:  # 1e-3: as in trajectory.py, which names the pose; here the line is named
        raise FlightError(f"{where}: the quaternion has length {length:g}, not 1: the order is qx qy qz qw")
    return values
