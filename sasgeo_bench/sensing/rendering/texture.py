# SPDX-License-Identifier: Apache-2.0
"""Random numbers that belong to a place on the ground or to a feature: windows that overlap are painted alike."""

import hashlib
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid

Field = NDArray[np.float32]
Numbers = NDArray[np.float64]

_MIX: Final = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_TILE_CELLS: Final = 512


def seed_of(*names: object) -> int:
    """Return a seed of 63 bits for names, the same on every machine.

    >>> seed_of("vaduz", "trees") == seed_of("vaduz", "trees"), seed_of("vaduz", "trees") == seed_of("vaduz", "cars")
    (True, False)
    """
    text = "/".join(map(str, names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def draw(seed: int, *keys: NDArray[np.int64]) -> Numbers:
    """Return a number in [0, 1) for each combination of whole numbers; the arrays broadcast.

    Notes
    -----
    SplitMix64 (Steele et al., OOPSLA 2014) as a hash: one round for each key.

    Examples
    --------
    >>> draw(7, np.arange(3)).round(3).tolist() == draw(7, np.arange(5))[:3].round(3).tolist()
    True
    """
    state: NDArray[np.uint64] = np.asarray(seed, dtype=np.uint64)
    for key in keys:
        mixed = (np.asarray(key, dtype=np.int64).astype(np.uint64) ^ state) + _STEP
        mixed = (mixed ^ (mixed >> np.uint64(30))) * _MIX[0]
        mixed = (mixed ^ (mixed >> np.uint64(27))) * _MIX[1]
        state = mixed ^ (mixed >> np.uint64(31))
    return np.asarray((state >> np.uint64(11)).astype(np.float64) / 2.0**53)


def bell(seed: int, *keys: NDArray[np.int64]) -> Numbers:
    """Return numbers about 0 with a standard deviation of 1 and at most 3.5 from it, drawn as `draw` does."""
    return np.asarray(np.sum([draw(seed + 7919 * part, *keys) for part in range(4)], axis=0) - 2.0) * 3**0.5


def noise(grid: Grid, wavelength_m: float, seed: int) -> Field:
    """Return smooth noise in [-1, 1], shape (rows, cols), whose bumps are about a wavelength wide.

    Values are drawn at the crossings of a lattice that is fixed to the ground, and joined by a smooth step. Wide bumps
    are made on coarser cells.
    """
    factor = min(8, int(wavelength_m / grid.cell_size_m / 10))
    if factor > 1:
        coarse = noise(grid.coarsen(factor), wavelength_m, seed)
        rows, cols = coarse.shape
        wide = cv2.resize(coarse, (cols * factor, rows * factor), interpolation=cv2.INTER_LINEAR)
        return np.asarray(wide[: grid.rows, : grid.cols])
    west, _, _, north = grid.bounds_m
    across = (west + (np.arange(grid.cols) + 0.5) * grid.cell_size_m) / wavelength_m
    down = -(north - (np.arange(grid.rows) + 0.5) * grid.cell_size_m) / wavelength_m
    first_col, first_row = int(np.floor(across[0])), int(np.floor(down[0]))
    cols = np.arange(first_col, int(np.floor(across[-1])) + 2)
    rows = np.arange(first_row, int(np.floor(down[-1])) + 2)
    values = (2 * draw(seed, rows[:, None], cols[None, :]) - 1).astype(np.float32)
    wide = _joined(values.T, np.asarray(across - first_col)).T
    return _joined(np.ascontiguousarray(wide), np.asarray(down - first_row))


def _joined(values: Field, at: NDArray[np.floating]) -> Field:
    low = np.floor(at).astype(np.int64)
    part = (at - low).astype(np.float32)
    part = (part * part * (3 - 2 * part))[:, None]
    joined = np.diff(values, axis=0).take(low, axis=0)
    joined *= part
    joined += values.take(low, axis=0)
    return np.asarray(joined, dtype=np.float32)


def fractal(grid: Grid, wavelength_m: float, seed: int, *, octaves: int = 3) -> Field:
    """Return noise in [-1, 1] summed over octaves, each half as wide and 0.6 times as strong as the one before."""
    total = np.zeros(grid.shape, dtype=np.float32)
    strength, whole = 1.0, 0.0
    for octave in range(octaves):
        total += np.float32(strength) * noise(grid, wavelength_m / 2**octave, seed + octave)
        strength, whole = strength * 0.6, whole + strength
    total /= np.float32(whole)
    return total


@lru_cache(maxsize=4)
def _tile(seed: int) -> Field:
    tile = np.random.default_rng(seed).standard_normal((_TILE_CELLS, _TILE_CELLS), dtype=np.float32)
    tile.flags.writeable = False
    return tile


def grain(grid: Grid, seed: int = 1) -> Field:
    """Return noise without correlation, standard deviation 1, shape (rows, cols); it repeats every 512 cells."""
    west = round(grid.west_m / grid.cell_size_m)
    north = -round(grid.north_m / grid.cell_size_m)
    rows = (north + np.arange(grid.rows)) % _TILE_CELLS
    cols = (west + np.arange(grid.cols)) % _TILE_CELLS
    return np.asarray(_tile(seed).take(cols, axis=1).take(rows, axis=0))
