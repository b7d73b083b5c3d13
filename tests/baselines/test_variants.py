# SPDX-License-Identifier: Apache-2.0
"""The paper's variants: each differs from the one before by its own switch alone."""

import numpy as np
import pytest
from sasgeo_baselines.fft_vote import FftVote
from sasgeo_baselines.raster_uniform import RasterUniform

from sasgeo_bench.evidence import ABSENT, UNKNOWN
from sasgeo_bench.pose import Pose, Prior

HERE = Pose(easting_m=1170.0, northing_m=8800.0, yaw_deg=40.0)
PLACES = (
    Pose(easting_m=1290.0, northing_m=8870.0, yaw_deg=43.0),
    Pose(easting_m=1176.0, northing_m=8795.0, yaw_deg=43.0),
    Pose(easting_m=1240.0, northing_m=8720.0, yaw_deg=43.0),
)
KNOWN_YAW = Prior(center_m=None, radius_m=None, yaw_deg=43.0, yaw_sigma_deg=5.0, scale_sigma=0.0)


def half_hidden(cells: np.ndarray, state: int) -> np.ndarray:
    """The view with its left half in one state."""
    hidden = cells.copy()
    hidden[:, :, : cells.shape[2] // 2] = state
    return hidden


def answer(made, matcher, evidence, *, seed: int = 1):
    """Poses and scores of the candidates on the textured map."""
    matcher.prepare(made.region_of(made.textured(seed)), None)
    found = matcher.match(made.query_of(evidence, KNOWN_YAW, candidates=PLACES), top_k=3)
    return list(found.poses), list(found.scores)


@pytest.fixture(scope="module")
def view(made):
    """A perfect view of a textured map."""
    return made.view_of(made.region_of(made.textured(1)), HERE, size_cells=64)


@pytest.mark.parametrize("matcher", [RasterUniform()])
def test_what_is_unknown_is_taken_for_absent(made, view, matcher) -> None:
    unknown, absent = (view.replace(half_hidden(view.cells, state)) for state in (UNKNOWN, ABSENT))
    assert answer(made, matcher, unknown) == answer(made, matcher, absent)


@pytest.mark.parametrize("matcher", [FftVote()])
def test_what_is_unknown_is_silent(made, view, matcher) -> None:
    unknown, absent = (view.replace(half_hidden(view.cells, state)) for state in (UNKNOWN, ABSENT))
    assert answer(made, matcher, unknown)[1][0] > answer(made, matcher, absent)[1][0]
