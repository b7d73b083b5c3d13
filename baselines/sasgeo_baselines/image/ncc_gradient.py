# SPDX-License-Identifier: Apache-2.0
"""`ncc_gradient`: directions of the gradients of a picture against those of the imagery, by cross-correlation."""

from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.image.dense import (
    MOST_PLACES,
    Field,
    Question,
    Search,
    Stack,
    answer_candidates,
    answer_places,
    disc_of,
    size_for,
)
from sasgeo_baselines.image.view_image import (
    LIMITS,
    MASKED,
    PICTURE,
    Ortho,
    ViewImage,
    grey_of,
    side_of,
    under_roofs,
    view_image,
)

COARSE_M: Final = 2.0  # pixels of the search
FINE_M: Final = 1.0  # of the local one that follows
_RIM_PX: Final = 3  # beside what is not known, a gradient is that of the rim
_STEP: Final = 2.0  # pixels at the edge of a view between two headings


def directions(grey: NDArray[np.uint8], is_known: NDArray[np.bool_]) -> Stack:
    """Return cosine and sine of twice the direction of the gradient, shape (2, rows, cols), softly of length 1.

    A gradient of the median strength has length 1/2, so that neither brightness nor contrast counts; twice the
    direction makes no difference between light on dark and dark on light.

    >>> ramp = np.tile(np.arange(0, 160, 10, dtype=np.uint8), (16, 1))
    >>> found = directions(ramp, np.ones((16, 16), dtype=bool)).channels[:, 8, 8]
    >>> [round(float(value), 2) for value in found]
    [0.5, 0.0]
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    right, down = (np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *way)) / 8 for way in ((1, 0), (0, 1)))
    strength = np.hypot(right, down)
    rim = np.ones((2 * _RIM_PX + 1,) * 2, dtype=np.uint8)
    inside = np.asarray(cv2.erode(is_known.astype(np.uint8), rim)) > 0
    usual = float(np.median(strength[inside])) if inside.any() else 0.0
    length = np.where(inside, 1 / np.maximum(strength * (strength + usual), 1e-6), 0)
    channels = np.stack([(right**2 - down**2) * length, 2 * right * down * length])
    return Stack(channels=channels.astype(np.float32), is_known=inside)


class NccGradient:
    """Normalized cross-correlation of the directions of gradients, at every place, heading and scale."""

    card = sgb.MatcherCard(
        name="ncc_gradient",
        version="1",
        title="Directions of gradients against imagery, by cross-correlation",
        source="Orientation correlation (Fitch et al., BMVC 2002), as normalized cross-correlation under a mask",
        ours=(
            f"{PICTURE}; twice the direction, its length strength / (strength + median); pixels of 2 m at every place, "
            "heading and scale within 2.5 standard deviations, then pixels of 1 m around the best ten; candidates by "
            "the best pose within 24 m, pixels of 2 m"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("image", "imagery"),
        limits=f"Slow where the heading is unknown; half of the view must be on the imagery; {LIMITS}",
    )

    is_masked = False  # roofs of the map count as unknown

    def __init__(self) -> None:
        self._grey: NDArray[np.uint8] | None = None

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Read the imagery and take its gradients."""
        del learned
        fine, coarse = (Ortho.of(region, gsd_m=gsd_m) for gsd_m in (FINE_M, COARSE_M))
        self._grey = None
        if fine is None or coarse is None:
            return
        self._grey, self._known, self._fine = grey_of(fine.rgb, fine.is_known), fine.is_known, fine.grid
        self._grid = coarse.grid
        self._is_kept, is_kept = (
            ~under_roofs(region, grid) if self.is_masked else np.ones(grid.shape, dtype=bool)
            for grid in (self._fine, self._grid)
        )
        self._stack = _where(directions(grey_of(coarse.rgb, coarse.is_known), coarse.is_known), is_kept)

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Return the best poses, or rank the candidates by the best pose near each."""
        if self._grey is None:
            return sgb.WITHHELD
        question = Question.of(query, self._grid, gsd_m=COARSE_M, step_m=_STEP * COARSE_M)
        if question is None:
            return sgb.WITHHELD
        field = _search(self._stack, self._grid, question)
        diagnostics = {"peak": field.peak(), "seen_share": float(question.seen_image.is_seen.mean())}
        if query.track == "retrieval":
            return answer_candidates(query, field.near(query.candidates), top_k=top_k, diagnostics=diagnostics)
        disc = disc_of(query.prior)
        modes = field.best(disc, most=min(top_k, MOST_PLACES) + 1)
        finer = view_image(query, gsd_m=FINE_M)
        if finer is not None:
            step = _STEP * COARSE_M / (side_of(query) / 2)
            modes = [self._refined(mode, finer, step, disc) for mode in modes]
        return answer_places(modes, top_k=min(top_k, MOST_PLACES), diagnostics=diagnostics)

    def _refined(self, mode: sgb.Mode, seen_image: ViewImage, step: float, disc: sgb.Disc) -> sgb.Mode:
        """Return the best pose near a mode, on finer pixels and in finer steps."""
        assert self._grey is not None  # noqa: S101 - match() has looked
        pose = mode.pose
        turns = tuple(
            replace(pose, yaw_deg=pose.yaw_deg + float(np.degrees(part * step)), scale=pose.scale * (1 + more * step))
            for part in (-0.5, -0.25, 0.0, 0.25, 0.5)  # of a step of heading
            for more in (-0.4, 0.0, 0.4)  # of a step of scale
        )
        reach, margin = round(4.0 / FINE_M), size_for(turns, len(seen_image.rgb)) // 2  # 4 m: reach of the local search
        row, col = self._fine.to_cells(sgb.points_of([pose]))[0].tolist()
        whole = reach + margin + 2 * _RIM_PX
        top, left = max(row - whole, 0), max(col - whole, 0)
        cut = (slice(top, row + whole + 1), slice(left, col + whole + 1))
        stack = _where(directions(self._grey[cut], self._known[cut]), self._is_kept[cut])
        part = self._fine.window(top, left, *stack.is_known.shape)
        low, high = (row - top, col - left), stack.is_known.shape
        bounds = (
            *(max(at - reach, 0) for at in low),
            *(min(at + reach + 1, end) for at, end in zip(low, high, strict=True)),
        )
        question = Question(seen_image=seen_image, bounds=(bounds[0], bounds[1], bounds[2], bounds[3]), turns=turns)
        found = _search(stack, part, question).best(disc, most=1)
        return found[0] if found else mode


class NccGradientMasked(NccGradient):
    """`ncc_gradient_masked`: the same without the roofs of the map."""

    is_masked = True
    card = replace(
        NccGradient.card,
        name="ncc_gradient_masked",
        title="Directions of gradients against imagery, roofs of the map left out",
        ours=f"`ncc_gradient` {MASKED}",
        limits=f"Half of the view must be on imagery beside roofs; {NccGradient.card.limits}",
    )


def _where(stack: Stack, is_kept: NDArray[np.bool_]) -> Stack:
    """Return a stack that is unknown where it is not kept."""
    return Stack(channels=stack.channels * is_kept, is_known=stack.is_known & is_kept)


def _search(stack: Stack, grid: sgb.Grid, question: Question) -> Field:
    size_px = size_for(question.turns, len(question.seen_image.rgb))
    search = Search.of(stack, grid, question.bounds, margin=size_px // 2)
    turned = (question.seen_image.turned(turn, size_px) for turn in question.turns)
    return search.field(question.turns, (directions(view.grey, view.is_seen) for view in turned))
