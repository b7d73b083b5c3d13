# SPDX-License-Identifier: Apache-2.0
"""Joint score of a list of modes, Eq. 11 of the SASGeo paper: raster, graph and contradiction."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError

HALF_NODES: Final = 6.0  # a graph of so many nodes has half its weight


@dataclass(frozen=True, slots=True, kw_only=True)
class Blend:
    """Weights of raster, graph and contradiction in Eq. 11; single views have no odometry term (gamma).

    Raises
    ------
    ConfigError
        If one is negative or not finite.
    """

    alpha: float = 1.0
    beta: float = 0.5
    eta: float = 0.1

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "eta"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"{name} of the joint score is at least 0 and finite, got {value!r}")


def contradiction(by_class: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of negative class scores of each mode, nats, shape (M,), from scores of shape (M, C).

    In the raster score a class that agrees can hide one that contradicts; here it cannot.
    """
    return np.asarray(np.maximum(0.0, -by_class).sum(axis=1))


def columns(
    by_class: NDArray[np.float64], graph: NDArray[np.float64] | None, blend: Blend, *, nodes: int
) -> NDArray[np.float64]:
    """Return the terms of Eq. 11 for each mode, whose sum is the joint score: classes, graph, contradiction.

    `by_class`, shape (M, C), are scaled raster scores; `graph`, shape (M,), scores of Eq. 9, without which the raster
    decides alone; `nodes` seen set the weight of the graph. The result, nats, has shape (M, C + 2), or (M, C) without a
    graph.

    Examples
    --------
    >>> columns(np.array([[3.0, -1.0]]), np.array([2.0]), Blend(), nodes=6).round(2).tolist()
    [[3.0, -1.0, 0.5, -0.1]]
    """
    raster = blend.alpha * by_class
    if graph is None:
        return raster
    share = nodes / (nodes + HALF_NODES)
    return np.column_stack((raster, blend.beta * share * graph, -blend.eta * contradiction(by_class)))
