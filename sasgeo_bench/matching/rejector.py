# SPDX-License-Identifier: Apache-2.0
"""The second door: rules that say of an answer how likely it is a false fix, fitted on calibration blocks."""

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
    """Description of a rejector: the fields of a `MatcherCard`, and one more.

    Parameters
    ----------
    is_calibrated : bool
        False where `p_false` keeps an order alone and is no probability. A board then tells neither Brier score nor
        calibration error nor costs by Eq. 14: they would judge numbers that claim nothing.

    Raises
    ------
    MatchError
        If a field is empty or the name holds what a name may not.

    Examples
    --------
    >>> said = {"name": "mine", "version": "1", "title": "Mine", "source": "original", "ours": "all", "licence": "MIT"}
    >>> RejectorCard(**said).limits
    ''
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
        """Refuse a card that does not say what a reader of the board needs."""
        check_said(self)
        check_identity(self.name, self.version)


@runtime_checkable
class Rejector(Protocol):
    """A rule over the answers of one matcher; it is made without arguments and sees no query, map or truth.

    Of each answer it sees what the matcher told: candidates with scores, confidence, diagnostics. After a fit it may
    have a `remark`, a text that the board is to say of that fit, as where calibration was too little to learn from.
    """

    card: RejectorCard

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Learn from answers of calibration blocks; `is_false`, shape (N,), says which of them were false fixes."""
        ...

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Probability, shape (N,), 0..1, that each answer is a false fix."""
        ...


def remark_of(rejector: Rejector) -> str:
    """Return a rejector's remark on its last fit in one line; empty where it has no `remark`.

    Examples
    --------
    >>> class Plain:
    ...     remark = "too few answers"
    >>> remark_of(Plain())
    'too few answers'
    """
    return one_line(str(getattr(rejector, "remark", "") or ""))


def check_p_false(found: object, count: int) -> NDArray[np.float64]:
    """Hold what a rejector returned to what it must be.

    Parameters
    ----------
    found : object
        What `p_false` returned.
    count : int
        Answers it was asked about.

    Returns
    -------
    ndarray of float64, shape (count,)
        Probabilities.

    Raises
    ------
    MatchError
        If these are not as many finite numbers from 0 to 1.

    Examples
    --------
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
