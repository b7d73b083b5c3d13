# SPDX-License-Identifier: Apache-2.0
"""Sharpness of pictures: one is blurred until it shows no more fine detail than another."""

from typing import Final

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.image import Picture

_TILE_PX: Final = 64  # in which spectra are measured; waves that are longer are left as they are
_STEP_PX: Final = 32
_FADE: Final = np.outer(*(np.hanning(_TILE_PX + 2)[1:-1],) * 2)
_ROUNDING: Final = (
    float((_FADE**2).sum()) / 36
)  # power of rounding three colours to 8 bits, which adds to what is blurred

Floats = NDArray[np.float64]


def no_sharper(picture: Picture, *, than: Picture) -> Picture:
    """Return a picture with the power of another one, at most, at each spatial frequency.

    What a nominal pixel leaves out counts: blur of the lens, upsampling, sharpening, noise and contrast. Two pictures
    of one pixel size that are each made no sharper than the other have one spectrum of brightness, so that no measure
    of it, such as the variance of the Laplacian, tells which is which. Their colours stay, and how their detail is
    spread: much on a few edges, or some everywhere.

    Parameters
    ----------
    picture, than : ndarray of uint8, shape (H, W, 3)
        Red, green, blue, with pixels of one width on the ground; their sizes may differ.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        A new picture: blurred evenly in all directions, nothing in it moves.

    Raises
    ------
    ImageError
        If a picture is less than 64 pixels high or wide.

    Examples
    --------
    A chessboard of single pixels becomes grey beside one whose fields are four pixels wide: that has no such waves.

    >>> rows, cols = np.indices((128, 128))
    >>> fine, coarse = (np.uint8(120 + 80 * ((rows // n + cols // n) % 2))[..., None].repeat(3, axis=2) for n in (1, 4))
    >>> bool(no_sharper(fine, than=coarse).std() < 0.1 * fine.std())
    True
    """
    own, other = _power(picture), _power(than)
    loss = np.minimum(np.log(np.maximum(other - _ROUNDING, _ROUNDING / 8) / (own + 1e-9)), 0.0) / 2
    loss[0] = 0.0  # of the mean brightness
    padded = cv2.copyMakeBorder(picture, *(_TILE_PX,) * 4, cv2.BORDER_REFLECT_101).astype(np.float32)
    rows, cols = padded.shape[:2]
    loss_at = np.interp(_TILE_PX * _frequencies(rows, cols), np.arange(len(loss)), loss)
    waves = scipy.fft.rfft2(padded, axes=(0, 1)) * np.exp(loss_at)[..., None].astype(np.float32)
    blurred = scipy.fft.irfft2(waves, s=(rows, cols), axes=(0, 1))[_TILE_PX:-_TILE_PX, _TILE_PX:-_TILE_PX]
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


def _power(picture: Picture) -> Floats:
    """Return the mean power of brightness by waves per tile, shape (R,): that of all tiles, in all directions."""
    if min(picture.shape[:2]) < _TILE_PX:
        wide = f"{picture.shape[1]} x {picture.shape[0]}"
        raise ImageError(
            f"a picture of {wide} pixels is too small to measure its sharpness: expected {_TILE_PX} or more"
        )
    grey = picture.astype(np.float64).mean(axis=2)
    tiles = np.lib.stride_tricks.sliding_window_view(grey, (_TILE_PX, _TILE_PX))[::_STEP_PX, ::_STEP_PX]
    tiles = tiles - tiles.mean(axis=(2, 3), keepdims=True)
    power = (np.abs(scipy.fft.rfft2(tiles * _FADE)) ** 2).mean(axis=(0, 1)).ravel()
    waves = np.rint(_TILE_PX * _frequencies(_TILE_PX, _TILE_PX)).astype(int).ravel()
    return np.asarray(np.bincount(waves, power) / np.bincount(waves))


def _frequencies(rows: int, cols: int) -> Floats:
    """Return the waves per pixel of each term of a real two-dimensional Fourier transform."""
    return np.asarray(np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)))
