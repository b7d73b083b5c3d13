# SPDX-License-Identifier: Apache-2.0
"""Chances of a right fix where absent places are as frequent as declared, instead of as drawn.

A rejector learns from a pool in which some share of the places is absent. Where that share differs, its chances are
wrong in a known direction: the features of an absent place look the same, but there are more of them. Reweighting the
calibration places to the declared share and fitting a line to the log-odds corrects for it.
"""

from typing import Final

import numpy as np
from scipy import special

from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.decisions import Fixes, presence_weights

_EDGE: Final = 1e-6  # least distance of a chance from 0 and 1
_WEAK: Final = 100.0  # inverse strength of the prior on the slope: it matters for a handful of answers alone


def at_share(calibration: Fixes, present_share: float, p_right: Floats) -> Floats:
    """Return chances of a right fix at a declared share of present places, shape (N,); NaN stays NaN.

    `calibration` are answers with the chances that a rejector gave them without having seen them, `p_right` its chances
    for other answers. The line through the log-odds is fitted to the calibration answers, weighted so that present
    places have the declared share; a falling line counts as flat. All NaN where the calibration lacks present or absent
    places, or right or false answers.

    Notes
    -----
    Prior shift with known class conditionals: Saerens, Latinne and Decaestecker, Neural Computation 2002. What shifts
    here is the share of absent places, and a false fix is one there or a wrong one at a present place, so the shift is
    fitted by weights instead of by their closed form; the line is that of Platt (1999).

    Half of the calibration places are absent; where one in ten is, the same evidence is more reassuring:

    >>> rng = np.random.default_rng(1)
    >>> is_present = np.arange(400) % 2 == 0
    >>> chance = special.expit(np.where(is_present, 1.5, -1.5) + rng.normal(size=400))
    >>> known = Fixes(confidence=chance, is_answered=np.ones(400), is_right=is_present, is_present=is_present)
    >>> at_share(known, 0.9, np.array([0.5])).round(1).tolist()
    [0.9]
    """
    # Slow to import, and most processes judge no rejector.
    from sklearn.linear_model import LogisticRegression  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415

    given = calibration.is_answered & ~np.isnan(calibration.confidence)
    right, present = calibration.is_right[given], calibration.is_present[given]
    if right.all() or not right.any() or present.all():
        return np.full(len(p_right), np.nan)
    mass = presence_weights(calibration.is_present, present_share)[given]
    line = LogisticRegression(C=_WEAK).fit(_log_odds(calibration.confidence[given]), right, sample_weight=mass)
    slope, shift = float(line.coef_[0, 0]), float(line.intercept_[0])
    if slope < 0:
        slope, shift = 0.0, float(special.logit(np.average(right, weights=mass)))
    found = np.full(len(p_right), np.nan)
    known = ~np.isnan(p_right)
    found[known] = special.expit(slope * _log_odds(p_right[known])[:, 0] + shift)
    return found


def _log_odds(chances: Floats) -> Floats:
    return np.asarray(special.logit(np.clip(chances, _EDGE, 1 - _EDGE)))[:, None]
