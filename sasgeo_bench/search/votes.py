# SPDX-License-Identifier: Apache-2.0
"""Three-state votes of a view on a map (Eqs. 7-8 of the SASGeo paper) for all shifts at once, by FFT."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN


@dataclass(frozen=True, kw_only=True)
class VoteGains:
    """Weights of each class, shape (C,), at least 0: its weight times the lambdas of Eq. (7).

    `agree` is gained where a class is seen and mapped, `extra` lost where it is seen and not mapped, `missed` lost
    where it is mapped and seen to be absent. All other cells count 0.
    """

    agree: NDArray[np.float64]
    extra: NDArray[np.float64]
    missed: NDArray[np.float64]

    @classmethod
    def uniform(cls, count: int) -> Self:
        """Return gains of 1 for every class."""
        return cls(agree=np.ones(count), extra=np.ones(count), missed=np.ones(count))


def make_template(
    seen: NDArray[np.uint8], gains: VoteGains, *, near: NDArray[np.float32] | None = None
) -> NDArray[np.float64]:
    """Return the factors of the map in Eq. (8), which is linear in the map, shape (C + 2, rows, cols).

    `seen` has shape (C, rows, cols). C bands are for the degree to which the map holds each class; one for known map
    cells (the loss of what is seen, regained where it is mapped); the last counts the classes known in the view.
    `near`, 0..1, is the proximity of the class in the view: it reduces the loss for mapped cells that are seen to be
    absent.

    Examples
    --------
    >>> make_template(np.array([[[1, 0, 2]]], dtype=np.uint8), VoteGains.uniform(1))[:, 0].tolist()
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


def map_spectrum(layers: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.complexfloating]:
    """Return the conjugate transform of map layers, made once for all templates."""
    return np.conj(fft.rfft2(layers, s=size))


def correlated(
    window: NDArray[np.complexfloating], template: NDArray[np.complexfloating], size: tuple[int, int]
) -> NDArray[np.floating]:
    """Return the correlation summed over bands, for all shifts, of a `map_spectrum` and the spectrum of a template."""
    total = window[0] * template[0]
    for layer, band in zip(window[1:], template[1:], strict=True):
        total += layer * band  # one by one they stay in the cache
    return np.asarray(fft.irfft2(np.conj(total, out=total), s=size))


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """A template in the Fourier domain: `score` for the layers and for known cells, `counts` for known cells alone."""

    score: NDArray[np.complexfloating]
    counts: NDArray[np.complexfloating]


@dataclass(frozen=True, slots=True, kw_only=True)
class ByPlanes:
    """Votes for templates of `high` cells a side at `places` shifts a side, by transforms of whole squares.

    Templates have shape (T, B + 2, high, high), windows (Q, B + 1, side, side), where side = places + high - 1.
    """

    places: int
    high: int

    @property
    def size(self) -> tuple[int, int]:
        """Return rows and columns of a transform."""
        side = fft.next_fast_len(self.places + self.high - 1, real=True)
        return side, side

    def at_once(self, bands: int) -> int:
        """Return how many templates to transform together."""
        del bands
        return 1

    def window(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Transform squares of the map, once for all templates."""
        return map_spectrum(layers, self.size)

    def templates(self, templates: NDArray[np.floating]) -> Spectrum:
        """Transform templates, once for all windows; half of the rows that are all zeros is never computed."""
        rows, cols = self.size
        bands = fft.fft(fft.rfft(templates, n=cols, axis=-1), n=rows, axis=-2)
        return Spectrum(score=bands[..., :-1, :, :], counts=bands[..., -1, :, :])

    def votes(
        self, window: NDArray[np.complexfloating], templates: Spectrum
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return sums of gains and numbers of known cells, shape (T, Q, places, places) each."""
        shape = (len(templates.score), len(window), self.places, self.places)
        total, counted = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        for at, square in np.ndindex(*shape[:2]):
            layers = window[square]
            sums = correlated(layers, templates.score[at], self.size)
            counts = correlated(layers[-1:], templates.counts[at, None], self.size)
            total[at, square], counted[at, square] = (part[: self.places, : self.places] for part in (sums, counts))
        return total, counted


@dataclass(frozen=True, slots=True, kw_only=True)
class ByRows:
    """The same votes as `ByPlanes` by transforms of rows alone, which cost less for few places.

    All rows of a template at all places they may have are one matrix product for each frequency.
    """

    places: int
    high: int

    @property
    def size(self) -> int:
        """Return columns of a transform."""
        return int(fft.next_fast_len(self.places + self.high - 1, real=True))

    def at_once(self, bands: int) -> int:
        """Return how many templates to transform together: as many as stay small."""
        # At most 4 million values of transformed templates at a time
        return max(1, 4_000_000 // (bands * self.high * self.size))

    def window(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Transform squares of the map, once for all templates."""
        return np.asarray(fft.rfft(layers, n=self.size, axis=-1))

    def templates(self, templates: NDArray[np.floating]) -> Spectrum:
        """Conjugate rows of templates, shapes (frequencies, (B + 1) * high, T) and (frequencies, high, T)."""
        rows = np.conj(fft.rfft(templates, n=self.size, axis=-1).transpose(3, 1, 2, 0), order="C")
        rows = rows.reshape(len(rows), -1, len(templates))
        return Spectrum(score=rows[:, : -self.high], counts=rows[:, -self.high :])

    def votes(
        self, window: NDArray[np.complexfloating], templates: Spectrum
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return sums of gains and numbers of known cells, shape (T, Q, places, places) each."""
        # Map rows under a template at each place: frequencies first, then Q * places, then (B + 1) * high.
        under = np.lib.stride_tricks.sliding_window_view(window, self.high, axis=2).transpose(3, 0, 2, 1, 4)
        under = under.reshape(len(under), len(window) * self.places, -1)
        products = (under @ templates.score, under[:, :, -self.high :] @ templates.counts)
        total, counted = (fft.irfft(product, n=self.size, axis=0)[: self.places] for product in products)
        shape = (self.places, -1, self.places, total.shape[-1])
        return total.reshape(shape).transpose(3, 1, 2, 0), counted.reshape(shape).transpose(3, 1, 2, 0)
