# SPDX-License-Identifier: Apache-2.0
"""Bounds of numbers and texts in an answer, the same for a plugin, a file, a submission and stored results."""

from collections.abc import Mapping
from typing import Final

from sasgeo_bench.texts import plain

MOST_CANDIDATES: Final = 1000  # of one answer
MOST_DIAGNOSTICS: Final = 64
MOST_NAME: Final = 64  # characters of the name of a diagnostic
MOST_MESSAGE: Final = 300  # characters
MOST_S: Final = 7 * 86_400.0  # of one answer: no run allows more
_MOST_M: Final = 1e8  # farther than any projected coordinate on Earth
_MOST_TURN_DEG: Final = 1e6  # far beyond it a number has too few digits for a heading
_MOST: Final = 3.4028234663852886e38  # largest single-precision number: squares and differences stay finite

# Least and most of each number; none may be NaN or infinite.
BOUNDS: Final[Mapping[str, tuple[float, float]]] = {
    "easting_m": (-_MOST_M, _MOST_M),
    "northing_m": (-_MOST_M, _MOST_M),
    "yaw_deg": (-_MOST_TURN_DEG, _MOST_TURN_DEG),
    "scale": (1e-3, 1e3),
    "score": (-_MOST, _MOST),
    "confidence": (0.0, 1.0),
    "diagnostics": (-_MOST, _MOST),
    "latency_s": (0.0, MOST_S),
    "matcher_s": (0.0, MOST_S),
}


def is_line(text: str, most: int) -> bool:
    """Return whether a text is one line of printable characters, at most `most` of them; it may be empty."""
    return len(text) <= most and text.isprintable()


def bounds_text(name: str) -> str:
    """Format the bounds of a number for an error."""
    least, most = BOUNDS[name]
    return f"{least:g}..{most:g}"


def one_line(text: str) -> str:
    """Return any text in one line of at most `MOST_MESSAGE` printable characters."""
    line = plain(" ".join(text.split()))
    return line if len(line) <= MOST_MESSAGE else line[: MOST_MESSAGE - 3] + "..."


def message_of(error: BaseException) -> str:
    """Return class and text of an error in one line; only the class if its text cannot be made.

    >>> message_of(ValueError("no index today"))
    'ValueError: no index today'
    """
    try:
        return one_line(f"{type(error).__name__}: {error}")
    except Exception:  # noqa: BLE001 - a plugin's own errors may fail at telling of themselves
        return type(error).__name__
