# SPDX-License-Identifier: Apache-2.0
"""The SASGeo scorer as a matcher: evidence by class, dense search, graph, joint score; and what an answer tells of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.evidence import UNKNOWN
from sasgeo_bench.matcher import WITHHELD, Match, MatcherCard, Training
from sasgeo_bench.pose import Pose
from sasgeo_bench.query import Query
from sasgeo_bench.region import Region
from sasgeo_bench.sasgeo.arms import Switches
from sasgeo_bench.sasgeo.learning import learn
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.reading import Reader, Terms
from sasgeo_bench.search.find import rank, search
from sasgeo_bench.search.plan import Mode, Null, Plan

MODES: Final = 20  # of a search: the list that everything after it shares


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

    def learn(self, training: Training) -> str:
        """Learn rates and exponents from views whose places are known."""
        return learn(training, self.switches, plan=self.plan).to_text()

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read a map, by what was learnt; as set by hand where nothing was."""
        learnt = Learnt.from_text(learned) if learned else Learnt.by_hand(region.classes)
        self._reader = Reader.of(region, learnt.of_classes(region.classes), self.switches)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Find the best modes, or rank the candidates by the best pose near each."""
        if self._reader is None:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        if bool((query.evidence.cells == UNKNOWN).all()):
            return WITHHELD
        glance = self._reader.glance(query)
        if query.track == "retrieval":
            modes, null = rank(glance.field, glance.template(), query.prior, query.candidates, self.plan)
