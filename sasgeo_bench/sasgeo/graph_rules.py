# SPDX-License-Identifier: Apache-2.0
"""Numbers of the graph score, Eq. 9: tolerances, likelihood ratios, and what each kind of node is worth."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, Self

import numpy as np

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.sasgeo.nodes import INDEX, NODE_KINDS, Floats, Ints

DEGREES: Final = 3  # equal degrees, degrees that differ by one, and by more
_OF_KINDS: Final = ("hit", "extra")
_RATIOS: Final = ("degrees", "link", "false_link", "lost_link")  # the rest is positive


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphRules:
    """Tolerances and likelihood ratios of nodes and of their relations.

    The defaults are starting values: guesses from how far maps and odometry are off, before any view was seen.
    `rule_fitting.fit_rules` replaces the ratios, hits and extra nodes by statistics of training views; tolerances stay.

    Parameters
    ----------
    gate_m : float
        Largest offset of a node.
    place_sigma_m : float
        Standard deviation of an offset, each axis.
    shift_m, stretch_m : float
        Largest shift that neighbouring nodes have in common, and the distance over which they have it: after a first
        assignment the gate moves with the neighbours.
    wander : float
        Probability that the place, an arm or the area of a right match is an outlier.
    arm_sigma_deg : float
        Standard deviation of the direction of a road at a junction.
    area_sigma, area_spread : float
        Standard deviation of the logarithm of an area, and that among different houses.
    degrees : tuple of float
        Log ratios of degrees that are equal, differ by one, and by more.
    edge_sigma_m, edge_strain : float
        Standard deviation of the relative place of two neighbours, each axis: a constant, and a part of their distance.
    edge_weight : float
        Of a pair of neighbours: several pairs share one node.
    link, false_link, lost_link : float
        Log ratios of a way between two nodes on both sides, in the view alone, and on the map alone.
    hit, extra : tuple of float
        For each of `NODE_KINDS`: the probability that a visible map node is seen, and the share of seen nodes that no
        map has.

    Raises
    ------
    ConfigError
        If a number is not finite or out of range.
    """

    gate_m: float = 12.0
    place_sigma_m: float = 6.0
    shift_m: float = 20.0
    stretch_m: float = 35.0
    wander: float = 0.05
    arm_sigma_deg: float = 15.0
    area_sigma: float = 0.2
    area_spread: float = 0.8
    degrees: tuple[float, ...] = (0.4, -1.2, -2.5)
    edge_sigma_m: float = 2.0
    edge_strain: float = 0.12
    edge_weight: float = 0.25
    link: float = 0.6
    false_link: float = -1.5
    lost_link: float = -0.7
    hit: tuple[float, ...] = tuple(kind.hit for kind in NODE_KINDS)
    extra: tuple[float, ...] = tuple(kind.extra for kind in NODE_KINDS)

    def __post_init__(self) -> None:
        for item in fields(self):
            values = np.atleast_1d(getattr(self, item.name))
            fits = np.isfinite(values) if item.name in _RATIOS else np.isfinite(values) & (values > 0)
            if item.name in (*_OF_KINDS, "wander"):
                fits &= values < 1
            if not fits.all():
                raise ConfigError(f"{item.name} of the graph is out of range: {getattr(self, item.name)!r}")
        if (len(self.degrees), len(self.hit), len(self.extra)) != (DEGREES, len(NODE_KINDS), len(NODE_KINDS)):
            raise ConfigError(f"the graph has {DEGREES} ratios of degrees and {len(NODE_KINDS)} kinds of nodes")

    def to_stored(self) -> dict[str, Any]:
        """Return the numbers for JSON, those of kinds by name."""
        return asdict(self) | {
            name: {kind.name: value for kind, value in zip(NODE_KINDS, getattr(self, name), strict=True)}
            for name in _OF_KINDS
        }

    @classmethod
    def from_stored(cls, stored: Mapping[str, Any]) -> Self:
        """Read what `to_stored` returns; raise KeyError, TypeError or ConfigError for anything else."""
        by_kind = {name: tuple(float(stored[name][kind]) for kind in INDEX) for name in _OF_KINDS}
        return cls(**{**stored, **by_kind, "degrees": tuple(stored["degrees"])})


def by_degree(seen: Ints, mapped: Ints, rules: GraphRules) -> Floats:
    """Return the ratios of degrees; 0 where either is unknown, shape (P,)."""
    return np.where((seen > 0) & (mapped > 0), np.array(rules.degrees)[degree_step(seen, mapped)], 0.0)


def degree_step(seen: Ints, mapped: Ints) -> Ints:
    """Return by how much degrees differ, as an index of `GraphRules.degrees`, shape (P,)."""
    return np.asarray(np.minimum(np.abs(seen - mapped), DEGREES - 1))


def by_area(seen_m2: Floats, mapped_m2: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of equal against unrelated areas; 0 where there are none, shape (P,)."""
    off = np.log(seen_m2 / mapped_m2)
    has_both = np.isfinite(off)
    off = np.where(has_both, off, 0.0)
    spread = 2**0.5 * rules.area_spread
    right = np.log(spread / rules.area_sigma) + off**2 / 2 * (1 / spread**2 - 1 / rules.area_sigma**2)
    return np.where(has_both, np.logaddexp(np.log1p(-rules.wander) + right, np.log(rules.wander)), 0.0)


def by_arms(seen_deg: Floats, mapped_deg: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of seen arms and the nearest mapped ones; 0 where either side has none, shape (P,)."""
    count = np.isfinite(mapped_deg).sum(axis=1, keepdims=True)
    nearest = arm_offsets_deg(seen_deg, mapped_deg)
    counts = np.isfinite(nearest)
    nearest = np.where(counts, nearest, 0.0)
    right = np.exp(-(nearest**2) / (2 * rules.arm_sigma_deg**2)) * (2 / np.pi) ** 0.5 / rules.arm_sigma_deg
    chance = np.maximum(count, 1) / 180.0
    ratio = np.log((1 - rules.wander) * right / chance + rules.wander)
    return np.asarray(np.where(counts, ratio, 0.0).sum(axis=1))


def arm_offsets_deg(seen_deg: Floats, mapped_deg: Floats) -> Floats:
    """Return the angle from each seen arm to the nearest mapped one, shape (P, MOST_ARMS); infinite without one."""
    off_deg = np.abs(wrap_deg(seen_deg[:, :, None] - mapped_deg[:, None, :]))
    return np.asarray(np.where(np.isfinite(off_deg), off_deg, np.inf).min(axis=2, initial=np.inf))
