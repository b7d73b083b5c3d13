# SPDX-License-Identifier: Apache-2.0
"""The second interface: rules that estimate how likely an answer is a false fix, fitted on calibration blocks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import MatchError
from sasgeo_bench.matching.matcher import check_identity, check_said
from sasgeo_bench.matching.results import Prediction


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectorCard:
    """Description of a rejector: the fields of a `MatcherCard`, and `is_calibrated`.

    It is False where `p_false` only orders answers and is no probability. A board then reports neither Brier score nor
    calibration error nor costs by Eq. 14. Raise `MatchError` if a field is empty or the name is not allowed.
    """

    name: str
    version: str
    title: str
    source: str
    ours: str
    licence: str
    limits: str = ""
    is_calibrated: bool = True

    def __post_init__(self) -> None:
        """Refuse a card without the facts that a reader of the board needs."""
        check_said(self)
        check_identity(self.name, self.version)


@runtime_checkable
class Rejector(Protocol):
    """A rule over the answers of one matcher; it is made without arguments and sees no query, map or truth.

    Of each answer it sees the matcher's output: candidates with scores, confidence, diagnostics. After a fit it may
    have a `remark`, a text about that fit for the board, for instance that there was too little calibration data.
    """

    card: RejectorCard

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Fit to answers of calibration blocks; `is_false`, shape (N,), marks false fixes."""
        ...

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Probability, shape (N,), 0..1, that each answer is a false fix."""
        ...


def remark_of(rejector: Rejector) -> str:
    """Return a rejector's remark on its last fit in one line; empty where it has no `remark`."""
    return one_line(str(getattr(rejector, "remark", "") or ""))


def check_p_false(found: object, count: int) -> NDArray[np.float64]:
    """Return the result of `p_false` as float64, shape (count,); raise `MatchError` if it is not `count` numbers, 0..1.

    >>> check_p_false([0.25, 1.0], 2)
    array([0.25, 1.  ])
    """
    try:
        values = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError) as error:
        message = f"p_false() returned {type(found).__name__}, expected {count} numbers"
        raise MatchError(message) from error
    if values.shape != (count,):
        message = f"p_false() returned shape {values.shape}, expected ({count},): one number for each answer"
        raise MatchError(message)
    wrong = np.flatnonzero(~((values >= 0) & (values <= 1)))
    if len(wrong):
        message = f"p_false() returned {values[wrong[0]]:g} in place {wrong[0]}, expected 0..1"
        raise MatchError(message)
    return values
