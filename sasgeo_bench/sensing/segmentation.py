# SPDX-License-Identifier: Apache-2.0
"""Segmentation: the probability of every class at every pixel of an image, or no prediction."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import scipy  # its parts are loaded where they are used: what only plans or carries pictures starts without them
from numpy.typing import NDArray
from scipy.special import expit, logit

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.image import check_classes, pack_parts, split_parts, unpack_body

SILENT: Final = 255  # the byte of a pixel without a prediction
CERTAIN: Final = 254  # the byte of P(present) = 1
MOST_CLASSES: Final = 64
MOST_VALUES: Final = 2**30  # bytes of probabilities in one segmentation

_MAGIC: Final = b"SGSEG\x01"
_STEP: Final = 1 / CERTAIN
_MOST_SHIFT: Final = 60.0  # of the log-odds: beyond it a probability is 0 or 1 to all digits
_LEAST_SHARE: Final = 1e-9  # far less than a pixel
_PIXELS_EACH: Final = 100.0  # that count as one: neighbours are right or wrong together


@dataclass(frozen=True, slots=True, kw_only=True)
class Segmentation:
    """What a segmenter says of an image: for each class and pixel the probability that the class is there, or nothing.

    Parameters
    ----------
    classes : tuple of str
        Names of the classes, in the order of the planes. Classes overlap, so probabilities do not add up to 1.
    probability_bytes : ndarray of uint8, shape (C, H, W)
        0..254 is P(present) times 254, rounded; 255 says nothing. Row 0 is the top of the picture. Made read-only.

    Raises
    ------
    ImageError
        If shape or type do not fit, or a class is missing or repeated.

    Examples
    --------
    >>> seen = Segmentation(classes=("water",), probability_bytes=np.array([[[0, 127, 254, 255]]], dtype=np.uint8))
    >>> seen.probabilities()[0, 0].tolist()
    [0.0, 0.5, 1.0, nan]
    """

    classes: tuple[str, ...]
    probability_bytes: NDArray[np.uint8]

    def __post_init__(self) -> None:
        """Check shape and type; lock the bytes."""
        check_classes(self.classes)
        planes = self.probability_bytes
        is_sound = planes.dtype == np.uint8 and planes.ndim == 3 and len(planes) == len(self.classes)
        if not is_sound or planes.size == 0:
            raise ImageError(
                f"a segmentation of {len(self.classes)} classes is uint8 of shape (C, H, W) with a pixel at least, "
                f"got {planes.dtype} of shape {planes.shape}"
            )
        planes.flags.writeable = False

    @classmethod
    def of_probabilities(cls, classes: tuple[str, ...], probabilities: NDArray[np.floating]) -> Self:
        """Round probabilities, shape (C, H, W), to bytes; NaN says nothing. Raise `ImageError` for one beyond 0..1.

        >>> Segmentation.of_probabilities(("water",), np.array([[[0.25, np.nan]]])).probability_bytes.tolist()
        [[[64, 255]]]
        """
        planes = np.empty(probabilities.shape, dtype=np.uint8)
        for plane, given in zip(planes, probabilities, strict=True):  # each alone: all at a time take 20 bytes a pixel
            is_silent = np.isnan(given)
            filled = np.where(is_silent, 0, given)
            if filled.size and not (filled.min() >= 0 and filled.max() <= 1):
                raise ImageError(f"probabilities lie in 0..1, got {filled.min():g}..{filled.max():g}")
            plane[:] = np.where(is_silent, SILENT, np.floor(filled * CERTAIN + 0.5))
        return cls(classes=classes, probability_bytes=planes)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return (self.probability_bytes.shape[1], self.probability_bytes.shape[2])

    def probabilities(self) -> NDArray[np.float32]:
        """Return P(present) for each class and pixel, shape (C, H, W); NaN where there is no prediction."""
        table = (np.arange(SILENT + 1) * _STEP).astype(np.float32)
        table[SILENT] = np.nan
        return table[self.probability_bytes]

    def shares(self) -> dict[str, float]:
        """Return the mean probability of each class over the pixels with a prediction; NaN where none is.

        >>> seen = Segmentation(classes=("water",), probability_bytes=np.array([[[0, 254, 255]]], dtype=np.uint8))
        >>> seen.shares()
        {'water': 0.5}
        """
        counts = (np.bincount(plane.ravel(), minlength=256)[:SILENT] for plane in self.probability_bytes)
        steps = np.arange(SILENT)
        means = (float(count @ steps / count.sum() * _STEP) if count.any() else np.nan for count in counts)
        return dict(zip(self.classes, means, strict=True))

    def with_shares(self, shares: Mapping[str, float]) -> Self:
        """Return the segmentation recalibrated so that the mean probability of a class is a given share; no labels.

        Parameters
        ----------
        shares : mapping of str to float
            Fraction of the ground that a class covers, 0..1, such as the map's own in the area of the prior. Classes
            that are not named stay as they are.

        Returns
        -------
        Segmentation
            Log-odds of each named class are shifted by one number, so the order of pixels stays; pixels of which
            there is no prediction stay so. The mean is met up to the rounding of bytes (1/508).

        Raises
        ------
        ImageError
            If a class is not there, or a share is not within 0..1.

        Notes
        -----
        Under a change of priors alone, all odds of a class change by one factor (Saerens, Latinne and Decaestecker,
        Neural Computation 14, 2002, Eq. 2.4). They compute it from the shares of the training data; here it is the one
        factor that gives the new share, so that shares of the training data need not be known. It holds as far as the
        look of a class does not change with the place, and the share is that of the ground in the picture.

        Examples
        --------
        A segmenter that learned in a town sees too many roofs in the country, where the map has 10 %:

        >>> cells = np.array([[[127, 127, 127, 203]]], dtype=np.uint8)
        >>> seen = Segmentation(classes=("building",), probability_bytes=cells)
        >>> seen.with_shares({"building": 0.1}).probability_bytes.tolist()
        [[[16, 16, 16, 54]]]
        """
        return self.recoded(tables_of(self.counts(), shares))

    def counts(self) -> dict[str, NDArray[np.int64]]:
        """Return how many pixels have each byte, shape (255,), by class; those without a prediction are left out.

        Counts of several pictures add up: with the sum `tables_of` recalibrates them together, as one flight.
        """
        planes = zip(self.classes, self.probability_bytes, strict=True)
        return {name: np.bincount(plane.ravel(), minlength=SILENT + 1)[:SILENT] for name, plane in planes}

    def recoded(self, tables: Mapping[str, NDArray[np.uint8]]) -> Self:
        """Return the segmentation with every byte of some classes replaced, by tables of shape (256,)."""
        planes = self.probability_bytes.copy()
        for at, name in enumerate(self.classes):
            if name in tables:
                planes[at] = tables[name][planes[at]]
        return type(self)(classes=self.classes, probability_bytes=planes)

    def to_bytes(self) -> bytes:
        """Return classes, shape and compressed probabilities as bytes, which `from_bytes` reads; executes nothing."""
        head = {"classes": self.classes, "shape": self.shape}
        return pack_parts(_MAGIC, head, self.probability_bytes.tobytes())

    @classmethod
    def from_bytes(cls, data: bytes, *, shape: tuple[int, int] | None = None) -> Self:
        """Read the bytes of `to_bytes`, from anywhere: never more is unpacked than the head announces.

        `shape` is the expected number of rows and columns, if known. Raise `ImageError` if the bytes are damaged or
        too many, or of another shape.
        """
        head, rest = split_parts(_MAGIC, data, "a segmentation")
        classes, found = _read_head(head)
        if shape is not None and found != shape:
            raise ImageError(f"a segmentation of shape {found}, expected {shape} as the picture is")
        planes = unpack_body(rest, len(classes) * found[0] * found[1], "a segmentation")
        cells = np.frombuffer(planes, dtype=np.uint8).reshape(len(classes), *found)
        return cls(classes=classes, probability_bytes=cells)


def tables_of(counts: Mapping[str, NDArray[np.int64]], shares: Mapping[str, float]) -> dict[str, NDArray[np.uint8]]:
    """Return the new byte of every byte, shape (256,), by class, so that mean probabilities become the shares.

    `counts` are as of `Segmentation.counts`. Raise `ImageError` as `Segmentation.with_shares` does.

    >>> tables_of({"water": np.bincount([127] * 4, minlength=255)}, {"water": 0.3})["water"][[100, 127, 255]].tolist()
    [55, 76, 255]
    """
    tables = {}
    for name, share in shares.items():
        if name not in counts:
            raise ImageError(f"there is no class {name!r}, the segmentation has {', '.join(counts)}")
        if not 0 <= share <= 1:
            raise ImageError(f"the share of {name} must lie in 0..1, got {share!r}")
        tables[name] = _shifted_bytes(counts[name], share)
    return tables


def _shifted_bytes(counts: NDArray[np.int64], share: float) -> NDArray[np.uint8]:
    """Return the new byte of every byte, shape (256,), so that the mean over `counts`, shape (255,), is the share."""
    same = np.arange(SILENT + 1, dtype=np.uint8)
    if not counts.any():
        return same
    if share in (0, 1):
        return np.where(same == SILENT, SILENT, round(share * CERTAIN)).astype(np.uint8)
    log_odds = _byte_log_odds()
    share = min(max(share, _LEAST_SHARE), 1 - _LEAST_SHARE)
    weights = counts / counts.sum()
    shift = scipy.optimize.brentq(lambda by: float(weights @ expit(log_odds + by)) - share, -_MOST_SHIFT, _MOST_SHIFT)
    same[:SILENT] = np.floor(expit(log_odds + shift) * CERTAIN + 0.5)
    return same


def calibration_tables(counts: Mapping[str, NDArray[np.integer]]) -> dict[str, NDArray[np.uint8]]:
    """Return the new byte of every byte, shape (256,), by class, that is calibrated on labelled pixels.

    Parameters
    ----------
    counts : mapping of str to ndarray of int, shape (2, 256)
        Pixels of each class by label (absent, present) and byte, as `PixelCounts.of_class` has them: of places that
        taught the segmenter nothing.

    Returns
    -------
    dict of str to ndarray of uint8
        For `Segmentation.recoded`. Log-odds of a class are scaled by one positive number and shifted by another (Platt
        1999), so the order of pixels stays. A class without pixels of both labels is left out.

    Notes
    -----
    Pixels repeat each other: some hundred count as one, against a weak prior of no change.

    Examples
    --------
    A segmenter that says 0.5 of roofs is right in one case of ten:

    >>> counts = np.zeros((2, 256), dtype=np.int64)
    >>> counts[:, 127] = 90_000, 10_000
    >>> calibration_tables({"building": counts})["building"][[127, 255]].tolist()
    [26, 255]
    """
    tables = {}
    for name, pixels in counts.items():
        if pixels[:, :SILENT].any(axis=1).all():
            scale, shift = calibration_of(pixels)
            tables[name] = np.arange(SILENT + 1, dtype=np.uint8)
            tables[name][:SILENT] = np.floor(expit(scale * _byte_log_odds() + shift) * CERTAIN + 0.5)
    return tables


def calibration_of(pixels: NDArray[np.integer]) -> tuple[float, float]:
    """Return scale and shift of the log-odds of one class, from its pixels, shape (2, 256), as `calibration_tables`.

    >>> counts = np.zeros((2, 256), dtype=np.int64)
    >>> counts[:, 127] = 90_000, 10_000
    >>> [round(number, 1) for number in calibration_of(counts)]
    [1.0, -2.2]
    """
    log_odds = _byte_log_odds()
    absent, present = pixels[:, :SILENT] / _PIXELS_EACH

    def loss(vector: NDArray[np.float64]) -> float:
        """Return the negative log posterior of the logarithm of the scale, and of the shift."""
        changed = np.exp(vector[0]) * log_odds + vector[1]
        return float(present @ np.logaddexp(0, -changed) + absent @ np.logaddexp(0, changed) + 0.5 * vector @ vector)

    scale, shift = scipy.optimize.minimize(
        loss, np.zeros(2), method="L-BFGS-B", bounds=[(-3.0, 3.0), (-_MOST_SHIFT, _MOST_SHIFT)]
    ).x
    return float(np.exp(scale)), float(shift)


def _byte_log_odds() -> NDArray[np.float64]:
    """Return the log-odds of every byte, shape (255,).

    The outer bytes stand for half a step each: their odds are finite, so a share can always be met.
    """
    return np.asarray(logit(np.clip(np.arange(SILENT) * _STEP, _STEP / 4, 1 - _STEP / 4)))


def _read_head(head: Mapping[str, object]) -> tuple[tuple[str, ...], tuple[int, int]]:
    """Read classes, rows and columns; raise `ImageError` if they are none, or too many."""
    classes, shape = head.get("classes"), head.get("shape")
    if not (isinstance(classes, list) and all(isinstance(name, str) for name in classes)) or not (
        isinstance(shape, list)
        and len(shape) == 2  # rows and columns
        and all(type(side) is int and side > 0 for side in shape)
    ):
        raise ImageError("the head of a segmentation is damaged: make it again")
    rows, cols = shape
    if len(classes) > MOST_CLASSES or len(classes) * rows * cols > MOST_VALUES:
        raise ImageError(
            f"a segmentation of {len(classes)} classes and {rows} x {cols} pixels is too large: cut the picture"
        )
    return tuple(classes), (rows, cols)
