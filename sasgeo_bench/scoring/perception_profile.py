# SPDX-License-Identifier: Apache-2.0
"""Measure the confusions and the silence of a segmenter from its counts of pixels: a profile to draw views with.

False alarms are split by what lies there: ground without any class, or each other class. A precision alone would
change with how common the class is; these rates do not.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import MetricError, named
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.segmentation import (
    LEVELS,
    SEEN,
    PixelCounts,
    precision,
    predicted_classes,
    recall_where_known,
)
from sasgeo_bench.sensing.segmentation import SILENT
from sasgeo_bench.tasks.perturbations.base import Mask
from sasgeo_bench.tasks.perturbations.measured import Silence
from sasgeo_bench.tasks.perturbations.perception_profile import ClassConfusions, PerceptionProfile

_LEAST_SHARE: Final = 0.0005  # rarer confusions are left out


def measure_profile(
    counts: Sequence[PixelCounts], *, segmenter: str, learned_from: str, silence: float = 0.0
) -> PerceptionProfile:
    """Return the confusions of a segmenter on some labelled images.

    Parameters
    ----------
    counts : sequence of PixelCounts
        One for each image; all label the same classes.
    segmenter, learned_from : str
        What the profile says of itself, and the places of the images.
    silence : float
        Share of the answers on all classes together that the segmenter withholds: those that are least sure, by one
        limit of |P - 0.5|, and all that are as sure as the last of them.

    Raises
    ------
    MetricError
        If the images label different classes, or none of the classes that the segmenter tells is there; if `silence` is
        not in [0, 1).

    Notes
    -----
    Only pixels with a prediction count, for rates and for silence: that a segmenter says nothing is no error. Rates are
    of all its answers, those that it withholds among them. Of answers that it never gave, 1 is withheld. Lines are
    scored without the cell of tolerance that the detector "measured" has, so their rates are worse than on a map.

    Examples
    --------
    A segmenter that always says "perhaps" sees everything everywhere:

    >>> from sasgeo_bench.sensing.segmentation import Segmentation
    >>> from sasgeo_bench.sensing.tiny_images import tiny_images
    >>> labelled = tiny_images()[0]
    >>> bytes_ = np.full(labelled.labels.shape, 127, dtype=np.uint8)
    >>> half = Segmentation(classes=labelled.classes, probability_bytes=bytes_)
    >>> some = measure_profile([PixelCounts.of(labelled, half, image="1")], segmenter="half", learned_from="nothing")
    >>> water = some.classes["water"]
    >>> water.recall, water.of_ground, water.called, water.also["building"]
    (1.0, 1.0, {}, 1.0)
    """
    if not 0 <= silence < 1:
        raise MetricError(f"silence is a share of the answers, at least 0 and below 1, got {silence!r}")
    classes = counts[0].classes if counts else ()
    if not counts or any(one.classes != classes for one in counts):
        raise MetricError("a profile is measured on images that all label the same classes, and on one at least")
    predicted = predicted_classes(counts)
    shares = {key: _shares(counts, key) for key in ("instead", "besides")}
    totals = {name: np.sum([one.of_class(name) for one in counts], axis=0).astype(np.float64) for name in predicted}
    withheld = _withheld(np.sum(list(totals.values()), axis=0), silence) if silence and totals else None
    found = {}
    for name, total in totals.items():
        pixels = int(total[1, :-1].sum())
        if pixels:
            silent = None if withheld is None else _silence(total, withheld)
            found[name] = _of_class(name, classes, total, shares).model_copy(
                update={"pixels": pixels, "silent": silent}
            )
    if not found:
        raise MetricError(
            f"no class that {segmenter} tells is there in {named([one.image for one in counts], 'image')}"
        )
    places = ", ".join(sorted({one.place for one in counts}))
    about = {"segmenter": segmenter, "learned_from": learned_from, "tested_on": places, "images": len(counts)}
    return PerceptionProfile.model_validate(about | {"silence": silence, "class": found})


def _withheld(total: Floats, silence: float) -> Mask:
    """Return the bytes of the least sure answers, shape (255,), of counts of all classes, shape (2, 256)."""
    answers = np.bincount(LEVELS, weights=total[:, :SILENT].sum(axis=0))
    return np.asarray(np.searchsorted(np.cumsum(answers), silence * answers.sum()) >= LEVELS)


def _silence(total: Floats, withheld: Mask) -> Silence:
    """Return the shares of the answers on one class that are withheld; `total` has shape (2, 256)."""
    is_seen = np.arange(SILENT) >= SEEN

    def share(label: int, said: Mask) -> float:
        answers = total[label, :SILENT] * said
        return float(answers[withheld].sum() / answers.sum()) if answers.any() else 1.0

    absent, present = 0, 1
    return Silence(
        found=share(present, is_seen),
        missed=share(present, ~is_seen),
        alarm=share(absent, is_seen),
        absent=share(absent, ~is_seen),
    )


def _of_class(name: str, classes: tuple[str, ...], total: Floats, shares: dict[str, Floats]) -> ClassConfusions:
    """Return the rates of one class; `total` has shape (2, 256), the shares have shape (C + 1, C)."""
    at = classes.index(name)
    recall, right = float(recall_where_known(total)), float(np.nan_to_num(precision(total)))
    called, also = (
        {other: share for other, share in zip(classes, shares[key][at].tolist(), strict=True) if share >= _LEAST_SHARE}
        for key in ("instead", "besides")
    )
    # A pixel may be called two classes at once; together they cannot be more than what is missed.
    most = (1 - recall) / max(sum(called.values()), 1e-12)
    return ClassConfusions(
        pixels=1,
        recall=recall,
        precision=right,
        of_ground=float(shares["instead"][-1, at]),
        called={other: share * min(1.0, most) for other, share in called.items()},
        also=also,
    )


def _shares(counts: Sequence[PixelCounts], key: str) -> Floats:
    """Return a kind of confusion over the pixels that are asked about, shape (C + 1, C); 0 where there is none."""
    part = np.sum([getattr(one, key) for one in counts], axis=0).astype(np.float64)
    asked = np.sum([one.asked for one in counts], axis=0)
    return np.asarray(np.divide(part, asked, out=np.zeros_like(part), where=asked > 0))
