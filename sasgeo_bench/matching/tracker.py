# SPDX-License-Identifier: Apache-2.0
"""Interface of trackers: plugins that follow a flight view by view, and their answer, a fix."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.texts import message_of, typed
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import Match, MatcherCard, Prediction, check_match, numbers_of
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Head, Query

ROW: Final = TypeAdapter(Prediction)  # as a plugin's process sends it, in JSON
SIDE: Final = 3  # of a covariance: east, north, yaw
MOST_VARIANCE: Final = 1e12  # m2 or deg2


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """Answer to one view of a flight: where the drone is now, by all that was seen until now.

    Parameters
    ----------
    pose : Pose, optional
        The estimate; None where nothing is known yet, and the flight goes on.
    covariance : ndarray or nested sequence of float, shape (3, 3), optional
        Of the estimate, in the order east, north, yaw; m2, m deg and deg2. None if the tracker gives none.
    is_accepted : bool
        Whether the estimate may be relied on. A tracker that merely reckons on after a doubtful view says False.
    confidence : float, optional
        Probability, 0..1, that the estimate is right.
    modes : sequence of (Pose, float)
        Further hypotheses with weights of 0..1, best first.
    diagnostics : mapping of str to float
        Further numbers for a reader.

    Examples
    --------
    >>> fix = Fix(pose=Pose(easting_m=500.0, northing_m=0.0, yaw_deg=90.0), covariance=np.diag([9.0, 9.0, 4.0]))
    >>> check_fix(fix, top_k=5).is_accepted
    True
    """

    pose: Pose | None
    covariance: NDArray[np.float64] | Sequence[Sequence[float]] | None = None
    is_accepted: bool = True
    confidence: float | None = None
    modes: Sequence[tuple[Pose, float]] = ()
    diagnostics: Mapping[str, float] = field(default_factory=dict)


@runtime_checkable
class Tracker(Protocol):
    """A method that follows flights. It is made without arguments, in a process of its own, and sees no truth.

    The views of a flight come one at a time: when `step` is called, later views are not in its process yet.
    """

    card: MatcherCard

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index a map; called in the process of each flight. `learned` is the text of `learn`, None without one."""
        ...

    def start(self, prior: Prior) -> None:
        """Begin a flight on the map prepared last, and forget the one before."""
        ...

    def step(self, query: Query) -> Fix:
        """Answer the next view; `query.step` says which it is, and what the odometer says of the way to it."""
        ...


def check_fix(fix: object, *, top_k: int) -> Fix:
    """Check an answer of `step` with at most `top_k` poses, and return it with floats for numbers.

    Raise `MatchError` if it is no Fix, a number is out of range, weights are not between 0 and 1 or out of order, or
    the covariance is not a symmetric positive definite matrix of 3 x 3.
    """
    if not isinstance(fix, Fix):
        given = "nothing" if fix is None else type(fix).__name__
        raise MatchError(f"step() returned {given}, expected a sasgeo_bench.Fix: without a pose where nothing is known")
    if not isinstance(fix.is_accepted, bool | np.bool_):
        raise MatchError(f"is_accepted is {typed(fix.is_accepted)}, expected True or False")
    if fix.pose is None and (fix.is_accepted or fix.modes):
        raise MatchError("a fix without a pose is not accepted and has no modes: say is_accepted=False")
    found = check_match(match_of(fix), None, top_k=top_k)
    if found.poses and not 0 <= found.scores[-1] <= found.scores[0] <= 1:
        raise MatchError(f"weights of modes lie in 0..1, got {found.scores[-1]:g}")
    return replace(
        fix,
        pose=found.poses[0] if found.poses else None,
        covariance=None if fix.covariance is None else check_covariance(fix.covariance),
        is_accepted=bool(fix.is_accepted),
        confidence=found.confidence,
        modes=tuple(zip(found.poses[1:], found.scores[1:], strict=True)),
        diagnostics=found.diagnostics,
    )


def match_of(fix: Fix) -> Match:
    """Return a fix as an answer of ranked poses: the estimate first, with score 1, then the modes by weight."""
    try:
        modes = [(pose, weight) for pose, weight in fix.modes]
    except (TypeError, ValueError) as error:
        raise MatchError("modes holds something else than pairs of a pose and a weight") from error
    first = () if fix.pose is None else (fix.pose,)
    return Match(
        poses=(*first, *(pose for pose, _ in modes)),
        scores=(*(1.0 for _ in first), *(weight for _, weight in modes)),
        confidence=fix.confidence,
        diagnostics=fix.diagnostics,
    )


def row_of(match: Match, query_id: str) -> Prediction:
    """Return a checked answer to a query as a row."""
    return Prediction(
        query_id=query_id,
        candidates=tuple(zip(match.poses, match.scores, strict=True)),
        confidence=match.confidence,
        diagnostics=match.diagnostics,
    )


def check_prediction(found: Prediction, query: Query | Head | None, *, top_k: int) -> Prediction:
    """Check a row that another process or program made, and return it with floats for numbers.

    Raise `MatchError` as `check_match` and `check_covariance` do.
    """
    match = Match(
        poses=[pose for pose, _ in found.candidates],
        scores=[score for _, score in found.candidates],
        confidence=found.confidence,
        diagnostics=found.diagnostics,
    )
    match = check_match(match, query, top_k=top_k)
    if found.covariance is not None:
        check_covariance(found.covariance)
    candidates = tuple(zip(match.poses, match.scores, strict=True))
    return replace(found, candidates=candidates, confidence=match.confidence, diagnostics=match.diagnostics)


def are_covariances(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of some matrices, shape (N, 3, 3), are symmetric and positive definite, shape (N,).

    >>> are_covariances(np.array([np.eye(3), np.ones((3, 3)), -np.eye(3)])).tolist()
    [True, False, False]
    """
    turned = matrices.transpose(0, 2, 1)
    is_even = np.isclose(matrices, turned, rtol=1e-6, atol=1e-9).all(axis=(1, 2))
    values = np.linalg.eigvalsh((matrices + turned) / 2)
    # 1e-12: least ratio of the smallest to the largest eigenvalue, with yaw in degrees
    return np.asarray(is_even & (values[:, 0] > 1e-12 * values[:, -1]) & (values[:, -1] > 0))


def check_covariance(given: object) -> NDArray[np.float64]:
    """Return a covariance, 3 x 3 or row by row, as an array of shape (3, 3); raise `MatchError` if it is none."""
    try:
        found = numbers_of(given)
        found = found.reshape(SIDE, SIDE) if found.shape == (SIDE**2,) else found
    except (TypeError, ValueError, OverflowError) as error:
        raise MatchError(f"covariance is {typed(given)}, expected 3 x 3 numbers ({message_of(error)})") from error
    if found.shape != (SIDE, SIDE):
        raise MatchError(f"covariance has shape {found.shape}, expected {SIDE} x {SIDE}: east, north, yaw")
    if not (np.abs(found) <= MOST_VARIANCE).all():
        odd = found[~(np.abs(found) <= MOST_VARIANCE)][0]
        raise MatchError(f"covariance holds {odd:g}, expected numbers of {MOST_VARIANCE:g} at most; or give none")
    if not are_covariances(found[None])[0]:
        raise MatchError("covariance is not symmetric and positive definite: NEES needs its inverse; or give none")
    return found
