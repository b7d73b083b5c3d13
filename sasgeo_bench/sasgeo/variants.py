# SPDX-License-Identifier: Apache-2.0
"""The SASGeo scorer as a matcher, and its ablations as plugins: a card for each setting of the switches."""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard, Training
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.conformal import levels_of
from sasgeo_bench.sasgeo.graph import GraphScore
from sasgeo_bench.sasgeo.integrity import Modes, evidence_of
from sasgeo_bench.sasgeo.learning import learn
from sasgeo_bench.sasgeo.overlap import INDEPENDENT
from sasgeo_bench.sasgeo.raster import (
    CELL_M,
    RasterView,
    likeness_by_hand,
    read_field,
    with_unknown_margins,
)
from sasgeo_bench.sasgeo.rates import hand_rates
from sasgeo_bench.sasgeo.reading import Reader, Reading
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weights import by_hand, likelihood_gains
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.search.find import rank, search
from sasgeo_bench.search.plan import Mode, Null, Plan
from sasgeo_bench.tasks.query import Query

_DAYS_PER_YEAR: Final = 365.25


def map_by_hand(region: Region, *, cell_size_m: float = CELL_M) -> Field:
    """Return a map for the search: areas as they are, lines fading by exp(-D^2 / 2 tau^2) with tau 4 m.

    Cells have a whole number of map cells a side, of about `cell_size_m`.

    Examples
    --------
    >>> import tempfile
    >>> import sasgeo_bench as sgb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     town = sgb.tiny_place(folder).region
    >>> map_by_hand(town, cell_size_m=4.0).grid.shape
    (256, 256)
    """
    return read_field(region, likeness_by_hand(region.classes), cell_size_m=cell_size_m)


def view_by_hand(query: Query, classes: Sequence[str], *, map_date: dt.date) -> Template:
    """Return the template of a view in the classes of a map, by rates of seeing, mapping and ageing set by hand.

    A score is a sum over classes and cells of log-likelihood ratios of the view with and without the map, in nats, each
    times the area of its cell in m2. Cells are far from independent, so scores need a factor (a temper) to be
    likelihoods of the whole view, and a bound on what a view says if a filter shall survive its errors. Unknown cells
    count 0, and so do cells near a seen line that are seen without it: a line mapped there may be the same.

    Parameters
    ----------
    query : Query
        The view, its date and its season.
    classes : sequence of str
        Classes of the map, as in `Region.classes`; those that the view lacks count 0.
    map_date : datetime.date
        Date of the map: `region.manifest.extract.date`. The older it is, the less it says.

    Examples
    --------
    >>> import tempfile
    >>> import sasgeo_bench as sgb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = sgb.tiny_place(folder)
    >>> town, query, truth = place.region, place.queries[0], place.truths[0]
    >>> field = map_by_hand(town)
    >>> view = view_by_hand(query, town.classes, map_date=town.manifest.extract.date)
    >>> away = sgb.Pose(easting_m=truth.pose.easting_m + 60.0, northing_m=truth.pose.northing_m, yaw_deg=90.0)
    >>> sgb.score_at(field, view, truth.pose) > sgb.score_at(field, view, away)
    True
    """
    age_years = max(0.0, (query.observed_on - map_date).days / _DAYS_PER_YEAR)
    rates = [hand_rates(name) for name in classes]
    gains = likelihood_gains(rates, age_years=age_years, persists=by_hand(query.season, classes).tolist())
    view = RasterView.of(with_unknown_margins(query.evidence), classes, gains)
    return view.times(np.float32(query.evidence.cell_size_m**2)).template()


LISTED: Final = 20  # modes of one search, or candidates, that are ranked by the joint score


@dataclass(frozen=True, kw_only=True)
class _Ranked:
    """Modes by the joint score: `order`, best first, terms of Eq. 11, and graph scores of each mode."""

    order: NDArray[np.int64]
    terms: NDArray[np.float64]
    verified: Sequence[GraphScore] | None


class SasgeoMatcher:
    """The scorer with the parts that `switches` select; `plan` sets the search."""

    card: MatcherCard
    switches: ClassVar[Switches] = Switches()

    def __init__(self, plan: Plan | None = None) -> None:
        self.plan = plan or Plan()
        self._reader: Reader | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read a map with a trained model, or the one set by hand."""
        model = ScorerModel.from_text(learned) if learned else ScorerModel.by_hand(region.classes)
        self._reader = Reader.of(region, model, self.switches)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the best modes, or rank the candidates by the best pose near each."""
        if self._reader is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if bool((query.evidence.cells == UNKNOWN).all()):
            return WITHHELD
        reading = self._reader.read(query)
        if query.track == "retrieval":
            return _of_candidates(reading, self.plan, top_k=top_k)
        starts = reading.proposed()
        found = search(
            self._reader.field, reading.searched, query.prior, reading.plan(self.plan), count=LISTED, starts=starts
        )
        if not found.modes:
            return WITHHELD
        ranked = _ranked(reading, found.modes)
        poses = [found.modes[at].pose for at in ranked.order]
        return _answer(reading, poses, ranked, null=found.null, top_k=top_k)


class LearningMatcher(SasgeoMatcher):
    """The scorer with what it learns from train places."""

    def learn(self, training: Training) -> str:
        """Fit the model to views of known place."""
        return learn(training, self.switches, plan=self.plan).to_text()


def _ranked(reading: Reading, modes: Sequence[Mode]) -> _Ranked:
    """Rank modes by Eq. 11; ties keep their order."""
    poses = [mode.pose for mode in modes]
    verified = reading.verified(poses)
    terms = reading.terms(poses, verified)
    order = np.argsort(-terms.sum(axis=1), kind="stable")
    return _Ranked(order=order, terms=terms, verified=verified)


def _answer(
    reading: Reading, poses: Sequence[Pose], ranked: _Ranked, *, null: Null, top_k: int, rest: Sequence[Pose] = ()
) -> Match:
    """Return an answer with poses in the order of `ranked` and, below them, the rest."""
    terms = ranked.terms[ranked.order]
    scores = terms.sum(axis=1)
    places_m = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
    modes = Modes(
        positions_m=places_m,
        by_class=terms,
        sigma_m=reading.sigma_m(poses[0]),
        none_nats=float(np.log(max(null.places, 1))),
    )
    best = None if ranked.verified is None else ranked.verified[int(ranked.order[0])]
    diagnostics = evidence_of(
        modes,
        null=null,
        unknown_share=reading.query.evidence.unknown_share,
        information_nats=reading.information_nats,
        map_age_years=reading.age_years,
        graph_consistency=None if best is None else best.consistency,
    )
    diagnostics |= levels_of(modes)
    given = [*poses, *rest][:top_k]
    low = float(scores[-1]) - 1.0
    values = [*scores.tolist(), *(low - at for at in range(len(rest)))][:top_k]
    return Match(poses=given, scores=values, confidence=float(modes.masses[0]), diagnostics=diagnostics)


def _of_candidates(reading: Reading, plan: Plan, *, top_k: int) -> Match:
    """Rank the candidates of a query; drop those off the map."""
    query = reading.query
    found, null = rank(reading.reader.field, reading.searched, query.prior, query.candidates, reading.plan(plan))
    scored = sorted(((at, mode) for at, mode in enumerate(found) if mode is not None), key=lambda item: -item[1].score)
    if not scored:
        return WITHHELD
    looked, rest = scored[:LISTED], scored[LISTED:]
    ranked = _ranked(reading, [mode for _, mode in looked])
    poses = [_at_candidate(query, *looked[at]) for at in ranked.order]
    return _answer(reading, poses, ranked, null=null, top_k=top_k, rest=[_at_candidate(query, *item) for item in rest])


def _at_candidate(query: Query, at: int, mode: Mode) -> Pose:
    return replace(query.candidates[at], yaw_deg=mode.pose.yaw_deg, scale=mode.pose.scale)


_OURS: Final = (
    "dense search over place, heading and scale in the Fourier domain, coarse to fine, 20 modes; what lies within 8 m "
    "of a seen line is left open; a posterior over the modes and none of them"
)
_EVEN: Final = "gains of 1 for all classes (Eq. 7), distance made a degree by exp(-D^2 / 2 tau^2), tau 4 m, for lines"
_GRAPH: Final = (
    "of views with perceived vectors: correspondences by assignment within a gate and relations of matched nodes (Eq. "
    "9), on the list of modes that the raster found, with tolerances set by hand; likelihood ratios of nodes, and "
    "weights of raster, graph and contradiction (Eq. 11), {how}"
)
_FITTED: Final = (
    "log-likelihood ratios from rates of vanishing, appearing, seeing and mapping by class, how much being near a "
    "class is like being on it, and an exponent for each class by conditional logit; all learnt on train places"
)
_CORRELATED: Final = (
    "errors of a class hang together: each class less its mean over some 24 m of known cells, so that where it lies "
    "counts, and bounded, so that much of it says little more than some"
)
_GRAPH_BY_HAND: Final = _GRAPH.format(how="set by hand")
_GRAPH_FITTED: Final = _GRAPH.format(
    how="learnt from train places, from views with vectors: the rules of nodes by their plain statistics at true and "
    "wrong poses; without such views those set by hand hold"
)
_FRESH: Final = (
    "training views on older maps are moved to the map of their own day, and dropped where there is none: with "
    "`sasgeo` and `sasgeo_ageless` it crosses having learnt from old maps with knowing the age"
)
_BLIND: Final = "what is unknown counts as absent, as in all variants of the paper but its last"
_SILENT: Final = "what is unknown says nothing"
_LIMITS: Final = (
    "headings and scales beyond 2.5 standard deviations are not searched; places are 2 m apart before they are "
    "refined; where the heading is known the graph finds no place that the raster has not found"
)
_BURNT: Final = (
    "perceived vectors burnt as a second view, lines in the median width of their class; where layers and vectors both "
    "show a class, each counts half"
)
_NOT_BURNT: Final = "of perceived vectors the graph alone is read, as in version 6 of `sasgeo`"
_RIVAL: Final = "the rival of the graph with the same sensor"
_BURNT_LIMITS: Final = "of vectors it reads where they lie, not how they connect or pass over each other"
_SOFT: Final = (
    "a cell seen with a probability has the logarithm of its expected likelihood ratio, so that a certain one counts "
    "as in Eq. 7"
)
_RANKED: Final = (
    "modes of a view with probabilities are ranked, besides, by how well the map explains each class (its correlation, "
    f"as that of {INDEPENDENT:g} independent cells) and by the prior of heading and scale"
)
_GAINS: Final = "a view that is certain is searched for and ranked by Eqs. 7-11 alone, as in version 5 of `sasgeo`"
_SEARCH: Final = (
    "a view that is certain is searched for by its gains and by its overlap with the map, intersection over union of "
    "each class to first order"
)
_POSE_PRIOR: Final = "the prior of heading and scale"
_AMOUNTS: Final = "how unlike the amounts of the classes are"
_OVERLAP: Final = "the overlap of view and map, that of areas as far as no mode overlaps the lines of the view"
_UNTAUGHT: Final = f"without train places its rates are those set by hand; {_LIMITS}"


_TERMS: Final = (_SEARCH, f"its modes are ranked, besides, by {_POSE_PRIOR}; by {_AMOUNTS}; by {_OVERLAP}")


def _card(
    name: str,
    title: str,
    what: str,
    *ours: str,
    limits: str = _LIMITS,
    reads: str = _SOFT,
    terms: Sequence[str] = _TERMS,
) -> MatcherCard:
    has_graph = bool({_GRAPH_FITTED, _GRAPH_BY_HAND}.intersection(ours))
    has_both = has_graph and _BURNT in ours
    is_soft, is_correlated = reads == _SOFT, _CORRELATED in ours
    ranked = (_RANKED,) if is_soft and is_correlated else ()
    beside = tuple(terms) if is_correlated else ()
    return MatcherCard(
        name=name,
        version=str(
            1 + is_soft + is_correlated + has_graph + len(ranked) + (terms is _TERMS and is_correlated) + has_both
        ),
        title=title,
        source=f"SASGeo paper (Trukhina and Vashkelis), {what}",
        ours="; ".join((_OURS, reads, *ranked, *beside, *ours)),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=limits,
    )


def _whole(
    name: str,
    title: str,
    *ours: str,
    limits: str = _UNTAUGHT,
    reads: str = _SOFT,
    terms: Sequence[str] = _TERMS,
    vectors: Sequence[str] = (_GRAPH_FITTED, _BURNT),
) -> MatcherCard:
    """Return the card of the whole scorer, taught, with something changed."""
    told = (_FITTED, _CORRELATED, *ours, *vectors, _SILENT)
    return _card(name, title, "Eqs. 5, 7-9, 11-14", *told, limits=limits, reads=reads, terms=terms)


class SasgeoRaster(SasgeoMatcher):
    """Raster alone, uniform weights."""

    card = _card("sasgeo_raster", "SASGeo: raster, uniform weights", "Eqs. 7-8", _EVEN, _CORRELATED, _BLIND)
    switches = Switches(weights="even", is_unknown_silent=False, has_graph=False, burns_vectors=False)


class SasgeoRasterVectors(SasgeoMatcher):
    """Raster alone, uniform weights, that sees the perceived vectors too."""

    card = _card(
        "sasgeo_raster_vectors",
        "SASGeo: raster, with perceived vectors burnt in",
        "Eqs. 7-8",
        _EVEN,
        _CORRELATED,
        _BURNT,
        _RIVAL,
        _BLIND,
        limits=f"{_BURNT_LIMITS}; {_LIMITS}",
    )
    switches = Switches(weights="even", is_unknown_silent=False, has_graph=False)


class SasgeoGraph(LearningMatcher):
    """Raster and graph; it learns the rules of the graph and the weights of Eq. 11, its raster stays uniform."""

    card = _card(
        "sasgeo_graph",
        "SASGeo: raster and graph",
        "Eqs. 7-9, 11",
        _EVEN,
        _CORRELATED,
        _GRAPH_FITTED,
        _BURNT,
        _BLIND,
        limits=f"without train places rules and weights of the graph are those set by hand; {_LIMITS}",
    )
    switches = Switches(weights="even", is_unknown_silent=False)


class SasgeoStability(LearningMatcher):
    """Raster and graph, classes weighed by stability."""

    card = _card(
        "sasgeo_stability",
        "SASGeo: raster, graph and stability",
        "Eqs. 5, 7-9, 11",
        _FITTED,
        _CORRELATED,
        _GRAPH_FITTED,
        _BURNT,
        _BLIND,
        limits=_UNTAUGHT,
    )
    switches = Switches(is_unknown_silent=False)


class Sasgeo(LearningMatcher):
    """The whole scorer."""

    card = _whole("sasgeo", "SASGeo, whole")
    switches = Switches()


class SasgeoEven(LearningMatcher):
    """The whole scorer for which all classes weigh the same."""

    card = _card(
        "sasgeo_even",
        "SASGeo, all classes weigh the same",
        "Eqs. 7-9, 11-14",
        _EVEN,
        _CORRELATED,
        _GRAPH_FITTED,
        _BURNT,
        _SILENT,
        limits=f"without train places rules and weights of the graph are those set by hand; {_LIMITS}",
    )
    switches = Switches(weights="even")


class SasgeoPrior(SasgeoMatcher):
    """The whole scorer, untaught: what is believed of classes before any view."""

    card = _card(
        "sasgeo_prior",
        "SASGeo, untaught",
        "Eqs. 5, 7-9, 11-14",
        "log-likelihood ratios from rates of vanishing, appearing and mapping in the taxonomy, in place of sigma of "
        "Eq. 5, and of a detector that is mostly right; one cell in a hundred counts",
        _CORRELATED,
        _GRAPH_BY_HAND,
        _BURNT,
        _SILENT,
    )
    switches = Switches()


class SasgeoDistinct(LearningMatcher):
    """The whole scorer with Eq. 6."""

    card = _card(
        "sasgeo_distinct",
        "SASGeo with distinctiveness",
        "Eqs. 5-9, 11-14",
        _FITTED,
        _CORRELATED,
        "cells weigh by -log of the share of the map's configurations that are of their kind (Eq. 6)",
        _GRAPH_FITTED,
        _BURNT,
        _SILENT,
        limits=_UNTAUGHT,
    )
    switches = Switches(is_distinctive=True)


class SasgeoAgeless(LearningMatcher):
    """The whole scorer without the age of the map."""

    card = _whole(
        "sasgeo_ageless",
        "SASGeo without the age of the map",
        "every map is weighed as one of today is: beside `sasgeo` it tells stability from fitted weights; its "
        "exponents are learnt on old maps too",
    )
    switches = Switches(knows_age=False)


class SasgeoSeasonless(LearningMatcher):
    """The whole scorer for which all seasons are alike."""

    card = _whole(
        "sasgeo_seasonless",
        "SASGeo without the season",
        "a view of winter is weighed as one of no known season is: d_season of Eq. 5 is 1",
    )
    switches = Switches(knows_season=False)


class SasgeoFresh(LearningMatcher):
    """The whole scorer, trained on maps of the day only."""

    card = _whole(
        "sasgeo_fresh",
        "SASGeo trained without old maps",
        _FRESH,
        limits=f"its rates of vanishing and appearing are those set by hand, which no map of the day can teach; "
        f"{_UNTAUGHT}",
    )
    switches = Switches(learns_from_old=False)


class SasgeoFreshAgeless(LearningMatcher):
    """The whole scorer, trained on maps of the day only, without the age of the map."""

    card = _whole(
        "sasgeo_fresh_ageless",
        "SASGeo trained without old maps, without the age of the map",
        _FRESH,
        "every map is weighed as one of today is",
        limits=f"knows nothing of ageing; {_UNTAUGHT}",
    )
    switches = Switches(learns_from_old=False, knows_age=False)


class SasgeoStamped(LearningMatcher):
    """The whole scorer with edit ages of features."""

    card = _whole(
        "sasgeo_stamped",
        "SASGeo with OSM timestamps",
        "features weigh by how long nobody had edited them when the map was taken, learnt by class in four strata",
    )
    switches = Switches(is_stamped=True)


class OracleSasgeo(LearningMatcher):
    """The whole scorer, trained on the places that it is asked: an upper bound for training."""

    card = _whole(
        "oracle_sasgeo",
        "SASGeo that learns from the places it is asked on",
        "a yardstick, never ranked: a pipeline names it among its oracles",
        limits=f"Knows what no matcher can know; {_LIMITS}",
    )
    switches = Switches()


class SasgeoNoGraph(LearningMatcher):
    """The whole scorer without graph, that sees the perceived vectors as cells."""

    card = _card(
        "sasgeo_no_graph",
        "SASGeo without graph",
        "Eqs. 5, 7-8, 12-14",
        _FITTED,
        _CORRELATED,
        _BURNT,
        _RIVAL,
        _SILENT,
        limits=f"{_BURNT_LIMITS}; {_UNTAUGHT}",
    )
    switches = Switches(has_graph=False)


class SasgeoGraphAlone(LearningMatcher):
    """The whole scorer that reads perceived vectors as a graph alone."""

    card = _whole("sasgeo_graph_alone", "SASGeo, vectors as a graph alone", vectors=(_GRAPH_FITTED, _NOT_BURNT))
    switches = Switches(burns_vectors=False)


class SasgeoIndependent(LearningMatcher):
    """The whole scorer for which each cell counts alone."""

    card = _card(
        "sasgeo_independent",
        "SASGeo with independent cells",
        "Eqs. 5, 7-9, 11-14",
        _FITTED,
        "each cell counts alone, as in version 1 of `sasgeo`: it tells what correlated errors are worth",
        _GRAPH_FITTED,
        _BURNT,
        _SILENT,
        limits=_UNTAUGHT,
    )
    switches = Switches(correlates="never")


class SasgeoHard(LearningMatcher):
    """The whole scorer that reads states alone."""

    card = _whole(
        "sasgeo_hard",
        "SASGeo, probabilities read as states",
        reads="of a view with probabilities each cell is the likelier of present and absent: it tells what "
        "probabilities are worth",
    )
    switches = Switches(reads_probabilities=False)


class SasgeoGains(LearningMatcher):
    """The whole scorer without the terms that are ours."""

    card = _whole(
        "sasgeo_gains",
        "SASGeo by its gains alone",
        terms=(_GAINS,),
        vectors=(_GRAPH_FITTED, _NOT_BURNT),
    )
    switches = Switches(
        burns_vectors=False, searches_overlap=False, weighs_prior=False, weighs_amounts=False, weighs_overlap="never"
    )


class SasgeoGainsSearch(LearningMatcher):
    """The whole scorer whose search knows no overlap."""

    card = _whole(
        "sasgeo_gains_search",
        "SASGeo that searches by its gains alone",
        terms=("a view that is certain is searched for by its gains alone", _TERMS[1]),
    )
    switches = Switches(searches_overlap=False)


class SasgeoNoPosePrior(LearningMatcher):
    """The whole scorer that takes all headings and scales for alike."""

    card = _whole(
        "sasgeo_no_pose_prior",
        "SASGeo without the prior of heading and scale",
        terms=(_SEARCH, f"its modes are ranked, besides, by {_AMOUNTS}; by {_OVERLAP}"),
    )
    switches = Switches(weighs_prior=False)


class SasgeoNoAmounts(LearningMatcher):
    """The whole scorer that asks where a class lies, not how much of it there is."""

    card = _whole(
        "sasgeo_no_amounts",
        "SASGeo without the amounts of the classes",
        terms=(_SEARCH, f"its modes are ranked, besides, by {_POSE_PRIOR}; by {_OVERLAP}"),
    )
    switches = Switches(weighs_amounts=False)


class SasgeoNoOverlap(LearningMatcher):
    """The whole scorer that searches for overlap, and does not rank by it."""

    card = _whole(
        "sasgeo_no_overlap",
        "SASGeo that ranks without overlap",
        terms=(_SEARCH, f"its modes are ranked, besides, by {_POSE_PRIOR}; by {_AMOUNTS}; not by the overlap"),
    )
    switches = Switches(weighs_overlap="never")


class SasgeoOverlapAlways(LearningMatcher):
    """The whole scorer for which areas count as much as lines, however well these are seen."""

    card = _whole(
        "sasgeo_overlap_always",
        "SASGeo, the overlap of areas always counts",
        terms=(
            _SEARCH,
            f"its modes are ranked, besides, by {_POSE_PRIOR}; by {_AMOUNTS}; by the overlap of all classes alike",
        ),
    )
    switches = Switches(weighs_overlap="always")
