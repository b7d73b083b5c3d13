# SPDX-License-Identifier: Apache-2.0
"""SUES-200: four flying heights, which are reported one by one; as split by its authors' script, or raw."""

import re
from typing import Final

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.exchange.importers.items import Dataset, DatasetCard, Item
from sasgeo_bench.exchange.importers.reader import FolderReader, LabelFolder, read_labels

CARD: Final = DatasetCard(
    kind="sues-200",
    title="SUES-200",
    source="https://github.com/Reza-Zhu/SUES-200-Benchmark",
    licence="data for academic use; no licence file",
    attribution="Zhu, Yin, Yang, Wu: SUES-200, IEEE TCSVT 2023",
)
LAYOUT: Final = (
    "SUES-200 has Testing/150/query_drone and its like if split, satellite-view and drone_view_512 (or another name "
    "with 'drone') if raw"
)

_HEIGHTS: Final = ("150", "200", "250", "300")
_DIGITS: Final = 4
_TEST: Final = ("query_drone", "query_satellite", "gallery_drone", "gallery_satellite")
_RAW: Final = (
    "the raw layout says neither which labels are for training nor what is a query: all items are 'unsplit'; run the "
    "set's split_datasets.py to evaluate"
)


def read_sues(reader: FolderReader) -> Dataset:
    """Read the folder of SUES-200; raise `DatasetError`, which names what is missing."""
    if reader.has("Testing"):
        return Dataset(card=CARD, items=tuple(_split_items(reader)), notes=reader.notes())
    return Dataset(card=CARD, items=tuple(_raw_items(reader)), notes=(_RAW, *reader.notes()))


def _split_items(reader: FolderReader) -> list[Item]:
    heights = [height for height in _HEIGHTS if reader.has(f"Testing/{height}")]
    if not heights:
        first = f"Testing/{_HEIGHTS[0]}"
        raise reader.missing(first)
    folders = []
    for height in heights:
        folders += [_folder(f"Testing/{height}/{name}", height) for name in _TEST]
        training = (f"Training/{height}/{view}" for view in ("drone", "satellite"))
        folders += [_folder(name, height) for name in training if reader.has(name)]
    return [item for folder in folders for item in read_labels(reader, folder, digits=_DIGITS)]


def _folder(relative: str, height: str) -> LabelFolder:
    """Describe a folder of the split by its name; only drones have a flying height."""
    role, _, view = relative.rsplit("/", maxsplit=1)[1].rpartition("_")
    return LabelFolder(
        relative=relative,
        role="query" if role == "query" else "gallery" if role == "gallery" else "train",
        view=view,
        group=height,
        height_m=float(height) if view == "drone" else None,
    )


def _raw_items(reader: FolderReader) -> list[Item]:
    satellite = LabelFolder(relative="satellite-view", role="unsplit", view="satellite")
    items = read_labels(reader, satellite, digits=_DIGITS)
    drones = [name for name in reader.folders(".") if "drone" in name.lower()]
    if len(drones) != 1:
        raise DatasetError(
            f"{reader.root} holds {len(drones)} folders with 'drone' in their names, expected one: {LAYOUT}"
        )
    for label in reader.folders(drones[0]):
        for height in reader.folders(f"{drones[0]}/{label}"):
            items += _raw_drone_items(reader, f"{drones[0]}/{label}/{height}", label=label, height=height)
    return items


def _raw_drone_items(reader: FolderReader, relative: str, *, label: str, height: str) -> list[Item]:
    if not (re.fullmatch(rf"[0-9]{{{_DIGITS}}}", label) and height in _HEIGHTS):
        raise DatasetError(
            f"{relative} is no <4 digits>/<height> with a height of {', '.join(_HEIGHTS)}: remove it or rename it"
        )
    about = {"role": "unsplit", "view": "drone", "label": label, "group": height, "height_m": float(height)}
    return [Item(item_id=f"{relative}/{name}", **about) for name in reader.images(relative)]  # type: ignore[arg-type]
