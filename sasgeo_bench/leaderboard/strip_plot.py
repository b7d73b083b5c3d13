# SPDX-License-Identifier: Apache-2.0
"""A strip of queries, one a row: the picture, the evidence made of it, the map at the answer, and both on the map."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from sasgeo_bench.canvas import Page, new_figure, styled
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.leaderboard.case_plot import CasePicture, draw_map, draw_panel, draw_picture, pixels_of
from sasgeo_bench.leaderboard.run_cases import RunCases, picture_of

_SIDE_INCHES: Final = 1.9
_DPI: Final = 100
_PANELS: Final = 4


def strip_of(cases: RunCases, count: int) -> list[CasePicture]:
    """Return queries of a run for a strip: half of them failures, as far as there are, by the order of their ids.

    Raise `ConfigError` if no query of the run holds pictures.
    """
    present = cases.scores[cases.scores["is_present"].astype(bool) & (cases.scores["role"] != "falsifier")]
    pictured = [name for name, task in cases.tasks.items() if task.about.get("frames")]
    keys = pd.MultiIndex.from_frame(present[["suite", "region"]])
    own = present[keys.isin(pictured)].sort_values("query_id")
    if own.empty:
        message = f"{cases.run} holds no answers to queries with pictures: name a run on a suite such as aerial+..."
        raise ConfigError(message)
    is_right = own["is_right"].to_numpy(bool)
    failed, right = own.loc[~is_right, "query_id"].tolist(), own.loc[is_right, "query_id"].tolist()
    wrong = max(count // 2, count - len(right))
    chosen = [*failed[:wrong], *right[: count - min(wrong, len(failed))]]
    return [picture_of(cases, name)[1] for name in chosen]


def strip_pixels(rows: Sequence[CasePicture], *, title: str) -> NDArray[np.uint8]:
    """Draw the rows of a strip; pixels as of `case_plot.pixels_of`, the same for the same rows."""
    about = Page(title=title, data=rows[0].attribution)
    with styled():
        figure = new_figure((_PANELS * _SIDE_INCHES + 0.4, len(rows) * (_SIDE_INCHES + 0.35) + 0.9), dpi=_DPI)
        charts = figure.framed(about).subplots(len(rows), _PANELS, squeeze=False)
        for line, case in zip(charts, rows, strict=True):
            _draw_row(line, case)
        return pixels_of(figure)


def _draw_row(line: Sequence[Axes], case: CasePicture) -> None:
    if case.picture is not None:
        draw_picture(line[0], case.picture)
    line[0].set_title(case.what.split(" (")[0], fontsize=7.5)  # without the unit, which has no room
    draw_panel(line[1], "evidence made of it", case.view)
    draw_panel(line[2], "map at the answer", case.at_answer)
    draw_map(line[3], case)
    error = "no answer" if case.error_m is None else f"{case.error_m:.0f} m off"
    line[3].set_title(f"{error} (true solid, answer dashed)", fontsize=7.0)
