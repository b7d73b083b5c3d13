# SPDX-License-Identifier: Apache-2.0
"""The commands of flights: what was read, figures of drift, files that are asked for, mistakes on one line."""

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.flights.drift_profile import load_profile, read_drift_profile
from sasgeo_bench.flights.odometry import dead_reckon, draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory, read_tum, write_tum
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.tasks.task_files import Task
from tests.flights.autopilots import Flown, fusing, px4_drift, tlog, ulog, write
from tests.tasks.test_flown import Logged

pytestmark = pytest.mark.usefixtures("small_flight_views")


@pytest.fixture
def pairs(tmp_path):
    """Three flights of 300 m and an estimate of each; the first truth is gzipped."""
    at = np.arange(0.0, 301.0, 2.0)
    words = []
    for number in range(3):
        position = np.stack([at, 20 * np.sin(at / 30 + number), 0 * at + 80], axis=1)
        flown = Trajectory.of_angles(time_s=at / 10, position_m=position, yaw_deg=90 + 0 * at)
        steps = draw_odometry(flown, load_profile("vio-stereo"), rng=np.random.default_rng(number))
        truth, estimate = tmp_path / f"truth-{number}.txt", tmp_path / f"estimate-{number}.txt"
        write_tum(flown, truth)
        write_tum(dead_reckon(flown, steps), estimate)
        words += ["--truth", truth, "--estimate", estimate]
    first = tmp_path / "truth-0.txt"
    first.write_bytes(gzip.compress(first.read_bytes()))
    return words


def test_drift_is_printed_by_length_with_its_interval(program, pairs) -> None:
    code, out, err = program("measure-drift", *pairs, "--lengths-m", "20,100")
    assert code == 0
    assert err.startswith("3 runs of 3 sequences, ")
    rows = [line.split() for line in out.splitlines() if line.startswith("position_pct ")]
    assert [row[1] for row in rows] == ["20", "100"]
    assert all(0 < float(row[2]) < 10 for row in rows)
    assert "resets_per_km" in out


def test_runs_of_one_truth_are_one_sequence(program, pairs) -> None:
    code, _, err = program("measure-drift", *pairs, *pairs[:4], "--lengths-m", "20")
    assert code == 0
    assert err.startswith("4 runs of 3 sequences, ")


def test_figures_and_a_fitted_profile_are_written_where_asked(program, pairs, tmp_path) -> None:
    words = ("--lengths-m", "20,50,100", "--results", "figures.parquet", "--profile", "mine.toml")
    code, out, err = program("measure-drift", *pairs, *words)
    assert code == 0
    assert "wrote mine.toml: add where the data come from" in err
    assert "slip.sigma_pct = " in err
    assert "wrote" not in out
    figures = read_frame(tmp_path / "figures.parquet", mend="measure again")
    assert isinstance(figures, pd.DataFrame)
    assert figures.attrs == {"runs": 3, "lost_s": 2.0}
    assert set(figures["length_m"].dropna()) == {20.0, 50.0, 100.0}
    assert read_drift_profile(tmp_path / "mine.toml").id == "mine"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--lengths-m", "20,x"), "--lengths-m must be positive metres as in 10,50, got '20,x'"),
        (("--lengths-m", "0"), "--lengths-m must be positive metres"),
        (("--truth", "lonely.txt"), "give one --estimate for each --truth, got 4 truths and 3 estimates"),
        (("--truth", "no.txt", "--estimate", "no.txt"), "no.txt cannot be read as a trajectory (No such file"),
        (("--truth", "bad.txt", "--estimate", "bad.txt"), "bad.txt, line 1: 3 words: a line is 'time_s x y z"),
        (("--truth", "late.txt", "--estimate", "truth-1.txt"), "truth-1.txt against late.txt: 0 of 151 poses of the"),
        (("--truth", "loop", "--estimate", "truth-1.txt"), "loop cannot be read as a trajectory (Too many levels"),
        (("--results", "truth-1.txt"), "truth-1.txt is named twice, to read from and to write to: name another file"),
        (("--results", "new", "--profile", "new"), "new is named twice"),
        (("--profile", "folder"), "folder cannot be written (Is a directory): name another place"),
        (("--lost-s", "-1"), "lost-s"),
    ],
)
def test_a_mistake_gets_one_line(mistake, pairs, tmp_path, words, expected) -> None:
    (tmp_path / "bad.txt").write_text("0 1 2\n")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    (tmp_path / "late.txt").write_text("1e9 0 0 0 0 0 0 1\n1000000001 5 0 0 0 0 0 1\n")
    assert expected in mistake("measure-drift", *pairs, *words)


def test_a_profile_that_cannot_be_named_or_written_gets_one_line_after_the_table(program, pairs, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    for name, each in (("Not a name.toml", "'id'"), ("file/mine.toml", "cannot be written")):
        code, out, err = program("measure-drift", *pairs, "--profile", name)
        assert code == 2
        assert each in err.splitlines()[-1]
        assert "position_pct" in out


# Logs

ROWS = "".join(f"{at}000,49.005,{11.001 + at * 6.838e-5:.7f},328.084,90\n" for at in range(6))


def test_what_is_read_of_a_log_is_printed_with_its_columns_and_units(program, tmp_path) -> None:
    (tmp_path / "log.csv").write_text("time_ms,lat,lon,height_ft,heading_deg\n" + ROWS)
    code, out, err = program("import-flight", "log.csv")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "6 points, 25 m, 5.0 s, 5.00 m/s on average",
        "latitude: 'lat', deg",
        "longitude: 'lon', deg",
        "time: 'time_ms', ms",
        "height: 'height_ft', ft",
        "yaw: 'heading_deg', deg",
        "height from 100.0 to 100.0 m",
        "yaw from 90.0 to 90.0 deg",
        "longitude from 11.0010 to 11.0013, latitude from 49.0050 to 49.0050 deg",
    ]


def test_a_flight_over_the_antimeridian_lies_from_west_to_east(program, tmp_path) -> None:
    rows = [f"{at},-16.5,{lon}\n" for at, lon in enumerate((179.9998, 179.9999, 180.0, -179.9999, -179.9998))]
    (tmp_path / "log.csv").write_text("time_s,lat,lon\n" + "".join(rows))
    _, out, _ = program("import-flight", "log.csv")
    assert out.splitlines()[-1] == "longitude from 179.9998 to -179.9998, latitude from -16.5000 to -16.5000 deg"


def test_a_unit_that_is_not_told_is_asked_for_and_taken(program, mistake, tmp_path) -> None:
    (tmp_path / "log.csv").write_text("t,lat,lon,height,heading\n" + ROWS)
    words: list[str] = []
    for quantity, unit in (("time", "ms"), ("height", "ft"), ("angle", "none")):
        assert f"states no unit: say --{quantity}-unit" in mistake("import-flight", "log.csv", *words)
        words += [f"--{quantity}-unit", unit]
    assert "height from 100.0 to 100.0 m" in program("import-flight", "log.csv", *words)[1]
    assert "yaw" not in program("import-flight", "log.csv", *words)[1]
    words[words.index("--height-unit") : words.index("--height-unit") + 2] = ["--height", "80"]
    _, out, err = program("import-flight", "log.csv", *words)
    assert err == ""  # its heights are not asked for
    assert out.splitlines()[-4:-1] == [
        "not read: 'height', 'heading'",
        "height: 80 m throughout, as --height says",
        "height from 80.0 to 80.0 m",
    ]
    (tmp_path / "line.csv").write_text("lat,lon\n49.005,11.001\n49.005,11.002\n")
    _, out, err = program("import-flight", "line.csv")
    assert out.startswith("2 points, 73 m, no times\n")
    assert "no times: a flight has an even speed (--speed-mps, 10 m/s)" in err
    assert "no height above the ground: a flight needs --height" in err
    _, out, err = program("import-flight", "line.csv", "--height", "90", "--speed-mps", "25")
    assert "height: 90 m throughout" in out
    assert err == "no times: a flight has an even speed (--speed-mps, 25 m/s)\n"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("log.csv", "--height", "nan"), "--height must be a number from 5 to 10000, got nan"),
        (("log.csv", "--speed-mps", "-1"), "--speed-mps must be a number from 0.1 to 100, got -1"),
        (("log.csv", "--speed-mps", "9"), "log.csv has times: leave out --speed-mps"),
        (("log.csv", "--axes", "camera"), "log.csv is no TUM file: leave out --axes"),
        (
            ("line.kml", "--height-unit", "none"),
            "line.kml is no table, and its units are known: leave out --height-unit",
        ),
        (
            ("log.csv", "--place-unit", "e7"),
            "'lat' has decimals, and is no count of 1e-7 degrees: say --place-unit deg",
        ),
        (("log.csv", "--least-m", "5"), "--least-m needs --region"),
        (("log.csv", "--tum", "other.txt"), "--tum needs --region"),
        (("log.csv", "--prior", "gnss"), "--prior needs --region"),
        (("log.csv", "--tum", "."), ". cannot be written (Is a directory): name another place"),
        ((".",), "sasgeo-bench: . is no flight log"),
    ],
)
def test_an_option_without_a_meaning_or_beyond_its_range_gets_one_line(mistake, tmp_path, words, expected) -> None:
    (tmp_path / "log.csv").write_text("time_ms,lat,lon,height_ft,heading_deg\n" + ROWS)
    (tmp_path / "run.txt").write_text("0 0 0 80 0 0 0 1\n1 9 0 80 0 0 0 1\n")
    (tmp_path / "line.kml").write_text("<kml><LineString><coordinates>9,47 9,48</coordinates></LineString></kml>")
    assert expected in mistake("import-flight", *words)


def test_gaps_between_flights_are_told_with_their_number(program, tmp_path) -> None:
    rows = "".join(f"{at + 90 * (at > 3)},49.005,{11.001 + at * 6.838e-5:.7f}\n" for at in range(6))
    (tmp_path / "log.csv").write_text("time_s,lat,lon\n" + rows)
    out = program("import-flight", "log.csv")[1].splitlines()
    assert out[1].startswith("2 stretches: a gap of more than 10 s ends one, the longest has 91.0 s")


def test_the_queries_of_a_flight_are_drawn_and_its_stretch_over_the_region_is_written_as_tum(
    program, mistake, lay_towns, tmp_path
) -> None:
    folder = lay_towns(tmp_path / "out", "town-grid") / "regions" / "town-grid"
    west, south, east, north = read_region(folder).grid.bounds_m
    at = np.linspace(west, east, 201)
    poses = np.column_stack(
        [np.arange(201.0), at, 0 * at + (south + north) / 2, 0 * at + 80, *[0 * at] * 3, 0 * at + 1]
    )
    np.savetxt(tmp_path / "run.txt", poses)
    words = ("import-flight", "run.txt", "--region", "town-grid")
    assert "run.txt is named twice" in mistake(*words, "--tum", "run.txt")
    assert not (tmp_path / "out" / "tasks").exists()
    code, out, err = program(*words, "--tum", "cut.txt")
    assert code == 0, err
    task = Path(out.strip())
    assert task == Path("out") / "tasks" / "flight-clean" / "town-grid"
    assert Task.open(tmp_path / task).manifest.is_of_flights
    cut = read_tum(tmp_path / "cut.txt")
    assert cut.position_m[[0, -1], 0] == pytest.approx([west + 100, east - 100], abs=3)
    assert f"wrote cut.txt: {program('import-flight', 'cut.txt')[1]}" in err
    # by the folder of the region, and by the command's old name
    assert program("read-flight", "run.txt", "--region", folder)[1] == out


def test_a_cameras_axes_are_refused_and_read_where_they_are_said(program, mistake, tmp_path) -> None:
    at = np.linspace(0, 300, 301)
    turn = np.radians(60 * np.sin(at / 50))
    east, north = (np.concatenate([[0], np.cumsum(f(turn[:-1]))]) for f in (np.sin, np.cos))
    for name, scale in (("truth.txt", 1.0), ("estimate.txt", 1.05)):
        poses = [at / 10, scale * east, 0 * at, scale * north, 0 * at, np.sin(turn / 2), 0 * at, np.cos(turn / 2)]
        np.savetxt(tmp_path / name, np.column_stack(poses))
    words = ("--truth", "truth.txt", "--estimate", "estimate.txt", "--lengths-m", "100")
    assert "say --axes camera" in mistake("measure-drift", *words)
    assert "say --axes camera" in mistake("import-flight", "truth.txt")
    _, out, _ = program("measure-drift", *words, "--axes", "camera")
    position = next(line.split() for line in out.splitlines() if line.startswith("position_pct "))
    assert float(position[2]) == pytest.approx(4.7, abs=0.3)
    assert "301 poses, 300 m over the ground" in program("import-flight", "truth.txt", "--axes", "camera")[1]


# Logs of autopilots


def test_what_is_read_of_the_log_of_an_autopilot_is_printed_with_its_messages(program, mistake, tmp_path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra [logs]")
    write(tmp_path / "log.tlog", tlog(Flown(), systems=(1, 2)))
    assert "vehicles 1, 2 send places: say which one, as in --vehicle 1" in mistake("import-flight", "log.tlog")
    code, out, err = program("import-flight", "log.tlog", "--vehicle", "2")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "200 points, 317 m, 39.8 s, 7.95 m/s on average",
        "starts at 2025-05-01T10:00:00.000+00:00",
        "place: GPS_RAW_INT, fixes, 5 Hz, accuracy 1.2 m (median)",
        "altitude: above the geoid (the sea)",
        "height: GLOBAL_POSITION_INT.relative_alt, above take-off",
        "attitude: ATTITUDE, yaw from true north",
        "clock: UTC by time_unix_usec of SYSTEM_TIME",
        "not read: GLOBAL_POSITION_INT",
        "vehicle 2, component 1",
        "height from 0.0 to 80.0 m",
        "altitude from 480.0 to 560.0 m",
        "yaw from 0.0 to 359.5 deg",
        "pitch from 0.0 to 0.0 deg",
        "roll from 0.0 to 0.0 deg",
        "longitude from 9.5200 to 9.5230, latitude from 47.1400 to 47.1420 deg",
    ]


@pytest.mark.slow
def test_where_odometry_and_priors_are_from_is_said_and_shown_by_inspect(program, mistake, lay_towns, tmp_path) -> None:
    logged = Logged(lay_towns(tmp_path / "out", "town-grid"))
    logged.write(tmp_path / "a.ulg", has_camera=True, second_m=9.0)
    words = ("import-flight", "a.ulg", "--region", "town-grid", "--height", "90", "--suite", "flight-gap")
    code, out, err = program(*words, "--prior", "gnss", "--drift", "vio-stereo")
    assert code == 0, err
    told = (
        "of the log (vehicle_visual_odometry 0) in ",
        "noise is declared as the profile vio-stereo has it",
        "of sensor_gps 0 of the log, discs of 3 times the accuracy that it states, 15 m (median)",
    )
    shown = " ".join(program("inspect", out.strip())[1].split())
    assert all(part in err and part in shown for part in told)
    before = mistake("import-flight", "a.ulg", "--drift", "vio-stereo")
    assert "--drift needs --region" in before
    assert "--topic is of the odometry of a bag, and a.ulg gives none" in mistake(*words, "--topic", "/vo")
    assert "mine.toml cannot be read as a drift profile" in mistake(*words, "--drift", "mine.toml")
    words = ("make-queries", "--suite", "flight-gap", "--regions", "town-grid", "--n", "1")
    assert "--drift is of a flight: name its log by --flight" in mistake(*words, "--drift", "vio-stereo")
    assert "--odometry is of a flight: name its log by --flight" in mistake(*words, "--odometry", "drawn")
    code, _, err = program(*words, "--flight", "a.ulg", "--height", "90", "--odometry", "drawn")
    assert code == 0, err
    assert "odometry: drawn by profiles of drift: --odometry drawn says so" in err


def test_drift_of_a_log_is_that_of_its_stretches_without_gnss(program, mistake, tmp_path) -> None:
    pytest.importorskip("pyulog", reason="needs the extra [logs]")
    status = {("estimator_status", 0): fusing(lambda time_s: time_s < 20)}
    write(tmp_path / "a.ulg", ulog(px4_drift(1.02, status)))
    write(tmp_path / "b.ulg", ulog(px4_drift(1.04, status)))
    code, out, err = program("measure-drift", "a.ulg", "b.ulg", "--lengths-m", "100,200")
    assert code == 0
    assert err.startswith("2 runs of 2 sequences, ")
    lines = out.splitlines()
    assert lines[1].startswith("a.ulg: odometry: vehicle_local_position 0, 1 stretch of ")
    assert "a.ulg: the receiver is good to 1.2 m, 1.2 % of 100 m" in lines
    rows = [line.split() for line in lines if line.startswith("position_pct ")]
    assert [row[1] for row in rows] == ["100", "200"]
    assert all(float(row[2]) == pytest.approx(3, abs=0.02) for row in rows)
    assert "yaw_deg" not in out  # the estimator turned as the vehicle did
    assert "a profile needs headings" in mistake("measure-drift", "a.ulg", "b.ulg", "--profile", "mine.toml")
    assert "leave out --axes" in mistake("measure-drift", "a.ulg", "--axes", "up")
    for words in ((), ("a.ulg", "--truth", "b.txt")):
        assert "say either logs, or --truth and --estimate" in mistake("measure-drift", *words)
    write(tmp_path / "c.ulg", ulog(px4_drift(1.02, {("estimator_status", 0): fusing(lambda _: True)})))
    assert "it is a copy of the truth, and no odometry" in mistake("measure-drift", "c.ulg")
