# SPDX-License-Identifier: Apache-2.0
"""`kinnari_mcl`: Monte Carlo localisation, weighed by how the correlation peaks around each particle (Kinnari)."""

import math
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.particles import NEAR_M, TRAINED_ON, Floats, Noise, ParticleFilter, Particles

_OF: Final = sgb.load_taxonomy().groups
GROUPS: Final = (
    (*_OF["building"], "parking"),
    (*_OF["street"], *_OF["path"], *_OF["railway"], *_OF["bridge"]),
    _OF["water"],
    _OF["green"],
    _OF["field"],
)
CELL_M: Final = 12.0  # of what is correlated
SHIFTS: Final = 2  # cells to each side of a particle at which the correlation is looked at
MAP_CELL_M: Final = 4.0
COUNT: Final = 20_000
FEWEST: Final = 5_000
LEAST_EFFECTIVE: Final = 0.5

# Log of the likelihood ratio of being right, from the features of a correlation surface (`features`): a logistic
# regression of right against wrong places on made-up towns, `benchmarks/fit_particle_filters.py`.
RATIO: Final = np.array([-5.15, 7.01, 3.46])

_BLOCK: Final = 500  # particles weighed at once
_LEAST_ENERGY: Final = 1e-3

Planes = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Mosaic:
    """Occupancy of groups in squares of 12 m around the points of a grid: `share`, 0..255, (rows, cols, groups)."""

    grid: sgb.Grid
    share: NDArray[np.uint8]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Read a map."""
        grid = region.grid.coarsen(max(1, round(MAP_CELL_M / region.grid.cell_size_m)))
        share = np.zeros((*grid.shape, len(GROUPS)), dtype=np.uint8)
        factor = round(grid.cell_size_m / region.grid.cell_size_m)
        size = max(1, round(CELL_M / grid.cell_size_m))
        for number, names in enumerate(GROUPS):
            present = np.zeros((grid.rows * factor, grid.cols * factor), dtype=np.uint8)
            inside = present[: region.grid.rows, : region.grid.cols]
            for name in names:
                if name in region.classes:
                    inside[region.layer(name) == sgb.PRESENT] = 255
            coarse = cv2.resize(present, grid.shape[::-1], interpolation=cv2.INTER_AREA)
            share[:, :, number] = cv2.blur(coarse, (size, size), borderType=cv2.BORDER_CONSTANT)
        return cls(grid=grid, share=share)

    def around(self, particles: Particles, side: int) -> Planes:
        """Read squares of `side` cells of 12 m, turned as each particle, float32 (N, groups, side * side)."""
        at_m = (np.arange(side) + 0.5 - side / 2) * CELL_M
        right_m, up_m = (part.ravel().astype(np.float32) for part in np.meshgrid(at_m, -at_m))
        sine, cosine = (part.astype(np.float32)[:, None] for part in _turn(particles.yaw_deg))
        scale = (particles.scale / self.grid.cell_size_m).astype(np.float32)[:, None]
        middle = self.grid.to_uv(particles.place_m).astype(np.float32)
        cols = (middle[:, :1] + scale * (cosine * right_m + sine * up_m)).astype(np.int32)
        rows = (middle[:, 1:] - scale * (cosine * up_m - sine * right_m)).astype(np.int32)
        height, width = self.grid.shape
        flat = np.clip(rows, 0, height - 1) * width + np.clip(cols, 0, width - 1)
        found = self.share.reshape(-1, len(GROUPS)).take(flat, axis=0)
        return np.asarray(found.transpose(0, 2, 1), dtype=np.float32) / np.float32(255)


def _turn(yaw_deg: Floats) -> tuple[Floats, Floats]:
    turn = np.radians(yaw_deg)
    return np.sin(turn), np.cos(turn)


@dataclass(frozen=True, kw_only=True)
class Template:
    """A view in cells of 12 m: `share`, float32 (groups, side^2), and how far each cell is known, float32 (side^2,)."""

    side: int
    share: Planes
    known: Planes

    @classmethod
    def of(cls, evidence: sgb.Evidence) -> Self:
        """Average a view over its cells."""
        side = max(1, min(16, int(min(evidence.size_m) / CELL_M + 1e-6)))  # 16 cells a side, at most: 192 m
        height, width = evidence.shape
        rows, cols = (
            np.floor(((np.arange(count) + 0.5 - count / 2) * evidence.cell_size_m) / CELL_M + side / 2).astype(np.int64)
            for count in (height, width)
        )
        inside = ((rows >= 0) & (rows < side))[:, None] & ((cols >= 0) & (cols < side))[None, :]
        at = (rows[:, None] * side + cols[None, :])[inside]
        present, known = np.zeros((len(GROUPS), side * side)), np.full((len(GROUPS), side * side), np.inf)
        for group, names in enumerate(GROUPS):
            layers = [evidence.layer(name) for name in names if name in evidence.classes]
            if layers:
                is_present = np.any([layer == sgb.PRESENT for layer in layers], axis=0)
                is_known = is_present | np.all([layer != sgb.UNKNOWN for layer in layers], axis=0)
                present[group] = np.bincount(at, weights=is_present[inside], minlength=side * side)
                known[group] = np.bincount(at, weights=is_known[inside], minlength=side * side)
        cells = max(1.0, (CELL_M / evidence.cell_size_m) ** 2)
        return cls(
            side=side,
            share=(present / np.maximum(known, 1)).astype(np.float32),
            known=np.minimum(known.min(axis=0) / cells, 1.0).astype(np.float32),  # by the groups that a view has
        )

    @property
    def centred(self) -> Planes:
        """Return the shares less their mean over what is known, weighed by how far they are, (groups, side^2)."""
        mean = self.share @ self.known / max(float(self.known.sum()), _LEAST_ENERGY)
        return (self.share - mean[:, None]) * self.known


def surfaces(template: Template, mosaic: Mosaic, particles: Particles) -> Planes:
    """Return the correlation around each particle, shape (N, (2 * SHIFTS + 1)^2), row by row; -1..1.

    Zero-mean normalised cross-correlation over all groups and known cells; each group has its own mean.
    """
    wide, reach = template.side + 2 * SHIFTS, 2 * SHIFTS + 1
    known = _shifted(template.known[None], wide)[:, 0]  # (shifts, wide^2)
    weights = _shifted(template.centred, wide)  # (shifts, groups, wide^2)
    own = float((np.square(template.centred) / np.maximum(template.known, _LEAST_ENERGY)).sum())
    total = max(float(template.known.sum()), _LEAST_ENERGY)
    found = np.empty((len(particles), reach * reach), dtype=np.float32)
    for begin in range(0, len(particles), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        mapped = mosaic.around(_some(particles, part), wide)  # (n, groups, wide^2)
        product = mapped.reshape(len(mapped), -1) @ weights.reshape(len(weights), -1).T
        means = mapped @ known.T  # (n, groups, shifts)
        squares = np.einsum("ngc,ngc->nc", mapped, mapped) @ known.T
        energy = squares - np.einsum("ngs,ngs->ns", means, means) / total
        found[part] = product / np.sqrt(np.maximum(energy, _LEAST_ENERGY) * max(own, _LEAST_ENERGY))
    return found


def _some(particles: Particles, part: slice) -> Particles:
    return Particles(
        place_m=particles.place_m[part],
        yaw_deg=particles.yaw_deg[part],
        scale=particles.scale[part],
        weight=particles.weight[part],
    )


def _shifted(planes: Planes, wide: int) -> Planes:
    """Return planes, shape (K, side^2), at every shift within a square of `wide` cells, shape (shifts, K, wide^2)."""
    side = wide - 2 * SHIFTS
    reach = 2 * SHIFTS + 1
    found = np.zeros((reach, reach, len(planes), wide, wide), dtype=np.float32)
    for down, right in np.ndindex(reach, reach):
        found[down, right, :, down : down + side, right : right + side] = planes.reshape(-1, side, side)
    return found.reshape(reach * reach, len(planes), wide * wide)


def features(surface: Planes) -> Floats:
    """Return features of correlation surfaces, shape (N, 3): 1, the correlation, and how it peaks at the particle.

    The peak is the correlation at the particle less the mean around it, in standard deviations of the surface (and
    0.05, so that a flat one has none).

    >>> flat, peaked = np.full((1, 25), 0.3), np.full((1, 25), 0.1)
    >>> peaked[0, 12] = 0.9
    >>> features(np.concatenate([flat, peaked]).astype(np.float32)).round(2).tolist()
    [[1.0, 0.3, 0.0], [1.0, 0.9, 3.71]]
    """
    here = surface[:, surface.shape[1] // 2].astype(np.float64)
    peak = (here - surface.mean(axis=1)) / (surface.std(axis=1) + 0.05)
    return np.stack([np.ones(len(surface)), here, peak], axis=1)


class KinnariMcl(ParticleFilter):
    """Particles weighed by a fitted ratio of likelihoods of correlation surfaces; the weighted mean."""

    card = sgb.MatcherCard(
        name="kinnari_mcl",
        version="1",
        title="Monte Carlo localisation by the peak of the correlation",
        source="Kinnari, Verdoja and Kyrki, arXiv 2103.14381, 2021, by its abstract",
        ours=(
            "The source's: correlation with the map around each particle; a measure of how good the surface of "
            "correlation is; Monte Carlo localisation. Ours: views are metric and seen from above already, so that "
            "nothing is rectified; occupancy of five groups of classes in cells of 12 m for grey values, on 16 x 16 "
            "cells; zero-mean normalised correlation at 5 x 5 shifts; log-likelihood ratio by a logistic regression "
            "on the correlation and how it peaks (weights 7.0 and 3.5, so that the value counts too; a weight by the "
            "value alone is not registered), times 0.5 since views overlap; 20,000 to 5,000 particles, resampled "
            "below half of effective ones; noise of 3 m and 1 degree; increments and covariances of an odometer, 1 km "
            "and 90 degrees where it lost its way; a fix is accepted where the particles are spread by 25 m or less"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        trained_on=TRAINED_ON,
        limits=(
            "The ratio is fitted to towns whose maps are of the day of the flight; a cell counts as far as all groups "
            "are known in it in the view, while ground that the map does not know counts as empty; views beyond 96 m "
            "to each side are cut; what is even, such as forest, correlates with nothing; once it follows a wrong "
            "place it stays there"
        ),
    )
    count = COUNT
    noise = Noise(place_m=3.0, yaw_deg=1.0)

    def read(self, region: sgb.Region) -> None:
        """Read the map."""
        self._mosaic, self._bounds_m = Mosaic.of(region), region.grid.bounds_m

    def likelihood(self, particles: Particles, query: sgb.Query) -> Floats:
        """Return the tempered ratio of likelihoods, 0 beyond the map."""
        west_m, south_m, east_m, north_m = self._bounds_m
        is_inside = ((particles.place_m >= (west_m, south_m)) & (particles.place_m <= (east_m, north_m))).all(axis=1)
        # 0.5: views of a flight overlap, and share their errors
        logs = features(surfaces(Template.of(query.evidence), self._mosaic, particles)) @ RATIO * 0.5
        return np.asarray(np.where(is_inside, np.exp(logs - logs.max()), 0.0))

    def estimate(self, particles: Particles) -> sgb.Fix:
        """Return the weighted mean."""
        pose, spread_m = particles.mean, particles.spread_m
        return sgb.Fix(
            pose=pose,
            covariance=particles.covariance,
            is_accepted=spread_m <= NEAR_M,
            confidence=particles.share_near(pose),
            diagnostics={"spread_m": spread_m, "effective": particles.effective_count, "particles": len(particles)},
        )

    def settled(self, particles: Particles, *, rng: np.random.Generator) -> Particles:
        """Resample where few particles are effective; fewer each time."""
        count = len(particles)
        if particles.effective_count >= LEAST_EFFECTIVE * count:
            return particles
        # 0.7 of the particles at each resampling
        return particles.resampled(min(count, max(FEWEST, math.floor(0.7 * count))), rng=rng)
