# SPDX-License-Identifier: Apache-2.0
"""Schemas of the tables of a board: what each column holds is stated once, where its rows are declared."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated, Any, Final, NamedTuple, Self, TypeVar, get_args, get_origin, get_type_hints

import pandas as pd

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.scoring.intervals import BoardInterval, Interval

Item = TypeVar("Item")


class Shown(NamedTuple):
    """What a column holds, where tables are shown, too; `head` is its title there, by default its name."""

    meaning: str
    head: str = ""


MATCHER: Final = Shown(
    "Name of the entry. Controls have no rank: they are references for reading the figures",
)
REJECTOR: Final = Shown(
    "Estimates of each answer how likely it is false; own: the matcher's own confidence, fitted to nothing",
)
TRACK: Final = Shown(
    "localization: find the place on the map; retrieval: pick it among candidates; sequence: follow a flight",
)
PRIOR_GROUP: Final = "What was known of the pose before; figures of two groups are never ranked against each other"


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table; its unit is in its name: `_m`, `_deg`, `_s`, `_mb`.

    `kind` is `str`, `bool` or `int`, which have a value in each row, or `int | None` or `float`, which may have none.
    `head` is the title where tables are shown, "" where none shows it. `source` is the attribute of a row, if it is not
    the name, as "finding.first".
    """

    name: str
    kind: Any
    meaning: str
    head: str = ""
    source: str = ""

    @classmethod
    def of(cls, name: str, kind: object) -> Self:
        """Return the column of a field whose type may be annotated with a meaning, or with `Shown`."""
        found, shown = get_args(kind)[:2] if get_origin(kind) is Annotated else (kind, "")
        if isinstance(shown, Shown):
            return cls(name, found, shown.meaning, shown.head or name)
        return cls(name, found, shown)

    def holds(self, values: "pd.Series[Any]") -> bool:
        """Return whether a column of a table is of this kind."""
        if self.kind is str:
            return bool(values.map(lambda one: isinstance(one, str)).all())
        if self.kind is bool:
            return bool(pd.api.types.is_bool_dtype(values)) and not values.isna().any()
        if self.kind is int:
            return bool(pd.api.types.is_integer_dtype(values)) and not values.isna().any()
        is_number = pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_bool_dtype(values)
        return bool(is_number) or bool(values.isna().all())


def row_columns(row: type) -> tuple[Column, ...]:
    """Return the columns of a class of rows; an `Interval` is a value and its ends.

    >>> @dataclass
    ... class Found:
    ...     share: Annotated[Interval, "Share of queries"]
    >>> [column.name for column in row_columns(Found)]
    ['share', 'share_lo', 'share_hi']
    """
    found = []
    for column in (Column.of(*field) for field in get_type_hints(row, include_extras=True).items()):
        if column.kind not in {Interval, BoardInterval}:
            found.append(column)
            continue
        found.append(replace(column, kind=float, source=f"{column.name}.value"))
        for end, word in (("lo", "Lower"), ("hi", "Upper")):
            meaning = f"{word} end of the 95 % interval of `{column.name}`"
            found.append(Column(f"{column.name}_{end}", float, meaning, source=f"{column.name}.{end}"))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Schema:
    """The columns of `<name>.parquet`, in their order.

    Files of older versions may lack those that are not `needed`, by default none. A board that lacks a table that is
    not `is_required` has one without columns.
    """

    name: str
    columns: tuple[Column, ...]
    needed: tuple[str, ...] = ()
    is_required: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(column.name for column in self.columns)

    def __getitem__(self, name: str) -> Column:
        """Return a column by its name."""
        return self.columns[self.names.index(name)]

    def empty(self) -> pd.DataFrame:
        """Return the table without a row; its columns have no type."""
        return pd.DataFrame(columns=list(self.names))

    def frame(self, rows: Iterable[object]) -> pd.DataFrame:
        """Return the table of some rows, whose attributes are the columns."""
        values = attrgetter(*(column.source or column.name for column in self.columns))
        table = pd.DataFrame(list(map(values, rows)), columns=list(self.names))
        return table.astype({column.name: "Int64" for column in self.columns if column.kind == int | None})

    def rows(self, kind: Callable[..., Item], table: pd.DataFrame) -> list[Item]:
        """Return the rows of a table that `frame` made; whatever follows from others is left out."""
        if not len(table):
            return []
        names = [*get_type_hints(kind)]
        columns = [table[name].astype(self[name].kind).tolist() for name in names]
        return [kind(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)]

    def check(self, table: pd.DataFrame) -> None:
        """Raise StoreError, naming file and column, if one is missing, of another kind, or lacks a value.

        >>> Schema("controls", (Column("matcher", str, "Its name"),)).check(pd.DataFrame({"control": ["blind"]}))
        Traceback (most recent call last):
            ...
        sasgeo_bench.core.errors.StoreError: controls.parquet has no column 'matcher': score it again
        """
        if not (self.is_required or len(table.columns)):
            return
        for column in map(self.__getitem__, self.needed or self.names):
            if list(table.columns).count(column.name) != 1:
                fault = "two columns" if column.name in table else "no column"
                raise StoreError(f"{self.name}.parquet has {fault} {column.name!r}: score it again")
            if len(table) and not column.holds(table[column.name]):
                fault = "something else than it should, or nothing"
                raise StoreError(f"{self.name}.parquet: {column.name} holds {fault}: score it again")
