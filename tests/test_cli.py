# SPDX-License-Identifier: Apache-2.0
"""The program as a user meets it: exit codes, one line for a mistake, results on stdout."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sasgeo_bench.store.catalog import shipped_dir

PROGRAM = [sys.executable, "-c", "from sasgeo_bench.cli import main; main()"]


def run(*words: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    root = str(Path(__file__).parents[1])
    clean = {name: value for name, value in os.environ.items() if not name.startswith("SASGEO")}
    return subprocess.run(  # noqa: S603 - our own program
        [*PROGRAM, *words],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env=clean | {"PYTHONPATH": root, "XDG_CACHE_HOME": str(cwd.parent / "cache")} | environment,
    )


def mistake(*words: str, cwd: Path, **environment: str) -> str:
    """The one line that a user's mistake gets."""
    result = run(*words, cwd=cwd, **environment)
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


def small_town(folder: Path, **changes: str) -> Path:
    text = (shipped_dir("regions") / "town-suburb.toml").read_text()
    for old, new in ({"size_m = [1024, 1024]": "size_m = [300, 200]"} | changes).items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "own.toml"
    path.write_text(text)
    return path


def test_a_region_is_built_inspected_and_verified(tmp_path):
    own = small_town(tmp_path, **{'id = "town-suburb"': 'id = "own"'})
    result = run("build-region", str(own), cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "own: built out/regions/own" in result.stderr
    again = run("build-region", str(own), cwd=tmp_path)
    assert "own: up to date, nothing to do" in again.stderr
    shown = run("inspect", "own", cwd=tmp_path)
    assert "(c) OpenStreetMap contributors, ODbL" in shown.stdout
    assert "building" in shown.stdout
    assert run("verify", "out/regions/own", cwd=tmp_path).returncode == 0
    (tmp_path / "out/regions/own/preview.png").write_bytes(b"?")
    broken = run("verify", "out/regions/own", cwd=tmp_path)
    assert broken.returncode == 2
    assert "preview.png" in broken.stdout


def test_a_dry_run_tells_and_writes_nothing(tmp_path):
    own = small_town(tmp_path)
    result = run("build-region", str(own), "--dry-run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for word in ("reads", "grid", "200 x 300", "writes", "before compression"):
        assert word in result.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["own.toml"]


def test_several_regions_are_built_at_once(tmp_path):
    names = ("town-suburb", "town-agricultural")
    result = run("build-region", *names, "--jobs", "2", "--out", "o", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for name in names:
        assert (tmp_path / "o/regions" / name / "region.json").is_file()


def test_lists_and_findings_go_to_stdout(tmp_path):
    listed = run("list-regions", cwd=tmp_path)
    assert listed.returncode == 0, listed.stderr
    assert "vaduz" in listed.stdout
    assert "2013-08-03 .. 2025-09-19 (9)" in listed.stdout
    healthy = run("doctor", cwd=tmp_path)
    assert healthy.returncode == 0, healthy.stderr
    assert "GDAL, GEOS, PROJ" in healthy.stdout
    assert "liechtenstein-2025-09-19.osm.pbf" in healthy.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("build-region", "vadus"), "did you mean 'vaduz'"),
        (("build-region", "none.toml"), "no region file none.toml"),
        (("build-region", "town-grid", "--date", "2014-13-01"), "must be a date"),
        (("build-region", "town-grid", "--date", "2013-01-01"), "2014-01-01, 2019-01-01, 2025-01-01"),
        (("build-region", "town-grid", "--regions", "nowhere"), "no folder nowhere"),
        (("inspect", "vaduz"), "build the region first"),
        (("verify", "nowhere"), "holds no region.json"),
    ],
)
def test_a_mistake_gets_one_line_and_exit_2(words, told, tmp_path):
    assert told in mistake(*words, cwd=tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("cell_size_m = 1.0", "cell_size_m = 0.0", "cell_size_m must lie between"),
        ("cell_size_m", "cell_sise_m", "did you mean 'cell_size_m'"),
        ("size_m = [300, 200]", "size_m = [1e6, 1e6]", "make it smaller"),
        ('morphology = "suburb"', 'morphology = "village"', "morphology"),
        ("center_lonlat = [11.65, 48.65]", "center_lonlat = [11.65, 88.65]", "84"),
    ],
)
def test_a_wrong_region_file_gets_one_line_and_exit_2(old, new, told, tmp_path):
    path = small_town(tmp_path)
    path.write_text(path.read_text().replace(old, new))
    assert told in mistake("build-region", str(path), cwd=tmp_path)
    assert not (tmp_path / "out").exists()


def test_a_missing_extract_names_the_file_its_hash_and_where_to_put_it(tmp_path):
    text = (shipped_dir("regions") / "monaco.toml").read_text()
    own = tmp_path / "own.toml"
    own.write_text("\n".join(line for line in text.splitlines() if not line.startswith("urls")))
    told = mistake("build-region", str(own), "--extracts", "mine", cwd=tmp_path)
    for word in ("monaco-2025-02-15.osm.pbf", "72dc9a65600864fa", "mine", "--extracts"):
        assert word in told


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_the_right_to_write_is_told(tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    assert "cannot be written" in mistake("build-region", "town-grid", "--out", "locked", cwd=tmp_path)


# What is started in the background of a shell does not hear Ctrl-C, nor does what it starts.
HEEDS_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "


def test_ctrl_c_leaves_nothing_half_written(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    program = [*PROGRAM[:2], HEEDS_CTRL_C + PROGRAM[2]]
    words = [*program, "build-region", "town-riverside", "town-old-town", "town-suburb", "town-grid"]
    with subprocess.Popen(  # noqa: S603 - our own program
        words, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        for line in process.stderr:
            if "features into a graph" in line:
                break
        time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130
    assert "interrupted" in rest
    assert "Traceback" not in rest
    left = [path for path in (tmp_path / "out/regions").iterdir() if not path.name.endswith(".lock")]
    assert all((path / "region.json").is_file() for path in left)
    assert not any(path.name.startswith(".") for path in left)


def test_a_message_without_end_is_cut_in_its_middle(program):
    code, _, err = program("score", "--predictions", "p", "--name", "a" * 5000)
    assert code == 2
    assert len(err) < 2100
    assert " ... " in err
    assert err.startswith("sasgeo-bench: --name must hold letters")
