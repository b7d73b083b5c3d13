# SPDX-License-Identifier: Apache-2.0
"""Messages between a runner and a matcher's process: a length, JSON, and bytes; nothing that is executed when read."""

import json
import select
import socket
import struct
import time
from typing import Any, Final

MOST_BYTES: Final = 16 * 2**20  # of a message from a matcher's process; what it sends is not trusted
_HEAD: Final = struct.Struct("!II")


class Closed(Exception):  # noqa: N818 - it is no error: the other side has gone
    """The other side has gone, or sent what is no message."""


class Late(Exception):  # noqa: N818
    """Nothing came in time."""


def send(channel: socket.socket, message: dict[str, Any], blob: bytes = b"") -> None:
    """Send a message; `Closed` if the other side has gone."""
    text = json.dumps(message, allow_nan=True).encode()
    try:
        channel.sendall(_HEAD.pack(len(text), len(blob)) + text + blob)
    except OSError as error:
        raise Closed(str(error)) from error


def receive(
    channel: socket.socket, *, deadline: float | None = None, most_bytes: int | None = None
) -> tuple[dict[str, Any], bytes]:
    """Wait for a message.

    Parameters
    ----------
    channel : socket
        Its end of a pair.
    deadline : float, optional
        Of `time.monotonic`; `Late` when it has passed.
    most_bytes : int, optional
        A longer message is not read.

    Raises
    ------
    Closed
        If the other side has gone, the message is too long, or it is none.
    Late
        If it did not come in time.
    """
    text_bytes, blob_bytes = _HEAD.unpack(_exactly(channel, _HEAD.size, deadline))
    if most_bytes is not None and text_bytes + blob_bytes > most_bytes:
        message = f"an answer of {text_bytes + blob_bytes} bytes, at most {most_bytes} are read"
        raise Closed(message)
    text = _exactly(channel, text_bytes, deadline)
    blob = _exactly(channel, blob_bytes, deadline)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        message = "an answer that is no JSON"
        raise Closed(message) from error
    if not isinstance(found, dict):
        message = "an answer that is no JSON object"
        raise Closed(message)
    return found, blob


def _exactly(channel: socket.socket, count: int, deadline: float | None) -> bytes:
    parts = []
    while count:
        if deadline is not None:
            left_s = deadline - time.monotonic()
            if left_s <= 0 or not select.select([channel], [], [], left_s)[0]:
                raise Late
        try:
            part = channel.recv(min(count, 2**20))
        except OSError as error:
            raise Closed(str(error)) from error
        if not part:
            message = "gone"
            raise Closed(message)
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
