# SPDX-License-Identifier: Apache-2.0
"""Segmented pictures to look at: the class that is drawn on top at each pixel, stored apart from the queries."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.parquet import read_table, write_table
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.painting import PAINT_ORDER, rgb_of
from sasgeo_bench.sensing.segmentation import CERTAIN, SILENT, Segmentation

MOST_PX: Final = 384  # along a side: they are shown small
NOTHING: Final = 0  # no class is likely
_HALF: Final = CERTAIN / 2
_VEIL: Final = 0.6  # of a class's colour over the picture
_LIGHT: Final = 0.5  # of the grey picture below is at least this
_MEND: Final = "remove this file and segment the pictures again"
_SCHEMA: Final = pa.schema(
    [("query_id", pa.string()), ("rows", pa.int32()), ("cols", pa.int32()), ("drawn", pa.binary())]
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Segmented:
    """What a segmenter says of a picture, reduced to one class a pixel.

    `drawn`, uint8 of shape (H, W), is 1 plus the position in `PAINT_ORDER` of the last class there with
    P(present) >= 0.5, `NOTHING` without one, and `SILENT` where no class has a prediction.

    >>> seen = Segmentation(classes=("green", "building"), probability_bytes=np.array([[[200, 200]], [[0, 200]]], "u1"))
    >>> [PAINT_ORDER[at - 1] for at in Segmented.of(seen).drawn[0]]
    ['green', 'building']
    """

    drawn: NDArray[np.uint8]

    @classmethod
    def of(cls, seen: Segmentation) -> Self:
        """Reduce a segmentation to at most `MOST_PX` pixels along a side; thin classes stay as they are sampled."""
        rows, cols = seen.shape
        step = -(-max(rows, cols) // MOST_PX)
        planes = seen.probability_bytes[:, ::step, ::step]
        drawn = np.full(planes.shape[1:], NOTHING, dtype=np.uint8)
        for number, name in enumerate(PAINT_ORDER, start=1):
            if name in seen.classes:
                plane = planes[seen.classes.index(name)]
                drawn[(plane >= _HALF) & (plane != SILENT)] = number
        drawn[(planes == SILENT).all(axis=0)] = SILENT
        return cls(drawn=drawn)

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the classes that are drawn anywhere."""
        return tuple(name for number, name in enumerate(PAINT_ORDER, start=1) if number in self.drawn)

    def over(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a picture, shape (H, W, 3), in light grey with the colours of the classes laid over it.

        >>> seen = Segmented(drawn=np.array([[NOTHING, 1]], dtype=np.uint8))
        >>> (seen.over(np.zeros((1, 2, 3), dtype=np.uint8)).std(axis=2) > 0).tolist()
        [[False, True]]
        """
        colours = {item.name: rgb_of(item.colour) for item in load_taxonomy().classes}
        drawn = cv2.resize(self.drawn, rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        grey = 255 * _LIGHT + (1 - _LIGHT) * rgb.mean(axis=2)
        # Colours in floating point would take 24 bytes of each pixel, and twice that on the way.
        found = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)
        for number, name in enumerate(PAINT_ORDER, start=1):
            here = drawn == number
            veiled = (1 - _VEIL) * grey[here][:, None] + _VEIL * 255 * np.array(colours[name])
            found[here] = np.rint(veiled)
        return found


def segmented_file(root: Path, queries_sha256: str) -> Path:
    """Return the file of the segmented pictures of a task: named by its queries, so that none of others is shown."""
    return root / "segmenters" / "pictures" / f"{queries_sha256}.parquet"


def write_segmented(path: Path, found: Mapping[str, Segmented]) -> None:
    """Write segmented pictures by query id, whole or not at all; raise `StoreError` if they cannot be written."""
    rows = [
        {
            "query_id": query_id,
            "rows": item.drawn.shape[0],
            "cols": item.drawn.shape[1],
            "drawn": zlib.compress(item.drawn.tobytes()),
        }
        for query_id, item in sorted(found.items())
    ]
    with fresh_file(path, mend="free some space and run again") as scratch:
        write_table(pa.Table.from_pylist(rows, schema=_SCHEMA), scratch)


def read_segmented(path: Path, query_id: str) -> Segmented | None:
    """Return the segmented picture of a query; None without one. Raise `StoreError` if the file is damaged."""
    if not path.is_file():
        return None
    table = read_table(path, mend=_MEND, columns=_SCHEMA.names)
    row = next((row for row in table.to_pylist() if row["query_id"] == query_id), None)
    if row is None:
        return None
    try:
        most = min(row["rows"], MOST_PX) * min(row["cols"], MOST_PX)
        drawn = np.frombuffer(zlib.decompressobj().decompress(row["drawn"], most), dtype=np.uint8)
        return Segmented(drawn=drawn.reshape(row["rows"], row["cols"]))
    except (ValueError, TypeError, zlib.error) as error:
        raise StoreError(f"{path} is damaged ({error}): {_MEND}") from error
