# SPDX-License-Identifier: Apache-2.0
"""The process of a segmenter, which is asked about one image after the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pydantic import TypeAdapter

from sasgeo_bench.core.errors import ImageError, MatchError
from sasgeo_bench.matching.segmenter import MOST_TEXT_BYTES, SegmenterCard, check_segmentation
from sasgeo_bench.running import wire
from sasgeo_bench.running.worker import PluginProcess, PluginReply
from sasgeo_bench.sensing.image import AerialImage, image_bytes
from sasgeo_bench.sensing.segmentation import MOST_CLASSES, Segmentation

SegmenterReply = PluginReply[SegmenterCard, Segmentation]


@dataclass(kw_only=True)
class SegmenterProcess(PluginProcess[SegmenterCard, Segmentation]):
    """The process of a segmenter; `luggage` is the text that it gets with each image, empty without training."""

    door: ClassVar[str] = "segmenter"
    most_learned_bytes: ClassVar[int] = MOST_TEXT_BYTES
    card: ClassVar[TypeAdapter[SegmenterCard]] = TypeAdapter(SegmenterCard)

    _asked: tuple[AerialImage, tuple[str, ...]] | None = None

    def learn(self, images: Sequence[Path]) -> SegmenterReply:
        """Train on the labelled images of some files, which the process must be able to read."""
        return self._learn(images=[str(path.resolve()) for path in images])

    def segment(self, image: AerialImage, *, classes: Sequence[str] = ()) -> SegmenterReply:
        """Ask about one image; `classes` are those of the card, against which the answer is checked once more."""
        self._asked = (image, tuple(classes))
        rows, cols = image.shape
        # 1.01: growth of bytes that do not become fewer by compression
        most_bytes = int(MOST_CLASSES * rows * cols * 1.01) + wire.MOST_BYTES
        return self._ask("segment", image_bytes(image), timeout_s=self.limits.match_s, most_bytes=most_bytes)

    def _found(self, data: bytes) -> Segmentation:
        """Return the segmentation that the bytes are, of the image that was asked about."""
        if self._asked is None:
            raise MatchError("unexpected message: no image was requested")
        image, classes = self._asked
        try:
            segmentation = Segmentation.from_bytes(data, shape=image.shape)
        except ImageError as error:
            raise MatchError(str(error)) from error
        return check_segmentation(segmentation, image, classes=classes)
