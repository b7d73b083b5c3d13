# SPDX-License-Identifier: Apache-2.0
"""Suite `volatile-lure`: another place has today's fields and sheds, the true one still has its roads and water."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from sasgeo_bench.suites.base import Draft, Edit, Scene, Seeds, Site, SuiteCard, Variant, changed_share, perceived
from sasgeo_bench.suites.twins import TWIN_GROUP, TwinSuite
from sasgeo_bench.twin import mirror

VOLATILE: Final = ("farmland", "parking", "field_boundary", "building", "green")
STABLE: Final = ("road_major", "road_minor", "path_track", "railway", "water", "waterway", "coastline", "bridge")


class VolatileLure(TwinSuite):
    """The world is the map with its volatile classes mirrored at each site; a lure has both kinds mirrored.

    So the view agrees with the true place on all that is stable and on nothing volatile, and with the lure the other
    way round; amounts are the same at both.
    """

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Change the world at the sites, and paste the lures into the map."""
        plain = super().edit(scene, sites, seeds)
        own = [item for item in plain.map_pastes if item.source_m == item.target_m]
        lures = [
            replace(item, change=partial(mirror, classes=(*VOLATILE, *STABLE), center_m=item.source_m))
            for item in plain.map_pastes
            if item not in own
        ]
        world = [replace(item, change=partial(mirror, classes=VOLATILE, center_m=item.source_m)) for item in own]
        return Edit(map_pastes=(*own, *lures), world_pastes=tuple(world), twins=plain.twins)

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """The control and the falsifier see the map as it is, the stress the changed world."""
        if variant.role != "stress":
            return Draft(evidence=perceived(scene.map, site, variant, seeds), changed_share=0.0)
        seen = perceived(scene.world, site, variant, seeds)
        cells, cell_m = variant.view_cells, variant.cell_size_m
        views = (state.view(site.pose, size_cells=cells, cell_size_m=cell_m) for state in (scene.world, scene.map))
        share = changed_share(*views)
        return Draft(evidence=seen, changed_share=share, measured={"changed_share": share})


SUITE: Final = VolatileLure(
    card=SuiteCard(
        name="volatile-lure",
        version=1,
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
    variants=(
        Variant(role="control", kind="unchanged"),
        Variant(role="stress", kind="S2", strength=1.0),
        Variant(role="falsifier", kind="unchanged again"),
    ),
    change_of=None,
    find=lambda scene: None,  # noqa: ARG005
    needs="",
    is_swapped=False,
)
