# SPDX-License-Identifier: Apache-2.0
"""The walk through the folders of the code finds what tells answers, is bounded, and says what it did not look at."""

import sys
import sysconfig
from pathlib import Path

import pytest

from sasgeo_bench.boards import archive_file, board_files, site_files
from sasgeo_bench.exchange import release_files
from sasgeo_bench.running import leak_scan, worker
from sasgeo_bench.running.segmenter_process import SegmenterProcess
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.scoring import submission_files
from sasgeo_bench.tasks import task_files


def lay(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def hidden(root, *kept, **limits):
    """What is hidden below a folder, by its place in it, and what is said of the rest."""
    found = leak_scan.walk([str(root)], **limits)
    return sorted(str(Path(path).relative_to(root)) for path in found.hidden(kept)), found.unsearched


@pytest.mark.parametrize(
    "sign",
    [
        *("pack.json", "truths.parquet", "truth.parquet", "truth.json", "truth-test.parquet", "part-00001-2.parquet"),
        "queries.parquet",
    ],
)
def test_one_telling_name_hides_its_folder(tmp_path, sign):
    lay(tmp_path, f"a/b/{sign}", "a/c/notes.txt")
    assert hidden(tmp_path) == (["a/b"], "")


@pytest.mark.parametrize(
    ("sign", "with_it"), [(a, b) for a, b in map(sorted, filter(lambda sign: len(sign) > 1, leak_scan._SIGNS))]
)
def test_a_name_that_others_use_too_hides_nothing_alone(tmp_path, sign, with_it):
    lay(tmp_path, f"a/{sign}", f"b/{with_it}", f"c/{sign}", f"c/{with_it}")
    assert hidden(tmp_path)[0] == ["c"]


def test_what_stored_results_are_called_is_what_is_looked_for():
    signs = set().union(*leak_scan._SIGNS)
    assert {
        archive_file.PACK,
        task_files.QUERIES,
        task_files.TRUTH,
        task_files.TRUTH_OF,
        board_files.BOARD,
        site_files.MANIFEST,
    } <= signs
    assert {release_files.INDEX, submission_files.SUBMISSION, "truths.parquet"} <= signs


def test_a_root_of_the_program_hides_all_of_it(tmp_path):
    lay(tmp_path, "out/tasks/clean/a/task.json", "out/truth/clean/a/truth.parquet", "out/runs/x/run.json", "out/x.txt")
    lay(tmp_path, "out/regions/a/region.json", "out/regions/a/layers.tif")
    names = ("boards", "release", "results", "runs", "segmenters", "sheets", "tasks", "truth")
    everything = [f"out/{name}" for name in names]
    assert hidden(tmp_path)[0] == sorted([*everything, "out/regions/a"])
    assert hidden(tmp_path, tmp_path / "out/regions/a")[0] == everything


def test_a_release_whose_map_is_asked_about_keeps_the_map_and_loses_the_rest(tmp_path):
    lay(tmp_path, "rel/release.json", "rel/SHA256SUMS", "rel/truth/clean/a/truth.parquet")
    lay(tmp_path, *(f"rel/regions/{name}/{file}" for name in "ab" for file in ("region.json", "layers.tif")))
    assert hidden(tmp_path)[0] == ["rel"]
    assert hidden(tmp_path, tmp_path / "rel/regions/a")[0] == ["rel/regions/b", "rel/truth"]


def test_code_beside_what_tells_stays_and_what_tells_goes(tmp_path):
    lay(tmp_path, "mine/matcher.py", "mine/truths.parquet", "mine/predictions/a.parquet", "mine/weights.npz")
    assert hidden(tmp_path)[0] == ["mine/predictions", "mine/truths.parquet"]
    lay(tmp_path, "pack.json")
    assert hidden(tmp_path, tmp_path)[0] == ["mine/predictions", "mine/truths.parquet", "pack.json"]


def test_installed_packages_are_passed_over_and_what_was_committed_is_hidden(tmp_path):
    lay(tmp_path, ".venv/pyvenv.cfg", ".venv/lib/a/pack.json", "node_modules/b/pack.json", ".git/objects/ab/cd")
    assert hidden(tmp_path) == ([".git"], "")


def test_links_are_not_followed(tmp_path):
    lay(tmp_path, "far/pack.json")
    (tmp_path / "near").mkdir()
    (tmp_path / "near/link").symlink_to(tmp_path / "far")
    (tmp_path / "near/round").symlink_to(tmp_path / "near")
    assert hidden(tmp_path / "near") == ([], "")


def test_a_walk_that_ends_early_has_found_the_upper_ones_and_says_what_it_did_not_see(tmp_path):
    lay(tmp_path, "a/pack.json", "b/c/d/e/pack.json")
    assert hidden(tmp_path, most_depth=2) == (
        ["a"],
        "stored results deeper than 2 folders next to the code were not looked for",
    )
    assert hidden(tmp_path, most_depth=4) == (["a", "b/c/d/e"], "")
    found, words = hidden(tmp_path, most_entries=4)
    assert (found, words) == (["a"], "stored results beyond 4 files next to the code were not looked for")


def test_the_interpreters_own_folders_are_not_walked(tmp_path):
    lay(tmp_path, "pack.json")
    own = [Path(sys.prefix), Path(sys.base_prefix), Path(sysconfig.get_paths()["stdlib"])]
    leak_scan._walked.cache_clear()
    found = leak_scan.walk_code([*own, tmp_path, tmp_path / "no.zip"])
    assert [item.folder for item in found.found] == [str(tmp_path)]


def test_answers_packed_beside_a_pipeline_file_are_hidden_and_other_archives_are_not(tmp_path):
    lay(tmp_path, "a/mine.toml", "a/mine.tar.xz", "a/weights.tar.xz", "b/other.toml")
    assert hidden(tmp_path)[0] == ["a/mine.tar.xz"]


@pytest.mark.parametrize("process", [Worker, SegmenterProcess])
def test_the_archives_that_ship_are_hidden_from_every_plugin_although_nobody_walks_what_is_installed(
    tmp_path, monkeypatch, process
):
    lay(tmp_path, "pipelines/demo.tar.xz")
    monkeypatch.setattr(worker, "shipped_dir", lambda kind: tmp_path / kind)
    reach = Reach(readable=[], hidden=[])
    policy = process(spec="random", reach=reach, limits=Limits())._policy(str(tmp_path))
    assert str(tmp_path / "pipelines/demo.tar.xz") in policy.hidden
