# SPDX-License-Identifier: Apache-2.0
"""University-1652: `test/<role>_<view>/<4 digits>/*` and `train/<view>/<4 digits>/*`, without coordinates."""

from typing import Final

from sasgeo_bench.exchange.importers.items import Dataset, DatasetCard
from sasgeo_bench.exchange.importers.reader import FolderReader, LabelFolder, read_labels

CARD: Final = DatasetCard(
    kind="university-1652",
    title="University-1652",
    source="https://github.com/layumi/University1652-Baseline",
    licence="data on request from its authors, for research; no licence file",
    attribution="Zheng, Wei, Yang: University-1652, ACM Multimedia 2020",
)
LAYOUT: Final = "University-1652 has test/query_drone, test/gallery_satellite ... with folders 0000, 0001 ..."

_NEEDED: Final = ("query_drone", "gallery_satellite", "query_satellite", "gallery_drone")
_OPTIONAL: Final = ("query_street", "gallery_street")
_TRAINING: Final = ("drone", "satellite", "street", "google")
_LARGE: Final = "4K_drone"  # further queries of the same labels, at 4,096 pixels


def read_university(reader: FolderReader) -> Dataset:
    """Read the folder of University-1652; raise `DatasetError`, which names what is missing."""
    found = [_test_folder(name) for name in _NEEDED]
    found += [_test_folder(name) for name in _OPTIONAL if reader.has(f"test/{name}")]
    if reader.has(f"test/{_LARGE}"):
        found.append(LabelFolder(relative=f"test/{_LARGE}", role="query", view="drone_4k"))
    found += [
        LabelFolder(relative=f"train/{view}", role="train", view=view)
        for view in _TRAINING
        if reader.has(f"train/{view}")
    ]
    items = [item for folder in found for item in read_labels(reader, folder, digits=4)]
    return Dataset(card=CARD, items=tuple(items), notes=reader.notes())


def _test_folder(name: str) -> LabelFolder:
    role, view = name.split("_")
    return LabelFolder(relative=f"test/{name}", role="query" if role == "query" else "gallery", view=view)
