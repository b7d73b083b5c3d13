# SPDX-License-Identifier: Apache-2.0
"""Correlations of a map and templates at all places, part by part, in the Fourier domain."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft


def map_spectrum(layers: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.complexfloating]:
    """Return the conjugate transform of map layers, made once for all templates."""
    return np.conj(fft.rfft2(layers, s=size))


def correlated(
    window: Iterable[NDArray[np.complexfloating]],
    template: Iterable[NDArray[np.complexfloating]],
    size: tuple[int, int],
    places: tuple[int, int] | None = None,
) -> NDArray[np.floating]:
    """Return the correlation summed over bands of a `map_spectrum` and the spectrum of a template.

    Of the shifts the first rows and columns of `places` are returned, by default all.
    """
    pairs = iter(zip(window, template, strict=True))
    total = np.multiply(*next(pairs))
    product = np.empty_like(total)
    for layer, band in pairs:
        total += np.multiply(layer, band, out=product)  # one by one they stay in the cache
    rows, cols = places or size
    along = fft.ifft(np.conj(total, out=total), axis=0, overwrite_x=True)[:rows]  # the other rows are not asked for
    return np.asarray(fft.irfft(along, size[1], axis=1)[:, :cols])


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """Places at which templates of `high` cells a side are laid on a map, cut into `count` parts a side.

    Each part has a transform of its own: templates are transformed at the size of a part, which costs less, and parts
    where nothing can be found are left out. The map has `places` and `high` - 1 more rows and columns.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> town, view = rng.random((1, 9, 8), dtype=np.float32), rng.random((1, 4, 4), dtype=np.float32)
    >>> parts = Parts(places=(6, 5), high=4, count=2)
    >>> found = np.zeros(parts.places, dtype=np.float32)
    >>> for here, window in zip(parts.slices, parts.windows(town), strict=True):
    ...     found[here] = parts.sums(window, parts.templates(view))
    >>> bool(np.isclose(found[5, 3], (town[0, 5:9, 3:7] * view).sum()))
    True
    """

    places: tuple[int, int]
    high: int
    count: int = 1

    @classmethod
    def cheapest(cls, *, places: tuple[int, int], high: int, bands: int, windows: int = 1) -> Self:
        """Return the parts that cost least, for so many bands of a template and windows of a map."""

        def cost(count: int) -> float:
            rows, cols = cls(places=places, high=high, count=count).size
            # In units of a transform of a band: two sums of each part cost two, their products a third of one a band
            return rows * cols * (bands + windows * count**2 * (2 + bands / 3))

        return cls(places=places, high=high, count=min((1, 2, 3), key=cost))

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of a part."""
        rows, cols = (-(-side // self.count) for side in self.places)
        return rows, cols

    @property
    def size(self) -> tuple[int, int]:
        """Return rows and columns of a transform."""
        rows, cols = (int(fft.next_fast_len(side + self.high - 1, real=True)) for side in self.shape)
        return rows, cols

    @property
    def slices(self) -> list[tuple[slice, slice]]:
        """Return the places of each part; the last ones overlap others where places cannot be cut evenly."""
        rows, cols = self.shape
        downs, acrosses = (
            [min(at * side, whole - side) for at in range(self.count)]
            for side, whole in zip(self.shape, self.places, strict=True)
        )
        return [(slice(row, row + rows), slice(col, col + cols)) for row in downs for col in acrosses]

    def windows(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Transform the map under each part, once for all templates: shape (P, B, ...) of layers (B, ...)."""
        more = self.high - 1
        cuts = [
            layers[:, down.start : down.stop + more, across.start : across.stop + more] for down, across in self.slices
        ]
        return map_spectrum(np.stack(cuts), self.size)

    def templates(self, bands: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Transform templates, once for all parts; half of the rows that are all zeros is never computed."""
        rows, cols = self.size
        return np.asarray(fft.fft(fft.rfft(bands, n=cols, axis=-1), n=rows, axis=-2))

    def sums(
        self, window: Iterable[NDArray[np.complexfloating]], template: Iterable[NDArray[np.complexfloating]]
    ) -> NDArray[np.floating]:
        """Return the correlation of bands of the map under a part and of a template, summed, at each place of it."""
        return correlated(window, template, self.size, self.shape)

    def is_full(self, window: NDArray[np.complexfloating]) -> bool:
        """Return whether a layer of shares, 0..1, is 1 everywhere under a part."""
        rows, cols = self.shape
        return bool(window[0, 0].real > (rows + self.high - 1) * (cols + self.high - 1) - 0.01)  # the sum of all cells
