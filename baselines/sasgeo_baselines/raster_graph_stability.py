# SPDX-License-Identifier: Apache-2.0
"""`raster_graph_stability`: as `raster_graph`, and what lasts weighs more in the raster."""

from sasgeo_baselines.raster import GRAPH, LIMITS, OURS, SOURCE, STABLE, UNKNOWN_IS_ABSENT, RasterMatcher, Switches
from sasgeo_bench import MatcherCard


class RasterGraphStability(RasterMatcher):
    """Raster by stability, and graph descriptor."""

    card = MatcherCard(
        name="raster_graph_stability",
        version="1",
        title="Stability-weighted raster matching and graph descriptor",
        source=SOURCE.format(variant=4),
        ours=f"{OURS}; {GRAPH}; {STABLE}; {UNKNOWN_IS_ABSENT}",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No distinctiveness, no unknown; weights are neither fitted nor aged; {LIMITS}",
    )
    switches = Switches(has_graph=True, is_stable=True)
