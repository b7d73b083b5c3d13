# SPDX-License-Identifier: Apache-2.0
"""One matcher in one process, seen from outside: started, asked, watched, and ended when it must be."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

import psutil

import sasgeo_bench.run.child
from sasgeo_bench.errors import MatchError
from sasgeo_bench.matcher import Match, MatcherCard, check_learned
from sasgeo_bench.pose import Pose
from sasgeo_bench.query import Truth
from sasgeo_bench.results import Status, one_line
from sasgeo_bench.run import wire
from sasgeo_bench.run.beside import walk_code
from sasgeo_bench.store.taskrows import pairs_bytes

WATCH_S: Final = 0.05  # how often memory is looked at
_KEPT_BYTES: Final = 4000  # of what a matcher prints
_START_S: Final = 120.0
_PASSED_ON: Final = ("LANG", "LC_ALL", "TZ")


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What a matcher may take.

    Parameters
    ----------
    match_s, prepare_s, learn_s : float
        Seconds by the clock for one query, for one map, and for whatever is learnt at once.
    memory_bytes : int
        Of all its processes together, resident; and of the address space of each.
    file_bytes : int
        Of one file in its scratch folder.
    """

    match_s: float = 30.0
    prepare_s: float = 600.0
    learn_s: float = 900.0
    memory_bytes: int = 4 * 10**9
    file_bytes: int = 2**30


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """What a matcher may read, what is hidden from it, and whether it is shut in at all."""

    readable: Sequence[Path]
    hidden: Sequence[Path]
    is_shut_in: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What came of a question: a status, a line that says why, seconds and processor seconds inside, the answer.

    Of a plugin that was loaded: its card, a hash of its code, and whether it has a `learn`; of a map: by how much
    memory grew; of a lesson: what was learnt.
    """

    status: Status
    message: str = ""
    seconds: float | None = None
    cpu_s: float = 0.0
    match: Match | None = None
    card: MatcherCard | None = None
    code: str = ""
    learns: bool = False
    grown_bytes: int | None = None
    learned: str | None = None


@dataclass(kw_only=True)
class Worker:
    """A matcher's process; a new one is started whenever the last one has ended.

    Use it in a `with` block: at its end nothing of it is left, neither processes nor files.

    Examples
    --------
    >>> Limits().match_s
    30.0
    """

    spec: str
    reach: Reach
    limits: Limits
    isolation: dict[str, str] = field(default_factory=dict)
    peak_bytes: int = 0
    starts: int = 0
    _process: subprocess.Popen[bytes] | None = None
    _channel: socket.socket | None = None
    _printed: deque[bytes] = field(default_factory=deque)
    _scratch: Path | None = None
    _region: Path | None = None
    _learned: str | None = None

    def __enter__(self) -> Self:
        """Start nothing yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process."""
        self.end()

    def load(self) -> Reply:
        """Import the plugin."""
        return self._ask({"kind": "load"}, timeout_s=self.limits.prepare_s)

    def learn(self, regions: Mapping[str, Path], pairs: Iterable[tuple[bytes, Truth]]) -> Reply:
        """Learn from queries, each a row in Arrow's stream format, and their truths, on maps by their names."""
        sizes, blob = pairs_bytes(pairs)
        maps = {name: str(path.resolve()) for name, path in regions.items()}
        message = {"kind": "learn", "regions": maps, "query_bytes": sizes}
        return self._ask(message, blob, timeout_s=self.limits.learn_s)

    def prepare(self, region: Path, learned: str | None = None) -> Reply:
        """Index a map, with what was learnt before."""
        self._region, self._learned = region, learned
        message = {"kind": "prepare", "region": str(region.resolve()), "learned": learned}
        reply = self._ask(message, timeout_s=self.limits.prepare_s)
        if reply.status != "ok":
            self.end()
        return reply

    def match(self, query: bytes, *, top_k: int) -> Reply:
        """Ask one query, a row in Arrow's stream format, on the map prepared last."""
        if self._process is None and self._region is not None:
            again = self.prepare(self._region, self._learned)
            if again.status != "ok":
                return again
        reply = self._ask({"kind": "match", "top_k": top_k}, query, timeout_s=self.limits.match_s)
        if reply.status in {"timeout", "crash"} and self._is_gone():
            self.end()
        return reply

    def _is_gone(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def _ask(self, message: dict[str, Any], blob: bytes = b"", *, timeout_s: float) -> Reply:
        try:
            channel = self._started()
            wire.send(channel, message, blob)
            answer = self._wait(channel, timeout_s)
        except wire.Late:
            self.end()
            return Reply(status="timeout", message=f"no answer within {timeout_s:g} s")
        except wire.Closed as closed:
            reply = Reply(status="crash", message=self._last_words(str(closed)))
            self.end()
            return reply
        except _TooLarge as large:
            self.end()
            return Reply(status="crash", message=str(large))
        try:
            return _reply_of(answer)
        except (MatchError, ValueError, TypeError, KeyError, OverflowError) as error:
            self.end()
            return Reply(status="invalid", message=one_line(f"an answer that is none: {error}"))

    def _wait(self, channel: socket.socket, timeout_s: float) -> dict[str, Any]:
        """Wait for an answer, looking at the memory meanwhile."""
        deadline = time.monotonic() + timeout_s
        while True:
            step = min(deadline, time.monotonic() + WATCH_S)
            try:
                # Only the wait for the first byte is cut into steps.
                if wire.is_waiting(channel, step):
                    return wire.receive(channel, deadline=deadline, most_bytes=wire.MOST_BYTES)[0]
            finally:
                self._watch()
            if time.monotonic() >= deadline:
                raise wire.Late

    def _watch(self) -> None:
        """Sum the resident memory of the process and all that came from it."""
        if self._process is None:
            return
        try:
            root = psutil.Process(self._process.pid)
            family = [root, *root.children(recursive=True)]
        except psutil.Error:
            return
        total = _memory_bytes(family, shared=True)
        if total > self.limits.memory_bytes:  # what forked processes share counts once, which takes longer to find out
            total = _memory_bytes(family, shared=False)
        self.peak_bytes = max(self.peak_bytes, total)
        if total > self.limits.memory_bytes:
            raise _TooLarge(total, self.limits.memory_bytes)

    def _started(self) -> socket.socket:
        if self._channel is not None and not self._is_gone():
            return self._channel
        self.end()
        ours, theirs = socket.socketpair()
        self._scratch = Path(tempfile.mkdtemp(prefix="sasgeo-matcher-"))
        command = [sys.executable, "-P", "-m", sasgeo_bench.run.child.__name__, str(theirs.fileno())]
        self._process = subprocess.Popen(  # noqa: S603 - our own module, by our own interpreter
            command,
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=_environment(self._scratch),
            start_new_session=True,
        )
        theirs.close()
        self._printed = deque()
        threading.Thread(target=_drain, args=(self._process.stdout, self._printed), daemon=True).start()
        self._channel = ours
        self.starts += 1
        policy = None
        if self.reach.is_shut_in:
            code = _code()
            beside = walk_code(code)
            hidden = [*map(str, self.reach.hidden), *beside.hidden([*code, *self.reach.readable])]
            policy = {
                "readable": [str(path) for path in (*code, *self.reach.readable)],
                "writable": [str(self._scratch)],
                "hidden": list(dict.fromkeys(hidden)),
                "unsearched": beside.unsearched,
                "memory_bytes": self.limits.memory_bytes + 2 * 2**30,  # libraries reserve what they never touch
                "file_bytes": self.limits.file_bytes,
            }
        paths = [os.getcwd(), *filter(None, sys.path)]  # noqa: PTH109
        start = {"spec": self.spec, "policy": policy, "scratch": str(self._scratch), "paths": paths}
        wire.send(ours, start)
        said, _ = wire.receive(ours, deadline=time.monotonic() + _START_S, most_bytes=wire.MOST_BYTES)
        self.isolation = {str(name): one_line(str(words)) for name, words in dict(said.get("isolation", {})).items()}
        return ours

    def _last_words(self, closed: str) -> str:
        """How a process ended, and the last line it printed."""
        code = None
        if self._process is not None:
            try:
                code = self._process.wait(timeout=10)  # on a busy machine an end takes its time
            except subprocess.TimeoutExpired:
                code = None
        how = closed
        if code is not None:
            how = f"died by {_signal_name(-code)}" if code < 0 else f"ended with exit status {code}"
        lines = b"".join(self._printed).decode(errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "")
        return one_line(f"{how}: {last}" if last else how)

    def end(self) -> None:
        """End the process and all that came from it, and remove its scratch folder."""
        if self._channel is not None:
            self._channel.close()
        if self._process is not None:
            _kill_family(self._process)
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)
        self._process, self._channel, self._scratch = None, None, None


def _signal_name(number: int) -> str:
    """Name of a signal; those of real time have a number alone."""
    known = {item.value: item.name for item in signal.Signals}
    return known.get(number, f"signal {number}")


class _TooLarge(Exception):  # noqa: N818 - a limit, told as a row's message
    def __init__(self, found: int, most: int) -> None:
        super().__init__(f"{found / 1e6:.0f} MB of memory, at most {most / 1e6:.0f} are allowed")


def _memory_bytes(family: Sequence[psutil.Process], *, shared: bool) -> int:
    """Resident memory of some processes; pages they share count for each of them, or in shares."""
    total = 0
    for process in family:
        try:
            total += process.memory_info().rss if shared else process.memory_full_info().pss
        except psutil.Error:
            continue
    return total


def _reply_of(answer: Mapping[str, Any]) -> Reply:
    """An answer taken apart with care: the process it comes from is not trusted."""
    status, message = str(answer["status"]), one_line(str(answer.get("message", "")))
    if status != "ok":
        known: dict[str, Status] = {"crash": "crash", "invalid": "invalid", "refused": "refused"}
        return Reply(status=known.get(status, "invalid"), message=message)
    seconds = answer.get("seconds")
    seconds = None if seconds is None else max(0.0, float(seconds))
    row = answer.get("match")
    if row is None:
        card = answer.get("card")
        return Reply(
            status="ok",
            seconds=seconds,
            card=None if card is None else _card_of(card),
            code=str(answer.get("code", "")),
            learns=answer.get("learns") is True,
            grown_bytes=int(answer.get("grown_bytes", 0)),
            learned=check_learned(answer["learned"]) if "learned" in answer else None,
        )
    numbers = [[float(value) for value in candidate] for candidate in row["candidates"]]
    poses = [Pose(easting_m=x, northing_m=y, yaw_deg=yaw, scale=scale) for x, y, yaw, scale, _ in numbers]
    match = Match(
        poses=poses,
        scores=[candidate[4] for candidate in numbers],
        confidence=None if row["confidence"] is None else float(row["confidence"]),
        diagnostics={str(name): float(value) for name, value in dict(row["diagnostics"]).items()},
    )
    return Reply(status="ok", seconds=seconds, cpu_s=max(0.0, float(answer["cpu_s"])), match=match)


def _card_of(said: Mapping[str, Any]) -> MatcherCard:
    """A card as it came, held to what a card must be."""
    lists = ("tracks", "needs", "trained_on")
    fields: dict[str, Any] = {name: tuple(value) if name in lists else value for name, value in said.items()}
    return MatcherCard(**fields)


def _environment(scratch: Path) -> dict[str, str]:
    """Next to nothing: no folder of ours, no key, no proxy; one thread, so that latencies can be compared."""
    kept = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
    own = {"PATH": "/usr/bin:/bin", "HOME": str(scratch), "TMPDIR": str(scratch), "PYTHONHASHSEED": "0"}
    return {**kept, **threads, **own, "PYTHONDONTWRITEBYTECODE": "1"}


def _code() -> list[Path]:
    """Where the interpreter and everything importable lies."""
    found = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.executable), Path(os.getcwd())]  # noqa: PTH109
    found += [Path(entry) for entry in sys.path if entry]
    found.append(Path(sasgeo_bench.run.child.__file__).parents[2] / "sasgeo_bench")
    return [path for path in dict.fromkeys(found) if path.exists()]


def _drain(stream: IO[bytes] | None, printed: deque[bytes]) -> None:
    """Read what a process prints, so that it never waits for us, and keep the end of it."""
    if stream is None:
        return
    while part := stream.read1(65536):  # type: ignore[attr-defined]
        printed.append(part[-_KEPT_BYTES:])
        while sum(map(len, printed)) > 2 * _KEPT_BYTES and len(printed) > 1:
            printed.popleft()


def _kill_family(process: subprocess.Popen[bytes]) -> None:
    """Kill a process, its session, and whatever it started elsewhere."""
    try:
        family = psutil.Process(process.pid).children(recursive=True)
    except psutil.Error:
        family = []
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.kill()
    for member in family:
        try:
            member.kill()
        except psutil.Error:
            continue
    process.wait()
