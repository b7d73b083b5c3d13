# SPDX-License-Identifier: Apache-2.0
"""The three-state score of a view on a map (Eqs. 7-8 of the SASGeo paper): cell by cell, and for all shifts by FFT."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench import ABSENT, PRESENT, UNKNOWN

_HALF_A_CELL: Final = 0.5  # a count that is whole is at least 1 or at most 0, whatever the transform rounds

_MOST_VALUES: Final = 4_000_000  # of transformed templates at a time


@dataclass(frozen=True, kw_only=True)
class Gains:
    """What each class is worth, shape (C,) each, not negative: its weight times the lambdas of Eq. (7).

    `agree` for seen and mapped, `extra` the loss for seen and not mapped, `missed` the loss for mapped and seen to be
    absent. Seen absent and mapped absent counts 0, as does whatever is unknown on either side.

    Examples
    --------
    >>> Gains.uniform(2).missed.tolist()
    [1.0, 1.0]
    """

    agree: NDArray[np.float64]
    extra: NDArray[np.float64]
    missed: NDArray[np.float64]

    @classmethod
    def uniform(cls, count: int) -> Self:
        """One for everything."""
        return cls(agree=np.ones(count), extra=np.ones(count), missed=np.ones(count))


def score_cells(seen: NDArray[np.uint8], mapped: NDArray[np.uint8], gains: Gains) -> float:
    """Sum Eq. (8) cell by cell and divide it by the number of cells known on both sides.

    Parameters
    ----------
    seen, mapped : ndarray of uint8, shape (C, rows, cols)
        ABSENT, PRESENT or UNKNOWN, on one lattice.
    gains : Gains
        What each class is worth.

    Returns
    -------
    float
        Dimensionless, larger is better; 0 where nothing is known.

    Examples
    --------
    >>> seen = np.array([[[1, 1, 0, 0, 2]]], dtype=np.uint8)
    >>> mapped = np.array([[[1, 0, 1, 0, 1]]], dtype=np.uint8)
    >>> score_cells(seen, mapped, Gains.uniform(1))
    -0.25
    """
    total, known = 0.0, 0
    for index, (view, under) in enumerate(zip(seen, mapped, strict=True)):
        total += float(gains.agree[index]) * int(((view == PRESENT) & (under == PRESENT)).sum())
        total -= float(gains.extra[index]) * int(((view == PRESENT) & (under == ABSENT)).sum())
        total -= float(gains.missed[index]) * int(((view == ABSENT) & (under == PRESENT)).sum())
        known += int(((view != UNKNOWN) & (under != UNKNOWN)).sum())
    return total / known if known else 0.0


def vote_directly(seen: NDArray[np.uint8], mapped: NDArray[np.uint8], gains: Gains) -> NDArray[np.float64]:
    """Score every shift at which a view touches the map, by `score_cells`: slow, and what `vote` is held against.

    Parameters
    ----------
    seen : ndarray of uint8, shape (C, h, w)
        The view.
    mapped : ndarray of uint8, shape (C, H, W)
        The map; beyond it everything is unknown.
    gains : Gains
        What each class is worth.

    Returns
    -------
    ndarray of float, shape (H + h - 1, W + w - 1)
        At (i, j) the score with the view's first cell on the map's cell (i - h + 1, j - w + 1).

    Examples
    --------
    >>> dot, map_row = np.ones((1, 1, 1), dtype=np.uint8), np.array([[[0, 1, 2]]], dtype=np.uint8)
    >>> vote_directly(dot, map_row, Gains.uniform(1)).tolist()
    [[-1.0, 1.0, 0.0]]
    """
    rows, cols = seen.shape[1:]
    around = ((0, 0), (rows - 1, rows - 1), (cols - 1, cols - 1))
    padded = np.pad(mapped, around, constant_values=UNKNOWN)
    votes = np.zeros((mapped.shape[1] + rows - 1, mapped.shape[2] + cols - 1))
    for row, col in np.ndindex(*votes.shape):
        votes[row, col] = score_cells(seen, padded[:, row : row + rows, col : col + cols], gains)
    return votes


def make_template(
    seen: NDArray[np.uint8], gains: Gains, *, near: NDArray[np.float32] | None = None
) -> NDArray[np.float64]:
    """Turn a view into what it multiplies the map with, since Eq. (8) is linear in the map.

    Parameters
    ----------
    seen : ndarray of uint8, shape (C, rows, cols)
        ABSENT, PRESENT or UNKNOWN.
    gains : Gains
        What each class is worth.
    near : ndarray of float, shape (C, rows, cols), optional
        0..1, how near something of the class was seen: it excuses what is mapped there and seen to be absent.

    Returns
    -------
    ndarray of float, shape (C + 2, rows, cols)
        C bands for the degree to which the map holds each class; one for whether it knows anything (the loss of what
        is seen, won back where it is mapped); one that counts the classes known in the view.

    Examples
    --------
    >>> make_template(np.array([[[1, 0, 2]]], dtype=np.uint8), Gains.uniform(1))[:, 0].tolist()
    [[2.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    """
    count = len(seen)
    made = np.zeros((count + 2, *seen.shape[1:]))
    for index, view in enumerate(seen):
        present, absent = (view == PRESENT).astype(np.float64), (view == ABSENT).astype(np.float64)
        if near is not None:
            absent *= 1 - near[index]
        made[index] = (gains.agree[index] + gains.extra[index]) * present - gains.missed[index] * absent
        made[count] -= gains.extra[index] * present
        made[count + 1] += view != UNKNOWN
    return made


def vote(seen: NDArray[np.uint8], mapped: NDArray[np.uint8], gains: Gains) -> NDArray[np.float64]:
    """Score every shift at which a view touches the map, by FFT; the same numbers as `vote_directly`.

    A map cell must be known for all classes or for none, as the cells of a region are.

    Examples
    --------
    >>> dot, map_row = np.ones((1, 1, 1), dtype=np.uint8), np.array([[[0, 1, 2]]], dtype=np.uint8)
    >>> vote(dot, map_row, Gains.uniform(1)).round(9).tolist()
    [[-1.0, 1.0, 0.0]]
    """
    rows, cols = seen.shape[1:]
    known = (mapped != UNKNOWN).all(axis=0)
    window = np.concatenate(((mapped == PRESENT) & known, known[None])).astype(np.float64)
    window = np.pad(window, ((0, 0), (rows - 1, rows - 1), (cols - 1, cols - 1)))
    size = (fft.next_fast_len(window.shape[1], real=True), fft.next_fast_len(window.shape[2], real=True))
    total, counted = vote_spectra(transform_window(window, size), transform(make_template(seen, gains), size), size)
    valid = (slice(window.shape[1] - rows + 1), slice(window.shape[2] - cols + 1))
    total, counted = total[valid], counted[valid]
    return np.asarray(np.where(counted > _HALF_A_CELL, total / np.maximum(counted, 1.0), 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """A template in the Fourier domain: `score` for the layers and for knowing, `counts` for knowing alone."""

    score: NDArray[np.complexfloating]
    counts: NDArray[np.complexfloating]


def transform(template: NDArray[np.floating], size: tuple[int, int]) -> Spectrum:
    """Transform a template, padded with zeros; a half of the rows that are all zeros is never computed."""
    bands = fft.fft(fft.rfft(template, n=size[1], axis=-1), n=size[0], axis=-2)
    return Spectrum(score=bands[..., :-1, :, :], counts=bands[..., -1, :, :])


def transform_window(layers: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.complexfloating]:
    """Transform a square of the map and conjugate it, once for all templates; `vote_spectra` conjugates back."""
    return np.conj(fft.rfft2(layers, s=size))


def vote_spectra(
    window: NDArray[np.complexfloating], template: Spectrum, size: tuple[int, int]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Sum of gains and number of known cells at every shift of a template within a window.

    Entry (i, j) has the template's first cell on the window's cell (i, j); entries where the template would reach
    beyond the window wrap around and mean nothing. One inverse transform each for the sum and for the count.
    """
    total = window[0] * template.score[0]
    for layer, band in zip(window[1:], template.score[1:], strict=True):
        total += layer * band  # one by one they stay in the cache
    counted = window[-1] * template.counts
    return fft.irfft2(np.conj(total, out=total), s=size), fft.irfft2(np.conj(counted, out=counted), s=size)


@dataclass(frozen=True, slots=True, kw_only=True)
class ByPlanes:
    """Votes for templates of `high` cells a side at `places` shifts a side, by transforms of whole squares.

    Templates have shape (T, B + 2, high, high), windows (Q, B + 1, side, side), where side = places + high - 1.
    """

    places: int
    high: int

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a transform."""
        side = fft.next_fast_len(self.places + self.high - 1, real=True)
        return side, side

    def at_once(self, bands: int) -> int:
        """How many templates are to be made ready together."""
        del bands
        return 1

    def window(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Make some squares of the map ready, once for all templates."""
        return transform_window(layers, self.size)

    def templates(self, templates: NDArray[np.floating]) -> Spectrum:
        """Make some templates ready, once for all windows."""
        return transform(templates, self.size)

    def votes(
        self, window: NDArray[np.complexfloating], templates: Spectrum
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Sum of gains and number of known cells, shape (T, Q, places, places) each."""
        shape = (len(templates.score), len(window), self.places, self.places)
        total, counted = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        for at, square in np.ndindex(*shape[:2]):
            template = Spectrum(score=templates.score[at], counts=templates.counts[at])
            pair = vote_spectra(window[square], template, self.size)
            total[at, square], counted[at, square] = (part[: self.places, : self.places] for part in pair)
        return total, counted


@dataclass(frozen=True, slots=True, kw_only=True)
class ByRows:
    """The same as `ByPlanes` by transforms of rows alone: what few places cost less by.

    All rows of a template at all places they may have are one matrix product for each frequency.
    """

    places: int
    high: int

    @property
    def size(self) -> int:
        """Columns of a transform."""
        return int(fft.next_fast_len(self.places + self.high - 1, real=True))

    def at_once(self, bands: int) -> int:
        """How many templates are to be made ready together: as many as stay small."""
        return max(1, _MOST_VALUES // (bands * self.high * self.size))

    def window(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Make some squares of the map ready, once for all templates."""
        return np.asarray(fft.rfft(layers, n=self.size, axis=-1))

    def templates(self, templates: NDArray[np.floating]) -> Spectrum:
        """Rows of some templates, conjugated, shapes (frequencies, (B + 1) * high, T) and (frequencies, high, T)."""
        rows = np.conj(fft.rfft(templates, n=self.size, axis=-1).transpose(3, 1, 2, 0), order="C")
        rows = rows.reshape(len(rows), -1, len(templates))
        return Spectrum(score=rows[:, : -self.high], counts=rows[:, -self.high :])

    def votes(
        self, window: NDArray[np.complexfloating], templates: Spectrum
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Sum of gains and number of known cells, shape (T, Q, places, places) each."""
        # What lies under a template at each row: frequencies first, then Q * places, then (B + 1) * high.
        under = np.lib.stride_tricks.sliding_window_view(window, self.high, axis=2).transpose(3, 0, 2, 1, 4)
        under = under.reshape(len(under), len(window) * self.places, -1)
        products = (under @ templates.score, under[:, :, -self.high :] @ templates.counts)
        total, counted = (fft.irfft(product, n=self.size, axis=0)[: self.places] for product in products)
        shape = (self.places, -1, self.places, total.shape[-1])
        return total.reshape(shape).transpose(3, 1, 2, 0), counted.reshape(shape).transpose(3, 1, 2, 0)
