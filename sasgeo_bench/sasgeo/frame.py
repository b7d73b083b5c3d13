# SPDX-License-Identifier: Apache-2.0
"""Features of answers, without gaps: the input of `sasgeo_logistic` and `sasgeo_boosted`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.sasgeo.integrity import APART_M, EVIDENCE

Rows = NDArray[np.float64]

_MOST: Final = 1e100  # numbers are clipped to it, so that squares and differences stay finite
_FAR: Final = 10.0  # standard deviations: features are clipped to it
_NEAR: Final = 1e-12  # a smaller spread is zero
_SURE: Final = 1e-6  # least distance of a confidence from 0 and 1


def is_none(prediction: Prediction) -> bool:
    """Tell if an answer has no candidate, or its view was wholly unknown."""
    return not prediction.candidates or 1.0 <= prediction.diagnostics.get("unknown_share", 0.0) < math.inf


def lead(prediction: Prediction) -> float:
    """Return the score of the first candidate less that of the best one outside the suppression radius.

    Without one outside, less that of the last candidate: a rival that was not returned scores no better.

    Examples
    --------
    >>> from sasgeo_bench.geometry.pose import Pose
    >>> places = [Pose(easting_m=x, northing_m=0.0, yaw_deg=0.0) for x in (0.0, 10.0, 40.0)]
    >>> lead(Prediction(query_id="a", candidates=tuple(zip(places, (5.0, 4.0, 2.0)))))
    3.0
    """
    (first, best), *others = prediction.candidates
    rival = next(
        (
            score
            for pose, score in others
            if math.hypot(pose.easting_m - first.easting_m, pose.northing_m - first.northing_m) >= APART_M
        ),
        prediction.candidates[-1][1],
    )
    return _clipped(best) - _clipped(rival)


def _clipped(value: float) -> float:
    return min(max(value, -_MOST), _MOST)


def features(answers: Sequence[Prediction]) -> Rows:
    """Return features of answers, shape (N, 2 + evidence): lead, confidence, then `EVIDENCE`; NaN where missing."""
    return np.array([_row(item) for item in answers], dtype=np.float64).reshape(-1, 2 + len(EVIDENCE))


def _row(answer: Prediction) -> list[float]:
    given = [answer.diagnostics.get(item.name, math.nan) for item in EVIDENCE]
    scaled = [
        math.asinh(_clipped(value)) if item.is_wide else _clipped(value)
        for item, value in zip(EVIDENCE, given, strict=True)
    ]
    gaps = [math.nan if not math.isfinite(raw) else value for raw, value in zip(given, scaled, strict=True)]
    sure = math.nan if answer.confidence is None else min(max(answer.confidence, _SURE), 1.0 - _SURE)
    is_given = answer.confidence is not None and math.isfinite(answer.confidence)
    return [math.asinh(lead(answer)), float(special.logit(sure)) if is_given else math.nan, *gaps]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Medians, flags, means and spreads of calibration, which turn raw features into rows without gaps."""

    medians: NDArray[np.float64]
    is_flagged: NDArray[np.bool_]
    means: NDArray[np.float64]
    spreads: NDArray[np.float64]

    @classmethod
    def of(cls, raw: Rows) -> Self:
        """Fit to raw features; a feature that all answers lack is 0."""
        gap = np.isnan(raw)
        is_given = np.asarray(~gap.all(axis=0))
        medians = np.zeros(raw.shape[1])
        medians[is_given] = np.nanmedian(raw[:, is_given], axis=0)
        is_flagged = np.asarray(gap.any(axis=0) & is_given)
        rows = cls._with_flags(raw, medians, is_flagged)
        spreads = rows.std(axis=0)
        # A feature that is constant in calibration must not count later: its spread is infinite.
        spreads = np.where((spreads > _NEAR * np.maximum(1.0, np.abs(rows).max(axis=0))), spreads, np.inf)
        return cls(medians=medians, is_flagged=is_flagged, means=rows.mean(axis=0), spreads=spreads)

    def filled(self, raw: Rows) -> Rows:
        """Return standardised features and flags, shape (N, features + flags)."""
        rows = self._with_flags(raw, self.medians, self.is_flagged)
        return np.asarray(np.clip((rows - self.means) / self.spreads, -_FAR, _FAR))

    @staticmethod
    def _with_flags(raw: Rows, medians: NDArray[np.float64], is_flagged: NDArray[np.bool_]) -> Rows:
        gap = np.isnan(raw)
        return np.hstack((np.where(gap, medians, raw), gap[:, is_flagged].astype(np.float64)))
