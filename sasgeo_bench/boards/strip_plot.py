# SPDX-License-Identifier: Apache-2.0
"""A strip of queries, one a row: picture, segmentation, evidence, map at the pose found, and both poses on the map."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sasgeo_bench.boards.cases import (
    ANSWERED,
    TRUE,
    CasePicture,
    draw_map,
    draw_panel,
    draw_picture,
    evidence_keys,
    is_own,
    is_turned,
    pixels_of,
)
from sasgeo_bench.boards.run_cases import RunCases, picture_of
from sasgeo_bench.core.canvas import GREY, Page, new_figure, styled, without_ticks
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.scoring.pose import SUCCESS_DEG
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.scoring.strata import STRESS
from sasgeo_bench.tasks.query import BY, PERCEIVED

_SIDE_INCHES: Final = 2.3
_DPI: Final = 100
_COLUMNS: Final = ("picture", "segmentation", "evidence, heading up", "map at the pose found", "map, north up")
_FOUND: Final = "#00695c"
_MISSED: Final = "#b3261e"
_TURNED: Final = "#8a5a00"


@dataclass(frozen=True, kw_only=True)
class Strip:
    """Queries of one matcher on pictures: how often it finds the pose in all of them, and some to look at.

    `query_ids` are half failures, as far as there are, and these last. `turned` of a user's own pictures are at the
    right place with another heading than their files state, and `has_stress` if any query is under stress.
    """

    found: int
    total: int
    query_ids: tuple[str, ...]
    turned: int = 0
    has_stress: bool = False

    @classmethod
    def of(cls, scores: pd.DataFrame, pictured: Collection[tuple[str, str]], count: int) -> Self:
        """Choose at most `count` queries, regions in turn; the same scores give the same ones.

        Parameters
        ----------
        scores : DataFrame
            One matcher's rows: `query_id`, `suite`, `region`, `role`, `detector`, `is_present`, `is_right`,
            `yaw_error_deg`, `strength_unit`.
        pictured : collection of (suite, region)
            Tasks that hold pictures. Queries of others count nowhere, nor do those of a model of perception, falsifiers
            and places that are not on the map.
        count : int
            How many to look at.

        Examples
        --------
        >>> rows = {"query_id": list("abcd"), "suite": "aerial", "region": ["x", "x", "y", "y"], "role": "control"}
        >>> answers = {"is_right": [False, False, False, True], "yaw_error_deg": 1.0}
        >>> scores = pd.DataFrame({**rows, **answers, "is_present": True, "detector": "rendered", "strength_unit": "m"})
        >>> Strip.of(scores, {("aerial", "x"), ("aerial", "y")}, 3)
        Strip(found=1, total=4, query_ids=('d', 'a', 'c'), turned=0, has_stress=False)
        """
        keys = pd.MultiIndex.from_frame(scores[["suite", "region"]])
        is_usable = scores["is_present"].astype(bool) & (scores["role"] != "falsifier") & keys.isin(list(pictured))
        is_usable &= ~scores["detector"].isin(PERCEIVED)
        own = scores[is_usable].sort_values(["suite", "region", "query_id"])
        own = own.assign(is_found=own["is_right"].astype(bool) & (own["yaw_error_deg"] <= SUCCESS_DEG))
        own["turn"] = own.groupby(["is_found", "suite", "region"]).cumcount()
        own = own.sort_values(["turn", "suite", "region"], kind="stable")
        failed, right = (own.loc[own["is_found"] == is_found, "query_id"].tolist() for is_found in (False, True))
        wrong = min(max(count // 2, count - len(right)), len(failed))
        chosen = (*right[: count - wrong], *failed[:wrong])
        turned = int((is_turned(own) & is_own(own)).sum())
        has_stress = bool((own["role"] == STRESS).any())
        return cls(found=len(right), total=len(own), query_ids=chosen, turned=turned, has_stress=has_stress)

    @property
    def facts(self) -> str:
        """Return how often the pose is found, and how the queries were chosen."""
        more = f" (in {self.turned} more the place, with another heading than the file states)" if self.turned else ""
        stress = " Views without the stress (control) are among them; tables count those under stress."
        return (
            f"The pose is found (within 25 m and 5 deg) in {self.found} of {counted(self.total, 'query', 'queries')}"
            f"{more}; here are {len(self.query_ids)} of them, half of them failures where there are so many."
            f"{stress if self.has_stress else ''}"
        )


def best_on_pictures(scores: Mapping[str, pd.DataFrame], pictured: Collection[tuple[str, str]]) -> str | None:
    """Return the matcher, controls apart, that finds most queries with pictures; None if none was asked any.

    >>> rows = {"query_id": ["q"], "suite": "aerial", "region": "x", "role": "control", "detector": "rendered"}
    >>> rows |= {"is_present": True, "yaw_error_deg": 0.0, "strength_unit": "m"}
    >>> good, bad = (pd.DataFrame(rows | {"is_right": found}) for found in (True, False))
    >>> best_on_pictures({"a": bad, "b": good, "oracle_pose": good}, {("aerial", "x")})
    'b'
    """
    strips = {name: Strip.of(frame, pictured, 1) for name, frame in scores.items() if not is_unranked(name)}
    asked = {name: strip for name, strip in strips.items() if strip.total}
    return min(asked, key=lambda name: (-asked[name].found, name), default=None)


def pictured_tasks(cases: RunCases) -> tuple[tuple[str, str], ...]:
    """Return suite and region of the tasks of a run that hold pictures: those of segmenters that get nothing else.

    Tasks of a control such as `oracle_segmenter` are returned if there are no others, flights never: they are scored as
    wholes.
    """
    tasks = cases.tasks.items()
    found = tuple(name for name, task in tasks if task.manifest.frames and not task.manifest.is_of_flights)
    return tuple(name for name in found if not is_unranked(name[0].partition(BY)[2])) or found


def strip_of(cases: RunCases, count: int) -> tuple[Strip, list[CasePicture]]:
    """Return a strip of queries of a run, and the content of its rows.

    Raise `ConfigError` if no query of the run holds pictures.
    """
    strip = Strip.of(cases.scores, pictured_tasks(cases), count)
    if not strip.query_ids:
        raise ConfigError(
            f"{cases.run} holds no answers to queries with pictures: name a run on a suite such as aerial+..."
        )
    return strip, [picture_of(cases, name)[1] for name in strip.query_ids]


def strip_pixels(strip: Strip, rows: Sequence[CasePicture], *, title: str) -> NDArray[np.uint8]:
    """Draw the rows of a strip; pixels as of `cases.pixels_of`, the same for the same rows."""
    columns = len(_COLUMNS)
    about = Page(
        title=title,
        facts=f"{strip.facts} A segmenter finds classes in the picture; seen from above they are the evidence, which "
        "the matcher looks for on the map.",
        data="; ".join(dict.fromkeys(row.attribution for row in rows)),
        columns=columns,
        panel_inches=(_SIDE_INCHES, _SIDE_INCHES),
        keys=_keys(rows),
    )
    with styled():
        figure = new_figure((columns * _SIDE_INCHES + 0.4, len(rows) * (_SIDE_INCHES + 0.3) + 1.6), dpi=_DPI)
        charts = figure.framed(about).subplots(len(rows), columns, squeeze=False)
        for at, (line, case) in enumerate(zip(charts, rows, strict=True)):
            _draw_row(line, case, is_first=at == 0)
        return pixels_of(figure)


def _keys(rows: Sequence[CasePicture]) -> list[Artist]:
    """Return the legend: both poses, the search, what is unknown, and the classes that any row shows."""
    keys: list[Artist] = [
        Line2D([], [], color=TRUE, lw=1.8, marker="o", ms=3.5, label="true pose"),
        Line2D([], [], color=ANSWERED, lw=1.8, ls="--", marker="o", ms=3.5, label="pose found"),
        Line2D([], [], color=GREY, lw=1.0, ls=":", label="area searched"),
    ]
    seen = [item for row in rows for item in (row.view, row.at_true, row.at_answer) if item is not None]
    shown = {name for item in seen for name, cells in zip(item.classes, item.cells, strict=True) if PRESENT in cells}
    shown |= {name for row in rows if row.segmented is not None for name in row.segmented.classes}
    return [*keys, *evidence_keys(shown)]


def _draw_row(line: Sequence[Axes], case: CasePicture, *, is_first: bool) -> None:
    """Draw a query; the first row names the columns."""
    if case.picture is not None:
        draw_picture(line[0], case.picture)
    if case.picture is not None and case.segmented is not None:
        draw_picture(line[1], case.segmented.over(case.picture))
    else:
        without_ticks(line[1])
        line[1].text(
            0.5, 0.5, "not stored: segment again", ha="center", va="center", color=GREY, transform=line[1].transAxes
        )
    draw_panel(line[2], "", case.view.of_known_classes())
    draw_panel(line[3], "", case.at_answer)
    draw_map(line[4], case)
    across_m = max(case.part.east_m - case.part.west_m, case.part.north_m - case.part.south_m)
    for chart, name in zip(line, _COLUMNS, strict=True):
        chart.set_title(name if is_first else "", fontsize=9)
    line[4].set_xlabel(f"{across_m:.0f} m across", fontsize=8, labelpad=2)
    what = case.what.split(" (")[0].replace(", strength", "")  # without the unit, which has no room
    line[0].set_xlabel(f"{case.region}: {what}", fontsize=8, labelpad=2, loc="left")
    off = "no answer" if case.error_m is None else f"{case.error_m:.0f} m and {case.error_deg:.0f} deg off"
    verdict, colour = (f"FOUND: {off}", _FOUND) if case.is_found else (f"MISSED: {off}", _MISSED)
    if case.is_own and case.is_turned:  # the heading is a compass's, and may itself be wrong
        verdict, colour = f"PLACE FOUND: {off}", _TURNED
    line[3].set_xlabel(verdict, fontsize=9, weight="bold", color=colour, labelpad=2)
