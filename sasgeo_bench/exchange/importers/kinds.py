# SPDX-License-Identifier: Apache-2.0
"""The datasets that can be imported, by their name on the command line."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.exchange.importers import dense_uav, sues, university, visloc
from sasgeo_bench.exchange.importers.items import Dataset, DatasetCard
from sasgeo_bench.exchange.importers.reader import FolderReader


@dataclass(frozen=True, slots=True, kw_only=True)
class Importer:
    """How one kind of dataset is read: its card, what its folder holds, and the function that reads it."""

    card: DatasetCard
    layout: str
    read: Callable[[FolderReader], Dataset]


IMPORTERS: Final[Mapping[str, Importer]] = {
    importer.card.kind: importer
    for importer in (
        Importer(card=university.CARD, layout=university.LAYOUT, read=university.read_university),
        Importer(card=sues.CARD, layout=sues.LAYOUT, read=sues.read_sues),
        Importer(card=dense_uav.CARD, layout=dense_uav.LAYOUT, read=dense_uav.read_dense_uav),
        Importer(card=visloc.CARD, layout=visloc.LAYOUT, read=visloc.read_visloc),
    )
}


def read_dataset(folder: Path, kind: str) -> Dataset:
    """Read a folder of another benchmark's data; nothing in it is changed.

    Raise `DatasetError`, in one line that names the file, if there is no such kind, or the folder is not laid out as
    its kind says.

    >>> from pathlib import Path
    >>> read_dataset(Path("data"), "denseuav")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.DatasetError: there is no kind of dataset 'denseuav', did you mean 'dense-uav'? There are
    university-1652, sues-200, dense-uav, uav-visloc
    """
    if kind not in IMPORTERS:
        near = difflib.get_close_matches(kind, IMPORTERS, n=1)
        hint = f", did you mean {near[0]!r}?" if near else "."
        raise DatasetError(f"there is no kind of dataset {kind!r}{hint} There are {', '.join(IMPORTERS)}")
    importer = IMPORTERS[kind]
    return importer.read(FolderReader(folder, layout=importer.layout))
