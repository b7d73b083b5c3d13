# SPDX-License-Identifier: Apache-2.0
"""Arrays in a folder, a file each, mapped into memory: opened at once, and read where they are looked at."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of


def save_arrays(folder: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name into a folder that is there; raise `OSError` if it cannot be written."""
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", values, allow_pickle=False)


def map_arrays(folder: Path, *names: str) -> dict[str, NDArray[Any]]:
    """Map arrays that `save_arrays` wrote into memory, read only; raise `StoreError` if one is missing or damaged.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_arrays(Path(folder), {"heights_m": np.array([3.5, 7.0])})
    ...     found = map_arrays(Path(folder), "heights_m")["heights_m"]
    ...     found.tolist(), found.flags.writeable
    ([3.5, 7.0], False)
    """
    found = {}
    for name in names:
        path = folder / f"{name}.npy"
        try:
            mapped = open_memmap(plain_file(path), mode="r")
        except Exception as error:  # NumPy parses a header as Python, which fails at damage with errors of many kinds
            raise StoreError(f"{path} is missing or damaged ({message_of(error)[:200]}): remove {folder}") from error
        found[name] = np.asarray(mapped)
    return found
