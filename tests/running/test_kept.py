# SPDX-License-Identifier: Apache-2.0
"""What is kept of a map is what would be made, of this map and these settings; and no plugin can change it."""

import io
import json
import os
import pwd
import select
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from sasgeo_bench.boards.archive import fits_folder
from sasgeo_bench.cli.doctor import examine
from sasgeo_bench.core import room
from sasgeo_bench.core.errors import MatchError, StoreError
from sasgeo_bench.core.folders import remove_tree
from sasgeo_bench.regions.region_files import read_manifest, read_region
from sasgeo_bench.running import keeper, kept, sandbox, worker
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.raster import likeness_by_hand, read_field
from sasgeo_bench.sasgeo.rates import FAR
from sasgeo_bench.sasgeo.weights import STRATA
from sasgeo_bench.search.stored import FACTORS
from sasgeo_bench.search.view import Chart
from sasgeo_bench.tasks import task_files
from tests.threaded import Threaded

SETTINGS = {"thin": ["road_major", "railway"], "reach_m": 4.0}
shut_in = pytest.mark.skipif(sandbox.landlock_version() <= 0, reason="this kernel has no Landlock to refuse files with")


@pytest.fixture(autouse=True)
def shelf(tmp_path, monkeypatch):
    """A cache of one's own, in which the smallest maps are kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("SASGEO_KEPT_MB", "1000")
    monkeypatch.setattr(kept, "LEAST_CELLS", 1)
    return tmp_path / "cache" / "sasgeo-bench" / "maps"


@pytest.fixture
def here(monkeypatch):
    """What is kept is made in this process; the orders in a list."""
    orders = []

    def make(ordered):
        order = json.loads(ordered)
        for wanted in order["wanted"]:
            orders.append(dict(wanted))
            keeper.keep(Path(order["region"]), Path(wanted.pop("folder")), **wanted)

    monkeypatch.setattr(kept, "_make", make)
    return orders


def town_of(place, task):
    return place / "out" / "regions" / task.name


def asked(region, what, **settings):
    """What is kept of the map by some settings, made if it is not there."""
    wanted = {"what": what, "settings": settings, "digest": read_manifest(region).digest}
    if kept.kept_of(region, **wanted) is None:
        kept.order(region, [wanted])
        kept._ORDERS.join()
    return kept.kept_of(region, **wanted)


def keeping(region):
    """The region, as a matcher's process gets it."""
    found = read_region(region, with_layers=False)
    vars(found)["keep"] = lambda what, settings: asked(region, what, **settings)
    return found


@pytest.mark.parametrize("is_trusted", [False, True])
def test_a_kept_field_is_that_which_would_be_made_on_every_level(is_trusted, place, task, here):
    region = town_of(place, task)
    likeness = likeness_by_hand(read_manifest(region).classes)
    trust = np.linspace(1.0, 0.3, len(likeness) * STRATA).reshape(-1, STRATA) if is_trusted else None
    made, found = (read_field(one, likeness, trust=trust) for one in (read_region(region), keeping(region)))
    assert len(here) == 1
    assert found.grid == made.grid
    for factor in (*FACTORS, 64):
        one, two = made.level(factor), found.level(factor)
        np.testing.assert_array_equal(one.cells.fours, two.cells.fours)
        np.testing.assert_array_equal(one.thinner, two.thinner)
        assert one.grid == two.grid


def test_a_kept_chart_is_that_which_would_be_made(place, task, here):
    region = town_of(place, task)
    thin = tuple(SETTINGS["thin"])
    made, found = (Chart.of(one, thin=thin, reach_m=4.0) for one in (read_region(region), keeping(region)))
    assert len(here) == 1
    for name in ("degree", "known", "totals"):
        np.testing.assert_array_equal(getattr(made, name), getattr(found, name))
    assert (made.grid, made.classes) == (found.grid, found.classes)
    is_known = made.known > 0
    means = [layer[is_known].mean() / 255 if is_known.any() else 0.0 for layer in made.degree]
    assert found.shares().tolist() == means
    np.testing.assert_array_equal(found.used(), [layer.max() > 0 for layer in made.degree])


def test_a_kept_graph_is_that_which_would_be_made(place, task, here):
    region = town_of(place, task)
    made, found = (MappedGraph.of(one) for one in (read_region(region), keeping(region)))
    assert len(here) == 1
    for name in kept_fields(made):
        one, two = getattr(made.nodes, name), getattr(found.nodes, name)
        np.testing.assert_array_equal(one, two)
        assert one.dtype == two.dtype
    np.testing.assert_array_equal(made.density_per_m2, found.density_per_m2)
    np.testing.assert_array_equal(made.known, found.known)
    np.testing.assert_array_equal(made.tree.data, found.tree.data)


def kept_fields(graph):
    return type(graph.nodes).__dataclass_fields__


def test_what_is_there_is_not_made_again_but_for_another_map_other_settings_or_other_code(
    place, task, here, monkeypatch
):
    region = town_of(place, task)
    first = asked(region, "chart", **SETTINGS)
    assert asked(region, "chart", **SETTINGS) == first
    assert len(here) == 1
    others = [asked(region, "chart", **SETTINGS | {"reach_m": 5.0}), asked(region, "graph")]
    for name in ("code_hash", "installed"):
        monkeypatch.setattr(kept, name, lambda: "changed")
        others.append(asked(region, "chart", **SETTINGS))
    assert len({first, *others}) == len(here) == 5
    assert None not in others


def test_nothing_is_given_of_a_map_that_was_built_anew(place, task, here):
    region = town_of(place, task)
    assert kept.kept_of(region, "graph", {}, digest="0" * 64) is None
    assert here == []
    with pytest.raises(StoreError, match="was built anew meanwhile"):
        keeper.keep(region, kept.shelf_of(region) / "one", "graph", {}, digest="0" * 64)
    assert [*kept.shelf_of(region).iterdir()] == []


def test_every_statement_of_a_manifest_counts(place, task):
    manifest = read_manifest(town_of(place, task))
    extract = manifest.extract.model_copy(update={"date": manifest.extract.date.replace(year=1999)})
    changed = [
        manifest.model_copy(update=update)
        for update in ({"extract": extract}, {"rows": manifest.rows + 1}, {"files": {}}, {"classes": ("water",)})
    ]
    assert len({one.digest for one in (manifest, *changed)}) == len(changed) + 1
    assert manifest.digest == read_manifest(town_of(place, task)).digest


@pytest.mark.parametrize("damage", ["shorter", "missing", "unfinished"])
def test_what_was_damaged_is_made_again(damage, place, task, here):
    folder = asked(town_of(place, task), "chart", **SETTINGS)
    path = folder / ("kept.json" if damage == "unfinished" else "known.npy")
    if damage == "shorter":
        os.truncate(path, 100)
    else:
        path.unlink()
    assert asked(town_of(place, task), "chart", **SETTINGS) == folder
    assert len(here) == 2
    assert len(np.load(folder / "known.npy"))


def test_a_matcher_makes_what_was_removed_meanwhile(place, task):
    region = read_region(town_of(place, task), with_layers=False)
    vars(region)["keep"] = lambda *_: place / "nowhere"
    assert Chart.of(region).used().any()
    assert len(MappedGraph.of(region).nodes)
    assert read_field(region, likeness_by_hand(region.classes)).known.any()


def test_a_matcher_makes_what_was_overwritten(place, task, here):
    found = keeping(town_of(place, task))
    makers = [Chart.of, MappedGraph.of, lambda region: read_field(region, likeness_by_hand(region.classes))]
    for make in makers:
        make(found)
    assert len(here) == len(makers)
    for path in kept.shelf_of(town_of(place, task)).glob("*/*[ny]"):  # arrays and levels.json
        if path.name != "kept.json":
            path.write_bytes(bytes(path.stat().st_size))
    for make in makers:
        assert make(found).known.any()


def test_a_part_of_a_map_is_not_taken_for_the_whole(place, task):
    region = read_region(town_of(place, task), with_layers=False)
    vars(region)["keep"] = pytest.fail
    (part,) = region.cuts([(0, 0, 64, 64)])
    assert Chart.of(part).degree.shape[1:] == (64, 64)
    assert MappedGraph.of(region.within(region.coverage.buffer(-100.0))).known.any()


def test_what_was_not_asked_for_longest_is_removed_first(place, task, here, monkeypatch):
    region = town_of(place, task)
    folders = [asked(region, "chart", thin=[], reach_m=float(at)) for at in range(4)]
    for at, folder in enumerate(folders):
        os.utime(folder / "kept.json", (at, at))
    size = sum(path.stat().st_size for path in folders[0].iterdir())
    asked(region, "chart", thin=[], reach_m=0.0)  # asked for again
    monkeypatch.setenv("SASGEO_KEPT_MB", str(int(4.5 * size / 1e6)))
    more = asked(region, "chart", thin=[], reach_m=9.0)
    assert [folder.is_dir() for folder in (*folders, more)] == [True, False, True, True, True]
    monkeypatch.setenv("SASGEO_KEPT_MB", "0")
    assert asked(region, "chart", thin=[], reach_m=0.0) is None
    assert len(here) == 5


def test_without_a_folder_that_can_be_written_nothing_is_kept(place, task, here, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert kept.shelf_of(town_of(place, task)) is None
    assert asked(town_of(place, task), "graph") is None
    assert here == []


@pytest.mark.parametrize("fault", ["no home", "a home that is no path", "a circle"])
def test_without_a_cache_nothing_is_kept(fault, place, task, here, tmp_path, monkeypatch):
    if fault == "no home":  # as of a user who is only a number, in a container
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.delenv("HOME")
        monkeypatch.setattr(pwd, "getpwuid", {}.__getitem__)
    elif fault == "a home that is no path":
        monkeypatch.setenv("XDG_CACHE_HOME", "beside")
        monkeypatch.setenv("HOME", "mine")
    else:
        (tmp_path / "one").symlink_to("two")
        (tmp_path / "two").symlink_to("one")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "one"))
    region = town_of(place, task)
    assert (kept.shelf_of(region), asked(region, "graph"), here) == (None, None, [])
    assert replies(place, task, "graph_only")[1].status == "ok"
    assert (fits_folder() is None) == (fault != "a circle")
    (words,) = [words for what, words in examine([], out=tmp_path) if what == "kept of maps and answers"]
    assert fault == "a circle" or words.endswith("name a folder by XDG_CACHE_HOME")


@pytest.mark.parametrize("fault", [StoreError("full"), SystemExit("stopped"), KeyboardInterrupt()])
def test_of_what_was_made_in_part_nothing_is_left(fault, place, task, monkeypatch):
    def make(_, into):
        (into / "known.npy").touch()
        raise fault

    monkeypatch.setitem(keeper.MAKERS, "graph", make)
    region = town_of(place, task)
    with pytest.raises(type(fault)):
        keeper.keep(region, kept.shelf_of(region) / "one", "graph", {}, digest=read_manifest(region).digest)
    assert [*kept.shelf_of(region).iterdir()] == []


def test_what_cannot_be_made_is_told_once(place, task, monkeypatch):
    told = []
    monkeypatch.setattr(kept, "tell", told.append)
    kept._tell_once.cache_clear()
    region = town_of(place, task)
    assert [asked(region, "chart", thin=[], reach_m=1e9) for _ in range(2)] == [None, None]
    assert len(told) == 1
    assert "lines fade within 100 m, not 1000000000.0" in told[0]


@pytest.mark.usefixtures("here")
def test_what_a_killed_process_left_goes_in_time(place, task):
    region = town_of(place, task)
    folders = [kept.shelf_of(region) / f".{name}.partial" for name in ("old", "new")]
    for folder in folders:
        folder.mkdir()
        (folder / "kept.json").write_text("{}", encoding="utf-8")
    os.utime(folders[0], (0, 0))
    asked(region, "graph")
    assert [folder.is_dir() for folder in folders] == [False, True]


def test_code_that_changed_since_a_process_began_makes_nothing(place, task, monkeypatch):
    monkeypatch.setattr(kept, "code_hash", lambda: "of other code")
    told = []
    monkeypatch.setattr(kept, "tell", told.append)
    kept._tell_once.cache_clear()
    assert asked(town_of(place, task), "graph") is None
    assert "the program was changed meanwhile" in told[0]


def of_python(program, **more):
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, **more)  # noqa: S603


@pytest.mark.parametrize("number", ["SIGALRM", "SIGINT", "SIGHUP"])
@pytest.mark.parametrize("is_swallowed", [False, True])
def test_a_maker_that_is_stopped_leaves_nothing_and_says_why(number, is_swallowed, place, task, shelf):
    """As one that takes too long is by itself, and one of an interrupted command by the terminal."""
    region = town_of(place, task)
    wanted = {"what": "graph", "settings": {}, "digest": read_manifest(region).digest}
    wanted["folder"] = str(kept.shelf_of(region) / "one")
    order = {"region": str(region), "wanted": [wanted], "code": kept.code_hash()}
    program = (
        "import os, signal; from contextlib import suppress; from sasgeo_bench.running import keeper\n"
        f"keeper._AGAIN_S = 0.01; signal.signal(signal.{number}, signal.SIG_DFL)\n"  # the tests may run by `nohup`
        "def make(_, into):\n"
        f"    with suppress({'SystemExit' if is_swallowed else ''}):\n"
        f"        (into / 'a').touch(); os.kill(os.getpid(), signal.{number})\n"
        "    signal.pause()\n"
        "keeper.MAKERS['graph'] = make; keeper.main()"
    )
    said = of_python(program, input=json.dumps(order)).stderr.strip()
    assert said == f"it was stopped by {'SIGALRM' if is_swallowed else number}"
    assert [*shelf.rglob("*")] == [kept.shelf_of(region)]


def test_a_run_that_ends_first_leaves_a_whole_map_and_then_no_process(place, task, shelf):
    region = town_of(place, task)
    wanted = {"what": "graph", "settings": {}, "digest": read_manifest(region).digest}
    program = (
        "import subprocess, sys, threading, pathlib; from sasgeo_bench.running import kept; kept.LEAST_CELLS = 1\n"
        "class Told(subprocess.Popen):\n"
        "    def communicate(self, *words, **more):\n"
        "        print(self.pid, flush=True); has_begun.set(); return super().communicate(*words, **more)\n"
        "kept.installed()  # asks another program\n"
        "has_begun, subprocess.Popen = threading.Event(), Told\n"
        f"kept.order(pathlib.Path({str(region)!r}), [{wanted!r}]); has_begun.wait()"
    )
    with suppress(ProcessLookupError):  # it ended before we looked
        select.select([os.pidfd_open(int(of_python(program).stdout))], [], [])
    (folder,) = shelf.glob("*/*")
    assert room.is_whole(folder)
    assert len(MappedGraph.open(folder, grid=read_manifest(region).grid).nodes)


def test_a_cache_where_plugins_are_imported_from_is_hidden_and_nothing_is_kept_in_it(
    place, task, shelf, tmp_path, monkeypatch
):
    region = town_of(place, task)
    worker = Worker(spec="graph_only", reach=Reach(readable=[region], hidden=[]), limits=Limits())
    cache = [str(shelf), str(shelf.with_name("rejectors"))]
    assert not {*cache} & {*worker._policy("/scratch").hidden}
    monkeypatch.chdir(tmp_path)  # as of a user who works at home
    assert [reply.status for reply in replies(place, task, "graph_only")] == ["ok"] * 2
    assert [*shelf.glob("*/*/")] == []
    policy = worker._policy("/scratch")
    assert {*cache} <= {*policy.hidden}
    assert not any(path.startswith(str(shelf.parent)) for path in policy.readable)


def replies(place, task, spec):
    """The replies of a matcher in a process of its own to the preparation and the first query."""
    region = town_of(place, task)
    query = task_files.query_bytes(next(iter(task_files.read_queries(task))))
    reach = Reach(readable=[region], hidden=[place / "out" / "truth"])
    with Worker(spec=spec, reach=reach, limits=Limits(match_s=600.0, memory_bytes=10**9)) as worker:
        return worker.prepare(region), worker.match(query, top_k=5)


def test_a_matcher_answers_by_what_is_kept_as_without(place, task, shelf, monkeypatch):
    first = replies(place, task, "sasgeo_prior")
    kept._ORDERS.join()
    folders = sorted(shelf.glob("*/*/"))
    assert len(folders) == 2  # a field and a graph
    given = []
    monkeypatch.setattr(
        worker, "kept_of", lambda *words, **more: given.append(kept.kept_of(*words, **more)) or given[-1]
    )
    monkeypatch.setattr(kept, "_make", pytest.fail)
    again = replies(place, task, "sasgeo_prior")
    kept._ORDERS.join()
    assert sorted(given) == folders
    monkeypatch.setenv("SASGEO_KEPT_MB", "0")
    without = replies(place, task, "sasgeo_prior")
    assert [reply.status for reply in (*first, *again, *without)] == ["ok"] * 6
    assert first[1].found == again[1].found == without[1].found


def test_a_matcher_waits_for_nothing_that_is_made(place, task, here, monkeypatch):
    make, may_end = kept._make, threading.Event()
    monkeypatch.setattr(kept, "_make", lambda ordered: may_end.wait() and make(ordered))
    try:
        assert [reply.status for reply in replies(place, task, "graph_only")] == ["ok"] * 2
        assert [reply.status for reply in replies(place, task, "graph_only")] == ["ok"] * 2
        assert here == []
    finally:
        may_end.set()
        kept._ORDERS.join()
    assert [order["what"] for order in here] == ["chart"]  # for both


def test_a_cache_that_can_only_be_read_is_read(place, task, here, monkeypatch):
    region = town_of(place, task)
    folder = asked(region, "graph")
    is_writable = os.access
    monkeypatch.setattr(os, "utime", mock.Mock(side_effect=PermissionError))  # root may write everywhere
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK and is_writable(path, mode))
    assert asked(region, "graph") == folder
    assert asked(region, "chart", **SETTINGS) is None
    assert len(here) == 1


@shut_in
def test_a_matcher_reads_what_is_kept_of_its_map_alone_and_changes_nothing(place, task, shelf):
    assert asked(town_of(place, task), "chart", thin=[], reach_m=0.0)
    (shelf / "another map").mkdir()
    ready, found = replies(place, task, "hostile:ReadsWhatIsKept")
    assert ready.status == "ok", ready.message
    assert found.found.diagnostics == {"is there": 1.0, "other maps": 0.0, "written": 0.0, "nonsense": 0.0}


def test_a_process_that_has_seen_a_query_is_given_nothing(place, task, here):
    region = town_of(place, task)
    query = task_files.query_bytes(next(iter(task_files.read_queries(task))))
    with Threaded(spec="graph_only", reach=Reach(readable=[region], hidden=[]), limits=Limits()) as worker:
        assert worker.prepare(region).status == "ok"
        assert worker.match(query, top_k=1).status == "ok"
        kept._ORDERS.join()
        for path in kept.shelf_of(region).iterdir():
            remove_tree(path)
        assert worker.prepare(region).status == "ok"
    kept._ORDERS.join()
    assert len(here) == 1


def test_a_size_that_is_none_is_told_once_and_the_usual_one_holds(monkeypatch):
    told = []
    monkeypatch.setattr(room, "tell", told.append)
    monkeypatch.setenv("SASGEO_KEPT_MB", "1 GB")
    assert [room.most_bytes() for _ in range(2)] == [room.MOST_MB * 10**6] * 2
    assert told == ["SASGEO_KEPT_MB is '1 GB', no whole number of megabytes: 4000 are kept at most"]
    monkeypatch.setenv("SASGEO_KEPT_MB", "9" * 5000)  # Python makes no number of so many digits
    assert room.most_bytes() == room.MOST_MB * 10**6
    assert len(told[1]) < 120


def test_a_matcher_that_asks_for_something_else_is_refused(place, task):
    ready, _ = replies(place, task, "hostile:AsksForWhatIsNotKept")
    assert (ready.status, "an answer that is none" in ready.message) == ("invalid", True)


LIKENESS = [[1.0] * (FAR + 1)] * 5
BAD = {
    "a cell of a country": ("field", {"likeness": LIKENESS, "trust": None, "cell_size_m": 1e6}),
    "a cell of nothing": ("field", {"likeness": LIKENESS, "trust": None, "cell_size_m": -1.0}),
    "no shares": ("field", {"likeness": [[7.0] * (FAR + 1)] * 5, "trust": None, "cell_size_m": 2.0}),
    "shares of nothing": ("field", {"likeness": [], "trust": None, "cell_size_m": 2.0}),
    "endless shares": ("field", {"likeness": [[10**400]], "trust": None, "cell_size_m": 2.0}),
    "trust of too few": ("field", {"likeness": LIKENESS, "trust": [[1.0]], "cell_size_m": 2.0}),
    "no reach": ("chart", {"thin": ["road_major"], "reach_m": 5e-324}),
    "a text": ("chart", {"thin": [], "reach_m": "4"}),
    "no list": ("chart", {"thin": 7, "reach_m": 4.0}),
    "a folder": ("graph", {"into": "/elsewhere"}),
    "a kind that is none": ("truth", {}),
}


@pytest.mark.parametrize("fault", BAD)
def test_settings_that_are_none_make_nothing_in_vain_and_what_was_ordered_beside_them_is_made(
    fault, place, task, monkeypatch
):
    region, (what, settings) = town_of(place, task), BAD[fault]
    digest, made, classes = read_manifest(region).digest, [], read_manifest(region).classes
    settings = {
        name: value if value is not LIKENESS else LIKENESS[:1] * len(classes) for name, value in settings.items()
    }
    monkeypatch.setattr(keeper, "signal", mock.Mock())
    monkeypatch.setattr(keeper, "store_field", lambda *_, **__: pytest.fail("it was begun"))
    monkeypatch.setitem(keeper.MAKERS, "another", lambda _, into: made.append((into / "a").touch()))
    shelf = kept.shelf_of(region)
    wanted = [
        {"what": what, "settings": settings, "digest": digest, "folder": str(shelf / "one")},
        {"what": "another", "settings": {}, "digest": digest, "folder": str(shelf / "two")},
    ]
    order = {"region": str(region), "wanted": wanted, "code": kept.code_hash()}
    monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(order)))
    with pytest.raises(SystemExit) as ended:
        keeper.main()
    assert len(str(ended.value).splitlines()) == 1
    assert "it was begun" not in str(ended.value)
    assert [path.name for path in shelf.iterdir()] == ["two"]
    assert room.is_whole(shelf / "two")


def test_a_plugin_can_hold_no_lock_that_a_maker_waits_for(place, task, monkeypatch):
    region, found = town_of(place, task), []
    monkeypatch.setitem(
        keeper.MAKERS, "graph", lambda _, into: found.extend([*into.parent.iterdir(), (into / "a").touch()])
    )
    shelf = kept.shelf_of(region)
    keeper.keep(region, shelf / "one", "graph", {}, digest=read_manifest(region).digest)
    assert found[:-1] == [shelf / ".one.partial"]
    assert [*shelf.parent.iterdir()] == [shelf]


def test_nobody_else_can_look_into_what_is_made_where_the_folder_of_a_map_was_removed(place, task):
    region = town_of(place, task)
    shelf = kept.shelf_of(region)
    shelf.rmdir()
    keeper.keep(region, shelf / "one", "graph", {}, digest=read_manifest(region).digest)
    assert shelf.stat().st_mode & 0o077 == 0


def test_of_another_map_nothing_is_ordered(place, task, here):
    region = town_of(place, task)
    kept.order(region, [{"what": "graph", "settings": {}, "digest": digest} for digest in ("0" * 64, "../..", "")])
    kept._ORDERS.join()
    assert here == []
    assert [*kept.shelf_of(region).iterdir()] == []


def test_a_matcher_that_ends_at_each_query_orders_once(place, task, here):
    region = town_of(place, task)
    query = task_files.query_bytes(next(iter(task_files.read_queries(task))))
    with Threaded(spec="graph_only", reach=Reach(readable=[region], hidden=[]), limits=Limits()) as worker:
        worker.prepare(region)
        for _ in range(2):
            kept._ORDERS.join()
            remove_tree(kept.shelf_of(region))
            worker.end()
            worker._seen = -1  # as of a new process
            assert worker.match(query, top_k=1).status == "ok"
        kept._ORDERS.join()
    assert len(here) == 1


def test_settings_without_end_are_no_question(place, task):
    region = town_of(place, task)
    worker = Worker(spec="graph_only", reach=Reach(readable=[region], hidden=[]), limits=Limits())
    worker._region, worker._is_kept, worker._seen = region, True, 7
    wanted = {"what": "chart", "settings": {"thin": ["a" * 70_000]}, "digest": "0"}
    with pytest.raises(MatchError, match="more than 65536 characters"):
        worker._given({"nonce": "n", "wanted": wanted}, "n")


def test_a_cache_below_a_map_is_hidden_and_nothing_is_kept_in_it(place, task, shelf, tmp_path):
    region = town_of(place, task)
    reach = Reach(readable=[region, tmp_path], hidden=[])
    worker = Worker(spec="graph_only", reach=reach, limits=Limits())
    policy = worker._policy("/scratch")
    assert {str(shelf), str(shelf.with_name("rejectors"))} <= {*policy.hidden}
    assert worker._shelf(region) is None
    assert not any(path.startswith(str(shelf)) for path in policy.readable)


@pytest.mark.usefixtures("here")
def test_what_is_mapped_can_be_removed(place, task, monkeypatch):
    region = town_of(place, task)
    chart = Chart.open(asked(region, "chart", **SETTINGS), read_region(region))
    monkeypatch.setenv("SASGEO_KEPT_MB", "20")
    room.Room.of_user().make(20_000_000)
    assert [*room.Room.of_user().entries()] == []
    made = Chart.of(read_region(region), thin=tuple(SETTINGS["thin"]), reach_m=SETTINGS["reach_m"])
    np.testing.assert_array_equal(chart.degree, made.degree)


@pytest.mark.usefixtures("here")
def test_room_that_cannot_be_made_is_not_taken(place, task, monkeypatch):
    asked(town_of(place, task), "graph")
    monkeypatch.setenv("SASGEO_KEPT_MB", "1")
    monkeypatch.setattr(room, "_remove", lambda _: None)
    with pytest.raises(StoreError, match="holds what cannot be removed"):
        room.Room.of_user().make(1_000_000)
