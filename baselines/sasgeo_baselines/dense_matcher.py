# SPDX-License-Identifier: Apache-2.0
"""What the dense matchers share: reading the map once, searching, and answering for both tracks."""

from abc import ABC, abstractmethod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.answers import is_blind, ranked_candidates
from sasgeo_baselines.chart import Chart
from sasgeo_baselines.dense import Mode, Plan, Search, ranked
from sasgeo_baselines.verification import Verifier
from sasgeo_baselines.view import View
from sasgeo_bench import PRESENT, WITHHELD, Evidence, Match, MatcherCard, Query, Region

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

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read the map; nothing is learnt."""
        del learned
        self._chart = self.read(region)
        self._used = self._chart.used()

    def seen(self, cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Read the cells of a view; as they are unless a child says otherwise."""
        return cells

    def rescored(self, modes: list[Mode], verifier: Verifier) -> list[Mode]:
        """Score the modes of a search anew, in their order; as they are unless a child says otherwise."""
        del verifier
        return modes

    def told(self, best: Mode, verifier: Verifier) -> dict[str, float]:
        """Diagnostics of the best mode."""
        return {"class_agreement": verifier.agreement(best.pose)}

    def match(self, query: Query, *, top_k: int) -> Match:
        """Find the best modes, or rank the candidates by the best pose near each."""
        if self._chart is None:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        if is_blind(query):
            return WITHHELD
        chart, view = self._chart, self._read(query.evidence, self._chart)
        search = Search(chart=chart, view=self._view(view, chart), prior=query.prior, plan=self.plan)
        verifier = self._verifier(view, chart)
        count = min(top_k, MOST_PLACES)
        is_retrieval = query.track == "retrieval"
        found = search.candidates(query.candidates) if is_retrieval else search.places(count)
        modes = self.rescored([mode for mode in found.modes if mode is not None], verifier)
        best = ranked(modes)
        said = {"known_share": 1.0 - query.evidence.unknown_share, "null_score": found.null_score}
        said |= _margin(best) | (self.told(best[0], verifier) if best else {})
        if not is_retrieval:
            given = best[:count]
            return Match(poses=[mode.pose for mode in given], scores=[mode.score for mode in given], diagnostics=said)
        left = iter(modes)
        by_candidate = [None if mode is None else next(left) for mode in found.modes]
        poses = [mode.pose if mode else pose for pose, mode in zip(query.candidates, by_candidate, strict=True)]
        scores = [mode.score if mode else None for mode in by_candidate]
        return ranked_candidates(query, scores, top_k=top_k, poses=poses, diagnostics=said)

    def _read(self, evidence: Evidence, chart: Chart) -> Evidence:
        """Take the classes the map speaks of, as this matcher reads them."""
        shared = [index for index, name in enumerate(evidence.classes) if name in chart.classes]
        names = tuple(evidence.classes[index] for index in shared)
        return Evidence(classes=names, cells=self.seen(evidence.cells[shared]), cell_size_m=evidence.cell_size_m)

    def _view(self, seen: Evidence, chart: Chart) -> View:
        """Make the template; of classes that the map holds nowhere, only what is seen in vain counts."""
        whole, bands = self.template(seen), _bands(seen, chart)
        chosen = [index for index, band in enumerate(bands) if self._used[band] and whole[index].any()]
        return View.of(seen, np.concatenate((whole[chosen], whole[-2:])), bands[chosen])

    def _verifier(self, seen: Evidence, chart: Chart) -> Verifier:
        """Make ready for looking at the map under single poses, in the classes that either side holds."""
        bands = _bands(seen, chart)
        chosen = self._used[bands] | (seen.cells == PRESENT).any(axis=(1, 2))
        return Verifier(chart=chart, bands=bands[chosen], seen=seen.cells[chosen], cell_size_m=seen.cell_size_m)


def _bands(evidence: Evidence, chart: Chart) -> NDArray[np.int64]:
    """Places of a view's classes among those of the map, shape (C,)."""
    return np.array([chart.classes.index(name) for name in evidence.classes], dtype=np.int64)


def _margin(modes: list[Mode]) -> dict[str, float]:
    """Margin of the best mode over the next, 0 where there is none, and how many there are."""
    margin = modes[0].score - modes[1].score if len(modes) > 1 else 0.0
    return {"margin": margin, "modes": float(len(modes))}
