# SPDX-License-Identifier: Apache-2.0
"""What figures read of stored results beside the tables of their board: ages of maps, and protection levels."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.boards.archive_file import is_pack, read_stored_predictions
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.parquet import read_table
from sasgeo_bench.scoring.protection import ProtectionLevels, protection_levels
from sasgeo_bench.tasks.split import Split

_TRUTHS: Final = "truths.parquet"
_MEND: Final = "store the results again"


def check_stored(folder: Path) -> None:
    """Raise `ConfigError` unless a folder holds stored results: a board alone has neither truths nor answers."""
    if not is_pack(folder):
        raise ConfigError(
            f"{folder} holds a board alone, and this figure needs truths and answers, too: store its results "
            "(score --results DIR) and read the board from there"
        )


def measured_of(folder: Path) -> dict[str, Mapping[str, float]]:
    """Return the measurements of the truths of stored results by query id; raise `StoreError` if they are damaged."""
    rows = read_table(folder / _TRUTHS, columns=["query_id", "measured"], mend=_MEND).to_pylist()
    return {row["query_id"]: dict(row["measured"] or ()) for row in rows}


def levels_of(
    folder: Path,
    scores: Mapping[str, pd.DataFrame],
    shown: Sequence[str],
    *,
    prior_group: str,
    risk: float,
    split: Split | None,
) -> dict[tuple[str, str], ProtectionLevels]:
    """Return protection levels of stored results by matcher and method, of one prior group and risk.

    Raise `StoreError` if they are damaged.
    """
    found: dict[tuple[str, str], ProtectionLevels] = {}
    for matcher in shown:
        mine = scores[matcher]
        mine = mine[mine["prior_group"] == prior_group]
        if mine.empty:
            continue
        answers = {
            item.query_id: item for item in read_stored_predictions(folder, matcher, queries=set(mine["query_id"]))
        }
        for item in protection_levels(mine, answers, split):
            if item.risk == risk and len(item.level_m):
                found[matcher, item.method] = item
    return found
