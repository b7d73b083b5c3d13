# SPDX-License-Identifier: Apache-2.0
"""Aerial images: decoded within limits, with the camera as it is believed; and with labels to learn from."""

import datetime as dt
import json
import struct
import warnings
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Self, overload

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from sasgeo_bench.core.errors import ImageError, StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.regions.evidence import CELLS_PER_BYTE, UNKNOWN, pack, unpack
from sasgeo_bench.sensing.camera import Camera, Intrinsics

Picture = NDArray[np.uint8]

MOST_BYTES: Final = 64 * 2**20  # of an encoded image
MOST_PIXELS: Final = 64_000_000  # of a decoded one; Pillow itself warns beyond 89 million
_FORMATS: Final = ("JPEG", "PNG", "WEBP", "TIFF")
_WITHIN_8_BITS: Final = frozenset(
    {"1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "LAB"}
)
_16_BITS: Final = 65535
_BETWEEN: Final = (2, 249)  # levels of an alpha that are neither transparent nor opaque


def decode_image(
    data: bytes, *, name: str = "the image", most_bytes: int = MOST_BYTES, most_pixels: int = MOST_PIXELS
) -> Picture:
    """Decode an image from outside: JPEG, PNG, WebP or TIFF; bytes and pixels are counted before anything is decoded.

    Parameters
    ----------
    data : bytes
        The encoded image. Of several pictures in one file the first is read.
    name : str
        What errors call it, such as its path.
    most_bytes, most_pixels : int
        Limits of the encoded and of the decoded image.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        Red, green, blue, turned upright as its EXIF orientation says. Grey becomes three equal bands; 16 bits are
        rounded to 8; transparent pixels are laid over black.

    Raises
    ------
    ImageError
        In one line, if the image is empty, too large, truncated or damaged, holds no colours (32-bit numbers), or is a
        TIFF whose alpha is no mask, or whose first picture is a preview.

    Examples
    --------
    >>> encoded = BytesIO()
    >>> Image.new("P", (3, 2)).save(encoded, format="PNG")
    >>> decode_image(encoded.getvalue()).shape
    (2, 3, 3)
    >>> decode_image(encoded.getvalue(), name="roof.png", most_pixels=5)
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ImageError: roof.png has 3 x 2 pixels, at most 5 are decoded: cut it, or scale it down,
    first
    """
    if not data:
        raise ImageError(f"{name} is empty: copy or download it again")
    if len(data) > most_bytes:
        raise ImageError(
            f"{name} has {len(data)} bytes, at most {most_bytes} are read: cut it, or scale it down, first"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Pillow: large images and odd metadata; we refuse what matters
        return _decoded(data, name, most_pixels)


def _decoded(data: bytes, name: str, most_pixels: int) -> Picture:
    try:
        with Image.open(BytesIO(data), formats=_FORMATS) as image:  # reads the head alone
            _check_head(image, name, most_pixels)
            return _to_rgb(ImageOps.exif_transpose(image), name, is_tiff=image.format == "TIFF")
    except ImageError:
        raise
    except Image.DecompressionBombError as error:
        raise ImageError(
            f"{name} has more than twice the pixels that Pillow decodes: cut it, or scale it down, first"
        ) from error
    except UnidentifiedImageError as error:
        raise ImageError(
            f"{name} is no JPEG, PNG, WebP or TIFF image, or its first bytes are damaged: export it as one"
        ) from error
    except Exception as error:  # Pillow fails at damaged files with errors of many kinds
        raise ImageError(f"{name} is truncated or damaged ({message_of(error)}): copy or download it again") from error


def _check_head(image: Image.Image, name: str, most_pixels: int) -> None:
    """Refuse an image by its head, before its pixels are decoded."""
    width, height = image.size
    if width < 1 or height < 1:
        raise ImageError(f"{name} has {width} x {height} pixels: export it again")
    if width * height > most_pixels:
        raise ImageError(
            f"{name} has {width} x {height} pixels, at most {most_pixels} are decoded: cut it, or scale it down, first"
        )
    # 1: its bit of a preview, as raw photos (DNG) have one in front
    if getattr(image, "tag_v2", {}).get(254, 0) & 1:  # 254: TIFF's NewSubfileType
        raise ImageError(f"{name} begins with what is a preview of another picture in the file: export it as JPEG")
    if image.mode not in _WITHIN_8_BITS and not image.mode.startswith("I;16"):
        raise ImageError(
            f"{name} holds numbers of kind {image.mode!r}, not colours: export it with 8 or 16 bits a band"
        )


def _to_rgb(image: Image.Image, name: str, *, is_tiff: bool) -> Picture:
    """Return the bands of a decoded image as 8-bit red, green and blue."""
    if image.mode.startswith("I;16"):
        grey = np.asarray(image).astype(np.uint32)
        bytes_ = ((grey * 255 + _16_BITS // 2) // _16_BITS).astype(np.uint8)
        return np.repeat(bytes_[:, :, None], 3, axis=2)
    if image.has_transparency_data:
        seen = image.convert("RGBA")
        alpha = np.asarray(seen.getchannel("A"))
        # 0.1 of a TIFF's pixels, at the edges of a mask, are neither opaque nor transparent
        if is_tiff and ((alpha >= _BETWEEN[0]) & (alpha <= _BETWEEN[1])).mean() > 0.1:
            raise ImageError(
                f"{name} has a band that calls itself alpha and holds a picture, such as near infrared: write its red, "
                "green and blue alone (gdal_translate -b 1 -b 2 -b 3)"
            )
        image = Image.new("RGBA", seen.size, (0, 0, 0, 255))
        image.alpha_composite(seen)
    return np.array(image.convert("RGB"), dtype=np.uint8)


_AXES: Final = 3  # of a picture: rows, columns, bands
_FAR_M: Final = 1000.0  # height of the camera of an orthophoto, in which nothing leans


@dataclass(frozen=True, slots=True, kw_only=True)
class AerialImage:
    """A picture from the air, and what is believed of the camera that took it.

    Parameters
    ----------
    rgb : ndarray of uint8, shape (H, W, 3)
        Red, green, blue; it is made read-only.
    camera : Camera
        As believed: its pose in a frame whose origin is below the camera; yaw 0, since the heading is not given away.
    height_sigma_m, attitude_sigma_deg : float
        Standard deviations of the believed height, and of each angle of the believed attitude; 0 where exact.
    observed_on : date, optional
        Day of the picture; None if unknown.
    season : str
        As in a query: "leaf_on", "snow", ..., or "" for unspecified.

    Raises
    ------
    ImageError
        If the picture is no 8-bit RGB of the camera's size, or a standard deviation is negative or not finite.
    """

    rgb: Picture
    camera: Camera
    height_sigma_m: float = 0.0
    attitude_sigma_deg: float = 0.0
    observed_on: dt.date | None = None
    season: str = ""

    def __post_init__(self) -> None:
        """Check shape, type and sigmas; lock the picture."""
        size = (self.camera.intrinsics.height_px, self.camera.intrinsics.width_px)
        if self.rgb.dtype != np.uint8 or self.rgb.shape != (*size, 3):
            raise ImageError(
                f"rgb is uint8 of shape {(*size, 3)}, as the camera's pictures are; "
                f"got {self.rgb.dtype} of shape {self.rgb.shape}"
            )
        for name in ("height_sigma_m", "attitude_sigma_deg"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ImageError(f"{name} must be finite and not negative, got {value!r}")
        self.rgb.flags.writeable = False

    @classmethod
    def from_above(cls, rgb: Picture, *, gsd_m: float) -> Self:
        """Make an image of a picture from straight above, such as a part of an orthophoto.

        Parameters
        ----------
        rgb : ndarray of uint8, shape (H, W, 3)
            Red, green, blue; it is made read-only.
        gsd_m : float
            Width of a pixel on the ground, metres. A segmenter goes by it: with half of it streets look like rivers.

        Raises
        ------
        ImageError
            If the picture is no 8-bit RGB, or `gsd_m` is not positive and finite.

        Examples
        --------
        >>> seen = AerialImage.from_above(np.zeros((400, 300, 3), dtype=np.uint8), gsd_m=0.25)
        >>> seen.shape, seen.camera.height_m / seen.camera.intrinsics.focal_px[0]
        ((400, 300), 0.25)
        """
        if rgb.ndim != _AXES or rgb.size == 0:
            raise ImageError(f"rgb is uint8 of shape (H, W, 3), got {rgb.dtype} of shape {rgb.shape}")
        if not (np.isfinite(gsd_m) and gsd_m > 0):
            raise ImageError(f"gsd_m, the width of a pixel on the ground, is positive and finite, got {gsd_m!r}")
        rows, cols = rgb.shape[:2]
        lens = Intrinsics(
            width_px=cols,
            height_px=rows,
            focal_px=(_FAR_M / gsd_m, _FAR_M / gsd_m),
            centre_px=(cols / 2, rows / 2),
        )
        camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=_FAR_M, yaw_deg=0.0)
        return cls(rgb=rgb, camera=camera)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return (self.rgb.shape[0], self.rgb.shape[1])

    def cropped(self, top: int, left: int, rows: int, cols: int) -> Self:
        """Return a part of the image by its first row and column and its size, as the same camera sees it.

        >>> from sasgeo_bench.sensing.tiny_images import tiny_images
        >>> whole = tiny_images()[0].image
        >>> whole.cropped(10, 20, 30, 40).camera.intrinsics.centre_px, whole.camera.intrinsics.centre_px
        ((44.0, 38.0), (64.0, 48.0))
        """
        rgb = np.ascontiguousarray(self.rgb[top : top + rows, left : left + cols])
        across, down = self.camera.intrinsics.centre_px
        lens = replace(
            self.camera.intrinsics, width_px=rgb.shape[1], height_px=rgb.shape[0], centre_px=(across - left, down - top)
        )
        return replace(self, rgb=rgb, camera=replace(self.camera, intrinsics=lens))


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledImage:
    """An aerial image and what is on it, pixel by pixel.

    Parameters
    ----------
    image : AerialImage
        The picture.
    classes : tuple of str
        Names of the classes, in the order of `labels`; classes overlap, as a bridge and the river below it do.
    labels : ndarray of uint8, shape (C, H, W)
        ABSENT 0, PRESENT 1 or UNKNOWN 2, where nothing is labelled; made read-only.
    place : str
        Region or town; parts of an image set are never split within one.

    Raises
    ------
    ImageError
        If the labels are of another shape than the picture, have no or repeated classes, or hold any other value.
    """

    image: AerialImage
    classes: tuple[str, ...]
    labels: NDArray[np.uint8]
    place: str

    def __post_init__(self) -> None:
        """Check shape, type and values; lock the labels."""
        check_classes(self.classes)
        expected = (len(self.classes), *self.image.shape)
        if self.labels.dtype != np.uint8 or self.labels.shape != expected:
            raise ImageError(
                f"labels are uint8 of shape {expected}, got {self.labels.dtype} of shape {self.labels.shape}"
            )
        if self.labels.max() > UNKNOWN:
            raise ImageError(f"labels are 0 absent, 1 present or 2 unknown, got {int(self.labels.max())}")
        self.labels.flags.writeable = False


def check_classes(classes: tuple[str, ...]) -> None:
    """Raise `ImageError` if there is no class, or one twice.

    >>> check_classes(("building", "water", "building"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ImageError: classes are at least one and each once, got building, water, building
    """
    if not classes or len(set(classes)) != len(classes):
        raise ImageError(f"classes are at least one and each once, got {', '.join(classes) or 'none'}")


_HEAD: Final = struct.Struct("!I")
_MOST_HEAD: Final = 2**16  # bytes
QUICK: Final = 1  # level of compression that is worth its time
STORED: Final = 0  # for bytes that do not stay
LABELLED: Final = ".labelled"  # suffix of a file that holds one labelled image


def pack_parts(magic: bytes, head: Mapping[str, object], body: bytes, *, level: int = QUICK) -> bytes:
    """Return a head and a body as bytes that begin with `magic`.

    >>> data = pack_parts(b"DEMO", {"count": 3}, b"abc")
    >>> head, rest = split_parts(b"DEMO", data, "a demo")
    >>> head["count"], unpack_body(rest, 3, "a demo")
    (3, b'abc')
    """
    text = json.dumps(head, allow_nan=False).encode()
    return magic + _HEAD.pack(len(text)) + text + zlib.compress(body, level=level)


def split_parts(magic: bytes, data: bytes, what: str) -> tuple[dict[str, object], bytes]:
    """Return the head and the compressed body of bytes; raise `ImageError` if they are not what `pack_parts` writes."""
    fault = f"these bytes are not {what}, or their head is damaged: make it again"
    start = len(magic) + _HEAD.size
    if len(data) < start or not data.startswith(magic):
        raise ImageError(fault)
    (head_bytes,) = _HEAD.unpack_from(data, len(magic))
    if head_bytes > min(_MOST_HEAD, len(data) - start):
        raise ImageError(fault)
    try:
        head = json.loads(data[start : start + head_bytes])
    except (ValueError, RecursionError) as error:
        raise ImageError(fault) from error
    if not isinstance(head, dict):
        raise ImageError(fault)
    return head, data[start + head_bytes :]


def unpack_body(rest: bytes, count: int, what: str) -> bytes:
    """Return a body of `count` bytes; raise `ImageError` if it has another number. No more than that is unpacked."""
    unpacking = zlib.decompressobj()
    try:
        body = unpacking.decompress(rest, count + 1)
    except zlib.error as error:
        raise ImageError(f"the bytes of {what} are damaged ({error}): make it again") from error
    if len(body) != count or not unpacking.eof or unpacking.unused_data:
        raise ImageError(f"{what} does not hold the {count} bytes that its head announces: make it again")
    return body


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


def _head(image: AerialImage) -> dict[str, object]:
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
        lens = dict(given["intrinsics"])
        intrinsics = Intrinsics(**lens | {name: tuple(lens[name]) for name in lens if isinstance(lens[name], list)})
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
                "label the same classes everywhere, as unknown where nothing is labelled"
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
