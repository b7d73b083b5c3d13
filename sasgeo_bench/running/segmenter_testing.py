# SPDX-License-Identifier: Apache-2.0
"""The conformance kit of segmenters: the rules that each keeps, checked on tiny images under the limits of a run."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.errors import counted
from sasgeo_bench.files.folders import scratch_folder
from sasgeo_bench.files.plugins import SEGMENTERS
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.running.segmenter_process import SegmenterProcess, SegmenterReply
from sasgeo_bench.running.testing import Check, check_of, kept_check, listing_of, loaded_check, refusal_of, taught_check
from sasgeo_bench.running.worker import Limits, Reach
from sasgeo_bench.sensing.image import AerialImage, LabelledImage, write_labelled
from sasgeo_bench.sensing.segmentation import SILENT, Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images, with_picture

_QUICK_S: Final = 5.0
_Rule = Callable[[str, AerialImage], str | None]  # name and image -> a fault
_NO_IMAGE: Final = "no image to try it with"


def check_segmenter(
    spec: str,
    *,
    limits: Limits | None = None,
    images: Sequence[LabelledImage] | None = None,
    is_shut_in: bool = True,
) -> Iterator[Check]:
    """Try a segmenter, given by name or module:Class, on a few small images; yield a row for each rule.

    `images` are `tiny_images` by default; it learns from them, if it learns, and is asked about them. Without
    `is_shut_in`, trusted code runs without isolation.
    """
    labelled = tuple(tiny_images() if images is None else images)
    with ExitStack() as stack:
        folder = stack.enter_context(scratch_folder("check"))
        paths = write_labelled(folder, labelled)
        before = listing_of(folder)
        reach = Reach(readable=[folder], hidden=[], is_shut_in=is_shut_in)
        process = stack.enter_context(SegmenterProcess(spec=spec, reach=reach, limits=limits or Limits()))
        loaded = process.load()
        yield (first := loaded_check(spec, loaded, loaded.card, group=SEGMENTERS))
        if loaded.card is None or first.outcome == "fail":
            return
        kit = _Kit(process=process, card=loaded.card, images={f"image {at}": x.image for at, x in enumerate(labelled)})
        if loaded.learns:
            yield from kit.lessons(paths)
        yield from kit.checks()
        limited = process.isolation.get("files_changed", "")
        yield kept_check(kit.refused, before, listing_of(folder), limited)


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
class _Kit:
    process: SegmenterProcess
    card: SegmenterCard
    images: Mapping[str, AerialImage]
    refused: str = ""
    first: dict[str, SegmenterReply] = field(default_factory=dict)
    second: dict[str, SegmenterReply] = field(default_factory=dict)

    def lessons(self, paths: Sequence[Path]) -> Iterator[Check]:
        """Train twice, each time in a process of its own, and ask once without; keep the text for all that follows."""
        replies = []
        for _ in range(2):
            self.process.end()
            replies.append(self.process.learn(paths))
        self.process.end()
        for reply in replies:
            self.refused = self.refused or refusal_of(reply)
        yield taught_check(replies[0], replies[1], counted(len(paths), "image"))
        yield self._untaught()
        self.process.end()
        self.process.learned = replies[0].learned

    def _untaught(self) -> Check:
        """Check that it also answers untrained, unless its card excludes that."""
        name = "answers without training"
        if "training" in self.card.needs:
            return Check(name=name, outcome="not applicable", found="the card needs training")
        shown, image = next(iter(self.images.items()))
        fault = _fault(shown, self._ask(image))
        return check_of(name, fault and f"learned = None: {fault}", "1 image")

    def checks(self) -> Iterator[Check]:
        if "training" in self.card.needs and self.process.learned is None:
            found = "the card needs training, and there is no learned text"
            yield Check(name="answers an image", outcome="not applicable", found=found)
            return
        yield self._answers()
        sound = {name: image for name, image in self.images.items() if name in self.second}
        yield self._over("the same answer twice", sound, self._twice)
        yield self._over("the same classes everywhere", sound, self._classes)
        yield self._over("small and odd pictures", odd_images() if sound else {}, self._odd)
        yield self._order({name: image for name, image in sound.items() if self._twice(name, image) is None})
        yield self._cost()

    def _ask(self, image: AerialImage) -> SegmenterReply:
        reply = self.process.segment(image, classes=self.card.classes)
        self.refused = self.refused or refusal_of(reply)
        return reply

    def _over(self, name: str, images: Mapping[str, AerialImage], check: _Rule) -> Check:
        """Run a check over images; the first fault counts."""
        if not images:
            return Check(name=name, outcome="not applicable", found=_NO_IMAGE)
        fault = next(filter(None, (check(shown, image) for shown, image in images.items())), None)
        return check_of(name, fault, counted(len(images), "image"))

    def _answers(self) -> Check:
        """Ask about every image twice in a row, and keep the answers; report an unsound first answer once."""
        faults = []
        for name, image in self.images.items():
            self.first[name] = self._ask(image)
            fault = _fault(name, self.first[name])
            if fault is None:
                self.second[name] = self._ask(image)
            else:
                faults.append(fault)
        shown = f"{faults[0]} ({len(faults)} of {counted(len(self.images), 'image')})" if faults else None
        return check_of("shapes, known classes, and an unchanged picture", shown, self._told())

    def _told(self) -> str:
        told = [reply.segmentation for reply in self.first.values() if reply.segmentation is not None]
        if not told:
            return "no answer"
        silent = np.mean([(each.probability_bytes == SILENT).mean() for each in told])
        return f"{counted(len(told), 'image')}, {', '.join(told[0].classes)}; silent at {silent:.0%} of the pixels"

    def _twice(self, name: str, image: AerialImage) -> str | None:
        del image
        return _difference(name, self.first[name], self.second[name], "the second time")

    def _classes(self, name: str, image: AerialImage) -> str | None:
        del image
        return self._other_classes(name, self.first[name])

    def _other_classes(self, name: str, reply: SegmenterReply) -> str | None:
        """Return a fault if an answer tells other classes than that about the first image."""
        told = next(each.segmentation.classes for each in self.first.values() if each.segmentation is not None)
        found = () if reply.segmentation is None else reply.segmentation.classes
        return None if found == told else f"{name} tells {', '.join(found)}, the first one {', '.join(told)}"

    def _odd(self, name: str, image: AerialImage) -> str | None:
        reply = self._ask(image)
        return _fault(f"{name} ({image.shape[0]} x {image.shape[1]})", reply) or self._other_classes(name, reply)

    def _order(self, images: Mapping[str, AerialImage]) -> Check:
        """Check that an answer depends neither on earlier images nor on the start of the process."""
        self.process.end()
        again = {name: self._ask(images[name]) for name in reversed(list(images))}

        def other(name: str, image: AerialImage) -> str | None:
            del image
            return _difference(name, self.first[name], again[name], "after others, in a fresh process")

        return self._over("the same answers in any order", images, other)

    def _cost(self) -> Check:
        """Measure the second answers: the first ones may load libraries."""
        name = "time and memory"
        seconds = [reply.seconds for reply in self.second.values() if reply.seconds is not None]
        if not seconds:
            return Check(name=name, outcome="not applicable", found=_NO_IMAGE)
        each_s = sum(seconds) / len(seconds)
        found = f"{each_s:.3f} s an image, {self.process.peak_bytes / 1e6:.0f} MB at most"
        return check_of(name, None if each_s < _QUICK_S else f"{found}: more than {_QUICK_S:g} s", found)


def _fault(name: str, reply: SegmenterReply) -> str | None:
    return None if reply.segmentation is not None else f"{name}: {reply.status}: {reply.message}"


def _difference(name: str, first: SegmenterReply, other: SegmenterReply, when: str) -> str | None:
    """Return how another answer about an image differs from the first; None if it does not."""
    if other.segmentation is None:
        return f"{name} has none ({other.status}: {other.message}) {when}"
    return None if _is_same(first.segmentation, other.segmentation) else f"{name} has another answer {when}"


def _is_same(first: Segmentation | None, other: Segmentation) -> bool:
    return (
        first is not None
        and first.classes == other.classes
        and np.array_equal(first.probability_bytes, other.probability_bytes)
    )
