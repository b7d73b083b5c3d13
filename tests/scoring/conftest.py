# SPDX-License-Identifier: Apache-2.0
"""What the tests of figures share: a truth of which only the answer matters."""

from collections.abc import Callable

import pytest

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.tasks.query import Truth


@pytest.fixture(scope="session")
def truth_of() -> Callable[..., Truth]:
    """Make a truth at (0, 0) out of what a test asks for."""

    def make(*, candidate: int = -1, is_present: bool = True) -> Truth:
        return Truth(
            query_id="q",
            is_present=is_present,
            pose=Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0),
            candidate=candidate,
            pair_id="p",
            role="control",
            kind="",
            strength=0.0,
            strength_unit="",
            unknown_share=0.0,
            changed_share=0.0,
            feature_density=0.0,
            alias_index=None,
            block="b",
            scene="",
        )

    return make
