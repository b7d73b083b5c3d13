# SPDX-License-Identifier: Apache-2.0
"""The board of segmenters: what is stored of trials, and the tables that are made of it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import MetricError, StoreError
from sasgeo_bench.core.parquet import write_frame
from sasgeo_bench.scoring.segmentation import PixelCounts
from sasgeo_bench.scoring.segmenter_board import SegmenterBoard, SegmenterTrial, page_tables, with_tables, write_board
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import with_picture

CLASSES = ("building", "water")
SIDE = 20


def counts_of(places, *, classes=CLASSES, right=0.9):
    """Counts of pictures whose pixels are seen rightly with a probability."""
    rng = np.random.default_rng(7)
    found = []
    for at, place in enumerate(places):
        labels = rng.integers(0, 2, (len(classes), SIDE, SIDE), dtype=np.uint8)
        seen = np.where(rng.random(labels.shape) < right, labels, 1 - labels)
        image = replace(with_picture(np.zeros((SIDE, SIDE, 3), dtype=np.uint8)), season="summer")
        labelled = LabelledImage(image=image, classes=classes, labels=labels, place=place)
        given = Segmentation(classes=classes, probability_bytes=(seen * 200 + 20).astype(np.uint8))
        found.append(PixelCounts.of(labelled, given, image=str(at)))
    return found


def trial(counts, **changes):
    plain = SegmenterTrial(
        segmenter="mine",
        learned_from="rendered",
        tested_on="test",
        counts={"plain": counts, "flight": counts},
        learn_s=12.0,
        learned_mb=1.5,
        segment_s=0.25,
    )
    return replace(plain, **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("board")
    many = trial(counts_of([f"place-{at}" for at in range(6)] * 2))
    few = trial(counts_of(["north", "south"], classes=("building",)), tested_on="real")
    write_board(path, [many, few], draws=50, attrs={"pictures": 12})
    return path


def table_below(text, title):
    return re.search(rf"## {title}\n\n((?:\|.*\n?)+)", text)[1].splitlines()


def test_a_board_comes_back_with_one_profile_for_each_trial(folder):
    board = SegmenterBoard.read(folder)
    assert set(board.profiles) == {"mine-rendered-test.toml", "mine-rendered-real.toml"}
    assert board.profiles["mine-rendered-test.toml"].classes["building"].recall == pytest.approx(0.9, abs=0.05)
    assert board.runs["places"].tolist() == [6, 2]
    assert board.runs.attrs == {"pictures": 12}


def test_places_and_seasons_are_scored_for_plain_probabilities_alone(folder):
    scores = SegmenterBoard.read(folder).scores
    assert set(scores.loc[scores["shares"] == "flight", "group"]) == {"all"}
    assert set(scores.loc[scores["shares"] == "plain", "group"]) == {"all", "place", "season"}


def test_intervals_of_few_places_draw_pictures_and_are_marked(folder):
    _, _, many, few = table_below(page_tables(SegmenterBoard.read(folder)), "From set to set: buildings")
    assert "†" not in many
    assert few.count("†") == 5


def test_a_trial_of_one_class_has_no_row_among_the_classes(folder):
    lines = table_below(page_tables(SegmenterBoard.read(folder)), "Classes")[2:]
    assert [line.split(" | ")[3] for line in lines] == ["building", "water"]
    assert all("| test |" in line for line in lines)


def test_what_is_kept_of_all_pixels_has_their_error_and_recall(folder):
    board = SegmenterBoard.read(folder)
    scores = board.scores[(board.scores["group"] == "all") & (board.scores["shares"] == "plain")]
    value = scores[(scores["class"] == "building") & (scores["tested_on"] == "test")].set_index("metric")["value"]
    line = table_below(page_tables(board), "Unknown: buildings")[2]
    assert f"| {value['error']:.3f} / {value['recall']:.3f} |" in line


def test_tables_are_put_into_a_page_below_their_headings_and_prose_stays(folder):
    board = SegmenterBoard.read(folder)
    titles = re.findall("^## .*", page_tables(board), re.MULTILINE)
    page = "# Page\n\n| kept |\n\n" + "".join(f"{title}\n\nBefore.\n\n| old |\n\nAfter.\n\n" for title in titles)
    text = with_tables(page, board)
    assert "| old |" not in text
    assert (text.count("Before."), text.count("After."), text.count("| kept |")) == (len(titles), len(titles), 1)
    assert with_tables(text, board) == text
    with pytest.raises(MetricError, match="no heading '## Costs' with a table"):
        with_tables(page.replace("## Costs", "## Prices"), board)


def test_a_second_board_in_a_folder_leaves_no_profile_of_the_first(tmp_path):
    for name in ("first", "second"):
        write_board(tmp_path, [trial(counts_of(["here"]), segmenter=name)], draws=5)
    assert set(SegmenterBoard.read(tmp_path).profiles) == {"second-rendered-test.toml"}


def test_a_folder_that_holds_something_else_is_refused(folder, tmp_path):
    with pytest.raises(StoreError):
        SegmenterBoard.read(tmp_path)
    board = SegmenterBoard.read(folder)
    for name in ("scores", "reliability", "coverage", "runs"):
        frame = getattr(board, name)
        frame = frame.drop(columns="tested_on") if name == "coverage" else frame
        write_frame(frame, tmp_path / f"{name}.parquet", attrs={})
    with pytest.raises(StoreError, match="no table of a board of segmenters"):
        SegmenterBoard.read(tmp_path)
