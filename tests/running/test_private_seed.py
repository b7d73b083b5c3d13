# SPDX-License-Identifier: Apache-2.0
"""No matcher finds the private seed that its queries were drawn by."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sasgeo_bench.core.errors import ConfigError, MatchError
from sasgeo_bench.running import leak_scan, prediction_files, sandbox
from sasgeo_bench.running.plan import RunRequest, plan_run, reach_of
from sasgeo_bench.running.testing import check_matcher
from sasgeo_bench.tasks.private_seed import PrivateSeed
from tests.running.seedthief import SECRET
from tests.slow import rest_slow
from tests.world import drawn

pytestmark = pytest.mark.skipif(sandbox.landlock_version() == 0, reason="this kernel has no Landlock")
RUN = """
import sys
from pathlib import Path
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.runner import run
from sasgeo_bench.tasks.private_seed import take_seed

tasks = [Path("out/private/tasks/clean/town-riverside")]
assert take_seed(Path("my.seed") if sys.argv[1] == "file" else None) is not None
run(plan_run(RunRequest(spec="seedthief:Thief", tasks=tasks, out=Path("out/private"), limit=1)))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A private task, the seed in the working folder, and the thief beside it."""
    root = tmp_path_factory.mktemp("thief")
    drawn(root / "out" / "private", "clean", "town-riverside", seed=PrivateSeed(SECRET))
    shutil.copy(Path(__file__).with_name("seedthief.py"), root / "seedthief.py")
    source = (root / "seedthief.py").read_text(encoding="utf-8")
    assert SECRET not in source
    (root / "my.seed").write_text(SECRET, encoding="ascii")
    (root / "my.seed").chmod(0o600)
    return root


@pytest.mark.parametrize("way", rest_slow(["file", "environment"]))
def test_neither_file_nor_environment_gives_the_seed_to_a_matcher(made, tmp_path, way):
    root = Path(shutil.copytree(made, tmp_path / way))
    given = {"SASGEO_SEED": SECRET} if way == "environment" else {}
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", RUN, way],
        cwd=root,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(root), **given},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert SECRET not in done.stdout + done.stderr
    (row,) = [row for path in (root / "out" / "private" / "runs").rglob("run.json") for row in _rows(path.parent)]
    assert row.diagnostics == {"file": 0.0, "environment": 0.0, "processes": 0.0}, row.message


def _rows(folder):
    return prediction_files.read_predictions(folder)


def test_every_run_hides_the_files_of_seeds_beside_the_code(made):
    assert str(made / "my.seed") in leak_scan.walk([str(made)]).hidden([])


def test_the_file_of_a_pipelines_seed_is_hidden_wherever_it_lies(tmp_path):
    request = RunRequest(spec="random", tasks=[], out=tmp_path, hidden=[tmp_path / "far" / "my.seed"])
    assert tmp_path / "far" / "my.seed" in reach_of(request, ()).hidden
    others = {"truth", "segmenters", "private", "results", "datasets"}
    assert {request.out.resolve() / name for name in others} <= set(reach_of(request, ()).hidden)


def test_a_map_behind_a_link_is_readable_and_the_others_there_are_hidden(tmp_path):
    disk, out = tmp_path / "disk", tmp_path / "out"
    for name in ("here", "here@2020-01-01"):
        (disk / name).mkdir(parents=True)
    out.mkdir()
    (out / "regions").symlink_to(disk)
    reach = reach_of(RunRequest(spec="random", tasks=[], out=out), [out / "regions" / "here"])
    assert reach.readable == [disk / "here"]
    assert disk / "here@2020-01-01" in reach.hidden
    assert not any((disk / "here").is_relative_to(path.resolve()) for path in reach.hidden)


def test_a_matcher_that_bears_a_shipped_name_is_refused_before_it_is_asked_or_tried(made, monkeypatch):
    monkeypatch.chdir(made)
    monkeypatch.syspath_prepend(str(made))
    spec, words = "seedthief:PassesForFftVote", "its card is named 'fft_vote', as a matcher that ships: rename it"
    task = made / "out" / "private" / "tasks" / "clean" / "town-riverside"
    with pytest.raises(MatchError, match=words):
        plan_run(RunRequest(spec=spec, tasks=[task], out=made / "out" / "private"))
    (check,) = check_matcher(spec)
    assert (check.outcome, check.found) == ("fail", f"{spec}: {words}")


def test_answers_to_private_queries_stay_beside_them(made):
    task = made / "out" / "private" / "tasks" / "clean" / "town-riverside"
    with pytest.raises(ConfigError, match=r"is of a private seed, whose answers stay with it: say --out .*private"):
        plan_run(RunRequest(spec="random", tasks=[task], out=made / "out"))
