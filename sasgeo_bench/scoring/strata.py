# SPDX-License-Identifier: Apache-2.0
"""Strata of a suite and steps of its ladders of strengths; neither depends on an answer."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.metrics import TRACKS, primary_of
from sasgeo_bench.tasks.query import PUBLISHED

ALL: Final = "all"
STRESS: Final = "stress"
CONTROL: Final = "control"
MOST_STEPS: Final = 24  # more are no steps: each query has its own random strength
DRIFT: Final = "odometer_drift"  # of flights
_EDGES: Final = {  # fixed, to keep boards comparable
    "unknown_share": (0.0, 0.2, 0.4, 0.6, 1.0),
    "changed_share": (0.0, 0.1, 0.2, 0.4, 1.0),
    "feature_density": (0.0, 0.05, 0.1, 0.2, 1.0),
    "alias_index": (0.0, 0.7, 0.8, 0.9, 1.0),
    DRIFT: (0.0, 0.01, 0.02, 0.04, 0.08, 1.0),
}
_MAPPING: Final = ("real-age",)  # suites whose maps differ mostly in completeness, not in construction


def strata(scores: pd.DataFrame) -> Iterator[tuple[str, Bools]]:
    """Yield names and masks, shape (N,), of every stratum of one suite that holds a query.

    Roles, then each step of each kind at each view size, then detectors if there are several, then bins of measured
    properties of the truth. A kind with one step and size has no separate rows for them.

    >>> table = {"role": ["control", "stress"], "kind": ["control", "U1"], "strength": [0.0, 0.3]}
    >>> table |= {"view_cells": [96, 96]}
    >>> table |= {name: [0.1, 0.5] for name in ("unknown_share", "changed_share", "feature_density", "alias_index")}
    >>> [name for name, _ in strata(pd.DataFrame(table))][:4]
    ['all', 'control', 'stress', 'U1']
    """
    yield ALL, np.ones(len(scores), dtype=bool)
    role = scores["role"].to_numpy()
    for name in (CONTROL, STRESS, "falsifier"):
        if (role == name).any():
            yield name, role == name
    kind, strength = scores["kind"].to_numpy(), scores["strength"].to_numpy(float)
    cells = scores["view_cells"].to_numpy()
    for one in dict.fromkeys(sorted(set(kind) - {CONTROL})):
        mine = kind == one
        yield one, mine
        steps = sorted({(step, size) for step, size in zip(strength[mine], cells[mine], strict=True)})
        if 1 < len(steps) <= MOST_STEPS:
            for step, size in steps:
                yield step_name(one, step, size), mine & (strength == step) & (cells == size)
    sizes = sorted(set(cells[role == CONTROL]))
    if len(sizes) > 1:
        for size in sizes:
            yield control_name(size), (role == CONTROL) & (cells == size)
    detector = scores["detector"].to_numpy() if "detector" in scores else np.full(len(scores), PUBLISHED)
    for name in sorted(set(detector)) if len(set(detector)) > 1 else ():
        yield f"detector {name}", detector == name
    yield from _bins(scores, role != CONTROL)


def is_counted(queries: pd.DataFrame) -> Bools:
    """Return a mask of the queries of one suite that its first figure counts, shape (N,).

    Present places under stress, or all present ones where nothing is stressed.

    >>> asked = pd.DataFrame({"role": ["control", "stress", "stress"], "is_present": [True, True, False]})
    >>> is_counted(asked).tolist(), is_counted(asked[:1]).tolist()
    ([False, True, False], [True])
    """
    present = queries["is_present"].to_numpy(bool)
    stress = present & (queries["role"] == STRESS).to_numpy(bool)
    return stress if stress.any() else present


def step_name(kind: str, step: float, view_cells: int) -> str:
    """Return the name of one step of a kind at one view size, as "G1 5, 96 cells"."""
    return f"{kind} {step:g}, {view_cells} cells"


def control_name(view_cells: int) -> str:
    """Return the name of the controls at one view size, as "control, 96 cells"."""
    return f"{CONTROL}, {view_cells} cells"


def is_step(stratum: str) -> bool:
    """Return whether a stratum is a step of a ladder, or the controls of one size of view, and not a kind.

    >>> is_step("G1 5, 96 cells"), is_step("control, 96 cells"), is_step("G1")
    (True, True, False)
    """
    return stratum.endswith(" cells")


def is_bin(stratum: str) -> bool:
    """Return whether a stratum is a bin of a measured property.

    >>> is_bin("alias_index 0.7-0.8"), is_bin("S1")
    (True, False)
    """
    return stratum.split(" ", maxsplit=1)[0] in _EDGES


def _bins(scores: pd.DataFrame, counted: Bools) -> Iterator[tuple[str, Bools]]:
    """Yield bins of measured properties, without the controls."""
    is_mapping = (
        scores["suite"].isin(_MAPPING).to_numpy(bool) if "suite" in scores else np.zeros(len(scores), dtype=bool)
    )
    for column, edges in _EDGES.items():
        if column not in scores:
            continue
        name = f"{column} (mostly mapping)" if column == "changed_share" and is_mapping.all() else column
        values = scores[column].to_numpy(float)
        for low, high in pairwise(edges):
            is_last = high == edges[-1]
            inside = counted & (values >= low) & ((values <= high) if is_last else (values < high))
            if inside.any():
                yield f"{name} {low:g}-{high:g}", inside


GROUP: Final = ("suite", "track", "prior_group")


def queries_of(scores: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return the query columns of scored rows, each query once."""
    found = next(iter(scores.values())).iloc[:0]
    whole: list[pd.Series] = []  # ids of matchers whose queries are in it: many were asked the same
    for frame in scores.values():
        ids = frame["query_id"]
        if not any(ids.equals(one) for one in whole):
            whole.append(ids)
            fresh = frame[~ids.isin(found["query_id"])].drop_duplicates("query_id")
            found = pd.concat([found, fresh], ignore_index=True) if len(found) else fresh.reset_index(drop=True)
    return found


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


class _Step(NamedTuple):
    """The stratum of one step of a kind at one view size."""

    suite: str
    track: str
    prior_group: str
    kind: str
    strength_unit: str
    stratum: str
    strength: float
    view_cells: int


def _ladders(queries: pd.DataFrame) -> Iterator[_Step]:
    """Yield every step of each kind that has several."""
    some = queries[queries["is_present"].to_numpy(bool)]
    for key, group in some.groupby(list(GROUP), sort=True):
        sizes = sorted(set(group.loc[group["role"] == CONTROL, "view_cells"]))
        stress = group[group["role"] == STRESS]
        suite, track, prior_group = map(str, key)
        for kind, mine in stress.groupby("kind", sort=True):
            if mine["strength"].nunique() < 2:  # one step is no ladder
                continue
            step = partial(_Step, suite, track, prior_group, str(kind), str(mine["strength_unit"].iloc[0]))
            steps = sorted({*zip(mine["strength"], mine["view_cells"], strict=True)})
            for strength, size in steps:
                yield step(stratum=step_name(str(kind), strength, size), strength=strength, view_cells=size)
            for size in sorted({size for _, size in steps} & {*sizes}):
                name = control_name(size) if len(sizes) > 1 else CONTROL
                yield step(stratum=name, strength=0.0, view_cells=size)
