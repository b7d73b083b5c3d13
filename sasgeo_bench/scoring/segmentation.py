# SPDX-License-Identifier: Apache-2.0
"""Scores of segmenters: what is found, how far chances can be trusted, and what silence costs and saves.

Every figure is computed from counts of pixels by label and probability (`segmentation_counts`), so images add up, and
images that are drawn again add up as well. Pixels of one image are far from independent: intervals draw places with
replacement, then images within them, and never pixels.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
import pandas as pd

from sasgeo_bench.core.errors import MetricError, StoreError
from sasgeo_bench.core.parquet import read_frame, write_frame
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.scoring.base import Floats, Ints
from sasgeo_bench.scoring.intervals import ClusterDraws, percentile_interval, seed_of_text
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation

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
        about: the row's class is there, the column's is not, and both have a prediction. The diagonal is 0.

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
        pixels = np.stack(
            [_by_byte(predicted, labels) for predicted, labels in zip(bytes_, labelled.labels, strict=True)]
        )
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


def _by_byte(predicted: np.ndarray, labels: np.ndarray) -> Ints:
    """Count the bytes where a class is absent and where it is present, shape (2, 256)."""
    return np.stack([np.bincount(predicted[labels == state], minlength=BYTES) for state in (ABSENT, PRESENT)])


def _confusions(predicted: np.ndarray, labels: np.ndarray) -> tuple[Ints, Ints, Ints]:
    """Count confusions, shape (C + 1, C) each; see `PixelCounts`."""
    # Classes are few and pixels many: one matrix product of pixels' states counts all pairs of classes.
    flat, truth = predicted.reshape(len(predicted), -1), labels.reshape(len(labels), -1)
    spoken = flat != SILENT
    seen = spoken & (flat >= SEEN)
    labelled = (truth != UNKNOWN).any(axis=1)  # a class that is not labelled hides no ground
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


DRAWS: Final = 1000  # of the bootstrap: percentiles of images need no more, and each draw is 512 counts
BINS: Final = 10  # of a reliability table, equally wide
KEPT: Final = 0.8  # coverage at which the error of the surest pixels is reported
GROUPS: Final = ("all", "place", "season")
_CHANCES: Final = np.arange(SILENT) / CERTAIN
_BIN: Final = np.minimum((_CHANCES * BINS).astype(int), BINS - 1)
LEVELS: Final = np.abs(np.arange(SILENT) - SEEN)  # how sure a byte is, 0 to 127
_IN_LEVEL: Final = (LEVELS[:, None] == np.arange(SEEN, -1, -1)).astype(np.float64)  # surest first


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelMetric:
    """A figure of one class from counts of pixels.

    `compute` maps counts by label and byte, shape (..., 2, 256), to values, shape (...); NaN where there is nothing to
    divide by.
    """

    name: str
    meaning: str
    better: Literal["higher", "lower", ""]
    compute: Callable[[Floats], Floats]


def _ratio(part: Floats, whole: Floats) -> Floats:
    return np.asarray(np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=whole > 0))


def _seen(counts: Floats) -> Floats:
    """Return the pixels that are seen, by label, shape (..., 2)."""
    return np.asarray(counts[..., SEEN:SILENT].sum(axis=-1))


def iou(counts: Floats) -> Floats:
    """Return intersection over union of what is seen (P >= 0.5) and what is there; silence sees nothing.

    >>> counts = np.zeros((2, 256))
    >>> counts[1, 254], counts[1, 255], counts[0, 200] = 6, 2, 4  # found, silent, false alarm
    >>> iou(counts).item(), recall(counts).item(), precision(counts).item()
    (0.5, 0.75, 0.6)
    """
    seen = _seen(counts)
    return _ratio(seen[..., 1], counts[..., 1, :].sum(axis=-1) + seen[..., 0])


def recall(counts: Floats) -> Floats:
    """Return the fraction of what is there that is seen; silence on it is a miss."""
    return _ratio(_seen(counts)[..., 1], counts[..., 1, :].sum(axis=-1))


def recall_where_known(counts: Floats) -> Floats:
    """Return the fraction of what is there that is seen, of pixels with a prediction."""
    return _ratio(_seen(counts)[..., 1], counts[..., 1, :SILENT].sum(axis=-1))


def precision(counts: Floats) -> Floats:
    """Return the fraction of what is seen that is there."""
    seen = _seen(counts)
    return _ratio(seen[..., 1], seen.sum(axis=-1))


def silent_share(counts: Floats) -> Floats:
    """Return the fraction of labelled pixels without a prediction."""
    return _ratio(counts[..., SILENT].sum(axis=-1), counts.sum(axis=(-2, -1)))


def auc(counts: Floats) -> Floats:
    """Return the chance that a pixel of the class has a higher probability than one without it; ties count half.

    >>> counts = np.zeros((2, 256))
    >>> counts[1, [100, 200]], counts[0, [100, 50]] = 1, 1  # of four pairs three are in order, one is tied
    >>> auc(counts).item()
    0.875
    """
    absent, present = counts[..., 0, :SILENT], counts[..., 1, :SILENT]
    below = np.cumsum(absent, axis=-1) - absent / 2
    return _ratio((present * below).sum(axis=-1), present.sum(axis=-1) * absent.sum(axis=-1))


def brier(counts: Floats) -> Floats:
    """Return the mean squared difference of probability and truth, where there is a prediction."""
    absent, present = counts[..., 0, :SILENT], counts[..., 1, :SILENT]
    total = absent @ _CHANCES**2 + present @ (1 - _CHANCES) ** 2
    return _ratio(total, (absent + present).sum(axis=-1))


def calibration_error(counts: Floats) -> Floats:
    """Return the mean over pixels of |mean probability - fraction present| of their bin, of ten equally wide.

    Guo et al., ICML 2017, Eq. (3), on the probability of the class rather than of the answer.

    Of ten pixels with 0.75 five are present, and of ten with 0 none:

    >>> counts = np.zeros((2, 256))
    >>> counts[1, 190], counts[0, 190], counts[0, 0] = 5, 5, 10
    >>> round(calibration_error(counts).item(), 3)
    0.124
    """
    pixels, mass, hits = _binned(counts)
    return _ratio(np.abs(mass - hits).sum(axis=-1), pixels.sum(axis=-1))


def _binned(counts: Floats) -> tuple[Floats, Floats, Floats]:
    """Return pixels, sum of probabilities and present pixels by bin, shape (..., BINS) each."""
    in_bin = (_BIN[:, None] == np.arange(BINS)).astype(np.float64)
    both = counts[..., :SILENT].sum(axis=-2)
    return both @ in_bin, (both * _CHANCES) @ in_bin, counts[..., 1, :SILENT] @ in_bin


def share_gap(counts: Floats) -> Floats:
    """Return the mean probability less the fraction present, where there is a prediction."""
    both = counts[..., :SILENT].sum(axis=-2)
    return _ratio(both @ _CHANCES - counts[..., 1, :SILENT].sum(axis=-1), both.sum(axis=-1))


def error_where_known(counts: Floats) -> Floats:
    """Return the fraction of pixels that are taken for the wrong state, where there is a prediction."""
    wrong, answered = _by_level(counts)
    return _ratio(wrong.sum(axis=-1), answered.sum(axis=-1))


def error_of_most_confident(counts: Floats) -> Floats:
    """Return the error of the surest 80 % of the labelled pixels; NaN where fewer have a prediction.

    This is what is left to go wrong once the rest becomes unknown. Pixels that are equally sure are kept together.
    """
    wrong, answered = (np.cumsum(part, axis=-1) for part in _by_level(counts))
    enough = answered >= KEPT * counts.sum(axis=(-2, -1))[..., None]
    first = np.argmax(enough, axis=-1)[..., None]
    kept = _ratio(np.take_along_axis(wrong, first, -1)[..., 0], np.take_along_axis(answered, first, -1)[..., 0])
    return np.where(enough.any(axis=-1), kept, np.nan)


def aurc(counts: Floats) -> Floats:
    """Return the area under error over coverage, where there is a prediction: pixels become unknown, least sure first.

    Geifman et al., ICLR 2019. Pixels that are equally sure are kept together.

    >>> counts = np.zeros((2, 256))
    >>> counts[1, 254], counts[0, 130] = 1, 1  # the surer pixel is right, the other wrong: (0 + 1/2) / 2
    >>> aurc(counts).item()
    0.25
    """
    wrong, answered = _by_level(counts)
    error = np.nan_to_num(_ratio(np.cumsum(wrong, axis=-1), np.cumsum(answered, axis=-1)))
    return _ratio((answered * error).sum(axis=-1), answered.sum(axis=-1))


def _by_level(counts: Floats) -> tuple[Floats, Floats]:
    """Return wrong pixels and all with a prediction, by how sure they are, surest first, shape (..., 128)."""
    wrong = np.concatenate((counts[..., 1, :SEEN], counts[..., 0, SEEN:SILENT]), axis=-1)
    return wrong @ _IN_LEVEL, counts[..., :SILENT].sum(axis=-2) @ _IN_LEVEL


PIXEL_METRICS: Final = (
    PixelMetric(name="iou", meaning="intersection over union at P >= 0.5", better="higher", compute=iou),
    PixelMetric(name="recall", meaning="fraction of the class that is seen", better="higher", compute=recall),
    PixelMetric(name="precision", meaning="fraction of what is seen that is there", better="higher", compute=precision),
    PixelMetric(name="auc", meaning="area under the ROC curve", better="higher", compute=auc),
    PixelMetric(name="brier", meaning="mean squared error of the probability", better="lower", compute=brier),
    PixelMetric(name="ece", meaning="expected calibration error, ten bins", better="lower", compute=calibration_error),
    PixelMetric(name="share_gap", meaning="mean probability less fraction present", better="", compute=share_gap),
    PixelMetric(name="silent", meaning="fraction of pixels without a prediction", better="", compute=silent_share),
    PixelMetric(
        name="recall_where_known",
        meaning="recall where there is a prediction",
        better="higher",
        compute=recall_where_known,
    ),
    PixelMetric(
        name="error", meaning="wrong pixels where there is a prediction", better="lower", compute=error_where_known
    ),
    PixelMetric(
        name="error_80", meaning="wrong pixels of the surest 80 %", better="lower", compute=error_of_most_confident
    ),
    PixelMetric(name="aurc", meaning="area under error over coverage", better="lower", compute=aurc),
)


def segmentation_scores(
    counts: Sequence[PixelCounts], *, draws: int = DRAWS, groups: Sequence[str] = GROUPS, **about: str
) -> pd.DataFrame:
    """Return every metric of every class, over all images, by place and by season, with 95 % intervals.

    Parameters
    ----------
    counts : sequence of PixelCounts
        One for each image of a test, by one segmenter.
    draws : int
        Draws of the bootstrap.
    groups : sequence of str
        Which of "all", "place" and "season" to score.
    **about : str
        Columns that come first, as segmenter="pixel_forest", tested_on="shifted".

    Returns
    -------
    DataFrame
        `group` is "all", "place" or "season", `name` which one; then class, metric, value; `lo`, `hi` of draws of
        places, then of images within them, NaN for a single place; `lo_images`, `hi_images` of draws of images alone,
        NaN for a single one; the number of images and of places; and labelled pixels. A class without a prediction
        in any image, since the segmenter cannot tell it, has no row.
    """
    rows = [row for group, name, part in _groups(counts, groups) for row in _rows(group, name, part, draws)]
    columns = ["group", "name", "class", "metric", "value", "lo", "hi", "lo_images", "hi_images"]
    frame = pd.DataFrame(rows, columns=[*columns, "images", "places", "pixels"])
    for at, (key, value) in enumerate(about.items()):
        frame.insert(at, key, value)
    return frame


def _groups(counts: Sequence[PixelCounts], groups: Sequence[str]) -> Iterator[tuple[str, str, list[PixelCounts]]]:
    """Yield the images of all, of each place and of each season that is known, as far as they are wanted."""
    if GROUPS[0] in groups:
        yield GROUPS[0], "", list(counts)
    for group in filter(groups.__contains__, GROUPS[1:]):
        for name in sorted({getattr(one, group) for one in counts} - {""}):
            yield group, name, [one for one in counts if getattr(one, group) == name]


def predicted_classes(counts: Sequence[PixelCounts]) -> tuple[str, ...]:
    """Return the classes with a prediction on a labelled pixel of any image, as they first come."""
    names = dict.fromkeys(name for one in counts for name in one.classes)
    return tuple(name for name in names if any(one.of_class(name)[:, :SILENT].any() for one in counts))


def _rows(group: str, name: str, counts: list[PixelCounts], draws: int) -> Iterator[tuple[str | float, ...]]:
    """Yield rows with the columns of `segmentation_scores`."""
    places = [one.place for one in counts]
    for class_name in predicted_classes(counts):
        table = np.stack([one.of_class(class_name) for one in counts]).astype(np.float64)
        used = table.sum(axis=(1, 2)) > 0
        where = [place for place, is_used in zip(places, used, strict=True) if is_used]
        tail = len(where), len(set(where)), int(table.sum())
        seed = seed_of_text(f"{group}/{name}/{class_name}")
        by_image = _drawn(table[used], ["all"] * len(where), seed, draws)
        has_others = len(set(where)) > 1  # one place says nothing of others
        by_place = _drawn(table[used], where, seed, draws) if has_others else np.full_like(by_image, np.nan)
        for metric, first, second in zip(PIXEL_METRICS, by_place, by_image, strict=True):
            value = float(metric.compute(table.sum(axis=0)))
            outer, inner = percentile_interval(value, first), percentile_interval(value, second)
            yield group, name, class_name, metric.name, value, outer.lo, outer.hi, inner.lo, inner.hi, *tail


def _drawn(table: Floats, blocks: list[str], seed: int, draws: int) -> Floats:
    """Return every metric of every draw, shape (metrics, D); NaN for a single image."""
    if len(table) < 2:  # there is nothing to draw
        return np.full((len(PIXEL_METRICS), 1), np.nan)
    sums = ClusterDraws(blocks=blocks, seed=seed, draws=draws).sums(table.reshape(len(table), -1))
    parts = (some.reshape(-1, 2, BYTES) for some in sums)
    return np.concatenate([np.stack([metric.compute(part) for metric in PIXEL_METRICS]) for part in parts], axis=1)


def reliability(counts: Sequence[PixelCounts], **about: str) -> pd.DataFrame:
    """Return a reliability table: for each class and bin, pixels, mean probability and fraction present.

    Chances can be trusted where the last two agree; bins without pixels are left out.
    """
    rows = []
    for name in predicted_classes(counts):
        pixels, mass, hits = _binned(_total(counts, name))
        for at in np.flatnonzero(pixels).tolist():
            row = {"class": name, "from": at / BINS, "to": (at + 1) / BINS, "pixels": int(pixels[at])}
            rows.append({**about, **row, "probability": mass[at] / pixels[at], "present": hits[at] / pixels[at]})
    return pd.DataFrame(rows)


def error_over_coverage(counts: Sequence[PixelCounts], **about: str) -> pd.DataFrame:
    """Return the error of what is kept when all pixels less sure than a confidence become unknown, for each class.

    Columns: confidence (max of P and 1 - P), coverage of all labelled pixels, error, and recall, which falls with it.
    """
    rows = []
    for name in predicted_classes(counts):
        total = _total(counts, name)
        wrong, answered = (np.cumsum(part) for part in _by_level(total))
        found = np.cumsum(np.concatenate((np.zeros(SEEN), total[1, SEEN:SILENT])) @ _IN_LEVEL)
        for at in np.flatnonzero(np.diff(answered, prepend=0.0)).tolist():
            row = {"class": name, "confidence": 0.5 + (SEEN - at) / CERTAIN, "coverage": answered[at] / total.sum()}
            rows.append(
                {**about, **row, "error": wrong[at] / answered[at], "recall": found[at] / max(total[1].sum(), 1)}
            )
    return pd.DataFrame(rows)


def _total(counts: Sequence[PixelCounts], name: str) -> Floats:
    return np.asarray(np.sum([one.of_class(name) for one in counts], axis=0), dtype=np.float64)
