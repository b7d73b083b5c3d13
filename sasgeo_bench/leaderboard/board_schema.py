# SPDX-License-Identifier: Apache-2.0
"""Tables of a board that anybody may have made, held against what its pages take from them."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import StoreError
from sasgeo_bench.scoring import falsifiers, protection
from sasgeo_bench.scoring.contrasts import Finding
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.scoring.rows import Row

_TEXTS: Final = frozenset({"contrast", "suite", "kind", "matcher", "prior_group", "method", "supports"})
_FINDING: Final = {item.name: item.type for item in fields(Finding)}
_SHAPES: Final[Mapping[str, Mapping[str, Any]]] = {
    "leaderboard": {item.name: item.type for item in fields(Row)},
    "contrasts": _FINDING,
    "falsifiers": {name: str if name in _TEXTS else _FINDING[name] for name in falsifiers.COLUMNS},
    "controls": {item.name: item.type for item in fields(Verdict)},
    "protection": {name: str if name in _TEXTS else float for name in protection.COLUMNS},
    "scores": {
        **dict.fromkeys(("query_id", "matcher", "suite", "track", "kind", "role", "place"), str),
        "is_present": bool,
    },
}


def check_shape(name: str, table: pd.DataFrame) -> None:
    """Refuse a table whose columns are missing, of another type, or without a name where there must be one.

    Parameters
    ----------
    name : str
        Of the table, as in "leaderboard".
    table : pandas.DataFrame
        As it was read; one that no board has to have may be without columns.

    Raises
    ------
    StoreError
        Naming the file and the column.

    Examples
    --------
    >>> check_shape("controls", pd.DataFrame({"control": ["blind"]}))
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: controls.parquet has no column 'matcher': score it again
    """
    if name != "leaderboard" and not len(table.columns):
        return
    for column, kind in _SHAPES[name].items():
        if list(table.columns).count(column) != 1:
            fault = "two columns" if column in table else "no column"
            message = f"{name}.parquet has {fault} {column!r}: score it again"
            raise StoreError(message)
        if len(table) and not _is_of(table[column], kind):
            message = f"{name}.parquet: {column} holds something else than it should, or nothing: score it again"
            raise StoreError(message)


def _is_of(values: "pd.Series[Any]", kind: object) -> bool:
    """Return whether a column holds texts, booleans or whole numbers without a gap, or numbers with gaps."""
    if kind is str:
        return bool(values.map(lambda one: isinstance(one, str)).all())
    if kind is bool:
        return bool(pd.api.types.is_bool_dtype(values)) and not values.isna().any()
    is_number = pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_bool_dtype(values)
    if kind is int:
        return bool(pd.api.types.is_integer_dtype(values)) and not values.isna().any()
    return bool(is_number) or bool(values.isna().all())
