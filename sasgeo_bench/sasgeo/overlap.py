# SPDX-License-Identifier: Apache-2.0
"""A view held against the map under a pose, class by class: areas on either side, what both hold, what that tells."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.search.field import FULL, Field, between, squares

INDEPENDENT: Final = 20.0  # cells of a view that say something of their own, in each class; from Andorra's picture
FEW_M2: Final = 8.0  # that much of a class varies by chance
LEAST_M2: Final = 4.0  # less is no overlap: a cell of the search
UNLIKE_M2: Final = 400.0  # of a class, of which a view and a map may differ by chance
SEARCHED: Final = 30.0  # nats of a class whose overlap is whole, in a search; as the next two, from train places
RARE_M2: Final = 1000.0  # of a class in a view that count half
CROWDED: Final = 0.03  # charge for a mapped cell, as a share of what one brings that is seen
BADLY_SEEN, BLUNT = 0.2, 0.03  # overlap of lines at which areas have half of their say, and how fast that falls
_MOST_ALIKE: Final = 0.99  # squared correlation
_MOST_FADED: Final = 0.9  # a class that fades less is taken as it is
_LEAST: Final = 1e-6

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Areas of each class under each pose, square metres, shape (M, C), over cells that view and map know.

    `seen` and `mapped` are sums of P(present) and of the degree of the map, `both` that of their product, `seen_twice`
    and `mapped_twice` those of their squares; `known` is the area of the cells. A class that the view lacks has none.
    """

    known: Floats
    seen: Floats
    mapped: Floats
    both: Floats
    seen_twice: Floats
    mapped_twice: Floats

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        classes: Sequence[str],
        field: Field,
        poses: Sequence[Pose],
        *,
        near: Floats | None = None,
    ) -> Self:
        """Compare a view with the map at each pose, in squares of about a cell of the field.

        `near`, shape (C,), is the degree that the field has at most beside a class (`ScorerModel.likeness`): with it
        degrees are those of cells that the class covers, as if nothing faded.

        Examples
        --------
        >>> from sasgeo_bench.geometry.grid import Grid
        >>> grid = Grid(epsg=0, west_m=-4.0, north_m=4.0, cell_size_m=2.0, rows=4, cols=4)
        >>> water, known = np.full((1, 4, 4), FULL, dtype=np.uint8), np.full((4, 4), FULL, dtype=np.uint8)
        >>> water[:, :, 2:] = 0  # in the west
        >>> seen = np.tile([0.3, 0.3, 0.1, 0.1], (1, 4, 1))
        >>> view = Evidence.of_probabilities(("water",), seen, cell_size_m=2.0)
        >>> north, south = (Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg) for yaw_deg in (0.0, 180.0))
        >>> found = Compared.of(view, ("water",), Field.of(grid=grid, layers=water, known=known), [north, south])
        >>> found.mapped.tolist(), found.both.round(1).tolist(), found.overlaps.round(2).tolist()
        ([[32.0], [32.0]], [[9.6], [3.2]], [[0.27], [0.08]])
        >>> found.explained.round(2).tolist()
        [[0.51], [0.0]]
        """
        pool = max(1, round(field.grid.cell_size_m / evidence.cell_size_m))
        names = [name for name in evidence.classes if name in classes and (evidence.layer(name) != UNKNOWN).any()]
        layers, at = [evidence.classes.index(name) for name in names], [classes.index(name) for name in names]
        is_known = evidence.cells[layers] != UNKNOWN
        chances = np.where(is_known, evidence.probabilities()[layers], 0.0)
        bands = np.concatenate((chances, is_known), dtype=np.float32)
        summed, frame = squares(bands, pool, cell_size_m=evidence.cell_size_m)
        seen, known = np.split(summed / pool**2, 2)
        seen = seen / np.maximum(known, _LEAST)
        parts = np.stack((known, known * seen, known * seen**2)).reshape(3, len(at), frame.rows * frame.cols)
        whole = parts.sum(axis=2, dtype=np.float64)
        faded = None if near is None else np.minimum(near[at], _MOST_FADED).astype(np.float32)[:, None]
        found = np.zeros((len(poses), 6, len(classes)))
        for row, pose in zip(found, poses, strict=True):
            under = field.cells.under(between(frame, pose, field.grid), frame.shape)
            degree = np.stack([under.band(one).ravel() for one in (*at, len(classes))]).astype(np.float32) / FULL
            mapped, is_mapped = degree[:-1], degree[-1]
            if faded is not None:  # inverts `raster.read_field`: covered share u has degree u + near (1 - u)
                np.clip((mapped - faded) / (1 - faded), 0, 1, out=mapped)
            if is_mapped.size and is_mapped.min() == 1:  # well inside the map, as most are
                row[:3, at] = whole
            else:
                row[:3, at] = parts @ is_mapped
                mapped *= is_mapped
            row[3, at], row[4, at] = np.vecdot(parts[:2], mapped)
            row[5, at] = np.vecdot(parts[0], mapped * mapped)
        known_m2, seen_m2, seen_twice_m2, mapped_m2, both_m2, mapped_twice_m2 = (
            np.moveaxis(found, 1, 0) * frame.cell_size_m**2
        )
        return cls(
            known=known_m2,
            seen=seen_m2,
            mapped=mapped_m2,
            both=both_m2,
            seen_twice=seen_twice_m2,
            mapped_twice=mapped_twice_m2,
        )

    @property
    def either(self) -> Floats:
        """Return the area that view or map hold of each class, square metres."""
        return self.seen + self.mapped - self.both

    @property
    def overlaps(self) -> Floats:
        """Return the intersection over union of each class, 0..1; 0 where neither side holds it."""
        return np.where(self.either > LEAST_M2, self.both / np.maximum(self.either, LEAST_M2), 0.0)

    @property
    def unlike(self) -> Floats:
        """Return how unlike the amounts of each class are, 0..1: their difference over their sum."""
        return np.asarray(np.abs(self.seen - self.mapped) / (self.seen + self.mapped + UNLIKE_M2))

    @property
    def seen_varies(self) -> Floats:
        """Return the variance of the view within the known cells, times their area."""
        return self.seen_twice - self.seen**2 / np.maximum(self.known, LEAST_M2)

    @property
    def map_varies(self) -> Floats:
        """Return the variance of the map within the known cells, times their area."""
        return self.mapped_twice - self.mapped**2 / np.maximum(self.known, LEAST_M2)

    @property
    def explained(self) -> Floats:
        """Return how well the map explains each class of the view, nats.

        It is -n / 2 ln(1 - r^2), 0 where r is negative: the log-likelihood ratio of a straight line through n
        independent cells against their mean, r the correlation of P(present) with the degree of the map, n
        `INDEPENDENT`. Gains by cell charge what is seen and not mapped; r charges what is mapped and not seen as well,
        and a view that is faint all over as little as a clear one.
        """
        common = self.both - self.seen * self.mapped / np.maximum(self.known, LEAST_M2)
        squared = common**2 / ((self.seen_varies + FEW_M2) * (self.map_varies + FEW_M2))
        is_there = (common > 0) & (self.known >= LEAST_M2)
        return np.where(is_there, -INDEPENDENT / 2 * np.log1p(-np.minimum(squared, _MOST_ALIKE)), 0.0)


def overlap_weights(evidence: Evidence, classes: Sequence[str]) -> NDArray[np.float32]:
    """Return weights of the cells of a view by which a map overlaps it, to first order, nats, shape (C, rows, cols).

    The intersection over union b / (s + m - b) grows with b, what both hold, and falls with m, what the map holds.
    About a place where the map holds as much as the view, s, that is a sum over the cells of the map: each counts
    (p - `CROWDED`) / (s + `RARE_M2`), p being 1 where the view shows the class, 0 elsewhere. So it can be searched for
    in the Fourier domain, as gains are.

    Examples
    --------
    >>> cells = np.zeros((1, 2, 100, 100), dtype=np.uint8)[0]
    >>> cells[0, :10] = 1
    >>> seen = Evidence(classes=("building", "water"), cells=cells, cell_size_m=1.0)
    >>> weights = overlap_weights(seen, ("water", "building"))
    >>> [f"{weight:.5f}" for weight in weights[1, [0, 99], 0]], bool(weights[0].any())
    (['0.01455', '-0.00045'], False)
    """
    weights, area_m2 = np.zeros((len(classes), *evidence.shape), dtype=np.float32), evidence.cell_size_m**2
    for name, cells in zip(evidence.classes, evidence.cells, strict=True):
        seen_m2 = np.count_nonzero(cells == PRESENT) * area_m2
        if name in classes and seen_m2 > LEAST_M2:
            share = SEARCHED * area_m2 / (seen_m2 + RARE_M2)
            each = np.array([-CROWDED, 1 - CROWDED, 0.0], dtype=np.float32)  # absent, present, unknown
            weights[classes.index(name)] = (np.float32(share) * each).take(cells)
    return weights


def overlap_of(compared: Compared, is_line: NDArray[np.bool_], *, is_gated: bool = True) -> Floats:
    """Return the overlap of each pose of a list, shape (M,): that of its lines, and of areas as far as lines are faint.

    Lines last, areas are filled and cleared: where a view shows lines well, at the best of all poses, it is they that
    tell places apart. A detector that errs much loses lines first; then areas have all the say they can get. How well
    lines are seen is told by all their ground as one. Unless it `is_gated`, all classes have their say always.
    `is_line` has shape (C,).

    Examples
    --------
    >>> flat = np.array([[100.0, 100.0]])
    >>> some = [[[100.0, 0.0], [0.0, 100.0]], [[5.0, 0.0], [0.0, 100.0]]]  # lines: seen well, hardly seen
    >>> whole = {name: np.repeat(flat, 2, axis=0) for name in ("known", "seen", "mapped", "seen_twice", "mapped_twice")}
    >>> [overlap_of(Compared(both=np.array(both), **whole), np.array([True, False])).round(2).tolist() for both in some]
    [[1.0, 0.0], [0.03, 1.0]]
    """
    overlaps = compared.overlaps
    of_lines, of_areas = overlaps[:, is_line].sum(axis=1), overlaps[:, ~is_line].sum(axis=1)
    if not is_gated or not len(of_lines):
        return np.asarray(of_lines + of_areas)
    both, either = (areas[:, is_line].sum(axis=1) for areas in (compared.both, compared.either))
    seen = float((both / np.maximum(either, LEAST_M2)).max())
    say = 1 / (1 + np.exp((seen - BADLY_SEEN) / BLUNT))
    return np.asarray(of_lines + say * of_areas)
