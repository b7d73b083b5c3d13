# SPDX-License-Identifier: Apache-2.0
"""`orb_vlad`: words of ORB descriptors, learned from the imagery of the map, gathered tile by tile as VLAD."""

from dataclasses import dataclass, replace
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

import sasgeo_bench as sgb
from sasgeo_baselines.image.dense import (
    MOST_PLACES,
    Field,
    answer_candidates,
    answer_places,
    bounds_of,
    disc_of,
)
from sasgeo_baselines.image.features import BITS, PIXEL_M, Features, map_features, view_features
from sasgeo_baselines.image.view_image import LIMITS, PICTURE, side_of, view_image

WINDOW_M: Final = 20.0  # standard deviation of the weight of a feature by its distance from the middle of a tile
WORDS: Final = 32
PARTS: Final = 16  # of a descriptor, its principal components
LEAST_FEATURES: Final = 8
_MOST_TAUGHT: Final = 20_000
_SEED: Final = 7
_NOTHING: Final = 1e-9
_AROUND: Final = 3  # blocks around a mode whose scores say where it is
_HALF: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class Vocabulary:
    """Words of a map: the mean descriptor, its principal directions, shape (BITS, PARTS), and words (WORDS, PARTS)."""

    mean: NDArray[np.float32]
    directions: NDArray[np.float32]
    words: NDArray[np.float32]

    @classmethod
    def of(cls, descriptors: NDArray[np.uint8], rng: np.random.Generator) -> Self:
        """Learn words from descriptors of imagery, uint8 of shape (N, 32)."""
        taught = descriptors
        if len(taught) > _MOST_TAUGHT:
            taught = taught[np.sort(rng.choice(len(taught), _MOST_TAUGHT, replace=False))]
        bits = _bits(taught)
        mean = bits.mean(axis=0)
        _, directions = np.linalg.eigh(np.cov((bits - mean).T))
        chosen = directions[:, ::-1][:, :PARTS].astype(np.float32)
        words, _ = kmeans2((bits - mean) @ chosen, WORDS, iter=20, minit="points", seed=rng)
        return cls(mean=mean.astype(np.float32), directions=chosen, words=words.astype(np.float32))

    def residuals(self, descriptors: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the nearest word of each descriptor, shape (N,), and its offset from it, shape (N, PARTS)."""
        short = (_bits(descriptors) - self.mean) @ self.directions
        nearest, _ = vq(short, self.words)
        return nearest.astype(np.int64), (short - self.words[nearest]).astype(np.float32)


def _bits(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.unpackbits(descriptors, axis=1).astype(np.float32).reshape(-1, BITS)


def normalized(vlad: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return VLAD, shape (..., WORDS, PARTS), as vectors of length 1, shape (..., WORDS * PARTS); 0 stays 0."""
    flat = vlad.reshape(*vlad.shape[:-2], -1)
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    return np.asarray(flat / np.maximum(length, _NOTHING), dtype=np.float32)


def gathered(features: Features, vocabulary: Vocabulary, grid: sgb.Grid) -> NDArray[np.float32]:
    """Return the normalized VLAD of a tile around every block of a lattice, shape (rows, cols, WORDS * PARTS)."""
    nearest, offsets = vocabulary.residuals(features.descriptors)
    rows, cols = grid.to_cells(features.points).T
    sums = np.zeros((*grid.shape, WORDS, PARTS), dtype=np.float32)
    np.add.at(sums, (rows, cols, nearest), offsets)
    sigma = WINDOW_M / grid.cell_size_m
    for word in range(WORDS):
        for part in range(PARTS):
            plane = np.ascontiguousarray(sums[:, :, word, part])
            sums[:, :, word, part] = cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return normalized(sums)


class OrbVlad:
    """Tile, around every block of 8 m, whose VLAD is nearest to that of the view."""

    card = sgb.MatcherCard(
        name="orb_vlad",
        version="1",
        title="VLAD of ORB words over tiles of imagery",
        source="VLAD (Jegou et al., CVPR 2010), on ORB (Rublee et al., ICCV 2011)",
        ours=(
            f"{PICTURE}; pixels of 0.5 m; descriptors as bits, brought to 16 principal components; 32 words, all of "
            "the searched map's own imagery; a tile around every block of 8 m, features weighted by distance from its "
            "middle (standard deviation 20 m); cosine; the place is the centroid of "
            "the scores within 24 m"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("image", "imagery"),
        limits=f"Places are good to about 5 m; heading is the prior's (north if unknown), scale 1; {LIMITS}",
    )

    def __init__(self) -> None:
        self._vocabulary: Vocabulary | None = None

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Learn the words of the imagery and gather them tile by tile."""
        del learned
        self._vocabulary = None
        found = map_features(region)
        if found is None or len(found[0]) < WORDS:
            return
        features, fine = found
        self._grid = fine.coarsen(round(8.0 / fine.cell_size_m))  # m: block between the middles of two tiles
        self._vocabulary = Vocabulary.of(features.descriptors, np.random.default_rng(_SEED))
        self._tiles = gathered(features, self._vocabulary, self._grid)

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Return the most similar tiles, or rank the candidates by the most similar one near each."""
        seen_image = view_image(query, gsd_m=PIXEL_M)
        if self._vocabulary is None or seen_image is None:
            return sgb.WITHHELD
        seen = view_features(seen_image, side_m=side_of(query))
        top, left, bottom, right = bounds_of(query, self._grid)
        if len(seen) < LEAST_FEATURES or top >= bottom or left >= right:
            return sgb.WITHHELD
        tiles = self._tiles[top:bottom, left:right]
        # Normalized VLAD of a view, its features weighted as those of a tile, shape (WORDS * PARTS,)
        nearest, offsets = self._vocabulary.residuals(seen.descriptors)
        weights = np.exp(-(seen.points**2).sum(axis=1) / (2 * WINDOW_M**2)).astype(np.float32)
        sums = np.zeros((WORDS, PARTS), dtype=np.float32)
        np.add.at(sums, nearest, offsets * weights[:, None])
        scores = tiles @ normalized(sums)
        field = Field(
            grid=self._grid.window(top, left, bottom - top, right - left),
            scores=np.where(tiles.any(axis=2), scores, -np.inf).astype(np.float32),
            which=np.zeros(scores.shape, dtype=np.int32),
            turns=(sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=query.prior.yaw_deg or 0.0),),
        )
        diagnostics = {"features": float(len(seen)), "peak": field.peak()}
        if query.track == "retrieval":
            return answer_candidates(query, field.near(query.candidates), top_k=top_k, diagnostics=diagnostics)
        most, disc = min(top_k, MOST_PLACES), disc_of(query.prior)
        modes = [centred(mode, field, disc) for mode in field.best(disc, most=most + 1)]
        return answer_places(modes, top_k=most, diagnostics=diagnostics)


def centred(mode: sgb.Mode, field: Field, disc: sgb.Disc) -> sgb.Mode:
    """Move a mode to the centroid of the scores around it, if that lies in the disc: tiles nearby are much alike."""
    row, col = field.grid.to_cells(sgb.points_of([mode.pose]))[0].tolist()
    top, left = max(row - _AROUND, 0), max(col - _AROUND, 0)
    part = field.scores[top : row + _AROUND + 1, left : col + _AROUND + 1].astype(np.float64)
    rows, cols = np.indices(part.shape)
    is_near = np.hypot(rows - (row - top), cols - (col - left)) <= _AROUND
    # 0.6 of its score, which counts as nothing there
    weights = np.where(is_near & np.isfinite(part), np.maximum(part - 0.6 * mode.score, 0), 0)
    if not weights.any():
        return mode
    uv = np.array([[(weights * (at + _HALF)).sum() for at in (cols + left, rows + top)]]) / weights.sum()
    east_m, north_m = field.grid.to_en_m(uv)[0].tolist()
    pose = replace(mode.pose, easting_m=east_m, northing_m=north_m)
    return replace(mode, pose=pose) if disc.has(pose) else mode
