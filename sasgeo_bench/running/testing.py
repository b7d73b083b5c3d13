# SPDX-License-Identifier: Apache-2.0
"""The conformance kit: the rules that every matcher keeps, checked on a tiny place under the limits of a run."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from sasgeo_bench.errors import MatchError
from sasgeo_bench.files.folders import scratch_folder
from sasgeo_bench.files.plugins import MATCHERS, check_card_name
from sasgeo_bench.matching.matcher import MatcherCard, candidates_at, check_match, lacks
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.progress import reporting, silent
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.running.worker import Limits, PluginReply, Reach, Reply, Worker
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.query import SEQUENCE, Query, Truth
from sasgeo_bench.tasks.task_files import query_bytes
from sasgeo_bench.tasks.task_plan import Wanted, plan_requests
from sasgeo_bench.texts import message_of

Outcome = Literal["pass", "fail", "not applicable"]
Listing = Mapping[str, tuple[int, int]]

LEARNS: Final = "learns, the same text twice"  # a row of those that have a learn()
_LOADS: Final = "loads, and has a card"
_MOST_NAMED: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One row of the table."""

    name: str
    outcome: Outcome
    found: str


def check_of(name: str, fault: str | None, found: str) -> Check:
    """Return a row that fails by a fault, or passes with what was found.

    >>> check_of("the same answer twice", None, "4 images").outcome
    'pass'
    """
    return Check(name=name, outcome="fail" if fault else "pass", found=fault or found)


def tried(rules: Iterable[tuple[str, Callable[[], str | None], str]]) -> Iterator[Check]:
    """Yield a row for each rule: its name, what returns a fault or None, and what was found where there is none.

    What code of somebody's own raises is a fault, too.
    """
    for name, rule, found in rules:
        try:
            fault = rule()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - as said
            fault = message_of(error)
        yield check_of(name, fault, found)


def loaded_check(spec: str, reply: PluginReply, card: MatcherCard | SegmenterCard | None, *, group: str) -> Check:
    """Check that a plugin of a group of entry points was loaded, and that its card has a name of its own."""
    if reply.status != "ok" or card is None:
        return Check(name=_LOADS, outcome="fail", found=reply.message)
    try:
        check_card_name(spec, card.name, group=group)
    except MatchError as error:
        return Check(name=_LOADS, outcome="fail", found=str(error))
    return Check(name=_LOADS, outcome="pass", found=f"{card.name} {card.version}")


def taught_check(first: PluginReply, second: PluginReply, lessons: str) -> Check:
    """Check that two trainings on the same lessons, each in a process of its own, gave the same text."""
    lost = next((reply for reply in (first, second) if reply.learned is None), None)
    fault = "another text the second time" if lost is None and first.learned != second.learned else ""
    fault = fault if lost is None else f"{lost.status}: {lost.message}"
    size = len((first.learned or "").encode())
    return check_of(LEARNS, fault, f"{size} bytes from {lessons}, {first.seconds or 0.0:.2f} s")


def refusal_of(reply: PluginReply) -> str:
    """Return what a process was refused, in words; empty if nothing was."""
    return reply.message if reply.status == "refused" else ""


def listing_of(folder: Path) -> Listing:
    """List everything below a folder, files with size and time of writing."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    status = {name: path.stat() for name, path in found.items() if path.is_file()}
    return {name: (status[name].st_size, status[name].st_mtime_ns) if name in status else (0, 0) for name in found}


def kept_check(refused: str, before: Listing, after: Listing, limited: str) -> Check:
    """Check that nothing outside the scratch folder was refused, or written where no sandbox refuses it."""
    changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    fault = f"wrote among maps and tasks: {', '.join(changed[:_MOST_NAMED])}" if changed else ""
    fault = f"was refused what it asked for: {refused}" if refused else fault
    return check_of(
        "kept to its scratch folder", fault, limited or "not shut in: looked for files among maps and tasks alone"
    )


TOWN: Final = "town-agricultural"  # the smallest that has room for candidates
TOP_K: Final = 10
_EDGE_SHARE: Final = 0.3
_QUICK_S: Final = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TinyPlace:
    """A synthetic place of 1 km2, made by `tiny_place`: its map, queries, and their truths in the same order.

    `folder` holds regions/, tasks/ and truth/, as `make-queries` writes them. The queries are of both tracks, some with
    vectors, some without any prior.
    """

    folder: Path
    region: Region
    queries: tuple[Query, ...]
    truths: tuple[Truth, ...]

    @property
    def map_folder(self) -> Path:
        """Return the folder of the map."""
        return self.folder / "regions" / self.region.manifest.id

    @property
    def is_pictured(self) -> bool:
        """Return whether the map has imagery."""
        return self.region.imagery is not None


def tiny_place(path: str | Path) -> TinyPlace:
    """Make a small place to try a matcher on, in about a second, the same on every machine; nothing is downloaded.

    Map, queries and truths go to the folder `path`, in place of earlier ones. Raise `StoreError` if it cannot be
    written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = tiny_place(folder)
    >>> place.region.grid.shape, sorted({query.track for query in place.queries})
    ((1024, 1024), ['localization', 'retrieval'])
    """
    folder = Path(path)
    queries: list[Query] = []
    truths: list[Truth] = []
    wanted = Wanted(
        suites=("clean", "no-priors"), regions=(TOWN,), split="crossfit", count=1, seed=1, out=folder, may_be_fewer=True
    )
    with reporting(silent):
        build_region(plan_build(read_region_file(find_region_file(TOWN)), out=folder))
        for request in plan_requests(wanted):
            for made in make_tasks(request):
                queries += made.queries()
                truths += made.truths
    region = read_region(folder / "regions" / TOWN)
    return TinyPlace(folder=folder, region=region, queries=tuple(queries), truths=tuple(truths))


def check_matcher(
    spec: str, *, limits: Limits | None = None, place: TinyPlace | None = None, is_shut_in: bool = True
) -> Iterator[Check]:
    """Try a matcher, given by name or module:Class, on a tiny place; yield a row for each rule.

    `place` can be shared by several matchers. Without `is_shut_in`, trusted code runs without isolation, as in
    `run --trusted`. Rules about what the card excludes are not applicable. A query without a sound answer counts in the
    first row only.
    """
    with ExitStack() as stack:
        if place is None:
            place = tiny_place(stack.enter_context(scratch_folder("check")))
        readable, hidden = place.map_folder.resolve(), (place.folder / "truth").resolve()
        reach = Reach(readable=[readable], hidden=[hidden], is_shut_in=is_shut_in)
        worker = stack.enter_context(Worker(spec=spec, reach=reach, limits=limits or Limits()))
        before = listing_of(place.folder)
        loaded = worker.load()
        yield (first := loaded_check(spec, loaded, loaded.card, group=MATCHERS))
        if loaded.card is None or first.outcome == "fail":
            return
        taught = _taught(worker, place) if loaded.learns else None
        if taught is not None:
            yield taught.check
            yield _untaught(worker, loaded.card, place)
        text, refused = (None, "") if taught is None else (taught.text, taught.refused)
        ready = worker.prepare(place.map_folder, text)
        seconds = f"{ready.seconds:.2f} s" if ready.seconds is not None else ready.message
        yield Check(name="prepares a map", outcome="pass" if ready.status == "ok" else "fail", found=seconds)
        kit = _Kit(worker=worker, card=loaded.card, place=place, is_taught=text is not None)
        if ready.status == "ok":
            yield from kit.checks()
        yield kept_check(
            refused or kit.refused or refusal_of(ready),
            before,
            listing_of(place.folder),
            worker.isolation.get("files_changed", ""),
        )


@dataclass(frozen=True, kw_only=True)
class _Taught:
    """The text that a matcher learned from the tiny place, refused accesses, and the row of the table."""

    text: str | None
    refused: str
    check: Check


def _taught(worker: Worker, place: TinyPlace) -> _Taught:
    """Train a matcher twice, each time in a process of its own."""
    maps = {place.region.manifest.id: place.map_folder}
    blobs = [query_bytes(query) for query in place.queries]
    replies = []
    for _ in range(2):
        worker.end()
        replies.append(worker.learn(maps, zip(blobs, place.truths, strict=True)))
    worker.end()
    first, second = replies
    check = taught_check(first, second, f"{len(blobs)} queries")
    return _Taught(text=first.learned, refused=refusal_of(first) or refusal_of(second), check=check)


def _untaught(worker: Worker, card: MatcherCard, place: TinyPlace) -> Check:
    """Check that a matcher with a `learn` also answers untrained, unless its card excludes that."""
    name = "answers without training"
    if "training" in card.needs:
        return Check(name=name, outcome="not applicable", found="the card needs training")
    ready = worker.prepare(place.map_folder)
    fault = None if ready.status == "ok" else f"{ready.status}: {ready.message}"
    queries = _one_of_each_track(
        [query for query in place.queries if lacks(card, query, is_pictured=place.is_pictured) is None]
    )
    for query in queries if fault is None else ():
        fault = fault or _fault(worker.match(query_bytes(query), top_k=TOP_K), query)
    worker.end()
    found = f"learned = None: {fault}" if fault else f"{len(queries)} queries"
    return Check(name=name, outcome="fail" if fault else "pass", found=found)


def _chosen(queries: Iterable[Query]) -> list[Query]:
    """Choose a few queries of each kind: first those with a prior, and the smallest views."""
    kinds: dict[tuple[str, bool], list[Query]] = {}
    for query in sorted(queries, key=lambda item: (item.prior.yaw_deg is None, item.evidence.shape, item.query_id)):
        kinds.setdefault((query.track, query.vectors is not None), []).append(query)
    return [query for kind in kinds.values() for query in kind[:2]]  # queries asked of each kind


def _one_of_each_track(queries: Sequence[Query]) -> list[Query]:
    ordered = sorted(queries, key=lambda item: item.evidence.shape, reverse=True)
    return list({query.track: query for query in ordered}.values())


def _changed(query: Query, what: str, **changes: Any) -> Query:  # noqa: ANN401 - any field of a query
    """Change a query, and its id: a matcher may remember its answer to an id."""
    name = hashlib.sha256(f"{query.query_id} {what}".encode()).hexdigest()[: len(query.query_id)]
    return replace(query, query_id=name, **changes)


@dataclass(kw_only=True)
class _Kit:
    worker: Worker
    card: MatcherCard
    place: TinyPlace
    is_taught: bool = False
    refused: str = ""
    first: dict[str, Reply] = field(default_factory=dict)
    second: dict[str, Reply] = field(default_factory=dict)

    def checks(self) -> Iterator[Check]:
        able = _chosen(query for query in self.place.queries if self._lacks(query) is None)
        if not able and self.card.tracks == (SEQUENCE,):
            fault = "it follows flights: check it as a tracker (--kind tracker)"
            yield Check(name="answers a query", outcome="fail", found=fault)
            return
        if not able:
            yield Check(name="answers a query", outcome="not applicable", found="the card's needs leave no query")
            return
        yield self._answers(able)
        sound = [query for query in able if query.query_id in self.second]
        named: tuple[tuple[str, Callable[[Query], str | None], Sequence[Query]], ...] = (
            ("the same answer twice", self._twice, sound),
            ("no more than top_k", self._top_k, sound),
            ("needs no more than its card says", self._less, _one_of_each_track(sound)),  # searching everywhere is slow
            ("withholds where all is unknown", self._unknown, sound),
            ("answers where the place is absent", self._absent, sound),
            ("a moved prior moves the answer", self._moved, sound),
            ("equal candidates tie", self._ties, sound),
        )
        for name, check, queries in named:
            yield self._over(name, check, queries)
        yield self._order([query for query in sound if self._twice(query) is None])
        yield self._cost(sound)

    def _lacks(self, query: Query) -> str | None:
        return lacks(self.card, query, is_taught=self.is_taught, is_pictured=self.place.is_pictured)

    def _ask(self, query: Query, *, top_k: int = TOP_K) -> Reply:
        reply = self.worker.match(query_bytes(query), top_k=top_k)
        self.refused = self.refused or refusal_of(reply)
        return reply

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
            return Check(name=name, outcome="not applicable", found="no query to try it with")
        return Check(name=name, outcome="pass", found=f"{tried} queries")

    def _answers(self, queries: Sequence[Query]) -> Check:
        """Ask every query twice in a row, and keep the answers; report an unsound first answer once."""
        faults = []
        for query in queries:
            self.first[query.query_id] = self._ask(query)
            fault = _fault(self.first[query.query_id], query)
            if fault is None:
                self.second[query.query_id] = self._ask(query)
            else:
                faults.append(fault)
        found = f"{faults[0]} ({len(faults)} of {len(queries)} queries)" if faults else f"{len(queries)} queries"
        return Check(name="shapes, order and finite scores", outcome="fail" if faults else "pass", found=found)

    def _twice(self, query: Query) -> str | None:
        first, second = self.first[query.query_id], self.second[query.query_id]
        return None if first.match == second.match else f"query {query.query_id[:8]} {_other(second)} the second time"

    def _top_k(self, query: Query) -> str | None:
        return _fault(self._ask(_changed(query, "top_k"), top_k=1), query, top_k=1)

    def _less(self, query: Query) -> str | None:
        """Ask without the disc, or without the heading, where the card does not need it."""
        prior = query.prior
        bare = {
            "a disc": replace(prior, center_m=None, radius_m=None),
            "a heading": replace(prior, yaw_deg=None, yaw_sigma_deg=None),
        }
        asked = [(what, _changed(query, what, prior=less)) for what, less in bare.items() if less != prior]
        able = [(what, less) for what, less in asked if self._lacks(less) is None]
        if not able:
            raise _NotApplicable
        faults = ((what, _fault(self._ask(less), less)) for what, less in able)
        return next((f"without {what}: {fault}" for what, fault in faults if fault is not None), None)

    def _unknown(self, query: Query) -> str | None:
        unseen = query.evidence.replace(np.full_like(query.evidence.cells, UNKNOWN))
        blind = _changed(query, "unknown", evidence=unseen, vectors=None, frames=())
        if self._lacks(blind) is not None:
            raise _NotApplicable
        reply = self._ask(blind)
        if reply.status != "ok" or reply.match is None:
            return f"{reply.status}: {reply.message}"
        withheld = not reply.match.poses or reply.match.confidence == 0.0
        return None if withheld else "answers although nothing was seen: return matcher.WITHHELD"

    def _absent(self, query: Query) -> str | None:
        if query.prior.center_m is None or query.prior.radius_m is None:
            raise _NotApplicable
        x, y = query.prior.center_m
        away = replace(query.prior, center_m=(x + 10 * query.prior.radius_m, y))
        reply = self._ask(_changed(query, "absent", prior=away))
        return None if reply.status == "ok" else f"{reply.status} with a disc beyond the map: {reply.message}"

    def _moved(self, query: Query) -> str | None:
        if query.track != "localization" or query.prior.center_m is None:
            raise _NotApplicable
        west_m, south_m, east_m, north_m = self.place.region.grid.bounds_m
        places = []
        for share in (_EDGE_SHARE, 1 - _EDGE_SHARE):
            center_m = (west_m + share * (east_m - west_m), (south_m + north_m) / 2)
            # 100 m: radius of two discs that do not meet, each so far from the edge of the map:
            prior = replace(query.prior, center_m=center_m, radius_m=100.0)
            reply = self._ask(_changed(query, f"moved {share:g}", prior=prior))
            if reply.match is None:
                return f"{reply.status} with a small disc: {reply.message}"
            places.append([(pose.easting_m, pose.northing_m) for pose in reply.match.poses])
        if not all(places):
            raise _NotApplicable
        return "the same answer in two discs that do not meet" if places[0] == places[1] else None

    def _ties(self, query: Query) -> str | None:
        if query.track != "retrieval":
            raise _NotApplicable
        # The same place twice: a scorer that looks at the map alone cannot separate them.
        one, other = query.candidates[:2]
        reply = self._ask(_changed(query, "ties", candidates=(one, other, one)))
        if reply.match is None:
            return f"{reply.status}: {reply.message}"
        pairs = zip(reply.match.poses, reply.match.scores, strict=True)
        scores = {score for pose, score in pairs if candidates_at(pose, (one,))}
        return None if len(scores) <= 1 else f"two scores for one place: {sorted(scores)}"

    def _order(self, queries: Sequence[Query]) -> Check:
        """Check that an answer depends neither on earlier queries nor on the start of the process."""
        name = "the same answers in any order"
        if not queries:
            return Check(name=name, outcome="not applicable", found="no query to try it with")
        self.worker.end()
        for query in reversed(queries):
            reply = self._ask(query)
            if reply.match != self.first[query.query_id].match:
                found = f"query {query.query_id[:8]} {_other(reply)} after others, in a fresh process"
                return Check(name=name, outcome="fail", found=found)
        return Check(name=name, outcome="pass", found=f"{len(queries)} queries both ways, in two processes")

    def _cost(self, queries: Sequence[Query]) -> Check:
        """Measure the second answers: the first ones may load libraries."""
        name = "time and memory"
        seconds = [self.second[query.query_id].seconds or 0.0 for query in queries]
        if not seconds:
            return Check(name=name, outcome="not applicable", found="no query to try it with")
        each_s = sum(seconds) / len(seconds)
        found = f"{each_s:.3f} s a query, {self.worker.peak_bytes / 1e6:.0f} MB at most"
        return Check(name=name, outcome="pass" if each_s < _QUICK_S else "fail", found=found)


def _fault(reply: Reply, query: Query, *, top_k: int = TOP_K) -> str | None:
    if reply.status != "ok" or reply.match is None:
        return f"{reply.status}: {reply.message}"
    try:
        check_match(reply.match, query, top_k=top_k)
    except MatchError as error:
        return str(error)
    return None


def _other(reply: Reply) -> str:
    return "has another answer" if reply.status == "ok" else f"has none ({reply.status}: {reply.message})"


class _NotApplicable(Exception):  # noqa: N818 - no error: the check does not concern this matcher
    """The check does not concern this matcher or query."""
