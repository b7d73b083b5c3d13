# SPDX-License-Identifier: Apache-2.0
"""The command that measures drift: a table to stdout, files that are asked for, mistakes on one line."""

import gzip

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.files.parquet import read_frame
from sasgeo_bench.flights.drift_profile import load_profile, read_drift_profile
from sasgeo_bench.flights.odometry import dead_reckon, draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.flights.tum import write_tum


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
    ("words", "told"),
    [
        (("--lengths-m", "20,x"), "--lengths-m must be positive metres as in 10,50, got '20,x'"),
        (("--lengths-m", "0"), "--lengths-m must be positive metres"),
        (("--lengths-m", ""), "--lengths-m must be positive metres"),
        (("--truth", "lonely.txt"), "give one --estimate for each --truth, got 4 truths and 3 estimates"),
        (("--truth", "no.txt", "--estimate", "no.txt"), "no.txt cannot be read as a trajectory (No such file"),
        (("--truth", "bad.txt", "--estimate", "bad.txt"), "bad.txt, line 1: 3 words: a line is 'time_s x y z"),
        (("--truth", "late.txt", "--estimate", "truth-1.txt"), "truth-1.txt against late.txt: 0 of 151 poses of the"),
        (("--truth", "loop", "--estimate", "truth-1.txt"), "loop cannot be read as a trajectory (Too many levels"),
        (("--results", "truth-1.txt"), "truth-1.txt is named twice, to read from and to write to: name another file"),
        (("--results", "new", "--profile", "new"), "new is named twice"),
        (("--lost-s", "-1"), "lost-s"),
    ],
)
def test_a_mistake_gets_one_line(mistake, pairs, tmp_path, words, told) -> None:
    (tmp_path / "bad.txt").write_text("0 1 2\n")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "late.txt").write_text("1e9 0 0 0 0 0 0 1\n1000000001 5 0 0 0 0 0 1\n")
    assert told in mistake("measure-drift", *pairs, *words)


def test_results_that_cannot_be_written_leave_nothing_behind(program, pairs, tmp_path) -> None:
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.iterdir())
    code, _, err = program("measure-drift", *pairs, "--results", "folder")
    assert code == 2
    assert err.splitlines()[-1].startswith(
        "sasgeo-bench: folder cannot be written (Is a directory): name another place"
    )
    assert sorted(tmp_path.iterdir()) == before


def test_a_profile_that_cannot_be_named_or_written_gets_one_line_after_the_table(program, pairs, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    for name, told in (("Not a name.toml", "'id'"), ("file/mine.toml", "cannot be written")):
        code, out, err = program("measure-drift", *pairs, "--profile", name)
        assert code == 2
        assert told in err.splitlines()[-1]
        assert "position_pct" in out
