# SPDX-License-Identifier: Apache-2.0
"""`popov_roadplane`: a front end that straightens a tilted view by the borders of its roads (Popov et al. 2026)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sasgeo_baselines.place_matcher import AROUND_M
from sasgeo_baselines.roads import Bools, Floats, road_cells, road_mask, view_grid
from sasgeo_baselines.schmidt_segcorr import SchmidtSegcorr
from sasgeo_baselines.tunable import Tunable
from sasgeo_bench import (
    PRESENT,
    UNKNOWN,
    Grid,
    Match,
    Matcher,
    MatcherCard,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    rotation,
    thinned,
)

STARTS: Final = 3  # first answers that are tried
ROUNDS: Final = 24
# Standard deviations of what a homography does at the edge of a view, in halves of the view: a similarity leaves the
# place, heading and scale of the start open; shear is small; a perspective of 0.2 is a tilt of 15 degrees from 137 m.
SIMILARITY, SHEAR, PERSPECTIVE = 0.15, 0.05, 0.2
APART_M: Final = 25.0
_HORIZON: Final = 0.1  # least denominator of a homography: 0 is the horizon

# What the eight parameters (see `matrix_of`) are likely to be: each row is one that is 0, give or take 1.
_PRIOR: Final = (
    np.array(
        [
            [0.5, 0, 0, 0, 0.5, 0, 0, 0],  # scale
            [0, 0.5, 0, -0.5, 0, 0, 0, 0],  # heading
            [0, 0, 1, 0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0, 1, 0, 0],
            [0.5, 0, 0, 0, -0.5, 0, 0, 0],  # shear
            [0, 0.5, 0, 0.5, 0, 0, 0, 0],
            [0, 0, 0, 0, 0, 0, 1, 0],
            [0, 0, 0, 0, 0, 0, 0, 1],
        ]
    )
    / np.repeat([SIMILARITY, SHEAR, PERSPECTIVE], [4, 2, 2])[:, None]
)


@dataclass(frozen=True, kw_only=True)
class Borders:
    """Points on the borders of roads, shape (N, 2), metres, and the unit vectors that lead off the road there."""

    places_m: Floats
    outward: Floats

    @classmethod
    def of(cls, present: Bools, known: Bools, grid: Grid) -> Self:
        """Find the borders in a mask of roads, away from unknown cells and from the edge.

        Examples
        --------
        A road that leads north, 10 m wide:

        >>> mask = np.zeros((40, 40), dtype=bool)
        >>> mask[:, 15:25] = True
        >>> grid = Grid(epsg=0, west_m=-20.0, north_m=20.0, cell_size_m=1.0, rows=40, cols=40)
        >>> found = Borders.of(mask, np.ones_like(mask), grid)
        >>> np.unique(found.places_m[:, 0]).tolist(), np.unique(found.outward[:, 0].round(3)).tolist()
        ([-5.0, 5.0], [-1.0, 1.0])
        """
        # 1.5 cells, for the direction of a border
        blurred = cv2.GaussianBlur(present.astype(np.float32), (0, 0), 1.5)
        right, down = (cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
        steep = np.hypot(right, down)
        core = cv2.erode(present.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1)
        usable = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)
        at = np.argwhere(present & (core == 0) & (usable > 0) & (steep > 0))
        slope = np.stack([right, -down], axis=-1)[at[:, 0], at[:, 1]].astype(np.float64)
        outward = -slope / np.linalg.norm(slope, axis=1, keepdims=True)
        return cls(places_m=grid.to_centres_m(at) + outward * grid.cell_size_m / 2, outward=outward)

    def some(self, most: int) -> Self:
        """Return at most so many of the points, evenly."""
        every = max(1, -(-len(self.places_m) // most))
        return type(self)(places_m=self.places_m[::every], outward=self.outward[::every])

    def embedded(self) -> Floats:
        """Return points in which distance means place and direction, shape (N, 4)."""
        # 30 m: two borders that face opposite ways seem twice this farther apart: the other side of a road
        return np.hstack([self.places_m, 30.0 * self.outward])


def matrix_of(parameters: Floats) -> Floats:
    """Return a homography, shape (3, 3), of its eight parameters: its numbers but the last, less the identity's.

    Examples
    --------
    What is seen ahead (up) lies farther away than it seems:

    >>> tilt = matrix_of(np.array([0, 0, 0, 0, 0, 0, 0, -0.2]))
    >>> through(tilt, np.array([[0.0, 0.5], [0.0, -0.5]])).round(3).tolist()
    [[0.0, 0.556], [0.0, -0.455]]
    """
    return np.asarray(np.eye(3) + np.append(parameters, 0.0).reshape(3, 3))


def through(matrix: Floats, at: Floats) -> Floats:
    """Return where a homography moves places, shape (N, 2); what lies behind the horizon goes far away."""
    shown = np.column_stack([at, np.ones(len(at))]) @ matrix.T
    return np.asarray(shown[:, :2] / np.maximum(shown[:, 2:], _HORIZON))


def upright(matrix: Floats) -> Floats:
    """Return a homography followed by the similarity that brings a square back to where it was, as near as can be.

    Place, heading and scale of a view are for the matcher to find; the square reaches from -1 to 1.

    Examples
    --------
    Nothing is left of a similarity:

    >>> turned = np.array([[0.0, -1.1, 0.3], [1.1, 0.0, -0.2], [0.0, 0.0, 1.0]])
    >>> bool(np.abs(upright(turned) - np.eye(3)).max() < 1e-9)
    True
    """
    steps = np.linspace(-1.0, 1.0, 9)
    ground = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) @ (1.0, 1.0j)
    shown = through(matrix, np.column_stack([ground.real, ground.imag])) @ (1.0, 1.0j)
    off = shown - shown.mean()
    factor = (off.conj() * ground).sum() / np.square(np.abs(off)).sum()  # the square's middle is 0
    shift = -factor * shown.mean()
    back = [[factor.real, -factor.imag, shift.real], [factor.imag, factor.real, shift.imag], [0.0, 0.0, 1.0]]
    return np.asarray(np.array(back) @ matrix)


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """A homography of a view, in halves of its longer side, that lays its borders on those of a map.

    `share` is the share of its borders that lie within 3 m of a mapped one, `before` that at `pose` without it.
    """

    pose: Pose
    matrix: Floats
    share: float
    before: float

    @classmethod
    def of(cls, seen: Borders, mapped: Borders, pose: Pose, half_m: float) -> Self:
        """Align borders, from a pose: nearest ones that face the same way, least squares with a prior, and again."""
        tree, turn = cKDTree(mapped.embedded()), rotation(pose.yaw_deg)
        at, outward = seen.places_m / half_m, seen.outward @ turn.T

        def nearest(parameters: Floats) -> tuple[Floats, Floats]:
            there_m = pose.to_map(through(matrix_of(parameters), at) * half_m)
            _, row = tree.query(Borders(places_m=there_m, outward=outward).embedded())
            return (mapped.places_m[row] - there_m) @ turn, mapped.outward[row] @ turn

        def share(parameters: Floats) -> float:
            # 3 m: a seen border this near to a mapped one lies on it
            return float((np.linalg.norm(nearest(parameters)[0], axis=1) <= 3.0).mean())

        found = np.zeros(8)
        # A seen border is drawn to a mapped one within this, in the first round and in the last
        for pull_m in np.linspace(*(20.0, 4.0), ROUNDS):
            way_m, normal = nearest(found)
            # 10 m: standard deviation of the place of a border: of one among many that err alike
            weight = np.maximum(1.0 - np.square(way_m).sum(axis=1) / pull_m**2, 0.0) / 10.0**2
            found = found + _step(found, at, normal * half_m, (way_m * normal).sum(axis=1), weight)
        # 7 decimals of a homography: far less than a cell, and more than what the last bits of a sum change
        matrix = upright(matrix_of(found)).round(7)
        return cls(pose=pose, matrix=matrix, share=share(found), before=share(np.zeros(8)))


def _step(parameters: Floats, at: Floats, normal: Floats, way_m: Floats, weight: Floats) -> Floats:
    ahead = np.column_stack([at, np.ones(len(at))])
    below = np.maximum(ahead @ matrix_of(parameters)[2], _HORIZON)
    across = (normal * through(matrix_of(parameters), at)).sum(axis=1)
    slope = np.hstack([normal[:, :1] * ahead, normal[:, 1:] * ahead, -across[:, None] * at]) / below[:, None]
    ties = _PRIOR.T @ _PRIOR
    left = slope.T @ (weight[:, None] * slope) + ties
    return np.asarray(np.linalg.solve(left, slope.T @ (weight * way_m) - ties @ parameters))


def straightened(query: Query, matrix: Floats) -> Query:
    """Return a query whose view, its vectors too, is moved by a homography in halves of its longer side.

    Ground that is not seen is unknown.
    """
    evidence, half_m = query.evidence, max(query.evidence.size_m) / 2
    rows, cols = evidence.shape
    pixels = evidence.cell_size_m / half_m
    to_view = np.array([[pixels, 0, (1 - cols) / 2 * pixels], [0, -pixels, (rows - 1) / 2 * pixels], [0, 0, 1]])
    in_cells = np.linalg.inv(to_view) @ matrix @ to_view

    def warped(layers: NDArray[np.uint8], beyond: int) -> NDArray[np.uint8]:
        """Move layers; what comes from beyond the view has the value `beyond`."""
        found = [
            cv2.warpPerspective(
                layer,
                in_cells,
                (cols, rows),
                flags=cv2.INTER_NEAREST,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=beyond,
            )
            for layer in layers
        ]
        return np.asarray(found, dtype=np.uint8)

    confidence = None if evidence.confidence is None else warped(evidence.confidence, 0)
    vectors = query.vectors
    if vectors is not None:
        shapes = vectors.geometry.to_numpy()
        moved = shapely.transform(shapes, lambda at_m: through(matrix, at_m / half_m) * half_m)
        vectors = vectors.set_geometry(moved)
    return replace(query, evidence=evidence.replace(warped(evidence.cells, UNKNOWN), confidence), vectors=vectors)


class PopovRoadplane(Tunable):
    """A matcher before which views are straightened by the borders of roads around its first answers."""

    open_numbers = {
        # Of seen borders that lie on mapped ones, and their gain: in a dense town chance alone gives a share of 0.15.
        "least_share": (0.2, 0.3, 0.4),
        "least_gain": (0.02, 0.05),
    }
    chosen = {"least_share": 0.2, "least_gain": 0.02}

    card = MatcherCard(
        name="popov_roadplane",
        version="1",
        title="Views straightened by road borders, then overlap class by class",
        source=(
            "Popov et al. 2026, Mobile Traffic Camera Calibration from Road Geometry for UAV-Based Traffic "
            "Surveillance: a homography from the picture to the plane of the road by borders, lanes and crosswalks. It "
            "calibrates a camera over a known road, shown on one sequence with correspondences checked by hand; it "
            "does not localize"
        ),
        ours=(
            "A front end of `schmidt_segcorr`, made of that idea: from each of its first three answers, borders of "
            "seen roads are drawn to mapped ones that face the same way by ICP, 24 rounds from 20 to 4 m, point to "
            "line, for a homography of eight parameters with a prior (0.15 for place, heading and scale, 0.05 for "
            "shear, 0.2 for perspective, in halves of the view). Where the best lays at least "
            f"{chosen['least_share']:g} of the borders within 3 m, and {chosen['least_gain']:g} more than before,  the "
            "view is moved by it, less the similarity in it, and matched again around that answer; what is found "
            "comes first if it scores higher"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Changes nothing where few borders are seen, or where none of the first three answers is near; a plane "
            "only, so no relief; borders of a map are drawn by its rules for widths; else as the matcher behind it"
        ),
    )

    def __init__(self, inner: Matcher | None = None, **numbers: float) -> None:
        super().__init__(**numbers)
        self.inner: Matcher = inner or SchmidtSegcorr()

    def prepare(self, region: Region, learned: str | None) -> None:
        """Prepare the matcher, and read the roads of the map."""
        self.inner.prepare(region, learned)
        self._roads, self._known, self._grid = road_mask(region), region.known(), region.grid

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the answer to a view, with that to the straightened view before it if that scores higher."""
        first = self.inner.match(query, top_k=max(top_k, STARTS))
        if not first.poses:
            return first
        found = self.alignment(query, first.poses[:STARTS])
        reported = {} if found is None else {"borders": found.share, "borders_before": found.before}
        answer = first
        least_share, least_gain = self.numbers["least_share"], self.numbers["least_gain"]
        if found is not None and found.share >= max(least_share, found.before + least_gain):
            answer = _better(first, self.inner.match(self._again(query, found), top_k=top_k), query)
        reported["is_straightened"] = float(answer is not first)
        return replace(
            answer,
            poses=answer.poses[:top_k],
            scores=answer.scores[:top_k],
            diagnostics={**answer.diagnostics, **reported},
        )

    def _again(self, query: Query, found: Alignment) -> Query:
        """Return the question about the straightened view: around the pose it was aligned from, or of candidates."""
        seen = straightened(query, found.matrix)
        if query.track == "retrieval":
            return seen
        place_m = (found.pose.easting_m, found.pose.northing_m)
        near = Prior(
            center_m=place_m,
            radius_m=AROUND_M,
            yaw_deg=found.pose.yaw_deg,
            yaw_sigma_deg=5.0,  # standard deviation of the heading of a first answer
            scale_sigma=query.prior.scale_sigma,
        )
        return replace(seen, prior=near)

    def alignment(self, query: Query, starts: Sequence[Pose]) -> Alignment | None:
        """Return the best alignment from some poses; None where too few borders are seen."""
        cells, grid = road_cells(query.evidence), view_grid(query.evidence)
        # At most 500 points along the borders of a view; of more, every n-th is taken
        seen = Borders.of(cells == PRESENT, cells != UNKNOWN, grid).some(500)
        if len(seen.places_m) < 60:  # at least 60 points of borders, for eight unknowns
            return None
        half_m = max(query.evidence.size_m) / 2
        # 40 m: margin of the map around a view
        around = [(self._around(pose, np.sqrt(2) * half_m + 40.0), pose) for pose in starts]
        found = [Alignment.of(seen, mapped, pose, half_m) for mapped, pose in around if len(mapped.places_m)]
        flat = [alignment for alignment in found if np.abs(alignment.matrix[2, :2]).sum() < 1.0 - _HORIZON]
        return max(flat, key=lambda alignment: alignment.share, default=None)

    def _around(self, pose: Pose, radius_m: float) -> Borders:
        row, col = self._grid.to_cells(np.array([[pose.easting_m, pose.northing_m]]))[0].tolist()
        reach = round(radius_m / self._grid.cell_size_m)
        top, left = max(row - reach, 0), max(col - reach, 0)
        part = (slice(top, max(row + reach, 0)), slice(left, max(col + reach, 0)))
        present = self._roads[part]
        if not present.any():
            return Borders(places_m=np.zeros((0, 2)), outward=np.zeros((0, 2)))
        return Borders.of(present, self._known[part], self._grid.window(top, left, *present.shape))


def _better(first: Match, again: Match, query: Query) -> Match:
    """Return an answer with the best of a later one before it, or itself if it scores as high."""
    if not again.scores or again.scores[0] <= first.scores[0]:
        return first
    if query.track == "retrieval":
        return again
    answers = zip((again.poses[0], *first.poses), (again.scores[0], *first.scores), strict=True)
    modes = thinned((Mode(pose=pose, score=score) for pose, score in answers), APART_M)
    scores = [mode.score for mode in modes]
    margin = {"margin": scores[0] - scores[1]} if len(scores) > 1 else {}
    return Match(poses=[mode.pose for mode in modes], scores=scores, diagnostics={**again.diagnostics, **margin})
