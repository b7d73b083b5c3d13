# SPDX-License-Identifier: Apache-2.0
"""docs/concepts/paper.md says what its stored tables hold: every row, every figure, and every count of readings."""

import re
from pathlib import Path

import pandas as pd
import pytest
from sasgeo_paper.board import paper_markdown
from sasgeo_paper.decoys import decoys_markdown
from sasgeo_paper.tables import PUBLISHED

PAGE = Path(__file__).parents[2] / "docs" / "concepts" / "paper.md"
ABOUT = {"trials": "220 trials", "made_by": "a test", "data": "made up"}
CROPS = ("unknown", "absent", "smaller")
DECOYS = ["chosen_by", "nearest_to", "windows", "ranked_by"]


@pytest.fixture(scope="module")
def readings():
    """The board of pipelines/paper-readings.toml."""
    return pd.read_parquet(PAGE.parent / "paper" / "readings.parquet")


@pytest.fixture(scope="module")
def decoys():
    """The table of `python -m sasgeo_paper`."""
    return pd.read_parquet(PAGE.parent / "paper" / "decoys.parquet")


def part(title: str) -> str:
    """The text under a heading of the page, its line ends as spaces in prose."""
    return re.split(rf"^##+ {title}$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1].split("\n##")[0]


def rows(text: str) -> list[str]:
    return re.findall(r"^\| (?!Method|Recall@1|Chosen).* \|$", text, flags=re.MULTILINE)


def prose(text: str) -> str:
    return " ".join(line.strip() for line in text.splitlines() if not line.startswith("|"))


def test_every_row_of_seed_42_is_that_of_the_board(readings):
    given = paper_markdown(readings, [], ABOUT, {})
    found = rows(part("Seed 42"))
    assert len(found) == len(PUBLISHED)
    for row in found:
        assert f"\n{row} 220 |" in given


def test_every_row_of_the_crop_is_that_of_the_board(readings):
    table = readings.set_index(["title", "metric", "crop"])
    expected = []
    for item in PUBLISHED:
        cells = [table.loc[(item.title, "recall_1", crop)] for crop in CROPS]
        lines = [f"{cell['value']:.3f} [{cell['lo']:.3f}, {cell['hi']:.3f}]" for cell in cells]
        expected.append(f"| {item.title} | {item.recall_1:.3f} | {' | '.join(lines)} |")
    inside = readings[readings["paper"].notna()].groupby("crop")["is_within"].sum()
    expected.append(f"| of 15 figures inside | | {' | '.join(str(inside[crop]) for crop in CROPS)} |")
    assert rows(part("Cropped cells")) == expected


def test_what_is_said_of_the_crop_follows_from_the_board(readings):
    spatial = readings[(readings["title"] != "Global descriptor") & readings["paper"].notna()]
    absent = spatial[spatial["crop"] == "absent"]
    assert "The reading *absent* agrees with the paper" in prose(part("Cropped cells"))
    assert absent["is_within"].all()
    assert len(absent) == 12


def test_every_row_of_the_decoys_is_that_of_the_table(decoys):
    given = decoys_markdown(decoys)
    found = rows(part("Decoys and descriptors"))
    assert len(found) > 5
    for row in found:
        assert f"\n{row.removesuffix(' |')} of 3 |" in given


def test_what_is_said_of_the_decoys_follows_from_the_table(decoys):
    text = prose(part("Decoys and descriptors"))
    held = decoys[decoys["inside"] == 3]
    assert f"{len(held)} of {len(decoys)} readings hold all three, and differ in every part" in text
    by_reading = decoys.set_index(DECOYS)["inside"]
    assert by_reading[("rings", "truth", 1470, "rings")] == 3  # the literal reading
    assert by_reading[("counts", "anchor", 1470, "shares")] == 0  # the experiment
    assert all(len(set(held[name])) > 1 for name in DECOYS)  # "differ in every part"


def test_the_experiment_is_the_same_in_both_tables(readings, decoys):
    board = readings[(readings["matcher"] == "global_descriptor") & (readings["crop"] == "unknown")]
    row = decoys.set_index(DECOYS).loc[("counts", "anchor", 1470, "shares")]
    for name, value in board.set_index("metric")["value"].items():
        assert row[name] == pytest.approx(value)
