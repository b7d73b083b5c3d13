# SPDX-License-Identifier: Apache-2.0
"""The errors users meet: every one is a `SasgeoError` and fits on one line that names the fault and the mend."""

from collections.abc import Sequence
from typing import Final

from sasgeo_bench.texts import plain

MOST_MESSAGE: Final = 2000  # characters


def counted(count: int, one: str, many: str = "") -> str:
    """How many of something, as a line says it; the plural is `one` with an s unless it is given.

    Examples
    --------
    >>> counted(1, "block"), counted(2, "block"), counted(0, "query", "queries")
    ('1 block', '2 blocks', '0 queries')
    """
    return f"{count} {one if count == 1 else many or one + 's'}"


def named(names: Sequence[str], one: str, *, most: int = 3) -> str:
    """How many of something, and the first of them by name.

    Examples
    --------
    >>> named(["monaco", "porto"], "place"), named(list("abcd"), "task", most=2)
    ('2 places (monaco, porto)', '4 tasks (a, b, ...)')
    """
    more = ", ..." if len(names) > most else ""
    return f"{counted(len(names), one)} ({', '.join(names[:most])}{more})"


class SasgeoError(Exception):
    """Base of all errors that are the input's fault; the command line prints its text and exits with 2.

    Its text is one printable line of a bounded length, also where it quotes a file or a library that says more.

    Examples
    --------
    >>> issubclass(GridError, (SasgeoError, ValueError))
    True
    >>> str(StoreError(f"a.json: line 1{chr(10)}line 2"))
    'a.json: line 1 line 2'
    """

    def __str__(self) -> str:
        """The text on one line, cut in its middle: it begins with the fault and ends with the mend."""
        text = plain(" ".join(super().__str__().split()))
        half = MOST_MESSAGE // 2
        return text if len(text) <= MOST_MESSAGE else f"{text[: half - 5]} ... {text[-half:]}"


class GridError(SasgeoError, ValueError):
    """A grid, bounds or cell size that cannot be used."""


class ShapeError(SasgeoError, ValueError):
    """Arrays or tables whose shapes, columns or types do not fit together."""


class PoseError(SasgeoError, ValueError):
    """A pose, prior or increment with a value outside its range."""


class ConfigError(SasgeoError, ValueError):
    """A TOML file with an unknown key, a wrong type or a value out of range."""


class ExtractError(SasgeoError, OSError):
    """An OpenStreetMap file that is missing, damaged or not what its hash says."""


class CoverageError(SasgeoError, ValueError):
    """Bounds that the extract does not cover, or that hold nothing."""


class StoreError(SasgeoError, OSError):
    """A folder or file of ours that cannot be written, or is not what its manifest says."""


class PerturbError(SasgeoError, ValueError):
    """A perturbation with a strength out of range, or asked for what it must not do."""


class MatchError(SasgeoError, ValueError):
    """An answer, a card or a plugin that is not what the door asks for."""


class MetricError(SasgeoError, ValueError):
    """Values, weights or a level that no figure can be computed from."""
