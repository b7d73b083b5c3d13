# SPDX-License-Identifier: Apache-2.0
"""Base of matchers that score overlaps of single channels at all places: intersection, information, phase."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.place_matcher import PlaceMatcher
from sasgeo_bench import Chart, Disc, Evidence, Mode, Overlaps, Pose, Query, Region, ShiftPlan, ShiftSearch

LEAST_CELLS: Final = 1.0  # of a union: less is rounding of the transform


def overlap(
    overlaps: Overlaps, present: int, known: int, band: int, ground: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return intersection over union of a layer of the view and a class of the map, and where either of them has it.

    `present` and `known` are channels of the view, `band` and `ground` the class and the known cells of the map.

    >>> seen = np.stack([np.eye(2), np.ones((2, 2))]).astype(np.float32)
    >>> mapped = np.stack([np.array([[1, 1], [0, 0]]), np.ones((2, 2))]).astype(np.float32)
    >>> share, is_there = overlap(Overlaps.of(seen, mapped, places=(1, 1)), 0, 1, 0, 1)
    >>> share.round(3).tolist(), is_there.tolist()
    ([[0.3330000042915344]], [[True]])
    """
    is_seen, is_mapped = bool(overlaps.totals[present] > 0), overlaps.holds(band)
    if not (is_seen and is_mapped):  # nothing in common
        nothing = np.zeros(overlaps.places, dtype=np.float32)
        alone = (present, ground) if is_seen else (known, band)
        return nothing, (overlaps.sums(*alone) if is_seen or is_mapped else nothing) > LEAST_CELLS
    both = overlaps.cross(present, band)
    either = overlaps.cross(known, band)
    either -= both
    either += overlaps.cross(present, ground)
    shared, either = overlaps.back(np.stack([both, either]))
    is_there = either > LEAST_CELLS
    shared /= np.maximum(either, LEAST_CELLS)
    shared *= is_there
    return shared, is_there


class ShiftMatcher(PlaceMatcher[ShiftSearch]):
    """A matcher of single views by a score of their overlaps with the map; a subclass says which."""

    coarse_m: float = 4.0  # where it is no open number
    yaw_step_deg: float = 3.0

    @property
    def plan(self) -> ShiftPlan:
        """Return the settings of the search: the fine cells are half as wide as the coarse ones."""
        coarse_m = self.numbers.get("coarse_m", self.coarse_m)
        return ShiftPlan(coarse_m=coarse_m, fine_m=coarse_m / 2, yaw_step_deg=self.yaw_step_deg)

    def chart_of(self, region: Region) -> Chart:
        """Return the map; by default its classes as they are."""
        return Chart.of(region)

    def shared(self, evidence: Evidence, chart: Chart) -> list[str]:
        """Return the classes of the map that a view is held against; by default those that both have."""
        return [name for name in chart.classes if name in evidence.classes]

    @abstractmethod
    def channels(self, evidence: Evidence, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the view as the score reads it, of the classes `names`, shape (V, rows, cols)."""

    @abstractmethod
    def score(self, overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the score of each place from overlaps of `channels` with the map's classes `names` and known cells."""

    def read(self, region: Region, learned: str | None) -> None:
        """Read the map."""
        del learned
        self._chart = self.chart_of(region)
        self._used = self._chart.used()

    def modes(self, view: ShiftSearch, disc: Disc, *, count: int) -> list[Mode]:
        """Return the best poses within the prior."""
        del disc  # it is that of the prior
        return view.places(count)

    def near(self, view: ShiftSearch, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best pose near each candidate, of one search for all."""
        return view.candidates(poses)

    def look(self, query: Query) -> ShiftSearch | None:
        """Return the search for a view; None where it shares no class with the map."""
        chart, seen = self._chart, query.evidence
        names = tuple(name for name in self.shared(seen, chart) if self._used[chart.classes.index(name)])
        if not names:
            return None
        return ShiftSearch(
            chart=chart,
            bands=np.array([chart.classes.index(name) for name in names], dtype=np.int64),
            channels=self.channels(seen, names),
            cell_size_m=seen.cell_size_m,
            score=lambda overlaps: self.score(overlaps, names),
            prior=query.prior,
            plan=self.plan,
        )
