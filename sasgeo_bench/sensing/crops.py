# SPDX-License-Identifier: Apache-2.0
"""Crops to teach a network with: pictures, drawn or real, each with the map's layers at its pose.

An author's own training loop takes them one by one; nothing is written to disk. Labels are maps: what a map lacks is
labelled absent, and what lies beyond it, or beyond the picture, unknown.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, ImageryError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, LayerBits, cell_offsets_m, observe
from sasgeo_bench.regions.imagery import Bounds, ImageryWindow
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sensing.rendering.sheet import Sheet, make_sheet
from sasgeo_bench.sensing.rendering.wild import Ingredients, draw_picture

_OPEN: Final = 20  # windows that crops are taken from in turn: fewer, where they are large
_MOST_CELLS: Final = 24_000_000  # of all of them, 12 bytes each
_DRAWN: Final = 40  # crops of one window, on average; each has a look of its own
_CUT: Final = 10  # of one window of a picture
_WINDOW: Final = 4  # sides of a crop in one of a window
_LEAST_SIDE_PX: Final = 16
_MOST_SIDE_PX: Final = 2048
_MOST_ZOOM: Final = 2.0
_MOST_TRIES: Final = 300  # poses in turn that show too little mapped ground
_AROUND: Final = 0.6  # share of windows around something that is mapped
_LEAST_KNOWN: Final = 0.5  # of a crop
_MARGIN_M: Final = 60.0  # around a window: what stands there has yards and shadows in it


@dataclass(frozen=True, slots=True, kw_only=True)
class Crop:
    """One picture with its labels.

    `rgb` is uint8 of shape (H, W, 3), up is the heading of `pose`; `labels`, uint8 of shape (C, H, W), holds ABSENT,
    PRESENT or UNKNOWN for each of `classes`; a pixel is `pixel_m` wide on the ground. `region` is the id of the place,
    `pose` the middle of the crop in its CRS.
    """

    rgb: NDArray[np.uint8]
    classes: tuple[str, ...]
    labels: NDArray[np.uint8]
    pixel_m: float
    region: str
    pose: Pose


def drawn_crops(
    regions: Sequence[Region],
    *,
    seed: int,
    side_px: int = 256,
    pixel_m: float = 0.5,
    zoom: float = 1.25,
    ingredients: Ingredients | None = None,
) -> Iterator[Crop]:
    """Draw crops of maps without end, each at any place, heading and scale, in a look of its own.

    Parameters
    ----------
    regions : sequence of Region
        Places with features; each is met equally often.
    seed : int
        Not negative. The same seed gives the same crops; poses do not depend on `ingredients`.
    side_px : int
        Side of a crop, pixels.
    pixel_m : float
        Width of a pixel on the ground, metres.
    zoom : float
        Crops have pixels of `pixel_m / zoom` to `pixel_m * zoom`, 1 to 2.
    ingredients : Ingredients, optional
        What is drawn; all by default.

    Yields
    ------
    Crop
        Without end: take as many as are needed.

    Raises
    ------
    ConfigError
        If there is no region, or a setting is out of range.

    Examples
    --------
    Pairs for a loss that leaves unknown ground out; here for buildings, of a town without any data:

    >>> from itertools import islice
    >>> import sasgeo_bench as sgb
    >>> def pairs(regions):  # doctest: +SKIP
    ...     for crop in sgb.drawn_crops(regions, seed=1):
    ...         truth = crop.labels[crop.classes.index("building")]
    ...         yield crop.rgb, truth == sgb.PRESENT, truth != sgb.UNKNOWN
    """
    shape = _Shape(seed=seed, side_px=side_px, pixel_m=pixel_m, zoom=zoom)
    look = ingredients or Ingredients()
    return _crops([_Map(region, shape, look) for region in _some(regions)], shape, each=_DRAWN)


def real_crops(
    regions: Sequence[Region],
    *,
    seed: int,
    side_px: int = 256,
    pixel_m: float = 0.5,
    zoom: float = 1.25,
    bounds_m: Bounds | None = None,
) -> Iterator[Crop]:
    """Cut crops out of the aerial pictures of regions without end, at any place, heading and scale.

    The measured offset of a picture against its map is taken off, where it is known.

    Parameters
    ----------
    regions : sequence of Region
        Places with imagery; each is met equally often.
    seed : int
        Not negative. The same seed gives the same crops.
    side_px, pixel_m, zoom
        As those of `drawn_crops`. Finer pictures are averaged to `pixel_m`; coarser ones show no more than they have.
    bounds_m : tuple of float, optional
        West, south, east, north in the CRS of the region, metres: crops lie within, to the last pixel, so that the
        rest can be kept back. For a single region.

    Yields
    ------
    Crop
        Without end.

    Raises
    ------
    ConfigError
        If there is no region, one has no imagery or a rendered one, or a setting is out of range.
    ImageryError
        If no crop that shows enough mapped ground is found.
    """
    shape = _Shape(seed=seed, side_px=side_px, pixel_m=pixel_m, zoom=zoom)
    if bounds_m is not None and len(regions) != 1:
        raise ConfigError(f"bounds_m is of one region, got {len(regions)} regions: make an iterator for each")
    return _crops([_Picture(region, shape, bounds_m) for region in _some(regions)], shape, each=_CUT)


def _some(regions: Sequence[Region]) -> Sequence[Region]:
    if not regions:
        raise ConfigError("crops are taken from at least one region, got none")
    return regions


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shape:
    """Size and scale of crops, and their seed."""

    seed: int
    side_px: int
    pixel_m: float
    zoom: float

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed!r}")
        if not _LEAST_SIDE_PX <= self.side_px <= _MOST_SIDE_PX:
            raise ConfigError(f"side_px must lie within {_LEAST_SIDE_PX} to {_MOST_SIDE_PX}, got {self.side_px!r}")
        if not (math.isfinite(self.pixel_m) and self.pixel_m > 0):
            raise ConfigError(f"pixel_m must be positive and finite, got {self.pixel_m!r}")
        if not 1 <= self.zoom <= _MOST_ZOOM:
            raise ConfigError(f"zoom must lie within 1 to {_MOST_ZOOM:g}, got {self.zoom!r}")

    @property
    def reach_m(self) -> float:
        """Return how far the corners of the widest crop are from its middle, metres."""
        return self.side_px * self.pixel_m * self.zoom / math.sqrt(2)

    @property
    def most_open(self) -> int:
        """Return how many windows are open at a time, at most."""
        return max(2, min(_OPEN, _MOST_CELLS // (_WINDOW * self.side_px) ** 2))

    @property
    def window_m(self) -> float:
        """Return the side of the windows that crops are taken from, metres."""
        return _WINDOW * self.side_px * self.pixel_m


class _Source(Protocol):
    """A place that crops are taken from, window by window."""

    def open(self, rng: np.random.Generator) -> "_Window":
        """Return a window at any place."""


class _Window(Protocol):
    """A part of a place, ready for many crops; their middles lie within `span_m` (west, south, east, north)."""

    @property
    def region(self) -> str: ...

    @property
    def classes(self) -> tuple[str, ...]: ...

    @property
    def span_m(self) -> Bounds: ...

    def labels(self, pose: Pose, side_px: int, pixel_m: float) -> NDArray[np.uint8]:
        """Return what the map, and the picture, say of a crop."""

    def rgb(self, pose: Pose, side_px: int, pixel_m: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the picture of a crop."""


def _crops(sources: Sequence[_Source], shape: _Shape, *, each: int) -> Iterator[Crop]:
    """Yield crops of a few windows in turn, one of which is closed and another opened now and then."""
    # Poses have a generator of their own, so that they are the same in any look.
    poses = np.random.default_rng((shape.seed, 0))
    windows: list[_Window] = []
    opened = 0
    for number in itertools.count():
        for attempt in range(_MOST_TRIES):
            is_new = len(windows) < shape.most_open or attempt % _OPEN == _OPEN - 1
            if is_new or poses.random() < 1 / each:
                window = sources[opened % len(sources)].open(poses)
                opened += 1
                if len(windows) == shape.most_open:
                    del windows[int(poses.integers(shape.most_open))]
                windows.append(window)
            else:
                window = windows[int(poses.integers(len(windows)))]
            west, south, east, north = window.span_m
            pixel_m = shape.pixel_m * shape.zoom ** poses.uniform(-1, 1)
            pose = Pose(
                easting_m=poses.uniform(west, east),
                northing_m=poses.uniform(south, north),
                yaw_deg=poses.uniform(0, 360),
            )
            labels = window.labels(pose, shape.side_px, pixel_m)
            if np.mean(labels[0] != UNKNOWN) >= _LEAST_KNOWN:
                break
        else:
            raise ImageryError(
                f"{_MOST_TRIES} crops in turn show too little mapped ground, with {shape.side_px} pixels of "
                f"{shape.pixel_m:g} m: take smaller ones, or another region"
            )
        looks = np.random.default_rng((shape.seed, 1, number))
        rgb = window.rgb(pose, shape.side_px, pixel_m, looks)
        yield Crop(rgb=rgb, classes=window.classes, labels=labels, pixel_m=pixel_m, region=window.region, pose=pose)


def _spread(bounds_m: Bounds, reach_m: float) -> Bounds:
    """Return where the middles of crops may lie that do not leave a box; its middle, if it is too small for one."""
    west, south, east, north = bounds_m
    across, along = min(reach_m, (east - west) / 2), min(reach_m, (north - south) / 2)
    return (west + across, south + along, east - across, north - along)


def _window(bounds_m: Bounds, at_m: tuple[float, float], shape: _Shape, epsg: int) -> Grid:
    """Return a window around a place, moved and cut so that it lies within a box."""
    half = shape.window_m / 2
    west, south, east, north = _spread(bounds_m, half)
    east_m, north_m = min(max(at_m[0], west), east), min(max(at_m[1], south), north)
    size_m = (min(2 * half, bounds_m[2] - bounds_m[0]), min(2 * half, bounds_m[3] - bounds_m[1]))
    return Grid.around(east_m, north_m, size_m=size_m, cell_size_m=shape.pixel_m, epsg=epsg)


class _Map:
    """The map of a region, to draw pictures of."""

    def __init__(self, region: Region, shape: _Shape, look: Ingredients) -> None:
        self._region, self._shape, self._look = region, shape, look
        self._box_m = region.features.bounds.to_numpy(dtype=np.float64)

    def open(self, rng: np.random.Generator) -> "_Drawn":
        region, bounds_m = self._region, self._region.grid.bounds_m
        at_m = (rng.uniform(bounds_m[0], bounds_m[2]), rng.uniform(bounds_m[1], bounds_m[3]))
        if len(self._box_m) and rng.random() < _AROUND:  # most of a country is fields
            west, south, east, north = self._box_m[rng.integers(len(self._box_m))]
            at_m = ((west + east) / 2, (south + north) / 2)
        window = _window(bounds_m, at_m, self._shape, region.grid.epsg)
        west, south, east, north = window.bounds_m
        near = (self._box_m[:, 0] < east + _MARGIN_M) & (self._box_m[:, 2] > west - _MARGIN_M)
        near &= (self._box_m[:, 1] < north + _MARGIN_M) & (self._box_m[:, 3] > south - _MARGIN_M)
        sheet = make_sheet(region.features[near], region.classes, region.coverage, window)
        return _Drawn(
            region.manifest.id, region.classes, _spread(window.bounds_m, self._shape.reach_m), sheet, self._look
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    region: str
    classes: tuple[str, ...]
    span_m: Bounds
    sheet: Sheet
    look: Ingredients

    def labels(self, pose: Pose, side_px: int, pixel_m: float) -> NDArray[np.uint8]:
        return observe(self.sheet.bits, self.sheet.grid, pose, size_cells=side_px, cell_size_m=pixel_m)

    def rgb(self, pose: Pose, side_px: int, pixel_m: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        return draw_picture(self.sheet, pose, side_px=side_px, pixel_m=pixel_m, ingredients=self.look, rng=rng)


class _Picture:
    """The imagery of a region with its map."""

    def __init__(self, region: Region, shape: _Shape, bounds_m: Bounds | None) -> None:
        if region.imagery is None or region.imagery.record.is_rendered:
            raise ConfigError(f"{region.manifest.id} has no real imagery: build it with imagery, or take drawn_crops")
        self._region, self._shape, self._imagery = region, shape, region.imagery
        self._paint = make_paint(region.features, region.classes, region.coverage)
        self._off_m = self._imagery.off_m
        west, south, east, north = self._imagery.record.bounds_m
        shown = (west - self._off_m[0], south - self._off_m[1], east - self._off_m[0], north - self._off_m[1])
        self._within_m = _common(_common(shown, region.grid.bounds_m), bounds_m or shown)
        sides = (self._within_m[2] - self._within_m[0], self._within_m[3] - self._within_m[1])
        if min(sides) < 2 * shape.reach_m:
            raise ConfigError(
                f"crops of {shape.side_px} pixels reach {2 * shape.reach_m:.0f} m, {region.manifest.id} shows "
                f"{sides[0]:.0f} x {sides[1]:.0f} m of the map within the bounds: take smaller crops or wider bounds"
            )

    def open(self, rng: np.random.Generator) -> "_Photograph":
        region, (west, south, east, north) = self._region, self._within_m
        at_m = (rng.uniform(west, east), rng.uniform(south, north))
        window = _window(self._within_m, at_m, self._shape, region.grid.epsg)
        bounds_m = _common(window.bounds_m, self._within_m)
        right, up = self._off_m
        picture = self._imagery.read(
            (bounds_m[0] + right, bounds_m[1] + up, bounds_m[2] + right, bounds_m[3] + up),
            gsd_m=max(self._imagery.record.gsd_m, self._shape.pixel_m / self._shape.zoom),
        )
        bits = LayerBits.of(burn_layers(self._paint, window))
        span_m = _spread(bounds_m, self._shape.reach_m)
        return _Photograph(region.manifest.id, region.classes, span_m, window, bits, picture, self._off_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Photograph:
    region: str
    classes: tuple[str, ...]
    span_m: Bounds
    grid: Grid
    bits: LayerBits
    picture: ImageryWindow
    off_m: tuple[float, float]

    def labels(self, pose: Pose, side_px: int, pixel_m: float) -> NDArray[np.uint8]:
        labels = observe(self.bits, self.grid, pose, size_cells=side_px, cell_size_m=pixel_m)
        u, v = self._pixels(pose, side_px, pixel_m)
        known = cv2.remap(self.picture.is_known.astype(np.uint8), u, v, cv2.INTER_NEAREST)
        labels[:, known == 0] = UNKNOWN
        return labels

    def rgb(self, pose: Pose, side_px: int, pixel_m: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        del rng  # nothing is drawn
        return np.asarray(cv2.remap(self.picture.rgb, *self._pixels(pose, side_px, pixel_m), cv2.INTER_LINEAR))

    def _pixels(self, pose: Pose, side_px: int, pixel_m: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the pixels of the picture under those of a crop, in OpenCV's frame."""
        uv = self.picture.grid.to_uv(pose.to_map(cell_offsets_m((side_px, side_px), pixel_m)) + self.off_m)
        u, v = (uv - 0.5).T.reshape(2, side_px, side_px).astype(np.float32)
        return u, v


def _common(first: Bounds, second: Bounds) -> Bounds:
    return (
        max(first[0], second[0]),
        max(first[1], second[1]),
        min(first[2], second[2]),
        min(first[3], second[3]),
    )
