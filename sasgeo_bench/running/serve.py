# SPDX-License-Identifier: Apache-2.0
"""Serve a runner for a matcher or a tracker, inside the sandbox: load, learn, prepare, match or step."""

import os
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.matching.follower import Follower
from sasgeo_bench.matching.matcher import (
    Matcher,
    Training,
    check_match,
    is_followed,
)
from sasgeo_bench.matching.plugins import load_method
from sasgeo_bench.matching.tracker import ROW, Tracker, check_fix, match_of, row_of
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.running.server import Answer, Clock, PluginServer
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.task_files import pairs_from, query_from

if TYPE_CHECKING:
    from sasgeo_bench.geometry.grid import Grid

MOST_MAPS: Final = 2  # cached while a matcher trains


class Server(PluginServer[Matcher | Tracker]):
    """Answers for a matcher, or a tracker."""

    _grid: "Grid | None" = None
    _follower: Tracker | None = None

    def _make(self) -> Matcher | Tracker:
        return load_method(self.spec)

    def _learn(self, blob: bytes, *, regions: Mapping[str, str], query_bytes: Sequence[int]) -> Answer:
        maps = Maps({name: Path(folder) for name, folder in regions.items()})
        return self._learned(Training(regions=maps, pairs=tuple(pairs_from(query_bytes, blob))))

    def _prepare(self, _: bytes, *, region: str, learned: str | None, is_kept: bool = False) -> Answer:
        reading, looking, matcher = _Cost(), _Cost(), self.plugin
        place = read_region(Path(region), around=lambda: reading, around_layer=lambda: looking, with_layers=False)
        self._grid = place.grid

        def keep(what: str, settings: Mapping[str, Any]) -> Path | None:
            """Ask for what is kept of the map; its time is none of the matcher's."""
            with looking:
                said = self._wants({"what": what, "settings": settings, "digest": place.manifest.digest})
            folder = Path(str(said["folder"])) if said["folder"] else None
            return folder if folder is not None and folder.is_dir() else None  # gone meanwhile, or not shown

        if is_kept:
            vars(place)["keep"] = keep
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
        pages = int(plain_file(Path("/proc/self/statm")).read_text(encoding="ascii").split()[1])
    except OSError:  # no Linux
        import psutil  # noqa: PLC0415 - takes longer to import than a town to prepare

        return int(psutil.Process().memory_info().rss)
    return pages * os.sysconf("SC_PAGE_SIZE")
