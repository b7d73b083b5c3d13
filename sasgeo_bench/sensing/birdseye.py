# SPDX-License-Identifier: Apache-2.0
"""Bird's-eye view: from a picture, or the class probabilities of its pixels, to a heading-up lattice on the ground."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CameraError, ShapeError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence, cell_offsets_m
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Dem, Ground
from sasgeo_bench.sensing.segmentation import Segmentation

Planes = NDArray[np.float32]

# Width of the narrowest things of a class, and height of what stands up and hides the ground behind it, metres.
WIDTHS_M: Final[Mapping[str, float]] = MappingProxyType(
    {item.name: item.narrowest_m for item in load_taxonomy().classes}
)
STANDING_M: Final[Mapping[str, float]] = MappingProxyType(
    {item.name: item.standing_m for item in load_taxonomy().classes if item.standing_m}
)

_MOST_CELLS: Final = 4096  # a side of a view
_HALF: Final = 0.5


class Seen(Protocol):
    """Class probabilities of the pixels of a picture, as a `Segmentation` has them."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the classes."""
        ...

    def probabilities(self) -> Planes:
        """Return P(present), shape (C, H, W); NaN where nothing is known."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How pixels are read: thresholds of a probability, what is too narrow to be seen, what hides the ground.

    A cell is present from `present_at` on, absent up to `absent_at`, unknown between. `widths_m` and `standing_m` are
    by class; a class without width is never too narrow, one without height hides nothing.
    """

    present_at: float = 0.5
    absent_at: float = 0.5
    widths_m: Mapping[str, float] = field(default_factory=lambda: WIDTHS_M)
    standing_m: Mapping[str, float] = field(default_factory=lambda: STANDING_M)

    def __post_init__(self) -> None:
        if not 0 <= self.absent_at <= self.present_at <= 1:
            raise CameraError(f"0 <= absent_at <= present_at <= 1, got {self.absent_at!r} and {self.present_at!r}")
        if not all(value >= 0 for value in (*self.widths_m.values(), *self.standing_m.values())):
            raise CameraError(
                f"widths and heights are not negative, got {dict(self.widths_m)!r} and {dict(self.standing_m)!r}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftView:
    """P(present) of each class and cell of a heading-up view, float32 of shape (C, rows, cols), NaN where unknown."""

    classes: tuple[str, ...]
    probabilities: Planes
    cell_size_m: float

    def __post_init__(self) -> None:
        """Check the shape."""
        if self.probabilities.ndim != 3 or len(self.probabilities) != len(self.classes):  # C, rows, cols
            raise ShapeError(f"{len(self.classes)} classes need (C, rows, cols), got shape {self.probabilities.shape}")

    def to_evidence(self, reading: Reading | None = None) -> Evidence:
        """Return present, absent and unknown cells; confidence is 255 * |2 P - 1|, 0 where unknown.

        >>> soft = SoftView(classes=("water",), probabilities=np.array([[[0.9, 0.5, np.nan]]]), cell_size_m=1.0)
        >>> soft.to_evidence(Reading(present_at=0.7, absent_at=0.3)).cells.tolist()
        [[[1, 2, 2]]]
        """
        reading = reading or Reading()
        return Evidence.of_probabilities(
            self.classes,
            self.probabilities,
            cell_size_m=self.cell_size_m,
            present_at=reading.present_at,
            absent_at=reading.absent_at,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class BirdsEye:
    """Where each cell of a heading-up lattice lies in a picture.

    `points_px`, shape (rows, cols, 2), is NaN where the ground is not in the picture or hidden by other ground;
    `gsd_m`, shape (rows, cols), is the ground sampling distance there, in the direction in which it is coarsest.
    `offsets_m`, shape (rows, cols, 2), are (east, north) of the cells from the point beneath the camera.
    """

    points_px: NDArray[np.float64]
    gsd_m: NDArray[np.float64]
    offsets_m: NDArray[np.float64]
    cell_size_m: float
    above_m: float

    @classmethod
    def of(
        cls, camera: Camera, ground: Ground, *, size_cells: int, cell_size_m: float, pose: Pose | None = None
    ) -> Self:
        """Look a lattice up in a picture; its middle lies beneath the camera and its up is the picture's by default.

        `pose` puts it elsewhere. Raise `CameraError` for a lattice that cannot be, or ground without height beneath.
        """
        if not (1 < size_cells <= _MOST_CELLS and math.isfinite(cell_size_m) and cell_size_m > 0):
            raise CameraError(f"a view has 2 to {_MOST_CELLS} cells a side, got {size_cells!r} of {cell_size_m!r} m")
        pose = pose or Pose(easting_m=camera.east_m, northing_m=camera.north_m, yaw_deg=camera.yaw_deg)
        shape = (size_cells, size_cells)
        en_m = pose.to_map(cell_offsets_m(shape, cell_size_m))
        points_m = np.column_stack([en_m, ground.heights_m(en_m)])
        points_px = camera.project(points_m)
        gsd_m = _sampling(points_px.reshape(*shape, 2), cell_size_m)
        unseen = ~camera.intrinsics.contains(points_px)
        if isinstance(ground, Dem):
            unseen |= _is_behind(camera, ground, points_m, points_px, unseen)
        points_px[unseen] = np.nan
        beneath_m = ground.heights_m(camera.position_m[None, :2])[0]
        above_m = camera.height_m - (beneath_m if math.isfinite(beneath_m) else float(np.nanmean(points_m[:, 2])))
        return cls(
            points_px=points_px.reshape(*shape, 2),
            gsd_m=np.where(unseen.reshape(shape), np.nan, gsd_m),
            offsets_m=(en_m - camera.position_m[:2]).reshape(*shape, 2),
            cell_size_m=cell_size_m,
            above_m=float(above_m),
        )

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """Return which cells the picture shows, shape (rows, cols)."""
        return np.isfinite(self.points_px[:, :, 0])

    def sample(self, planes: Iterable[NDArray[np.floating]]) -> Planes:
        """Bring planes of a picture, (H, W) each, onto the lattice, (C, rows, cols); NaN where unseen or unknown.

        A picture much finer than the lattice is averaged first, so that a cell takes what lies in it, not one pixel.
        A cell is known if more than half of what it takes is.
        """
        factor = self._factor()
        at = (self.points_px / factor - _HALF).astype(np.float32)  # OpenCV counts from the centre of the first pixel
        where = np.nan_to_num(at, nan=-2.0)
        found = []
        for plane in planes:
            cells = np.full(self.is_seen.shape, np.nan, dtype=np.float32)
            is_known = np.isfinite(plane)
            weight = self._take(is_known.astype(np.float32), where, factor)
            total = self._take(np.where(is_known, plane, 0).astype(np.float32), where, factor)
            enough = self.is_seen & (weight > _HALF)
            cells[enough] = total[enough] / weight[enough]
            found.append(cells)
        return np.stack(found) if found else np.empty((0, *self.is_seen.shape), dtype=np.float32)

    def _factor(self) -> int:
        if not self.is_seen.any():
            return 1
        # 10: percentile of the sampling distances by which a picture is reduced before it is sampled
        return max(1, int(self.cell_size_m / max(np.nanpercentile(self.gsd_m, 10), 1e-6)))

    def _take(self, plane: Planes, where: Planes, factor: int) -> Planes:
        rows, cols = plane.shape
        if factor > 1:
            padded = cv2.copyMakeBorder(plane, 0, -rows % factor, 0, -cols % factor, cv2.BORDER_REPLICATE)
            size = (padded.shape[1] // factor, padded.shape[0] // factor)
            plane = np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        taken = cv2.remap(plane, where, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(taken, dtype=np.float32)

    def hidden_by(self, standing: NDArray[np.bool_], height_m: float) -> NDArray[np.bool_]:
        """Return which cells show the upper part of something that stands up, not the ground, shape (rows, cols).

        Something `height_m` high leans away from the point beneath the camera: what is seen at a distance d belongs to
        its foot if, and only if, its top at d * H / (H - height_m) is seen as standing too. The other cells of
        `standing` cover ground that is not seen. Beyond the lattice and the picture, what stands is taken to go on.
        """
        if not standing.any() or height_m <= 0:
            return np.zeros_like(standing)
        # 1.5: least height of the camera over what stands up: from less, nothing is known behind it
        if self.above_m < 1.5 * height_m:
            return standing.copy()
        outward = height_m / (self.above_m - height_m)
        rows, cols = standing.shape
        # The lattice is a similarity: one step of a row or column is the same offset everywhere.
        across, down = self.offsets_m[0, 1] - self.offsets_m[0, 0], self.offsets_m[1, 0] - self.offsets_m[0, 0]
        to_cells = np.stack([across, down]) / self.cell_size_m**2  # rows: one column on, one row on
        shift = self.offsets_m @ to_cells.T * outward
        col, row = np.arange(cols)[None, :] + shift[:, :, 0], np.arange(rows)[:, None] + shift[:, :, 1]
        tops = (standing | ~self.is_seen).astype(np.float32)
        found = cv2.remap(
            tops,
            np.stack([col, row], axis=-1).astype(np.float32),
            np.empty(0),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=1.0,
        )
        return np.asarray(standing & (found < _HALF))


def see_ground(
    seen: Seen,
    camera: Camera,
    ground: Ground,
    *,
    size_cells: int,
    cell_size_m: float,
    pose: Pose | None = None,
    reading: Reading | None = None,
) -> SoftView:
    """Bring the class probabilities of a picture onto the ground; parameters and what is unknown as in `to_evidence`.

    Raise `ShapeError` if the probabilities are not of the camera's picture.
    """
    reading = reading or Reading()
    lattice = BirdsEye.of(camera, ground, size_cells=size_cells, cell_size_m=cell_size_m, pose=pose)
    found = lattice.sample(_planes(seen, camera.intrinsics))
    hidden = np.zeros(lattice.is_seen.shape, dtype=bool)
    for name, height_m in reading.standing_m.items():
        if name in seen.classes:
            standing = found[seen.classes.index(name)] >= reading.present_at
            hidden |= lattice.hidden_by(standing, height_m)
    found[:, hidden] = np.nan
    for index, name in enumerate(seen.classes):
        with np.errstate(invalid="ignore"):
            found[index][lattice.gsd_m > reading.widths_m.get(name, math.inf)] = np.nan
    return SoftView(classes=seen.classes, probabilities=found, cell_size_m=cell_size_m)


def _planes(seen: Seen, lens: Intrinsics) -> Iterator[Planes]:
    """Yield P(present) of each class; of a `Segmentation` class by class: all take four times its own bytes."""
    parts: Iterable[Seen] = (seen,)
    if isinstance(seen, Segmentation):
        pairs = zip(seen.classes, seen.probability_bytes[:, np.newaxis], strict=True)
        parts = (Segmentation(classes=(name,), probability_bytes=plane) for name, plane in pairs)
    for part in parts:
        planes = part.probabilities()
        if planes.shape[1:] != (lens.height_px, lens.width_px):
            raise ShapeError(
                f"the camera's pictures are {lens.height_px} x {lens.width_px}, got probabilities {planes.shape}"
            )
        yield from planes


def to_evidence(
    seen: Seen,
    camera: Camera,
    ground: Ground,
    *,
    size_cells: int,
    cell_size_m: float,
    pose: Pose | None = None,
    reading: Reading | None = None,
) -> Evidence:
    """Return heading-up evidence of a picture's class probabilities, and how sure each cell is.

    Parameters
    ----------
    seen : Seen
        Class probabilities of the pixels, such as a `Segmentation`; NaN where the segmenter says nothing.
    camera : Camera
        As believed: its errors become errors of the evidence.
    ground : Plane or Dem
        What the camera looks at, in the camera's frame.
    size_cells, cell_size_m : int, float
        Cells a side of the square view, and their side on the ground, metres.
    pose : Pose, optional
        Middle and heading of the view; beneath the camera and with the picture's up if not given.
    reading : Reading, optional
        Thresholds, widths and heights of the classes.

    Returns
    -------
    Evidence
        UNKNOWN outside the picture, behind hills of a Dem, where the ground sampling distance exceeds the width of the
        class, where something that stands up hides the ground, and where the probability is undecided.

    Raises
    ------
    ShapeError, CameraError
        If the probabilities are not of the camera's picture, or the view cannot be.

    Examples
    --------
    The right half of a picture straight down is water; beyond the picture nothing is known:

    >>> from types import SimpleNamespace
    >>> from sasgeo_bench.sensing.ground import Plane
    >>> from sasgeo_bench.sensing.camera import Intrinsics
    >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=40, height_px=20)
    >>> camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=20.0, yaw_deg=0.0)
    >>> right = np.tile(np.arange(40) >= 20, (20, 1)).astype(np.float32)[None]
    >>> seen = SimpleNamespace(classes=("water",), probabilities=lambda: right)
    >>> to_evidence(seen, camera, Plane(), size_cells=4, cell_size_m=10.0).cells[0].tolist()
    [[2, 2, 2, 2], [0, 0, 1, 1], [0, 0, 1, 1], [2, 2, 2, 2]]
    """
    view = see_ground(seen, camera, ground, size_cells=size_cells, cell_size_m=cell_size_m, pose=pose, reading=reading)
    return view.to_evidence(reading)


def rectify(
    picture: NDArray[np.uint8],
    camera: Camera,
    ground: Ground,
    *,
    size_cells: int,
    cell_size_m: float,
    pose: Pose | None = None,
) -> NDArray[np.uint8]:
    """Return a picture, uint8 (H, W, 3), as seen from above; black where it shows nothing."""
    lattice = BirdsEye.of(camera, ground, size_cells=size_cells, cell_size_m=cell_size_m, pose=pose)
    if picture.shape != (camera.intrinsics.height_px, camera.intrinsics.width_px, 3):
        raise ShapeError(f"the camera's pictures are of another size than {picture.shape}")
    bands = lattice.sample(np.moveaxis(picture, 2, 0).astype(np.float32))
    return np.rint(np.nan_to_num(np.moveaxis(bands, 0, 2))).astype(np.uint8)


def _sampling(points_px: NDArray[np.float64], cell_size_m: float) -> NDArray[np.float64]:
    """Return the coarsest metres a pixel at each cell, from the pixels of its neighbours, shape (rows, cols)."""
    down, across = (np.asarray(np.gradient(points_px / cell_size_m, axis=axis)) for axis in (0, 1))
    total = (across**2 + down**2).sum(axis=2)
    area = across[:, :, 0] * down[:, :, 1] - across[:, :, 1] * down[:, :, 0]
    fewest = np.sqrt(np.maximum(total - np.sqrt(np.maximum(total**2 - 4 * area**2, 0)), 1e-12) / 2)  # pixels a metre
    return np.asarray(1 / fewest)


def _is_behind(
    camera: Camera,
    ground: Dem,
    points_m: NDArray[np.float64],
    points_px: NDArray[np.float64],
    unseen: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return which points the ground itself hides: their pixel shows something a cell nearer or more."""
    rows = np.flatnonzero(~unseen)
    met = camera.unproject(points_px[rows], ground)
    nearer_m = np.linalg.norm(points_m[rows] - camera.position_m, axis=1) - np.linalg.norm(
        met - camera.position_m, axis=1
    )
    behind = np.zeros(len(points_m), dtype=bool)
    behind[rows] = ~(nearer_m < ground.grid.cell_size_m)
    return behind
