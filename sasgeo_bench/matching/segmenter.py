# SPDX-License-Identifier: Apache-2.0
"""Interface of segmenters: plugins that say, class by class and pixel by pixel, what is on an aerial image."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final, Literal, Protocol, get_args, runtime_checkable

from sasgeo_bench.core.errors import ImageError, MatchError
from sasgeo_bench.matching.matcher import FORBID_MORE, check_card, check_learned
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sensing.image import AerialImage, LabelledImage
from sasgeo_bench.sensing.segmentation import Segmentation

SegmenterNeed = Literal["training"]
SEGMENTER_NEEDS: Final[tuple[SegmenterNeed, ...]] = get_args(SegmenterNeed)
MOST_TEXT_BYTES: Final = 32 * 2**20  # of a learned text, as UTF-8: trees and small networks are longer than tables


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterCard:
    """Description of a segmenter, printed on the board with its row.

    Parameters
    ----------
    name, version, title, source, ours, licence : str
        As on the card of a matcher; the version is raised whenever answers change.
    classes : tuple of str
        Classes of the taxonomy that it can tell; empty for those that its training labels.
    needs : tuple of {"training"}
        "training" if it cannot answer before it has learned.
    limits : str
        Known limits.
    trained_on : tuple of str
        Places that its shipped parameters come from; a row that was trained on a test place is set apart.

    Raises
    ------
    MatchError
        If a field is empty, too long or not printable, or has an unknown value.
    """

    name: str
    version: str
    title: str
    source: str
    ours: str
    licence: str
    classes: tuple[str, ...] = ()
    needs: tuple[SegmenterNeed, ...] = ()
    limits: str = ""
    trained_on: tuple[str, ...] = ()

    __pydantic_config__ = FORBID_MORE

    def __post_init__(self) -> None:
        """Refuse a card without the facts that a reader of the board needs."""
        check_card(asdict(self), classes=load_taxonomy().names, needs=SEGMENTER_NEEDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageTraining:
    """Training data of a segmenter: labelled images of places that it is not asked about.

    Parameters
    ----------
    images : sequence of LabelledImage
        All label the same classes in the same order; what is not labelled is UNKNOWN. In a run each is read from
        disk when it is asked for: take them one after the other, and keep what is needed of each.

    Examples
    --------
    >>> from sasgeo_bench.sensing.tiny_images import tiny_images
    >>> ImageTraining(images=tiny_images()).classes
    ('road_minor', 'building', 'water', 'green')
    """

    images: Sequence[LabelledImage]

    def __post_init__(self) -> None:
        """Refuse a training without images."""
        if not len(self.images):
            raise ImageError("there is no image to learn from: name places that have labels")

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the classes that the images label."""
        return self.images[0].classes


@runtime_checkable
class Segmenter(Protocol):
    """A segmenter. It is made without arguments, in a process of its own, and sees neither map nor truth.

    An answer depends on the picture, its camera and the learned text alone: neither on the images before it nor on
    chance.
    """

    card: SegmenterCard

    def segment(self, image: AerialImage, *, learned: str | None) -> Segmentation:
        """Return the probability of each class at every pixel of an image; silent where it cannot tell.

        `learned` is the text of `learn`, None without one. Every call of a process gets the same text: parse it once.
        """
        ...


@runtime_checkable
class LearningSegmenter(Segmenter, Protocol):
    """A segmenter that learns, once for each set of training places and in a process of its own.

    The same images give the same text. After a failed training, or without any, `segment` gets None: a segmenter that
    then cannot answer needs "training" on its card.
    """

    def learn(self, training: ImageTraining) -> str:
        """Return the result as JSON or any other text of at most `MOST_TEXT_BYTES`."""
        ...


def check_text(learned: object) -> str:
    """Return the learned text of a segmenter, if it is one that can be stored; raise `MatchError` otherwise."""
    return check_learned(learned, most_bytes=MOST_TEXT_BYTES)


def check_segmentation(found: object, image: AerialImage, *, classes: Sequence[str] = ()) -> Segmentation:
    """Return the result of `segment`, if it is one of the image.

    Parameters
    ----------
    found : object
        What `segment` returned.
    image : AerialImage
        The image that it was asked about.
    classes : sequence of str
        Those of the card; with none, any class of the taxonomy may be reported.

    Raises
    ------
    MatchError
        If it is no `Segmentation`, has not the rows and columns of the picture, or tells a class that it must not.

    Examples
    --------
    >>> from sasgeo_bench.sensing.tiny_images import tiny_images
    >>> check_segmentation("roofs everywhere", tiny_images()[0].image)
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: segment() returned str, expected sasgeo_bench.sensing.segmentation.Segmentation
    """
    if not isinstance(found, Segmentation):
        raise MatchError(
            f"segment() returned {type(found).__name__}, expected sasgeo_bench.sensing.segmentation.Segmentation"
        )
    if found.shape != image.shape:
        raise MatchError(f"segment() returned a segmentation of shape {found.shape}, the picture has {image.shape}")
    known = tuple(classes) or load_taxonomy().names
    wrong = next((name for name in found.classes if name not in known), None)
    if wrong is not None:
        whose = "the card names" if classes else "the taxonomy has"
        raise MatchError(f"segment() returned the class {wrong[:60]!r}, {whose} {', '.join(known)}")
    return found
