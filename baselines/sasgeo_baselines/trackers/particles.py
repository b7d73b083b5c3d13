# SPDX-License-Identifier: Apache-2.0
"""Particles on a map: drawn from a prior, moved by odometry, weighed, resampled, and summed up as a fix."""

import hashlib
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

import sasgeo_bench as sgb

Floats = NDArray[np.float64]

NEAR_M: Final = 25.0  # the confidence of a fix is the weight of particles so near to it
LOST_M: Final = 1000.0  # standard deviations of what is added where the odometer lost its way
LOST_DEG: Final = 90.0
TRAINED_ON: Final = ("six made-up towns that are in no split (benchmarks/fit_particle_filters.py)",)
_FLOOR: Final = np.diag([1.0, 1.0, 0.25])  # m2, m2, deg2: added to a covariance, which equal particles would make 0
_FULL_TURN: Final = 360.0
_SCALES: Final = (0.5, 2.0)
_MOST_CELLS: Final = 2048  # a side, of the lattice on which clusters are found


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Standard deviations of what a source adds to each particle at each step, on top of the odometer's covariance.

    Metres on each axis, degrees of heading, and a fraction of the scale.
    """

    place_m: float = 0.0
    yaw_deg: float = 0.0
    scale: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Cluster:
    """The heaviest cluster: its members, shape (N,), their weight together, and how many clusters there are."""

    members: NDArray[np.bool_]
    mass: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Particles:
    """N weighted poses; weights sum to 1.

    Parameters
    ----------
    place_m : ndarray of float64, shape (N, 2)
        Easting and northing.
    yaw_deg, scale, weight : ndarray of float64, shape (N,)
        Heading, clockwise from grid north, not reduced to a full turn; residual scale of the view; weight.
    """

    place_m: Floats
    yaw_deg: Floats
    scale: Floats
    weight: Floats

    def __len__(self) -> int:
        return len(self.weight)

    @classmethod
    def drawn(cls, prior: sgb.Prior, grid: sgb.Grid, *, count: int, rng: np.random.Generator) -> Self:
        """Draw particles evenly over the disc of a prior, or the map if it has none; heading and scale as it says."""
        chance = rng.random((count, 2))
        if prior.radius_m is not None:
            away_m, bearing = prior.radius_m * np.sqrt(chance[:, 0]), 2 * np.pi * chance[:, 1]
            offset_m = away_m[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
            place_m = np.asarray(sgb.middle_m(prior, grid)) + offset_m
        else:
            west_m, south_m, east_m, north_m = grid.bounds_m
            place_m = np.array([west_m, south_m]) + chance * np.array([east_m - west_m, north_m - south_m])
        if prior.yaw_deg is None or prior.yaw_sigma_deg is None:
            yaw_deg = _FULL_TURN * rng.random(count)
        else:
            yaw_deg = prior.yaw_deg + prior.yaw_sigma_deg * rng.standard_normal(count)
        scale = np.clip(1.0 + prior.scale_sigma * rng.standard_normal(count), *_SCALES)
        return cls(place_m=place_m, yaw_deg=yaw_deg, scale=scale, weight=np.full(count, 1.0 / count))

    def moved(
        self,
        increment: tuple[float, float, float] | None,
        covariance: tuple[float, ...] | None,
        *,
        noise: Noise,
        rng: np.random.Generator,
    ) -> Self:
        """Move each particle by an increment (right and up in metres, turn in degrees) in its own axes, with noise.

        `covariance` is that of the increment, 3 x 3 row by row. None stands for an odometer that lost its way: the
        particles stay on average, and spread by 1 km and 90 degrees.

        >>> east = Particles(place_m=np.zeros((1, 2)), yaw_deg=np.array([90.0]), scale=np.ones(1), weight=np.ones(1))
        >>> moved = east.moved((0.0, 50.0, 10.0), (0.0,) * 9, noise=Noise(), rng=np.random.default_rng(0))
        >>> moved.place_m.round(6).tolist(), moved.yaw_deg.tolist()
        ([[50.0, 0.0]], [100.0])
        """
        own = np.diag(np.square([noise.place_m, noise.place_m, noise.yaw_deg]))
        if increment is None or covariance is None:
            mean, spread = np.zeros(3), own + np.diag(np.square([LOST_M, LOST_M, LOST_DEG]))
        else:
            mean, spread = np.array(increment), own + np.reshape(covariance, (3, 3))
        values, vectors = np.linalg.eigh((spread + spread.T) / 2)  # a covariance of a perfect odometer has no Cholesky
        shift = mean + rng.standard_normal((len(self), 3)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        sine, cosine = np.sin(np.radians(self.yaw_deg)), np.cos(np.radians(self.yaw_deg))
        east_m, north_m = cosine * shift[:, 0] + sine * shift[:, 1], cosine * shift[:, 1] - sine * shift[:, 0]
        scale = np.clip(self.scale * (1.0 + noise.scale * rng.standard_normal(len(self))), *_SCALES)
        return replace(
            self,
            place_m=self.place_m + np.stack([east_m, north_m], axis=1),
            yaw_deg=self.yaw_deg + shift[:, 2],
            scale=scale,
        )

    def weighed(self, likelihood: Floats) -> Self:
        """Multiply the weights by a likelihood, shape (N,), up to a factor; unchanged where all of it is 0."""
        weight = self.weight * likelihood
        total = float(weight.sum())
        return replace(self, weight=weight / total) if total > 0 and math.isfinite(total) else self

    @property
    def effective_count(self) -> float:
        """Return the effective number of particles, 1 / sum of squared weights.

        >>> some = Particles(place_m=np.zeros((4, 2)), yaw_deg=np.zeros(4), scale=np.ones(4), weight=np.ones(4) / 4)
        >>> some.effective_count, some.weighed(np.array([1.0, 1.0, 0.0, 0.0])).effective_count
        (4.0, 2.0)
        """
        return float(1.0 / np.square(self.weight).sum())

    def resampled(self, count: int, *, rng: np.random.Generator) -> Self:
        """Draw `count` particles of equal weight by systematic resampling.

        Each particle is drawn `count` times its weight, rounded up or down; on average exactly so.
        """
        edges = np.cumsum(self.weight)
        at = np.searchsorted(edges / edges[-1], (rng.random() + np.arange(count)) / count, side="right")
        return self.chosen(np.minimum(at, len(self) - 1))

    def resampled_multinomial(self, count: int, *, rng: np.random.Generator) -> Self:
        """Draw `count` particles of equal weight by multinomial resampling."""
        edges = np.cumsum(self.weight)
        at = np.searchsorted(edges / edges[-1], np.sort(rng.random(count)), side="right")
        return self.chosen(np.minimum(at, len(self) - 1))

    def chosen(self, at: NDArray[np.int64]) -> Self:
        """Return the particles at some indices, with equal weights."""
        weight = np.full(len(at), 1.0 / len(at))
        return replace(self, place_m=self.place_m[at], yaw_deg=self.yaw_deg[at], scale=self.scale[at], weight=weight)

    def within(self, members: NDArray[np.bool_]) -> Self:
        """Return some of the particles, of which at least one has weight; the weights are made to sum to 1."""
        weight = self.weight[members]
        return replace(
            self,
            place_m=self.place_m[members],
            yaw_deg=self.yaw_deg[members],
            scale=self.scale[members],
            weight=weight / weight.sum(),
        )

    @property
    def mean(self) -> sgb.Pose:
        """Return the weighted mean; headings are averaged on the circle.

        >>> both = np.array([[0.0, 0.0], [4.0, 0.0]])
        >>> some = Particles(place_m=both, yaw_deg=np.array([350.0, 20.0]), scale=np.ones(2), weight=np.ones(2) / 2)
        >>> some.mean.easting_m, round(some.mean.yaw_deg, 6)
        (2.0, 5.0)
        """
        east_m, north_m = (self.weight @ self.place_m).tolist()
        turn = np.radians(self.yaw_deg)
        yaw_deg = math.degrees(math.atan2(self.weight @ np.sin(turn), self.weight @ np.cos(turn)))
        scale = float(self.weight @ self.scale)
        return sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg, scale=scale)

    @property
    def covariance(self) -> Floats:
        """Return the weighted covariance of east, north and yaw, shape (3, 3); m2, m deg, deg2.

        It is a little larger than that of the particles (1 m, 0.5 degrees), and so never singular.
        """
        middle = self.mean
        turn = np.mod(self.yaw_deg - middle.yaw_deg + _FULL_TURN / 2, _FULL_TURN) - _FULL_TURN / 2
        away = np.column_stack([self.place_m - (middle.easting_m, middle.northing_m), turn])
        return np.asarray((away * self.weight[:, None]).T @ away + _FLOOR)

    @property
    def spread_m(self) -> float:
        """Return the weighted root mean square distance from the mean place, metres."""
        away_m = self.place_m - self.weight @ self.place_m
        return math.sqrt(float(self.weight @ np.square(away_m).sum(axis=1)))

    def share_near(self, pose: sgb.Pose, *, reach_m: float = NEAR_M) -> float:
        """Return the weight of the particles at most so far from a pose."""
        away_m = sgb.offsets_m(self.place_m, (pose.easting_m, pose.northing_m))
        return float(min(1.0, self.weight[away_m <= reach_m].sum()))

    def heaviest_cluster(self, *, reach_m: float, least: int) -> Cluster:
        """Return the heaviest of the clusters of particles: squares of `reach_m` with `least` particles that touch.

        Where no square holds so many, all particles are one cluster. Density on a lattice stands for DBSCAN, whose
        neighbourhoods of 20,000 particles on one spot would not fit into memory.
        """
        low_m = self.place_m.min(axis=0)
        side_m = max(reach_m, float((self.place_m - low_m).max()) / _MOST_CELLS)
        cells = np.floor((self.place_m - low_m) / side_m).astype(np.int64)
        shape = tuple((cells.max(axis=0) + 1).tolist())
        flat = np.ravel_multi_index((cells[:, 0], cells[:, 1]), shape)
        counts = np.bincount(flat, minlength=math.prod(shape)).reshape(shape)
        labels, count = ndimage.label(counts >= least, structure=np.ones((3, 3)))
        if count == 0:
            return Cluster(members=np.ones(len(self), dtype=bool), mass=1.0, count=1)
        label = labels.ravel()[flat]
        masses = np.bincount(label, weights=self.weight, minlength=count + 1)
        masses[0] = -1.0  # of particles in no cluster
        best = int(masses.argmax())
        return Cluster(members=label == best, mass=float(min(1.0, masses[best])), count=int(count))


def generator(name: str, sequence_id: str) -> np.random.Generator:
    """Return the random generator of a tracker on a flight; it depends on the two names alone."""
    seed = hashlib.sha256(f"{name}/{sequence_id}".encode()).digest()
    return np.random.default_rng(int.from_bytes(seed[:16], "big"))


class ParticleFilter(ABC):
    """Base of trackers: draws particles, moves and weighs them view by view; a method fills in three steps."""

    card: ClassVar[sgb.MatcherCard]
    count: ClassVar[int]  # of particles at the start
    noise: ClassVar[Noise]

    def __init__(self) -> None:
        self._grid: sgb.Grid | None = None
        self._prior: sgb.Prior | None = None
        self._particles: Particles | None = None
        self._rng = generator(self.card.name, "")
        self.start_spread_m = 0.0  # of the particles at the first view

    @abstractmethod
    def read(self, region: sgb.Region) -> None:
        """Index a map."""

    @abstractmethod
    def likelihood(self, particles: Particles, query: sgb.Query) -> Floats:
        """Return the likelihood of a view at each particle, shape (N,), up to a factor; 0 where there is no map."""

    @abstractmethod
    def estimate(self, particles: Particles) -> sgb.Fix:
        """Return the fix of weighed particles."""

    @abstractmethod
    def settled(self, particles: Particles, *, rng: np.random.Generator) -> Particles:
        """Return the particles to go on with: resampled, or as they are."""

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Index a map for flights over it."""
        del learned
        self._grid = region.grid
        self.read(region)

    def start(self, prior: sgb.Prior) -> None:
        """Begin a flight; particles are drawn when its name is known, at the first view."""
        if self._grid is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before start()")
        self._prior, self._particles = prior, None

    def step(self, query: sgb.Query) -> sgb.Fix:
        """Move the particles, weigh them by the view, and return a fix."""
        step = query.step
        if self._grid is None or self._prior is None or step is None:
            raise RuntimeError(f"{self.card.name}: call start() first, and step() with the views of a flight")
        if self._particles is None:
            self._rng = generator(self.card.name, step.sequence_id)
            moved = Particles.drawn(self._prior, self._grid, count=self.count, rng=self._rng)
            self.start_spread_m = moved.spread_m
        else:
            moved = self._particles.moved(step.increment, step.covariance, noise=self.noise, rng=self._rng)
        weighed = moved if sgb.is_blind(query) else moved.weighed(self.likelihood(moved, query))
        fix = self.estimate(weighed)
        self._particles = self.settled(weighed, rng=self._rng)
        return fix
