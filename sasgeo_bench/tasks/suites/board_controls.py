# SPDX-License-Identifier: Apache-2.0
"""Suite `controls`: views whose right score is known beforehand; a board on which they fail is not to be trusted."""

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence, LayerBits
from sasgeo_bench.tasks.query import BLIND, CONTROLS, NOISE_FREE, SHUFFLED, TURNED, TWINS, PriorGroup, Track
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import QueryDraft, SuiteCard, Variant, ViewRequest, changed_share
from sasgeo_bench.tasks.suites.twins import TwinSuite

VIEW_CELLS: Final = 96
# Smaller than the distance to a site's twin, so that only one place fits a noise-free view.
NEAR: Final = PriorGroup(radius_m=100.0, yaw="weak", scale_sigma=0.03)
_PIECE_M: Final = 32.0


class ControlSuite(TwinSuite):
    """Views without error: of the map, of a wrong map, of one of two identical places, and of nothing.

    A wrong map is the world cut into shuffled pieces, or rotated by 180 degrees around a point. Its views keep the
    place of their site as their truth, so a score better than chance shows a leak.
    """

    def tracks(self, variant: Variant) -> tuple[Track, ...]:
        """Ask for twins only among candidates."""
        return ("retrieval",) if variant.kind == TWINS else self.card.tracks

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """See the map of the variant's kind; only `TWINS` has the site's twin among its candidates."""
        clear, kind = shot.clean(), shot.variant.kind
        if kind == BLIND:
            nothing = clear.replace(np.full_like(clear.cells, UNKNOWN))
            return QueryDraft(evidence=nothing, is_present=False, has_pose=False, is_removed=True, has_twins=False)
        if kind == SHUFFLED:
            return _wrong(shot.clean(shuffled(shot.scene.world, shot.seeds.rng(SHUFFLED))), clear)
        if kind == TURNED:
            return _wrong(shot.variant.view(shot.scene.world, _turned(shot)), clear)
        is_twin = kind == TWINS
        return QueryDraft(evidence=clear, has_twins=is_twin, group=None if is_twin else NEAR)


def _wrong(seen: Evidence, clear: Evidence) -> QueryDraft:
    return QueryDraft(evidence=seen, has_twins=False, changed_share=changed_share(clear, seen))


def shuffled(state: State, rng: np.random.Generator) -> State:
    """Shuffle squares of 32 m of a state's layers that are wholly mapped; features and graph stay."""
    side = max(1, round(_PIECE_M / state.grid.cell_size_m))
    rows, cols = state.grid.rows // side, state.grid.cols // side
    bits, inner = state.bits.bits.copy(), (slice(rows * side), slice(cols * side))
    pieces = bits[inner].reshape(rows, side, cols, side).swapaxes(1, 2).reshape(rows * cols, side, side)
    is_whole = state.known[inner].reshape(rows, side, cols, side).all(axis=(1, 3)).ravel()
    pieces[is_whole] = pieces[rng.permutation(np.flatnonzero(is_whole))]
    bits[inner] = pieces.reshape(rows, cols, side, side).swapaxes(1, 2).reshape(rows * side, cols * side)
    bits.flags.writeable = False
    return replace(state, bits=LayerBits(bits=bits, count=state.bits.count))


def _turned(shot: ViewRequest) -> Pose:
    """Return where the view comes from if the world is rotated by 180 degrees: a mapped place well away."""
    scene, here, rng = shot.scene, np.array(shot.site.en_m), shot.seeds.rng(TURNED)
    least_m = 2 * scene.view_reach_m
    west_m, south_m, east_m, north_m = scene.world.grid.bounds_m
    points = rng.uniform((west_m, south_m), (east_m, north_m), (400, 2))
    far = points[np.hypot(*(points - here).T) >= least_m]
    for place in far:
        if scene.world.is_mapped(place, scene.view_reach_m):
            return _at(shot.site.pose, place)
    return _at(shot.site.pose, far[0] if len(far) else here + least_m)


def _at(pose: Pose, place: NDArray[np.float64]) -> Pose:
    easting_m, northing_m = float(place[0]), float(place[1])
    return replace(pose, easting_m=easting_m, northing_m=northing_m, yaw_deg=(pose.yaw_deg + 180) % 360)


SUITE: Final = ControlSuite(
    card=SuiteCard(
        name=CONTROLS,
        version=1,
        title="Controls of a board",
        what="Views without error (found nearly always), of a shuffled and of a turned map (found by chance), of one "
        "of two places that are the same (told apart by chance), and of nothing (withheld).",
        separates="Boards that can be trusted from boards with a leak or a fault; no matcher is ranked by it.",
        falsifier="All but the views without error.",
        strength_unit="number of the draw",
        tracks=("retrieval", "localization"),
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind=NOISE_FREE, view_cells=VIEW_CELLS),
        *(Variant(role="falsifier", kind=kind, view_cells=VIEW_CELLS) for kind in (SHUFFLED, TURNED, BLIND)),
        *(
            Variant(role="falsifier", kind=TWINS, strength=float(number), view_cells=VIEW_CELLS)
            for number in range(1, 4)  # 3 queries of each pair of twins
        ),
    ),
    within_m=math.inf,  # twins are candidates, and lie outside the disc of all others
    is_swapped=False,
)
