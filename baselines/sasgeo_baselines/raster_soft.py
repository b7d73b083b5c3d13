# SPDX-License-Identifier: Apache-2.0
"""`raster_soft`: covariance of a segmenter's probabilities with the map, at every pose; no threshold, no labels."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.raster import REACH_M, THIN
from sasgeo_bench import Chart, DenseMatcher, Evidence, MatcherCard, Region, VotePlan

# A place of which the map knows half would be judged by half of the view, whose covariance varies more.
LEAST_OVERLAP: Final = 0.9


def soft_template(chances: NDArray[np.float64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors of a map whose mean over a view is the covariance of view and map, summed over classes.

    Parameters
    ----------
    chances : ndarray of float64, shape (C, rows, cols)
        P(present), NaN where unknown.
    shares : ndarray of float64, shape (C,)
        Mean of each layer of the map.

    Returns
    -------
    ndarray of float64, shape (C + 2, rows, cols)
        As `make_template` returns it: factors of the layers, of known map cells, and the number of known classes. With
        p the probability, p0 its mean over the view, m the map and m0 its share, cells sum to (p - p0) (m - m0) where
        both are known, and to 0 elsewhere.

    Notes
    -----
    Only p - p0 counts, so a segmenter that sees twice too much everywhere, or half of it, orders the poses alike. With
    calibrated p this is, class by class and but for a factor, the log-likelihood ratio of Eq. (7) of the SASGeo paper
    to first order in p - p0.

    Examples
    --------
    Adding 0.2 to all probabilities changes nothing:

    >>> faint = np.array([[[0.1, 0.3]]])
    >>> half = np.array([0.5])
    >>> [soft_template(some, half)[0].round(3).tolist() for some in (faint, faint + 0.2)]
    [[[-0.1, 0.1]], [[-0.1, 0.1]]]
    """
    is_known = np.isfinite(chances)
    counts = np.maximum(is_known.sum(axis=(1, 2)), 1)
    filled = np.where(is_known, chances, 0.0)
    means = filled.sum(axis=(1, 2)) / counts
    centred = np.where(is_known, chances - means[:, None, None], 0.0)
    against = -(shares[:, None, None] * centred).sum(axis=0)
    return np.concatenate([centred, [against], [is_known.sum(axis=0)]])


class RasterSoft(DenseMatcher):
    """Covariance of probabilities and map, layer by layer."""

    card = MatcherCard(
        name="raster_soft",
        version="2",
        title="Covariance of probabilities and map",
        source="Zero-mean correlation of templates; Eqs. 7-8 of the SASGeo paper (Trukhina and Vashkelis), first order",
        ours=(
            "The mean of the view is taken off each class's probabilities, the share of the map off its layers; lines "
            "fade by exp(-D^2 / 2 tau^2), tau 4 m, on the map; the sum over classes and cells is divided by the cells "
            "known on both sides, which must be 0.9 of the view"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "How common a class is in the view says nothing, a view that one class fills has none of it; no graph, no "
            "ages, nothing learned; headings beyond 2.5 and scales beyond two standard deviations are not searched; "
            "candidates that share a place within 24 m cannot be told apart; no confidence"
        ),
    )

    def __init__(self, plan: VotePlan | None = None) -> None:
        super().__init__(plan or VotePlan(least_overlap=LEAST_OVERLAP))
        self._shares: dict[str, float] = {}

    def read(self, region: Region) -> Chart:
        """Return the map with the proximity of its lines; note the share of each layer."""
        chart = Chart.of(region, thin=THIN, reach_m=REACH_M)
        self._shares = dict(zip(chart.classes, chart.shares().tolist(), strict=True))
        return chart

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return the template of the view's probabilities."""
        return soft_template(evidence.probabilities(), np.array([self._shares[name] for name in evidence.classes]))
