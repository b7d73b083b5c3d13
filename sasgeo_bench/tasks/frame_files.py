# SPDX-License-Identifier: Apache-2.0
"""Frames and their labels as rows of tables; apart from what they are, for segmenters know no table."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.core.parquet import open_table
from sasgeo_bench.tasks.frames import SIGMAS, Frame, FrameLabels

LABELS: Final = "labels.parquet"  # beside the truths: what is on each pixel of each frame

FRAME: Final = pa.struct(
    [
        ("picture", pa.binary()),
        ("width_px", pa.int32()),
        ("height_px", pa.int32()),
        *((name, pa.list_(pa.float64())) for name in ("focal_px", "centre_px", "distortion", "rotation")),
        *((name, pa.float64()) for name in ("east_m", "north_m", "height_m", *SIGMAS)),
    ]
)
LABEL_SCHEMA: Final = pa.schema(
    [
        ("query_id", pa.string()),
        ("frame", pa.int32()),
        ("rows", pa.int32()),
        ("cols", pa.int32()),
        ("classes", pa.list_(pa.string())),
        ("labels", pa.binary()),
    ]
)


def frame_row(frame: Frame) -> dict[str, object]:
    """Return a frame as a row of `FRAME`."""
    lens = frame.camera.intrinsics
    return {
        "picture": frame.picture,
        "width_px": lens.width_px,
        "height_px": lens.height_px,
        **{name: list(getattr(lens, name)) for name in ("focal_px", "centre_px", "distortion")},
        "rotation": list(frame.camera.rotation),
        **{name: getattr(frame.camera, name) for name in ("east_m", "north_m", "height_m")},
        **{name: getattr(frame, name) for name in SIGMAS},
    }


def frame_of(row: Mapping[str, Any]) -> Frame:
    """Return the frame of a row of `FRAME`; raise as `Frame` and its camera do."""
    from sasgeo_bench.sensing.camera import Camera, Intrinsics  # noqa: PLC0415 - see above

    lens = Intrinsics(
        width_px=row["width_px"],
        height_px=row["height_px"],
        **{name: tuple(row[name]) for name in ("focal_px", "centre_px", "distortion")},
    )
    stands = {name: row[name] for name in ("east_m", "north_m", "height_m")}
    camera = Camera(intrinsics=lens, rotation=tuple(row["rotation"]), **stands)
    return Frame(picture=row["picture"], camera=camera, **{name: row[name] for name in SIGMAS})


def label_row(query_id: str, number: int, item: FrameLabels) -> dict[str, object]:
    """Return the labels of one frame as a row of `LABEL_SCHEMA`."""
    return {
        "query_id": query_id,
        "frame": number,
        "rows": item.rows,
        "cols": item.cols,
        "classes": list(item.classes),
        "labels": item.packed,
    }


def read_labels(truth_folder: Path) -> Iterator[tuple[str, int, FrameLabels]]:
    """Yield query id, number of the frame and its labels, one at a time, in the order of the queries.

    Raise `StoreError` if the file is missing or damaged.
    """
    with open_table(truth_folder / LABELS, mend="make the queries again", is_whole=False) as source:
        for batch in source.iter_batches(batch_size=1):
            row = batch.to_pylist()[0]
            labels = FrameLabels(
                classes=tuple(row["classes"]), rows=row["rows"], cols=row["cols"], packed=row["labels"]
            )
            yield row["query_id"], row["frame"], labels
