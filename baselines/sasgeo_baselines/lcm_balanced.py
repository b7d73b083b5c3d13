# SPDX-License-Identifier: Apache-2.0
"""`lcm_balanced`: tiles ranked by a feature that is learned from as many turned tiles as views (LCM)."""

from typing import Final

from sasgeo_baselines.embedding import LIMITS, OURS, EmbeddingMatcher
from sasgeo_bench import MatcherCard

COPIES: Final = 36  # 10 degrees from each other
SEVERAL_DEG: Final = (-10.0, 0.0, 10.0)


class LcmBalanced(EmbeddingMatcher):
    """Classification of locations with as many turned tiles as views, and the mean feature of several queries."""

    card = MatcherCard(
        name="lcm_balanced",
        version="1",
        title="Tiles ranked by a feature learned from as many turned tiles as views",
        source=(
            "Ding et al., LCM, Remote Sensing 2021: locations are classified; the one image from a satellite is "
            "augmented until a class has as many as views from drones; the features of several queries are averaged"
        ),
        ours=(
            "36 copies of the tile of a location, 10 degrees from each other, and as many views at the same headings, "
            "so that the feature tells places and hardly headings. A question has one view: the several queries whose "
            f"features are averaged are copies of it that are turned by -10, 0 and 10 degrees. {OURS}"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=f"Nearly blind to directions within a tile, and so to the heading that it answers; {LIMITS}",
    )
    chosen = {"penalty": 1e-4, "epochs": 15}
    copies = COPIES
    made_up = COPIES
    several_deg = SEVERAL_DEG
