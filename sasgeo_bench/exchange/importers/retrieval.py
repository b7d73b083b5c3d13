# SPDX-License-Identifier: Apache-2.0
"""Retrieval measures as the released code of the datasets computes them, and as their names say.

A rank counts from 0, as in that code. Each function is one formula; `reports.py` puts them together.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyproj
from numpy.typing import NDArray

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.core.parquet import open_table, read_schema
from sasgeo_bench.exchange.importers.items import Item

COLUMNS: Final = ("query_id", "gallery_id", "rank")
_MEND: Final = f"write a Parquet file with the columns {', '.join(COLUMNS)}, ranks from 1"

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranking:
    """Answers of a method; items are given by their position in the dataset.

    Parameters
    ----------
    queries : array of int, shape (Q,)
        Answered queries.
    starts : array of int, shape (Q + 1,)
        Where the answers to each query begin in `answers`, and where the last ones end.
    answers : array of int, shape (R,)
        Gallery items, best first.
    """

    queries: Ints
    starts: Ints
    answers: Ints

    @property
    def depth(self) -> int:
        """Return the length of the shortest list."""
        return int(np.diff(self.starts).min())

    @property
    def ranks(self) -> Ints:
        """Return the rank of each answer, from 0, shape (R,)."""
        return np.arange(len(self.answers)) - np.repeat(self.starts[:-1], np.diff(self.starts))

    def first(self, count: int) -> Ints:
        """Return the first answers to each query, shape (Q, count); `count` is at most the depth."""
        return np.asarray(self.answers[self.starts[:-1, None] + np.arange(count)])


def read_ranking(paths: Sequence[Path], items: Sequence[Item]) -> Ranking:
    """Read a ranking of the items of a dataset, from one file or several.

    Raise `StoreError` if a file cannot be read, `DatasetError` if it has other columns, an id that no item of that
    role has, two answers on one rank, one answer twice, or ranks that do not run from 1 without a gap.
    """
    columns = [_read_columns(path, items) for path in paths]
    queries, answers, ranks = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    return _sorted(paths[0], items, (queries, answers, ranks))


def _read_columns(path: Path, items: Sequence[Item]) -> tuple[Ints, Ints, Ints]:
    _check_columns(path, read_schema(path, mend=_MEND))
    # At most 33 million rows of one file
    with open_table(path, mend=_MEND, most_rows=33_000_000, read_dictionary=list(COLUMNS[:2])) as source:
        table = source.read(columns=list(COLUMNS))
    if table.num_rows == 0:
        raise DatasetError(f"{path} has no row: {_MEND}")
    if table["rank"].null_count:
        raise DatasetError(f"{path}, rank: expected whole numbers, found a missing value: {_MEND}")
    queries, answers = (_positions(path, table, name, items) for name in COLUMNS[:2])
    return queries, answers, table["rank"].to_numpy().astype(np.int64)


def _check_columns(path: Path, schema: pa.Schema) -> None:
    """Refuse a table without the columns of a ranking, or with other types."""
    for name in COLUMNS:
        if schema.names.count(name) != 1:
            raise DatasetError(f"{path} has no column {name!r}, or more than one: {_MEND}")
        kind = schema.field(name).type
        kind = kind.value_type if pa.types.is_dictionary(kind) and name != "rank" else kind
        is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        if not (pa.types.is_integer(kind) if name == "rank" else is_text):
            expected = "whole numbers" if name == "rank" else "text"
            raise DatasetError(f"{path}, {name}: expected {expected}, got {kind}: {_MEND}")


def _positions(path: Path, table: pa.Table, column: str, items: Sequence[Item]) -> Ints:
    """Return the position of each id among the items that have its role."""
    role = column.removesuffix("_id")
    values = table[column].combine_chunks()
    values = values if pa.types.is_dictionary(values.type) else values.dictionary_encode()
    known = [at for at, item in enumerate(items) if item.role == role]
    names = pa.array([items[at].item_id for at in known], type=values.type.value_type)
    found = pc.index_in(values.dictionary, value_set=names).take(values.indices)
    if found.null_count:
        wrong = values.filter(pc.is_null(found))[:1].dictionary_decode().cast(pa.binary())[0].as_py()
        shown = "a missing value" if wrong is None else repr(wrong[:100].decode(errors="replace"))
        raise DatasetError(f"{path}, {column}: {shown} is no {role} of the dataset: ids are those of items.parquet")
    return np.asarray(np.array(known, dtype=np.int64)[found.to_numpy()])


def _sorted(path: Path, items: Sequence[Item], columns: tuple[Ints, Ints, Ints]) -> Ranking:
    """Bring rows into the order of queries and ranks; refuse ties, repeats and gaps."""
    queries, answers, ranks = columns
    if ranks.min() >= 1 and ranks.max() <= len(items):
        order = np.argsort(queries * (len(items) + 1) + ranks, kind="stable")  # linear where rows are in order already
        queries, answers, ranks = queries[order], answers[order], ranks[order]
    begins = np.flatnonzero(np.diff(queries, prepend=-1))
    ranking = Ranking(queries=queries[begins], starts=np.append(begins, len(answers)), answers=answers)
    wrong = np.flatnonzero(ranks != ranking.ranks + 1)
    if len(wrong):
        shown = items[queries[wrong[0]]].item_id
        raise DatasetError(f"{path}: the ranks of query {shown!r} do not run from 1 without a gap or a tie: {_MEND}")
    pairs = np.sort(queries * len(items) + answers)
    twice = pairs[1:][pairs[1:] == pairs[:-1]]
    if len(twice):
        query, answer = divmod(int(twice[0]), len(items))
        raise DatasetError(
            f"{path} ranks {items[answer].item_id!r} twice for query {items[query].item_id!r}: keep one of them"
        )
    return ranking


Floats = NDArray[np.float64]

PER_DEGREE: Final = 5000.0  # decay of DenseUAV's SDM
DENSE_PER_M: Final = PER_DEGREE / 111_320.0  # the same along a meridian
GTA_PER_M: Final = 0.001  # decay of the SDM of GTA-UAV and Game4Loc
_SPHERE_M: Final = 6_378_137.0


def one_percent_rank(gallery_size: int) -> int:
    """Return how many ranks are 1 % of a gallery, at least one.

    The released code of University-1652, SUES-200, DenseUAV and Game4Loc looks one rank further, for it takes this
    number as an index that counts from 0: in a gallery of 951 its "Recall@top1" is Recall@11.

    >>> one_percent_rank(951), one_percent_rank(40)
    (10, 1)
    """
    return max(1, round(0.01 * gallery_size))


def trapezoid_ap(ranks: Ints, positives: int) -> float:
    """Average precision as University-1652 computes it: trapezoids under precision over recall.

    Parameters
    ----------
    ranks : array of int, shape (n,)
        Ranks of the gallery's positives, from 0, in order.
    positives : int
        Positives in the gallery, at least one.

    Returns
    -------
    float
        In [0, 1].

    Notes
    -----
    `compute_mAP` of `evaluate_gpu.py`: before the i-th positive of rank r (both from 0) the precision counts as i / r,
    and as 1 before rank 0. So a single positive on the second rank gets 0.25, not 0.5.

    Examples
    --------
    >>> trapezoid_ap(np.array([0]), 1), trapezoid_ap(np.array([1]), 1)
    (1.0, 0.25)
    """
    order = np.arange(len(ranks))
    before = np.where(ranks > 0, order / np.maximum(ranks, 1), 1.0)
    return float(((before + (order + 1) / (ranks + 1)) / 2).sum() / positives)


def step_ap(ranks: Ints, positives: int) -> float:
    """Average precision: the mean of the precision at each positive; arguments as in `trapezoid_ap`.

    >>> step_ap(np.array([1]), 1), step_ap(np.array([0, 3]), 2)
    (0.5, 0.75)
    """
    return float(((np.arange(len(ranks)) + 1) / (ranks + 1)).sum() / positives)


def float32_degrees(first: Floats, second: Floats) -> NDArray[np.float32]:
    """Euclidean distance of longitudes and latitudes, shape (..., 2), in degrees and single precision.

    So does `evaluateDistance.py` of DenseUAV. A degree of longitude counts as much as one of latitude, and at 120
    degrees east neighbouring numbers of single precision lie 0.7 m apart:

    >>> here, near = np.array([120.3870, 30.0]), np.array([120.387003, 30.0])
    >>> float(float32_degrees(here, near)), float(geodesic_m(here, near).round(2))
    (0.0, 0.29)
    """
    offset = second.astype(np.float32) - first.astype(np.float32)
    return np.asarray(np.sqrt((offset * offset).sum(axis=-1)))


def geodesic_m(first: Floats, second: Floats) -> Floats:
    """Distance on the ellipsoid of WGS 84 between longitudes and latitudes, shape (..., 2), in metres."""
    first, second = np.broadcast_arrays(first, second)
    (lon_deg, lat_deg), (to_lon_deg, to_lat_deg) = (np.array(np.moveaxis(at, -1, 0)) for at in (first, second))
    return np.asarray(pyproj.Geod(ellps="WGS84").inv(lon_deg, lat_deg, to_lon_deg, to_lat_deg)[2])


def haversine_m(first: Floats, second: Floats) -> Floats:
    """Distance on a sphere of radius 6,378,137 m, as `latlog2meter` of DenseUAV; arguments as in `geodesic_m`.

    Along a meridian at 30 degrees it is 0.4 % longer than on the ellipsoid:

    >>> here, there = np.array([120.0, 30.0]), np.array([120.0, 30.001])
    >>> float(haversine_m(here, there).round(1)), float(geodesic_m(here, there).round(1))
    (111.3, 110.9)
    """
    first, second = np.radians(first), np.radians(second)
    half = np.sin((first - second) / 2) ** 2
    chord = half[..., 1] + np.cos(first[..., 1]) * np.cos(second[..., 1]) * half[..., 0]
    return np.asarray(2 * _SPHERE_M * np.arcsin(np.sqrt(chord)))


def parallel_m(first: Floats, second: Floats) -> Floats:
    """Distance along the parallel of the first point alone, as `get_dis_target` of Game4Loc logs it.

    It puts the latitude of the query in place of the answer's, so an answer due north is 0 m away:

    >>> here, there = np.array([116.0, 29.7]), np.array([116.0, 29.8])
    >>> float(parallel_m(here, there)), float(geodesic_m(here, there).round())
    (0.0, 11085.0)
    """
    moved = np.stack(np.broadcast_arrays(second[..., 0], first[..., 1]), axis=-1)
    return geodesic_m(first, moved)


def weighted_decay(decayed: NDArray[Any]) -> Floats:
    """Mean over K columns with the weights K, K - 1, ... 1, shape (N, K) to (N,): SDM@K of two papers.

    They share the name, and differ in the decay: exp(-5000 degrees), half after 15 m, in DenseUAV; exp(-0.001 metres),
    half after 693 m, in GTA-UAV. An answer 100 m off is a miss to the one and almost right to the other:

    >>> far_m = np.array([[100.0]])
    >>> [float(weighted_decay(np.exp(-rate * far_m)).round(3)[0]) for rate in (DENSE_PER_M, GTA_PER_M)]
    [0.011, 0.905]
    """
    weights = np.arange(decayed.shape[1], 0, -1)
    return np.asarray(decayed @ weights / weights.sum())


def half_distance_m(rate_per_m: float) -> float:
    """Distance at which an exponential decay has fallen to a half, metres.

    >>> round(half_distance_m(DENSE_PER_M), 1), round(half_distance_m(GTA_PER_M))
    (15.4, 693)
    """
    return math.log(2) / rate_per_m
