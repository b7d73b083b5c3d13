# SPDX-License-Identifier: Apache-2.0
"""Trajectory: positions and attitudes over time, as a flight log, an estimator or a plan gives them."""

import gzip
import io
import math
import warnings
import zlib
from array import array
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Self, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import plain
from sasgeo_bench.geometry.pose import bearing_deg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sasgeo_bench.regions.region import Region

Floats = NDArray[np.float64]

_UNIT = 1e-3  # a quaternion's length may be off by so much, from rounding in files
# Columns: forward, right and down of a body that is level and heads north, in (east, north, up).
_LEVEL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """N poses of a body in a frame whose third axis points up, in order of time, one at least.

    Parameters
    ----------
    time_s : ndarray, shape (N,)
        Seconds, strictly increasing, from any origin.
    position_m : ndarray, shape (N, 3)
        East, north, up, metres. An estimator's frame may be turned about the vertical and moved.
    quaternion_xyzw : ndarray, shape (N, 4)
        Rotation from the body to the frame. The body's axes are forward, right, down unless a file has others;
        differences between two trajectories of one body do not depend on them.

    Raises
    ------
    FlightError
        If shapes do not fit, a value is not finite, time does not increase, or a quaternion is not of unit length.

    Examples
    --------
    Ten metres east in one second, level, heading east:

    >>> flown = Trajectory.of_angles(time_s=[0.0, 1.0], position_m=[[0, 0, 80], [10, 0, 80]], yaw_deg=[90.0, 90.0])
    >>> flown.distance_m.tolist(), flown.yaw_deg.round(6).tolist()
    ([0.0, 10.0], [90.0, 90.0])
    >>> flown.at([0.25]).position_m.tolist()
    [[2.5, 0.0, 80.0]]
    """

    time_s: Floats
    position_m: Floats
    quaternion_xyzw: Floats

    def __post_init__(self) -> None:
        """Check shapes and values; keep own arrays, read-only."""
        shapes = {"time_s": (), "position_m": (3,), "quaternion_xyzw": (4,)}
        for name, rest in shapes.items():
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (len(self.time_s), *rest):
                raise FlightError(f"{name} of {len(self.time_s)} poses has shape {values.shape}")
            if not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0, 0])
                raise FlightError(f"{name} of pose {row + 1} is not finite: leave that pose out")
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if not len(self.time_s):
            raise FlightError("a trajectory has one pose at least, got none")
        back = np.flatnonzero(np.diff(self.time_s) <= 0)
        if len(back):
            raise FlightError(
                f"time does not increase after pose {back[0] + 1}: sort the poses and keep one of each time"
            )
        lengths = np.linalg.norm(self.quaternion_xyzw, axis=1)
        off = np.flatnonzero(np.abs(lengths - 1) > _UNIT)
        if len(off):
            raise FlightError(
                f"the quaternion of pose {off[0] + 1} has length {lengths[off[0]]:g}, not 1: order is x y z w"
            )

    @classmethod
    def of_angles(
        cls,
        *,
        time_s: Floats | list[float],
        position_m: Floats | list[list[float]],
        yaw_deg: Floats | list[float],
        pitch_deg: Floats | float = 0.0,
        roll_deg: Floats | float = 0.0,
    ) -> Self:
        """Return a trajectory from angles in the order of `sensing.camera.Attitude`; yaw runs clockwise from north."""
        yaw = np.asarray(yaw_deg, dtype=np.float64)
        angles = np.stack(np.broadcast_arrays(yaw, pitch_deg, roll_deg), axis=1)
        level = Rotation.from_matrix(_LEVEL)
        turned = Rotation.from_euler("ZYX", angles, degrees=True)
        return cls(
            time_s=np.asarray(time_s, dtype=np.float64),
            position_m=np.asarray(position_m, dtype=np.float64),
            quaternion_xyzw=(level * turned).as_quat(),
        )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def rotation(self) -> Rotation:
        """Return the rotations from the body to the frame."""
        return Rotation.from_quat(self.quaternion_xyzw)

    @property
    def yaw_deg(self) -> Floats:
        """Return where the body's first axis points over the ground, clockwise from north, [0, 360)."""
        ahead = self.rotation.apply([1.0, 0.0, 0.0])
        return bearing_deg(ahead[:, 0], ahead[:, 1])

    @property
    def distance_m(self) -> Floats:
        """Return the distance flown over the ground since the first pose, metres; climbs do not count."""
        steps = np.linalg.norm(np.diff(self.position_m[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def at(self, time_s: Floats | list[float]) -> Self:
        """Return the poses at times within the trajectory: positions by lines, attitudes by the shortest turn.

        Raise `FlightError` if a time lies outside.
        """
        times = np.asarray(time_s, dtype=np.float64)
        if times.size and (times.min() < self.time_s[0] or times.max() > self.time_s[-1]):
            raise FlightError(
                f"times from {times.min():.3f} to {times.max():.3f} s, the trajectory has {self.span_text()}"
            )
        position = np.stack([np.interp(times, self.time_s, axis) for axis in self.position_m.T], axis=1)
        turned = Slerp(self.time_s, self.rotation)(times) if len(self) > 1 else self.rotation
        return type(self)(time_s=times, position_m=position, quaternion_xyzw=turned.as_quat())

    def plot(self, region: "Region", *, width_mm: float | None = None) -> "Figure":
        """Draw the flight over a map in one call; see `sgb.plot_flight`."""
        # By its public name: the drawing stands below in the order of folders
        return cast("Figure", import_module("sasgeo_bench").plot_flight(self, region, width_mm=width_mm))

    def span_text(self) -> str:
        """Return from when to when it goes, for messages; times may count from 1970, so to the millisecond."""
        return f"{self.time_s[0]:.3f} to {self.time_s[-1]:.3f} s"


Axes = Literal["up", "camera"]

AXES: Final = ("up", "camera")
# East, north, up out of a first camera's right, down, ahead; forward, right, down of a body in its camera's axes.
_FRAME: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_BODY: Final = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
_ALONG: Final = 0.3  # share of the third axis in the spread of a path that does not lie across it
_AHEAD: Final = 0.7  # mean cosine between the way and the body's axis that looks along it
_LOOKING: Final = 0.01  # a camera looks along its way, and turns by 8 degrees about its second axis (rms)
_TILTED: Final = 0.05
# A camera that looks ahead and down: the body turns about an axis off the third, and the path lies across that axis.
_PITCHED_DEG: Final = (
    10.0,
    80.0,
)  # beyond: the third axis itself, or a level one


def in_axes(flown: Trajectory, axes: Axes | None, path: Path) -> Trajectory:
    """Return a trajectory whose third axis points up.

    Parameters
    ----------
    flown : Trajectory
        As its file has it.
    axes : {"up", "camera"}, optional
        Axes of the file: east, north, up; or right, down, ahead of its first camera, with poses of the camera. By
        default they are up, unless the path shows that they are not.
    path : Path
        Of the file, for messages.

    Raises
    ------
    FlightError
        If the body turns about another axis of the frame than the third, as no level flight does.

    Notes
    -----
    A body that flies level turns about the vertical, so the vertical is that axis of the frame that keeps its place in
    the body: the mean of the axis in the axes of the body has a length near 1. A body that does not turn tells nothing:
    straight up and straight ahead of a camera look alike, and so do a front and the ground. A loop turns about a level
    axis as well; it is known by the body's first axis, which points along the way, where a camera looks with its third.
    Warnings say so of both. A camera that looks ahead and down turns about an axis off the third by 10 to 80 degrees,
    and its path lies flat across that axis, as none does that climbs.

    Examples
    --------
    Two metres ahead in the axes of a camera are two metres north, heading north:

    >>> level = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    >>> ahead = Trajectory(time_s=[0, 1], position_m=[[0, 0, 0], [0, 0, 2]], quaternion_xyzw=level)
    >>> flown = in_axes(ahead, "camera", Path("orb.txt"))
    >>> flown.position_m[1].tolist(), flown.yaw_deg.tolist()
    ([0.0, 2.0, 0.0], [0.0, 0.0])
    """
    if axes is not None and axes not in AXES:
        raise FlightError(f"axes must be one of {', '.join(AXES)}, got {axes!r}")
    if axes == "camera":
        turns = np.matmul(np.matmul(_FRAME, flown.rotation.as_matrix()), _BODY)
        flown = Trajectory(
            time_s=flown.time_s,
            position_m=flown.position_m @ _FRAME.T,
            quaternion_xyzw=type(flown.rotation).from_matrix(turns).as_quat(),
        )
    if axes != "up" and len(flown) >= 10:  # fewer decide nothing
        _check_upright(flown, axes, plain(str(path)))
    return flown


def _between_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return math.degrees(math.acos(min(1.0, abs(float(first @ second)))))


def _lies_across(position_m: NDArray[np.float64], axis: NDArray[np.float64]) -> bool:
    _, spread, normals = np.linalg.svd(position_m - position_m.mean(axis=0), full_matrices=False)
    # 0.2: thickness of the path's plane, in its width
    is_plane = spread[1] > 0.05 * spread[0] and spread[2] < 0.2 * spread[1]  # 0.05: width of the path, in its spread
    # 10 degrees between that axis and the normal of the path's plane
    return bool(is_plane) and _between_deg(normals[2], axis) < 10.0


def _check_upright(flown: Trajectory, axes: Axes | None, name: str) -> None:
    """Raise `FlightError` if the third axis is shown not to point up; warn if the path leaves it open."""
    turns = flown.rotation.as_matrix()
    mean = turns.mean(axis=0)
    kept = np.linalg.norm(mean, axis=1)  # of each axis of the frame, in the axes of the body
    axes_of_turn, strength, _ = np.linalg.svd(mean)
    spread_m = flown.position_m.std(axis=0)
    steps_m = np.diff(flown.position_m, axis=0)
    way_m = float(np.linalg.norm(steps_m, axis=1).sum())
    if way_m == 0:
        return
    ahead = np.abs(np.einsum("nij,ni->j", turns[:-1], steps_m)) / way_m
    share = float(spread_m[2] / np.linalg.norm(spread_m))
    looks = share >= _ALONG and ahead[2] >= _AHEAD
    loops = share >= _ALONG and ahead[0] >= _AHEAD
    # 0.7: a body that turns by 45 degrees (rms): its axis is known well, and may lie less off, 18 degrees
    is_around = strength[1] < 0.7
    # 0.2: any body turns by 40 degrees (rms) about another axis than the third
    is_tilted = strength[0] - kept[2] > (_TILTED if is_around else 0.2)
    off_deg = _between_deg(axes_of_turn[:, 0], np.array([0.0, 0.0, 1.0]))
    is_pitched = (
        _PITCHED_DEG[0] < off_deg < _PITCHED_DEG[1]
        and strength[0] - strength[1] > _LOOKING
        and _lies_across(flown.position_m, axes_of_turn[:, 0])
    )
    if (looks and kept[1] - kept[2] > _LOOKING) or (is_tilted and not loops) or is_pitched:
        # 0.9: cosine of an axis of turning with the second axis
        is_second = not is_pitched and (abs(float(axes_of_turn[1, 0])) > 0.9 or (looks and not is_around))
        mend = "turn the frame first, or say --axes up if it is right"
        if is_second and axes is None:
            mend = "say --axes camera (as of ORB-SLAM)"
        about = "the second axis" if is_second else f"an axis {off_deg:.0f} degrees off the third"
        raise FlightError(
            f"{name}: the body turns about {about} of the frame, so its third axis does not point up: {mend}; "
            "quaternions are in the order qx qy qz qw"
        )
    # 0.1: share of the second axis in the spread of a path before a front, or level for a camera
    is_flat = share >= _ALONG and spread_m[1] < 0.1 * np.linalg.norm(spread_m)
    # 0.9 of a body that does not turn
    if axes is None and ((is_flat and strength[2] > 0.9) or (loops and (is_flat or is_tilted))):
        message = (
            f"{name}: the path lies along the third axis, which is read as up, since the body does not turn or loops; "
            "if that axis points ahead, as in the axes of a camera, say --axes camera"
        )
        warnings.warn(message, stacklevel=3)


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
        Text, or gzipped text, which is known by its first bytes. Lines that begin with "#" and empty lines are skipped.
        `MOST_BYTES` of unpacked text and `MOST_POSES` are read at most.
    axes : {"up", "camera"}, optional
        Axes of the file: third axis up, or right, down and ahead of a camera, as KITTI and ORB-SLAM have them. By
        default third axis up; a path that shows another is refused (`sasgeo_bench.flights.trajectory`).

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
