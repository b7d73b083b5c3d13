# SPDX-License-Identifier: Apache-2.0
"""`vio_dead_reckoning`: the odometer alone, which says for as long as it believes so that it knows the place."""

from typing import Final

import numpy as np

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.window import NEAR_M, radius_95_m

_FLOOR: Final = 1e-6 * np.eye(3)  # m2, deg2: keeps the covariance of a perfect odometer invertible


class VioDeadReckoning:
    """Adds the increments up, with the covariance that the odometer gives them, from the middle of the prior."""

    card = sgb.MatcherCard(
        name="vio_dead_reckoning",
        version="1",
        title="Visual-inertial odometry alone",
        source="VINS-Mono (Qin, Li and Shen, T-RO 2018): poses by odometry alone, without the map",
        ours=(
            "increments and their covariances come with the flight instead of from images and an IMU, and their errors "
            "count as independent; no loops are closed; accepted while 95 % of its own belief lie within 25 m"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "Never finds itself on the map: it knows no more of the start than the prior, and drifts from there; "
            "errors of neighbouring increments are alike, so it is too sure of itself after some hundred metres"
        ),
    )

    def __init__(self) -> None:
        self._grid: sgb.Grid | None = None
        self._pose: sgb.Pose | None = None
        self._covariance = np.eye(3)

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Keep the outline of the map for flights that may begin anywhere."""
        del learned
        self._grid = region.grid

    def start(self, prior: sgb.Prior) -> None:
        """Begin in the middle of the prior."""
        if self._grid is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before start()")
        self._pose, self._covariance = sgb.start_of(prior, self._grid)

    def step(self, query: sgb.Query) -> sgb.Fix:
        """Add the increment."""
        if self._pose is None or query.step is None:
            raise RuntimeError(f"{self.card.name}: call start() first, and step() with the views of a flight")
        self._pose, self._covariance = sgb.advance(self._pose, self._covariance, query.step)
        is_near = radius_95_m(self._covariance) <= NEAR_M
        return sgb.Fix(pose=self._pose, covariance=self._covariance + _FLOOR, is_accepted=is_near)
