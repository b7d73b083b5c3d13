# SPDX-License-Identifier: Apache-2.0
"""The SASGeo scorer as a matcher: evidence by class, search, graph, joint score, and how sound the answer is."""

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
from sasgeo_bench.sasgeo.graph import GraphScore
from sasgeo_bench.sasgeo.integrity import Modes, evidence_of
from sasgeo_bench.sasgeo.learning import learn
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.protection import levels_of
from sasgeo_bench.sasgeo.reading import Glance, Reader
from sasgeo_bench.search.find import rank, search
from sasgeo_bench.search.plan import Mode, Null, Plan
from sasgeo_bench.tasks.query import Query

LISTED: Final = 20  # modes of one search, or candidates, that are looked at again: all that comes after shares them


@dataclass(frozen=True, kw_only=True)
class _Ranked:
    """The shared list by the joint score, best first: `order` into modes, terms of Eq. 11, and the graph of each."""

    order: NDArray[np.int64]
    terms: NDArray[np.float64]
    verified: Sequence[GraphScore] | None


class SasgeoMatcher:
    """The scorer; `switches` say which of its parts are on.

    Parameters
    ----------
    plan : Plan, optional
        How is searched.
    """

    card: MatcherCard
    switches: ClassVar[Switches] = Switches()

    def __init__(self, plan: Plan | None = None) -> None:
        self.plan = plan or Plan()
        self._reader: Reader | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read a map, by what was learnt; as set by hand where nothing was."""
        learnt = Learnt.from_text(learned) if learned else Learnt.by_hand(region.classes)
        self._reader = Reader.of(region, learnt, self.switches)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Find the best modes, or rank the candidates by the best pose near each."""
        if self._reader is None:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        if bool((query.evidence.cells == UNKNOWN).all()):
            return WITHHELD
        glance = self._reader.glance(query)
        if query.track == "retrieval":
            return _of_candidates(glance, self.plan, top_k=top_k)
        starts = glance.proposed()
        found = search(self._reader.field, glance.template, query.prior, self.plan, count=LISTED, starts=starts)
        if not found.modes:
            return WITHHELD
        ranked = _ranked(glance, found.modes)
        poses = [found.modes[at].pose for at in ranked.order]
        return _answer(glance, poses, ranked, null=found.null, top_k=top_k)


class LearningMatcher(SasgeoMatcher):
    """The scorer with fitted weights."""

    def learn(self, training: Training) -> str:
        """Learn rates and exponents from views whose places are known."""
        return learn(training, self.switches, plan=self.plan).to_text()


def _ranked(glance: Glance, modes: Sequence[Mode]) -> _Ranked:
    """Score a list anew by Eq. 11; equals keep their order."""
    poses = [mode.pose for mode in modes]
    verified = glance.verified(poses)
    terms = glance.terms(poses, verified)
    order = np.argsort(-terms.sum(axis=1), kind="stable")
    return _Ranked(order=order, terms=terms, verified=verified)


def _answer(
    glance: Glance, poses: Sequence[Pose], ranked: _Ranked, *, null: Null, top_k: int, rest: Sequence[Pose] = ()
) -> Match:
    """Answer with poses that are in the order of `ranked`, and below them the rest."""
    terms = ranked.terms[ranked.order]
    scores = terms.sum(axis=1)
    places_m = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
    modes = Modes(
        positions_m=places_m,
        by_class=terms,
        sigma_m=glance.sigma_m(poses[0]),
        none_nats=float(np.log(max(null.places, 1))),
    )
    best = None if ranked.verified is None else ranked.verified[int(ranked.order[0])]
    said = evidence_of(
        modes,
        null=null,
        unknown_share=glance.query.evidence.unknown_share,
        information_nats=glance.information_nats,
        map_age_years=glance.age_years,
        graph_consistency=None if best is None else best.consistency,
    )
    said |= levels_of(modes)
    given = [*poses, *rest][:top_k]
    low = float(scores[-1]) - 1.0
    worth = [*scores.tolist(), *(low - at for at in range(len(rest)))][:top_k]
    return Match(poses=given, scores=worth, confidence=float(modes.masses[0]), diagnostics=said)


def _of_candidates(glance: Glance, plan: Plan, *, top_k: int) -> Match:
    """Rank the candidates of a query; those whose neighbourhood is off the map come last."""
    query = glance.query
    found, null = rank(glance.reader.field, glance.template, query.prior, query.candidates, plan)
    scored = sorted(((at, mode) for at, mode in enumerate(found) if mode is not None), key=lambda item: -item[1].score)
    if not scored:
        return WITHHELD
    looked, rest = scored[:LISTED], scored[LISTED:]
    ranked = _ranked(glance, [mode for _, mode in looked])
    poses = [_at_candidate(query, *looked[at]) for at in ranked.order]
    return _answer(glance, poses, ranked, null=null, top_k=top_k, rest=[_at_candidate(query, *item) for item in rest])


def _at_candidate(query: Query, at: int, mode: Mode) -> Pose:
    """A candidate's place, turned and scaled as the best pose near it."""
    return replace(query.candidates[at], yaw_deg=mode.pose.yaw_deg, scale=mode.pose.scale)
