# SPDX-License-Identifier: Apache-2.0
"""`hog_colour`: histograms of oriented gradients and colours of a view, and the tiles of imagery most like it."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.image.dense import (
    MOST_PLACES,
    Question,
    Search,
    Stack,
    answer_candidates,
    answer_places,
    disc_of,
    size_for,
)
from sasgeo_baselines.image.view_image import LIMITS, PICTURE, Ortho, side_of

PIXEL_M: Final = 1.0
CELL_PX: Final = 4  # pixels a side of a cell of the descriptor
BINS: Final = 8  # of the direction of a gradient, over 180 degrees
_LEAST: Final = 1e-3


def descriptors(rgb: NDArray[np.uint8], is_known: NDArray[np.bool_]) -> Stack:
    """Return the descriptor of every cell, float32 of shape (BINS + 3, rows / CELL_PX, cols / CELL_PX).

    Shares of gradients by direction, each as long as strength / (strength + median), then the means of CIELAB; of
    each channel the mean of the surroundings is taken off, and it is divided by its standard deviation.
    """
    cells = _pooled(is_known.astype(np.float32))
    weight = np.maximum(cells, _LEAST)
    lab = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)).astype(np.float32)
    bins, length = _gradients(lab[:, :, 0], is_known)
    planes = [_pooled(np.where(bins == at, length, 0).astype(np.float32)) / weight for at in range(BINS)]
    planes += [_pooled(np.where(is_known, lab[:, :, at], 0).astype(np.float32)) / weight for at in range(3)]
    there = cells > 0.5
    channels = np.stack([_standard(plane.astype(np.float32), there) for plane in planes])
    return Stack(channels=channels, is_known=there)


def _gradients(grey: NDArray[np.float32], is_known: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the bin of the direction of each gradient, and its soft length, 0 beside what is not known."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    right, down = (np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *way)) for way in ((1, 0), (0, 1)))
    strength = np.hypot(right, down)
    inside = np.asarray(cv2.erode(is_known.astype(np.uint8), np.ones((7, 7), dtype=np.uint8))) > 0
    usual = float(np.median(strength[inside])) if inside.any() else 0.0
    length = np.where(inside, strength / np.maximum(strength + usual, _LEAST), 0).astype(np.float32)
    bins = np.floor(np.arctan2(down, right) / np.pi * BINS).astype(np.int64) % BINS
    return bins, length


def _pooled(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return means of cells; the last rows and columns are filled up with nothing."""
    rows, cols = plane.shape
    whole = cv2.copyMakeBorder(plane, 0, -rows % CELL_PX, 0, -cols % CELL_PX, cv2.BORDER_CONSTANT, value=0)
    size = (whole.shape[1] // CELL_PX, whole.shape[0] // CELL_PX)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _standard(plane: NDArray[np.float32], there: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return a channel without the mean of its surroundings, of standard deviation 1, 0 where it is not known."""
    # 8 cells: standard deviation of the surroundings whose mean is taken off
    soft = _mean_around(plane, there, 1.0) - _mean_around(plane, there, 8.0)  # 1: cells lend to their neighbours
    spread = float(soft[there].std()) if there.any() else 0.0
    return np.where(there, soft / max(spread, _LEAST), 0).astype(np.float32)


def _mean_around(plane: NDArray[np.float32], there: NDArray[np.bool_], sigma: float) -> NDArray[np.float32]:
    total, weight = (
        np.asarray(cv2.GaussianBlur(part.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT))
        for part in (np.where(there, plane, 0), there)
    )
    return np.asarray(total / np.maximum(weight, _LEAST), dtype=np.float32)


class HogColour:
    """Nearest tile, among all tiles of the imagery, by the cosine of descriptors of gradients and colours."""

    card = sgb.MatcherCard(
        name="hog_colour",
        version="1",
        title="HOG and colour of tiles of imagery, nearest neighbours",
        source="Histograms of oriented gradients (Dalal and Triggs, CVPR 2005)",
        ours=(
            f"{PICTURE}; cells of 4 m of pixels of 1 m; 8 directions and 3 channels of CIELAB, each less the mean of "
            "its surroundings (standard deviation 32 m) and divided by its standard deviation; a tile around every "
            "cell, at every heading and scale within 2.5 standard deviations, compared by cosine, which orders as "
            "Euclidean distance of unit vectors does"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("image", "imagery"),
        limits=f"Places are middles of cells of 4 m, headings of a lattice; {LIMITS}",
    )

    def __init__(self) -> None:
        self._stack: Stack | None = None

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Describe the imagery."""
        del learned
        ortho = Ortho.of(region, gsd_m=PIXEL_M)
        self._stack = None
        if ortho is not None:
            self._stack, self._grid = descriptors(ortho.rgb, ortho.is_known), ortho.grid.coarsen(CELL_PX)

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Return the most similar tiles, or rank the candidates by the most similar one near each."""
        if self._stack is None:
            return sgb.WITHHELD
        cell_m = CELL_PX * PIXEL_M
        # 2 cells at the edge of a view between two headings
        question = Question.of(query, self._grid, gsd_m=PIXEL_M, step_m=2.0 * cell_m)
        if question is None:
            return sgb.WITHHELD
        size = size_for(question.turns, side_of(query) / cell_m)
        search = Search.of(self._stack, self._grid, question.bounds, margin=size // 2)
        turned = (question.seen_image.turned(turn, size * CELL_PX) for turn in question.turns)
        field = search.field(question.turns, (descriptors(view.rgb, view.is_seen) for view in turned))
        diagnostics = {"peak": field.peak(), "seen_share": float(question.seen_image.is_seen.mean())}
        if query.track == "retrieval":
            return answer_candidates(query, field.near(query.candidates), top_k=top_k, diagnostics=diagnostics)
        most = min(top_k, MOST_PLACES)
        return answer_places(field.best(disc_of(query.prior), most=most + 1), top_k=most, diagnostics=diagnostics)
