# SPDX-License-Identifier: Apache-2.0
"""Serve a runner inside the sandbox: load, learn, prepare, match or step; every failure becomes a message."""

import errno
import os
import socket
import time
import traceback
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, Self, TypeVar

import numpy as np
import psutil

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.texts import message_of, one_line
from sasgeo_bench.matching.follower import Follower
from sasgeo_bench.matching.matcher import (
    MOST_LEARNED_BYTES,
    Matcher,
    Training,
    check_learned,
    check_match,
    is_followed,
)
from sasgeo_bench.matching.plugins import load_method
from sasgeo_bench.matching.tracker import ROW, Tracker, check_fix, match_of, row_of
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.running import wire
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.task_files import pairs_from, query_from

if TYPE_CHECKING:
    from sasgeo_bench.geometry.grid import Grid
    from sasgeo_bench.matching.segmenter import Segmenter

Answer = tuple[wire.Message, bytes]  # to a question that was answered, and the bytes that follow it

MOST_MAPS: Final = 2  # cached while a matcher trains
_REFUSED: Final = frozenset({errno.EACCES, errno.EPERM, errno.EROFS, errno.ENETUNREACH, errno.EHOSTUNREACH})


Plugin = TypeVar("Plugin", bound="Matcher | Tracker | Segmenter")


class PluginServer(ABC, Generic[Plugin]):
    """Answers messages until the runner closes its end: each kind of question by the method of its name.

    A method is given the bytes after the question, and its fields.
    """

    most_learned_bytes = MOST_LEARNED_BYTES

    def __init__(self, channel: socket.socket, *, spec: str, luggage: bytes = b"") -> None:
        self.channel = channel
        self.spec = spec
        self.luggage = luggage.decode()
        self._made: Plugin | None = None

    def run(self) -> None:
        """Serve until the other side closes."""
        while True:
            try:
                message, blob = wire.receive(self.channel)
            except wire.Closed:
                return
            head = {"nonce": message["nonce"]}
            fields = {name: value for name, value in message.items() if name not in {"kind", "nonce"}}
            try:
                content, data = getattr(self, f"_{message['kind']}")(blob, **fields)
                answer = wire.packed({**head, "status": "ok", **content}, data)
            except Exception as error:  # noqa: BLE001 - an error of a plugin costs only its own row
                answer = wire.packed({**head, **_failure(error, plugin=self._made)})
            try:
                wire.put(self.channel, answer)
            except wire.Closed:  # the runner waited no longer
                return

    @abstractmethod
    def _make(self) -> Plugin:
        """Import and make the plugin."""

    @property
    def plugin(self) -> Plugin:
        """Return the plugin, made at the first question."""
        if self._made is None:
            self._made = self._make()
        return self._made

    def _load(self, _: bytes) -> Answer:
        return {"card": asdict(self.plugin.card), "learns": callable(getattr(self.plugin, "learn", None))}, b""

    def _learned(self, training: object) -> Answer:
        learn = getattr(self.plugin, "learn", None)
        if not callable(learn):
            raise MatchError(f"{self.plugin.card.name} has no learn()")
        with (used := Clock()):
            learned = learn(training)
        return {"seconds": used.seconds}, check_learned(learned, most_bytes=self.most_learned_bytes).encode()


class Server(PluginServer[Matcher | Tracker]):
    """Answers for a matcher, or a tracker."""

    _grid: "Grid | None" = None
    _follower: Tracker | None = None

    def _make(self) -> Matcher | Tracker:
        return load_method(self.spec)

    def _learn(self, blob: bytes, *, regions: Mapping[str, str], query_bytes: Sequence[int]) -> Answer:
        maps = Maps({name: Path(folder) for name, folder in regions.items()})
        return self._learned(Training(regions=maps, pairs=tuple(pairs_from(query_bytes, blob))))

    def _prepare(self, _: bytes, *, region: str, learned: str | None) -> Answer:
        reading, looking, matcher = _Cost(), _Cost(), self.plugin
        place = read_region(Path(region), around=lambda: reading, around_layer=lambda: looking, with_layers=False)
        self._grid = place.grid
        with (preparing := _Cost()):
            matcher.prepare(place, learned)
        # The region keeps what it read for good; a layer that was read alone is the matcher's, if it is kept.
        grown_bytes = max(0, preparing.grown_bytes - reading.grown_bytes)
        return {"seconds": preparing.seconds - reading.seconds - looking.seconds, "grown_bytes": grown_bytes}, b""

    def _match(self, blob: bytes, *, top_k: int) -> Answer:
        query, matcher = query_from(blob), self.plugin
        if isinstance(matcher, Tracker):
            return _step(matcher, query, top_k)
        if query.step is not None and is_followed(matcher.card):
            return _step(self._following(matcher), query, top_k)
        with (used := Clock()):
            match = matcher.match(query, top_k=top_k)
        return used.times(), ROW.dump_json(row_of(check_match(match, query, top_k=top_k), query.query_id))

    def _following(self, matcher: Matcher) -> Tracker:
        if self._follower is None:
            self._follower = Follower(matcher, grid=self._grid)
        return self._follower


def _step(tracker: Tracker, query: Query, top_k: int) -> Answer:
    """Answer the next view of a flight; its first one begins it."""
    if query.step is None:
        raise MatchError(f"{tracker.card.name} follows flights, and this query is a view alone")
    with (used := Clock()):
        if query.step.frame == 0:
            tracker.start(query.prior)
        found = tracker.step(query)
    fix = check_fix(found, top_k=top_k)
    covariance = None if fix.covariance is None else tuple(np.asarray(fix.covariance).ravel().tolist())
    row = replace(row_of(match_of(fix), query.query_id), is_accepted=fix.is_accepted, covariance=covariance)
    return used.times(), ROW.dump_json(row)


def _failure(error: Exception, *, plugin: object) -> wire.Message:
    """Describe an error as an answer; an unforeseen one with the last line of the plugin's package on its way."""
    if isinstance(error, MatchError):
        return {"status": "invalid", "message": one_line(str(error))}
    if isinstance(error, MemoryError):
        return {"status": "crash", "message": "out of memory"}
    is_refused = isinstance(error, OSError) and error.errno in _REFUSED
    status = "refused" if is_refused else "crash"
    package = str(type(plugin).__module__).partition(".")[0]
    lines = [
        f" ({Path(frame.f_code.co_filename).name}:{line})"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if plugin is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == package
    ]
    return {"status": status, "message": one_line("".join([message_of(error), *lines[-1:]]))}


class Clock:
    """Seconds by the clock, and of the processors, while it is entered."""

    def __init__(self) -> None:
        self.seconds, self.cpu_s = 0.0, 0.0

    def __enter__(self) -> Self:
        self._start, self._start_cpu = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._start
        self.cpu_s += time.process_time() - self._start_cpu

    def times(self) -> wire.Message:
        """Return both as part of an answer."""
        return {"seconds": self.seconds, "cpu_s": self.cpu_s}


class _Cost(Clock):
    """The same, and growth of the resident memory."""

    grown_bytes = 0

    def __enter__(self) -> Self:
        self._before = _resident_bytes()
        return super().__enter__()

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self.grown_bytes += _resident_bytes() - self._before


class Maps(Mapping[str, Region]):
    """Regions read on demand: all of a split at once would not fit into memory."""

    def __init__(self, folders: Mapping[str, Path]) -> None:
        self._folders = dict(folders)
        self._kept: OrderedDict[str, Region] = OrderedDict()

    def __getitem__(self, name: str) -> Region:
        folder = self._folders[name]
        if name not in self._kept:
            while len(self._kept) >= MOST_MAPS:
                self._kept.popitem(last=False)
            self._kept[name] = read_region(folder, with_layers=False)
        self._kept.move_to_end(name)
        return self._kept[name]

    def __contains__(self, name: object) -> bool:
        """True if there is a map of that name; reads nothing."""
        return name in self._folders

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names; reads nothing."""
        return iter(self._folders)

    def __len__(self) -> int:
        return len(self._folders)


def _resident_bytes() -> int:
    try:
        number = int(os.readlink("/proc/self"))  # noqa: PTH115 - no file, a number
    except OSError:
        number = os.getpid()
    return int(psutil.Process(number).memory_info().rss)
