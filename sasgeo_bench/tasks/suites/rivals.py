# SPDX-License-Identifier: Apache-2.0
"""Check of twins and lures: whether the list of a plain search holds the true place and its rivals.

A query whose list lacks one of them does not test how a matcher decides between the two. The check measures queries
that are already drawn, and changes none of them. Its search learns nothing, sees no graph and weighs all classes alike,
so it favours no method.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, Evidence
from sasgeo_bench.search.field import FULL, Field, Template, squares
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Mode, place_m
from sasgeo_bench.tasks.query import UNRIVALLED, Role
from sasgeo_bench.tasks.state import State

# Of `Truth.measured`: how many rivals a place has, how many of them lie in the disc of the prior and in the list, and
# whether the place itself is in the list.
RIVALS: Final = "rivals"
IN_DISC: Final = "rivals_in_disc"
LISTED: Final = "rivals_listed"
TRUTH_LISTED: Final = "truth_listed"
LEAD: Final = "rival_lead"  # score of the best rival minus that of the true place, -2..2; where both are listed

CELL_M: Final = 2.0
MODES: Final = 20
NEAR_M: Final = 25.0  # from a place to the mode that stands for it

Place = tuple[float, float]
_MARGIN_M: Final = 32.0  # around the largest view, for cells of the coarsest level


@dataclass(frozen=True, kw_only=True)
class RivalCheck:
    """A plain search of each distinct view; variants of a site that show the same are searched once."""

    found: dict[tuple[str, Prior, bytes], tuple[Mode, ...]] = field(default_factory=dict)

    def measure(
        self, state: State, seen: Evidence, prior: Prior, *, truth_m: Place, rivals_m: Sequence[Place]
    ) -> dict[str, float]:
        """Return what `Truth.measured` says of the rivals of a query.

        Parameters
        ----------
        state : State
            The searched map.
        seen : Evidence
            The view.
        prior : Prior
            What is known before; the search keeps to it.
        truth_m, rivals_m : tuple of float, sequence of tuple of float
            Easting and northing of the true place and of its rivals.
        """
        key = (state.region, prior, hashlib.sha256(seen.cells.tobytes()).digest())
        if key not in self.found:
            self.found[key] = plain_modes(state, seen, prior)
        modes = self.found[key]
        own, theirs = score_near(modes, truth_m), [score_near(modes, place) for place in rivals_m]
        listed = [score for score in theirs if score is not None]
        lead = {LEAD: round(max(listed) - own, 4)} if listed and own is not None else {}
        return {
            RIVALS: float(len(rivals_m)),
            IN_DISC: float(sum(holds(prior, place) for place in rivals_m)),
            LISTED: float(len(listed)),
            TRUTH_LISTED: float(own is not None),
            **lead,
        }


def kind_of(role: Role, kind: str, measured: dict[str, float]) -> str:
    """Return the kind of a query: another one for a stress whose list lacks the true place or a rival.

    Contrasts leave it out.

    Examples
    --------
    >>> kind_of("stress", "G2", {"rivals": 1.0, "rivals_in_disc": 1.0, "rivals_listed": 0.0, "truth_listed": 1.0})
    'unrivalled G2'
    >>> kind_of("control", "no vectors", {"rivals": 1.0, "rivals_listed": 0.0, "truth_listed": 1.0})
    'no vectors'
    """
    if role != "stress" or RIVALS not in measured:
        return kind
    is_full = measured[LISTED] == measured[RIVALS] and measured[TRUTH_LISTED] == 1.0
    return kind if is_full else f"{UNRIVALLED} {kind}"


def holds(prior: Prior, place: Place) -> bool:
    """Return whether a place lies in the disc of a prior; without a disc every place does."""
    return prior.center_m is None or bool(np.hypot(*np.subtract(place, prior.center_m)) <= (prior.radius_m or 0.0))


def score_near(modes: Sequence[Mode], place: Place) -> float | None:
    """Return the best score of the modes within `NEAR_M` of a place, or None if there is none."""
    scores = [mode.score for mode in modes if np.hypot(*np.subtract(place_m(mode.pose), place)) <= NEAR_M]
    return max(scores, default=None)


def plain_modes(state: State, seen: Evidence, prior: Prior) -> tuple[Mode, ...]:
    """Return the best modes of a view on a map, at most `MODES`, best first.

    The score of a pose, -1..1, is the mean over the known cells of all classes: 1 where view and map agree, present or
    absent, and -1 where they differ; cells that the map does not know count 0.
    """
    pool = max(1, round(CELL_M / seen.cell_size_m))
    present, absent = (seen.cells == PRESENT).astype(np.float32), (seen.cells == ABSENT).astype(np.float32)
    counted = max(float(present.sum() + absent.sum()), 1.0)
    # Agreement minus difference, with the map m in {0, 1}: m (2 p - 2 a) + (a - p).
    weights, known = 2 * (present - absent) / counted, (absent - present).sum(axis=0) / counted
    bands, frame = squares(np.concatenate((weights, known[None])), pool, cell_size_m=seen.cell_size_m)
    template = Template(weights=bands[:-1], known=bands[-1], cell_size_m=frame.cell_size_m)
    # 2.5: standard deviations of the scale that the search tries (`search.plan.Plan.spread`)
    reach_m = template.reach_m * (1 + 2.5 * prior.scale_sigma) + _MARGIN_M
    return search(field_of(state, seen.classes, prior, reach_m=reach_m), template, prior, count=MODES).modes


def field_of(state: State, classes: Sequence[str], prior: Prior, *, reach_m: float) -> Field:
    """Return the layers of some classes in cells of `CELL_M`: all of the map, or what lies within reach of a disc."""
    factor = max(1, round(CELL_M / state.grid.cell_size_m))
    top, left, rows, cols = 0, 0, -(-state.grid.rows // factor) * factor, -(-state.grid.cols // factor) * factor
    if prior.center_m is not None and prior.radius_m is not None:
        row, col = state.grid.to_cells(np.array([prior.center_m]))[0].tolist()
        half = int(np.ceil((prior.radius_m + reach_m) / state.grid.cell_size_m / factor)) * factor
        top, left, rows, cols = row - half, col - half, 2 * half, 2 * half
    bits = window(state.bits.bits, top, left, (rows, cols))
    # A cell that the map does not know has none of its classes.
    known = bits >> np.uint32(31) == 0
    layers = [_coarse((bits >> np.uint32(state.classes.index(name)) & 1 > 0) & known, factor) for name in classes]
    grid = state.grid.window(top, left, rows, cols).coarsen(factor)
    return Field.of(grid=grid, layers=np.stack(layers), known=_coarse(known, factor))


def window(bits: NDArray[np.uint32], top: int, left: int, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Cut a window of a map's bits that may reach beyond the map, where nothing is known."""
    cut = np.full(shape, 1 << 31, dtype=np.uint32)
    first, start = max(top, 0), max(left, 0)
    last, end = min(top + shape[0], bits.shape[0]), min(left + shape[1], bits.shape[1])
    if first < last and start < end:
        cut[first - top : last - top, start - left : end - left] = bits[first:last, start:end]
    return cut


def _coarse(mask: NDArray[np.bool_], factor: int) -> NDArray[np.uint8]:
    """Return the share of a mask in squares of `factor` cells, 0..FULL; sides are multiples of `factor`."""
    size = (mask.shape[1] // factor, mask.shape[0] // factor)
    return np.asarray(cv2.resize(mask.astype(np.uint8) * FULL, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
