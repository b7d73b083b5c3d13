# SPDX-License-Identifier: Apache-2.0
"""Three-state rasters: present, absent or unknown per class, as a view observed them; packing, and views of a map."""

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Final, Self, cast

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ABSENT: Final = 0
PRESENT: Final = 1
UNKNOWN: Final = 2

_STATES: Final = 3
CERTAIN: Final = 255  # the confidence of what is certain
_HALF: Final = 0.5

LEVELS: Final = 2 * CERTAIN  # steps of probability that a state and its confidence can tell
SILENT: Final = LEVELS + 1  # the level of an unknown cell
_CHANCES: Final = np.append(_HALF + np.arange(-CERTAIN, CERTAIN + 1) / CERTAIN / 2, np.nan)  # by level
_OF_STATE: Final = np.array([0, LEVELS, SILENT], dtype=np.uint16)  # level of each state that has no confidence
_MOST_CLASSES: Final = 31
_NOT_KNOWN: Final = np.uint32(1 << 31)

CELLS_PER_BYTE: Final = 4
_SHIFTS: Final = np.arange(0, 8, 2, dtype=np.uint8)  # of the four cells within a byte, first cell lowest
_CELLS: Final = np.arange(256, dtype=np.uint8)[:, None] >> _SHIFTS & 3  # shape (256, 4): the cells of each byte


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """The state of each class and cell, as observed in one view; `ShapeError` if shapes, types or values do not fit.

    Row 0 of `cells`, uint8 of shape (C, rows, cols), is the top of the view; a cell is ABSENT, PRESENT or UNKNOWN and
    `cell_size_m` wide on the ground, for scale 1. `confidence` is that of perception, 255 * |2 P - 1| for a probability
    P that the class is there, of the same shape; without it, known cells are certain. Both arrays are made read-only.
    `of_probabilities` makes evidence of probabilities, `probabilities` and `log_odds` read them back.
    """

    classes: tuple[str, ...]
    cells: NDArray[np.uint8]
    cell_size_m: float
    confidence: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        """Check shapes, types and values; lock the arrays."""
        if self.cells.dtype != np.uint8 or self.cells.ndim != 3 or len(self.cells) != len(self.classes):
            raise ShapeError(
                f"evidence for {len(self.classes)} classes is uint8 of shape (C, rows, cols), "
                f"got {self.cells.dtype} of shape {self.cells.shape}"
            )
        if self.cells.size == 0 or self.cells.max() >= _STATES:
            raise ShapeError("evidence cells are 0 absent, 1 present or 2 unknown, and there is at least one")
        if not (np.isfinite(self.cell_size_m) and self.cell_size_m > 0):
            raise ShapeError(f"cell_size_m must be positive and finite, got {self.cell_size_m!r}")
        if self.confidence is not None:
            if self.confidence.dtype != np.uint8 or self.confidence.shape != self.cells.shape:
                found = f"{self.confidence.dtype} of shape {self.confidence.shape}"
                raise ShapeError(f"confidence is uint8 of shape {self.cells.shape}, got {found}")
            self.confidence.flags.writeable = False
        self.cells.flags.writeable = False

    @classmethod
    def of_probabilities(
        cls,
        classes: tuple[str, ...],
        probabilities: NDArray[np.floating],
        *,
        cell_size_m: float,
        present_at: float = _HALF,
        absent_at: float = _HALF,
    ) -> Self:
        """Make evidence of the probability that each class is there.

        Parameters
        ----------
        classes : tuple of str
            Names of the classes.
        probabilities : ndarray of float, shape (C, rows, cols)
            P(present), 0..1; NaN where nothing is known.
        cell_size_m : float
            Side of a cell on the ground for scale 1, metres.
        present_at, absent_at : float
            A cell is PRESENT from `present_at` on, ABSENT below `absent_at` or at it, UNKNOWN between: nothing is kept
            of a probability there. A PRESENT cell of less than 0.5, or an ABSENT one of more, has confidence 0: it
            reads as 0.5.

        Raises
        ------
        ShapeError
            If shapes do not fit, or a probability is not within 0..1.

        Examples
        --------
        >>> seen = Evidence.of_probabilities(("water",), np.array([[[0.9, 0.25, np.nan]]]), cell_size_m=1.0)
        >>> seen.cells.tolist(), seen.confidence.tolist()
        ([[[1, 0, 2]]], [[[204, 128, 0]]])
        >>> seen.probabilities().round(2).tolist()
        [[[0.9, 0.25, nan]]]
        """
        filled = np.nan_to_num(probabilities, nan=_HALF)
        if filled.size and not (filled.min() >= 0 and filled.max() <= 1):
            raise ShapeError(
                f"probabilities lie in 0..1, got {filled.min():g}..{filled.max():g}: NaN says that nothing is known"
            )
        cells = np.full(probabilities.shape, UNKNOWN, dtype=np.uint8)
        cells[probabilities <= absent_at] = ABSENT
        cells[probabilities >= present_at] = PRESENT
        # For its state: |2 P - 1| of a present cell of 0.4 would be read back as 0.6.
        sureness = np.where(cells == PRESENT, 2 * filled - 1, 1 - 2 * filled).clip(0)
        confidence = np.where(cells == UNKNOWN, 0, np.rint(CERTAIN * sureness)).astype(np.uint8)
        return cls(classes=classes, cells=cells, cell_size_m=cell_size_m, confidence=confidence)

    def levels(self) -> NDArray[np.uint16]:
        """Return the probability of each class and cell in whole steps, shape (C, rows, cols).

        0 is absent for certain, `LEVELS` (510) present for certain, `SILENT` unknown. A table by level reads evidence
        cell by cell at no more cost than one by state.

        >>> cells = np.array([[[1, 0, 2]]], dtype=np.uint8)
        >>> Evidence(classes=("water",), cells=cells, cell_size_m=1.0).levels().tolist()
        [[[510, 0, 511]]]
        """
        if self.confidence is None:
            return _OF_STATE.take(self.cells)
        off = self.confidence.astype(np.int16)
        found = np.where(self.cells == PRESENT, CERTAIN + off, CERTAIN - off).astype(np.uint16)
        found[self.cells == UNKNOWN] = SILENT
        return found

    def probabilities(self) -> NDArray[np.float64]:
        """Return P(present) of each class and cell, shape (C, rows, cols), in steps of 1/510; NaN where unknown.

        Evidence without confidence is certain: a present cell is 1, an absent one 0.

        >>> cells = np.array([[[1, 0, 2]]], dtype=np.uint8)
        >>> Evidence(classes=("water",), cells=cells, cell_size_m=1.0).probabilities().tolist()
        [[[1.0, 0.0, nan]]]
        """
        return _CHANCES.take(self.levels())

    def log_odds(self) -> NDArray[np.float64]:
        """Return ln(P / (1 - P)) of each class and cell, shape (C, rows, cols); 0 where unknown: no evidence.

        The outer levels stand for half a step each, so that none is infinite: at most 7.6 either way.

        >>> cells = np.array([[[1, 0, 2]]], dtype=np.uint8)
        >>> Evidence(classes=("water",), cells=cells, cell_size_m=1.0).log_odds().round(1).tolist()
        [[[7.6, -7.6, 0.0]]]
        """
        edge = 1 / (4 * LEVELS)
        chances = np.clip(np.nan_to_num(self.probabilities(), nan=_HALF), edge, 1 - edge)
        return np.asarray(np.log(chances / (1 - chances)))

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return (self.cells.shape[1], self.cells.shape[2])

    @property
    def size_m(self) -> tuple[float, float]:
        """Return width and height on the ground for scale 1, metres."""
        return (self.cells.shape[2] * self.cell_size_m, self.cells.shape[1] * self.cell_size_m)

    @cached_property
    def unknown_share(self) -> float:
        """Return the fraction of unknown cells over all classes."""
        return float((self.cells == UNKNOWN).mean())

    def of_known_classes(self) -> Self:
        """Return the view without the classes that are unknown everywhere; as it is if all are.

        >>> cells = np.array([[[PRESENT, UNKNOWN]], [[UNKNOWN, UNKNOWN]]], dtype=np.uint8)
        >>> view = Evidence(classes=("building", "water"), cells=cells, cell_size_m=1.0)
        >>> view.unknown_share, view.of_known_classes().unknown_share
        (0.75, 0.5)
        """
        kept = (self.cells != UNKNOWN).any(axis=(1, 2))
        if kept.all() or not kept.any():
            return self
        return type(self)(
            classes=tuple(name for name, is_kept in zip(self.classes, kept, strict=True) if is_kept),
            cells=self.cells[kept],
            cell_size_m=self.cell_size_m,
            confidence=None if self.confidence is None else self.confidence[kept],
        )

    def replace(self, cells: NDArray[np.uint8], confidence: NDArray[np.uint8] | None = None) -> Self:
        """Return the same view with other cells (and confidence, none by default)."""
        return type(self)(classes=self.classes, cells=cells, cell_size_m=self.cell_size_m, confidence=confidence)

    @cached_property
    def is_certain(self) -> bool:
        """Return whether every known cell is present or absent for certain.

        >>> Evidence.of_probabilities(("water",), np.array([[[1.0, np.nan]]]), cell_size_m=1.0).is_certain
        True
        """
        return self.confidence is None or bool((self.confidence[self.cells != UNKNOWN] == CERTAIN).all())

    def without_unknown(self) -> Self:
        """Return the view with unknown cells as absent for certain.

        >>> seen = Evidence.of_probabilities(("water",), np.array([[[0.9, np.nan]]]), cell_size_m=1.0)
        >>> seen.without_unknown().probabilities().round(2).tolist()
        [[[0.9, 0.0]]]
        """
        is_unknown = self.cells == UNKNOWN
        cells = np.where(is_unknown, np.uint8(ABSENT), self.cells)
        return self.replace(
            cells, None if self.confidence is None else np.where(is_unknown, np.uint8(CERTAIN), self.confidence)
        )

    def plot(self, *, title: str = "evidence of one view", data: str = "not stated") -> "Figure":
        """Draw what was seen in one call, and how much is known; see `sgb.plot_evidence`."""
        # By its public name: the drawing stands below in the order of folders
        return cast("Figure", import_module("sasgeo_bench").plot_evidence(self, title=title, data=data))

    def layer(self, class_name: str) -> NDArray[np.uint8]:
        """Return the cells of one class, shape (rows, cols)."""
        return np.asarray(self.cells[self.classes.index(class_name)])


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerBits:
    """All classes of a map in one integer per cell: many views are cut from it for the price of one layer.

    `bits` is uint32 of shape (rows, cols), bit i set where class i is present, the highest where nothing is known;
    `count` is the number of classes.
    """

    bits: NDArray[np.uint32]
    count: int

    @classmethod
    def of(cls, layers: NDArray[np.uint8]) -> Self:
        """Combine layers, uint8 of shape (C, rows, cols); a cell unknown in one class is unknown in all.

        >>> LayerBits.of(np.array([[[1, 0, 255]], [[1, 1, 255]]], dtype=np.uint8)).bits.tolist()
        [[3, 2, 2147483648]]
        """
        if len(layers) > _MOST_CLASSES:
            raise ShapeError(f"at most {_MOST_CLASSES} classes fit into the bits of one cell, got {len(layers)}")
        bits = np.zeros(layers.shape[1:], dtype=np.uint32)
        is_unknown = np.zeros(layers.shape[1:], dtype=np.bool_)
        for index, layer in enumerate(layers):
            bits |= np.left_shift(layer, np.uint32(index), dtype=np.uint32)
            is_unknown |= layer > PRESENT
        bits[is_unknown] = _NOT_KNOWN
        bits.flags.writeable = False
        return cls(bits=bits, count=len(layers))


def pack(cells: NDArray[np.uint8]) -> bytes:
    """Pack three-state cells of any shape to two bits each, in C order, the first of four cells in the lowest bits.

    >>> pack(np.array([1, 2, 0, 1, 2], dtype=np.uint8)).hex()
    '4902'
    """
    flat = np.zeros(-(-cells.size // CELLS_PER_BYTE) * CELLS_PER_BYTE, dtype=np.uint8)
    flat[: cells.size] = cells.ravel()
    packed = np.zeros(len(flat) // CELLS_PER_BYTE, dtype=np.uint8)
    for first, shift in enumerate(_SHIFTS):
        packed |= flat[first::CELLS_PER_BYTE] << shift
    return packed.tobytes()


def unpack(packed: bytes, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Unpack bytes of `pack` into cells of a known shape; raise `ShapeError` if their number or a state is wrong."""
    count = int(np.prod(shape))
    if len(packed) != -(-count // CELLS_PER_BYTE):
        raise ShapeError(
            f"{count} cells of shape {shape} take {-(-count // CELLS_PER_BYTE)} bytes, got {len(packed)}: "
            "rows, cols or classes do not belong to this evidence"
        )
    cells = _CELLS.take(np.frombuffer(packed, dtype=np.uint8), axis=0).ravel()
    if cells.max(initial=0) >= _STATES:
        raise ShapeError(
            "packed evidence holds a state that is neither absent, present nor unknown: the bytes are damaged"
        )
    return np.asarray(cells[:count].reshape(shape), dtype=np.uint8)


def observe(layers: LayerBits, grid: Grid, pose: Pose, *, size_cells: int, cell_size_m: float) -> NDArray[np.uint8]:
    """Return the map as a perfect view from a pose: each view cell takes the map cell under its centre.

    The result is uint8 of shape (C, size_cells, size_cells), ABSENT, PRESENT or UNKNOWN; beyond the map all is UNKNOWN.
    `cell_size_m` is the side of a view cell on the ground, for scale 1.

    Examples
    --------
    A house east of the centre lies at the top of a view that heads east (yaw 90):

    >>> layers = np.zeros((1, 5, 5), dtype=np.uint8)
    >>> layers[0, 2, 4] = 1
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=5.0, cell_size_m=1.0, rows=5, cols=5)
    >>> east = Pose(easting_m=2.5, northing_m=2.5, yaw_deg=90.0)
    >>> observe(LayerBits.of(layers), grid, east, size_cells=5, cell_size_m=1.0)[0, 0].tolist()
    [0, 0, 1, 0, 0]
    """
    shape = (size_cells, size_cells)
    # A pose is an affine map, so three points give it, and each of a view's cells is a sum of two numbers.
    middle, right, up = grid.to_uv(pose.to_map(np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])))
    steps_m = (np.arange(size_cells) + 0.5 - size_cells / 2) * cell_size_m
    across, along = np.outer(right - middle, steps_m), middle[:, None] + np.outer(up - middle, -steps_m)
    cols, rows = np.floor(along[:, :, None] + across[:, None, :]).astype(np.int64)
    height, width = layers.bits.shape
    at = rows * width + cols
    if rows.min() >= 0 and rows.max() < height and cols.min() >= 0 and cols.max() < width:
        bits = layers.bits.ravel().take(at)
    else:
        within = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        bits = np.where(within, layers.bits.ravel().take(np.where(within, at, 0)), _NOT_KNOWN)
    seen = np.empty((layers.count, *shape), dtype=np.uint8)
    unknown = np.multiply(bits == _NOT_KNOWN, UNKNOWN, dtype=np.uint8)
    for index, layer in enumerate(seen):
        np.not_equal(bits & np.uint32(1 << index), 0, out=layer.view(np.bool_))
        np.bitwise_or(layer, unknown, out=layer)  # unknown cells have the bit of no class
    return seen


def cell_offsets_m(shape: tuple[int, int], cell_size_m: float) -> NDArray[np.float64]:
    """Return (right, up) of every cell centre of a view from its middle, row by row, shape (rows * cols, 2), metres.

    >>> cell_offsets_m((2, 2), 1.0).tolist()
    [[-0.5, 0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]
    """
    rows, cols = shape
    west_m, north_m = -cols * cell_size_m / 2, rows * cell_size_m / 2
    view = Grid(epsg=0, west_m=west_m, north_m=north_m, cell_size_m=cell_size_m, rows=rows, cols=cols)
    return view.to_centres_m(np.argwhere(np.ones(shape, dtype=bool)))


def footprint(pose: Pose, *, size_m: tuple[float, float]) -> shapely.Polygon:
    """Return the outline of a view of a width and height on the map, counter-clockwise.

    >>> footprint(Pose(easting_m=5.0, northing_m=5.0, yaw_deg=90.0), size_m=(4.0, 2.0)).bounds
    (4.0, 3.0, 6.0, 7.0)
    """
    half = np.array(size_m) / 2
    corners = pose.to_map(np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half)
    return shapely.Polygon(corners.round(9))
