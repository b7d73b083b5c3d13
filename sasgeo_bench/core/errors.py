# SPDX-License-Identifier: Apache-2.0
"""Errors of users: each is a `SasgeoError` on one line that names the cause and the fix."""

from collections.abc import Sequence
from typing import Final

from sasgeo_bench.core.texts import plain

MOST_MESSAGE: Final = 2000  # characters
_SHORT: Final = 60  # characters of a wrong value


def counted(count: int, one: str, many: str = "") -> str:
    """Return a count with its noun; the plural is `one` with an s by default.

    >>> counted(1, "block"), counted(2, "block"), counted(0, "query", "queries")
    ('1 block', '2 blocks', '0 queries')
    """
    return f"{count} {one if count == 1 else many or one + 's'}"


def named(names: Sequence[str], one: str, *, most: int = 3) -> str:
    """Return a count with its noun, and the first few by name.

    >>> named(["monaco", "porto"], "place"), named(list("abcd"), "task", most=2)
    ('2 places (monaco, porto)', '4 tasks (a, b, ...)')
    """
    more = ", ..." if len(names) > most else ""
    return f"{counted(len(names), one)} ({', '.join(names[:most])}{more})"


def check_given(value: object, kind: type, how: str) -> None:
    """Raise `ConfigError` unless an argument is of a kind; `how` says where one is got.

    >>> check_given("5", float, "say it as a number")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: expected a float, got '5': say it as a number
    """
    if not isinstance(value, kind):
        raise ConfigError(f"expected a {kind.__name__}, got {plain(repr(value))[:_SHORT]}: {how}")


class SasgeoError(Exception):
    """Base of all errors caused by the input; the command line prints its text and exits with 2.

    Its text is one printable line of a bounded length, even if it quotes a file or a library.
    """

    def __str__(self) -> str:
        """Return the text on one line, cut in its middle: keep the cause and the fix."""
        text = plain(" ".join(super().__str__().split()))
        half = MOST_MESSAGE // 2
        return text if len(text) <= MOST_MESSAGE else f"{text[: half - 5]} ... {text[-half:]}"


class GridError(SasgeoError, ValueError):
    """Unusable grid, bounds or cell size."""


class ShapeError(SasgeoError, ValueError):
    """Arrays or tables whose shapes, columns or types do not fit together."""


class PoseError(SasgeoError, ValueError):
    """A pose or prior with a value outside its range."""


class CameraError(SasgeoError, ValueError):
    """A camera, a ground or a photo whose values cannot be, or from which no view can be computed."""


class FlightError(SasgeoError, ValueError):
    """A trajectory, a flight plan or a drift profile whose values cannot be."""


class ConfigError(SasgeoError, ValueError):
    """A TOML file with an unknown key, a wrong type or a value out of range."""


class ExtractError(SasgeoError, OSError):
    """An OpenStreetMap file that is missing, damaged or contradicts its hash."""


class ImageryError(SasgeoError, OSError):
    """An aerial picture that is missing, damaged, of an unusable kind, or not of the place."""


class CoverageError(SasgeoError, ValueError):
    """Bounds that the extract does not cover, or that hold nothing."""


class StoreError(SasgeoError, OSError):
    """A folder or file of ours that cannot be written, or contradicts its manifest."""


class ImageError(SasgeoError, ValueError):
    """A picture, labels or a segmentation that is damaged, too large, or of the wrong shape."""


class PerturbError(SasgeoError, ValueError):
    """A perturbation with a strength out of range, or used where it must not be."""


class MatchError(SasgeoError, ValueError):
    """An answer, a card or a plugin that breaks its protocol."""


class MetricError(SasgeoError, ValueError):
    """Values, weights or a level from which a metric cannot be computed."""


class DatasetError(SasgeoError, ValueError):
    """A folder of another benchmark's data, or a ranking of its items, that is not what its layout says."""
