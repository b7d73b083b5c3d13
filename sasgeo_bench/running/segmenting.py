# SPDX-License-Identifier: Apache-2.0
"""Train a segmenter and ask it about images, in processes of its own; a failure costs one image and is recorded."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from sasgeo_bench.errors import MatchError
from sasgeo_bench.files.folders import scratch_folder
from sasgeo_bench.files.plugins import ORACLE_SEGMENTER, SEGMENTERS, check_card_name
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.running.answers import Patience
from sasgeo_bench.running.failures import LOG, guard, our_failure
from sasgeo_bench.running.oracle import ISOLATION, SEGMENTER_CARD, oracle_reply
from sasgeo_bench.running.plan import TrainingResult, hidden_below, segmenter_code
from sasgeo_bench.running.segmenter_process import SegmenterProcess, SegmenterReply
from sasgeo_bench.running.training import failed_training
from sasgeo_bench.running.worker import Limits, Reach
from sasgeo_bench.sensing.image import AerialImage, LabelledFiles, LabelledImage, write_labelled


@dataclass(frozen=True, kw_only=True)
class SegmentRequest:
    """A segmenter to ask, by its name or module:Class, and its limits.

    All output below `out` is hidden from it: maps, tasks, truths, runs; and `hidden`, files or folders of one's own.
    `limits.match_s` holds for one image, `limits.learn_s` for all training. Without `is_shut_in`, trusted code runs
    without isolation.
    """

    spec: str
    out: Path
    limits: Limits = field(default_factory=Limits)
    hidden: Sequence[Path] = ()
    is_shut_in: bool = True

    def reach(self, readable: Sequence[Path] = ()) -> Reach:
        """Return what the segmenter may read: some folders, and nothing else of ours."""
        root = self.out.resolve()
        hidden = [root / "regions", *hidden_below([root]), *self.hidden]
        shown = [path.resolve() for path in readable]
        return Reach(
            readable=shown,
            hidden=[part for path in hidden for part in _without(path, shown)],
            is_shut_in=self.is_shut_in,
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
    with SegmenterProcess(spec=request.spec, reach=request.reach(), limits=request.limits) as process:
        reply = process.load()
    if reply.status != "ok" or reply.card is None:
        cause = reply.message or "the plugin has no card"
        raise MatchError(cause if request.spec in cause else f"{request.spec}: cannot be made ({cause})")
    check_card_name(request.spec, reply.card.name, group=SEGMENTERS)
    return LoadedSegmenter(card=reply.card, code=segmenter_code(request.spec), learns=reply.learns)


def train_segmenter(request: SegmentRequest, images: Iterable[LabelledImage]) -> TrainingResult:
    """Train a segmenter on labelled images, in a process of its own that can read them and nothing else of ours.

    `LabelledFiles` are read where they lie, others are written to a temporary folder first. A failure is a result
    without a text, and with its cause in a line. Raise `ImageError` if the images do not label the same classes,
    `StoreError` if they cannot be written.
    """
    with _paths_of(images) as paths:
        reach = request.reach(tuple(dict.fromkeys(path.parent for path in paths)))
        with SegmenterProcess(spec=request.spec, reach=reach, limits=request.limits) as process:
            reply = guard(partial(process.learn, paths), partial(_failed_by_us, request))
    if reply.status != "ok" or reply.learned is None:
        return failed_training(reply)
    return TrainingResult(text=reply.learned)


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
            spec=request.spec, reach=request.reach(), limits=request.limits, learned=learned
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
        reply = guard(ask, partial(_failed_by_us, self._request))
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


def _failed_by_us(request: SegmentRequest, error: Exception) -> SegmenterReply:
    return SegmenterReply(status="crash", message=our_failure(request.out / LOG, request.spec, error))
