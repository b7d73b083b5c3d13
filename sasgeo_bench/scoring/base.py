# SPDX-License-Identifier: Apache-2.0
"""What every figure shares: its declaration, weights that are checked, weighted means and quantiles."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sasgeo_bench.errors import MetricError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


def check_column(values: ArrayLike, name: str, count: int | None = None) -> Floats:
    """Numbers of one column, shape (N,); infinity may be among them.

    Parameters
    ----------
    values : array_like, shape (N,)
        Numbers or truth values.
    name : str
        What they are called in an error.
    count : int, optional
        How many there must be.

    Returns
    -------
    ndarray of float, shape (N,)
        The same as floats.

    Raises
    ------
    MetricError
        If the shape is another, or a value is NaN.

    Examples
    --------
    >>> check_column([True, False], "hits").tolist()
    [1.0, 0.0]
    """
    column = np.asarray(values, dtype=np.float64)
    if column.ndim != 1 or (count is not None and len(column) != count):
        expected = "(N,)" if count is None else f"({count},)"
        message = f"{name} has shape {column.shape}, expected {expected}: one value for each query"
        raise MetricError(message)
    if np.isnan(column).any():
        message = f"{name} holds NaN at place {int(np.isnan(column).argmax())}: a query without a value is a miss"
        raise MetricError(message)
    return column


def check_weights(weights: ArrayLike | None, count: int) -> Floats:
    """Weights of N queries, 1 each where none are given.

    Parameters
    ----------
    weights : array_like, shape (N,), optional
        Finite and not negative. They are counts: a query with weight 2 is there twice.
    count : int
        N.

    Returns
    -------
    ndarray of float, shape (N,)
        The weights.

    Raises
    ------
    MetricError
        If there are more or fewer, or one is negative or not finite.

    Examples
    --------
    >>> check_weights(None, 2).tolist()
    [1.0, 1.0]
    """
    if weights is None:
        return np.ones(count)
    column = check_column(weights, "weights", count)
    wrong = ~(np.isfinite(column) & (column >= 0))
    if wrong.any():
        message = f"weights holds {column[wrong][0]:g}, expected finite numbers that are not negative"
        raise MetricError(message)
    return column


def block_codes(blocks: Sequence[str] | Ints, count: int) -> tuple[Ints, Ints]:
    """Sizes of K blocks in the order of their names, shape (K,), and the number of each query's block, shape (N,).

    Parameters
    ----------
    blocks : sequence of str or ndarray of int, length N
        Block of each query; numbers that stand in the order of the names give the same.
    count : int
        N.

    Returns
    -------
    tuple of ndarray of int
        Sizes, and numbers from 0.

    Raises
    ------
    MetricError
        If there are more or fewer blocks than queries.

    Examples
    --------
    >>> sizes, code = block_codes(["b", "a", "b"], 3)
    >>> sizes.tolist(), code.tolist()
    ([1, 2], [1, 0, 1])
    """
    if len(blocks) != count:
        message = f"{len(blocks)} blocks for {count} queries, expected one each"
        raise MetricError(message)
    names = np.asarray(blocks)
    names = names if names.dtype.kind == "i" else names.astype(str)
    _, code, sizes = np.unique(names, return_inverse=True, return_counts=True)
    return np.asarray(sizes, dtype=np.int64), np.asarray(code, dtype=np.int64)


def weighted_mean(values: ArrayLike, weights: ArrayLike | None = None) -> float:
    """Mean of one value for each query.

    Parameters
    ----------
    values : array_like, shape (N,)
        Infinity is honoured: one infinite value of positive weight makes the mean infinite.
    weights : array_like, shape (N,), optional
        Not negative; a value of weight 0 does not count, even if it is infinite.

    Returns
    -------
    float
        NaN where nothing counts.

    Examples
    --------
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
    """Least value that at least a share of the queries does not exceed.

    Parameters
    ----------
    values : array_like, shape (N,)
        Infinity is a value like any other, the greatest one.
    share : float
        In (0, 1]; 0.5 is the median.
    weights : array_like, shape (N,), optional
        Not negative.

    Returns
    -------
    float
        One of the values, never one in between: no mean of a finite and an infinite error is taken. NaN where nothing
        counts.

    Raises
    ------
    MetricError
        If the share is out of range.

    Notes
    -----
    The inverse of the empirical distribution function, type 1 of Hyndman and Fan (1996); with an even number of
    queries the median is the lower of the two in the middle.

    Examples
    --------
    >>> weighted_quantile([3.0, 1.0, float("inf"), 2.0], 0.5)
    2.0
    """
    if not 0 < share <= 1:
        message = f"share must lie in (0, 1], got {share!r}"
        raise MetricError(message)
    column = check_column(values, "values")
    mass = check_weights(weights, len(column))
    if not (mass > 0).any():
        return float("nan")
    return float(np.quantile(column, share, weights=mass, method="inverted_cdf"))
