# SPDX-License-Identifier: Apache-2.0
"""The paper's variants 2 to 5 as one matcher with switches; a file beside it for each card."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.chart import Chart, fade
from sasgeo_baselines.dense import Plan
from sasgeo_baselines.dense_matcher import DenseMatcher
from sasgeo_baselines.voting import Gains, make_template
from sasgeo_bench.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.region import Region

THIN: Final = (
    *("road_major", "road_minor", "path_track", "railway", "waterway", "coastline", "field_boundary", "bridge"),
)
REACH_M: Final = 4.0

# What the cards share.
SOURCE: Final = "SASGeo paper (Trukhina and Vashkelis), Eqs. 7-8 and variant {variant} of its Section VI"
OURS: Final = (
    "Distance made a degree by exp(-D^2 / 2 tau^2), tau 4 m, for the classes drawn as lines, on the map, and in the "
    "view as an excuse for what seems missed; all gains 1; division by the cells that count; the search over place, "
    "heading and scale (the paper ranks ten windows)"
)
UNKNOWN_IS_ABSENT: Final = (
    "what is unknown in the view counts as absent, so that what is mapped there contradicts, as in the paper's trials, "
    "whose last variant alone ignores it"
)
LIMITS: Final = (
    "headings and scales beyond two standard deviations are not searched; candidates that share a place within 24 m "
    "cannot be told apart; no confidence; withholds only where everything is unknown"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Switches:
    """What the variants differ in; with all off it is the second.

    Parameters
    ----------
    is_unknown_silent : bool
        What is unknown in the view says nothing; else it is taken for absent.
    """

    is_unknown_silent: bool = False


class RasterMatcher(DenseMatcher):
    """Eqs. (7)-(8) with gains of 1; lines agree by nearness.

    Parameters
    ----------
    reach_m : float
        The tau of exp(-D^2 / 2 tau^2) for lines, metres.
    plan : Plan, optional
        How the search is done.
    """

    switches: ClassVar[Switches] = Switches()

    def __init__(self, *, reach_m: float = REACH_M, plan: Plan | None = None) -> None:
        super().__init__(plan)
        self.reach_m = reach_m

    def read(self, region: Region) -> Chart:
        """Let the lines of the map fade."""
        return Chart.of(region, thin=THIN, reach_m=self.reach_m)

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Three states or two, one vote each; a line that is mapped beside one that was seen is not missed."""
        cells = self.seen(evidence.cells)
        near = np.zeros(cells.shape, dtype=np.float32)
        for name, layer, into in zip(evidence.classes, cells, near, strict=True):
            if name in THIN:
                into[:] = fade(layer == PRESENT, reach_cells=self.reach_m / evidence.cell_size_m)
        return make_template(cells, Gains.uniform(len(evidence.classes)), near=near)

    def seen(self, cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What the cells of a view say by this variant's reading."""
        if self.switches.is_unknown_silent:
            return cells
        return np.where(cells == UNKNOWN, ABSENT, cells).astype(np.uint8)
