# SPDX-License-Identifier: Apache-2.0
"""Heads of photos: size, EXIF, GPS and XMP of a JPEG, TIFF or DNG; no pixel is decoded."""

import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]
from PIL import ExifTags, Image, UnidentifiedImageError
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from sasgeo_bench.errors import ImageError
from sasgeo_bench.files.paths import plain_file
from sasgeo_bench.texts import message_of

_TIFF: Final = (b"II*\0", b"MM\0*")
_WIDTH, _HEIGHT, _KIND, _PARTS, _XMP, _CROP = 256, 257, 254, 330, 700, 50720
_FRAME: Final = ("adobe:ns:meta", "http://www.w3.org/1999/02/22-rdf-syntax-ns#")  # namespaces that hold no property

Xmp = Mapping[tuple[str, str], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoHead:
    """Metadata of a photo: `exif` is the first directory of tags, `inner` that of the camera.

    `size_px` is the width and height as stored, before the orientation turns it; of a DNG those of the developed photo.
    Keys of `xmp` are a namespace URI without its last "/", and a name; parts of a structure are named "Whole/Part".
    """

    size_px: tuple[int, int]
    exif: Mapping[int, Any]
    inner: Mapping[int, Any]
    gps: Mapping[int, Any]
    xmp: Xmp


def read_head(path: Path) -> PhotoHead:
    """Read the head of a photo; raise `ImageError` if it is no sound JPEG, TIFF or DNG."""
    try:
        with warnings.catch_warnings(), plain_file(path).open("rb") as file:
            warnings.simplefilter("ignore")  # of Pillow: odd metadata; what is needed and odd is refused later
            if file.read(4) in _TIFF:
                return _read_tiff(file)
            with Image.open(plain_file(path), formats=("JPEG",)) as image:  # one of several (MPO) is one, too
                return _head(image.size, image.getexif(), image.info.get("xmp"))
    except ImageError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ImageError(
            f"{path} is no JPEG, TIFF or DNG of a size that can be read ({message_of(error)}): check the file"
        ) from error
    except FileNotFoundError as error:
        raise ImageError(f"there is no photo {path}: check the path") from error
    except Exception as error:  # Pillow and the reader of XML fail at damaged files with errors of many kinds
        raise ImageError(f"{path} has damaged metadata ({message_of(error)}): copy it again from the drone") from error


def _head(size_px: tuple[int, int], exif: Image.Exif, xmp: object) -> PhotoHead:
    packet = xmp.encode() if isinstance(xmp, str) else xmp if isinstance(xmp, bytes) else b""
    return PhotoHead(
        size_px=size_px,
        exif=exif,
        inner=exif.get_ifd(ExifTags.IFD.Exif),
        gps=exif.get_ifd(ExifTags.IFD.GPSInfo),
        xmp=properties_of(packet),
    )


def _read_tiff(file: IO[bytes]) -> PhotoHead:
    """Read a TIFF's or DNG's head: in a DNG the first picture is a preview, and others hang on its directory."""
    file.seek(0)
    exif = Image.Exif()
    exif.load_from_fp(file)
    first = dict(exif)
    offsets = first.get(_PARTS, ())
    parts: list[Mapping[int, Any]] = [first]
    file.seek(0)
    start = file.read(8)
    for offset in (offsets if isinstance(offsets, tuple) else (offsets,))[:32]:  # at most 32 parts of a DNG
        part = ImageFileDirectory_v2(start)
        file.seek(int(offset))
        part.load(file)
        parts.append(dict(part))
    # 1: bit of NewSubfileType: a preview of another picture in the file
    whole = [part for part in parts if not int(part.get(_KIND, 0)) & 1] or parts
    return _head(max(map(_size_px, whole), key=math.prod), exif, first.get(_XMP))


def _size_px(part: Mapping[int, Any]) -> tuple[int, int]:
    """Return width and height of a picture of a TIFF: of a raw one those that its maker crops it to."""
    width, height = part.get(_CROP) or (part.get(_WIDTH, 0), part.get(_HEIGHT, 0))
    return int(width), int(height)


def properties_of(packet: bytes) -> dict[tuple[str, str], str]:
    """Return the properties of an XMP packet, written as attributes or as elements, by namespace URI and name.

    >>> found = properties_of(b'<x:xmpmeta xmlns:x="adobe:ns:meta/" xmlns:d="http://x.y/z/" d:Yaw="+9.0"/>')
    >>> found["http://x.y/z", "Yaw"]
    '+9.0'
    """
    packet = packet.strip(b"\0 \r\n")
    found: dict[tuple[str, str], str] = {}
    if packet:
        for key, text in _properties(fromstring(packet), ()):
            found.setdefault(key, text)
    return found


def _properties(element: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, str], str]]:  # noqa: ANN401 - untyped
    uri, name = _split(element.tag)
    here = path if uri in _FRAME else (*path, name)
    if here != path and element.text and element.text.strip():
        yield (uri, "/".join(here)), element.text.strip()
    for attribute, value in element.attrib.items():
        uri, name = _split(attribute)
        if uri and uri not in _FRAME:
            yield (uri, "/".join((*here, name))), value
    for child in element:
        yield from _properties(child, here)


def _split(name: str) -> tuple[str, str]:
    """Return the namespace URI of a name without its last "/", and the local name."""
    uri, _, local = name.rpartition("}")
    return uri.removeprefix("{").rstrip("/"), local


def number_of(value: Any) -> float | None:  # noqa: ANN401 - whatever metadata hold
    """Return a finite number out of EXIF or XMP, which may hold text, fractions of zero or nothing.

    >>> number_of("+12.50"), number_of("7/2"), number_of("0/0"), number_of(None)
    (12.5, 3.5, None, None)
    """
    try:
        parts = value.split("/") if isinstance(value, str) else [value]
        number = float(parts[0]) / float(parts[1]) if len(parts) == 2 else float(value)  # a fraction
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def positive_of(value: Any) -> float | None:  # noqa: ANN401 - as above
    """Return a finite number above 0 out of EXIF or XMP, None for anything else."""
    number = number_of(value)
    return number if number is not None and number > 0 else None
