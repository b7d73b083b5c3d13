# SPDX-License-Identifier: Apache-2.0
"""DenseUAV: labels with one position each, in `Dense_GPS_ALL.txt`: longitude first, whatever its README says."""

import re
from dataclasses import replace
from typing import Final

import pyproj

from sasgeo_bench.core.errors import DatasetError, counted
from sasgeo_bench.exchange.importers.items import Dataset, DatasetCard, Item, Position
from sasgeo_bench.exchange.importers.reader import FolderReader, LabelFolder, read_labels, to_number

CARD: Final = DatasetCard(
    kind="dense-uav",
    title="DenseUAV",
    source="https://github.com/Dmmm1997/DenseUAV",
    licence="Apache-2.0 for code; ask the authors about the images",
    attribution="Dai et al.: Vision-Based UAV Self-Positioning in Low-Altitude Urban Environments, IEEE TIP 2024",
)
POSITIONS: Final = "Dense_GPS_ALL.txt"
LAYOUT: Final = (
    f"DenseUAV has {POSITIONS}, test/query_drone, test/gallery_satellite and their like, with folders 000000 ..."
)

_TEST: Final = ("query_drone", "query_satellite", "gallery_drone", "gallery_satellite")
_LINE: Final = re.compile(r"(?P<path>\S.*?)\s+E(?P<longitude>\S+)\s+N(?P<latitude>\S+)(\s+(?P<height>[^\sEN]\S*))?\s*")
_HEIGHT: Final = re.compile(r"H([0-9]{1,4})(_old)?\.\w+")
_SAME_M: Final = 1.0


def read_dense_uav(reader: FolderReader) -> Dataset:
    """Read the folder of DenseUAV; raise `DatasetError`, which names what is missing."""
    positions, notes = read_positions(reader)
    folders = [
        LabelFolder(
            relative=f"test/{name}", role="query" if name.startswith("query") else "gallery", view=name.split("_")[1]
        )
        for name in _TEST
    ]
    training = [LabelFolder(relative=f"train/{view}", role="train", view=view) for view in ("drone", "satellite")]
    folders += [folder for folder in training if reader.has(folder.relative)]
    items = [item for folder in folders for item in read_labels(reader, folder, digits=6)]
    return Dataset(card=CARD, items=tuple(_placed(item, positions) for item in items), notes=(*notes, *reader.notes()))


def _placed(item: Item, positions: dict[str, Position]) -> Item:
    if item.label not in positions:
        raise DatasetError(f"{POSITIONS} has no line for the label of {item.item_id}: copy the file again")
    height = _HEIGHT.fullmatch(item.item_id.rsplit("/", maxsplit=1)[1])
    height_m = float(height[1]) if height and item.view == "drone" else None
    return replace(item, position=positions[item.label], height_m=height_m)


def read_positions(reader: FolderReader) -> tuple[dict[str, Position], tuple[str, ...]]:
    """Return the position of each label, and notes; of several lines of a label the last one counts, as released.

    Raise `DatasetError` for a line that is not `<path> E<longitude> N<latitude> [height]`, or has no place on Earth.
    """
    found: dict[str, Position] = {}
    apart: set[str] = set()
    geodesic = pyproj.Geod(ellps="WGS84")
    for number, line in reader.lines(POSITIONS):
        label, position = _read_line(line, where=f"{POSITIONS} line {number}")
        before = found.get(label)
        if before is not None and before != position:
            ends = (before.longitude_deg, before.latitude_deg, position.longitude_deg, position.latitude_deg)
            if geodesic.inv(*ends)[2] > _SAME_M:
                apart.add(label)
        found[label] = position
    if not found:
        raise DatasetError(f"{POSITIONS} is empty: copy it again")
    note = (
        f"{counted(len(apart), 'label')} with lines in {POSITIONS} more than {_SAME_M:g} m apart: the last counts, as "
        "in the released code"
    )
    return found, (note,) if apart else ()


def _read_line(line: str, *, where: str) -> tuple[str, Position]:
    parts = _LINE.fullmatch(line)
    folders = parts["path"].replace("\\", "/").split("/") if parts else []
    if parts is None or len(folders) < 2:  # the label is the folder of the image
        raise DatasetError(
            f"{where}: expected '<folder>/<label>/<image> E<longitude> N<latitude> [height]', got {line[:80]!r}"
        )
    if parts["height"] is not None:
        to_number(parts["height"], where=f"{where}, height")
    longitude, latitude = (to_number(parts[name], where=f"{where}, {name}") for name in ("longitude", "latitude"))
    try:
        return folders[-2], Position(longitude_deg=longitude, latitude_deg=latitude)
    except DatasetError as error:
        raise DatasetError(f"{where}: {error}") from error
