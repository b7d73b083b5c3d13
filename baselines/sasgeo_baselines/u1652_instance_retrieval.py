# SPDX-License-Identifier: Apache-2.0
"""`u1652_instance_retrieval`: tiles ranked by a feature learned with an instance loss (University-1652)."""

from sasgeo_baselines.embedding import LIMITS, EmbeddingMatcher, ours
from sasgeo_bench import MatcherCard


class U1652InstanceRetrieval(EmbeddingMatcher):
    """Instance loss over one tile and several views of each location."""

    card = MatcherCard(
        name="u1652_instance_retrieval",
        version="1",
        title="Tiles ranked by a feature learned with an instance loss",
        source=(
            "Zheng, Wei and Yang, University-1652, ACM Multimedia 2020: a location is a class, views from drones and "
            "from a satellite share a feature in front of one softmax (instance loss), and are ranked by its cosine"
        ),
        ours=(
            "One tile, facing north, and its views, turned north, are the lessons of a location; a random one has "
            f"{EmbeddingMatcher.made_up} views. {ours(EmbeddingMatcher.chosen)}"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=LIMITS,
    )
