# SPDX-License-Identifier: Apache-2.0
"""Train a segmenter and ask it about images, in processes of its own; a failure costs one image and is recorded."""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import ORACLE_SEGMENTER, SEGMENTERS
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.running.answers import Patience
from sasgeo_bench.running.oracle import ISOLATION
from sasgeo_bench.running.plugin_code import segmenter_code
from sasgeo_bench.running.segmenter_process import SegmenterProcess, SegmenterReply
from sasgeo_bench.running.training import failed_training
from sasgeo_bench.running.worker import Limits, Reach, guarded, hidden_below, loaded_card
from sasgeo_bench.sensing.image import AerialImage, LabelledFiles, LabelledImage, write_labelled
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation

SEGMENTER_CARD: Final = SegmenterCard(
    name=ORACLE_SEGMENTER,
    version="1",
    title="Control: the labels themselves",
    source="original",
    ours="all of it",
    licence="Apache-2.0",
    limits="is no method: it reads the labels, so that whatever does not score it as perfect is at fault",
)

_BYTES: Final = np.zeros(3, dtype=np.uint8)  # of a label: absent is 0
_BYTES[PRESENT], _BYTES[UNKNOWN] = CERTAIN, SILENT


def right_segmentation(labelled: LabelledImage) -> Segmentation:
    """Return the labels of an image as a segmentation: certain, and silent where nothing is labelled.

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
    return SegmenterReply(status="ok", seconds=seconds, own_s=seconds, found=found)


@dataclass(frozen=True, kw_only=True)
class SegmentRequest:
    """A segmenter to ask, by its name or module:Class, and its limits.

    All output below `out` is hidden from it: maps, tasks, truths, runs; and `hidden`, files or folders of one's own.
    `limits.match_s` holds for one image, `limits.learn_s` for all training. Without `is_sandboxed`, trusted code runs
    without isolation.
    """

    spec: str
    out: Path
    limits: Limits = field(default_factory=Limits)
    hidden: Sequence[Path] = ()
    is_sandboxed: bool = True

    def reach(self, readable: Sequence[Path] = ()) -> Reach:
        """Return what the segmenter may read: some folders, and nothing else of ours."""
        root = self.out.resolve()
        hidden = [root / "regions", *hidden_below([root]), *self.hidden]
        shown = [path.resolve() for path in readable]
        return Reach(
            readable=shown,
            hidden=[part for path in hidden for part in _without(path, shown)],
            is_sandboxed=self.is_sandboxed,
        )


def _without(hidden: Path, shown: Sequence[Path]) -> list[Path]:
    """Return what is left of a hidden folder if some folders are shown: all that lies beside the way to them."""
    if hidden in shown:
        return []
    if not any(folder.is_relative_to(hidden) for folder in shown):
        return [hidden]
    return [part for child in sorted(hidden.iterdir()) for part in _without(child, shown)]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedSegmenter:
    """Card of a segmenter and whether it learns, as its own process reports them, and the hash of its code."""

    card: SegmenterCard
    code: str
    learns: bool


def load_card(request: SegmentRequest) -> LoadedSegmenter:
    """Load a segmenter in a process of its own; raise `MatchError` if that fails, or its name is not its own."""
    if request.spec == ORACLE_SEGMENTER:
        return LoadedSegmenter(card=SEGMENTER_CARD, code="", learns=False)
    process = SegmenterProcess(spec=request.spec, reach=request.reach(), limits=request.limits)
    card, learns = loaded_card(process, group=SEGMENTERS)
    return LoadedSegmenter(card=card, code=segmenter_code(request.spec), learns=learns)


def train_segmenter(request: SegmentRequest, images: Iterable[LabelledImage]) -> SegmenterReply:
    """Train a segmenter on labelled images, in a process of its own that can read them and nothing else of ours.

    `LabelledFiles` are read where they lie, others are written to a temporary folder first. A failure is a reply
    without a text, and with its cause in a line. Raise `ImageError` if the images do not label the same classes,
    `StoreError` if they cannot be written.
    """
    with _paths_of(images) as paths:
        reach = request.reach(tuple(dict.fromkeys(path.parent for path in paths)))
        with SegmenterProcess(spec=request.spec, reach=reach, limits=request.limits) as process:
            reply = guarded(partial(process.learn, paths), request.out, request.spec)
    return reply if reply.learned is not None else failed_training(reply)


@contextmanager
def _paths_of(images: Iterable[LabelledImage]) -> Iterator[tuple[Path, ...]]:
    if isinstance(images, LabelledFiles):
        yield images.paths
        return
    with scratch_folder("images") as folder:
        yield write_labelled(folder, images)


class SegmenterRun:
    """A segmenter at work on one image after the other; use it in a `with` block, at whose end nothing of it is left.

    `learned` is the text of its training, None without one. Of a `LabelledImage` a plugin is sent the image alone; the
    control `oracle_segmenter` answers with the labels, in this process.
    """

    def __init__(self, request: SegmentRequest, loaded: LoadedSegmenter, *, learned: str | None = None) -> None:
        self._request, self._loaded, self._learned = request, loaded, learned
        self._patience = Patience("images")
        self._process = SegmenterProcess(
            spec=request.spec, reach=request.reach(), limits=request.limits, luggage=learned or ""
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.end()

    def segment(self, image: AerialImage | LabelledImage) -> SegmenterReply:
        """Ask about an image; a crash, a late or an unsound answer is a status with its cause, and costs no other one.

        After ten late answers in a row the segmenter is not asked any more. Raise `StoreError` if no process can be
        started for want of space, `MatchError` if the control has no labels.
        """
        if self._request.spec == ORACLE_SEGMENTER:
            return oracle_reply(image)
        card = self._loaded.card
        if "training" in card.needs and self._learned is None:
            return SegmenterReply(status="not applicable", message="no training")
        picture = image.image if isinstance(image, LabelledImage) else image
        if self._patience.given_up is not None:
            return SegmenterReply(status="timeout", message=self._patience.given_up)
        ask = partial(self._process.segment, picture, classes=card.classes)
        reply = guarded(ask, self._request.out, self._request.spec)
        self._patience.note(reply.status, reply.message)
        return reply

    @property
    def isolation(self) -> dict[str, str]:
        """Return how the processes so far were isolated, as in `run.json`."""
        return dict(ISOLATION if self._request.spec == ORACLE_SEGMENTER else self._process.isolation)

    @property
    def peak_bytes(self) -> int:
        """Return the most memory that a process of the segmenter held."""
        return self._process.peak_bytes
