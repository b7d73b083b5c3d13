# SPDX-License-Identifier: Apache-2.0
"""A task whose map is a packed one is answered as on the built region, which need not be there."""

import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.regions.packed_map import UNPACKED, Weights, pack_map, unpack_map
from sasgeo_bench.regions.region_files import differing_files
from sasgeo_bench.running.plan import RunRequest, plan_run, reach_of
from sasgeo_bench.running.prediction_files import RunManifest, parts_of
from sasgeo_bench.running.profiling import ProfileRequest, profile
from tests import world
from tests.slow import rest_slow

TOWN = "town-riverside"
TIMED = ("latency_s", "matcher_s")  # which no two runs have in common


@pytest.fixture(scope="module")
def packed(tasks: Path, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("packed") / f"{TOWN}.map"
    pack_map(tasks / "regions" / TOWN, path)
    return path


@pytest.fixture
def aboard(tasks, packed, tmp_path) -> tuple[Path, Path]:
    """The root of an aircraft, with a task and a packed map, and no region; the task."""
    out = tmp_path / "aboard"
    task = out / "tasks" / "clean" / TOWN
    shutil.copytree(tasks / "tasks" / "clean" / TOWN, task)
    shutil.copy(packed, out)
    return out, task


def rows(runs: Path) -> bytes:
    """All rows of a run in the order of their queries, without times."""
    frame = pd.concat([read_frame(path, mend="") for path in parts_of(runs)])
    return frame.drop(columns=[*TIMED]).sort_values("query_id").to_json(orient="records", double_precision=15).encode()


@pytest.mark.parametrize("matcher", rest_slow(["random", "sasgeo"]))
def test_the_answers_are_the_same_bytes(tasks, aboard, matcher, tmp_path):
    out, task = aboard
    here = Path(shutil.copytree(tasks, tmp_path / "here"))
    built = world.answered(here, matcher, [here / "tasks" / "clean" / TOWN], limit=3)
    with pytest.raises(StoreError, match=r"holds no region\.json"):
        plan_run(RunRequest(spec=matcher, tasks=[task], out=out))
    one = unpack_map(out / f"{TOWN}.map", out)
    flown = world.answered(out, matcher, [task], limit=3, maps=[one])
    assert rows(flown) == rows(built)
    before, after = (RunManifest.open(next(runs.rglob("run.json")).parent) for runs in (built, flown))
    assert (after.hash, after.map_fingerprint) == (before.hash, before.map_fingerprint)
    assert after.map_bytes == sum(record.bytes for record in one.about.files.values())


def test_a_map_of_no_task_is_refused(tasks, aboard, tmp_path):
    out, task = aboard
    pack_map(tasks / "regions" / "town-grid", tmp_path / "grid.map")
    maps = [unpack_map(path, out) for path in (out / f"{TOWN}.map", tmp_path / "grid.map")]
    with pytest.raises(
        ConfigError, match=r"grid\.map, a map of town-grid, is not what the queries of 1 task .* were made on"
    ):
        plan_run(RunRequest(spec="random", tasks=[task], out=out, maps=maps))


@pytest.mark.slow
def test_who_looks_at_imagery_is_not_asked_on_a_map_packed_without(aboard):
    out, task = aboard
    one = unpack_map(out / f"{TOWN}.map", out)
    without = replace(one, about=one.about.model_copy(update={"left_out": ("ortho.tif",)}))
    with pytest.raises(ConfigError, match=r"was packed without imagery, .*: pack-map --with-imagery"):
        plan_run(RunRequest(spec="orb_homography", tasks=[task], out=out, maps=[without]))
    assert plan_run(RunRequest(spec="random", tasks=[task], out=out, maps=[without])).parts[0].left


def test_other_maps_that_lie_unpacked_are_hidden(tasks, aboard, tmp_path):
    out, task = aboard
    pack_map(tasks / "regions" / "town-grid", tmp_path / "grid.map")
    mine, other = (unpack_map(path, out).folder for path in (out / f"{TOWN}.map", tmp_path / "grid.map"))
    reach = reach_of(RunRequest(spec="random", tasks=[task], out=out), [mine])
    assert reach.readable == [mine.resolve()]
    assert other.resolve() in reach.hidden
    assert not any(mine.resolve().is_relative_to(path.resolve()) for path in reach.hidden)
    assert UNPACKED in other.parts


def taught(tasks: Path, root: Path) -> Path:
    """A run that learned in one town, over another; the folder of its answers."""
    here = Path(shutil.copytree(tasks, root))
    (train,) = (here / "tasks" / "alias").glob("town-grid*")
    runs = world.answered(here, "learners:Counts", [here / "tasks" / "clean" / TOWN], limit=2, train=(train,))
    return next(runs.rglob("run.json")).parent


def test_what_was_learned_travels_with_the_map_and_ties_the_same_answers(program, tasks, aboard, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    out, task = aboard
    run = taught(tasks, tmp_path / "here")
    path = tmp_path / "taught.map"
    code, printed, err = program("pack-map", tasks / "regions" / TOWN, "--learned", run, "--into", path)
    assert code == 0, err
    assert "; with what counts has learned" in printed
    one = unpack_map(path, out)
    assert differing_files(one.folder) == []
    flown = world.answered(out, "learners:Counts", [task], limit=2, maps=[one])
    assert rows(flown) == rows(run.parents[3])
    before, after = RunManifest.open(run), RunManifest.open(next(flown.rglob("run.json")).parent)
    assert (after.hash, after.key, after.learned.key) == (before.hash, before.key, before.learned.key)
    assert (after.learned.trained_on, after.learned.pairs) == (["town-grid"], before.learned.pairs)
    assert (flown / "counts" / after.hash / after.learned.file).read_bytes() == one.learned.read_bytes()


@pytest.mark.slow
def test_another_matcher_leaves_the_weights_alone(tasks, aboard, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    out, task = aboard
    text = tmp_path / "text.json"
    text.write_text("{}")
    by = Weights(matcher="counts", trained_on=("town-grid",), pairs=3)
    pack_map(tasks / "regions" / TOWN, tmp_path / "a.map", learned=(by, text))
    one = unpack_map(tmp_path / "a.map", out)
    assert plan_run(RunRequest(spec="sasgeo", tasks=[task], out=out, maps=[one])).key is None
    assert plan_run(RunRequest(spec="learners:Counts", tasks=[task], out=out, maps=[one])).key is not None


def test_weights_of_two_kinds_are_refused(tasks, aboard, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    out, task = aboard
    by, text = Weights(matcher="counts", trained_on=("town-grid",), pairs=3), tmp_path / "text.json"
    maps = []
    for name in "ab":
        text.write_text(f'"{name}"')
        pack_map(tasks / "regions" / TOWN, tmp_path / f"{name}.map", learned=(by, text))
        maps.append(unpack_map(tmp_path / f"{name}.map", out))
    with pytest.raises(ConfigError, match=r"b\.map holds other weights of 'counts' than the maps before it"):
        plan_run(RunRequest(spec="learners:Counts", tasks=[task], out=out, maps=maps))


def test_locate_says_that_it_leaves_the_weights(program, tasks, tmp_path):
    text = tmp_path / "text.json"
    text.write_text("{}")
    by = Weights(matcher="sasgeo", trained_on=("town-grid",), pairs=3)
    pack_map(tasks / "regions" / TOWN, tmp_path / "a.map", learned=(by, text))
    code, _, err = program("locate", "none.jpg", "--region", "a.map")
    assert code == 2
    assert "what sasgeo has learned is left packed" in err
    assert "there is no picture or folder none.jpg" in err


def test_a_run_without_training_has_nothing_to_pack(mistake, tasks, tmp_path):
    here = Path(shutil.copytree(tasks, tmp_path / "here"))
    runs = world.answered(here, "random", [here / "tasks" / "clean" / TOWN], limit=1)
    run = next(runs.rglob("run.json")).parent
    words = ("pack-map", here / "regions" / TOWN, "--learned")
    assert "is a run without training: name one that was made with --train" in mistake(*words, run)
    assert "holds no run: name one" in mistake(*words, tmp_path)


@pytest.mark.usefixtures("in_threads")
def test_it_is_profiled_by_its_own_size(aboard):
    out, task = aboard
    one = unpack_map(out / f"{TOWN}.map", out)
    found = profile(ProfileRequest(spec="random", tasks=(task,), out=out, sustain_s=0.01, maps=[one]))
    assert found.region == TOWN
    assert found.map_bytes == sum(record.bytes for record in one.about.files.values())


def test_the_program_takes_it(program, aboard):
    out, task = aboard
    words = ("--matcher", "random", "--tasks", task, "--maps", out / f"{TOWN}.map", "--out", out)
    code, printed, err = program("run", *words, "--limit", "2")
    assert code == 0, err
    assert parts_of(Path(printed.strip()))
    code, printed, err = program("profile", *words, "--seconds", "0.1")
    assert code == 0, err
    assert "map on disk: 0." in printed
