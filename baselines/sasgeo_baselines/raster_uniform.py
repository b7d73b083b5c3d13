# SPDX-License-Identifier: Apache-2.0
"""`raster_uniform`: the paper's raster objective with uniform weights, thin lines by their distance transform."""

from sasgeo_baselines.raster import LIMITS, OURS, SOURCE, UNKNOWN_IS_ABSENT, RasterMatcher
from sasgeo_bench import MatcherCard


class RasterUniform(RasterMatcher):
    """Every weight and gain 1, and every switch off."""

    card = MatcherCard(
        name="raster_uniform",
        version="2",
        title="Raster matching with uniform weights",
        source=SOURCE.format(variant=2),
        ours=f"{OURS}; {UNKNOWN_IS_ABSENT}",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"No stability, no distinctiveness, no graph, no unknown; {LIMITS}",
    )
