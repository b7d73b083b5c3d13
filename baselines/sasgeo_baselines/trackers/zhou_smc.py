# SPDX-License-Identifier: Apache-2.0
"""`zhou_smc`: sequential Monte Carlo with a likelihood that is linear in the distance of embeddings (Zhou, Samano)."""

import hashlib
import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.polar import CELL_M, GROUPS, described, turned, view_descriptor
from sasgeo_baselines.trackers.particles import TRAINED_ON, Floats, Noise, ParticleFilter, Particles

YAWS: Final = 8  # headings for which the map has embeddings
DIMENSIONS: Final = 16
FEWEST: Final = 5_000  # above it, resampling drops the least likely
DROPPED: Final = 0.1
LEAST_EFFECTIVE: Final = 2 / 3  # of the particles, below which they are resampled
MOST_BYTES: Final = 128 * 10**6  # of the embeddings of a map, which are farther apart on larger maps
STEP_M: Final = 12.0  # between them, at least

_FULL: Final = 127.0  # of a component of an embedding in int8
EMBEDDING: Final = Path(__file__).with_name("zhou_embedding.npz")
EMBEDDING_SHA256: Final = "73a4f80a7078ed4791b6d0a54d82be5e02ffcc17eacf7c5b3028d217d63a40ab"  # part of the code's hash


@dataclass(frozen=True, kw_only=True)
class Embedding:
    """Two linear maps from descriptors to embeddings, one for views and one for maps.

    `view` and `mapped` have shape (D, DIMENSIONS), `view_mean` and `mapped_mean` shape (D,).
    """

    view: NDArray[np.float32]
    view_mean: NDArray[np.float32]
    mapped: NDArray[np.float32]
    mapped_mean: NDArray[np.float32]

    @classmethod
    def read(cls, path: Path = EMBEDDING, *, sha256: str = EMBEDDING_SHA256) -> Self:
        """Read the embedding that ships, made by `benchmarks/fit_particle_filters.py`, or another."""
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != sha256:
            raise ValueError(f"{path} is another embedding than the program knows of: install sasgeo-baselines again")
        with np.load(io.BytesIO(content)) as arrays:
            check_groups(arrays["groups"].tolist())
            return cls(**{item.name: arrays[item.name].astype(np.float32) for item in fields(cls)})

    def of_view(self, evidence: sgb.Evidence) -> NDArray[np.float32]:
        """Return the embedding of a view, shape (DIMENSIONS,); what is unknown counts as average."""
        found = view_descriptor(evidence)
        return np.asarray((np.where(np.isnan(found), self.view_mean, found) - self.view_mean) @ self.view)


def group_names() -> list[str]:
    """Return the names of the classes of each group of a descriptor, with spaces between them."""
    return [" ".join(names) for names in GROUPS]


def check_groups(learned: list[str]) -> None:
    """Raise `ValueError`, with the class, if an embedding was fitted to other groups of classes than those of today.

    >>> check_groups([names for names in group_names() if names != "green"])  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    ValueError: the weights of zhou_smc do not know the class 'green' as it is grouped today: fit them anew by ...
    """
    was, now = (
        {name: at for at, one in enumerate(names) for name in one.split()} for names in (learned, group_names())
    )
    strange = [name for name in now | was if (name in was) != (name in now)] or [
        name for name in now if was[name] != now[name]
    ]
    if strange:
        raise ValueError(
            f"the weights of zhou_smc do not know the class {strange[0]!r} as it is grouped today: fit them anew by "
            "benchmarks/fit_particle_filters.py"
        )


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Divide vectors by their length."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Embeddings of a map, of length 1 after the mean over the map is taken off.

    `values`, int8 of shape (rows, cols, YAWS, DIMENSIONS), are those at places `step_m` apart from the north-western
    corner, `corner_m`; `mean`, shape (DIMENSIONS,), is that of the map, which is taken off views as well.
    """

    corner_m: tuple[float, float]
    step_m: float
    mean: NDArray[np.float32]
    values: NDArray[np.int8]

    @classmethod
    def of(cls, region: sgb.Region, embedding: Embedding, *, most_bytes: int = MOST_BYTES) -> Self:
        """Embed a map at every place and heading of a lattice."""
        west_m, south_m, east_m, north_m = region.grid.bounds_m
        area_m2 = (east_m - west_m) * (north_m - south_m)
        least_m = np.sqrt(area_m2 * YAWS * DIMENSIONS / most_bytes)
        stride = max(round(STEP_M / CELL_M), int(np.ceil(least_m / CELL_M)))
        weights = np.concatenate([turned(embedding.mapped, yaw, yaws=YAWS) for yaw in range(YAWS)], axis=1)
        shift = np.concatenate([embedding.mapped_mean @ embedding.mapped] * YAWS)
        rows = []
        for row in described(region, stride=stride):
            found = row @ weights - shift
            rows.append(found.reshape(-1, YAWS, DIMENSIONS).astype(np.float16))
        mean = np.mean([row.mean(axis=(0, 1), dtype=np.float32) for row in rows], axis=0)
        values = np.stack([np.rint(unit(row - mean) * _FULL).astype(np.int8) for row in rows])
        return cls(corner_m=(west_m, north_m), step_m=stride * CELL_M, mean=mean, values=values)

    def at(self, place_m: Floats, yaw_deg: Floats) -> NDArray[np.float32]:
        """Return embeddings by trilinear interpolation, shape (N, DIMENSIONS); places beyond are moved to the edge."""
        rows, cols = self.values.shape[:2]
        down = np.clip((self.corner_m[1] - place_m[:, 1]) / self.step_m, 0, rows - 1)
        right = np.clip((place_m[:, 0] - self.corner_m[0]) / self.step_m, 0, cols - 1)
        turn = np.mod(yaw_deg, 360.0) * (YAWS / 360.0)
        low = [np.floor(part).astype(np.int64) for part in (down, right, turn)]
        part = [(value - whole).astype(np.float32) for value, whole in zip((down, right, turn), low, strict=True)]
        found = np.zeros((len(place_m), DIMENSIONS), dtype=np.float32)
        flat = self.values.reshape(-1, DIMENSIONS)
        for corner in np.ndindex(2, 2, 2):
            row, col, yaw = (whole + step for whole, step in zip(low, corner, strict=True))
            row, col = np.minimum(row, rows - 1), np.minimum(col, cols - 1)  # on the edge: its share is 0
            share = np.prod([near if step else 1 - near for near, step in zip(part, corner, strict=True)], axis=0)
            found += flat[(row * cols + col) * YAWS + yaw % YAWS] * (share / np.float32(_FULL))[:, None]
        return found


class ZhouSmc(ParticleFilter):
    """Particles weighed by embeddings, resampled when few are effective; the weighted mean."""

    card = sgb.MatcherCard(
        name="zhou_smc",
        version="1",
        title="Sequential Monte Carlo on embeddings of views and map",
        source=(
            "Zhou et al., IROS 2021 (seen from the ground), by its aerial twin: Samano, Zhou and Calway, ICRA 2021, "
            "and the latter's released program"
        ),
        ours=(
            "The source's: embeddings of 16 numbers, those of the map on a lattice with 8 headings, read by trilinear "
            "interpolation; weights (2 s - distance) / (2 s); 20,000 particles over what is known at the start; noise "
            "of 10 m and 5 degrees a view; particles beyond the map die; resampling below 2/3 of effective particles, "
            "first without the lowest tenth while there are more than 5,000, then systematic; the weighted mean. "
            "Ours: a linear embedding for the network (PCA, then CCA of views with errors against the map), of the "
            "occupancy of 7 groups of classes in 8 rings and 16 sectors of 96 m and of their distances; unknown "
            "sectors of a view count as average; the mean embedding of the map is taken off both; the lattice is 12 "
            "m, and up to 24 m on a map of 470 km2; increments and covariances of an odometer, 1 km and 90 degrees "
            "where it lost its way (there the last step is repeated); the scale of the view is not modulated; a fix "
            "is accepted where the particles are spread by 60 m or less"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        trained_on=TRAINED_ON,
        limits=(
            "Ground that the map does not know counts as empty; views beyond 96 m to each side are cut; "
            "a linear weight prefers a place little, and the noise of 10 m a view bounds the precision, so that it "
            "takes 1 km and more to find a place in a disc of 500 m; scale is ignored; the source rejects nothing"
        ),
    )
    count = 20_000  # particles at the start
    noise = Noise(place_m=10.0, yaw_deg=5.0)

    def read(self, region: sgb.Region) -> None:
        """Embed the map."""
        self._embedding = Embedding.read()
        self._table = Table.of(region, self._embedding)
        self._bounds_m = region.grid.bounds_m

    def likelihood(self, particles: Particles, query: sgb.Query) -> Floats:
        """Return 1 - distance / 2 of embeddings, 0 beyond the map."""
        away = self._table.at(particles.place_m, particles.yaw_deg) - unit(
            self._embedding.of_view(query.evidence) - self._table.mean
        )
        west_m, south_m, east_m, north_m = self._bounds_m
        is_inside = ((particles.place_m >= (west_m, south_m)) & (particles.place_m <= (east_m, north_m))).all(axis=1)
        return np.asarray(np.where(is_inside, np.maximum(1 - np.linalg.norm(away, axis=1) / 2, 0.0), 0.0))

    def estimate(self, particles: Particles) -> sgb.Fix:
        """Return the weighted mean."""
        pose, spread_m = particles.mean, particles.spread_m
        return sgb.Fix(
            pose=pose,
            covariance=particles.covariance,
            is_accepted=spread_m <= 60.0,  # m: spread of the particles: less than that of a disc of 100 m
            confidence=particles.share_near(pose),
            diagnostics={"spread_m": spread_m, "effective": particles.effective_count, "particles": len(particles)},
        )

    def settled(self, particles: Particles, *, rng: np.random.Generator) -> Particles:
        """Resample where few particles are effective."""
        if particles.effective_count >= LEAST_EFFECTIVE * len(particles):
            return particles
        count = len(particles)
        if count > FEWEST:
            count = max(FEWEST, round((1 - DROPPED) * count))
            kept = np.zeros(len(particles), dtype=bool)
            kept[np.argsort(-particles.weight, kind="stable")[:count]] = True
            particles = particles.within(kept)
        return particles.resampled(count, rng=rng)
