# SPDX-License-Identifier: Apache-2.0
"""Rows of other boards that asked the same queries stand beside those of a board."""

from pathlib import Path

import pandas as pd
import pytest

from sasgeo_bench.boards.board_files import BOARD
from sasgeo_bench.boards.elsewhere import asked_elsewhere, elsewhere_lines, elsewhere_tables
from sasgeo_bench.core.parquet import write_frame
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, Row
from tests.handmade import entry_of, put_board

KEY = ("clean", "localization", "r500-weak-s3")


def stored(folder: Path, shares: dict[str, float], asked: list[str | None]) -> Path:
    """Stored results of some matchers, and the hashes of their queries."""
    facts = {"suite": KEY[0], "track": KEY[1], "prior_group": KEY[2], "stratum": "all", "metric": "success_25m"}
    facts |= {"n": 2, "answered": 2, "missing": 0, "blocks": 2, "places": 2, "unit": "1", "better": "higher"}
    ends = {"lo": 0.0, "hi": 1.0, "interval": "places", "rejector": ""}
    rows = [Row(matcher=name, value=value, **facts, **ends) for name, value in shares.items()]
    put_board(folder, table=FIGURE_SCHEMA.frame(rows), entries=[entry_of(name) for name in shares])
    (folder / "pack.json").write_text("{}", encoding="utf-8")
    queries = pd.DataFrame({"asked_sha256": asked}, dtype="string")
    for name, value in zip(("suite", "track", "prior_group"), KEY, strict=True):
        queries[name] = value
    write_frame(queries, folder / "queries.parquet", attrs={})
    return folder


def test_the_best_rows_of_a_board_with_the_same_queries_are_told_and_shown(tmp_path: Path) -> None:
    mine = stored(tmp_path / "objects", {"graph": 0.3, "random": 0.0}, ["a", "b"])
    stored(tmp_path / "systems", {"raster": 0.8, "graph": 0.3, "dense": 0.9, "random": 0.0}, ["b", "a"])
    stored(tmp_path / "others", {"better": 1.0}, ["a", "c"])
    stored(tmp_path / "older", {"unknown": 1.0}, ["a", None])
    (stored(tmp_path / "damaged", {"spoilt": 1.0}, ["a", "b"]) / BOARD).write_text("{")
    found = asked_elsewhere(mine)
    (line,) = elsewhere_lines(found)
    assert line.startswith("clean, localization: the same ")
    assert "queries on the board systems, success_25m: dense 0.900 [" in line
    assert [name for name in ("raster", "graph", "random", "better", "unknown", "spoilt") if name in line] == ["raster"]
    ((table,),) = elsewhere_tables(found).values()
    assert [row.cells[0].text for row in table.rows] == ["dense", "raster"]
    assert table.columns[1].order == "descending"


@pytest.mark.parametrize("asked", [["a"], ["a", "b", "c"], []])
def test_a_board_that_asked_more_or_fewer_queries_is_not_comparable(tmp_path: Path, asked: list[str]) -> None:
    mine = stored(tmp_path / "objects", {"graph": 0.3}, ["a", "b"])
    stored(tmp_path / "systems", {"raster": 0.8}, asked)
    assert asked_elsewhere(mine) == ()
