# SPDX-License-Identifier: Apache-2.0
"""Serve a runner for a segmenter, inside the sandbox: load, learn, segment."""

import socket
import time
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sasgeo_bench.errors import MatchError
from sasgeo_bench.matching.plugins import load_segmenter
from sasgeo_bench.matching.segmenter import (
    ImageTraining,
    LearningSegmenter,
    Segmenter,
    check_segmentation,
    check_text,
)
from sasgeo_bench.running.serve import PluginServer, package_of
from sasgeo_bench.sensing.image_bytes import LabelledFiles, image_from


class SegmenterServer(PluginServer):
    """Answers for a segmenter; `luggage` is the learned text, the same for all images of a process."""

    def __init__(self, channel: socket.socket, *, spec: str, luggage: bytes | None = None) -> None:
        super().__init__(channel, spec=spec)
        self.learned = None if luggage is None else luggage.decode()
        self.segmenter: Segmenter | None = None

    def _package(self) -> str:
        return package_of(self.segmenter)

    def _answer(self, message: dict[str, Any], blob: bytes) -> tuple[dict[str, Any], bytes]:
        if self.segmenter is None:
            self.segmenter = load_segmenter(self.spec)
        if message["kind"] == "load":
            card, learns = asdict(self.segmenter.card), isinstance(self.segmenter, LearningSegmenter)
            return {"status": "ok", "card": card, "learns": learns}, b""
        if message["kind"] == "learn":
            return _learn(self.segmenter, message)
        return _segment(self.segmenter, blob, self.learned)


def _learn(segmenter: Segmenter, message: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    if not isinstance(segmenter, LearningSegmenter):
        fault = f"{segmenter.card.name} has no learn()"
        raise MatchError(fault)
    training = ImageTraining(images=LabelledFiles([Path(path) for path in message["images"]]))
    start = time.perf_counter()
    learned = check_text(segmenter.learn(training))
    return {"status": "ok", "seconds": time.perf_counter() - start}, learned.encode()


def _segment(segmenter: Segmenter, blob: bytes, learned: str | None) -> tuple[dict[str, Any], bytes]:
    image = image_from(blob)
    before = zlib.crc32(image.rgb.tobytes())
    start, start_cpu = time.perf_counter(), time.process_time()
    found = segmenter.segment(image, learned=learned)
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - start_cpu
    checked = check_segmentation(found, image, classes=segmenter.card.classes)
    if zlib.crc32(image.rgb.tobytes()) != before:
        fault = "segment() changed the picture that it was given: copy it first"
        raise MatchError(fault)
    return {"status": "ok", "seconds": seconds, "cpu_s": cpu_s}, checked.to_bytes()
