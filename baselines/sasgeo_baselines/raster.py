# SPDX-License-Identifier: Apache-2.0
"""Variants 2 to 5 of the paper as one matcher with switches; each card has a file of its own."""

from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.verification import GraphCheck, blended
from sasgeo_bench import (
    ABSENT,
    PRESENT,
    UNKNOWN,
    Chart,
    DenseMatcher,
    Evidence,
    Mode,
    PoseCheck,
    Region,
    VoteGains,
    VotePlan,
    fade,
    load_taxonomy,
    make_template,
)

THIN: Final = (
    *("road_major", "road_minor", "path_track", "railway", "waterway", "coastline", "field_boundary", "bridge"),
)
REACH_M: Final = 4.0

# Texts that the cards share.
SOURCE: Final = "SASGeo paper (Trukhina and Vashkelis), Eqs. 7-8 and variant {variant} of its Section VI"
OURS: Final = (
    "Distance made a degree by exp(-D^2 / 2 tau^2), tau 4 m, for the classes drawn as lines, on the map, and in the "
    "view as an excuse for what seems missed; all gains 1; division by the cells that count; the search over place, "
    "heading and scale (the paper ranks ten windows)"
)
GRAPH: Final = (
    "graph descriptor: for every class the number of connected patches of at least 9 m2 (8 neighbours) and a histogram "
    "of the distances of their centroids (16 bins to the view's diagonal), of the view and of the map under each pose "
    "that the raster found; counts differ by |n - m| / (n + m + 1), histograms by half their L1 distance; the mean "
    "over classes; it changes the order of the raster's modes and finds none; raster and graph are standardised over "
    "the modes or candidates of the query and the graph weighs 0.5, set by hand: below 0.71 it cannot overturn a mode "
    "that stands alone in the raster"
)
STABLE: Final = (
    "every class weighs its prior p_c of Eq. 5, set by hand in the taxonomy (0.70 for fields to 0.98 for coastlines); "
    "ages, seasons, visibility and distinctiveness are 1, and the graph is not weighted"
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
    """Settings in which the variants differ; all are off in variant 2.

    Parameters
    ----------
    has_graph : bool
        Add the graph descriptor to the score of each mode: see `verification.blended`.
    is_stable : bool
        Weigh each class by `stability`, else by 1.
    is_unknown_silent : bool
        Ignore unknown cells of the view; else they count as absent.
    """

    has_graph: bool = False
    is_stable: bool = False
    is_unknown_silent: bool = False


class RasterMatcher(DenseMatcher):
    """Eqs. (7)-(8) with gains of 1; lines agree by proximity.

    Parameters
    ----------
    reach_m : float
        The tau of exp(-D^2 / 2 tau^2) for lines, metres.
    plan : VotePlan, optional
        Settings of the search.
    """

    switches: ClassVar[Switches] = Switches()

    def __init__(self, *, reach_m: float = REACH_M, plan: VotePlan | None = None) -> None:
        super().__init__(plan)
        self.reach_m = reach_m

    def read(self, region: Region) -> Chart:
        """Return the map with the proximity of its lines."""
        return Chart.of(region, thin=THIN, reach_m=self.reach_m)

    def seen(self, cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return unknown cells as absent, unless this variant ignores them."""
        if self.switches.is_unknown_silent:
            return cells
        return np.where(cells == UNKNOWN, ABSENT, cells).astype(np.uint8)

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return the template; a line mapped near a seen one is not missed."""
        near = np.zeros(evidence.cells.shape, dtype=np.float32)
        for name, layer, into in zip(evidence.classes, evidence.cells, near, strict=True):
            if name in THIN:
                into[:] = fade(layer == PRESENT, reach_cells=self.reach_m / evidence.cell_size_m)
        weights = stability(evidence.classes) if self.switches.is_stable else np.ones(len(evidence.classes))
        return make_template(evidence.cells, VoteGains(agree=weights, extra=weights, missed=weights), near=near)

    def rescored(self, modes: list[Mode], check: PoseCheck) -> list[Mode]:
        """Return the modes with scores of raster and graph."""
        if not self.switches.has_graph:
            return modes
        graph = GraphCheck(check=check)
        distances = np.array([graph.distance(mode.pose) for mode in modes])
        scores = blended(np.array([mode.score for mode in modes]), distances)
        return [replace(mode, score=float(score)) for mode, score in zip(modes, scores, strict=True)]

    def diagnose(self, best: Mode, check: PoseCheck) -> dict[str, float]:
        """Return diagnostics of the best mode, that of the graph only if the variant has one."""
        found = super().diagnose(best, check)
        graph = {"graph_distance": GraphCheck(check=check).distance(best.pose)} if self.switches.has_graph else {}
        return found | graph


def stability(classes: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the prior p_c of each class, shape (C,): Eq. (5) of the SASGeo paper with all other factors 1.

    Examples
    --------
    >>> stability(("railway", "farmland")).tolist()
    [0.97, 0.7]
    """
    taxonomy = load_taxonomy()
    return np.array([taxonomy[name].persistence.prior for name in classes], dtype=np.float64)
