# SPDX-License-Identifier: Apache-2.0
"""The joint score of a list of modes, Eq. 11 of the SASGeo paper: raster, graph, and what speaks against."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError

SIGHT: Final = 6.0  # nodes: a graph of so many has half its say


@dataclass(frozen=True, slots=True, kw_only=True)
class Blend:
    """Weights of Eq. 11 where all there is to see is seen; of odometry (gamma) there is none in single views.

    Parameters
    ----------
    alpha : float
        Of the raster's score.
    beta : float
        Of the graph's score.
    eta : float
        Of the contradiction.

    Raises
    ------
    ConfigError
        If one is negative or not finite.

    Examples
    --------
    >>> Blend().beta
    0.5
    """

    alpha: float = 1.0
    beta: float = 0.5
    eta: float = 0.1

    def __post_init__(self) -> None:
        """Refuse what would turn a term around."""
        for name in ("alpha", "beta", "eta"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                message = f"{name} of the joint score is at least 0 and finite, got {value!r}"
                raise ConfigError(message)


def contradiction(by_class: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the classes that speak against a mode say in sum, nats, shape (M,), of scores by class, shape (M, C).

    The raster's sum lets a class that agrees much cover up another that contradicts; this does not.

    Examples
    --------
    >>> contradiction(np.array([[3.0, -1.0], [1.0, 1.0]])).tolist()
    [1.0, 0.0]
    """
    return np.asarray(np.maximum(0.0, -by_class).sum(axis=1))


def columns(
    by_class: NDArray[np.float64], graph: NDArray[np.float64] | None, blend: Blend, *, nodes: int
) -> NDArray[np.float64]:
    """Terms of Eq. 11 for each mode, whose sum over columns is the joint score: classes, graph, contradiction.

    Parameters
    ----------
    by_class : ndarray of float, shape (M, C)
        Tempered raster scores, nats.
    graph : ndarray of float, shape (M,), optional
        Scores by Eq. 9; without them the raster decides alone.
    blend : Blend
        Weights.
    nodes : int
        Nodes that were seen: what there is of a graph decides what it may say.

    Returns
    -------
    ndarray of float, shape (M, C) or (M, C + 2)
        Nats.

    Examples
    --------
    >>> columns(np.array([[3.0, -1.0]]), np.array([2.0]), Blend(), nodes=6).round(2).tolist()
    [[3.0, -1.0, 0.5, -0.1]]
    """
    raster = blend.alpha * by_class
    if graph is None:
        return raster
    share = nodes / (nodes + SIGHT)
    return np.column_stack((raster, blend.beta * share * graph, -blend.eta * contradiction(by_class)))
