# SPDX-License-Identifier: Apache-2.0
"""A query as a figure: its view, the map that is searched, what is known before, and the truth where it is given."""

from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sasgeo_bench.canvas import GREY, Page, new_figure, styled
from sasgeo_bench.errors import ConfigError, check_given
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.leaderboard.case_plot import (
    TRUE,
    CasePicture,
    MapPart,
    disc_of,
    draw_map,
    draw_panel,
    draw_picture,
    evidence_keys,
    seen_at,
)
from sasgeo_bench.leaderboard.columns import prior_words
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.regions.layers import PRESENT
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query, Truth, base_of

_SIDE_INCHES: Final = 2.7  # of the view
_MAP_INCHES: Final = 4.2
_ROOM: Final = 1.1  # around the disc of the prior
_CANDIDATE: Final = "#0072b2"


def plot_query(query: Query, region: Region, truth: Truth | None = None) -> Figure:
    """Draw a query: its picture, if it has one, its view, and the map around its prior.

    Parameters
    ----------
    query : Query
        A question, as of `read_queries`.
    region : Region
        The map that it searches: `read_region` of the region that it names.
    truth : Truth, optional
        Its answer, as of `read_truths`. With it, the map at the true place stands beside the view, and the footprint
        of the view is drawn on the map, its top marked.

    Returns
    -------
    matplotlib.figure.Figure
        A figure of its own, with the attribution of the map. A notebook shows it.

    Raises
    ------
    ConfigError
        If the region is not the one that the query names, or the truth is of another query.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import sasgeo_bench as sgb
    >>> with TemporaryDirectory() as folder:
    ...     place = sgb.tiny_place(Path(folder))
    ...     figure = plot_query(place.queries[0], place.region, place.truths[0])
    >>> [chart.get_title("left").partition(",")[0] for chart in figure.axes]
    ['view', 'map at the true place', 'map']
    """
    check_given(query, Query, "read_queries reads those of a task")
    check_given(region, Region, "read_region reads one from its folder")
    if truth is not None:
        check_given(truth, Truth, "read_truths reads those of a task")
    _check(query, region, truth)
    case = _content(query, region, truth)
    panels = [("view", case.view), ("map at the true place", case.at_true)][: 1 + (case.at_true is not None)]
    count = len(panels) + (case.picture is not None)
    facts, keys = prior_words(query.prior_group), _keys(case, region)
    about = Page(title=case.title, facts=facts, data=case.attribution, keys=keys, columns=count + 2)
    with styled():
        figure = new_figure((count * _SIDE_INCHES + _MAP_INCHES, _MAP_INCHES + 1.6))
        ratios = (*[_SIDE_INCHES] * count, _MAP_INCHES)
        *small, large = figure.framed(about).subplots(1, count + 1, width_ratios=ratios)
        if case.picture is not None:
            draw_picture(small.pop(0), case.picture)
        for chart, (name, evidence) in zip(small, panels, strict=True):
            draw_panel(chart, name, evidence)
        draw_map(large, case)
        _draw_candidates(large, query, case.part)
        figure.arrange()
    return figure


def _check(query: Query, region: Region, truth: Truth | None) -> None:
    """Refuse a map or a truth that is not the query's."""
    name = region.manifest.id
    if base_of(query.region) != base_of(name):
        raise ConfigError(f"query {query.query_id!r} searches the map {query.region!r}, got {name!r}: read that region")
    if truth is not None and truth.query_id != query.query_id:
        raise ConfigError(
            f"the truth is of query {truth.query_id!r}, the query is {query.query_id!r}: give its own truth"
        )


def _content(query: Query, region: Region, truth: Truth | None) -> CasePicture:
    """Return what is drawn; there is no answer in it."""
    row, col, rows, cols = _window(query, region.grid)
    layers, grid = region.layers[:, row : row + rows, col : col + cols], region.grid.window(row, col, rows, cols)
    true, manifest = None if truth is None else truth.pose, region.manifest
    shown = [manifest.attribution]
    if query.frames and manifest.imagery is not None:
        shown.append(manifest.imagery.attribution)
    return CasePicture(
        title=f"{query.suite} on {query.region}, {query.track}: query {query.query_id}",
        view=query.evidence,
        part=MapPart.of(layers, grid, manifest),
        true=true,
        is_present=truth is not None and truth.is_present,
        modes=(),
        at_true=None if true is None else seen_at(true, query.evidence, LayerBits.of(layers), grid, manifest),
        at_answer=None,
        disc=disc_of(query),
        lines=(),
        attribution="; ".join(shown),
        picture=query.frames[-1].image().rgb if query.frames else None,
    )


def _window(query: Query, grid: Grid) -> tuple[int, int, int, int]:
    """Return row, column, rows and columns of the map within reach of the prior; all of it without a disc."""
    disc = disc_of(query)
    if disc is None:
        return (0, 0, grid.rows, grid.cols)
    half_m = _ROOM * (disc[2] + float(np.hypot(*query.evidence.size_m)) / 2)
    ends = grid.to_cells(np.array(disc[:2]) + half_m * np.array([(-1.0, 1.0), (1.0, -1.0)]))
    row, col = np.clip(ends[0], 0, [grid.rows - 1, grid.cols - 1]).tolist()
    end_row, end_col = np.clip(ends[1] + 1, [row + 1, col + 1], [grid.rows, grid.cols]).tolist()
    return (row, col, end_row - row, end_col - col)


def _draw_candidates(chart: Axes, query: Query, part: MapPart) -> None:
    at = [(pose.easting_m - part.west_m, pose.northing_m - part.south_m) for pose in query.candidates]
    if at:
        chart.plot(*np.transpose(at), color=_CANDIDATE, marker="x", ms=5, ls="")


def _keys(case: CasePicture, region: Region) -> list[Artist]:
    """Return the legend: the pose, the disc, candidates, and the classes of the map."""
    keys: list[Artist] = []
    if case.true is not None:
        keys.append(Line2D([], [], color=TRUE, lw=1.8, marker="o", ms=3.5, label="true pose"))
    if case.disc is not None:
        keys.append(Line2D([], [], color=GREY, lw=1.0, ls=":", label="prior: the place is in it"))
    else:
        keys.append(Line2D([], [], color=_CANDIDATE, marker="x", ms=5, ls="", label="candidate"))
    bands = [*zip(region.classes, region.layers, strict=True), *zip(case.view.classes, case.view.cells, strict=True)]
    return [*keys, *evidence_keys({name for name, cells in bands if (cells == PRESENT).any()})]
