# SPDX-License-Identifier: Apache-2.0
"""Joint score of a list of modes, Eq. 11 of the SASGeo paper: raster, graph and contradiction; and what is ours."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg

HALF_NODES: Final = 6.0  # a graph of so many nodes has half its weight
_LEAST_SIGMA: Final = 1e-3  # of a scale that is known: a search still takes steps of it


@dataclass(frozen=True, slots=True)
class Blend:
    """Weights of the terms of the joint score: raster, graph and contradiction in Eq. 11, and what is ours.

    `heading` and `scale` weigh the prior of the query (`of_prior`), `amount` how unlike the amounts of the classes are,
    `overlap` that of view and map (`overlap.overlap_of`). Single views have no odometry term (gamma).

    Raises
    ------
    ConfigError
        If one is negative or not finite.
    """

    alpha: float = 1.0
    beta: float = 0.5
    eta: float = 0.1
    heading: float = 0.3
    scale: float = 0.3
    amount: float = 1.0
    overlap: float = 30.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"{item.name} of the joint score is at least 0 and finite, got {value!r}")

    @property
    def beside(self) -> NDArray[np.float64]:
        """Return the weights of our terms, shape (4,): heading, scale, amount, overlap."""
        return np.array([self.heading, self.scale, self.amount, self.overlap])


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


def of_prior(poses: Sequence[Pose], prior: Prior) -> NDArray[np.float64]:
    """Return what a prior says of heading and scale of each mode, nats, shape (M, 2): at most 0, at its middle.

    Places are even within the disc of the prior, so that it says nothing of them.

    Examples
    --------
    >>> north = Prior(center_m=None, radius_m=None, yaw_deg=0.0, yaw_sigma_deg=20.0, scale_sigma=0.05)
    >>> turned = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=340.0, scale=1.1)
    >>> of_prior([turned], north).round(2).tolist()
    [[-0.5, -1.82]]
    """
    scales = np.log([pose.scale for pose in poses])
    found = np.zeros((len(poses), 2))
    if prior.yaw_deg is not None and prior.yaw_sigma_deg is not None:
        off_deg = wrap_deg(np.array([pose.yaw_deg for pose in poses]) - prior.yaw_deg)
        found[:, 0] = -0.5 * (off_deg / prior.yaw_sigma_deg) ** 2
    found[:, 1] = -0.5 * (scales / max(prior.scale_sigma, _LEAST_SIGMA)) ** 2
    return found
