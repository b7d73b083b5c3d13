# SPDX-License-Identifier: Apache-2.0
"""Beliefs of trackers: a belief after a step, and its fix: the place with the most mass, refined below the cell."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.matching.tracker import Fix
from sasgeo_bench.search.belief import Floats, GridBelief, moved
from sasgeo_bench.tasks.query import Step

NEAR_M: Final = 25.0  # the confidence of a fix is the mass so near to it
MODES: Final = 4
LEAST_MODE: Final = 0.01
_EVEN: Final = 1 / 12  # variance of an even spread over a unit


def followed(belief: GridBelief, step: Step, *, diffuses: bool = True) -> GridBelief:
    """Return the belief at the next view; `diffuses` spreads it by the covariance of the increment.

    Where the odometer lost its way the belief stays, and spreads by 1 km and 90 degrees.
    """
    if step.frame == 0:
        return belief
    covariance = None if step.covariance is None else np.reshape(step.covariance, (3, 3))
    return moved(belief, step.increment, covariance, diffuses=diffuses)


def fix_of(belief: GridBelief, *, least: float) -> Fix:
    """Return the place with the most mass around it, accepted if that is at least `least`."""
    plane = belief.mass.sum(axis=0)
    # Mass within `NEAR_M` of the middle of each cell
    reach = int(NEAR_M / belief.grid.cell_size_m)
    squares = np.arange(-reach, reach + 1) ** 2
    disc = (squares[:, None] + squares <= (NEAR_M / belief.grid.cell_size_m) ** 2).astype(np.float32)
    around: NDArray[np.float32] = np.asarray(cv2.filter2D(plane, -1, disc, borderType=cv2.BORDER_CONSTANT))
    peaks = _peaks(around, belief)
    pose, mass = _refined(belief, plane, peaks[0])
    modes = []
    for peak in peaks[1:]:
        mode, share = _refined(belief, plane, peak)
        if share >= LEAST_MODE:
            modes.append((mode, share))
    return Fix(
        pose=pose,
        covariance=_covariance(belief, plane, pose),
        is_accepted=mass >= least,
        confidence=mass,
        modes=sorted(modes, key=lambda item: -item[1]),
        diagnostics={"cell_m": belief.grid.cell_size_m, "rows": belief.shape[0], "cols": belief.shape[1]},
    )


def _peaks(around: Floats, belief: GridBelief) -> list[tuple[float, float]]:
    """Return places with the most mass around, metres, best first: `MODES` + 1 at most, each apart from the others."""
    left = around.copy()
    found: list[tuple[float, float]] = []
    places_m = belief.places_m
    best = float(around.max())
    while len(found) <= MODES:
        at = int(left.argmax())
        if found and left.flat[at] < LEAST_MODE * best:
            break
        place = places_m[at]
        found.append((float(place[0]), float(place[1])))
        left.reshape(-1)[np.hypot(*(places_m - place).T) < 50.0] = -1.0  # 50 m between two modes
    return found


def _refined(belief: GridBelief, plane: Floats, place_m: tuple[float, float]) -> tuple[Pose, float]:
    """Return the mean pose of the mass near a place, and how much mass lies near it."""
    at_m = np.array(place_m)
    flat = plane.reshape(-1)
    for _ in range(3):  # rounds of moving to the mean of what is near
        near = np.hypot(*(belief.places_m - at_m).T) <= max(NEAR_M, belief.grid.cell_size_m)
        weight = flat[near].astype(np.float64)
        if weight.sum() > 0:
            at_m = weight @ belief.places_m[near] / weight.sum()
    near = np.hypot(*(belief.places_m - at_m).T) <= max(NEAR_M, belief.grid.cell_size_m)
    of_yaw = belief.mass.reshape(len(belief.mass), -1)[:, near].sum(axis=1, dtype=np.float64)
    turn = np.radians(belief.yaws_deg)
    yaw_deg = float(np.degrees(np.arctan2(of_yaw @ np.sin(turn), of_yaw @ np.cos(turn))))
    pose = Pose(easting_m=float(at_m[0]), northing_m=float(at_m[1]), yaw_deg=yaw_deg)
    return pose, float(min(1.0, of_yaw.sum()))


def _covariance(belief: GridBelief, plane: Floats, pose: Pose) -> NDArray[np.float64]:
    """Return the second moments of the belief about a pose: m2, m deg, deg2."""
    away_m = belief.places_m - (pose.easting_m, pose.northing_m)
    turn_deg = np.asarray(wrap_deg(belief.yaws_deg - pose.yaw_deg))
    flat = plane.reshape(-1).astype(np.float64)
    found = np.zeros((3, 3))
    found[:2, :2] = (away_m * flat[:, None]).T @ away_m
    of_yaw = belief.mass.sum(axis=(1, 2), dtype=np.float64)
    found[2, 2] = of_yaw @ turn_deg**2
    by_yaw = belief.mass.reshape(len(belief.mass), -1) @ away_m.astype(np.float32)
    found[:2, 2] = found[2, :2] = turn_deg @ by_yaw
    cell_m, step_deg = belief.grid.cell_size_m, belief.yaw_step_deg
    return found + np.diag(_EVEN * np.array([cell_m**2, cell_m**2, step_deg**2]))
