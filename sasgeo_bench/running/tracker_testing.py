# SPDX-License-Identifier: Apache-2.0
"""The conformance kit of trackers: the rules that each keeps, checked on a short flight under the limits of a run."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import ClassVar, Final

import numpy as np

from sasgeo_bench.core.errors import counted
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import MATCHERS, TRACKERS
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.matching.matcher import MatcherCard, is_followed, lacks
from sasgeo_bench.running.testing import Check, MapKit, TinyMap, check_of, draw, unseen
from sasgeo_bench.running.worker import Limits, Reply
from sasgeo_bench.tasks.query import Query, Step, Truth
from sasgeo_bench.tasks.suites.base import Choice
from sasgeo_bench.tasks.task_files import query_bytes

TOWN: Final = "town-riverside"  # the smallest over which views tell where they are
_SUITE, _KIND = "flight-clean", "F1 vo-mono-survey"
_ODD: Final = slice(5, 8)  # views that are changed: once a tracker may know its place, and some are left
_NEAR_M: Final = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TinyFlights(TinyMap):
    """Short flights over a synthetic town, made by `tiny_flights`.

    `folder` holds regions/, tasks/ and truth/, as `make-queries` writes them. Each flight is its views in order, and
    `truths` gives the truth of a view by its query id.
    """

    flights: tuple[tuple[Query, ...], ...]
    truths: dict[str, Truth]


def tiny_flights(path: str | Path) -> TinyFlights:
    """Make short flights to try a tracker on, in some seconds, the same on every machine; nothing is downloaded.

    The first has an odometer that drifts, the others one that does not. Map, queries and truths go to the folder
    `path`, in place of earlier ones. Raise `StoreError` if it cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = tiny_flights(folder)
    >>> len(made.flights), made.flights[0][1].step.frame, made.flights[0][1].track
    (3, 1, 'sequence')
    """
    region, pairs = draw(Path(path), TOWN, (_SUITE,), Choice(kinds=(_KIND,)))
    truths = {query.query_id: truth for query, truth in pairs}
    views = groupby((query for query, _ in pairs), key=lambda query: query.step and query.step.sequence_id)
    flights = sorted(
        (tuple(flight) for _, flight in views),
        key=lambda flight: (truths[flight[0].query_id].kind != _KIND, flight[0].query_id),
    )
    return TinyFlights(folder=Path(path), region=region, flights=tuple(flights), truths=truths)


def check_tracker(
    spec: str, *, limits: Limits | None = None, made: TinyFlights | None = None, is_sandboxed: bool = True
) -> Iterator[Check]:
    """Try a tracker, given by name or module:Class, on short flights; yield a row for each rule.

    A matcher of single views is tried as it follows flights (`Follower`). `made` can be shared by several trackers.
    Without `is_sandboxed`, trusted code runs without isolation, as in `run --trusted`.
    """
    with ExitStack() as stack:
        if made is None:
            made = tiny_flights(stack.enter_context(scratch_folder("check")))
        worker = stack.enter_context(made.worker(spec, limits=limits, is_sandboxed=is_sandboxed))
        yield from _TrackerKit(process=worker, folder=made.folder, worker=worker, place=made).table()


@dataclass(kw_only=True)
class _TrackerKit(MapKit[Query]):
    one: ClassVar[str] = "a view"
    many: ClassVar[str] = "views"
    first_rule: ClassVar[str] = "follows a flight"

    place: TinyFlights

    def group_of(self, card: MatcherCard) -> str:
        return MATCHERS if is_followed(card) else TRACKERS

    def rules(self) -> Iterator[Check]:
        """Run every check in turn; nothing more where an ordinary flight is not followed."""
        views, other = (flight[:12] for flight in self.place.flights[:2])  # 12 views of a flight that are asked
        lack = lacks(self.card, views[0])
        if lack is not None:
            yield Check(name=self.first_rule, outcome="not applicable", found=f"the flights here have {lack}")
            return
        first = self._fly(views)
        yield check_of(self.first_rule, _fault(first, views), self._summary(first))
        if _fault(first, views) is not None:
            return
        yield _covariances(first)
        yield self._again("the same answers twice", first, views)
        self._fly(other)
        yield self._again("forgets the flight before", first, views)
        self.process.end()
        # 6 of them, where the flight is cut short
        yield self._again("the same answers to a flight that is cut short, in a fresh process", first, views[:6])
        for name, changed in odd_flights(views).items():
            yield check_of(name, _fault(self._fly(changed), changed), self.count(len(changed)))
        yield self._blind([replace(query, evidence=unseen(query)) for query in views])
        seconds = [reply.seconds or 0.0 for reply in first]
        yield self.quick(seconds, f"{np.median(seconds):.3f} s a step (median), {max(seconds):.3f} s at most")

    def ask(self, item: Query) -> Reply:
        return self.noted(self.worker.match(query_bytes(item), top_k=10))

    def fault(self, label: str, item: Query, reply: Reply) -> str | None:
        del item
        return None if reply.found is not None else f"{label}: {reply.status}: {reply.message}"

    def _fly(self, views: Sequence[Query]) -> list[Reply]:
        """Ask the views of a flight in order; stop at the first without an answer."""
        replies: list[Reply] = []
        for query in views:
            replies.append(self.ask(query))
            if replies[-1].status != "ok":
                break
        return replies

    def _again(self, name: str, first: Sequence[Reply], views: Sequence[Query]) -> Check:
        for frame, (before, now) in enumerate(zip(first, self._fly(views), strict=False)):
            if now.status != "ok":
                return Check(name=name, outcome="fail", found=f"frame {frame}: {now.status}: {now.message}")
            if before.found != now.found:
                return Check(name=name, outcome="fail", found=f"frame {frame} has another answer")
        return Check(name=name, outcome="pass", found=self.count(len(views)))

    def _blind(self, views: Sequence[Query]) -> Check:
        """Check that nothing is accepted where no view shows anything: the start is known to some 500 m alone."""
        replies, number = self._fly(views), self.count(len(views))
        accepted = sum(bool(reply.found and reply.found.is_accepted) for reply in replies)
        fault = f"{accepted} of {number} accepted: odometry alone does not tell the place" if accepted else None
        return check_of("accepts nothing where nothing is seen", _fault(replies, views) or fault, number)

    def _summary(self, replies: Sequence[Reply]) -> str:
        """Describe how near the estimates are, and how many were accepted."""
        near, accepted, wrong = 0, 0, 0
        for query, reply in zip(self.place.flights[0], replies, strict=False):
            if reply.found is None:
                continue
            truth, fix = self.place.truths[query.query_id].pose, next(iter(reply.found.candidates), None)
            is_near = bool(
                truth
                and fix
                and np.hypot(fix[0].easting_m - truth.easting_m, fix[0].northing_m - truth.northing_m) <= _NEAR_M
            )
            near, accepted = near + is_near, accepted + bool(reply.found.is_accepted)
            wrong += bool(reply.found.is_accepted) and not is_near
        views = self.count(len(replies))
        return f"{views}: {near} within {_NEAR_M:g} m, {accepted} accepted, {wrong} of these farther away"


def odd_flights(views: Sequence[Query]) -> dict[str, tuple[Query, ...]]:
    """Return flights that a tracker must bear, by the name of the check, each a change of a flight."""
    prior = views[0].prior
    nowhere = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=prior.scale_sigma)
    chosen = range(len(views))[_ODD]
    # 5000 m: flown in one step, off the map
    return {
        "bears views that show nothing": tuple(
            replace(query, evidence=unseen(query)) if at in chosen else query for at, query in enumerate(views)
        ),
        "bears steps that the odometer lost": tuple(
            replace(query, step=_stepped(query, None)) if at in chosen else query for at, query in enumerate(views)
        ),
        "bears an odometer without errors": tuple(
            replace(query, step=_stepped(query, query.step.increment if query.step else None, sigma=0.0))
            for query in views
        ),
        "bears a flight off the map": tuple(
            replace(query, step=_stepped(query, (0.0, 5000.0, 0.0))) if at == chosen[0] else query
            for at, query in enumerate(views)
        ),
        "bears a prior without a place": (replace(views[0], prior=nowhere), *views[1:]),
        "bears a flight of one view": tuple(views[:1]),
    }


def _stepped(query: Query, increment: tuple[float, float, float] | None, *, sigma: float = 1.0) -> Step:
    """Return the step of a view with another increment, of the given standard deviations; the first view has none."""
    step = query.step or Step(sequence_id=query.query_id, frame=0)
    given = None if step.frame == 0 else increment
    covariance = None if given is None else tuple((sigma**2 * np.eye(3)).ravel().tolist())
    return replace(step, increment=given, covariance=covariance)


def _fault(replies: Sequence[Reply], views: Sequence[Query]) -> str | None:
    if replies and replies[-1].status != "ok":
        return f"frame {len(replies) - 1} of 0 to {len(views) - 1}: {replies[-1].status}: {replies[-1].message}"
    return None


def _covariances(replies: Sequence[Reply]) -> Check:
    """Check that every estimate has a covariance, or none has; the door has checked that each is one."""
    name = "a covariance for every estimate"
    posed = [reply.found for reply in replies if reply.found is not None and reply.found.candidates]
    given = [found for found in posed if found.covariance is not None]
    if not given:
        return Check(name=name, outcome="not applicable", found="none is given: figures of honesty will be empty")
    fault = f"{len(posed) - len(given)} of {len(posed)} estimates have none" if len(given) < len(posed) else None
    return check_of(name, fault, f"{counted(len(given), 'estimate')}, symmetric and positive definite")
