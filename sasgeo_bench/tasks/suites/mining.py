# SPDX-License-Identifier: Apache-2.0
"""Decoys: the places most like the true one by four different scorers, so that they favour no single method."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.graph import LAYERS
from sasgeo_bench.tasks.state import BLOCK_M, DRAWN_CLASSES, State

if TYPE_CHECKING:
    import geopandas as gpd

SCORERS: Final = ("histogram", "rings", "distance", "graph")
STRIDE_M: Final = 32.0
LEAST_RADII: Final = 3.0  # least distance of a decoy from the truth, in half diagonals of the footprint

RINGS: Final = 4
_SECTORS: Final = 12
_FAR_M: Final = 64.0  # distances are clipped here
_THIN: Final = (*LAYERS, *load_taxonomy().of_graph("building"))
_NODE_KINDS: Final = (
    *("intersection", "dead_end", "crossing", "building", "building_cluster", "level_crossing"),
    *("river_bend", "road_rail_crossing", "road_water_crossing"),
)
Floats = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Every place on a lattice of a map, with the descriptors of four scorers.

    `points_m` is easting and northing, shape (N, 2). Each descriptor of `plain` and `spectrum` has shape (N, D); those
    of `plain` have columns of unit variance over the map, or another one; `spread` is what they were divided by.
    `polar` has shape (N, D, sectors); `shares`, shape (N, D), are fractions of the drawn classes in rings, 0..1.
    """

    points_m: NDArray[np.float64]
    radius_m: float
    shares: Floats
    plain: dict[str, Floats]
    spread: dict[str, Floats]
    polar: Floats
    spectrum: Floats


def describe(state: State, *, side_m: float, clear_m: float, like: Windows | None = None) -> Windows:
    """Describe every mapped place of a map, on a lattice, for views of one side.

    A square of half side `clear_m` around a place must be mapped, as around a site: a place nearer to the rim of the
    map could not be the true one. `like` are windows of another map of the same classes whose scale is taken, so that
    the two can be compared.

    Notes
    -----
    The scorers: fractions of the classes in the disc; fractions in rings; distances to thin classes on a polar grid at
    the best rotation; graph nodes by kind in two rings. None of them is an evaluated method.
    """
    grid, known, shares = state.blocks.grid, state.blocks.known, state.blocks.shares
    radius = side_m / 2 / grid.cell_size_m
    kernels = _rings(radius, RINGS)
    step = max(1, round(STRIDE_M / grid.cell_size_m))
    rows, cols = np.meshgrid(
        np.arange(step // 2, grid.rows, step), np.arange(step // 2, grid.cols, step), indexing="ij"
    )
    square = np.ones((2 * math.ceil(clear_m / grid.cell_size_m) + 1,) * 2, dtype=np.uint8)
    # Outside the map nothing is known: the border counts as 0.
    whole = (known >= 1).astype(np.uint8)
    mapped = cv2.erode(whole, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)[rows, cols] == 1
    cells = np.column_stack((rows[mapped], cols[mapped])).astype(np.int64)
    rings = np.stack(
        [_filtered(share, kernel)[cells[:, 0], cells[:, 1]] for share in shares.values() for kernel in kernels],
        axis=1,
    ).reshape(len(cells), len(state.classes), RINGS)
    drawn = [index for index, name in enumerate(state.classes) if name in (*DRAWN_CLASSES, "water")]
    areas = np.array([kernel.size for kernel in kernels], dtype=np.float32)
    polar = _polar(shares, cells, radius)
    tables = {
        "histogram": (rings * areas).sum(axis=2) / areas.sum(),
        "rings": rings.reshape(len(cells), -1),
        "graph": _node_counts(state.graph.nodes, grid.to_centres_m(cells), side_m / 2),
    }
    spread = {name: _spread(table) for name, table in tables.items()} if like is None else like.spread
    return Windows(
        points_m=grid.to_centres_m(cells),
        radius_m=side_m / 2,
        shares=rings[:, drawn].reshape(len(cells), -1),
        plain={name: np.asarray(table / spread[name], dtype=np.float32) for name, table in tables.items()},
        spread=spread,
        polar=polar,
        spectrum=np.abs(np.fft.rfft(polar, axis=2)).astype(np.float32).reshape(len(cells), -1),
    )


def _rings(radius: float, count: int) -> list[Floats]:
    """Return kernels of equal area that tile a disc, each with sum 1."""
    reach = int(np.ceil(radius))
    down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    ring = np.floor(count * (down**2 + right**2) / max(radius, 1.0) ** 2).astype(int)
    kernels = []
    for index in range(count):
        kernel = (ring == index).astype(np.float32)
        kernels.append(kernel / max(float(kernel.sum()), 1.0))
    return kernels


def _filtered(share: Floats, kernel: Floats) -> Floats:
    if not share.any():  # as of most classes on most maps
        return np.zeros_like(share)
    return np.asarray(cv2.filter2D(share, -1, kernel, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)


def _polar(shares: dict[str, Floats], cells: NDArray[np.int64], radius: float) -> Floats:
    """Return clipped distances to thin classes on rings and sectors, shape (N, classes * rings, sectors), 0..1."""
    turns = np.arange(_SECTORS) * 2 * np.pi / _SECTORS
    reach = radius * (np.arange(RINGS) + 0.5) / RINGS
    down = np.rint(-np.cos(turns)[None, :] * reach[:, None]).astype(int)  # sector 0 is north, the next one clockwise
    right = np.rint(np.sin(turns)[None, :] * reach[:, None]).astype(int)
    found = []
    for name in _THIN:
        if name not in shares:
            continue
        distance = cv2.distanceTransform((shares[name] <= 0).astype(np.uint8), cv2.DIST_L2, 3)
        near = np.minimum(distance, _FAR_M / BLOCK_M) * (BLOCK_M / _FAR_M)
        rows = np.clip(cells[:, 0, None, None] + down, 0, near.shape[0] - 1)
        cols = np.clip(cells[:, 1, None, None] + right, 0, near.shape[1] - 1)
        found.append(near[rows, cols])
    return np.concatenate(found, axis=1).astype(np.float32)


def _node_counts(nodes: "gpd.GeoDataFrame", points_m: NDArray[np.float64], radius_m: float) -> Floats:
    """Return square roots of the counts of nodes of each kind, within half the disc's area and within all of it."""
    kinds = nodes["kind"].to_numpy()
    counts = np.zeros((len(points_m), 2 * len(_NODE_KINDS)), dtype=np.float32)
    centres = shapely.points(points_m)
    for at, kind in enumerate(_NODE_KINDS):
        tree = shapely.STRtree(nodes.geometry.to_numpy()[kinds == kind])
        for ring, reach_m in enumerate((radius_m / np.sqrt(2), radius_m)):
            hit = tree.query(centres, predicate="dwithin", distance=reach_m)[0]
            counts[:, 2 * at + ring] = np.bincount(hit, minlength=len(points_m))
    return np.sqrt(counts)


def _spread(table: Floats) -> Floats:
    """Return the standard deviation of each column, 1 for one that is the same everywhere."""
    spread = table.std(axis=0)
    return np.asarray(np.where(spread > 0, spread, 1.0))


@dataclass(frozen=True, kw_only=True)
class Decoys:
    """Places most like one, most alike first, all far enough from it.

    `alias_index`, 0..1, is the likeness of the most similar place: the mean of the overlap of the drawn classes'
    fractions in rings, and of 1 minus the root mean square error of distances to thin classes at the best rotation.
    Neither depends on the map, so regions can be compared. `scorer` names the scorer of each place; `points_m` has
    shape (N, 2).
    """

    points_m: NDArray[np.float64]
    scorer: tuple[str, ...]
    alias_index: float


def mine(windows: Windows, center_m: tuple[float, float], *, count: int) -> Decoys:
    """Find up to `count` decoys for one place: the best of each scorer in turn.

    No decoy is nearer than `LEAST_RADII` half diagonals to the truth or to another decoy. If decoys were nearer to each
    other than to the truth, the most isolated candidate would be the true one.
    """
    distance_m = np.hypot(*(windows.points_m - center_m).T)
    is_far = distance_m >= min_distance_m(windows.radius_m)
    here = int(np.argmin(distance_m)) if len(distance_m) else -1
    if here < 0 or not is_far.any():
        return Decoys(points_m=np.zeros((0, 2)), scorer=(), alias_index=0.0)
    far = np.flatnonzero(is_far)
    order = []
    for name in SCORERS:
        distance = _distances(windows, name, here, far)
        order.append(far[_ascending(distance)])
        if name == "distance":
            misses = float(distance.min()) / math.sqrt(windows.polar[here].size)
    spacing_m = min_distance_m(windows.radius_m)
    picked = list(_in_turn(order, windows.points_m, spacing_m=spacing_m, count=count))
    return Decoys(
        points_m=windows.points_m[[index for index, _ in picked]].reshape(-1, 2),
        scorer=tuple(name for _, name in picked),
        alias_index=(_overlap(windows.shares, here, far) + 1.0 - misses) / 2,
    )


def _ascending(values: Floats) -> NDArray[np.int64]:
    """Return what a stable `argsort` of values that are not negative does, in a quarter of its time."""
    # Their bits sort as they do, and behind these stands the place of each.
    keys = values.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
    keys |= np.arange(len(values), dtype=np.uint64)
    keys.sort()
    return keys.astype(np.uint32).astype(np.int64)


def _overlap(shares: Floats, here: int, far: NDArray[np.int64]) -> float:
    """Return the largest overlap of fractions in rings with another place: 1 minus the Bray-Curtis dissimilarity."""
    # All places, as to pick out those afar takes longer.
    difference = np.abs(shares - shares[here]).sum(axis=1)[far]
    total = (shares + shares[here]).sum(axis=1)[far]
    return 1.0 - float(np.divide(difference, total, out=np.zeros_like(difference), where=total > 0).min())


def min_distance_m(radius_m: float) -> float:
    """Return the least distance between a decoy and the truth, for views of half that side: three half diagonals."""
    return LEAST_RADII * radius_m * float(np.sqrt(2))


def _distances(windows: Windows, name: str, here: int, far: NDArray[np.int64]) -> Floats:
    if name in windows.plain:
        return _away(windows.plain[name], here)[far]
    # The magnitude of the spectrum does not depend on rotation and gives the short list; there the best one counts.
    rough = _away(windows.spectrum, here)[far]
    # 400 places whose best rotation is searched; the others are too different at any rotation
    short = _ascending(rough)[:400]
    ours, theirs = windows.polar[here], windows.polar[far[short]]
    turned = np.stack([np.roll(ours, turn, axis=1) for turn in range(_SECTORS)]).reshape(_SECTORS, -1)
    flat = theirs.reshape(len(short), -1)
    squared = (flat**2).sum(axis=1)[:, None] - 2 * flat @ turned.T + (turned**2).sum(axis=1)[None, :]
    best = np.sqrt(np.maximum(squared.min(axis=1), 0.0))
    distance = best.max() + rough
    distance[short] = best
    return np.asarray(distance, dtype=np.float32)


def _away(table: Floats, here: int) -> Floats:
    """Return the Euclidean distance of each row from one."""
    difference = table - table[here]
    np.multiply(difference, difference, out=difference)
    return np.asarray(np.sqrt(difference.sum(axis=1)))


def _in_turn(
    order: list[NDArray[np.int64]], points_m: NDArray[np.float64], *, spacing_m: float, count: int
) -> Iterator[tuple[int, str]]:
    """Yield the best of each scorer in turn, then the second best, and so on; skip places near a taken one."""
    places = np.rint((points_m - points_m.min(axis=0)) / STRIDE_M).astype(np.int64)
    reach = int(np.ceil(spacing_m / STRIDE_M))
    offsets_m = np.arange(-reach, reach + 1) * STRIDE_M
    disc = np.hypot(offsets_m[:, None], offsets_m[None, :]) < spacing_m
    # One cell for each place of the lattice, with a margin as wide as the disc, so that it need not be clipped.
    is_taken = np.zeros(places.max(axis=0) + 1 + 2 * reach, dtype=bool)
    flat = np.ravel_multi_index(tuple((places + reach).T), is_taken.shape)
    taken, at = 0, [0] * len(order)
    while taken < count and any(at[scorer] < len(ranked) for scorer, ranked in enumerate(order)):
        for scorer, ranked in enumerate(order):
            at[scorer] = _next_free(ranked, at[scorer], is_taken.ravel(), flat)
            if at[scorer] == len(ranked):
                continue
            index = int(ranked[at[scorer]])
            yield index, SCORERS[scorer]
            x, y = places[index]
            is_taken[x : x + len(disc), y : y + len(disc)] |= disc
            taken += 1
            if taken == count:
                return


def _next_free(ranked: NDArray[np.int64], start: int, is_taken: NDArray[np.bool_], flat: NDArray[np.int64]) -> int:
    """Return the position of the first free place from `start` on; look at ever longer parts of the ranking."""
    length = 64
    while start < len(ranked):
        free = np.flatnonzero(~is_taken[flat[ranked[start : start + length]]])
        if len(free):
            return start + int(free[0])
        start, length = start + length, 2 * length
    return len(ranked)


def candidates(
    truth: tuple[float, float] | None,
    decoys_m: NDArray[np.float64],
    *,
    yaw_deg: float,
    jitter_m: float,
    rng: np.random.Generator,
) -> tuple[tuple[Pose, ...], int]:
    """Shuffle the true place among decoys; return candidates and the index of the true one, -1 without a truth.

    All are jittered alike: decoys are on a lattice and the truth is not, so coordinates alone would reveal it.
    """
    points = decoys_m if truth is None else np.vstack((np.array([truth]), decoys_m))
    moved = points + rng.uniform(-jitter_m, jitter_m, points.shape)
    poses, order = shuffled_poses(moved, yaw_deg=yaw_deg, rng=rng)
    return poses, -1 if truth is None else int(np.argmin(order))


def shuffled_poses(
    points_m: NDArray[np.float64], *, yaw_deg: float, rng: np.random.Generator
) -> tuple[tuple[Pose, ...], NDArray[np.int64]]:
    """Return poses at points, shape (N, 2), in random order, and that order."""
    order = rng.permutation(len(points_m))
    easts_norths = points_m[order].tolist()
    return tuple(Pose(easting_m=round(x, 2), northing_m=round(y, 2), yaw_deg=yaw_deg) for x, y in easts_norths), order
