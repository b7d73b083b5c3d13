# SPDX-License-Identifier: Apache-2.0
"""Steps of a board: the primary metric along each ladder of strengths."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import pandas as pd

from sasgeo_bench.scoring.metrics import TRACKS, primary_of
from sasgeo_bench.scoring.strata import CONTROL, STRESS, control_name, step_name

GROUP: Final = ("suite", "track", "prior_group")


def queries_of(scores: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return the query columns of scored rows, each query once."""
    return pd.concat(list(scores.values()), ignore_index=True).drop_duplicates("query_id", ignore_index=True)


def steps_frame(table: pd.DataFrame, queries: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """Return the primary metric of the matchers `shown` at each step of each kind that has several.

    The rows are those of the leaderboard `table`, with the columns kind, strength, strength_unit and view_cells.
    Controls have strength 0 of each kind. View sizes are separate, since not every size has every step.
    """
    places = pd.DataFrame(_ladders(queries))
    if places.empty:
        return pd.DataFrame(columns=[*table.columns, "kind", "strength", "strength_unit", "view_cells"])
    rows = table[(table["rejector"] == "") & table["matcher"].isin(list(shown)) & table["value"].notna()]
    return primary_rows(rows).merge(places, on=[*GROUP, "stratum"], how="inner")


def primary_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the primary metric of each track."""
    wanted = {track: primary_of(track).name for track in TRACKS}
    return rows[(rows["metric"] == rows["track"].map(wanted)).to_numpy(bool)]


def _ladders(queries: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield the stratum name of each step of each kind, with its kind, strength and view size."""
    some = queries[queries["is_present"].to_numpy(bool)]
    for key, group in some.groupby(list(GROUP), sort=True):
        sizes = sorted(set(group.loc[group["role"] == CONTROL, "view_cells"]))
        stress = group[group["role"] == STRESS]
        for kind, mine in stress.groupby("kind", sort=True):
            if mine["strength"].nunique() < 2:  # noqa: PLR2004 - one step is no ladder
                continue
            columns = dict(zip(GROUP, key, strict=True))
            columns |= {"kind": kind, "strength_unit": mine["strength_unit"].iloc[0]}
            steps = sorted({*zip(mine["strength"], mine["view_cells"], strict=True)})
            for strength, size in steps:
                name = step_name(str(kind), strength, size)
                yield {**columns, "stratum": name, "strength": strength, "view_cells": size}
            for size in sorted({size for _, size in steps} & {*sizes}):
                name = control_name(size) if len(sizes) > 1 else CONTROL
                yield {**columns, "stratum": name, "strength": 0.0, "view_cells": size}
