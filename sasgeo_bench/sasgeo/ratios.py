# SPDX-License-Identifier: Apache-2.0
"""Log-likelihood ratios of equal degrees, areas and arms of two nodes, and their parameters."""

from dataclasses import dataclass

import numpy as np

from sasgeo_bench.geometry.angles import wrap_deg
from sasgeo_bench.sasgeo.nodes import Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphRules:
    """Tolerances and likelihood ratios, set by hand.

    Parameters
    ----------
    gate_m : float
        Largest offset of a node: twice the errors of maps and detectors, and that of a search.
    place_sigma_m : float
        Standard deviation of the place of a node, each axis: 4 m of the map, 3 m of the pose, some metres of a warp.
    warp_m, stretch_m : float
        Largest common shift of neighbouring nodes, and its correlation length: after a first assignment the gate moves
        with the neighbours. This tolerates warps of 15 m rms with waves of 60 m and more.
    wander : float
        Probability that the place, an arm or the area of a right match is an outlier.
    arm_sigma_deg, area_sigma : float
        Standard deviations of the direction of an arm, and of the logarithm of an area.
    area_spread : float
        Standard deviation of the logarithm of areas of different houses.
    degrees : tuple of float
        Log-likelihood ratios of degrees that are equal, differ by one, and by more.
    edge_sigma_m, edge_strain : float
        Standard deviation of the relative place of two neighbours: a constant, and a part of their distance. A warp of
        10 m rms with waves of 90 m strains by 0.4, a heading error of 3 degrees by 0.05.
    edge_weight : float
        Weight of a pair of neighbours. A node has about six, which share its place.
    link, false_link, lost_link : float
        Log-likelihood ratios of a way between two nodes on both sides, in the view alone, on the map alone.
    """

    gate_m: float = 12.0
    place_sigma_m: float = 6.0
    warp_m: float = 20.0
    stretch_m: float = 35.0
    wander: float = 0.05
    arm_sigma_deg: float = 15.0
    area_sigma: float = 0.2
    area_spread: float = 0.8
    degrees: tuple[float, float, float] = (0.4, -1.2, -2.5)
    edge_sigma_m: float = 2.0
    edge_strain: float = 0.12
    edge_weight: float = 0.25
    link: float = 0.6
    false_link: float = -1.5
    lost_link: float = -0.7


def by_degree(seen: Ints, mapped: Ints, rules: GraphRules) -> Floats:
    """Return the ratios of degrees; 0 where either is unknown, shape (P,).

    Examples
    --------
    >>> by_degree(np.array([3, 3, 0]), np.array([3, 4, 3]), GraphRules()).tolist()
    [0.4, -1.2, 0.0]
    """
    off = np.minimum(np.abs(seen - mapped), len(rules.degrees) - 1)
    return np.where((seen > 0) & (mapped > 0), np.array(rules.degrees)[off], 0.0)


def by_area(seen_m2: Floats, mapped_m2: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of equal against unrelated areas; 0 where there are none, shape (P,).

    Examples
    --------
    >>> by_area(np.array([100.0, 100.0, np.nan]), np.array([100.0, 300.0, 50.0]), GraphRules()).round(1).tolist()
    [1.7, -3.0, 0.0]
    """
    off = np.log(seen_m2 / mapped_m2)
    spread = 2**0.5 * rules.area_spread
    right = np.exp(-(off**2) / (2 * rules.area_sigma**2)) / rules.area_sigma
    chance = np.exp(-(off**2) / (2 * spread**2)) / spread
    ratio = np.log((1 - rules.wander) * right + rules.wander * chance) - np.log(chance)
    return np.where(np.isfinite(ratio), ratio, 0.0)


def by_arms(seen_deg: Floats, mapped_deg: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of seen arms and the nearest mapped ones; 0 where either side has none, shape (P,).

    Examples
    --------
    >>> by_arms(np.array([[10.0], [90.0]]), np.array([[0.0, 180.0]] * 2), GraphRules()).round(1).tolist()
    [1.3, -3.0]
    """
    off_deg = np.abs(wrap_deg(seen_deg[:, :, None] - mapped_deg[:, None, :]))
    count = np.isfinite(mapped_deg).sum(axis=1, keepdims=True)
    nearest = np.where(np.isfinite(off_deg), off_deg, np.inf).min(axis=2, initial=np.inf)
    counts = np.isfinite(nearest)
    nearest = np.where(counts, nearest, 0.0)
    right = np.exp(-(nearest**2) / (2 * rules.arm_sigma_deg**2)) * (2 / np.pi) ** 0.5 / rules.arm_sigma_deg
    chance = np.maximum(count, 1) / 180.0
    ratio = np.log((1 - rules.wander) * right / chance + rules.wander)
    return np.asarray(np.where(counts, ratio, 0.0).sum(axis=1))
