# SPDX-License-Identifier: Apache-2.0
"""A listener on a free port of UDP that reads MAVLink with pymavlink, and a simulator that tells its time."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Self

import pytest

FIRST_S, STEP_S = 100.0, 0.5  # of the simulator: its first time, and that between two
UNIX_S = 1_777_629_700.0  # at its first time
ASKED_NS = 12_345


@dataclass
class Listener:
    """What was heard, in order; as a simulator it tells its time from the first packet on, and asks for another's."""

    is_simulator: bool = False
    heard: list[Any] = field(default_factory=list)

    def __enter__(self) -> Self:
        self._common = pytest.importorskip("pymavlink.dialects.v20.common")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.005)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()

    @property
    def port(self) -> int:
        """The port, which the system chose."""
        return self._socket.getsockname()[1]

    def named(self, name: str) -> list[Any]:
        """Messages of a name that were heard until now; waits for nothing."""
        return [one for one in self.heard if one.get_type() == name]

    def _run(self) -> None:
        link, told = self._common.MAVLink(None), 0
        own = self._common.MAVLink(None, srcSystem=1, srcComponent=1)
        while True:
            try:
                data, address = self._socket.recvfrom(65_536)
                self.heard += link.parse_buffer(data) or []
            except TimeoutError:
                if self._ended.is_set():
                    return
            if self.is_simulator and self.heard:
                since_s = told * STEP_S
                message = own.system_time_encode(round((UNIX_S + since_s) * 1e6), round((FIRST_S + since_s) * 1e3))
                self._socket.sendto(message.pack(own), address)
                if told == 0:
                    self._socket.sendto(own.timesync_encode(0, ASKED_NS).pack(own), address)
                told += 1


@contextmanager
def silence() -> Iterator[int]:
    """A port that nobody listens at."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    yield port
