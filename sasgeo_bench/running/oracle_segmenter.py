# SPDX-License-Identifier: Apache-2.0
"""The control that is given the labels, an upper bound for all segmenters; no plugin can be one."""

import time
from typing import Final

import numpy as np

from sasgeo_bench.errors import MatchError
from sasgeo_bench.files.plugins import ORACLE_SEGMENTER
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.running.segmenter_process import SegmenterReply
from sasgeo_bench.sensing.image import AerialImage, LabelledImage
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation

CARD: Final = SegmenterCard(
    name=ORACLE_SEGMENTER,
    version="1",
    title="Control: the labels themselves",
    source="original",
    ours="all of it",
    licence="Apache-2.0",
    limits="is no method: it reads the labels, so that whatever does not score it as perfect is at fault",
)
ISOLATION: Final = {"truth": "given, as this control needs it"}

_BYTES: Final = np.zeros(3, dtype=np.uint8)  # of a label: absent is 0
_BYTES[PRESENT], _BYTES[UNKNOWN] = CERTAIN, SILENT


def right_segmentation(labelled: LabelledImage) -> Segmentation:
    """Return the labels of an image as a segmentation: certain, and silent where nobody has looked.

    >>> from sasgeo_bench.sensing.tiny_images import tiny_images
    >>> first = tiny_images()[0]
    >>> np.unique(right_segmentation(first).probability_bytes).tolist(), np.unique(first.labels).tolist()
    ([0, 254, 255], [0, 1, 2])
    """
    return Segmentation(classes=labelled.classes, probability_bytes=_BYTES[labelled.labels])


def oracle_reply(image: AerialImage | LabelledImage) -> SegmenterReply:
    """Return the reply of the control; raise `MatchError` if an image has no labels."""
    if not isinstance(image, LabelledImage):
        raise MatchError(f"{ORACLE_SEGMENTER} answers with labels, and this image has none: name images with labels")
    start = time.perf_counter()
    found = right_segmentation(image)
    seconds = time.perf_counter() - start
    return SegmenterReply(status="ok", seconds=seconds, own_s=seconds, segmentation=found)
