# SPDX-License-Identifier: Apache-2.0
"""Masks and probabilities that somebody else's network made: read, by a legend, as segmentations."""

import io
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import rasterio
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from sasgeo_bench.core.config import Document, parse_toml
from sasgeo_bench.core.errors import ConfigError, ImageError, named
from sasgeo_bench.core.geotiff import open_geotiff, open_png
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.core.paths import plain_file, read_bounded
from sasgeo_bench.core.texts import one_line, plain
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation

MASKS: Final = (".png", ".tif", ".tiff", ".npy", ".npz")
NONE: Final = "none"  # of a legend: nothing of any class that it names is there
UNKNOWN: Final = "unknown"
MOST_PIXELS: Final = 64_000_000
_MOST_BYTES: Final = 2**30
_BACKGROUNDS: Final = ("0", "#000000")
_MOST_STRANGE: Final = 0.5  # of the pixels that are not background: of more, the legend is of other masks
_COLOUR: Final = re.compile(r"#[0-9a-f]{6}")
_VALUE: Final = re.compile(r"[0-9]{1,5}")
_SHOWN: Final = 6
_MOST_VALUE: Final = 65535
_FEW: Final = 32  # an 8-bit plane that holds no more than this holds values of classes, not chances

Classes = Annotated[list[str], Field(min_length=1)]
Meaning = str | Classes


class Legend(Document):
    r"""What masks mean, as a TOML file says it: one of four tables, by what the masks hold.

    `values` are whole numbers of pixels, `colours` those of pictures in red, green and blue ("#ff0000"), `categories`
    names of a COCO file, and `bands` numbers (from 1) or names of probabilities. Each means a class of the taxonomy, or
    a list of classes, one of which it is; of values and colours also "none" and "unknown". Whatever is not named is
    unknown. A class of the taxonomy that the legend does not name is unknown everywhere.

    >>> text = '[values]\n0 = "none"\n1 = "building"\n2 = ["road_major", "road_minor"]'
    >>> parse_toml(text, Legend, source="legend.toml").classes
    ('road_major', 'road_minor', 'building')
    """

    without_empty = frozenset({"values", "colours", "categories", "bands"})

    values: dict[str, Meaning] = {}
    colours: dict[str, Meaning] = {}
    categories: dict[str, Meaning] = {}
    bands: dict[str, str] = {}

    @field_validator("values")
    @classmethod
    def _are_numbers(cls, given: dict[str, Meaning]) -> dict[str, Meaning]:
        strange = next((key for key in given if not _VALUE.fullmatch(key) or int(key) > _MOST_VALUE), None)
        if strange is not None:
            raise ValueError(f"values are whole numbers from 0 to {_MOST_VALUE}, got {strange!r}")
        found = {str(int(key)): meaning for key, meaning in given.items()}
        if len(found) < len(given):
            raise ValueError(f"a value stands there twice, as in '1' and '01': {', '.join(given)}")
        return found

    @field_validator("bands", mode="before")
    @classmethod
    def _mean_one_class_each(cls, given: object) -> object:
        several = (
            next((key for key, one in given.items() if isinstance(one, list)), None)
            if isinstance(given, dict)
            else None
        )
        if several is not None:
            raise ValueError(f"a band holds the chances of one class, got several for {several!r}: name one")
        return given

    @field_validator("bands")
    @classmethod
    def _are_bands_of_a_class_each(cls, given: dict[str, str]) -> dict[str, str]:
        if "0" in given:
            raise ValueError("bands are counted from 1, got '0'")
        twice = next((name for name in given.values() if list(given.values()).count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"{twice!r} is from two bands: put their chances together first (the larger of both)")
        return given

    @field_validator("colours")
    @classmethod
    def _are_colours(cls, given: dict[str, Meaning]) -> dict[str, Meaning]:
        found = {key.lower(): meaning for key, meaning in given.items()}
        strange = next((key for key in found if not _COLOUR.fullmatch(key)), None)
        if strange is not None or len(found) < len(given):
            raise ValueError(f"colours are written as in '#ff0000', each once, got {strange or 'one twice'!r}")
        return found

    @model_validator(mode="after")
    def _means_something(self) -> "Legend":
        tables = [name for name in ("values", "colours", "categories", "bands") if getattr(self, name)]
        if len(tables) != 1:
            raise ValueError(f"a legend has one of [values], [colours], [categories] and [bands], got {len(tables)}")
        known = load_taxonomy().names
        words = known if self.bands else (*known, NONE, UNKNOWN)
        for meaning in (*self.values.values(), *self.colours.values(), *self.categories.values(), *self.bands.values()):
            strange = next((one for one in _listed(meaning) if one not in words), None)
            if strange is not None:
                raise ValueError(f"{strange!r} is no class: there are {', '.join(words)}")
            if not isinstance(meaning, str) and {NONE, UNKNOWN} & set(meaning):
                raise ValueError(f"a list names classes alone, got {', '.join(meaning)}")
        if not self.classes:
            raise ValueError("the legend names no class")
        return self

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the classes that it names, in the order of the taxonomy."""
        meanings = (*self.values.values(), *self.colours.values(), *self.categories.values(), *self.bands.values())
        there = {one for meaning in meanings for one in _listed(meaning)}
        return tuple(name for name in load_taxonomy().names if name in there)

    def column(self, meaning: Meaning) -> NDArray[np.uint8]:
        """Return the byte of each class where a meaning stands, shape (C,)."""
        if meaning == UNKNOWN:
            return np.full(len(self.classes), SILENT, dtype=np.uint8)
        names = _listed(meaning)
        share = round(CERTAIN / len(names))  # one of them, and nobody says which
        return np.array([share if name in names else 0 for name in self.classes], dtype=np.uint8)


def _listed(meaning: Meaning) -> list[str]:
    return [meaning] if isinstance(meaning, str) else list(meaning)


def read_legend(path: Path) -> Legend:
    """Read a legend (TOML); raise `ConfigError` if it is none."""
    try:
        text = plain_file(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: name a legend (*.toml)") from error
    return parse_toml(text, Legend, source=str(path))


@dataclass(kw_only=True)
class Strange:
    """Pixels whose value no legend names, by value, over some masks."""

    counts: Counter[str] = field(default_factory=Counter)

    def note(self) -> str:
        """Return a line for the user; empty without any.

        >>> Strange(counts=Counter({"7": 12})).note()
        '12 pixels of 7, which the legend does not name, are unknown'
        """
        if not self.counts:
            return ""
        values = [value for value, _ in self.counts.most_common(_SHOWN)]
        more = ", ..." if len(self.counts) > _SHOWN else ""
        return f"{self.counts.total()} pixels of {', '.join(values)}{more}, which the legend does not name, are unknown"


def read_mask(path: Path, legend: Legend, strange: Strange | None = None) -> Segmentation:
    r"""Read a mask, or probabilities, as a segmentation of the legend's classes.

    Parameters
    ----------
    path : Path
        PNG or GeoTIFF (1 to 16 bits as stored; palettes count as indices, for a legend of colours as these), or an
        array of numpy: (H, W) of values, (C, H, W) of probabilities, or an archive with an array of probabilities for
        each name of `bands`.
    legend : Legend
        What its values, colours or bands mean.
    strange : Strange, optional
        Counts pixels of values that the legend does not name.

    Returns
    -------
    Segmentation
        Certain where a value means a class; of probabilities as they are. Unknown is silent.

    Raises
    ------
    ImageError
        If the file is no mask, most of what it shows is not in the legend, or probabilities lie beyond 0..1.

    Examples
    --------
    >>> import tempfile
    >>> legend = parse_toml('[values]\n0 = "none"\n1 = "water"', Legend, source="legend.toml")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(Path(folder, "mask.npy"), np.array([[0, 1, 1, 9]], dtype=np.uint8))
    ...     read_mask(Path(folder, "mask.npy"), legend).probability_bytes.tolist()
    [[[0, 254, 254, 255]]]
    """
    strange = Strange() if strange is None else strange
    if legend.categories:
        raise ImageError(f"{path.name} is no COCO file, and the legend has [categories]: say [values] or [bands]")
    if path.suffix.lower() in (".npy", ".npz"):
        return _of_array(path, legend, strange)
    try:
        with _opened(path) as source:
            if source.width * source.height * source.count > 4 * MOST_PIXELS:
                raise ImageError(f"{path.name} has {source.width} x {source.height} pixels: cut it first")
            bands, colours = source.read(), source.colorinterp
            nodata, names = source.nodata, source.descriptions
            if legend.colours and colours == (ColorInterp.palette,):
                bands, colours = _painted(bands[0], source.colormap(1)), _RGBA
    except (RasterioError, OSError) as error:
        if isinstance(error, ImageError):
            raise
        raise ImageError(f"{path.name} is no PNG or GeoTIFF that can be read: export the mask anew") from error
    if legend.bands:
        return _of_probabilities(path, bands, [name or "" for name in names], legend)
    if legend.colours:
        return _of_colours(path, bands, colours, legend, strange)
    if len(bands) > 1 and not all(one is ColorInterp.alpha for one in colours[1:]):
        raise ImageError(f"{path.name} has {len(bands)} bands: a legend of [colours] reads pictures, [bands] chances")
    return _of_values(path, bands[0], legend, strange, nodata=nodata)


@contextmanager
def _opened(path: Path) -> Iterator[rasterio.io.DatasetReader]:
    """Open a PNG or a TIFF, without the files beside it, with the values that are stored in it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # where it lies is in a table of poses
        with open_png(path) if path.suffix.lower() == ".png" else open_geotiff(path) as source:
            yield source


_RGBA: Final = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)


def _painted(values: NDArray[Any], palette: Mapping[int, tuple[int, ...]]) -> NDArray[np.uint8]:
    """Return indices as the colours of their palette, shape (4, H, W); those that it lacks are transparent."""
    table = np.zeros((65536, 4), dtype=np.uint8)
    table[list(palette)] = list(palette.values())
    return np.moveaxis(table[values], -1, 0)


def _of_values(
    path: Path, values: NDArray[Any], legend: Legend, strange: Strange, *, nodata: float | None = None
) -> Segmentation:
    if values.dtype == bool:
        values = values.astype(np.uint8)
    if values.dtype.kind not in "iu" or values.size == 0:
        raise ImageError(f"{path.name} holds {values.dtype} numbers: values of a mask are whole, chances need [bands]")
    if values.min() < 0 or values.max() > 65535:
        raise ImageError(f"{path.name} holds {int(values.min())} to {int(values.max())}, a mask 0 to 65535")
    table = np.full((65536, len(legend.classes)), SILENT, dtype=np.uint8)
    known = np.zeros(65536, dtype=bool)
    for key, meaning in legend.values.items():
        table[int(key)], known[int(key)] = legend.column(meaning), True
    if nodata is not None and float(nodata).is_integer() and 0 <= nodata <= 65535:
        known[int(nodata)] = True  # unknown by the file's own word, unless the legend says otherwise
    there, counts = np.unique(values, return_counts=True)
    missing = {str(value): int(count) for value, count in zip(there, counts, strict=True) if not known[value]}
    zero = [int(key) for key, meaning in legend.values.items() if meaning in (NONE, UNKNOWN)]
    _note(path, missing, int(values.size), int(np.isin(values, zero).sum()), legend.values, strange)
    return Segmentation(classes=legend.classes, probability_bytes=np.moveaxis(table[values], -1, 0).copy())


def _of_colours(
    path: Path, bands: NDArray[Any], interpretation: Sequence[ColorInterp], legend: Legend, strange: Strange
) -> Segmentation:
    if len(bands) not in (3, 4) or bands.dtype != np.uint8:
        raise ImageError(
            f"{path.name} has {len(bands)} band(s) of {bands.dtype}: [colours] are of 8-bit red, green, blue"
        )
    red, green, blue = (bands[at].astype(np.uint32) for at in range(3))
    codes = (red << 16) | (green << 8) | blue
    shown = np.ones(codes.shape, dtype=bool)
    if len(bands) == 4 and interpretation[3] is ColorInterp.alpha:
        shown = bands[3] > 0  # what is transparent is unknown
    planes = np.full((len(legend.classes), *codes.shape), SILENT, dtype=np.uint8)
    known = ~shown
    for key, meaning in legend.colours.items():
        here = shown & (codes == int(key[1:], 16))
        planes[:, here] = legend.column(meaning)[:, None]
        known |= here
    there, counts = np.unique(codes[~known], return_counts=True)
    missing = {f"#{code:06x}": int(count) for code, count in zip(there.tolist(), counts, strict=True)}
    zero = [int(key[1:], 16) for key, meaning in legend.colours.items() if meaning in (NONE, UNKNOWN)]
    _note(path, missing, int(codes.size), int(np.isin(codes, zero).sum()), legend.colours, strange)
    return Segmentation(classes=legend.classes, probability_bytes=planes)


def _note(
    path: Path, missing: Mapping[str, int], total: int, empty: int, known: Mapping[str, Meaning], strange: Strange
) -> None:
    """Count pixels that the legend does not name; refuse a mask of which most that is not background is such.

    The error has one value alone, that of a background if it can, so that masks with one fault are counted together.
    """
    if sum(missing.values()) > _MOST_STRANGE * (total - empty):
        shown = next((one for one in _BACKGROUNDS if one in missing), max(missing, key=lambda one: missing[one]))
        fault = f"most of what {path.name} holds is not in the legend, such as {shown}"
        if shown in _BACKGROUNDS:
            key = f'"{shown}"' if shown.startswith("#") else shown
            raise ImageError(f'{fault}: if that is the background, say {key} = "none"')
        raise ImageError(
            f"{fault}: was the mask stretched to grey levels, or is the legend ({', '.join(list(known)[:_SHOWN])}) of "
            "others?"
        )
    strange.counts.update(missing)


def _of_probabilities(path: Path, bands: NDArray[Any], names: Sequence[str], legend: Legend) -> Segmentation:
    planes = np.full((len(legend.classes), *bands.shape[1:]), SILENT, dtype=np.uint8)
    for key, name in legend.bands.items():
        at = int(key) - 1 if key.isdecimal() else list(names).index(key) if key in names else -1
        if not 0 <= at < len(bands):
            listed = ", ".join(filter(None, names)) or "without names"
            raise ImageError(f"{path.name} has no band {key!r}: it has {len(bands)} ({plain(listed)[:200]})")
        planes[legend.classes.index(name)] = _chances(path, bands[at])
    return Segmentation(classes=legend.classes, probability_bytes=planes)


def _chances(path: Path, plane: NDArray[Any]) -> NDArray[np.uint8]:
    """Return probabilities as bytes: numbers of 0 to 1, or of 8 bits, of which 255 is 1."""
    if plane.dtype == np.uint8:
        values = np.unique(plane)
        if 0 < int(values[values < 255].max(initial=0)) < _FEW:
            raise ImageError(
                f"{path.name} holds few numbers, all below {_FEW}: these look like values of classes, which [values] "
                "reads; chances of 8 bits go from 0 to 255"
            )
        return np.floor(plane / 255 * CERTAIN + 0.5).astype(np.uint8)
    if plane.dtype.kind != "f":
        raise ImageError(f"{path.name} holds {plane.dtype} numbers: chances are floats of 0 to 1, or 8 bits")
    known = np.isfinite(plane)
    least, most = (float(plane[known].min()), float(plane[known].max())) if known.any() else (0.0, 0.0)
    if least < 0 or most > 1:
        beyond = "below 0" if least < 0 else "above 1"
        raise ImageError(
            f"{path.name} holds numbers {beyond}, chances lie within 0 to 1: if they are logits, take the sigmoid"
        )
    filled = np.where(known, plane, 0)
    return np.where(known, np.floor(filled * CERTAIN + 0.5), SILENT).astype(np.uint8)


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file of numpy by name; that of an npy has none."""
    try:
        data = read_bounded(path, _MOST_BYTES)
        if path.suffix.lower() == ".npz":
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                if sum(item.file_size for item in archive.infolist()) > _MOST_BYTES:
                    raise ImageError(f"{path.name} unpacks to more than {_MOST_BYTES} bytes: cut the picture first")
            loaded = np.load(io.BytesIO(data), allow_pickle=False)
            return {name: loaded[name] for name in loaded.files}
        return {"": np.load(io.BytesIO(data), allow_pickle=False)}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, ImageError):
            raise
        raise ImageError(
            f"{path.name} is no array that can be read ({one_line(str(error))[:120]}): save it anew"
        ) from error


def _of_array(path: Path, legend: Legend, strange: Strange) -> Segmentation:
    arrays = _arrays(path)
    named_planes = all(array.ndim == 2 for array in arrays.values()) and len({a.shape for a in arrays.values()}) == 1
    if legend.bands and path.suffix.lower() == ".npz" and named_planes:
        return _of_probabilities(path, np.stack(list(arrays.values())), list(arrays), legend)
    if len(arrays) != 1:
        raise ImageError(
            f"{path.name} holds {named(list(arrays), 'array')}: one of values, or 2D ones that [bands] name"
        )
    (array,) = arrays.values()
    if legend.bands:
        if array.ndim != 3:
            raise ImageError(f"{path.name} has shape {array.shape}, chances (classes, rows, columns)")
        if array.shape[2] < min(array.shape[:2]):  # (rows, columns, classes): no picture is that narrow
            raise ImageError(
                f"{path.name} has its shortest axis last: chances are read as (classes, rows, columns), transpose them "
                "(numpy.moveaxis(chances, -1, 0))"
            )
        return _of_probabilities(path, array, [""] * len(array), legend)
    if array.ndim != 2:
        raise ImageError(f"{path.name} has shape {array.shape}, a mask (rows, columns)")
    return _of_values(path, array, legend, strange)


def read_coco(path: Path, legend: Legend) -> Iterator[tuple[str, Segmentation]]:
    """Yield name and segmentation of each picture of a COCO file; classes are there where a mask of theirs is.

    Masks are run lengths (RLE), as lists or compressed texts. Polygons are refused: programs turn them into unlike
    pixels. Where no mask is, all classes of the legend are absent; categories that it does not name count as nothing.
    Raise `ImageError` if the file is damaged, names no picture, or a mask does not fit its picture.
    """
    if not legend.categories:
        raise ImageError(f"{path.name} is a COCO file: the legend names its [categories]")
    try:
        found = parse_json(read_bounded(path, _MOST_BYTES))
        categories = {int(item["id"]): str(item["name"]) for item in found["categories"]}
        pictures = {
            int(item["id"]): (str(item["file_name"]), int(item["height"]), int(item["width"]))
            for item in found["images"]
        }
        masks: dict[int, list[tuple[str, Any]]] = {number: [] for number in pictures}
        for item in found["annotations"]:
            masks[int(item["image_id"])].append((categories[int(item["category_id"])], item["segmentation"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ImageError(
            f"{path.name} is no sound COCO file ({one_line(repr(error))[:120]}): export it anew"
        ) from error
    missing = [name for name in legend.categories if name not in categories.values()]
    if missing:
        raise ImageError(f"{path.name} has no {named(missing, 'category')}: it has {', '.join(categories.values())}")
    for number, (name, rows, cols) in pictures.items():
        if rows < 1 or cols < 1 or rows * cols > MOST_PIXELS:
            raise ImageError(f"{path.name}: {plain(name)} has {cols} x {rows} pixels")
        planes = np.zeros((len(legend.classes), rows, cols), dtype=np.uint8)
        for category, mask in masks[number]:
            if category in legend.categories:
                here = _decoded(path, plain(name), mask, (rows, cols))
                column = legend.column(legend.categories[category])
                planes[:, here] = np.maximum(planes[:, here], column[:, None])
        yield name, Segmentation(classes=legend.classes, probability_bytes=planes)


def _decoded(path: Path, name: str, mask: object, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask in run lengths, down the columns, beginning with what is absent."""
    if isinstance(mask, list):
        raise ImageError(f"{path.name}: {name} has polygons, which programs draw unlike: export run lengths (RLE)")
    try:
        counts, size = mask["counts"], tuple(mask["size"])  # type: ignore[index]
        runs = np.array(run_lengths(counts) if isinstance(counts, str) else counts, dtype=np.int64)
        if size != shape or runs.ndim != 1 or (runs < 0).any() or runs.sum() != shape[0] * shape[1]:
            raise ValueError(f"runs of {int(runs.sum())} pixels in a mask of {size}")  # noqa: TRY301
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        why = one_line(str(error))[:120]
        raise ImageError(f"{path.name}: a mask of {name} does not fit {shape[0]} x {shape[1]} ({why})") from error
    is_there = np.arange(len(runs)) % 2 == 1
    return np.repeat(is_there, runs).reshape(shape, order="F")


def run_lengths(text: str) -> list[int]:
    """Return the run lengths of COCO's compressed text; raise `ValueError` if it ends within a number.

    Each number is in groups of five bits, the lowest first, in letters from "0" on; from the fourth on it is the
    difference to the number two before it (cocodataset.org, maskApi.c).

    >>> run_lengths("52203")
    [5, 2, 2, 2, 5]
    """
    found: list[int] = []
    at = 0
    while at < len(text):
        value, bits = 0, 0
        while True:
            if at == len(text):
                raise ValueError("the text ends within a number")
            group = ord(text[at]) - 48
            at += 1
            if not 0 <= group < 64 or bits > 60:
                raise ValueError(f"{text[at - 1]!r} is no letter of run lengths")
            value |= (group & 0x1F) << bits
            bits += 5
            if not group & 0x20:
                if group & 0x10:
                    value |= -1 << bits
                break
        found.append(value + found[-2] if len(found) > 2 else value)
    return found
