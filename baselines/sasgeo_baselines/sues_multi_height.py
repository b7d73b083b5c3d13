# SPDX-License-Identifier: Apache-2.0
"""`sues_multi_height`: tiles ranked by a feature that is learned from views at four heights (SUES-200)."""

from typing import Final

from sasgeo_baselines.embedding import LIMITS, OURS, EmbeddingMatcher
from sasgeo_bench import MatcherCard

HEIGHTS: Final = (0.75, 1.0, 1.25, 1.5)  # 150, 200, 250 and 300 m over the second


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
            "The heights are 0.75, 1, 1.25 and 1.5 of that of the view, whose descriptor is read at four scales, as if "
            "the height were not known. One tile, facing north, and its views at all heights, turned north, are the "
            "lessons of a location; a random one has two views at each height. A question is asked at its own height. "
            f"{OURS}"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"A feature that bears wrong heights tells less than one for the right height, which is known; {LIMITS}",
    )
    chosen = {"penalty": 1e-4, "epochs": 15}
    heights = HEIGHTS
    made_up = 2
