# SPDX-License-Identifier: Apache-2.0
"""The process of a segmenter: what it is asked, and what it may answer."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field

from sasgeo_bench.errors import ImageError, MatchError
from sasgeo_bench.matching.matcher import Status
from sasgeo_bench.matching.segmenter import (
    MOST_TEXT_BYTES,
    SegmenterCard,
    SegmenterNeed,
    check_segmentation,
    check_text,
)
from sasgeo_bench.running import wire
from sasgeo_bench.running.worker import (
    Failed,
    Line,
    PluginProcess,
    PluginReply,
    Seconds,
    SentCard,
    Strictly,
    read_answer,
)
from sasgeo_bench.sensing.image import AerialImage, image_bytes
from sasgeo_bench.sensing.segmentation import MOST_CLASSES, Segmentation


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterReply(PluginReply):
    """Reply of a segmenter: loading returns its `card`; an image, its `segmentation`."""

    card: SegmenterCard | None = None
    segmentation: Segmentation | None = None


class _Card(SentCard):
    classes: Annotated[list[Line], Field(max_length=MOST_CLASSES)]
    needs: list[SegmenterNeed]


class _Loaded(Strictly):
    status: Literal["ok"]
    card: _Card
    learns: bool

    def reply(self, data: bytes) -> SegmenterReply:
        del data
        return SegmenterReply(status="ok", card=SegmenterCard(**self.card.fields()), learns=self.learns)


class _Trained(Strictly):
    status: Literal["ok"]
    seconds: Seconds

    def reply(self, data: bytes) -> SegmenterReply:
        """Return the reply for the runner, with the text that the bytes are."""
        try:
            text = data.decode()
        except UnicodeDecodeError as error:
            raise MatchError("the learned text is no UTF-8") from error
        return SegmenterReply(status="ok", own_s=self.seconds, learned=check_text(text))


class _Segmented(Strictly):
    status: Literal["ok"]
    seconds: Seconds
    cpu_s: Annotated[float, Field(ge=0)]


_KINDS: Final[dict[str, type[_Loaded | _Trained | _Segmented]]] = {
    "load": _Loaded,
    "learn": _Trained,
    "segment": _Segmented,
}


@dataclass(kw_only=True)
class SegmenterProcess(PluginProcess[SegmenterReply]):
    """The process of a segmenter; `learned` is the text that it gets with each image, None without training."""

    door: ClassVar[str] = "segmenter"

    learned: str | None = None
    _asked: tuple[AerialImage, tuple[str, ...]] | None = None

    def learn(self, images: Sequence[Path]) -> SegmenterReply:
        """Train on the labelled images of some files, which the process must be able to read."""
        files = [str(path.resolve()) for path in images]
        most_bytes = MOST_TEXT_BYTES + wire.MOST_BYTES
        return self._ask("learn", timeout_s=self.limits.learn_s, most_bytes=most_bytes, images=files)

    def segment(self, image: AerialImage, *, classes: Sequence[str] = ()) -> SegmenterReply:
        """Ask about one image; `classes` are those of the card, against which the answer is checked once more."""
        self._asked = (image, tuple(classes))
        rows, cols = image.shape
        # 1.01: growth of bytes that do not become fewer by compression
        most_bytes = int(MOST_CLASSES * rows * cols * 1.01) + wire.MOST_BYTES
        return self._ask("segment", image_bytes(image), timeout_s=self.limits.match_s, most_bytes=most_bytes)

    def _luggage(self) -> bytes | None:
        return None if self.learned is None else self.learned.encode()

    def _failure(self, status: Status, message: str) -> SegmenterReply:
        return SegmenterReply(status=status, message=message)

    def _read(self, kind: str, answer: wire.Message, data: bytes, *, nonce: str) -> SegmenterReply:
        found = read_answer(_KINDS[kind], answer, nonce=nonce)
        if isinstance(found, Failed):
            return self._failure(found.status, found.message)
        return self._segmented(found, data) if isinstance(found, _Segmented) else found.reply(data)

    def _segmented(self, found: _Segmented, data: bytes) -> SegmenterReply:
        """Return the reply with the segmentation that the bytes are, of the image that was asked about."""
        if self._asked is None:
            raise MatchError("nobody asked about an image")
        image, classes = self._asked
        try:
            segmentation = Segmentation.from_bytes(data, shape=image.shape)
        except ImageError as error:
            raise MatchError(str(error)) from error
        checked = check_segmentation(segmentation, image, classes=classes)
        return SegmenterReply(status="ok", own_s=found.seconds, cpu_s=found.cpu_s, segmentation=checked)
