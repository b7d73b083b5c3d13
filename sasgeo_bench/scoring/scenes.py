# SPDX-License-Identifier: Apache-2.0
"""Success by kind of place: what to expect at a place of which no more is known than that it is alpine, or coastal."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, get_args

import numpy as np
import pandas as pd

from sasgeo_bench.regions.region_spec import Scene
from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, is_unranked
from sasgeo_bench.scoring.strata import ALL, STRESS, is_counted, primary_rows, step_name
from sasgeo_bench.scoring.tables import asked_alike, leaderboard
from sasgeo_bench.tasks.query import BY

SCENES: Final[tuple[str, ...]] = get_args(Scene)


@dataclass(frozen=True, slots=True, kw_only=True)
class Use:
    """A suite as a user meets it: in words, and at which strength alone; None for all."""

    words: str
    strength: float | None = None


# Suites whose maps are searched as a user would: nothing is copied, bent, hidden or taken away for the test. The ladder
# of `clean` goes from half to four times the errors that were measured, of which a user meets the measured ones.
AS_USED: Final[Mapping[str, Use]] = {
    "clean": Use(words="a map of the day", strength=1.0),
    "real-age": Use(words="a map 2 to 10 years old"),
    "aerial": Use(words="a picture and a map of the day"),
    "real-image": Use(words="a real picture"),
    "flight-clean": Use(words="a flight and a map of the day"),
    "flight-real-age": Use(words="a flight and a map 2 to 10 years old"),
}
_RETRIEVAL: Final = "retrieval"  # nobody hands a user candidates of which one is right


def scene_frame(scores: Mapping[str, pd.DataFrame], *, draws: int, excluded: Collection[str] = ()) -> pd.DataFrame:
    """Return the primary metric of the ranked matchers by kind of place, with the columns of `rows.Row`.

    `scores` are scored rows by matcher. The column `stratum` is the kind, or "all" for all of them together: there the
    figure and its interval are those of the board. A place with several kinds counts in each. Only suites of `AS_USED`
    count, neither of candidates nor with a segmenter that knows the truth. Matchers in `excluded`, and controls, have
    no row.
    """
    ranked = {name: rows for name, rows in scores.items() if not is_unranked(name) and name not in excluded}
    some = {name: rows[is_as_used(rows)] for name, rows in ranked.items()}
    found = [leaderboard(alike, draws=draws, parts=scene_parts) for alike in asked_alike(some)]
    rows = primary_rows(pd.concat(found, ignore_index=True)) if found else FIGURE_SCHEMA.empty()
    return rows.assign(stratum=rows["stratum"].where(rows["stratum"].isin(SCENES), ALL)).reset_index(drop=True)


def is_as_used(scores: pd.DataFrame) -> Bools:
    """Return a mask of the scored rows of suites that are searched as a user would, shape (N,).

    >>> suites = ["real-age", "alias", "aerial+pixel_forest", "aerial+oracle_segmenter"]
    >>> is_as_used(pd.DataFrame({"suite": suites, "track": "localization"})).tolist()
    [True, False, True, False]
    """
    suites = scores["suite"].str.partition(BY)
    is_used = suites[0].isin(AS_USED) & ~suites[2].map(is_unranked).astype(bool)
    return np.asarray(is_used & (scores["track"] != _RETRIEVAL), dtype=bool)


def scene_parts(queries: pd.DataFrame) -> Iterator[tuple[str, Bools]]:
    """Yield names and masks, shape (N,), of the queries of one suite that count, and of those of each kind of place.

    The first has the name of that stratum on a board, so that both share their draws.

    >>> table = {"suite": "real-age", "role": ["stress", "stress", "control"], "is_present": True, "kind": "S1"}
    >>> table |= {"strength": [5.0, 2.0, 0.0], "view_cells": 192, "scene": ["alpine", "coastal,urban", "alpine"]}
    >>> [(name, mask.tolist()) for name, mask in scene_parts(pd.DataFrame(table))][:2]
    [('stress', [True, True, False]), ('urban', [False, True, False])]
    """
    counts = is_counted(queries)
    strength = AS_USED[str(queries["suite"].iloc[0]).partition(BY)[0]].strength
    name = STRESS if (queries.loc[counts, "role"] == STRESS).any() else ALL
    if strength is not None:
        counts = counts & (queries["strength"] == strength).to_numpy(bool)
        steps = queries.loc[counts, ["kind", "view_cells"]].drop_duplicates()
        name = "; ".join(step_name(str(kind), strength, int(cells)) for kind, cells in steps.to_numpy())
    tags = queries["scene"].str.split(",")
    yield name, counts
    for scene in SCENES:
        inside = counts & tags.map(lambda own, scene=scene: scene in own).to_numpy(bool)
        if inside.any():
            yield scene, inside
