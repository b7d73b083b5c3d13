# SPDX-License-Identifier: Apache-2.0
"""Learning from views whose places are known: rates at the true pose, exponents from what a search finds beside it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.edit_age import StampTally, fit_trust, stamp_tally, strata
from sasgeo_bench.sasgeo.evidence_scaling import fit_temper
from sasgeo_bench.sasgeo.joint import Blend, columns
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.rates import FAR, NOWHERE, RINGS_M, Tally, rings, tally
from sasgeo_bench.sasgeo.reading import Reader, age_years
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.query import Query, Truth

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
        region = training.regions[name]
        stamps += _stamps(region, some, switches) if switches.is_stamped else ()
        for query, truth in some:
            tallies.setdefault(query.season, []).append(_tally(query, truth, region, switches))
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


@dataclass(frozen=True, kw_only=True)
class _Footprint:
    """Cells of a map in the middle of each cell of a view, and which of them lie on the map."""

    row: NDArray[np.int64]
    col: NDArray[np.int64]
    is_inside: NDArray[np.bool_]

    @classmethod
    def of(cls, grid: Grid, pose: Pose, seen: Evidence) -> Self:
        """Where a view lies on a map."""
        rows, cols = np.indices(seen.shape)
        right_m = (cols - (seen.shape[1] - 1) / 2) * seen.cell_size_m
        up_m = ((seen.shape[0] - 1) / 2 - rows) * seen.cell_size_m
        places_m = pose.to_map(np.column_stack((right_m.ravel(), up_m.ravel())))
        row, col = (part.reshape(seen.shape) for part in grid.to_cells(places_m).T)
        is_inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
        return cls(row=np.clip(row, 0, grid.rows - 1), col=np.clip(col, 0, grid.cols - 1), is_inside=is_inside)

    def of_layers(self, layers: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What layers of the map have there, shape (C, rows, cols)."""
        return np.where(self.is_inside, layers[:, self.row, self.col], np.uint8(NOWHERE))

    def rings(self, region: Region) -> NDArray[np.uint8]:
        """How far each class is there: rings of no more of the map than they need."""
        cell_m = region.grid.cell_size_m
        reach = math.ceil(RINGS_M[-1] / cell_m) + 1
        top, left = max(0, int(self.row.min()) - reach), max(0, int(self.col.min()) - reach)
        window = region.layers[:, top : int(self.row.max()) + reach + 1, left : int(self.col.max()) + reach + 1]
        near = rings(window, cell_size_m=cell_m)
        return np.where(self.is_inside, near[:, self.row - top, self.col - left], np.uint8(NOWHERE))


def _tally(query: Query, truth: Truth, region: Region, switches: Switches) -> Tally:
    """What was seen of a map at the true place."""
    seen = switches.seen(query.evidence)
    under = _Footprint.of(region.grid, _pose(truth), seen).rings(region)
    return tally(region.classes, _on_map(region, seen), under, age_years=age_years(query, region), block=truth.block)


def _stamps(region: Region, lessons: Sequence[tuple[Query, Truth]], switches: Switches) -> list[StampTally]:
    """What was seen on one map of what was edited lately and long ago; views of a season apart, as for rates."""
    stratum, found = strata(region), []
    for query, truth in lessons:
        if not query.season:
            seen = switches.seen(query.evidence)
            there = _Footprint.of(region.grid, _pose(truth), seen)
            stamped = there.of_layers(stratum)
            found.append(stamp_tally(_on_map(region, seen), there.rings(region), stamped, FAR))
    return found


def _on_map(region: Region, seen: Evidence) -> NDArray[np.uint8]:
    """A view in the classes of a map; neither present nor absent where it does not know a class."""
    cells = np.full((len(region.classes), *seen.shape), NOWHERE, dtype=np.uint8)
    for at, name in enumerate(region.classes):
        if name in seen.classes:
            cells[at] = seen.layer(name)
    return cells


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
