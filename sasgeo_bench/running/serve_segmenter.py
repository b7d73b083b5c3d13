# SPDX-License-Identifier: Apache-2.0
"""Serve a runner for a segmenter, inside the sandbox: load, learn, segment."""

import socket
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from sasgeo_bench.errors import MatchError
from sasgeo_bench.matching.plugins import load_segmenter
from sasgeo_bench.matching.segmenter import (
    ImageTraining,
    LearningSegmenter,
    Segmenter,
    check_segmentation,
    check_text,
)
from sasgeo_bench.running.serve import Answer, PluginServer, package_of
from sasgeo_bench.sensing.image import LabelledFiles, image_from


class SegmenterServer(PluginServer):
    """Answers for a segmenter; `luggage` is the learned text, the same for all images of a process."""

    def __init__(self, channel: socket.socket, *, spec: str, luggage: bytes | None = None) -> None:
        super().__init__(channel, spec=spec)
        self.learned = None if luggage is None else luggage.decode()
        self._loaded: Segmenter | None = None

    def _package(self) -> str:
        return package_of(self._loaded)

    @property
    def segmenter(self) -> Segmenter:
        """Return the plugin, loaded at the first question."""
        if self._loaded is None:
            self._loaded = load_segmenter(self.spec)
        return self._loaded

    def _answers(self) -> Mapping[str, Callable[..., Answer]]:
        return {"load": self._load, "learn": self._learn, "segment": self._segment}

    def _load(self, _: bytes) -> Answer:
        segmenter = self.segmenter
        return {"card": asdict(segmenter.card), "learns": isinstance(segmenter, LearningSegmenter)}, b""

    def _learn(self, _: bytes, *, images: Sequence[str]) -> Answer:
        if not isinstance(self.segmenter, LearningSegmenter):
            raise MatchError(f"{self.segmenter.card.name} has no learn()")
        training = ImageTraining(images=LabelledFiles([Path(path) for path in images]))
        start = time.perf_counter()
        learned = check_text(self.segmenter.learn(training))
        return {"seconds": time.perf_counter() - start}, learned.encode()

    def _segment(self, blob: bytes) -> Answer:
        image, segmenter = image_from(blob), self.segmenter
        before = zlib.crc32(image.rgb.tobytes())
        start, start_cpu = time.perf_counter(), time.process_time()
        found = segmenter.segment(image, learned=self.learned)
        seconds, cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
        checked = check_segmentation(found, image, classes=segmenter.card.classes)
        if zlib.crc32(image.rgb.tobytes()) != before:
            raise MatchError("segment() changed the picture that it was given: copy it first")
        return {"seconds": seconds, "cpu_s": cpu_s}, checked.to_bytes()
