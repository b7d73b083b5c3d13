# SPDX-License-Identifier: Apache-2.0
"""How far the best of today's stored boards is from what can be reached, suite by suite; ships as `headroom.json`."""

from functools import cache
from importlib import resources
from typing import Final, Literal

from sasgeo_bench.core.config import Document, check_document
from sasgeo_bench.core.json import parse_json

FILE: Final = "headroom.json"
OPEN: Final = "open"
SATURATED: Final = "saturated"
FEW: Final = "too few"
State = Literal["open", "too few", "saturated"]
STATES: Final[tuple[State, ...]] = (OPEN, FEW, SATURATED)  # in the order in which they are listed


class Headroom(Document):
    """The best figure of a suite on a stored board, and the ceiling above it.

    `perceived` names the segmenter of views that were pictures, "" for others. `matcher` holds the figure, with its
    rejector where the figure is about accepted answers. `state` is "open" where the interval of the figure stays below
    the ceiling, "saturated" where it does not and the figure is near, and "too few" where so few places or queries say
    neither. `data_version` is that of the board's maps: a version of the program that makes others cannot enter it.
    """

    suite: str
    track: str
    prior_group: str
    perceived: str
    metric: str
    board: str
    data_version: int
    matcher: str
    value: float
    lo: float
    hi: float
    n: int
    places: int
    ceiling: float
    state: State

    @property
    def headroom(self) -> float:
        """Return what is left to gain, as a share of the queries."""
        return round(self.ceiling - self.value, 3)

    @property
    def order(self) -> tuple[int, float, str]:
        """Return the key to sort by: what is open first, and there the most headroom."""
        return STATES.index(self.state), -self.headroom, self.suite


@cache
def read_headroom() -> tuple[Headroom, ...]:
    """Return what ships with the program, in the order in which it is listed."""
    data = resources.files(__package__).joinpath(FILE).read_bytes()
    return tuple(check_document(item, Headroom, source=FILE) for item in parse_json(data))


def headroom_of(suite: str) -> Headroom | None:
    """Return the first row of a suite; None where no stored board asked it.

    >>> row = headroom_of("clean")
    >>> row is not None and row.lo < row.value < row.hi <= 1
    True
    >>> headroom_of("controls") is None
    True
    """
    return next((row for row in read_headroom() if row.suite == suite), None)
