# SPDX-License-Identifier: Apache-2.0
"""Flights out of files: GPX, KML, tables, TUM, logs of autopilots; brought onto a region and cut to it."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CameraError, FlightError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import plain
from sasgeo_bench.flights.drift_profile import DriftProfile, list_profiles, load_profile, read_drift_profile
from sasgeo_bench.flights.gnss import SecondReceiver, second_receiver
from sasgeo_bench.flights.log_bags import BAGS, is_bag, read_bag
from sasgeo_bench.flights.log_dataflash import read_dataflash
from sasgeo_bench.flights.log_points import MOST_POINTS, FlightLog, read_gpx, read_kml, steps_m
from sasgeo_bench.flights.log_subtitles import read_srt
from sasgeo_bench.flights.log_table import read_csv
from sasgeo_bench.flights.log_telemetry import read_tlog
from sasgeo_bench.flights.log_ulog import read_ulog
from sasgeo_bench.flights.log_units import LOWEST_M, SPEED_MPS, LogFacts, check_within
from sasgeo_bench.flights.own_odometry import OwnOdometry, read_own
from sasgeo_bench.flights.plans import MARGIN_M, SHORTEST_M, flight_area
from sasgeo_bench.flights.trajectory import Trajectory, read_tum
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.geometry.projection import from_lonlat
from sasgeo_bench.regions.region import Manifest, Region
from sasgeo_bench.sensing.dem import read_dem

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_TUM: Final = (".tum", ".txt", ".tum.gz", ".txt.gz")
_READERS: Final = MappingProxyType(
    {
        ".gpx": read_gpx,
        ".kml": read_kml,
        ".kmz": read_kml,
        ".srt": lambda path: read_srt(path).log,
        ".ulg": read_ulog,
        ".bin": read_dataflash,
        ".log": read_dataflash,
    }
)
_TABLES: Final = (".csv", ".pos")
_TELEMETRY: Final = ".tlog"
SUFFIXES: Final = (*_READERS, _TELEMETRY, *BAGS, *_TABLES, *_TUM)
SHORTEST_FLOWN_M: Final = 200.0  # of a flight whose views are drawn: five or so
_GROUND_CELL_M: Final = 10.0  # of heights of the ground
OdometryOf = Literal["log", "drawn"]
ODOMETRY_OF: Final = ("log", "drawn")
MOST_GAP_S: Final = 10.0  # between points of a log: over longer ones the place of the drone is unknown

_FAR_M: Final = 1e9  # where a projection ends: outside of every region


def read_log(path: Path, facts: LogFacts | None = None, *, height_m: float | None = None) -> FlightLog:
    """Read a log by its suffix (GPX, KML, SRT, CSV, .pos); raise `FlightError` if it is not sound, or of another kind.

    `facts` say what a table does not; what they say of a file without it is refused. A line drawn in KML has no times:
    `read_flight` flies it at an even speed. A `height_m` replaces the log's heights. Logs of autopilots are read by
    their suffixes, too (`SUFFIXES`), and so are folders of bags of ROS 2.

    >>> import tempfile
    >>> line = "<coordinates>9.52,47.14,80 9.53,47.15,80</coordinates><altitudeMode>relativeToGround</altitudeMode>"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "line.kml")
    ...     _ = path.write_text(f"<kml><LineString>{line}</LineString></kml>")
    ...     log = read_log(path)
    >>> log.lat_deg.tolist(), log.height_m.tolist(), log.time_s
    ([47.14, 47.15], [80.0, 80.0], None)
    """
    check_within("--height", height_m)
    facts = facts or LogFacts()
    if sum(item is not None for item in (height_m, facts.takeoff_m, facts.dem)) > 1:
        raise FlightError("heights come from one source: give --height, --dem or --takeoff-height alone")
    log = _read(path, facts, has_height=height_m is not None)
    if facts.speed_mps is not None and log.time_s is not None:
        raise _meaningless(path, "has times", "--speed-mps")
    if height_m is None:
        return log
    heights_m, where = np.full(len(log), height_m), "throughout"
    if log.height_m is not None and (is_flown := log.height_m >= LOWEST_M).any() and not is_flown.all():
        # Where the log itself has the drone on the ground, it flew at no height that anyone says
        heights_m, where = np.where(is_flown, height_m, log.height_m), f"where its own is {LOWEST_M:g} m at least"
    notes = (*log.notes, f"height: {height_m:g} m {where}, as --height says")
    return replace(log, height_m=heights_m, notes=notes)


def read_places(path: Path, *, vehicle: int | None = None) -> Floats:
    """Return longitude and latitude of the points of a log, shape (N, 2); what else it holds needs no unit."""
    facts = LogFacts(vehicle=vehicle)
    if path.suffix.lower() in _TABLES:
        facts = replace(facts, time_unit="none", height_unit="none", angle_unit="none")
    log = read_log(path, facts)
    return np.column_stack([log.lon_deg, log.lat_deg])


def _read(path: Path, facts: LogFacts, *, has_height: bool) -> FlightLog:
    suffix = path.suffix.lower()
    reader = read_bag if is_bag(path) else _READERS.get(suffix)
    is_table, is_telemetry = suffix in _TABLES, suffix == _TELEMETRY
    if reader is None and not is_table and not is_telemetry:
        raise FlightError(f"{path.name or path} is no flight log that is read: {', '.join(SUFFIXES)} are")
    if facts.axes is not None:
        raise _meaningless(path, "is no TUM file", "--axes")
    if facts.vehicle is not None and not is_telemetry:
        raise _meaningless(path, "is no telemetry log", "--vehicle")
    if is_table:
        # What is not read has no unit to be asked for.
        return read_csv(path, replace(facts, height_unit="none") if has_height else facts)
    facts.check_untold(path)
    return read_tlog(path, vehicle=facts.vehicle) if reader is None else reader(path)


def _meaningless(path: Path, why: str, option: str) -> FlightError:
    return FlightError(f"{path.name} {why}: leave out {option}")


def read_poses(path: Path, facts: LogFacts | None = None, *, height_m: float | None = None) -> Trajectory:
    """Read a TUM file as `read_log` reads logs, with its axes and the height that is kept."""
    check_within("--height", height_m)
    facts = facts or LogFacts()
    facts.check_untold(path)
    if facts.speed_mps is not None:
        raise _meaningless(path, "has times", "--speed-mps")
    if facts.takeoff_m is not None or facts.dem is not None:
        raise _meaningless(path, "has heights", "--dem and --takeoff-height")
    flown = read_tum(path, axes=facts.axes)
    return flown if height_m is None else _at_height(flown, height_m)


def is_tum(path: Path) -> bool:
    """Return whether a file is a trajectory of poses, by its suffix."""
    return path.name.lower().endswith(_TUM)


def read_flight(
    path: Path,
    region: Region,
    *,
    margin_m: float = MARGIN_M,
    least_m: float = SHORTEST_M,
    height_m: float | None = None,
    facts: LogFacts | None = None,
    step_s: float = 0.2,
) -> Trajectory:
    r"""Read a flight log and return its longest stretch inside a region.

    Parameters
    ----------
    path : Path
        GPX, KML, SRT of a DJI, CSV, positions of RTKLIB (.pos), or TUM (.tum, .txt), whose positions are easting,
        northing and height of the region's CRS.
    region : Region
        The stretch lies over its mapped ground.
    margin_m : float
        Least distance from ground that is not mapped, metres.
    least_m : float
        Shortest stretch that is taken, metres.
    height_m : float, optional
        Height above the ground that is kept in the air, 5 to 10,000 m; it replaces the heights in the log.
    facts : LogFacts, optional
        What the file does not say: units of a table, axes of a TUM file, the speed of a log without times (10 m/s).
    step_s : float
        Seconds between poses.

    Returns
    -------
    Trajectory
        In the region's CRS, heights above the ground or the place of take-off; time counts from the first point. Yaw is
        from grid north. A log without a heading points along its course, and is level.

    Raises
    ------
    FlightError
        If the file is not sound, has no heights and none is given, or leaves the region.

    Notes
    -----
    Places are linear between the points of the log, attitudes take the shortest turn. A gap of more than 10 s between
    points ends a stretch, and so does a height of less than 5 m: take-off and landing are left out.

    Examples
    --------
    A flight due east across an embedded town, from edge to edge; true east is 88 degrees from grid north there:

    >>> import tempfile
    >>> from sasgeo_bench.regions.build import build_region, plan_build
    >>> from sasgeo_bench.regions.region_files import read_region
    >>> from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
    >>> with tempfile.TemporaryDirectory() as out:
    ...     spec = read_region_file(find_region_file("town-suburb"))
    ...     _ = build_region(plan_build(spec, out=Path(out)))
    ...     region = read_region(Path(out) / "regions" / "town-suburb")
    ...     west, south, east, north = region.manifest.bounds_lonlat
    ...     path = Path(out) / "flight.csv"
    ...     _ = path.write_text(f"lat,lon\n{(south + north) / 2},{west}\n{(south + north) / 2},{east}\n")
    ...     flown = read_flight(path, region, height_m=100.0, least_m=500.0)
    >>> round(flown.distance_m[-1] / 100), round(np.mean(flown.yaw_deg))
    (8, 88)
    """
    cut = _Cut(margin_m=margin_m, least_m=least_m, height_m=height_m, facts=facts, step_s=step_s)
    return _over(None if is_tum(path) else read_log(path, facts, height_m=height_m), path, region, cut)


@dataclass(frozen=True, kw_only=True)
class _Cut:
    """How a log is cut to a region, as `read_flight` says."""

    margin_m: float
    least_m: float
    height_m: float | None
    facts: LogFacts | None
    step_s: float = 0.2

    def __post_init__(self) -> None:
        check_within("--least-m", self.least_m)
        check_within("--margin-m", self.margin_m)
        if not (math.isfinite(self.step_s) and self.step_s > 0):
            raise FlightError(f"step_s must be positive, got {self.step_s!r}")


def _over(log: FlightLog | None, path: Path, region: Region, cut: _Cut) -> Trajectory:
    facts, step_s = cut.facts, cut.step_s
    if log is None:
        logged = read_poses(path, facts, height_m=cut.height_m)
    else:
        for line in (*log.notes, *gaps_of(log.time_s)):
            tell(line)
        _check_near(log, path, region)
        logged = _on_grid(log, path, region.manifest, facts or LogFacts())
    flown = _resampled(logged, path, step_s)
    if cut.height_m is not None:  # between a point on the ground and one in the air nothing climbs through that height
        flown = _at_height(flown, np.where(flown.position_m[:, 2] >= LOWEST_M, cut.height_m, flown.position_m[:, 2]))
    is_known = np.ones(len(flown) - 1, dtype=bool)
    if log is None or log.time_s is not None:
        is_known = ~_in_gaps(flown.time_s, logged.time_s)
    if log is not None and log.yaw_deg is None:
        flown = _along_course(flown, step_s)
    return _longest_inside(flown, is_known, path, region, cut.margin_m, cut.least_m)


@dataclass(frozen=True, kw_only=True)
class FlownPath:
    """The log of a flight that was flown, and what it does not say; `read_flight` says what each means.

    `odometry` is that of the log where no receiver was fused into it, or `drawn` by a profile all the way; `topic` has
    it in a bag whose messages do not say what they fused. `drift` names the profile by which it is drawn and its noise
    is declared: one that comes with the package, or a file.
    """

    file: Path
    facts: LogFacts = field(default_factory=LogFacts)
    height_m: float | None = None
    least_m: float = SHORTEST_FLOWN_M
    odometry: OdometryOf = "log"
    topic: str | None = None
    drift: str | None = None

    def __post_init__(self) -> None:
        if not self.file.is_file() and not is_bag(self.file):
            raise FlightError(f"there is no flight log {self.file}: check the path")
        if self.odometry not in ODOMETRY_OF:
            raise FlightError(f"--odometry is one of {', '.join(ODOMETRY_OF)}, got {self.odometry!r}")
        if self.topic is not None and (self.odometry == "drawn" or not is_bag(self.file)):
            raise FlightError(f"--topic is of the odometry of a bag, and {self.file.name} gives none: leave it out")

    @cached_property
    def key(self) -> str:
        """Return the hash of all that the path follows from."""
        logs = sorted(self.file.iterdir()) if self.file.is_dir() else [self.file]
        files = [*map(sha256_of, logs), None if self.facts.dem is None else sha256_of(self.facts.dem)]
        asked = [*files, self.file.name, asdict(self.facts) | {"dem": None}, self.height_m, self.least_m]
        asked += [self.odometry, self.topic, None if self.profile is None else self.profile.model_dump()]
        return hashlib.sha256(json.dumps(asked).encode()).hexdigest()

    @cached_property
    def log(self) -> FlightLog | None:
        """The points of the log; None of a file of poses."""
        return None if is_tum(self.file) else read_log(self.file, self.facts, height_m=self.height_m)

    @property
    def start_s(self) -> float | None:
        """When the log begins, seconds since 1970, UTC; None where it does not tell."""
        return None if self.log is None else self.log.start_s

    @cached_property
    def profile(self) -> DriftProfile | None:
        """The profile of drift that `drift` names; None where it names none."""
        if self.drift is None or self.drift in list_profiles():
            return None if self.drift is None else load_profile(self.drift)
        return read_drift_profile(Path(self.drift))

    def own_odometry(self) -> OwnOdometry:
        """Return the log's own odometry; raise `FlightError` that says why it has none that fused no GNSS."""
        if self.odometry == "drawn":
            raise FlightError("--odometry drawn says so")
        if self.log is None:
            raise FlightError(f"{self.file.name} has poses, and no odometry beside them")
        if self.log.yaw_deg is None and self.log.clock_s is not None:
            raise FlightError(f"{self.file.name} has no attitudes, so that its heading is that of its course")
        return read_own(self.file, clock_s=self.log.clock_s or 0.0, vehicle=self.facts.vehicle, topic=self.topic)

    def second_receiver(self) -> SecondReceiver:
        """Return a weaker receiver of the log beside that of the truth; raise `FlightError` that says why none is."""
        if self.log is None or self.log.clock_s is None:
            raise FlightError(f"{self.file.name} has no second receiver")
        return second_receiver(self.file, clock_s=self.log.clock_s, vehicle=self.facts.vehicle)

    def over(self, region: Region, *, margin_m: float) -> Trajectory:
        """Return the longest stretch over a region, as `read_flight` does."""
        cut = _Cut(margin_m=margin_m, least_m=self.least_m, height_m=self.height_m, facts=self.facts)
        return _over(self.log, self.file, region, cut)


def _check_near(log: FlightLog, path: Path, region: Region) -> None:
    """Raise `FlightError` if a log lies all beside a region, on one side of it: far off a CRS tells no metres."""
    west, south, east, north = region.manifest.bounds_lonlat
    lon, lat = log.lon_deg, log.lat_deg
    if lon.max() < west or lon.min() > east or lat.max() < south or lat.min() > north:
        message = (
            f"{path.name} lies elsewhere, at latitude {lat.min():.4f} to {lat.max():.4f}, longitude {lon.min():.4f} to "
            f"{lon.max():.4f} degrees, and {region.manifest.id} at latitude {south:.4f} to {north:.4f}, longitude "
            f"{west:.4f} to {east:.4f}: take another region{_hint(log, region)}"
        )
        raise FlightError(plain(message))


def _hint(log: FlightLog, region: Region) -> str:
    """Return what a log beside a region may have wrong, if the middle of its points lies on it otherwise."""
    west, south, east, north = region.manifest.bounds_lonlat
    lon, lat = float(np.median(log.lon_deg)), float(np.median(log.lat_deg))
    if west <= lat <= east and south <= lon <= north:
        return ", or mend the log, whose longitude and latitude seem to be swapped"
    if west <= math.degrees(lon) <= east and south <= math.degrees(lat) <= north:
        return ", or say --place-unit rad, as its places seem to be in radians"
    return ""


def _above_ground(log: FlightLog, path: Path, en_m: Floats, manifest: Manifest, facts: LogFacts) -> Floats | None:
    """Return heights above the ground of the points of a log, shape (N,); 0 beside the ground that is known."""
    if facts.takeoff_m is None and facts.dem is None:
        return log.height_m
    if log.altitude_m is None:
        raise FlightError(f"{path.name} has no altitude, from which --dem and --takeoff-height count: leave them out")
    if log.altitude_of == "ellipsoid":
        raise FlightError(
            f"altitudes of {path.name} count from the ellipsoid, where --dem and --takeoff-height do from the sea: say "
            "--height"
        )
    tell(f"heights: altitudes of {plain(path.name)}, taken to be above the sea, less those of the ground")
    if facts.dem is None:
        return log.altitude_m - (facts.takeoff_m or 0.0)
    grid = Grid.from_bounds(*manifest.bounds_m, cell_size_m=_GROUND_CELL_M, epsg=manifest.epsg)
    try:
        ground_m = read_dem(facts.dem, grid).heights_m(en_m)
    except CameraError as error:
        raise FlightError(str(error)) from error
    return np.nan_to_num(log.altitude_m - ground_m, nan=0.0)


def _on_grid(log: FlightLog, path: Path, manifest: Manifest, facts: LogFacts) -> Trajectory:
    """Return the points of a log in a map's CRS; without a heading yaw is 0."""
    epsg = manifest.epsg
    en_m = np.stack(from_lonlat(epsg).transform(log.lon_deg, log.lat_deg), axis=1)
    en_m = np.nan_to_num(en_m, nan=_FAR_M, posinf=_FAR_M, neginf=-_FAR_M)
    up_m = _above_ground(log, path, en_m, manifest, facts)
    if up_m is not None and (highest_m := float(up_m.max())) < LOWEST_M:
        raise FlightError(
            f"{path.name} never leaves the ground: {highest_m:.1f} m above it at most, {LOWEST_M:g} m are needed: take "
            "another log, or say a height, as in --height 100"
        )
    if up_m is None:
        why = "" if log.altitude_m is None else ", and its altitudes do not count from there"
        more = "" if log.altitude_m is None else ", or that of the ground by --dem or --takeoff-height"
        raise FlightError(f"{path.name} has no height above the ground{why}: say one, as in --height 100{more}")
    time_s = log.time_s
    if time_s is None:
        time_s = np.append(0.0, np.cumsum(steps_m(log.lon_deg, log.lat_deg))) / (facts.speed_mps or SPEED_MPS)
    if log.yaw_deg is None:
        return Trajectory.of_angles(time_s=time_s, position_m=np.column_stack([en_m, up_m]), yaw_deg=np.zeros(len(log)))
    # A bearing in the grid is one from true north less the meridian convergence.
    convergence = pyproj.Proj(f"EPSG:{epsg}").get_factors(log.lon_deg, log.lat_deg).meridian_convergence
    return Trajectory.of_angles(
        time_s=time_s,
        position_m=np.column_stack([en_m, up_m]),
        yaw_deg=log.yaw_deg - np.nan_to_num(convergence, nan=0.0, posinf=0.0, neginf=0.0),
        pitch_deg=0.0 if log.pitch_deg is None else log.pitch_deg,
        roll_deg=0.0 if log.roll_deg is None else log.roll_deg,
    )


def _at_height(flown: Trajectory, height_m: float | Floats) -> Trajectory:
    position_m = np.column_stack([flown.position_m[:, :2], np.broadcast_to(height_m, len(flown))])
    return Trajectory(time_s=flown.time_s, position_m=position_m, quaternion_xyzw=flown.quaternion_xyzw)


def _resampled(flown: Trajectory, path: Path, step_s: float) -> Trajectory:
    if len(flown) < 2:  # a way
        raise FlightError(f"{path.name}: a flight has two poses at least, got {len(flown)}")
    first_s, last_s = float(flown.time_s[0]), float(flown.time_s[-1])
    count = math.floor((last_s - first_s) / step_s) + 1
    if count < 2:  # a way
        raise FlightError(
            f"{path.name} lasts {last_s - first_s:g} s, less than one step of {step_s:g} s: take a smaller step_s"
        )
    if count > MOST_POINTS:
        lasts = f"{path.name} lasts {last_s - first_s:.0f} s, more than {MOST_POINTS} steps of {step_s:g} s"
        raise FlightError(f"{lasts}: cut it, or take a larger step_s")
    return flown.at(np.minimum(first_s + step_s * np.arange(count), last_s))


def _along_course(flown: Trajectory, step_s: float) -> Trajectory:
    """Return a trajectory that is level and points where it flies; while it hovers, where it flew before."""
    reach = max(1, round(1.0 / step_s))  # 1 s before and after a pose, over which its course is measured
    at = np.arange(len(flown))
    before, after = np.maximum(at - reach, 0), np.minimum(at + reach, len(flown) - 1)
    way_m = flown.position_m[after, :2] - flown.position_m[before, :2]
    moves = np.flatnonzero(np.hypot(*way_m.T) >= 1.0)  # m: a shorter way has no course
    yaw_deg = np.zeros(len(flown))
    if len(moves):
        held = moves[np.maximum(np.searchsorted(moves, at, side="right") - 1, 0)]
        yaw_deg = bearing_deg(*way_m[held].T)
    return Trajectory.of_angles(time_s=flown.time_s, position_m=flown.position_m, yaw_deg=yaw_deg)


def _longest_inside(
    flown: Trajectory, is_known: Bools, path: Path, region: Region, margin_m: float, least_m: float
) -> Trajectory:
    """Return the longest run of known poses inside a region; raise `FlightError` if it is too short."""
    area = flight_area(region, margin_m)
    places_m = flown.position_m[:, :2]
    sides = shapely.linestrings(np.stack([places_m[:-1], places_m[1:]], axis=1))
    is_up = flown.position_m[:, 2] >= LOWEST_M
    is_inside = np.asarray(shapely.covers(area, sides), dtype=bool) & is_known & is_up[:-1] & is_up[1:]
    edges = np.diff(np.concatenate([[0], is_inside, [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    along_m = flown.distance_m
    lengths_m = along_m[ends] - along_m[starts]
    best = int(np.argmax(lengths_m)) if len(lengths_m) else -1
    longest_m = float(lengths_m[best]) if best >= 0 else 0.0
    if best < 0 or longest_m < least_m:
        message = (
            f"{path.name} leaves {region.manifest.id}: of {along_m[-1]:.0f} m the longest stretch over mapped ground, "
            f"{margin_m:.0f} m from its edge and in the air, has {longest_m:.0f} m, {least_m:g} m are needed: take "
            "another region, or a smaller --least-m"
        )
        raise FlightError(plain(message))
    run = slice(starts[best], ends[best] + 1)
    return Trajectory(
        time_s=flown.time_s[run], position_m=flown.position_m[run], quaternion_xyzw=flown.quaternion_xyzw[run]
    )


def gaps_of(time_s: Floats | None) -> tuple[str, ...]:
    """Return a line on the gaps that end stretches, none if there are none.

    >>> gaps_of(np.array([0.0, 1.0, 60.0, 61.0]))
    ('2 stretches: a gap of more than 10 s ends one, the longest has 59.0 s',)
    """
    steps_s = np.diff(time_s if time_s is not None else [])
    count = int((steps_s > MOST_GAP_S).sum())
    if not count:
        return ()
    return (
        f"{count + 1} stretches: a gap of more than {MOST_GAP_S:g} s ends one, the longest has {steps_s.max():.1f} s",
    )


def _in_gaps(time_s: Floats, logged_s: Floats) -> Bools:
    """Return which steps between poses lie in a gap of the log, shape (N - 1,)."""
    is_gap = np.append(np.diff(logged_s) > MOST_GAP_S, [False])  # nothing follows its end
    middle_s = (time_s[:-1] + time_s[1:]) / 2
    return np.asarray(is_gap[np.searchsorted(logged_s, middle_s, side="right") - 1])
