# SPDX-License-Identifier: Apache-2.0
"""Sites of queries: places in mapped blocks that hold features and do not overlap."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.split import Block
from sasgeo_bench.tasks.suites.base import Scene, Seeds, Site, Suite

_SCALE_CUT: Final = 2.0  # sigmas at which the scales of views are cut


@dataclass(frozen=True, kw_only=True)
class _Sums:
    """Fractions of the cells of a mask in squares, in constant time by an integral image."""

    integral: NDArray[np.int32]

    @classmethod
    def of(cls, mask: NDArray[np.bool_]) -> "_Sums":
        return cls(integral=np.asarray(cv2.integral(mask.view(np.uint8)), dtype=np.int32))

    def share(self, row: int, col: int, half: int) -> float:
        """Return the fraction in the square around a cell; cells outside the map count as False."""
        rows, cols = self.integral.shape
        top, bottom = max(0, row - half), min(rows - 1, row + half)
        left, right = max(0, col - half), min(cols - 1, col + half)
        if top >= bottom or left >= right:
            return 0.0
        table = self.integral
        total = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
        return float(total) / float(2 * half) ** 2


def choose_sites(
    scene: Scene, suite: Suite, *, count: int, seeds: Seeds, group: PriorGroup, may_be_fewer: bool = False
) -> tuple[Site, ...]:
    """Choose places for a suite, block by block in turn, and in each block by kinds of ground in turn.

    The result begins a sequence that does not depend on `count`: a larger count only adds sites. Centres keep the
    suite's spacing. `seeds` are those of region and suite; the scale sigma of `group` sets the spread of the views'
    scales.

    Raises
    ------
    ConfigError
        If the region holds fewer places; with `may_be_fewer`, only if it holds none.
    """
    ground = _Ground(
        scene=scene,
        suite=suite,
        anchors=suite.anchors(scene),
        known=_Sums.of(scene.map.known),
        drawn=tuple(_Sums.of(state.drawn) for state in (scene.map, *suite.older(scene))),
        seeds=seeds,
        group=group,
    )
    found: list[Site] = []
    kinds = suite.grounds
    turns = ((at, block, turn) for turn in range(len(kinds)) for at, block in enumerate(scene.blocks))
    streams = [ground.sites(block, kinds[(at + turn) % len(kinds)], found) for at, block, turn in turns]
    while streams and len(found) < count:
        for stream in list(streams):
            site = next(stream, None)
            if site is None:
                streams.remove(stream)
                continue
            found.append(site)
            if len(found) == count:
                break
    if not found:
        raise ConfigError(
            f"{scene.map.region} holds no place for suite {suite.card.name!r}: too little is mapped or drawn"
        )
    if len(found) < count and not may_be_fewer:
        raise ConfigError(
            f"{scene.map.region} holds {len(found)} places for suite {suite.card.name!r} that do not overlap, "
            f"{count} were asked for: lower --n or pass --up-to"
        )
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class _Ground:
    """The requirements that all sites of a suite must meet."""

    scene: Scene
    suite: Suite
    anchors: NDArray[np.float64] | None
    known: _Sums
    drawn: tuple[_Sums, ...]  # of today's map and of older ones that are searched
    seeds: Seeds
    group: PriorGroup

    def sites(self, block: Block, kind: str, found: Sequence[Site]) -> Iterator[Site]:
        """Draw sites of one block on a kind of ground, none near those found so far, until too many draws failed."""
        rng = self.seeds.rng("block", block.row, block.col, "places", *filter(None, (kind,)))
        west, south, east, north = block.bounds_m
        near = self._near(block)
        if near is not None and len(near) == 0:
            return
        spread_m, failed = self.suite.anchor_spread_m, 0
        while failed < 400:  # draws in a block before it counts as full
            point = rng.uniform((west, south), (east, north))
            if near is not None:
                point = near[rng.integers(len(near))] + rng.uniform(-1, 1, 2) * spread_m
            place = (float(point[0]), float(point[1]))
            densities = self._densities(point) if block.holds(place) else None
            is_drawn = densities is not None and min(densities) >= self.suite.card.min_density
            pose = self._pose(place) if is_drawn and self._is_free(place, found) else None
            if densities is None or pose is None or self.suite.ground_at(self.scene, pose) != kind:
                failed += 1
                continue
            failed = 0
            yield Site(index=len(found), pose=pose, block=block.id, density=densities[0])

    def _near(self, block: Block) -> NDArray[np.float64] | None:
        if self.anchors is None:
            return None
        west, south, east, north = block.bounds_m
        x, y = self.anchors.T
        return np.asarray(self.anchors[(x >= west) & (x < east) & (y >= south) & (y < north)])

    def _densities(self, point: NDArray[np.float64]) -> list[float] | None:
        """Return the fractions of drawn cells in the main view; None unless all that a view may show is mapped."""
        grid = self.scene.map.grid
        row, col = grid.to_cells(point[None, :])[0].tolist()
        if self.known.share(row, col, math.ceil(self.suite.clear_m(self.scene) / grid.cell_size_m)) < 1.0:
            return None
        half = max(1, round(self.suite.main_side_m / 2 / grid.cell_size_m))
        return [drawn.share(row, col, half) for drawn in self.drawn]

    def _is_free(self, place: tuple[float, float], found: Sequence[Site]) -> bool:
        spacing_m = self.suite.spacing_m(self.scene)
        return all(math.dist(place, site.en_m) >= spacing_m for site in found)

    def _pose(self, place: tuple[float, float]) -> Pose:
        easting_m, northing_m = place
        rng = self.seeds.rng("site", round(easting_m * 1000), round(northing_m * 1000))
        scale = 1.0 + self.group.scale_sigma * float(np.clip(rng.standard_normal(), -_SCALE_CUT, _SCALE_CUT))
        return Pose(easting_m=easting_m, northing_m=northing_m, yaw_deg=float(rng.uniform(0, 360)), scale=scale)


def largest_scale(group: PriorGroup) -> float:
    """Return the largest scale of a view of a prior group."""
    return 1.0 + _SCALE_CUT * group.scale_sigma
