# SPDX-License-Identifier: Apache-2.0
"""Small pictures for pages of the web: figures as PNG or WebP of at most so many bytes; a region as a thumbnail."""

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sasgeo_bench.canvas import PlainFigure
from sasgeo_bench.errors import StoreError
from sasgeo_bench.regions.preview import paint_overview
from sasgeo_bench.regions.region import Manifest

WEBP: Final = ".webp"
PNG: Final = ".png"
_QUALITIES: Final = (80, 65, 50, 35, 20, 10)
_SCALES: Final = (1.0, 0.75, 0.5)
_THUMB_INCHES: Final = 3.2
_FOOT_INCHES: Final = 0.16
_DPI: Final = 100


def pixels_of(figure: Figure) -> NDArray[np.uint8]:
    """Return a figure as pixels, shape (rows, cols, 3), blue first."""
    canvas: Any = FigureCanvasAgg(figure)  # without types
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba(), dtype=np.uint8)[..., 2::-1])


def fitted(pixels: NDArray[np.uint8], most_bytes: int) -> bytes:
    """Pixels as WebP, as good and then as large as fits; the same bytes for the same pixels.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (rows, cols, 3)
        Blue first.
    most_bytes : int
        Of the file.

    Raises
    ------
    StoreError
        If even half of its size in the worst quality takes more.

    Examples
    --------
    >>> len(fitted(np.zeros((8, 8, 3), dtype=np.uint8), 1000)) < 200
    True
    """
    for scale in _SCALES:
        smaller = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        for quality in _QUALITIES:
            data = _encoded(WEBP, smaller, [cv2.IMWRITE_WEBP_QUALITY, quality])
            if len(data) <= most_bytes:
                return data
    message = f"a picture of {pixels.shape[1]} x {pixels.shape[0]} pixels does not fit into {most_bytes} bytes"
    raise StoreError(message)


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels without loss, whole or not at all.

    Raises
    ------
    StoreError
        If the folder cannot be written.
    """
    scratch = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(_encoded(PNG, pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9]))
        scratch.rename(path)
    except OSError as error:
        message = f"{path} cannot be written ({error.strerror or error}): check the free space and your rights"
        raise StoreError(message) from error


def _encoded(kind: str, pixels: NDArray[np.uint8], settings: list[int]) -> bytes:
    is_done, data = cv2.imencode(kind, pixels, settings)
    if not is_done:
        message = f"a picture cannot be written as {kind}"
        raise StoreError(message)
    return bytes(data)


def thumbnail(manifest: Manifest, overview: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a region as a small picture with its attribution below; pixels as of `pixels_of`.

    Parameters
    ----------
    manifest : Manifest
        What it is of.
    overview : ndarray of uint8, shape (C, rows, cols)
        A coarse level of the layers.
    """
    rows, cols = overview.shape[1:]
    scale = _THUMB_INCHES / max(rows, cols)
    width, height = max(cols * scale, 1.6), rows * scale + _FOOT_INCHES
    figure = PlainFigure(figsize=(width, height), dpi=_DPI, facecolor="white")
    chart = figure.add_axes((0, _FOOT_INCHES / height, cols * scale / width, rows * scale / height))
    chart.imshow(paint_overview(manifest, overview), interpolation="antialiased", aspect="auto")
    chart.set_axis_off()
    figure.text(0.03 / width, 0.03 / height, manifest.attribution, fontsize=5.5, color="#444444", va="bottom")
    return pixels_of(figure)
