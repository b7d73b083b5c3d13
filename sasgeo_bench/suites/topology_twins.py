# SPDX-License-Identifier: Apache-2.0
"""Suite `topology-twins`: a copy of the place whose roads do not meet where they met, or meet elsewhere."""

from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.suites.base import Scene, Site, SuiteCard, Variant
from sasgeo_bench.suites.twins import TWIN_GROUP, TwinSuite, nodes_of, places_of
from sasgeo_bench.twin import Change, open_gaps, stagger

GAP_M: Final = 2.0  # one or two cells: what perception's own gaps hide
OFFSET_M: Final = 5.0  # between two T-junctions: less than a road is wide
LEAST_JUNCTIONS: Final = 2
_PAIR_M: Final = 125.0  # between two junctions that a view holds both
_SEEN_M: Final = 90.0
_FEWEST_X: Final = 2


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


SUITE: Final = TwinSuite(
    card=SuiteCard(
        name="topology-twins",
        version=1,
        title="Topology twins (G2)",
        what="A twin of the place in which one road at each junction stops two metres short of the other, or in which "
        "every X-junction is two T-junctions five metres apart; at every second site the other way round.",
        separates="Connectivity of perceived vectors from rasters, in which the gap is as wide as perception's own.",
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
