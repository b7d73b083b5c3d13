# SPDX-License-Identifier: Apache-2.0
"""Suite `season`: leaves, snow, low water or harvest hide and change what the map shows, class by class."""

from typing import Final, get_args

from sasgeo_bench.tasks.perturbations.season import Kind, Season
from sasgeo_bench.tasks.suites.base import (
    VIEW_CELLS,
    Draft,
    Scene,
    Seeds,
    Site,
    Suite,
    SuiteCard,
    Variant,
    controls,
    ladder,
    perceived,
)

STRENGTHS: Final = (0.3, 0.6, 0.9)
SMALL_STRENGTHS: Final = (0.6, 0.9)
NEEDS: Final = {"leaf_on": ("green",), "snow": (), "low_water": ("water", "waterway"), "harvest": ("farmland",)}
_LEAST_SHARE: Final = 0.003  # of the mapped cells, for a season to have anything to change


class SeasonSuite(Suite):
    """The query says which season it is; in the falsifier it says so and nothing has changed."""

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Seasons that find what they change."""
        cells = float(scene.map.known.sum())
        shares = {name: float(scene.map.has(name).sum()) / max(1.0, cells) for name in scene.map.classes}
        able = {
            kind for kind, names in NEEDS.items() if not names or sum(shares[name] for name in names) > _LEAST_SHARE
        }
        return tuple(item for item in self.variants if item.role == "control" or item.kind in able)

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """Let the season come, then perceive."""
        if variant.role == "control":
            return Draft(evidence=perceived(scene.world, site, variant, seeds))
        kind = next(kind for kind in get_args(Kind) if kind == variant.kind)
        clean = scene.world.view(site.pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
        changed = Season(kind=kind, strength=variant.strength)(clean, seeds.rng("season", kind, variant.view_cells))
        return Draft(
            evidence=perceived(scene.world, site, variant, seeds, clean=changed),
            season=kind,
            measured={"cells_changed": float((clean.cells != changed.cells).mean())},
        )


SUITE: Final = SeasonSuite(
    card=SuiteCard(
        name="season",
        version=1,
        title="Season (S4)",
        what="Leaves over roads and paths, snow over ground and roads, low water, harvest; the query says which.",
        separates="Weights by season from weights for all the year.",
        falsifier="The query says the season, and nothing has changed.",
        strength_unit="how far the season has come",
    ),
    variants=(
        *controls(views=VIEW_CELLS),
        *(variant for kind in NEEDS for variant in ladder(kind, STRENGTHS, small=SMALL_STRENGTHS)),
        *(Variant(role="falsifier", kind=kind) for kind in NEEDS),
    ),
)
