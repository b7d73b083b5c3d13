# SPDX-License-Identifier: Apache-2.0
"""Suite `controls`: queries whose right score is known beforehand; a board on which they fail is not to be trusted."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence, LayerBits
from sasgeo_bench.tasks.query import BLIND, CONTROLS, NOISE_FREE, SHUFFLED, TURNED, TWINS, PriorGroup, Track
from sasgeo_bench.tasks.suites.base import Draft, Scene, Seeds, Site, State, SuiteCard, Variant, changed_share
from sasgeo_bench.tasks.suites.twins import TwinSuite

VIEW_CELLS: Final = 96
# Narrower than the way to a site's twin, so that a noise-free view has one place alone.
NEAR: Final = PriorGroup(radius_m=100.0, yaw="weak", scale_sigma=0.03)
_TWIN_DRAWS: Final = 3  # queries of each pair of twins
_PIECE_M: Final = 32.0
_TRIES: Final = 400


class ControlSuite(TwinSuite):
    """Views without error: of the map, of a wrong map, of one of two places that are the same, and of nothing.

    A wrong map is the world cut into pieces that are shuffled, or turned by half around a point. Its views keep the
    place of their site as their truth, so that whoever scores better than chance has it from somewhere else.
    """

    def tracks(self, variant: Variant) -> tuple[Track, ...]:
        """Twins are told apart among candidates alone."""
        return ("retrieval",) if variant.kind == TWINS else self.card.tracks

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """See what the kind says; the candidates of all but `TWINS` are without the site's twin."""
        clear = _view(scene.world, site.pose, variant)
        if variant.kind == BLIND:
            nothing = clear.replace(np.full_like(clear.cells, UNKNOWN))
            return Draft(evidence=nothing, is_present=False, has_pose=False, is_removed=True, has_twins=False)
        if variant.kind == SHUFFLED:
            return _wrong(_view(shuffled(scene.world, seeds.rng(SHUFFLED)), site.pose, variant), clear)
        if variant.kind == TURNED:
            return _wrong(_view(scene.world, _turned(scene, site, seeds.rng(TURNED)), variant), clear)
        is_twin = variant.kind == TWINS
        return Draft(evidence=clear, has_twins=is_twin, group=None if is_twin else NEAR)


def _view(state: State, pose: Pose, variant: Variant) -> Evidence:
    return state.view(pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)


def _wrong(seen: Evidence, clear: Evidence) -> Draft:
    return Draft(evidence=seen, has_twins=False, changed_share=changed_share(clear, seen))


def shuffled(state: State, rng: np.random.Generator) -> State:
    """Cut a state into squares of 32 m and lay those that are mapped whole in any order; all others stay.

    Its features and graph are those of before: it is there to be seen.
    """
    side = max(1, round(_PIECE_M / state.grid.cell_size_m))
    rows, cols = state.grid.rows // side, state.grid.cols // side
    bits, inner = state.bits.bits.copy(), (slice(rows * side), slice(cols * side))
    pieces = bits[inner].reshape(rows, side, cols, side).swapaxes(1, 2).reshape(rows * cols, side, side)
    is_whole = state.known[inner].reshape(rows, side, cols, side).all(axis=(1, 3)).ravel()
    pieces[is_whole] = pieces[rng.permutation(np.flatnonzero(is_whole))]
    bits[inner] = pieces.reshape(rows, cols, side, side).swapaxes(1, 2).reshape(rows * side, cols * side)
    bits.flags.writeable = False
    return replace(state, bits=LayerBits(bits=bits, count=state.bits.count))


def _turned(scene: Scene, site: Site, rng: np.random.Generator) -> Pose:
    """Where a site's view comes from if the world is turned by half around some point: a mapped place well away."""
    least_m = 2 * scene.view_reach_m
    west_m, south_m, east_m, north_m = scene.world.grid.bounds_m
    here = np.array([site.pose.easting_m, site.pose.northing_m])
    points = rng.uniform((west_m, south_m), (east_m, north_m), (_TRIES, 2))
    far = points[np.hypot(*(points - here).T) >= least_m]
    for place in far:
        if scene.world.is_mapped(place, scene.view_reach_m):
            return _at(site.pose, place)
    return _at(site.pose, far[0] if len(far) else here + least_m)


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
            for number in range(1, _TWIN_DRAWS + 1)
        ),
    ),
    change_of=None,
    find=lambda scene: None,  # noqa: ARG005
    needs="",
    is_swapped=False,
)
