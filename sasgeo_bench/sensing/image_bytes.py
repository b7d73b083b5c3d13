# SPDX-License-Identifier: Apache-2.0
"""Aerial images, with labels or without, as bytes and as files: what a segmenter's process is sent and learns from."""

import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, overload

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ImageError, StoreError
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.files.paths import plain_file
from sasgeo_bench.regions.evidence import CELLS_PER_BYTE, pack, unpack
from sasgeo_bench.sensing.camera import Camera
from sasgeo_bench.sensing.image import MOST_PIXELS, AerialImage, LabelledImage
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.sensing.packing import LABELLED, QUICK, STORED, pack_parts, split_parts, unpack_body

SUFFIX: Final = LABELLED  # of a file that holds one labelled image

_IMAGE: Final = b"SGIMG\x01"
_LABELLED: Final = b"SGLAB\x01"
_BANDS: Final = 3
_MOST_CLASSES: Final = 64


def image_bytes(image: AerialImage) -> bytes:
    """Return an image as bytes that `image_from` reads; pixels are kept as they are, without compression."""
    return pack_parts(_IMAGE, _head(image), image.rgb.tobytes(), level=STORED)


def image_from(data: bytes) -> AerialImage:
    """Return the image of `image_bytes`; raise `ImageError` if the bytes are not one, or damaged."""
    head, rest = split_parts(_IMAGE, data, "an aerial image")
    camera = _camera(head)
    pixels = unpack_body(rest, _pixels(camera) * _BANDS, "an aerial image")
    return _image(head, camera, np.frombuffer(pixels, dtype=np.uint8))


def labelled_bytes(labelled: LabelledImage) -> bytes:
    """Return a labelled image as compressed bytes that `labelled_from` reads, without any loss.

    >>> from sasgeo_bench.sensing.tiny_images import tiny_images
    >>> first = tiny_images()[0]
    >>> again = labelled_from(labelled_bytes(first))
    >>> again.place, (again.labels == first.labels).all(), (again.image.rgb == first.image.rgb).all()
    ('drawn-east', np.True_, np.True_)
    """
    head = _head(labelled.image) | {"classes": labelled.classes, "place": labelled.place}
    return pack_parts(_LABELLED, head, labelled.image.rgb.tobytes() + pack(labelled.labels), level=QUICK)


def labelled_from(data: bytes) -> LabelledImage:
    """Return the labelled image of `labelled_bytes`; raise `ImageError` if the bytes are not one, or damaged."""
    what = "a labelled image"
    head, rest = split_parts(_LABELLED, data, what)
    camera = _camera(head)
    classes, place = head.get("classes"), head.get("place")
    if not isinstance(classes, list) or len(classes) > _MOST_CLASSES or not isinstance(place, str):
        raise ImageError(f"the head of {what} is damaged: make it again")
    shape = (len(classes), camera.intrinsics.height_px, camera.intrinsics.width_px)
    picture_bytes = _pixels(camera) * _BANDS
    body = unpack_body(rest, picture_bytes + -(-int(np.prod(shape)) // CELLS_PER_BYTE), what)
    image = _image(head, camera, np.frombuffer(body[:picture_bytes], dtype=np.uint8))
    labels = unpack(body[picture_bytes:], shape)
    return LabelledImage(image=image, classes=tuple(classes), labels=labels, place=place)


def _head(image: AerialImage) -> dict[str, Any]:
    return {
        "camera": asdict(image.camera),
        "height_sigma_m": float(image.height_sigma_m),
        "attitude_sigma_deg": float(image.attitude_sigma_deg),
        "observed_on": None if image.observed_on is None else image.observed_on.isoformat(),
        "season": image.season,
    }


def _camera(head: Mapping[str, Any]) -> Camera:
    """Return the camera of a head; raise `ImageError` if it has none, or one of too many pixels."""
    try:
        given = dict(head["camera"])
        inner = given["intrinsics"].items()
        lens: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in inner}
        intrinsics = Intrinsics(**lens)
        camera = Camera(**{**given, "intrinsics": intrinsics, "rotation": tuple(given["rotation"])})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ImageError("the camera of an image's head is damaged: make it again") from error
    if type(intrinsics.width_px) is not int or type(intrinsics.height_px) is not int or _pixels(camera) > MOST_PIXELS:
        raise ImageError(f"an image has at most {MOST_PIXELS} pixels: cut it, or scale it down, first")
    return camera


def _pixels(camera: Camera) -> int:
    return camera.intrinsics.width_px * camera.intrinsics.height_px


def _image(head: Mapping[str, Any], camera: Camera, pixels: NDArray[np.uint8]) -> AerialImage:
    try:
        day, season = head["observed_on"], str(head["season"])
        sigmas = {name: float(head[name]) for name in ("height_sigma_m", "attitude_sigma_deg")}
        observed_on = None if day is None else dt.date.fromisoformat(day)
    except (KeyError, TypeError, ValueError) as error:
        raise ImageError("the head of an image is damaged: make it again") from error
    rgb = pixels.reshape(camera.intrinsics.height_px, camera.intrinsics.width_px, _BANDS)
    return AerialImage(rgb=rgb, camera=camera, observed_on=observed_on, season=season, **sigmas)


def write_labelled(folder: Path, images: Iterable[LabelledImage]) -> tuple[Path, ...]:
    """Write labelled images into a folder, one file each, in their order; one at a time is held in memory.

    Raise `ImageError` if they do not all label the same classes, `StoreError` if the folder cannot be written.
    """
    paths: list[Path] = []
    classes: tuple[str, ...] | None = None
    for number, labelled in enumerate(images):
        classes = classes or labelled.classes
        if labelled.classes != classes:
            raise ImageError(
                f"image {number} labels {', '.join(labelled.classes)}, the first one {', '.join(classes)}: "
                "label the same classes everywhere, as unknown where nobody has looked"
            )
        paths.append(folder / f"{number:06d}{SUFFIX}")
        with fresh_file(paths[-1], mend="free some space and run again") as scratch:
            scratch.write_bytes(labelled_bytes(labelled))
    return tuple(paths)


class LabelledFiles(Sequence[LabelledImage]):
    """Labelled images on disk, each read whenever it is asked for; all of a set would not fit into memory."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)

    @overload
    def __getitem__(self, at: int) -> LabelledImage: ...
    @overload
    def __getitem__(self, at: slice) -> "LabelledFiles": ...
    def __getitem__(self, at: int | slice) -> "LabelledImage | LabelledFiles":
        """Read an image, or select some without reading; raise `ImageError` or `StoreError` if it cannot be read."""
        if isinstance(at, slice):
            return LabelledFiles(self.paths[at])
        path = self.paths[at]
        try:
            return labelled_from(plain_file(path).read_bytes())
        except ImageError as error:
            raise ImageError(f"{path}: {error}") from error
        except OSError as error:
            raise StoreError(f"{path} cannot be read ({error.strerror or error}): make the images again") from error

    def __len__(self) -> int:
        return len(self.paths)
