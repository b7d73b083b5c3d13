# SPDX-License-Identifier: Apache-2.0
"""Queries along a flight that was flown: its log is the path, and what cannot be asked is refused in one line."""

import numpy as np
import pyproj
import pytest
import shapely

from sasgeo_bench.core.errors import ConfigError, FlightError
from sasgeo_bench.flights.logs import FlownPath
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.tasks.build import ensure_tasks, made_tasks, make_tasks
from sasgeo_bench.tasks.task_files import read_queries, read_truths
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.tasks.test_task_plan import own_region

TOWN = "town-grid"


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
