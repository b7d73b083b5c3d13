# SPDX-License-Identifier: Apache-2.0
"""What a command prints, and where: quiet ones, the log file, signs of life, and how an interrupted one goes on."""

import os
import re
import subprocess
import sys
from pathlib import Path
from threading import Event

import pytest

from sasgeo_bench.cli import console
from sasgeo_bench.cli import program as program_file
from sasgeo_bench.cli.console import complain, heartbeat, note, open_outlets, outlets, say, tell
from sasgeo_bench.core import progress
from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import Lines

TIMED = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00 .+")


def logged(path):
    """Lines of a log without their times, each of which has one."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert all(TIMED.fullmatch(line) for line in lines)
    return [line.split(" ", maxsplit=1)[1] for line in lines]


def speak():
    tell("on the way")
    say("first\nsecond\n")
    say("last")
    complain("a fault")


def test_a_quiet_command_prints_errors_and_the_last_line_of_its_result(capsys):
    with outlets():
        open_outlets(quiet=True, log=None)
        speak()
    assert capsys.readouterr() == ("last\n", "a fault\n")
    with outlets():
        speak()
    assert capsys.readouterr() == ("first\nsecond\n\nlast\n", "on the way\na fault\n")


def test_a_quiet_command_is_not_silent_to_its_log(monkeypatch):
    """Else signs of life would follow each other without a pause."""
    with outlets():
        open_outlets(quiet=True, log=None)
        for outlet in (tell, say, complain):
            monkeypatch.setattr(console._heard, "last_s", 0.0)
            outlet("a line")
            assert console._heard.last_s > 0.0


@pytest.mark.parametrize("quiet", [False, True])
def test_a_log_gets_every_line_and_keeps_what_it_held(tmp_path, monkeypatch, quiet):
    monkeypatch.setattr("sys.argv", ["sasgeo-bench", "doctor"])
    path = tmp_path / "all.log"
    for _ in range(2):
        with outlets():
            open_outlets(quiet=quiet, log=path)
            speak()
        note("of no command")
    assert logged(path) == 2 * ["sasgeo-bench doctor", "on the way", "first", "second", "last", "a fault"]


def test_every_command_has_both_flags_and_they_end_with_it(program, tmp_path):
    code, out, err = program("list", "regions", "--quiet", "--log", "all.log")
    assert (code, len(out.splitlines()), err) == (0, 1, "")
    assert len(program("list", "regions")[1].splitlines()) > 20
    code, out, err = program("build-region", "vadus", "--quiet", "--log", "all.log")
    assert (code, out) == (2, "")
    assert "did you mean 'vaduz'" in err
    lines = logged(tmp_path / "all.log")
    assert lines[0] == "sasgeo-bench list regions --quiet --log all.log"
    assert lines[-3:] == ["sasgeo-bench build-region vadus --quiet --log all.log", err.strip(), "ended with status 2"]
    assert lines.count("ended with status 0") == 1
    assert not {progress.QUIET, console.LOG} & set(os.environ)


@pytest.mark.slow
def test_two_processes_of_a_quiet_command_build_a_region_each_and_are_quiet_and_write_the_same_log(program, tmp_path):
    for name in ("town-suburb", "town-old-town"):
        text = (shipped_dir("regions") / f"{name}.toml").read_text(encoding="utf-8")
        small = re.sub(r"size_m = \[.*\]", "size_m = [300, 200]", text).replace(f'id = "{name}"', f'id = "my-{name}"')
        (tmp_path / f"{name}.toml").write_text(small, encoding="utf-8")
    words = ("town-suburb.toml", "town-old-town.toml", "--jobs", "2", "--log", "all.log", "--quiet")
    assert program("build-region", *words) == (0, "", "")
    lines = logged(tmp_path / "all.log")
    for name in ("my-town-suburb", "my-town-old-town"):
        assert f"{name}: built out/regions/{name}" in lines
        assert (tmp_path / "out" / "regions" / name / "region.json").is_file()


@pytest.mark.parametrize("log", ["none/all.log", "."])
def test_a_log_that_cannot_be_written_is_one_line(mistake, log):
    assert "cannot be written" in mistake("list", "suites", "--log", log)
    assert "name a file in a folder of yours" in mistake("list", "suites", "--log", log)


def test_a_log_that_can_no_longer_be_written_stops_once_and_then_is_left_alone(tmp_path, capsys):
    with outlets():
        open_outlets(quiet=False, log=tmp_path / "all.log")
        (tmp_path / "all.log").unlink()
        (tmp_path / "all.log").mkdir()
        with pytest.raises(StoreError, match=r"all\.log cannot be written"):
            tell("on the way")
        complain("a fault")
    assert capsys.readouterr().err == "on the way\na fault\n"


def test_a_silent_command_says_that_it_is_at_work_and_how_far_it_is(monkeypatch):
    """Waits for lines, however long they take, and measures no time."""
    lines, both = [], Event()

    def hear(line):
        lines.append(line)
        if len(lines) > 1:
            both.set()

    monkeypatch.setattr(console, "tell", hear)
    monkeypatch.setattr(progress, "EVERY_S", 0.01)
    counts = Lines(lambda _: None)
    counts.begin("regions built", 2)
    monkeypatch.setattr(console._heard, "counts", counts)
    with heartbeat():
        assert both.wait(600)
    assert all(re.fullmatch(r"at work for \d+ s; regions built: 0 of 2", line) for line in lines)


def test_an_interrupted_command_says_what_is_kept_and_how_to_go_on(program, monkeypatch):
    def strike(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("sasgeo_bench.regions.build.build_region", strike)
    monkeypatch.setattr("sasgeo_bench.cli.doctor.examine", strike)
    code, out, err = program("build-region", "town-grid", "--quiet")
    assert (code, out) == (130, "")
    assert err == ("sasgeo-bench: interrupted; regions that were built are kept; the same command builds the others\n")
    message = "sasgeo-bench: interrupted; nothing is half-written, and what was there before is kept; run it again\n"
    assert program("doctor")[2] == message


# Strikes when a module is imported, once: as an interrupt, or as what Python 3.11 makes of one in a class body.
STRUCK = """
import sys
from sasgeo_bench.cli import main

class Striking:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r} and sys.meta_path.pop(0):
            {strike}

sys.meta_path.insert(0, Striking())
main()
"""


@pytest.mark.parametrize("strike", ["raise KeyboardInterrupt", "raise RuntimeError('x') from KeyboardInterrupt()"])
@pytest.mark.parametrize(
    ("module", "expected"),
    [("typer", "interrupted before it began; run it again"), ("rasterio", "interrupted; regions that were built are")],
)
def test_an_interrupted_import_is_one_line(tmp_path, strike, module, expected):
    words = [sys.executable, "-c", STRUCK.format(module=module, strike=strike), "build-region", "town-grid"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert (ended.returncode, ended.stdout) == (130, "")
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f"sasgeo-bench: {expected}")


def test_what_is_kept_is_said_of_commands_that_there_are():
    known = {name for commands in program_file.COMMANDS.values() for name in commands}
    assert set(program_file.KEPT) <= known


def test_a_fault_of_ours_is_in_the_log_with_its_traceback(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["sasgeo-bench", "doctor", "--log", "all.log"])
    monkeypatch.setattr("sasgeo_bench.cli.doctor.examine", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        program_file.main()
    assert "ZeroDivisionError: division by zero" in logged(Path("all.log"))
