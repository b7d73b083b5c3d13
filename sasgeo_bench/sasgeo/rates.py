# SPDX-License-Identifier: Apache-2.0
"""Rates of seeing, mapping and ageing of classes, fitted to training views of known place."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import scipy  # its optimizers are loaded where they are used: matchers that do not learn start without them
from numpy.typing import NDArray
from scipy import special

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT
from sasgeo_bench.search.field import round_kernel

RINGS_M: Final = (4.0, 8.0, 12.0)  # around a class: OSM and masks of views are off by some metres each
FAR: Final = len(RINGS_M) + 1
NOWHERE: Final = FAR + 1

_SHARES: Final = ("hit", "false_alarm", "missing", "mapped")
_YEARLY: Final = ("vanish_per_year", "appear_per_year")
_CELLS_PER_WITNESS: Final = 200.0  # a house or a piece of road is right or wrong as a whole
_EDGE: Final = 1e-5  # least distance of probabilities from 0 and 1
_SLACK_M: Final = 1e-3  # tolerance of a distance at the edge of a ring
_WIDE: Final = 16.0  # cells: to mark all cells around a class takes longer than to measure how far they are


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassRates:
    """Rates of seeing, mapping and ageing of one class.

    `hit` and `false_alarm` are the probabilities that a cell is seen as the class where the class is, and where it is
    not; `missing` that the class is on a cell where a map of age 0 lacks it. `vanish_per_year` and `appear_per_year`
    are the yearly rates at which mapped cells vanish and unmapped ones appear. `mapped` is the share of cells on which
    the class is mapped.

    Raises
    ------
    ConfigError
        If a share is not within 0..1, a rate negative or not finite, or a false alarm likelier than a hit.
    """

    hit: float
    false_alarm: float
    missing: float
    vanish_per_year: float
    appear_per_year: float
    mapped: float

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} is a share within 0..1, got {getattr(self, name)!r}")
        for name in _YEARLY:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"{name} is a rate of at least 0 a year, got {value!r}")
        if self.hit < self.false_alarm:
            raise ConfigError(f"a hit cannot be rarer than a false alarm, got {self.hit!r} and {self.false_alarm!r}")

    def survival(self, age_years: float) -> float:
        """Return the probability that a mapped cell still holds the class."""
        return float(np.exp(-self.vanish_per_year * max(age_years, 0.0)))

    def unmapped(self, age_years: float) -> float:
        """Return the probability that an unmapped cell holds the class."""
        return float(1 - (1 - self.missing) * np.exp(-self.appear_per_year * max(age_years, 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """Counts of cells of one view at its true place, by state and distance from the mapped class.

    `seen` and `missed`, shape (C, FAR + 1), count cells seen present and absent: first on the mapped class, then
    within each of `RINGS_M` of it, last farther away. Unknown cells of either side are not counted.
    `block` names the place of the view, `age_years` is the age of the map.
    """

    classes: tuple[str, ...]
    age_years: float
    block: str
    seen: NDArray[np.int64]
    missed: NDArray[np.int64]


def rings(layers: NDArray[np.uint8], *, cell_size_m: float) -> NDArray[np.uint8]:
    """Return the distance of each cell from its class as the index of a ring, shape (C, rows, cols) as `layers`.

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
    """Return the ring of each cell around the marked ones, shape (rows, cols)."""
    if not is_there.any():
        return np.full(is_there.shape, FAR, dtype=np.uint8)
    reaches = [(edge_m + _SLACK_M) / cell_size_m for edge_m in RINGS_M]
    beyond = (~is_there).astype(np.uint8)
    if reaches[-1] > _WIDE:
        distance = cv2.distanceTransform(beyond, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        for reach in reaches:
            beyond += distance > reach
        return beyond
    for reach in reaches:
        beyond += np.asarray(cv2.dilate(is_there.view(np.uint8), round_kernel(reach))) == 0
    return beyond


def tally(
    classes: tuple[str, ...], seen: NDArray[np.uint8], under: NDArray[np.uint8], *, age_years: float, block: str
) -> Tally:
    """Count the cells of a view against `rings` of the map under it, both of shape (C, rows, cols).

    `age_years` is from the map to the view, `block` the place of the view.
    """

    def count(state: int) -> NDArray[np.int64]:
        """Count the cells of a state by ring, shape (C, FAR + 1)."""
        return np.stack(
            [
                np.bincount(ring[view == state], minlength=NOWHERE + 1)[: FAR + 1]
                for view, ring in zip(seen, under, strict=True)
            ]
        )

    return Tally(classes=classes, age_years=age_years, block=block, seen=count(PRESENT), missed=count(ABSENT))


def likeness(tallies: Sequence[Tally]) -> NDArray[np.float64]:
    """Return the likeness of cells near a class to cells on it: 1 on it, 0 far away, shape (C, FAR + 1).

    In each ring it is the logarithm of the share seen present, scaled between cells on the class and far from it. This
    measures for all classes what the paper's exp(-D^2 / 2 tau^2) sets for lines. It never rises with distance.
    """
    share = np.log(_seen_share(tallies))
    span = share[:, :1] - share[:, FAR:]
    ratio = np.where(span > _EDGE, (share - share[:, FAR:]) / np.maximum(span, _EDGE), 0.0)
    ratio[:, 0], ratio[:, FAR] = 1.0, 0.0
    return np.minimum.accumulate(np.clip(ratio, 0.0, 1.0), axis=1)


def missed_share(tallies: Sequence[Tally], near: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the loss for a missed cell per degree of likeness, as a share of the loss on the class, 0..1, shape (C,).

    The score of a cell is linear in the likeness of the map, `near`, of shape (C, FAR + 1), which fits cells seen but
    overstates misses near a class. This is the least-squares slope through the rings, over the step from far away onto
    the class.

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
    """Return the share of cells seen present by ring, shape (C, FAR + 1), with a prior of one unit from far away."""
    seen = np.sum([one.seen for one in tallies], axis=0) / _CELLS_PER_WITNESS
    known = seen + np.sum([one.missed for one in tallies], axis=0) / _CELLS_PER_WITNESS
    far = (seen[:, FAR:] + _EDGE) / (known[:, FAR:] + 2 * _EDGE)
    return np.asarray(np.clip((seen + far) / (known + 1), _EDGE, 1 - _EDGE))


def hand_rates(class_name: str) -> ClassRates:
    """Return rates of a class by hand: yearly ones from the taxonomy, and a detector that is mostly right."""
    hand = load_taxonomy()[class_name].persistence
    return ClassRates(
        hit=0.85,
        false_alarm=0.02,
        missing=1 - hand.prior,
        vanish_per_year=hand.vanish_per_year,
        appear_per_year=hand.appear_per_year,
        mapped=0.05,
    )


def fit_rates(tallies: Sequence[Tally]) -> dict[str, ClassRates]:
    """Fit the rates of every class to views of known place.

    The likelihood is that of `weights.likelihood_gains`, cell by cell. On a map of age 0 nothing is missing, so such
    views separate hits and false alarms from ageing. Cells are not independent: `_CELLS_PER_WITNESS` of them count as
    one against a weak prior around `hand_rates`, which decides alone without data.

    Raises
    ------
    ConfigError
        If there is no tally, or their classes differ.
    """
    if not tallies:
        raise ConfigError("no views to fit rates to: the train part is empty; choose another split, or weights by hand")
    classes = tallies[0].classes
    if any(other.classes != classes for other in tallies):
        raise ConfigError("views to fit rates to have different classes: build their regions with one taxonomy")
    ages_years, age = np.unique([one.age_years for one in tallies], return_inverse=True)
    blocks, block = np.unique([one.block for one in tallies], return_inverse=True)
    counts = np.array([(t.seen[:, 0], t.missed[:, 0], t.seen[:, FAR], t.missed[:, FAR]) for t in tallies])
    sums = np.zeros((len(blocks), len(ages_years), *counts.shape[1:]))
    np.add.at(sums, (block, age), counts)
    return {name: _fitted(hand_rates(name), ages_years, sums[..., at]) for at, name in enumerate(classes)}


def _fitted(hand: ClassRates, ages_years: NDArray[np.float64], counts: NDArray[np.float64]) -> ClassRates:
    """Fit the rates of one class to counts of shape (blocks, ages, 4)."""
    shares = np.clip([hand.hit, hand.false_alarm / hand.hit, hand.missing], _EDGE, 1 - _EDGE)
    yearly = np.maximum([hand.vanish_per_year, hand.appear_per_year], _EDGE)
    start = np.concatenate((special.logit(shares), np.log(yearly)))

    def loss(vector: NDArray[np.float64]) -> float:
        mapped, empty = _chances(vector, ages_years)
        chances = np.stack((mapped, 1 - mapped, empty, 1 - empty), axis=1)
        losses = np.einsum("bak,ak->b", counts, np.log(chances)) / -_CELLS_PER_WITNESS
        # 1.5: width of the prior of logits of shares and logarithms of rates
        return float(losses.sum() + 0.5 * (((vector - start) / 1.5) ** 2).sum())

    total = counts.sum()
    mapped = float(counts[..., :2].sum() / total) if total else hand.mapped
    return _to_rates(scipy.optimize.minimize(loss, start, method="L-BFGS-B").x, mapped=mapped)


def _chances(
    vector: NDArray[np.float64], ages_years: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the probabilities of seeing the class where it is mapped and where it is not, by age."""
    hit, ratio, missing = special.expit(vector[:3])
    false_alarm = hit * ratio
    vanish, appear = np.exp(vector[3:])
    stands = np.exp(-vanish * ages_years)
    came = np.where(ages_years > 0, 1 - (1 - missing) * np.exp(-appear * ages_years), 0.0)
    mapped, empty = (share * hit + (1 - share) * false_alarm for share in (stands, came))
    return np.clip(mapped, _EDGE, 1 - _EDGE), np.clip(empty, _EDGE, 1 - _EDGE)


def _to_rates(vector: NDArray[np.float64], *, mapped: float) -> ClassRates:
    hit, ratio, missing = special.expit(vector[:3]).tolist()
    vanish, appear = np.exp(vector[3:]).tolist()
    return ClassRates(
        hit=hit, false_alarm=hit * ratio, missing=missing, vanish_per_year=vanish, appear_per_year=appear, mapped=mapped
    )
