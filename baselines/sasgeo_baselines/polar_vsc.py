# SPDX-License-Identifier: Apache-2.0
"""`polar_vsc`: rings of classes find places, a test drops unlikely ones, sectors give the heading.

Visual Semantic Context, NAVIGATION 71(1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

import sasgeo_bench as sgb
from sasgeo_baselines.place_matcher import PlaceMatcher, turns_within
from sasgeo_baselines.polar import CELL_M, GROUPS, RADIUS_M, SIDE, coarse_groups, sector_weights, view_planes
from sasgeo_bench import Disc, MatcherCard, Mode, Pose, Prior, Query, Region, points_of, thinned

RINGS: Final = 12
SECTORS: Final = 36  # the first begins straight ahead, on a map in the north; clockwise
STRIDE: Final = 4  # cells between places of a map: 16 m
AREAS_M2: Final = np.pi * np.diff(np.square(np.arange(RINGS + 1) * RADIUS_M / RINGS))

_LEAST_KNOWN: Final = 0.25  # of a ring or sector; else it is not compared
_FULL: Final = 255

Floats = NDArray[np.float32]


AROUND: Final = 2  # cells to each side: halfway to the next place
STEP_DEG: Final = 360.0 / SECTORS
APART_M: Final = 25.0
_BLOCK: Final = 50_000  # places that are tested together: bounds the memory

Ints = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Shares of groups of classes in parts of a view or a map, and how much of each part is known.

    `value` has shape (..., G, RINGS) or (..., G, RINGS, SECTORS); `known` too, or 1 for G where groups are known alike.
    Where too little is known both are 0.
    """

    value: Floats
    known: Floats

    @classmethod
    def of(cls, present: Floats, known: Floats) -> Self:
        """Divide what is present by what is known, where that is at least a quarter.

        >>> found = Shares.of(np.float32([0.2, 0.1]), np.float32([0.8, 0.2]))
        >>> found.value.tolist(), found.known.round(1).tolist()
        ([0.25, 0.0], [0.800000011920929, 0.0])
        """
        is_known = known >= _LEAST_KNOWN
        value = np.where(is_known, present / np.maximum(known, _LEAST_KNOWN), 0)
        return cls(value=value.astype(np.float32), known=np.where(is_known, known, 0).astype(np.float32))


@dataclass(frozen=True, kw_only=True)
class Context:
    """Rings, shape (..., G, RINGS), and sectors, shape (..., G, RINGS, SECTORS), of a view or of places of a map."""

    rings: Shares
    sectors: Shares

    @classmethod
    def of(cls, present: Floats, known: Floats) -> Self:
        """Describe squares around places by the shares of their cells, shape (..., G, SIDE^2)."""
        rings, sectors = (
            Shares.of(*(averaged(cells, sectors=count) for cells in (present, known))) for count in (1, SECTORS)
        )
        return cls(rings=Shares(value=rings.value[..., 0], known=rings.known[..., 0]), sectors=sectors)

    @classmethod
    def of_view(cls, evidence: sgb.Evidence, is_used: NDArray[np.bool_]) -> Self:
        """Describe a view by the groups that are used, shape (G,); the others count as unknown."""
        present, known = view_planes(evidence) * is_used[:, None]
        return cls.of(present, known)


def averaged(cells: Floats, *, sectors: int) -> Floats:
    """Return means of cells of squares, shape (..., SIDE^2), over rings and sectors, shape (..., RINGS, sectors).

    Ground straight ahead of a view lies in the first and the last of four sectors:

    >>> cells = np.zeros((SIDE, SIDE), dtype=np.float32)
    >>> cells[: SIDE // 2] = 1.0
    >>> averaged(cells.ravel(), sectors=4)[-1].round(3).tolist()
    [1.0, 0.0, 0.0, 1.0]
    """
    flat = cells.reshape(-1, SIDE * SIDE)
    means = (sector_weights(RINGS, sectors) @ flat.T).T
    return np.asarray(means.reshape(*cells.shape[:-1], RINGS, sectors), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class ContextMap:
    """Rings around places of a map, and its cells, of which the sectors of any place are read.

    `cells`, uint8 of shape (G + 1, rows, cols), are shares of the groups and, last, of known ground, 0..255, with a
    margin of half a square. `rings`, of shape (P, G + 1, RINGS), are their means around `places_m`, shape (P, 2).
    `mean`, shape (G,), is the share of each group over the map, `is_used` whether the map has a class of it.
    """

    corner_m: tuple[float, float]
    cells: NDArray[np.uint8]
    places_m: NDArray[np.float64]
    rings: NDArray[np.uint8]
    mean: Floats
    is_used: NDArray[np.bool_]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Describe a map at places 16 m apart, corners of cells, from its north-western corner."""
        west_m, _, _, north_m = region.grid.bounds_m
        half = SIDE // 2
        groups = coarse_groups(region, above=half, beside=half)
        inner = (slice(half, groups.shape[1] - half), slice(half, groups.shape[2] - half))
        known = np.zeros_like(groups[0])
        rows, cols = known[inner].shape
        known[inner] = cv2.resize(
            region.known().astype(np.uint8) * np.uint8(_FULL), (cols, rows), interpolation=cv2.INTER_AREA
        )
        cells = np.concatenate([groups, known[None]])
        rings = np.stack([_rings_of(layer) for layer in cells], axis=-2)
        down, right = (np.arange(count) * STRIDE * CELL_M for count in rings.shape[:2])
        east_m, north_m_ = np.meshgrid(west_m + right, north_m - down)
        total = cells[:-1][(slice(None), *inner)].mean(axis=(1, 2), dtype=np.float64)
        return cls(
            corner_m=(west_m, north_m),
            cells=cells,
            places_m=np.stack([east_m.ravel(), north_m_.ravel()], axis=1),
            rings=rings.reshape(-1, *rings.shape[2:]),
            mean=(total / max(1.0, float(known[inner].mean()))).astype(np.float32),
            is_used=np.array([any(name in region.classes for name in names) for names in GROUPS]),
        )

    def rings_at(self, rows: NDArray[np.int64]) -> Shares:
        """Return rings of places by number, shape (N, G, RINGS)."""
        found = self.rings[rows].astype(np.float32) / np.float32(_FULL)
        return Shares.of(found[:, :-1], found[:, -1:])

    def at(self, places_m: NDArray[np.float64]) -> Context:
        """Describe the corners of cells next to places; beyond the map nothing is known."""
        offset = (places_m - self.corner_m) * (1 / CELL_M, -1 / CELL_M)
        windows = np.lib.stride_tricks.sliding_window_view(self.cells, (SIDE, SIDE), axis=(1, 2))
        most = np.array(windows.shape[2:0:-1]) - 1
        right, down = np.clip(np.rint(offset).astype(np.int64), 0, most).T
        found = windows[:, down, right].reshape(len(self.cells), len(places_m), SIDE * SIDE).transpose(1, 0, 2)
        squares = found.astype(np.float32) / np.float32(_FULL)
        return Context.of(squares[:, :-1], squares[:, -1:])


def _rings_of(layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return means over rings around every STRIDE-th corner of the cells within a margin, (rows, cols, RINGS)."""
    half = SIDE // 2
    inside = (slice(half, layer.shape[0] - half + 1, STRIDE), slice(half, layer.shape[1] - half + 1, STRIDE))
    found = np.zeros((*layer[inside].shape, RINGS), dtype=np.uint8)
    if layer.any():
        values = layer.astype(np.float32)
        for ring, weights in enumerate(sector_weights(RINGS, 1).toarray().reshape(RINGS, SIDE, SIDE)):
            means = cv2.filter2D(values, -1, weights, anchor=(half, half), borderType=cv2.BORDER_CONSTANT)
            found[..., ring] = np.clip(np.rint(means[inside]), 0, _FULL)
    return found


def ring_p_values(seen: Shares, mapped: Shares, *, patch_m: float) -> NDArray[np.float64]:
    """Return the p-values of two-sample Kolmogorov-Smirnov tests of the classes in each ring, shape (N, RINGS).

    The groups of classes, in their order and last what has none, are the values that are observed, once for each patch
    of `patch_m` that is known: cells are no independent observations. A value is NaN where too little is known.

    Parameters
    ----------
    seen : Shares
        Rings of a view, shape (G, RINGS); groups that it does not know are compared in no ring.
    mapped : Shares
        Rings of places, shape (N, G, RINGS).
    patch_m : float
        Side of ground that counts as one observation, as neighbouring cells are alike.

    Examples
    --------
    The third ring has 15.7 patches. Half of them are houses; on the map all are, or a few less than half:

    >>> known = np.ones((1, 3), dtype=np.float32)
    >>> seen = Shares(value=np.float32([[0.0, 0.0, 0.5]]), known=known)
    >>> mapped = Shares(value=np.float32([[[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.4]]]), known=np.ones((2, 1, 3)))
    >>> ring_p_values(seen, mapped, patch_m=8.0).round(3).tolist()
    [[1.0, 1.0, 0.039], [1.0, 1.0, 1.0]]
    """
    compared = seen.known > 0
    count = compared.sum(axis=0)
    distance = np.abs(_cumulative(seen.value * compared) - _cumulative(mapped.value * compared)).max(axis=-2)
    patches = AREAS_M2[: seen.value.shape[-1]] / patch_m**2
    mine = patches * seen.known.sum(axis=0) / np.maximum(count, 1)
    theirs = patches * mapped.known[:, 0]
    effective = mine * theirs / np.maximum(mine + theirs, 1.0)
    return np.where(effective > 0, special.kolmogorov(np.sqrt(effective) * distance), np.nan)


def _cumulative(values: Floats) -> Floats:
    """Return cumulative shares over groups; where these overlap, as on a bridge, they share the ground."""
    total = np.cumsum(values, axis=-2)
    return np.asarray(total / np.maximum(total[..., -1:, :], 1.0))


def passing_share(p_values: NDArray[np.float64], alpha: float) -> NDArray[np.float64]:
    """Return the share of the judged rings of each place, shape (N, RINGS), that pass the test; 0 where none is judged.

    >>> passing_share(np.array([[0.5, 0.02, 0.001, np.nan], [np.nan] * 4]), 0.01).round(3).tolist()
    [0.667, 0.0]
    """
    judged = np.isfinite(p_values)
    return np.asarray((judged & (p_values >= alpha)).sum(axis=1) / np.maximum(judged.sum(axis=1), 1))


def correlations(seen: Shares, mapped: Shares, mean: Floats) -> NDArray[np.float64]:
    """Return the correlation of the sectors of a view, turned clockwise by 0, 1, ... of them, with those of places.

    Parameters
    ----------
    seen : Shares
        Of a view, shape (G, RINGS, SECTORS).
    mapped : Shares
        Of places, shape (N, G, RINGS, SECTORS).
    mean : ndarray of float32, shape (G,)
        Share of each group over the map: it is taken off both.

    Returns
    -------
    ndarray of float64, shape (N, SECTORS)
        -1..1, over what is known on both sides, rings by their areas; minus infinity where that is less than half of
        what is known of the view.
    """
    areas = AREAS_M2.astype(np.float32)[:, None] / np.float32(AREAS_M2.sum())
    weight = seen.known * areas
    mine, theirs = (shares.value - mean[:, None, None] for shares in (seen, mapped))
    known = np.broadcast_to(mapped.known, mapped.value.shape)
    both = _turned_sums(weight * mine, known * theirs)
    squares = _turned_sums(weight * mine**2, known) * _turned_sums(weight, known * theirs**2)
    # 0.5 of what is known of a view, that the map must know
    shared = _turned_sums(weight, known) >= 0.5 * weight.sum()
    return np.where(shared & (squares > 0), both / np.sqrt(np.maximum(squares, 1e-12)), -np.inf)


def _turned_sums(seen: Floats, mapped: Floats) -> NDArray[np.float64]:
    """Return sums of products over all, the view turned clockwise by 0, 1, ... sectors, shape (N, SECTORS)."""
    spectra = np.conj(fft.rfft(seen, axis=-1)) * fft.rfft(mapped, axis=-1)
    return np.asarray(fft.irfft(spectra.sum(axis=(1, 2)), n=SECTORS, axis=-1), dtype=np.float64)


def vertices(before: Floats, here: Floats, after: Floats) -> NDArray[np.float64]:
    """Return where parabolas through three values, one step apart, peak: -1/2..1/2 around the middle one.

    Where that is no peak, or a value is not finite, it is the middle one:

    >>> vertices(np.array([0.0, 0.0, 3.0]), np.array([1.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.0])).tolist()
    [0.0, 0.5, 0.0]
    """
    finite = np.isfinite(before) & np.isfinite(here) & np.isfinite(after)
    low, middle, high = (np.where(finite, values, 0.0) for values in (before, here, after))
    is_peak = (middle >= low) & (middle >= high) & (low + high < 2 * middle)
    bend = np.where(is_peak, low - 2 * middle + high, -1.0)
    return np.asarray(np.where(is_peak, (low - high) / (2 * bend), 0.0) + 0.0)  # no -0


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """A view as it is matched, and what is known of its pose."""

    context: Context
    prior: Prior


class PolarVsc(PlaceMatcher[PreparedView]):
    """Two stages: rings with the heading marginalised, gated by a test; then sectors."""

    open_numbers = {
        "alpha": (0.001, 0.01, 0.05),  # of the test, for each ring
        "patch_m": (4.0, 8.0),  # ground that counts as one observation; a ring is 8 m wide
    }
    chosen = {"alpha": 0.001, "patch_m": 8.0}

    card = MatcherCard(
        name="polar_vsc",
        version="1",
        title="Visual semantic context: rings, a Kolmogorov-Smirnov gate, sectors",
        source=(
            "Visual semantic context, NAVIGATION 71(1), navi.634, by its abstract, shown in numerical experiments: "
            "semantics in polar bins; a first stage marginalises the heading and searches places coarsely, a "
            "Kolmogorov-Smirnov test rejects unlikely ones, a second stage refines place and heading"
        ),
        ours=(
            "All numbers and measures: 7 groups of classes in 12 rings and 36 sectors of a disc of 96 m in radius; "
            f"places 16 m apart; a two-sample test of the groups in each ring at alpha {chosen['alpha']:g}, in which "
            f"each patch of {chosen['patch_m']:g} m counts as one observation, with the asymptotic distribution; "
            "places where a smaller share of rings passes than at the best place are dropped, so that an answer "
            "remains where no place passes in all; the 200 nearest of the rest by squared differences of rings; then "
            "the circular correlation of sectors, less the mean shares of the map, at headings within 2.5 standard "
            "deviations of the prior, with a parabola between sectors; then the best place in steps of 4 m around the "
            "best 16. ks_share, the share of rings that pass at the answer, and ks_p, the least p-value, are "
            "diagnostics, which the rejector ks_gate reads"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Views beyond 96 m to each side are cut, thin and thick roads are one group, and no sequence is used; the "
            "test depends on the order of the groups, and errors of a detector make right places fail; what is "
            "unknown in a view or on the map is not compared; a view that shows the same all around has no heading; "
            "scale is 1, no confidence"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Describe the map."""
        del learned
        self._map = ContextMap.of(region)

    def look(self, query: Query) -> PreparedView | None:
        """Describe a view; None where it knows no class that the map has."""
        context = Context.of_view(query.evidence, self._map.is_used)
        return PreparedView(context=context, prior=query.prior) if context.sectors.known.any() else None

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the best correlations of sectors around the places whose rings are alike."""
        start = self._turned(view, self._map.places_m[self._shortlist(view, disc)])
        # 16 places around which the best one is searched
        best = points_of([mode.pose for mode in thinned(start, APART_M, max(16, count))])
        steps_m = CELL_M * np.array(list(product(range(-AROUND, AROUND + 1), repeat=2)))
        found = self._turned(view, (best[:, None] + steps_m).reshape(-1, 2))
        wide = disc.wider(CELL_M)
        return thinned((mode for mode in found if wide.has(mode.pose)), APART_M, count)

    def diagnostics(self, view: PreparedView, found: Sequence[Mode]) -> dict[str, float]:
        """Return the least p-value of the rings at the best place, and the share of rings that pass there."""
        best = found[0].pose
        here = self._map.at(np.array([[best.easting_m, best.northing_m]])).rings
        p_values = ring_p_values(view.context.rings, here, patch_m=self.numbers["patch_m"])
        least = np.min(p_values, initial=1.0, where=np.isfinite(p_values))
        return {"ks_p": float(least), "ks_share": float(passing_share(p_values, self.numbers["alpha"])[0])}

    def _shortlist(self, view: PreparedView, disc: Disc) -> Ints:
        """Return the places in a disc where most rings pass the test, and of these the most similar by their rings."""
        near = np.flatnonzero(disc.wider(STRIDE * CELL_M).holds(self._map.places_m))
        seen = view.context.rings
        weight = seen.known * AREAS_M2
        share, away = np.empty(len(near)), np.empty(len(near))
        for first in range(0, len(near), _BLOCK):
            part = slice(first, first + _BLOCK)
            mapped = self._map.rings_at(near[part])
            share[part] = passing_share(
                ring_p_values(seen, mapped, patch_m=self.numbers["patch_m"]), self.numbers["alpha"]
            )
            both = weight * mapped.known
            squares = (both * np.square(seen.value - mapped.value)).sum(axis=(1, 2))
            away[part] = squares / np.maximum(both.sum(axis=(1, 2)), 1.0)
        passing = np.flatnonzero(share == share.max(initial=0.0))
        return near[passing[np.argsort(away[passing], kind="stable")[:200]]]  # places whose sectors are compared

    def _turned(self, view: PreparedView, places_m: NDArray[np.float64]) -> list[Mode]:
        """Return places with their best headings, best first; without those of which the map knows too little."""
        if not len(places_m):
            return []
        found = correlations(view.context.sectors, self._map.at(places_m).sectors, self._map.mean)
        allowed = turns_within(view.prior, SECTORS)
        best = allowed[found[:, allowed].argmax(axis=1)]
        rows = np.arange(len(found))
        before, here, after = (found[rows, (best + step) % SECTORS] for step in (-1, 0, 1))
        offset = vertices(before, here, after)
        score = here + np.subtract(after, before, out=np.zeros(len(found)), where=offset != 0) * offset / 4
        modes = [
            Mode(pose=Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg), score=value)
            for (east_m, north_m), yaw_deg, value in zip(
                places_m.tolist(), ((best + offset) * STEP_DEG).tolist(), score.tolist(), strict=True
            )
            if np.isfinite(value)
        ]
        return sorted(modes, key=lambda mode: -mode.score)
