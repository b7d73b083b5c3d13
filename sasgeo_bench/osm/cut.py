# SPDX-License-Identifier: Apache-2.0
"""Cut a place out of an extract, with whole ways and whole multipolygons."""

import datetime as dt
from array import array
from pathlib import Path
from typing import Final

import numpy as np
import osmium
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.scan import Tally, line_wkb
from sasgeo_bench.osm.snapshot import Snapshot, elements, open_snapshot
from sasgeo_bench.osm.xml_text import Box

_AREAS: Final = ("multipolygon", "boundary", "building")  # types of relations that are read as areas
_AT_ONCE: Final = 50_000  # ways whose lines are in memory


def cut_extract(path: Path, target: Path, box: Box, *, at: dt.date | None = None) -> None:
    """Write what reaches into a box (west, south, east, north, degrees) to an extract of its own.

    These are ways, and relations of areas with all their ways, whose bounds meet the box, with all their nodes; the
    result is sorted and holds one state of the world. Its header states the box, as far as the extract's own goes, and
    the extract's date. `at` is the day to cut a full history at. Raise `ExtractError` as `open_snapshot` does.
    """
    with open_snapshot(path, at=at) as snapshot:
        kept = osmium.IdTracker()
        ids, bounds = _bounds_of_ways(snapshot.path)
        for way in ids[_meets(bounds, box)].tolist():
            kept.add_way(way)
        for item in elements(osmium.FileProcessor(str(snapshot.path), osmium.osm.RELATION)):
            if item.tags.get("type") not in _AREAS:
                continue
            ways = np.array([member.ref for member in item.members if member.type == "w"], dtype=np.int64)
            own = bounds[np.searchsorted(ids, ways[np.isin(ways, ids)])]
            if len(own) and _meets(np.concatenate([own[:, :2].min(axis=0), own[:, 2:].max(axis=0)])[None], box).any():
                kept.add_relation(item.id)
                for way in ways.tolist():
                    kept.add_way(way)
        kept.complete_backward_references(str(snapshot.path))
        with osmium.SimpleWriter(str(target), header=_header(snapshot, box), overwrite=True) as writer:
            for item in elements(osmium.FileProcessor(str(snapshot.path)).with_filter(kept.id_filter())):
                writer.add(item)


def _bounds_of_ways(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the ids of all ways with a node, ascending, and their bounds, degrees."""
    ids, lines, found = array("q"), list[bytes](), [np.empty((0, 4))]
    source = osmium.FileProcessor(str(path), osmium.osm.NODE | osmium.osm.WAY).with_locations()
    for way in elements(source.with_filter(osmium.filter.EntityFilter(osmium.osm.WAY))):
        line = line_wkb(way, Tally())
        if line is not None:
            ids.append(way.id)
            lines.append(line)
        if len(lines) == _AT_ONCE:
            found.append(shapely.bounds(shapely.from_wkb(lines)))
            lines.clear()
    if lines:
        found.append(shapely.bounds(shapely.from_wkb(lines)))
    return np.array(ids, dtype=np.int64), np.concatenate(found)


def _meets(bounds: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    west, south, east, north = bounds.T
    return np.asarray((west <= box[2]) & (east >= box[0]) & (south <= box[3]) & (north >= box[1]))


def _header(snapshot: Snapshot, box: Box) -> osmium.io.Header:
    header = osmium.io.Header()
    header.set("sorting", "Type_then_ID")
    for stated in snapshot.boxes_lonlat or (box,):
        within = shapely.intersection(shapely.box(*stated), shapely.box(*box))
        if within.area:
            header.add_box(osmium.osm.Box(*within.bounds))
    if snapshot.replicated_at is not None:
        header.set("osmosis_replication_timestamp", f"{snapshot.replicated_at.astimezone(dt.UTC):%Y-%m-%dT%H:%M:%SZ}")
    return header
