# SPDX-License-Identifier: Apache-2.0
"""`raster_graph`: the raster with uniform weights, its modes ranked anew by the graph descriptor."""

from sasgeo_baselines.raster import GRAPH, LIMITS, OURS, SOURCE, UNKNOWN_IS_ABSENT, RasterMatcher, Switches
from sasgeo_bench import MatcherCard


class RasterGraph(RasterMatcher):
    """Raster and graph descriptor."""

    card = MatcherCard(
        name="raster_graph",
        version="1",
        title="Raster matching and graph descriptor",
        source=SOURCE.format(variant=3),
        ours=f"{OURS}; {GRAPH}; {UNKNOWN_IS_ABSENT}",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No stability, no distinctiveness, no unknown; no relations but distances within a class; {LIMITS}",
    )
    switches = Switches(has_graph=True)
