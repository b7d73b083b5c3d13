# SPDX-License-Identifier: Apache-2.0
"""What the dense matchers share: reading the map once, searching, and answering for both tracks."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.answers import is_blind, ranked_candidates
from sasgeo_baselines.chart import Chart
from sasgeo_baselines.dense import Mode, Plan, Search
from sasgeo_baselines.view import View
from sasgeo_bench.evidence import Evidence
from sasgeo_bench.matcher import WITHHELD, Match, MatcherCard, Training
from sasgeo_bench.query import Query
from sasgeo_bench.region import Region

MOST_PLACES: Final = 20  # modes given for one query, however many are asked for


class DenseMatcher(ABC):
    """A matcher that scores every place, heading and scale; a child says what is scored."""

    card: MatcherCard

    def __init__(self, plan: Plan | None = None) -> None:
        self.plan = plan or Plan()
        self._chart: Chart | None = None

    @abstractmethod
    def read(self, region: Region) -> Chart:
        """What is to be matched of a map."""

    @abstractmethod
    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """What the map is multiplied with, for all classes of the view: see `voting.make_template`."""

    def prepare(self, region: Region, training: Training | None) -> None:
        """Read the map; nothing is learnt."""
        del training
        self._chart = self.read(region)
        self._used = self._chart.used()

    def match(self, query: Query, *, top_k: int) -> Match:
        """Find the best modes, or rank the candidates by the best pose near each."""
        if self._chart is None:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        if is_blind(query):
            return WITHHELD
        search = Search(
            chart=self._chart, view=self._view(self._chart, query.evidence), prior=query.prior, plan=self.plan
        )
        known = {"known_share": 1.0 - query.evidence.unknown_share}
        if query.track == "retrieval":
            found = search.candidates(query.candidates)
            modes = sorted((mode for mode in found if mode is not None), key=lambda mode: -mode.score)
            poses = [pose if mode is None else mode.pose for pose, mode in zip(query.candidates, found, strict=True)]
            scores = [None if mode is None else mode.score for mode in found]
            said = {**_diagnostics(modes), **known}
            return ranked_candidates(query, scores, top_k=top_k, poses=poses, diagnostics=said)
        modes = search.places(min(top_k, MOST_PLACES))
        given = modes[: min(top_k, MOST_PLACES)]
        poses = [replace(mode.pose) for mode in given]
        return Match(poses=poses, scores=[mode.score for mode in given], diagnostics={**_diagnostics(modes), **known})

    def _view(self, chart: Chart, evidence: Evidence) -> View:
        """Take the classes the map speaks of; of those it holds nowhere, only what is seen in vain counts."""
        shared = [index for index, name in enumerate(evidence.classes) if name in chart.classes]
        seen = Evidence(
            classes=tuple(evidence.classes[index] for index in shared),
            cells=evidence.cells[shared],
            cell_size_m=evidence.cell_size_m,
        )
        whole = self.template(seen)
        places = [chart.classes.index(name) for name in seen.classes]
        chosen = [index for index, band in enumerate(places) if self._used[band] and whole[index].any()]
        template = np.concatenate((whole[chosen], whole[-2:]))
        return View.of(evidence, template, np.array([places[index] for index in chosen], dtype=np.int64))


def _diagnostics(modes: list[Mode]) -> dict[str, float]:
    """Margin of the best mode over the next, and how many there are."""
    if not modes:
        return {"margin": 0.0, "modes": 0.0}
    second = modes[1].score if len(modes) > 1 else 0.0
    return {"margin": modes[0].score - second, "modes": float(len(modes))}
