# SPDX-License-Identifier: Apache-2.0
"""Where queries lie: places spread over the blocks that are mapped, hold something, and do not overlap."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.split import Block
from sasgeo_bench.tasks.suites.base import Scene, Seeds, Site, Suite

_TRIES: Final = 400  # draws in a block before it counts as full
_SCALE_CUT: Final = 2.0  # sigmas: a scale farther off is not drawn
ANCHOR_SPREAD: Final = 0.2  # of the view's side: how far a site lies from what it is about


@dataclass(frozen=True, kw_only=True)
class _Sums:
    """Sums over squares in constant time: an integral image of what is known and one of what is drawn."""

    known: NDArray[np.int32]
    drawn: NDArray[np.int32]

    def shares(self, row: int, col: int, half: int) -> tuple[float, float]:
        """Shares of known and of drawn cells in the square around a cell; beyond the map nothing is known."""
        rows, cols = self.known.shape
        top, bottom = max(0, row - half), min(rows - 1, row + half)
        left, right = max(0, col - half), min(cols - 1, col + half)
        if top >= bottom or left >= right:
            return (0.0, 0.0)
        area = float(2 * half) ** 2
        known, drawn = (
            float(table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]) / area
            for table in (self.known, self.drawn)
        )
        return (known, drawn)


def _integral(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.asarray(cv2.integral(mask.view(np.uint8)), dtype=np.int32)


def choose_sites(
    scene: Scene, suite: Suite, *, count: int, seeds: Seeds, group: PriorGroup, may_be_fewer: bool = False
) -> tuple[Site, ...]:
    """Choose places for a suite, block by block in turn.

    Parameters
    ----------
    scene : Scene
        The map and its blocks.
    suite : Suite
        Says how much must be there, and near what.
    count : int
        How many.
    seeds : Seeds
        Of the region and suite.
    group : PriorGroup
        Its scale sigma is how much the views' scale varies.
    may_be_fewer : bool
        Whether as many as the region holds will do; one at least.

    Returns
    -------
    tuple of Site
        The first `count` of one long sequence: a larger count only adds to it. Centres are at least the suite's spacing
        apart.

    Raises
    ------
    ConfigError
        If the region holds fewer.
    """
    sums = _Sums(known=_integral(scene.map.known), drawn=_integral(scene.map.drawn))
    ground = _Ground(scene=scene, suite=suite, anchors=suite.anchors(scene), sums=sums)
    found: list[Site] = []
    centres: list[tuple[float, float]] = []
    streams = [ground.places(block, seeds.under("block", block.row, block.col), centres) for block in scene.blocks]
    while streams and len(found) < count:
        for stream in list(streams):
            place = next(stream, None)
            if place is None:
                streams.remove(stream)
                continue
            found.append(_site(place, len(found), seeds, group))
            centres.append((place.easting_m, place.northing_m))
            if len(found) == count:
                break
    if not found:
        message = f"{scene.map.region} holds no place for suite {suite.card.name!r}: too little is mapped or drawn"
        raise ConfigError(message)
    if len(found) < count and not may_be_fewer:
        message = (
            f"{scene.map.region} holds {len(found)} places for suite {suite.card.name!r} that do not overlap, "
            f"{count} were asked for: lower --n or pass --up-to"
        )
        raise ConfigError(message)
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    easting_m: float
    northing_m: float
    block: str
    density: float


@dataclass(frozen=True, kw_only=True)
class _Ground:
    """What a place must hold to, whatever the block."""

    scene: Scene
    suite: Suite
    anchors: NDArray[np.float64] | None
    sums: _Sums

    def places(self, block: Block, seeds: Seeds, centres: list[tuple[float, float]]) -> Iterator[_Place]:
        """Draw places of one block that the suite can use, none near `centres`, until too many draws failed."""
        rng = seeds.rng("places")
        west, south, east, north = block.bounds_m
        near = self._near(block)
        if near is not None and len(near) == 0:
            return
        spacing_m, spread_m = self.suite.spacing_m(self.scene), ANCHOR_SPREAD * self.suite.main_side_m
        failed = 0
        while failed < _TRIES:
            point = rng.uniform((west, south), (east, north))
            if near is not None:
                point = near[rng.integers(len(near))] + rng.uniform(-1, 1, 2) * spread_m
            place = (float(point[0]), float(point[1]))
            is_within = west <= place[0] < east and south <= place[1] < north
            density = self._density(point) if is_within else None
            if density is None or density < self.suite.card.min_density or not _is_free(place, centres, spacing_m):
                failed += 1
                continue
            failed = 0
            yield _Place(easting_m=place[0], northing_m=place[1], block=block.id, density=density)

    def _near(self, block: Block) -> NDArray[np.float64] | None:
        """Anchors in a block."""
        if self.anchors is None:
            return None
        west, south, east, north = block.bounds_m
        x, y = self.anchors.T
        return np.asarray(self.anchors[(x >= west) & (x < east) & (y >= south) & (y < north)])

    def _density(self, point: NDArray[np.float64]) -> float | None:
        """Share of drawn cells in the main view, or None where not all is mapped that a view may show."""
        grid = self.scene.map.grid
        row, col = grid.to_cells(point[None, :])[0].tolist()
        known, _ = self.sums.shares(row, col, math.ceil(self.suite.clear_m(self.scene) / grid.cell_size_m))
        if known < 1.0:
            return None
        return self.sums.shares(row, col, max(1, round(self.suite.main_side_m / 2 / grid.cell_size_m)))[1]


def _is_free(place: tuple[float, float], centres: list[tuple[float, float]], spacing_m: float) -> bool:
    if not centres:
        return True
    apart = np.hypot(*(np.array(centres) - place).T)
    return bool(apart.min() >= spacing_m)


def largest_scale(group: PriorGroup) -> float:
    """Largest scale that a view of a prior group can have.

    Examples
    --------
    >>> largest_scale(PriorGroup(radius_m=None, yaw="unknown", scale_sigma=0.15))
    1.3
    """
    return 1.0 + _SCALE_CUT * group.scale_sigma


def _site(place: _Place, index: int, seeds: Seeds, group: PriorGroup) -> Site:
    """Give a place its heading and scale."""
    rng = seeds.rng("site", round(place.easting_m * 1000), round(place.northing_m * 1000))
    spread = float(np.clip(rng.standard_normal(), -_SCALE_CUT, _SCALE_CUT))
    pose = Pose(
        easting_m=place.easting_m,
        northing_m=place.northing_m,
        yaw_deg=float(rng.uniform(0, 360)),
        scale=1.0 + group.scale_sigma * spread,
    )
    return Site(index=index, pose=pose, block=place.block, density=place.density)
