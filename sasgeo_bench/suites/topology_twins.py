# SPDX-License-Identifier: Apache-2.0
"""Suite `topology-twins`: a copy of the place in which some roads no longer meet, by gaps of a cell or two."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.suites.base import Scene, Site, SuiteCard, Variant
from sasgeo_bench.suites.twins import TWIN_GROUP, TwinSuite, nodes_of, places_of
from sasgeo_bench.twin import Change, open_gaps

GAP_M: Final = 2.0  # one or two cells: what perception's own gaps hide
LEAST_JUNCTIONS: Final = 3
_NEAR_M: Final = 75.0


def _junctions(scene: Scene) -> NDArray[np.float64] | None:
    """Junctions that have at least two others near."""
    places = places_of(nodes_of(scene, ["intersection"], least_degree=3))
    if len(places) == 0:
        return places
    apart = np.hypot(*(places[:, None, :] - places[None, :, :]).transpose(2, 0, 1))
    return np.asarray(places[(apart < _NEAR_M).sum(axis=1) >= LEAST_JUNCTIONS])


def _change(scene: Scene, site: Site, rng: np.random.Generator) -> Change:
    places = places_of(nodes_of(scene, ["intersection"], least_degree=3))
    near = places[np.hypot(*(places - (site.pose.easting_m, site.pose.northing_m)).T) < _NEAR_M]
    return lambda piece: open_gaps(piece, near, gap_m=GAP_M, rng=rng)


SUITE: Final = TwinSuite(
    card=SuiteCard(
        name="topology-twins",
        version=1,
        title="Topology twins (G2)",
        what="A twin of the place in which one road at each junction stops two metres short of the other.",
        separates="Connectivity of perceived vectors from rasters, in which the gap is as wide as perception's own.",
        falsifier="Without vectors (the control) nothing separates the two but cells within the noise.",
        strength_unit="1 with perceived vectors",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.05,
    ),
    variants=(Variant(role="control", kind="no vectors"), Variant(role="stress", kind="G2", strength=1.0)),
    change_of=_change,
    find=_junctions,
    needs="fewer than three junctions near each other",
)
