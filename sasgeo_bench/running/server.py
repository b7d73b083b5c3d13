# SPDX-License-Identifier: Apache-2.0
"""Serve a runner inside the sandbox: every question is answered, a failure by a message of its cause.

What one kind of plugin is asked stands beside it (`serve`, `serve_segmenter`): a process loads no other's libraries.
"""

import errno
import socket
import time
import traceback
from abc import ABC, abstractmethod
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, Self, TypeVar

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.texts import message_of, one_line
from sasgeo_bench.matching.matcher import MOST_LEARNED_BYTES, Matcher, check_learned
from sasgeo_bench.running import wire

if TYPE_CHECKING:
    from sasgeo_bench.matching.segmenter import Segmenter
    from sasgeo_bench.matching.tracker import Tracker

Answer = tuple[wire.Message, bytes]  # to a question that was answered, and the bytes that follow it

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
        self._nonce: wire.Json = None  # of the question that is answered

    def run(self) -> None:
        """Serve until the other side closes."""
        while True:
            try:
                message, blob = wire.receive(self.channel)
            except wire.Closed:
                return
            answer = self._answered(message, blob)
            try:
                wire.put(self.channel, answer)
            except wire.Closed:  # the runner waited no longer
                return
            del message, blob, answer  # megabytes of a picture, while the next one is waited for

    def _answered(self, message: wire.Message, blob: bytes) -> bytes:
        """Return the answer to a question as it is sent."""
        self._nonce = message["nonce"]
        head = {"nonce": self._nonce}
        fields = {name: value for name, value in message.items() if name not in {"kind", "nonce"}}
        try:
            content, data = getattr(self, f"_{message['kind']}")(blob, **fields)
            return wire.packed({**head, "status": "ok", **content}, data)
        except Exception as error:  # noqa: BLE001 - an error of a plugin costs only its own row
            return wire.packed({**head, **_failure(error, plugin=self._made)})

    def _wants(self, wanted: wire.Message) -> wire.Message:
        """Ask the runner for something, before the question is answered; return what it says."""
        wire.send(self.channel, {"nonce": self._nonce, "wanted": wanted})
        return wire.receive(self.channel)[0]

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
