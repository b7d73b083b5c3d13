# SPDX-License-Identifier: Apache-2.0
"""Poses of pictures as tables have them: place, height, attitude and time of each; and what of a table is no pose."""

import math
import warnings
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj.exceptions import CRSError
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import PoseError, counted, named
from sasgeo_bench.core.texts import plain
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.geometry.projection import WGS84, between, to_lonlat, true_north_deg
from sasgeo_bench.sensing.camera import Attitude, Intrinsics

Floats = NDArray[np.float64]
HeightOf = Literal["ground", "take-off", "origin"]
AltitudeOf = Literal["sea", "ellipsoid", "unstated"]
Clock = Literal["utc", "local", "own"]
PitchZero = Literal["down", "horizon"]

FLIGHT_LOG: Final = "flight log"  # the kind of a table whose rows are the photos themselves, joined by time
STRAIGHT_DOWN: Final = "say --poses: a column gimbal_pitch of -90 says straight down"
FARTHEST_M: Final = 50_000.0  # of a row from the median of all: no battery lasts so long
SWAPPED: Final = "whose longitude and latitude are swapped"
_LEVEL_DEG: Final = 85.0  # of tilt: a camera that leans more shows the horizon
_EARTH_M: Final = 6_371_000.0
_ORTHOGONAL: Final = 1e-3  # by which a rotation in a file may be off, from rounding
# Rows of a camera's right, down, ahead in the axes of its body (forward, right, down); and of NED in east, north, up.
_CAMERA_OF_BODY: Final = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
_NED_OF_ENU: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class PicturePose:
    """Where a picture was taken and how, by a table; None for what the table does not say.

    Parameters
    ----------
    name : str
        Of the picture, as the table has it, with "/" between folders.
    place : tuple of float
        Longitude and latitude, degrees, if the CRS is geographic; else easting and northing in its unit.
    epsg : int
        CRS of the place. A place never passes through another datum on its way to a third: use `in_crs`.
    height_m : float, optional
        Above `height_of`: the ground, the place of take-off, or the origin that the user named.
    altitude_m : float, optional
        Above `altitude_of`: the sea, the ellipsoid, or what the table leaves open.
    attitude : Attitude, optional
        Of the camera (forward is the optical axis), against true north.
    heading_deg : float, optional
        Of the picture's up if there is an attitude, else of the drone, degrees clockwise from true north.
    time_s : float, optional
        Seconds since 1970 by UTC or by a local clock whose zone the table does not say, or by a clock of its own.
    sigma_m : float, optional
        Standard deviation of the place along one axis, metres.
    intrinsics : Intrinsics, optional
        Of the camera.

    Examples
    --------
    >>> pose = PicturePose(name="a.jpg", place=(9.0, 47.0), attitude=Attitude(pitch_deg=-60.0, yaw_deg=90.0))
    >>> round(pose.tilt_deg), [round(value) for value in pose.in_crs(32632)]
    (30, [500000, 5205164])
    """

    name: str
    place: tuple[float, float]
    epsg: int = WGS84
    height_m: float | None = None
    height_of: HeightOf = "take-off"
    altitude_m: float | None = None
    altitude_of: AltitudeOf = "unstated"
    attitude: Attitude | None = None
    heading_deg: float | None = None
    time_s: float | None = None
    clock: Clock = "own"
    sigma_m: float | None = None
    intrinsics: Intrinsics | None = None

    @property
    def lonlat(self) -> tuple[float, float]:
        """Return longitude and latitude by WGS 84, degrees."""
        return self.in_crs(WGS84)

    def in_crs(self, epsg: int) -> tuple[float, float]:
        """Return the place in another CRS: easting and northing, or longitude and latitude."""
        if epsg == self.epsg:
            return self.place
        first, second = between(self.epsg, epsg).transform(*self.place)
        return float(first), float(second)

    @property
    def tilt_deg(self) -> float | None:
        """Return the angle between the optical axis and straight down, [0, 180] degrees; None without an attitude."""
        if self.attitude is None:
            return None
        return math.degrees(math.acos(max(-1.0, min(1.0, float(self.attitude.matrix[2, 0])))))


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseFacts:
    """What a table of poses does not say itself.

    Parameters
    ----------
    epsg : int, optional
        CRS of eastings and northings, or of longitudes and latitudes that are not of WGS 84.
    origin : tuple of float, optional
        Longitude, latitude (degrees) and height (metres) of the point around which a model has metres to the east, to
        the north and up.
    pitch_zero : {"down", "horizon"}, optional
        Where a camera looks at pitch 0, in a table of columns that are just called yaw, pitch and roll.
    names : tuple of str
        Pictures of a TUM file, in its order.
    times_s : mapping
        Pictures of a TUM file, and when each was taken by its clock.

    Raises
    ------
    PoseError
        If the CRS is none, the origin is no place, or a frame is given twice.
    """

    epsg: int | None = None
    origin: tuple[float, float, float] | None = None
    pitch_zero: PitchZero | None = None
    names: tuple[str, ...] = ()
    times_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        if self.epsg is not None:
            check_crs(self.epsg)
        if self.epsg is not None and self.origin is not None:
            raise PoseError("a table has one frame: say --epsg or --origin, not both")
        if self.pitch_zero not in (None, "down", "horizon"):
            raise PoseError(f"pitch_zero is down or horizon, got {self.pitch_zero!r}")
        if self.origin is not None:
            lon_deg, lat_deg, height_m = self.origin
            if not (abs(lon_deg) <= 180 and abs(lat_deg) <= 90 and abs(height_m) <= 10_000):
                raise PoseError(f"an origin is longitude, latitude and height in metres, got {self.origin!r}")


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTable:
    """Poses of a table, in its order; and the rows that are none, by reason.

    Parameters
    ----------
    path : Path
        Of the table.
    kind : str
        Format that its content told, as "COLMAP" or "exiftool CSV".
    poses : tuple of PicturePose
        One at least.
    left_out : mapping
        Reason -> names of the rows that are no poses for it.
    notes : tuple of str
        What was read of which column, and what a user should know of it.
    """

    path: Path
    kind: str
    poses: tuple[PicturePose, ...]
    left_out: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return what a user is told: format and count, then each reason with the first few rows, then the notes."""
        start = f"{plain(self.path.name)} ({self.kind}): {counted(len(self.poses), 'pose')}"
        # The rows of a log are the photos themselves, whose reasons are told with those of all pictures.
        rows = {} if self.kind == FLIGHT_LOG else self.left_out
        out = [f"left out: {named([plain(name) for name in names], 'row')} {why}" for why, names in rows.items()]
        return [start, *out, *self.notes]

    def find(self, picture: str | Path) -> PicturePose | None:
        """Return the pose of a picture, by its path; None if the table has none.

        Folders decide between pictures of one name, as far as the table has them: a row of another folder is none.
        Letter case does not count, and a name without a suffix fits any. Raise `PoseError` if two rows fit alike.

        >>> poses = tuple(PicturePose(name=f"{day}/a.JPG", place=(9.0, 47.0)) for day in ("may", "june"))
        >>> PoseTable(path=Path("t.csv"), kind="CSV", poses=poses).find("photos/june/a.jpg").name
        'june/a.JPG'
        """
        parts = _parts(str(picture))
        near = self._by_name.get(parts[-1], []) or self._by_name.get(PurePosixPath(parts[-1]).stem, [])
        above = {at: _parts(self.poses[at].name)[:-1] for at in near}
        near = [at for at in near if not above[at] or not parts[:-1] or above[at][-1] == parts[-2]]
        common = [_common(above[at], parts[:-1]) for at in near]
        best = [at for at, count in zip(near, common, strict=True) if count == max(common)]
        if len(best) > 1:
            raise PoseError(
                f"{plain(str(picture))} may be {plain(self.poses[best[0]].name)} or {plain(self.poses[best[1]].name)} "
                f"of {plain(self.path.name)}: keep the folders that the table names"
            )
        return self.poses[best[0]] if best else None

    def why_not(self, picture: str) -> str:
        """Return why there is no pose of a picture, as in "2 pictures ..."."""
        if self.kind == FLIGHT_LOG:
            return next((why for why, names in self.left_out.items() if picture in names), "that the log does not tell")
        rows = {_parts(name)[-1] for names in self.left_out.values() for name in names}
        is_left_out = _parts(picture)[-1] in rows
        return "whose row is left out" if is_left_out else "that the table does not name, or in another folder"

    @property
    def angles_hint(self) -> str:
        """Return how angles of cameras can be told, of which neither photos nor this table say any."""
        if self.kind == FLIGHT_LOG:
            return f"{plain(self.path.name)} has no headings: name a log that has, or a table with gimbal_pitch"
        return STRAIGHT_DOWN

    @cached_property
    def _by_name(self) -> Mapping[str, list[int]]:
        found: defaultdict[str, list[int]] = defaultdict(list)
        for at, pose in enumerate(self.poses):
            found[_parts(pose.name)[-1]].append(at)
        return found


def _parts(name: str) -> tuple[str, ...]:
    return PurePosixPath(name.casefold()).parts or ("",)


def _common(first: Sequence[str], second: Sequence[str]) -> int:
    """Return how many folders two paths share, counted from the picture."""
    pairs = zip(reversed(first), reversed(second), strict=False)
    return next((at for at, (one, other) in enumerate(pairs) if one != other), min(len(first), len(second)))


@lru_cache(maxsize=64)
def check_crs(epsg: int) -> bool:
    """Return whether a CRS is geographic; raise `PoseError` if it is neither that nor projected.

    >>> check_crs(4326), check_crs(32632)
    (True, False)
    """
    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except CRSError as error:
        raise PoseError(f"EPSG:{epsg} is no CRS that is known: look it up at epsg.io") from error
    if not (crs.is_geographic or crs.is_projected):
        raise PoseError(f"EPSG:{epsg} ({crs.name}) has no longitudes or eastings: take a geographic or projected CRS")
    return bool(crs.is_geographic)


@lru_cache(maxsize=64)
def metres_of_unit(epsg: int) -> float:
    """Return the length of the unit of a projected CRS, metres; 1 if the CRS is geographic, where heights are metres.

    >>> metres_of_unit(32632), round(metres_of_unit(2263), 4)
    (1.0, 0.3048)
    """
    return 1.0 if check_crs(epsg) else float(pyproj.CRS.from_epsg(epsg).axis_info[0].unit_conversion_factor)


def convergence_deg(lonlat: Floats, epsg: int) -> Floats:
    """Return the bearing of true north in the grid of a CRS, shape (N, 2) -> (N,), degrees; 0 if it is geographic.

    >>> convergence_deg(np.array([[10.0, 47.0]]), 32632).round(2).tolist()
    [-0.73]
    """
    if check_crs(epsg):
        return np.zeros(len(lonlat))
    lon_deg, lat_deg = lonlat.T
    return true_north_deg(lon_deg, lat_deg, epsg)


def enu_of_ecef(lon_deg: float, lat_deg: float) -> Floats:
    """Return the rotation from earth-centred axes to east, north, up of a place, shape (3, 3)."""
    lon, lat = math.radians(lon_deg), math.radians(lat_deg)
    sin_lon, cos_lon, sin_lat, cos_lat = math.sin(lon), math.cos(lon), math.sin(lat), math.cos(lat)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def is_rotation(matrix: Floats) -> bool:
    """Return whether a matrix is right-handed and orthogonal, but for rounding: scipy takes any for a rotation."""
    return bool(np.allclose(matrix @ matrix.T, np.eye(3), atol=_ORTHOGONAL) and np.linalg.det(matrix) > 0)


def attitude_of(matrix: Floats) -> Attitude:
    """Return the attitude of a camera by its rotation from (east, north, up) to (right, down, ahead), shape (3, 3).

    Straight down, where yaw and roll are one turn, roll is 0.

    >>> matrix = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # the picture's up is east
    >>> attitude_of(matrix).yaw_deg
    90.0
    """
    turn = _NED_OF_ENU @ matrix.T @ _CAMERA_OF_BODY
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scipy's, of straight down
        yaw_deg, pitch_deg, roll_deg = Rotation.from_matrix(turn).as_euler("ZYX", degrees=True).tolist()
    return Attitude(roll_deg=roll_deg, pitch_deg=pitch_deg, yaw_deg=yaw_deg)


def picture_heading_deg(attitude: Attitude) -> float:
    """Return the heading of a picture's up, degrees from true north in [0, 360).

    >>> picture_heading_deg(Attitude(pitch_deg=-90.0, yaw_deg=30.0, roll_deg=10.0))
    40.0
    """
    north, east, _ = (-attitude.matrix[:, 2]).tolist()
    return round(float(bearing_deg(east, north)), 9) % 360.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFrame:
    """Frame of a model's positions and rotations: a projected CRS, or metres to the east, to the north and up.

    `origin` is longitude, latitude (WGS 84) and height of that point; one of both is given.
    """

    epsg: int | None = None
    origin: tuple[float, float, float] | None = None
    has_height: bool = True  # whether the height of the origin is known

    def poses(
        self, names: Sequence[str], position_m: Floats, matrices: Floats, lenses: Sequence[Intrinsics | None]
    ) -> list[PicturePose]:
        """Return poses; `matrices`, shape (N, 3, 3), turn axes of the frame to a camera's (right, down, ahead)."""
        if not names:
            return []
        if self.origin is None:
            assert self.epsg is not None  # noqa: S101 - one of both is given
            # A model is as high in the unit of its CRS as it is wide.
            places, epsg, up_m = position_m[:, :2], self.epsg, position_m[:, 2] * metres_of_unit(self.epsg)
            lonlat = np.stack(to_lonlat(epsg).transform(*places.T), axis=1)
            turns = [turn_about_up(angle) for angle in convergence_deg(lonlat, epsg).tolist()]
        else:
            lon_deg, lat_deg, height_m = self.origin
            pipeline = (
                f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon_deg!r} +lat_0={lat_deg!r} "
                f"+h_0={height_m!r} +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
            )
            lon, lat, up_m = pyproj.Transformer.from_pipeline(pipeline).transform(
                position_m[:, 0], position_m[:, 1], position_m[:, 2]
            )
            places, epsg = np.stack([lon, lat], axis=1), WGS84
            here = enu_of_ecef(lon_deg, lat_deg)
            turns = [here @ enu_of_ecef(*place).T for place in places.tolist()]
        found = []
        for at, name in enumerate(names):
            attitude = attitude_of(matrices[at] @ turns[at])
            is_up = self.origin is not None and not self.has_height
            found.append(
                PicturePose(
                    name=name,
                    place=(float(places[at, 0]), float(places[at, 1])),
                    epsg=epsg,
                    height_m=float(up_m[at]) if is_up else None,
                    height_of="origin",
                    altitude_m=None if is_up else float(up_m[at]),
                    attitude=attitude,
                    heading_deg=picture_heading_deg(attitude),
                    intrinsics=lenses[at],
                )
            )
        return found


def turn_about_up(angle_deg: float) -> Floats:
    """Return the turn from true (east, north, up) to a grid's, in which true north has a bearing, shape (3, 3)."""
    sine, cosine = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def checked(
    poses: Sequence[PicturePose], left_out: Mapping[str, Sequence[str]]
) -> tuple[tuple[PicturePose, ...], dict[str, tuple[str, ...]]]:
    """Return the poses that can be, and the rows that are left out, by reason, with those that were before.

    A row is no pose if its place is nowhere on earth, at 0, 0, or more than `FARTHEST_M` from the median; if its camera
    looks level or up; or if another row has its name, since nothing says which of both is right.
    """
    reasons: dict[str, list[str]] = {why: list(names) for why, names in left_out.items()}

    def leave(pose: PicturePose, why: str) -> None:
        reasons.setdefault(why, []).append(pose.name)

    counts = Counter(pose.name for pose in poses)
    kept: list[tuple[PicturePose, tuple[float, float]]] = []
    for pose, (lon_deg, lat_deg) in zip(poses, _lonlats(poses), strict=True):
        if counts[pose.name] > 1:
            leave(pose, "share their name with another (keep one row of each)")
        elif not (abs(lon_deg) <= 180 and abs(lat_deg) <= 90):
            # A latitude beyond a pole is a longitude where the other can be a latitude.
            is_swapped = check_crs(pose.epsg) and abs(lon_deg) <= 90 < abs(lat_deg) <= 180
            leave(pose, SWAPPED if is_swapped else "with a place that is nowhere on earth")
        elif lon_deg == 0 == lat_deg:
            leave(pose, "at 0, 0, where no receiver had a fix")
        else:
            kept.append((pose, (lon_deg, lat_deg)))
    good = []
    if kept:
        units = _units(np.array([place for _, place in kept]))
        middle = np.median(units, axis=0)
        middle /= np.linalg.norm(middle) or 1.0
        swapped = _units(np.array([place[::-1] for _, place in kept]))
        far, back = ((np.linalg.norm(one - middle, axis=1) * _EARTH_M > FARTHEST_M) for one in (units, swapped))
        for (pose, _), is_far, is_far_swapped in zip(kept, far, back, strict=True):
            tilt_deg = pose.tilt_deg
            if is_far:
                is_swapped = check_crs(pose.epsg) and not is_far_swapped
                leave(pose, SWAPPED if is_swapped else f"more than {FARTHEST_M / 1000:.0f} km from the others")
            elif tilt_deg is not None and tilt_deg >= _LEVEL_DEG:
                leave(pose, "whose camera looks level or up")
            else:
                good.append(pose)
    return tuple(good), {why: tuple(names) for why, names in reasons.items()}


def _lonlats(poses: Sequence[PicturePose]) -> list[tuple[float, float]]:
    """Return places by WGS 84, transformed at once for each CRS."""
    found: list[tuple[float, float]] = [pose.place for pose in poses]
    for epsg in {pose.epsg for pose in poses} - {WGS84}:
        at = [i for i, pose in enumerate(poses) if pose.epsg == epsg]
        lon, lat = to_lonlat(epsg).transform(*np.array([poses[i].place for i in at]).T)
        for i, place in zip(at, zip(lon.tolist(), lat.tolist(), strict=True), strict=True):
            found[i] = place
    return found


def _units(lonlat: Floats) -> Floats:
    lon, lat = np.radians(lonlat).T
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
