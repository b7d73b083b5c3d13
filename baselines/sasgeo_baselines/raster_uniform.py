# SPDX-License-Identifier: Apache-2.0
"""`raster_uniform`: the paper's raster objective with uniform weights, thin lines by their distance transform."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.chart import Chart, fade
from sasgeo_baselines.dense import Plan
from sasgeo_baselines.dense_matcher import DenseMatcher
from sasgeo_baselines.voting import Gains, make_template
from sasgeo_bench.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.matcher import MatcherCard
from sasgeo_bench.region import Region

THIN: Final = (
    *("road_major", "road_minor", "path_track", "railway", "waterway", "coastline", "field_boundary", "bridge"),
)
REACH_M: Final = 4.0


class RasterUniform(DenseMatcher):
    """Eqs. (7)-(8) with every weight and gain 1; lines agree by nearness.

    Parameters
    ----------
    reach_m : float
        The tau of exp(-D^2 / 2 tau^2) for lines, metres.
    is_unknown_absent : bool
        Take what is unknown for absent, as the paper's own trials did before its last variant.
    plan : Plan, optional
        How the search is done.
    """

    card = MatcherCard(
        name="raster_uniform",
        version="1",
        title="Raster matching with uniform weights",
        source="SASGeo paper (Trukhina and Vashkelis), Eqs. 7-8 and variant 2 of its Section VI",
        ours=(
            "Distance made a degree by exp(-D^2 / 2 tau^2), tau 4 m, for the classes drawn as lines, on the map, "
            "and in the view as an excuse for what seems missed; all gains 1; division by the known cells; the search "
            "over place, heading and scale (the paper ranks ten windows). Unknown is silent as in Eq. 7, "
            "though the paper's trials add that in their last variant only"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "No stability, no distinctiveness, no graph; headings and scales beyond two standard deviations are not "
            "searched; candidates that share a place within 24 m cannot be told apart; no confidence"
        ),
    )

    def __init__(self, *, reach_m: float = REACH_M, is_unknown_absent: bool = False, plan: Plan | None = None) -> None:
        super().__init__(plan)
        self.reach_m = reach_m
        self.is_unknown_absent = is_unknown_absent

    def read(self, region: Region) -> Chart:
        """Let the lines of the map fade."""
        return Chart.of(region, thin=THIN, reach_m=self.reach_m)

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Three states, one vote each; a line that is mapped beside one that was seen is not missed."""
        cells = evidence.cells
        if self.is_unknown_absent:
            cells = np.where(cells == UNKNOWN, ABSENT, cells).astype(np.uint8)
        near = np.zeros(cells.shape, dtype=np.float32)
        for name, layer, into in zip(evidence.classes, cells, near, strict=True):
            if name in THIN:
                into[:] = fade(layer == PRESENT, reach_cells=self.reach_m / evidence.cell_size_m)
        return make_template(cells, Gains.uniform(len(evidence.classes)), near=near)
