# SPDX-License-Identifier: Apache-2.0
"""`inliers`: how many matches agree with the pose (geometric verification)."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import MOST, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class Inliers:
    """Count of inliers that the matcher reports, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="inliers",
        version="1",
        title="Matches that agree with the pose",
        source=(
            "Geometric verification, the usual re-check of place recognition: inliers of RANSAC between query and best "
            "match as confidence, among the baselines of Zaffar, Nan and Kooij, CVPR 2024"
        ),
        ours=(
            "The matcher's own diagnostic inliers, of whatever it matches (patches, objects, a clique), or else "
            "inlier_ratio; 1 / (2 + value), and 1/2 where it reports neither; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Says the same of all answers of a matcher that verifies nothing; uncalibrated; counts grow with the "
            "number of objects in a view; of one matcher all answers should report the same diagnostic"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall with the inliers, from 1/2, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([1 / (2 + _told(item)) for item in answers]))


def _told(item: Prediction) -> float:
    """Return the first diagnostic that is given and a number; 0 without one."""
    # Diagnostics in the order in which they are asked for
    values = (item.diagnostics.get(name, math.nan) for name in ("inliers", "inlier_ratio"))
    return next((min(max(value, 0.0), MOST) for value in values if not math.isnan(value)), 0.0)
