# SPDX-License-Identifier: Apache-2.0
"""Serve a runner for a segmenter, inside the sandbox: load, learn, segment."""

import zlib
from collections.abc import Sequence
from pathlib import Path

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.matching.plugins import load_segmenter
from sasgeo_bench.matching.segmenter import (
    MOST_TEXT_BYTES,
    ImageTraining,
    Segmenter,
    check_segmentation,
)
from sasgeo_bench.running.server import Answer, Clock, PluginServer
from sasgeo_bench.sensing.image import LabelledFiles, image_from


class Server(PluginServer[Segmenter]):
    """Answers for a segmenter; `luggage` is the learned text, the same for all images of a process."""

    most_learned_bytes = MOST_TEXT_BYTES

    def _make(self) -> Segmenter:
        return load_segmenter(self.spec)

    def _learn(self, _: bytes, *, images: Sequence[str]) -> Answer:
        return self._learned(ImageTraining(images=LabelledFiles([Path(path) for path in images])))

    def _segment(self, blob: bytes) -> Answer:
        image, segmenter = image_from(blob), self.plugin
        before = zlib.crc32(image.rgb.tobytes())
        with (used := Clock()):
            found = segmenter.segment(image, learned=self.luggage or None)
        checked = check_segmentation(found, image, classes=segmenter.card.classes)
        if zlib.crc32(image.rgb.tobytes()) != before:
            raise MatchError("segment() changed the picture that it was given: copy it first")
        return used.times(), checked.to_bytes()
