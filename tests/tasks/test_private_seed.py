# SPDX-License-Identifier: Apache-2.0
"""A private seed draws the same kind of queries elsewhere, is written nowhere, and changes no public query."""

import os

import pytest
from sasgeo_paper import made_paper_task, make_paper_task

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import ensure_tasks, make_tasks, why_to_draw
from sasgeo_bench.tasks.private_seed import PrivateSeed, seed_record, take_seed
from sasgeo_bench.tasks.suites.base import Seeds
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

TEXT = "0f1e2d3c4b5a69788796a5b4c3d2e1f0"
SEED = PrivateSeed(TEXT)


def request_of(out, seed, suite="clean"):
    wanted = TaskRequest(suites=(suite,), regions=("town-riverside",), split="crossfit", count=1, seed=seed, out=out)
    return plan_requests(wanted)[0]


def put_seed(folder, text=TEXT, *, name="my.seed", mode=0o600):
    path = folder / name
    path.write_text(text + "\n", encoding="ascii")
    path.chmod(mode)
    return path


def files_with(folder, text):
    """Files below a folder that hold a text, or the number that it is in hexadecimal digits."""
    needles = (text.encode(), bytes.fromhex(text), str(int(text, 16)).encode())
    paths = [path for path in folder.rglob("*") if path.is_file()]
    assert paths
    return [path for path in paths if any(needle in path.read_bytes() for needle in needles)]


@pytest.mark.parametrize(
    ("seed", "query", "draw"),
    [
        (7, "a84f6c6987a23404c869cc43", 408084407),
        (12345678901234567890, "3d1d47390bbb2f10ea425f1a", None),
    ],
)
def test_public_seeds_draw_what_they_always_drew(seed, query, draw):
    seeds = Seeds(root=seed, names=("vaduz", "clean", "1"))
    assert seeds.under("site", 0).digest("query", "control", "localization").hex()[:24] == query
    assert draw is None or seeds.rng("prior").integers(10**9) == draw
    assert seed_record(seed) == {"seed": seed}


@pytest.mark.parametrize("text", ["", "7f" * 16 + "x", "0x" + TEXT, TEXT.upper(), "7f 7f", "geheim"])
def test_text_that_is_no_seed_is_refused_and_not_repeated(text):
    with pytest.raises(ConfigError, match="random digits 0-9 and a-f") as refused:
        PrivateSeed(text)
    assert not text or text not in str(refused.value)


def test_digits_are_counted_as_bits_and_never_shown():
    assert [PrivateSeed(text).bits for text in (TEXT, "7" * 39, "7" * 20, "f" * 16, "12345")] == [128, 129, 66, 64, 16]
    assert TEXT not in f"{SEED} {SEED!r} {Seeds(root=SEED, names=())} {seed_record(SEED)}"


def test_a_private_seed_draws_other_than_the_number_of_the_same_digits():
    public, private = (Seeds(root=root, names=("vaduz",)) for root in (42, PrivateSeed("42")))
    assert public.digest("yaw") != private.digest("yaw")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o666])
def test_a_seed_file_that_others_can_read_is_refused(tmp_path, mode):
    path = put_seed(tmp_path, mode=mode)
    with pytest.raises(
        StoreError, match=rf"^\S+my.seed can be read by others \(mode {mode:o}\): chmod 600 \S+my.seed$"
    ) as refused:
        take_seed(path, {})
    assert TEXT not in str(refused.value)
    path.chmod(0o600)
    assert take_seed(path, {}) == SEED
    assert take_seed(path, {}).file == path.resolve()


def test_a_seed_file_is_a_small_file_of_its_name(tmp_path):
    for path, words in (
        (put_seed(tmp_path, name="seed.txt"), "must be named <name>.seed"),
        (tmp_path / "none.seed", "cannot be read"),
        (put_seed(tmp_path, "7" * 5000, name="long.seed"), "must be random digits"),
        (put_seed(tmp_path, "not digits", name="words.seed"), "must be random digits"),
    ):
        with pytest.raises((StoreError, ConfigError), match=words) as refused:
            take_seed(path, {})
        assert "not digits" not in str(refused.value)


def test_a_seed_of_the_environment_is_taken_out_of_it(tmp_path):
    environ = {"SASGEO_SEED": TEXT, "HOME": "/"}
    assert take_seed(None, environ) == SEED
    assert environ == {"HOME": "/"}
    assert take_seed(None, environ) is None
    with pytest.raises(ConfigError, match="--seed-file and SASGEO_SEED both give a private seed"):
        take_seed(put_seed(tmp_path), {"SASGEO_SEED": TEXT})


@pytest.mark.slow
def test_make_queries_draws_by_a_private_seed_into_a_root_of_its_own(program, tmp_path):
    asked = ("make-queries", "--suite", "clean", "--suite", "occlusion", "--regions", "town-riverside", "--n", 1)
    seed_file = put_seed(tmp_path)
    code, out, err = program(*asked)
    assert code == 0, err
    code, out, err = program(*asked, "--seed-file", seed_file)
    assert code == 0, err
    assert err.startswith(f"drawing by a private seed of 128 bits, commitment {SEED.commitment[:12]}, into OUT/private")
    assert "warning" not in err
    assert TEXT not in out + err
    public, private = (tmp_path / "out" / name for name in ("tasks", "private/tasks"))
    folders = [path.parent.relative_to(public) for path in sorted(public.rglob("task.json"))]
    assert folders == [path.parent.relative_to(private) for path in sorted(private.rglob("task.json"))]
    for folder in folders:
        assert set(task_files.Task.open(public / folder).ids()).isdisjoint(task_files.Task.open(private / folder).ids())
        given, other = (task_files.read_task(root / folder) for root in (private, public))
        assert given["private_seed"] == {"commitment": SEED.commitment, "bits": 128}
        assert "private_seed" not in other
        assert given["counts"]["localization"] == other["counts"]["localization"]
        assert given["map_fingerprint"] == other["map_fingerprint"]
    assert files_with(tmp_path / "out", TEXT) == []


def test_a_weak_private_seed_is_warned_of(program, monkeypatch):
    asked = ("make-queries", "--suite", "clean", "--regions", "town-riverside", "--n", 1, "--dry-run")
    for text, words in (("12345", "16 bits are no secret"), ("f" * 20, "makes no row reproduced: that takes 128 bits")):
        monkeypatch.setenv("SASGEO_SEED", text)
        code, out, err = program(*asked)
        assert code == 0, err
        assert words in err
        assert text not in out + err
        assert "SASGEO_SEED" not in os.environ
        assert "out/private/tasks" in out


def test_a_public_and_a_private_seed_at_once_are_refused(mistake, monkeypatch):
    monkeypatch.setenv("SASGEO_SEED", TEXT)
    line = mistake("make-queries", "--suite", "clean", "--regions", "town-riverside", "--seed", 3)
    assert line.endswith("--seed is public and a private seed is given too: leave one of them out")


def test_a_private_request_is_drawn_once_and_anew_by_another_seed(own_out):
    (folder,) = ensure_tasks(request_of(own_out, SEED))
    before = task_files.Task.open(folder).ids()
    lines = []
    with reporting(lines.append):
        assert ensure_tasks(request_of(own_out, SEED)) == (folder,)
    assert lines == []
    other = request_of(own_out, PrivateSeed("ab" * 16))
    assert why_to_draw(other) == "drawn with another seed"
    ensure_tasks(other)
    assert set(task_files.Task.open(folder).ids()).isdisjoint(before)


def test_public_and_private_queries_never_share_a_folder(own_out):
    for first, second in ((5, SEED), (SEED, 5)):
        suite = "clean" if first == SEED else "occlusion"
        make_tasks(request_of(own_out, first, suite))
        with pytest.raises(StoreError, match=r"was drawn by a .* seed, and this one is .*: choose another --out"):
            make_tasks(request_of(own_out, second, suite))


def test_the_papers_experiment_is_drawn_by_a_private_seed_under_its_own_names(tmp_path):
    folder = make_paper_task(seed=42, trials=2, out=tmp_path, private=SEED)
    assert made_paper_task(seed=42, trials=2, out=tmp_path, private=SEED) == folder
    assert made_paper_task(seed=42, trials=2, out=tmp_path) is None
    assert folder.name == "paper-poc-42"
    public = Seeds(root=42, names=("paper-poc", "1"))
    drawn = {public.under("trial", index).digest("query").hex()[:24] for index in range(2)}
    assert len(drawn.difference(task_files.Task.open(folder).ids())) == 2
    assert task_files.read_task(folder)["private_seed"] == {"commitment": SEED.commitment, "bits": 128}
    assert files_with(tmp_path, TEXT) == []
