# SPDX-License-Identifier: Apache-2.0
"""`maplocnet_regress`: a pose regressed from a coarse surface of scores, without a posterior (MapLocNet)."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.learned import read_learned, sound
from sasgeo_baselines.place_matcher import SPREAD, PlaceMatcher
from sasgeo_bench import (
    PRESENT,
    Disc,
    Evidence,
    Field,
    Grid,
    MatcherCard,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    Template,
    Training,
    VoteGains,
    make_template,
    surface,
    turns_of,
    wrap_deg,
)

CELL_M: Final = 4.0  # of the map that is read
COARSE_M: Final = 16.0  # of a cell of the surface: leaves a residual that a finer search would find
YAW_STEP_DEG: Final = 10.0  # moves the rim of a view by a cell of the surface
LEAST_SHARE: Final = 0.5  # of the view's known cells that the map must know
REACH: Final = 2  # cells to each side of the highest one whose scores are read, and one heading
MOST_EXAMPLES: Final = 400

_FULL: Final = 255
_FORMAT: Final = "maplocnet_regress 1"
_SIDE: Final = 2 * REACH + 1
_SHAPE: Final = (3 * _SIDE**2, 3)  # scores; residuals to the east, north and clockwise, in cells and steps

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Peak:
    """Highest cell of a surface: its pose and score, and the part around it, shape (3, 5, 5), headings first.

    Scores of the part count from that of the highest cell, in standard deviations of the part.
    """

    mode: Mode
    part: Floats


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """Template of a view, the number of classes known in each of its cells, and what is known of its pose."""

    template: Template
    counts: Template
    prior: Prior

    @property
    def yaws_deg(self) -> list[float]:
        """Return headings to try, in equal steps; all around, if nothing is known."""
        turns = turns_of(replace(self.prior, scale_sigma=0.0), spread=SPREAD, step=math.radians(YAW_STEP_DEG))
        return [base.yaw_deg + 90.0 * quarter for quarter in range(turns.quarters) for base in turns.bases]


class MaplocnetRegress(PlaceMatcher[PreparedView]):
    """Highest cell of a coarse surface, moved by a residual that is linear in the scores around it."""

    open_numbers = {"penalty": (0.1, 1.0, 10.0, 100.0, 1000.0, 10000.0)}  # of squared coefficients
    chosen = {"penalty": 100.0}

    card = MatcherCard(
        name="maplocnet_regress",
        version="2",
        title="Control: a pose regressed from a coarse surface of scores",
        source=(
            "Wu et al., MapLocNet: Coarse-to-Fine Feature Registration for Visual Re-Localization in Navigation Maps, "
            "arXiv 2407.08561, for cars and from street level, as reviews describe it: from coarse to fine the pose "
            "is regressed, not searched for, and there is no posterior"
        ),
        ours=(
            "The coarse stage is a surface of three-state votes over the cells known on both sides (cells of 16 m, "
            "headings 10 degrees apart within 2.5 standard deviations of the prior), its highest cell the first pose; "
            "the fine stage a ridge regression of the residual (east, north, heading) from the 5 x 5 cells at three "
            "headings around it, in their standard deviations, learned from the highest cells near true places of "
            "training that are at most 1.5 cells or steps off, each turned by right angles (penalty "
            f"{chosen['penalty']:g}); at most one cell and one step. Untaught it answers with the highest cell"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "A control for integrity: one pose without rivals, margin or confidence, however flat the surface; the "
            "residual only corrects the highest cell; scale is 1; no sequence, no weights by what lasts"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Read the map and the coefficients."""
        self._weights = None if learned is None else weights_of(learned)
        self._field, self._classes = field_of(region), region.classes
        self._factor = max(1, round(COARSE_M / self._field.grid.cell_size_m))
        self._field.level(self._factor)

    def look(self, query: Query) -> PreparedView | None:
        """Return the template of a view; None where it shares no class with the map."""
        seen = query.evidence
        if not any(name in self._classes for name in seen.classes):
            return None
        template, counts = templates_of(seen, self._classes)
        return PreparedView(template=template, counts=counts, prior=query.prior)

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the regressed pose alone."""
        del count
        peak = self.peak(view, disc)
        if peak is None:
            return []
        if self._weights is None:
            return [peak.mode]
        east, north, turn = np.clip(peak.part.ravel() @ self._weights, -1.0, 1.0).tolist()
        pose = peak.mode.pose
        moved = replace(
            pose,
            easting_m=pose.easting_m + COARSE_M * east,
            northing_m=pose.northing_m + COARSE_M * north,
            yaw_deg=pose.yaw_deg + YAW_STEP_DEG * turn,
        )
        return [replace(peak.mode, pose=moved)]

    def peak(self, view: PreparedView, disc: Disc) -> Peak | None:
        """Return the highest cell within a disc, or the nearest one to its middle."""
        west_m, south_m, east_m, north_m = self._field.grid.bounds_m
        center_m = disc.center_m or ((west_m + east_m) / 2, (south_m + north_m) / 2)
        radius_m = disc.radius_m if disc.center_m else math.hypot(east_m - west_m, north_m - south_m) / 2
        nearest_m = np.clip(center_m, (west_m, south_m), (east_m, north_m))
        if np.abs(nearest_m - center_m).max() >= radius_m:
            return None
        around_m = radius_m + (REACH + 1) * COARSE_M
        yaws_deg = view.yaws_deg
        votes, known = (
            surface(
                self._field,
                template,
                center_m=center_m,
                radius_m=around_m,
                yaws_deg=yaws_deg,
                factor=self._factor,
            )
            for template in (view.template, view.counts)
        )
        least = max(1.0, LEAST_SHARE * float(view.counts.known.sum()))
        means = np.where(known.scores >= least, votes.scores / np.maximum(known.scores, 1.0), np.nan).astype(np.float64)
        return peak_of(means, votes.grid, np.array(yaws_deg), Disc(center_m=center_m, radius_m=radius_m))

    def learn(self, training: Training) -> str:
        """Return the coefficients, as JSON."""
        pairs = [pair for pair in training.pairs if pair[0].track == "localization" and pair[1].pose is not None]
        chosen = sorted(pairs[:: -(-len(pairs) // MOST_EXAMPLES) or 1], key=lambda pair: pair[0].region)
        parts, residuals = [np.zeros((0, _SHAPE[0]))], [np.zeros((0, _SHAPE[1]))]
        for name, some in groupby(chosen, key=lambda pair: pair[0].region):
            self.prepare(training.regions[name], None)
            for query, truth in some:
                view = self.look(query)
                if view is None or truth.pose is None:
                    continue
                place_m = (truth.pose.easting_m, truth.pose.northing_m)
                peak = self.peak(view, Disc(center_m=place_m, radius_m=REACH * COARSE_M))
                if peak is not None:
                    turned, missed = examples(peak, truth.pose)
                    # 1.5 cells or steps: a larger residual belongs to another peak, of which the part does not tell
                    if np.abs(missed).max() <= 1.5:
                        parts.append(turned)
                        residuals.append(missed)
        table, wanted = np.concatenate(parts), np.concatenate(residuals)
        weights = np.linalg.solve(table.T @ table + self.numbers["penalty"] * np.eye(_SHAPE[0]), table.T @ wanted)
        return json.dumps({"format": _FORMAT, "weights": weights.round(6).tolist()})


def field_of(region: Region) -> Field:
    """Return a map in cells of about `CELL_M`, which holds thin classes in part."""
    known = region.known()
    factor = max(1, round(CELL_M / region.grid.cell_size_m))
    grid = region.grid.coarsen(factor)
    share = _shrunk(known, factor)
    layers = np.zeros((len(region.classes), *grid.shape), dtype=np.uint8)
    for name, into in zip(region.classes, layers, strict=True):
        into[:] = _shrunk((region.layer(name) == PRESENT) & known, factor)
    return Field.of(grid=grid, layers=layers, known=np.where(share > _FULL // 2, _FULL, 0).astype(np.uint8))


def _shrunk(layer: NDArray[np.bool_], factor: int) -> NDArray[np.uint8]:
    """Return the share of each cell of a grid that is coarser by a factor, 0..255."""
    rows, cols = (-(-size // factor) for size in layer.shape)
    marked = np.zeros((rows * factor, cols * factor), dtype=np.uint8)
    marked[: layer.shape[0], : layer.shape[1]] = layer * np.uint8(_FULL)
    return np.asarray(cv2.resize(marked, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def templates_of(seen: Evidence, classes: Sequence[str]) -> tuple[Template, Template]:
    """Return the votes of a view for the classes of a map, and how many of them are known in each cell."""
    shared = [name for name in seen.classes if name in classes]
    at = [seen.classes.index(name) for name in shared]
    votes = make_template(seen.cells[at], VoteGains.uniform(len(shared)), chances=seen.probabilities()[at])
    weights = np.zeros((len(classes), *seen.shape), dtype=np.float32)
    for name, band in zip(shared, votes, strict=False):
        weights[classes.index(name)] = band
    known, counted = votes[-2:].astype(np.float32)
    cell_m = seen.cell_size_m
    return (
        Template(weights=weights, known=known, cell_size_m=cell_m),
        Template(weights=np.zeros_like(weights), known=counted, cell_size_m=cell_m),
    )


def peak_of(scores: Floats, grid: Grid, yaws_deg: Floats, disc: Disc) -> Peak | None:
    """Return the highest cell of scores, shape (Y, rows, cols), NaN where there are none, within a disc.

    What lies beyond the surface is as high as the nearest cell of it; headings all around have no end.

    Examples
    --------
    >>> scores = np.zeros((1, 3, 3)); scores[0, 1, 2] = 3.0
    >>> grid = Grid(epsg=0, west_m=0.0, north_m=48.0, cell_size_m=16.0, rows=3, cols=3)
    >>> found = peak_of(scores, grid, np.array([90.0]), Disc(center_m=None, radius_m=0.0))
    >>> found.mode.pose.easting_m, found.mode.score, found.part[1, 2].round(2).tolist()
    (40.0, 3.0, [-3.08, -3.08, 0.0, 0.0, 0.0])
    """
    cells = np.argwhere(np.ones(grid.shape, dtype=bool))
    inside = disc.wider(grid.cell_size_m / 2).holds(grid.to_centres_m(cells)).reshape(grid.shape)
    allowed = np.where(inside & ~np.isnan(scores), scores, -np.inf)
    yaw, row, col = (int(at) for at in np.unravel_index(int(allowed.argmax()), scores.shape))
    if not np.isfinite(allowed[yaw, row, col]):
        return None
    easting_m, northing_m = grid.to_centres_m(np.array([(row, col)]))[0].tolist()
    pose = Pose(easting_m=easting_m, northing_m=northing_m, yaw_deg=float(yaws_deg[yaw]))
    level = np.where(np.isnan(scores), np.nanmean(scores), scores)
    is_round = len(yaws_deg) * YAW_STEP_DEG >= 360.0  # degrees
    level = np.pad(level, ((1, 1), (0, 0), (0, 0)), mode="wrap" if is_round else "edge")
    level = np.pad(level, ((0, 0), (REACH, REACH), (REACH, REACH)), mode="edge")
    part = level[yaw : yaw + 3, row : row + _SIDE, col : col + _SIDE] - scores[yaw, row, col]
    return Peak(mode=Mode(pose=pose, score=float(scores[yaw, row, col])), part=part / max(float(part.std()), 1e-9))


def examples(peak: Peak, truth: Pose) -> tuple[Floats, Floats]:
    """Return the part of the surface as four rows, turned by right angles, and the residuals that belong to them.

    A true place to the east of the cell is one to the north of it, once the surface is turned counter-clockwise:

    >>> here = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=350.0)
    >>> peak = Peak(mode=Mode(pose=here, score=1.0), part=np.zeros((3, 5, 5)))
    >>> examples(peak, replace(here, easting_m=8.0, yaw_deg=355.0))[1][:2].tolist()
    [[0.5, 0.0, 0.5], [0.0, 0.5, 0.5]]
    """
    pose = peak.mode.pose
    east, north = (truth.easting_m - pose.easting_m) / COARSE_M, (truth.northing_m - pose.northing_m) / COARSE_M
    turn = float(wrap_deg(truth.yaw_deg - pose.yaw_deg)) / YAW_STEP_DEG
    parts = [np.rot90(peak.part, quarter, axes=(1, 2)).ravel() for quarter in range(4)]
    return np.stack(parts), np.array(
        [(east, north, turn), (-north, east, turn), (-east, -north, turn), (north, -east, turn)]
    ) + 0.0


def weights_of(learned: str) -> Floats:
    """Read the coefficients; raise one line if their text is damaged."""

    def read(saved: dict[str, Any]) -> Floats:
        weights = np.array(saved["weights"], dtype=np.float64)
        is_whole = saved["format"] == _FORMAT and weights.shape == _SHAPE and bool(np.isfinite(weights).all())
        return sound(weights, is_sound=is_whole)

    return read_learned("maplocnet_regress", learned, read)
