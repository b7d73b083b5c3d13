# SPDX-License-Identifier: Apache-2.0
"""`items.parquet` and `metrics.parquet`: what an import writes, each whole or not at all."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pyarrow as pa

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.parquet import write_frame, write_table
from sasgeo_bench.core.texts import json_text
from sasgeo_bench.exchange.importers.items import Dataset, Item, Position, UtmPlaces
from sasgeo_bench.exchange.importers.reports import Report

METRICS: Final = "metrics.parquet"
_MEND: Final = "check the free space and your rights, or name another --out"
_NAMES: Final = pa.dictionary(pa.int32(), pa.string())

ITEM_SCHEMA: Final = pa.schema(
    [
        ("item_id", pa.string()),
        ("role", _NAMES),
        ("view", _NAMES),
        ("label", pa.string()),
        ("group", _NAMES),
        ("longitude_deg", pa.float64()),
        ("latitude_deg", pa.float64()),
        ("epsg", pa.int32()),
        ("easting_m", pa.float64()),
        ("northing_m", pa.float64()),
        ("height_m", pa.float64()),
        ("heading_deg", pa.float64()),
        ("yaw_deg", pa.float64()),
        ("pitch_deg", pa.float64()),
        ("roll_deg", pa.float64()),
        ("taken_on", pa.date32()),
        ("west_deg", pa.float64()),
        ("south_deg", pa.float64()),
        ("east_deg", pa.float64()),
        ("north_deg", pa.float64()),
        ("attribution", _NAMES),
    ]
)


def items_table(dataset: Dataset) -> pa.Table:
    """Return the items as a table of `ITEM_SCHEMA`; null where the set says nothing.

    `yaw_deg` is the heading from grid north of the item's UTM zone: the heading less the meridian convergence.
    """
    items = dataset.items
    rows: dict[str, Sequence[Any]] = {
        name: [getattr(item, name) for item in items]
        for name in ("item_id", "role", "view", "label", "group", "height_m", "taken_on")
    }
    for name in ("longitude_deg", "latitude_deg"):
        rows[name] = [getattr(item.position, name, None) for item in items]
    for name in ("heading_deg", "pitch_deg", "roll_deg"):
        rows[name] = [getattr(item.attitude, name, None) for item in items]
    for name in ("west_deg", "south_deg", "east_deg", "north_deg"):
        rows[name] = [getattr(item.box, name, None) for item in items]
    rows["attribution"] = [dataset.card.attribution] * len(items)
    rows |= _utm_columns(items)
    card = dataset.card
    about = {
        "kind": card.kind,
        "title": card.title,
        "source": card.source,
        "licence": card.licence,
        "attribution": card.attribution,
        "notes": list(dataset.notes),
    }
    return pa.table(
        {field.name: pa.array(rows[field.name], type=field.type) for field in ITEM_SCHEMA},
        schema=ITEM_SCHEMA.with_metadata({"dataset": json_text(about)}),
    )


def _utm_columns(items: Sequence[Item]) -> dict[str, Sequence[Any]]:
    """Return EPSG code, easting, northing and yaw of each item, None where it has no place or no heading."""
    placed = [at for at, item in enumerate(items) if item.position is not None]
    positions: list[Position] = [item.position for item in items if item.position is not None]
    found = UtmPlaces.of(positions)
    rows: dict[str, list[Any]] = {name: [None] * len(items) for name in ("epsg", "easting_m", "northing_m", "yaw_deg")}
    for place, at in enumerate(placed):
        rows["epsg"][at] = int(found.epsg[place])
        rows["easting_m"][at] = float(found.easting_m[place])
        rows["northing_m"][at] = float(found.northing_m[place])
        attitude = items[at].attitude
        if attitude is not None and attitude.heading_deg is not None:
            rows["yaw_deg"][at] = float((attitude.heading_deg - found.convergence_deg[place]) % 360.0 % 360.0)
    return dict(rows)


def reports_frame(reports: Sequence[Report]) -> pd.DataFrame:
    """Return a row for each metric of each report; NaN where a value is None."""
    rows = [
        {
            "query_view": report.query_view,
            "gallery_view": report.gallery_view,
            "group": report.group,
            "queries": report.queries,
            "answered": report.answered,
            "without_positive": report.without_positive,
            "gallery": report.gallery,
            "metric": score.metric,
            "unit": score.unit,
            "released": np.nan if score.released is None else score.released,
            "corrected": np.nan if score.corrected is None else score.corrected,
            "difference": score.difference,
        }
        for report in reports
        for score in report.scores
    ]
    return pd.DataFrame(rows)


def import_folder(out: Path, dataset: Dataset, *, source: Path) -> Path:
    """Return where an import is written; raise `DatasetError` if that lies in the folder that is read."""
    target = out / "datasets" / dataset.card.kind
    if target.resolve().is_relative_to(source.resolve()):
        raise DatasetError(f"{target} lies in the folder that is read, {source}: name another --out")
    return target


def write_items(folder: Path, dataset: Dataset) -> Path:
    """Write `items.parquet`, replaced whole; raise `StoreError` if it cannot be written."""
    table, path = items_table(dataset), folder / "items.parquet"
    with fresh_file(path, mend=_MEND) as scratch:
        write_table(table, scratch)
    return path


def write_reports(folder: Path, dataset: Dataset, reports: Sequence[Report], *, rankings: Sequence[str]) -> Path:
    """Write `metrics.parquet`, replaced whole, with the SHA-256 of each ranking; raise `StoreError` if that fails."""
    path = folder / METRICS
    attrs = {
        "kind": dataset.card.kind,
        "source": dataset.card.source,
        "attribution": dataset.card.attribution,
        "rankings_sha256": list(rankings),
    }
    with fresh_file(path, mend=_MEND) as scratch:
        write_frame(reports_frame(reports), scratch, attrs=attrs)
    return path
