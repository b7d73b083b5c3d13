# SPDX-License-Identifier: Apache-2.0
"""Start a process that holds the other end of a socket; imports the standard library alone, and so starts fast."""

import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

INHERITS: Final = sys.platform != "win32"  # whether a process is given sockets of the one that starts it
_HOST: Final = "127.0.0.1"
_KEY_BYTES: Final = 32
_START_S: Final = 120.0  # until a process has connected: Python starts, and imports this file
_LOOK_S: Final = 0.2  # between two looks at whether it has ended before


class Started(NamedTuple):
    """A process, and our end of the socket to it."""

    process: subprocess.Popen[bytes]
    channel: socket.socket


def start_process(command: Sequence[str], environment: Mapping[str, str]) -> Started:
    """Start a command whose last argument, appended here, tells `far_end` where its end of a socket is.

    Where processes inherit no sockets it connects by itself, and shows a key that it reads from its standard input. A
    process that has ended before leaves a closed socket. Its output and errors are one pipe.
    """
    if INHERITS:
        ours, theirs = socket.socketpair()
        with theirs:
            return Started(_begun(command, str(theirs.fileno()), environment, passed=[theirs.fileno()]), ours)
    key = secrets.token_bytes(_KEY_BYTES)
    with socket.create_server((_HOST, 0)) as door:
        process = _begun(command, f"{_HOST}:{door.getsockname()[1]}", environment, stdin=subprocess.PIPE)
        if process.stdin is not None:
            with process.stdin:
                process.stdin.write(key)
        return Started(process, _accepted(door, key, process))


def far_end(where: str) -> socket.socket:
    """Return this process's end of the socket, given the last argument of its command."""
    if where.isdecimal():
        return socket.socket(fileno=int(where))
    host, _, port = where.rpartition(":")
    channel = socket.create_connection((host, int(port)))
    channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    channel.sendall(sys.stdin.buffer.read(_KEY_BYTES))
    return channel


def _begun(
    command: Sequence[str],
    where: str,
    environment: Mapping[str, str],
    *,
    passed: Sequence[int] = (),
    stdin: int = subprocess.DEVNULL,
) -> subprocess.Popen[bytes]:
    return subprocess.Popen(  # noqa: S603 - our own module, by our own interpreter
        [*command, where],
        pass_fds=passed,
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment,
        start_new_session=True,
    )


def _accepted(door: socket.socket, key: bytes, process: subprocess.Popen[bytes]) -> socket.socket:
    """Return the socket of whoever shows the key: any program of this computer may connect."""
    late = time.monotonic() + _START_S
    door.settimeout(_LOOK_S)
    while process.poll() is None and time.monotonic() < late:
        try:
            channel, _ = door.accept()
        except TimeoutError:
            continue
        channel.settimeout(_LOOK_S)
        if secrets.compare_digest(_shown(channel), key):
            channel.settimeout(None)
            channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return channel
        channel.close()
    ours, theirs = socket.socketpair()
    theirs.close()
    return ours


def _shown(channel: socket.socket) -> bytes:
    shown = b""
    try:
        while len(shown) < _KEY_BYTES and (part := channel.recv(_KEY_BYTES - len(shown))):
            shown += part
    except OSError:
        return b""
    return shown
