# SPDX-License-Identifier: Apache-2.0
"""Training on views of known place: rates at the true pose, scales of evidence from the modes of a search."""

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
from sasgeo_bench.sasgeo.joint import Blend, columns
from sasgeo_bench.sasgeo.rates import FAR, NOWHERE, RINGS_M, Tally, rings, tally
from sasgeo_bench.sasgeo.reading import Reader, age_years
from sasgeo_bench.sasgeo.scorer_model import ScorerModel, fit_scaling
from sasgeo_bench.sasgeo.weights import StampTally, fit_trust, stamp_tally, strata
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.query import Query, Truth

MODES: Final = 16  # of each training search
WRONG_M: Final = 25.0  # a mode this far from the truth is a wrong place


ViewsByMap = Mapping[str, Sequence[tuple[Query, Truth]]]  # by the map they lie on


def views_by_map(training: Training) -> ViewsByMap:
    """Group localization views that lie on their maps by map, since maps are large.

    Raises
    ------
    ConfigError
        If there is no such view.
    """
    found: dict[str, list[tuple[Query, Truth]]] = {}
    for query, truth in training.pairs:
        if truth.is_present and truth.pose is not None and query.track == "localization":
            found.setdefault(query.region, []).append((query, truth))
    if not found:
        message = "no view of the training part lies on its map: name suites whose places are present, such as clean"
        raise ConfigError(message)
    return found


def learn(training: Training, switches: Switches, *, plan: Plan | None = None) -> ScorerModel:
    """Fit rates, likeness, scales of evidence and weights of the joint score for the classes of the maps.

    Raises
    ------
    ConfigError
        If no view lies on its map, or maps have different classes.
    """
    views = views_by_map(training)
    tallies: dict[str, list[Tally]] = {"": []}
    stamps: list[StampTally] = []
    for name, some in views.items():
        region = training.regions[name]
        stamps += _stamps(region, some, switches) if switches.is_stamped else ()
        for query, truth in some:
            tallies.setdefault(query.season, []).append(_tally(query, truth, region, switches))
    model = ScorerModel.of(tallies)
    if switches.is_stamped:
        model = replace(model, trust=fit_trust(stamps))
    lists = []
    for name, some in views.items():
        reader = Reader.of(training.regions[name], model, switches)
        lists += [_list(query, _pose(truth), reader, plan or Plan()) for query, truth in some]
    lists = [one for one in lists if len(one.by_class) > 1]
    if not lists:
        return model
    model = replace(model, scaling=fit_scaling([one.by_class for one in lists]))
    return replace(model, blend=_fit_blend(lists, model.scaling)) if switches.has_graph else model


@dataclass(frozen=True, kw_only=True)
class _ScoredModes:
    """Scores of the right place, first, and of the wrong modes of a search: by class, of the graph, and its nodes."""

    by_class: NDArray[np.float64]
    graph: NDArray[np.float64] | None
    nodes: int


def _fit_blend(lists: Sequence[_ScoredModes], scaling: NDArray[np.float64]) -> Blend:
    """Fit the weights of the joint score by the same logit, with fixed scales of evidence."""
    terms = [
        columns(one.by_class * scaling, one.graph, Blend(alpha=1.0, beta=1.0, eta=1.0), nodes=one.nodes)
        for one in lists
    ]
    sums = [np.column_stack((rows[:, :-2].sum(axis=1), rows[:, -2:])) for rows in terms]
    alpha, beta, eta = fit_scaling(sums, start=(1.0, Blend().beta, Blend().eta)).tolist()
    return Blend(alpha=alpha, beta=beta, eta=eta)


def _pose(truth: Truth) -> Pose:
    """Return the place of a training view, or raise ConfigError."""
    if truth.pose is None:
        message = f"the training view {truth.query_id} has no place: give views of present places to the fit"
        raise ConfigError(message)
    return truth.pose


@dataclass(frozen=True, kw_only=True)
class _Footprint:
    """Map cells under the centres of the cells of a view, and which of them lie on the map."""

    row: NDArray[np.int64]
    col: NDArray[np.int64]
    is_inside: NDArray[np.bool_]

    @classmethod
    def of(cls, grid: Grid, pose: Pose, seen: Evidence) -> Self:
        """Return the cells of a map under a view."""
        rows, cols = np.indices(seen.shape)
        right_m = (cols - (seen.shape[1] - 1) / 2) * seen.cell_size_m
        up_m = ((seen.shape[0] - 1) / 2 - rows) * seen.cell_size_m
        places_m = pose.to_map(np.column_stack((right_m.ravel(), up_m.ravel())))
        row, col = (part.reshape(seen.shape) for part in grid.to_cells(places_m).T)
        is_inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
        return cls(row=np.clip(row, 0, grid.rows - 1), col=np.clip(col, 0, grid.cols - 1), is_inside=is_inside)

    def of_layers(self, layers: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return map layers under the view, shape (C, rows, cols)."""
        return np.where(self.is_inside, layers[:, self.row, self.col], np.uint8(NOWHERE))

    def rings(self, region: Region) -> NDArray[np.uint8]:
        """Return the rings of each class under the view, computed on a window of the map."""
        cell_m = region.grid.cell_size_m
        reach = math.ceil(RINGS_M[-1] / cell_m) + 1
        top, left = max(0, int(self.row.min()) - reach), max(0, int(self.col.min()) - reach)
        window = region.layers[:, top : int(self.row.max()) + reach + 1, left : int(self.col.max()) + reach + 1]
        near = rings(window, cell_size_m=cell_m)
        return np.where(self.is_inside, near[:, self.row - top, self.col - left], np.uint8(NOWHERE))


def _tally(query: Query, truth: Truth, region: Region, switches: Switches) -> Tally:
    """Count cells seen against the map at the true place."""
    seen = switches.seen(query.evidence)
    under = _Footprint.of(region.grid, _pose(truth), seen).rings(region)
    return tally(region.classes, _on_map(region, seen), under, age_years=age_years(query, region), block=truth.block)


def _stamps(region: Region, views: Sequence[tuple[Query, Truth]], switches: Switches) -> list[StampTally]:
    """Count cells seen by edit age on one map, in views without a season."""
    stratum, found = strata(region), []
    for query, truth in views:
        if not query.season:
            seen = switches.seen(query.evidence)
            there = _Footprint.of(region.grid, _pose(truth), seen)
            stamped = there.of_layers(stratum)
            found.append(stamp_tally(_on_map(region, seen), there.rings(region), stamped, FAR))
    return found


def _on_map(region: Region, seen: Evidence) -> NDArray[np.uint8]:
    """Return a view in the classes of a map; NOWHERE where the view lacks a class."""
    cells = np.full((len(region.classes), *seen.shape), NOWHERE, dtype=np.uint8)
    for at, name in enumerate(region.classes):
        if name in seen.classes:
            cells[at] = seen.layer(name)
    return cells


def _list(query: Query, pose: Pose, reader: Reader, plan: Plan) -> _ScoredModes:
    """Score the true pose of a view and the wrong modes that a search finds."""
    reading = reader.read(query)
    modes = search(reader.field, reading.template, query.prior, plan, count=MODES).modes
    here = (pose.easting_m, pose.northing_m)
    wrong = [mode.pose for mode in modes if math.dist((mode.pose.easting_m, mode.pose.northing_m), here) > WRONG_M]
    poses = [pose, *wrong]
    verified = reading.verified(poses)
    graph = None if verified is None else np.array([one.score for one in verified])
    nodes = 0 if graph is None else len(reading.observed.nodes)
    return _ScoredModes(by_class=reading.by_class(poses), graph=graph, nodes=nodes)
