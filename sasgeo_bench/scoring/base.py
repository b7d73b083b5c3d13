# SPDX-License-Identifier: Apache-2.0
"""Checks of columns and weights, weighted means and quantiles, shared by all metrics."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from sasgeo_bench.core.errors import MetricError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

_MOST_GAPS = 4  # codes are numbered in place up to so many times their count; other numbers are sorted


def check_column(values: ArrayLike, name: str, count: int | None = None) -> Floats:
    """Return the values of a column as floats, shape (N,); infinity is allowed.

    `count` is the expected N, `name` names the column in errors. Raise MetricError if the shape differs, or a value is
    NaN.

    >>> check_column([True, False], "hits").tolist()
    [1.0, 0.0]
    """
    column = np.asarray(values, dtype=np.float64)
    if column.ndim != 1 or (count is not None and len(column) != count):
        expected = "(N,)" if count is None else f"({count},)"
        raise MetricError(f"{name} has shape {column.shape}, expected {expected}: one value for each query")
    if np.isnan(column).any():
        raise MetricError(
            f"{name} holds NaN at place {int(np.isnan(column).argmax())}: a query without a value is a miss"
        )
    return column


def check_weights(weights: ArrayLike | None, count: int) -> Floats:
    """Return the weights of N queries, shape (N,); 1 each where none are given.

    Weights are counts: a query of weight 2 counts twice. Raise MetricError if their number is not N, or one is negative
    or not finite.
    """
    if weights is None:
        return np.ones(count)
    column = check_column(weights, "weights", count)
    wrong = ~(np.isfinite(column) & (column >= 0))
    if wrong.any():
        raise MetricError(f"weights holds {column[wrong][0]:g}, expected finite numbers that are not negative")
    return column


def block_codes(blocks: Sequence[str] | Ints, count: int) -> tuple[Ints, Ints]:
    """Return the sizes of K blocks, shape (K,), and the index of each query's block from 0, shape (N,).

    Blocks stand in the order of their names. Integer codes in the same order give the same result. Raise MetricError if
    the number of blocks is not N.

    >>> sizes, code = block_codes(["b", "a", "b"], 3)
    >>> sizes.tolist(), code.tolist()
    ([1, 2], [1, 0, 1])
    """
    if len(blocks) != count:
        raise MetricError(f"{len(blocks)} blocks for {count} queries, expected one each")
    code = codes_of(blocks)
    return np.bincount(code), code


def codes_of(names: ArrayLike) -> Ints:
    """Return for each of N names its place in their order, each counted once, shape (N,).

    >>> codes_of(["b", "a", "b"]).tolist(), codes_of(np.array([7, 3, 7])).tolist()
    ([1, 0, 1], [1, 0, 1])
    """
    values = np.asarray(names)
    if values.dtype.kind != "i":
        values = values.astype(object)
    elif values.size and values.min() >= 0 and values.max() <= _MOST_GAPS * values.size:  # codes, most of the time
        is_there = np.zeros(int(values.max()) + 1, dtype=np.int64)
        is_there[values] = 1
        return np.asarray((np.cumsum(is_there) - 1)[values], dtype=np.int64)
    return np.asarray(pd.factorize(values, sort=True)[0], dtype=np.int64)


def weighted_mean(values: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Return the mean of one value per query, shape (N,); NaN where the weights sum to 0.

    An infinite value of positive weight makes the mean infinite; a value of weight 0 never counts.

    >>> weighted_mean([1.0, 0.0, 0.0], weights=[2.0, 1.0, 1.0])
    0.5
    """
    column = check_column(values, "values")
    mass = check_weights(weights, len(column))
    counts = mass > 0
    if not counts.any():
        return float("nan")
    return float(column[counts] @ mass[counts] / mass[counts].sum())


def weighted_quantile(values: ArrayLike, share: float, weights: ArrayLike | None = None) -> float:
    """Return the least value that at least a fraction `share` in (0, 1] of the queries does not exceed.

    The result is always one of the values, so a finite and an infinite error are never averaged; NaN where the weights
    sum to 0. Raise MetricError if the share is out of range.

    The inverse of the empirical distribution function, type 1 of Hyndman and Fan (1996). For an even number of queries
    the median is the lower of the two in the middle.

    >>> weighted_quantile([3.0, 1.0, float("inf"), 2.0], 0.5)
    2.0
    """
    if not 0 < share <= 1:
        raise MetricError(f"share must lie in (0, 1], got {share!r}")
    column = check_column(values, "values")
    mass = check_weights(weights, len(column))
    if not (mass > 0).any():
        return float("nan")
    return float(np.quantile(column, share, weights=mass, method="inverted_cdf"))
