# SPDX-License-Identifier: Apache-2.0
"""Rules of the graph as statistics of training views: how matched nodes differ at the true pose, and at wrong ones.

Every number is the plain statistic of what it stands for, mixed with its starting value, which counts as `WEIGHT`
observations. None was chosen by the success of a matcher.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import nnls

from sasgeo_bench.sasgeo.graph import START, Matching
from sasgeo_bench.sasgeo.graph_rules import GraphRules
from sasgeo_bench.sasgeo.nodes import Floats, Ints

ROUNDS: Final = 2  # the second assigns with what the first found
WEIGHT: Final = 30.0  # observations that a starting value counts as
INSIDE: Final = 0.95  # share of right matches that gate and common shift leave room for
OUTLYING: Final = 3.0  # standard deviations
_BROAD: Final = 2.0  # of tolerances while rules are estimated
_LEAST_SHARE: Final = 0.01  # and most, 1 less it
_LEAST: Final = 0.1  # of a statistic, in units of its starting value: vectors are rounded to a decimetre
_TOLERANCES: Final = ("gate_m", "place_sigma_m", "arm_sigma_deg", "area_sigma")
_BINS: Final = 4  # of distances between neighbours
_NORMAL: Final = 1.4826  # standard deviation over median deviation
_RAYLEIGH_2: Final = 2 * np.log(2)  # median of a squared length over the variance of each axis


def broadened(rules: GraphRules) -> GraphRules:
    """Return rules for matching nodes while rules are estimated.

    Tolerances are twice as broad as the starting values and these rules: else each round would match fewer nodes that
    are off, and narrow the next. Degrees say nothing: else nodes of wrong places would be matched where their degrees
    agree, and agreement would look common there.
    """
    wide = {name: _BROAD * max(getattr(rules, name), getattr(START, name)) for name in _TOLERANCES}
    return replace(rules, degrees=(0.0,) * len(rules.degrees), **wide)


def fit_rules(right: Sequence[Matching], wrong: Sequence[Matching]) -> GraphRules:
    """Estimate the rules from matchings at the true poses of views, and at wrong poses that a search found.

    Standard deviations are robust (1.48 median deviations), gate and common shift quantiles, ratios of degrees and
    links the logarithms of their frequencies at right poses over those at wrong ones, hits and extra nodes frequencies.
    Strain is the line through median squared strains against squared distances. `area_spread` is the plain standard
    deviation of mapped areas, `stretch_m` the median distance of neighbours, `edge_weight` matched nodes for each pair
    of them, `wander` the share of offsets beyond three standard deviations.
    """
    offset_m, areas, edges = (np.concatenate([getattr(one, name) for one in right]) for name in _POINTS)
    length_m, arms_deg = np.hypot(*offset_m.T), np.concatenate([one.arms_deg for one in right])
    common_m = np.concatenate([one.common_m for one in right])
    sigma_m = _spread(offset_m.ravel(), START.place_sigma_m)
    far = int((length_m > OUTLYING * sigma_m).sum())
    constant_m, strain = _strain(edges)
    hit, extra = _kinds(np.sum([one.kinds for one in right], axis=0))
    links = _ratios([one.links for one in right], [one.links for one in wrong], _LINKS)
    return GraphRules(
        gate_m=_mixed(_quantile(length_m), START.gate_m, len(length_m)),
        place_sigma_m=sigma_m,
        shift_m=_mixed(_quantile(common_m), START.shift_m, len(common_m)),
        stretch_m=_mixed(_median(edges[:, 0]), START.stretch_m, len(edges)),
        wander=_share(far, len(length_m), START.wander),
        arm_sigma_deg=_spread(arms_deg, START.arm_sigma_deg),
        area_sigma=_spread(areas[:, 0] - areas[:, 1], START.area_sigma),
        area_spread=_mixed(float(areas[:, 1].std()) if len(areas) else 0.0, START.area_spread, len(areas)),
        degrees=_ratios([one.degrees for one in right], [one.degrees for one in wrong], START.degrees),
        edge_sigma_m=constant_m,
        edge_strain=strain,
        edge_weight=_mixed(min(1.0, len(length_m) / max(len(edges), 1)), START.edge_weight, len(edges)),
        link=links[0],
        false_link=links[1],
        lost_link=links[2],
        hit=hit,
        extra=extra,
    )


_POINTS: Final = ("offset_m", "areas", "edges")
_LINKS: Final = (START.link, START.false_link, START.lost_link)


def _mixed(found: float, start: float, count: int) -> float:
    """Return a positive statistic of so many observations, mixed with its starting value by logarithms."""
    ratio = max(found / start, _LEAST)
    return start * float(ratio ** (count / (count + WEIGHT)))


def _median(values: Floats) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _quantile(values: Floats) -> float:
    return float(np.quantile(values, INSIDE)) if len(values) else 0.0


def _spread(values: Floats, start: float) -> float:
    """Return the robust standard deviation of values around 0."""
    return _mixed(_NORMAL * _median(np.abs(values)), start, len(values))


def _share(count: int, total: int, start: float) -> float:
    return float(np.clip((count + WEIGHT * start) / (total + WEIGHT), _LEAST_SHARE, 1 - _LEAST_SHARE))


def _kinds(counts: Ints) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return hits and extra nodes of each kind, from `Matching.kinds`."""
    due, matched, seen, free = counts.tolist()
    hit = tuple(map(_share, matched, due, START.hit))
    return hit, tuple(map(_share, free, seen, START.extra))


def _strain(edges: Floats) -> tuple[float, float]:
    """Return the constant, metres, and the strain of the relative place of neighbours at a distance."""
    if len(edges) < _BINS:
        return START.edge_sigma_m, START.edge_strain
    order = np.argsort(edges[:, 0], kind="stable")
    bins = [edges[rows] for rows in np.array_split(order, _BINS)]
    squares = np.array([(np.median(part[:, 0] ** 2), np.median(part[:, 1] ** 2) / _RAYLEIGH_2) for part in bins])
    (constant, slope), _ = nnls(np.column_stack((np.ones(_BINS), squares[:, 0])), squares[:, 1])
    return (
        _mixed(float(np.sqrt(constant)), START.edge_sigma_m, len(edges)),
        _mixed(float(np.sqrt(slope)), START.edge_strain, len(edges)),
    )


def _ratios(right: Sequence[Ints], wrong: Sequence[Ints], start: Sequence[float]) -> tuple[float, ...]:
    """Return log ratios of the frequencies of some outcomes, right over wrong, mixed with starting values.

    One observation of each outcome is shared out by the totals, so that what was never seen has ratio 0. A ratio counts
    by its precision, a starting value as known to within one nat.
    """
    here, there = (np.sum([*counts, np.zeros(len(start))], axis=0) for counts in (right, wrong))
    if not (here.sum() and there.sum()):
        return tuple(start)
    total = here.sum() + there.sum()
    here, there = here + here.sum() / total, there + there.sum() / total
    found = np.log(here / here.sum()) - np.log(there / there.sum())
    precision = here * there / (here + there)
    return tuple(((precision * found + np.array(start)) / (precision + 1)).tolist())
