# SPDX-License-Identifier: Apache-2.0
"""The small town as a map for the search, and views of it."""

import pytest

from sasgeo_bench.sasgeo.raster import likeness_by_hand, read_field


@pytest.fixture(scope="module")
def field(tiny):
    return read_field(tiny.region, likeness_by_hand(tiny.region.classes))


@pytest.fixture(scope="module")
def asked(tiny):
    """Views whose places are on the map, and these."""
    pairs = zip(tiny.queries, tiny.truths, strict=True)
    return [(query, truth.pose) for query, truth in pairs if truth.pose is not None and query.suite == "clean"]
