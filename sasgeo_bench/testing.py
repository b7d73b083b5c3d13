# SPDX-License-Identifier: Apache-2.0
"""The conformance kit: what every matcher keeps to, tried on a tiny town under the limits of a run."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from sasgeo_bench.build import build_region, plan_build
from sasgeo_bench.errors import MatchError
from sasgeo_bench.evidence import UNKNOWN
from sasgeo_bench.matcher import MatcherCard, check_match, lacks
from sasgeo_bench.query import Query
from sasgeo_bench.request import Wanted, plan_requests
from sasgeo_bench.run.worker import Limits, Reach, Reply, Worker
from sasgeo_bench.store import taskdir
from sasgeo_bench.store.catalog import find_region_file, read_region_file
from sasgeo_bench.tasks import make_tasks

TOWN: Final = "town-riverside"
TOP_K: Final = 10
_FAR_M: Final = 300.0
_QUICK_S: Final = 5.0
_ASKED: Final = 5  # about so many queries are asked in each check

Outcome = Literal["pass", "fail", "not applicable"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One row of the table."""

    name: str
    outcome: Outcome
    found: str


def check_matcher(spec: str, *, limits: Limits | None = None) -> Iterator[Check]:
    """Try a matcher on a tiny town.

    Parameters
    ----------
    spec : str
        Its name, or module:Class.
    limits : Limits, optional
        Those of a run unless given.

    Yields
    ------
    Check
        A row for each thing that a matcher keeps to; what its card says it cannot do is not applicable.
    """
    with tempfile.TemporaryDirectory(prefix="sasgeo-check-") as folder:
        out = Path(folder)
        queries = _queries(out)
        region = out / "regions" / TOWN
        reach = Reach(readable=[region.resolve()], hidden=[(out / "truth").resolve()])
        with Worker(spec=spec, reach=reach, limits=limits or Limits()) as worker:
            loaded = worker.load()
            if loaded.status != "ok" or loaded.card is None:
                yield Check(name="loads, and has a card", outcome="fail", found=loaded.message)
                return
            yield Check(name="loads, and has a card", outcome="pass", found=f"{loaded.card.name} {loaded.card.version}")
            ready = worker.prepare(region)
            seconds = f"{ready.seconds:.2f} s" if ready.seconds is not None else ready.message
            yield Check(name="prepares a map", outcome="pass" if ready.status == "ok" else "fail", found=seconds)
            if ready.status == "ok":
                yield from _Kit(worker=worker, card=loaded.card, queries=queries).checks()


def _queries(out: Path) -> tuple[Query, ...]:
    """Queries of a tiny town, drawn as any others: both tracks, with vectors."""
    spec = read_region_file(find_region_file(TOWN))
    build_region(plan_build(spec, out=out), tell=lambda _: None, with_preview=False)
    found: list[Query] = []
    for suite in ("clean", "no-priors"):
        wanted = Wanted(suites=(suite,), regions=(TOWN,), split="crossfit", count=2, seed=1, out=out, may_be_fewer=True)
        for made in make_tasks(plan_requests(wanted, tell=lambda _: None)[0], tell=lambda _: None):
            found += taskdir.read_queries(made.folder)
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class _Kit:
    worker: Worker
    card: MatcherCard
    queries: Sequence[Query]

    def checks(self) -> Iterator[Check]:
        """Every check in turn."""
        small = sorted(self.queries, key=lambda query: (query.evidence.shape[0], query.query_id))
        able = [query for query in small[: len(small) // 2] if lacks(self.card, query) is None]
        able = able[:: max(1, len(able) // _ASKED)]
        if not able:
            yield Check(name="answers a query", outcome="not applicable", found="the card's needs leave no query")
            return
        named: tuple[tuple[str, Callable[[Query], str | None]], ...] = (
            ("shapes, order and finite scores", self._shapes),
            ("the same answer twice", self._determinism),
            ("no more than top_k", self._top_k),
            ("withholds where all is unknown", self._unknown),
            ("answers where the place is absent", self._absent),
            ("a moved prior moves the answer", self._moved),
            ("equal candidates tie", self._ties),
        )
        for name, check in named:
            yield self._over(name, check, able)
        yield self._order(able)
        start = time.perf_counter()
        replies = [self._ask(query) for query in able]
        each_s = (time.perf_counter() - start) / len(replies)
        peak = f"{each_s:.3f} s a query, {self.worker.peak_bytes / 2**20:.0f} MiB at most"
        yield Check(name="time and memory", outcome="pass" if each_s < _QUICK_S else "fail", found=peak)
        said = self.worker.isolation.get("files", "")
        yield Check(name="kept to its scratch folder", outcome="pass" if said else "not applicable", found=said)

    def _ask(self, query: Query, *, top_k: int = TOP_K) -> Reply:
        return self.worker.match(taskdir.query_bytes(query), top_k=top_k)

    def _over(self, name: str, check: Callable[[Query], str | None], queries: Sequence[Query]) -> Check:
        """Run a check over the queries; the first fault counts."""
        tried = 0
        for query in queries:
            try:
                fault = check(query)
            except _NotApplicable:
                continue
            tried += 1
            if fault is not None:
                return Check(name=name, outcome="fail", found=fault)
        if not tried:
            return Check(name=name, outcome="not applicable", found="no query of this kind that the card allows")
        return Check(name=name, outcome="pass", found=f"{tried} queries")

    def _shapes(self, query: Query) -> str | None:
        reply = self._ask(query)
        if reply.status != "ok" or reply.match is None:
            return f"{reply.status}: {reply.message}"
        try:
            check_match(reply.match, query, top_k=TOP_K)
        except MatchError as error:
            return str(error)
        return None

    def _determinism(self, query: Query) -> str | None:
        first, second = self._ask(query).match, self._ask(query).match
        return None if first == second else f"query {query.query_id[:8]} has another answer the second time"

    def _top_k(self, query: Query) -> str | None:
        reply = self._ask(query, top_k=1)
        if reply.status != "ok" or reply.match is None:
            return f"{reply.status}: {reply.message}"
        return None if len(reply.match.poses) <= 1 else f"{len(reply.match.poses)} poses for top_k = 1"

    def _unknown(self, query: Query) -> str | None:
        if "image" in self.card.needs:
            raise _NotApplicable
        blind = replace(
            query, evidence=query.evidence.replace(np.full_like(query.evidence.cells, UNKNOWN)), vectors=None
        )
        if lacks(self.card, blind) is not None:
            raise _NotApplicable
        reply = self._ask(blind)
        if reply.status != "ok" or reply.match is None:
            return f"{reply.status}: {reply.message}"
        withheld = not reply.match.poses or reply.match.confidence == 0.0
        return None if withheld else "answers with confidence although nothing was seen: return matcher.WITHHELD"

    def _absent(self, query: Query) -> str | None:
        if query.prior.center_m is None or query.prior.radius_m is None:
            raise _NotApplicable
        x, y = query.prior.center_m
        away = replace(query.prior, center_m=(x + 10 * query.prior.radius_m, y))
        reply = self._ask(replace(query, prior=away))
        return None if reply.status == "ok" else f"{reply.status} with a disc beyond the map: {reply.message}"

    def _moved(self, query: Query) -> str | None:
        if query.track != "localization" or query.prior.center_m is None or query.prior.radius_m is None:
            raise _NotApplicable
        x, y = query.prior.center_m
        near = replace(query.prior, center_m=(x + _FAR_M, y), radius_m=_FAR_M / 3)
        here = replace(query.prior, radius_m=_FAR_M / 3)
        answers = [self._ask(replace(query, prior=prior)).match for prior in (here, near)]
        if any(answer is None for answer in answers):
            return "no answer to a small disc"
        if not all(answer is not None and answer.poses for answer in answers):
            return None
        first, second = ([(pose.easting_m, pose.northing_m) for pose in answer.poses] for answer in answers if answer)
        return "the same answer in two discs that do not meet" if first == second else None

    def _ties(self, query: Query) -> str | None:
        if query.track != "retrieval":
            raise _NotApplicable
        # The same place twice: a scorer that looks at the map alone cannot tell one from the other.
        one = query.candidates[0]
        twin = replace(one, easting_m=one.easting_m + 0.0)
        reply = self._ask(replace(query, candidates=(one, query.candidates[1], twin)), top_k=3)
        if reply.match is None:
            return f"{reply.status}: {reply.message}"
        scores = {
            score
            for pose, score in zip(reply.match.poses, reply.match.scores, strict=True)
            if (pose.easting_m, pose.northing_m) == (one.easting_m, one.northing_m)
        }
        return None if len(scores) <= 1 else f"two scores for one place: {sorted(scores)}"

    def _order(self, queries: Sequence[Query]) -> Check:
        """An answer depends on its own query alone, not on those before it."""
        forth = {query.query_id: self._ask(query).match for query in queries}
        back = {query.query_id: self._ask(query).match for query in reversed(queries)}
        other = next((name for name in forth if forth[name] != back[name]), None)
        found = f"query {other[:8]} has another answer after others" if other else f"{len(forth)} queries both ways"
        return Check(name="the same answers in any order", outcome="fail" if other else "pass", found=found)


class _NotApplicable(Exception):  # noqa: N818 - no error: the check does not concern this matcher
    """The check does not concern this matcher or query."""
