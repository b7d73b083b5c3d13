# SPDX-License-Identifier: Apache-2.0
"""Ablations of the scorer as plugins: a card for each setting of the switches."""

from typing import Final

from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.matchers import LearningMatcher, SasgeoMatcher

_SOURCE: Final = "SASGeo paper (Trukhina and Vashkelis), {what}"
_OURS: Final = (
    "dense search over place, heading and scale in the Fourier domain, coarse to fine, 20 modes; what lies within 8 m "
    "of a seen line is left open; a posterior over the modes and none of them"
)
_EVEN: Final = "gains of 1 for all classes (Eq. 7), distance made a degree by exp(-D^2 / 2 tau^2), tau 4 m, for lines"
_GRAPH: Final = (
    "correspondences by assignment within a gate and relations of matched nodes (Eq. 9), on the list of modes that the "
    "raster found; nodes of perceived vectors, or of the thinned mask where there are none; likelihood ratios set by "
    "hand, weights of raster, graph and contradiction (Eq. 11) {how}"
)
_FITTED: Final = (
    "log-likelihood ratios from rates of vanishing, appearing, seeing and mapping by class, how much being near a "
    "class is like being on it, and an exponent for each class by conditional logit; all learnt on train places"
)
_GRAPH_BY_HAND: Final = _GRAPH.format(how="set by hand")
_GRAPH_FITTED: Final = _GRAPH.format(how="learnt")
_BLIND: Final = "what is unknown counts as absent, as in all variants of the paper but its last"
_SILENT: Final = "what is unknown says nothing"
_LIMITS: Final = (
    "headings and scales beyond 2.5 standard deviations are not searched; places are 2 m apart before they are "
    "refined; where the heading is known the graph finds no place that the raster has not found"
)
_UNTAUGHT: Final = f"without train places its rates are those set by hand; {_LIMITS}"


def _card(name: str, title: str, what: str, *ours: str, limits: str = _LIMITS) -> MatcherCard:
    return MatcherCard(
        name=name,
        version="1",
        title=title,
        source=_SOURCE.format(what=what),
        ours="; ".join((_OURS, *ours)),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=limits,
    )


class SasgeoRaster(SasgeoMatcher):
    """Raster alone, uniform weights."""

    card = _card("sasgeo_raster", "SASGeo: raster, uniform weights", "Eqs. 7-8", _EVEN, _BLIND)
    switches = Switches(weights="even", is_unknown_silent=False, has_graph=False)


class SasgeoGraph(SasgeoMatcher):
    """Raster and graph."""

    card = _card("sasgeo_graph", "SASGeo: raster and graph", "Eqs. 7-9, 11", _EVEN, _GRAPH_BY_HAND, _BLIND)
    switches = Switches(weights="even", is_unknown_silent=False)


class SasgeoStability(LearningMatcher):
    """Raster and graph, classes weighed by stability."""

    card = _card(
        "sasgeo_stability",
        "SASGeo: raster, graph and stability",
        "Eqs. 5, 7-9, 11",
        _FITTED,
        _GRAPH_FITTED,
        _BLIND,
        limits=_UNTAUGHT,
    )
    switches = Switches(is_unknown_silent=False)


class Sasgeo(LearningMatcher):
    """The whole scorer."""

    card = _card("sasgeo", "SASGeo, whole", "Eqs. 5, 7-9, 11-14", _FITTED, _GRAPH_FITTED, _SILENT, limits=_UNTAUGHT)
    switches = Switches()


class SasgeoHand(SasgeoMatcher):
    """The whole scorer with weights by hand."""

    card = _card(
        "sasgeo_hand",
        "SASGeo with the paper's weights by hand",
        "Eqs. 5, 7-9, 11-14",
        "prior, decay and lambdas of Eqs. 5 and 7 from the taxonomy",
        _GRAPH_BY_HAND,
        _SILENT,
    )
    switches = Switches(weights="hand")


class SasgeoDistinct(LearningMatcher):
    """The whole scorer with Eq. 6."""

    card = _card(
        "sasgeo_distinct",
        "SASGeo with distinctiveness",
        "Eqs. 5-9, 11-14",
        _FITTED,
        "cells weigh by -log of the share of the map's configurations that are of their kind (Eq. 6)",
        _GRAPH_FITTED,
        _SILENT,
        limits=_UNTAUGHT,
    )
    switches = Switches(is_distinctive=True)


class SasgeoAgeless(LearningMatcher):
    """The whole scorer without the age of the map."""

    card = _card(
        "sasgeo_ageless",
        "SASGeo without the age of the map",
        "Eqs. 5, 7-9, 11-14",
        _FITTED,
        "every map is weighed as one of today is: beside `sasgeo` it tells stability from fitted weights",
        _GRAPH_FITTED,
        _SILENT,
        limits=_UNTAUGHT,
    )
    switches = Switches(knows_age=False)


class SasgeoStamped(LearningMatcher):
    """The whole scorer with edit ages of features."""

    card = _card(
        "sasgeo_stamped",
        "SASGeo with OSM timestamps",
        "Eqs. 5, 7-9, 11-14",
        _FITTED,
        "features weigh by how long nobody had edited them when the map was taken, learnt by class in four strata",
        _GRAPH_FITTED,
        _SILENT,
        limits=_UNTAUGHT,
    )
    switches = Switches(is_stamped=True)


class OracleSasgeo(LearningMatcher):
    """The whole scorer, trained on the places that it is asked: an upper bound for training."""

    card = _card(
        "oracle_sasgeo",
        "SASGeo that learns from the places it is asked on",
        "Eqs. 5, 7-9, 11-14",
        _FITTED,
        _GRAPH_FITTED,
        _SILENT,
        "a yardstick, never ranked: a pipeline names it among its oracles",
        limits=f"Knows what no matcher can know; {_LIMITS}",
    )
    switches = Switches()


class SasgeoNoGraph(LearningMatcher):
    """The whole scorer without graph."""

    card = _card("sasgeo_no_graph", "SASGeo without graph", "Eqs. 5, 7-8, 12-14", _FITTED, _SILENT, limits=_UNTAUGHT)
    switches = Switches(has_graph=False)
