# SPDX-License-Identifier: Apache-2.0
"""Bands of a picture: which are red, green and blue, and which one says where there is a picture."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np
import rasterio
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from sasgeo_bench.errors import ImageryError
from sasgeo_bench.texts import one_line

_COLOURS: Final = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
_SILENT: Final = frozenset({ColorInterp.undefined, ColorInterp.gray, ColorInterp.alpha})  # say nothing of a colour
_WORD: Final = re.compile(r"\b(red|green|blue)\b(?!\W*edge)")  # not the red edge
_LETTERS: Final[dict[str, str]] = {item.name[0]: item.name for item in _COLOURS}
_BITS: Final = 8
_SAMPLES: Final = 8  # blocks along each side of a picture that are looked at
_SAMPLE_PX: Final = 1024  # of a block, where it is larger


@dataclass(frozen=True, slots=True)
class Bands:
    """Numbers of the bands that are red, green and blue, from 1 on; and that of alpha, if there is one.

    `note` is what whoever builds the region should know of the choice; empty where there was none.
    """

    rgb: tuple[int, int, int] = (1, 2, 3)
    alpha: int | None = None
    note: str = ""


RGB: Final = Bands()


def find_bands(path: Path, source: rasterio.io.DatasetReader) -> Bands:
    """Find the colours of a GeoTIFF by its colour interpretation, else by the names of its bands.

    Raise `ImageryError` if it has no red, green and blue of 8 bits, or says two things about them. Where it says
    nothing, the first three bands are taken, and `note` says so. A few blocks of an alpha band are read: one that is
    neither opaque nor transparent in many places holds a picture, as the near infrared of NAIP does.
    """
    colours = colour_bands(source.colorinterp, source.descriptions)
    alphas = [band for band, is_what in enumerate(source.colorinterp, start=1) if is_what is ColorInterp.alpha]
    kinds = {source.dtypes[band - 1] for band in colours.rgb or ()} or set(source.dtypes)
    if not colours.rgb or kinds != {"uint8"} or len(alphas) > 1:
        raise ImageryError(
            f"{path} has {source.count} band(s) of {source.dtypes[0]}, imagery is 8-bit red, green and blue: convert "
            "it (gdal_translate -ot Byte -scale, -expand rgb for a palette, -b for the bands, -colorinterp for their "
            f"colours); {colours.fault or 'its bands are ' + _names(source.colorinterp)}"
        )
    bits = source.tags(colours.rgb[0], ns="IMAGE_STRUCTURE").get("NBITS", str(_BITS))
    if bits != str(_BITS):
        raise ImageryError(
            f"{path} has colours of {bits} bits, imagery has 8: convert it (gdal_translate -ot Byte -scale)"
        )
    alpha, notes = alphas[0] if alphas else None, [colours.note] if colours.note else []
    if alpha is not None and not _is_mask(source, alpha):
        notes.append(f"its band {alpha} calls itself alpha and holds a picture, such as infrared: it hides nothing")
        alpha = None
    return Bands(rgb=colours.rgb, alpha=alpha, note="; ".join(notes))


@dataclass(frozen=True, slots=True)
class _Colours:
    rgb: tuple[int, int, int] | None = None
    note: str = ""
    fault: str = ""


def colour_bands(interpretation: Sequence[ColorInterp], names: Sequence[str | None]) -> _Colours:
    """Return the bands that are red, green and blue, None if there are none; and a note on the choice, or the fault.

    >>> colour_bands([ColorInterp.undefined, ColorInterp.blue, ColorInterp.green, ColorInterp.red], [None] * 4).rgb
    (4, 3, 2)
    >>> colour_bands([ColorInterp.gray, *[ColorInterp.undefined] * 3], ["blue", "green", "red", "red edge"]).rgb
    (3, 2, 1)
    """
    words = [_colour_of(name or "") for name in names]
    named, listed = _each_once(words), ", ".join(one_line(name or "")[:20] or "nothing" for name in names[:8])
    told = _each_once([item.name if item in _COLOURS else "" for item in interpretation])
    if told:
        called = [(words[band - 1], item.name) for band, item in zip(told, _COLOURS, strict=True)]
        if all(word in ("", colour) for word, colour in called) and named in (None, told):
            return _Colours(told)
        by_names = f"{named or listed} by their names"
        return _Colours(fault=f"red, green and blue are {told} by their colour interpretation, {by_names}")
    if len(interpretation) < len(_COLOURS) or not set(interpretation) <= _SILENT:
        return _Colours()
    if named or any(words):
        return _Colours(named, fault=f"its bands are called {listed}")
    first = [band for band, item in enumerate(interpretation, start=1) if item is not ColorInterp.alpha][:3]
    if len(first) < len(_COLOURS):
        return _Colours()
    rgb = (first[0], first[1], first[2])
    what = f"its bands are called {listed}" if any(names) else "it does not say what its bands show"
    return _Colours(rgb, f"{what}: bands {rgb} are taken as red, green, blue")


def _colour_of(name: str) -> str:
    """Return the colour that a name of a band says, empty if it says none or several."""
    text = name.replace("_", " ").strip().lower()
    found: list[str] = _WORD.findall(text)
    return _LETTERS.get(text, found[0] if len(found) == 1 else "")


def _each_once(words: Sequence[str]) -> tuple[int, int, int] | None:
    """Return the numbers of the bands called red, green and blue, if each is called so once."""
    if any(words.count(item.name) != 1 for item in _COLOURS):
        return None
    red, green, blue = (words.index(item.name) + 1 for item in _COLOURS)
    return red, green, blue


def _names(interpretation: Sequence[ColorInterp]) -> str:
    return ", ".join(item.name for item in interpretation[:8])


def _is_mask(source: rasterio.io.DatasetReader, band: int) -> bool:
    """Return whether an alpha band is opaque or transparent nearly everywhere, by blocks all over the picture."""
    tall, wide = source.block_shapes[band - 1]
    tops = np.unique(np.linspace(0, (source.height - 1) // tall, _SAMPLES).astype(int)) * tall
    lefts = np.unique(np.linspace(0, (source.width - 1) // wide, _SAMPLES).astype(int)) * wide
    low, high = 2, 249  # levels of an alpha that are neither transparent nor opaque; 1 is, in masks of 0 and 1
    counts = np.zeros(2**_BITS, dtype=np.int64)
    for top in tops.tolist():
        for left in lefts.tolist():
            rows, cols = min(tall, _SAMPLE_PX, source.height - top), min(wide, _SAMPLE_PX, source.width - left)
            alpha = source.read(band, window=Window(left, top, cols, rows))
            counts += np.bincount(alpha.ravel(), minlength=len(counts))
    # 8 levels of a mask of any shares, of which one is opaque
    is_of_few = np.count_nonzero(counts) <= 8 and counts[high + 1 :].any()
    # 0.1 of the pixels of a mask, at its edges, are neither opaque nor transparent
    return bool(is_of_few) or counts[low : high + 1].sum() <= 0.1 * counts.sum()


def selected(source: rasterio.io.DatasetReader, bands: Bands) -> str | None:
    """Return a virtual raster of the colours, and of alpha as the fourth band; None if the file is that already.

    GDAL's warper knows an alpha band only where it is the last one, and takes every band of that name for alpha.
    """
    masks = set(source.mask_flag_enums[bands.rgb[0] - 1])
    has_mask = MaskFlags.per_dataset in masks and MaskFlags.alpha not in masks
    order = (*bands.rgb, *([bands.alpha] if bands.alpha else []))
    if order == tuple(range(1, source.count + 1)) and not (has_mask and bands.alpha):
        return None
    root = ET.Element("VRTDataset", rasterXSize=str(source.width), rasterYSize=str(source.height))
    ET.SubElement(root, "SRS", dataAxisToSRSAxisMapping="1,2").text = source.crs.to_wkt()
    ET.SubElement(root, "GeoTransform").text = ", ".join(map(repr, source.transform.to_gdal()))
    for number, (band, colour) in enumerate(zip(bands.rgb, _COLOURS, strict=True), start=1):
        entry = _band(root, number, colour, {})
        if source.nodatavals[band - 1] is not None:
            ET.SubElement(entry, "NoDataValue").text = repr(source.nodatavals[band - 1])
        _simple_source(entry, source.name, str(band))
    hiding = [str(bands.alpha)] * bool(bands.alpha) + [f"mask,{bands.rgb[0]}"] * has_mask
    if hiding:
        both = {"subClass": "VRTDerivedRasterBand"} if len(hiding) > 1 else {}
        entry = _band(root, 4, ColorInterp.alpha, both)
        if both:
            ET.SubElement(entry, "PixelFunctionType").text = "mul"
        for band_of in hiding:
            _simple_source(entry, source.name, band_of)
    return ET.tostring(root, encoding="unicode")


def _band(root: ET.Element, number: int, colour: ColorInterp, more: dict[str, str]) -> ET.Element:
    entry = ET.SubElement(root, "VRTRasterBand", {"dataType": "Byte", "band": str(number), **more})
    ET.SubElement(entry, "ColorInterp").text = colour.name.capitalize()
    return entry


def _simple_source(entry: ET.Element, name: str, band: str) -> None:
    into = ET.SubElement(entry, "SimpleSource")
    ET.SubElement(into, "SourceFilename", relativeToVRT="0", shared="0").text = str(Path(name).absolute())
    ET.SubElement(into, "SourceBand").text = band
