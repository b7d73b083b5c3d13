# SPDX-License-Identifier: Apache-2.0
"""Suite `volatile-lure`: another place has today's fields and sheds, the true one still has its roads and water."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.tasks.suites.base import Draft, Edit, Scene, Seeds, Shot, Site, SuiteCard, pair
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite
from sasgeo_bench.tasks.twin import mirror

VOLATILE: Final = tuple(item.name for item in load_taxonomy().classes if item.volatile)
STABLE: Final = tuple(item.name for item in load_taxonomy().classes if not item.volatile)


def _mixed(scene: Scene) -> NDArray[np.float64]:
    """Return centres of buildings near something stable: a lure needs both."""
    features = scene.map.features[scene.map.features["is_visible"].to_numpy()]
    shapes = features.geometry.to_numpy()
    centres = shapely.centroid(shapes[(features["class"] == "building").to_numpy()])
    stable = shapely.STRtree(shapes[features["class"].isin(STABLE).to_numpy()])
    near = np.unique(stable.query(centres, predicate="dwithin", distance=40.0)[0])
    return np.asarray(shapely.get_coordinates(centres[near])).reshape(-1, 2)


class VolatileLure(TwinSuite):
    """The world is the map with its volatile classes mirrored at each site; in a lure all classes are mirrored.

    So the view agrees with the true place on all stable classes and no volatile one, and with the lure the other way
    round; amounts are the same at both. Only the middle of each place is mirrored: without anything in common with the
    view, neither place would be in the list of a search, and there would be nothing to decide.
    """

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Paste the lures into the map, and change the world at the true places.

        If the lure is the true place, by lot, the original is the lure: the world then has the lure's roads, and
        everything else as at the original.
        """
        plain = super().edit(scene, sites, seeds)
        # 60 m: radius of what differs: a third of a view; the rest is the same at both places
        middle = partial(mirror, within_m=60.0)
        lures = [
            replace(item, change=partial(middle, classes=(*VOLATILE, *STABLE), center_m=item.source_m))
            for item in plain.map_pastes
        ]
        world = []
        for site, item in zip(plain.sites, plain.map_pastes, strict=True):
            changed = STABLE if site.is_copy else VOLATILE
            target_m = item.target_m if site.is_copy else item.source_m
            change = partial(middle, classes=changed, center_m=item.source_m)
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
        what="In the middle of the true place, 60 m around, fields, parking, green and buildings have changed; a lure "
        "at most 800 m away agrees on them and on no road or water there. Around the middle both agree with the view.",
        separates="Stability weights from uniform ones, which count a field like a road.",
        falsifier="The same places without the change: in its middle the lure agrees on nothing.",
        strength_unit="1 where all that is volatile has changed",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.18,
    ),
    variants=pair("unchanged", "S2", "unchanged again"),
    find=_mixed,
    needs="no building near a road, a railway or water",
    is_swapped=False,
)
