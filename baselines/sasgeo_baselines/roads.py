# SPDX-License-Identifier: Apache-2.0
"""Roads of views and maps as points along their middle lines, and how well the two lie on each other."""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.morphology import skeletonize

from sasgeo_baselines.object_matcher import fitted
from sasgeo_bench import ABSENT, PRESENT, UNKNOWN, Disc, Evidence, Grid, Pose, Query, Region, inverse, load_taxonomy

ROADS: Final = load_taxonomy().of_graph("road")
NEAR_M: Final = 5.0  # of a road: a point this near lies on it
FAR, ON, UNSURE = 0, 1, 2  # of cells of a map: whether a road is near
_TILE: Final = 2048  # cells a side
_MARGIN: Final = 64  # around a tile, so that lines go on from one to the next
_CHUNK: Final = 2048  # poses at a time

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def road_mask(region: Region) -> Bools:
    """Return the cells of a map where any road is, shape (rows, cols)."""
    mask = np.zeros(region.grid.shape, dtype=bool)
    for name in ROADS:
        if name in region.classes:
            mask |= region.layer(name) == PRESENT
    return mask


def road_cells(evidence: Evidence) -> NDArray[np.uint8]:
    """Return where a view shows any road, shape (rows, cols): UNKNOWN where one may be that is not seen."""
    layers = [evidence.layer(name) for name in ROADS if name in evidence.classes]
    if not layers:
        return np.full(evidence.shape, UNKNOWN, dtype=np.uint8)
    is_present = np.any([layer == PRESENT for layer in layers], axis=0)
    is_unknown = np.any([layer == UNKNOWN for layer in layers], axis=0)
    return np.where(is_present, PRESENT, np.where(is_unknown, UNKNOWN, ABSENT)).astype(np.uint8)


def view_grid(evidence: Evidence) -> Grid:
    """Return the lattice of a view in (right, up) from its middle."""
    width_m, height_m = evidence.size_m
    rows, cols = evidence.shape
    return Grid(
        epsg=0, west_m=-width_m / 2, north_m=height_m / 2, cell_size_m=evidence.cell_size_m, rows=rows, cols=cols
    )


def middle_cells(mask: Bools) -> Ints:
    """Return row and column of the cells along the middle lines of a mask, shape (N, 2).

    Examples
    --------
    A road five cells wide, all along a view:

    >>> mask = np.zeros((20, 40), dtype=bool)
    >>> mask[8:13] = True
    >>> cells = middle_cells(mask)
    >>> np.unique(cells[np.abs(cells[:, 1] - 20) < 10, 0]).tolist()
    [10]
    """
    found = [np.zeros((0, 2), dtype=np.int64)]
    rows, cols = mask.shape
    for top in range(0, rows, _TILE):
        for left in range(0, cols, _TILE):
            low, side = max(top - _MARGIN, 0), max(left - _MARGIN, 0)
            part = mask[low : top + _TILE + _MARGIN, side : left + _TILE + _MARGIN]
            closed = cv2.morphologyEx(part.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
            cells = np.argwhere(skeletonize(closed > 0)) + np.array([low, side])
            is_own = (cells >= (top, left)).all(axis=1) & (cells < (top + _TILE, left + _TILE)).all(axis=1)
            found.append(cells[is_own])
    return np.concatenate(found)


def beside(cells: Ints, shape: tuple[int, int], cell_size_m: float) -> Bools:
    """Return which cells of a lattice have their middle within `NEAR_M` of that of any of some cells."""
    away = np.ones(shape, dtype=np.uint8)
    away[cells[:, 0], cells[:, 1]] = 0
    if away.all():
        return np.zeros(shape, dtype=bool)
    return np.asarray(cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * cell_size_m <= NEAR_M)


def looked_up(grid: Grid, values: NDArray[np.uint8], places_m: Floats, *, beyond: int) -> NDArray[np.uint8]:
    """Return the values of the cells at places, shape (..., 2), and `beyond` where there is no cell."""
    cell = grid.to_uv(places_m)
    col, row = np.floor(cell[..., 0]).astype(np.int64), np.floor(cell[..., 1]).astype(np.int64)
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    found = values.ravel().take(np.where(inside, row * grid.cols + col, 0))
    return np.where(inside, found, np.uint8(beyond))


@dataclass(frozen=True, kw_only=True)
class SeenRoads:
    """Roads of a view: points along them, (right, up) metres, shape (S, 2), and the state of each of its cells.

    `state`, uint8 of shape (rows, cols), is `ON` within 5 m of a road, `UNSURE` where none is seen and none is known to
    be absent.
    """

    points_m: Floats
    grid: Grid
    state: NDArray[np.uint8]

    @classmethod
    def of(cls, query: Query) -> Self:
        """Read the roads of a view: its vectors, if they hold any, else the middle lines of its masks."""
        cells, grid = road_cells(query.evidence), view_grid(query.evidence)
        points_m = _points_of_vectors(query)
        if points_m is None:
            points_m = grid.to_centres_m(middle_cells(cells == PRESENT))
        near = grid.to_cells(points_m)
        inside = (near >= 0).all(axis=1) & (near < grid.shape).all(axis=1)
        is_near = beside(near[inside], grid.shape, grid.cell_size_m)
        state = np.where(is_near, ON, np.where(cells == UNKNOWN, UNSURE, FAR)).astype(np.uint8)
        every = max(1, -(-len(points_m) // 400))  # 400 points of a view; of more, every n-th is taken
        return cls(points_m=points_m[inside][::every], grid=grid, state=state)

    @property
    def reach_m(self) -> float:
        """Return how far the corners of the view lie from its middle."""
        return float(np.hypot(*self.grid.shape)) * self.grid.cell_size_m / 2


def _points_of_vectors(query: Query) -> Floats | None:
    """Return points along the roads among the vectors of a view, None if they have none."""
    vectors = query.vectors
    if vectors is None or not vectors["class"].isin(ROADS).any():
        return None
    lines = vectors.geometry.to_numpy()[vectors["class"].isin(ROADS).to_numpy()]
    lines = lines[shapely.length(lines) > 0]  # a line between equal points cannot be cut
    # 3 m: step between points of vectors
    return np.asarray(shapely.get_coordinates(shapely.segmentize(lines, 3.0)), dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class MappedRoads:
    """Roads of a map: points along them, easting and northing, and whether a road is near each cell.

    `state`, uint8 of shape (rows, cols), is `ON` within 5 m of a road, else `FAR`, or `UNSURE` off the known map.
    """

    points_m: Floats
    tree: cKDTree
    grid: Grid
    state: NDArray[np.uint8]

    @classmethod
    def of(cls, region: Region) -> Self:
        """Read the roads of a map."""
        cells = middle_cells(road_mask(region))
        state = beside(cells, region.grid.shape, region.grid.cell_size_m).astype(np.uint8)
        state[~region.known()] = UNSURE
        points_m = region.grid.to_centres_m(cells)
        return cls(points_m=points_m, tree=cKDTree(points_m), grid=region.grid, state=state)

    def hits(self, points_m: Floats, poses: Floats) -> Floats:
        """Return the share of seen points that lie on a mapped road under each pose, shape (V,).

        `poses`, shape (V, 3), are easting, northing and heading. Points off the known map do not count; where they are
        more than half, the share is 0.
        """
        shares = [self._hits(points_m, part) for part in np.split(poses, range(_CHUNK, len(poses), _CHUNK))]
        return np.concatenate(shares)

    def _hits(self, points_m: Floats, poses: Floats) -> Floats:
        yaw = np.radians(poses[:, 2:])
        sine, cosine = np.sin(yaw), np.cos(yaw)
        right_m, up_m = points_m.T
        east_m = poses[:, :1] + cosine * right_m + sine * up_m
        north_m = poses[:, 1:2] - sine * right_m + cosine * up_m
        state = looked_up(self.grid, self.state, np.stack([east_m, north_m], axis=-1), beyond=UNSURE)
        known = (state != UNSURE).sum(axis=1)
        share = (state == ON).sum(axis=1) / np.maximum(known, 1)
        # 0.5 of the seen points that must lie where the map is known
        return np.where(known >= 0.5 * len(points_m), share, 0.0)

    def missed(self, seen: SeenRoads, pose: Pose) -> float:
        """Return the share of mapped points within the known part of a view that lie on no road it shows."""
        rows = self.tree.query_ball_point((pose.easting_m, pose.northing_m), seen.reach_m, return_sorted=True)
        if not rows:
            return 0.0
        state = looked_up(seen.grid, seen.state, inverse(pose).to_map(self.points_m[rows]), beyond=UNSURE)
        known = int((state != UNSURE).sum())
        return float((state == FAR).sum() / known) if known else 0.0

    def agreement(self, seen: SeenRoads, pose: Pose) -> float:
        """Return the share of seen road points on a mapped road, less the share of mapped ones that are not seen.

        From -1 to 1.
        """
        here = np.array([[pose.easting_m, pose.northing_m, pose.yaw_deg]])
        return float(self.hits(seen.points_m, here)[0]) - self.missed(seen, pose)

    def settled(self, seen: SeenRoads, pose: Pose, disc: Disc) -> Pose:
        """Return the rigid pose nearby that draws seen points to the nearest mapped ones (ICP), within a disc."""
        pull_m = 10.0  # m: a seen point is drawn to a mapped one within this, at first
        for _ in range(8):  # rounds of the fit; it stands still before
            at_m = pose.to_map(seen.points_m)
            away_m, nearest = (np.asarray(part) for part in self.tree.query(at_m, distance_upper_bound=pull_m))
            pairs = np.isfinite(away_m)
            if pairs.sum() < 10:  # of points, for a fit
                break
            moved, _ = fitted(seen.points_m[pairs], self.points_m[nearest[pairs]])
            if not disc.has(moved):
                break
            pose, pull_m = moved, max(NEAR_M, 0.8 * pull_m)  # outliers are let go of little by little
        return pose
