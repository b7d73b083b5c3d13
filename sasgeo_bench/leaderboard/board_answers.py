# SPDX-License-Identifier: Apache-2.0
"""Where the answers of a board lie: place and fix of every query, and the class of each failure."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import pandas as pd

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.leaderboard.board import Board
from sasgeo_bench.leaderboard.board_files import ANSWER_COLUMNS
from sasgeo_bench.scoring.pose import first_pose
from sasgeo_bench.scoring.score import single_views

_TOLD: Final = ("suite", "region", "kind", "role", "is_present", "status")


def answers_frame(board: Board, failures: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return a row for each answer of some matchers to a single view, with the columns `ANSWER_COLUMNS`.

    `failures` are all of these matchers, as of `cases.find_cases`; `failure` is empty where there is none. Falsifiers
    are left out: nothing is asked of them than another answer. `view_m` is the side of a view. True is where it was
    taken, also of absent places; poses that do not exist are NaN.
    """
    classes = {(row.query_id, row.matcher): row.failure for row in failures.itertuples()}
    records = [
        {**row, "failure": classes.get((row["query_id"], row["matcher"]), "")}
        for name in names
        if name in board.scores
        for row in _answers_of(board, name)
    ]
    return pd.DataFrame(records, columns=list(ANSWER_COLUMNS))


def _answers_of(board: Board, name: str) -> Iterator[dict[str, Any]]:
    scores = single_views(board.scores[name]).copy()
    scores["view_m"] = scores["view_cells"] * scores["cell_size_m"]
    for row in scores.loc[scores["role"] != "falsifier", ["query_id", *_TOLD, "view_m"]].to_dict("records"):
        query_id = row["query_id"]
        true, fix = board.truths[query_id].pose, first_pose(board.predictions[name].get(query_id))
        told = {str(key): value for key, value in row.items()}
        yield {**told, "matcher": name, **_numbers("true", true), **_numbers("fix", fix)}


def _numbers(what: str, pose: Pose | None) -> dict[str, float]:
    """Return a pose to a decimetre and a tenth of a degree: enough to draw, and small on disk."""
    values = (math.nan,) * 3 if pose is None else (pose.easting_m, pose.northing_m, pose.yaw_deg)
    names = ("easting_m", "northing_m", "yaw_deg")
    return {f"{what}_{name}": round(value, 1) for name, value in zip(names, values, strict=True)}
