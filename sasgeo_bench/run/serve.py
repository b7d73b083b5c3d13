# SPDX-License-Identifier: Apache-2.0
"""What a matcher's process does once it is shut in: load, prepare, match; every failure becomes a message."""

import errno
import hashlib
import socket
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import psutil

from sasgeo_bench.errors import MatchError
from sasgeo_bench.matcher import Match, Matcher, check_match
from sasgeo_bench.plugins import load_matcher
from sasgeo_bench.results import one_line, told
from sasgeo_bench.run import wire
from sasgeo_bench.store.regiondir import read_region
from sasgeo_bench.store.taskrows import query_from

_REFUSED: Final = frozenset({errno.EACCES, errno.EPERM, errno.EROFS, errno.ENETUNREACH, errno.EHOSTUNREACH})


class Server:
    """Answers messages until the runner has gone."""

    def __init__(self, channel: socket.socket, *, spec: str) -> None:
        self.channel = channel
        self.spec = spec
        self.matcher: Matcher | None = None

    def run(self) -> None:
        """Serve until the other side closes."""
        while True:
            try:
                message, blob = wire.receive(self.channel)
            except wire.Closed:
                return
            try:
                answer = self._answer(message, blob)
            except MatchError as error:
                answer = {"status": "invalid", "message": one_line(str(error))}
            except MemoryError:
                answer = {"status": "crash", "message": "out of memory"}
            except OSError as error:
                status = "refused" if error.errno in _REFUSED else "crash"
                answer = {"status": status, "message": told(error)}
            except Exception as error:  # noqa: BLE001 - whatever a plugin raises costs its own row
                answer = {"status": "crash", "message": told(error)}
            wire.send(self.channel, answer)

    def _answer(self, message: dict[str, Any], blob: bytes) -> dict[str, Any]:
        if message["kind"] == "load":
            self.matcher = load_matcher(self.spec)
            return {"status": "ok", "card": asdict(self.matcher.card), "code": code_hash(self.matcher)}
        if self.matcher is None:
            self.matcher = load_matcher(self.spec)
        if message["kind"] == "prepare":
            region = read_region(Path(message["region"]))
            before, start = _resident_bytes(), time.perf_counter()
            self.matcher.prepare(region, None)
            seconds = time.perf_counter() - start
            return {"status": "ok", "seconds": seconds, "grown_bytes": max(0, _resident_bytes() - before)}
        query = query_from(blob)
        start, start_cpu = time.perf_counter(), time.process_time()
        found = self.matcher.match(query, top_k=message["top_k"])
        seconds, cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
        return {
            "status": "ok",
            "seconds": seconds,
            "cpu_s": cpu_s,
            "match": match_row(check_match(found, query, top_k=message["top_k"])),
        }


def code_hash(matcher: Matcher) -> str:
    """SHA-256 of the file a matcher's class is in and of all Python files beside and below it, by their names.

    Examples
    --------
    >>> class Mine: ...
    >>> len(code_hash(Mine()))
    64
    """
    module = sys.modules.get(type(matcher).__module__)
    name = getattr(module, "__file__", None)
    digest = hashlib.sha256()
    if name is None:
        return digest.hexdigest()
    own = Path(name)
    is_package = "." in type(matcher).__module__ or own.name == "__init__.py"
    files = sorted(own.parent.rglob("*.py")) if is_package else [own]
    for path in files:
        digest.update(path.relative_to(own.parent).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _resident_bytes() -> int:
    return int(psutil.Process().memory_info().rss)


def match_row(match: Match) -> dict[str, Any]:
    """A checked answer as plain numbers."""
    return {
        "candidates": [
            [pose.easting_m, pose.northing_m, pose.yaw_deg, pose.scale, score]
            for pose, score in zip(match.poses, match.scores, strict=True)
        ],
        "confidence": match.confidence,
        "diagnostics": dict(match.diagnostics),
    }
