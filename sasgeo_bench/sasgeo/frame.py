# SPDX-License-Identifier: Apache-2.0
"""Answers -> rows without gaps: what `sasgeo_logistic` and `sasgeo_boosted` are fitted on."""

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

_MOST: Final = 1e100  # larger numbers are taken for this one, so that squares and differences stay finite
_FAR: Final = 10.0  # standard deviations: beyond what calibration has seen, farther is no more
_NEAR: Final = 1e-12  # a smaller spread is none
_SURE: Final = 1e-6  # a confidence is no nearer to 0 or 1


def is_none(prediction: Prediction) -> bool:
    """Whether there is no answer that could be right by more than luck: none at all, or one to a view wholly unknown.

    Examples
    --------
    >>> is_none(Prediction(query_id="a"))
    True
    """
    return not prediction.candidates or 1.0 <= prediction.diagnostics.get("unknown_share", 0.0) < math.inf


def lead(prediction: Prediction) -> float:
    """Score of the first candidate less that of the best one outside the suppression radius, in the matcher's units.

    Less that of the last one where none lies outside: a rival that is not given is no better.

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
    """What answers tell, shape (N, 2 + evidence): lead, confidence, then `EVIDENCE`; NaN where it is not told.

    Examples
    --------
    >>> features([]).shape[1] == 2 + len(EVIDENCE)
    True
    """
    return np.array([_row(item) for item in answers], dtype=np.float64).reshape(-1, 2 + len(EVIDENCE))


def _row(answer: Prediction) -> list[float]:
    told = [answer.diagnostics.get(item.name, math.nan) for item in EVIDENCE]
    scaled = [
        math.asinh(_clipped(value)) if item.is_wide else _clipped(value)
        for item, value in zip(EVIDENCE, told, strict=True)
    ]
    gaps = [math.nan if not math.isfinite(raw) else value for raw, value in zip(told, scaled, strict=True)]
    sure = math.nan if answer.confidence is None else min(max(answer.confidence, _SURE), 1.0 - _SURE)
    is_told = answer.confidence is not None and math.isfinite(answer.confidence)
    return [math.asinh(lead(answer)), float(special.logit(sure)) if is_told else math.nan, *gaps]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """How raw features become rows without gaps: medians, flags, means and spreads of calibration."""

    medians: NDArray[np.float64]
    is_flagged: NDArray[np.bool_]
    means: NDArray[np.float64]
    spreads: NDArray[np.float64]

    @classmethod
    def of(cls, raw: Rows) -> Self:
        """Learn them; a feature that no answer tells is 0 for all, and so says nothing."""
        gap = np.isnan(raw)
        is_told = np.asarray(~gap.all(axis=0))
        medians = np.zeros(raw.shape[1])
        medians[is_told] = np.nanmedian(raw[:, is_told], axis=0)
        is_flagged = np.asarray(gap.any(axis=0) & is_told)
        rows = cls._with_flags(raw, medians, is_flagged)
        spreads = rows.std(axis=0)
        # Of what never varied in calibration nothing was learnt: were it 1 here, a new value would count.
        spreads = np.where((spreads > _NEAR * np.maximum(1.0, np.abs(rows).max(axis=0))), spreads, np.inf)
        return cls(medians=medians, is_flagged=is_flagged, means=rows.mean(axis=0), spreads=spreads)

    def filled(self, raw: Rows) -> Rows:
        """Standardised features and flags, shape (N, features + flags)."""
        rows = self._with_flags(raw, self.medians, self.is_flagged)
        return np.asarray(np.clip((rows - self.means) / self.spreads, -_FAR, _FAR))

    @staticmethod
    def _with_flags(raw: Rows, medians: NDArray[np.float64], is_flagged: NDArray[np.bool_]) -> Rows:
        gap = np.isnan(raw)
        return np.hstack((np.where(gap, medians, raw), gap[:, is_flagged].astype(np.float64)))
