# SPDX-License-Identifier: Apache-2.0
"""Trees and hedges: where crowns stand, and how they are painted: domes, cones, palms, bare branches in winter."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.sensing.rendering.plan import CROWN, Canvas, Mask, along
from sasgeo_bench.sensing.rendering.seasons import GROWTH
from sasgeo_bench.sensing.rendering.texture import Field, Numbers, bell, draw, grain, seed_of

BROAD, CONIFER, PALM, BUSH = range(4)
_SPACING_M: Final = 3.5
_RADII_M: Final = (0.6, 0.9, 1.3, 1.8, 2.4, 3.0, 3.7, 4.5, 5.5)
_SHAPES: Final = 6  # different crowns of one size
_BARK: Final = (134.0, 122.0, 108.0)
_HALF, _NO_TREE = np.uint64(32), np.uint64(2**32 - 1)
_AT_ONCE: Final = 2**18  # cells of crowns, so that they stay in the cache


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trees:
    """N crowns: easting and northing (N, 2), radius, height of the top, form, colour (N, 3), a draw of their own."""

    at_m: Numbers
    radius_m: Numbers
    height_m: Numbers
    form: NDArray[np.int64]
    colour: Numbers
    luck: Numbers

    def part(self, chosen: Mask | NDArray[np.int64]) -> "Trees":
        """Return the chosen trees."""
        return Trees(**{name: getattr(self, name)[chosen] for name in Trees.__slots__})


def scatter(grid: Grid, seed: int) -> tuple[Numbers, NDArray[np.int64]]:
    """Return places for trees: easting, northing, two draws, shape (N, 4); and the cell of each, shape (N, 2).

    Places lie on a lattice that is fixed to the ground, each moved within its square.
    """
    west, south, east, north = grid.bounds_m
    cols = np.arange(int(np.floor(west / _SPACING_M)), int(np.ceil(east / _SPACING_M)))
    rows = np.arange(int(np.floor(south / _SPACING_M)), int(np.ceil(north / _SPACING_M)))
    col, row = (part.ravel() for part in np.meshgrid(cols, rows))
    at_m = np.stack([col + draw(seed, row, col), row + draw(seed + 1, row, col)], axis=1) * _SPACING_M
    cells = grid.to_cells(at_m)
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    points = np.column_stack([at_m, draw(seed + 3, row, col), draw(seed + 2, row, col)])
    return points[inside], cells[inside]


def make_trees(canvas: Canvas, points: Numbers, *, size: tuple[float, float], is_wood: bool = False) -> Trees:
    """Return trees at points (easting, northing, draw) with crowns between two radii, forms by the palette."""
    palette, luck = canvas.plan.palette, points[:, 2]
    key = (luck * 2**40).astype(np.int64)
    low, high = size
    radius_m = low + (high - low) * draw(1, key) ** 1.5
    stand = np.full(len(points), draw(canvas.plan.seed("stand"), np.array([0]))[0])
    if is_wood:  # conifers stand together
        blocks = np.floor(points[:, :2] / 90).astype(np.int64)
        stand = draw(canvas.plan.seed("stand"), blocks[:, 0], blocks[:, 1])
    conifer = np.clip(palette.conifer_share * (0.4 + 2.2 * stand * (1 + is_wood)), 0, 0.95) * (
        palette.conifer_share > 0
    )
    pick = draw(2, key)
    form = np.where(pick < palette.palm_share, PALM, np.where(pick > 1 - conifer, CONIFER, BROAD))
    form = np.where(radius_m < 1.2, BUSH, form)
    radius_m = np.where(form == CONIFER, radius_m * 0.75, np.where(form == PALM, np.maximum(radius_m, 2.4), radius_m))
    height_m = radius_m * np.choose(form, [2.0, 3.5, 2.3, 1.2]) * (0.85 + 0.3 * draw(3, key))
    return Trees(
        at_m=points[:, :2],
        radius_m=radius_m,
        height_m=np.clip(height_m, 0.5, 24.0),
        form=form,
        colour=_leaves(canvas, key, form),
        luck=luck,
    )


def _leaves(canvas: Canvas, key: NDArray[np.int64], form: NDArray[np.int64]) -> Numbers:
    growth, crowns = GROWTH[canvas.season], np.array(canvas.plan.palette.crowns)
    colour = crowns[(draw(4, key) * len(crowns)).astype(int)]
    colour = colour * (1 + 0.12 * bell(5, key))[:, None] + 5.0 * np.stack(
        [bell(part, key) for part in (6, 7, 8)], axis=1
    )
    share = growth.crown_share * (0.3 + 0.9 * draw(9, key)) * (form != CONIFER) * (form != PALM)
    turned = np.array(growth.crown) + np.array([18.0, -14.0, -4.0]) * bell(10, key)[:, None]
    colour = colour + share[:, None] * (turned - colour)
    colour = np.where((form == CONIFER)[:, None], colour * (0.72, 0.86, 0.9), colour)
    return np.asarray(np.clip(colour, 10, 245))


def hedge_trees(canvas: Canvas) -> Trees:
    """Return bushes along hedges and trees along tree rows."""
    found = [np.zeros((0, 5))]
    boundary = canvas.plan.of("field_boundary")
    for line, width_m, key in zip(boundary.geometry, boundary.width_m, boundary.key, strict=True):
        if not width_m >= 1.4:
            continue
        spacing_m = 6.5 if width_m >= 3.5 else 1.1
        at = along(line, spacing_m, 0.5)
        number = np.arange(len(at))
        shift = (draw(int(key) & 0xFFFFFFFF, number)[:, None] - 0.5) * 0.25 * spacing_m
        points = at[:, :2] + shift * at[:, 2:4]
        radius = np.full(len(at), width_m / 2 + 0.25) * (0.8 + 0.5 * draw(int(key) & 0xFFFFFFFF, number, number))
        found.append(
            np.column_stack([points, draw(seed_of("hedge", key), number), radius, np.full(len(at), spacing_m)])
        )
    rows = np.concatenate(found)
    trees = make_trees(canvas, rows[:, :3], size=(1.0, 1.1))
    is_tree = rows[:, 4] > 2
    return Trees(
        at_m=trees.at_m,
        radius_m=np.where(is_tree, rows[:, 3] * 1.3, rows[:, 3]),
        height_m=np.where(is_tree, 7 + 5 * trees.luck, 1.2 + 0.8 * trees.luck),
        form=np.where(is_tree, BROAD, BUSH),
        colour=trees.colour,
        luck=trees.luck,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Stand:
    """Trees in the order in which they are painted, with the number of each one's crown, its corner (row, col), side.

    `is_bare` has no leaves, `fits` lies wholly on the canvas.
    """

    trees: Trees
    crowns: "Sequence[_Crown]"
    number: NDArray[np.int64]
    corner: NDArray[np.int64]
    side: NDArray[np.int64]
    is_bare: Mask
    fits: Mask

    @classmethod
    def of(cls, canvas: Canvas, groups: Sequence[Trees]) -> "_Stand":
        trees = _in_turn(groups)
        number, crowns = _crowns_of(trees, canvas.grid.cell_size_m)
        side = np.array([len(crown.height) for crown in crowns], dtype=np.int64)[number]
        corner = canvas.grid.to_cells(trees.at_m).astype(np.int64) - (side // 2)[:, None]
        return cls(
            trees=trees,
            crowns=crowns,
            number=number,
            corner=corner,
            side=side,
            is_bare=_is_bare(canvas, trees),
            fits=np.asarray(((corner >= 0) & (corner + side[:, None] <= canvas.grid.shape)).all(axis=1)),
        )


def paint_trees(canvas: Canvas, groups: Sequence[Trees]) -> None:
    """Paint crowns, one group after the other; each raises the height where it is the highest thing.

    Bare ones leave gaps between branches.
    """
    stand = _Stand.of(canvas, groups)
    highest = _highest(canvas, stand)
    colour = np.where(stand.is_bare[:, None], _BARK, stand.trees.colour)
    # The tones of all crowns in one row, and where those of each tree would begin if its crown lay in the corner
    tones = np.concatenate([np.zeros(0, dtype=np.float32), *(crown.tone.ravel() for crown in stand.crowns)])
    first = np.cumsum([0, *(crown.tone.size for crown in stand.crowns)])[:-1][stand.number]
    first -= stand.corner[:, 0] * stand.side + stand.corner[:, 1]
    for strip, grid in canvas.strips():
        height_m, owner = highest[strip] >> _HALF, highest[strip].astype(np.uint32)
        at = np.flatnonzero(owner != _NO_TREE)
        tree = (_NO_TREE - 1 - owner.ravel()[at]).astype(np.int64)
        row, col = np.divmod(at, grid.cols)
        tone = tones[first[tree] + (row + strip.start) * stand.side[tree] + col]
        canvas.height_m[strip].reshape(-1)[at] = height_m.ravel()[at].astype(np.uint32).view(np.float32)
        canvas.kind[strip].reshape(-1)[at] = CROWN
        canvas.owner[strip].reshape(-1)[at] = 0
        canvas.colour[strip].reshape(-1, 3)[at] = np.clip(tone[:, None] * colour[tree], 0, 255)


def _highest(canvas: Canvas, stand: _Stand) -> NDArray[np.uint64]:
    """Return for each cell the highest thing: the bits of its height, and in the lower half of the number whose it is.

    A height that is not negative sorts by the bits of its float32. Of equal heights that of what stands there already
    is seen (`_NO_TREE`), or that of the first tree, whose number counts down. So the order of trees does not matter.
    """
    found = (canvas.height_m + np.float32(0)).view(np.uint32).astype(np.uint64) << _HALF | _NO_TREE
    is_bare, height_m = stand.is_bare, stand.trees.height_m.astype(np.float32)
    twigs = np.abs(grain(canvas.grid, 3 + canvas.plan.salt)) > 1.3 if is_bare.any() else np.ones((1, 1), dtype=bool)
    for kind, crown in enumerate(stand.crowns):
        own = np.flatnonzero((stand.number == kind) & stand.fits)
        row, col = np.nonzero(crown.height)
        for trees in np.array_split(own, 1 + len(own) * len(row) // _AT_ONCE):
            cell = (stand.corner[trees] @ (canvas.grid.cols, 1))[:, None] + (row * canvas.grid.cols + col)
            key = (crown.height[row, col] * height_m[trees, None]).view(np.uint32).astype(np.uint64) << _HALF
            key |= (_NO_TREE - 1 - trees.astype(np.uint64))[:, None]
            if is_bare[trees].any():
                key[is_bare[trees, None] & ~twigs.ravel()[cell]] = 0
            np.maximum.at(found.ravel(), cell.ravel(), key.ravel())
    return found


def _in_turn(groups: Sequence[Trees]) -> Trees:
    """Return the trees of all groups in the order in which they are painted: by group, then by height."""
    order = [trees.part(np.argsort(trees.height_m, kind="stable")) for trees in groups]
    return Trees(**{name: np.concatenate([getattr(trees, name) for trees in order]) for name in Trees.__slots__})


def _is_bare(canvas: Canvas, trees: Trees) -> Mask:
    """Return which trees have no leaves in this season, shape (N,)."""
    growth = GROWTH[canvas.season]
    is_evergreen = (trees.form == CONIFER) | (trees.form == PALM)
    share = growth.bare_share * (0.85 if growth.bare_share == 1 else 1)
    return np.asarray(~is_evergreen & (np.mod(trees.luck * 7.31, 1) < share))


@dataclass(frozen=True, slots=True, eq=False)
class _Crown:
    """Height (share of the tree's) and brightness of a crown on cells, height 0 outside it; shape (2n + 1, 2n + 1)."""

    height: Field
    tone: Field


def _crowns_of(trees: Trees, cell_m: float) -> tuple[NDArray[np.int64], list[_Crown]]:
    """Return the number of each tree's crown, shape (N,), and those crowns."""
    size = np.abs(trees.radius_m[:, None] - np.array(_RADII_M)).argmin(axis=1)
    shape = (trees.luck * 1e6).astype(np.int64) % _SHAPES
    kinds = (BUSH + 1, len(_RADII_M), _SHAPES)
    found, number = np.unique(np.ravel_multi_index((trees.form, size, shape), kinds), return_inverse=True)
    return number, [_crown(*map(int, np.unravel_index(kind, kinds)), cell_m) for kind in found]


@lru_cache(maxsize=512)
def _crown(form: int, size: int, shape: int, cell_m: float) -> _Crown:
    radius = _RADII_M[size] / cell_m
    half = int(np.ceil(radius * 1.15)) + 1
    down, right = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
    angle, far = np.arctan2(down, right), np.hypot(down, right) / radius
    rng = np.random.default_rng((form, size, shape, 11))
    phases = rng.uniform(0, 2 * np.pi, 4)
    wavy = sum(0.09 / (1 + k * 0.4) * np.sin((k + 2) * angle + phases[k]) for k in range(4))
    lumps = cv2.GaussianBlur(rng.standard_normal(far.shape).astype(np.float32), (0, 0), max(0.6, 0.55 / cell_m))
    lumps /= max(float(lumps.std()), 1e-6)
    if form == PALM:
        fronds = rng.integers(9, 13)
        reach = 0.32 + 0.72 * np.abs(np.cos(angle * fronds / 2 + phases[0])) ** 0.6 * (1 + wavy)
        inside = far < reach
        dome = np.where(inside, 1.0 - 0.4 * far, 0.0)
        tone = 0.8 + 0.35 * np.abs(np.cos(angle * fronds / 2 + phases[0])) + 0.08 * lumps
    else:
        rim = 1.0 + wavy + 0.07 * lumps
        inside = far < rim
        bulge = np.clip(1 - (far / np.maximum(rim, 0.2)) ** 2, 0, 1)
        rise = (
            bulge**0.6 * 0.68 + 0.28 if form != CONIFER else np.clip(1 - far / np.maximum(rim, 0.2), 0, 1) * 0.85 + 0.12
        )
        dome = np.where(inside, np.clip(rise + 0.055 * lumps, 0.05, 1.05), 0.0)
        tone = 0.84 + 0.2 * bulge + 0.15 * lumps
    return _Crown(dome.astype(np.float32), np.asarray(tone, dtype=np.float32))
