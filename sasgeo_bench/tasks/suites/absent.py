# SPDX-License-Identifier: Apache-2.0
"""Suite `absent`: views whose place cannot be found, each kind apart."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.suites.base import (
    Draft,
    Scene,
    Seeds,
    Site,
    State,
    Suite,
    SuiteCard,
    Variant,
    controls,
    perceived,
)

PATCH_CELLS: Final = 24
_TURNS: Final = 4
_TRIES: Final = 256
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
            return Draft(evidence=seen, is_present=False, away_m=2 * variant.side_m)
        if variant.kind == "feature-poor":
            return _feature_poor(scene, site, variant, seeds)
        if variant.kind == "wrong place" and scene.elsewhere is not None:
            other = _same_place_elsewhere(scene, scene.elsewhere, site, variant, seeds)
            return Draft(
                evidence=perceived(scene.elsewhere, other, variant, seeds),
                is_present=False,
                has_pose=False,
                density=other.density,
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
        return Draft(
            evidence=perceived(scene.world, replace(site, pose=poor.pose), variant, seeds),
            pose=poor.pose,
            density=poor.density,
            measured={"is_real_place": 1.0},
        )
    seen = perceived(scene.world, site, variant, seeds)
    return Draft(evidence=strip(seen), density=0.0, measured={"is_real_place": 0.0})


def _poor_place(scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Site | None:
    """A place in the site's block whose square is mapped and holds hardly anything drawn."""
    block = next(item for item in scene.blocks if item.id == site.block)
    west, south, east, north = block.bounds_m
    state, rng = scene.map, seeds.rng("feature-poor")
    half = round(variant.side_m / 2 / state.grid.cell_size_m)
    for _ in range(_TRIES):
        point = rng.uniform((west, south), (east, north))
        if not state.is_mapped(point, scene.view_reach_m):
            continue
        density = _density(state, point, half)
        if density <= _MOST_DRAWN:
            pose = replace(site.pose, easting_m=float(point[0]), northing_m=float(point[1]))
            return replace(site, pose=pose, density=density)
    return None


def _density(state: State, point: NDArray[np.float64], half: int) -> float:
    """Share of drawn cells in a square that is mapped."""
    row, col = state.grid.to_cells(point[None, :])[0].tolist()
    return float(state.drawn[row - half : row + half, col - half : col + half].mean())


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


def _same_place_elsewhere(scene: Scene, other: State, site: Site, variant: Variant, seeds: Seeds) -> Site:
    """Of many places in the other region, that with the density nearest to the site's: an easy giveaway is no test."""
    rng = seeds.rng("elsewhere")
    west, south, east, north = other.grid.bounds_m
    half = round(variant.side_m / 2 / other.grid.cell_size_m)
    points = [
        point
        for point in rng.uniform((west, south), (east, north), (_TRIES, 2))
        if other.is_mapped(point, scene.view_reach_m)
    ]
    if not points:
        message = f"{other.region} is too small to take a view of a wrong place from: choose another split"
        raise ConfigError(message)
    densities = [_density(other, point, half) for point in points]
    best = int(np.argmin(np.abs(np.array(densities) - site.density)))
    pose = replace(site.pose, easting_m=float(points[best][0]), northing_m=float(points[best][1]))
    return replace(site, pose=pose, density=densities[best])


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
        needs=("another region",),
    ),
    variants=(
        *controls(),
        *(
            Variant(role="stress", kind=kind, strength=1.0)
            for kind in ("outside", "feature-poor", "wrong place", "corrupted view")
        ),
    ),
)
