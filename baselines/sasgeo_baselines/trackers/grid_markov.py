# SPDX-License-Identifier: Apache-2.0
"""`grid_markov`: a histogram filter over place and heading; `grid_markov_still`, the same without diffusion."""

from dataclasses import replace
from typing import Final

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.grid_filter import LEAST, Floats, GridFilter

# Of `python benchmarks/fit_grid_trackers.py`, on made-up towns that are in no split: of the settings with the most
# views within 25 m (0.799 to 0.801, a view or two apart) that with the most belief near the truth.
TEMPER: Final = 0.024
DOUBT: Final = 1e-2

SOURCE: Final = (
    "OrienterNet (Sarlin et al., CVPR 2023), its belief over several views: the last belief is looked up at the pose "
    "without the increment (linear, headings on a circle), the log-likelihood of the view is added, the sum normalised"
)
OURS: Final = (
    "The likelihood: log-likelihood ratios of classes and cells by rates set by hand in place of a learned one, of "
    f"any map as if it were of the day of the view, times a temper of {TEMPER:g}, fitted to made-up towns, since "
    f"neighbouring cells agree and views share ground; a share of {DOUBT:g} of views that say nothing; a window that "
    "follows the belief, with cells of 4 to 32 m and 72 or 36 headings; 1 km and 90 degrees where the odometer lost "
    "its way; the estimate is the mean of what lies within 25 m of the place with the most mass, accepted if that "
    f"mass is at least {LEAST:g}"
)
LIMITS: Final = (
    "Scale 1 alone; errors of neighbouring increments count as independent; nothing finds a drone again that was "
    "carried where the belief does not reach; rates are not fitted, so it is weaker than a learned likelihood where "
    "detector or map differ from them"
)
TRAINED_ON: Final = ("four made-up towns that are in no split (benchmarks/fit_grid_trackers.py)",)


class GridMarkov(GridFilter):
    """OrienterNet's belief over several views, with diffusion by the covariance of the increments."""

    card = sgb.MatcherCard(
        name="grid_markov",
        version="3",
        title="Histogram filter over place and heading",
        source=SOURCE,
        ours=f"Diffusion by the covariance of each increment, which the released code leaves out. {OURS}",
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=LIMITS,
        trained_on=TRAINED_ON,
    )
    exponent_scale = TEMPER
    outlier_probability = DOUBT

    def read(self, region: sgb.Region, learned: str | None) -> sgb.Grid:
        """Read a map by hand-set rates."""
        del learned
        # 4 m: cell of the map, and the finest of the belief
        self._field = sgb.prepare_levels(sgb.map_by_hand(region, cell_size_m=4.0))
        self._classes = region.classes
        return self._field.grid

    def logs(self, query: sgb.Query, belief: sgb.GridBelief) -> Floats:
        """Return tempered sums of log-likelihood ratios over classes and cells.

        OrienterNet knows neither the date of a map nor the season, so both are those of the view.
        """
        template = sgb.view_by_hand(replace(query, season=""), self._classes, map_date=query.observed_on)
        return sgb.surface_logs(self._field, template, belief, exponent_scale=self.exponent_scale)


class GridMarkovStill(GridMarkov):
    """The same without diffusion, as in OrienterNet's released code."""

    card = sgb.MatcherCard(
        name="grid_markov_still",
        version="3",
        title="Histogram filter over place and heading, without diffusion",
        source=f"{SOURCE}; without diffusion, as its released code",
        ours=OURS,
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=f"Trusts every increment but for what interpolation blurs. {LIMITS}",
        trained_on=TRAINED_ON,
    )
    diffuses = False
