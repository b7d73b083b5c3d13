# SPDX-License-Identifier: Apache-2.0
"""Horizontal protection levels: what the error of an answer is said not to exceed, but for a stated risk.

Four ways, the first the method's own, the others what it is held against: by leaving out one class at a time, by the
spread of the posterior, by the radius that holds its mass, and (fitted by the scorer on calibration answers, see
`metrics.protection`) by a conformal multiple of `sigma_m`.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from sasgeo_bench.errors import ShapeError
from sasgeo_bench.sasgeo.integrity import Diagnostic, Modes

RISKS: Final = (1e-2, 1e-3)
SCALE: Final = "sigma_m"  # the diagnostic that a conformal level is a multiple of
METHODS: Final = {
    "separation": "how far the best mode moves if one class is left out, the worst of them, and what the refined "
    "position is uncertain by",
    "gauss": "the posterior taken for one Gaussian about the chosen mode: its longer axis",
    "density": "radius around the chosen mode that holds all of the posterior but the risk",
}


def level_name(method: str, risk: float) -> str:
    """Name of the diagnostic that holds a protection level, metres.

    Examples
    --------
    >>> level_name("separation", 1e-2)
    'hpl_separation_0.01_m'
    """
    return f"hpl_{method}_{risk:g}_m"


PROTECTION: Final = (
    Diagnostic(name=SCALE, unit="m", meaning="standard deviation of the posterior about the chosen mode, longer axis"),
    *(
        Diagnostic(
            name=level_name(method, risk), unit="m", meaning=f"protection level at a risk of {risk:g}: {meaning}"
        )
        for method, meaning in METHODS.items()
        for risk in RISKS
    ),
)


def sigmas(risk: float) -> float:
    """How many standard deviations along an axis a round Gaussian exceeds with some probability: sqrt(-2 ln risk).

    Raises
    ------
    ShapeError
        If the risk is none.

    Examples
    --------
    >>> round(sigmas(1e-2), 2), round(sigmas(1e-3), 2)
    (3.03, 3.72)
    """
    if not 0 < risk < 1:
        message = f"risk must lie in (0, 1), got {risk!r}"
        raise ShapeError(message)
    return math.sqrt(-2.0 * math.log(risk))


def posterior_sigma_m(modes: Modes) -> float:
    """Standard deviation of the posterior about the chosen mode along its longer axis, metres.

    About the chosen mode and not about the mean, for it is the chosen one whose error is to be bounded. That none of
    the modes may be right is left out.

    Examples
    --------
    >>> posterior_sigma_m(Modes(positions_m=np.zeros((1, 2)), by_class=np.array([[9.0]]), sigma_m=2.0))
    2.0
    """
    apart_m = modes.positions_m - modes.positions_m[0]
    spread = (modes.shares[:, None] * apart_m).T @ apart_m
    return float(np.sqrt(np.linalg.eigvalsh(spread)[-1].clip(0.0) + modes.sigma_m**2))


def gauss_level(modes: Modes, risk: float) -> float:
    """Protection level of the posterior taken for one Gaussian, metres.

    Examples
    --------
    >>> one = Modes(positions_m=np.zeros((1, 2)), by_class=np.array([[9.0]]), sigma_m=2.0)
    >>> round(gauss_level(one, 1e-2), 2)
    6.07
    """
    return sigmas(risk) * posterior_sigma_m(modes)


def density_level(modes: Modes, risk: float) -> float:
    """Radius around the chosen mode beyond which less than the risk of the posterior lies, metres.

    Half of the risk goes to modes beyond it, half to positions within a mode. Infinite where none of the modes being
    right is as likely as that: no radius holds what lies nowhere.

    Examples
    --------
    >>> two = Modes(positions_m=np.array([[0.0, 0.0], [50.0, 0.0]]), by_class=np.array([[9.0], [6.0]]), sigma_m=2.0)
    >>> round(density_level(two, 1e-2), 1), density_level(two, 1e-4)
    (56.5, inf)
    """
    order = np.argsort(modes.away_m, kind="stable")
    beyond = 1.0 - np.cumsum(modes.masses[order])
    enough = np.flatnonzero(beyond <= risk / 2)
    if not len(enough):
        return math.inf
    return float(modes.away_m[order[enough[0]]] + sigmas(risk / 2) * modes.sigma_m)


def separation_level(modes: Modes, risk: float) -> float:
    """Protection level by leaving out one class at a time, metres: how far the best mode moves, and some sigmas.

    Infinite where nothing is left that could disagree: one mode alone, or one class that says all.

    Notes
    -----
    After solution separation in receiver autonomous integrity monitoring (Brown and McBurney, NAVIGATION 1988; Blanch
    et al., IEEE TAES 2015), which holds against one fault at a time: that one class misleads. Moves are among the modes
    of one list, found with all classes, so a place that only the other classes would find is not seen; and the refined
    position is taken to be as good without a class as with it.

    Examples
    --------
    The first class alone holds the first mode up: without it the answer would lie 50 m away.

    >>> two = Modes(
    ...     positions_m=np.array([[0.0, 0.0], [50.0, 0.0]]), by_class=np.array([[9.0, 1.0], [2.0, 3.0]]), sigma_m=2.0
    ... )
    >>> round(separation_level(two, 1e-2), 1)
    56.1
    """
    without = modes.scores[:, None] - modes.by_class
    highest = without.max(axis=0)
    near = 1e-9 * (1.0 + np.abs(modes.by_class).max())  # rounding parts what is equal
    is_mute = highest - without.min(axis=0) <= near
    if is_mute.any():
        return math.inf
    moved_m = np.where(without >= highest - near, modes.away_m[:, None], 0.0).max(initial=0.0)
    return float(moved_m + sigmas(risk) * modes.sigma_m)


def levels_of(modes: Modes, *, risks: Sequence[float] = RISKS) -> dict[str, float]:
    """Everything of `PROTECTION` that can be said of an answer; a level that is infinite is left out.

    Parameters
    ----------
    modes : Modes
        Of the search.
    risks : sequence of float
        How often a level may be exceeded.

    Returns
    -------
    dict of str to float
        Metres.

    Examples
    --------
    >>> list(levels_of(Modes(positions_m=np.zeros((1, 2)), by_class=np.array([[9.0]]), sigma_m=2.0), risks=(1e-2,)))
    ['sigma_m', 'hpl_gauss_0.01_m', 'hpl_density_0.01_m']
    """
    ways = {"separation": separation_level, "gauss": gauss_level, "density": density_level}
    found = {level_name(method, risk): way(modes, risk) for method, way in ways.items() for risk in risks}
    found = {SCALE: posterior_sigma_m(modes), **found}
    return {name: value for name, value in found.items() if math.isfinite(value)}
