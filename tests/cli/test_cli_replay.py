# SPDX-License-Identifier: Apache-2.0
"""The command replay: what it prints, its flags, and mistakes on one line."""

import re

import pandas as pd
import pytest

from sasgeo_bench.tasks.task_files import Task
from tests.observing.flown import answer, flights_of, run_of
from tests.observing.listening import Listener, silence
from tests.world import drawn

pytestmark = pytest.mark.usefixtures("small_flight_views")

TOWN = "town-grid"
START = ("--start", "2026-05-01T12:00:00+02:00")


@pytest.fixture(scope="module")
def root(lay_towns, tmp_path_factory):
    out = lay_towns(tmp_path_factory.mktemp("replay") / "out", TOWN)
    drawn(out, "flight-clean", TOWN)
    return out


@pytest.fixture(scope="module")
def task(root):
    return root / "tasks" / "flight-clean" / TOWN


@pytest.fixture(scope="module")
def flight(task):
    return min(flights_of(task))


@pytest.fixture(scope="module")
def run(root, task):
    """A run in which the third fix of each flight is not accepted."""
    return run_of(root, task, lambda frame, truth: answer(truth, is_accepted=frame != 2))


def test_a_flight_is_sent_and_the_last_line_says_how_late(program, task, flight, run) -> None:
    with Listener() as listener:
        to = f"udp:127.0.0.1:{listener.port}"
        code, out, err = program("replay", run, "--flight", flight[:6], "--to", to, "--speed", 1000)
    count = len(flights_of(task)[flight])
    assert code == 0, err
    assert re.fullmatch(
        rf"{count - 1} fixes sent to {to}, late by [\d.]+ ms \(p50\), [\d.]+ ms \(p99\); UDP does not tell .*\n", out
    )
    assert f"flight {flight}: {count} views, {count} fixes, {count - 1} accepted" in err
    assert "stamps are of this computer's clock: the flight does not say when it began (--start)" in err
    assert len(listener.named("VISION_POSITION_ESTIMATE")) == count - 1


def test_all_fixes_are_sent_of_a_receiver_from_a_chosen_start(program, task, flight, run) -> None:
    with Listener() as listener:
        words = ("--to", f"udp:127.0.0.1:{listener.port}", "--speed", 1000, "--as", "gps_input", "--all")
        code, _, err = program("replay", run, "--flight", flight, *words, *START, "--origin", "9.5,47.1,450")
    assert code == 0, err
    found = listener.named("GPS_INPUT")
    assert [one.fix_type for one in found[:4]] == [3, 3, 1, 3]
    times = [truth.measured["time_s"] for truth in flights_of(task)[flight]]
    assert [one.time_usec / 1e6 for one in found] == pytest.approx([1_777_629_600 + time_s for time_s in times])
    (origin,) = listener.named("SET_GPS_GLOBAL_ORIGIN")
    assert (origin.latitude, origin.longitude, origin.altitude) == (471_000_000, 95_000_000, 450_000)


def test_a_table_of_messages_is_written_with_a_delay_and_a_rate_of_ones_own(
    program, task, flight, run, tmp_path
) -> None:
    words = ("--to", "a.csv", "--delay", 0.4, "--rate", 0.1, *START)
    code, out, err = program("replay", run, "--flight", flight, *words)
    assert (code, out) == (0, "a.csv\n"), err
    rows = pd.read_csv(tmp_path / "a.csv")
    assert (rows["timestamp"] - rows["usec"] / 1e6).tolist() == pytest.approx([0.4] * len(rows), abs=1e-5)
    assert rows["usec"].diff().min() >= 10e6
    assert 1 < len(rows) < len(flights_of(task)[flight])


def test_where_nobody_listens_the_command_says_so_and_ends_with_status_4(program, flight, run) -> None:
    pytest.importorskip("pymavlink")
    with silence() as port:
        code, out, err = program("replay", run, "--flight", flight, "--to", f"udp:127.0.0.1:{port}", "--speed", 1000)
    assert code == 4
    assert "fixes sent" in out
    assert re.search(rf"nobody listened at udp:127\.0\.0\.1:{port} to \d+ of \d+ packets", err)


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (("--to", "a.gpx", "--clock", "now"), "--clock makes no sense for a.gpx"),
        (("--to", "a.gpx", "--speed", "2"), "--speed makes no sense for a.gpx"),
        (("--to", "a.tum", "--as", "gps_input"), "--as makes no sense for a.tum"),
        (("--to", "tcp:127.0.0.1:5760"), "is no address that is known: say udp:HOST:PORT, or a file"),
        (("--to", "udp:127.0.0.1:14550", "--delay", "-1"), "--delay lies within 0 and 3600 s, got -1"),
        (("--to", "udp:127.0.0.1:14550", "--rate", "0"), "--rate lies above 0"),
        (("--to", "a.gpx", "--start", "2026-05-01T10:00:00"), "--start is a date and time with its zone"),
        (("--to", "a.gpx", "--start", "noon"), "--start is a date and time with its zone"),
        (("--to", "a.csv", "--origin", "9.5"), "--origin is LON,LAT or LON,LAT,ALT"),
    ],
)
def test_flags_that_make_no_sense_are_refused_before_anything_is_read(mistake, words, fault) -> None:
    assert fault in mistake("replay", "nowhere", *words)


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (("--to", "udp:127.0.0.1:14550", "--all"), "VISION_POSITION_ESTIMATE cannot say which fixes are accepted"),
        (("--to", "udp:127.0.0.1:14550", "--clock", "log"), "does not say when it began, and --clock log holds dates"),
        (("--to", "a.gpx"), "does not say when it began, and a.gpx holds dates"),
    ],
)
def test_what_a_flight_cannot_be_asked_is_refused(program, flight, run, words, fault) -> None:
    code, out, err = program("replay", run, "--flight", flight, *words)
    assert (code, out) == (2, "")
    assert fault in err.splitlines()[-1]


def test_a_run_without_accepted_fixes_sends_nothing(program, root, task, flight) -> None:
    run = run_of(root, task, lambda _, truth: answer(truth, is_accepted=False), "never")
    count = len(flights_of(task)[flight])
    code, _, err = program("replay", run, "--flight", flight, "--to", "a.tum")
    assert code == 2
    assert (
        err.splitlines()[-1]
        == f"sasgeo-bench: none of {count} fixes is accepted: --all takes them (a file, or --as gps_input)"
    )


def test_a_task_elsewhere_is_named_by_its_folder(program, task, flight, tmp_path) -> None:
    moved = run_of(tmp_path, task, lambda _, truth: answer(truth), "moved")
    code, _, err = program("replay", moved, "--flight", flight, "--to", "a.tum")
    assert code == 2
    assert "name its folder by --tasks" in err
    code, out, err = program("replay", moved, "--flight", flight, "--to", "a.tum", "--tasks", Task.open(task).folder)
    assert (code, out) == (0, "a.tum\n"), err
