# SPDX-License-Identifier: Apache-2.0
"""Errors of the first pose against the truth, and success within metres and degrees; every query counts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sasgeo_bench.errors import MetricError
from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.scoring.base import Bools, Floats, check_column
from sasgeo_bench.scoring.ranking import MISS, Rank, rank_of
from sasgeo_bench.tasks.query import Truth

SUCCESS_DEG: Final = 5.0
AUC_M: Final = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """Errors of N answers, each of shape (N,) and not negative; infinite without an answer.

    `position_m` is the distance on the map plane, `yaw_deg` unsigned in [0, 180], `log_scale` is |ln(scale / true
    scale)|: twice too large and half as large are equally wrong, and 0.1 is about 10 %.
    """

    position_m: Floats
    yaw_deg: Floats
    log_scale: Floats

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        count = np.size(self.position_m)
        for name in ("position_m", "yaw_deg", "log_scale"):
            column = check_column(getattr(self, name), name, count)
            if (column < 0).any():
                message = f"{name} holds {column.min():g}, errors are not negative"
                raise MetricError(message)
            object.__setattr__(self, name, column)


def first_pose(prediction: Prediction | None) -> Pose | None:
    """Return the fix of an answer, its first pose; None for no row, no answer, a crash or a time-out.

    Of poses with equal scores the first listed counts, since a vehicle would use it.
    """
    if prediction is None or prediction.status != "ok" or not prediction.candidates:
        return None
    return prediction.candidates[0][0]


def pose_errors(answers: Sequence[Pose | None], truths: Sequence[Pose]) -> PoseErrors:
    """Return the errors of N fixes against N truths; infinite for None, never clipped.

    Raise MetricError if there are not as many answers as truths.

    >>> truth = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=350.0)
    >>> errors = pose_errors([Pose(easting_m=3.0, northing_m=4.0, yaw_deg=10.0), None], [truth, truth])
    >>> errors.position_m.tolist(), errors.yaw_deg.tolist(), errors.log_scale.tolist()
    ([5.0, inf], [20.0, inf], [0.0, inf])
    """
    if len(answers) != len(truths):
        message = f"{len(answers)} answers for {len(truths)} truths: give None where there is no answer"
        raise MetricError(message)
    nothing = (math.inf,) * 4
    given = np.array([nothing if pose is None else _numbers(pose) for pose in answers]).reshape(-1, 4)
    true = np.array([_numbers(pose) for pose in truths]).reshape(-1, 4)
    is_given = np.array([pose is not None for pose in answers], dtype=bool)
    gap = np.where(is_given[:, None], given, true) - true
    ratio = np.where(is_given, given[:, 3], true[:, 3]) / true[:, 3]
    return PoseErrors(
        position_m=np.where(is_given, np.hypot(gap[:, 0], gap[:, 1]), np.inf),
        yaw_deg=np.where(is_given, np.abs(wrap_deg(gap[:, 2])), np.inf),
        log_scale=np.where(is_given, np.abs(np.log(ratio)), np.inf),
    )


def _numbers(pose: Pose) -> tuple[float, float, float, float]:
    return (pose.easting_m, pose.northing_m, pose.yaw_deg, pose.scale)


def successes(errors: PoseErrors, within_m: float, within_deg: float = SUCCESS_DEG) -> Bools:
    """Return which fixes are right, shape (N,): `position_m <= within_m` and `yaw_deg <= within_deg`.

    Use 180 degrees to ignore the heading. An error equal to a tolerance is within it, as in all of this package. Metres
    are those of the region's UTM zone, which differ from metres on the ground by at most 0.1 %. Raise MetricError if a
    tolerance is negative or `within_m` is not finite.

    >>> errors = PoseErrors(position_m=[5.0, 5.1, 0.0], yaw_deg=[5.0, 0.0, 5.1], log_scale=[0.0, 0.0, 0.0])
    >>> successes(errors, 5.0).tolist()
    [True, False, False]
    """
    if not 0 <= within_m < math.inf or not within_deg >= 0:
        message = f"tolerances must be finite and not negative, got {within_m!r} m and {within_deg!r} deg"
        raise MetricError(message)
    return (errors.position_m <= within_m) & (errors.yaw_deg <= within_deg)


def rank_pose(prediction: Prediction | None, truth: Truth, *, within_m: float, within_deg: float = SUCCESS_DEG) -> Rank:
    """Return the rank of the best pose within tolerance in an answer to a localization query; `MISS` without one.

    Raise MetricError if the place is absent: recall is a share of the queries whose place is present.
    """
    if not truth.is_present or truth.pose is None:
        message = (
            f"query {truth.query_id} has no right pose: "
            "leave absent places out of recall, the integrity track counts them"
        )
        raise MetricError(message)
    if first_pose(prediction) is None or prediction is None:
        return MISS
    poses = [pose for pose, _ in prediction.candidates]
    errors = pose_errors(poses, [truth.pose] * len(poses))
    return rank_of([score for _, score in prediction.candidates], successes(errors, within_m, within_deg))


def area_values(errors: PoseErrors) -> Floats:
    """Return each query's part of the success AUC, shape (N,): max(0, 1 - error / 50 m), 0 for a wrong heading.

    >>> area_values(PoseErrors(position_m=[10.0, 60.0, 0.0], yaw_deg=[0.0, 0.0, 90.0], log_scale=[0.0] * 3)).tolist()
    [0.8, 0.0, 0.0]
    """
    near = np.maximum(0.0, 1.0 - errors.position_m / AUC_M)
    return np.where(errors.yaw_deg <= SUCCESS_DEG, near, 0.0)
