# SPDX-License-Identifier: Apache-2.0
"""Score a ranking by the metrics of its dataset: each as the released code computes it, and as its name says."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.exchange.importers import dense_uav, sues, visloc
from sasgeo_bench.exchange.importers.items import Dataset, Item
from sasgeo_bench.exchange.importers.retrieval import (
    DENSE_PER_M,
    GTA_PER_M,
    PER_DEGREE,
    Floats,
    Ints,
    Ranking,
    float32_degrees,
    geodesic_m,
    half_distance_m,
    haversine_m,
    one_percent_rank,
    parallel_m,
    step_ap,
    trapezoid_ap,
    weighted_decay,
)

Bools = NDArray[np.bool_]

_RECALLS: Final = (1, 5, 10)
_SDM: Final = (1, 3, 5, 10)
_DIS: Final = (1, 3, 5)
_MA_M: Final = (3, 5, 10, 20, 50, 100)
_ACCURACY_M: Final = (20, 40, 80, 100, 200)

# Released / corrected.
_DENOMINATOR: Final = "over all queries / those with a positive"
_RANK: Final = f"one rank too far; {_DENOMINATOR}"
_TRAPEZOID: Final = f"trapezoids / steps; {_DENOMINATOR}"
_OTHER: Final = "SDM of another paper: not comparable"
_STRICT: Final = "below the limit / up to it"
_SPHERE: Final = f"{_STRICT}; sphere / ellipsoid"
_SAME: Final = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One metric twice: as released, and corrected; None where the ranking is too short or the code has no such metric.

    `unit` is 1 for a share and m for metres; `difference` says how the two differ, empty if they do not.
    """

    metric: str
    unit: str = "1"
    released: float | None
    corrected: float | None
    difference: str = _SAME


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Metrics of the queries of one view against the gallery of another; of SUES-200 at one height.

    Parameters
    ----------
    query_view, gallery_view : str
        Views of the items that the ranking holds.
    group : str, optional
        Flying height in SUES-200.
    queries, answered, without_positive, gallery : int
        Queries of the set, those with a row in the ranking, those without a positive; items of the gallery.
    scores : tuple of Score
        The metrics.
    """

    query_view: str
    gallery_view: str
    group: str | None
    queries: int
    answered: int
    without_positive: int
    gallery: int
    scores: tuple[Score, ...]

    @property
    def title(self) -> str:
        """Return views and group on one line."""
        return f"{self.query_view} to {self.gallery_view}" + (f", {self.group} m" if self.group else "")


def score_ranking(dataset: Dataset, ranking: Ranking) -> tuple[Report, ...]:
    """Score a ranking by the metrics of its dataset, a report for each pair of views (and height, in SUES-200).

    A query of the set without a row is a miss. A metric that needs more ranks than the shortest list has is None.
    Raise `DatasetError` if the answers to one query are of several views or, in SUES-200, heights.
    """
    columns = _Columns.of(dataset.items)
    by_height = dataset.card.kind == sues.CARD.kind
    keys = _keys(columns, ranking, by_height=by_height)
    reports = []
    for key in np.unique(keys, axis=0):
        # Answers to some of the queries
        which = np.flatnonzero((keys == key).all(axis=1))
        lengths = np.diff(ranking.starts)[which]
        keep = np.repeat(np.isin(np.arange(len(ranking.queries)), which), np.diff(ranking.starts))
        starts = np.concatenate([[0], np.cumsum(lengths)])
        part = Ranking(queries=ranking.queries[which], starts=starts, answers=ranking.answers[keep])
        reports.append(_report(dataset, columns, part, by_height=by_height))
    return tuple(reports)


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """Items as columns: text as codes, -1 for None; places of shape (N, 2), boxes of shape (N, 4), NaN for None."""

    role: Ints
    view: Ints
    group: Ints
    label: Ints
    lonlat_deg: Floats
    box_deg: Floats

    @classmethod
    def of(cls, items: Sequence[Item]) -> "_Columns":
        nothing = (np.nan, np.nan)
        places = [(p.longitude_deg, p.latitude_deg) if p else nothing for p in (item.position for item in items)]
        boxes = [
            (b.west_deg, b.south_deg, b.east_deg, b.north_deg) if b else nothing * 2
            for b in (item.box for item in items)
        ]
        return cls(
            role=_codes([item.role for item in items]),
            view=_codes([item.view for item in items]),
            group=_codes([item.group for item in items]),
            label=_codes([item.label for item in items]),
            lonlat_deg=np.array(places),
            box_deg=np.array(boxes),
        )


def _codes(texts: Sequence[str | None]) -> Ints:
    known = {text: at for at, text in enumerate(dict.fromkeys(text for text in texts if text is not None))}
    return np.array([-1 if text is None else known[text] for text in texts], dtype=np.int64)


def _keys(columns: _Columns, ranking: Ranking, *, by_height: bool) -> Ints:
    """Return what tells reports apart, a row for each answered query."""
    kinds = [columns.view, columns.group] if by_height else [columns.view]
    found = [columns.view[ranking.queries]]
    for kind in kinds:
        values = kind[ranking.answers]
        least, most = (part.reduceat(values, ranking.starts[:-1]) for part in (np.minimum, np.maximum))
        if (least != most).any():
            what = "views and heights" if by_height else "views"
            raise DatasetError(f"the answers to one query are of several {what}: rank one gallery for each query")
        found.append(least)
    return np.stack(found, axis=1)


def _report(dataset: Dataset, columns: _Columns, ranking: Ranking, *, by_height: bool) -> Report:
    scope = _Scope(items=dataset.items, columns=columns, ranking=ranking)
    first_query, first_answer = (dataset.items[int(at[0])] for at in (ranking.queries, ranking.answers))
    return Report(
        query_view=first_query.view,
        gallery_view=first_answer.view,
        group=(first_query.group or first_answer.group) if by_height else None,
        queries=len(scope.queries),
        answered=len(ranking.queries),
        without_positive=int((scope.positives == 0).sum()),
        gallery=len(scope.gallery),
        scores=tuple(_scores(dataset.card.kind, scope)),
    )


@dataclass(frozen=True, kw_only=True)
class _Scope:
    """Queries of one report, their gallery, and the answers; a released script is run on exactly this."""

    items: Sequence[Item]
    columns: _Columns
    ranking: Ranking

    @cached_property
    def queries(self) -> Ints:
        """Return all queries of the views and groups that the ranking answers, shape (Q,)."""
        return self._alike(self.ranking.queries)

    @cached_property
    def gallery(self) -> Ints:
        """Return all gallery items of the views and groups that the ranking names, shape (G,)."""
        return self._alike(self.ranking.answers)

    def _alike(self, some: Ints) -> Ints:
        columns, one = self.columns, some[0]
        alike = (columns.role == columns.role[one]) & (columns.view == columns.view[one])
        return np.flatnonzero(alike & np.isin(columns.group, np.unique(columns.group[some])))

    @cached_property
    def positives(self) -> Ints:
        """Return how many gallery items are right for each query, shape (Q,)."""
        label = self.columns.label
        if (label[self.queries] >= 0).all():
            return np.bincount(label[self.gallery], minlength=label.max() + 1)[label[self.queries]]
        boxes = self.columns.box_deg[self.gallery]
        return np.array([_inside(place, boxes).sum() for place in self.columns.lonlat_deg[self.queries]])

    @cached_property
    def hits(self) -> Bools:
        """Return whether each answer is right, shape (R,)."""
        asked = np.repeat(self.ranking.queries, np.diff(self.ranking.starts))
        label = self.columns.label
        if (label[self.ranking.queries] >= 0).all():
            return np.asarray(label[asked] == label[self.ranking.answers])
        return _inside(self.columns.lonlat_deg[asked], self.columns.box_deg[self.ranking.answers])

    @cached_property
    def hit_ranks(self) -> list[Ints]:
        """Return the ranks of the right answers to each answered query, from 0."""
        found = np.flatnonzero(self.hits)
        bounds = np.searchsorted(found, self.ranking.starts[1:-1])
        return list(np.split(self.ranking.ranks[found], bounds))

    @cached_property
    def best(self) -> Ints:
        return np.array([ranks[0] for ranks in self.hit_ranks if len(ranks)], dtype=np.int64)

    @cached_property
    def answered(self) -> Ints:
        return np.searchsorted(self.queries, self.ranking.queries)

    @property
    def with_positive(self) -> int:
        return int((self.positives > 0).sum())

    def mean(self, values: NDArray[np.floating] | Bools) -> float:
        """Average values of the answered queries over all queries; one without an answer counts as 0."""
        return float(values.sum(dtype=np.float64) / len(self.queries))

    def places(self, count: int) -> tuple[Floats, Floats] | None:
        """Return places of queries, shape (A, 1, 2), and of their first answers, (A, count, 2); None if too few."""
        if self.ranking.depth < count:
            return None
        lonlat = self.columns.lonlat_deg
        return lonlat[self.ranking.queries][:, None], lonlat[self.ranking.first(count)]


def _inside(places: Floats, boxes: Floats) -> Bools:
    """Return whether places lie in boxes, as `Box.contains`."""
    lon_deg, lat_deg = places[..., 0], places[..., 1]
    west, south, east, north = (boxes[..., side] for side in range(4))
    return np.asarray((west <= lon_deg) & (lon_deg < east) & (south <= lat_deg) & (lat_deg < north))


def _scores(kind: str, scope: _Scope) -> Iterator[Score]:
    for count in _RECALLS:
        released = _hits_within(scope, count) if count <= len(scope.gallery) else None
        yield _recall(scope, f"recall_{count}", released, _hits_within(scope, count), _DENOMINATOR)
    ranks = one_percent_rank(len(scope.gallery))
    further = round(0.01 * len(scope.gallery)) + 1
    released = _hits_within(scope, further) if further <= len(scope.gallery) else None
    yield _recall(scope, "recall_1pct", released, _hits_within(scope, ranks), _RANK)
    yield _average_precision(scope, is_trapezoid=kind != visloc.CARD.kind)
    if kind == dense_uav.CARD.kind:
        yield from _dense_scores(scope)
    elif kind == visloc.CARD.kind:
        yield from _game4loc_scores(scope)


def _hits_within(scope: _Scope, count: int) -> int | None:
    """Return how many queries have a right answer among the first ones; None if lists are shorter."""
    within = min(count, len(scope.gallery))
    return int((scope.best < within).sum()) if scope.ranking.depth >= within else None


def _recall(scope: _Scope, metric: str, released: int | None, hits: int | None, difference: str) -> Score:
    return Score(
        metric=metric,
        released=None if released is None else released / len(scope.queries),
        corrected=None if hits is None or scope.with_positive == 0 else hits / scope.with_positive,
        difference=difference,
    )


def _average_precision(scope: _Scope, *, is_trapezoid: bool) -> Score:
    """Average precision; None unless every positive of every answered query is ranked."""
    difference = _TRAPEZOID if is_trapezoid else _SAME
    found = list(zip(scope.hit_ranks, scope.positives[scope.answered].tolist(), strict=True))
    if scope.with_positive == 0 or any(len(ranks) < positives for ranks, positives in found):
        return Score(metric="ap", released=None, corrected=None, difference=difference)
    pairs = [(ranks, positives) for ranks, positives in found if positives]
    steps = sum(step_ap(*pair) for pair in pairs) / scope.with_positive
    trapezoids = sum(trapezoid_ap(*pair) for pair in pairs) / len(scope.queries)
    return Score(metric="ap", released=trapezoids if is_trapezoid else steps, corrected=steps, difference=difference)


def _dense_scores(scope: _Scope) -> Iterator[Score]:
    """SDM and MA of DenseUAV's `evaluateDistance.py`."""
    for count in _SDM:
        places = scope.places(count)
        released = None if places is None else np.exp(-float32_degrees(*places) * np.float32(PER_DEGREE))
        yield _sdm(scope, DENSE_PER_M, count, released=released, difference="single-precision degrees / metres")
    yield from (_sdm(scope, GTA_PER_M, count, released=None, difference=_OTHER) for count in _SDM)
    places = scope.places(1)
    if places is not None:
        sphere_m, ellipsoid_m = haversine_m(*places)[:, 0], geodesic_m(*places)[:, 0]
        for limit in _MA_M:
            yield Score(
                metric=f"ma_{limit}m",
                released=scope.mean(sphere_m < limit),
                corrected=scope.mean(ellipsoid_m <= limit),
                difference=_SPHERE,
            )


def _game4loc_scores(scope: _Scope) -> Iterator[Score]:
    """SDM, accuracy and Dis of Game4Loc's `evaluate/visloc.py`; the set itself has released no metric."""
    for count in _SDM:
        places = scope.places(count)
        decayed = None if places is None else np.exp(-GTA_PER_M * geodesic_m(*places))
        yield _sdm(scope, GTA_PER_M, count, released=decayed, difference=_SAME)
    yield from (_sdm(scope, DENSE_PER_M, count, released=None, difference=_OTHER) for count in _SDM)
    places = scope.places(1)
    if places is not None:
        distance_m = geodesic_m(*places)[:, 0]
        for limit in _ACCURACY_M:
            yield Score(
                metric=f"accuracy_{limit}m",
                released=scope.mean(distance_m < limit),
                corrected=scope.mean(distance_m <= limit),
                difference=_STRICT,
            )
        logged_m = float(parallel_m(*places).mean())
        yield Score(
            metric="logged_distance",
            unit="m",
            released=logged_m,
            corrected=float(distance_m.mean()),
            difference="longitudes alone / both",
        )
    for count in _DIS:
        places = scope.places(count)
        mean_m = None if places is None else float(geodesic_m(*places).mean())
        yield Score(metric=f"dis_{count}", unit="m", released=mean_m, corrected=mean_m)


def _sdm(scope: _Scope, per_m: float, count: int, *, released: NDArray[np.floating] | None, difference: str) -> Score:
    places = scope.places(count)
    corrected = None if places is None else scope.mean(weighted_decay(np.exp(-per_m * geodesic_m(*places))))
    return Score(
        metric=f"sdm_{half_distance_m(per_m):.0f}m_{count}",
        released=None if released is None else scope.mean(weighted_decay(released)),
        corrected=corrected,
        difference=difference,
    )
