# SPDX-License-Identifier: Apache-2.0
"""`full_unknown`: as `raster_graph_stability`, and what is unknown in the view says nothing."""

from sasgeo_baselines.raster import GRAPH, LIMITS, OURS, SOURCE, STABLE, RasterMatcher, Switches
from sasgeo_bench import MatcherCard


class FullUnknown(RasterMatcher):
    """Raster by stability, graph descriptor, and three states."""

    card = MatcherCard(
        name="full_unknown",
        version="1",
        title="The paper's full model: stability, graph descriptor, unknown ignored",
        source=SOURCE.format(variant=5),
        ours=(
            f"{OURS}; {GRAPH}; {STABLE}; what is unknown in the view is silent, class by class: it neither agrees nor "
            "contradicts, and the descriptor of the map is made without it"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No distinctiveness; weights are neither fitted nor aged; {LIMITS}",
    )
    switches = Switches(has_graph=True, is_stable=True, is_unknown_silent=True)
