# SPDX-License-Identifier: Apache-2.0
"""Arrays of an image with a description, as bytes that may come from anywhere: a head in JSON and a compressed body."""

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any, Final

from sasgeo_bench.errors import ImageError

_HEAD: Final = struct.Struct("!I")
_MOST_HEAD: Final = 2**16  # bytes
QUICK: Final = 1  # level of compression that is worth its time
STORED: Final = 0  # for bytes that do not stay
LABELLED: Final = ".labelled"  # suffix of a file that holds one labelled image


def pack_parts(magic: bytes, head: Mapping[str, Any], body: bytes, *, level: int = QUICK) -> bytes:
    """Return a head and a body as bytes that begin with `magic`.

    >>> data = pack_parts(b"DEMO", {"count": 3}, b"abc")
    >>> head, rest = split_parts(b"DEMO", data, "a demo")
    >>> head["count"], unpack_body(rest, 3, "a demo")
    (3, b'abc')
    """
    text = json.dumps(head, allow_nan=False).encode()
    return magic + _HEAD.pack(len(text)) + text + zlib.compress(body, level=level)


def split_parts(magic: bytes, data: bytes, what: str) -> tuple[dict[str, Any], bytes]:
    """Return the head and the compressed body of bytes; raise `ImageError` if they are not what `pack_parts` writes."""
    fault = f"these bytes are not {what}, or their head is damaged: make it again"
    start = len(magic) + _HEAD.size
    if len(data) < start or not data.startswith(magic):
        raise ImageError(fault)
    (head_bytes,) = _HEAD.unpack_from(data, len(magic))
    if head_bytes > min(_MOST_HEAD, len(data) - start):
        raise ImageError(fault)
    try:
        head = json.loads(data[start : start + head_bytes])
    except (ValueError, RecursionError) as error:
        raise ImageError(fault) from error
    if not isinstance(head, dict):
        raise ImageError(fault)
    return head, data[start + head_bytes :]


def unpack_body(rest: bytes, count: int, what: str) -> bytes:
    """Return a body of `count` bytes; raise `ImageError` if it has another number. No more than that is unpacked."""
    unpacking = zlib.decompressobj()
    try:
        body = unpacking.decompress(rest, count + 1)
    except zlib.error as error:
        raise ImageError(f"the bytes of {what} are damaged ({error}): make it again") from error
    if len(body) != count or not unpacking.eof or unpacking.unused_data:
        raise ImageError(f"{what} does not hold the {count} bytes that its head announces: make it again")
    return body
