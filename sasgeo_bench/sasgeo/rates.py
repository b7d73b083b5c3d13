# SPDX-License-Identifier: Apache-2.0
"""How classes are seen, mapped and outlived: estimated from views whose places are known, on train blocks alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT

RINGS_M: Final = (4.0, 8.0, 12.0)  # around a class: OSM lies a few metres off, masks of views another few
FAR: Final = len(RINGS_M) + 1
NOWHERE: Final = FAR + 1

_SLACK_M: Final = 1e-3  # a distance this much beyond a ring is in it
_SHARES: Final = ("hit", "false_alarm", "missing", "mapped")
_YEARLY: Final = ("vanish_per_year", "appear_per_year")
_CELLS_PER_WITNESS: Final = 200.0  # a house, or a road's width of road: cells that are right or wrong together
_PRIOR_WIDTH: Final = 1.5  # of logits of shares and logarithms of rates
_STEP: Final = 1e-3  # of a numerical slope
_Z: Final = 1.96
_EDGE: Final = 1e-5  # chances are no nearer to 0 or 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassRates:
    """How one class is seen, mapped and outlived.

    Parameters
    ----------
    hit, false_alarm : float
        Chance that a cell is seen as the class where the class is, and where it is not.
    missing : float
        Chance that the class stands on a cell that a map of age 0 does not give it.
    vanish_per_year, appear_per_year : float
        Yearly rates at which what is mapped goes, and comes where nothing is mapped.
    mapped : float
        Share of the cells that maps give the class.

    Raises
    ------
    ConfigError
        If a share is not within 0..1, a rate negative or not finite, or a false alarm likelier than a hit.

    Examples
    --------
    >>> house = ClassRates(
    ...     hit=0.9, false_alarm=0.02, missing=0.01, vanish_per_year=0.01, appear_per_year=0.002, mapped=0.1
    ... )
    >>> round(house.survival(10.0), 3)
    0.905
    """

    hit: float
    false_alarm: float
    missing: float
    vanish_per_year: float
    appear_per_year: float
    mapped: float

    def __post_init__(self) -> None:
        """Refuse what is no rate."""
        for name in _SHARES:
            if not 0 <= getattr(self, name) <= 1:
                message = f"{name} is a share within 0..1, got {getattr(self, name)!r}"
                raise ConfigError(message)
        for name in _YEARLY:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                message = f"{name} is a rate of at least 0 a year, got {value!r}"
                raise ConfigError(message)
        if self.hit < self.false_alarm:
            message = f"a hit cannot be rarer than a false alarm, got {self.hit!r} and {self.false_alarm!r}"
            raise ConfigError(message)

    def survival(self, age_years: float) -> float:
        """Chance that what is mapped still stands."""
        return float(np.exp(-self.vanish_per_year * max(age_years, 0.0)))

    def unmapped(self, age_years: float) -> float:
        """Chance that the class stands where the map does not give it."""
        return float(1 - (1 - self.missing) * np.exp(-self.appear_per_year * max(age_years, 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Cells of one view at its true place, by what was seen and how far away the map has the class.

    `seen` and `missed`, shape (C, FAR + 1), count cells seen present and seen to be absent: first where the map has the
    class, then within each of `RINGS_M` of it, last farther away. What either side does not know is in none.
    `block` is where the view lies, `age_years` how old the map was.
    """

    classes: tuple[str, ...]
    age_years: float
    block: str
    seen: NDArray[np.int64]
    missed: NDArray[np.int64]


def rings(layers: NDArray[np.uint8], *, cell_size_m: float) -> NDArray[np.uint8]:
    """How far each cell is from the nearest of its class, as the index of a ring.

    Parameters
    ----------
    layers : ndarray of uint8, shape (C, rows, cols)
        PRESENT, ABSENT, or more where nothing is known.
    cell_size_m : float
        Side of a cell, metres.

    Returns
    -------
    ndarray of uint8, shape (C, rows, cols)
        0 on the class, i within `RINGS_M[i - 1]`, `FAR` beyond, `NOWHERE` where nothing is known.

    Examples
    --------
    >>> row = np.zeros((1, 1, 20), dtype=np.uint8)
    >>> row[0, 0, 0] = 1
    >>> rings(row, cell_size_m=1.0)[0, 0, [0, 1, 4, 5, 12, 13]].tolist()
    [0, 1, 1, 2, 3, 4]
    """
    made = np.stack([ring_of(layer == PRESENT, cell_size_m=cell_size_m) for layer in layers])
    made[:, (layers > PRESENT).any(axis=0)] = NOWHERE
    return made


def ring_of(is_there: NDArray[np.bool_], *, cell_size_m: float) -> NDArray[np.uint8]:
    """How far each cell is from the nearest that is marked, as `rings` has it, shape (rows, cols).

    Examples
    --------
    >>> ring_of(np.array([[True, False, False]]), cell_size_m=5.0).tolist()
    [[0, 2, 3]]
    """
    if not is_there.any():
        return np.full(is_there.shape, FAR, dtype=np.uint8)
    distance = cv2.distanceTransform((~is_there).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = np.zeros(is_there.shape, dtype=np.uint8)
    for edge_m in (0.0, *RINGS_M):
        beyond += distance > (edge_m + _SLACK_M) / cell_size_m
    return beyond


def tally(
    classes: tuple[str, ...], seen: NDArray[np.uint8], under: NDArray[np.uint8], *, age_years: float, block: str
) -> Tally:
    """Count the cells of a view against the map under it.

    Parameters
    ----------
    classes : tuple of str
        Bands of both.
    seen : ndarray of uint8, shape (C, rows, cols)
        PRESENT, ABSENT or UNKNOWN.
    under : ndarray of uint8, shape (C, rows, cols)
        `rings` of the map, on the lattice of the view.
    age_years : float
        From the map to the view.
    block : str
        Where the view lies: what is resampled for intervals.

    Examples
    --------
    >>> view = np.array([[[1, 1, 0, 2]]], dtype=np.uint8)
    >>> tally(("water",), view, np.array([[[0, 4, 4, 0]]], dtype=np.uint8), age_years=1.0, block="a").seen.tolist()
    [[1, 0, 0, 0, 1]]
    """

    def count(state: int) -> NDArray[np.int64]:
        """Cells of one state by class and ring."""
        return np.stack(
            [
                np.bincount(ring[view == state], minlength=NOWHERE + 1)[: FAR + 1]
                for view, ring in zip(seen, under, strict=True)
            ]
        )

    return Tally(classes=classes, age_years=age_years, block=block, seen=count(PRESENT), missed=count(ABSENT))


def likeness(tallies: Sequence[Tally]) -> NDArray[np.float64]:
    """How much being near a class is like being on it: 1 on it, 0 far away, shape (C, FAR + 1).

    In each ring, the logarithm of the share that was seen present, between those on the class and far away from it:
    what the paper's exp(-D^2 / 2 tau^2) sets by hand for lines, measured for all classes. It never rises with distance.

    Examples
    --------
    >>> seen, missed = np.array([[900, 300, 40, 20, 100]]), np.array([[100, 700, 960, 980, 9900]])
    >>> one = Tally(classes=("building",), age_years=0.0, block="a", seen=seen * 99, missed=missed * 99)
    >>> likeness([one]).round(1).tolist()
    [[1.0, 0.8, 0.3, 0.2, 0.0]]
    """
    share = np.log(_seen_share(tallies))
    span = share[:, :1] - share[:, FAR:]
    ratio = np.where(span > _EDGE, (share - share[:, FAR:]) / np.maximum(span, _EDGE), 0.0)
    ratio[:, 0], ratio[:, FAR] = 1.0, 0.0
    return np.minimum.accumulate(np.clip(ratio, 0.0, 1.0), axis=1)


def missed_share(tallies: Sequence[Tally], near: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much of a miss on a class one degree of its likeness is worth, 0..1, shape (C,).

    The score of a cell is linear in the likeness of the map, `near`, of shape (C, FAR + 1). What is seen follows it by
    its making; what is missed beside a class says less than that. This is the slope of least squares through the rings,
    as a share of the step from far away onto the class.

    Examples
    --------
    >>> seen, missed = np.array([[900, 300, 40, 20, 100]]), np.array([[100, 700, 960, 980, 9900]])
    >>> one = Tally(classes=("building",), age_years=0.0, block="a", seen=seen * 99, missed=missed * 99)
    >>> missed_share([one], likeness([one])).round(1).tolist()
    [0.3]
    """
    share = np.log1p(-_seen_share(tallies))
    step = share - share[:, FAR:]
    cells = np.sum([one.missed for one in tallies], axis=0) + 1.0
    slope = (cells * near * step).sum(axis=1) / (cells * near**2).sum(axis=1)
    down = step[:, 0]
    return np.clip(np.where(down < -_EDGE, slope / np.minimum(down, -_EDGE), 0.0), 0.0, 1.0)


def _seen_share(tallies: Sequence[Tally]) -> NDArray[np.float64]:
    """Share of cells that were seen present by ring, shape (C, FAR + 1); with one witness for what is seen far away."""
    seen = np.sum([one.seen for one in tallies], axis=0) / _CELLS_PER_WITNESS
    known = seen + np.sum([one.missed for one in tallies], axis=0) / _CELLS_PER_WITNESS
    far = (seen[:, FAR:] + _EDGE) / (known[:, FAR:] + 2 * _EDGE)
    return np.asarray(np.clip((seen + far) / (known + 1), _EDGE, 1 - _EDGE))


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedRates:
    """Rates of one class with the 95 % interval of each, and how many views and blocks they come from.

    `lo` and `hi` hold the bounds field by field.
    """

    best: ClassRates
    lo: ClassRates
    hi: ClassRates
    views: int
    blocks: int


def hand_rates(class_name: str) -> ClassRates:
    """Rates of a class before anything was measured: yearly ones from the taxonomy, a detector that is mostly right.

    Examples
    --------
    >>> hand_rates("railway").vanish_per_year
    0.003
    """
    hand = load_taxonomy()[class_name].persistence
    return ClassRates(
        hit=0.85,
        false_alarm=0.02,
        missing=1 - hand.prior,
        vanish_per_year=hand.vanish_per_year,
        appear_per_year=hand.appear_per_year,
        mapped=0.05,
    )


def fit_rates(tallies: Sequence[Tally]) -> Mapping[str, FittedRates]:
    """Estimate the rates of every class from views whose places are known.

    The likelihood is that of `weights.likelihood_gains`, cell by cell; views whose map has age 0 show a world that is
    the map, so nothing can be missing from it there, and they tell hits and false alarms apart from ageing. Cells are
    no independent witnesses: `_CELLS_PER_WITNESS` of them count as one against a weak prior around `hand_rates`, which
    decides alone where there is nothing to learn from. Intervals are normal ones of logits and logarithms, from the
    covariance that is robust to what views of one block have in common (Huber's sandwich).

    Parameters
    ----------
    tallies : sequence of Tally
        Of train blocks; all with the same classes.

    Returns
    -------
    mapping of str to FittedRates
        By class.

    Raises
    ------
    ConfigError
        If there is no tally, or their classes differ.

    Examples
    --------
    >>> seen, missed = np.array([[90_000, 0, 0, 0, 100]]), np.array([[10_000, 0, 0, 0, 900_000]])
    >>> young = Tally(classes=("building",), age_years=0.0, block="a", seen=seen, missed=missed)
    >>> round(fit_rates([young])["building"].best.hit, 2)
    0.9
    """
    if not tallies:
        message = "no views to learn rates from: the train part is empty; choose another split, or weights by hand"
        raise ConfigError(message)
    classes = tallies[0].classes
    if any(other.classes != classes for other in tallies):
        message = "views to learn rates from have different classes: build their regions with one taxonomy"
        raise ConfigError(message)
    ages_years, age = np.unique([one.age_years for one in tallies], return_inverse=True)
    blocks, block = np.unique([one.block for one in tallies], return_inverse=True)
    counts = np.array([(t.seen[:, 0], t.missed[:, 0], t.seen[:, FAR], t.missed[:, FAR]) for t in tallies])
    sums = np.zeros((len(blocks), len(ages_years), *counts.shape[1:]))
    np.add.at(sums, (block, age), counts)
    views = (counts[:, 0] + counts[:, 1] > 0).sum(axis=0)
    return {
        name: _fitted(hand_rates(name), ages_years, sums[..., at], views=int(views[at]))
        for at, name in enumerate(classes)
    }


def _fitted(
    hand: ClassRates, ages_years: NDArray[np.float64], counts: NDArray[np.float64], *, views: int
) -> FittedRates:
    """Rates of one class from counts of shape (blocks, ages, 4)."""
    start = _to_vector(hand)

    def losses(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of each block, all but the prior's."""
        mapped, empty = _chances(vector, ages_years)
        chances = np.stack((mapped, 1 - mapped, empty, 1 - empty), axis=1)
        return np.asarray(np.einsum("bak,ak->b", counts, np.log(chances)) / -_CELLS_PER_WITNESS)

    def loss(vector: NDArray[np.float64]) -> float:
        """Of all blocks and the prior."""
        return float(losses(vector).sum() + 0.5 * (((vector - start) / _PRIOR_WIDTH) ** 2).sum())

    best = optimize.minimize(loss, start, method="L-BFGS-B").x
    deviation = _deviations(losses, best)
    total = counts.sum()
    mapped = float(counts[..., :2].sum() / total) if total else hand.mapped
    low, middle, high = (_to_rates(best + z * deviation, mapped=mapped) for z in (-_Z, 0.0, _Z))
    return FittedRates(best=middle, lo=low, hi=high, views=views, blocks=int(counts.any(axis=(1, 2)).sum()))


def _deviations(
    losses: Callable[[NDArray[np.float64]], NDArray[np.float64]], best: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Standard deviations of a vector at the least sum of the losses of blocks and of the prior, robust to blocks."""
    steps = _STEP * np.eye(len(best))
    slopes = np.stack([(losses(best + step) - losses(best - step)) / (2 * _STEP) for step in steps])

    def slope(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of the sum of all blocks."""
        return np.array([(losses(vector + step) - losses(vector - step)).sum() / (2 * _STEP) for step in steps])

    bend = np.stack([(slope(best + step) - slope(best - step)) / (2 * _STEP) for step in steps])
    bend = (bend + bend.T) / 2 + np.eye(len(best)) / _PRIOR_WIDTH**2
    inner = slopes @ slopes.T + np.eye(len(best)) / _PRIOR_WIDTH**2
    back = np.linalg.pinv(bend)
    return np.asarray(np.sqrt(np.clip(np.diag(back @ inner @ back), 0, None)))


def _chances(
    vector: NDArray[np.float64], ages_years: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Chances to see the class where it is mapped and where it is not, by age."""
    hit, ratio, missing = special.expit(vector[:3])
    false_alarm = hit * ratio
    vanish, appear = np.exp(vector[3:])
    stands = np.exp(-vanish * ages_years)
    came = np.where(ages_years > 0, 1 - (1 - missing) * np.exp(-appear * ages_years), 0.0)
    mapped, empty = (share * hit + (1 - share) * false_alarm for share in (stands, came))
    return np.clip(mapped, _EDGE, 1 - _EDGE), np.clip(empty, _EDGE, 1 - _EDGE)


def _to_vector(rates: ClassRates) -> NDArray[np.float64]:
    shares = np.clip([rates.hit, rates.false_alarm / rates.hit, rates.missing], _EDGE, 1 - _EDGE)
    yearly = np.maximum([rates.vanish_per_year, rates.appear_per_year], _EDGE)
    return np.concatenate((special.logit(shares), np.log(yearly)))


def _to_rates(vector: NDArray[np.float64], *, mapped: float) -> ClassRates:
    hit, ratio, missing = special.expit(vector[:3]).tolist()
    vanish, appear = np.exp(vector[3:]).tolist()
    return ClassRates(
        hit=hit,
        false_alarm=hit * ratio,
        missing=missing,
        vanish_per_year=vanish,
        appear_per_year=appear,
        mapped=mapped,
    )
