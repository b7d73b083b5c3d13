# SPDX-License-Identifier: Apache-2.0
"""Variants 2 to 5 of the paper, `raster_uniform` to `full_unknown`, as settings of one dense matcher."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.global_descriptor import Descriptor, components
from sasgeo_bench import (
    ABSENT,
    PRESENT,
    UNKNOWN,
    Chart,
    DenseMatcher,
    Evidence,
    MatcherCard,
    Mode,
    Pose,
    PoseCheck,
    Region,
    VoteGains,
    VotePlan,
    fade,
    load_taxonomy,
    make_template,
)

# The graph is made of what the raster has used already, so it has half its weight. Among N poses of which one leads in
# the raster and all others are equal, it leads by N / sqrt(N - 1) > sqrt(N) standard deviations, and no two graph terms
# differ by more than sqrt(2 N): below 1 / sqrt(2) = 0.71 the graph never overturns it.
BETA: Final = 0.5


def blended(scores: NDArray[np.float64], distances: NDArray[np.float64], *, beta: float = BETA) -> NDArray[np.float64]:
    """Subtract graph distances from raster scores of one query, shape (N,), both standardised over its list.

    The result is in units of the raster scores, so that margins keep their meaning: a standard deviation of distances
    counts as `beta` standard deviations of scores; as `beta` itself where all scores are equal.

    Examples
    --------
    >>> blended(np.array([1.0, 3.0]), np.array([0.25, 0.75])).tolist()
    [1.5, 2.5]
    >>> blended(np.array([1.0, 3.0]), np.array([0.5, 0.5])).tolist()
    [1.0, 3.0]
    """
    if len(scores) == 0 or not np.ptp(distances) > 1e-9:  # 1e-9: smaller differences of distances are rounding
        return scores
    unit = scores.std() if np.ptp(scores) > 0 else 1.0
    return np.asarray(scores - beta * unit * (distances - distances.mean()) / distances.std())


@dataclass(frozen=True, kw_only=True)
class GraphCheck:
    """Graph descriptors of a view and of the map under its poses."""

    check: PoseCheck

    def distance(self, pose: Pose) -> float:
        """Return the distance between the descriptors of the view and of the map under a pose, 0..1.

        The map is cut as the view would show it, so the scale of the pose is that of the distances. Cells that are
        unknown to either side are ignored.
        """
        mapped, seen = self.check.mapped(pose), self.check.seen
        known = mapped != UNKNOWN
        view = self._described if known.all() else self._describe((seen == PRESENT) & known)
        return view.distance(self._describe((mapped == PRESENT) & (seen != UNKNOWN)))

    @cached_property
    def _described(self) -> Descriptor:
        return self._describe(self.check.seen == PRESENT)

    def _describe(self, present: NDArray[np.bool_]) -> Descriptor:
        cell_m = self.check.cell_size_m
        layers = np.where(present, np.uint8(PRESENT), np.uint8(ABSENT))
        reach_m = math.hypot(*present.shape[1:]) * cell_m
        return Descriptor.of([components(layer, cell_size_m=cell_m) for layer in layers], reach_m=reach_m)


THIN: Final = load_taxonomy().lines
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
    "headings beyond 2.5 and scales beyond two standard deviations are not searched; candidates that share a place "
    "within 24 m cannot be told apart; no confidence; withholds only where everything is unknown"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Switches:
    """Settings in which the variants differ; all are off in variant 2.

    `has_graph` adds the graph descriptor to the score of each mode (`blended`), `is_stable` weighs each class by
    `stability` instead of 1, `is_unknown_silent` ignores unknown cells of the view, which else count as absent.
    """

    has_graph: bool = False
    is_stable: bool = False
    is_unknown_silent: bool = False


class RasterMatcher(DenseMatcher):
    """Eqs. (7)-(8) with gains of 1; lines agree by proximity, exp(-D^2 / 2 tau^2) with tau `reach_m`."""

    switches: ClassVar[Switches] = Switches()

    def __init__(self, *, reach_m: float = REACH_M, plan: VotePlan | None = None) -> None:
        super().__init__(plan)
        self.reach_m = reach_m

    def read(self, region: Region) -> Chart:
        """Return the map with the proximity of its lines."""
        return Chart.of(region, thin=THIN, reach_m=self.reach_m)

    def seen(self, evidence: Evidence) -> Evidence:
        """Return unknown cells as absent, unless this variant ignores them."""
        return evidence if self.switches.is_unknown_silent else evidence.without_unknown()

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
    """Return the prior p_c of each class, shape (C,): Eq. (5) of the SASGeo paper with all other factors 1."""
    taxonomy = load_taxonomy()
    return np.array([taxonomy[name].persistence.prior for name in classes], dtype=np.float64)


class FullUnknown(RasterMatcher):
    """Raster by stability, graph descriptor, and three states."""

    card = MatcherCard(
        name="full_unknown",
        version="2",
        title="The paper's full model: stability, graph descriptor, unknown ignored",
        source=SOURCE.format(variant=5),
        ours=(
            f"{OURS}; {GRAPH}; {STABLE}; what is unknown in the view is silent, class by class: it neither agrees nor "
            "contradicts, and the descriptor of the map is made without it"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No distinctiveness; weights are neither fitted nor aged; {LIMITS}",
    )
    switches = Switches(has_graph=True, is_stable=True, is_unknown_silent=True)


class RasterGraph(RasterMatcher):
    """Raster and graph descriptor."""

    card = MatcherCard(
        name="raster_graph",
        version="2",
        title="Raster matching and graph descriptor",
        source=SOURCE.format(variant=3),
        ours=f"{OURS}; {GRAPH}; {UNKNOWN_IS_ABSENT}",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No stability, no distinctiveness, no unknown; no relations but distances within a class; {LIMITS}",
    )
    switches = Switches(has_graph=True)


class RasterGraphStability(RasterMatcher):
    """Raster by stability, and graph descriptor."""

    card = MatcherCard(
        name="raster_graph_stability",
        version="2",
        title="Stability-weighted raster matching and graph descriptor",
        source=SOURCE.format(variant=4),
        ours=f"{OURS}; {GRAPH}; {STABLE}; {UNKNOWN_IS_ABSENT}",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No distinctiveness, no unknown; weights are neither fitted nor aged; {LIMITS}",
    )
    switches = Switches(has_graph=True, is_stable=True)


class RasterUniform(RasterMatcher):
    """Every weight and gain 1, and every switch off."""

    card = MatcherCard(
        name="raster_uniform",
        version="3",
        title="Raster matching with uniform weights",
        source=SOURCE.format(variant=2),
        ours=f"{OURS}; {UNKNOWN_IS_ABSENT}",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No stability, no distinctiveness, no graph, no unknown; {LIMITS}",
    )
