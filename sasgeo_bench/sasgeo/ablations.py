# SPDX-License-Identifier: Apache-2.0
"""The switches of the scorer: its ablations are settings of one matcher, not copies of it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sasgeo_bench.regions.evidence import ABSENT, UNKNOWN, Evidence
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.raster import doubted
from sasgeo_bench.sasgeo.seasons import by_hand
from sasgeo_bench.sasgeo.weights import Gains, even_gains, hand_gains, likelihood_gains

Weights = Literal["even", "hand", "fitted"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Switches:
    """What an arm of the experiment differs in; the full scorer has all of them.

    Parameters
    ----------
    weights : {"even", "hand", "fitted"}
        All classes alike; Eqs. 5 and 7 with the taxonomy's numbers; likelihood ratios of learnt rates, each class with
        a learnt exponent.
    is_unknown_silent : bool
        What is unknown in the view says nothing; else it is taken for absent.
    has_graph : bool
        Eq. 9 has a say in the order of the modes.
    is_distinctive : bool
        Eq. 6: what is rare on the map weighs more.
    is_stamped : bool
        Eq. 5 feature by feature: what nobody has edited for years is worth what it was learnt to be worth.
    knows_age : bool
        Else every map is taken for one of today: what of fitted weights is not stability.

    Examples
    --------
    >>> Switches(weights="even").learns
    False
    """

    weights: Weights = "fitted"
    is_unknown_silent: bool = True
    has_graph: bool = True
    is_distinctive: bool = False
    is_stamped: bool = False
    knows_age: bool = True

    @property
    def learns(self) -> bool:
        """Whether train places change anything."""
        return self.weights == "fitted"

    def seen(self, evidence: Evidence) -> Evidence:
        """Read a view as this arm does."""
        if not self.is_unknown_silent:
            cells = np.where(evidence.cells == UNKNOWN, ABSENT, evidence.cells).astype(np.uint8)
            evidence = Evidence(classes=evidence.classes, cells=cells, cell_size_m=evidence.cell_size_m)
        return doubted(evidence)

    def gains(self, learnt: Learnt, *, age_years: float, season: str = "") -> Gains:
        """Gains of Eq. 7 for a map of an age and a season, for classes in the order of what was learnt."""
        if self.weights == "even":
            return even_gains(learnt.classes)
        age_years = age_years if self.knows_age else 0.0
        if self.weights == "hand":
            return hand_gains(learnt.classes, age_years=age_years, persists=by_hand(season, learnt.classes).tolist())
        persists = learnt.persists(season).tolist()
        return likelihood_gains(learnt.rates, age_years=age_years, persists=persists).softened(learnt.missed_share)
