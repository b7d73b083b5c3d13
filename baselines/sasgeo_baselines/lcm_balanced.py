# SPDX-License-Identifier: Apache-2.0
"""`lcm_balanced`: tiles ranked by a feature that is learned from as many turned tiles as views (LCM)."""

from typing import Final

from sasgeo_baselines.embedding import LIMITS, EmbeddingMatcher, ours
from sasgeo_bench import MatcherCard

COPIES: Final = 36  # 10 degrees from each other
SEVERAL_DEG: Final = (-10.0, 0.0, 10.0)


class LcmBalanced(EmbeddingMatcher):
    """Classification of locations with as many turned tiles as views, and the mean feature of several queries."""

    chosen = {"shrinkage": 0.1, "size": 128}

    card = MatcherCard(
        name="lcm_balanced",
        version="1",
        title="Tiles ranked by a feature learned from as many turned tiles as views",
        source=(
            "Ding et al., LCM, Remote Sensing 2021: locations are classified; the one image from a satellite is "
            "augmented until a class has as many as views from drones; the features of several queries are averaged"
        ),
        ours=(
            f"{COPIES} copies of the tile of a location, {360 / COPIES:g} degrees from each other, and as many views "
            "at the same headings, so that the feature tells places and hardly headings. A question has one view: the "
            "several queries whose features are averaged are copies of it that are turned by "
            f"{', '.join(f'{turn_deg:g}' for turn_deg in SEVERAL_DEG)} degrees. {ours(chosen)}"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Nearly blind to directions within a tile, and so to the heading that it answers: where that is known, "
            f"it costs places. {LIMITS}"
        ),
    )
    copies = COPIES
    made_up = COPIES
    several_deg = SEVERAL_DEG
