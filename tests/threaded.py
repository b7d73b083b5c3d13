# SPDX-License-Identifier: Apache-2.0
"""A worker whose matcher is served by a thread, for tests that are not about processes: those take long to start."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from sasgeo_bench.running import (
    answers,
    plan,
    profiling,
    segmenter_testing,
    segmenting,
    serve_segmenter,
    testing,
    training,
)
from sasgeo_bench.running.segmenter_process import SegmenterProcess
from sasgeo_bench.running.serve import Server
from sasgeo_bench.running.server import PluginServer
from sasgeo_bench.running.worker import PluginProcess, Worker


class _Threaded(PluginProcess):
    """No process of its own: nothing limits or isolates the plugin."""

    def _server(self, theirs: socket.socket) -> PluginServer:
        raise NotImplementedError

    def _started(self) -> socket.socket:
        if self._channel is None:
            self._channel, theirs = socket.socketpair()
            self._process = SimpleNamespace(poll=lambda: None)
            threading.Thread(target=self._server(theirs).run, daemon=True).start()
        return self._channel

    def end(self) -> None:
        """Close the channel, which ends the thread."""
        if self._channel is not None:
            self._channel.close()
        self._process, self._channel = None, None


class Threaded(_Threaded, Worker):
    """A matcher, served by a thread."""

    def _server(self, theirs: socket.socket) -> PluginServer:
        return Server(theirs, spec=self.spec)


class ThreadedSegmenter(_Threaded, SegmenterProcess):
    """A segmenter, served by a thread."""

    def _server(self, theirs: socket.socket) -> PluginServer:
        return serve_segmenter.Server(theirs, spec=self.spec, luggage=self.luggage.encode())


@contextmanager
def threaded() -> Iterator[None]:
    """Serve every matcher and segmenter by a thread."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (answers, plan, profiling, training, testing):
            patch.setattr(module, "Worker", Threaded)
        for module in (segmenting, segmenter_testing):
            patch.setattr(module, "SegmenterProcess", ThreadedSegmenter)
        yield
