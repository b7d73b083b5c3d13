# SPDX-License-Identifier: Apache-2.0
"""Fixes of a flight out of a run or of locate: places against true north, delays, jumps, and what is refused."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pyproj
import pytest

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.observing.fix_files import NS
from sasgeo_bench.observing.fixes import Fix
from sasgeo_bench.observing.flight_fixes import read_flight_fixes
from sasgeo_bench.observing.results import csv_text
from sasgeo_bench.tasks.task_files import Task
from tests.observing.flown import SPREAD, answer, flights_of, run_of
from tests.world import drawn

pytestmark = pytest.mark.usefixtures("small_flight_views")

TOWN = "town-grid"


@pytest.fixture(scope="module")
def out(lay_towns, tmp_path_factory):
    """A root with a flight over a town, and its control."""
    root = lay_towns(tmp_path_factory.mktemp("flown") / "out", TOWN)
    drawn(root, "flight-clean", TOWN)
    drawn(root, "clean", TOWN)
    return root


@pytest.fixture(scope="module")
def task(out):
    return out / "tasks" / "flight-clean" / TOWN


@pytest.fixture(scope="module")
def flight(task):
    return min(flights_of(task))


def test_places_are_those_of_the_answers_and_headings_count_from_true_north(out, task, flight):
    run = run_of(out, task, lambda _, truth: answer(truth), "all")
    found = read_flight_fixes(run, flight=flight[:5])
    truths, epsg = flights_of(task)[flight], Task.open(task).manifest.epsg
    assert (found.flight, found.views, found.clock) == (flight, len(truths), "flight")
    assert [fix.name for fix in found.fixes] == [truth.query_id for truth in truths]
    assert [fix.time_ns / NS for fix in found.fixes] == pytest.approx([one.measured["time_s"] for one in truths])
    to_grid = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
    for fix, truth in zip(found.fixes, truths, strict=True):
        at = to_grid.transform(fix.lon_deg, fix.lat_deg)
        # Answers are stored in steps of 1/128 m.
        assert at == pytest.approx((truth.pose.easting_m + 3.0, truth.pose.northing_m - 4.0), abs=0.01)
        # A metre ahead in the grid, seen as an azimuth on the ellipsoid, is the heading.
        ahead = math.radians(truth.pose.yaw_deg + 2.0)
        there = to_grid.transform(at[0] + math.sin(ahead), at[1] + math.cos(ahead), direction="INVERSE")
        azimuth_deg, _, _ = pyproj.Geod(ellps="WGS84").inv(fix.lon_deg, fix.lat_deg, *there)
        assert (fix.heading_deg - azimuth_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)
        assert fix.p_false == pytest.approx(0.1)


def test_a_view_without_an_answer_is_counted_and_the_odometer_leads_past_it(out, task, flight):
    truths = flights_of(task)[flight]
    run = run_of(out, task, lambda at, truth: None if at in (0, 3) else answer(truth), "holes")
    found, whole = read_flight_fixes(run, flight=flight), run_of(out, task, lambda _, truth: answer(truth), "whole")
    assert (found.views, len(found.fixes)) == (len(truths), len(truths) - 2)
    assert found.begin_ns / NS == truths[0].measured["time_s"]
    same = [
        fix for fix in read_flight_fixes(whole, flight=flight).fixes if fix.name in {one.name for one in found.fixes}
    ]
    assert list(found.fixes) == same  # without a jump at the view that was left out


def test_an_ellipse_turns_with_the_north_that_it_counts_from(out, task, flight):
    run = run_of(out, task, lambda _, truth: answer(truth), "ellipse")
    fix = read_flight_fixes(run, flight=flight).fixes[0]
    # Of the offset (e, n) in the grid, of an angle by which true north is off, by complex numbers.
    turn = np.exp(1j * math.radians(fix.yaw_deg - fix.heading_deg))
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(3), SPREAD, 200_000)
    true = (draws[:, 0] + 1j * draws[:, 1]) * turn
    expected = np.cov(np.stack([true.real, true.imag, draws[:, 2]]))
    assert abs(fix.yaw_deg - fix.heading_deg) > 0.1
    np.testing.assert_allclose(np.reshape(fix.covariance, (3, 3)), expected, atol=0.2)


def test_an_answer_waits_for_those_before_it(out, task, flight):
    seconds = [one.measured["time_s"] for one in flights_of(task)[flight]]
    step_s = seconds[1] - seconds[0]
    long_s = {0: step_s + 2.0, 1: 0.25}
    run = run_of(out, task, lambda frame, truth: answer(truth, latency_s=long_s.get(frame, 0.1)), "late")
    fixes = read_flight_fixes(run, flight=flight).fixes
    assert [fix.delay_s for fix in fixes[:3]] == pytest.approx([step_s + 2.0, 2.25, 0.1], abs=1e-6)


def test_after_an_answer_of_unknown_latency_no_delay_is_known(out, task, flight):
    run = run_of(out, task, lambda frame, truth: answer(truth, latency_s=0.1 if frame < 2 else None), "unknown")
    delays = [fix.delay_s for fix in read_flight_fixes(run, flight=flight).fixes]
    assert delays[:2] == pytest.approx([0.1, 0.1])
    assert set(delays[2:]) == {None}


def test_a_fix_that_the_odometer_contradicts_is_a_jump(out, task, flight):
    def moved(frame, truth):
        # all are moved from the fifth view on: one jump
        pose = replace(truth.pose, easting_m=truth.pose.easting_m + (300.0 if frame >= 5 else 0.0))
        return answer(replace(truth, pose=pose), is_accepted=frame != 3)

    found = read_flight_fixes(run_of(out, task, moved, "jump"), flight=flight)
    assert [at for at, fix in enumerate(found.fixes) if fix.is_jump] == [5]
    assert [at for at, fix in enumerate(found.fixes) if not fix.is_accepted] == [3]
    assert len(found.accepted) == len(found.fixes) - 1


def test_views_without_an_answer_are_no_fixes(out, task, flight):
    def some(frame, truth):
        return answer(truth, candidates=(), confidence=0.0) if frame == 1 else answer(truth)

    found = read_flight_fixes(run_of(out, task, some, "some"), flight=flight)
    assert (len(found.fixes), found.views) == (found.views - 1, len(flights_of(task)[flight]))


def test_a_flight_that_starts_later_keeps_its_pace(out, task, flight):
    run = run_of(out, task, lambda _, truth: answer(truth), "start")
    found = read_flight_fixes(run, flight=flight)
    assert found.start_ns is None
    later = found.starting(10**18)
    assert later.start_ns == 10**18
    assert [fix.time_ns - 10**18 for fix in later.fixes] == [fix.time_ns for fix in found.fixes]


def test_what_cannot_be_read_is_refused_with_what_there_is(out, task, flight, tmp_path):
    run = run_of(out, task, lambda _, truth: answer(truth), "refused")
    names = sorted(flights_of(task))
    with pytest.raises(
        ConfigError, match=rf"answers {len(names)} flights, name one by --flight: {names[0]} \(.*, \d+ view"
    ):
        read_flight_fixes(run)
    with pytest.raises(ConfigError, match=f"no flight begins with 'zz': name one of {names[0]}"):
        read_flight_fixes(run, flight="zz")
    with pytest.raises(ConfigError, match=rf"{len(names)} flights begin with ''"):
        read_flight_fixes(run, flight="")
    with pytest.raises(ConfigError, match=r"holds \d+ runs, name one: "):
        read_flight_fixes(out / "runs")
    with pytest.raises(StoreError, match=r"holds no run and no locate\.csv"):
        read_flight_fixes(out / "regions")
    with pytest.raises(StoreError, match="there is no folder"):
        read_flight_fixes(tmp_path / "none")
    with pytest.raises(StoreError, match=r"holds no task that .* answers: name its folder by --tasks"):
        read_flight_fixes(run, flight=flight, tasks=tmp_path)
    single = run_of(out, out / "tasks" / "clean" / TOWN, lambda _, truth: answer(truth), "single")
    with pytest.raises(ConfigError, match="answers single views of suite clean, and no flight"):
        read_flight_fixes(single)
    blind = run_of(out, task, lambda _, truth: answer(truth, candidates=(), confidence=0.0), "blind")
    with pytest.raises(ConfigError, match=r"none of the \d+ views of flight .* has an answer"):
        read_flight_fixes(blind, flight=flight)


FIX = Fix(
    file="b.jpg",
    status="found",
    lon=9.5,
    lat=47.1,
    x_m=537_000.0,
    y_m=5_216_000.0,
    heading_deg=89.7,
    p_false=0.01,
    is_accepted=True,
    taken_at="2024-05-01T10:20:31.500000",
    seconds=0.5,
    view=(537_000.0, 5_216_000.0, 90.0, 1.0),
)


def located(folder, fixes, *, earlier=()):
    folder.mkdir()
    (folder / "locate.csv").write_text(csv_text(fixes), encoding="utf-8")
    rows = [json.dumps({"key": f"k{at}", "fix": asdict(fix)}) for at, fix in enumerate((*earlier, *fixes))]
    (folder / "answers.jsonl").write_text("\n".join(rows), encoding="utf-8")
    return folder


def test_located_pictures_are_a_flight_in_the_order_of_their_cameras_clock(tmp_path):
    first = replace(FIX, file="z.jpg", taken_at="2024-05-01T10:20:30")
    untimed = replace(FIX, file="c.jpg", taken_at=None)
    of_earlier_call = replace(FIX, lon=9.6)
    found = read_flight_fixes(located(tmp_path / "a b", (FIX, first, untimed), earlier=(of_earlier_call,)))
    assert (found.flight, found.clock, found.epsg) == ("a-b", "camera", None)
    assert [(fix.name, fix.lon_deg, fix.delay_s) for fix in found.fixes] == [("z.jpg", 9.5, 0.5), ("b.jpg", 9.5, 0.5)]
    assert [fix.time_ns for fix in found.fixes] == [1_714_558_830 * NS, 1_714_558_831_500_000_000]
    assert found.begin_ns == 1_714_558_830 * NS


def test_pictures_without_times_cannot_be_replayed(tmp_path):
    with pytest.raises(ConfigError, match="its cameras told no time"):
        read_flight_fixes(located(tmp_path / "a", (replace(FIX, taken_at=None),)))
    with pytest.raises(ConfigError, match="one flight and no task: leave out --flight and --tasks"):
        read_flight_fixes(tmp_path / "a", flight="12")
    with pytest.raises(ConfigError, match="lists no place"):
        read_flight_fixes(located(tmp_path / "b", (Fix(file="c.jpg", status="failed", reason="damaged"),)))
