# SPDX-License-Identifier: Apache-2.0
"""`satloc_layers`: retrieval as the absolute layer and odometry as the relative one, each by how sure it is."""

import numpy as np

import sasgeo_bench as sgb
from sasgeo_baselines.polar_vsc import PolarVsc
from sasgeo_baselines.trackers.ekf_loose import EkfLoose, EkfPlan
from sasgeo_baselines.trackers.window import Floats


class SatlocLayers(EkfLoose):
    """The loosely coupled filter on fixes of retrieval, whose covariance is divided by their confidence."""

    card = sgb.MatcherCard(
        name="satloc_layers",
        version="1",
        title="Layers of absolute and relative fixes, weighed by confidence",
        source=(
            "SatLoc-Fusion (2025), by accounts of others: absolute fixes by retrieval, relative ones by features, "
            "velocity by optical flow, each layer's covariance scaled by its confidence, in one filter"
        ),
        ours=(
            "The absolute layer is `polar_vsc`, since a view has classes and no pixels; its confidence is the share of "
            "rings that pass the test there, 0.1 at least. Relative layer and velocity are the odometer's increments, "
            "whose confidence is the covariance that it tells. The filter is `ekf_loose`"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "One hypothesis at a time; a pose of retrieval is no finer than 4 m; blind beyond 96 m from the middle of "
            "a view; nothing is learned, and nothing known of the map's age"
        ),
    )

    def __init__(self, matcher: sgb.Matcher | None = None, plan: EkfPlan | None = None) -> None:
        super().__init__(matcher or PolarVsc(), plan)

    def covariance_of(self, found: sgb.Match, query: sgb.Query) -> Floats:
        """Return the covariance of fixes as innovations have it, divided by the confidence of this one."""
        # 0.1 of it: below, a fix would count for nothing
        sure = max(0.1, min(1.0, found.diagnostics.get("ks_share", 1.0)))  # diagnostic of the absolute layer, 0..1
        return np.asarray(super().covariance_of(found, query) / sure)
