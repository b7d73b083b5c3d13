# SPDX-License-Identifier: Apache-2.0
"""Descriptor of a place: occupancy of groups of classes in rings and sectors, and a histogram of their distances."""

from collections.abc import Iterator
from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

import sasgeo_bench as sgb

# Buildings first; without bridges, which lie on roads.
GROUPS: Final = tuple(
    sorted(
        (names for group, names in sgb.load_taxonomy().groups.items() if group != "bridge"),
        key=lambda names: "building" not in names,
    )
)
RINGS: Final = 8
SECTORS: Final = 16  # the first begins straight ahead, clockwise
RADIUS_M: Final = 96.0
CELL_M: Final = 4.0
SIDE: Final = round(2 * RADIUS_M / CELL_M)  # cells a side of the square around the disc
DISTANCES_M: Final = (4.0, 12.0, 36.0)  # shares of the disc so near to each group
DEPTH: Final = RINGS * SECTORS + len(DISTANCES_M)  # numbers of a group

_FINE: Final = 4  # points a side of a cell, for its share in each sector
_LEAST_KNOWN: Final = 0.25  # of a sector; else it is unknown

# Of shape (len(GROUPS) * (1 + len(DISTANCES_M)), rows, cols): occupancies, then nearness by distance.
Planes = NDArray[np.float32]


@cache
def sector_weights(rings: int = RINGS, sectors: int = SECTORS) -> sparse.csr_array:
    """Return the share of each cell of the square in each sector, shape (rings * sectors, SIDE^2); rows sum to 1."""
    points = (np.arange(SIDE * _FINE) + 0.5) / _FINE * CELL_M - RADIUS_M
    right_m, up_m = np.meshgrid(points, -points)
    ring = np.floor(np.hypot(right_m, up_m) / RADIUS_M * rings).astype(np.int64)
    sector = np.floor(np.mod(np.arctan2(right_m, up_m) / (2 * np.pi), 1.0) * sectors).astype(np.int64) % sectors
    cell = np.arange(SIDE * _FINE) // _FINE
    cells = cell[:, None] * SIDE + cell[None, :]
    inside = ring < rings
    at = (ring[inside] * sectors + sector[inside], cells[inside])
    counts = sparse.coo_array((np.ones(len(at[0])), at), shape=(rings * sectors, SIDE * SIDE)).tocsr()
    return sparse.csr_array(sparse.diags_array(1.0 / counts.sum(axis=1)) @ counts).astype(np.float32)


@cache
def _disc() -> NDArray[np.float32]:
    """Return the share of each cell of the square in the disc, shape (SIDE^2,); they sum to 1."""
    at = (np.arange(SIDE) + 0.5) * CELL_M - RADIUS_M
    area = (np.hypot(at[:, None], at[None, :]) <= RADIUS_M).astype(np.float32).ravel()
    return np.asarray(area / area.sum(), dtype=np.float32)


def planes_of(occupancy: NDArray[np.float32]) -> Planes:
    """Return occupancies, shape (groups, rows, cols), and whether each cell is near to each group, by distance."""
    # 0.25: occupancy from which a cell counts for distances
    near = [_away_m(layer >= 0.25) <= distance_m for distance_m in DISTANCES_M for layer in occupancy]
    return np.concatenate([occupancy, np.array(near, dtype=np.float32)])


def _away_m(present: NDArray[np.bool_]) -> NDArray[np.float32]:
    if not present.any():
        return np.full(present.shape, np.inf, dtype=np.float32)
    away = cv2.distanceTransform((~present).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away * CELL_M, dtype=np.float32)


def view_descriptor(evidence: sgb.Evidence) -> NDArray[np.float32]:
    """Return the descriptor of a view, shape (len(GROUPS) * DEPTH,): by group, NaN where too little is known."""
    present, known = view_planes(evidence)
    return _view_means(present, known)


def view_planes(evidence: sgb.Evidence) -> NDArray[np.float32]:
    """Return the shares of each cell of the square where a group is present, and where it is known, in a view.

    The result has shape (2, len(GROUPS), SIDE^2). A group is known where each of its classes is, or one is present.
    """
    height, width = evidence.shape
    down_m = (np.arange(height) + 0.5 - height / 2) * evidence.cell_size_m + RADIUS_M
    right_m = (np.arange(width) + 0.5 - width / 2) * evidence.cell_size_m + RADIUS_M
    rows, cols = (np.floor(at_m / CELL_M).astype(np.int64) for at_m in (down_m, right_m))
    inside = ((rows >= 0) & (rows < SIDE))[:, None] & ((cols >= 0) & (cols < SIDE))[None, :]
    at = (rows[:, None] * SIDE + cols[None, :])[inside]
    full = max(1.0, (CELL_M / evidence.cell_size_m) ** 2)
    known, present = np.zeros((2, len(GROUPS), SIDE * SIDE), dtype=np.float32)
    for group, names in enumerate(GROUPS):
        layers = [evidence.layer(name) for name in names if name in evidence.classes]
        if not layers:
            continue
        is_present = np.any([layer == sgb.PRESENT for layer in layers], axis=0)
        is_known = is_present | np.all([layer != sgb.UNKNOWN for layer in layers], axis=0)
        known[group] = np.minimum(np.bincount(at, weights=is_known[inside], minlength=SIDE * SIDE) / full, 1.0)
        present[group] = np.minimum(np.bincount(at, weights=is_present[inside], minlength=SIDE * SIDE) / full, 1.0)
    return np.stack([present, known])


def _view_means(present: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    occupancy = np.divide(present, np.maximum(known, 1e-6), dtype=np.float32)
    planes = planes_of(occupancy.reshape(-1, SIDE, SIDE)).reshape(1 + len(DISTANCES_M), len(GROUPS), -1)
    sectors, disc = sector_weights(), _disc()
    found = np.empty((len(GROUPS), DEPTH), dtype=np.float32)
    for group, into in enumerate(found):
        weight = np.concatenate([sectors @ known[group], np.full(len(DISTANCES_M), disc @ known[group])])
        polar = sectors @ present[group]
        near = planes[1:, group] * known[group] @ disc
        total = np.concatenate([polar, near])
        into[:] = np.where(weight >= _LEAST_KNOWN, total / np.maximum(weight, 1e-6), np.nan)
    return found.ravel()


def padded_strips(region: sgb.Region, *, stride: int) -> Iterator[Planes]:
    """Yield planes of a map in cells of CELL_M, SIDE rows high, one for each row of places.

    Places are corners of cells, `stride` cells apart, from the north-western corner of the map. Strips reach half a
    square beyond the map on all sides, where nothing is.
    """
    reach = round(max(DISTANCES_M) / CELL_M)
    padded = coarse_groups(region, above=SIDE // 2 + reach, beside=SIDE // 2)
    # 256 rows of cells whose distances are measured together
    count, together = (padded.shape[1] - SIDE - 2 * reach) // stride + 1, max(1, 256 // stride)
    for first in range(0, count, together):
        tops = [row * stride for row in range(first, min(first + together, count))]
        band = padded[:, tops[0] : tops[-1] + SIDE + 2 * reach].astype(np.float32) / np.float32(255)
        planes = planes_of(band)
        for top in tops:
            at = top - tops[0] + reach
            yield planes[:, at : at + SIDE]


def coarse_groups(region: sgb.Region, *, above: int, beside: int) -> NDArray[np.uint8]:
    """Return the occupancy of each group in cells of CELL_M, 0..255, with a margin, uint8 of shape (groups, H, W)."""
    west_m, south_m, east_m, north_m = region.grid.bounds_m
    rows, cols = (max(1, round(side_m / CELL_M)) for side_m in (north_m - south_m, east_m - west_m))
    found = np.zeros((len(GROUPS), rows + 2 * above, cols + 2 * beside), dtype=np.uint8)
    for names, into in zip(GROUPS, found, strict=True):
        held = [name for name in names if name in region.classes]
        present = np.zeros(region.grid.shape, dtype=np.uint8)
        for name in held:
            present[region.layer(name) == sgb.PRESENT] = 255
        if held:
            into[above : above + rows, beside : beside + cols] = cv2.resize(
                present, (cols, rows), interpolation=cv2.INTER_AREA
            )
    return found


def map_rows(strip: Planes, *, stride: int) -> NDArray[np.float32]:
    """Return descriptors of the places along a strip, facing north, shape (places, len(GROUPS) * DEPTH)."""
    windows = np.lib.stride_tricks.sliding_window_view(strip, SIDE, axis=2)[:, :, ::stride]  # plane, row, place, col
    places = windows.shape[2]
    flat = np.ascontiguousarray(windows.transpose(0, 1, 3, 2)).reshape(len(strip), SIDE * SIDE, places)
    groups = len(GROUPS)
    found = np.empty((groups, DEPTH, places), dtype=np.float32)
    for group in range(groups):
        found[group, : RINGS * SECTORS] = sector_weights() @ flat[group]
    near = np.einsum("c,pcn->pn", _disc(), flat[groups:]).reshape(len(DISTANCES_M), groups, places)
    found[:, RINGS * SECTORS :] = near.transpose(1, 0, 2)
    return np.ascontiguousarray(found.reshape(groups * DEPTH, places).T)


def described(region: sgb.Region, *, stride: int) -> Iterator[NDArray[np.float32]]:
    """Yield the descriptors of each row of places of a map (`places_m`), facing north, shape (cols, D)."""
    for strip in padded_strips(region, stride=stride):
        yield map_rows(strip, stride=stride)


def places_m(grid: sgb.Grid, shape: tuple[int, int], *, stride: int) -> NDArray[np.float64]:
    """Return easting and northing of places in so many rows and columns, row by row, shape (rows * cols, 2).

    >>> grid = sgb.Grid(epsg=32632, west_m=0.0, north_m=90.0, cell_size_m=1.0, rows=90, cols=90)
    >>> places_m(grid, (2, 2), stride=6).tolist()
    [[0.0, 90.0], [24.0, 90.0], [0.0, 66.0], [24.0, 66.0]]
    """
    west_m, _, _, north_m = grid.bounds_m
    down, right = np.indices(shape).reshape(2, -1) * stride * CELL_M
    return np.column_stack((west_m + right, north_m - down))


def turned(values: NDArray[np.float32], turn: int, *, yaws: int) -> NDArray[np.float32]:
    """Turn descriptors, or weights of them, shape (D, ...), clockwise by `turn` of `yaws` parts of a circle.

    A view that heads east sees straight ahead what a north-up map has to the right: its descriptor is that of the map
    turned by -1/4; and weights of a view, turned by +1/4, read the map as that view would.
    """
    parts = values.reshape(len(GROUPS), DEPTH, -1)
    polar = parts[:, : RINGS * SECTORS].reshape(len(GROUPS), RINGS, SECTORS, -1)
    rolled = np.roll(polar, turn * SECTORS // yaws, axis=2).reshape(len(GROUPS), RINGS * SECTORS, -1)
    return np.ascontiguousarray(np.concatenate([rolled, parts[:, RINGS * SECTORS :]], axis=1).reshape(values.shape))
