# SPDX-License-Identifier: Apache-2.0
"""`zhang_hier_consensus`: retrieval of a crop, then patches that match it with the consent of their neighbours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.global_descriptor import separate
from sasgeo_baselines.patches import SIDE, Patches, matches
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

SLACK_M: Final = 8.0  # beyond the disc of the prior: the side of a patch, as places are middles of them
LEAST: Final = 4  # matches that agree: two make a similarity
MOST_OFF: Final = 3.0  # standard deviations of the prior, of a heading or scale that is found
_STEP_DEG: Final = 360.0 / SECTORS

Floats = NDArray[np.float32]


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
