# SPDX-License-Identifier: Apache-2.0
"""`brm_grid`: shares of building area in a grid and in rings, then overlap of masks (building ratio maps)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.buildings import CLASS, Windows, ring_shares
from sasgeo_baselines.global_descriptor import Sums
from sasgeo_baselines.place_matcher import SPREAD, PlaceMatcher
from sasgeo_baselines.schmidt_segcorr import FULL, SchmidtSegcorr
from sasgeo_bench import (
    PRESENT,
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
    ShiftSearch,
    rotation,
    thinned,
    turns_of,
)

SIDE: Final = 4  # parts of the grid along each of its sides
PART_M: Final = 32.0  # a grid of four lies within a view of 192 m at any heading
NEAR_M: Final = 20.0  # of a window; neighbours are 24 m apart
LEAST_MAPPED: Final = 0.5  # of the grid around a place, and of a view, that the map must know
APART_M: Final = 25.0

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RatioMap:
    """Shares of building area around places of a map: `places_m`, shape (W, 2), `shares`, shape (W, D).

    First those of the grid, row by row from the north-west, then those of the rings. `spread`, shape (D,), is the
    standard deviation of each over the map.
    """

    places_m: Floats
    shares: Floats
    spread: Floats

    @classmethod
    def of(cls, region: Region) -> Self:
        """Measure a map at places 24 m apart, and leave out those around which it knows less than half of the grid."""
        windows, sums = Windows.of(region), Sums.of(region, (CLASS,))
        parts = [sums.squares(windows.middle_m + offset_m, PART_M) for offset_m in part_offsets_m()]
        present, known = (np.stack([part[at] for part in parts], axis=1) for at in (0, -1))
        shares = np.hstack([present / np.maximum(known, 1), windows.share])
        is_mapped = known.sum(axis=1) >= LEAST_MAPPED * (SIDE * PART_M / region.grid.cell_size_m) ** 2
        # 0.01: least spread of a share over a map: where hardly anything is built
        spread = np.maximum(shares[is_mapped].std(axis=0), 0.01) if is_mapped.any() else np.ones(shares.shape[1])
        return cls(places_m=windows.middle_m[is_mapped], shares=shares[is_mapped], spread=spread)

    def best(self, seen: Floats, disc: Disc, *, count: int) -> Floats:
        """Return places in a disc that are most like a view at its best heading, at most `count`, the best first.

        `seen`, shape (headings, D), are shares of the view, NaN where too little is known: by the root mean square of
        the differences of z-scores over what is known.
        """
        rows = np.flatnonzero(disc.holds(self.places_m))
        known = ~np.isnan(seen)
        away = np.full(len(rows), np.inf)
        for shares, is_known in zip(seen, known, strict=True):
            if is_known.any():
                difference = (self.shares[rows][:, is_known] - shares[is_known]) / self.spread[is_known]
                away = np.minimum(away, np.square(difference).mean(axis=1))
        order = np.argsort(away, kind="stable")[:count]
        return np.asarray(self.places_m[rows[order[np.isfinite(away[order])]]])


def part_offsets_m() -> Floats:
    """Return the middles of the parts of the grid, (east, north) of its own, row by row from the north-west.

    >>> part_offsets_m()[[0, 1, 15]].tolist()
    [[-48.0, 48.0], [-16.0, 48.0], [48.0, -48.0]]
    """
    steps_m = (np.arange(SIDE) - (SIDE - 1) / 2) * PART_M
    return np.column_stack([np.tile(steps_m, SIDE), np.repeat(-steps_m, SIDE)])


def grid_shares(evidence: Evidence, yaw_deg: float) -> Floats:
    """Return the share of building area in each part of a north-up grid around a view that heads so, shape (SIDE^2,).

    It is NaN where less than a quarter of the part is known.

    Examples
    --------
    A block of houses on the right of a view that heads east lies in the south:

    >>> cells = np.zeros((1, 128, 128), dtype=np.uint8)
    >>> cells[0, :, 96:] = PRESENT
    >>> grid_shares(Evidence(classes=("building",), cells=cells, cell_size_m=1.0), 90.0).reshape(4, 4)[:, 0].tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    layer = evidence.layer(CLASS)
    height, width = layer.shape
    right_m = (np.arange(width) + 0.5 - width / 2) * evidence.cell_size_m
    up_m = (height / 2 - 0.5 - np.arange(height)) * evidence.cell_size_m
    turn = rotation(yaw_deg)
    col, row = (
        np.floor(sign * (line[0] * right_m[None, :] + line[1] * up_m[:, None]) / PART_M + SIDE / 2).astype(np.int64)
        for sign, line in zip((1, -1), turn, strict=True)
    )
    inside = (col >= 0) & (col < SIDE) & (row >= 0) & (row < SIDE)
    part, states = row[inside] * SIDE + col[inside], layer[inside]
    known = np.bincount(part, weights=states != UNKNOWN, minlength=SIDE * SIDE)
    present = np.bincount(part, weights=states == PRESENT, minlength=SIDE * SIDE)
    full = (PART_M / evidence.cell_size_m) ** 2
    # 0.25 of a part of a view; else it is not compared
    return np.asarray(np.where(known >= 0.25 * full, present / np.maximum(known, 1), np.nan))


def headings_deg(prior: Prior, step_deg: float) -> list[float]:
    """Return headings to try within 2.5 standard deviations, or all around, at most a step apart."""
    turns = turns_of(replace(prior, scale_sigma=0.0), spread=SPREAD, step=float(np.radians(step_deg)))
    return [base.yaw_deg + 90.0 * quarter for base in turns.bases for quarter in range(turns.quarters)]


class MaskOverlap(SchmidtSegcorr):
    """Intersection over union of buildings alone."""

    def chart_of(self, region: Region) -> Chart:
        """Return the buildings of a map."""
        known = region.known()
        degree = ((region.layer(CLASS) == PRESENT) & known).astype(np.uint8) * np.uint8(FULL)
        shown = known.astype(np.uint8) * np.uint8(FULL)
        return Chart(grid=region.grid, classes=(CLASS,), degree=degree[None], known=shown)


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """A view: its shares at each heading that is tried, shape (headings, D), and the search by overlap of masks."""

    shares: Floats
    search: ShiftSearch


class BrmGrid(PlaceMatcher[PreparedView]):
    """Building ratios name the best windows, overlap of masks the pose."""

    open_numbers = {
        "windows": (25, 50, 100),  # whose masks are compared
        "yaw_step_deg": (5.0, 10.0),  # between headings of the grid
    }
    chosen = {"windows": 100, "yaw_step_deg": 5.0}

    card = MatcherCard(
        name="brm_grid",
        version="1",
        title="Building ratio in a grid and in rings, then overlap of masks",
        source=(
            "Choi and Myung, IROS 2020, as reviews describe it: the ratio of building area in sub-windows of a view is "
            "looked up in a map of such ratios; odometry decides among the candidates"
        ),
        ours=(
            "All numbers: a north-up grid of 4 x 4 parts of 32 m and six rings of 16 m, at places 24 m apart; mean "
            f"squared difference of z-scores over the map, at the best of headings {chosen['yaw_step_deg']:g} degrees "
            f"apart within 2.5 standard deviations of the prior; the best {chosen['windows']:g} windows within the "
            "prior; then, within 20 m of each, intersection over union of the masks of buildings in cells of 4 m and "
            "headings 3 degrees apart, which is the score. Candidates of retrieval are compared by their masks alone. "
            "No odometry: each view stands alone"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Withheld where a view shows no building, and weak where it shows few; all else of a map says nothing; "
            "what is unknown in a view or beyond the map is not compared, but within the rings of the map it counts as "
            "empty; scale is 1; no confidence"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Measure ratios of a map, and keep its buildings."""
        del learned
        self._is_built = CLASS in region.classes
        if self._is_built:
            self._ratios = RatioMap.of(region)
            self._overlap = MaskOverlap(coarse_m=4.0, least_share=LEAST_MAPPED)  # of masks
            self._overlap.read(region, None)

    def look(self, query: Query) -> PreparedView | None:
        """Return the ratios of a view; None where it shows no building, or the map has none."""
        seen = query.evidence
        if not self._is_built or CLASS not in seen.classes or not (seen.layer(CLASS) == PRESENT).any():
            return None
        search = self._overlap.look(query)
        if search is None:
            return None
        rings = ring_shares(seen)
        yaws_deg = headings_deg(query.prior, self.numbers["yaw_step_deg"])
        shares = [np.concatenate([grid_shares(seen, yaw_deg), rings]) for yaw_deg in yaws_deg]
        return PreparedView(shares=np.array(shares), search=search)

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the best overlaps near the best windows."""
        places_m = self._ratios.best(view.shares, disc.wider(NEAR_M), count=int(self.numbers["windows"]))
        windows = [Pose(easting_m=east_m, northing_m=north_m, yaw_deg=0.0) for east_m, north_m in places_m.tolist()]
        near = replace(view.search, plan=replace(view.search.plan, around_m=NEAR_M)).candidates(windows)
        found = sorted((mode for mode in near if mode and disc.has(mode.pose)), key=lambda mode: -mode.score)
        return thinned(found, APART_M, count)

    def near(self, view: PreparedView, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best overlap near each candidate."""
        return view.search.candidates(poses)
