# SPDX-License-Identifier: Apache-2.0
"""Commands about flights: what a log holds, its stretch over a region, and the drift of odometry."""

import datetime as dt
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from rich.table import Table

from sasgeo_bench.cli.console import print_table, said_after, say
from sasgeo_bench.cli.options import ExtractFolders, Options, Out, OwnRegionFolders, takes
from sasgeo_bench.core.errors import FlightError, counted
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.parquet import write_frame
from sasgeo_bench.core.progress import reporting, silent, tell
from sasgeo_bench.flights.drift import LOST_S, PairedRun, fit_profile, measure_drift, pair_run
from sasgeo_bench.flights.drift_profile import write_drift_profile
from sasgeo_bench.flights.log_odometry import LoggedRuns, read_runs
from sasgeo_bench.flights.log_points import FlightLog, steps_m
from sasgeo_bench.flights.log_units import SPEED_MPS, AngleUnit, HeightUnit, LogFacts, PlaceUnit, TimeUnit
from sasgeo_bench.flights.logs import SHORTEST_FLOWN_M, FlownPath, OdometryOf, gaps_of, is_tum, read_log, read_poses
from sasgeo_bench.flights.plans import MARGIN_M
from sasgeo_bench.flights.trajectory import Axes, Trajectory, read_tum, write_tum
from sasgeo_bench.regions.region_files import MANIFEST, read_manifest, read_region
from sasgeo_bench.scoring.gnss_check import IN_A_ROW, SHARE, SIGMA_M, Monitor, check_gnss, summary
from sasgeo_bench.tasks.query import TRUTH_SIGMA, PriorGroup
from sasgeo_bench.tasks.task_files import TASK, Task

AxesFlag = Annotated[
    Axes | None,
    typer.Option(help="axes of TUM files: up (third axis up), or camera (right, down, ahead: KITTI, ORB-SLAM)"),
]
OdometryFlag = Annotated[
    OdometryOf,
    typer.Option(
        help="of the flight: that of its log where this fused no GNSS, or drawn by a profile of drift (drawn)"
    ),
]
DriftFlag = Annotated[
    str | None,
    typer.Option(
        help="profile of drift that the odometry of the flight declares, and is drawn by: a file of measure-drift "
        "--profile, or a name, as vio-mono; default: that of the suite"
    ),
]
VehicleFlag = Annotated[int | None, typer.Option(help="system id of the vehicle in a .tlog of several")]


@dataclass(frozen=True, kw_only=True)
class FlightOptions(Options):
    """Flags of `import-flight`."""

    file: Annotated[
        Path,
        typer.Argument(
            help="GPX, KML, KMZ, SRT, CSV, RTKLIB .pos, ULog, DataFlash, .tlog, bag, MCAP, or TUM in the region's CRS"
        ),
    ] = field(kw_only=False)
    region: Annotated[
        str | None, typer.Option(help="region that was flown over: id, or own file; its queries are drawn")
    ] = None
    suite: Annotated[str, typer.Option(help="suite of flights whose views are drawn along it")] = "flight-clean"
    prior: Annotated[
        str | None,
        typer.Option(help="prior group, as in r500-weak-s3, of flights also gnss; default: that of the suite"),
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="public random seed")] = 0
    extracts: ExtractFolders = None
    region_files: OwnRegionFolders = None
    out: Out = Path("out")
    tum: Annotated[Path | None, typer.Option(help="TUM file to write the stretch over the region into")] = None
    height: Annotated[
        float | None, typer.Option("--height", "--height-m", help="above the ground, metres, instead of the log's")
    ] = None
    dem: Annotated[Path | None, typer.Option(help="heights of the ground above the sea, a GeoTIFF")] = None
    takeoff_height: Annotated[float | None, typer.Option(help="altitude of the place of take-off, metres")] = None
    least_m: Annotated[
        float | None, typer.Option(help=f"shortest stretch that is taken, metres; default: {SHORTEST_FLOWN_M:g}")
    ] = None
    speed_mps: Annotated[
        float | None, typer.Option(help=f"even speed of a log without times, m/s; default: {SPEED_MPS:g}")
    ] = None
    time_unit: Annotated[
        TimeUnit | None, typer.Option(help="of times whose column does not name it; none: no column is the time")
    ] = None
    height_unit: Annotated[
        HeightUnit | None, typer.Option(help="of heights whose column does not name it; none: do not read them")
    ] = None
    angle_unit: Annotated[
        AngleUnit | None,
        typer.Option(help="of yaw, pitch and roll (cdeg: 0.01 degrees); none: do not read them"),
    ] = None
    place_unit: Annotated[PlaceUnit | None, typer.Option(help="of latitude and longitude (e7: 1e-7 degrees)")] = None
    axes: AxesFlag = None
    vehicle: VehicleFlag = None
    odometry: OdometryFlag = "log"
    drift: DriftFlag = None
    topic: Annotated[str | None, typer.Option(help="topic of a bag with odometry that fused no GNSS")] = None

    @property
    def facts(self) -> LogFacts:
        """Return what the file does not say."""
        return LogFacts(
            time_unit=self.time_unit,
            height_unit=self.height_unit,
            angle_unit=self.angle_unit,
            place_unit=self.place_unit,
            axes=self.axes,
            speed_mps=self.speed_mps,
            vehicle=self.vehicle,
            takeoff_m=self.takeoff_height,
            dem=self.dem,
        )

    @property
    def flown(self) -> FlownPath:
        """Return the flight."""
        least_m = SHORTEST_FLOWN_M if self.least_m is None else self.least_m
        return FlownPath(
            file=self.file,
            facts=self.facts,
            height_m=self.height,
            least_m=least_m,
            odometry=self.odometry,
            topic=self.topic,
            drift=self.drift,
        )


@takes(FlightOptions)
def import_flight(options: FlightOptions) -> tuple[Path, ...]:
    """Read the log of a flight, say what was read of which columns in which units, and draw its queries on a region.

    Views are drawn from the map along the longest stretch over it, in the order in which they were flown; the truth is
    the log. `run` and `score` work as on any task of flights.

    Returns
    -------
    tuple of Path
        Task folders, `out/tasks/<suite>/<region>`; none without a region.

    Raises
    ------
    ConfigError
        If there is no such suite or region, or what the flight sees cannot be asked.
    ExtractError
        If the region cannot be built since its extract is missing.
    FlightError
        If the log is not sound, needs a unit, has no height, or leaves the region.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.import_flight("nowhere.gpx", region="vaduz")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.FlightError: there is no flight log nowhere.gpx: check the path
    """
    _check_outputs([options.file], [options.tum] if options.tum else [])
    if options.region is None:
        for name in ("tum", "least_m", "dem", "takeoff_height", "topic", "odometry", "drift", "prior"):
            if getattr(options, name) not in (None, "log"):
                raise FlightError(f"--{name.replace('_', '-')} needs --region: it is about the stretch over a region")
        if is_tum(options.file):
            poses = read_poses(options.file, options.facts, height_m=options.height)
            options.say("\n".join((_summary(poses), *gaps_of(poses.time_s))))
        else:
            log = read_log(options.file, options.facts, height_m=options.height)
            for line in _lines(log, options.speed_mps or SPEED_MPS):
                options.say(line)
        return ()
    # Half a second, which who only asks what a log holds need not wait for.
    from sasgeo_bench.tasks.build import made_tasks, make_tasks  # noqa: PLC0415
    from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests  # noqa: PLC0415

    flown = options.flown
    built = Path(options.region, MANIFEST)
    wanted = TaskRequest(
        suites=(options.suite,),
        regions=(read_manifest(built.parent).id if built.is_file() else options.region,),
        count=1,
        seed=options.seed,
        group=PriorGroup.parse(options.prior) if options.prior else None,
        extract_folders=tuple(options.extracts or ()),
        region_folders=tuple(options.region_files or ()),
        out=options.out,
        flown=flown,
    )
    (request,) = plan_requests(wanted)
    suite = request.found
    before = options.out / "tasks" / request.suite / request.region.id
    is_other = (before / TASK).is_file() and made_tasks(request) is None
    tasks = make_tasks(request)
    if is_other:
        tell(f"{before} held the queries of another flight or request: they are replaced (another --out keeps both)")
    kinds = ", ".join(dict.fromkeys(f"{truth.kind} ({truth.role})" for task in tasks for truth in task.truths))
    tell(f"the flight is asked once for each of: {kinds}")
    if not suite.is_pictured:
        tell(f"views of {request.suite} are {suite.main_side_m:g} m wide, whatever the height of the flight")
    for task in tasks:
        options.say(task.folder)
    if options.tum is not None:
        region = read_region(options.out / "regions" / request.region.id, with_layers=False)
        with reporting(silent):  # its lines were told before
            stretch = flown.over(region, margin_m=MARGIN_M)
        write_tum(stretch, options.tum)
        tell(f"wrote {options.tum}: {_summary(stretch)}")
    return tuple(task.folder for task in tasks)


def import_flight_command(options: FlightOptions) -> None:
    """Read the log of a flight and say what was read, in which units; draw its queries on a region."""
    with said_after() as say_later:
        import_flight(**vars(options) | {"say": say_later})


@dataclass(frozen=True, kw_only=True)
class GnssOptions(Options):
    """Flags of `check-gnss`."""

    run: Annotated[Path, typer.Argument(help="folder of a tracker's run on tasks of flights")] = field(kw_only=False)
    pull_off: Annotated[
        str, typer.Option(metavar="M/S,M/S,...", help="speeds at which the receiver's place leaves the true one")
    ] = "0.2,0.5,1,2"
    sigma: Annotated[float, typer.Option(help="standard deviation of the receiver's places, metres")] = SIGMA_M
    in_a_row: Annotated[int, typer.Option(help="accepted fixes that must disagree for an alarm")] = IN_A_ROW
    seed: Annotated[int, typer.Option(min=0, help="of noise and directions")] = 0
    out: Out = Path("out")


def check_gnss_command(options: GnssOptions) -> None:
    """Say how soon fixes on the map notice that a receiver is led astray, and how often they are wrong about it."""
    from sasgeo_bench.boards.run_cases import read_run_cases  # noqa: PLC0415 - a second, as above

    monitor = Monitor(sigma_m=options.sigma, in_a_row=options.in_a_row)
    speeds_mps = _positive(options.pull_off, "--pull-off", "0.5,2", "metres a second")
    cases = read_run_cases(options.run, out=options.out, split=None)
    if not cases.flights:
        raise FlightError(f"{options.run} has no flights: name a run of a tracker on a task of flights")
    table = Table(
        *("suite", "region", "flights", "paths", "hours", "fixes", "false alarms / h", "at most (95 %)"),
        *("pull-off, m/s", "noticed", "after s: p50", "p95"),
        box=None,
        pad_edge=False,
    )
    for (suite, region), found in cases.flights.items():
        task = Task.open(cases.root / "tasks" / suite / region, cases.root)
        is_own = task.manifest.strength_unit == TRUTH_SIGMA
        groups = dict(tuple(found.views.groupby("sequence_id", sort=True)))
        sites = found.flights.set_index("query_id")["pair_id"]
        for speed_mps in speeds_mps:
            checks = [
                check_gnss(
                    views,
                    cases.predictions,
                    monitor=monitor,
                    pull_mps=speed_mps,
                    draws_noise=not is_own,
                    seed=options.seed + number,
                )
                for number, views in enumerate(groups.values())
            ]
            figures = summary(checks, [str(sites[name]) for name in groups])
            fixes = sum(one.fixes for one in checks)
            times_s = (figures["notice_p50_s"], figures["notice_p95_s"])
            table.add_row(
                *(suite, region, str(len(groups)), str(figures["paths"]), f"{figures['hours']:.2g}", str(fixes)),
                *(f"{figures['alarms_per_hour']:.2f}", f"{figures['alarms_per_hour_at_most']:.2f}", f"{speed_mps:g}"),
                f"{figures['noticed']:.0%}",
                *("never" if time == math.inf else f"{time:.0f}" for time in times_s),
            )
        whose = "the truths are the receiver's own places" if is_own else f"the receiver is off by {options.sigma:g} m"
        alarm = f"an alarm is {options.in_a_row} accepted fixes in a row outside of the ellipse of {SHARE:.1%}"
        once = "; flights along one path count as one in hours and bound" if len(groups) > len(set(sites)) else ""
        tell(f"{suite} on {region}: {whose}; {alarm}{once}")
    print_table(table)


@dataclass(frozen=True, kw_only=True)
class DriftOptions(Options):
    """Flags of `measure-drift`."""

    logs: Annotated[
        list[Path] | None,
        typer.Argument(help="logs: ULog, DataFlash, .tlog, bags; instead of --truth and --estimate"),
    ] = None
    truth: Annotated[
        list[Path] | None, typer.Option(help="true trajectory, TUM format, plain or gzipped; may be repeated")
    ] = None
    estimate: Annotated[
        list[Path] | None, typer.Option(help="estimate of it; one for each --truth, in the same order")
    ] = None
    lengths_m: Annotated[
        str | None,
        typer.Option(metavar="M,M,...", help="lengths of segments, metres of path; default: 10,50; of logs 100,500"),
    ] = None
    lost_s: Annotated[float, typer.Option(min=0, help="seconds without a pose that are a lost stretch")] = LOST_S
    axes: AxesFlag = None
    vehicle: VehicleFlag = None
    topic: Annotated[str | None, typer.Option(help="topic of a bag with poses that fused no GNSS")] = None
    results: Annotated[Path | None, typer.Option(help="also write the figures into this Parquet file")] = None
    profile: Annotated[Path | None, typer.Option(help="also write a profile that was fitted, a TOML file")] = None

    @property
    def inputs(self) -> list[Path]:
        """Return the files that are read."""
        return [*(self.logs or []), *(self.truth or []), *(self.estimate or [])]

    @property
    def lengths(self) -> list[float]:
        """Return the lengths of segments, metres; a receiver's noise hides the drift over short ones."""
        return _positive(self.lengths_m or ("100,500" if self.logs else "10,50"), "--lengths-m", "10,50", "metres")


def measure_drift_command(drift: DriftOptions) -> None:
    """Measure drift of odometry against truth by segment length; runs of one truth file or log are one cluster."""
    if bool(drift.logs) == bool(drift.truth or drift.estimate):
        raise FlightError("say either logs, or --truth and --estimate: drift is measured of one of them")
    lengths = drift.lengths
    _check_outputs(drift.inputs, [path for path in (drift.results, drift.profile) if path is not None])
    if not drift.logs and (drift.vehicle, drift.topic) != (None, None):
        raise FlightError("TUM files have neither vehicles nor topics: leave out --vehicle and --topic")
    if drift.logs:
        logged = _read_logs(drift)
        runs, has_yaw = (
            [run for one in logged.values() for run in one.runs],
            all(one.has_yaw for one in logged.values()),
        )
        _show_logs(logged, min(lengths))
    else:
        runs, has_yaw = _read_runs(drift.truth or [], drift.estimate or [], drift.lost_s, drift.axes), True
    flights = counted(len({run.sequence for run in runs}), "sequence")
    tell(f"{counted(len(runs), 'run')} of {flights}, {sum(run.path_m for run in runs):.0f} m tracked")
    figures = measure_drift(runs, lengths_m=lengths)
    if not has_yaw:
        figures = figures[~figures["figure"].str.startswith("yaw_")]
    print_table(_table_of(figures))
    if drift.results is not None:
        with fresh_file(drift.results, mend="name another place, or free some space") as scratch:
            write_frame(figures, scratch, attrs={"runs": len(runs), "lost_s": drift.lost_s})
        tell(f"wrote {drift.results}")
    if drift.profile is not None:
        fitted = fit_profile(runs, name=drift.profile.stem, lengths_m=lengths)
        write_drift_profile(fitted.profile, drift.profile)
        for row in fitted.parameters.to_dict("records"):
            tell(f"{row['name']} = {row['value']:.3f} [{row['lo']:.3f}, {row['hi']:.3f}]")
        tell(f"wrote {drift.profile}: add where the data come from and where the profile must not be believed")


def _read_logs(drift: DriftOptions) -> dict[Path, LoggedRuns]:
    """Read the odometry of logs, each once."""
    if drift.axes is not None:
        raise FlightError("logs have axes of their own: leave out --axes")
    logged = {
        path: read_runs(path, lost_s=drift.lost_s, vehicle=drift.vehicle, topic=drift.topic)
        for path in drift.logs or []
    }
    if drift.profile is not None and not all(one.has_yaw for one in logged.values()):
        raise FlightError("a profile needs headings, and the log has none but the vehicle's: leave out --profile")
    return logged


def _show_logs(logged: dict[Path, LoggedRuns], shortest_m: float) -> None:
    """Print what was read of each log, and how far its truth is to be trusted."""
    for path, one in logged.items():
        for line in one.notes:
            say(f"{path.name}: {line}")
        if math.isfinite(one.accuracy_m):
            share = 100 * one.accuracy_m / shortest_m
            say(f"{path.name}: the receiver is good to {one.accuracy_m:.1f} m, {share:.2g} % of {shortest_m:g} m")


def _summary(flown: Trajectory) -> str:
    height_m = flown.position_m[:, 2]
    return (
        f"{counted(len(flown), 'pose')}, {flown.distance_m[-1]:.0f} m over the ground, {np.ptp(flown.time_s):.1f} s, "
        f"third axis {height_m.min():.1f} to {height_m.max():.1f} m"
    )


def _lines(log: FlightLog, speed_mps: float) -> Iterator[str]:
    """Yield what was read of a log."""
    way_m = float(steps_m(log.lon_deg, log.lat_deg).sum())
    lasts = "no times"
    if log.time_s is not None:
        lasts_s = float(log.time_s[-1] - log.time_s[0])  # an SRT counts from the video's begin
        lasts = f"{lasts_s:.1f} s, {way_m / lasts_s:.2f} m/s on average"
    yield f"{counted(len(log), 'point')}, {way_m:.0f} m, {lasts}"
    if log.start_s is not None:
        yield f"starts at {dt.datetime.fromtimestamp(log.start_s, tz=dt.UTC).isoformat(timespec='milliseconds')}"
    yield from (*gaps_of(log.time_s), *log.notes)
    for name in ("height_m", "altitude_m", "yaw_deg", "pitch_deg", "roll_deg"):
        values = getattr(log, name)
        if values is not None:
            what, _, unit = name.partition("_")
            yield f"{what} from {values.min():.1f} to {values.max():.1f} {unit}"
    lon, lat = log.lon_deg, log.lat_deg
    west, east = lon.min(), lon.max()
    if east - west > 180:  # over the antimeridian
        west, east = lon[lon > 0].min(), lon[lon <= 0].max()
    yield f"longitude from {west:.4f} to {east:.4f}, latitude from {lat.min():.4f} to {lat.max():.4f} deg"
    if log.time_s is None:
        tell(f"no times: a flight has an even speed (--speed-mps, {speed_mps:g} m/s)")
    if log.height_m is None:
        tell("no height above the ground: a flight needs --height")


def _positive(text: str, option: str, example: str, unit: str) -> list[float]:
    """Read positive numbers, separated by commas."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(0 < number < math.inf for number in numbers):
        raise FlightError(f"{option} must be positive {unit} as in {example}, got {text!r}")
    return numbers


def _read_runs(truth: list[Path], estimate: list[Path], lost_s: float, axes: Axes | None) -> list[PairedRun]:
    """Read pairs of files; each truth is read once."""
    if len(truth) != len(estimate):
        raise FlightError(
            f"give one --estimate for each --truth, got {len(truth)} truths and {len(estimate)} estimates"
        )
    truths = {path: read_tum(path, axes=axes) for path in dict.fromkeys(truth)}
    runs = []
    for true_path, path in zip(truth, estimate, strict=True):
        believed = read_tum(path, axes=axes)
        try:
            run = pair_run(truths[true_path], believed, sequence=str(true_path.resolve()), lost_s=lost_s)
        except FlightError as error:
            raise FlightError(f"{path} against {true_path}: {error}") from error
        runs.append(run)
    return runs


def _check_outputs(inputs: list[Path], outputs: list[Path]) -> None:
    """Refuse to write a file over an input, or two into one."""
    for at, path in enumerate(outputs):
        if path in outputs[:at] or any(path.exists() and other.exists() and path.samefile(other) for other in inputs):
            raise FlightError(f"{path} is named twice, to read from and to write to: name another file")
        if path.is_dir():
            raise FlightError(f"{path} cannot be written (Is a directory): name another place")


def _table_of(figures: pd.DataFrame) -> Table:
    table = Table("figure", "length, m", "value", "95 %", "sequences", "segments", box=None, pad_edge=False)
    for row in figures.to_dict("records"):
        length = "" if math.isnan(row["length_m"]) else f"{row['length_m']:g}"
        value, lo, hi = ("-" if math.isnan(row[key]) else f"{row[key]:.2f}" for key in ("value", "lo", "hi"))
        table.add_row(row["figure"], length, value, f"[{lo}, {hi}]", str(row["sequences"]), str(row["segments"]))
    return table
