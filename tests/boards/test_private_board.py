# SPDX-License-Identifier: Apache-2.0
"""Rows are reproduced where a private seed bears them out; a matcher that draws the truths again is found out."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards.archive import pack_board, request_of, score_all
from sasgeo_bench.boards.board_files import read_board_manifest
from sasgeo_bench.boards.board_tables import seed_table
from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.manifests import BoardEntry, PipelineRecord, SeedResult
from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.boards.private_board import OnPrivate, compare_seeds, result_of
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.boards.tables import Cell, marks_of, text_of
from sasgeo_bench.boards.text import seed_lines
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.exchange.release import ReleaseRequest, make_release
from sasgeo_bench.experiments.pipeline_plan import plan_pipeline
from sasgeo_bench.running import sandbox
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.runner import run
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.rows import PACKED
from sasgeo_bench.tasks.build import ensure_tasks
from sasgeo_bench.tasks.private_seed import PrivateSeed
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.scoring.test_tables import scores

pytestmark = pytest.mark.usefixtures("few_figures")

SEED = PrivateSeed("0f1e2d3c4b5a69788796a5b4c3d2e1f0")
PIPELINE = {"id": "little", "sha256": "ab" * 32}
PIPELINE_TEXT = """
id = "little"
title = "Little"
split = "crossfit"
regions = ["town-suburb"]
seed = 7
matchers = ["random"]

[paper]
seeds = [42]

[[task]]
suites = ["clean"]
sites = 4
"""
has_landlock = pytest.mark.skipif(sandbox.landlock_version() == 0, reason="this kernel has no Landlock")


def silent(line):
    del line


def rows(share, *, blocks=12, count=120, seed="public", **changes):
    """Scored rows of a matcher that is right on a share of the queries, four of them in each block and site."""
    is_right = (np.arange(count) * 37) % count < share * count
    sites = [f"{seed}-{at // 4}" for at in range(count)]
    return scores(np.where(is_right, 2.0, 80.0), blocks=blocks, pair_id=sites, **changes)


@pytest.mark.parametrize(
    ("public", "private", "verdict"), [(0.9, 0.1, "not reproduced"), (0.5, 0.5, "reproduced"), (0.1, 0.9, "reproduced")]
)
def test_a_row_is_reproduced_where_the_private_figure_is_not_shown_to_be_worse(public, private, verdict):
    figures = compare_seeds(rows(public), rows(private, seed="private"), draws=400)
    assert [item.suite for item in figures] == ["all suites", "occlusion"]
    assert all(item.lo <= item.difference <= item.hi for item in figures)
    assert figures[0].blocks_shared == 12
    found = result_of(figures)
    assert found.verdict == verdict
    assert f"private {private:.3f} against public {public:.3f}, difference {private - public:.3f} [" in found.why


def test_a_single_suite_that_falls_is_found_among_others_that_hold():
    def frame(fallen, seed):
        shares = {"clean": 0.5, "occlusion": 0.5, "alias": 0.5, "season": fallen}
        return pd.concat([rows(share, suite=suite, seed=seed) for suite, share in shares.items()], ignore_index=True)

    assert result_of(compare_seeds(frame(0.5, "public"), frame(0.5, "private"), draws=400)).verdict == "reproduced"
    found = result_of(compare_seeds(frame(0.95, "public"), frame(0.05, "private"), draws=400))
    assert (found.verdict, found.why.split(",")[0]) == ("not reproduced", "season")


def test_few_blocks_make_no_row_reproduced_and_nothing_in_common_neither():
    figures = compare_seeds(rows(0.5, blocks=5), rows(0.5, blocks=12, seed="private"), draws=400)
    found = result_of(figures)
    assert found.verdict == "run here"
    assert found.why == "localization is asked in 5 blocks of a seed, at least 6 are needed to decide"
    other = rows(0.5, seed="private", suite="alias")
    assert result_of(compare_seeds(rows(0.5), other.iloc[:0], draws=400)).why == "nothing was asked on both seeds"


def test_more_false_fixes_on_the_private_seed_are_worse_too():
    def frame(answered, seed):
        absent = rows(0.5, seed=seed, is_present=False)
        return absent.assign(is_answered=np.arange(len(absent)) % 10 < 10 * answered)

    for public, private, verdict in ((0.1, 0.9, "not reproduced"), (0.9, 0.1, "reproduced")):
        figures = compare_seeds(frame(public, "public"), frame(private, "private"), draws=400)
        assert {item.metric for item in figures} == {"answered_absent"}
        assert result_of(figures).verdict == verdict


def test_ground_that_both_seeds_have_in_common_is_drawn_for_both():
    """Blocks that are all right or all wrong on both seeds: drawn together, they cancel."""
    frame = rows(0.5).assign(position_error_m=np.where(np.arange(120) % 12 < 6, 2.0, 80.0))
    other = frame.assign(pair_id=frame["pair_id"] + "'")
    apart = other.assign(block=other["block"] + "'")
    spans = [
        figure.hi - figure.lo
        for private in (other, apart)
        for figure in compare_seeds(pd.concat([frame] * 8), pd.concat([private] * 8), draws=2000)[:1]
    ]
    assert spans[0] < spans[1]


# --- a matcher that draws the truths again ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Tasks of a public and of a private seed, runs of the cheating matcher on both, and the private board."""
    root = tmp_path_factory.mktemp("seeds")
    shutil.copy(Path(__file__).parents[1] / "running" / "redrawer.py", root / "redrawer.py")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.syspath_prepend(str(root))
        for out, seed in ((root / "out", 7), (root / "out" / "private", SEED)):
            wanted = TaskRequest(
                suites=("clean",), regions=("town-suburb",), split="crossfit", count=4, seed=seed, out=out
            )
            for request in plan_requests(replace(wanted, may_be_fewer=True)):
                tasks = ensure_tasks(request)
                run(plan_run(RunRequest(spec="redrawer:Redrawer", tasks=tasks, out=out)))
    make_board(request_on(root / "out" / "private"))
    return root


def request_on(out, **changes):
    board = ScoreRequest(predictions=[out / "runs"], root=out, board=out / "boards" / "little", draws=200)
    return replace(board, pipeline=PipelineRecord(**PIPELINE), **changes)


def entry_of(folder):
    (entry,) = read_board_manifest(folder).entries
    return entry


@pytest.mark.slow
@has_landlock
@pytest.mark.usefixtures("plain_site")
def test_who_draws_the_truths_again_is_right_on_the_public_seed_alone_and_the_board_says_so(made, tmp_path):
    lines = []
    private = made / "out" / "private" / "boards" / "little"
    with reporting(lines.append):
        board = make_board(request_on(made / "out", board=tmp_path / "board", private=private))
    entry = entry_of(tmp_path / "board")
    assert entry.how == "not reproduced"
    (figure,) = [item for item in entry.private.figures if item.suite == "clean"]
    assert (figure.public, figure.private) == (1.0, 0.0)
    assert figure.hi < 0
    assert set(board.board.leaderboard["how"]) == {"not reproduced"}
    assert any(
        line.startswith("redrawer: not reproduced (all suites, localization, success_25m: private") for line in lines
    )
    text = (tmp_path / "board" / "leaderboard.md").read_text(encoding="utf-8")
    assert "| redrawer | clean | localization | success_25m | 1.000 | 0.000 | -1.000 [-1.000, -" in text
    assert "| redrawer (not reproduced) | 1.000 [" in text
    assert "Public and private seed" in (tmp_path / "board" / "leaderboard.tex").read_text(encoding="utf-8")
    publish(tmp_path / "board")
    page = (tmp_path / "board" / "site" / "index.html").read_text(encoding="utf-8")
    assert '<span class="mark warn" title="it was run on a private seed too' in page
    assert "Public and private seed" in page


@has_landlock
def test_without_a_private_seed_a_row_says_run_here(made, tmp_path):
    make_board(request_on(made / "out", board=tmp_path / "board"))
    about = read_board_manifest(tmp_path / "board")
    assert entry_of(tmp_path / "board").how == "run here"
    assert not {"private", "private_seed"} & about.model_fields_set
    assert "so none is reproduced" in seed_lines(about)[0]
    assert not seed_table(about.entries).rows


@has_landlock
def test_stored_results_keep_both_figures_and_nothing_else_of_the_private_seed(made, tmp_path):
    private = made / "out" / "private" / "boards" / "little"
    request = request_on(made / "out", board=tmp_path / "board", private=private)
    pack_board(make_board(request), request, tmp_path / "pack")
    asked = pd.read_parquet(private / "scores.parquet")["query_id"]
    packed = [path.read_bytes() for path in (tmp_path / "pack").rglob("*") if path.is_file()]
    assert not [name for name in asked for data in packed if name.encode() in data]
    again = request_of([tmp_path / "pack"], board=tmp_path / "again", root=tmp_path)
    score_all(again)
    assert entry_of(tmp_path / "again").private == entry_of(tmp_path / "board").private
    assert entry_of(tmp_path / "again").how == "not reproduced"


@has_landlock
def test_nothing_of_a_private_seed_is_published_but_figures(made, tmp_path):
    out = made / "out" / "private"
    request = request_on(out, board=tmp_path / "board")
    board = make_board(request)
    release = ReleaseRequest(
        regions=("town-suburb",), suites=(), split="crossfit", with_truth=False, out=out, into=tmp_path / "release"
    )
    for publishing in (
        lambda: pack_board(board, request, tmp_path / "pack"),
        lambda: publish(tmp_path / "board"),
        lambda: make_release(release),
    ):
        with pytest.raises(ConfigError, match="is of a private seed, and holds queries, truths and answers"):
            publishing()
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["board"]


def changed(made, tmp_path, **changes):
    """A copy of the private board that says something else."""
    folder = Path(shutil.copytree(made / "out" / "private" / "boards" / "little", tmp_path / "other"))
    about = json.loads((folder / "board.json").read_text(encoding="utf-8"))
    (folder / "board.json").write_text(json.dumps(about | changes), encoding="utf-8")
    return folder


@has_landlock
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"private_seed": None}, "is a board of a public seed"),
        ({"pipeline": PIPELINE | {"sha256": "cd" * 32}}, "is of another pipeline file, or of other --matcher"),
        ({"task_version": 0}, r"has task_version 0, this program \d+: run the seed again"),
    ],
)
def test_a_private_board_of_something_else_is_refused(made, tmp_path, changes, words):
    private = changed(made, tmp_path, **changes)
    with pytest.raises(ConfigError, match=words):
        make_board(request_on(made / "out", board=tmp_path / "board", private=private))
    assert not (tmp_path / "board").exists()


@has_landlock
def test_only_the_same_code_shut_in_on_128_bits_vouches_for_a_row(made, tmp_path):
    record = entry_of(made / "out" / "private" / "boards" / "little").model_dump()
    seed = {"commitment": SEED.commitment, "bits": 80}
    for number, (changes, words) in enumerate(
        (
            ({"private_seed": seed}, "the private seed has 80 bits, 128 are needed"),
            (
                {"entries": [record | {"hash": "other"}]},
                "this version, code and settings are not on the private board",
            ),
            (
                {"entries": [record | {"isolation": {"truth": "not in its root | trusted code, not shut in"}}]},
                "on the private seed its truths were not kept from it (not in its root | trusted code, not shut in)",
            ),
        )
    ):
        private = changed(made, tmp_path / str(number), **changes)
        make_board(request_on(made / "out", board=tmp_path / f"board-{number}", private=private))
        assert entry_of(tmp_path / f"board-{number}").private == SeedResult(verdict="run here", why=words, figures=[])


@has_landlock
def test_a_private_board_is_not_held_against_another_and_seeds_are_not_mixed(made, tmp_path):
    out = made / "out"
    private = out / "private" / "boards" / "little"
    with pytest.raises(ConfigError, match="are of a private seed themselves: name a public board"):
        make_board(request_on(out / "private", board=tmp_path / "board", private=private))


def test_a_private_pipeline_is_the_same_with_another_seed_in_another_root(tmp_path):
    spec = parse_toml(PIPELINE_TEXT, PipelineFile, source="little.toml")
    public, private = (plan_pipeline(spec, out=tmp_path, private=seed) for seed in (None, SEED))
    assert private.out == tmp_path / "private"
    for name in ("requests", "controls"):
        ours, theirs = getattr(public, name), getattr(private, name)
        assert [replace(item, seed=7, out=tmp_path) for item in theirs] == list(ours)
        assert {item.seed for item in theirs} == {SEED}
        assert {item.out for item in theirs} == {tmp_path / "private"}
    assert private.spec.identity == public.spec.identity
    assert SEED.text not in private.to_text() + repr(private)


def test_a_private_pipeline_stores_no_results(program, tmp_path, monkeypatch):
    (tmp_path / "little.toml").write_text(PIPELINE_TEXT, encoding="utf-8")
    monkeypatch.setenv("SASGEO_SEED", SEED.text)
    code, out, err = program("leaderboard", "little.toml", "--results", "results")
    assert (code, out) == (2, "")
    assert err.splitlines()[-1].startswith(
        "sasgeo-bench: out/private/boards/little is of a private seed, and holds queries, truths and answers:"
    )
    assert not (tmp_path / "out").exists()
    assert SEED.text not in err


def test_boards_of_older_programs_do_not_pass_for_reproduced():
    fared = SeedResult(verdict="reproduced", why="", figures=[])
    for private, shown in ((None, "run here"), (fared, "reproduced")):
        entry = BoardEntry(name="mine", how="reproduced", private=private)
        assert [mark.text for mark in marks_of(entry, is_control=False)] == [shown]


def test_rows_of_answers_that_came_packed_say_so_whatever_a_private_seed_shows():
    packed = Entry(name="mine", version="1", hash="ab", how=PACKED, sources=())
    for verdict in ("run here", "reproduced"):
        assert (
            OnPrivate(rows={"mine": SeedResult(verdict=verdict, why="", figures=[])}).how(packed)
            == "answers came packed"
        )
    shown = BoardEntry(name="random", how=PACKED)
    for is_control in (True, False):
        assert "answers came packed" in [mark.text for mark in marks_of(shown, is_control=is_control)]
        cell = Cell(text="random", marks=marks_of(shown, is_control=is_control))
        assert "(answers came packed)" in text_of(cell)
