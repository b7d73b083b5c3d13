# SPDX-License-Identifier: Apache-2.0
"""`lsvl_belief`: a belief on a grid, weighed by a fitted ratio of densities of the distance between descriptors."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.grid_filter import LEAST, Floats, GridFilter

CELL_M: Final = 16.0  # of the map
SIDE: Final = 4  # parts of a view along each of its sides

_LEAST_KNOWN: Final = 0.25  # share of a part below which it says nothing
_HALF: Final = 0.5
_FULL: Final = 255


NEAR_M, NEAR_DEG = CELL_M / 2, 5.0  # of a match: half a cell, and half a step of heading
WRONG: Final = 20  # other poses for each view
BINS: Final = 24
MOST: Final = 0.48  # distance of the last bin
# Of `python benchmarks/fit_grid_trackers.py`, on made-up towns that are in no split: the ratio, and the temper and
# doubt with the most belief near the truth. The temper is above 1, since the doubt bounds what a view says.
TEMPER: Final = 2.0
DOUBT: Final = 1e-2
TAUGHT: Final = """{
"distance": [0.01, 0.03, 0.05, 0.07, 0.09, 0.11, 0.13, 0.15, 0.17, 0.19, 0.21, 0.23, 0.25, 0.27, 0.29, 0.31, 0.33,
0.35, 0.37, 0.39, 0.41, 0.43, 0.45, 0.47],
"log": [3.062, 3.062, 3.062, 2.579, 1.472, -0.052, -1.421, -1.421, -1.421, -1.421, -1.929, -2.261, -2.261, -2.261,
-2.261, -2.261, -2.261, -2.261, -2.261, -2.261, -2.261, -2.261, -2.261, -2.261]
}"""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Descriptor of a view: of each part, the square roots of the shares of the classes.

    `roots` and `known` have shape (P, C), `known` is 1 where enough of the part is known to have a share; `places_m`,
    shape (P, 2), are the middles of the parts, right and up, metres.
    """

    roots: Floats
    known: Floats
    places_m: NDArray[np.float64]

    @classmethod
    def of(cls, evidence: sgb.Evidence, classes: Sequence[str]) -> Self:
        """Describe a view in the classes of a map; classes that it lacks are unknown."""
        rows, cols = (count // SIDE * SIDE for count in evidence.shape)
        roots, known = np.zeros((SIDE**2, len(classes))), np.zeros((SIDE**2, len(classes)))
        for at, name in enumerate(classes):
            if name in evidence.classes:
                layer = evidence.layer(name)[:rows, :cols].reshape(SIDE, rows // SIDE, SIDE, cols // SIDE)
                seen = (layer != sgb.UNKNOWN).mean(axis=(1, 3)).ravel()
                present = (layer == sgb.PRESENT).mean(axis=(1, 3)).ravel()
                known[:, at] = seen >= _LEAST_KNOWN
                roots[:, at] = np.sqrt(present / np.maximum(seen, _LEAST_KNOWN)) * known[:, at]
        width_m, height_m = evidence.size_m
        middles = (np.arange(SIDE) + _HALF) / SIDE - _HALF
        up, right = np.meshgrid(-middles * height_m, middles * width_m, indexing="ij")
        return cls(
            roots=roots.astype(np.float32),
            known=known.astype(np.float32),
            places_m=np.column_stack((right.ravel(), up.ravel())),
        )


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Shares of cells that a map's classes cover, uint8 of shape (C, rows, cols), 0..255, and shares that are known."""

    grid: sgb.Grid
    classes: tuple[str, ...]
    present: NDArray[np.uint8]
    known: NDArray[np.uint8]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Read a map in cells of a whole number of its own, of about `CELL_M`."""
        factor = max(1, round(CELL_M / region.grid.cell_size_m))
        grid = region.grid.coarsen(factor)
        is_known = region.known()
        classes = tuple(name for name in region.classes if (region.layer(name) == sgb.PRESENT).any())
        present = np.zeros((len(classes), *grid.shape), dtype=np.uint8)
        for name, into in zip(classes, present, strict=True):
            into[:] = _share((region.layer(name) == sgb.PRESENT) & is_known, grid, factor)
        return cls(grid=grid, classes=classes, present=present, known=_share(is_known, grid, factor))

    def described(self, part_m: float) -> "Described":
        """Average over discs as large as a part of a view, so that the heading does not matter."""
        # Round kernel with a sum of 1
        radius = part_m / math.sqrt(math.pi) / self.grid.cell_size_m
        reach = math.ceil(radius)
        away = np.arange(-reach, reach + 1) ** 2
        kernel = np.clip(radius + _HALF - np.sqrt(away[:, None] + away), 0.0, 1.0).astype(np.float32)
        disc = np.asarray(kernel / kernel.sum())
        known = _averaged(self.known, disc)
        roots = np.zeros(self.present.shape, dtype=np.float32)
        for present, into in zip(self.present, roots, strict=True):
            into[:] = np.sqrt(_averaged(present, disc) / np.maximum(known, _HALF))
        return Described(
            grid=self.grid, classes=self.classes, roots=roots, known=(known >= _HALF).astype(np.float32), part_m=part_m
        )


@dataclass(frozen=True, kw_only=True)
class Described:
    """A map by the square roots of the shares of its classes around each cell, float32 of shape (C, rows, cols).

    `known`, shape (rows, cols), is 1 where at least half of what is around is known. `part_m` is the side of the parts
    of views to compare it with.
    """

    grid: sgb.Grid
    classes: tuple[str, ...]
    roots: Floats
    known: Floats
    part_m: float

    def compared(self, view: Parts, cells: sgb.Grid) -> "Compared":
        """Compare the parts of a view with the map around each of some cells of its grid, on the map or beyond."""
        reach = math.ceil(float(np.hypot(*view.places_m.T).max()) / self.grid.cell_size_m) + 1
        wide = cells.window(-reach, -reach, cells.rows + 2 * reach, cells.cols + 2 * reach)
        corner = self.grid.to_uv(np.array([(wide.west_m, wide.north_m)]))[0]
        into, part = sgb.window_overlap(wide.shape, self.grid.shape, -round(float(corner[1])), -round(float(corner[0])))
        roots, known = self.roots[(slice(None), *part)], self.known[part]
        sums = np.zeros((len(view.roots), *wide.shape), dtype=np.float32)
        counts = np.zeros_like(sums)
        for total, count, own, mask in zip(sums, counts, view.roots, view.known, strict=True):
            total[into] = np.einsum("c,cij->ij", mask, (roots - own[:, None, None]) ** 2) * known
            count[into] = mask.sum() * known
        return Compared(view=view, cells=cells, reach=reach, sums=sums, counts=counts)


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Squared distances between each part of a view and the map around each cell, summed over `counts` classes.

    Both have shape (P, rows + 2 reach, cols + 2 reach). Descriptors of all headings follow by moving the parts: the map
    is averaged over discs, which a turn does not change.
    """

    view: Parts
    cells: sgb.Grid
    reach: int
    sums: Floats
    counts: Floats

    def distances(self, yaw_deg: float) -> Floats:
        """Return root mean square distances of descriptors at a heading, shape (rows, cols); NaN where none is known.

        Places of parts are rounded to whole cells.
        """
        rows, cols = self.cells.shape
        total, count = np.zeros((2, rows, cols), dtype=np.float32)
        shifts = self.view.places_m @ sgb.rotation(yaw_deg).T / self.cells.cell_size_m
        for (east, north), sums, counts in zip(
            shifts.round().astype(int).tolist(), self.sums, self.counts, strict=True
        ):
            row, col = self.reach - north, self.reach + east
            total += sums[row : row + rows, col : col + cols]
            count += counts[row : row + rows, col : col + cols]
        return np.sqrt(total / np.where(count > 0, count, np.float32(np.nan)))


def _share(layer: NDArray[np.bool_], grid: sgb.Grid, factor: int) -> NDArray[np.uint8]:
    """Return the share of each cell of a coarser grid, 0..255."""
    around = [(0, count * factor - size) for count, size in zip(grid.shape, layer.shape, strict=True)]
    marked = np.pad(layer.view(np.uint8) * np.uint8(_FULL), around)
    return np.asarray(cv2.resize(marked, (grid.cols, grid.rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _averaged(shares: NDArray[np.uint8], kernel: Floats) -> Floats:
    """Return shares, 0..1, averaged over a kernel."""
    layer = shares.astype(np.float32) / np.float32(_FULL)
    return np.asarray(cv2.filter2D(layer, -1, kernel, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Ratio:
    """Logarithm of p(distance | match) / p(distance | other place), linear between distances.

    Both have shape (N,); distances ascend, and the ratio falls with them.
    """

    distance: NDArray[np.float64]
    log: NDArray[np.float64]

    @classmethod
    def fitted(cls, right: NDArray[np.float64], wrong: NDArray[np.float64]) -> Self:
        """Fit the ratio of two histograms, each with one count more in every bin, made to fall with the distance.

        >>> rng = np.random.default_rng(0)
        >>> ratio = Ratio.fitted(rng.normal(0.1, 0.03, 500), rng.normal(0.2, 0.03, 5000))
        >>> ratio.at(np.array([0.1, 0.15, 0.2, np.nan])).round().tolist()
        [5.0, 0.0, -4.0, 0.0]
        """
        edges = np.linspace(0.0, MOST, BINS + 1)
        counts = [np.histogram(np.clip(some, 0, MOST), edges)[0] + 1.0 for some in (right, wrong)]
        logs = np.log(counts[0] / counts[0].sum()) - np.log(counts[1] / counts[1].sum())
        return cls(distance=(edges[:-1] + edges[1:]) / 2, log=_falling(logs, counts[0] + counts[1]))

    def to_text(self) -> str:
        """Return the ratio as JSON."""
        return json.dumps({"distance": self.distance.round(4).tolist(), "log": self.log.round(3).tolist()})

    @classmethod
    def of(cls, text: str) -> Self:
        """Read what `to_text` wrote."""
        found = json.loads(text)
        return cls(distance=np.array(found["distance"]), log=np.array(found["log"]))

    def at(self, distances: Floats) -> Floats:
        """Return the logarithm at distances; 0 where the distance is unknown (NaN)."""
        return np.nan_to_num(np.interp(distances, self.distance, self.log), nan=0.0).astype(np.float32)


def _falling(logs: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest sequence that does not rise: neighbours that rise are pooled."""
    blocks: list[list[float]] = []
    for log, weight in zip(logs.tolist(), weights.tolist(), strict=True):
        blocks.append([log, weight, 1])
        while len(blocks) > 1 and blocks[-2][0] < blocks[-1][0]:
            value, mass, count = blocks.pop()
            before = blocks[-1]
            before[0] = (before[0] * before[1] + value * mass) / (before[1] + mass)
            before[1] += mass
            before[2] += count
    return np.concatenate([np.full(int(count), value) for value, _, count in blocks])


class LsvlBelief(GridFilter):
    """Kinnari's belief on a grid, with descriptors of layers in place of learned ones."""

    card = sgb.MatcherCard(
        name="lsvl_belief",
        version="1",
        title="Belief on a grid by descriptors, with a fitted likelihood",
        source=(
            "LSVL (Kinnari, Renzulli, Verdoja and Kyrki, arXiv 2212.03581): descriptors of a grid over the map, a "
            "likelihood fitted to distances of matches and of others, a belief over place and heading"
        ),
        ours=(
            "The descriptor: square roots of the shares of the classes in 4 x 4 parts of the view, of the map in discs "
            "as large as a part around cells of 16 m, at 36 headings (theirs is learned of pictures); the distance, "
            "root mean square over parts and classes known on both sides; the ratio of two histograms of 24 bins, "
            f"made to fall, times {TEMPER:g}, fitted together with the share of views that say nothing, {DOUBT:g}, "
            "which bounds what a view says; where training is given the ratio is fitted to it, and these two stay; "
            "diffusion by the covariance of each increment, 1 km and 90 degrees where the odometer lost its "
            f"way; an estimate is accepted if {LEAST:g} of the belief lies within 25 m"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        trained_on=("four made-up towns that are in no split (benchmarks/fit_grid_trackers.py)",),
        limits=(
            "Scale 1 alone; errors of neighbouring increments count as independent; nothing finds a drone again that "
            "was carried where the belief does not reach; ages of maps are not known to it"
        ),
    )
    exponent_scale = TEMPER
    outlier_probability = DOUBT

    def learn(self, training: sgb.Training) -> str:
        """Fit the ratio to views of training places; without enough of them, return the one that ships."""
        right, wrong = distances(training)
        # 50 views below which a ratio is not fitted
        return Ratio.fitted(right, wrong).to_text() if len(right) >= 50 else TAUGHT

    def read(self, region: sgb.Region, learned: str | None) -> sgb.Grid:
        """Describe a map."""
        self._ratio = Ratio.of(TAUGHT if learned is None else learned)
        self._shares = Shares.of(region)
        # 192 m: views that are expected; the map is described for others when the first one comes
        self._described = self._shares.described(192.0 / SIDE)
        return self._shares.grid

    def logs(self, query: sgb.Query, belief: sgb.GridBelief) -> Floats:
        """Return the fitted ratio at the distance between the descriptors of the view and of each place."""
        part_m = max(query.evidence.size_m) / SIDE
        if not math.isclose(part_m, self._described.part_m):
            self._described = self._shares.described(part_m)
        view = Parts.of(query.evidence, self._described.classes)
        top, left, bottom, right = belief.box
        cells = self._described.grid.window(top, left, bottom - top, right - left)
        compared = self._described.compared(view, cells)
        found = np.empty((len(belief.asked), *belief.shape), dtype=np.float32)
        for into, yaw_deg in zip(found, belief.yaws_deg[belief.asked].tolist(), strict=True):
            logs = np.float32(self.exponent_scale) * self._ratio.at(compared.distances(yaw_deg))
            into[:] = sgb.pooled_logs(logs[None], belief.factor)[0]
        return found


def distances(training: sgb.Training) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances of descriptors at right poses and at others, of all views of known place.

    Right ones are within half a cell and half a step of heading, others anywhere on the same map, farther away than a
    view is wide.
    """
    right, wrong = [], []
    described: dict[str, Described] = {}  # of one map at a time
    for query, truth in training.pairs:
        if truth.pose is None or sgb.is_blind(query):
            continue
        part_m = max(query.evidence.size_m) / SIDE
        found = described.get(query.region)
        if found is None or not math.isclose(found.part_m, part_m):
            found = Shares.of(training.regions[query.region]).described(part_m)
            described = {query.region: found}
        view = Parts.of(query.evidence, found.classes)
        rng = np.random.default_rng(list(query.query_id.encode()))
        right.append(_distance(found, view, near(truth.pose, rng=rng)))
        apart_m = max(query.evidence.size_m)
        wrong += [_distance(found, view, pose) for pose in others(found.grid, truth.pose, apart_m=apart_m, rng=rng)]
    kept = [np.array(some, dtype=np.float64) for some in (right, wrong)]
    return kept[0][np.isfinite(kept[0])], kept[1][np.isfinite(kept[1])]


def near(pose: sgb.Pose, *, rng: np.random.Generator) -> sgb.Pose:
    """Return a pose within half a cell and half a step of heading of another."""
    east_m, north_m, turn_deg = rng.uniform(-1, 1, 3) * (NEAR_M, NEAR_M, NEAR_DEG)
    return sgb.Pose(
        easting_m=pose.easting_m + east_m, northing_m=pose.northing_m + north_m, yaw_deg=pose.yaw_deg + turn_deg
    )


def others(grid: sgb.Grid, pose: sgb.Pose, *, apart_m: float, rng: np.random.Generator) -> Iterator[sgb.Pose]:
    """Yield up to `WRONG` poses anywhere on a map, but for those near another."""
    west_m, south_m, east_m, north_m = grid.bounds_m
    for _ in range(WRONG):
        east, north, yaw_deg = rng.uniform((west_m, south_m, 0.0), (east_m, north_m, 360.0)).tolist()
        if math.dist((east, north), (pose.easting_m, pose.northing_m)) > apart_m:
            yield sgb.Pose(easting_m=east, northing_m=north, yaw_deg=yaw_deg)


def _distance(described: Described, view: Parts, pose: sgb.Pose) -> float:
    row, col = described.grid.to_cells(np.array([(pose.easting_m, pose.northing_m)]))[0].tolist()
    return float(described.compared(view, described.grid.window(row, col, 1, 1)).distances(pose.yaw_deg)[0, 0])
