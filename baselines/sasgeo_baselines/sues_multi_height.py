# SPDX-License-Identifier: Apache-2.0
"""`sues_multi_height`: tiles ranked by a feature that is learned from views at four heights (SUES-200)."""

from typing import Final

from sasgeo_baselines.embedding import LIMITS, EmbeddingMatcher, ours
from sasgeo_bench import MatcherCard

HEIGHTS: Final = (0.75, 1.0, 1.25, 1.5)  # as remembered: 150, 200, 250 and 300 m, over the second
MADE_UP: Final = 2  # views of a random location at each height


class SuesMultiHeight(EmbeddingMatcher):
    """Instance loss over one tile of each location and views from four heights."""

    card = MatcherCard(
        name="sues_multi_height",
        version="1",
        title="Tiles ranked by a feature learned from views at four heights",
        source=(
            "Zhu et al., SUES-200, IEEE TCSVT 2023: each scene has one image from a satellite and views from drones at "
            "four heights, which are ranked by a feature that they share"
        ),
        ours=(
            f"The heights are {', '.join(f'{height:g}' for height in HEIGHTS)} of that of the view, whose descriptor "
            "is read at as many scales, as if the height were not known. One tile, facing north, and its views at all "
            f"heights, turned north, are the lessons of a location; a random one has {MADE_UP} views at each height. A "
            f"question is asked at its own height. {ours(EmbeddingMatcher.chosen)}"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"A feature that bears wrong heights tells less than one for the right height, which is known. {LIMITS}",
    )
    heights = HEIGHTS
    made_up = MADE_UP
