# SPDX-License-Identifier: Apache-2.0
"""Suite `season`: leaves, snow, low water or harvest hide and change what the map shows, class by class."""

from typing import Final, get_args

from sasgeo_bench.osm.taxonomy import Season as Kind
from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.perturbations.season import CHANGED, Season
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, SuiteCard, Variant, controls, ladder

STRENGTHS: Final = (0.3, 0.6, 0.9)
NEEDS: Final[dict[Kind, tuple[str, ...]]] = {
    "leaf_on": ("green",),
    "snow": (),
    "low_water": CHANGED["low_water"],
    "harvest": ("farmland",),
}


class SeasonSuite(Suite):
    """The query gives the season; in the falsifier it does so without any change."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a map that knows of no class that a season changes."""
        known = set(scene.map.classes)
        if not any(known.intersection(changed) for changed in CHANGED.values()):
            return "no season changes any class that its map knows of"
        return super().lack(scene)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the seasons whose classes the map has."""
        cells = float(scene.map.known.sum())
        shares = {name: float(scene.map.has(name).sum()) / max(1.0, cells) for name in scene.map.classes}
        # 0.003 of the mapped cells that the classes of a season cover
        able = {
            kind
            for kind, names in NEEDS.items()
            if shares.keys() & CHANGED[kind] and (not names or sum(shares.get(name, 0.0) for name in names) > 0.003)
        }
        return tuple(item for item in self.variants if item.role == "control" or item.kind in able)

    def draw(self, shot: Shot) -> Draft:
        """Change the view by the season, then perceive it."""
        if shot.variant.role == "control":
            return Draft(evidence=shot.perceived())
        kind = next(kind for kind in get_args(Kind) if kind == shot.variant.kind)
        clean = shot.clean()
        changed = Season(kind=kind, strength=shot.variant.strength)(clean, shot.rng("season", kind))
        measured = {"cells_changed": share_changed(clean, changed)}
        return Draft(evidence=shot.perceived(changed), season=kind, measured=measured)


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
        *controls(),
        *(variant for kind in NEEDS for variant in ladder(kind, STRENGTHS, small=(0.6, 0.9))),
        *(Variant(role="falsifier", kind=kind) for kind in NEEDS),
    ),
)
