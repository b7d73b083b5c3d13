# SPDX-License-Identifier: Apache-2.0
"""`zhang_hier_consensus`: retrieval of a crop, then patches that match it with the consent of their neighbours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.global_descriptor import separate
from sasgeo_baselines.place_matcher import AROUND_M, PlaceMatcher, turns_within
from sasgeo_baselines.polar import (
    DEPTH,
    GROUPS,
    RINGS,
    SECTORS,
    described,
    places_m,
    turned,
    view_descriptor,
)
from sasgeo_bench import (
    UNKNOWN,
    Chart,
    Disc,
    Evidence,
    MatcherCard,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    thinned,
    wrap_deg,
)

SIDE: Final = 8  # cells a side of a patch
FAR_M: Final = 32.0  # distances are cut there: what is further away does not describe a patch
_LEAST_KNOWN: Final = 0.5  # of the cells of a patch; else the class is not compared there
_LEAST_SPREAD: Final = 0.05  # of a number over patches: a class of one small patch must not outweigh all others

Scores = NDArray[np.float32]  # of shape (rows, cols, rows of the map, cols of the map)


SLACK_M: Final = 8.0  # beyond the disc of the prior: the side of a patch, as places are middles of them
LEAST: Final = 4  # matches that agree: two make a similarity
MOST_OFF: Final = 3.0  # standard deviations of the prior, of a heading or scale that is found
_STEP_DEG: Final = 360.0 / SECTORS

Floats = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Patches:
    """Patches of a raster: `values` and `known`, shape (rows, cols, D), and `places_m`, (rows, cols, 2).

    The D numbers are the share of each class, then its nearness: 1 less the mean distance in units of `FAR_M`. `known`
    is 1 or 0. Places are (right, up) from the middle of the raster.
    """

    values: Floats
    known: Floats
    places_m: NDArray[np.float64]

    @classmethod
    def of(cls, cells: NDArray[np.uint8], cell_size_m: float) -> Self:
        """Describe the whole patches of three-state cells, shape (C, rows, cols).

        >>> cells = np.zeros((1, 8, 16), dtype=np.uint8)
        >>> cells[0, :, :4] = sgb.PRESENT
        >>> found = Patches.of(cells, 1.0)
        >>> found.values[0, :, 0].tolist(), found.places_m[0, :, 0].tolist()  # a half, then nothing
        ([0.5, 0.0], [-4.0, 4.0])
        """
        height, width = cells.shape[1:]
        present, known = cells == sgb.PRESENT, cells != sgb.UNKNOWN
        near = np.stack([1 - np.minimum(_away(layer) * cell_size_m / FAR_M, 1) for layer in present])
        seen = _means(known)
        shares = _means(present) / np.maximum(seen, _LEAST_KNOWN)
        is_known = (seen >= _LEAST_KNOWN).astype(np.float32)
        values = np.concatenate([shares, _means(near)]).transpose(1, 2, 0)
        down, right = (np.arange(count // SIDE) * SIDE + SIDE / 2 - count / 2 for count in (height, width))
        places = np.stack(np.meshgrid(right, -down), axis=-1) * cell_size_m
        return cls(values=values, known=np.concatenate([is_known, is_known]).transpose(1, 2, 0), places_m=places)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return (self.values.shape[0], self.values.shape[1])


def _away(present: NDArray[np.bool_]) -> Floats:
    if not present.any():
        return np.full(present.shape, np.inf, dtype=np.float32)
    away = cv2.distanceTransform((~present).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, dtype=np.float32)


def _means(layers: NDArray[np.generic]) -> Floats:
    """Return means over whole patches, shape (C, rows, cols) of patches."""
    count, height, width = layers.shape
    rows, cols = height // SIDE, width // SIDE
    cut = layers[:, : rows * SIDE, : cols * SIDE].astype(np.float32)
    return np.asarray(cut.reshape(count, rows, SIDE, cols, SIDE).mean(axis=(2, 4)))


def correlation(view: Patches, town: Patches) -> Scores:
    """Return the cosine of each patch of a view with each patch of a map, 0 where it is negative or nothing is known.

    Numbers are centred and scaled by their mean and spread over the map's patches; a cosine is over what both know.
    """
    known, there = (part.known.reshape(-1, part.known.shape[-1]) for part in (view, town))
    weight = np.maximum(there.sum(axis=0), 1)
    mean = (town.values.reshape(there.shape) * there).sum(axis=0) / weight
    spread = np.sqrt((np.square(town.values.reshape(there.shape) - mean) * there).sum(axis=0) / weight)
    scale = np.maximum(spread, _LEAST_SPREAD)
    mine, theirs = (
        (part.values.reshape(mask.shape) - mean) / scale * mask for part, mask in ((view, known), (town, there))
    )
    norms = (np.square(mine) @ there.T) * (known @ np.square(theirs).T)
    cosine = np.divide(mine @ theirs.T, np.sqrt(norms), out=np.zeros_like(norms), where=norms > 0)
    return np.asarray(np.maximum(cosine, 0).reshape(*view.shape, *town.shape), dtype=np.float32)


def soft_mutual(scores: Scores) -> Scores:
    """Weigh scores by their shares in the best of their patch on either side (soft mutual nearest neighbours).

    >>> scores = np.array([[1.0, 0.5], [0.5, 0.5]], dtype=np.float32).reshape(2, 1, 2, 1)
    >>> soft_mutual(scores).reshape(2, 2).tolist()
    [[1.0, 0.25], [0.25, 0.5]]
    """
    best_mine = np.maximum(scores.max(axis=(2, 3), keepdims=True), np.finfo(np.float32).tiny)
    best_theirs = np.maximum(scores.max(axis=(0, 1), keepdims=True), np.finfo(np.float32).tiny)
    return np.asarray(scores * (scores / best_mine) * (scores / best_theirs))


def consensus(scores: Scores) -> Scores:
    """Add to each pair of patches the mean score of the eight pairs at equal offsets from both.

    >>> scores = np.zeros((1, 2, 1, 3), dtype=np.float32)
    >>> scores[0, 0, 0, 1] = scores[0, 1, 0, 2] = 8.0  # neighbours that agree
    >>> scores[0, 0, 0, 0] = 8.0
    >>> consensus(scores)[0, 0, 0].tolist()
    [8.0, 9.0, 0.0]
    """
    total = np.zeros_like(scores)
    offsets = [offset for offset in product((-1, 0, 1), repeat=2) if offset != (0, 0)]
    for offset in offsets:
        into, of = zip(*(_shifted(step) for step in (*offset, *offset)), strict=True)
        total[into] += scores[of]
    return np.asarray(scores + total / len(offsets))


def _shifted(step: int) -> tuple[slice, slice]:
    """Return the part of an axis that has a neighbour `step` further on, and the part of these neighbours."""
    return {-1: (slice(1, None), slice(None, -1)), 0: (slice(None), slice(None)), 1: (slice(None, -1), slice(1, None))}[
        step
    ]


def mutual(scores: Scores) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs of patches, flat indices, that are each other's best; of equal ones the first is best."""
    rows, cols, *_ = scores.shape
    flat = scores.reshape(rows * cols, -1)
    best = flat.argmax(axis=1)
    mine = np.arange(len(flat))
    is_mutual = (flat.argmax(axis=0)[best] == mine) & (flat[mine, best] > 0)
    return mine[is_mutual], best[is_mutual]


def matches(view: Patches, town: Patches, *, rounds: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places of matched patches in a view and in a map, shape (M, 2) each, (right, up) of either's middle."""
    scores = soft_mutual(correlation(view, town))
    for _ in range(rounds):
        scores = consensus(scores)
    mine, theirs = mutual(scores)
    return view.places_m.reshape(-1, 2)[mine], town.places_m.reshape(-1, 2)[theirs]


@dataclass(frozen=True, kw_only=True)
class Crops:
    """Crops of a map: their middles, shape (N, 2), and standardised descriptors facing north, shape (N, D)."""

    middles_m: NDArray[np.float64]
    values: Floats
    mean: Floats
    spread: Floats

    @classmethod
    def of(cls, region: Region, *, stride: int) -> Self:
        """Describe the crops of a map, so many cells of 4 m apart."""
        rows = list(described(region, stride=stride))
        values = np.concatenate(rows)
        mean, spread = _alike(values.mean(axis=0)), np.sqrt(_alike(values.var(axis=0)))
        spread = np.maximum(spread, np.float32(0.02))  # least spread of a number of the descriptor over the map
        np.subtract(values, mean, out=values)
        np.divide(values, spread, out=values)
        middles_m = places_m(region.grid, (len(rows), len(rows[0])), stride=stride)
        return cls(middles_m=middles_m, values=values, mean=mean, spread=spread)

    def likeness(self, descriptor: Floats, rows: NDArray[np.int64], turns: Sequence[int]) -> Floats:
        """Return cosines of crops with a view that heads so many sectors east of north, shape (rows, turns).

        What the view does not know (NaN) is left out of both.
        """
        known = ~np.isnan(descriptor)
        view = np.where(known, (descriptor - self.mean) / self.spread, 0).astype(np.float32)
        both = np.column_stack([turned(part, turn, yaws=SECTORS) for part in (view, known) for turn in turns])
        views, masks = both[:, : len(turns)], both[:, len(turns) :]
        values = self.values[rows]
        norms = np.sqrt(np.square(values) @ masks.astype(np.float32)) * np.linalg.norm(view)
        return np.asarray((values @ views) / np.maximum(norms, np.float32(1e-6)))


def _alike(numbers: Floats) -> Floats:
    """Give all sectors of a ring their mean, so that standardised descriptors may be turned."""
    parts = numbers.reshape(len(GROUPS), DEPTH).copy()
    rings = parts[:, : RINGS * SECTORS].reshape(len(GROUPS), RINGS, SECTORS)
    rings[:] = rings.mean(axis=2, keepdims=True)
    return parts.ravel()


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A view: the descriptor of all of it, that of its patches in the classes `bands` of the map, and its prior."""

    evidence: Evidence
    bands: NDArray[np.int64]
    descriptor: Floats
    patches: Patches
    prior: Prior

    def allows(self, pose: Pose, disc: Disc) -> bool:
        """Return whether place, heading and scale of a pose are likely by the prior."""
        prior = self.prior
        off_deg = 0.0 if prior.yaw_deg is None else abs(float(wrap_deg(pose.yaw_deg - prior.yaw_deg)))
        return (
            disc.wider(SLACK_M).has(pose)
            and off_deg <= MOST_OFF * (prior.yaw_sigma_deg or 0.0) + _STEP_DEG / 2
            and abs(math.log(pose.scale)) <= MOST_OFF * prior.scale_sigma + SLACK_M / max(self.evidence.size_m)
        )


@dataclass(frozen=True, kw_only=True)
class Agreed(Mode):
    """A pose on which `inliers` of `matched` patches agree; its score is that of its crop."""

    inliers: int
    matched: int


class ZhangHierConsensus(PlaceMatcher[Seen]):
    """Retrieval by one descriptor of the view, and a similarity from patches of the crop that was found."""

    open_numbers = {
        "stride": (6, 8),  # cells between two crops: a view is at most 17 or 23 m off the middle of one
        "near_m": (6.0, 8.0, 12.0),  # of a match from where the similarity puts it; the side of a patch is 8 m
    }
    chosen = {"stride": 6, "near_m": 12.0}

    card = MatcherCard(
        name="zhang_hier_consensus",
        version="1",
        title="Retrieval of a crop, then patch matching with neighbourhood consensus",
        source=(
            "Zhang et al., arXiv 2506.09748, by its abstract and an independent review of its text: the first crop by "
            "the cosine of one descriptor; 4-D cosine correlation of patches, soft mutual nearest neighbours, learned "
            "4-D convolutions, hard assignment, then a transform by RANSAC that takes the image's middle to the map"
        ),
        ours=(
            "Class layers in place of learned features. Crops every 24 m by a descriptor of rings and sectors, "
            "standardised over the map, at headings 22.5 degrees apart within 2.5 standard deviations of the prior; "
            "patches of 8 x 8 cells by shares and mean distances (to 32 m) of the classes, standardised over a crop "
            "that is turned by the heading and 48 m wider than the view on all sides; in place of the convolutions "
            "two rounds of consensus, each of which adds the mean of the eight neighbours at equal offsets; a "
            f"similarity within {chosen['near_m']:g} m of at least four matches; no keypoints. The first crop gives "
            "the first answer, as in the source, and those after it further ones; without a similarity that the prior "
            "allows, the answer is the crop. Score and margin are those of retrieval; inliers and inlier_ratio, those "
            "of the first answer, are diagnostics"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "A wrong first crop is not mended. What a view does not know is left out, what a map does not know counts "
            "as absent in retrieval. No graph, no sequence, no weights by what lasts; its source has no rejection"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Describe the crops of the map."""
        del learned
        self._crops = Crops.of(region, stride=int(self.numbers["stride"]))
        self._chart = Chart.of(region)
        self._used = self._chart.used()

    def look(self, query: Query) -> Seen | None:
        """Describe a view; None where it shares no class with the map, or holds no whole patch."""
        chart, evidence = self._chart, query.evidence
        shared = [name for name in chart.classes if name in evidence.classes and self._used[chart.classes.index(name)]]
        descriptor = view_descriptor(evidence)
        if not shared or np.isnan(descriptor).all() or min(evidence.shape) < SIDE:
            return None
        cells = evidence.cells[[evidence.classes.index(name) for name in shared]]
        return Seen(
            evidence=evidence,
            bands=np.array([chart.classes.index(name) for name in shared], dtype=np.int64),
            descriptor=descriptor,
            patches=Patches.of(cells, evidence.cell_size_m),
            prior=query.prior,
        )

    def modes(self, view: Seen, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses of the best crops, in their order."""
        found = [self.aligned(view, mode, disc) for mode in self.crops(view, disc, count=count)]
        return list(thinned(found, 25.0))  # m: two answers

    def near(self, view: Seen, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best crop near each candidate; the best of these with the pose of their patches."""
        discs = [Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=AROUND_M) for pose in poses]
        found: list[Mode | None] = [next(iter(self.crops(view, disc, count=1)), None) for disc in discs]
        there = [(at, mode) for at, mode in enumerate(found) if mode is not None]
        # 5 candidates of a retrieval query whose patches are matched, the best first
        for at, mode in sorted(there, key=lambda pair: -pair[1].score)[:5]:
            found[at] = self.aligned(view, mode, discs[at])
        return found

    def diagnostics(self, view: Seen, found: Sequence[Mode]) -> dict[str, float]:
        """Return how many matches agree on the first answer, and which share of all."""
        del view
        first = found[0]
        if not isinstance(first, Agreed):
            return {}
        return {"inliers": float(first.inliers), "inlier_ratio": first.inliers / max(1, first.matched)}

    def crops(self, view: Seen, disc: Disc, *, count: int) -> list[Mode]:
        """Return the crops most like a view, each at its best heading, best first."""
        rows = np.flatnonzero(disc.holds(self._crops.middles_m))
        if not len(rows):
            return []
        turns = turns_within(view.prior, SECTORS).tolist()  # sectors east of north
        likeness = self._crops.likeness(view.descriptor, rows, turns)
        turn, best = likeness.argmax(axis=1), likeness.max(axis=1)
        middles_m = self._crops.middles_m[rows]
        chosen = separate(middles_m, best, apart_m=48.0, most=count)  # nearer ones show the same ground
        return [
            Mode(
                pose=Pose(
                    easting_m=float(middles_m[at, 0]),
                    northing_m=float(middles_m[at, 1]),
                    yaw_deg=turns[turn[at]] * _STEP_DEG,
                ),
                score=float(best[at]),
            )
            for at in chosen
        ]

    def aligned(self, view: Seen, crop: Mode, disc: Disc) -> Agreed:
        """Return the pose that the patches of a view and a crop agree on, or else that of the crop."""
        cell_m = view.evidence.cell_size_m
        # 48 m: margin of a crop around a view: twice that, so that turned views fit, too
        margin = math.ceil(48.0 / cell_m / SIDE) * SIDE
        rows, cols = (count // SIDE * SIDE + 2 * margin for count in view.evidence.shape)
        town = self._chart.under(crop.pose, (rows, cols), view.bands, cell_size_m=cell_m)
        if (town == UNKNOWN).all():
            return Agreed(pose=crop.pose, score=crop.score, inliers=0, matched=0)
        # 2 rounds of consensus: a patch hears of those two patches away
        seen_m, mapped_m = matches(view.patches, Patches.of(town, cell_m), rounds=2)
        pose, inliers = similarity(seen_m, mapped_m, crop.pose, near_m=self.numbers["near_m"])
        if pose is None or not view.allows(pose, disc):
            pose, inliers = crop.pose, 0
        return Agreed(pose=pose, score=crop.score, inliers=inliers, matched=len(seen_m))


def similarity(
    seen_m: NDArray[np.float64], mapped_m: NDArray[np.float64], crop: Pose, *, near_m: float
) -> tuple[Pose | None, int]:
    """Return the pose of a view by RANSAC, and how many matches agree with it; None for fewer than four.

    Matches are (right, up) of the middles of the view and of a crop, shape (M, 2).

    >>> crop = Pose(easting_m=100.0, northing_m=50.0, yaw_deg=90.0)
    >>> seen_m = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [-40.0, 0.0], [0.0, -40.0]])
    >>> pose, inliers = similarity(seen_m, seen_m + np.array([[0.0, 16.0]] * 4 + [[60.0, 0.0]]), crop, near_m=8.0)
    >>> round(pose.easting_m, 3), round(pose.northing_m, 3), round(pose.yaw_deg, 3), inliers
    (116.0, 50.0, 90.0, 4)
    """
    if len(seen_m) < LEAST:
        return None, 0
    # 2000 tries of RANSAC
    matrix, agrees = cv2.estimateAffinePartial2D(
        seen_m, mapped_m, method=cv2.RANSAC, ransacReprojThreshold=near_m, maxIters=2000, confidence=0.999
    )
    inliers = 0 if matrix is None else int(np.count_nonzero(agrees))
    if inliers < LEAST:
        return None, 0
    middle_m = crop.to_map(np.array([matrix[:, 2]], dtype=np.float64))[0].tolist()
    turn_deg = math.degrees(math.atan2(-matrix[1, 0], matrix[0, 0]))
    scale = math.hypot(matrix[0, 0], matrix[1, 0])
    if not scale > 0:
        return None, 0
    pose = Pose(easting_m=middle_m[0], northing_m=middle_m[1], yaw_deg=crop.yaw_deg + turn_deg, scale=scale)
    return pose, inliers
