# SPDX-License-Identifier: Apache-2.0
"""Base of systems whose sources leave numbers open: the values that are tried on train places, and those in use."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import ClassVar, Final

from sasgeo_bench import MatcherCard

MOST_TRIALS: Final = 6  # settings of a system: the same for all


class Tunable:
    """A system with open numbers, each with the values that are tried; the settings are all combinations of them.

    `chosen` are the values in use: of all settings those that found most in `benchmarks/open_numbers.py`, which asks
    all systems about the same views of train places.

    Parameters
    ----------
    **numbers : float
        Values of open numbers in place of the chosen ones: any, as long as the system makes sense of it.

    Raises
    ------
    TypeError
        If there is no open number of a name.

    Examples
    --------
    >>> class Mine(Tunable):
    ...     open_numbers = {"reach_m": (8.0, 16.0), "share": (0.25, 0.5)}
    ...     chosen = {"reach_m": 16.0, "share": 0.5}
    >>> Mine(share=0.25).numbers
    {'reach_m': 16.0, 'share': 0.25}
    >>> len(Mine.settings())
    4
    """

    card: MatcherCard
    open_numbers: ClassVar[Mapping[str, Sequence[float]]] = {}
    chosen: ClassVar[Mapping[str, float]] = {}

    def __init__(self, **numbers: float) -> None:
        unknown = sorted(numbers.keys() - self.open_numbers.keys())
        if unknown:
            known = ", ".join(self.open_numbers) or "none"
            raise TypeError(f"{type(self).__name__} has no open number {unknown[0]!r}, it has {known}")
        self.numbers: dict[str, float] = {**self.chosen, **numbers}

    @classmethod
    def settings(cls) -> list[dict[str, float]]:
        """Return all combinations of the values that are tried."""
        return [dict(zip(cls.open_numbers, values, strict=True)) for values in product(*cls.open_numbers.values())]
