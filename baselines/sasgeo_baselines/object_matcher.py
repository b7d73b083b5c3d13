# SPDX-License-Identifier: Apache-2.0
"""Base of matchers of objects: nodes of view and map, and poses that many pairs of like objects vote for."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.place_matcher import SPREAD, PlaceMatcher
from sasgeo_baselines.pose_votes import allowed
from sasgeo_bench import (
    NODE_KINDS,
    Disc,
    MappedGraph,
    Mode,
    Nodes,
    ObservedGraph,
    Pose,
    Prior,
    Query,
    Region,
    rotation,
    thinned,
    turns_of,
)

FEWEST: Final = 3  # objects of a view that differ from chance
CELL_M: Final = 8.0  # of votes
PEAKS_APART_M: Final = 25.0  # neighbouring cells and headings of one place are one peak
# Ends of roads are gaps of perception more often than ends; bends of rivers lie nowhere in particular.
LEFT_OUT: Final = tuple(at for at, kind in enumerate(NODE_KINDS) if kind.name.endswith(("dead_end", "river_bend")))
_WINDOW: Final = 3  # cells a side that vote together
_EACH: Final = 24  # peaks of a heading, before neighbours are left out

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """Objects of a view, (right, up) of its middle, and what is known of its heading."""

    nodes: Nodes
    prior: Prior

    @property
    def reach_m(self) -> float:
        """Return how far the farthest object lies from the middle."""
        return float(np.hypot(*self.nodes.places_m.T).max(initial=0.0))

    def yaws_deg(self, step_deg: float) -> list[float]:
        """Return headings to try, at most a step apart."""
        turns = turns_of(self.prior, spread=SPREAD, step=float(np.radians(step_deg)))
        found = [base.yaw_deg + 90.0 * quarter for base in turns.bases for quarter in range(turns.quarters)]
        return sorted({round(yaw_deg % 360.0, 6) for yaw_deg in found})

    def allows(self, pose: Pose, disc: Disc) -> bool:
        """Return whether a fitted pose lies in a disc, and heads within three standard deviations of the prior."""
        return bool(allowed(np.array([[pose.easting_m, pose.northing_m, pose.yaw_deg]]), self.prior, disc)[0])


class ObjectMatcher(PlaceMatcher[PreparedView]):
    """A matcher of objects: buildings, patches of ground, junctions and crossings, as the scorer's graph has them."""

    def read(self, region: Region, learned: str | None) -> None:
        """Read the nodes of the map."""
        del learned
        self.mapped = MappedGraph.of(region)

    def look(self, query: Query) -> PreparedView | None:
        """Return the whole objects of a view; None if they are fewer than three."""
        seen = ObservedGraph.of(query)
        nodes = seen.nodes.taken(~seen.is_cut & ~np.isin(seen.nodes.kind, LEFT_OUT))
        return PreparedView(nodes=nodes, prior=query.prior) if len(nodes) >= FEWEST else None

    def within(self, view: PreparedView, disc: Disc) -> Ints:
        """Return rows of the nodes of the map that a view from a disc may show."""
        if disc.center_m is None:
            return np.arange(len(self.mapped.nodes))
        return self.mapped.around(np.array(disc.center_m), disc.radius_m + view.reach_m)


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Pairs of a seen and a mapped object that may be the same: places of both, shape (P, 2), and weights, shape (P,).

    `seen` and `mapped` are rows of the nodes of the view and of the map.
    """

    seen: Ints
    mapped: Ints
    seen_m: Floats
    mapped_m: Floats
    weight: Floats

    @classmethod
    def of_kind(cls, view: PreparedView, nodes: Nodes, rows: Ints) -> "Pairs":
        """Pair objects of one kind; a kind that is rare among the rows weighs more: by the logarithm of its share."""
        mine, theirs = view.nodes.kind, nodes.kind[rows]
        counts = np.bincount(theirs, minlength=int(max(mine.max(initial=0), theirs.max(initial=0))) + 1)
        seen, at = np.nonzero(mine[:, None] == theirs[None, :])
        weight = np.log1p(len(rows) / np.maximum(counts[mine[seen]], 1))
        return cls(
            seen=seen,
            mapped=rows[at],
            seen_m=view.nodes.places_m[seen],
            mapped_m=nodes.places_m[rows[at]],
            weight=weight,
        )

    def places_m(self, yaw_deg: float) -> Floats:
        """Return where the view would lie, by each pair alone, if it headed so, shape (P, 2)."""
        return np.asarray(self.mapped_m - self.seen_m @ rotation(yaw_deg).T)

    def peaks(self, disc: Disc, yaws_deg: list[float], *, count: int) -> list[Mode]:
        """Return up to `count` poses that most pairs vote for, best first, `PEAKS_APART_M` from each other."""
        found = [mode for yaw_deg in yaws_deg for mode in self._peaks(disc, yaw_deg)]
        return thinned(sorted(found, key=lambda mode: -mode.score), PEAKS_APART_M, count)

    def _peaks(self, disc: Disc, yaw_deg: float) -> Iterator[Mode]:
        places_m = self.places_m(yaw_deg)
        inside = disc.wider(CELL_M).holds(places_m)
        if not inside.any():
            return
        places_m, weight = places_m[inside], self.weight[inside]
        corner_m = places_m.min(axis=0)
        cells = ((places_m - corner_m) / CELL_M).astype(np.int64)
        cols, rows = (cells.max(axis=0) + 1).tolist()
        votes = np.bincount(cells[:, 1] * cols + cells[:, 0], weights=weight, minlength=rows * cols)
        total = cv2.boxFilter(
            votes.reshape(rows, cols), -1, (_WINDOW, _WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT
        ).ravel()
        best = np.argpartition(-total, min(_EACH, len(total) - 1))[:_EACH]
        for at in sorted(best.tolist(), key=lambda at: (-total[at], at)):
            near = (np.abs(cells - (at % cols, at // cols)) <= _WINDOW // 2).all(axis=1)
            if near.any():  # the filter leaves more than nothing where there is none
                middle_m = np.average(places_m[near], axis=0, weights=weight[near])
                pose = Pose(easting_m=float(middle_m[0]), northing_m=float(middle_m[1]), yaw_deg=yaw_deg)
                yield Mode(pose=pose, score=float(total[at]))


def fitted(seen_m: Floats, mapped_m: Floats, weight: Floats | None = None) -> tuple[Pose, float]:
    """Return the rigid pose that lays seen places on mapped ones, shape (N, 2), and the error left (rms, metres).

    Least squares in closed form (Umeyama 1991, without scale).

    >>> here = Pose(easting_m=10.0, northing_m=20.0, yaw_deg=30.0)
    >>> seen_m = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 40.0]])
    >>> pose, error_m = fitted(seen_m, here.to_map(seen_m))
    >>> round(pose.easting_m, 6), round(pose.northing_m, 6), round(pose.yaw_deg, 6), round(error_m, 6)
    (10.0, 20.0, 30.0, 0.0)
    """
    share = np.full(len(seen_m), 1.0 / len(seen_m)) if weight is None else weight / weight.sum()
    mine, theirs = share @ seen_m, share @ mapped_m
    one, other = seen_m - mine, mapped_m - theirs
    dot = share @ (one * other).sum(axis=1)
    cross = share @ (one[:, 1] * other[:, 0] - one[:, 0] * other[:, 1])  # yaw turns clockwise
    yaw_deg = float(np.degrees(np.arctan2(cross, dot)))
    middle_m = theirs - rotation(yaw_deg) @ mine
    pose = Pose(easting_m=float(middle_m[0]), northing_m=float(middle_m[1]), yaw_deg=yaw_deg)
    left_m = np.square(pose.to_map(seen_m) - mapped_m).sum(axis=1)
    return pose, float(np.sqrt(share @ left_m))
