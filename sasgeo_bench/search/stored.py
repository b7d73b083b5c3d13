# SPDX-License-Identifier: Apache-2.0
"""The levels of a map on disk, made window by window and mapped into memory: a country is searched as a town is."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Final, Self

import cv2
import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from sasgeo_bench.core.errors import SasgeoError, ShapeError, StoreError
from sasgeo_bench.core.folders import check_known, fresh_folder, is_ours, locked
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.search.field import FOUR, Cells, Field, Level, averaged, dilated, fours_of, round_kernel, thinner_of

FACTORS: Final = (1, 2, 4, 8, 16, 32)  # cells of 2 m: views of up to 2 km
WINDOW_CELLS: Final = 2048  # of the map's own cells: 14 bands of one window take 60 MB
_ABOUT: Final = "levels.json"
_MEND: Final = "store the levels of the map again"

Paint = Callable[[Grid], Field | None]  # of a window; None where nothing is mapped


@dataclass(frozen=True, kw_only=True)
class StoredField:
    """A map whose levels lie in a folder: opened at once, and read where a search looks.

    Searches take it in place of a `Field`, with the same result. `key` says of what map and by what settings it was
    made; `thinner` has for each factor that is stored the `Level.thinner` of its bands.
    """

    folder: Path
    grid: Grid
    key: str
    thinner: Mapping[int, tuple[float, ...]]

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Open the output of `store_levels`; raise `StoreError` if it is missing or damaged."""
        about = read_json(folder / _ABOUT, mend=_MEND)
        try:
            thinner = {int(factor): _shares(shares) for factor, shares in about["thinner"].items()}
            found = cls(folder=folder, grid=Grid(**about["grid"]), key=str(about["key"]), thinner=thinner)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise _damaged(folder, error) from error
        if 1 not in thinner:
            raise _damaged(folder, ValueError(f"{_ABOUT} lists no level 1"))
        for factor in thinner:
            found._cells(factor)
        return found

    def _cells(self, factor: int) -> Cells:
        """Map the cells of a level into memory; raise `StoreError` if they are not what the grid says."""
        path = self.folder / _name(factor)
        try:
            count = len(self.thinner[factor])
            return Cells(fours=_mapped(path, _shape_of(self.grid.coarsen(factor).shape, count)), count=count)
        except Exception as error:  # NumPy parses a header as Python, which fails at damage with errors of many kinds
            raise _damaged(self.folder, error) from error

    def field(self) -> Field:
        """Return it as a field: the levels that are stored are mapped, others are made when they are asked for."""
        found = Field(grid=self.grid, cells=self.level(1).cells)
        found.add_levels(map(self.level, self.thinner))
        return found

    def level(self, factor: int) -> Level:
        """Return the map in cells of `factor` of its own a side; raise `StoreError` if that level is not stored."""
        if factor not in self.thinner:
            stored = ", ".join(map(str, self.thinner))
            raise StoreError(f"{self.folder} holds the levels {stored}, not {factor}: search for a smaller view")
        shares = np.array(self.thinner[factor])
        return Level(factor=factor, grid=self.grid.coarsen(factor), cells=self._cells(factor), thinner=shares)


def _shares(values: Iterable[float]) -> tuple[float, ...]:
    """Return the `thinner` of a level; raise `ValueError` for what is no share."""
    shares = tuple(map(float, values))
    if not all(0.0 <= share <= 1.0 for share in shares):
        raise ValueError(f"{shares} are no shares")
    return shares


def _mapped(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Map the cells of a file into memory; raise `ValueError` for other ones."""
    cells = open_memmap(plain_file(path), mode="r")
    if cells.dtype != np.uint8 or cells.shape != shape or not cells.flags.c_contiguous:
        raise ValueError(f"{path.name} has {cells.dtype} of shape {cells.shape}, expected uint8 of {shape}")
    if path.stat().st_size != cells.offset + cells.nbytes:
        raise ValueError(f"{path.name} is longer than its cells")
    return np.asarray(cells)


def _damaged(folder: Path, error: Exception) -> StoreError:
    return StoreError(f"{folder} is damaged ({message_of(error)[:200]}): {_MEND}")


def store_levels(
    folder: Path,
    grid: Grid,
    bands: int,
    paint: Paint,
    *,
    key: str = "",
    factors: tuple[int, ...] = FACTORS,
    window_cells: int | None = None,
) -> StoredField:
    """Store the levels of a map, whole or not at all, in the memory of a few windows.

    Parameters
    ----------
    folder : Path
        Folder to write; an earlier one of the same `key` is opened as it is.
    grid : Grid
        Cells of the map.
    bands : int
        Number of classes, K.
    paint : callable
        Takes a window of the grid and returns its `Field`, of the same grid; None where nothing is mapped. A disk that
        can leave holes in files stores nothing of such windows.
    key : str
        Says of what the levels are made: hash of the map and settings.
    factors : tuple of int
        Sides of the cells of the levels, in cells of the map: 1 and powers of two.
    window_cells : int, optional
        Side of a window, a multiple of all factors; by default `WINDOW_CELLS`.

    Returns
    -------
    StoredField
        The levels, equal to those that a `Field` of all the map makes in memory.

    Raises
    ------
    StoreError
        If the folder cannot be written, or holds other files.
    ShapeError
        If a window does not end where the cells of each level do.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=64.0, cell_size_m=1.0, rows=64, cols=64)
    >>> town = np.random.default_rng(0).choice(np.array([0, 255], np.uint8), (1, 64, 64), p=[0.9, 0.1])
    >>> whole = Field.of(grid=grid, layers=town, known=np.full((64, 64), 255, np.uint8))
    >>> stored = store_levels(Path(mkdtemp()) / "town", grid, 1, lambda _: whole, factors=(1, 2, 4))
    >>> all(np.array_equal(stored.level(at).cells.fours, whole.level(at).cells.fours) for at in (1, 2, 4))
    True
    """
    window_cells = window_cells or WINDOW_CELLS
    uneven = [factor for factor in factors if window_cells % factor]
    if uneven:
        raise ShapeError(
            f"windows of {window_cells} cells cut cells of the levels {uneven}: name a multiple of all factors"
        )
    with locked(folder):
        if (folder / _ABOUT).is_file() and _key_of(folder) == key:
            return StoredField.open(folder)
        if folder.exists() and not folder.is_dir():
            raise StoreError(f"{folder} is no folder: name another one")
        names = {_ABOUT, *map(_name, FACTORS), *map(_name, factors)} if is_ours(folder / _ABOUT) else set[str]()
        check_known(folder, names, "the levels of a map")
        try:
            with fresh_folder(folder) as scratch:
                base = _made(scratch, _name(1), grid.shape, bands + 1)
                for row, col, window in grid.windows(window_cells):
                    field = paint(window)
                    if field is not None:
                        base.cut(row, col, window.shape).fours[:] = field.cells.fours
                shares = {1: np.ones(bands + 1)}
                for factor in factors:
                    if factor > 1:
                        shares[factor] = _store_level(scratch, base, grid, factor, window_cells)
                about = {
                    "made_by": f"sasgeo-bench {metadata.version('sasgeo-bench')}",
                    "key": key,
                    "grid": asdict(grid),
                    "thinner": {factor: share.tolist() for factor, share in shares.items()},
                }
                (scratch / _ABOUT).write_text(json.dumps(about), encoding="utf-8")
        except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
            raise
        except OSError as error:
            raise StoreError(
                f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights"
            ) from error
    return StoredField.open(folder)


def _key_of(folder: Path) -> str | None:
    """Return of what the levels in a folder are made, whatever layout they have."""
    about = read_json(folder / _ABOUT, mend=_MEND)
    return str(about.get("key")) if isinstance(about, dict) else None


def _name(factor: int) -> str:
    return f"level-{factor}.npy"


def _shape_of(shape: tuple[int, int], count: int) -> tuple[int, int, int, int]:
    return (fours_of(count), *shape, FOUR)


def _made(folder: Path, name: str, shape: tuple[int, int], count: int) -> Cells:
    fours = open_memmap(folder / name, mode="w+", dtype=np.uint8, shape=_shape_of(shape, count))
    return Cells(fours=fours, count=count)


def _store_level(folder: Path, base: Cells, grid: Grid, factor: int, window_cells: int) -> NDArray[np.float64]:
    """Store a level, as `Field.level` makes it, and return its `thinner`."""
    # Whether a class is thin is known when all of the map was looked at: until then there are two versions, the class
    # as it is and spread.
    shape, bands = grid.coarsen(factor).shape, base.count
    plain, grown = (_made(folder, name, shape, bands) for name in (_name(factor), "grown.npy"))
    before, after = np.zeros((len(base.fours), FOUR)), np.zeros((len(base.fours), FOUR))
    kernel = round_kernel(factor)
    for row, col, window in grid.windows(window_cells):
        top, left = max(row - factor, 0), max(col - factor, 0)
        around = base.cut(top, left, (row + window.rows + factor - top, col + window.cols + factor - left))
        inner = np.s_[row - top : row - top + window.rows, col - left : col - left + window.cols]
        coarse = np.s_[
            row // factor : -(-(row + window.rows) // factor), col // factor : -(-(col + window.cols) // factor)
        ]
        for at, four in enumerate(around.fours):
            if not four.any():
                continue
            own, spread = four[inner], dilated(four, kernel)[inner]
            plain.fours[at][coarse], grown.fours[at][coarse] = averaged(own, factor), averaged(spread, factor)
            before[at] += cv2.sumElems(own)
            after[at] += cv2.sumElems(spread)
    thinner = thinner_of(before.ravel()[:bands], after.ravel()[:bands])
    for at in np.flatnonzero(thinner < 1).tolist():
        for rows in _stripes(shape[0]):
            plain.band(at)[rows] = grown.band(at)[rows]
    del grown
    (folder / "grown.npy").unlink()
    return thinner


def _stripes(rows: int) -> Iterator[slice]:
    for top in range(0, rows, WINDOW_CELLS):
        yield slice(top, top + WINDOW_CELLS)
