# SPDX-License-Identifier: Apache-2.0
"""`ouyang_cfbvm_pf`: coarse-to-fine matching of buildings gives a mixture that weighs particles (Ouyang)."""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import KDTree

import sasgeo_bench as sgb
from sasgeo_baselines.buildings import RADIUS_M, Buildings, Windows, ring_shares
from sasgeo_baselines.trackers.particles import Floats, Noise, ParticleFilter, Particles

WINDOWS: Final = 50  # most like the view by their rings
REACH_M: Final = RADIUS_M + 24.0  # around the middle of a window
CORRELATION: Final = 0.9  # of two shapes that may be the same building
BANDWIDTH_M: Final = 12.0  # of votes
YAW_STEP_DEG: Final = 8.0  # between headings that are tried where the heading is not known
CERTAIN_DEG: Final = 4.0  # standard deviation of a heading that counts as known
LEAST_SIGMA_M: Final = 8.0  # of a component of the mixture: that of footprints, their middles and the scale
COMPONENTS: Final = 10
# Likelihood of any other place, where a perfect vote adds 1. `benchmarks/fit_particle_filters.py --floors` tries 1 to
# 0.01 on made-up towns: 0.03 and 0.01 keep most views within 25 m, 0.83 of 1,126, and the larger trusts votes less.
FLOOR: Final = 0.03
MOST_VOTES: Final = 1000
COUNT: Final = 20_000
FEWEST: Final = 1_000
CREDIBLE: Final = 0.6
HELD: Final = 3  # updates
CLUSTER_M: Final = 30.0
MEMBERS: Final = 20

# What the numbers of a shape are divided by: about twice the difference that a detector makes between two views of one
# building. By their spread over a map, they would mean most in a town where all houses are alike.
SCALES: Final = np.array([0.4, 0.3, 0.3, 0.6, 0.3, 0.3, 0.2, 0.2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixture:
    """Places that votes agree on: `place_m`, shape (K, 2); `yaw_deg`, `sigma_m` and `height`, shape (K,)."""

    place_m: Floats
    yaw_deg: Floats
    sigma_m: Floats
    height: Floats

    def at(self, particles: Particles) -> Floats:
        """Return the sum of the components at each particle, shape (N,)."""
        total = np.zeros(len(particles))
        for place_m, yaw_deg, sigma_m, height in zip(
            self.place_m, self.yaw_deg, self.sigma_m, self.height, strict=True
        ):
            away = np.square(particles.place_m - place_m).sum(axis=1) / sigma_m**2
            turn = np.mod(particles.yaw_deg - yaw_deg + 180.0, 360.0) - 180.0
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
            for mine in np.flatnonzero(is_mutual & (part.max(axis=1) > CORRELATION)).tolist():
                other = int(place[best[mine]])
                at_m = mapped.middle_m[chosen[other]] - turned_m[mine]
                found[mine, other, yaw_deg] = (*at_m.tolist(), yaw_deg, float(mine), float(likeness[mine, other]))
    return np.array(list(found.values())).reshape(-1, 5)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


def mixture_of(votes: Floats) -> Mixture:
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
        [votes[:, :2] / BANDWIDTH_M, np.stack([np.sin(turn), np.cos(turn)], axis=1) / np.radians(1.5 * YAW_STEP_DEG)]
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
        rows.append((*place_m.tolist(), float(yaw), max(float(spread_m), LEAST_SIGMA_M), float(height)))
    best = np.array(sorted(rows, key=lambda row: -row[4])[:COMPONENTS]).reshape(-1, 5)
    return Mixture(place_m=best[:, :2], yaw_deg=best[:, 2], sigma_m=best[:, 3], height=best[:, 4])


class OuyangCfbvmPf(ParticleFilter):
    """Rings of building area, votes of shapes, a mixture as likelihood, and fixes that are credible."""

    card = sgb.MatcherCard(
        name="ouyang_cfbvm_pf",
        version="1",
        title="Coarse-to-fine building matching and a particle filter",
        source="Ouyang et al., Defence Technology 34(4), 2024: its abstract, and a public account of the coarse stage",
        ours=(
            "The source's: windows of a vector map by the building area in six rings, shapes of buildings matched in "
            "them, votes for a translation, a Gaussian mixture as likelihood, fewer particles as they gather, an "
            "indicator of credibility that suppresses fixes. Ours, since the abstract does not say: 50 windows by "
            "z-scores, at places 24 m apart within 2.5 spreads of the particles; eight numbers of a shape; mutual best "
            "pairs with a correlation above 0.9; mean shift of 12 m; heights of votes x correlation over a floor of "
            "0.03; 20,000 to 1,000 particles; credibility = mass of the heaviest cluster x (1 - spread / spread at the "
            "start), above 0.6 for 3 views. Buildings are patches of the raster on both sides; headings 8 degrees "
            "apart are tried within two standard deviations of the particles, where the source has a compass"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "Blind where no whole building is in a view; errors of a detector change shapes, so that a right pair "
            "seldom correlates above 0.9; houses that are alike vote for each other's places, and where all are, as "
            "in a planned quarter, it finds nothing; with an unknown heading it tries 45"
        ),
    )
    count = COUNT
    noise = Noise(place_m=3.3)

    def __init__(self, *, floor: float = FLOOR) -> None:
        super().__init__()
        self.floor = floor
        self._held: deque[bool] = deque(maxlen=HELD)

    def read(self, region: sgb.Region) -> None:
        """Index buildings and windows."""
        self._windows, self._buildings = Windows.of(region), Buildings.of_map(region)
        self._tree = KDTree(self._buildings.middle_m) if len(self._buildings) else None
        self._mean = self._buildings.shape.mean(axis=0) if len(self._buildings) else np.zeros(len(SCALES))
        self._bounds_m = region.grid.bounds_m

    def start(self, prior: sgb.Prior) -> None:
        """Begin a flight."""
        super().start(prior)
        self._held.clear()

    def likelihood(self, particles: Particles, query: sgb.Query) -> Floats:
        """Return the mixture and its floor, 0 beyond the map."""
        west_m, south_m, east_m, north_m = self._bounds_m
        is_inside = ((particles.place_m >= (west_m, south_m)) & (particles.place_m <= (east_m, north_m))).all(axis=1)
        votes = self._votes(particles, query.evidence)
        found = mixture_of(votes).at(particles) if len(votes) else 0.0
        return np.asarray(np.where(is_inside, self.floor + found, 0.0))

    def _votes(self, particles: Particles, evidence: sgb.Evidence) -> Floats:
        seen, share = Buildings.of_view(evidence), ring_shares(evidence)
        if self._tree is None or len(seen) == 0 or np.isnan(share).all():
            return np.empty((0, 5))
        pose = particles.mean
        middles_m = self._windows.nearest(
            share,
            count=WINDOWS,
            place_m=(pose.easting_m, pose.northing_m),
            radius_m=2.5 * particles.spread_m + 2 * REACH_M,
        )
        found = self._tree.query_ball_point(middles_m, REACH_M)
        windows = [list(window) for window in np.atleast_1d(np.asarray(found, dtype=object)) if window]
        if not windows:
            return np.empty((0, 5))
        yaws_deg = headings(pose.yaw_deg, float(np.sqrt(particles.covariance[2, 2])))
        return votes_for(seen, self._buildings, windows, mean=self._mean, yaws_deg=yaws_deg)

    def estimate(self, particles: Particles) -> sgb.Fix:
        """Return the mean of the heaviest cluster; accepted where it has been credible for some views."""
        cluster = particles.heaviest_cluster(reach_m=CLUSTER_M, least=MEMBERS)
        chosen = particles.within(cluster.members)
        remaining = particles.spread_m / max(self.start_spread_m, 1.0)
        credibility = cluster.mass * max(0.0, 1.0 - remaining)
        self._held.append(credibility >= CREDIBLE)
        return sgb.Fix(
            pose=chosen.mean,
            covariance=chosen.covariance,
            is_accepted=len(self._held) == HELD and all(self._held),
            confidence=particles.share_near(chosen.mean),
            diagnostics={"credibility": credibility, "spread_m": particles.spread_m, "particles": len(particles)},
        )

    def settled(self, particles: Particles, *, rng: np.random.Generator) -> Particles:
        """Resample where half of the particles are effective: as many as their spread asks for."""
        if particles.effective_count >= len(particles) / 2:
            return particles
        count = round(COUNT * min(1.0, particles.spread_m / max(self.start_spread_m, 1.0)))
        return particles.resampled(min(max(count, FEWEST), self.count), rng=rng)


def headings(yaw_deg: float, sigma_deg: float) -> Floats:
    """Return headings to try, 8 degrees apart within two standard deviations; all around where nothing is known.

    >>> headings(10.0, 2.0).tolist(), headings(10.0, 6.0).tolist(), len(headings(0.0, 104.0))
    ([10.0], [2.0, 10.0, 18.0], 45)
    """
    if sigma_deg <= CERTAIN_DEG:
        return np.array([yaw_deg])
    steps, every = int(2 * sigma_deg / YAW_STEP_DEG), round(360.0 / YAW_STEP_DEG)
    turns = np.arange(every) if 2 * steps + 1 >= every else np.arange(-steps, steps + 1)
    return np.asarray(yaw_deg + turns * YAW_STEP_DEG, dtype=np.float64)
