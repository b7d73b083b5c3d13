# SPDX-License-Identifier: Apache-2.0
"""Integrity evidence of an answer: E of Eqs. 12-14 of the SASGeo paper, by fixed names.

A matcher adds these to the diagnostics of its answers; rejectors read them there. None depends on the units of a
matcher's score.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.search.plan import Null, posterior

APART_M: Final = 25.0  # the widest tolerance of the benchmark: nearer modes are one answer


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """A diagnostic of an answer: key, unit ("1" where there is none) and meaning.

    `is_wide` ones span orders of magnitude, so models use their inverse hyperbolic sine.
    """

    name: str
    unit: str
    meaning: str
    is_wide: bool = False


EVIDENCE: Final = (
    Diagnostic(
        "margin_nats",
        "nat",
        "score of the chosen mode less that of the best one outside the suppression radius of 25 m, or less "
        "that of none being right where there is no such mode",
        is_wide=True,
    ),
    Diagnostic("posterior_entropy_nats", "nat", "entropy of the posterior over the modes and none of them being right"),
    Diagnostic(
        "modes_above",
        "1",
        "how many modes there are: the chosen one, and those outside the suppression radius with at least 5 % "
        "of its posterior mass",
    ),
    Diagnostic(
        "spread_m",
        "m",
        "root mean square distance of the modes from their mean place, weighted by posterior mass",
        is_wide=True,
    ),
    Diagnostic(
        "null_z",
        "1",
        "how far the best coarse score stands above those of all places, in their standard deviations",
    ),
    Diagnostic(
        "class_agreement",
        "1",
        "of all that classes say about chosen mode against rival (or against nothing, without a rival), the "
        "share that speaks for the chosen one",
    ),
    Diagnostic(
        "graph_consistency",
        "1",
        "share of the nodes and edges seen that find their like in the map's graph at the chosen mode",
    ),
    Diagnostic("unknown_share", "1", "share of the view that is unknown; an answer of which all is, is none"),
    Diagnostic(
        "information_nats",
        "nat",
        "what the known cells can tell: cells by class, times mutual information with a map of that age, "
        "times the class's exponent",
        is_wide=True,
    ),
    Diagnostic("map_age_years", "yr", "from the date of the map to that of the view; 0 for a younger map"),
    Diagnostic(
        "vio_mahalanobis",
        "1",
        "Mahalanobis norm of the step from the last fix against odometry; of single views there is none",
        is_wide=True,
    ),
)
EVIDENCE_NAMES: Final = tuple(item.name for item in EVIDENCE)
_FROM_MATCHER: Final = frozenset(
    {"graph_consistency", "unknown_share", "information_nats", "map_age_years", "vio_mahalanobis"}
)  # not computed from the modes: the matcher supplies them


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Modes of one search, the chosen one first, with scores by class.

    `positions_m`, shape (M, 2), are easting and northing. `by_class`, shape (M, C), are scaled scores in nats, which
    sum to the score of the mode; other terms, such as the graph, count as classes. `none_nats` is the score of no mode
    being right. `sigma_m` is the standard deviation of a refined position along either axis, from the curvature of the
    score or measured on training blocks.

    Raises
    ------
    ShapeError
        If there is no mode, shapes differ, a number is not finite, or `sigma_m` is not positive.

    Examples
    --------
    >>> near = Modes(positions_m=np.array([[0.0, 0.0], [60.0, 80.0]]), by_class=np.array([[3.0], [0.0]]), sigma_m=2.0)
    >>> near.masses.round(2).tolist(), near.away_m.tolist()
    ([0.91, 0.05, 0.05], [0.0, 100.0])
    """

    positions_m: NDArray[np.float64]
    by_class: NDArray[np.float64]
    sigma_m: float
    none_nats: float = 0.0

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        count = len(self.positions_m)
        shapes = (np.shape(self.positions_m), np.shape(self.by_class)[:1])
        if not count or shapes != ((count, 2), (count,)) or np.ndim(self.by_class) != 2:  # (M, C)
            raise ShapeError(
                f"positions_m has shape {np.shape(self.positions_m)} and by_class {np.shape(self.by_class)}, expected "
                "(M, 2) and (M, C) with at least one mode: an answer without a mode is withheld"
            )
        if not (np.isfinite(self.positions_m).all() and np.isfinite(self.by_class).all()):
            raise ShapeError("positions_m or by_class holds a number that is not finite: leave that mode or class out")
        if not (np.isfinite(self.none_nats) and 0 < self.sigma_m < np.inf):
            raise ShapeError(
                f"none_nats is {self.none_nats!r}, sigma_m {self.sigma_m!r}, expected finite, and sigma_m positive"
            )

    @cached_property
    def scores(self) -> NDArray[np.float64]:
        """Return the score of each mode, nats, shape (M,)."""
        return np.asarray(self.by_class.sum(axis=1))

    @cached_property
    def masses(self) -> NDArray[np.float64]:
        """Return the posterior probability of each mode and, last, of none, shape (M + 1,)."""
        return posterior(self.scores.tolist(), null_score=self.none_nats)

    @cached_property
    def shares(self) -> NDArray[np.float64]:
        """Return the posterior probability of each mode if one of them is right, shape (M,)."""
        return np.asarray(special.softmax(self.scores))

    @cached_property
    def away_m(self) -> NDArray[np.float64]:
        """Return the distance of each mode from the chosen one, metres, shape (M,)."""
        return np.asarray(np.hypot(*(self.positions_m - self.positions_m[0]).T))


RIVAL_SHARE: Final = 0.05  # least mass of a rival, relative to the chosen mode


def evidence_of(modes: Modes, *, null: Null | None = None, **given: float | None) -> dict[str, float]:
    """Return the `EVIDENCE` of an answer that is available: finite numbers by name, in its order.

    `null` are coarse scores of all places. `given` is evidence not computed from the modes: `graph_consistency`,
    `unknown_share`, `information_nats`, `map_age_years`, `vio_mahalanobis`; None and NaN are dropped.

    Raises
    ------
    ShapeError
        If a name is unknown.
    """
    foreign = next((name for name in given if name not in _FROM_MATCHER), None)
    if foreign is not None:
        raise ShapeError(
            f"{foreign!r} is no evidence that a matcher supplies, known are {', '.join(sorted(_FROM_MATCHER))}"
        )
    rivals = np.flatnonzero(modes.away_m >= APART_M)
    rival = rivals[np.argmax(modes.scores[rivals])] if len(rivals) else None
    against = modes.none_nats if rival is None else modes.scores[rival]
    middle_m = modes.shares @ modes.positions_m
    # 0.05: least mass of a rival, relative to the chosen mode
    found: dict[str, float | None] = {
        "margin_nats": modes.scores[0] - against,
        "posterior_entropy_nats": -(modes.masses * np.log(np.maximum(modes.masses, np.finfo(float).tiny))).sum(),
        "modes_above": 1 + (modes.masses[rivals] >= RIVAL_SHARE * modes.masses[0]).sum(),
        "spread_m": np.sqrt(modes.shares @ ((modes.positions_m - middle_m) ** 2).sum(axis=1)),
        "null_z": None if null is None or not null.deviation > 0 else (null.best - null.mean) / null.deviation,
        "class_agreement": _agreement(modes.by_class[0] - (0.0 if rival is None else modes.by_class[rival])),
        **given,
    }
    known = {name: found.get(name) for name in EVIDENCE_NAMES}
    return {name: float(value) for name, value in known.items() if value is not None and np.isfinite(value)}


def _agreement(leads: NDArray[np.float64]) -> float | None:
    """Return the fraction of the evidence that supports the chosen mode; None without evidence."""
    total = np.abs(leads).sum()
    return float(leads[leads > 0].sum() / total) if total > 0 else None
