# SPDX-License-Identifier: Apache-2.0
"""`hu_dual_reference`: map and imagery as one reference, their scores added (Hu 2024); and each of them alone."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import islice, repeat
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.image.dense import (
    MOST_PLACES,
    Field,
    Planes,
    Search,
    Stack,
    answer_candidates,
    answer_places,
    bounds_of,
    disc_of,
    size_for,
    turns_for,
)
from sasgeo_baselines.image.ncc_gradient import directions
from sasgeo_baselines.image.view_image import LIMITS, PICTURE, Ortho, ViewImage, grey_of, side_of, view_image
from sasgeo_baselines.learned import read_learned, sound

PIXEL_M: Final = 2.0
SHARES: Final = (0.0, 0.2, 0.4, 0.5, 0.6, 0.8, 1.0)  # of the imagery in the sum, that learning tries
UNTAUGHT: Final = 0.5
RIGHT_M: Final = 25.0
MOST_EXAMPLES: Final = 60
SLOW: Final = (
    "more than a second a view, since every place is tried at every heading and scale: pixels of 3 m would take a "
    "third of that and find as much on maps, but less in imagery"
)


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Map and imagery on one lattice: channels of classes, and directions of gradients; None for a half without weight.

    `pictured` is None where there is no imagery, too.
    """

    grid: sgb.Grid
    classes: tuple[str, ...]
    drawn: Stack | None
    pictured: Stack | None

    @classmethod
    def of(cls, region: sgb.Region, share: float) -> "Reference":
        """Read a map and its imagery in pixels of 2 m, but not the half whose weight is 0; `share` is the imagery's."""
        factor = max(1, round(PIXEL_M / region.grid.cell_size_m))
        rows, cols = (-(-cells // factor) for cells in region.grid.shape)
        grid = replace(region.grid, cell_size_m=factor * region.grid.cell_size_m, rows=rows, cols=cols)
        drawn = _mapped(region, factor) if share < 1 else None
        pictured = _pictured(region, grid) if share > 0 else None
        return cls(grid=grid, classes=region.classes, drawn=drawn, pictured=pictured)


def pooled(mask: NDArray[np.bool_], factor: int) -> Planes:
    """Return shares of set cells in blocks of `factor` cells a side; beyond the edge nothing is set.

    >>> pooled(np.array([[True, False, True]]), 2).tolist()
    [[0.25, 0.25]]
    """
    rows, cols = (-(-cells // factor) for cells in mask.shape)
    wide = np.zeros((rows * factor, cols * factor), dtype=np.float32)
    wide[: mask.shape[0], : mask.shape[1]] = mask
    return np.asarray(cv2.resize(wide, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)


def centred(layers: Sequence[Planes] | Planes, known: NDArray[np.bool_]) -> Stack:
    """Return channels less their mean over what is known, 0 elsewhere; each as strong as any other where it varies.

    `known` has shape (rows, cols), or (C, rows, cols) where classes are known at different places.
    """
    found = np.zeros((len(layers), *known.shape[-2:]), dtype=np.float32)
    masks = np.broadcast_to(known, found.shape)
    for at, (layer, mask) in enumerate(zip(layers, masks, strict=True)):
        count = np.float32(max(int(np.count_nonzero(mask)), 1))
        channel = np.multiply(layer, mask, out=found[at])
        channel -= channel.sum() / count
        channel *= mask
        spread = np.sqrt(np.square(channel).sum() / count)
        if spread > 0:
            channel /= spread
    return Stack(channels=found, is_known=known if known.ndim < found.ndim else np.asarray(known.any(axis=0)))


def _mapped(region: sgb.Region, factor: int) -> Stack:
    """Return channels of the classes of the map, in pixels of `factor` cells a side."""
    known = pooled(region.known(), factor) > 0.5  # most of a pixel
    return centred([pooled(region.layer(name) == sgb.PRESENT, factor) for name in region.classes], known)


def _pictured(region: sgb.Region, grid: sgb.Grid) -> Stack | None:
    ortho = Ortho.of(region, gsd_m=grid.cell_size_m)
    if ortho is None:
        return None
    stack = directions(grey_of(ortho.rgb, ortho.is_known), ortho.is_known)
    corner = grid.to_centres_m(np.array([[0, 0]]))
    right, down = (ortho.grid.to_uv(corner)[0] - 0.5).tolist()
    onto = np.array([[1.0, 0.0, right], [0.0, 1.0, down]])
    size, how = (grid.cols, grid.rows), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    planes = [
        cv2.warpAffine(plane, onto, size, flags=how) for plane in (*stack.channels, stack.is_known.astype(np.float32))
    ]
    is_known = np.asarray(planes[-1]) > 0.99  # all of a pixel, but for rounding
    return Stack(channels=np.stack([np.where(is_known, plane, 0) for plane in planes[:-1]]), is_known=is_known)


class _HuReference:
    """Scores of the map and of the imagery, each in standard deviations, added at every pose."""

    card: sgb.MatcherCard
    share: float  # of the imagery

    def __init__(self) -> None:
        self._reference: Reference | None = None

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Read what has a weight: map, imagery or both."""
        del learned
        is_useless = "imagery" in self.card.needs and region.imagery is None
        self._reference = None if is_useless else Reference.of(region, self.share)

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Return the best poses, or rank the candidates by the best pose near each."""
        pair = None if self._reference is None else _Pair.of(query, self._reference)
        field = None if pair is None else pair.fields((self.share,))[0]
        if pair is None or field is None:
            return sgb.WITHHELD
        diagnostics = {"peak": field.peak(), "parts": float(sum(part is not None for part in pair.parts))}
        if query.track == "retrieval":
            return answer_candidates(query, field.near(query.candidates), top_k=top_k, diagnostics=diagnostics)
        modes = field.best(disc_of(query.prior), most=min(top_k, MOST_PLACES) + 1)
        return answer_places(modes, top_k=min(top_k, MOST_PLACES), diagnostics=diagnostics)


class HuDualReference(_HuReference):
    """Map and imagery, by a share that is learned."""

    card = sgb.MatcherCard(
        name="hu_dual_reference",
        version="2",
        title="Map and imagery as one reference",
        source=(
            "Hu et al., Combining OpenStreetMap with Satellite Imagery to Enhance Cross-View Geo-Localization, Sensors "
            "25(1), 2024: a reference of two kinds, fused, as its abstract describes it; its query is a street view"
        ),
        ours=(
            "All but the two references: the map's score is the correlation of class layers, each over the cells where "
            f"its class is known, the imagery's that of directions of gradients ({PICTURE}), in pixels of 2 m at every "
            "place, heading and scale within 2.5 standard deviations; each less its mean over places, over its "
            "standard deviation; the share of the imagery is that of seven that is right most often on training "
            "places, half without training"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("image", "imagery"),
        limits=(
            "Nothing of the source's network; no posterior, and no gate by how much the map holds; no graph, no "
            "sequence, no weights by what lasts, no rejection, no confidence; places no finer than 2 m; half of the "
            "view must be on the map; one picture of the query; leaning roofs and relief are not modelled. Where the "
            "picture is flat or shows less than a tenth of the view, the map alone decides; where no class varies, the "
            "imagery alone: the diagnostic `parts` says how many counted; "
            f"{SLOW}"
        ),
    )
    share = UNTAUGHT

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Read the share of the imagery, then map and imagery."""
        self.share = UNTAUGHT if learned is None else read_learned(self.card.name, learned, _share)
        super().prepare(region, learned)

    def learn(self, training: sgb.Training) -> str:
        """Return the share of the imagery that is right most often; of equal ones the nearest to one half."""
        right, at = dict.fromkeys(SHARES, 0), ""
        for query, truth in sorted(examples(training), key=lambda pair: pair[0].region):
            if query.region != at:
                at, reference = query.region, Reference.of(training.regions[query.region], UNTAUGHT)
            pair = _Pair.of(query, reference)
            for share, field in zip(SHARES, pair.fields(SHARES) if pair else (), strict=False):
                right[share] += _is_right(field, query, truth)
        return json.dumps({"share": max(SHARES, key=lambda share: (right[share], -abs(share - UNTAUGHT)))})


class HuMapOnly(_HuReference):
    """`hu_map_only`: the map alone."""

    share = 0.0
    card = replace(
        HuDualReference.card,
        name="hu_map_only",
        title="Map alone, as one half of hu_dual_reference",
        needs=(),
        ours=(
            "The map's half of `hu_dual_reference`: the correlation of class layers in pixels of 2 m, each over the "
            "cells where its class is known"
        ),
        limits=f"One half of `hu_dual_reference`, to see what the other adds; no confidence; {SLOW}",
    )


class HuImageryOnly(_HuReference):
    """`hu_imagery_only`: the imagery alone."""

    share = 1.0
    card = replace(
        HuDualReference.card,
        name="hu_imagery_only",
        title="Imagery alone, as one half of hu_dual_reference",
        ours="The imagery's half of `hu_dual_reference`: the correlation of directions of gradients in pixels of 2 m",
        limits=f"One half of `hu_dual_reference`, to see what the other adds; {SLOW}; {LIMITS}",
    )


def examples(training: sgb.Training) -> list[tuple[sgb.Query, sgb.Truth]]:
    """Return at most `MOST_EXAMPLES` localization queries with pictures and poses, evenly from all of them."""
    pairs = [
        pair
        for pair in training.pairs
        if pair[0].track == "localization" and pair[0].frames and pair[1].pose is not None
    ]
    return pairs[:: max(1, -(-len(pairs) // MOST_EXAMPLES))]


def _share(saved: dict[str, float]) -> float:
    """Return the learned share; raise where it is none."""
    return sound(float(saved["share"]), is_sound=saved["share"] in SHARES)


def _is_right(field: Field | None, query: sgb.Query, truth: sgb.Truth) -> bool:
    found = field.best(disc_of(query.prior), most=1) if field else []
    if not found or truth.pose is None:
        return False
    east_m, north_m = (sgb.points_of([truth.pose]) - sgb.points_of([found[0].pose]))[0].tolist()
    return math.hypot(east_m, north_m) <= RIGHT_M


@dataclass(frozen=True, kw_only=True)
class _Part:
    """One reference under one view: a search over its places, and the mean and spread of scores there."""

    search: Search
    view: "_Drawn | _Pictured"
    size_px: int

    def scores(self, turn: sgb.Pose) -> Planes:
        return self.search.scores(self.view.turned(turn, self.size_px))

    def scaled(self, turns: Sequence[sgb.Pose]) -> Iterator[Planes]:
        """Yield the scores of each turn less their mean, over their spread."""
        # 8 headings that tell the mean and the spread of scores
        some = {turn: self.scores(turn) for turn in turns[:: max(1, len(turns) // 8)]}
        values = np.concatenate([scores[np.isfinite(scores)] for scores in some.values()])
        spread = values.std() if len(values) else np.float32(0)
        mean, unit = (values.mean(), spread) if spread > 0 else (np.float32(0), np.float32(1))
        for turn in turns:
            scores = some.pop(turn) if turn in some else self.scores(turn)
            scores -= mean
            scores /= unit
            yield scores


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Map and imagery under one view, over the same places, headings and scales; None for what says nothing."""

    place: sgb.Grid
    turns: tuple[sgb.Pose, ...]
    parts: tuple[_Part | None, _Part | None]

    @classmethod
    def of(cls, query: sgb.Query, reference: Reference) -> "_Pair | None":
        """Lay a view on both references; None where the query leaves no place open."""
        top, left, bottom, right = bounds = bounds_of(query, reference.grid)
        if top >= bottom or left >= right:
            return None
        gsd_m = reference.grid.cell_size_m
        # 2 pixels at the edge of a view between two headings
        turns = turns_for(query, reach_m=side_of(query) / 2, step_m=2.0 * gsd_m)
        size_px = size_for(turns, side_of(query) / gsd_m)
        seen_image = view_image(query, gsd_m=gsd_m) if reference.pictured else None
        laid = (
            (reference.drawn, _Drawn.of(query, reference.classes, gsd_m=gsd_m) if reference.drawn else None),
            (reference.pictured, _Pictured(seen_image=seen_image) if seen_image else None),
        )
        found = [
            _Part(search=Search.of(stack, reference.grid, bounds, margin=size_px // 2), view=view, size_px=size_px)
            if stack is not None and view is not None
            else None
            for stack, view in laid
        ]
        place = reference.grid.window(top, left, bottom - top, right - left)
        return cls(place=place, turns=turns, parts=(found[0], found[1]))

    def fields(self, shares: Sequence[float]) -> list[Field | None]:
        """Return the best sum at every place, for each share of the imagery; None where nothing that counts is seen."""
        weights = [(1.0 - share, share) for share in shares]
        used = [part if any(pair[at] > 0 for pair in weights) else None for at, part in enumerate(self.parts)]
        scaled = [repeat(None) if part is None else part.scaled(self.turns) for part in used]
        best = [np.full(self.place.shape, -np.inf, dtype=np.float32) for _ in shares]
        which = [np.zeros(self.place.shape, dtype=np.int32) for _ in shares]
        for at, parts in enumerate(islice(zip(*scaled, strict=False), len(self.turns))):
            for pair, top, mine in zip(weights, best, which, strict=True):
                summed = zip(pair, parts, strict=True)
                counted = [np.float32(weight) * part for weight, part in summed if part is not None and weight > 0]
                if counted:
                    total = reduce(np.add, counted)
                    better = total > top
                    np.copyto(top, total, where=better)
                    np.copyto(mine, at, where=better)
        return [
            Field(grid=self.place, scores=top, which=mine, turns=self.turns) if np.isfinite(top).any() else None
            for top, mine in zip(best, which, strict=True)
        ]


@dataclass(frozen=True, kw_only=True)
class _Pictured:
    seen_image: ViewImage

    def turned(self, turn: sgb.Pose, size_px: int) -> Stack:
        """Return the directions of its gradients north up, if its heading and scale are those of `turn`."""
        seen = self.seen_image.turned(turn, size_px)
        return directions(seen.grey, seen.is_seen)


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """A view of classes: shares of each on pixels of the map, and where each is known.

    `seen` are the numbers of the classes of which there is any, `fours` their shares, four at a time, since OpenCV
    resamples four as fast as one; `masks` are the known cells that differ, and `which` is that of each class seen.
    """

    count: int
    seen: list[int]
    fours: list[Planes]
    masks: list[Planes]
    which: list[int]

    @classmethod
    def of(cls, query: sgb.Query, classes: tuple[str, ...], *, gsd_m: float) -> "_Drawn | None":
        """Read a view; None where it knows no class of the map, or shows nothing that varies."""
        evidence = query.evidence
        size = max(1, round(side_of(query) / gsd_m))
        layers = np.zeros((len(classes), size, size), dtype=np.float32)
        is_known = np.zeros(layers.shape, dtype=bool)
        for at, name in enumerate(classes):
            if name in evidence.classes:
                cells = evidence.layer(name)
                layers[at] = _resized(cells == sgb.PRESENT, size)
                is_known[at] = _resized(cells != sgb.UNKNOWN, size) > 0.5  # most of a pixel
        if not centred(layers, is_known).channels.any():
            return None
        seen = [at for at, layer in enumerate(layers) if layer.any()]
        masks = {mask.tobytes(): mask.astype(np.float32) for mask in is_known}
        filled = np.concatenate([layers[seen], np.zeros((-len(seen) % 4, size, size), dtype=np.float32)])
        return cls(
            count=len(classes),
            seen=seen,
            fours=[cv2.merge(list(filled[first : first + 4])) for first in range(0, len(filled), 4)],
            masks=list(masks.values()),
            which=[list(masks).index(is_known[at].tobytes()) for at in seen],
        )

    def turned(self, turn: sgb.Pose, size_px: int) -> Stack:
        """Return the view north up, if its heading and scale are those of `turn`."""
        along, across = (how(math.radians(turn.yaw_deg)) / turn.scale for how in (math.cos, math.sin))
        turning = np.array([[along, across], [-across, along]])
        shift = (len(self.masks[0]) - 1) / 2 - turning @ np.full(2, (size_px - 1) / 2)
        matrix, how = np.column_stack([turning, shift]), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        fours, masks = (
            [np.asarray(cv2.warpAffine(plane, matrix, (size_px, size_px), flags=how)) for plane in planes]
            for planes in (self.fours, self.masks)
        )
        layers = np.concatenate([cv2.split(four) for four in fours])[: len(self.seen)]
        is_known = np.stack(masks) > 0.5  # most of a pixel
        channels = np.zeros((self.count, size_px, size_px), dtype=np.float32)
        channels[self.seen] = centred(layers, is_known[self.which] if len(masks) > 1 else is_known[0]).channels
        return Stack(channels=channels, is_known=np.asarray(is_known.any(axis=0)))


def _resized(mask: NDArray[np.bool_], size: int) -> Planes:
    return np.asarray(cv2.resize(mask.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA), dtype=np.float32)
