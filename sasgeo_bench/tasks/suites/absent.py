# SPDX-License-Identifier: Apache-2.0
"""Suite `absent`: views whose place cannot be found, in several kinds."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import (
    MAIN_VIEW_CELLS,
    Draft,
    Scene,
    Shot,
    Site,
    Suite,
    SuiteCard,
    Variant,
    controls,
)

PATCH_CELLS: Final = 24
_TURNS: Final = 4
_TRIES: Final = 256


class AbsentSuite(Suite):
    """Outside the searched map, feature-poor, another town, or a corrupted view; the control is as everywhere."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a scene without another region for wrong views."""
        if scene.elsewhere is None:
            return "no other region: name a second one, views of a wrong place are taken there"
        return None

    def draw(self, shot: Shot) -> Draft:
        """Draw one kind of absence."""
        kind, elsewhere = shot.variant.kind, shot.scene.elsewhere
        if kind == "outside":
            # The searched disc is so far away that it excludes the footprint of the view.
            return Draft(evidence=shot.perceived(), is_present=False, away_m=2 * shot.variant.side_m)
        if kind == "feature-poor":
            return _feature_poor(shot)
        if kind == "wrong place" and elsewhere is not None:
            other = replace(shot, site=_same_place_elsewhere(shot, elsewhere))
            return Draft(
                evidence=other.perceived(other.clean(elsewhere)),
                is_present=False,
                has_pose=False,
                density=other.site.density,
                measured={"density": other.site.density},
            )
        seen = shot.perceived()
        if kind == "corrupted view":
            broken = shuffle_patches(seen, shot.seeds.rng("patches"))
            return Draft(evidence=broken, is_present=False, measured={"cells_changed": share_changed(seen, broken)})
        return Draft(evidence=seen)


def _feature_poor(shot: Shot) -> Draft:
    """Draw a place of the same block with hardly any feature, or the site's own view without its features."""
    # The place is on the map, so an answer may be right; but hardly anything distinguishes it.
    poor = _poor_place(shot)
    if poor is None:
        return Draft(evidence=strip(shot.perceived()), density=0.0, measured={"is_real_place": 0.0})
    seen = replace(shot, site=poor).perceived()
    return Draft(evidence=seen, pose=poor.pose, density=poor.density, measured={"is_real_place": 1.0})


def _poor_place(shot: Shot) -> Site | None:
    """Return a place in the site's block whose square is mapped and holds hardly any feature."""
    state, rng = shot.scene.map, shot.seeds.rng("feature-poor")
    west, south, east, north = next(item for item in shot.scene.blocks if item.id == shot.site.block).bounds_m
    for _ in range(_TRIES):
        point = rng.uniform((west, south), (east, north))
        if state.is_mapped(point, shot.scene.view_reach_m):
            density = _density(state, point, shot.variant)
            if density <= 0.003:  # of the cells of a feature-poor view
                return _moved(shot.site, point, density)
    return None


def _moved(site: Site, point: NDArray[np.float64], density: float) -> Site:
    pose = replace(site.pose, easting_m=float(point[0]), northing_m=float(point[1]))
    return replace(site, pose=pose, density=density)


def _density(state: State, point: NDArray[np.float64], variant: Variant) -> float:
    half = round(variant.side_m / 2 / state.grid.cell_size_m)
    row, col = state.grid.to_cells(point[None, :])[0].tolist()
    return float(state.drawn[row - half : row + half, col - half : col + half].mean())


def strip(evidence: Evidence) -> Evidence:
    """Keep only ground cover, as over open land, forest or water."""
    cells = evidence.cells.copy()
    for index, name in enumerate(evidence.classes):
        if name not in load_taxonomy().covering("land", "water"):
            cells[index][cells[index] == 1] = 0
    return evidence.replace(cells)


def shuffle_patches(evidence: Evidence, rng: np.random.Generator) -> Evidence:
    """Shuffle and rotate square patches of the view: local statistics stay, the place is gone."""
    cells = evidence.cells.copy()
    starts = (range(0, size - PATCH_CELLS + 1, PATCH_CELLS) for size in evidence.shape)
    rows, cols = ([slice(at, at + PATCH_CELLS) for at in listed] for listed in starts)
    patches = [(row, col) for row in rows for col in cols]
    order, turns = rng.permutation(len(patches)), rng.integers(0, _TURNS, len(patches))
    for target, source, turn in zip(patches, order.tolist(), turns.tolist(), strict=True):
        cells[(slice(None), *target)] = np.rot90(evidence.cells[(slice(None), *patches[source])], turn, axes=(1, 2))
    return evidence.replace(cells)


def _same_place_elsewhere(shot: Shot, other: State) -> Site:
    """Return the place of the other region whose density is nearest to the site's, so that it gives nothing away."""
    rng = shot.seeds.rng("elsewhere")
    west, south, east, north = other.grid.bounds_m
    points = [
        point
        for point in rng.uniform((west, south), (east, north), (_TRIES, 2))
        if other.is_mapped(point, shot.scene.view_reach_m)
    ]
    if not points:
        raise ConfigError(f"{other.region} is too small to take a view of a wrong place from: choose another split")
    densities = [_density(other, point, shot.variant) for point in points]
    best = int(np.argmin(np.abs(np.array(densities) - shot.site.density)))
    return _moved(shot.site, points[best], densities[best])


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
        *controls(views=(MAIN_VIEW_CELLS,)),
        *(
            Variant(role="stress", kind=kind, strength=1.0)
            for kind in ("outside", "feature-poor", "wrong place", "corrupted view")
        ),
    ),
)
