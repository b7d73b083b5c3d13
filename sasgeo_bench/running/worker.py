# SPDX-License-Identifier: Apache-2.0
"""Start, ask, watch and end the process of a plugin; that of a matcher."""

import contextlib
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Annotated, Any, ClassVar, Final, Generic, Literal, Protocol, Self, TypeVar

import psutil
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, TypeAdapter, ValidationError

import sasgeo_bench.running.child
from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import check_card_name, import_paths
from sasgeo_bench.core.room import Room
from sasgeo_bench.core.texts import (
    MOST_CANDIDATES,
    MOST_MESSAGE,
    MOST_S,
    is_line,
    message_of,
    one_line,
)
from sasgeo_bench.matching.matcher import (
    MOST_CARD_TEXT,
    MOST_LEARNED_BYTES,
    MatcherCard,
    Prediction,
    Status,
    check_learned,
)
from sasgeo_bench.matching.tracker import ROW, check_prediction
from sasgeo_bench.running import sandbox, wire
from sasgeo_bench.running.channel import start_process
from sasgeo_bench.running.failures import LOG, is_disk_error, our_failure
from sasgeo_bench.running.kept import kept_of, order, shelf_of
from sasgeo_bench.running.launch import PROGRAM
from sasgeo_bench.running.leak_scan import PACKED, walk_code
from sasgeo_bench.running.memory import LEAN, WATCH_S, Group, MemoryWatch
from sasgeo_bench.running.wire import Message
from sasgeo_bench.sensing.image import LABELLED
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.task_files import pairs_bytes

_MOST_BYTES: Final = 2**50  # of memory
# Folders below a root that reveal truths, answers, or what pictures of later queries show.
_HIDDEN: Final = (
    *("tasks", "truth", "runs", "boards", "release", "results", "sheets", "sealed"),
    *("segmenters", "private", "datasets", "head-start", "frames"),
)


class Named(Protocol):
    """A card of any kind."""

    @property
    def name(self) -> str: ...  # noqa: D102 - as its fields say


AnyCard = TypeVar("AnyCard", bound=Named)
Found = TypeVar("Found")
Checked = TypeVar("Checked")


@dataclass(frozen=True, kw_only=True)
class PluginReply(Generic[AnyCard, Found]):
    """Reply of a plugin to a question, with its status, and its cause in one line.

    `seconds` is by the runner's clock, `own_s` and `cpu_s` are those that the process reports. Loading returns its
    `card`, and whether the plugin `learns`; training, the `learned` text; preparing, by how much memory grew; a query
    or an image, what was `found`.
    """

    status: Status
    message: str = ""
    seconds: float | None = None
    own_s: float | None = None
    cpu_s: float = 0.0
    card: AnyCard | None = None
    learns: bool = False
    learned: str | None = None
    grown_bytes: int | None = None
    found: Found | None = None


Reply = PluginReply[MatcherCard, Prediction]  # of a matcher or tracker


def _line(text: str) -> str:
    if not is_line(text, MOST_CARD_TEXT):
        raise ValueError(f"must be one line of at most {MOST_CARD_TEXT} printable characters")
    return text


Line = Annotated[str, AfterValidator(_line)]
Seconds = Annotated[float, Field(ge=0, le=MOST_S)]


class StrictModel(BaseModel):
    """No silent conversion, nothing that is not known, no number that is none."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _Failed(StrictModel):
    status: Literal["crash", "invalid", "refused"]
    message: Annotated[Line, Field(max_length=MOST_MESSAGE)]


class _Sound(StrictModel):
    """A sound answer, with the fields of its question (`_FIELDS`)."""

    status: Literal["ok"]
    card: dict[str, JsonValue] | None = None
    learns: bool = False
    seconds: Seconds | None = None
    cpu_s: Annotated[float, Field(ge=0)] = 0.0
    grown_bytes: Annotated[int, Field(ge=0, le=_MOST_BYTES)] | None = None


# What the answer to each kind of question holds. The bytes after it are a learned text, a row, or a segmentation.
_FIELDS: Final[Mapping[str, frozenset[str]]] = {
    "load": frozenset({"card", "learns"}),
    "learn": frozenset({"seconds"}),
    "prepare": frozenset({"seconds", "grown_bytes"}),
    "match": frozenset({"seconds", "cpu_s"}),
    "segment": frozenset({"seconds", "cpu_s"}),
}


def checked(kind: TypeAdapter[Checked], given: object) -> Checked:
    """Return what a process sent, in bytes or read, as its type; raise `MatchError`, in one line, if it is none."""
    try:
        return kind.validate_json(given, strict=True) if isinstance(given, bytes) else kind.validate_python(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"]))[:60]  # characters of where a fault is
        fault = first["msg"].removeprefix("Value error, ")
        raise MatchError(one_line(f"{where}: {fault}" if where else fault)) from error


class _Wanted(StrictModel):
    what: Literal["field", "chart", "graph"]
    settings: dict[str, JsonValue]
    digest: str


class _Wants(StrictModel):
    """A question of a process, before it answers one itself."""

    nonce: str
    wanted: _Wanted


_WANTED: Final = TypeAdapter(_Wants)
_MOST_WANTED: Final = 8  # by one question
_MOST_SETTINGS: Final = 2**16  # characters of each, ten times those of a trained map
_FAILED: Final = TypeAdapter(_Failed)
_SOUND: Final = TypeAdapter(_Sound)
_ANSWERS: Final = ("-P", "-m", sasgeo_bench.running.child.__name__)
_KEPT_BYTES: Final = 4000  # of a matcher's output
_START_S: Final = 120.0
_PASSED_ON: Final = ("LANG", "LC_ALL", "TZ", "SYSTEMROOT")  # without the last one Python does not start on Windows


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of a matcher or segmenter.

    Seconds for one query or image, for one map, and for all training at once. `memory_bytes` bounds the resident memory
    of all its processes together, and the address space of each. `file_bytes` bounds one file in its scratch folder;
    where the system offers a way, `scratch_bytes` bounds all of them and `processes` the processes and threads at once.
    """

    match_s: float = 30.0
    prepare_s: float = 600.0
    learn_s: float = 900.0
    memory_bytes: int = 4 * 10**9
    file_bytes: int = 2**30
    scratch_bytes: int = 10**9
    processes: int = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """Folders that a plugin may read, folders hidden from it, and whether it runs in the sandbox."""

    readable: Sequence[Path]
    hidden: Sequence[Path]
    is_sandboxed: bool = True

    def __post_init__(self) -> None:
        if self.is_sandboxed and sys.platform != "linux":
            raise ConfigError(
                "only Linux offers the sandbox that plugins run in: run code that you trust without it, by --trusted "
                "(trusted=True); run.json and boards say so"
            )


def hidden_below(roots: Sequence[Path]) -> list[Path]:
    """Return the folders below some roots of output that tell truths, tasks and answers."""
    return [root / name for root in roots for name in _HIDDEN]


@dataclass(kw_only=True)
class PluginProcess(ABC, Generic[AnyCard, Found]):
    """The process of a plugin; a new one is started whenever the last one has ended.

    Use it in a `with` block: at its end no process or file of it is left. Each kind of plugin has a class of its own,
    which names its `door`, asks its questions and reads what is its own in the answers.
    """

    door: ClassVar[str]
    most_learned_bytes: ClassVar[int]
    card: ClassVar[TypeAdapter[Any]]  # of this kind of plugin

    spec: str
    reach: Reach
    limits: Limits
    luggage: str = ""  # that a process gets at its start
    is_lean: bool = False  # whether it keeps little of what it freed, and takes a little longer
    isolation: dict[str, str] = field(default_factory=dict)
    starts: int = 0
    _peak_bytes: int = 0
    _memory: MemoryWatch | None = None
    _group: Group | None = None
    _process: subprocess.Popen[bytes] | None = None
    _channel: socket.socket | None = None
    _printed: deque[bytes] = field(default_factory=deque)
    _drain: threading.Thread | None = None
    _scratch: Path | None = None
    _kept: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)  # its scratch folder, until it ends

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    @abstractmethod
    def _found(self, data: bytes) -> Found:
        """Read what was found for a query or an image; raise `MatchError` if it is none."""

    def _read(self, kind: str, given: Message, data: bytes, *, nonce: str) -> PluginReply[AnyCard, Found]:
        """Read an answer to a question of a kind, and its bytes; raise `MatchError`, in one line, if it is none.

        `nonce` is that of the question, so that no answer can be made before it.
        """
        content = dict(given)
        if content.pop("nonce", None) != nonce:
            raise MatchError("reply does not belong to this query")
        if content.get("status") != "ok":
            failed = checked(_FAILED, content)
            return PluginReply(status=failed.status, message=failed.message)
        answer = checked(_SOUND, content)
        odd = answer.model_fields_set ^ _FIELDS[kind] ^ {"status"}
        if odd:
            raise MatchError(f"{min(odd)} is missing, or no part of an answer to {kind!r}")
        return PluginReply(
            status="ok",
            own_s=answer.seconds,
            cpu_s=answer.cpu_s,
            card=None if answer.card is None else checked(self.card, answer.card),
            learns=answer.learns,
            learned=self._learned_text(data) if kind == "learn" else None,
            grown_bytes=answer.grown_bytes,
            found=self._found(data) if kind in {"match", "segment"} else None,
        )

    def _learned_text(self, data: bytes) -> str:
        try:
            return check_learned(data.decode(), most_bytes=self.most_learned_bytes)
        except UnicodeDecodeError as error:
            raise MatchError("the learned text is no UTF-8") from error

    def load(self) -> PluginReply[AnyCard, Found]:
        """Import the plugin."""
        return self._ask("load", timeout_s=self.limits.prepare_s)

    def _learn(self, blob: bytes = b"", **asked_for: Any) -> PluginReply[AnyCard, Found]:  # noqa: ANN401 - of JSON
        most_bytes = self.most_learned_bytes + wire.MOST_BYTES
        return self._ask("learn", blob, timeout_s=self.limits.learn_s, most_bytes=most_bytes, **asked_for)

    def _is_gone(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def _ask(
        self,
        kind: str,
        blob: bytes = b"",
        *,
        timeout_s: float,
        most_bytes: int = wire.MOST_BYTES,
        give: Callable[[Message, str], Message] | None = None,
        **asked_for: wire.Json,
    ) -> PluginReply[AnyCard, Found]:
        """Ask a question of a kind, with its fields and the bytes after it; the methods of a server answer it.

        What the process wants to know before it answers, `give` returns, given its question and the nonce.
        """
        nonce = secrets.token_hex(16)  # so that no answer can be made in advance
        try:
            channel = self._started()
            asked = time.perf_counter()
            deadline = time.monotonic() + timeout_s
            wire.send(channel, {"kind": kind, **asked_for, "nonce": nonce}, blob, deadline=deadline)
            answer, data = wire.receive(channel, deadline=deadline, most_bytes=most_bytes)
            for _ in range(_MOST_WANTED):
                if give is None or "wanted" not in answer:
                    break
                wire.send(channel, give(answer, nonce), deadline=deadline)
                answer, data = wire.receive(channel, deadline=deadline, most_bytes=most_bytes)
            came = time.perf_counter()
            reply = self._read(kind, answer, data, nonce=nonce)
        except wire.WireTimeout as late:
            self.end()
            return PluginReply(status="timeout", message=str(late) or f"no answer within {timeout_s:g} s")
        except wire.TooLong as error:
            self.end()
            return PluginReply(status="crash", message=one_line(str(error)))
        except wire.Closed as closed:
            words = self._exit_message(str(closed))
            self.end()
            return PluginReply(status="crash", message=words)
        except (MatchError, wire.Garbled) as error:
            self.end()
            return PluginReply(status="invalid", message=one_line(f"an answer that is none: {error}"))
        if reply.status != "ok":
            return reply
        seconds = came - asked
        # 0.1 s of processors beyond those of all processors: clocks tick
        most_cpu_s = seconds * (os.cpu_count() or 1) + 0.1
        return replace(reply, seconds=seconds, cpu_s=min(reply.cpu_s, most_cpu_s))

    def _started(self) -> socket.socket:
        if self._channel is not None and not self._is_gone():
            return self._channel
        self.end()
        self._scratch = self._kept.enter_context(scratch_folder(self.door))
        command = _command(is_sandboxed=self.reach.is_sandboxed)
        environment = _environment(self._scratch) | (LEAN if self.is_lean else {})
        self._process, ours = start_process(command, environment)
        self._begin_watch(self._process, self._scratch)
        self._printed = deque()
        self._drain = threading.Thread(target=_drain, args=(self._process.stdout, self._printed), daemon=True)
        self._drain.start()
        self._channel = ours
        self.starts += 1
        if self.reach.is_sandboxed:
            wire.send(ours, asdict(self._policy(str(self._scratch))))
            self.isolation = self._started_isolation(ours)
        self.isolation["memory"] = _memory_words(self.limits, self._group)
        start = {"door": self.door, "spec": self.spec, "scratch": str(self._scratch), "paths": import_paths(self.spec)}
        wire.send(ours, start, self.luggage.encode())
        return ours

    @staticmethod
    def _started_isolation(channel: socket.socket) -> dict[str, str]:
        """Return how the sandbox isolates; a late one is no fault of the matcher, and its message says so."""
        try:
            started, _ = wire.receive(channel, deadline=time.monotonic() + _START_S, most_bytes=wire.MOST_BYTES)
        except wire.WireTimeout:
            raise wire.WireTimeout(
                f"the sandbox did not stand within {_START_S:g} s: is a folder of sys.path very large?"
            ) from None
        return {str(name): one_line(str(text)) for name, text in dict(started["isolation"]).items()}

    def _begin_watch(self, process: subprocess.Popen[bytes], scratch: Path) -> None:
        """Put the process into a control group if possible, and measure its memory in any case."""
        memory_bytes, processes = self.limits.memory_bytes, self.limits.processes
        self._group = Group.make(memory_bytes=memory_bytes, processes=processes)
        try:
            if self._group is not None:
                self._group.add(process.pid)
        except OSError:
            self._end_watch()
        self._memory = MemoryWatch(
            process=process,
            most_bytes=memory_bytes,
            kill=partial(_kill_family, process),
            scratch=scratch,
            group=self._group,
        )
        self._memory.start()

    def _end_watch(self) -> None:
        if self._memory is not None:
            self._memory.stop()
            self._peak_bytes = max(self._peak_bytes, self._memory.peak_bytes)
        if self._group is not None:
            self._group.remove()
        self._memory, self._group = None, None

    @property
    def peak_bytes(self) -> int:
        """Return the peak memory of this matcher's process and all its descendants."""
        return max(self._peak_bytes, self._memory.peak_bytes if self._memory else 0)

    def _policy(self, scratch: str) -> sandbox.Policy:
        code = _code()
        scan = walk_code(code)
        found = scan.hidden([*code, *self.reach.readable])
        packed = sorted(shipped_dir("pipelines").glob(f"*{PACKED}"))  # answers; what is installed is not walked
        hidden = [*map(str, (*self.reach.hidden, *packed)), *(path for path in found if not self._is_lesson(path))]
        hidden += _open_cache([*code, *self.reach.readable])
        return sandbox.Policy(
            readable=[str(path) for path in (*code, *self.reach.readable)],
            scratch=scratch,
            hidden=list(dict.fromkeys(hidden)),
            unsearched=scan.unsearched,
            memory_bytes=self.limits.memory_bytes + 2 * 2**30,  # libraries reserve what they never touch
            file_bytes=self.limits.file_bytes,
            scratch_bytes=self.limits.scratch_bytes,
        )

    def _is_lesson(self, path: str) -> bool:
        """Return whether a file is a labelled image in a folder that the plugin may read, to learn from it."""
        return path.endswith(LABELLED) and Path(path).parent in self.reach.readable

    def _exit_message(self, closed: str) -> str:
        """Describe how a process ended, with the last line it printed."""
        code = None
        with contextlib.suppress(subprocess.TimeoutExpired):  # on a busy machine an end takes its time
            code = None if self._process is None else self._process.wait(timeout=10)
        if self._memory is not None and self._memory.look():
            return self._memory.why
        how = closed
        if code is not None:
            how = f"died by {_signal_name(-code)}" if code < 0 else f"ended with exit status {code}"
        if self._process is not None and self._drain is not None:
            _kill_family(self._process)  # no descendant keeps its output open
            self._drain.join(timeout=10.0)  # for the rest of its output, once it is dead
        lines = b"".join(self._printed).decode(errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "")
        return one_line(f"{how}: {last}" if last else how)

    def end(self) -> None:
        """End the process and all that came from it, and remove its scratch folder."""
        if self._channel is not None:
            self._channel.close()
        if self._process is not None:
            _kill_family(self._process)
        self._end_watch()
        self._kept.close()
        self._process, self._channel, self._scratch = None, None, None


@dataclass(kw_only=True)
class Worker(PluginProcess[MatcherCard, Prediction]):
    """The process of a matcher."""

    door: ClassVar[str] = "matcher"
    most_learned_bytes: ClassVar[int] = MOST_LEARNED_BYTES
    card: ClassVar[TypeAdapter[MatcherCard]] = TypeAdapter(MatcherCard)

    _region: Path | None = None
    _learned: str | None = None
    _seen: int = -1  # which of its processes was asked a query, or taught, last
    _is_kept: bool = False  # whether something can be kept of its map
    _missed: list[dict[str, Any]] = field(default_factory=list)  # what it asked for, and was not there

    def learn(self, regions: Mapping[str, Path], pairs: Iterable[tuple[bytes, Truth]]) -> Reply:
        """Train on queries, each a row in Arrow's stream format, and their truths, with maps by name."""
        sizes, blob = pairs_bytes(pairs)
        maps = {name: str(path.resolve()) for name, path in regions.items()}
        reply = self._learn(blob, regions=maps, query_bytes=sizes)
        self._seen = self.starts
        return reply

    def prepare(self, region: Path, learned: str | None = None) -> Reply:
        """Index a map, given the learned text."""
        is_again = (region, learned) == (self._region, self._learned)
        self._region, self._learned = region, learned
        self._is_kept, self._missed = self._shelf(region) is not None, []
        reply = self._ask(
            "prepare",
            timeout_s=self.limits.prepare_s,
            give=self._given,
            region=str(region.resolve()),
            learned=learned,
            is_kept=self._is_kept,
        )
        if not is_again:  # else a matcher that ends at each query has something new made each time
            order(region, self._missed)  # now that the matcher has made its own, so that it waits for nothing
        if reply.status != "ok":
            self.end()
        return reply

    def match(self, query: bytes, *, top_k: int) -> Reply:
        """Ask one query, a row in Arrow's stream format, on the map prepared last.

        A process that ended since its last answer costs this query; one that was ended by us, or has answered for its
        end already, is replaced, and prepares the map again.
        """
        if self._process is not None and self._is_gone():
            words = self._exit_message("ended between two questions")
            self.end()
            return PluginReply(status="crash", message=words)
        if self._process is None and self._region is not None:
            again = self.prepare(self._region, self._learned)
            if again.status != "ok":
                return again
        self._seen = self.starts
        reply = self._ask("match", query, timeout_s=self.limits.match_s, top_k=top_k)
        if reply.status in {"timeout", "crash"} and self._is_gone():
            self.end()
        return reply

    def _given(self, asked: Message, nonce: str) -> Message:
        """Return the folder of what is kept of the map that is prepared."""
        wants = checked(_WANTED, asked)
        if self._region is None or wants.nonce != nonce:
            raise MatchError("question does not belong to this map")
        if not self._is_kept or self._seen == self.starts:  # settings could tell its next process what it saw
            return {"folder": None}
        missed = wants.wanted.model_dump()
        if len(json.dumps(missed)) > _MOST_SETTINGS:
            raise MatchError(f"settings of what is kept have more than {_MOST_SETTINGS} characters")
        folder = kept_of(self._region, **missed)
        if folder is None:
            self._missed.append(missed)
        return {"folder": None if folder is None else str(folder)}

    def _policy(self, scratch: str) -> sandbox.Policy:
        """Let it read what is kept of its maps, too."""
        policy, shelves = super()._policy(scratch), filter(None, map(self._shelf, self.reach.readable))
        return replace(policy, readable=[*policy.readable, *map(str, shelves)])

    def _shelf(self, region: Path) -> Path | None:
        """Return the folder of what is kept of a map; None where others could be read beside it."""
        return None if _open_cache([*_code(), *self.reach.readable]) else shelf_of(region)

    def _found(self, data: bytes) -> Prediction:
        return check_prediction(checked(ROW, data), None, top_k=MOST_CANDIDATES)


def guarded(ask: Callable[[], PluginReply[AnyCard, Found]], folder: Path, name: str) -> PluginReply[AnyCard, Found]:
    """Return the reply to a question; an error of our own counts as one, and is logged in a folder.

    Raise `StoreError` if our own disk or folders are at fault.
    """
    try:
        return ask()
    except StoreError:
        raise
    except Exception as error:
        if is_disk_error(error):
            raise StoreError(
                f"no process of a plugin can be started ({message_of(error)}): free some space and run again"
            ) from error
        return PluginReply(status="crash", message=our_failure(folder / LOG, name, error))


def loaded_card(process: PluginProcess[AnyCard, Found], *, group: str, is_oracle: bool = False) -> tuple[AnyCard, bool]:
    """Load a plugin in a process of its own; return its card, and whether it learns.

    Raise `MatchError` if that fails, or its name is not its own.
    """
    with process:
        reply = process.load()
    if reply.status != "ok" or reply.card is None:
        cause = reply.message or "the plugin has no card"
        raise MatchError(cause if process.spec in cause else f"{process.spec}: cannot be made ({cause})")
    check_card_name(process.spec, reply.card.name, is_oracle=is_oracle, group=group)
    return reply.card, reply.learns


def _signal_name(number: int) -> str:
    """Return the name of a signal, or its number if it has none."""
    known = {item.value: item.name for item in signal.Signals}
    return known.get(number, f"signal {number}")


def _environment(scratch: Path) -> dict[str, str]:
    """Return a minimal environment: none of our folders, keys or proxies; one thread, for comparable latencies."""
    kept = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
    path = os.environ.get("PATH", "") if sys.platform == "win32" else "/usr/bin:/bin"  # there libraries are found by it
    own = {"PATH": path, "PYTHONHASHSEED": "0"} | dict.fromkeys(("HOME", "USERPROFILE", "TMPDIR"), str(scratch))
    # Plugins of pydantic, of which we have none, would be looked for in all that is installed: 15 ms of each start.
    # Arrow's own pool keeps what was freed, and so does a heap for each thread: 25 MB each of a map of 16 km2.
    own |= {"ARROW_DEFAULT_MEMORY_POOL": "system", "MALLOC_ARENA_MAX": "1"}
    return {**kept, **threads, **own, "PYTHONDONTWRITEBYTECODE": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}


def _command(*, is_sandboxed: bool) -> list[str]:
    if not is_sandboxed:
        return [sys.executable, *_ANSWERS]
    package = str(Path(sasgeo_bench.running.child.__file__).parents[2])
    return [sys.executable, "-I", "-S", "-c", PROGRAM, package, *_ANSWERS]


def _open_cache(read: Sequence[Path]) -> list[str]:
    """Return the parts of the user's cache that lie where plugins read, as where their home is the working folder."""
    with contextlib.suppress(StoreError):
        room = Room.of_user()
        parts = [os.path.realpath(path) for path in (room.maps, room.fits)]
        around = [os.path.realpath(path) for path in (*map(str, read), *sandbox.SYSTEM)]
        return [part for part in parts if any(Path(part).is_relative_to(path) for path in around)]
    return []


def _code() -> list[Path]:
    found = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.executable), Path(os.getcwd())]  # noqa: PTH109
    found += [Path(entry) for entry in sys.path if entry]
    found.append(Path(sasgeo_bench.running.child.__file__).parents[2] / "sasgeo_bench")
    return [path for path in dict.fromkeys(found) if path.exists()]


def _drain(stream: IO[bytes] | None, printed: deque[bytes]) -> None:
    """Read the output of a process, so that it never blocks, and keep the end of it."""
    if stream is None:
        return
    while part := stream.read1(65536):  # type: ignore[attr-defined]
        printed.append(part[-_KEPT_BYTES:])
        while sum(map(len, printed)) > 2 * _KEPT_BYTES and len(printed) > 1:
            printed.popleft()


def _memory_words(limits: Limits, group: Group | None) -> str:
    most = f"{limits.memory_bytes / 1e6:.0f} MB at most"
    if group is not None:
        return f"{most}, and {limits.processes} processes and threads, held by the kernel (cgroup v{group.version})"
    return f"{most}, looked at every {WATCH_S * 1000:.0f} ms; processes are not counted"


def _kill_family(process: subprocess.Popen[bytes]) -> None:
    try:
        family = psutil.Process(process.pid).children(recursive=True)
    except psutil.Error:
        family = []
    process.terminate()  # the keeper first kills the others
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5.0)  # for the keeper of a matcher's process to end all its descendants
    try:
        if sys.platform == "win32":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.kill()
    for member in family:
        with contextlib.suppress(psutil.Error):
            member.kill()
    process.wait()
