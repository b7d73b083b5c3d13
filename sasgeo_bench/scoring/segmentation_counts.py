# SPDX-License-Identifier: Apache-2.0
"""Pixels of a segmented image, counted against its labels: all that scores of segmenters are computed from."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
import pandas as pd

from sasgeo_bench.errors import MetricError, StoreError
from sasgeo_bench.files.parquet import read_frame, write_frame
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.scoring.base import Ints
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.sensing.segmentation import SILENT, Segmentation

BYTES: Final = 256
SEEN: Final = 127  # the least byte that says present: P = 0.5
GROUND: Final = ""  # the row of what no labelled class covers, in a file of counts
_PIXELS: Final = ("absent", "present")
_SHARED: Final = ("instead", "besides", "asked")
_MEND: Final = "count the images again"


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelCounts:
    """Counts of the labelled pixels of one image; what is labelled UNKNOWN counts nowhere.

    Parameters
    ----------
    image, place, season : str
        The image's own name, its place, and its season, "" for unspecified.
    classes : tuple of str
        The C labelled classes. One that the segmenter does not tell counts as one of which it says nothing.
    pixels : ndarray of int64, shape (C, 2, 256)
        Pixels by label (absent, present) and byte of the probability; 255 says nothing.
    instead, besides, asked : ndarray of int64, shape (C + 1, C)
        Confusions of what is there (rows; the last is ground, where every class is known to be absent) with what is
        seen wrongly (columns): the column's class instead of the row's, or besides it, of the pixels that are asked
        about: the row's class is there, the column's is not, and something is said of both. The diagonal is 0.

    Examples
    --------
    >>> from sasgeo_bench.sensing.tiny_images import tiny_images
    >>> labelled = tiny_images()[0]
    >>> half = Segmentation(classes=("water",), probability_bytes=np.full((1, *labelled.image.shape), 127, np.uint8))
    >>> counts = PixelCounts.of(labelled, half, image="1")
    >>> present = labelled.labels[labelled.classes.index("water")] == PRESENT
    >>> counts.of_class("water")[1, 127].item() == present.sum().item()
    True
    """

    image: str
    place: str
    season: str
    classes: tuple[str, ...]
    pixels: Ints
    instead: Ints
    besides: Ints
    asked: Ints

    @classmethod
    def of(cls, labelled: LabelledImage, found: Segmentation, *, image: str) -> Self:
        """Count a segmentation against the labels; raise `MetricError` if it is of another size."""
        if found.shape != labelled.image.shape:
            raise MetricError(
                f"a segmentation of shape {found.shape} is scored on a picture of shape {labelled.image.shape}"
            )
        bytes_ = np.full(labelled.labels.shape, SILENT, dtype=np.uint8)
        for at, name in enumerate(labelled.classes):
            if name in found.classes:
                bytes_[at] = found.probability_bytes[found.classes.index(name)]
        pixels = np.stack([_by_byte(said, labels) for said, labels in zip(bytes_, labelled.labels, strict=True)])
        instead, besides, asked = _confusions(bytes_, labelled.labels)
        return cls(
            image=image,
            place=labelled.place,
            season=labelled.image.season,
            classes=labelled.classes,
            pixels=pixels,
            instead=instead,
            besides=besides,
            asked=asked,
        )

    def of_class(self, name: str) -> Ints:
        """Return the pixels of a class by label and byte, shape (2, 256); all 0 if it is not labelled."""
        return self.pixels[self.classes.index(name)] if name in self.classes else np.zeros((2, BYTES), dtype=np.int64)


def _by_byte(said: np.ndarray, labels: np.ndarray) -> Ints:
    """Count the bytes where a class is absent and where it is present, shape (2, 256)."""
    return np.stack([np.bincount(said[labels == state], minlength=BYTES) for state in (ABSENT, PRESENT)])


def _confusions(said: np.ndarray, labels: np.ndarray) -> tuple[Ints, Ints, Ints]:
    """Count confusions, shape (C + 1, C) each; see `PixelCounts`."""
    # Classes are few and pixels many: one matrix product of pixels' states counts all pairs of classes.
    flat, truth = said.reshape(len(said), -1), labels.reshape(len(labels), -1)
    spoken = flat != SILENT
    seen = spoken & (flat >= SEEN)
    labelled = (truth != UNKNOWN).any(axis=1)  # a class that nobody has looked for hides no ground
    ground = (truth[labelled] == ABSENT).all(axis=0) & labelled.any()
    rows = np.concatenate(((truth == PRESENT) & spoken, ground[None]))
    missed = np.concatenate(((truth == PRESENT) & spoken & ~seen, ground[None]))
    could, alarm = (truth == ABSENT) & spoken, (truth == ABSENT) & seen
    asked, false, instead = _products(rows, could), _products(rows, alarm), _products(missed, alarm)
    return instead, false - instead, asked


def _products(first: np.ndarray, second: np.ndarray) -> Ints:
    """Count the pixels that two masks share, for each pair of rows; floats, as integers are not multiplied by BLAS."""
    found = first.astype(np.float32) @ second.astype(np.float32).T
    return np.asarray(np.rint(found), dtype=np.int64)


def write_counts(counts: Sequence[PixelCounts], path: Path, **about: str) -> None:
    """Write counts as a Parquet file: a row for each image and class, one for its ground; `about` goes to `attrs`."""
    rows = []
    for one in counts:
        head = {"image": one.image, "place": one.place, "season": one.season}
        for at, name in enumerate((*one.classes, GROUND)):
            bytes_ = one.pixels[at] if at < len(one.classes) else np.zeros((2, 0), dtype=np.int64)
            row = dict(zip(_PIXELS, bytes_, strict=True)) | {key: getattr(one, key)[at] for key in _SHARED}
            rows.append({**head, "class": name, **row})
    write_frame(pd.DataFrame(rows), path, attrs=about)


def read_counts(path: Path) -> tuple[PixelCounts, ...]:
    """Read the output of `write_counts`; raise `StoreError` if it is damaged or something else."""
    frame = read_frame(path, mend=_MEND)
    try:
        return tuple(_read(part) for _, part in frame.groupby("image", sort=False))
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise StoreError(f"{path} holds no counts of segmented images: {_MEND}") from error


def _read(part: pd.DataFrame) -> PixelCounts:
    """Read the rows of one image; the last one is its ground."""
    classes = tuple(part["class"].iloc[:-1])
    if part["class"].iloc[-1] != GROUND or GROUND in classes:
        raise ValueError(part["image"].iloc[0])
    shared = {key: np.stack(list(part[key])).astype(np.int64).reshape(len(part), len(classes)) for key in _SHARED}
    pixels = np.stack([np.stack(list(part[key])[:-1]) for key in _PIXELS], axis=1).astype(np.int64)
    image, place, season = (str(part[key].iloc[0]) for key in ("image", "place", "season"))
    return PixelCounts(
        image=image,
        place=place,
        season=season,
        classes=classes,
        pixels=pixels.reshape(len(classes), 2, BYTES),
        instead=shared["instead"],
        besides=shared["besides"],
        asked=shared["asked"],
    )
