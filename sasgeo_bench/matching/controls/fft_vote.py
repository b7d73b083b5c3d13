# SPDX-License-Identifier: Apache-2.0
"""`fft_vote`: three-state correlation at every pose; and the base class of matchers that vote."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.controls.blind import is_blind, ranked_candidates
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.search.plan import Mode
from sasgeo_bench.search.view import Chart, View
from sasgeo_bench.search.vote_search import VoteGains, VotePlan, VoteSearch, make_template, ranked
from sasgeo_bench.tasks.query import Query


@dataclass(frozen=True, kw_only=True)
class PoseCheck:
    """A view and a map, to be compared cell by cell under single poses.

    Parameters
    ----------
    chart : Chart
        The map.
    bands : ndarray of int64, shape (C,)
        Indices of the classes of the view among those of the map.
    seen : ndarray of uint8, shape (C, rows, cols)
        ABSENT, PRESENT or UNKNOWN.
    cell_size_m : float
        Side of a view cell at scale 1.
    """

    chart: Chart
    bands: NDArray[np.int64]
    seen: NDArray[np.uint8]
    cell_size_m: float

    def mapped(self, pose: Pose) -> NDArray[np.uint8]:
        """Return the map as a perfect view from a pose shows it, shape (C, rows, cols)."""
        return self.chart.under(pose, self.seen.shape[1:], self.bands, cell_size_m=self.cell_size_m)

    def agreement(self, pose: Pose) -> float:
        """Return the mean over classes of intersection over union of view and map, where both are known, 0..1."""
        mapped = self.mapped(pose)
        known = (mapped != UNKNOWN) & (self.seen != UNKNOWN)
        both, either = (
            (how(self.seen == PRESENT, mapped == PRESENT) & known).sum(axis=(1, 2))
            for how in (np.logical_and, np.logical_or)
        )
        there = either > 0
        return float((both[there] / either[there]).mean()) if there.any() else 0.0


class DenseMatcher(ABC):
    """A matcher that scores every place, heading and scale; a subclass defines the map and the template."""

    card: MatcherCard

    def __init__(self, plan: VotePlan | None = None) -> None:
        self.plan = plan or VotePlan()
        self._chart: Chart | None = None

    @abstractmethod
    def read(self, region: Region) -> Chart:
        """Return the layers of a map to match against."""

    @abstractmethod
    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return the factors of the map, for all classes of the view: see `vote_search.make_template`."""

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read the map."""
        del learned
        self._chart = self.read(region)
        self._used = self._chart.used()

    def seen(self, evidence: Evidence) -> Evidence:
        """Return a view as this matcher reads it."""
        return evidence

    def rescored(self, modes: list[Mode], check: PoseCheck) -> list[Mode]:
        """Return the modes of a search, in their order, with the scores that rank them."""
        del check
        return modes

    def diagnose(self, best: Mode, check: PoseCheck) -> dict[str, float]:
        """Return diagnostics of the best mode."""
        return {"class_agreement": check.agreement(best.pose)}

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the best modes, or rank the candidates by the best pose near each."""
        if self._chart is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if is_blind(query) or set(query.evidence.classes).isdisjoint(self._chart.classes):
            return WITHHELD
        chart, view = self._chart, self._read(query.evidence, self._chart)
        search = VoteSearch(chart=chart, view=self._view(view, chart), prior=query.prior, plan=self.plan)
        # Prepare comparisons at single poses, in the classes that view or map hold
        bands = _bands(view, chart)
        chosen = self._used[bands] | (view.cells == PRESENT).any(axis=(1, 2))
        check = PoseCheck(chart=chart, bands=bands[chosen], seen=view.cells[chosen], cell_size_m=view.cell_size_m)
        count = min(top_k, 20)  # modes of one answer at most
        is_retrieval = query.track == "retrieval"
        found = search.candidates(query.candidates) if is_retrieval else search.places(count)
        modes = self.rescored([mode for mode in found.modes if mode is not None], check)
        best = ranked(modes)
        diagnostics = {"known_share": 1.0 - query.evidence.unknown_share, "null_score": found.null_score}
        # Number of modes and the margin of the best over the next, 0 where there is none
        margin = best[0].score - best[1].score if len(best) > 1 else 0.0
        diagnostics |= {"margin": margin, "modes": float(len(best))} | (self.diagnose(best[0], check) if best else {})
        if not is_retrieval:
            given = best[:count]
            poses, values = [mode.pose for mode in given], [mode.score for mode in given]
            return Match(poses=poses, scores=values, diagnostics=diagnostics)
        left = iter(modes)
        by_candidate = [None if mode is None else next(left) for mode in found.modes]
        poses = [mode.pose if mode else pose for pose, mode in zip(query.candidates, by_candidate, strict=True)]
        scores = [mode.score if mode else None for mode in by_candidate]
        return ranked_candidates(query, scores, top_k=top_k, poses=poses, diagnostics=diagnostics)

    def _read(self, evidence: Evidence, chart: Chart) -> Evidence:
        shared = [index for index, name in enumerate(evidence.classes) if name in chart.classes]
        return self.seen(
            Evidence(
                classes=tuple(evidence.classes[index] for index in shared),
                cells=evidence.cells[shared],
                cell_size_m=evidence.cell_size_m,
                confidence=None if evidence.confidence is None else evidence.confidence[shared],
            )
        )

    def _view(self, seen: Evidence, chart: Chart) -> View:
        """Make the template; classes that the map holds nowhere only count where they are seen."""
        whole, bands = self.template(seen), _bands(seen, chart)
        chosen = [index for index, band in enumerate(bands) if self._used[band] and whole[index].any()]
        return View.of(seen, np.concatenate((whole[chosen], whole[-2:])), bands[chosen])


def _bands(evidence: Evidence, chart: Chart) -> NDArray[np.int64]:
    """Return indices of the classes of a view among those of the map, shape (C,)."""
    return np.array([chart.classes.index(name) for name in evidence.classes], dtype=np.int64)


class FftVote(DenseMatcher):
    """Exhaustive three-state voting, one vote for each class and cell: the reference search of every board."""

    card = MatcherCard(
        name="fft_vote",
        version="4",
        title="Exhaustive three-state voting by FFT",
        source="Template voting of OrienterNet (Sarlin et al., CVPR 2023), on the scores of the SASGeo paper, Eqs. 7-8",
        ours=(
            "One vote a class and cell, by its probability if the view has some, in place of learned features; "
            "division by the cells known on both sides; scale; half of the view must be on the map; modes by their "
            "mean votes in place of a softmax and a covariance; coarse cells of 4 m (8 m beyond 5 km2), then local "
            "search"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "No class weighs more than another and nothing is learnt; headings beyond 2.5 and scales beyond two "
            "standard deviations are not searched; candidates that share a place within 24 m cannot be told apart; no "
            "confidence"
        ),
    )

    def read(self, region: Region) -> Chart:
        """Return the map unchanged."""
        return Chart.of(region)

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return the template with gains of 1."""
        gains = VoteGains.uniform(len(evidence.classes))
        return make_template(evidence.cells, gains, chances=evidence.probabilities())
