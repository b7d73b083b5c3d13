# SPDX-License-Identifier: Apache-2.0
"""Learning from views whose places are known: rates at the true pose, exponents from what a search finds beside it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.evidence import Evidence
from sasgeo_bench.grid import Grid
from sasgeo_bench.matcher import Training
from sasgeo_bench.pose import Pose
from sasgeo_bench.query import Query, Truth
from sasgeo_bench.region import Region
from sasgeo_bench.sasgeo.arms import Switches
from sasgeo_bench.sasgeo.joint import Blend, columns
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.rates import FAR, NOWHERE, Tally, rings, tally
from sasgeo_bench.sasgeo.reading import Reader, age_years
from sasgeo_bench.sasgeo.stamps import StampTally, fit_trust, stamp_tally, strata
from sasgeo_bench.sasgeo.temper import fit_temper
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan

MODES: Final = 16  # of a search to learn from
WRONG_M: Final = 25.0  # a mode this far from the truth is a wrong place


Lessons = Mapping[str, Sequence[tuple[Query, Truth]]]  # by the map they lie on


def lessons_of(training: Training) -> Lessons:
    """Views that lie on their maps, map by map, since maps are large; those of a list of candidates are the same again.

    Raises
    ------
    ConfigError
        If there is none.
    """
    found: dict[str, list[tuple[Query, Truth]]] = {}
    for query, truth in training.pairs:
        if truth.is_present and truth.pose is not None and query.track == "localization":
            found.setdefault(query.region, []).append((query, truth))
    if not found:
        message = "no view of the train part lies on its map: name suites whose places are there, such as clean"
        raise ConfigError(message)
    return found


def learn(training: Training, switches: Switches, *, plan: Plan | None = None) -> Learnt:
    """Learn rates, likeness and exponents.

    Parameters
    ----------
    training : Training
        Of train places.
    switches : Switches
        Which arm learns.
    plan : Plan, optional
        How is searched.

    Returns
    -------
    Learnt
        Of the classes of the maps.

    Raises
    ------
    ConfigError
        If no view lies on its map, or maps have different classes.
    """
    lessons = lessons_of(training)
    tallies: dict[str, list[Tally]] = {"": []}
    stamps: list[StampTally] = []
    for name, some in lessons.items():
        found = _tallies(training.regions[name], some, switches)
        stamps += _stamps(training.regions[name], some, switches) if switches.is_stamped else ()
        for (query, _), one in zip(some, found, strict=True):
            tallies.setdefault(query.season, []).append(one)
    learnt = Learnt.of(tallies)
    if switches.is_stamped:
        learnt = replace(learnt, trust=fit_trust(stamps))
    lists = []
    for name, some in lessons.items():
        reader = Reader.of(training.regions[name], learnt, switches)
        lists += [_list(query, _pose(truth), reader, plan or Plan()) for query, truth in some]
    lists = [one for one in lists if len(one.by_class) > 1]
    if not lists:
        return learnt
    learnt = replace(learnt, temper=fit_temper([one.by_class for one in lists]))
    if not switches.has_graph:
        return learnt
    return replace(learnt, blend=_fit_blend(lists, learnt.temper))


@dataclass(frozen=True, kw_only=True)
class _List:
    """The right place and the wrong ones a search found, the right one first: scores by class, of graph, its nodes."""

    by_class: NDArray[np.float64]
    graph: NDArray[np.float64] | None
    nodes: int


def _fit_blend(lists: Sequence[_List], temper: NDArray[np.float64]) -> Blend:
    """Weights of the joint score by the same logit, exponents held."""
    terms = [
        columns(one.by_class * temper, one.graph, Blend(alpha=1.0, beta=1.0, eta=1.0), nodes=one.nodes) for one in lists
    ]
    sums = [np.column_stack((rows[:, :-2].sum(axis=1), rows[:, -2:])) for rows in terms]
    alpha, beta, eta = fit_temper(sums, start=(1.0, Blend().beta, Blend().eta)).tolist()
    return Blend(alpha=alpha, beta=beta, eta=eta)


def _pose(truth: Truth) -> Pose:
    if truth.pose is None:
        message = "a lesson has a place"
        raise AssertionError(message)
    return truth.pose


def _tallies(region: Region, lessons: Sequence[tuple[Query, Truth]], switches: Switches) -> list[Tally]:
    """What was seen on one map, at the true places."""
    near = rings(region.layers, cell_size_m=region.grid.cell_size_m)
    return [_tally(query, truth, region, near, switches.seen(query.evidence)) for query, truth in lessons]


def _tally(query: Query, truth: Truth, region: Region, near: NDArray[np.uint8], seen: Evidence) -> Tally:
    under = _under(near, region.grid, _pose(truth), seen.shape, seen.cell_size_m)
    return tally(region.classes, _on_map(region, seen), under, age_years=age_years(query, region), block=truth.block)


def _stamps(region: Region, lessons: Sequence[tuple[Query, Truth]], switches: Switches) -> list[StampTally]:
    """What was seen on one map of what was edited lately and long ago; views of a season apart, as for rates."""
    near, stratum = rings(region.layers, cell_size_m=region.grid.cell_size_m), strata(region)
    found = []
    for query, truth in lessons:
        if not query.season:
            seen = switches.seen(query.evidence)
            under = _under(near, region.grid, _pose(truth), seen.shape, seen.cell_size_m)
            stamped = _under(stratum, region.grid, _pose(truth), seen.shape, seen.cell_size_m)
            found.append(stamp_tally(_on_map(region, seen), under, stamped, FAR))
    return found


def _on_map(region: Region, seen: Evidence) -> NDArray[np.uint8]:
    """A view in the classes of a map; neither present nor absent where it does not know a class."""
    cells = np.full((len(region.classes), *seen.shape), NOWHERE, dtype=np.uint8)
    for at, name in enumerate(region.classes):
        if name in seen.classes:
            cells[at] = seen.layer(name)
    return cells


def _under(near: NDArray[np.uint8], grid: Grid, pose: Pose, shape: tuple[int, int], cell_m: float) -> NDArray[np.uint8]:
    """What of a map lies in the middle of each cell of a view."""
    rows, cols = np.indices(shape)
    right_m, up_m = (cols - (shape[1] - 1) / 2) * cell_m, ((shape[0] - 1) / 2 - rows) * cell_m
    row, col = grid.to_cells(pose.to_map(np.column_stack((right_m.ravel(), up_m.ravel())))).T
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    found = near[:, np.clip(row, 0, grid.rows - 1), np.clip(col, 0, grid.cols - 1)]
    return np.asarray(np.where(inside, found, NOWHERE), dtype=np.uint8).reshape(len(near), *shape)


def _list(query: Query, pose: Pose, reader: Reader, plan: Plan) -> _List:
    """The right place of a view and the wrong ones that a search finds."""
    glance = reader.glance(query)
    modes = search(reader.field, glance.template, query.prior, plan, count=MODES).modes
    here = (pose.easting_m, pose.northing_m)
    wrong = [mode.pose for mode in modes if math.dist((mode.pose.easting_m, mode.pose.northing_m), here) > WRONG_M]
    poses = [pose, *wrong]
    verified = glance.verified(poses)
    graph = None if verified is None else np.array([one.score for one in verified])
    return _List(by_class=glance.by_class(poses), graph=graph, nodes=0 if graph is None else len(glance.observed.nodes))
