# SPDX-License-Identifier: Apache-2.0
"""Learned texts, read so that a damaged one says what to do."""

import json
from collections.abc import Callable
from typing import Any, TypeVar

Value = TypeVar("Value")


def read_learned(name: str, learned: str, read: Callable[[Any], Value]) -> Value:
    """Return what `read` makes of the JSON that the matcher `name` learned; raise one line where it cannot.

    >>> read_learned("mine", '{"share": 0.5}', lambda saved: saved["share"])
    0.5
    >>> read_learned("mine", "{}", lambda saved: saved["share"])
    Traceback (most recent call last):
    ...
    ValueError: mine: the learned text is damaged, or of another version of this matcher: learn again
    """
    try:
        return read(json.loads(learned))
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        raise ValueError(
            f"{name}: the learned text is damaged, or of another version of this matcher: learn again"
        ) from None


def sound(value: Value, *, is_sound: bool) -> Value:
    """Return a value, or raise `ValueError` where it is not as it was learned."""
    if not is_sound:
        raise ValueError
    return value
