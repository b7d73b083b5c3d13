# SPDX-License-Identifier: Apache-2.0
"""The conformance kit of segmenters: the rules that each keeps, checked on tiny images under the limits of a run."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

import numpy as np

from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import SEGMENTERS
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.running.segmenter_process import SegmenterProcess, SegmenterReply
from sasgeo_bench.running.testing import Check, Kit
from sasgeo_bench.running.worker import Limits, Reach
from sasgeo_bench.sensing.image import AerialImage, LabelledImage, write_labelled
from sasgeo_bench.sensing.segmentation import SILENT, Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images, with_picture

_LEAST_CROPPED_PX: Final = 64  # a side of a picture whose crop still shows something
_MOST_CROP_DIFFERENCE: Final = 0.1  # of mean probabilities: normalization by the picture moves them by 0.03 at most


def check_segmenter(
    spec: str,
    *,
    limits: Limits | None = None,
    images: Sequence[LabelledImage] | None = None,
    is_sandboxed: bool = True,
) -> Iterator[Check]:
    """Try a segmenter, given by name or module:Class, on a few small images; yield a row for each rule.

    `images` are `tiny_images` by default; it learns from them, if it learns, and is asked about them. Without
    `is_sandboxed`, trusted code runs without isolation.
    """
    labelled = tuple(tiny_images() if images is None else images)
    with ExitStack() as stack:
        folder = stack.enter_context(scratch_folder("check"))
        paths = write_labelled(folder, labelled)
        reach = Reach(readable=[folder], hidden=[], is_sandboxed=is_sandboxed)
        process = stack.enter_context(SegmenterProcess(spec=spec, reach=reach, limits=limits or Limits()))
        asked = {f"image {at}": one.image for at, one in enumerate(labelled)}
        yield from _SegmenterKit(process=process, folder=folder, segmenter=process, images=asked, paths=paths).table()


def odd_images() -> dict[str, AerialImage]:
    """Return pictures that a segmenter must bear: of a pixel, narrow, of uneven sides, of one colour, of noise.

    >>> sorted(image.shape for image in odd_images().values())
    [(1, 1), (1, 40), (17, 33), (32, 32), (40, 1), (64, 64), (64, 64)]
    """
    rng = np.random.default_rng(2)  # seed of the odd pictures
    shapes = {"one pixel": (1, 1), "one row": (1, 40), "one column": (40, 1), "uneven sides": (17, 33)}
    noise = {name: rng.integers(0, 256, (*shape, 3), dtype=np.uint8) for name, shape in shapes.items()}
    plain = {name: np.full((64, 64, 3), value, dtype=np.uint8) for name, value in (("black", 0), ("white", 255))}
    grey = np.repeat(rng.integers(0, 256, (32, 32, 1), dtype=np.uint8), 3, axis=2)
    return {name: with_picture(rgb) for name, rgb in (noise | plain | {"grey": grey}).items()}


@dataclass(kw_only=True)
class _SegmenterKit(Kit[SegmenterCard, Segmentation, AerialImage]):
    one: ClassVar[str] = "an image"
    many: ClassVar[str] = "images"
    group: ClassVar[str] = SEGMENTERS
    first_rule: ClassVar[str] = "shapes, known classes, and an unchanged picture"

    segmenter: SegmenterProcess
    images: dict[str, AerialImage]
    paths: Sequence[Path]

    def checks(self) -> Iterator[Check]:
        if self.learns:
            few = dict(list(self.images.items())[:1])
            yield from self.lessons(lambda: self.segmenter.learn(self.paths), few, self.count(len(self.paths)))
            self.segmenter.luggage = self.learned or ""
        if "training" in self.card.needs and self.learned is None:
            found = "the card needs training, and there is no learned text"
            yield Check(name="answers an image", outcome="not applicable", found=found)
            return
        yield self.answers(self.images, summary=self._summary)
        sound = self.sound(self.images)
        yield self.over("the same answer twice", sound, self.twice)
        yield self.over("the same classes everywhere", sound, lambda label, _: self._classes(label, self.first[label]))
        yield self.over("small and odd pictures", odd_images() if sound else {}, self._odd)
        wide = {label: image for label, image in sound.items() if min(image.shape) >= _LEAST_CROPPED_PX}
        yield self.over("a crop gives what the whole gives", wide, self._cropped)
        yield self.order(sound)
        yield self.cost()

    def ask(self, item: AerialImage) -> SegmenterReply:
        return self.noted(self.segmenter.segment(item, classes=self.card.classes))

    def fault(self, label: str, item: AerialImage, reply: SegmenterReply) -> str | None:
        del item
        return None if reply.found is not None else f"{label}: {reply.status}: {reply.message}"

    def is_same(self, first: Segmentation | None, other: Segmentation) -> bool:
        return (
            first is not None
            and first.classes == other.classes
            and np.array_equal(first.probability_bytes, other.probability_bytes)
        )

    def _summary(self) -> str:
        found = [reply.found for reply in self.first.values() if reply.found is not None]
        if not found:
            return "no answer"
        silent = np.mean([(each.probability_bytes == SILENT).mean() for each in found])
        return f"{self.count(len(found))}, {', '.join(found[0].classes)}; silent at {silent:.0%} of the pixels"

    def _classes(self, label: str, reply: SegmenterReply) -> str | None:
        """Return a fault if an answer tells other classes than that about the first image."""
        first = next(each.found.classes for each in self.first.values() if each.found is not None)
        found = () if reply.found is None else reply.found.classes
        return None if found == first else f"{label} tells {', '.join(found)}, the first one {', '.join(first)}"

    def _odd(self, label: str, image: AerialImage) -> str | None:
        reply = self.ask(image)
        shown = f"{label} ({image.shape[0]} x {image.shape[1]})"
        return self.fault(shown, image, reply) or self._classes(label, reply)

    def _cropped(self, label: str, image: AerialImage) -> str | None:
        """Return a fault if the upper left of a picture, without the rest, has other probabilities there."""
        rows, cols = (side * 3 // 4 for side in image.shape)
        reply = self.ask(image.cropped(0, 0, rows, cols))
        shown = f"a crop of {label} ({rows} x {cols})"
        whole, crop = self.first[label].found, reply.found
        if whole is None or crop is None:
            return self.fault(shown, image, reply)
        fault = self._classes(label, reply)
        if fault is not None:
            return fault
        inner = np.s_[:, : rows * 2 // 3, : cols * 2 // 3]  # what lies near the new edges may differ
        differs = np.abs(whole.probabilities()[inner] - crop.probabilities()[inner])
        by_class = [float(np.mean(plane[np.isfinite(plane)])) for plane in differs if np.isfinite(plane).any()]
        if not by_class or max(by_class) <= _MOST_CROP_DIFFERENCE:
            return None
        return f"{shown} has probabilities that differ by {max(by_class):.2f} on average from those of the whole"
