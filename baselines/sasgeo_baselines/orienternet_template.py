# SPDX-License-Identifier: Apache-2.0
"""`orienternet_template`: learned templates over learned maps, and a posterior over all poses (OrienterNet)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any, Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.learned_template import (
    CELL_M,
    CHANNELS,
    FULL,
    MARGIN,
    NAME,
    Encoders,
    Floats,
    Tensor,
    TrainingExample,
    agreement,
    cut,
    fitted,
    half_of,
    known_m2,
    shares,
    step_deg_of,
    transformed,
    turned,
    weights_of,
    weights_text,
)
from sasgeo_baselines.maplocnet_regress import field_of
from sasgeo_baselines.place_matcher import AROUND_M, SPREAD, PlaceMatcher
from sasgeo_baselines.segmenters.network import torch_module
from sasgeo_bench import (
    ABSENT,
    PRESENT,
    Disc,
    Evidence,
    Grid,
    Match,
    MatcherCard,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    Training,
    Truth,
    turns_of,
)

APART_M: Final = 25.0  # between two modes; and the mass of a mode lies within
MOST_EXAMPLES: Final = 200

_TILE: Final = 256  # places a side of a tile: bounds the memory of the transforms
_ENCODED: Final = 256  # cells a side of a piece of map that is encoded at a time
_HEADINGS_KEPT: Final = 12  # whose transforms are held at a time
_HEADINGS_AT_ONCE: Final = 4
_CUT_AT_ONCE: Final = 20  # parts of a map, in all its classes
_LOW: Final = -np.inf

Planes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak(Mode):
    """A mode of the posterior; its score is the log-probability of its cell and heading.

    `mass` is the probability within 25 m of it, at any heading; `entropy_bits` that of the place, in cells of 4 m.
    """

    mass: float
    entropy_bits: float


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """Template of a view (`Encoders.template`), the size of its cells, and what is known of its pose."""

    template: Tensor
    cells_m: tuple[float, float]
    prior: Prior

    @property
    def yaws_deg(self) -> list[float]:
        """Return headings to try, in equal steps; all around, if nothing is known."""
        step = math.radians(step_deg_of(self.template.shape[1:], self.cells_m))
        turns = turns_of(replace(self.prior, scale_sigma=0.0), spread=SPREAD, step=step)
        return [base.yaw_deg + 90.0 * quarter for quarter in range(turns.quarters) for base in turns.bases]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Log-likelihood over a square of places.

    Parameters
    ----------
    grid : Grid
        The places, each the centre of a cell.
    top, which, mass : ndarray, shape (rows, cols)
        Log-likelihood at the best heading, minus infinity where no place is; number of that heading; logarithm of the
        sum of likelihoods over all headings.
    """

    grid: Grid
    top: Floats
    which: NDArray[np.int64]
    mass: Floats

    def near(self, point_m: tuple[float, float]) -> NDArray[np.bool_]:
        """Return which places lie nearer than `APART_M` to a point."""
        east_m, north_m = _axes_m(self.grid)
        return np.asarray((north_m[:, None] - point_m[1]) ** 2 + (east_m - point_m[0]) ** 2 < APART_M**2)


@dataclass(kw_only=True)
class Square:
    """A square of places whose likelihoods are added up heading by heading; `allowed` are those that are searched.

    `row` and `col` are of its first cell on the map, beyond which it may reach.
    """

    grid: Grid
    row: int
    col: int
    allowed: NDArray[np.bool_]
    top: Tensor = None
    which: Tensor = None
    mass: Tensor = None

    def add(self, torch: Any, logs: Tensor, first: int) -> None:  # noqa: ANN401 - a module
        """Add log-likelihoods of some headings, shape (Y, rows, cols), from number `first` on."""
        top, which = logs.max(dim=0)
        which, mass = which + first, torch.logsumexp(logs, dim=0)
        if self.top is not None:
            better = top > self.top
            top, which = torch.where(better, top, self.top), torch.where(better, which, self.which)
            mass = torch.logaddexp(self.mass, mass)
        self.top, self.which, self.mass = top, which, mass

    def surface(self) -> Surface:
        """Return what was added up, where places are searched."""
        top, mass = (np.where(self.allowed, one.numpy(), np.float32(_LOW)) for one in (self.top, self.mass))
        return Surface(grid=self.grid, top=top, which=self.which.numpy(), mass=mass)


def _axes_m(grid: Grid) -> tuple[NDArray[Any], NDArray[Any]]:
    rows, cols = grid.shape
    east_m = grid.west_m + (np.arange(cols) + 0.5) * grid.cell_size_m
    return east_m, grid.north_m - (np.arange(rows) + 0.5) * grid.cell_size_m


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """Probability of every place and heading, in surfaces that do not overlap, or count twice where they do.

    Examples
    --------
    Two places a hundred metres apart, one of them three times as likely:

    >>> grid = Grid(epsg=0, west_m=0.0, north_m=100.0, cell_size_m=100.0, rows=1, cols=2)
    >>> logs = np.log(np.array([[3.0, 1.0]], dtype=np.float32))
    >>> surface = Surface(grid=grid, top=logs, which=np.zeros((1, 2), dtype=np.int64), mass=logs)
    >>> [(peak.pose.easting_m, round(peak.mass, 2)) for peak in Posterior(surfaces=[surface], yaws_deg=[0.0]).peaks(5)]
    [(50.0, 0.75), (150.0, 0.25)]
    """

    surfaces: Sequence[Surface]
    yaws_deg: Sequence[float]

    @cached_property
    def total(self) -> float:
        """Return the logarithm of the sum of all likelihoods, minus infinity if there is none."""
        high = max((float(surface.mass.max()) for surface in self.surfaces), default=_LOW)
        if not high > _LOW:
            return _LOW
        return high + math.log(sum(float(np.exp(one.mass.astype(np.float64) - high).sum()) for one in self.surfaces))

    @cached_property
    def entropy_bits(self) -> float:
        """Return the entropy of the place."""
        found = 0.0
        for surface in self.surfaces:
            logs = surface.mass[surface.mass > _LOW].astype(np.float64) - self.total
            found -= float((np.exp(logs) * logs).sum())
        return found / math.log(2)

    def mass_near(self, point_m: tuple[float, float], surfaces: Sequence[Surface]) -> float:
        """Return the probability within `APART_M` of a point, in some of the surfaces."""
        logs = (surface.mass[surface.near(point_m)].astype(np.float64) - self.total for surface in surfaces)
        return min(1.0, sum(float(np.exp(one).sum()) for one in logs))

    def peaks(self, count: int) -> list[Peak]:
        """Return up to `count` modes, best first, `APART_M` from each other."""
        left = [surface.top.copy() for surface in self.surfaces]
        found: list[Peak] = []
        while left and len(found) < count:
            at = int(np.argmax([tops.max() for tops in left]))
            peak = self._peak(self.surfaces[at], left[at], self.surfaces)
            if peak is None:
                break
            found.append(peak)
            for surface, tops in zip(self.surfaces, left, strict=True):
                tops[surface.near((peak.pose.easting_m, peak.pose.northing_m))] = _LOW
        return found

    def best(self, surface: Surface) -> Peak | None:
        """Return the mode of one surface, with the probability of that surface alone."""
        return self._peak(surface, surface.top, [surface])

    def _peak(self, surface: Surface, tops: Floats, around: Sequence[Surface]) -> Peak | None:
        """Return the highest place of a surface as a mode; None if it has none."""
        row, col = (int(at) for at in np.unravel_index(int(tops.argmax()), tops.shape))
        if not tops[row, col] > _LOW:
            return None
        east_m, north_m = surface.grid.to_centres_m(np.array([(row, col)]))[0].tolist()
        return Peak(
            pose=Pose(easting_m=east_m, northing_m=north_m, yaw_deg=self.yaws_deg[int(surface.which[row, col])]),
            score=float(tops[row, col]) - self.total,
            mass=self.mass_near((east_m, north_m), around),
            entropy_bits=self.entropy_bits,
        )


@dataclass(frozen=True, kw_only=True)
class FeatureMap:
    """Channels of a map and, last, its known cells: half precision, shape (CHANNELS + 1, rows, cols)."""

    grid: Grid
    layers: NDArray[np.float16]

    @classmethod
    def of(cls, encoders: Encoders, planes: Planes, has: Floats, grid: Grid) -> Self:
        """Encode a map piece by piece; what an encoder sees of a cell is never cut."""
        torch = encoders.torch
        layers = np.empty((CHANNELS + 1, *grid.shape), dtype=np.float16)
        with torch.inference_mode():
            for row, col, part in grid.windows(_ENCODED):
                shape = (part.rows + 2 * MARGIN, part.cols + 2 * MARGIN)
                piece = shares(cut(planes, row - MARGIN, col - MARGIN, shape))
                found = encoders.features(torch.from_numpy(piece), torch.from_numpy(has)).numpy()
                layers[:, row : row + part.rows, col : col + part.cols] = found[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
        return cls(grid=grid, layers=layers)

    def squares(self, disc: Disc) -> Iterator[Square]:
        """Yield squares of places, all of one size, that hold a disc, or the whole map."""
        top, left, (bottom, right) = 0, 0, self.grid.shape
        if disc.center_m is not None:
            row, col = self.grid.to_cells(np.array([disc.center_m]))[0].tolist()
            reach = math.ceil(disc.radius_m / self.grid.cell_size_m)
            top, left = max(row - reach, 0), max(col - reach, 0)
            bottom, right = min(row + reach + 1, bottom), min(col + reach + 1, right)
        if top < bottom and left < right:
            side = min(_TILE, max(bottom - top, right - left))
            for row in range(top, bottom, side):
                yield from (self.square(row, col, side, disc) for col in range(left, right, side))

    def around(self, pose: Pose) -> Square:
        """Return the square of places around a candidate."""
        disc = Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=AROUND_M)
        reach = math.ceil(AROUND_M / self.grid.cell_size_m)
        row, col = self.grid.to_cells(np.array([disc.center_m]))[0].tolist()
        return self.square(row - reach, col - reach, 2 * reach + 1, disc)

    def square(self, row: int, col: int, side: int, disc: Disc) -> Square:
        """Return a square of places from a cell on; those on the map and within the disc are searched."""
        own, step_m = self.grid.window(row, col, side, side), self.grid.cell_size_m
        points_m = np.stack(np.meshgrid(*_axes_m(own)), axis=-1).reshape(-1, 2)
        west_m, south_m, east_m, north_m = self.grid.bounds_m
        inside = ((points_m > (west_m, south_m)) & (points_m < (east_m, north_m))).all(axis=1)
        allowed = (inside & disc.wider(step_m / 2).holds(points_m)).reshape(own.shape)
        return Square(grid=own, row=row, col=col, allowed=allowed)

    def under(self, square: Square, half: int) -> Floats:
        """Return the channels under all views from a square, which reach `half` cells from their place."""
        side = square.grid.rows + 2 * half
        return cut(self.layers, square.row - half, square.col - half, (side, side)).astype(np.float32)


class OrienternetTemplate(PlaceMatcher[PreparedView]):
    """Posterior over places and headings from a learned template of the view and learned channels of the map."""

    card = MatcherCard(
        name=NAME,
        version="1",
        title="Learned template of the view over learned channels of the map, with a posterior of all poses",
        source=(
            "Sarlin et al., OrienterNet, CVPR 2023: a view from above is inferred with a confidence for each cell, "
            "turned to each heading, correlated by FFT with a map that was encoded too, and divided by the valid "
            "cells; the softmax over places and headings is taught by the likelihood of the true pose. Built from "
            "that description, without its code and weights, which are not free"
        ),
        ours=(
            "No street picture: what is encoded are the three-state class layers of the view, and class layers of the "
            "map in cells of 4 m, each against its usual share, by two kernels of 3 x 3 beside a linear layer, to 8 "
            "channels; sharper for views that know more cells; headings that move the rim by 6 m, of 2.5 standard "
            "deviations of the prior; taught among the 96 x 96 places of a square of 384 m, and turned, mirrored and "
            "partly hidden views; modes 25 m apart, confidence the posterior within 25 m of the first; no prior of "
            "places from the map, and no mean and covariance"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("training",),
        limits=(
            "Needs the extra [torch]; scale is 1; places to 4 m; the posterior takes for granted that the place is "
            "searched, and is calibrated on no other places than it learned from; no sequence, no weights by what "
            "lasts; a detector's own confidence is not read; the same learned text on one machine and thread, others "
            "may round differently"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Encode the map; raise one line without a sound learned text, or PyTorch."""
        if learned is None:
            raise ValueError(f"{self.card.name} needs training: learn from views with true poses first (run --train)")
        classes, weights = weights_of(learned)
        self._encoders = Encoders.of(torch_module(self.card.name), classes, weights)
        planes, has, grid = map_planes(region, classes)
        self._classes = [name for name, there in zip(classes, has, strict=True) if there]
        self._map = FeatureMap.of(self._encoders, planes, has, grid)

    def look(self, query: Query) -> PreparedView | None:
        """Return the template of a view; None where it knows no class of the map."""
        view, cells_m = view_planes(query.evidence, self._encoders.classes)
        at = [self._encoders.classes.index(name) for name in self._classes]
        if not view.reshape(2, len(self._encoders.classes), -1)[:, at].any():
            return None
        torch = self._encoders.torch
        with torch.inference_mode():
            template = self._encoders.template(torch.from_numpy(shares(view)))
        return PreparedView(template=template, cells_m=cells_m, prior=query.prior)

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the best modes of the posterior within a disc."""
        return list(self.posterior(view, list(self._map.squares(disc))).peaks(count))

    def near(self, view: PreparedView, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best pose near each candidate, of one posterior around all of them."""
        posterior = self.posterior(view, [self._map.around(pose) for pose in poses])
        return [posterior.best(surface) for surface in posterior.surfaces]

    def diagnostics(self, view: PreparedView, found: Sequence[Mode]) -> dict[str, float]:
        """Return the probability around the first mode, and the entropy of the place."""
        del view
        first = found[0]
        return {"posterior_mass": first.mass, "entropy_bits": first.entropy_bits} if isinstance(first, Peak) else {}

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the best modes, or rank the candidates; the confidence is the probability around the first one."""
        found = super().match(query, top_k=top_k)
        mass = found.diagnostics.get("posterior_mass")
        return found if mass is None else replace(found, confidence=mass)

    def posterior(self, view: PreparedView, squares: Sequence[Square]) -> Posterior:
        """Return the posterior over squares of places, all of one size."""
        torch, yaws_deg = self._encoders.torch, view.yaws_deg
        with torch.inference_mode():
            for first in range(0, len(yaws_deg), _HEADINGS_KEPT) if squares else ():
                self._add(view, squares, yaws_deg[first : first + _HEADINGS_KEPT], first)
        return Posterior(surfaces=[square.surface() for square in squares], yaws_deg=yaws_deg)

    def _add(self, view: PreparedView, squares: Sequence[Square], yaws_deg: Sequence[float], first: int) -> None:
        torch, step_m = self._encoders.torch, self._map.grid.cell_size_m
        half, places = half_of(view.template.shape[1:], view.cells_m, step_m), squares[0].grid.rows
        side = places + 2 * half
        area_m2 = known_m2(view.template, view.cells_m)
        # 0.5: least share of the view's known cells that the map must know
        sharpness, least = self._encoders.sharpness(area_m2), 0.5 * area_m2 / step_m**2
        laid = turned(torch, view.template, view.cells_m, yaws_deg, step_m=step_m)
        seen, cells = transformed(torch, laid, side), laid[:, CHANNELS].sum(dim=(1, 2))[:, None, None]
        for square in squares:
            under = self._map.under(square, half)
            mapped = transformed(torch, torch.from_numpy(under), side)
            for at in range(0, len(yaws_deg), _HEADINGS_AT_ONCE):
                some = slice(at, at + _HEADINGS_AT_ONCE)
                known = cells[some] if under[-1].all() else None
                means, counts = agreement(torch, seen[some], mapped, places, known)
                logs = torch.where(counts >= least, sharpness * means, _LOW)
                square.add(torch, logs, first + at)

    def learn(self, training: Training) -> str:
        """Return the weights that views with true poses teach, as text."""
        torch = torch_module(self.card.name)
        pairs = [(query, truth) for query, truth in training.pairs if truth.is_present and truth.pose is not None]
        chosen = sorted(pairs[:: -(-len(pairs) // MOST_EXAMPLES) or 1], key=lambda pair: pair[0].region)
        classes = tuple(dict.fromkeys(name for query, _ in chosen for name in query.evidence.classes))
        examples = [
            example
            for name, some in groupby(chosen, key=lambda pair: pair[0].region)
            for example in examples_of(training.regions[name], list(some), classes)
        ]
        if not examples:
            raise ValueError(
                f"{self.card.name}: no view of training lies on its map and knows a class of it: name other tasks"
            )
        return weights_text(classes, fitted(torch, classes, examples))


def view_planes(seen: Evidence, classes: Sequence[str]) -> tuple[Planes, tuple[float, float]]:
    """Return shares of cells of about `CELL_M` where each class is present, then absent; height and width of a cell.

    A view of two by two metres is one cell, which is half a building, half unknown:

    >>> cells = np.array([[[PRESENT, PRESENT], [2, 2]]], dtype=np.uint8)
    >>> view_planes(Evidence(classes=("building",), cells=cells, cell_size_m=1.0), ("water", "building"))[0].ravel()
    array([  0, 128,   0,   0], dtype=uint8)
    """
    rows, cols = (max(1, round(count * seen.cell_size_m / CELL_M)) for count in seen.shape)
    planes = np.zeros((2, len(classes), rows, cols), dtype=np.uint8)
    for at, name in enumerate(classes):
        if name in seen.classes:
            layer = seen.layer(name)
            for state, into in zip((PRESENT, ABSENT), planes[:, at], strict=True):
                marked = (layer == state).astype(np.uint8) * np.uint8(FULL)
                into[:] = cv2.resize(marked, (cols, rows), interpolation=cv2.INTER_AREA)
    cells_m = (seen.shape[0] * seen.cell_size_m / rows, seen.shape[1] * seen.cell_size_m / cols)
    return planes.reshape(-1, rows, cols), cells_m


def map_planes(region: Region, classes: Sequence[str]) -> tuple[Planes, Floats, Grid]:
    """Return shares of each class and, last, known cells; 1 for each class that the map knows of; the grid."""
    field = field_of(region)
    planes = np.zeros((len(classes) + 1, *field.grid.shape), dtype=np.uint8)
    for name, into in zip(classes, planes, strict=False):
        if name in region.classes:
            into[:] = field.layers[region.classes.index(name)]
    planes[-1] = field.known
    has = np.array([name in region.classes for name in classes], dtype=np.float32)
    return planes, has, field.grid


def examples_of(
    region: Region, pairs: Sequence[tuple[Query, Truth]], classes: Sequence[str]
) -> Iterator[TrainingExample]:
    """Yield what views teach, each with the part of the map around it: a whole country is never encoded.

    Views that know no class of the map are left out, and those whose place lies off it.
    """
    on_map = [pair for pair in pairs if _is_on(region.grid, _pose(pair[1]))]
    for first in range(0, len(on_map), _CUT_AT_ONCE):
        some = on_map[first : first + _CUT_AT_ONCE]
        parts = region.cuts([_box(query, truth, region.grid) for query, truth in some])
        for (query, truth), part in zip(some, parts, strict=True):
            example = _example(part, query, _pose(truth), classes)
            if example is not None:
                yield example


def _example(part: Region, query: Query, pose: Pose, classes: Sequence[str]) -> TrainingExample | None:
    """Return what a view teaches on a part of its map, if anything."""
    view, cells_m = view_planes(query.evidence, classes)
    mapped, has, grid = map_planes(part, classes)
    ((across, down),) = grid.to_uv(np.array([(pose.easting_m, pose.northing_m)])).tolist()
    if not mapped[-1, int(down), int(across)] or not view.reshape(2, len(classes), -1)[:, has > 0].any():
        return None
    return TrainingExample(
        name=query.query_id,
        view=view,
        cells_m=cells_m,
        mapped=mapped,
        step_m=grid.cell_size_m,
        has=has,
        place=(down - 0.5, across - 0.5),
        yaw_deg=pose.yaw_deg,
    )


def _is_on(grid: Grid, pose: Pose) -> bool:
    row, col = grid.to_cells(np.array([(pose.easting_m, pose.northing_m)]))[0].tolist()
    return bool(0 <= row < grid.rows and 0 <= col < grid.cols)


def _pose(truth: Truth) -> Pose:
    assert truth.pose is not None  # noqa: S101 - others were left out
    return truth.pose


def _box(query: Query, truth: Truth, grid: Grid) -> tuple[int, int, int, int]:
    """Return the cells that learning may look at around a view: row, column, rows, columns."""
    pose = _pose(truth)
    row, col = grid.to_cells(np.array([(pose.easting_m, pose.northing_m)]))[0].tolist()
    # 400 m around a view and its true place that the map is kept for learning
    reach = math.ceil((math.hypot(*query.evidence.size_m) / 2 + 400.0) / grid.cell_size_m)
    unit = max(1, round(CELL_M / grid.cell_size_m))
    top, left = (row - reach) // unit * unit, (col - reach) // unit * unit
    return top, left, 2 * reach, 2 * reach
