# SPDX-License-Identifier: Apache-2.0
"""Burn features into one raster per class, by the cell-centre rule; read and write `layers.tif` window by window."""

import itertools
import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar
from xml.etree import ElementTree as ET

import numpy as np
import pyarrow as pa
import rasterio
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import RasterioError
from rasterio.windows import Window
from tifffile import TiffFile, TiffPage, TiffWriter

from sasgeo_bench.core.errors import ImageryError, SasgeoError, StoreError
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE

if TYPE_CHECKING:
    import geopandas as gpd

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

    `note` is what the user should know of the choice; empty where there was none.
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
            f"colours); {colours.fault or 'its bands are ' + ', '.join(item.name for item in source.colorinterp[:8])}"
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
    bands = _each_once([item.name if item in _COLOURS else "" for item in interpretation])
    if bands:
        called = [(words[band - 1], item.name) for band, item in zip(bands, _COLOURS, strict=True)]
        if all(word in ("", colour) for word, colour in called) and named in (None, bands):
            return _Colours(bands)
        by_names = f"{named or listed} by their names"
        return _Colours(fault=f"red, green and blue are {bands} by their colour interpretation, {by_names}")
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


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Shapes = NDArray[np.object_]

PLANE: Final = 2
RING_CORNERS: Final = 5  # of a closed rectangle
TRIANGLE: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Bends:
    """Bends of lines."""

    en_m: Floats  # shape (N, 2): place on the line, metres
    line: Ints  # shape (N,): number of the line
    at_m: Floats  # shape (N,): distance along it, metres
    inward: Floats  # shape (N, 2): direction of the bisector of the two arms, towards the inside; any length


def find_bends(
    en_m: Floats, at_m: Floats, first: Ints, *, step_m: float, smoothing_m: float, window_m: float, turn_deg: float
) -> Bends:
    """Find where lines turn most, at most once within half a window; lines shorter than the window have no bend.

    `en_m` and `at_m`, shapes (P, 2) and (P,), are the vertices of all lines, one line after the other, and the distance
    of each along its line; `first`, shape (L + 1,), is the row where each line begins, and P. `step_m` is the spacing
    of the samples, `smoothing_m` the length of the moving average, `window_m` the length within which a bend turns by
    `turn_deg`.

    >>> corner = np.array([[0.0, 0.0], [200.0, 0.0], [200.0, 200.0]])
    >>> rules = {"step_m": 10.0, "smoothing_m": 60.0, "window_m": 120.0, "turn_deg": 45.0}
    >>> find_bends(corner, np.array([0.0, 200.0, 400.0]), np.array([0, 3]), **rules).en_m.tolist()
    [[200.0, 0.0]]
    """
    length_m = at_m[first[1:] - 1]
    chosen = np.flatnonzero(length_m >= window_m)
    if not len(chosen):
        none = np.empty((0, PLANE))
        return Bends(en_m=none, line=chosen, at_m=none[:, 0], inward=none)
    # Equal steps, so that a line read backwards has the same samples.
    steps = np.maximum(np.rint(length_m[chosen] / step_m).astype(np.int64), 1)
    line = np.repeat(chosen, steps + 1)
    start = np.repeat(np.cumsum(steps + 1) - steps - 1, steps + 1)
    last = start + np.repeat(steps, steps + 1)
    row = np.arange(len(line))
    sample_m = (row - start) * np.repeat(length_m[chosen] / steps, steps + 1)
    # One axis for all lines: each begins a metre after the end of the one before.
    shift_m = np.cumsum(length_m + 1.0) - length_m
    axis_m = at_m + np.repeat(shift_m, np.diff(first))
    place = np.column_stack([np.interp(sample_m + shift_m[line], axis_m, part) for part in en_m.T]).reshape(-1, PLANE)

    reach = round(smoothing_m / step_m / 2)
    near = np.clip(row[:, None] + np.arange(-reach, reach + 1), start[:, None], last[:, None])
    smooth = (place[near] - place[:, None]).mean(axis=1) + place
    ahead = smooth[np.minimum(row + 1, last)] - smooth
    behind = smooth - smooth[np.maximum(row - 1, start)]
    turn = np.arctan2(behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0], (behind * ahead).sum(axis=1))

    reach = round(window_m / step_m / 2)
    offset = np.arange(-reach, reach + 1)
    near = row[:, None] + offset
    is_on_line = (near >= start[:, None]) & (near <= last[:, None])
    near = np.clip(near, start[:, None], last[:, None])
    turns = np.where(is_on_line, turn[near], 0.0)
    # A sharp corner turns the same in every window that holds it; the weights draw the peak to its middle.
    # Rounded, so that the first of two equal samples is the peak in spite of rounding errors.
    score = np.abs(turns @ (1.0 - np.abs(offset) / (reach + 1))).round(6)
    rivals = np.where(is_on_line, score[near], -1.0)
    is_peak = (rivals.argmax(axis=1) == reach) & (np.abs(turns.sum(axis=1)) >= np.radians(turn_deg))
    peak = np.flatnonzero(is_peak)
    arms = smooth[near[peak][:, [0, -1]]] - smooth[peak, None]
    inward = (arms / np.maximum(np.linalg.norm(arms, axis=2, keepdims=True), np.finfo(float).tiny)).sum(axis=1)
    return Bends(en_m=place[peak], line=line[peak], at_m=sample_m[peak], inward=inward)


def centroids(shapes: Shapes) -> Floats:
    """Return the centroid of each shape, shape (N, 2), metres; it need not lie inside."""
    centre = shapely.centroid(shapes)
    return np.column_stack([shapely.get_x(centre), shapely.get_y(centre)])


def long_sides(shapes: Shapes) -> Floats:
    """Return the vector along the long side of each minimum rotated rectangle, shape (N, 2), metres; or NaN."""
    boxes = np.asarray(shapely.oriented_envelope(shapes), dtype=object)
    found = np.flatnonzero(shapely.get_num_coordinates(boxes) == RING_CORNERS)
    sides = np.full((len(boxes), PLANE), np.nan)
    corners = shapely.get_coordinates(boxes[found]).reshape(-1, RING_CORNERS, PLANE)
    side = corners[:, 1:3] - corners[:, 0:2]
    sides[found] = side[np.arange(len(found)), np.linalg.norm(side, axis=2).argmax(axis=1)]
    return sides


def groups_within(shapes: Shapes, gap_m: float) -> Ints:
    """Number the groups of shapes, shape (N,): shapes at most `gap_m` from each other share one.

    >>> groups_within(shapely.box([0, 20, 99], 0, [9, 29, 109], 9), 15.0).tolist()
    [0, 0, 1]
    """
    if not len(shapes):
        return np.empty(0, dtype=np.int64)
    left, right = _near_pairs(shapes, gap_m).T
    is_near = shapely.dwithin(shapes[left], shapes[right], gap_m)
    return _components(len(shapes), left[is_near], right[is_near])


def _components(count: int, left: Ints, right: Ints) -> Ints:
    """Number the components of a graph by their first nodes, shape (count,)."""
    # scipy has it as well, and takes a sixth of a second to import
    first, before = np.arange(count), np.empty(0, dtype=np.int64)
    while not np.array_equal(first, before):
        before = first.copy()
        for one, other in ((left, right), (right, left)):
            np.minimum.at(first, first[one], first[other])
        first = first[first]
    return np.asarray(np.unique(first, return_inverse=True)[1], dtype=np.int64)


def touching_pairs(shapes: Shapes) -> Ints:
    """Return rows of shapes that touch or overlap, shape (K, 2), smaller row first.

    >>> touching_pairs(shapely.box([0, 9, 99], 0, [9, 29, 109], 9)).tolist()
    [[0, 1]]
    """
    pairs = _near_pairs(shapes, 0.0)
    shapely.prepare(shapes)
    return np.asarray(pairs[shapely.intersects(shapes[pairs[:, 0]], shapes[pairs[:, 1]])])


def _near_pairs(shapes: Shapes, gap_m: float) -> Ints:
    grown = shapely.box(*(shapely.bounds(shapes) + np.array([-gap_m, -gap_m, gap_m, gap_m])).T)
    pairs = overlapping(grown, shapes).T
    return np.asarray(pairs[pairs[:, 0] < pairs[:, 1]], dtype=np.int64)


def delaunay_pairs(en_m: Floats, longest_m: float) -> Ints:
    """Return Delaunay neighbours no further apart than `longest_m`, shape (K, 2), smaller row first.

    An edge that depends on the choice of the algorithm (a diagonal of four corners on one circle, as among houses on a
    lattice) is left out, so that the pairs turn with the places.

    >>> delaunay_pairs(np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]), 60.0).tolist()
    [[0, 1], [0, 3], [1, 2], [2, 3]]
    """
    count = len(en_m)
    if count < PLANE:
        return np.empty((0, PLANE), dtype=np.int64)
    centred = en_m - en_m.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if count < TRIANGLE or spread[1] <= 1e-9 * spread[0]:
        order = np.argsort(centred @ axes[0], kind="stable")  # all on one line: each next to the next
        pairs = np.sort(np.column_stack([order[:-1], order[1:]]), axis=1)
    else:
        pairs = _strict_pairs(centred)
    length_m = np.linalg.norm(en_m[pairs[:, 0]] - en_m[pairs[:, 1]], axis=1)
    pairs = pairs[length_m <= longest_m]
    return np.asarray(pairs[np.lexsort([pairs[:, 1], pairs[:, 0]])], dtype=np.int64)


def _strict_pairs(en_m: Floats) -> Ints:
    """Return edges of the triangulation whose two opposite angles sum to less than a half turn."""
    corners = _triangles(en_m)
    tip = corners.ravel()
    base = np.sort(np.stack([np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)], axis=2).reshape(-1, PLANE))
    arms = en_m[base] - en_m[tip][:, None]
    twice_area = np.abs(arms[:, 0, 0] * arms[:, 1, 1] - arms[:, 0, 1] * arms[:, 1, 0])
    with np.errstate(over="ignore"):  # the cotangent of a flat corner is infinite
        cotangent = (arms[:, 0] * arms[:, 1]).sum(axis=1) / np.maximum(twice_area, np.finfo(float).tiny)
    _, first, edge, uses = np.unique(
        base[:, 0] * len(en_m) + base[:, 1], return_index=True, return_inverse=True, return_counts=True
    )
    is_hull = uses == 1
    is_strict = np.bincount(edge, weights=cotangent) > 1e-6  # sum of two cotangents that counts as 0, dimensionless
    return np.asarray(base[first][is_hull | is_strict])


def _triangles(en_m: Floats) -> Ints:
    """Return the rows of the corners of the Delaunay triangles, shape (T, 3)."""
    places, row = np.unique(en_m, axis=0, return_index=True)
    if len(places) < len(en_m):
        # Of several at one place a corner is one, which Qhull names: most maps have none, and need not wait for scipy
        from scipy.spatial import Delaunay  # noqa: PLC0415 - as above

        return np.asarray(Delaunay(en_m).simplices, dtype=np.int64)
    triangles = shapely.get_parts(shapely.delaunay_triangles(shapely.multipoints(places)))
    corners = shapely.get_coordinates(triangles).reshape(-1, TRIANGLE + 1, PLANE)[:, :TRIANGLE]
    kind = [("east", np.float64), ("north", np.float64)]
    order = np.searchsorted(places.view(kind)[:, 0], np.ascontiguousarray(corners).view(kind)[..., 0])
    return np.asarray(row[order], dtype=np.int64)


PRESENT: Final = 1
OUTSIDE: Final = 255  # unknown: beyond the mapped area

_NO_AREAS: Final = np.array([], dtype=object)


@dataclass(frozen=True, kw_only=True)
class Paint:
    """The polygons to burn: for each class, in band order, with the outer ring counter-clockwise.

    `above` holds those of a class that nothing covers, because they are on a bridge; they are among `areas` too.
    """

    classes: tuple[str, ...]
    areas: tuple[NDArray[np.object_], ...]
    coverage: NDArray[np.object_]
    above: Mapping[str, NDArray[np.object_]] = field(default_factory=dict)

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], ...]:
        """Return west, south, east, north of every polygon, shape (N, 4) for each class."""
        return tuple(shapely.bounds(areas).reshape(-1, 4) for areas in self.areas)

    def near(self, index: int, grid: Grid) -> NDArray[np.object_]:
        """Return the polygons of a class that may reach into a window."""
        return self.areas[index][_meets(self.bounds[index], grid)]

    @cached_property
    def ground(self) -> NDArray[np.object_]:
        """Return the mapped area, prepared: whether it meets a window is asked thousands of times."""
        shapely.prepare(self.coverage)
        return self.coverage


def make_paint(
    features: "gpd.GeoDataFrame", classes: tuple[str, ...], coverage: shapely.Geometry, *, least_width_m: float = 0.0
) -> Paint:
    """Turn visible features into polygons for `burn_layers`: lines are buffered to their width, areas stay as they are.

    `classes` gives the band order, `coverage` the mapped area in the CRS of the features. For overviews with large
    cells, lines are at least `least_width_m` wide, so that they do not break, and simplified to an eighth of it.
    """
    seen = features[features["is_visible"].to_numpy()]
    shape = seen.geometry.to_numpy().copy()
    width_m = seen["width_m"].to_numpy(dtype=np.float64)
    is_line = ~np.isnan(width_m)
    half_m = np.maximum(width_m[is_line], least_width_m) / 2
    is_coarse = least_width_m > 0
    lines = shapely.simplify(shape[is_line], least_width_m / 8) if is_coarse else shape[is_line]
    # 2 arc segments per quarter circle at line ends and bends: 3 % of the radius, a few centimetres on a road
    shape[is_line] = shapely.buffer(lines, half_m, quad_segs=1 if is_coarse else 2)
    names, on_bridge = seen["class"].to_numpy(), seen["is_bridge"].to_numpy()
    return Paint(
        classes=classes,
        areas=tuple(_oriented(shape[names == name]) for name in classes),
        coverage=_oriented(np.array([coverage], dtype=object)),
        above={name: _oriented(shape[on_bridge & (names == name)]) for name in load_taxonomy().covers},
    )


def _oriented(areas: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return single polygons, outer rings counter-clockwise, holes clockwise: crossings are summed by sign."""
    parts = shapely.get_parts(areas)
    return np.asarray(shapely.orient_polygons(parts[~shapely.is_empty(parts)], exterior_cw=False))


def burn_layers(paint: Paint, grid: Grid) -> NDArray[np.uint8]:
    """Burn every class on a grid in the CRS of the polygons: PRESENT, ABSENT, or OUTSIDE beyond the mapped area.

    The result is uint8 of shape (C, rows, cols); a class is absent where another one covers it (`burn_class`). A window
    of the region's grid gives exactly that window of the whole.

    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=4.0, cell_size_m=1.0, rows=4, cols=4)
    >>> house = np.array([shapely.box(1, 1, 3, 3)])
    >>> land = np.array([shapely.box(0, 0, 3, 4)])
    >>> burn_layers(Paint(classes=("building",), areas=(house,), coverage=land), grid)[0]
    array([[  0,   0,   0, 255],
           [  0,   1,   1, 255],
           [  0,   1,   1, 255],
           [  0,   0,   0, 255]], dtype=uint8)
    """
    layers = np.empty((len(paint.classes), *grid.shape), dtype=np.uint8)
    for band, burnt in zip(layers, _burn_bands(paint, grid), strict=True):
        band[...] = burnt
    return layers


def _burn_bands(paint: Paint, grid: Grid) -> Iterator[NDArray[np.uint8]]:
    """Burn one class after the other; those of which none is near share one array, and most are such."""
    ground = np.zeros(grid.shape, dtype=np.uint8)
    if not shapely.covers(paint.ground, shapely.box(*grid.bounds_m)).any():
        ground[~burn(paint.coverage, grid)] = OUTSIDE
    for index in range(len(paint.classes)):
        seen = burn_class(paint, index, grid)
        yield ground if seen is None else np.maximum(ground, seen.view(np.uint8))


def burn_class(paint: Paint, index: int, grid: Grid) -> NDArray[np.bool_] | None:
    """Burn one class as it is seen from above, mapped or not; None where none of it is near.

    What another class covers is left out (`covered_by` in the taxonomy), if that one is among the classes: a stream is
    seen up to the lake that it enters, and an aqueduct over it.

    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=1.0, cell_size_m=1.0, rows=1, cols=5)
    >>> stream, lake = np.array([shapely.box(0, 0, 5, 1)]), np.array([shapely.box(2, 0, 5, 1)])
    >>> paint = Paint(classes=("water", "waterway"), areas=(lake, stream), coverage=stream)
    >>> burn_class(paint, 1, grid).astype(int)
    array([[1, 1, 0, 0, 0]])
    """
    near = paint.near(index, grid)
    if not len(near):
        return None
    name = paint.classes[index]
    seen, cover = burn(near, grid), load_taxonomy().covers.get(name)
    if cover in paint.classes:
        covered = burn(paint.near(paint.classes.index(cover), grid), grid)
        above = paint.above.get(name, _NO_AREAS)
        seen &= ~(covered & ~burn(above, grid) if len(above) else covered)
    return seen


def burn_mapped(paint: Paint, grid: Grid) -> list[NDArray[np.uint8]] | None:
    """Burn a window as `burn_layers` does, an array for each class; None where nothing of it is mapped."""
    is_mapped = shapely.intersects(paint.ground, shapely.box(*grid.bounds_m)).any()
    return list(_burn_bands(paint, grid)) if is_mapped else None


def _meets(bounds: NDArray[np.float64], grid: Grid) -> NDArray[np.bool_]:
    west, south, east, north = grid.bounds_m
    return (bounds[:, 0] < east) & (bounds[:, 2] > west) & (bounds[:, 1] < north) & (bounds[:, 3] > south)


def burn(areas: NDArray[np.object_], grid: Grid) -> NDArray[np.bool_]:
    """Mark the cells whose centre lies within any polygon: GDAL's rule, for all polygons at once; shape (rows, cols).

    Outer rings are counter-clockwise, holes clockwise (`shapely.orient_polygons`). A centre exactly on an edge belongs
    to the polygon south or east of it.

    Notes
    -----
    Each ring edge crosses the centre lines of some rows; downward crossings count +1, upward ones -1. Sorted along the
    raster, their running sum is the number of polygons that cover a cell, and its runs are written out in one go. The
    cells equal those of `rasterio.features.rasterize`, which spends its time on converting every vertex from Python
    (docs/decisions/0007).

    Examples
    --------
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=3.0, cell_size_m=1.0, rows=3, cols=3)
    >>> burn(np.array([shapely.box(0, 0, 2, 1)]), grid).astype(int)
    array([[0, 0, 0],
           [0, 0, 0],
           [1, 1, 0]])
    """
    row, col, step = _crossings(areas, grid)
    position = row * grid.cols + col
    order = np.argsort(position)  # in which order several at one place come makes no difference
    is_inside = np.cumsum(step[order]) > 0
    edges = np.concatenate(([0], position[order], [grid.rows * grid.cols]))
    runs = np.repeat(np.concatenate(([False], is_inside)), np.diff(edges))
    return np.asarray(runs.reshape(grid.rows, grid.cols))


def _crossings(
    areas: NDArray[np.object_], grid: Grid
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return row, first column at or right of the crossing, and sign, for every edge and every row's centre line."""
    rings = shapely.get_rings(areas)
    points, ring = shapely.get_coordinates(rings, return_index=True)
    northing_m, (_, south_m, _, north_m) = points[:, 1], grid.bounds_m
    lower_m, upper_m = np.minimum(northing_m[:-1], northing_m[1:]), np.maximum(northing_m[:-1], northing_m[1:])
    # Most edges of a sea or a country lie in no row of a window.
    near = np.flatnonzero((ring[1:] == ring[:-1]) & (lower_m < north_m) & (upper_m > south_m))
    start, end = grid.to_uv(points[near]), grid.to_uv(points[near + 1])
    # A row's centre line lies at row + 0.5; an edge crosses those in [upper end, lower end).
    first = np.clip(np.ceil(np.minimum(start[:, 1], end[:, 1]) - 0.5), 0, grid.rows).astype(np.int64)
    last = np.clip(np.ceil(np.maximum(start[:, 1], end[:, 1]) - 0.5), 0, grid.rows).astype(np.int64)
    count = last - first
    is_down = end[:, 1] > start[:, 1]
    # From its upper end, whichever way the ring runs: two parcels round the place on a shared edge alike.
    upper = np.where(is_down[:, None], start, end)
    across = np.where(is_down[:, None], end, start) - upper
    edge = np.repeat(np.arange(len(count)), count)
    row = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count - first, count)
    (u, v), (du, dv) = upper.T, across.T
    crossed_u = u[edge] + (row + 0.5 - v[edge]) * du[edge] / dv[edge]
    col = np.clip(np.ceil(crossed_u - 0.5), 0, grid.cols).astype(np.int64)
    return row, col, np.where(is_down, 1, -1)[edge]


BLOCK_CELLS: Final = 512
WINDOW_CELLS: Final = 1024  # 14 classes of one window take 15 MB, whatever the size of the region
_CACHE_BYTES: Final = 24 * 2**20
_REDUCED, _ZSTD = 1, 50000  # of TIFF: a smaller version, a codec
_COPYRIGHT, _GDAL_METADATA, _GDAL_NODATA = 33432, 42112, 42113  # tags of TIFF
_BIGTIFF_CELLS: Final = 2**31  # compressed, such a file stays far below the 4 GiB that need BigTIFF

In = TypeVar("In")
Out = TypeVar("Out")
Burnt = Iterable[NDArray[np.uint8]]  # an array of shape (rows, cols) for each class
PaintWindow = Callable[[Grid], Burnt | None]  # None where nothing is mapped


def overview_factors(grid: Grid) -> tuple[int, ...]:
    """Return factors of the internal overviews: quartered until the raster fits two blocks."""
    longest = max(grid.rows, grid.cols)
    return tuple(4**level for level in range(1, 10) if longest > 2 * BLOCK_CELLS * 4 ** (level - 1))


def write_layers(
    path: Path,
    grid: Grid,
    classes: tuple[str, ...],
    paint: Callable[[int], PaintWindow],
    *,
    credit: str = ATTRIBUTION,
    licence: str = LICENCE,
    filled: Callable[[int], None] = lambda _factor: None,
) -> None:
    """Write the layer stack of a region, with one band per class; raise `StoreError` if the file cannot be written.

    `paint` takes an overview factor (1 for the map itself) and returns what burns one window: Grid -> uint8 (rows,
    cols) for each class, or None where nothing is mapped. The next level is painted in another thread while one is
    burnt. `filled` is given the factor of each level, the coarsest first, once it can be read.

    A cloud-optimized file holds its overviews before the full raster, smallest first. GDAL's own COG driver writes
    everything twice to get there, and its empty overviews are made by reading the empty raster. Here all levels are
    laid out empty, and each is burnt from the vectors into its place: packed blocks are added at the end of the file,
    and where they lie is noted last. So memory and time are those of one pass.
    """
    factors = overview_factors(grid)
    try:
        _lay_out(path, grid, classes, factors, {"attribution": credit, "licence": licence})
        with TiffFile(path, mode="r+") as file, ThreadPoolExecutor(1) as painting, ThreadPoolExecutor(1) as packing:
            levels = list(zip((1, *factors), (page.aspage() for page in file.pages), strict=True))[::-1]
            painters = _in_turn(painting, paint, (factor for factor, _ in levels))
            for (factor, page), burn_window in zip(levels, painters, strict=True):
                _fill(page, grid.coarsen(factor), burn_window, packing)
                filled(factor)
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except (RasterioError, OSError) as error:
        raise StoreError(
            f"{path} cannot be written ({error}): check the free space and the rights of its folder"
        ) from error


def _lay_out(
    path: Path, grid: Grid, classes: tuple[str, ...], factors: Sequence[int], terms: Mapping[str, str]
) -> None:
    """Write the headers of all levels, with names and licence; no block is stored yet."""
    is_big = len(classes) * grid.rows * grid.cols > 16 * _BIGTIFF_CELLS
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=grid.rows,
        width=grid.cols,
        count=len(classes),
        dtype="uint8",
        crs=f"EPSG:{grid.epsg}",
        transform=Affine(*grid.transform),
        nodata=OUTSIDE,
        tiled=True,
        blockxsize=BLOCK_CELLS,
        blockysize=BLOCK_CELLS,
        interleave="band",
        compress="zstd",
        sparse_ok=True,
        bigtiff="YES" if is_big else "NO",
    ) as target:
        target.descriptions = classes
        target.update_tags(TIFFTAG_COPYRIGHT=terms["attribution"], **terms)
    with TiffFile(path) as file:
        about = [(tag, "s", 0, file.pages[0].aspage().tags[tag].value, True) for tag in (_COPYRIGHT, _GDAL_METADATA)]
    with TiffWriter(path, append=True) as levels:
        for size in map(grid.coarsen, factors):
            levels.write(
                itertools.repeat(b""),
                shape=(len(classes), size.rows, size.cols),
                dtype="uint8",
                tile=(BLOCK_CELLS, BLOCK_CELLS),
                photometric="minisblack",
                planarconfig="separate" if len(classes) > 1 else None,
                compression="deflate",  # until `_fill` notes its own; no block is packed here
                subfiletype=_REDUCED,
                extratags=[*about, (_GDAL_NODATA, "s", 0, str(OUTSIDE), True)],
                metadata=None,
                software=False,
            )


def _fill(page: TiffPage, grid: Grid, burn_window: PaintWindow, packing: ThreadPoolExecutor) -> None:
    """Burn a window while the one before is packed, which needs no interpreter, and add them to the file in order."""
    # Blocks beyond the mapped area are not stored: one that is missing reads as OUTSIDE, the value of no data.
    down, across = (-(-side // BLOCK_CELLS) for side in grid.shape)
    places = np.zeros((2, len(page.tags["TileOffsets"].value) // (down * across), down, across), np.uint64)
    file = page.parent.filehandle
    end = file.seek(0, os.SEEK_END)
    corners, windows = itertools.tee(grid.windows(WINDOW_CELLS))
    packed = _in_turn(packing, _packed, (burn_window(window) for *_, window in windows))
    for (top, left, _), blocks in zip(corners, packed, strict=True):
        for (band, row, col), block in blocks:
            places[:, band, top // BLOCK_CELLS + row, left // BLOCK_CELLS + col] = end, len(block)
            end += file.write(block)
    for name, values in zip(("TileOffsets", "TileByteCounts"), places, strict=True):
        page.tags[name].overwrite(values.ravel().tolist())
    page.tags["Compression"].overwrite(_ZSTD)
    file.flush()


def _packed(bands: Burnt | None) -> list[tuple[tuple[int, int, int], bytes]]:
    """Pack the blocks of a window that hold mapped ground, each with its band, row and column among the blocks."""
    kept = [] if bands is None else list(bands)
    # An array that several classes share is packed once
    packed = {number: _packed_band(band) for number, band in {id(band): band for band in kept}.items()}
    return [((number, *place), block) for number, band in enumerate(kept) for place, block in packed[id(band)]]


def _packed_band(band: NDArray[np.uint8]) -> list[tuple[tuple[int, int], bytes]]:
    found = []
    for top, left in itertools.product(*(range(0, side, BLOCK_CELLS) for side in band.shape)):
        block = band[top : top + BLOCK_CELLS, left : left + BLOCK_CELLS]
        lowest, highest = int(block.min()), int(block.max())
        if lowest == OUTSIDE:
            continue
        place = (top // BLOCK_CELLS, left // BLOCK_CELLS)
        found.append((place, _packed_plain(lowest) if lowest == highest else _packed_block(block)))
    return found


def _packed_block(block: NDArray[np.uint8]) -> bytes:
    """Pack a block; one that reaches beyond the raster is filled up."""
    whole = np.full((BLOCK_CELLS, BLOCK_CELLS), OUTSIDE, dtype=np.uint8)
    whole[: block.shape[0], : block.shape[1]] = block
    return bytes(pa.Codec("zstd", compression_level=1).compress(whole, asbytes=True))


@cache
def _packed_plain(value: int) -> bytes:
    """Pack a block of one value, which most are: a class is at few places."""
    return _packed_block(np.full((BLOCK_CELLS, BLOCK_CELLS), value, dtype=np.uint8))


def _in_turn(pool: ThreadPoolExecutor, work: Callable[[In], Out], items: Iterable[In]) -> Iterator[Out]:
    """Yield the results of work done in a thread, in the order of the items; the next one is worked on meanwhile."""
    ahead: deque[Future[Out]] = deque()
    for item in items:
        ahead.append(pool.submit(work, item))
        if len(ahead) > 1:
            yield ahead.popleft().result()
    while ahead:
        yield ahead.popleft().result()


PREVIEW_CELLS: Final = 2048  # of `preview.png`, along the longest side


def shown_factor(longest: int, factors: Sequence[int], *, longest_cells: int) -> int:
    """Return the factor of the finest level of which the longer side has at most `longest_cells`, else the coarsest.

    `longest` is the longer side of the map itself, in cells, and `factors` are those of its overviews.

    >>> shown_factor(5000, [4, 16], longest_cells=2048), shown_factor(2000, [4], longest_cells=2048)
    (4, 1)
    """
    levels = (1, *factors)
    return next((factor for factor in levels if longest / factor <= longest_cells), levels[-1])


def read_overview(path: Path, *, longest_cells: int) -> NDArray[np.uint8]:
    """Read the level of a `shown_factor`; shape (C, rows, cols).

    Raise `StoreError` if the file cannot be read.
    """
    try:
        with open_geotiff(path) as source:
            longest, factors = max(source.height, source.width), source.overviews(1)
        chosen = shown_factor(longest, factors, longest_cells=longest_cells)
        if chosen == 1:
            return read_layers(path)
        with open_geotiff(path, overview_level=factors.index(chosen)) as source:
            return np.asarray(source.read(), dtype=np.uint8)
    except (RasterioError, OSError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> StoreError:
    if isinstance(error, StoreError):
        return error
    return StoreError(f"{path} cannot be read ({error}): build the region again")


def read_layers(
    path: Path, *, window: tuple[int, int, int, int] | None = None, bands: Sequence[int] | None = None
) -> NDArray[np.uint8]:
    """Read a layer stack or some bands of it, one window (row, col, rows, cols) or all; (C, rows, cols), read-only.

    Raise `StoreError` if the file cannot be read.
    """
    try:
        with open_geotiff(path) as source:
            part = Window(window[1], window[0], window[3], window[2]) if window else None
            chosen = None if bands is None else [band + 1 for band in bands]
            layers = np.asarray(source.read(chosen, window=part), dtype=np.uint8)
    except (RasterioError, OSError) as error:
        raise _unreadable(path, error) from error
    layers.flags.writeable = False
    return layers


def read_bits(path: Path) -> LayerBits:
    """Read a layer stack as the bits of each cell, in stripes: a third of the memory that the layers would take.

    Raise `StoreError` if the file cannot be read.
    """
    try:
        with (
            rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES),
            open_geotiff(path) as source,
        ):  # no block is read twice
            bits = np.empty(source.shape, dtype=np.uint32)
            for top in range(0, source.height, BLOCK_CELLS):
                stripe = Window(0, top, source.width, min(BLOCK_CELLS, source.height - top))
                bits[top : top + BLOCK_CELLS] = LayerBits.of(np.asarray(source.read(window=stripe))).bits
            count = source.count
    except (RasterioError, OSError) as error:
        raise _unreadable(path, error) from error
    bits.flags.writeable = False
    return LayerBits(bits=bits, count=count)


def cog_faults(path: Path) -> list[str]:
    """List the faults found by a validator of cloud-optimized GeoTIFFs; raise `StoreError` if it cannot be read.

    The validator takes a level that is one block wide for strips: where its blocks are square, they are tiles.
    """
    from rio_cogeo.cogeo import cog_validate  # noqa: PLC0415 - an extra, needed only to write a release

    try:
        with open_geotiff(path):  # the validator would open whatever a file of another format names
            pass
        is_valid, faults, _ = cog_validate(path, quiet=True)
        found = [] if is_valid else list(faults) or ["not valid"]
        return [fault for fault in found if "not tiled" not in fault or not _is_tiled(path)]
    except (RasterioError, OSError) as error:
        raise _unreadable(path, error) from error


def _is_tiled(path: Path) -> bool:
    with open_geotiff(path) as source:
        levels = range(len(source.overviews(1)))
        shapes = {*source.block_shapes}
    for level in levels:
        with open_geotiff(path, overview_level=level) as source:
            shapes |= {*source.block_shapes}
    return all(rows == cols for rows, cols in shapes)
