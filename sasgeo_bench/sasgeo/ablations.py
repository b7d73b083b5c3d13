# SPDX-License-Identifier: Apache-2.0
"""Switches of the scorer: its ablations are settings of one matcher."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.sasgeo.raster import with_unknown_margins
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weights import Gains, even_gains, likelihood_gains

Weights = Literal["even", "fitted"]
Correlated = Literal["always", "faint", "never"]
Overlaps = Literal["gated", "always", "never"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Switches:
    """Settings in which the ablations differ; defaults are those of the full scorer.

    `weights` are "even", or "fitted": log-likelihood ratios of rates, each class with a scale of its evidence. A
    matcher that does not learn has rates set by hand. `is_unknown_silent` ignores unknown cells of the view, else they
    count as absent. `has_graph` ranks modes with Eq. 9, too. `is_distinctive`, Eq. 6, gives rare configurations more
    weight. `is_stamped`, Eq. 5 for each feature, weighs features by the time since their last edit. Unless it
    `knows_age`, every map counts as new, which separates stability from fitted weights. Unless it `knows_season`, every
    view is weighed as one of no season. Unless it `learns_from_old`, training views on an older map are moved to the
    map of their own day. `burns_vectors` reads the perceived vectors as a second raster view, beside their graph or in
    place of it, so that an arm without a graph sees what one with a graph sees. `correlates` says when errors of a
    class are taken to hang together ("faint": in views with probabilities), else each cell counts alone: see
    `raster.RasterView.levelled` and `damped`. `reads_probabilities` of views that have some, else each cell is the
    likelier of present and absent.

    The last four are of certain views in which errors hang together. `searches_overlap` adds the overlap of view and
    map to the template of the search, so that its list holds places that gains alone miss. `weighs_prior`,
    `weighs_amounts` and `weighs_overlap` add the prior of heading and scale, unlike amounts of the classes, and the
    overlap to the joint score: "gated", areas count as far as lines are badly seen. See `overlap`.
    """

    weights: Weights = "fitted"
    is_unknown_silent: bool = True
    has_graph: bool = True
    is_distinctive: bool = False
    is_stamped: bool = False
    knows_age: bool = True
    knows_season: bool = True
    learns_from_old: bool = True
    burns_vectors: bool = True
    correlates: Correlated = "always"
    reads_probabilities: bool = True
    searches_overlap: bool = True
    weighs_prior: bool = True
    weighs_amounts: bool = True
    weighs_overlap: Overlaps = "gated"

    @property
    def learns(self) -> bool:
        """Return whether the scorer is fitted to training places."""
        return self.weights == "fitted"

    def is_correlated(self, evidence: Evidence) -> bool:
        """Return whether errors of a class in a view are taken to hang together."""
        return self.correlates == "always" or (self.correlates == "faint" and not evidence.is_certain)

    def read(self, evidence: Evidence) -> Evidence:
        """Return a view as this ablation reads it."""
        if not self.reads_probabilities:
            evidence = evidence.replace(evidence.cells)
        return evidence if self.is_unknown_silent else evidence.without_unknown()

    def seen(self, evidence: Evidence) -> Evidence:
        """Return a view for the gains of Eq. 7: what lies beside a seen line is open."""
        return with_unknown_margins(self.read(evidence))

    def gains(self, model: ScorerModel, *, age_years: float, season: str = "") -> Gains:
        """Return the gains of Eq. 7 for the age of a map and a season, in the order of the classes of the model."""
        if self.weights == "even":
            return even_gains(np.ones(len(model.classes)))
        age_years = age_years if self.knows_age else 0.0
        persists = model.persists(season if self.knows_season else "").tolist()
        return likelihood_gains(model.rates, age_years=age_years, persists=persists).softened(model.missed_share)
