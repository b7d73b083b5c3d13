# SPDX-License-Identifier: Apache-2.0
"""Suite `topology-twins`: a copy of the place whose roads do not meet where they met, or meet elsewhere."""

from dataclasses import replace
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.suites.base import Scene, Seeds, Site, SuiteCard, Variant, perceived
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite, nodes_of, places_of
from sasgeo_bench.tasks.twin import Change, open_gaps, stagger

GAP_M: Final = 2.0  # one or two cells: what perception's own gaps hide
OFFSET_M: Final = 5.0  # between two T-junctions: less than a road is wide
LEAST_JUNCTIONS: Final = 2
_PAIR_M: Final = 125.0  # between two junctions that a view holds both
_SEEN_M: Final = 90.0
_FEWEST_X: Final = 2
_ONE_PATCH_CELLS: Final = 4  # cells that differ this near to each other belong to one junction


def _junctions(scene: Scene) -> NDArray[np.float64]:
    """Junctions that have another one near."""
    places = places_of(nodes_of(scene, ["intersection"], least_degree=3))
    tree = shapely.STRtree(shapely.points(places))
    hits = tree.query(shapely.points(places), predicate="dwithin", distance=_PAIR_M)[0]
    return np.asarray(places[np.bincount(hits, minlength=len(places)) >= LEAST_JUNCTIONS])


def _near(scene: Scene, site: Site, *, least_degree: int) -> NDArray[np.float64]:
    places = places_of(nodes_of(scene, ["intersection"], least_degree=least_degree))
    return np.asarray(places[np.hypot(*(places - (site.pose.easting_m, site.pose.northing_m)).T) < _SEEN_M])


def _change(scene: Scene, site: Site, rng: np.random.Generator) -> Change:
    """Two T-junctions for each X where there are some, and otherwise gaps; X-junctions take turns between the two."""
    crossings = _near(scene, site, least_degree=4)
    if len(crossings) >= _FEWEST_X and rng.random() < 0.5:  # noqa: PLR2004 - half of them
        return lambda piece: stagger(piece, crossings, offset_m=OFFSET_M, rng=rng)
    near = _near(scene, site, least_degree=3)
    return lambda piece: open_gaps(piece, near, gap_m=GAP_M, rng=rng)


class TopologyTwins(TwinSuite):
    """As every twin suite; layers show each junction as it is at the true place or as it is at the twin, by lot.

    A gap is a few cells wide, yet at the exact pose a few cells that perception left alone are enough to tell the two
    places apart. So that layers cannot, they have each junction either way, as a detector of that resolution would.
    """

    def see(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Evidence:
        """Perceive the layers with each junction as in one of the two places."""
        easting_m, northing_m = scene.twins[site.index][0]
        twin = replace(site.pose, easting_m=easting_m, northing_m=northing_m)
        own, other = (
            scene.world.view(pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
            for pose in (site.pose, twin)
        )
        clean = either(own, other, seeds.rng("junctions", variant.view_cells))
        return perceived(scene.world, site, variant, seeds, clean=clean)


def either(own: Evidence, other: Evidence, rng: np.random.Generator) -> Evidence:
    """Where two views differ, take each patch of cells from the one or the other.

    Examples
    --------
    >>> cells = np.repeat(np.array([0, 1], dtype=np.uint8), 9).reshape(2, 1, 1, 9)
    >>> one, two = (Evidence(classes=("a",), cells=item, cell_size_m=1.0) for item in cells)
    >>> sorted({int(either(one, two, np.random.default_rng(seed)).cells.sum()) for seed in range(20)})  # one patch
    [0, 9]
    """
    differ = (own.cells != other.cells).any(axis=0)
    near = ndimage.binary_dilation(differ, structure=np.ones((3, 3), dtype=bool), iterations=_ONE_PATCH_CELLS // 2)
    patch, count = ndimage.label(near, structure=np.ones((3, 3)))
    is_other = np.concatenate(([False], rng.random(count) < 0.5))[patch]  # noqa: PLR2004 - half of them
    return own.replace(np.where(is_other, other.cells, own.cells))


SUITE: Final = TopologyTwins(
    card=SuiteCard(
        name="topology-twins",
        version=1,
        title="Topology twins (G2)",
        what="A twin of the place in which one road at each junction stops two metres short of the other, or in which "
        "every X-junction is two T-junctions five metres apart; at every second site the other way round.",
        separates="Connectivity of perceived vectors from rasters, in which each junction looks one way or the other.",
        falsifier="Vectors whose detector closes such gaps show both places alike: no gain over the control.",
        strength_unit="1 with perceived vectors",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no vectors"),
        Variant(role="stress", kind="G2", strength=1.0),
        Variant(role="falsifier", kind="gaps closed"),
    ),
    change_of=_change,
    find=_junctions,
    needs="no two junctions near each other",
)
