# SPDX-License-Identifier: Apache-2.0
"""Suite `volatile-lure`: another place has today's fields and sheds, the true one still has its roads and water."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from sasgeo_bench.tasks.suites.base import Draft, Edit, Scene, Seeds, Shot, Site, SuiteCard, pair
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite
from sasgeo_bench.tasks.twin import mirror

VOLATILE: Final = ("farmland", "parking", "field_boundary", "building", "green")
STABLE: Final = ("road_major", "road_minor", "path_track", "railway", "water", "waterway", "coastline", "bridge")


class VolatileLure(TwinSuite):
    """The world is the map with its volatile classes mirrored at each site; in a lure all classes are mirrored.

    So the view agrees with the true place on all stable classes and no volatile one, and with the lure the other way
    round; amounts are the same at both.
    """

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Paste the lures into the map, and change the world at the true places.

        If the lure is the true place, by lot, the original is the lure: the world then has the lure's roads, and
        everything else as at the original.
        """
        plain = super().edit(scene, sites, seeds)
        lures = [
            replace(item, change=partial(mirror, classes=(*VOLATILE, *STABLE), center_m=item.source_m))
            for item in plain.map_pastes
        ]
        world = []
        for site, item in zip(plain.sites, plain.map_pastes, strict=True):
            changed = STABLE if site.is_copy else VOLATILE
            target_m = item.target_m if site.is_copy else item.source_m
            change = partial(mirror, classes=changed, center_m=item.source_m)
            world.append(replace(item, target_m=target_m, change=change))
        return replace(plain, map_pastes=tuple(lures), world_pastes=tuple(world))

    def draw(self, shot: Shot) -> Draft:
        """Perceive the changed world for the stress, and the map for control and falsifier."""
        mapped = shot.clean(shot.scene.map)
        if shot.variant.role != "stress":
            return Draft(evidence=shot.perceived(mapped), changed_share=0.0)
        return Draft.of_change(shot.perceived(), shot.clean(), mapped)


SUITE: Final = VolatileLure(
    card=SuiteCard(
        name="volatile-lure",
        version=2,
        title="Volatile lure (S2)",
        what="At the true place fields, parking, green and buildings have changed; a lure agrees on them and on no "
        "road or water.",
        separates="Stability weights from uniform ones, which count a field like a road.",
        falsifier="The same places without the change: the lure agrees on nothing.",
        strength_unit="1 where all that is volatile has changed",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.04,
    ),
    variants=pair("unchanged", "S2", "unchanged again"),
    is_swapped=False,
)
