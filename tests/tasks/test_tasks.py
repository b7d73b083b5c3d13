# SPDX-License-Identifier: Apache-2.0
"""Tasks: the same request makes the same bytes, a run that dies leaves the old task whole, and no task tells truths."""

import errno
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import locked
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions import region_files
from sasgeo_bench.tasks.build import check_task, is_of_region, make_tasks
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.sheet import panels_of
from sasgeo_bench.tasks.task_files import (
    QUERIES,
    TASK,
    TRUTH,
    TRUTH_OF,
    Task,
    read_queries,
    read_task,
    read_truths,
)
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

RIVERSIDE = "town-riverside"
# The program, ended when all is written and nothing is in its place yet.
KILLED = """
import os, signal
from sasgeo_bench.cli import main
from sasgeo_bench.tasks import task_files

def write_and_die(*words):
    write(*words)
    os.kill(os.getpid(), signal.SIGKILL)

write, task_files.write_task = task_files.write_task, write_and_die
main()
"""


def make(out: Path, suite: str = "absent", **changes):
    base = {"suites": (suite,), "regions": (RIVERSIDE,), "split": "crossfit", "count": 1, "seed": 0, "out": out}
    wanted = TaskRequest(**base | changes)
    return [made for request in plan_requests(wanted) for made in make_tasks(request)]


def content(out: Path) -> dict[str, bytes]:
    """Every table and task.json below a root, by its place."""
    found = (path for kind in ("tasks", "truth") for path in sorted((out / kind).rglob("*")))
    return {
        str(path.relative_to(out)): path.read_bytes() for path in found if path.is_file() and path.suffix != ".lock"
    }


def task_folders(out: Path) -> list[Path]:
    return sorted(path.parent for path in (out / "tasks").rglob(TASK))


def truth_of(folder: Path) -> Path:
    return folder.parents[2] / "truth" / folder.relative_to(folder.parents[1])


# --- the same bytes -------------------------------------------------------------------------------------------------


def test_the_same_request_makes_the_same_bytes(tasks, own_out):
    make(own_out)
    again = content(own_out)
    assert again
    assert again == {name: data for name, data in content(tasks).items() if "/absent/" in name}


@pytest.mark.slow
def test_other_suites_and_regions_change_no_byte_of_a_task(tasks, own_out):
    make(own_out, suites=("synthetic-age", "absent"), regions=("town-grid", RIVERSIDE))
    mine, theirs = content(own_out), content(tasks)
    shared = set(mine) & set(theirs)
    assert {name.split("/", 1)[1].rsplit("/", 1)[0] for name in shared} == {"absent/town-riverside"}
    assert all(mine[name] == theirs[name] for name in shared)


def test_another_seed_changes_every_query(tasks, own_out):
    (made,) = make(own_out, seed=1)
    old, new = (list(read_queries(folder)) for folder in (tasks / "tasks/absent" / RIVERSIDE, made.folder))
    assert not {query.query_id for query in old} & {query.query_id for query in new}
    assert not {query.evidence.cells.tobytes() for query in old} & {query.evidence.cells.tobytes() for query in new}
    assert not {query.prior.center_m for query in old} & {query.prior.center_m for query in new}
    poses = [
        {truth.pose for truth in read_truths(truth_of(folder)) if truth.pose}
        for folder in (tasks / "tasks/absent" / RIVERSIDE, made.folder)
    ]
    assert not poses[0] & poses[1]
    for name in ("easting_m", "northing_m", "yaw_deg", "scale"):
        assert not {getattr(pose, name) for pose in poses[0]} & {getattr(pose, name) for pose in poses[1]}


def rows(path: Path) -> dict[str, dict]:
    return {row["query_id"]: row for row in pq.read_table(path).to_pylist()}


@pytest.mark.parametrize("suite", ["absent", "season", "growth"])
def test_more_sites_keep_the_earlier_queries(suite, own_out):
    found = []
    for count in (1, 2):
        (made,) = make(own_out, suite, count=count)
        found.append((rows(made.folder / QUERIES), rows(truth_of(made.folder) / TRUTH)))
    for few, many in zip(*found, strict=True):
        assert len(many) == 2 * len(few)
        assert few == {name: many[name] for name in few}


# --- what a task says -----------------------------------------------------------------------------------------------


def test_ids_are_unique_and_sorted_and_say_nothing(tasks):
    names = []
    for folder in task_folders(tasks):
        own = [query.query_id for query in read_queries(folder)]
        assert own == sorted(own)
        assert own == [truth.query_id for truth in read_truths(truth_of(folder))]
        names += own
    assert len(names) == len(set(names)) > 40
    assert all(len(name) == 24 and set(name) <= set("0123456789abcdef") for name in names)
    leading = np.array([int(name[:8], 16) for name in names]) / 2**32
    assert 0.35 < leading.mean() < 0.65


def test_task_json_says_where_a_task_comes_from(tasks):
    about = read_task(tasks / "tasks/clean" / RIVERSIDE)
    lines = [about[name] for name in ("suite", "region", "split", "sites", "map_date")]
    assert lines == ["clean", RIVERSIDE, "crossfit", 2, "2025-01-01"]
    queries = list(read_queries(tasks / "tasks/clean" / RIVERSIDE))
    assert about["prior_groups"] == sorted({query.prior_group for query in queries})
    assert sum(about["counts"].values()) == len(queries)
    assert sorted({query.evidence.shape[0] for query in queries}) == about["views_cells"]


def test_no_truth_lies_among_the_tasks(tasks):
    for folder in task_folders(tasks):
        assert sorted(path.name for path in folder.iterdir()) == [QUERIES, TASK]
        assert "truth" not in {part for path in folder.rglob("*") for part in path.relative_to(tasks / "tasks").parts}
        named = set(pq.read_schema(folder / QUERIES).names)
        hidden = "pose easting_m candidate pair_id role kind strength block measured"
        assert not named & set(hidden.split())


def leaves(column: pa.ChunkedArray) -> Iterator[pa.Array]:
    """Flat arrays of a column, however it is nested."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_list(array.type):
        yield from leaves(array.flatten())
    elif pa.types.is_struct(array.type):
        for part in array.flatten():
            yield from leaves(part)
    else:
        yield array


def spelled(pose) -> tuple[set[bytes], set[float]]:
    """A truth as bytes and texts long enough not to come up by chance, and as numbers."""
    given, numbers = set(), set()
    for value, fewest in ((pose.easting_m, 1), (pose.northing_m, 1), (pose.yaw_deg, 2)):
        given.add(struct.pack("<d", value))
        given.add(struct.pack("<f", value))
        for decimals in range(fewest, 7):
            numbers.add(round(value, decimals))
            given.add(f"{value:.{decimals}f}".encode())
    return {item for item in given if len(item) >= 4}, numbers


def test_no_truth_is_spelled_out_in_a_task(tasks):
    looked = 0
    for folder in task_folders(tasks):
        table = pq.read_table(folder / QUERIES)
        raw = (folder / QUERIES).read_bytes() + (folder / TASK).read_bytes()
        flat = {name: list(leaves(table[name])) for name in table.column_names if name != "candidates"}
        numbers = {
            float(value)
            for arrays in flat.values()
            for array in arrays
            if pa.types.is_floating(array.type) or pa.types.is_integer(array.type)
            for value in array.drop_null().to_pylist()
        }
        buffers = [
            bytes(value) if isinstance(value, bytes) else value.encode()
            for arrays in flat.values()
            for array in arrays
            if pa.types.is_binary(array.type) or pa.types.is_string(array.type)
            for value in array.drop_null().to_pylist()
        ]
        text = b"\n".join([raw, *buffers])
        for pose in {truth.pose for truth in read_truths(truth_of(folder)) if truth.pose}:
            given, exact = spelled(pose)
            assert not exact & numbers
            assert not [item for item in given if item in text]
            looked += len(given)
    assert looked > 50


def test_the_search_for_spelled_truths_finds_one_that_is_there(tasks):
    folder = task_folders(tasks)[0]
    pose = next(truth.pose for truth in read_truths(truth_of(folder)) if truth.pose)
    given, numbers = spelled(pose)
    assert struct.pack("<d", pose.easting_m) in given
    assert f"{pose.northing_m:.3f}".encode() in given
    assert round(pose.easting_m, 1) in numbers


SEED = 7_315_482_906_117


def test_the_seed_lies_with_the_truths_and_nowhere_that_a_matcher_sees(own_out):
    (made,) = make(own_out, "topology-twins", regions=("town-grid",), seed=SEED)
    map_folder = own_out / "regions" / made.folder.name
    assert map_folder.name != "town-grid"
    assert json.loads((truth_of(made.folder) / TRUTH_OF).read_text(encoding="utf-8"))["seed"] == SEED
    values = {str(SEED).encode(), f"{SEED:x}".encode(), struct.pack("<q", SEED), struct.pack(">q", SEED)}
    looked = set()
    for folder in (own_out / "tasks", own_out / "regions"):
        for path in folder.rglob("*"):
            if path.is_file():
                assert not [item for item in values if item in path.read_bytes() + str(path).encode()], path
                looked.add(path.name)
    assert {QUERIES, TASK, "region.json"} <= looked
    tables = [path for folder in (made.folder, map_folder) for path in folder.glob("*.parquet")]
    assert len(tables) > 1
    for path in tables:  # compressed: the bytes above would not show it
        table = pq.read_table(path)
        flat = [value for name in table.column_names for array in leaves(table[name]) for value in array.to_pylist()]
        assert SEED not in {value for value in flat if isinstance(value, (int, float))}
        assert not [value for value in flat if isinstance(value, str) and str(SEED) in value]


def test_a_pair_is_one_place_seen_under_all_variants(tasks):
    for folder in task_folders(tasks):
        truths = list(read_truths(truth_of(folder)))
        for pair in {truth.pair_id for truth in truths}:
            own = [truth for truth in truths if truth.pair_id == pair]
            assert len({truth.pose for truth in own if truth.pose}) == 1
            assert "control" in {truth.role for truth in own}
            assert len({truth.block for truth in own}) == 1


# --- what is refused ------------------------------------------------------------------------------------------------


def test_a_count_that_a_region_does_not_hold_is_refused_and_fewer_may_be_taken(own_out):
    with pytest.raises(ConfigError, match=r"holds \d+ places .* 900 were asked for: lower --n or pass --up-to"):
        make(own_out, count=900)
    assert content(own_out) == {}
    (made,) = make(own_out, count=900, may_be_fewer=True)
    assert 1 < made.manifest.sites < 900
    assert made == Task.open(made.folder, made.root)


def test_a_region_that_cannot_carry_a_suite_is_told_what_it_lacks(own_out):
    with pytest.raises(ConfigError, match="cannot carry suite 'grade-separation': no bridge"):
        make(own_out, "grade-separation")
    assert content(own_out) == {}


def test_a_disc_too_small_for_twins_is_refused_in_one_line_before_anything_is_read(own_out):
    with pytest.raises(ConfigError) as caught:
        make(own_out, "topology-twins", group=PriorGroup.parse("r250-weak-s3"))
    assert str(caught.value) == (
        "suite 'topology-twins' needs a disc that holds two places up to 800 m apart, and r250-weak-s3 has none: "
        "use r500 or more, or leave --prior out"
    )
    assert content(own_out) == {}


def test_a_region_too_small_for_decoys_is_refused_before_its_map_is_edited(own_out):
    with pytest.raises(
        ConfigError, match="town-riverside is too small or too empty for suite 'alias': fewer than 4 candidates"
    ):
        make(own_out, "alias")
    assert content(own_out) == {}
    assert not (own_out / "regions/town-riverside+alias").exists()


def test_views_that_reach_beyond_the_split_are_refused(own_out, tmp_path):
    split = tmp_path / "split.toml"
    places = "".join(
        f'[[place]]\nname = "{name}"\nregions = ["{name}"]\npart = "test"\n' for name in (RIVERSIDE, "town-grid")
    )
    split.write_text(f'id = "x"\ntitle = "X"\nkind = "holdout"\nbuffer_m = 0.0\nreach_m = 200.0\n{places}')
    with pytest.raises(ConfigError, match=r"views of 384 m reach up to 288 m .* use a split with a larger reach_m"):
        make(own_out, "clean", split=str(split))
    assert content(own_out) == {}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_the_right_to_write_is_told(own_out):
    (own_out / "tasks").mkdir(mode=0o500)
    with pytest.raises(StoreError, match="cannot be written"):
        make(own_out)


def test_a_file_where_a_folder_should_be_is_told(own_out):
    (own_out / "tasks").write_text("not a folder")
    with pytest.raises(StoreError, match="cannot be written"):
        make(own_out)
    assert not (own_out / "truth").exists()


# --- runs that meet or die ------------------------------------------------------------------------------------------


def leftovers(out: Path) -> list[str]:
    found = (path.name for kind in ("tasks", "truth") for path in (out / kind).rglob(".*"))
    return [name for name in found if not name.endswith(".lock")]


def test_a_second_run_waits_for_the_first_and_both_leave_a_whole_task(own_out, tasks):
    lines: list[str] = []
    waiting = threading.Event()

    def tell(line):
        lines.append(line)
        if "is being written by another run" in line:
            waiting.set()

    folder = own_out / "tasks" / "absent" / RIVERSIDE
    second = threading.Thread(target=make, args=(own_out,))
    with reporting(tell):
        with locked(folder):
            second.start()
            waiting.wait()
            assert not (folder / TASK).exists()
        second.join()
    assert content(own_out) == {name: data for name, data in content(tasks).items() if "/absent/" in name}
    assert leftovers(own_out) == []


@pytest.mark.slow
def test_two_runs_of_different_counts_at_once_leave_the_map_of_the_last_and_its_task(own_out, tasks):
    values: dict[int, list[str]] = {2: [], 1: []}
    begun, waiting = threading.Event(), threading.Event()

    def tell(line):
        values[int(threading.current_thread().name)].append(line)
        if "is being written by another run" in line:
            waiting.set()
        else:
            begun.set()
            waiting.wait()  # the first says nothing more, and ends not, before the other one has come

    def draw(count):
        make(own_out, "topology-twins", regions=("town-grid",), count=count, may_be_fewer=count > 1)

    first, last = (threading.Thread(target=draw, args=(count,), name=str(count)) for count in values)
    with reporting(tell):
        first.start()
        begun.wait()
        last.start()
        for run in (first, last):
            run.join()
    folder = own_out / "tasks/topology-twins/town-grid+topology-twins"
    assert [sum(" queries at " in line for line in lines) for lines in values.values()] == [1, 1]
    assert [sum("is being written by another run" in line for line in lines) for lines in values.values()] == [0, 1]
    assert check_task(Task.open(folder)) == []
    assert leftovers(own_out) == []
    assert read_task(folder)["sites"] == len({truth.pose for truth in read_truths(truth_of(folder))}) == 1
    assert content(own_out) == {name: data for name, data in content(tasks).items() if "/topology-twins/" in name}
    manifests = [region_files.read_manifest(root / "regions" / folder.name) for root in (own_out, tasks)]
    assert manifests[0] == manifests[1]


def test_the_truths_are_in_place_before_the_task(own_out, monkeypatch):
    renamed = []
    rename = Path.rename

    def noted(self, target):
        renamed.append(Path(target).relative_to(own_out).parts[0])
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", noted)
    make(own_out)
    assert renamed == ["truth", "tasks"]


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_the_old_task_and_the_next_one_clears_up(own_out):
    make(own_out)
    before = content(own_out)
    words = ["make-queries", "--suite", "absent", "--regions", RIVERSIDE, "--n", "2", "--up-to", "--out", str(own_out)]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("SASGEO")}
    environment = clean | {"PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.run([sys.executable, "-c", KILLED, *words], env=environment, capture_output=True, check=False)  # noqa: S603 - our own program
    assert process.returncode == -signal.SIGKILL
    assert {name: data for name, data in content(own_out).items() if "/." not in name} == before
    assert leftovers(own_out)
    assert check_task(Task.open(own_out / "tasks" / "absent" / RIVERSIDE)) == []
    make(own_out)
    assert content(own_out) == before
    assert leftovers(own_out) == []


def test_a_run_that_fails_in_the_middle_leaves_the_old_task(own_out, monkeypatch):
    make(own_out)
    before = content(own_out)

    def full(*_):
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr("sasgeo_bench.tasks.task_files.file_record", full)
    with pytest.raises(StoreError, match="no space left on device"):
        make(own_out, seed=3)
    assert content(own_out) == before
    assert leftovers(own_out) == []


# --- looking again --------------------------------------------------------------------------------------------------


@pytest.fixture
def copied(tasks, tmp_path):
    """A root of one's own with the tasks in it."""
    return Path(shutil.copytree(tasks, tmp_path / "copied"))


def test_every_task_that_is_made_is_good(tasks):
    for folder in task_folders(tasks):
        assert check_task(Task.open(folder)) == []
        assert Task.open(folder).has_truths


def test_without_truths_a_task_can_be_checked_but_not_shown(copied):
    folder = copied / "tasks/clean" / RIVERSIDE
    shutil.rmtree(copied / "truth")
    assert check_task(Task.open(folder)) == []
    assert not Task.open(folder).has_truths
    with pytest.raises(StoreError, match=r"truth.parquet cannot be read .*: make the queries again"):
        panels_of(Task.open(folder))


def test_the_truths_of_another_task_are_not_shown(copied):
    folder = copied / "tasks/clean" / RIVERSIDE
    shutil.copy(truth_of(copied / "tasks/absent" / RIVERSIDE) / TRUTH, truth_of(folder) / TRUTH)
    with pytest.raises(StoreError, match="does not hold the truths of"):
        panels_of(Task.open(folder))


def test_a_task_on_a_map_that_was_built_anew_is_not_shown(copied):
    folder = copied / "tasks/clean" / RIVERSIDE
    manifest = copied / "regions" / RIVERSIDE / "region.json"
    record = json.loads(manifest.read_text(encoding="utf-8"))
    manifest.write_text(json.dumps(record | {"fingerprint": "0"}), encoding="utf-8")
    with pytest.raises(StoreError, match="was built anew since: make the queries again"):
        panels_of(Task.open(folder))


def test_a_sheet_shows_every_variant_of_a_task_before_it_shows_one_twice(tasks):
    folder = tasks / "tasks/clean" / RIVERSIDE
    shown = panels_of(Task.open(folder), count=6)
    variants = [(item.truth.kind, item.truth.strength) for item in shown[:5]]
    assert len(set(variants)) == 5
    assert all(item.at_truth is not None for item in shown)


def test_a_perfect_view_is_what_the_map_shows_at_the_truth(tasks):
    folder = tasks / "tasks/clean" / RIVERSIDE
    perfect = [item for item in panels_of(Task.open(folder), count=60) if item.truth.role == "control"]
    assert perfect
    for item in perfect:
        np.testing.assert_array_equal(item.query.evidence.cells, item.at_truth.cells)


def test_one_query_is_found_by_the_beginning_of_its_id_and_an_unknown_one_is_told(tasks):
    folder = tasks / "tasks/absent" / RIVERSIDE
    name = next(read_queries(folder)).query_id
    (shown,) = panels_of(Task.open(folder), query_id=name[:10])
    assert shown.query.query_id == name
    with pytest.raises(ConfigError, match="holds no query 'zzz'"):
        panels_of(Task.open(folder), query_id="zzz")


@pytest.mark.parametrize(
    ("name", "is_of_it"),
    [("vaduz", True), ("vaduz@2015-07-27", True), ("vaduz@2015-07-27+alias", True), ("vaduz-north", False)],
)
def test_dates_and_edits_of_a_map_are_of_its_region_and_no_other_one_is(name, is_of_it):
    assert is_of_region(name, "vaduz") is is_of_it


def test_a_task_of_a_map_that_was_built_anew_is_named(copied):
    manifest = copied / "regions" / RIVERSIDE / "region.json"
    record = json.loads(manifest.read_text(encoding="utf-8"))
    manifest.write_text(json.dumps(record | {"fingerprint": "0"}), encoding="utf-8")
    (given,) = check_task(Task.open(copied / "tasks/clean" / RIVERSIDE))
    assert "town-riverside was built anew since: make the queries again" in given
