# SPDX-License-Identifier: Apache-2.0
"""Read an OSM file into a feature table: read, classify, project, cut to the grid."""

import datetime as dt
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import geopandas as gpd
import numpy as np
import osmium
import pandas as pd
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CoverageError, ExtractError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.coverage import FULL_SHARE, LONGEST_M, M_PER_DEG, choose_coverage
from sasgeo_bench.osm.families import missing_families
from sasgeo_bench.osm.features import DTYPES, SEA, check_features, make_features
from sasgeo_bench.osm.geojson import classless, scan_geojson
from sasgeo_bench.osm.locate import ClassTable, CoverageSource
from sasgeo_bench.osm.mapped import Mapped, box_text, find_shore, lonlat_box, map_ground, project
from sasgeo_bench.osm.scan import DEFAULT_BRIDGE_WIDTH_M, Scan, ScanRow, Traits, joined_wkb, scan_file
from sasgeo_bench.osm.snapshot import Snapshot, elements, open_snapshot, own_id
from sasgeo_bench.osm.taxonomy import Label, Taxonomy, load_taxonomy
from sasgeo_bench.osm.vector import scan_vector

# Lines with the trait "through" lead somewhere: where they end at the edge of the data, the extract was cut there. Of
# 191 extracts with a box, those cut along a border have 2 to 11 such ends beyond the estimated area, or more than 0.38
# at its edge for each crossing of the box; those cut by a box have none beyond it and at most 0.25.
_MOST_OUTSIDE: Final = 1
_MOST_ENDS: Final = 0.3
# The box around a country or a town is crossed far less often than lines a little further inside.
_INSIDE: Final = 0.1  # of the box's width and height
_LEAST_CROSSED: Final = 0.3
_PROBES: Final = 64  # along each side of the box

Geometries = NDArray[np.object_]


def cuts_by_box(path: Path, scan: Scan, objects: Geometries) -> Callable[[shapely.Geometry, shapely.Geometry], bool]:
    """Return the function that tells whether an extract was cut by a box, from its content.

    `path` is a sorted file with one state of the world (`open_snapshot`), `scan` what was found in it, and `objects`
    the geometry of its rows and of all that lies far off, in longitude and latitude. The function gets the area that
    holds vertices (`estimate_coverage`) and the box of the header, or several boxes as one geometry.
    """

    def is_cut(found: shapely.Geometry, header: shapely.Geometry) -> bool:
        west, south, _, north = shapely.bounds(header)
        scale = np.array([np.cos(np.radians((south + north) / 2)), 1.0]) * M_PER_DEG

        def flat(geometry: Any) -> Any:  # noqa: ANN401 - one geometry or an array
            return shapely.transform(geometry, lambda lonlat: (lonlat - [west, south]) * scale)

        box, area = flat(header), flat(found)
        lines, ends = _through_ways(path, scan)
        ends = ends[_is_far_inside(flat(ends), area=area, box=box)]
        at_ends = objects[np.unique(overlapping(ends, objects)[1])]  # by their boxes: far fewer than all
        if _ends_inside(flat(lines), flat(ends), flat(at_ends), area=area, box=box):
            return False
        things = flat(objects)
        coast = flat(shapely.from_wkb(np.array(scan.coast, dtype=object)))
        sea = shapely.union_all(find_shore(coast, box).sea)
        # 0.25 of the box: around a small island in a large box there may be others, cut away
        is_shown = shapely.area(shapely.intersection(area, box)) >= 0.25 * shapely.area(box)
        if is_shown and _filled_share(things, area, box, sea) >= FULL_SHARE:
            return True
        tips = [mark for marks in scan.gaps.values() for mark in marks]
        return _is_crossed_all_round(things, flat(np.array(tips, dtype=object)), box, sea)

    return is_cut


def _through_ways(path: Path, scan: Scan) -> tuple[Geometries, Geometries]:
    """Return open ways of the classes that lead somewhere, and the ends at which they should meet others, degrees."""
    taxonomy = load_taxonomy()
    rules = [rule for name in taxonomy.having("through") for rule in taxonomy[name].rules if rule.geometry == "line"]
    wanted = osmium.filter.TagFilter(*((rule.key, value) for rule in rules for value in (*rule.widths, *rule.values)))  # noqa: PD011 - of a rule, not of a frame
    ways = osmium.FileProcessor(str(path), osmium.osm.WAY).with_filter(wanted).with_filter(scan.locator())
    found, is_stream = [], []
    for way in elements(ways):
        wkb = None if way.is_closed() else joined_wkb(way)
        if wkb is not None:
            found.append(wkb)
            is_stream.append("waterway" in way.tags)
    lines = np.asarray(shapely.from_wkb(np.array(found, dtype=object)), dtype=object)
    starts = shapely.get_point(lines[~np.array(is_stream, dtype=bool)], 0)  # streams begin anywhere
    return lines, np.concatenate([starts, shapely.get_point(lines, -1)])


def _is_far_inside(ends: Geometries, *, area: shapely.Geometry, box: shapely.Geometry) -> NDArray[np.bool_]:
    """Return which ends lie far from the sides of the box, and near the edge of the data or beyond it."""
    edge = shapely.boundary(area)
    shapely.prepare((edge, area))
    is_far = shapely.contains(box, ends) & (shapely.distance(ends, shapely.boundary(box)) > LONGEST_M)
    return np.asarray(is_far & (shapely.dwithin(edge, ends, LONGEST_M) | ~shapely.intersects(area, ends)))


def _ends_inside(
    lines: Geometries, ends: Geometries, objects: Geometries, *, area: shapely.Geometry, box: shapely.Geometry
) -> bool:
    """Return whether lines that lead somewhere end at the edge of the data instead: their ends far inside the box."""
    crossings = int(shapely.intersects(lines, shapely.boundary(box)).sum())
    end, _ = overlapping(ends, objects, predicate="intersects")
    loose = ends[np.bincount(end, minlength=len(ends)) <= 1]
    outside = int((~shapely.intersects(loose, area)).sum())
    return outside > _MOST_OUTSIDE or len(loose) > _MOST_ENDS * crossings


def _filled_share(objects: Geometries, area: shapely.Geometry, box: shapely.Geometry, sea: shapely.Geometry) -> float:
    """Return the share of the land in the box that holds vertices or lies inside a mapped area: a lake, a wood."""
    west, south, east, north = shapely.bounds(box)
    steps = (np.arange(_PROBES) + 0.5) / _PROBES
    xs, ys = np.meshgrid(west + steps * (east - west), south + steps * (north - south))
    probes = shapely.points(xs.ravel(), ys.ravel())
    probes = probes[shapely.intersects(probes, box) & ~shapely.intersects(probes, sea)]
    if len(probes) == 0:
        return 1.0
    is_filled = shapely.intersects(probes, area)
    areas = objects[shapely.get_dimensions(objects) == 2]  # polygons
    probe, _ = overlapping(probes, areas, predicate="intersects")
    is_filled[probe] = True
    return float(is_filled.mean())


def _is_crossed_all_round(objects: Geometries, tips: Geometries, box: shapely.Geometry, sea: shapely.Geometry) -> bool:
    """Return whether objects cross each side of the box that is not in the sea, as they cross lines a little inside."""
    west, south, east, north = shapely.bounds(box)
    if not shapely.equals(box, shapely.box(west, south, east, north)):
        return False  # several boxes
    inset = np.array([east - west, north - south]) * _INSIDE
    tree = shapely.STRtree(objects)

    def crossings(x: float, y: float) -> NDArray[np.int64]:
        corners = np.array([(west + x, south), (west + x, north), (east - x, south), (east - x, north),
                            (west, south + y), (east, south + y), (west, north - y), (east, north - y)])  # fmt: skip
        lines = shapely.linestrings(corners.reshape(4, 2, 2))
        line, _ = tree.query(lines, predicate="intersects")
        return np.bincount(line, minlength=4)

    sides = shapely.linestrings([[(west, south), (west, north)], [(east, south), (east, north)],
                                 [(west, south), (east, south)], [(west, north), (east, north)]])  # fmt: skip
    outer, inner = crossings(0.0, 0.0), crossings(*inset)
    outer += np.array([(shapely.distance(tips, side) <= LONGEST_M).sum() for side in sides])
    if not outer.any() or not ((outer > 0) | shapely.intersects(sides, sea)).all():
        return False
    # 30 crossings further inside: fewer are too few to compare
    return bool(inner.sum() < 30 or outer.sum() >= _LEAST_CROSSED * inner.sum())


_EPOCH: Final = dt.datetime(1970, 1, 2, tzinfo=dt.UTC)  # osmium returns 1970-01-01 if a file has no timestamps


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """The content of one extract for one grid.

    `coverage` lies in the grid's CRS and is cut to the grid. `unknown_m2` is the ground removed from it, by reason (one
    place may have two). `cuts` counts what an extract lost where it was cut out of a larger one. `drops`, `hidden` and
    `notes` count objects around the grid by reason. `osm_timestamp` is the newest time in the extract, None if it has
    none.
    """

    features: gpd.GeoDataFrame
    coverage: shapely.Geometry
    coverage_source: CoverageSource
    osm_timestamp: dt.datetime | None
    drops: dict[str, int]
    hidden: dict[str, int]
    notes: dict[str, int]
    warnings: tuple[str, ...]
    unknown_m2: dict[str, float] = field(default_factory=dict)
    cuts: dict[str, int] = field(default_factory=dict)

    def beside(self, other: Self) -> Self:
        """Return the content of two sources that share no class; mapped is the ground that both have."""
        taxonomy, table = load_taxonomy(), pd.concat([self.features, other.features])
        order = np.argsort([taxonomy.names.index(name) for name in table["class"]], kind="stable")
        return replace(
            self,
            features=check_features(table.iloc[order].reset_index(drop=True)),
            coverage=shapely.intersection(self.coverage, other.coverage),
            warnings=self.warnings + other.warnings,
            drops=dict(Counter(self.drops) + Counter(other.drops)),
            hidden=dict(Counter(self.hidden) + Counter(other.hidden)),
            notes=dict(Counter(self.notes) + Counter(other.notes)),
            unknown_m2=self.unknown_m2 | other.unknown_m2,
            cuts=dict(Counter(self.cuts) + Counter(other.cuts)),
        )

    def dated(self, snapshot: Snapshot) -> Self:
        """Return the content with the date and the warnings of the file that it was read from."""
        return replace(
            self, osm_timestamp=snapshot.replicated_at or self.osm_timestamp, warnings=snapshot.warnings + self.warnings
        )


def read_extract(
    path: Path,
    grid: Grid,
    *,
    at: dt.date | None = None,
    stated_coverage: shapely.Geometry | None = None,
    classes: Sequence[str] | None = None,
) -> Reading:
    """Read the features of one extract that touch a grid, in its CRS, with whole geometries, sorted by class and id.

    `at` cuts a full history (.osh.pbf) at the end of a day; any file is held against it (`misdated`).
    `stated_coverage` is the mapped area in longitude and latitude, if the user knows it. `classes` are those to keep,
    by default all. A node beyond the globe is removed from its ways and counted in `drops`.

    Raise `ExtractError` if the file is missing, damaged or of an unknown format, or an id, date or coordinate is not a
    number; `CoverageError` if the grid lies outside the extract, or no element of any class lies in it.
    """
    with open_snapshot(path, at=at) as snapshot:
        scan = scan_file(snapshot.path, load_taxonomy(), box=lonlat_box(grid))
        _check_nodes(path.name, scan)
        objects = _objects(scan)
        boxes = [shapely.box(*box) for box in snapshot.boxes_lonlat]
        header = shapely.union_all(boxes) if boxes else None
        area, source = choose_coverage(
            shapely.get_coordinates(objects),
            stated=stated_coverage,
            header=header,
            is_cut_by_box=cuts_by_box(snapshot.path, scan, objects),
        )
    mapped = _mapped(path.name, scan, grid, area=area, source=source, frame=header or _frame(objects))
    # Warning if a file cannot be of the day `at`, as `misdated` says
    newest = _newest(scan)
    days = {"newest": newest and newest.date(), "header": snapshot.replicated_at and snapshot.replicated_at.date()}
    warning = None if at is None else misdated(path.name, at, count=len(scan.rows), **days)
    warnings = (warning,) if warning else ()
    return _reading(path.name, scan, grid, mapped, objects=objects, classes=classes, warnings=warnings).dated(snapshot)


def read_geojson(
    files: Sequence[Path],
    grid: Grid,
    *,
    tags: Mapping[str, str],
    stated_coverage: shapely.Geometry,
    classes: Sequence[str] | None = None,
) -> Reading:
    """Read the features of GeoJSON files as `read_extract` reads an OSM file.

    `tags` are those that all features have. Raise `ExtractError` if a file is damaged, `CoverageError` as
    `read_extract`.
    """
    name, scan = files[0].name, scan_geojson(files, load_taxonomy(), tags=tags, box=lonlat_box(grid))
    objects = _objects(scan)
    mapped = _mapped(name, scan, grid, area=stated_coverage, source="region file", frame=_frame(objects))
    warning = classless(scan)
    return _reading(name, scan, grid, mapped, objects=objects, classes=classes, warnings=(warning,) if warning else ())


def read_vector(path: Path, grid: Grid, *, table: ClassTable, stated_coverage: shapely.Geometry) -> Reading:
    """Read a map of one's own by its table of classes, as `read_extract` reads an OSM file; raise as `scan_vector`."""
    scan, warnings = scan_vector(path, load_taxonomy(), table, grid=grid)
    objects, name = _objects(scan), path.name
    mapped = _mapped(name, scan, grid, area=stated_coverage, source="region file", frame=_frame(objects))
    return _reading(name, scan, grid, mapped, objects=objects, classes=table.named_classes, warnings=warnings)


def misdated(
    name: str, at: dt.date, *, newest: dt.date | None, header: dt.date | None = None, count: int = 0
) -> str | None:
    """Return a warning if a file cannot be of the day `at`; None if it can, or says nothing of its age.

    `newest` is the day of its newest object, `header` that of its header, `count` the number of its objects: a few may
    well stay as they are for more than a year.

    >>> misdated("a.osm.pbf", dt.date(1999, 1, 1), newest=dt.date(2013, 7, 19))
    'a.osm.pbf is dated 1999-01-01, and holds an object of 2013-07-19: state the day that it is of'
    >>> misdated("a.osm.pbf", dt.date(2013, 7, 19), newest=dt.date(2013, 7, 19))
    """
    mend = "state the day that it is of"
    # 2 days: a file may hold objects that are so much younger than its date: zones, slow downloads
    if newest is not None and (newest - at).days > 2:
        return f"{name} is dated {at}, and holds an object of {newest}: {mend}"
    last = max(filter(None, (newest, header)), default=None)
    # 366 days: where so many features stand, some change within a year
    # 300 objects; of 201 dated maps of all sizes the newest object is at most 61 days older than the date
    if last is not None and count >= 300 and (at - last).days > 366:
        return f"{name} is dated {at}, and nothing in it is younger than {last}: {mend}"
    return None


def _objects(scan: Scan) -> NDArray[np.object_]:
    return np.asarray(shapely.from_wkb(np.array([*(row.wkb for row in scan.rows), *scan.far], dtype=object)))


def _frame(objects: NDArray[np.object_]) -> shapely.Geometry:
    return shapely.box(*shapely.total_bounds(objects)) if len(objects) else shapely.Polygon()


def _mapped(
    name: str, scan: Scan, grid: Grid, *, area: shapely.Geometry, source: CoverageSource, frame: shapely.Geometry
) -> Mapped:
    """Return the mapped ground of a grid; raise `CoverageError` if there is none."""
    if area.is_empty:
        message = f"{name} holds no element of any class: is it an extract of map data?"
        if scan.rows or scan.far:
            message = f"{name} holds nothing within its own bounds, {box_text(frame.bounds)}: mend or remove them"
        raise CoverageError(message)
    mapped = map_ground(
        grid,
        area,
        source,
        coast=shapely.from_wkb(np.array(scan.coast, dtype=object)),
        gaps=np.array([mark for marks in scan.gaps.values() for mark in marks], dtype=object),
        frame=frame,
    )
    if mapped.coverage.is_empty and not mapped.unknown_m2:
        covered = box_text(shapely.bounds(area))
        raise CoverageError(
            f"bounds {box_text(lonlat_box(grid))} lie outside {name}, which covers {covered} (west, south, east, north)"
        )
    return mapped


def _reading(
    name: str,
    scan: Scan,
    grid: Grid,
    mapped: Mapped,
    *,
    objects: NDArray[np.object_],
    classes: Sequence[str] | None,
    warnings: tuple[str, ...] = (),
) -> Reading:
    """Turn what one pass found into features."""
    taxonomy, grid_lonlat = load_taxonomy(), lonlat_box(grid)
    geometry = objects[: len(scan.rows)]
    bounds = shapely.bounds(geometry)
    west, south, east, north = grid_lonlat
    near = np.asarray(
        (bounds[:, 0] <= east) & (bounds[:, 2] >= west) & (bounds[:, 1] <= north) & (bounds[:, 3] >= south)
    )
    features = _table(scan, np.flatnonzero(near), geometry[near], grid, taxonomy)
    features = _with_sea(features, mapped.sea, taxonomy)
    if classes is not None:
        features = features[features["class"].isin(list(classes)).to_numpy()].reset_index(drop=True)
    if len(features) == 0:
        of_class = "any class" if classes is None else f"class {', '.join(classes)}"
        message = f"{name} holds no element of {of_class} within {box_text(grid_lonlat)}: move or enlarge the bounds"
        if len(objects) and not near.any():
            message += f" (what it holds lies within {box_text(shapely.total_bounds(objects))})"
        raise CoverageError(message)
    kept = taxonomy.names if classes is None else classes
    built_up = project(shapely.from_wkb(np.array(scan.built_up, dtype=object)), grid.epsg)
    missing = missing_families(features, mapped.coverage, classes=kept, built_up=built_up)
    # Count the ways of a class in the whole extract that lack nodes; empty if none does
    partial = sum(bool(marks) for marks in scan.gaps.values())
    found = {"ways that lack some nodes": partial, "ways that lack all nodes": len(scan.gaps) - partial}
    return Reading(
        features=features,
        coverage=mapped.coverage,
        coverage_source=mapped.source,
        osm_timestamp=_newest(scan),
        drops=dict(scan.tally.drops.most_common()),
        hidden=dict(scan.tally.hidden.most_common()),
        notes=dict(scan.tally.notes.most_common()),
        warnings=(*warnings, *([missing] if missing else [])),
        unknown_m2=mapped.unknown_m2,
        cuts={what: count for what, count in found.items() if count},
    )


def _newest(scan: Scan) -> dt.datetime | None:
    return max((row.timestamp for row in scan.rows if row.timestamp > _EPOCH), default=None)


def _check_nodes(name: str, scan: Scan) -> None:
    """Refuse a file of which most ways lack their nodes: a filter has left them out."""
    lost = len(scan.gaps.keys() - {row.osm_id for row in scan.rows if not row.is_relation})
    ways = lost + len(scan.rows) + len(scan.far)
    if lost > 0.5 * ways:  # of the ways may lack their nodes; of 198 real extracts the most is 0.3
        raise ExtractError(
            f"{name} lacks the nodes of {lost} of its {ways} ways: they were filtered away; filter again and keep the "
            "nodes that ways refer to (osmium tags-filter without -R; Overpass: (._;>;); out;)"
        )


def _table(
    scan: Scan, picked: NDArray[np.int64], geometry: NDArray[np.object_], grid: Grid, taxonomy: Taxonomy
) -> gpd.GeoDataFrame:
    """Build one row for each picked object and class that touches the grid, sorted by class, type and id."""
    geometry = project(geometry, grid.epsg)
    touches = shapely.intersects(geometry, shapely.box(*grid.bounds_m))
    rows, geometry = [scan.rows[index] for index in picked[touches]], geometry[touches]
    pairs = [
        (index, _drawn(label, geometry[index]))
        for index, row in enumerate(rows)
        for label in scan.traits[row.kind].labels
    ]
    source = np.array([index for index, _ in pairs], dtype=np.int64)
    labels = [label for _, label in pairs]
    traits = [scan.traits[rows[index].kind] for index, _ in pairs]
    ids = np.array([own_id(row.osm_id) for row in rows], dtype=np.int64)[source]
    is_relation = np.array([row.is_relation for row in rows], dtype=bool)[source]
    class_ids = np.array([taxonomy.names.index(label.class_name) for label in labels], dtype=np.int64)
    order = np.lexsort((ids, is_relation, class_ids))
    columns: dict[str, object] = {
        "osm_type": np.where(is_relation, "relation", "way")[order],
        "osm_id": ids[order],
        "version": np.array([row.version for row in rows], dtype=np.int32)[source][order],
        "timestamp": _times(rows)[source][order],
        "class": np.array(taxonomy.names, dtype=object)[class_ids][order],
        "level": np.array([item.level for item in traits], dtype=np.int16)[order],
        "is_bridge": np.array([item.is_bridge for item in traits], dtype=bool)[order],
        "is_tunnel": np.array([item.is_tunnel for item in traits], dtype=bool)[order],
        "is_visible": np.array([item.hidden_by is None for item in traits], dtype=bool)[order],
        "width_m": np.array([_width_m(*pair) for pair in zip(labels, traits, strict=True)], dtype=np.float32)[order],
        "geometry": _shapes(geometry[source], labels)[order],
    }
    return make_features(columns, epsg=grid.epsg)


def _drawn(label: Label, shape: shapely.Geometry) -> Label:
    """Return how an object in metres is drawn: an area that is too wide to be what it says is an outline."""
    if label.fills_to_m is None or shapely.get_dimensions(shape) < 2:  # a line stays one
        return label
    is_wide = not shapely.is_empty(shapely.buffer(shape, -label.fills_to_m / 2))
    return replace(label, is_outline=label.is_outline or is_wide)


def _with_sea(features: gpd.GeoDataFrame, sea: NDArray[np.object_], taxonomy: Taxonomy) -> gpd.GeoDataFrame:
    """Add a row of class water for each polygon of sea, numbered from the largest; they have no date."""
    if len(sea) == 0:
        return features
    columns: dict[str, object] = {name: np.zeros(len(sea)) for name in DTYPES} | {
        "osm_type": [SEA] * len(sea),
        "osm_id": np.arange(len(sea)) + 1,
        "timestamp": np.full(len(sea), "NaT", dtype="datetime64[ms]"),
        "class": ["water"] * len(sea),
        "is_visible": True,
        "width_m": np.nan,
        "geometry": sea[np.argsort(-shapely.area(sea), kind="stable")],
    }
    table = pd.concat([features, make_features(columns, epsg=features.crs.to_epsg())])
    order = np.argsort([taxonomy.names.index(name) for name in table["class"]], kind="stable")
    return check_features(table.iloc[order].reset_index(drop=True))


def _times(rows: Sequence[ScanRow]) -> NDArray[np.datetime64]:
    known = [row.timestamp.replace(tzinfo=None) if row.timestamp > _EPOCH else None for row in rows]
    return np.array(known, dtype="datetime64[ms]")


def _width_m(label: Label, traits: Traits) -> float:
    """Return the drawn width of a line: as tagged, else of its class, else of the road or railway that it lies on."""
    if traits.is_area and not label.is_outline:
        return float("nan")
    if traits.width_m is not None and label.keeps_width:
        return traits.width_m
    if label.width_m is not None:
        return label.width_m
    return max((other.width_m for other in traits.labels if other.width_m is not None), default=DEFAULT_BRIDGE_WIDTH_M)


def _shapes(geometry: NDArray[np.object_], labels: list[Label]) -> NDArray[np.object_]:
    is_outline = np.array([label.is_outline for label in labels], dtype=bool)
    shaped = geometry.copy()
    shaped[is_outline] = shapely.boundary(geometry[is_outline])
    single = shapely.get_num_geometries(shaped) == 1
    shaped[single] = shapely.get_geometry(shaped[single], 0)
    return np.asarray(shaped)
