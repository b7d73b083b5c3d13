# SPDX-License-Identifier: Apache-2.0
"""`swapf`: particles weighed by how far each labelled cell of the view lies from its class on the map (SWA-PF)."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.particles import NEAR_M, Floats, Noise, ParticleFilter, Particles

# Labels of the source with a distance map. Where several classes hold in a cell, the first of them is its label.
_OF: Final = sgb.load_taxonomy().groups
BUILDING: Final = _OF["building"]
ROAD: Final = (*_OF["bridge"], *_OF["street"], *_OF["path"], *_OF["railway"], "parking")
VEGETATION: Final = (*_OF["green"], *_OF["field"])
GROUPS: Final = (BUILDING, ROAD, VEGETATION)
OTHER: Final = len(GROUPS)  # whatever is none of them, water included
UNLABELLED: Final = OTHER + 1

SIDE_PX: Final = 400.0  # side of the square of the view that is compared, in the source's pixels
TRUNCATION: Final = 100.0  # px: distances are truncated here
BINS: Final = 100  # of heading
LEAST_COST: Final = 10.0
MOST_CLUSTERS: Final = 4

LATTICE: Final = 28  # cells a side at which the square is sampled: 4.8 m apart in a view of 192 m
PX_M: Final = 0.34  # 400 px for the inner square of a view of 192 m
_STEPS: Final = 250.0  # of a stored distance: uint8 holds TRUNCATION as so many
_BLOCK: Final = 1000  # particles weighed at once: what they read fits into the cache


@dataclass(frozen=True, kw_only=True)
class DistanceMaps:
    """Truncated distance to each label on the map.

    `distance`, uint8 of shape (labels, rows, cols), counts steps of `TRUNCATION` / 250; `grid` is its lattice.
    """

    grid: sgb.Grid
    distance: NDArray[np.uint8]

    @classmethod
    # At most 32 million cells of a stored map of one label: larger maps are read in coarser cells
    def of(cls, region: sgb.Region, *, most_cells: int = 32_000_000) -> Self:
        """Measure the map at its own cells; keep every n-th, so that a whole country fits into 128 MB."""
        cell_m = region.grid.cell_size_m
        factor = max(1, round(2.0 / cell_m), math.ceil(math.sqrt(region.grid.rows * region.grid.cols / most_cells)))
        grid = region.grid.coarsen(factor)
        distance = np.empty((OTHER + 1, *grid.shape), dtype=np.uint8)
        reach = math.ceil(TRUNCATION * PX_M / cell_m)
        strip = max(1, 512 // factor) * factor  # 512 rows of a map whose distances are measured at once
        labels_of_map = labels_of(region.known(), region.layer, region.classes)
        for top in range(0, region.grid.rows, strip):
            above, below = min(reach, top), top + strip + reach
            labels = labels_of_map[top - above : below]
            # The middle of a block; of one that the map ends in, its last row or column.
            rows = slice(above + min(factor // 2, region.grid.rows - top - 1), above + strip, factor)
            cols = slice(min(factor // 2, region.grid.cols - 1), None, factor)
            for label, into in enumerate(distance[:, top // factor : (top + strip) // factor]):
                far_px = _far(labels == label, cell_m)[rows, cols] / PX_M
                part = np.rint(np.minimum(far_px / TRUNCATION, 1.0) * _STEPS).astype(np.uint8)
                part = np.pad(part, [(0, into.shape[0] - part.shape[0]), (0, into.shape[1] - part.shape[1])], "edge")
                into[:] = part
        return cls(grid=grid, distance=distance)


def _far(present: NDArray[np.bool_], cell_m: float) -> NDArray[np.float32]:
    """Return the distance to the nearest present cell, metres; far where there is none."""
    if not present.any():
        return np.full(present.shape, np.inf, dtype=np.float32)
    away = cv2.distanceTransform((~present).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away * cell_m, dtype=np.float32)


def labels_of(
    known: NDArray[np.bool_], layer: Callable[[str], NDArray[np.uint8]], classes: tuple[str, ...]
) -> NDArray[np.uint8]:
    """Return the label of each cell of a view or a map, uint8 of shape (rows, cols).

    A cell that is not known in some class and present in none has no label.

    >>> cells = {"building": np.array([[1, 0, 0, 2]]), "road_minor": np.array([[1, 1, 0, 0]])}
    >>> labels_of(np.array([[True, True, True, False]]), cells.__getitem__, tuple(cells)).tolist()
    [[0, 1, 3, 4]]
    """
    found = np.where(known, np.uint8(OTHER), np.uint8(UNLABELLED))
    for label in reversed(range(OTHER)):
        for name in GROUPS[label]:
            if name in classes:
                found[layer(name) == sgb.PRESENT] = label
    return found


@dataclass(frozen=True, kw_only=True)
class Square:
    """The upright square inside a view at every heading, on a lattice.

    `offsets_m`, shape (S, 2), are east and north of its points from the middle at scale 1; `labels`, uint8 of shape
    (BINS, S), the labels at each heading; `radial`, shape (S,), the weights of the points.
    """

    offsets_m: Floats
    labels: NDArray[np.uint8]
    radial: Floats

    @classmethod
    def of(cls, evidence: sgb.Evidence) -> Self:
        """Turn a view."""
        known = np.asarray((evidence.cells <= sgb.PRESENT).all(axis=0))
        labels = labels_of(known, evidence.layer, evidence.classes)
        side_m = min(evidence.size_m) / math.sqrt(2)
        at_m = ((np.arange(LATTICE) + 0.5) / LATTICE - 0.5) * side_m
        east_m, north_m = (part.ravel() for part in np.meshgrid(at_m, -at_m))
        yaw = np.radians(np.arange(BINS) * 360.0 / BINS)[:, None]
        right_m, up_m = np.cos(yaw) * east_m - np.sin(yaw) * north_m, np.sin(yaw) * east_m + np.cos(yaw) * north_m
        height, width = labels.shape
        cols = np.clip(np.floor(right_m / evidence.cell_size_m + width / 2), 0, width - 1).astype(np.int64)
        rows = np.clip(np.floor(height / 2 - up_m / evidence.cell_size_m), 0, height - 1).astype(np.int64)
        away_px = np.hypot(east_m, north_m) * SIDE_PX / side_m
        # 255 px: weight of a cell = its distance from the middle, at most this, + 1
        return cls(
            offsets_m=np.stack([east_m, north_m], axis=1),
            labels=labels[rows, cols],
            radial=np.minimum(away_px, 255.0) + 1.0,
        )


def costs(square: Square, maps: DistanceMaps, particles: Particles) -> Floats:
    """Return the cost of each particle, shape (N,): weighted distances, summed as if over 400 x 400 pixels."""
    height, width = maps.grid.shape
    bins = np.rint(np.mod(particles.yaw_deg, 360.0) * (BINS / 360.0)).astype(np.int64) % BINS
    place = maps.grid.to_uv(particles.place_m).astype(np.float32)
    across = (square.offsets_m / (maps.grid.cell_size_m, -maps.grid.cell_size_m)).astype(np.float32)
    weights = np.where(square.labels == UNLABELLED, 0.0, square.radial).astype(np.float32)
    layers = np.minimum(square.labels, OTHER).astype(np.int32) * (height * width)
    flat = maps.distance.ravel()
    found = np.empty(len(particles))
    for begin in range(0, len(particles), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        scale = particles.scale[part, None].astype(np.float32)
        cols = (place[part, :1] + scale * across[:, 0]).astype(np.int32)
        rows = (place[part, 1:] + scale * across[:, 1]).astype(np.int32)
        at = np.clip(rows, 0, height - 1) * width + np.clip(cols, 0, width - 1)
        far = flat.take(layers[bins[part]] + at)
        found[part] = np.einsum("ns,ns->n", far, weights[bins[part]], dtype=np.float32)
    px = (SIDE_PX / LATTICE) ** 2  # pixels that each point stands for
    beyond_px = SIDE_PX**2 * _beyond(
        maps.grid, particles, reach_m=float(square.offsets_m.max()) * LATTICE / (LATTICE - 1)
    )
    return np.asarray(found * (TRUNCATION / _STEPS * px) + LEAST_COST + 1e5 * beyond_px)  # a pixel beyond the map


def _beyond(grid: sgb.Grid, particles: Particles, *, reach_m: float) -> Floats:
    """Return the fraction of each particle's square, `reach_m` to each side at scale 1, that is beyond the map."""
    west_m, south_m, east_m, north_m = grid.bounds_m
    reach = (particles.scale * reach_m)[:, None]
    low, high = (
        np.maximum(particles.place_m - reach, (west_m, south_m)),
        np.minimum(particles.place_m + reach, (east_m, north_m)),
    )
    return np.asarray(1.0 - np.prod(np.maximum(high - low, 0.0) / (2 * reach), axis=1))


class SwaPf(ParticleFilter):
    """Weights of const / cost^2, fewer particles at each view, and the heaviest cluster."""

    card = sgb.MatcherCard(
        name="swapf",
        version="1",
        title="Semantic-weighted adaptive particle filter",
        source="Yuan et al., SWA-PF, arXiv 2509.13795, and its released program",
        ours=(
            "The source's: labels building, road, vegetation and other, distance maps truncated at 100 px, 100 "
            "headings, the inner square of the view, radial weights, weight = const / cost^2, multinomial resampling "
            "at each view, 20,000 particles that become 1,000, noise of 15 px and 0.2 degrees, convergence below a "
            "tenth of the first spread, clusters of 20 particles. Ours: the heaviest cluster (a helper of the "
            "released program, which its main loop does not call, takes the one nearest to the truth) on a lattice of "
            "30 m instead of DBSCAN within 30 px; one step of resampling a view (there two); increments and "
            "covariances of an odometer (there: differences of true positions), 1 km and 90 degrees where it lost its "
            "way, noise without a mean; scale of the view for height, with a noise of 0.005; a pixel is 0.34 m; the "
            "square is read at 28 x 28 points, the map every 2 m or coarser; unknown cells of the view have no cost; "
            "what has not converged is withheld"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "Loses the place where the first views tell little; ground that the map does not know counts as far from "
            "all labels; classes weigh alike, water counts as other, and a mapped thing that is not seen costs only "
            "what stands in its place; it gathers within 20 views whatever they show, and on a large map may accept a "
            "wrong place, where it stays; with a known start a tenth of the spread is hard to reach, so that a spread "
            "below 25 m counts as converged too (ours)"
        ),
    )
    count = 20_000
    noise = Noise(place_m=15.0 * PX_M, yaw_deg=0.2, scale=0.005)

    def read(self, region: sgb.Region) -> None:
        """Measure the distance maps."""
        self._maps = DistanceMaps.of(region)

    def likelihood(self, particles: Particles, query: sgb.Query) -> Floats:
        """Return 1 / cost^2, of the best particle 1."""
        cost = costs(Square.of(query.evidence), self._maps, particles)
        return np.asarray(np.square(cost.min() / cost))

    def estimate(self, particles: Particles) -> sgb.Fix:
        """Return the mean of the heaviest cluster; of all particles where there are more than four clusters."""
        cluster = particles.heaviest_cluster(reach_m=30.0, least=20)  # of a cluster
        chosen = particles.within(cluster.members) if cluster.count <= MOST_CLUSTERS else particles
        spread_m = particles.spread_m
        return sgb.Fix(
            pose=chosen.mean,
            covariance=chosen.covariance,
            is_accepted=spread_m < max(0.1 * self.start_spread_m, NEAR_M),  # of the spread at the start
            confidence=particles.share_near(chosen.mean),
            diagnostics={"spread_m": spread_m, "clusters": float(cluster.count), "particles": float(len(particles))},
        )

    def settled(self, particles: Particles, *, rng: np.random.Generator) -> Particles:
        """Resample a fifth fewer particles, at least 1,000."""
        # 0.8 of the particles remain at each resampling
        return particles.resampled_multinomial(max(int(0.8 * len(particles)), 1000), rng=rng)  # 1000 particles
