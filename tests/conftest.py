# SPDX-License-Identifier: Apache-2.0
"""What every test shares: no network, reproducible hypothesis runs, and the folder of real extracts."""

import gc
import math
import os
import pickle
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings

from sasgeo_bench import cli
from sasgeo_bench.boards import board_pictures, build
from sasgeo_bench.boards.board_figures import figures_extra
from sasgeo_bench.boards.board_files import AdditionalFiles
from sasgeo_bench.core import progress
from sasgeo_bench.experiments import pipeline_plan
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.running.testing import TinyPlace, tiny_place
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE, FLIGHT_SUITES
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.threaded import threaded

# No test depends on how busy the machine is, nor on chance: the same examples each time. To go on searching:
# make test ARGS="--hypothesis-profile=search".
settings.register_profile(
    "sasgeo",
    deadline=None,
    derandomize=True,
    max_examples=20,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("quick", settings.get_profile("sasgeo"), max_examples=10)
settings.register_profile("search", settings.get_profile("sasgeo"), derandomize=False, max_examples=200)
settings.load_profile("sasgeo")
gc.disable()  # until the tests are collected, of which nothing is garbage: a fifth of that time
os.environ["SASGEO_KEPT_MB"] = "0"  # no test reads or writes what the user keeps of maps (tests/running/test_kept.py)
os.fsync = lambda _: None  # what a test wrote need not outlive a power cut: none waits for the disk
progress.EVERY_S = math.inf  # else lines of progress come between others wherever the machine is slow

BUILDERS = ("test_build.py", "test_cli.py", "test_results.py", "test_town.py")  # build or start something in each test
LOOPBACK = ("127.", "localhost", "::1")


def pytest_collection_finish() -> None:
    """Collect garbage seldom, and never what is there for good: thousands of tests, and the modules they import."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(10_000, 10, 50)  # tables and figures make many objects that die without it


@pytest.hookimpl(tryfirst=True)  # before pytest selects by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that are quick, and skip those on real data, with the reason, where there is none."""
    skip = pytest.mark.skip(reason="real extracts: SASGEO_EXTRACTS names no folder with *.osm.pbf files")
    has_extracts = _extracts_folder() is not None
    for item in items:
        if _is_quick(item):
            item.add_marker("quick")
        if item.get_closest_marker("real") and not has_extracts:
            item.add_marker(skip)


def _is_quick(item: pytest.Item) -> bool:
    """Whether a test shares no fixture of ours with others, as whatever takes long is shared, nor builds for itself."""
    found = getattr(item, "_fixtureinfo").name2fixturedefs.values()  # noqa: B009 - of a function or a docstring's example
    shared = {each[-1].argname for each in found if each[-1].scope != "function" and each[-1].baseid}
    return shared <= {"_no_network"} and not item.get_closest_marker("real") and item.path.name not in BUILDERS


@pytest.fixture(scope="session")
def real_extracts() -> Path:
    """The folder of real extracts; a test that asks for it is skipped where there is none."""
    folder = _extracts_folder()
    if folder is None:
        pytest.skip("real extracts: SASGEO_EXTRACTS names no folder with *.osm.pbf files")
    return folder


@pytest.fixture(scope="session")
def towns(tmp_path_factory: pytest.TempPathFactory, lay_towns: Callable[..., Path]) -> Path:
    """Root of what is built, with two embedded towns in it; copy it before you write there."""

    return _made_once(tmp_path_factory, "towns", lambda out: lay_towns(out, "town-riverside", "town-grid"))


@pytest.fixture(scope="session")
def lay_towns(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Lay embedded towns, each built once for all tests, into a root of one's own; without previews."""

    def lay(out: Path, *names: str) -> Path:
        for name in names:
            built = _made_once(tmp_path_factory, name, partial(_build, name=name))
            shutil.copytree(built / "regions" / name, out / "regions" / name)
        return out

    return lay


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Make a root by its name, once for all processes that share the work; read it, do not write to it."""
    return partial(_made_once, tmp_path_factory)


def _build(out: Path, name: str) -> None:
    plan = plan_build(read_region_file(find_region_file(name)), out=out)
    build_region(plan)


def _made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Make a root once for all processes that share the work; where one fails, the next one tries anew."""
    base = factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    out = base / f"shared-{name}" / "out"
    with FileLock(base / f"shared-{name}.lock"):
        if not out.is_dir():
            partial = Path(tempfile.mkdtemp(prefix=f"shared-{name}-", dir=base)) / "out"
            make(partial)
            out.parent.mkdir()
            partial.rename(out)
    return out


@pytest.fixture
def own_out(towns: Path, tmp_path: Path) -> Path:
    """A root of one's own to write to, with the two towns in it."""
    return Path(shutil.copytree(towns, tmp_path / "out"))


@pytest.fixture(scope="session")
def tasks(towns: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root with the towns and some tasks in them: `clean` at two sites, others at one; read it, do not write to it."""

    def draw(out: Path) -> None:
        shutil.copytree(towns, out)
        made = (("clean", "town-riverside"), ("absent", "town-riverside"), ("alias", "town-grid"))
        for suite, region in (*made, ("topology-twins", "town-grid"), ("no-priors", "town-riverside")):
            count = 2 if suite == "clean" else 1
            wanted = TaskRequest(suites=(suite,), regions=(region,), split="crossfit", count=count, seed=0, out=out)
            for request in plan_requests(wanted):
                make_tasks(request)

    return _made_once(tmp_path_factory, "tasks", draw)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> TinyPlace:
    """The place of the conformance kit, made in a second by each process; read it, do not write to it."""
    return tiny_place(tmp_path_factory.mktemp("tiny") / "place")


@pytest.fixture
def program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """Run the program in an empty folder, without extracts; exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SASGEO_EXTRACTS", raising=False)
    monkeypatch.delenv("SASGEO_OUT", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / "cache"))

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["sasgeo-bench", *map(str, words)])
        with pytest.raises(SystemExit) as leaving:
            cli.main()
        out = capsys.readouterr()
        return int(leaving.value.code or 0), out.out, out.err

    return run


@pytest.fixture
def mistake(program: Callable[..., tuple[int, str, str]]) -> Callable[..., str]:
    """The one line that a user's mistake gets."""

    def run(*words: object) -> str:
        code, out, err = program(*words)
        assert code == 2, err
        assert out == ""
        assert len(err.strip().splitlines()) == 1, err
        return err.strip()

    return run


@pytest.fixture(autouse=True, scope="session")
def _no_network() -> Iterator[None]:
    """Refuse every connection that leaves this machine, so that no test can depend on one."""
    with pytest.MonkeyPatch.context() as patch:
        connect = socket.socket.connect

        def connect_here_only(self: socket.socket, address: object) -> None:
            if self.family != socket.AF_UNIX and not str(address[0]).startswith(LOOPBACK):  # type: ignore[index]
                raise RuntimeError(f"a test tried to reach {address!r}: tests use no network")
            connect(self, address)  # type: ignore[arg-type]

        patch.setattr(socket.socket, "connect", connect_here_only)
        yield


def _extracts_folder() -> Path | None:
    """The first folder of SASGEO_EXTRACTS (a list, as in PATH) that holds extracts."""
    for name in os.environ.get("SASGEO_EXTRACTS", "").split(os.pathsep):
        if name and any(Path(name).glob("*.osm.pbf")):
            return Path(name).resolve()
    return None


@pytest.fixture
def in_threads() -> Iterator[None]:
    """Matchers are served by threads: for tests that are not about processes."""
    with threaded():
        yield


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work for several jobs is done here, each item and result pickled: for tests that are about the same results.

    Processes take seconds to start. tests/core/test_progress.py, test_outlets.py and test_task_batch.py start some.
    """

    def found(work: Callable[[Any], Any], items: Sequence[Any], jobs: int) -> Iterator[Any]:
        return map(work, items) if jobs == 1 else (copied(copied(work)(copied(item))) for item in items)

    def copied(value: Any) -> Any:
        return pickle.loads(pickle.dumps(value))  # noqa: S301 - our own

    monkeypatch.setattr(progress, "_found", found)


def _leave_undrawn(patch: pytest.MonkeyPatch) -> None:
    for name in ("figures_extra", "pictures_extra"):
        patch.setattr(build, name, lambda *_, **__: AdditionalFiles())


@pytest.fixture(scope="module")
def without_drawings() -> Iterator[None]:
    """Boards of pipelines and of the program have no figures and no pictures: for modules that are about rows."""
    with pytest.MonkeyPatch.context() as patch:
        _leave_undrawn(patch)
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same for one test, where others of its module are about figures or pictures."""
    _leave_undrawn(monkeypatch)


@pytest.fixture(scope="module")
def without_pictures() -> Iterator[None]:
    """Boards of pipelines and of the program have no pictures: for tests that are about rows and figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "pictures_extra", lambda *_, **__: AdditionalFiles())
        yield


@pytest.fixture(scope="module")
def few_figures() -> Iterator[None]:
    """Boards of pipelines and of the program have two of their figures, and pictures of two of their cases.

    All are drawn where the test is about them.
    """

    def few(*about: Any, **more: Any) -> AdditionalFiles:
        extra = figures_extra(*about, **more)
        return replace(extra, figures=dict(islice(extra.figures.items(), 2)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "figures_extra", few)
        patch.setattr(board_pictures, "MOST_CASES", 2)
        yield


@pytest.fixture
def plain_site(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sites have blank figures of places and of rates, the dearest of a site: for tests that are about the rest."""

    def blank(path: Path, **_: object) -> None:
        path.write_text('<svg xmlns="http://www.w3.org/2000/svg" width="90pt" height="45pt"/>', encoding="utf-8")

    for name in ("draw_places", "draw_rates"):
        monkeypatch.setattr(f"sasgeo_bench.boards.publish.{name}", blank)


@pytest.fixture(scope="module")
def few_controls() -> Iterator[None]:
    """Pipelines draw their controls at one site of one town: what these find is tested beside their suite."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline_plan, "CONTROL_REGIONS", ("town-suburb",))
        patch.setattr(pipeline_plan, "CONTROL_SITES", 1)
        yield


@pytest.fixture(scope="module")
def small_flight_views() -> Iterator[None]:
    """Views of flights are a ninth of their size, which most of the drawing takes: for tests of ways and of answers."""
    with pytest.MonkeyPatch.context() as patch:
        for name, suite in FLIGHT_SUITES.items():
            views = tuple(replace(item, view_cells=64) for item in suite.variants)
            patch.setitem(EVERY_SUITE, name, replace(suite, variants=views))
        yield


@pytest.fixture
def named(monkeypatch):
    """Put something into a module, and return how it is named."""

    def put(value):
        module = ModuleType("module_of_mine")
        module.ONE = value
        monkeypatch.setitem(sys.modules, module.__name__, module)
        return "module_of_mine:ONE"

    return put


@pytest.fixture
def lay(tmp_path):
    """Write a file, given as text or bytes; its name says nothing."""

    def write(content, name="poses.txt"):
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write
