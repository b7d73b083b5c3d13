# SPDX-License-Identifier: Apache-2.0
"""Trajectories as text in the TUM format: one pose a line, `time x y z qx qy qz qw`, plain or gzipped."""

import gzip
import io
import math
import zlib
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import FlightError
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.flights.trajectory import Trajectory

MOST_BYTES: Final = 300_000_000  # of text, unpacked
MOST_POSES: Final = 2_000_000
_COLUMNS: Final = 8
_GZIP: Final = b"\x1f\x8b"
_FORM: Final = "a line is 'time_s x y z qx qy qz qw', 8 numbers with spaces between"
_UNIT: Final = 1e-3  # as in trajectory.py, which names the pose; here the line is named


def read_tum(path: Path, *, most_bytes: int = MOST_BYTES, most_poses: int = MOST_POSES) -> Trajectory:
    r"""Read a trajectory from a TUM file, whole or not at all.

    Parameters
    ----------
    path : Path
        Text, or gzipped text, which is told by its first bytes. Lines that begin with "#" and empty lines are skipped.
    most_bytes, most_poses : int
        Limits on the unpacked text and on its poses.

    Returns
    -------
    Trajectory
        Times in seconds as in the file; the file's frame, whose third axis must point up.

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
    times: list[float] = []
    rows: list[list[float]] = []
    for number, content in enumerate(io.BytesIO(_content_of(path, most_bytes)), start=1):
        line = _decoded(content, f"{path}, line {number}")
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        values = _pose(line, f"{path}, line {number}")
        if times and values[0] <= times[-1]:
            message = f"{path}, line {number}: time {values[0]!r} does not increase: sort the lines, keep one of a time"
            raise FlightError(message)
        if len(rows) == most_poses:
            message = f"{path}, line {number}: more than {most_poses} poses: keep every second one, or cut the file"
            raise FlightError(message)
        times.append(values[0])
        rows.append(values[1:])
    if not rows:
        message = f"{path} holds no pose: {_FORM}"
        raise FlightError(message)
    position, quaternion = [row[:3] for row in rows], [row[3:] for row in rows]
    return Trajectory(time_s=times, position_m=position, quaternion_xyzw=quaternion)  # type: ignore[arg-type] # converted there


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory as plain TUM text, to 1 us and 0.1 mm; raise `StoreError` if it cannot be written."""
    with fresh_file(path, mend="name another place, or free some space") as scratch, scratch.open("w") as out:
        out.write("# time_s x y z qx qy qz qw\n")
        for time, place, turn in zip(trajectory.time_s, trajectory.position_m, trajectory.quaternion_xyzw, strict=True):
            out.write(" ".join([f"{time:.6f}", *(f"{x:.4f}" for x in place), *(f"{x:.9f}" for x in turn)]) + "\n")


def _content_of(path: Path, most_bytes: int) -> bytes:
    try:
        with path.open("rb") as file:
            is_packed = file.read(2) == _GZIP
        with gzip.open(path, "rb") if is_packed else path.open("rb") as source:
            content = source.read(most_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        text = getattr(error, "strerror", None) or str(error)
        message = f"{path} cannot be read as a trajectory ({text}): name a TUM file, plain or gzipped, that is whole"
        raise FlightError(message) from error
    if len(content) > most_bytes:
        message = f"{path} holds more than {most_bytes} bytes of text: cut the file, or leave out poses"
        raise FlightError(message)
    return content


def _decoded(line: bytes, where: str) -> str:
    try:
        return line.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        message = f"{where}: no text: {_FORM}"
        raise FlightError(message) from error


def _pose(line: str, where: str) -> list[float]:
    """Return the eight numbers of a line; raise `FlightError` if they are no pose."""
    words = line.split(maxsplit=_COLUMNS)  # a line may be as long as the file
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != _COLUMNS or "_" in line or not all(map(math.isfinite, values)):
        count = f"{len(words)} words" if len(words) < _COLUMNS else "more than 8 words"
        found = count if len(words) != _COLUMNS else "words that are no finite numbers"
        message = f"{where}: {found}: {_FORM}"
        raise FlightError(message)
    length = math.hypot(*values[4:])
    if abs(length - 1) > _UNIT:
        message = f"{where}: the quaternion has length {length:g}, not 1: the order is qx qy qz qw"
        raise FlightError(message)
    return values
