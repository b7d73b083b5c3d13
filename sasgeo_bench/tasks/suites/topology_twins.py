# SPDX-License-Identifier: Apache-2.0
"""Suite `topology-twins`: a copy of the place whose roads do not meet where they met, or meet elsewhere."""

from dataclasses import replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.suites.base import Scene, Shot, Site, SuiteCard, pair
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite, nodes_of, places_of, with_neighbours
from sasgeo_bench.tasks.twin import Change, open_gaps, stagger

_SEEN_M: Final = 90.0
_FEWEST_X: Final = 2


def _junctions(scene: Scene) -> NDArray[np.float64]:
    # 125 m between two junctions that one view shows
    return with_neighbours(places_of(nodes_of(scene, ["intersection"], least_degree=3)), within_m=125.0)


def _near(scene: Scene, site: Site, *, least_degree: int) -> NDArray[np.float64]:
    places = places_of(nodes_of(scene, ["intersection"], least_degree=least_degree))
    return np.asarray(places[np.hypot(*(places - site.en_m).T) < _SEEN_M])


def _change(scene: Scene, site: Site, rng: np.random.Generator) -> Change:
    """Split X-junctions into two T-junctions at half of the sites that have some; open gaps at all others."""
    crossings = _near(scene, site, least_degree=4)
    if len(crossings) >= _FEWEST_X and rng.random() < 0.5:  # half of them
        # 5 m between two T-junctions: less than the width of a road
        return lambda piece: stagger(piece, crossings, offset_m=5.0, rng=rng)
    near = _near(scene, site, least_degree=3)
    # 2 m: one or two cells: perception's own gaps are as wide
    return lambda piece: open_gaps(piece, near, gap_m=2.0, rng=rng)


class TopologyTwins(TwinSuite):
    """Twins whose layers show each junction as at the true place or as at the twin, by lot.

    A gap is a few cells wide, but at the exact pose a few undisturbed cells are enough to distinguish the two places.
    With junctions drawn by lot, as a detector of that resolution would see them, layers cannot.
    """

    def see(self, shot: Shot) -> Evidence:
        """Perceive the layers with each junction as in one of the two places."""
        easting_m, northing_m = shot.scene.twins[shot.site.index][0]
        twin = replace(shot.site.pose, easting_m=easting_m, northing_m=northing_m)
        other = shot.variant.view(shot.scene.world, twin)
        return shot.perceived(either(shot.clean(), other, shot.rng("junctions")))


def either(own: Evidence, other: Evidence, rng: np.random.Generator) -> Evidence:
    """Take each patch of differing cells from one of two views, by lot."""
    differ = (own.cells != other.cells).any(axis=0)
    square = np.ones((3, 3), dtype=bool)
    # Differing cells within this distance belong to one junction
    near = scipy.ndimage.binary_dilation(differ, structure=square, iterations=4 // 2)
    patch, count = scipy.ndimage.label(near, structure=square)
    is_other = np.concatenate(([False], rng.random(count) < 0.5))[patch]  # half of them
    return own.replace(np.where(is_other, other.cells, own.cells))


SUITE: Final = TopologyTwins(
    card=SuiteCard(
        name="topology-twins",
        version=2,
        title="Topology twins (G2)",
        what="A twin of the place, at most 800 m away, in which one road at each junction stops two metres short of "
        "the other, or in which every X-junction is two T-junctions five metres apart; at every second site the other "
        "way round.",
        separates="Connectivity of perceived vectors from rasters, in which each junction looks one way or the other.",
        falsifier="Vectors whose detector closes such gaps show both places alike: no gain over the control.",
        strength_unit="1 with perceived vectors",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.1,  # with less in view a plain search lists neither place
    ),
    variants=pair("no vectors", "G2", "gaps closed"),
    change_of=_change,
    find=_junctions,
    needs="no two junctions near each other",
)
