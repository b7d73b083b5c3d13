# SPDX-License-Identifier: Apache-2.0
"""Read JSON of unknown origin: of a bounded size, each key once, every number finite, every text printable."""

import json
import math
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.paths import read_bounded
from sasgeo_bench.core.texts import plain

MOST_BYTES: Final = 50_000_000
_MOST_DIGITS: Final = 40  # a seed of 128 bits has 39
_MOST_QUOTED: Final = 200


def parse_json(data: bytes | str) -> Any:  # noqa: ANN401 - any document
    """Parse a JSON document.

    Raise `ValueError` if it is no JSON, is nested too deep, repeats a key, holds a number that is not finite or has too
    many digits, or a text that cannot be encoded.

    >>> parse_json('{"a": 1, "a": 2}')
    Traceback (most recent call last):
        ...
    ValueError: the key 'a' stands there twice
    """
    try:
        text = data if isinstance(data, str) else data.decode()
        content = json.loads(
            text, object_pairs_hook=_once, parse_float=_finite, parse_int=_short, parse_constant=_no_constant
        )
        json.dumps(content, ensure_ascii=False).encode()  # "\ud800" is JSON, but no text
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    return content


def read_json(path: Path, *, mend: str, most_bytes: int = MOST_BYTES) -> Any:  # noqa: ANN401 - any document
    """Read a JSON file; raise `StoreError` if it is missing, too large or refused by `parse_json`.

    `mend` is the advice of the message, as in "submit again".
    """
    try:
        return parse_json(read_bounded(path, most_bytes))
    except (OSError, ValueError) as error:
        text = plain(getattr(error, "strerror", None) or str(error))[:_MOST_QUOTED]
        raise StoreError(f"{path} is damaged ({text}): {mend}") from error


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(
            f"the key {next(name for name in names if names.count(name) > 1)[:_MOST_QUOTED]!r} stands there twice"
        )
    return content


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:_MOST_DIGITS]} is too large a number")
    return value


def _short(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError(f"{text[:_MOST_DIGITS]}... has too many digits")
    return int(text)


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")
