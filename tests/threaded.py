# SPDX-License-Identifier: Apache-2.0
"""A worker whose matcher is served by a thread, for tests that are not about processes: those take long to start."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import SimpleNamespace

import pytest

from sasgeo_bench.running import answers, plan, testing, training
from sasgeo_bench.running.serve import TOOLS, Server
from sasgeo_bench.running.worker import Worker


class Threaded(Worker):
    """A worker without a process of its own: nothing limits or isolates its matcher."""

    def _started(self) -> socket.socket:
        if self._channel is None:
            self._channel, theirs = socket.socketpair()
            self._process = SimpleNamespace(poll=lambda: None)
            threading.Thread(target=Server(theirs, spec=self.spec).run, daemon=True).start()
        return self._channel

    def end(self) -> None:
        """Close the channel, which ends the thread."""
        if self._channel is not None:
            self._channel.close()
        self._process, self._channel = None, None


@contextmanager
def threaded() -> Iterator[None]:
    """Serve every matcher by a thread."""
    for tool in TOOLS:  # the hash of a matcher's code covers those that are imported: all of them, from the beginning
        import_module(f"sasgeo_bench.{tool}")
    with pytest.MonkeyPatch.context() as patch:
        for module in (answers, plan, training, testing):
            patch.setattr(module, "Worker", Threaded)
        yield
