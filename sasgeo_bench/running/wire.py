# SPDX-License-Identifier: Apache-2.0
"""Exchange messages between a runner and a matcher's process: a length, JSON, and bytes; nothing is executed."""

import json
import select
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

MOST_BYTES: Final = 2**20  # of a message from a matcher's process, which is not trusted
_HEAD: Final = struct.Struct("!II")
_LEAST_S: Final = 1e-3  # zero would make the socket non-blocking


class Closed(Exception):  # noqa: N818 - it is no error: the other side has gone
    """The other side has gone, or sent no message."""


class TooLong(Closed):
    """The other side sends more than is read."""


class WireTimeout(Exception):  # noqa: N818
    """Nothing came in time, or the other side does not read."""


class Garbled(Exception):  # noqa: N818
    """The data is complete, but not a message."""


Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]
Message = Mapping[str, Json]


def send(channel: socket.socket, message: Message, blob: bytes = b"", *, deadline: float | None = None) -> None:
    """Send a message; `Closed` if the other side has gone, `WireTimeout` if it does not read until a deadline."""
    put(channel, packed(message, blob), deadline=deadline)


def packed(message: Message, blob: bytes = b"") -> bytes:
    """Return a message as it is sent."""
    text = json.dumps(dict(message)).encode()
    return _HEAD.pack(len(text), len(blob)) + text + blob


def put(channel: socket.socket, data: bytes, *, deadline: float | None = None) -> None:
    """Send a packed message, as `send` does."""
    try:
        channel.settimeout(None if deadline is None else max(deadline - time.monotonic(), _LEAST_S))
        channel.sendall(data)
        channel.settimeout(None)
    except TimeoutError as error:
        raise WireTimeout from error
    except OSError as error:
        raise Closed(str(error)) from error


def receive(
    channel: socket.socket, *, deadline: float | None = None, most_bytes: int | None = None
) -> tuple[dict[str, Any], bytes]:
    """Wait for a message until `deadline`, by `time.monotonic`; do not read one longer than `most_bytes`.

    Raises
    ------
    Closed
        If the other side has gone; `TooLong` if the message is.
    Garbled
        If it is no JSON object, repeats a name, or holds a number that is not finite.
    WireTimeout
        If it did not come in time.
    """
    text_bytes, blob_bytes = _HEAD.unpack(_exactly(channel, _HEAD.size, deadline))
    if most_bytes is not None and text_bytes + blob_bytes > most_bytes:
        raise TooLong(f"an answer of {text_bytes + blob_bytes} bytes, at most {most_bytes} are read")
    text = _exactly(channel, text_bytes, deadline)
    blob = _exactly(channel, blob_bytes, deadline)
    try:
        found = json.loads(text, object_pairs_hook=_once, parse_constant=_refused)
    except (ValueError, RecursionError) as error:
        raise Garbled(f"no JSON ({error})") from error
    if not isinstance(found, dict):
        raise Garbled("no JSON object")
    return found, blob


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object without repeated names: two readers might take different values."""
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a name is there twice")
    return found


def _refused(name: str) -> float:
    """Refuse NaN and Infinity, which Python reads and JSON does not have."""
    raise ValueError(f"{name} is no number")


def _exactly(channel: socket.socket, count: int, deadline: float | None) -> bytes:
    parts = []
    while count:
        if deadline is not None:
            left_s = deadline - time.monotonic()
            if left_s <= 0 or not select.select([channel], [], [], left_s)[0]:
                raise WireTimeout
        try:
            part = channel.recv(min(count, 2**20))
        except OSError as error:
            raise Closed(str(error)) from error
        if not part:
            raise Closed("closed its connection to the runner without an answer")
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
