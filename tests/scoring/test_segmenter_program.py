# SPDX-License-Identifier: Apache-2.0
"""The program that makes the board of segmenters: blocks of real pictures, trials, and a small trial carried out."""

import argparse
import importlib.util
from pathlib import Path

import pytest

from sasgeo_bench.scoring.segmenter_board import SegmenterBoard, write_board
from sasgeo_bench.sensing.image import LabelledFiles
from tests.regions.imagery_place import make_hamlet

PROGRAM = Path(__file__).parents[2] / "benchmarks" / "segmenters.py"
SETS = {
    "rendered": ["a", "b"],
    "test": ["c"],
    "shifted": ["c"],
    "zanzibar": ["north-0", "north-1", "south-0", "south-1"],
    "banepa": ["core-0", "north-0"],
}


@pytest.fixture
def program():
    spec = importlib.util.spec_from_file_location("segmenters_program", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def sets():
    return {name: [(Path(name, block, "0"), Path(name, block, "1")) for block in some] for name, some in SETS.items()}


@pytest.fixture
def blocks(program, tmp_path, monkeypatch):
    """Blocks of a made-up region with imagery, in place of the real ones."""
    hamlet = make_hamlet(tmp_path / "hamlet")
    monkeypatch.setattr(program, "REAL", {"hamlet": (("whole",), 2)})
    monkeypatch.setattr(program, "find_region_file", lambda name: name)
    monkeypatch.setattr(program, "read_region_file", lambda _: hamlet.spec())
    return program.real_blocks("hamlet", argparse.Namespace(out=tmp_path / "out", hamlet=hamlet.folder))


def names(files):
    return {path.parent.as_posix() for path in files}


def test_every_segmenter_is_tested_on_every_set_and_learns_from_each_kind(program, sets):
    trials = list(program.trials_of(sets, ("colour_thresholds", "pixel_forest")))
    assert {(trial.segmenter, trial.learned) for trial in trials if trial.segmenter == "colour_thresholds"} == {
        ("colour_thresholds", "-")
    }
    assert [(trial.learned, trial.tested) for trial in trials if trial.segmenter == "pixel_forest"] == [
        *(("rendered", tested) for tested in ("test", "shifted", "zanzibar", "banepa")),
        ("zanzibar", "zanzibar"),
        ("zanzibar", "banepa"),
        ("banepa", "banepa"),
    ]


def test_no_block_is_learned_from_where_it_is_tested(program, sets):
    trials = {(trial.learned, trial.tested): trial for trial in program.trials_of(sets, ("pixel_forest",))}
    for real in ("zanzibar", "banepa"):
        folds = trials[real, real].folds
        assert len(folds) == len(SETS[real])
        for taught, asked in folds:
            assert not names(taught) & names(asked)
            assert names(taught) | names(asked) == {f"{real}/{block}" for block in SETS[real]}
    ((taught, asked),) = trials["zanzibar", "banepa"].folds
    assert (len(taught), len(asked)) == (8, 4)


def test_trials_that_learn_from_other_pictures_are_kept_in_other_files(program, sets):
    trials = list(program.trials_of(sets, ("pixel_forest",)))
    taught = {program.digest(fold[0]) for trial in trials for fold in trial.folds}
    assert len(taught) == 1 + 4 + 1 + 2  # rendered, zanzibar without each block, all of zanzibar, either part of banepa


def test_pictures_of_another_number_are_not_taken_for_those_that_were_asked_for(program, tmp_path):
    (tmp_path / "done.json").write_text('{"asked": 3, "pictures": 3, "seconds": 1.0}')
    assert program.files_of(tmp_path, lambda: iter(()), asked=3) == ()
    with pytest.raises(SystemExit, match="made with --pictures 3, not 4"):
        program.files_of(tmp_path, lambda: iter(()), asked=4)


@pytest.mark.slow
def test_real_pictures_become_a_board(program, blocks, tmp_path):
    assert [len(block) > 0 for block in blocks] == [True, True]
    assert {one.place for one in LabelledFiles(blocks[0])} == {"hamlet-whole"}
    trials = [
        program.Trial("colour_thresholds", "-", "hamlet", (((), (*blocks[0], *blocks[1])),)),
        program.Trial("pixel_forest", "hamlet", "hamlet", tuple(program.without_each(blocks))),
    ]
    done = [program.outcome(trial, tmp_path / "made") for trial in trials]
    write_board(tmp_path / "board", done, draws=20)
    scores = SegmenterBoard.read(tmp_path / "board").scores
    found = scores[(scores["group"] == "all") & (scores["metric"] == "auc") & (scores["shares"] == "plain")]
    assert found["value"].min() > 0.95  # roofs of the made-up mosaic are far brighter than the ground
    again = [program.outcome(trial, tmp_path / "made") for trial in trials]
    for first, second in zip(done, again, strict=True):
        assert first.learn_s == second.learn_s
        both = zip(first.counts["plain"], second.counts["plain"], strict=True)
        assert all((one.pixels == other.pixels).all() for one, other in both)
    assert len(list((tmp_path / "made" / "learned").glob("*.json"))) == 2  # without either block
