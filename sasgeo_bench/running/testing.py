# SPDX-License-Identifier: Apache-2.0
"""The conformance kit: rules that plugins keep, checked on tiny maps under the limits of a run; those of matchers."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Generic, Literal, TypeVar

import numpy as np

from sasgeo_bench.core.errors import MatchError, counted
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import MATCHERS, check_card_name
from sasgeo_bench.core.progress import reporting, silent
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.matching.matcher import MatcherCard, Prediction, candidates_at, lacks
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.matching.tracker import check_prediction
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.running.worker import Found, Limits, PluginProcess, PluginReply, Reach, Reply, Worker
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.query import SEQUENCE, Query, Truth
from sasgeo_bench.tasks.suites.base import EVERYTHING, Choice
from sasgeo_bench.tasks.task_files import query_bytes
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

Outcome = Literal["pass", "fail", "not applicable"]
AnyCard = TypeVar("AnyCard", MatcherCard, SegmenterCard)
Item = TypeVar("Item")  # a query, a flight, or an image

LEARNS: Final = "learns, the same text twice"  # a row of those that have a learn()
TOWN: Final = "town-agricultural"  # the smallest that has room for candidates
TOP_K: Final = 10
_MOST_NAMED: Final = 3
_EDGE_SHARE: Final = 0.3
_QUICK_S: Final = 5.0


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
        except (Exception, SystemExit) as error:  # noqa: BLE001 - see above
            fault = message_of(error)
        yield check_of(name, fault, found)


class NotApplicable(Exception):  # noqa: N818 - no error: the rule does not concern this plugin
    """The rule does not concern this plugin or item."""


@dataclass(kw_only=True)
class Kit(ABC, Generic[AnyCard, Found, Item]):
    """Rules that all plugins keep, and those that a kind adds: tried on a few items, each under a label.

    `folder` holds all that the plugin may read, and must leave alone.
    """

    one: ClassVar[str] = "a query"
    many: ClassVar[str] = "queries"
    group: ClassVar[str]
    first_rule: ClassVar[str]  # name of that which every answer keeps

    process: PluginProcess[AnyCard, Found]
    folder: Path
    card: AnyCard = field(init=False)
    learns: bool = False
    learned: str | None = None
    refused: str = ""
    first: dict[str, PluginReply[AnyCard, Found]] = field(default_factory=dict)
    second: dict[str, PluginReply[AnyCard, Found]] = field(default_factory=dict)

    @abstractmethod
    def ask(self, item: Item) -> PluginReply[AnyCard, Found]:
        """Ask about an item."""

    @abstractmethod
    def checks(self) -> Iterator[Check]:
        """Yield the rows of the kind."""

    @abstractmethod
    def fault(self, label: str, item: Item, reply: PluginReply[AnyCard, Found]) -> str | None:
        """Return what is unsound in an answer."""

    def table(self) -> Iterator[Check]:
        """Yield all rows, as far as the plugin comes."""
        before = _listing(self.folder)
        loaded = self.process.load()
        yield (first := self._loaded(loaded))
        if loaded.card is None or first.outcome == "fail":
            return
        self.card, self.learns = loaded.card, loaded.learns
        yield from self.checks()
        after = _listing(self.folder)
        changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
        fault = f"wrote among maps and tasks: {', '.join(changed[:_MOST_NAMED])}" if changed else ""
        fault = f"was refused what it asked for: {self.refused}" if self.refused else fault
        limited = self.process.isolation.get("files_changed", "")
        found = limited or "not shut in: looked for files among maps and tasks alone"
        yield check_of("kept to its scratch folder", fault, found)

    def _loaded(self, reply: PluginReply[AnyCard, Found]) -> Check:
        """Check that the plugin was loaded, and that its card has a name of its own."""
        name = "loads, and has a card"
        if reply.status != "ok" or reply.card is None:
            return Check(name=name, outcome="fail", found=reply.message)
        try:
            check_card_name(self.process.spec, reply.card.name, group=self.group_of(reply.card))
        except MatchError as error:
            return Check(name=name, outcome="fail", found=str(error))
        return Check(name=name, outcome="pass", found=f"{reply.card.name} {reply.card.version}")

    def group_of(self, card: AnyCard) -> str:
        """Return the group whose names the card's must not be."""
        del card
        return self.group

    def noted(self, reply: PluginReply[AnyCard, Found]) -> PluginReply[AnyCard, Found]:
        """Return a reply, after a note of what its process was refused."""
        self.refused = self.refused or (reply.message if reply.status == "refused" else "")
        return reply

    def lessons(
        self, learn: Callable[[], PluginReply[AnyCard, Found]], few: Mapping[str, Item], given: str
    ) -> Iterator[Check]:
        """Train twice, each time in a process of its own, and ask about a few items without; keep the text."""
        replies = []
        for _ in range(2):
            self.process.end()
            replies.append(self.noted(learn()))
        self.process.end()
        lost = next((reply for reply in replies if reply.learned is None), None)
        fault = "another text the second time" if lost is None and len({one.learned for one in replies}) > 1 else ""
        fault = fault if lost is None else f"{lost.status}: {lost.message}"
        size = len((replies[0].learned or "").encode())
        yield check_of(LEARNS, fault, f"{size} bytes from {given}, {replies[0].seconds or 0.0:.2f} s")
        name = "answers without training"
        if "training" in self.card.needs:
            yield Check(name=name, outcome="not applicable", found="the card needs training")
        else:
            ready = self.noted(self.prepare())
            faults = (self.fault(label, item, self.ask(item)) for label, item in few.items())
            lack = next(filter(None, faults), None) if ready.status == "ok" else f"{ready.status}: {ready.message}"
            yield check_of(name, lack and f"learned = None: {lack}", self.count(len(few)))
        self.process.end()
        self.learned = replies[0].learned

    def prepare(self) -> PluginReply[AnyCard, Found]:
        """Make the plugin ready for what is asked."""
        return PluginReply(status="ok")

    def count(self, number: int) -> str:
        """Return a number of items in words."""
        return counted(number, self.one.partition(" ")[2], self.many)

    def over(
        self, name: str, items: Mapping[str, Item], rule: Callable[[str, Item], str | None], *, more: str = ""
    ) -> Check:
        """Try a rule, which returns a fault, on items; the first fault counts."""
        tried, fault = 0, None
        for label, item in items.items():
            try:
                fault = rule(label, item)
            except NotApplicable:
                continue
            tried += 1
            if fault is not None:
                break
        return check_of(name, fault, self.count(tried) + more) if tried else self._untried(name)

    def _untried(self, name: str) -> Check:
        return Check(name=name, outcome="not applicable", found=f"no {self.one.partition(' ')[2]} to try it with")

    def answers(self, items: Mapping[str, Item], *, summary: Callable[[], str] = str) -> Check:
        """Ask about every item twice in a row, and keep the answers; report an unsound first answer once."""
        faults = []
        for label, item in items.items():
            self.first[label] = self.ask(item)
            fault = self.fault(label, item, self.first[label])
            if fault is None:
                self.second[label] = self.ask(item)
            else:
                faults.append(fault)
        number = self.count(len(items))
        return check_of(
            self.first_rule, f"{faults[0]} ({len(faults)} of {number})" if faults else None, summary() or number
        )

    def sound(self, items: Mapping[str, Item]) -> dict[str, Item]:
        """Return the items of which the first answer was sound."""
        return {label: item for label, item in items.items() if label in self.second}

    def other(self, label: str, reply: PluginReply[AnyCard, Found], when: str) -> str | None:
        """Return how an answer differs from the first about an item; None if it does not."""
        if reply.found is None:
            return f"{label} has none ({reply.status}: {reply.message}) {when}"
        return None if self.is_same(self.first[label].found, reply.found) else f"{label} has another answer {when}"

    def is_same(self, first: Found | None, other: Found) -> bool:
        """Return whether two answers are one."""
        return first == other

    def twice(self, label: str, item: Item) -> str | None:
        """Return how the second answer differs from the first."""
        del item
        return self.other(label, self.second[label], "the second time")

    def order(self, items: Mapping[str, Item]) -> Check:
        """Check that an answer depends neither on earlier items nor on the start of the process."""
        steady = {label: item for label, item in items.items() if self.twice(label, item) is None}
        self.process.end()
        again = {label: self.ask(item) for label, item in reversed(steady.items())}

        def differs(label: str, _: Item) -> str | None:
            return self.other(label, again[label], "after others, in a fresh process")

        name = "the same answers in any order"
        return self.over(name, steady, differs, more=" both ways, in two processes")

    def cost(self) -> Check:
        """Measure the second answers: the first ones may load libraries."""
        seconds = [reply.seconds or 0.0 for reply in self.second.values()]
        return self.quick(seconds, f"{np.mean(seconds):.3f} s {self.one}") if seconds else self._untried(_COST)

    def quick(self, seconds: Sequence[float], words: str) -> Check:
        """Check that answers take seconds, and say how much memory they took."""
        found = f"{words}, {self.process.peak_bytes / 1e6:.0f} MB at most"
        return check_of(_COST, None if np.mean(seconds) < _QUICK_S else f"{found}: more than {_QUICK_S:g} s", found)


_COST: Final = "time and memory"


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """List everything below a folder, files with size and time of writing."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    status = {name: path.stat() for name, path in found.items() if path.is_file()}
    return {name: (status[name].st_size, status[name].st_mtime_ns) if name in status else (0, 0) for name in found}


@dataclass(frozen=True, slots=True, kw_only=True)
class TinyMap:
    """A synthetic place; `folder` holds regions/, tasks/ and truth/, as `make-queries` writes them."""

    folder: Path
    region: Region

    @property
    def map_folder(self) -> Path:
        """Return the folder of the map."""
        return self.folder / "regions" / self.region.manifest.id

    def worker(self, spec: str, *, limits: Limits | None, is_sandboxed: bool) -> Worker:
        """Return a process that may read the map alone."""
        hidden = [(self.folder / name).resolve() for name in ("truth", "tasks")]
        reach = Reach(readable=[self.map_folder.resolve()], hidden=hidden, is_sandboxed=is_sandboxed)
        return Worker(spec=spec, reach=reach, limits=limits or Limits())


@dataclass(frozen=True, slots=True, kw_only=True)
class TinyPlace(TinyMap):
    """A synthetic place of 1 km2, made by `tiny_place`: its map, queries, and their truths in the same order.

    `folder` holds regions/, tasks/ and truth/, as `make-queries` writes them. The queries are of both tracks, some with
    vectors, some without any prior.
    """

    queries: tuple[Query, ...]
    truths: tuple[Truth, ...]

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
    region, pairs = draw(Path(path), TOWN, ("clean", "no-priors"))
    queries, truths = zip(*pairs, strict=True)
    return TinyPlace(folder=Path(path), region=region, queries=queries, truths=truths)


def draw(
    folder: Path, town: str, suites: tuple[str, ...], choice: Choice = EVERYTHING
) -> tuple[Region, list[tuple[Query, Truth]]]:
    """Build a made-up town and draw a few queries on it; return its map, and the queries with their truths."""
    wanted = TaskRequest(
        suites=suites,
        regions=(town,),
        split="crossfit",
        count=1,
        seed=1,
        out=folder,
        may_be_fewer=True,
        choice=choice,
    )
    with reporting(silent):
        build_region(plan_build(read_region_file(find_region_file(town)), out=folder))
        made = [task for request in plan_requests(wanted) for task in make_tasks(request)]
    pairs = [pair for task in made for pair in zip(task.queries(), task.truths, strict=True)]
    return read_region(folder / "regions" / town), pairs


def unseen(query: Query) -> Evidence:
    """Return the evidence of a view on which nothing is seen."""
    return query.evidence.replace(np.full_like(query.evidence.cells, UNKNOWN))


def check_matcher(
    spec: str, *, limits: Limits | None = None, place: TinyPlace | None = None, is_sandboxed: bool = True
) -> Iterator[Check]:
    """Try a matcher, given by name or module:Class, on a tiny place; yield a row for each rule.

    `place` can be shared by several matchers. Without `is_sandboxed`, trusted code runs without isolation, as in
    `run --trusted`. Rules about what the card excludes are not applicable. A query without a sound answer counts in the
    first row only.
    """
    with ExitStack() as stack:
        if place is None:
            place = tiny_place(stack.enter_context(scratch_folder("check")))
        worker = stack.enter_context(place.worker(spec, limits=limits, is_sandboxed=is_sandboxed))
        yield from _MatcherKit(process=worker, folder=place.folder, worker=worker, place=place).table()


@dataclass(kw_only=True)
class MapKit(Kit[MatcherCard, Prediction, Item]):
    """Rules of those that search a map."""

    worker: Worker
    place: TinyMap

    def prepare(self) -> Reply:
        """Index the map, given what was learned."""
        return self.worker.prepare(self.place.map_folder, self.learned)

    def checks(self) -> Iterator[Check]:
        """Yield the row of the map, and the others if it could be prepared."""
        ready = self.noted(self.prepare())
        found = ready.message if ready.seconds is None else f"{ready.seconds:.2f} s"
        yield Check(name="prepares a map", outcome="pass" if ready.status == "ok" else "fail", found=found)
        if ready.status == "ok":
            yield from self.rules()

    @abstractmethod
    def rules(self) -> Iterator[Check]:
        """Yield the rows about answers."""


@dataclass(kw_only=True)
class _MatcherKit(MapKit[Query]):
    group: ClassVar[str] = MATCHERS
    first_rule: ClassVar[str] = "shapes, order and finite scores"

    place: TinyPlace

    def checks(self) -> Iterator[Check]:
        if self.learns:
            yield from self._lessons()
        yield from super().checks()

    def _lessons(self) -> Iterator[Check]:
        maps = {self.place.region.manifest.id: self.place.map_folder}
        blobs = [query_bytes(query) for query in self.place.queries]
        able = _labelled(query for query in self.place.queries if self._lacks(query) is None)
        return self.lessons(
            lambda: self.worker.learn(maps, zip(blobs, self.place.truths, strict=True)),
            _one_of_each_track(able),
            self.count(len(blobs)),
        )

    def rules(self) -> Iterator[Check]:
        able = _chosen(query for query in self.place.queries if self._lacks(query) is None)
        if not able:
            is_tracker = self.card.tracks == (SEQUENCE,)
            fault = "it follows flights: check it as a tracker (--kind tracker)"
            found = fault if is_tracker else "the card's needs leave no query"
            yield Check(name="answers a query", outcome="fail" if is_tracker else "not applicable", found=found)
            return
        yield self.answers(able)
        sound = self.sound(able)
        named: tuple[tuple[str, Callable[[str, Query], str | None], Mapping[str, Query]], ...] = (
            ("the same answer twice", self.twice, sound),
            ("no more than top_k", self._top_k, sound),
            ("needs no more than its card says", self._less, _one_of_each_track(sound)),  # searching everywhere is slow
            ("withholds where all is unknown", self._unknown, sound),
            ("answers where the place is absent", self._absent, sound),
            ("a moved prior moves the answer", self._moved, sound),
            ("equal candidates tie", self._ties, sound),
        )
        for name, rule, queries in named:
            yield self.over(name, queries, rule)
        yield self.order(sound)
        yield self.cost()

    def _lacks(self, query: Query) -> str | None:
        return lacks(self.card, query, is_taught=self.learned is not None, is_pictured=self.place.is_pictured)

    def ask(self, item: Query, *, top_k: int = TOP_K) -> Reply:
        return self.noted(self.worker.match(query_bytes(item), top_k=top_k))

    def fault(self, label: str, item: Query, reply: Reply, *, top_k: int = TOP_K) -> str | None:
        del label
        if reply.found is None:
            return f"{reply.status}: {reply.message}"
        try:
            check_prediction(reply.found, item, top_k=top_k)
        except MatchError as error:
            return str(error)
        return None

    def _top_k(self, label: str, query: Query) -> str | None:
        return self.fault(label, query, self.ask(_changed(query, "top_k"), top_k=1), top_k=1)

    def _less(self, label: str, query: Query) -> str | None:
        """Ask without the disc, or without the heading, where the card does not need it."""
        prior = query.prior
        bare = {
            "a disc": replace(prior, center_m=None, radius_m=None),
            "a heading": replace(prior, yaw_deg=None, yaw_sigma_deg=None),
        }
        asked = [(what, _changed(query, what, prior=less)) for what, less in bare.items() if less != prior]
        able = [(what, less) for what, less in asked if self._lacks(less) is None]
        if not able:
            raise NotApplicable
        faults = ((what, self.fault(label, less, self.ask(less))) for what, less in able)
        return next((f"without {what}: {fault}" for what, fault in faults if fault is not None), None)

    def _unknown(self, _: str, query: Query) -> str | None:
        blind = _changed(query, "unknown", evidence=unseen(query), vectors=None, frames=())
        if self._lacks(blind) is not None:
            raise NotApplicable
        reply = self.ask(blind)
        if reply.found is None:
            return f"{reply.status}: {reply.message}"
        withheld = not reply.found.candidates or reply.found.confidence == 0.0
        return None if withheld else "answers although nothing was seen: return matcher.WITHHELD"

    def _absent(self, _: str, query: Query) -> str | None:
        if query.prior.center_m is None or query.prior.radius_m is None:
            raise NotApplicable
        x, y = query.prior.center_m
        away = replace(query.prior, center_m=(x + 10 * query.prior.radius_m, y))
        reply = self.ask(_changed(query, "absent", prior=away))
        return None if reply.status == "ok" else f"{reply.status} with a disc beyond the map: {reply.message}"

    def _moved(self, _: str, query: Query) -> str | None:
        if query.track != "localization" or query.prior.center_m is None:
            raise NotApplicable
        west_m, south_m, east_m, north_m = self.place.region.grid.bounds_m
        places = []
        for share in (_EDGE_SHARE, 1 - _EDGE_SHARE):
            center_m = (west_m + share * (east_m - west_m), (south_m + north_m) / 2)
            # 100 m: radius of two discs that do not meet, each so far from the edge of the map:
            prior = replace(query.prior, center_m=center_m, radius_m=100.0)
            reply = self.ask(_changed(query, f"moved {share:g}", prior=prior))
            if reply.found is None:
                return f"{reply.status} with a small disc: {reply.message}"
            places.append([(pose.easting_m, pose.northing_m) for pose, _ in reply.found.candidates])
        if not all(places):
            raise NotApplicable
        return "the same answer in two discs that do not meet" if places[0] == places[1] else None

    def _ties(self, _: str, query: Query) -> str | None:
        if query.track != "retrieval":
            raise NotApplicable
        # The same place twice: a scorer that looks at the map alone cannot separate them.
        one, other = query.candidates[:2]
        reply = self.ask(_changed(query, "ties", candidates=(one, other, one)))
        if reply.found is None:
            return f"{reply.status}: {reply.message}"
        scores = {score for pose, score in reply.found.candidates if candidates_at(pose, (one,))}
        return None if len(scores) <= 1 else f"two scores for one place: {sorted(scores)}"


def _labelled(queries: Iterable[Query]) -> dict[str, Query]:
    return {f"query {query.query_id[:8]}": query for query in queries}


def _chosen(queries: Iterable[Query]) -> dict[str, Query]:
    """Choose a few queries of each kind: first those with a prior, and the smallest views."""
    kinds: dict[tuple[str, bool], list[Query]] = {}
    for query in sorted(queries, key=lambda item: (item.prior.yaw_deg is None, item.evidence.shape, item.query_id)):
        kinds.setdefault((query.track, query.vectors is not None), []).append(query)
    return _labelled(query for kind in kinds.values() for query in kind[:2])  # queries asked of each kind


def _one_of_each_track(queries: Mapping[str, Query]) -> dict[str, Query]:
    ordered = sorted(queries.values(), key=lambda item: item.evidence.shape, reverse=True)
    return _labelled({query.track: query for query in ordered}.values())


def _changed(query: Query, what: str, **changes: Any) -> Query:  # noqa: ANN401 - any field of a query
    """Change a query, and its id: a matcher may remember its answer to an id."""
    name = hashlib.sha256(f"{query.query_id} {what}".encode()).hexdigest()[: len(query.query_id)]
    return replace(query, query_id=name, **changes)
