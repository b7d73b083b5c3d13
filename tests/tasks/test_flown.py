# SPDX-License-Identifier: Apache-2.0
"""Queries along a flight that was flown: its log is the path, and what cannot be asked is refused in one line."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pyproj
import pytest
import shapely

from sasgeo_bench.core.errors import ConfigError, FlightError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.flights.drift_profile import SlipDrift, load_profile, write_drift_profile
from sasgeo_bench.flights.logs import FlownPath
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.tasks.build import ensure_tasks, made_tasks, make_tasks
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.task_files import read_queries, read_truths
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.flights import autopilots
from tests.tasks.test_task_plan import own_region

TOWN = "town-grid"

pytestmark = pytest.mark.usefixtures("small_flight_views")


@pytest.fixture
def root(lay_towns, tmp_path):
    return lay_towns(tmp_path / "out", TOWN)


def corners(root, *, along=0.6):
    """Corners of a way over the middle of the town: west to east, and back to the north of it; metres."""
    west, south, east, north = read_manifest(root / "regions" / TOWN).bounds_m
    x = west + (east - west) * (0.5 + along * np.array([-0.5, 0.5, 0.5, -0.5]))
    y = south + (north - south) * np.array([0.4, 0.4, 0.6, 0.6])
    return np.stack([x, y], axis=1)


def log_of(path, en_m, epsg, *, speed_mps=10.0, start=None):
    """Write a table of a flight along corners, a point a second; with dates from a start on, by UTC."""
    way = shapely.LineString(en_m)
    points = shapely.get_coordinates(shapely.line_interpolate_point(way, np.arange(0, way.length, speed_mps)))
    lon, lat = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True).transform(*points.T)
    times = range(len(lon)) if start is None else np.datetime64(start) + np.arange(len(lon))
    rows = [f"{time},{y:.8f},{x:.8f},90.0" for time, x, y in zip(times, lon, lat, strict=True)]
    column = "time_s" if start is None else "time_utc"
    path.write_text("\n".join([f"{column},lat,lon,height_m", *rows]) + "\n", encoding="ascii")
    return path


def request_of(root, suite="flight-clean", **changes):
    base = {"suites": (suite,), "regions": (TOWN,), "count": 1, "seed": 0, "out": root}
    (request,) = plan_requests(TaskRequest(**base | changes))
    return request


def test_the_views_lie_along_the_log_in_its_order_and_head_where_it_flies(root, tmp_path):
    epsg, way_m = read_manifest(root / "regions" / TOWN).epsg, corners(root)
    log = log_of(tmp_path / "log.csv", way_m, epsg)
    (task,) = make_tasks(request_of(root, flown=FlownPath(file=log)))
    truths = {truth.query_id: truth for truth in read_truths(root / "truth" / "flight-clean" / TOWN)}
    queries = [query for query in read_queries(task.folder) if truths[query.query_id].role == "control"]
    one = [query for query in queries if query.step.sequence_id == queries[0].step.sequence_id]
    places = [truths[query.query_id].pose for query in sorted(one, key=lambda query: query.step.frame)]
    points = shapely.points([(pose.easting_m, pose.northing_m) for pose in places])
    way = shapely.LineString(way_m)
    assert len(places) > 10
    assert shapely.distance(way, points).max() < 5.0  # corners are cut between two points of the log
    along_m = shapely.line_locate_point(way, points)
    assert (np.diff(along_m) > 0).all()
    legs = np.cumsum(np.hypot(*np.diff(way_m, axis=0).T))
    for at_m, pose in zip(along_m, places, strict=True):
        leg = int(np.searchsorted(legs, at_m))
        if np.abs(at_m - np.append(0.0, legs)).min() > 15.0:  # farther from a corner than its course is measured over
            expected = (90.0, 0.0, 270.0)[leg]
            assert abs((pose.yaw_deg - expected + 180) % 360 - 180) < 2.0


@pytest.mark.slow
def test_a_log_that_tells_the_date_tells_when_each_view_was_flown(root, tmp_path):
    epsg, way_m = read_manifest(root / "regions" / TOWN).epsg, corners(root)
    log = log_of(tmp_path / "log.csv", way_m, epsg, start="2025-05-01T10:00:00")
    make_tasks(request_of(root, flown=FlownPath(file=log)))
    truths = list(read_truths(root / "truth" / "flight-clean" / TOWN))
    way = shapely.LineString(way_m)
    assert truths
    for truth in truths:
        seconds = truth.measured["utc_s"] - 1_746_093_600
        at = way.interpolate(10.0 * seconds)  # where the log is then
        assert at.distance(shapely.Point(truth.pose.easting_m, truth.pose.northing_m)) < 5.0


@pytest.mark.slow
def test_a_log_without_a_date_tells_no_utc(root, tmp_path):
    epsg = read_manifest(root / "regions" / TOWN).epsg
    make_tasks(request_of(root, flown=FlownPath(file=log_of(tmp_path / "log.csv", corners(root), epsg))))
    assert not any("utc_s" in truth.measured for truth in read_truths(root / "truth" / "flight-clean" / TOWN))


@pytest.mark.slow
def test_a_flight_is_drawn_anew_when_its_log_or_its_height_changes(root, tmp_path):
    epsg = read_manifest(root / "regions" / TOWN).epsg
    log = log_of(tmp_path / "log.csv", corners(root), epsg)
    request = request_of(root, flown=FlownPath(file=log))
    folders = ensure_tasks(request)
    assert made_tasks(request) == folders
    assert made_tasks(request_of(root)) is None
    assert made_tasks(request_of(root, flown=FlownPath(file=log, height_m=120.0))) is None
    log_of(log, corners(root, along=0.5), epsg)
    assert made_tasks(request_of(root, flown=FlownPath(file=log))) is None


def test_what_cannot_be_asked_is_refused_with_the_reason(root, tmp_path):
    epsg, way_m = read_manifest(root / "regions" / TOWN).epsg, corners(root)
    log = log_of(tmp_path / "log.csv", way_m, epsg)
    with pytest.raises(ConfigError, match="--flight is for suites of flights, such as flight-clean, and clean is none"):
        request_of(root, "clean", flown=FlownPath(file=log))
    with pytest.raises(FlightError, match="there is no flight log"):
        FlownPath(file=tmp_path / "none.csv")
    short = log_of(tmp_path / "short.csv", way_m[:1] + np.array([[0, 0], [90, 0]]), epsg)
    with pytest.raises(FlightError, match=r"has \d+ m, 200 m are needed"):
        make_tasks(request_of(root, flown=FlownPath(file=short)))
    far = log_of(tmp_path / "far.csv", way_m + 50_000.0, epsg)
    with pytest.raises(FlightError, match=f"lies elsewhere.*{TOWN}"):
        make_tasks(request_of(root, flown=FlownPath(file=far)))
    assert not (root / "tasks").exists()


def test_a_flight_too_short_for_a_suite_is_told_so_and_not_the_region(root, tmp_path):
    epsg, way_m = read_manifest(root / "regions" / TOWN).epsg, corners(root)
    log = log_of(
        tmp_path / "log.csv", way_m[:2], epsg
    )  # less than 1.5 km, of which a gap of 500 m is more than a third
    request = request_of(root, "flight-gap", flown=FlownPath(file=log))
    with pytest.raises(
        ConfigError, match=f"the flight over {TOWN} leaves nothing to ask for suite 'flight-gap': a gap is"
    ):
        make_tasks(request)


def test_a_place_that_no_split_speaks_of_is_all_test(tmp_path):
    own = own_region(tmp_path, name="my-town", source=TOWN)
    (request,) = plan_requests(
        TaskRequest(suites=("clean",), regions=(str(own),), count=1, seed=0, out=tmp_path / "out")
    )
    assert [(place.name, place.part) for place in request.split.spec.place] == [("my-town", "test")]
    with pytest.raises(ConfigError, match="split 'crossfit' does not speak of region 'my-town': new-split makes"):
        plan_requests(
            TaskRequest(suites=("clean",), regions=(str(own),), split="crossfit", count=1, seed=0, out=tmp_path / "out")
        )


# Odometry of the log


class Logged:
    """A ULog of a way over the town, five fixes a second at 10 m/s, with the poses of an odometer that is too long."""

    scale = 1.04

    def __init__(self, root):
        pytest.importorskip("pyulog", reason="needs the extra [logs]")
        manifest = read_manifest(root / "regions" / TOWN)
        way = shapely.LineString(corners(root))
        self.time_s = np.arange(0, way.length / 10, 0.2)
        self.en_m = shapely.get_coordinates(shapely.line_interpolate_point(way, 10 * self.time_s))
        lon, lat = pyproj.Transformer.from_crs(manifest.epsg, 4326, always_xy=True).transform(*self.en_m.T)
        self.lonlat = np.column_stack([lon, lat])
        # An autopilot's north is the true one, from which the grid's is off
        turn_rad = np.radians(pyproj.Proj(manifest.epsg).get_factors(lon[0], lat[0]).meridian_convergence)
        east, north = (self.en_m - self.en_m[0]).T
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        self.true_m = np.column_stack([c * east + s * north, c * north - s * east])
        east, north = np.gradient(self.true_m, axis=0).T
        self.yaw_deg = np.degrees(np.unwrap(np.arctan2(east, north)))

    def write(self, path, *, fused=bool, has_camera=False, second_m=None, silent_s=None, every=1):
        """Write it; GNSS is fused at times, and a camera's poses head 0.05 degrees a second too far to the right.

        The second receiver has no fix for 15 s on either side of a moment, by default the middle of the flight;
        of the camera's poses one in `every` is kept.
        """
        us = autopilots.stamps_us(self.time_s)
        own_m = self.scale * self.true_m
        topics = {
            ("vehicle_gps_position", 0): (
                autopilots.GPS_114,
                [(one, 0, lat, lon, 100.0, 147.0, 1.0, 3) for one, (lon, lat) in zip(us, self.lonlat, strict=True)],
            ),
            ("vehicle_attitude", 0): (
                autopilots.ATTITUDE,
                [(one, *autopilots.turn(yaw)) for one, yaw in zip(us, self.yaw_deg, strict=True)],
            ),
            ("vehicle_local_position", 0): (
                autopilots.LOCAL,
                [(one, north, east, -90.0, True, True) for one, (east, north) in zip(us, own_m, strict=True)],
            ),
            ("estimator_status", 0): (
                autopilots.STATUS,
                [(one, 4 * fused(time_s + 1.0)) for one, time_s in zip(us, self.time_s, strict=True)],
            ),
        }
        if second_m is not None:  # a receiver to the east, which states 5 m
            wrong = self.lonlat + np.array([second_m / 111_320 / np.cos(np.radians(self.lonlat[0, 1])), 0])
            silent_s = self.time_s[-1] / 2 if silent_s is None else silent_s
            topics["sensor_gps", 0] = (
                autopilots.GPS_114,
                [
                    (one, 0, lat, lon, 100.0, 147.0, 5.0, 3)
                    for one, (lon, lat), time_s in zip(us, wrong, self.time_s, strict=True)
                    if abs(time_s - silent_s) > 15
                ],
            )
        if has_camera:
            yaw_deg = self.yaw_deg + 0.05 * self.time_s
            topics["vehicle_visual_odometry", 0] = (
                "uint64_t timestamp;uint8_t pose_frame;float[3] position;float[4] q;",
                [
                    (one, 2, north, east, -90.0, *autopilots.turn(yaw))
                    for one, (east, north), yaw in list(zip(us, own_m, yaw_deg, strict=True))[::every]
                ],
            )
        path.write_bytes(autopilots.ulog(topics))
        return FlownPath(file=path, height_m=90.0)

    def heard(self, task, kind):
        """Yield for each view of a variant but the first its step, where it was and where before, and its truth."""
        truths = {truth.query_id: truth for truth in task.truths if truth.kind == kind}
        views = sorted((one for one in task.queries() if one.query_id in truths), key=lambda one: one.step.frame)
        for before, view in itertools.pairwise(views):
            yield view.step, truths[before.query_id].pose, truths[view.query_id].pose, truths[view.query_id]


def moved(before, pose):
    """Right and up of a step, and its turn, by plain numpy."""
    east, north, a = pose.easting_m - before.easting_m, pose.northing_m - before.northing_m, np.radians(before.yaw_deg)
    turn_deg = (pose.yaw_deg - before.yaw_deg + 180) % 360 - 180
    return east * np.cos(a) - north * np.sin(a), east * np.sin(a) + north * np.cos(a), turn_deg


def test_steps_of_the_logs_own_odometer_are_asked_in_place_of_drawn_ones(root, tmp_path, capsys) -> None:
    logged = Logged(root)
    with reporting(print):
        (task,) = make_tasks(request_of(root, flown=logged.write(tmp_path / "a.ulg", has_camera=True)))
    steps = list(logged.heard(task, "F1 own odometer"))
    count = len(steps)
    assert count > 10
    straight = 0
    for step, before, pose, truth in steps:
        right, up, turn_deg = moved(before, pose)
        assert truth.measured["is_logged"] == 1.0
        if abs(turn_deg) < 1:  # corners are cut
            straight += 1
            assert np.hypot(*step.increment[:2]) == pytest.approx(1.04 * np.hypot(right, up), abs=0.3)
            assert 0 < step.increment[2] - turn_deg < 1  # by 0.05 degrees a second, of some 5 s
            assert step.covariance[4] < (0.05 * up) ** 2  # by the profile: 1.2 % of scale, and slip
    assert straight > count / 2
    for step, before, pose, truth in logged.heard(task, "no drift"):
        assert step.increment == pytest.approx(moved(before, pose), abs=1e-6)  # the control's odometer is perfect still
        assert "is_logged" not in truth.measured
    told = f"of the log (vehicle_visual_odometry 0) in {count} of {count} steps; noise is declared as the profile"
    assert task.manifest.odometry.startswith(told)
    out = capsys.readouterr().out
    assert f"odometry: {told}" in out
    # 4 % of its scale, and its axes head ever more wrong; 0.05 degrees a second are 0.25 a step
    times_s = np.array([truth.measured["time_s"] for *_, truth in steps])
    expected = np.median(np.abs(1.04 * np.exp(1j * np.radians(0.05 * times_s)) - 1))
    found = re.search(
        r"vehicle_visual_odometry 0 are off the receiver by ([\d.]+) % of the way and its turns by ([\d.]+)", out
    )
    off_pct, off_deg = map(float, found.groups())
    assert off_pct == pytest.approx(100 * expected, abs=0.6)
    assert off_deg == pytest.approx(0.25, abs=0.05)


def test_an_odometer_that_is_lost_all_the_way_has_no_figures_and_headings_of_its_own(root, tmp_path, capsys) -> None:
    flown = Logged(root).write(tmp_path / "a.ulg", has_camera=True, every=15)  # a pose in 3 s
    with reporting(print):
        (task,) = make_tasks(request_of(root, "flight-gap", flown=flown))
    told = task.manifest.odometry
    assert re.match(r"of the log \(vehicle_visual_odometry 0\) in (\d+) of \d+ steps, lost in \1 of these", told)
    assert "turns are drawn" not in told
    assert "nan" not in capsys.readouterr().out


@pytest.mark.slow
def test_steps_in_which_a_receiver_was_fused_are_drawn_and_counted(root, tmp_path) -> None:
    logged = Logged(root)
    end_s = float(logged.time_s[-1])
    flown = logged.write(tmp_path / "a.ulg", fused=lambda time_s: time_s > end_s / 2)
    (task,) = make_tasks(request_of(root, "flight-gap", flown=flown))
    steps = list(logged.heard(task, "no gap"))
    is_own = [truth.measured["is_logged"] == 1.0 for *_, truth in steps]
    assert is_own == sorted(is_own, reverse=True)
    assert 0.3 < np.mean(is_own) < 0.7
    for one, (step, before, pose, _) in zip(is_own, steps, strict=True):
        right, up, turn_deg = moved(before, pose)
        if abs(turn_deg) < 1:
            assert (np.hypot(*step.increment[:2]) == pytest.approx(1.04 * np.hypot(right, up), abs=0.3)) == one
    assert task.manifest.odometry == (
        f"of the log (vehicle_local_position 0) in {sum(is_own)} of {len(steps)} steps, drawn by the profile "
        "vo-mono-survey where it fused GNSS or has no poses (estimator_status); turns are drawn, as its headings are "
        "the vehicle's and so are those of the truth; noise is declared as the profile vo-mono-survey has it"
    )


@pytest.mark.slow
def test_the_step_of_a_carried_drone_is_the_logs_too(root, tmp_path) -> None:
    """Its odometer says of that step what it says in the control; before it another way is flown, which no log has."""
    (task,) = make_tasks(
        request_of(root, "flight-kidnap", flown=Logged(root).write(tmp_path / "a.ulg", has_camera=True))
    )
    usual = [step.increment for step, *_ in Logged(root).heard(task, "not carried")]
    carried = list(Logged(root).heard(task, "F5 odometer unaware"))
    is_own = [truth.measured["is_logged"] == 1.0 for *_, truth in carried]
    assert is_own == [step.increment == own for (step, *_), own in zip(carried, usual, strict=True)]
    assert 0.4 < np.mean(is_own) < 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("odometry", "why"),
    [
        ("log", "a.ulg: vehicle_local_position 0 fused GNSS from start to end (estimator_status): it is a copy of"),
        ("drawn", "--odometry drawn says so"),
    ],
)
def test_an_estimate_that_fused_gnss_is_named_and_the_profile_taken(root, tmp_path, odometry, why) -> None:
    logged = Logged(root)
    flown = replace(logged.write(tmp_path / "a.ulg", has_camera=odometry == "drawn"), odometry=odometry)
    (task,) = make_tasks(request_of(root, flown=flown))
    assert task.manifest.odometry.startswith(f"drawn by profiles of drift: {why}")
    assert not any("is_logged" in truth.measured for truth in task.truths)
    assert "F1 own odometer" not in {truth.kind for truth in task.truths}


@pytest.mark.slow
def test_a_profile_of_ones_own_is_what_the_odometer_declares_and_is_drawn_by(root, tmp_path) -> None:
    logged = Logged(root)
    mine = load_profile("wheel-poor").model_copy(update={"id": "mine", "slip": SlipDrift(sigma_pct=30.0, length_m=5.0)})
    write_drift_profile(mine, tmp_path / "mine.toml")
    flown = logged.write(tmp_path / "a.ulg", has_camera=True)
    (task,) = make_tasks(request_of(root, flown=replace(flown, drift=str(tmp_path / "mine.toml"))))
    for step, *_ in logged.heard(task, "F1 own odometer"):
        right, up = step.increment[:2]
        way_m = np.hypot(right, up)
        ahead, u = np.array([right, up]) / way_m, way_m / 5.0
        along_m2 = ahead @ np.reshape(step.covariance, (3, 3))[:2, :2] @ ahead
        # 2 % of scale, and 30 % of slip over 5 m
        assert along_m2 == pytest.approx(way_m**2 * (0.02**2 + 0.3**2 * 2 * (u - 1 + np.exp(-u)) / u**2), rel=1e-4)
    assert task.manifest.odometry.endswith("noise is declared as the profile mine has it")
    (task,) = make_tasks(request_of(root, "flight-gap", flown=replace(flown, odometry="drawn", drift="perfect")))
    assert task.manifest.odometry == "drawn by the profile perfect: --odometry drawn says so"
    for step, before, pose, _ in logged.heard(task, "no gap"):
        assert step.increment == pytest.approx(moved(before, pose), abs=1e-6)
    with pytest.raises(ConfigError, match=r"none\.toml cannot be read as a drift profile"):
        make_tasks(request_of(root, flown=replace(flown, drift=str(tmp_path / "none.toml"))))


# Priors of a weak receiver


def discs_of(task):
    """Yield each view's truth, prior and place in its flight."""
    truths = {truth.query_id: truth for truth in task.truths}
    for query in task.queries():
        yield truths[query.query_id], query.prior, query.step.frame


def test_the_priors_of_a_flight_are_the_fixes_of_the_logs_second_receiver(root, tmp_path, capsys) -> None:
    logged = Logged(root)
    flown = logged.write(tmp_path / "a.ulg", second_m=9.0)
    with reporting(print):
        (task,) = make_tasks(request_of(root, "flight-gap", flown=flown, group=PriorGroup.parse("gnss")))
    found = list(discs_of(task))
    seen = [(truth, prior, frame) for truth, prior, frame in found if prior.center_m is not None]
    assert 0 < len(found) - len(seen) < len(found) / 3  # those of the middle have no fix
    for truth, prior, frame in seen:
        east, north = np.subtract(prior.center_m, (truth.pose.easting_m, truth.pose.northing_m))
        assert np.hypot(east, north) == pytest.approx(9.0, abs=0.3)
        assert east > 8.5
        assert prior.radius_m == (15.0 if frame else 50.0)
        assert truth.measured["gnss_off_m"] == pytest.approx(9.0, abs=0.3)
    assert {prior.yaw_sigma_deg for _, prior, frame in found if frame == 0} == {20.0}
    assert {prior.yaw_sigma_deg for _, prior, frame in found if frame > 0} == {None}
    assert {query.prior_group for query in task.queries()} == {"gnss-weak-s3"}
    told = "of sensor_gps 0 of the log, discs of 3 times the accuracy that it states, 15 m (median), none in "
    assert task.manifest.gnss.startswith(told)
    out = capsys.readouterr().out
    assert f"prior: fixes {told}" in out
    assert "fixes of sensor_gps 0 are off the truth by 9.0 m (median), in 0 of" in out


def test_a_flight_whose_second_receiver_has_no_fix_at_first_begins_anywhere_and_says_so(root, tmp_path) -> None:
    flown = Logged(root).write(tmp_path / "a.ulg", second_m=9.0, silent_s=10.0)
    (task,) = make_tasks(request_of(root, "flight-gap", flown=flown, group=PriorGroup.parse("gnss")))
    assert {prior.center_m for _, prior, frame in discs_of(task) if frame == 0} == {None}
    assert task.manifest.gnss.endswith(" views, the first among them: the start is anywhere on the map")


@pytest.mark.slow
def test_without_a_second_receiver_a_weak_one_is_drawn_and_the_first_named(root, tmp_path) -> None:
    logged = Logged(root)
    flown = logged.write(tmp_path / "a.ulg", second_m=0.0)
    (task,) = make_tasks(request_of(root, "flight-gap", flown=flown, group=PriorGroup.parse("gnss-known-s1")))
    assert task.manifest.gnss == (
        "drawn, 16.7 m on each axis, correlated over 60 s, in discs of 50 m: sensor_gps 0 is vehicle_gps_position 0 "
        "under another name, which is the truth"
    )
    by_place = {}
    for truth, prior, frame in discs_of(task):
        away_m = np.hypot(*np.subtract(prior.center_m, (truth.pose.easting_m, truth.pose.northing_m)))
        assert 0 < away_m <= prior.radius_m == 50.0
        by_place.setdefault((truth.pair_id, frame), set()).add(prior.center_m)
    assert {len(centers) for centers in by_place.values()} == {1}  # control and stress are asked alike
    steps_m = np.diff([next(iter(by_place[key])) for key in sorted(by_place)], axis=0)
    assert np.hypot(*steps_m.T).max() < 100  # views are 40 to 80 m apart, and errors of neighbours are alike


@pytest.mark.slow
def test_a_carried_drone_has_a_weak_receiver_on_both_ways(root) -> None:
    (task,) = make_tasks(request_of(root, "flight-kidnap", group=PriorGroup.parse("gnss")))
    kinds = set()
    for truth, prior, _ in discs_of(task):
        kinds.add(truth.kind)
        away_m = np.hypot(*np.subtract(prior.center_m, (truth.pose.easting_m, truth.pose.northing_m)))
        assert 0 < away_m <= prior.radius_m
    assert any("F5" in kind for kind in kinds)


@pytest.mark.slow
def test_no_disc_tells_that_a_drone_was_carried(root, tmp_path) -> None:
    """The other first half was flown by nobody; the log's receiver is as far off there as on the control's."""
    flown = Logged(root).write(tmp_path / "a.ulg", second_m=9.0)
    (task,) = make_tasks(request_of(root, "flight-kidnap", flown=flown, group=PriorGroup.parse("gnss")))
    found = {}
    for truth, prior, frame in discs_of(task):
        found.setdefault(truth.kind, {})[frame] = (prior.radius_m, truth.measured.get("gnss_off_m"))
    assert {kind for kind in found if "F5" in kind} == {"F5 odometer lost", "F5 odometer unaware"}
    assert all(of_kind == found["not carried"] for of_kind in found.values())
    assert {radius_m for radius_m, _ in found["not carried"].values()} == {50.0, 15.0, None}


def test_suites_without_flights_have_no_weak_receiver(root) -> None:
    with pytest.raises(ConfigError, match="'clean' has no flights, of which prior group gnss-weak-s3 is: use r50 or"):
        make_tasks(request_of(root, "clean", group=PriorGroup.parse("gnss")))
