# SPDX-License-Identifier: Apache-2.0
"""Tiny folders laid out as those of other datasets, and rankings of them."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import rasterio
from rasterio.errors import NotGeoreferencedWarning

IMAGE = b"\xff\xd8\xff\xe0 no picture: importers open none"
FRAME_COLUMNS = "num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2"
MAP_COLUMNS = "mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region"
TESTS = ("query_drone", "query_satellite", "gallery_drone", "gallery_satellite")


def put(path: Path, content: bytes | str = IMAGE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_university(root: Path) -> Path:
    """Two places and a distractor (0002), which is in the galleries alone."""
    for name, labels in zip(TESTS, ((0, 1), (0, 1), (0, 1, 2), (0, 1, 2)), strict=True):
        for label in labels:
            put(root / "test" / name / f"{label:04}" / f"{label:04}.jpg")
    put(root / "test" / "query_drone" / "0000" / "image-02.jpeg")
    put(root / "train" / "street" / "0009" / "1.jpg")
    return root


def write_sues(root: Path, heights: Sequence[str] = ("150", "300")) -> Path:
    """As the authors' script splits it."""
    for height in heights:
        for name in TESTS:
            for label in ("0001", "0002"):
                put(root / "Testing" / height / name / label / "0.jpg")
        put(root / "Training" / height / "drone" / "0003" / "0.jpg")
    return root


def write_sues_raw(root: Path) -> Path:
    for label in ("0001", "0200"):
        put(root / "satellite-view" / label / "0.png")
        for height in ("150", "200", "250", "300"):
            put(root / "drone_view_512" / label / height / "0.jpg")
    return root


def write_dense(root: Path, places: Mapping[str, tuple[float, float]], *, queries: Sequence[str] = ()) -> Path:
    """One image for each label: longitude and latitude by label; all in the galleries, some asked for."""
    lines = []
    for label, (longitude, latitude) in places.items():
        for name in TESTS:
            if name.startswith("gallery") or label in (queries or places):
                put(root / "test" / name / label / ("H80.JPG" if name.endswith("drone") else "H80.tif"))
        lines.append(f"test/query_drone/{label}/H80.JPG E{longitude!r} N{latitude!r} 95.3")
    put(root / "Dense_GPS_ALL.txt", "\n".join(lines))
    return root


def write_flight(
    root: Path,
    flight: str,
    frames: Sequence[tuple[float, float]],
    *,
    columns: str = FRAME_COLUMNS,
    heading_deg: float = 350.0,
) -> None:
    """A flight of UAV-VisLoc: longitude and latitude of its frames; its map is written by `write_maps`."""
    lines = [columns]
    for at, (longitude, latitude) in enumerate(frames, start=1):
        name = f"{flight}_{at:04}.JPG"
        put(root / flight / "drone" / name)
        cells = [str(at), name, "2018-10-13", repr(latitude), repr(longitude), "520.5"]
        cells += ["1.5", "-2.5", repr(heading_deg), "7.0"]
        lines.append(",".join(cells[: len(columns.split(","))]))
    put(root / flight / f"{flight}.csv", "\n".join(lines))


def write_maps(root: Path, maps: Mapping[str, tuple[float, float, float, float]], *, size: tuple[int, int]) -> None:
    """Table of maps (west, south, east, north by name), and a black TIFF of a width and height for each flight."""
    lines = [MAP_COLUMNS]
    for name, (west, south, east, north) in maps.items():
        lines.append(f"satellite{name}.tif,{north!r},{west!r},{south!r},{east!r},Somewhere-1")
        folder = root / name[:2]
        if folder.is_dir():
            write_tiff(folder / f"satellite{name}.tif", *size)
    put(root / "satellite_coordinates_range.csv", "\n".join(lines))


def write_tiff(path: Path, width: int, height: int) -> None:
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "uint8", "sparse_ok": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile):
            pass


BOX = (116.0, 29.70, 116.04, 29.72)  # a map of 4 x 2 tiles of 512 pixels, 2 x 1 of 1024


def write_visloc(root: Path) -> Path:
    """Flight 01 with angles, 07 without; satellite12 is a row without a folder."""
    write_flight(root, "01", [(116.005, 29.715), (116.025, 29.705)])
    write_flight(root, "07", [(116.015, 29.715)], columns="num,filename,date,lat,lon,height")
    write_maps(root, {"01": BOX, "07": BOX, "12": BOX}, size=(2048, 1024))
    return root


def write_ranking(path: Path, answers: Mapping[str, Sequence[str]]) -> Path:
    """Gallery items by query, best first."""
    rows = [(query, answer, rank) for query, found in answers.items() for rank, answer in enumerate(found, start=1)]
    queries, gallery, ranks = zip(*rows, strict=True)
    pq.write_table(pa.table({"query_id": queries, "gallery_id": gallery, "rank": np.array(ranks)}), path)
    return path
