# SPDX-License-Identifier: Apache-2.0
"""Schemas of tables: what is written has their columns, what is read is checked by them, and rows come back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pandas as pd
import pytest

from sasgeo_bench.boards.board_files import SCHEMAS
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA, Finding
from sasgeo_bench.scoring.controls import CONTROL_SCHEMA, Verdict
from sasgeo_bench.scoring.frames import Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import Interval

STORED = Path(__file__).parents[2] / "docs" / "results" / "towns"


@dataclass(frozen=True, kw_only=True)
class Found:
    matcher: Annotated[str, Shown("Its name", "entry")]
    n: Annotated[int, "Queries"]
    holds: Annotated[bool, "It holds"]
    share: Annotated[Interval, Shown("Share of queries")]
    rank: Annotated[int | None, "Best rank"] = None


SCHEMA = Schema("found", row_columns(Found))
FOUND = Found(matcher="mine", n=2, holds=True, share=Interval(value=0.5, lo=0.25, hi=0.75))
TABLE = SCHEMA.frame([FOUND])


def test_a_row_becomes_columns_with_types_and_an_interval_three():
    assert TABLE.to_dict("list") == {
        "matcher": ["mine"],
        "n": [2],
        "holds": [True],
        "share": [0.5],
        "share_lo": [0.25],
        "share_hi": [0.75],
        "rank": [None],
    }
    assert (TABLE.dtypes["n"], TABLE.dtypes["rank"]) == ("int64", "Int64")
    assert [(one.head, one.meaning) for one in SCHEMA.columns if one.head] == [
        ("entry", "Its name"),
        ("share", "Share of queries"),
    ]
    assert list(SCHEMA.empty().columns) == list(SCHEMA.frame([]).columns) == list(TABLE.columns)


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        (TABLE.drop(columns="n"), "has no column 'n'"),
        (TABLE[["matcher", "n", "n"]], "has two columns 'n'"),
        (TABLE.assign(matcher=1), "matcher holds something else than it should, or nothing"),
        (TABLE.assign(n=1.0), "n holds"),
        (TABLE.assign(holds=1), "holds holds"),
        (TABLE.assign(share="half"), "share holds"),
    ],
)
def test_a_table_that_is_not_of_its_schema_is_refused(table, fault):
    SCHEMA.check(TABLE.assign(share=None))
    with pytest.raises(StoreError, match=rf"found\.parquet:? {fault}.*score it again"):
        SCHEMA.check(table)


def test_a_missing_table_is_one_without_columns_where_it_may_be_missing():
    SCHEMAS["contrasts"].check(pd.DataFrame())
    with pytest.raises(StoreError, match=r"leaderboard\.parquet has no column 'matcher'"):
        SCHEMAS["leaderboard"].check(pd.DataFrame())


@pytest.mark.parametrize("name", ["leaderboard", "contrasts", "controls", "falsifiers", "acceptance", "protection"])
def test_tables_of_a_board_have_the_columns_of_their_schema_in_order(name):
    table = read_frame(STORED / f"{name}.parquet", mend="")
    SCHEMAS[name].check(table)
    assert tuple(table.columns) == SCHEMAS[name].names


@pytest.mark.parametrize(("schema", "kind"), [(CONTRAST_SCHEMA, Finding), (CONTROL_SCHEMA, Verdict)])
def test_rows_come_back_from_their_table(schema, kind):
    table = read_frame(STORED / f"{schema.name}.parquet", mend="")
    rows = schema.rows(kind, table)
    assert len(rows) == len(table) > 0
    assert all(isinstance(row, kind) for row in rows)
    assert schema.rows(kind, pd.DataFrame()) == []
    columns = [one.name for one in row_columns(kind)]
    pd.testing.assert_frame_equal(schema.frame(rows)[columns], table[columns], check_exact=True)


def test_every_column_says_what_it_holds():
    assert [(name, one.name) for name, schema in SCHEMAS.items() for one in schema.columns if not one.meaning] == []
