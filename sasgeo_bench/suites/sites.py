# SPDX-License-Identifier: Apache-2.0
"""Where queries lie: places spread over the blocks that are mapped, hold something, and do not overlap."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.pose import Pose
from sasgeo_bench.query import PriorGroup
from sasgeo_bench.split import Block
from sasgeo_bench.suites.base import Scene, Seeds, Site, Suite

LEAST_KNOWN: Final = 0.95  # of the footprint's square
_TRIES: Final = 400  # draws in a block before it counts as full
_SCALE_CUT: Final = 2.0  # sigmas: a scale farther off is not drawn
_ANCHOR_SPREAD: Final = 0.2  # of the view's side: how far a site lies from what it is about


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
    anchors = suite.anchors(scene)
    spacing_m = suite.spacing_m()
    found: list[Site] = []
    centres: list[tuple[float, float]] = []
    streams = [
        _places(scene, suite, block, anchors, seeds.under("block", block.row, block.col), sums, centres, spacing_m)
        for block in scene.blocks
    ]
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


def _places(  # noqa: PLR0913, PLR0917 - one loop over what a place must hold to
    scene: Scene,
    suite: Suite,
    block: Block,
    anchors: NDArray[np.float64] | None,
    seeds: Seeds,
    sums: _Sums,
    centres: list[tuple[float, float]],
    spacing_m: float,
) -> Iterator[_Place]:
    """Draw places of one block that the suite can use, none near `centres`, until too many draws in a row failed."""
    rng = seeds.rng("places")
    west, south, east, north = block.bounds_m
    near: NDArray[np.float64] | None = None
    if anchors is not None:
        inside = (anchors[:, 0] >= west) & (anchors[:, 0] < east) & (anchors[:, 1] >= south) & (anchors[:, 1] < north)
        near = anchors[inside]
        if len(near) == 0:
            return
    largest_m = max(variant.side_m for variant in suite.variants)
    main_m = suite.main_side_m
    failed = 0
    while failed < _TRIES:
        point = rng.uniform((west, south), (east, north))
        if near is not None:
            point = near[rng.integers(len(near))] + rng.uniform(-1, 1, 2) * _ANCHOR_SPREAD * main_m
        place = (float(point[0]), float(point[1]))
        is_within = west <= place[0] < east and south <= place[1] < north
        density = _density(scene, point, sums, largest_m=largest_m, main_m=main_m) if is_within else None
        if density is None or density < suite.card.min_density or not _is_free(place, centres, spacing_m):
            failed += 1
            continue
        failed = 0
        yield _Place(easting_m=place[0], northing_m=place[1], block=block.id, density=density)


def _density(scene: Scene, point: NDArray[np.float64], sums: _Sums, *, largest_m: float, main_m: float) -> float | None:
    """Share of drawn cells in the main view, or None where the largest view is not mapped enough."""
    row, col = scene.map.grid.to_cells(point[None, :])[0].tolist()
    cell_m = scene.map.grid.cell_size_m
    known, _ = sums.shares(row, col, max(1, round(largest_m / 2 / cell_m)))
    if known < LEAST_KNOWN:
        return None
    return sums.shares(row, col, max(1, round(main_m / 2 / cell_m)))[1]


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
