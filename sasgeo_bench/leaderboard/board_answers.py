# SPDX-License-Identifier: Apache-2.0
"""Where the answers of a board lie: place and fix of every query, and the class of each failure."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from sasgeo_bench.leaderboard.board_files import ANSWER_SCHEMA
from sasgeo_bench.leaderboard.scored import Scored
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.pose import columns_of
from sasgeo_bench.scoring.score import single_views


def answers_frame(scored: Scored, failures: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return a row for each answer of some matchers to a single view, with the columns of `ANSWER_SCHEMA`.

    `failures` are all of these matchers, as of `cases.find_cases`; `failure` is empty where there is none. Falsifiers
    are left out: nothing is asked of them than another answer. `view_m` is the side of a view. True is where it was
    taken, also of absent places; poses that do not exist are NaN.
    """
    frames = [_answers_of(scored, name, failures) for name in names if name in scored.scores]
    some = [frame for frame in frames if len(frame)]
    return pd.concat(some, ignore_index=True) if some else ANSWER_SCHEMA.empty()


def _answers_of(scored: Scored, name: str, failures: pd.DataFrame) -> pd.DataFrame:
    scores = single_views(scored.scores[name])
    rows = scores[(scores["role"] != "falsifier").to_numpy(bool)]
    ids = rows["query_id"].tolist()
    mine = failures[(failures["matcher"] == name).to_numpy(bool)]
    classes = dict(zip(mine["query_id"], mine["failure"], strict=True))
    true = columns_of([scored.truths[query_id].pose for query_id in ids])
    columns = {
        "query_id": ids,
        "matcher": name,
        **{column: rows[column].to_numpy() for column in ("suite", "region", "kind", "role", "is_present", "status")},
        "failure": [classes.get(query_id, "") for query_id in ids],
        "view_m": (rows["view_cells"] * rows["cell_size_m"]).to_numpy(),
        **_numbers("true", true),
        **_numbers("fix", _fixes(scored.predictions[name], ids)),
    }
    return pd.DataFrame(columns)[list(ANSWER_SCHEMA.names)]


def _fixes(answers: StoredAnswers, ids: Sequence[str]) -> Floats:
    """Return the fixes of some queries as columns, shape (N, 4); NaN without one."""
    place = {query_id: at for at, query_id in enumerate(ids)}
    found = np.full((len(ids), 4), np.nan)
    for columns in answers.columns(ids):
        at = np.array([place.get(query_id, -1) for query_id in columns.query_id], dtype=np.int64)
        is_fix = (at >= 0) & (columns.fix >= 0)
        found[at[is_fix]] = columns.poses[columns.fix[is_fix]]
    return found


def _numbers(what: str, poses: Floats) -> dict[str, Floats]:
    """Return poses to a decimetre and a tenth of a degree: enough to draw, and small on disk."""
    names = ("easting_m", "northing_m", "yaw_deg")
    return {f"{what}_{name}": column.round(1) for name, column in zip(names, poses.T[:3], strict=True)}
