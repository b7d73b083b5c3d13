# SPDX-License-Identifier: Apache-2.0
"""TUM files: read whole or refused in one line that names the file, the line and the mend."""

import gzip
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights import trajectory
from sasgeo_bench.flights.trajectory import Trajectory, read_tum, write_tum

POSE = "0 0 80 0 0 0 1"
TEXT = f"# time x y z qx qy qz qw\n\n0.0 {POSE}\n0.5\t5 0 80 0 0 0 1\n  # a note\n1e0 10 0 80 0 0 0 1\r\n"


@pytest.mark.parametrize("content", [TEXT, gzip.compress(TEXT.encode(), mtime=0)])
@pytest.mark.parametrize("name", ["run.txt", "run.gz"])
def test_comments_blank_lines_and_any_white_space_are_read_packed_or_not_whatever_the_name(lay, content, name) -> None:
    read = read_tum(lay(content, name))
    assert read.time_s.tolist() == [0.0, 0.5, 1.0]
    assert read.position_m[:, 0].tolist() == [0.0, 5.0, 10.0]


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("1.0 0 0 80 0 0 0", "line 3: 7 words"),
        (f"1.0 {POSE} 5", "line 3: more than 8 words"),
        ("1.0,0,0,80,0,0,0,1", "line 3: 1 words"),
        ("1.0 0 0 nan 0 0 0 1", "line 3: words that are no finite numbers"),
        ("1.0 0 0 8_0 0 0 0 1", "line 3: words that are no finite numbers"),
        ("1.0 0 0 \x1b[31m 0 0 0 1", "line 3: words that are no finite numbers"),
        (f"1400000000000000000 {POSE}", r"line 3: a number of 1\.4e\+18: give times in seconds, positions in metres"),
        (f"0.0 {POSE}", r"line 3: time 0\.0 does not increase: sort the lines"),
        ("1.0 0 0 80 1 0 0 1", r"line 3: the quaternion has length 1\.41421, not 1: the order is qx qy qz qw"),
    ],
)
def test_a_wrong_line_is_named_with_its_mend(lay, line, found) -> None:
    path = lay(f"# head\n0.0 {POSE}\n{line}\n2.0 {POSE}\n")
    with pytest.raises(FlightError, match=found) as error:
        read_tum(path)
    assert str(path) in str(error.value)
    assert str(error.value).isprintable()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("", "holds no pose"),
        ("# nothing\n", "holds no pose"),
        (b"0.0 0 0 80 0 0 0 1\n\xff\xfe", "line 2: no text"),
        (gzip.compress(TEXT.encode(), mtime=0)[:-9], "cannot be read as a trajectory"),
        (gzip.compress(TEXT.encode(), mtime=0) + b"tail", "cannot be read as a trajectory"),
        (b"\x1f\x8b" + b"\x00" * 40, "cannot be read as a trajectory"),
    ],
)
def test_a_file_without_poses_or_damaged_is_refused(lay, content, found) -> None:
    with pytest.raises(FlightError, match=found):
        read_tum(lay(content))


def test_no_file_a_folder_a_pipe_and_a_file_over_the_limits_are_refused(lay, tmp_path, monkeypatch) -> None:
    with pytest.raises(FlightError, match="cannot be read as a trajectory"):
        read_tum(tmp_path / "missing.txt")
    with pytest.raises(FlightError, match="cannot be read as a trajectory"):
        read_tum(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FlightError, match="it is a pipe, a plain file is needed"):
        read_tum(tmp_path / "pipe")
    monkeypatch.setattr(trajectory, "MOST_POSES", 2)
    with pytest.raises(FlightError, match="line 6: more than 2 poses"):
        read_tum(lay(TEXT))
    monkeypatch.setattr(trajectory, "MOST_BYTES", 1000)
    with pytest.raises(FlightError, match="more than 1000 bytes of text"):
        read_tum(lay(gzip.compress(b"#" * 1_000_000, mtime=0)))


@given(st.lists(st.tuples(*[st.floats(-1e5, 1e5)] * 3, *[st.floats(-180, 180)] * 2), min_size=1, max_size=5))
def test_what_is_written_is_read_again(tmp_path_factory, poses) -> None:
    table = np.array(poses)
    flown = Trajectory.of_angles(
        time_s=np.arange(len(poses)) + 1.4e9, position_m=table[:, :3], yaw_deg=table[:, 3], pitch_deg=table[:, 4] / 4
    )
    path = tmp_path_factory.mktemp("tum") / "run.txt"
    write_tum(flown, path)
    again = read_tum(path)
    np.testing.assert_allclose(again.time_s, flown.time_s, atol=1e-6)
    np.testing.assert_allclose(again.position_m, flown.position_m, atol=1e-4)
    np.testing.assert_allclose(again.rotation.as_matrix(), flown.rotation.as_matrix(), atol=1e-7)
