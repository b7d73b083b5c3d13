# SPDX-License-Identifier: Apache-2.0
"""Suite `absent`: views whose place cannot be found, each kind apart."""

from dataclasses import replace
from typing import Final

import numpy as np

from sasgeo_bench.evidence import Evidence
from sasgeo_bench.pose import Pose
from sasgeo_bench.suites.base import Draft, Scene, Seeds, Site, Suite, SuiteCard, Variant, controls, perceived

PATCH_CELLS: Final = 24
_TURNS: Final = 4
_TRIES: Final = 64
_MOST_DRAWN: Final = 0.003  # of a feature-poor view


class AbsentSuite(Suite):
    """Outside the searched map, feature-poor, another town, or a corrupted view; the control is as everywhere."""

    def lack(self, scene: Scene) -> str | None:
        """A place to take a wrong view from is needed."""
        if scene.elsewhere is None:
            return "no other region: name a second one, views of a wrong place are taken there"
        return None

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """Make the view of one kind of absence."""
        seen = perceived(scene.world, site, variant, seeds)
        if variant.kind == "outside":
            # The disc that is searched lies so far off that the view's footprint is beyond it.
            return Draft(
                evidence=seen, is_present=False, away_m=2 * variant.side_m, measured={"away_m": 2 * variant.side_m}
            )
        if variant.kind == "feature-poor":
            return _feature_poor(scene, site, variant, seeds)
        if variant.kind == "wrong place" and scene.elsewhere is not None:
            other = _same_place_elsewhere(scene, site, seeds)
            return Draft(
                evidence=perceived(scene.elsewhere, other, variant, seeds),
                is_present=False,
                has_pose=False,
                measured={"density": other.density},
            )
        if variant.kind == "corrupted view":
            broken = shuffle_patches(seen, seeds.rng("patches"))
            moved = float((broken.cells != seen.cells).mean())
            return Draft(evidence=broken, is_present=False, measured={"cells_changed": moved})
        return Draft(evidence=seen)


def _feature_poor(scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
    """A place of the same block with nearly nothing drawn on it; the site's own view without its things if none is.

    The place is on the map, so an answer may be right; but there is next to nothing to tell it by.
    """
    poor = _poor_place(scene, site, variant, seeds)
    if poor is not None:
        there = replace(site, pose=poor)
        return Draft(evidence=perceived(scene.world, there, variant, seeds), pose=poor, measured={"is_real_place": 1.0})
    seen = perceived(scene.world, site, variant, seeds)
    return Draft(evidence=strip(seen), measured={"is_real_place": 0.0})


def _poor_place(scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Pose | None:
    """A place in the site's block whose square is mapped and holds hardly anything drawn."""
    block = next(item for item in scene.blocks if item.id == site.block)
    west, south, east, north = block.bounds_m
    state, rng = scene.map, seeds.rng("feature-poor")
    half = round(variant.side_m / 2 / state.grid.cell_size_m)
    for _ in range(_TRIES):
        easting_m, northing_m = (float(value) for value in rng.uniform((west, south), (east, north)))
        row, col = state.grid.to_cells(np.array([[easting_m, northing_m]]))[0].tolist()
        window = (slice(max(0, row - half), row + half), slice(max(0, col - half), col + half))
        is_mapped = state.known[window].size == (2 * half) ** 2 and state.known[window].all()
        if is_mapped and state.drawn[window].mean() <= _MOST_DRAWN:
            return replace(site.pose, easting_m=easting_m, northing_m=northing_m)
    return None


def strip(evidence: Evidence) -> Evidence:
    """Leave only ground cover: every drawn thing is absent, as over open land, forest or water."""
    cells = evidence.cells.copy()
    for index, name in enumerate(evidence.classes):
        if name not in ("green", "farmland", "water", "coastline"):
            cells[index][cells[index] == 1] = 0
    return evidence.replace(cells)


def shuffle_patches(evidence: Evidence, rng: np.random.Generator, *, patch_cells: int = PATCH_CELLS) -> Evidence:
    """Cut the view into patches, shuffle and turn them: every local statistic stays, the place is gone."""
    rows, cols = (size // patch_cells for size in evidence.shape)
    cells = evidence.cells.copy()
    patches = [
        (slice(r * patch_cells, (r + 1) * patch_cells), slice(c * patch_cells, (c + 1) * patch_cells))
        for r in range(rows)
        for c in range(cols)
    ]
    order, turns = rng.permutation(len(patches)), rng.integers(0, _TURNS, len(patches))
    for target, source, turn in zip(patches, order.tolist(), turns.tolist(), strict=True):
        cells[(slice(None), *target)] = np.rot90(evidence.cells[(slice(None), *patches[source])], turn, axes=(1, 2))
    return evidence.replace(cells)


def _same_place_elsewhere(scene: Scene, site: Site, seeds: Seeds) -> Site:
    """A site of about the same density in the other region: an easy giveaway would be no test."""
    other = scene.elsewhere
    if other is None:
        return site
    rng = seeds.rng("elsewhere")
    west, south, east, north = other.grid.bounds_m
    best: tuple[float, Site] | None = None
    margin_m = 0.5 * min(east - west, north - south, 400.0)
    for _ in range(_TRIES):
        x, y = rng.uniform((west + margin_m, south + margin_m), (east - margin_m + 1e-6, north - margin_m + 1e-6))
        row, col = other.grid.to_cells(np.array([[x, y]]))[0].tolist()
        half = round(margin_m / other.grid.cell_size_m / 2)
        window = (slice(max(0, row - half), row + half + 1), slice(max(0, col - half), col + half + 1))
        if not other.known[window].all():
            continue
        density = float(other.drawn[window].mean())
        pose = Pose(easting_m=float(x), northing_m=float(y), yaw_deg=site.pose.yaw_deg, scale=site.pose.scale)
        found = Site(index=site.index, pose=pose, block=site.block, density=density)
        if best is None or abs(density - site.density) < best[0]:
            best = (abs(density - site.density), found)
    return best[1] if best else site


SUITE: Final = AbsentSuite(
    card=SuiteCard(
        name="absent",
        version=1,
        title="Absent places",
        what="The true place is not in the searched map, it has next to nothing to tell it by, the view is of another "
        "town, or it is corrupted.",
        separates="Rejection: a matcher that answers here makes a false fix.",
        falsifier="The control of each site is present and must not be withheld more often than elsewhere.",
        strength_unit="1 where it cannot be found",
    ),
    variants=(
        *controls(),
        *(
            Variant(role="stress", kind=kind, strength=1.0)
            for kind in ("outside", "feature-poor", "wrong place", "corrupted view")
        ),
    ),
)
