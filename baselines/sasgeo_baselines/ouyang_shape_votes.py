# SPDX-License-Identifier: Apache-2.0
"""`ouyang_shape_votes`: rings of building area, then votes of shapes, and the mixture that they make (Ouyang)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sasgeo_baselines.building_votes import Mixture, Seen, Town, headings, mixture_of
from sasgeo_baselines.place_matcher import PlaceMatcher
from sasgeo_bench import Disc, MatcherCard, Mode, Pose, Prior, Query, Region, thinned

APART_M: Final = 25.0


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """A view as it is matched, and what is known of its pose."""

    seen: Seen
    prior: Prior


@dataclass(frozen=True, slots=True, kw_only=True)
class Component(Mode):
    """A component of a mixture; its height is the score, and `credibility` is that of the whole mixture."""

    credibility: float


class OuyangShapeVotes(PlaceMatcher[PreparedView]):
    """Components of the mixture of votes of a single view."""

    open_numbers = {"windows": (25, 50, 100), "bandwidth_m": (8.0, 12.0)}  # the most alike; of the mean shift of votes
    chosen = {"windows": 50, "bandwidth_m": 8.0}

    card = MatcherCard(
        name="ouyang_shape_votes",
        version="1",
        title="Coarse-to-fine matching of building shapes, of single views",
        source="Ouyang et al., Defence Technology 34(4), 2024: its abstract, and a public account of the coarse stage",
        ours=(
            "The source's: windows of a vector map by the building area in six rings, shapes of buildings matched in "
            "them, votes for a translation, a Gaussian mixture of them, an indicator of credibility. Ours is what the "
            f"abstract does not say, as in the tracker ouyang_cfbvm_pf: {chosen['windows']:g} windows by z-scores, at "
            "places 24 m apart within the prior; eight numbers of a shape; mutual best pairs with a correlation above "
            f"0.9; mean shift of {chosen['bandwidth_m']:g} m; heights of votes x correlation. The components are the "
            "answer, the height is the score, and credibility = share of the heights that the first has x (1 - spread "
            "of the mixture / radius of the prior) is a diagnostic. Headings 8 degrees apart are tried within 2.5 "
            "standard deviations of the prior, where the source has a compass. Buildings are patches of the raster on "
            "both sides"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "The source needs a filter over a flight to find its place. Withheld where no whole building is in a view, "
            "or none votes; errors of a detector change shapes, so that a right pair seldom correlates above 0.9; "
            "houses that are alike vote for each other's places; ground unknown to the map counts as empty in the "
            "rings; headings are as coarse as they are tried, scale is 1"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Index buildings and windows."""
        del learned
        self._town = Town.of(region)
        west_m, south_m, east_m, north_m = region.grid.bounds_m
        self._reach_m = float(np.hypot(east_m - west_m, north_m - south_m) / 2)

    def look(self, query: Query) -> PreparedView | None:
        """Return the buildings of a view; None where there is no whole one."""
        seen = Seen.of(query.evidence)
        return PreparedView(seen=seen, prior=query.prior) if seen.is_judged else None

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the highest components of the mixture of the votes in a disc."""
        prior = view.prior
        # 180 degrees: standard deviation of a heading of which nothing is known
        sigma_deg = 180.0 if prior.yaw_sigma_deg is None else prior.yaw_sigma_deg
        yaws_deg, bandwidth_m = headings(prior.yaw_deg or 0.0, sigma_deg), self.numbers["bandwidth_m"]
        votes = self._town.votes(view.seen, disc, yaws_deg=yaws_deg, count=int(self.numbers["windows"]))
        votes = votes[disc.wider(bandwidth_m).holds(votes[:, :2])]
        if not len(votes):
            return []
        mixture = mixture_of(votes, bandwidth_m=bandwidth_m)
        certain = credibility(mixture, self._reach_m if disc.center_m is None else disc.radius_m)
        found = [
            Component(
                pose=Pose(easting_m=place_m[0], northing_m=place_m[1], yaw_deg=yaw_deg),
                score=height,
                credibility=certain,
            )
            for place_m, yaw_deg, height in zip(
                mixture.place_m.tolist(), mixture.yaw_deg.tolist(), mixture.height.tolist(), strict=True
            )
        ]
        return thinned(found, APART_M, count)

    def diagnostics(self, view: PreparedView, found: Sequence[Mode]) -> dict[str, float]:
        """Return the credibility of the mixture, that around the first candidate in retrieval."""
        del view
        return {"credibility": found[0].credibility} if isinstance(found[0], Component) else {}


def credibility(mixture: Mixture, radius_m: float) -> float:
    """Return the share of the first component times 1 - spread / radius, 0..1; the spread is that of all components.

    One component is as credible as it is narrow; two that are as high and far apart are not credible:

    >>> one = Mixture(place_m=np.zeros((1, 2)), yaw_deg=np.zeros(1), sigma_m=np.array([8.0]), height=np.ones(1))
    >>> places_m = np.array([[-80.0, 0.0], [80.0, 0.0]])
    >>> two = Mixture(place_m=places_m, yaw_deg=np.zeros(2), sigma_m=np.zeros(2), height=np.ones(2))
    >>> round(credibility(one, 80.0), 3), round(credibility(two, 100.0), 3)
    (0.9, 0.1)
    """
    share = mixture.height / mixture.height.sum()
    away_m2 = np.square(mixture.place_m - share @ mixture.place_m).sum(axis=1)
    spread_m = np.sqrt(share @ (away_m2 + np.square(mixture.sigma_m)))
    return float(share[0] * max(0.0, 1.0 - spread_m / radius_m))
