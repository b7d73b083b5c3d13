# SPDX-License-Identifier: Apache-2.0
"""Poses that many pairs of like patterns of view and map name at once, and the poses on which most of them agree."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sasgeo_bench import Disc, Mode, Pose, Prior, wrap_deg

SLACK_M: Final = 8.0  # beyond the disc of the prior: a pose moves when it is fitted to more objects

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def rigid_poses(seen_m: Floats, mapped_m: Floats) -> Floats:
    """Return the poses that lay seen places on mapped ones, pattern by pattern, with least squares.

    Parameters
    ----------
    seen_m, mapped_m : ndarray of float, shape (V, N, 2)
        V patterns of N places: (right, up) of the view, easting and northing, metres.

    Returns
    -------
    ndarray of float, shape (V, 3)
        Easting and northing, metres, and heading, degrees in [0, 360).

    Examples
    --------
    Two corners of a street, seen by a view that heads east:

    >>> seen_m = np.array([[[0.0, 0.0], [0.0, 40.0]]])
    >>> mapped_m = np.array([[[100.0, 200.0], [140.0, 200.0]]])
    >>> rigid_poses(seen_m, mapped_m).round(6).tolist()
    [[100.0, 200.0, 90.0]]
    """
    mine, theirs = (places[..., 0] + 1j * places[..., 1] for places in (seen_m, mapped_m))
    here, there = mine.mean(axis=1), theirs.mean(axis=1)
    turn = (np.conj(mine - here[:, None]) * (theirs - there[:, None])).sum(axis=1)
    yaw = -np.angle(turn)  # clockwise
    middle = there - here * np.exp(-1j * yaw)
    return np.column_stack([middle.real, middle.imag, np.mod(np.degrees(yaw), 360.0)])


def allowed(poses: Floats, prior: Prior, disc: Disc) -> Bools:
    """Return which poses, shape (V, 3), lie in a disc and head within three standard deviations of the prior."""
    fits = disc.wider(SLACK_M).holds(poses[:, :2])
    if prior.yaw_deg is not None and prior.yaw_sigma_deg is not None:
        # 3: standard deviations of the prior's heading
        fits = fits & (np.abs(wrap_deg(poses[:, 2] - prior.yaw_deg)) <= 3.0 * prior.yaw_sigma_deg)
    return np.asarray(fits)


def pose_of(row: Floats) -> Pose:
    """Return a row of `rigid_poses` as a pose."""
    return Pose(easting_m=float(row[0]), northing_m=float(row[1]), yaw_deg=float(row[2]))


@dataclass(frozen=True, kw_only=True)
class Crowd:
    """Poses that agree: the one that they agree on, with the sum of their weights, and their rows."""

    mode: Mode
    rows: Ints


@dataclass(frozen=True, kw_only=True)
class Votes:
    """Poses with weights: `poses`, shape (V, 3), as of `rigid_poses`; `weight`, shape (V,)."""

    poses: Floats
    weight: Floats

    @classmethod
    def of(cls, poses: Floats, weight: Floats) -> Self:
        """Keep the heaviest poses, if there are too many; of equal ones the first."""
        # 30_000 poses whose neighbours are counted: bounds the time
        kept = np.sort(np.argsort(-weight, kind="stable")[:30_000])
        return cls(poses=poses[kept], weight=weight[kept])

    def crowds(self, *, count: int) -> list[Crowd]:
        """Return up to `count` crowds, the heaviest first, no two of which agree.

        Examples
        --------
        Two of three poses agree:

        >>> poses = np.array([[0.0, 0.0, 359.0], [90.0, 0.0, 10.0], [2.0, 0.0, 1.0]])
        >>> crowd = Votes.of(poses, np.ones(3)).crowds(count=1)[0]
        >>> crowd.rows.tolist(), crowd.mode.score, round(crowd.mode.pose.easting_m, 6)
        ([0, 2], 2.0, 1.0)
        """
        if not len(self.poses):
            return []
        yaw = np.radians(self.poses[:, 2:])
        ahead = np.hstack([np.cos(yaw), np.sin(yaw)]) / np.radians(8.0)  # turned by 8 degrees
        # Two poses no longer agree that are 12 m apart, or
        at = np.hstack([self.poses[:, :2] / 12.0, ahead])  # poses that agree lie within 1
        tree = cKDTree(at)
        lists = tree.query_ball_point(at, 1.0)
        starts = np.cumsum([0, *(len(rows) for rows in lists[:-1])])
        total = np.add.reduceat(self.weight[np.concatenate(lists).astype(np.int64)], starts)
        total = total.round(9)  # equal sums of unequal order tie
        kept: list[Crowd] = []
        middles: list[Floats] = []
        # 8: crowded poses for each that is asked for: neighbours of one crowd are dropped
        for first in np.argsort(-total, kind="stable")[: 8 * count].tolist():
            if all(np.linalg.norm(at[first] - other) > 1.0 for other in middles):
                rows = np.array(sorted(lists[first]), dtype=np.int64)
                # Mean of poses, with a score
                weight = self.weight[rows]
                east_m, north_m = weight @ self.poses[rows, :2] / weight.sum()
                turn = complex(weight @ np.exp(1j * np.radians(self.poses[rows, 2])))
                yaw_deg = float(np.degrees(np.angle(turn)))
                pose = Pose(easting_m=float(east_m), northing_m=float(north_m), yaw_deg=yaw_deg)
                kept.append(Crowd(mode=Mode(pose=pose, score=float(total[first])), rows=rows))
                middles.append(at[first])
        return kept[:count]
