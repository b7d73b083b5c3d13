# SPDX-License-Identifier: Apache-2.0
"""The program as a user meets it: exit codes, one line for a mistake, results on stdout."""

import os
import signal
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from sasgeo_bench.cli import segmenters
from sasgeo_bench.cli.program import COMMANDS, help_of, load, spelled_out
from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import read_region_file
from tests.slow import rest_slow

PROGRAM = [sys.executable, "-c", "from sasgeo_bench.cli import main; main()"]


def small_town(folder: Path, **changes: str) -> Path:
    text = (shipped_dir("regions") / "town-suburb.toml").read_text()
    for old, new in ({"size_m = [1024, 1024]": "size_m = [300, 200]"} | changes).items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "own.toml"
    path.write_text(text)
    return path


def test_the_version_lists_and_findings_go_to_stdout(program):
    assert program("--version")[1] == f"sasgeo-bench {metadata.version('sasgeo-bench')}\n"
    code, listed, err = program("list", "regions")
    assert code == 0, err
    assert "2013-08-03 .. 2025-09-19 (9)" in listed
    code, healthy, err = program("doctor")
    assert code == 0, err
    assert "GDAL, GEOS, PROJ" in healthy


def test_a_process_ends_with_the_exit_code_and_keeps_results_and_messages_apart(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    ended = [
        subprocess.run([*PROGRAM, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
        for words in (
            ["list", "regions"],
            ["build-region", "vadus", "--quiet"],
        )  # the second: one line however slow it is
    ]
    assert [item.returncode for item in ended] == [0, 2]
    assert "vaduz" in ended[0].stdout
    assert ended[1].stdout == ""
    assert "did you mean 'vaduz'" in ended[1].stderr
    assert len(ended[1].stderr.splitlines()) == 1


def test_the_package_is_the_program_too():
    command = [sys.executable, "-m", "sasgeo_bench", "--version"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert ended.stdout == f"sasgeo-bench {metadata.version('sasgeo-bench')}\n"


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("--tasks a b c --jobs 2", "--tasks a --tasks b --tasks c --jobs 2"),
        ("--tasks a --tasks b c", "--tasks a --tasks b --tasks c"),
        ("--tasks=a b --dry-run", "--tasks=a --tasks b --dry-run"),
        ("--matcher random extra", "--matcher random extra"),
        ("--tasks a -- b", "--tasks a -- b"),
        ("", ""),
    ],
)
def test_several_values_of_an_option_are_those_that_a_shell_makes_of_a_pattern(words, found):
    assert " ".join(spelled_out(words.split(), load("run").params)) == found


def test_a_run_and_segmentations_take_several_tasks(mistake, monkeypatch):
    assert "there is no folder a: make the queries first" in mistake("run", "--matcher", "random", "--tasks", "a", "b")

    def split(name, *, folders):
        raise ConfigError(f"asked for {name} of {folders}")

    monkeypatch.setattr(segmenters, "find_split", split)
    words = ("--tasks", "a", "b", "--split", "mine", "--region-files", "own")
    assert "asked for mine of (PosixPath('own'),)" in mistake("segment", "--segmenter", "unet", *words)


def test_a_command_with_arguments_takes_one_value_for_each_option():
    words = ["docs/results/systems", "--without", "vaduz", "eschen"]
    assert spelled_out(words, load("enter").params) == words


HELP = """
import sys
from sasgeo_bench.cli import main
try:
    main()
finally:
    assert not {"numpy", "pandas", "sasgeo_bench.regions.build"} & set(sys.modules)
"""


BUILD = """
import atexit, gc, sys
from sasgeo_bench.cli import main, program
load, lean = program.load, []
def loaded(name):
    command = load(name)
    lean.extend((gc.isenabled(), gc.get_freeze_count() > 10_000, collections() == before))
    return command
def collections():
    return sum(each["collections"] for each in gc.get_stats())
program.load, before = loaded, collections()
late = {"scipy.sparse", "scipy.spatial", "scipy.ndimage", "scipy.fft", "pooch", "matplotlib", "pyogrio"}
atexit.register(lambda: print(*lean, len(gc.get_objects()) < 1000, *late & set(sys.modules)))
main()
"""


def test_no_garbage_is_looked_for_around_a_build_and_nothing_is_imported_that_few_need():
    words = ["build-region", "vaduz", "--help"]
    ended = subprocess.run([sys.executable, "-c", BUILD, *words], capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert ended.stdout.splitlines()[-1] == "True True True True", ended.stderr


def test_help_names_every_command_and_reads_the_code_of_none():
    ended = subprocess.run([sys.executable, "-c", HELP, "--help"], capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert ended.returncode == 0, ended.stderr
    for group, commands in COMMANDS.items():
        assert group in ended.stdout
        assert set(commands) <= set(ended.stdout.split())


def test_the_name_of_the_program_alone_and_h_print_the_help(program):
    code, alone, err = program()
    assert (code, err) == (0, "")
    assert alone == program("-h")[1] == program("--help")[1]
    assert program("verify", "-h")[1] == program("verify", "--help")[1]


@pytest.mark.parametrize(("name", "file"), [one for group in COMMANDS.values() for one in group.items()])
def test_every_command_can_be_read_and_has_the_help_that_the_program_shows(program, name, file):
    code, shown, err = program(name, "--help")
    assert code == 0, err
    assert " ".join(help_of(file, name).split()[:5]) in shown


def test_a_region_is_built_inspected_and_verified(program, tmp_path):
    own = small_town(tmp_path, **{'id = "town-suburb"': 'id = "own"'})
    code, _, err = program("build-region", own)
    assert code == 0, err
    assert "own: built out/regions/own" in err
    assert "own: up to date, nothing to do" in program("build-region", own)[2]
    shown = program("inspect", "own")[1]
    assert "(c) OpenStreetMap contributors, ODbL" in shown
    assert "building" in shown
    assert program("verify", "out/regions/own")[0] == 0
    (tmp_path / "out/regions/own/preview.png").write_bytes(b"?")
    code, out, _ = program("verify", "out/regions/own")
    assert code == 2
    assert out.startswith("out/regions/own/preview.png: 1 bytes, the manifest says ")
    assert program("inspect", "own")[2] == f"warning: {out}"


def test_the_towns_of_the_demo_are_a_line_and_your_own_are_listed_whatever_their_name(program, tmp_path):
    small_town(tmp_path, **{'id = "town-suburb"': 'id = "demo-mine"'})
    code, out, err = program("list", "regions", "--region-files", tmp_path)
    assert code == 0, err
    assert [line.split()[0] for line in out.splitlines() if line.startswith("demo-")] == ["demo-mine"]
    assert "and 36 small towns of `leaderboard demo`, demo-..." in err


def test_what_new_region_wrote_is_listed_without_a_word_about_it(program, tmp_path):
    (tmp_path / "my-regions").mkdir()  # where new-region writes, in the folder that a program runs in
    small_town(tmp_path / "my-regions", **{'id = "town-suburb"': 'id = "mine"'}).rename(
        tmp_path / "my-regions/mine.toml"
    )
    listed = program("list", "regions")[1].split()
    assert {"mine", "vaduz"} <= set(listed)


def test_inspect_draws_a_map_that_was_built_on_the_way_to_queries(program, tmp_path):
    spec = read_region_file(Path(small_town(tmp_path)))
    build_region(plan_build(spec, out=tmp_path / "out"))
    code, out, err = program("inspect", spec.id)
    assert code == 0, err
    (drawn,) = (tmp_path / "out/sheets").glob("*.png")
    assert f"out/sheets/{drawn.name}" in out
    assert program("verify", spec.id)[0] == 0


def test_a_dry_run_tells_and_writes_nothing(program, tmp_path):
    own = small_town(tmp_path)
    code, out, err = program("build-region", own, "--dry-run")
    assert code == 0, err
    for word in ("reads", "grid", "200 x 300", "writes", "before compression"):
        assert word in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["own.toml"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("build-region", "vadus"), "did you mean 'vaduz'"),
        (("build-region", "vadus.toml"), "no region file vadus.toml, did you mean 'vaduz'?"),
        (("inspect", "vadus.toml"), "no split file vadus.toml: there are crossfit, demo, flights, holdout"),
        (("make-queries", "--split", "mine"), "no split 'mine': there are crossfit,"),
        (("build-region", "town-grid", "--date", "2013-01-01"), "2014-01-01, 2019-01-01, 2025-01-01"),
        (("build-region", "town-grid", "--regions", "nowhere"), "no folder nowhere"),
        (("inspect", "vaduz"), "out/regions holds no region 'vaduz': build-region vaduz first"),
    ],
)
def test_a_mistake_gets_one_line_and_exit_2(mistake, words, expected):
    assert expected in mistake(*words)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("inspect", "out", "--rows", "0"), "invalid value for '--rows': "),
        (("inspect", "out", "--row", "1"), "no such option: --row"),
        (("inspect",), "missing argument"),
        (("inspct",), "no such command 'inspct'"),
    ],
)
def test_a_wrong_word_on_the_command_line_gets_one_line_that_leads_to_the_help(mistake, words, expected):
    line = mistake(*words)
    assert line.startswith(f"sasgeo-bench: {expected}")
    assert line.endswith("(see 'sasgeo-bench inspect --help')" if words[0] == "inspect" else "'sasgeo-bench --help')")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("cell_size_m = 1.0", "cell_size_m = 0.0", "cell_size_m must lie between"),
        ("cell_size_m", "cell_sise_m", "did you mean 'cell_size_m'"),
        ("size_m = [300, 200]", "size_m = [1e6, 1e6]", "make it smaller"),
        ('morphology = "suburb"', 'morphology = "village"', "morphology"),
        ("center_lonlat = [11.65, 48.65]", "center_lonlat = [11.65, 88.65]", "84"),
    ],
)
def test_a_wrong_region_file_gets_one_line_and_exit_2(mistake, old, new, expected, tmp_path):
    path = small_town(tmp_path)
    path.write_text(path.read_text().replace(old, new))
    assert expected in mistake("build-region", path)
    assert not (tmp_path / "out").exists()


def test_a_missing_extract_names_the_file_its_hash_and_where_to_put_it(mistake, tmp_path):
    text = (shipped_dir("regions") / "monaco.toml").read_text()
    own = tmp_path / "own.toml"
    own.write_text("\n".join(line for line in text.splitlines() if not line.startswith("urls")))
    (tmp_path / "mine").mkdir()
    given = mistake("build-region", own, "--extracts", tmp_path / "mine")
    for word in ("monaco-2025-02-15.osm.pbf", "72dc9a65600864fa", "mine", "--extracts"):
        assert word in given
    assert "'nowhere' does not exist" in mistake("build-region", own, "--extracts", "nowhere")


# Interrupts itself 0.05 s of its own processor time after it tells of a graph, so that no load moves the moment; and
# heeds Ctrl-C, which what is started in the background of a shell does not.
INTERRUPTED = """
import signal, sys
from sasgeo_bench import cli

def tell(text):
    if "features into a graph" in text:
        signal.setitimer(signal.ITIMER_PROF, 0.05)
    return write(text)

signal.signal(signal.SIGINT, signal.default_int_handler)
for name in ("SIGTERM", "SIGHUP"):
    signal.signal(getattr(signal, name), signal.SIG_DFL)

def strike(number, frame):
    signal.raise_signal(NUMBER)

signal.signal(signal.SIGPROF, strike)
write, sys.stderr.write = sys.stderr.write, tell
cli.main()
"""


@pytest.mark.parametrize(("number", "status"), rest_slow([(signal.SIGTERM, 143), (signal.SIGINT, 130)]))
def test_an_interrupt_leaves_nothing_half_written(tmp_path, number, status):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    program = INTERRUPTED.replace("NUMBER", str(int(number)))
    command = [sys.executable, "-c", program, "build-region", "town-suburb", "town-grid"]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert ended.returncode == status, ended.stderr
    assert "interrupted" in ended.stderr
    assert "Traceback" not in ended.stderr
    left = [path for path in (tmp_path / "out/regions").iterdir() if not path.name.endswith(".lock")]
    assert all((path / "region.json").is_file() for path in left)
    assert not any(path.name.startswith(".") for path in left)


# Interrupts itself in a callback of a weak reference, where Python drops what is raised; else it sleeps for a minute.
DROPPED = """
import signal, sys, time, weakref
from sasgeo_bench.cli import interrupts
from sasgeo_bench.cli.interrupts import exit_interrupted, interrupted_by_signals

interrupts._PAUSE_S = DELAY  # with 0 it is sent while the hook still runs, as it may be on a busy machine

class Held:
    pass

signal.signal(signal.SIGTERM, signal.SIG_DFL)
with interrupted_by_signals():
    held = Held()
    watched = weakref.ref(held, lambda _: signal.raise_signal(NUMBER))
    try:
        del held
        time.sleep(60)
    except KeyboardInterrupt:
        sys.exit(exit_interrupted())
"""


@pytest.mark.parametrize("pause_s", [0, 0.01])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupt_that_python_drops_comes_again(tmp_path, number, status, pause_s):
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)" + DROPPED
    command = [sys.executable, "-c", program.replace("NUMBER", str(int(number))).replace("DELAY", str(pause_s))]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert (ended.returncode, ended.stderr) == (status, "")


def test_a_message_without_end_is_cut_in_its_middle(program):
    code, _, err = program("score", "--predictions", "p", "--name", "a" * 5000)
    assert code == 2
    assert len(err) < 2100
    assert " ... " in err
    assert err.startswith("sasgeo-bench: --name must hold letters")
