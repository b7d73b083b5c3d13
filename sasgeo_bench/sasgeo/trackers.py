# SPDX-License-Identifier: Apache-2.0
"""The scorer over time as a tracker, and its ablations as plugins: a card for each setting of the switches."""

from typing import Final

from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.temporal import CELL_M, FRESH, LEAST, NONE, OverTime
from sasgeo_bench.sasgeo.temporal import SasgeoTrack as _Base

_OURS: Final = (
    "raster by log-likelihood ratios learnt on train places, without graph; a belief over cells and headings in place "
    f"of lists of modes, moved by the odometer and spread by its covariance; cells of {CELL_M:g} m and more; a view "
    f"weighs by {FRESH:g} of its fitted exponents times the share of its ground that is new; a cell seen with a "
    "probability has the logarithm of its expected likelihood ratio, and in such a view errors of a class hang "
    "together as for `sasgeo`"
)
_NONE: Final = f"a view fits no place with probability {NONE:g}"
_RIVAL: Final = (
    "where three views in a row fit worse than an average place around, another belief is followed beside, and takes "
    "over with 6 nats more evidence"
)
_ACCEPTS: Final = (
    f"a fix is accepted if at least {LEAST:g} of the belief lies within 25 m and no rival has more evidence; where the "
    "map is unknown a view fits as at an average place"
)
_LIMITS: Final = (
    "without train places its rates are those set by hand; so are the numbers of rivals and acceptance; no graph "
    "(Eq. 9); errors of neighbouring increments count as independent, and its covariances are too wide"
)


def _card(name: str, title: str, *ours: str, equations: str = "Eqs. 5, 7-8, 10-12") -> MatcherCard:
    return MatcherCard(
        name=name,
        version="4",
        title=title,
        source=f"SASGeo paper (Trukhina and Vashkelis), {equations}",
        ours="; ".join((_OURS, "the scale of the flight's views is learnt as it goes", *ours, _ACCEPTS)),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=_LIMITS,
    )


class SasgeoTrack(_Base):
    """The whole scorer over time."""

    card = _card("sasgeo_track", "SASGeo over time", _NONE, _RIVAL)


class SasgeoTrackAlone(_Base):
    """Without the odometer."""

    card = _card(
        "sasgeo_track_no_odometer",
        "SASGeo over time without odometry",
        "without J_T: the belief spreads by 60 m and 30 degrees between views",
        _NONE,
        _RIVAL,
        equations="Eqs. 5, 7-8, 11-12",
    )
    over_time = OverTime(has_odometry=False)


class SasgeoTrackForced(_Base):
    """Every view must fit a place."""

    card = _card("sasgeo_track_forced", "SASGeo over time, every view fits a place", _RIVAL)
    over_time = OverTime(has_none=False)


class SasgeoTrackOne(_Base):
    """Nothing beside the belief."""

    card = _card("sasgeo_track_one", "SASGeo over time with one belief", _NONE)
    over_time = OverTime(takes_rivals=False)


class SasgeoTrackEven(_Base):
    """Classes weigh the same."""

    card = _card(
        "sasgeo_track_even",
        "SASGeo over time, classes weigh the same",
        "gains of 1 for all classes (Eq. 7)",
        _NONE,
        _RIVAL,
        equations="Eqs. 7-8, 10-12",
    )
    switches = Switches(weights="even", has_graph=False, burns_vectors=False, correlates="faint")


class SasgeoTrackAgeless(_Base):
    """Every map counts as new."""

    card = _card(
        "sasgeo_track_ageless",
        "SASGeo over time without the age of the map",
        "every map is weighed as one of today is: beside `sasgeo_track` it tells stability from fitted weights",
        _NONE,
        _RIVAL,
    )
    switches = Switches(knows_age=False, has_graph=False, burns_vectors=False, correlates="faint")


class SasgeoTrackBlind(_Base):
    """Unknown counts as absent."""

    card = _card(
        "sasgeo_track_unknown_absent",
        "SASGeo over time, unknown counts as absent",
        "what is unknown in a view counts as absent",
        _NONE,
        _RIVAL,
    )
    switches = Switches(is_unknown_silent=False, has_graph=False, burns_vectors=False, correlates="faint")
