# SPDX-License-Identifier: Apache-2.0
"""Votes of alike buildings for the place of a view, and the Gaussian mixture that they make (after Ouyang)."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from scipy.spatial import KDTree

import sasgeo_bench as sgb
from sasgeo_baselines.buildings import RADIUS_M, Buildings, Floats, Windows, ring_shares

REACH_M: Final = RADIUS_M + 24.0  # around the middle of a window
YAW_STEP_DEG: Final = 8.0  # between headings that are tried where the heading is not known
COMPONENTS: Final = 10
MOST_VOTES: Final = 1000

# What the numbers of a shape are divided by: about twice the difference that a detector makes between two views of one
# building. By their spread over a map, they would mean most in a town where all houses are alike.
SCALES: Final = np.array([0.4, 0.3, 0.3, 0.6, 0.3, 0.3, 0.2, 0.2])


@dataclass(frozen=True, kw_only=True)
class Town:
    """Buildings of a map, and windows of it by the building area in rings; `mean` is that of the shapes."""

    windows: Windows
    buildings: Buildings
    tree: KDTree | None
    mean: Floats

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Index buildings and windows of a map."""
        windows, buildings = Windows.of(region), Buildings.of_map(region)
        is_built = len(buildings) > 0
        return cls(
            windows=windows,
            buildings=buildings,
            tree=KDTree(buildings.middle_m) if is_built else None,
            mean=buildings.shape.mean(axis=0) if is_built else np.zeros(len(SCALES)),
        )

    # The 50 that are most like the view by their rings
    def votes(self, seen: "Seen", disc: sgb.Disc, *, yaws_deg: Floats, count: int = 50) -> Floats:
        """Return votes of the `count` windows in a disc that are most like a view, as `votes_for`."""
        if self.tree is None or not seen.is_judged:
            return np.empty((0, 5))
        place_m = disc.center_m or (0.0, 0.0)
        radius_m = np.inf if disc.center_m is None else disc.radius_m
        middles_m = self.windows.nearest(seen.share, count=count, place_m=place_m, radius_m=radius_m)
        found = self.tree.query_ball_point(middles_m, REACH_M)
        windows = [list(window) for window in np.atleast_1d(np.asarray(found, dtype=object)) if window]
        if not windows:
            return np.empty((0, 5))
        return votes_for(seen.buildings, self.buildings, windows, mean=self.mean, yaws_deg=yaws_deg)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Buildings of a view, and the share of building area in each of its rings, NaN where too little is known."""

    buildings: Buildings
    share: Floats

    @classmethod
    def of(cls, evidence: sgb.Evidence) -> Self:
        """Measure a view."""
        return cls(buildings=Buildings.of_view(evidence), share=ring_shares(evidence))

    @property
    def is_judged(self) -> bool:
        """Return whether there is a whole building, and a ring to find windows by."""
        return len(self.buildings) > 0 and not bool(np.isnan(self.share).all())


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixture:
    """Places that votes agree on: `place_m`, shape (K, 2); `yaw_deg`, `sigma_m` and `height`, shape (K,)."""

    place_m: Floats
    yaw_deg: Floats
    sigma_m: Floats
    height: Floats

    def at(self, places_m: Floats, yaws_deg: Floats) -> Floats:
        """Return the sum of the components at poses, places of shape (N, 2) and headings of shape (N,)."""
        total = np.zeros(len(places_m))
        for place_m, yaw_deg, sigma_m, height in zip(
            self.place_m, self.yaw_deg, self.sigma_m, self.height, strict=True
        ):
            away = np.square(places_m - place_m).sum(axis=1) / sigma_m**2
            turn = np.mod(yaws_deg - yaw_deg + 180.0, 360.0) - 180.0
            total += height * np.exp(-0.5 * (away + np.square(turn / YAW_STEP_DEG)))
        return total


def votes_for(
    seen: Buildings, mapped: Buildings, windows: list[list[int]], *, mean: Floats, yaws_deg: Floats
) -> Floats:
    """Return votes, shape (V, 5): easting, northing and heading of the view, the seen building, and the correlation.

    Two buildings vote if each is most like the other among those of a window, and their shapes correlate.
    """
    found = {}
    chosen = np.array(sorted({number for window in windows for number in window}), dtype=np.int64)
    places = [np.searchsorted(chosen, window) for window in windows]
    theirs = _unit((mapped.shape[chosen] - mean) / SCALES)
    for yaw_deg in yaws_deg.tolist():
        likeness = _unit((seen.turned(yaw_deg) - mean) / SCALES) @ theirs.T
        turned_m = sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg).to_map(seen.middle_m)
        for place in places:
            part = likeness[:, place]
            best = part.argmax(axis=1)
            is_mutual = part.argmax(axis=0)[best] == np.arange(len(seen))
            # 0.9: correlation of two shapes that may be the same building
            for mine in np.flatnonzero(is_mutual & (part.max(axis=1) > 0.9)).tolist():
                other = int(place[best[mine]])
                at_m = mapped.middle_m[chosen[other]] - turned_m[mine]
                found[mine, other, yaw_deg] = (*at_m.tolist(), yaw_deg, float(mine), float(likeness[mine, other]))
    return np.array(list(found.values())).reshape(-1, 5)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


def mixture_of(votes: Floats, *, bandwidth_m: float = 12.0) -> Mixture:  # of votes
    """Return the places where votes agree, by mean shift with a flat kernel; a seen building counts once at each.

    The height of a component is the number of its votes times their mean correlation; its width is their spread.

    >>> votes = np.array([[0.0, 0.0, 10.0, 0, 1.0], [6.0, 0.0, 10.0, 1, 0.9], [90.0, 0.0, 10.0, 1, 0.95]])
    >>> found = mixture_of(votes)
    >>> found.place_m.tolist(), found.height.round(2).tolist()
    ([[3.0, 0.0], [90.0, 0.0]], [1.9, 0.95])
    """
    votes = votes[np.argsort(-votes[:, 4], kind="stable")[:MOST_VOTES]]
    turn = np.radians(votes[:, 2])
    points = np.column_stack(  # headings on a circle, so that neighbours are at most a kernel apart
        [votes[:, :2] / bandwidth_m, np.stack([np.sin(turn), np.cos(turn)], axis=1) / np.radians(1.5 * YAW_STEP_DEG)]
    )
    tree, at = KDTree(points), points.copy()
    for _ in range(5):
        members = tree.query_ball_point(at, 1.0)
        at = np.array([points[near].mean(axis=0) if near else here for near, here in zip(members, at, strict=True)])
    rows: list[tuple[float, ...]] = []
    taken = np.zeros(len(votes), dtype=bool)
    counts = [
        (len(set(votes[near, 3].tolist())), -number) for number, near in enumerate(tree.query_ball_point(at, 1.0))
    ]
    for _, number in sorted(counts, reverse=True):
        near = np.array(tree.query_ball_point(at[-number], 1.0), dtype=np.int64)
        near = near[~taken[near]]
        if taken[-number] or len(near) == 0:
            continue
        taken[near] = True
        own = votes[near]
        place_m = own[:, :2].mean(axis=0)
        spread_m = np.sqrt(np.square(own[:, :2] - place_m).sum(axis=1).mean() / 2)
        yaw = np.degrees(np.arctan2(np.sin(np.radians(own[:, 2])).mean(), np.cos(np.radians(own[:, 2])).mean()))
        height = len(set(own[:, 3].tolist())) * own[:, 4].mean()
        # 8 m: least sigma of a component of the mixture: that of footprints, their middles and the scale
        rows.append((*place_m.tolist(), float(yaw), max(float(spread_m), 8.0), float(height)))
    best = np.array(sorted(rows, key=lambda row: -row[4])[:COMPONENTS]).reshape(-1, 5)
    return Mixture(place_m=best[:, :2], yaw_deg=best[:, 2], sigma_m=best[:, 3], height=best[:, 4])


def headings(yaw_deg: float, sigma_deg: float) -> Floats:
    """Return headings to try, 8 degrees apart within 2.5 standard deviations; all around where nothing is known.

    >>> headings(10.0, 2.0).tolist(), headings(10.0, 6.0).tolist(), len(headings(0.0, 104.0))
    ([10.0], [2.0, 10.0, 18.0], 45)
    """
    if sigma_deg <= 4.0:  # degrees: standard deviation of a heading that counts as known
        return np.array([yaw_deg])
    steps, every = int(2 * sigma_deg / YAW_STEP_DEG), round(360.0 / YAW_STEP_DEG)
    turns = np.arange(every) if 2 * steps + 1 >= every else np.arange(-steps, steps + 1)
    return np.asarray(yaw_deg + turns * YAW_STEP_DEG, dtype=np.float64)
