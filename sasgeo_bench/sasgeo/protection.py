# SPDX-License-Identifier: Apache-2.0
"""Horizontal protection levels: bounds of the position error, exceeded with a stated risk.

The method's own leaves out one class at a time. It is compared with the spread of the posterior, the radius that holds
its mass, and a conformal multiple of `sigma_m`, which `scoring.protection` fits to calibration answers.
"""

import math
from typing import Final

import numpy as np

from sasgeo_bench.errors import ShapeError
from sasgeo_bench.sasgeo.integrity import Diagnostic, Modes

RISKS: Final = (1e-2, 1e-3)
SCALE: Final = "sigma_m"  # the diagnostic that conformal levels scale
METHODS: Final = {
    "separation": "how far the best mode moves if one class is left out, the worst of them, and what the refined "
    "position is uncertain by",
    "gauss": "the posterior taken for one Gaussian about the chosen mode: its longer axis",
    "density": "radius around the chosen mode that holds all of the posterior but the risk",
}


def level_name(method: str, risk: float) -> str:
    """Return the name of the diagnostic of a protection level, metres."""
    return f"hpl_{method}_{risk:g}_m"


PROTECTION: Final = (
    Diagnostic(SCALE, "m", "standard deviation of the posterior about the chosen mode, longer axis"),
    *(
        Diagnostic(level_name(method, risk), "m", f"protection level at a risk of {risk:g}: {meaning}")
        for method, meaning in METHODS.items()
        for risk in RISKS
    ),
)


def sigmas(risk: float) -> float:
    """Return the radius of a round Gaussian exceeded with a probability, in standard deviations: sqrt(-2 ln risk).

    Raises
    ------
    ShapeError
        If the risk is not within (0, 1).
    """
    if not 0 < risk < 1:
        message = f"risk must lie in (0, 1), got {risk!r}"
        raise ShapeError(message)
    return math.sqrt(-2.0 * math.log(risk))


def posterior_sigma_m(modes: Modes) -> float:
    """Return the standard deviation of the posterior about the chosen mode along its longer axis, metres.

    It is taken about the chosen mode, whose error is bounded, not about the mean. The mass of no mode being right is
    ignored.
    """
    off_m = modes.positions_m - modes.positions_m[0]
    spread = (modes.shares[:, None] * off_m).T @ off_m
    return float(np.sqrt(np.linalg.eigvalsh(spread)[-1].clip(0.0) + modes.sigma_m**2))


def gauss_level(modes: Modes, risk: float) -> float:
    """Return the protection level of the posterior as one Gaussian, metres."""
    return sigmas(risk) * posterior_sigma_m(modes)


def density_level(modes: Modes, risk: float) -> float:
    """Return the radius around the chosen mode that holds the posterior but for the risk, metres.

    Half of the risk goes to modes beyond it, half to positions within a mode. It is infinite where the mass of no mode
    being right exceeds that.
    """
    order = np.argsort(modes.away_m, kind="stable")
    beyond = 1.0 - np.cumsum(modes.masses[order])
    enough = np.flatnonzero(beyond <= risk / 2)
    if not len(enough):
        return math.inf
    return float(modes.away_m[order[enough[0]]] + sigmas(risk / 2) * modes.sigma_m)


def separation_level(modes: Modes, risk: float) -> float:
    """Return the protection level by leaving out one class at a time: shift of the best mode and some sigmas, metres.

    It is infinite where nothing can disagree: with one mode, or one class that holds all evidence.

    Notes
    -----
    After solution separation in receiver autonomous integrity monitoring (Brown and McBurney, NAVIGATION 1988; Blanch
    et al., IEEE TAES 2015), for one fault at a time: one misleading class. The best mode moves within one list, found
    with all classes, so places that only the other classes would find are missed; and the refined position is assumed
    to be as good without a class as with it.

    Examples
    --------
    Only the first class supports the first mode: without it the answer lies 50 m away.

    >>> two = Modes(
    ...     positions_m=np.array([[0.0, 0.0], [50.0, 0.0]]), by_class=np.array([[9.0, 1.0], [2.0, 3.0]]), sigma_m=2.0
    ... )
    >>> round(separation_level(two, 1e-2), 1)
    56.1
    """
    without = modes.scores[:, None] - modes.by_class
    highest = without.max(axis=0)
    near = 1e-9 * (1.0 + np.abs(modes.by_class).max())  # ties may differ by rounding
    is_mute = highest - without.min(axis=0) <= near
    if is_mute.any():
        return math.inf
    moved_m = np.where(without >= highest - near, modes.away_m[:, None], 0.0).max(initial=0.0)
    return float(moved_m + sigmas(risk) * modes.sigma_m)


def levels_of(modes: Modes) -> dict[str, float]:
    """Return the `PROTECTION` of an answer by name, metres, without infinite levels."""
    ways = {"separation": separation_level, "gauss": gauss_level, "density": density_level}
    levels = {level_name(method, risk): way(modes, risk) for method, way in ways.items() for risk in RISKS}
    found = {SCALE: posterior_sigma_m(modes), **levels}
    return {name: value for name, value in found.items() if math.isfinite(value)}
