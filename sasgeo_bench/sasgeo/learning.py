# SPDX-License-Identifier: Apache-2.0
"""Training on views of known place: rates and rules at the true pose, weights from the modes of a search."""

import math
from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.graph import GraphRules, Matching, match_nodes, verify
from sasgeo_bench.sasgeo.joint import Blend, columns
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.sasgeo.rates import FAR, NOWHERE, RINGS_M, Tally, rings, tally
from sasgeo_bench.sasgeo.reading import Reader, age_years
from sasgeo_bench.sasgeo.rule_fitting import BLANK, fit_rules
from sasgeo_bench.sasgeo.scorer_model import ScorerModel, fit_scaling
from sasgeo_bench.sasgeo.weights import StampTally, fit_trust, stamp_tally, strata
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.query import Query, Truth, base_of

_UNIT: Final = 64  # cells: parts begin where cells of any size of the search do


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
        raise ConfigError(
            "no view of the training part lies on its map: name suites whose places are present, such as clean"
        )
    return found


def on_maps_of_the_day(views: ViewsByMap, regions: Mapping[str, Region]) -> ViewsByMap:
    """Move views on an older map to the map of their own day, and drop those for which there is none.

    Only the map changes: view, prior and true pose are the same, so that training with and without old maps compares
    the same views. The pose holds, since all dates of a region have one coordinate system; cells of the view that the
    other map does not cover count as unknown. A view and its control on the map of the day may be equal then, and
    count twice.

    Raises
    ------
    ConfigError
        If no view is left.
    """
    found: dict[str, list[tuple[Query, Truth]]] = {}
    for name, some in views.items():
        for query, truth in some:
            fresh = _map_of_the_day(name, query, regions)
            if fresh is not None:
                found.setdefault(fresh, []).append((replace(query, region=fresh), truth))
    if not found:
        raise ConfigError("no training view has a map of its own day: name suites such as clean beside real-age")
    return found


def around_views(
    # 400 million cells in all layers of a map that is held whole: 16 km2 in cells of 1 m
    views: ViewsByMap,
    regions: Mapping[str, Region],
    *,
    most_values: int = 400_000_000,
) -> tuple[ViewsByMap, Mapping[str, Region]]:
    """Cut each large map to what its views may be held against: a part for each view, under a name of its own.

    So training on a whole country needs no more memory than on towns. Maps of at most `most_values` cells in all layers
    stay as they are, and so do those whose views may lie anywhere.
    """
    found: dict[str, Sequence[tuple[Query, Truth]]] = {}
    parts: dict[str, Region] = {}
    for name, some in views.items():
        region = regions[name]
        is_small = len(region.classes) * region.grid.rows * region.grid.cols <= most_values
        if is_small or any(query.prior.center_m is None for query, _ in some):
            found[name] = some
            continue
        boxes = [_box(query, truth, region.grid) for query, truth in some]
        for number, ((query, truth), part) in enumerate(zip(some, region.cuts(boxes), strict=True)):
            own = f"{name} {number}"
            parts[own] = part
            found[own] = [(replace(query, region=own), truth)]
    return found, ChainMap(parts, regions)  # type: ignore[arg-type] # neither is written to


_MARGIN_M: Final = 72.0  # of a part of a map, beyond what any view there shows


def _box(query: Query, truth: Truth, grid: Grid) -> tuple[int, int, int, int]:
    """Return the cells around all places that a view may have, and around the true one: row, column, rows, columns."""
    pose = _pose(truth)
    middles_m = np.array([query.prior.center_m, (pose.easting_m, pose.northing_m)], dtype=np.float64)
    reach_m = (query.prior.radius_m or 0.0, 0.0)
    view_m = math.hypot(*query.evidence.size_m) / 2 * (1 + 3 * query.prior.scale_sigma)
    low, high = [], []
    for (row, col), radius_m in zip(grid.to_cells(middles_m).tolist(), reach_m, strict=True):
        reach = math.ceil((radius_m + view_m + RINGS_M[-1] + _MARGIN_M) / grid.cell_size_m)
        low.append((row - reach, col - reach))
        high.append((row + reach, col + reach))
    (top, left), (bottom, right) = np.min(low, axis=0) // _UNIT * _UNIT, np.max(high, axis=0) // _UNIT * _UNIT + _UNIT
    return int(top), int(left), int(bottom - top), int(right - left)


def _map_of_the_day(name: str, query: Query, regions: Mapping[str, Region]) -> str | None:
    """Return the map of a name with another date or none: the view's own day; None if there is no such map."""
    dated, plus, edits = name.partition("+")
    if "@" not in dated:
        return name
    base = base_of(name)
    for fresh in (f"{base}@{query.observed_on.isoformat()}{plus}{edits}", f"{base}{plus}{edits}"):
        if fresh in regions and regions[fresh].manifest.extract.date == query.observed_on:
            return fresh
    return None


def learn(training: Training, switches: Switches, *, plan: Plan | None = None) -> ScorerModel:
    """Fit the numbers of the scorer: weights of classes if the ablation learns them, rules and weight of the graph.

    Raises
    ------
    ConfigError
        If no view lies on its map.

    Notes
    -----
    Maps may know of different classes. Each class is fitted to the views on maps that know of it: elsewhere it is
    unknown, and counts nothing.
    """
    views = views_by_map(training)
    if not switches.learns_from_old:
        views = on_maps_of_the_day(views, training.regions)
    views, regions = around_views(views, training.regions)
    classes = classes_of(regions[name] for name in views)
    model = _fit_classes(regions, views, switches, classes) if switches.learns else _even(views, classes)
    lists: list[_ScoredModes] = []
    # 2 searches of each view; the second finds the wrong places that the exponents of the first take for right
    for _ in range(2 if switches.learns else 1):
        lists = _searched(views, regions, model, switches, plan or Plan())
        if switches.learns and lists:
            model = replace(model, scaling=fit_scaling([one.by_class for one in lists]))
    if not lists:
        return model
    drawn = [one for one in lists if one.query.vectors is not None] if switches.has_graph else []
    if drawn:
        model = replace(model, rules=_fit_rules(drawn, regions))
    plain = [one for one in lists if one.query.vectors is None or not switches.has_graph]
    return replace(model, blend=_fit_blend(drawn, plain, model, regions))


def classes_of(regions: Iterable[Region]) -> tuple[str, ...]:
    """Return the classes that any of some maps knows of, in the order of their ids.

    >>> from types import SimpleNamespace as Map
    >>> classes_of([Map(classes=("building",)), Map(classes=("road_minor", "building"))])
    ('road_minor', 'building')
    """
    known = {name for region in regions for name in region.classes}
    return tuple(name for name in load_taxonomy().names if name in known)


def _fit_classes(
    regions: Mapping[str, Region], views: ViewsByMap, switches: Switches, classes: tuple[str, ...]
) -> ScorerModel:
    tallies: dict[str, list[Tally]] = {"": []}
    stamps: list[StampTally] = []
    for name, some in views.items():
        region = regions[name]
        stamps += _stamps(region, some, switches, classes) if switches.is_stamped else ()
        for query, truth in some:
            tallies.setdefault(query.season, []).append(_tally(query, truth, region, switches, classes))
    model = ScorerModel.of(tallies)
    return replace(model, trust=fit_trust(stamps)) if switches.is_stamped else model


def _even(views: ViewsByMap, classes: tuple[str, ...]) -> ScorerModel:
    truths = [truth for some in views.values() for _, truth in some]
    model = ScorerModel.by_hand(classes)
    return replace(model, views=len(truths), blocks=len({truth.block for truth in truths}))


@dataclass(frozen=True, kw_only=True)
class _ScoredModes:
    """The right place of a query, first, and the wrong modes of its search, with scores by class and `beside` them."""

    query: Query
    poses: Sequence[Pose]
    by_class: NDArray[np.float64]
    beside: NDArray[np.float64]

    @cached_property
    def seen(self) -> ObservedGraph:
        return ObservedGraph.of(self.query)


def _graphs(lists: Sequence[_ScoredModes], regions: Mapping[str, Region]) -> Iterator[tuple[_ScoredModes, MappedGraph]]:
    for name, some in groupby(lists, key=lambda one: one.query.region):
        mapped = MappedGraph.of(regions[name])
        for one in some:
            yield one, mapped


def _fit_rules(drawn: Sequence[_ScoredModes], regions: Mapping[str, Region]) -> GraphRules:
    right: list[Matching] = []
    wrong: list[Matching] = []
    for one, mapped in _graphs(drawn, regions):
        first, *rest = match_nodes(one.seen, mapped, one.poses, BLANK)
        right.append(first)
        wrong += rest
    return fit_rules(right, wrong)


_SURE: Final = 0.5  # width of the prior of the factor of all weights, in logarithms: views may be told apart by any


def _fit_blend(
    drawn: Sequence[_ScoredModes], plain: Sequence[_ScoredModes], model: ScorerModel, regions: Mapping[str, Region]
) -> Blend:
    """Fit the weights of the joint score by the same logit to views with a graph and without, with fixed exponents.

    Each stays near its weight by hand, and so does their common factor: views with vectors alone are often separable.
    """
    sums, even = [], Blend(alpha=1.0, beta=1.0, eta=1.0)
    for one, mapped in _graphs(drawn, regions):
        graph = np.array([found.score for found in verify(one.seen, mapped, one.poses, model.rules)])
        rows = columns(one.by_class * model.scaling, graph, even, nodes=len(one.seen.nodes))
        sums.append(np.column_stack((rows[:, :-2].sum(axis=1), rows[:, -2:], one.beside)))
    for one in plain:
        raster = (one.by_class * model.scaling).sum(axis=1)
        sums.append(np.column_stack((raster, np.zeros((len(raster), 2)), one.beside)))
    start = astuple(Blend())
    return Blend(*fit_scaling(sums, start=start, common_width=_SURE).tolist())


def _pose(truth: Truth) -> Pose:
    """Return the place of a training view, or raise ConfigError."""
    if truth.pose is None:
        raise ConfigError(f"the training view {truth.query_id} has no place: give views of present places to the fit")
    return truth.pose


@dataclass(frozen=True, kw_only=True)
class _Footprint:
    """Map cells under the centres of the cells of a view, and which of them lie on the map."""

    row: NDArray[np.int64]
    col: NDArray[np.int64]
    is_inside: NDArray[np.bool_]

    @classmethod
    def of(cls, grid: Grid, pose: Pose, seen: Evidence) -> Self:
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
        cell_m = region.grid.cell_size_m
        reach = math.ceil(RINGS_M[-1] / cell_m) + 1
        top, left = max(0, int(self.row.min()) - reach), max(0, int(self.col.min()) - reach)
        window = region.layers[:, top : int(self.row.max()) + reach + 1, left : int(self.col.max()) + reach + 1]
        near = rings(window, cell_size_m=cell_m)
        return np.where(self.is_inside, near[:, self.row - top, self.col - left], np.uint8(NOWHERE))


def _tally(query: Query, truth: Truth, region: Region, switches: Switches, classes: tuple[str, ...]) -> Tally:
    """Count cells seen against the map at the true place, in some classes, of which the map may lack some."""
    seen = switches.seen(query.evidence)
    under = _Footprint.of(region.grid, _pose(truth), seen).rings(region)
    age = age_years(query, region) if switches.knows_age else 0.0  # who cannot tell ages learns none
    views = _in_classes(seen.cells, seen.classes, classes), _in_classes(under, region.classes, classes)
    return tally(classes, *views, age_years=age, block=truth.block)


def _stamps(
    region: Region, views: Sequence[tuple[Query, Truth]], switches: Switches, classes: tuple[str, ...]
) -> list[StampTally]:
    """Count cells seen by edit age on one map, in views without a season."""
    stratum, found = strata(region), []
    for query, truth in views:
        if not query.season:
            seen = switches.seen(query.evidence)
            there = _Footprint.of(region.grid, _pose(truth), seen)
            under, stamped = (
                _in_classes(layers, region.classes, classes)
                for layers in (there.rings(region), there.of_layers(stratum))
            )
            found.append(stamp_tally(_in_classes(seen.cells, seen.classes, classes), under, stamped, FAR))
    return found


def _in_classes(layers: NDArray[np.uint8], own: Sequence[str], classes: Sequence[str]) -> NDArray[np.uint8]:
    """Return layers in the order of other classes; NOWHERE for a class that they lack."""
    cells = np.full((len(classes), *layers.shape[1:]), NOWHERE, dtype=np.uint8)
    for at, name in enumerate(classes):
        if name in own:
            cells[at] = layers[own.index(name)]
    return cells


def _searched(
    views: ViewsByMap, regions: Mapping[str, Region], model: ScorerModel, switches: Switches, plan: Plan
) -> list[_ScoredModes]:
    lists: list[_ScoredModes] = []
    for name, some in views.items():
        reader = Reader.of(regions[name], model, replace(switches, has_graph=False))
        lists += [_list(query, _pose(truth), reader, plan, model.classes) for query, truth in some]
    return [one for one in lists if len(one.by_class) > 1]


WRONG_M: Final = 25.0  # a mode this far from the truth is a wrong place


def _list(query: Query, pose: Pose, reader: Reader, plan: Plan, classes: tuple[str, ...]) -> _ScoredModes:
    """Score the true pose of a view and the wrong modes that a search finds; 0 in classes that the map lacks."""
    reading = reader.read(query)
    modes = search(
        reader.field, reading.searched, query.prior, reading.plan(plan), count=16
    ).modes  # of each training search
    here = (pose.easting_m, pose.northing_m)
    wrong = [mode.pose for mode in modes if math.dist((mode.pose.easting_m, mode.pose.northing_m), here) > WRONG_M]
    poses = [pose, *wrong]
    by_class = np.zeros((len(poses), len(classes)))
    by_class[:, [classes.index(name) for name in reader.region.classes]] = reading.by_class(poses)
    return _ScoredModes(query=query, poses=poses, by_class=by_class, beside=reading.beside(poses))
