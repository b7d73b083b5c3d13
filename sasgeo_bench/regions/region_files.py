# SPDX-License-Identifier: Apache-2.0
"""Read and write a region on disk: `region.json` and the files it names; written whole or not at all."""

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import pyarrow as pa
import shapely

from sasgeo_bench.core.config import check_document
from sasgeo_bench.core.errors import ConfigError, GridError, StoreError
from sasgeo_bench.core.folders import FileRecord, file_record, fresh_file, sha256_of
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.parquet import (
    CHECKED,
    MOST_VALUES,
    as_frame,
    read_frame,
    read_kept,
    read_schema,
    read_table,
    write_frame,
)
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.texts import json_text, message_of
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import check_features
from sasgeo_bench.regions.imagery import ORTHO, Imagery
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE, SCHEMA_VERSION, Manifest, MapGraph, Region

if TYPE_CHECKING:
    import geopandas as gpd
    import pandas as pd
    from numpy.typing import NDArray
    from pyproj import CRS

Table = TypeVar("Table", bound="pd.DataFrame")
Bounds = tuple[float, float, float, float]  # west, south, east, north, metres

MANIFEST: Final = "region.json"
LAYERS: Final = "layers.tif"
FEATURES: Final = "features.parquet"
NODES: Final = "nodes.parquet"
EDGES: Final = "edges.parquet"
PREVIEW: Final = "preview.png"
GROUP_ROWS: Final = 2**15  # of features or nodes that are read at once: a town has fewer
_MEND: Final = "build the region again"
_UTM: Final = frozenset((*range(32601, 32661), *range(32701, 32761)))  # codes of its zones, north and south


def write_tables(
    folder: Path,
    features: "gpd.GeoDataFrame",
    graph: MapGraph,
    *,
    credit: str = ATTRIBUTION,
    licence: str = LICENCE,
) -> None:
    """Write features, nodes and edges as (Geo)Parquet 1.1 into a folder.

    Features that fill several row groups are put in order along a Hilbert curve: a part of a map lies in few of them.
    """
    if len(features) > GROUP_ROWS:
        features = features.iloc[np.argsort(features.hilbert_distance().to_numpy(), kind="stable")]
    geographic = {**CHECKED, "schema_version": "1.1.0", "row_group_size": GROUP_ROWS}
    origin: Mapping[Any, Any] = {"attribution": credit, "licence": licence}
    geometric = _attributed(features.reset_index(drop=True), origin)
    geometric.to_parquet(folder / FEATURES, write_covering_bbox=True, **geographic)
    _attributed(graph.nodes, origin).to_parquet(folder / NODES, **geographic)
    write_frame(graph.edges, folder / EDGES, attrs=origin)


def _attributed(table: Table, origin: Mapping[Any, Any]) -> Table:
    """Return a shallow copy whose parquet file states attribution and licence (`attrs` in its metadata)."""
    shown = table.copy(deep=False)
    shown.attrs = dict(origin)
    return shown


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `region.json`, the last file of a region: without it the folder is no region."""
    with fresh_file(folder / MANIFEST, mend="check the free space and your rights") as path:
        path.write_text(json_text(manifest.model_dump(mode="json")), encoding="utf-8")


def read_manifest(folder: Path) -> Manifest:
    """Read `region.json`; raise `StoreError` if it is missing, damaged or of another schema.

    >>> read_manifest(Path("nowhere"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.StoreError: nowhere holds no region.json: build the region first
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise StoreError(f"{folder} holds no {MANIFEST}: build the region first")
    content = read_json(path, mend=_MEND)
    found = content.get("schema_version") if isinstance(content, dict) else None
    if found != SCHEMA_VERSION:
        stated = "states no schema version" if found is None else f"has schema version {found!r}"
        raise StoreError(f"{path} {stated}, this version reads {SCHEMA_VERSION}: {_MEND}")
    try:
        manifest = check_document(content, Manifest, source=MANIFEST)
        shapely.from_wkt(manifest.coverage.wkt)
        _check_epsg(manifest.epsg)
        _check_bounds(manifest)
    except (ConfigError, GridError, shapely.errors.ShapelyError) as error:
        raise StoreError(f"{path} is damaged ({str(error)[:200]}): {_MEND}") from error
    lost = [name for name in (LAYERS, FEATURES, NODES, EDGES) if name not in manifest.files]
    if lost:
        raise StoreError(f"{path} is damaged (its files lack {lost[0]}): {_MEND}")
    return manifest


def _check_epsg(epsg: int) -> None:
    """Refuse a code that EPSG does not know; it is asked about those alone that are no zone of UTM."""
    if epsg in _UTM:
        return
    from pyproj import CRS  # noqa: PLC0415 - with GDAL and pandas the slowest import
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        CRS.from_epsg(epsg)
    except CRSError as error:
        raise GridError(message_of(error)) from error


def _check_shape(path: Path, shape: tuple[int, int, int]) -> None:
    """Refuse a raster of other layers, rows or columns than the manifest says: arrays are made by these."""
    from tifffile import TiffFile  # noqa: PLC0415 - reads a head in a tenth of the time that GDAL takes to import

    try:
        with TiffFile(path) as file:
            page = file.pages.first
            found = (page.samplesperpixel, page.imagelength, page.imagewidth)
    except Exception as error:  # its errors are of many kinds
        raise StoreError(f"{path} cannot be read ({message_of(error)[:200]}): {_MEND}") from error
    if found != shape:
        raise StoreError(f"{path} has layers, rows and columns {found}, its region {shape}: {_MEND}")


def _check_bounds(manifest: Manifest) -> None:
    """Refuse rows and columns that are not those of the bounds: arrays are made by them before a file is opened."""
    grid, (west_m, south_m, east_m, north_m) = manifest.grid, manifest.bounds_m
    rows, cols = (north_m - south_m) / grid.cell_size_m, (east_m - west_m) / grid.cell_size_m
    if not (abs(rows - grid.rows) < 0.5 and abs(cols - grid.cols) < 0.5):  # of a cell
        raise GridError(f"it has {grid.rows} x {grid.cols} cells, its bounds hold {rows:.0f} x {cols:.0f}")


def read_region(
    path: str | Path,
    *,
    bounds_m: Bounds | None = None,
    around: Callable[[], AbstractContextManager[object]] = nullcontext,
    around_layer: Callable[[], AbstractContextManager[object]] = nullcontext,
    with_layers: bool = True,
) -> Region:
    """Read a region, or a part of it: its layers now, its features and graph when they are first used.

    Parameters
    ----------
    path : str or Path
        Folder of the region.
    bounds_m : tuple of float, optional
        West, south, east, north of the part, metres in the region's CRS; by default all of the map, beyond whose edge
        no part reaches. The part has every cell that they touch, whole features that meet these cells, the nodes among
        them, numbered anew, and the edges between those. No more is read, but to check the hashes: of a country a town
        takes the memory of a town. What the manifest counts is of the whole map.
    around, around_layer : callable
        Give a context that is entered while something is read that the region keeps, and one for a layer that it does
        not keep.
    with_layers : bool
        Without, layers are read when they are first used, too, and `Region.layer` reads one of them alone: a country's
        take a gigabyte.

    Raises
    ------
    StoreError
        If a file is missing, changed or unreadable: all are checked against their hashes now.
    GridError
        If the bounds are no box, or lie beyond the map.
    """
    folder = given_path(path)
    manifest = read_manifest(folder)
    for name in (LAYERS, FEATURES, NODES, EDGES):
        _check_file(folder / name, manifest.files[name])
    _check_shape(folder / LAYERS, (len(manifest.classes), manifest.rows, manifest.cols))
    coverage, window, box = shapely.from_wkt(manifest.coverage.wkt), None, None
    if bounds_m is not None:
        window = _window(manifest.grid, bounds_m)
        manifest = manifest.of_part(manifest.grid.window(*window))
        box = manifest.bounds_m
        coverage = shapely.intersection(coverage, shapely.box(*box))

    def read(bands: tuple[int, ...] | None = None) -> "NDArray[np.uint8]":
        from sasgeo_bench.regions.layers import read_layers  # noqa: PLC0415 - imports GDAL

        return read_layers(folder / LAYERS, window=window, bands=bands)

    def layers() -> "NDArray[np.uint8]":
        with around():
            return read()

    def layer(index: int) -> "NDArray[np.uint8]":
        with around_layer():
            found: NDArray[np.uint8] = read((index,))[0]
            return found

    def features() -> "gpd.GeoDataFrame":
        with around():
            return check_features(_read_geometry(folder / FEATURES, box))

    def graph() -> MapGraph:
        with around():
            nodes = _read_geometry(folder / NODES, box)
            if box is None:
                return MapGraph(nodes=nodes, edges=read_frame(folder / EDGES, mend=_MEND))
            edges = _edges_between(nodes["id"].to_numpy(), folder / EDGES)
            return MapGraph(nodes=nodes.assign(id=np.arange(len(nodes))), edges=edges)

    return Region(
        manifest=manifest,
        layers=read() if with_layers else layers,
        features=features,
        graph=graph,
        coverage=coverage,
        imagery=_imagery(folder, manifest),
        read_layer=layer,
    )


def _window(grid: Grid, bounds_m: Bounds) -> tuple[int, int, int, int]:
    """Return first row and column, rows and columns of the cells that bounds touch; cut at the edge of the map."""
    try:
        west_m, south_m, east_m, north_m = map(float, bounds_m)
    except (TypeError, ValueError):
        west_m = south_m = east_m = north_m = math.nan
    if not all(map(math.isfinite, (west_m, south_m, east_m, north_m))):
        raise GridError(f"bounds_m are west, south, east, north, finite metres in the CRS of the map, got {bounds_m!r}")
    part = Grid.from_bounds(west_m, south_m, east_m, north_m, cell_size_m=grid.cell_size_m, epsg=grid.epsg)
    top, left = (
        round(shift_m / grid.cell_size_m) for shift_m in (grid.north_m - part.north_m, part.west_m - grid.west_m)
    )
    row, col = max(top, 0), max(left, 0)
    rows, cols = min(top + part.rows, grid.rows) - row, min(left + part.cols, grid.cols) - col
    if rows < 1 or cols < 1:
        raise GridError(
            f"the bounds {tuple(bounds_m)} lie beyond the map: it has {grid.bounds_m} (west, south, east, north, "
            f"metres in EPSG:{grid.epsg})"
        )
    return row, col, rows, cols


def _edges_between(ids: "NDArray[np.int64]", path: Path) -> "pd.DataFrame":
    """Read the edges between some nodes, by their numbers in ascending order; they refer to their places among them."""
    table = read_kept(
        path,
        mend=_MEND,
        keep=lambda part: pa.array(np.isin(part["source"], ids) & np.isin(part["target"], ids)),
    )
    edges = as_frame(table, path, mend=_MEND)
    return edges.assign(**{end: np.searchsorted(ids, edges[end].to_numpy()) for end in ("source", "target")})


def read_imagery(path: str | Path) -> Imagery | None:
    """Return the imagery of a region without reading its map; None if it has none.

    Raise `StoreError` if the folder is no region, or its imagery is missing or changed.
    """
    folder = given_path(path)
    imagery = _imagery(folder, read_manifest(folder))
    if imagery is not None:
        imagery.check()
    return imagery


def check_publishable(folder: Path, manifest: Manifest) -> None:
    """Raise `StoreError` if a map or its imagery must not be passed on; call it before it leaves this machine."""
    own = next((item for item in manifest.own_maps if not item.publish), None)
    if own is not None:
        raise StoreError(
            f"{folder} is made of {own.file}, whose region file says publish = false (licence: {own.licence}): leave "
            f"{manifest.id} out, or build it from a region file without that [[own_map]]"
        )
    if manifest.imagery is None or manifest.imagery.is_publishable:
        return
    kept = next(item for item in manifest.imagery.pictures if not item.publish)
    raise StoreError(
        f"{folder / ORTHO} holds {kept.file}, whose region file says publish = false (licence: {kept.licence}): leave "
        f"{manifest.id} out, or build it from a region file without [[imagery]]"
    )


def _imagery(folder: Path, manifest: Manifest) -> Imagery | None:
    """Return what reads the imagery; its file is not opened."""
    if manifest.imagery is None:
        return None
    if ORTHO not in manifest.files:
        raise StoreError(f"{folder / MANIFEST} is damaged (its files lack {ORTHO}): {_MEND}")
    return Imagery(path=folder / ORTHO, file=manifest.files[ORTHO], record=manifest.imagery, epsg=manifest.epsg)


def read_features(folder: Path) -> "gpd.GeoDataFrame":
    """Read a region's features alone; raise `StoreError` as `read_region` does."""
    manifest = read_manifest(folder)
    _check_file(folder / FEATURES, manifest.files[FEATURES])
    return check_features(_read_geometry(folder / FEATURES))


def check_files(folder: Path, names: Collection[str] | None = None) -> None:
    """Raise `StoreError` naming the first file of a region, or of `names`, that differs from `region.json`."""
    for name, record in read_manifest(folder).files.items():
        if names is None or name in names:
            _check_file(folder / name, record)


def _check_file(path: Path, record: FileRecord) -> None:
    """Refuse a file that differs from its record: nothing else protects a raster, or the footer of a GeoParquet."""
    if not path.is_file() or path.stat().st_size != record.bytes or file_record(path) != record:
        raise StoreError(f"{path} is missing, or not what {MANIFEST} says: {_MEND}")


def _read_geometry(path: Path, box: Bounds | None = None) -> "gpd.GeoDataFrame":
    """Read a table of geometry as `geopandas.read_parquet` does, which parses the same CRS anew for each table."""
    # Of a `box` read what meets it alone: row groups, and rows, are chosen by the boxes of their shapes.
    import geopandas as gpd  # noqa: PLC0415 - only tables of geometry need it
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        table = read_table(path, mend=_MEND, most_rows=MOST_VALUES) if box is None else _read_near(path, box)
        about = json.loads(table.schema.metadata[b"geo"])
        name = about["primary_column"]
        column = about["columns"][name]
        bounds = {each[0] for each in column.get("covering", {}).get("bbox", {}).values()}  # derived from the geometry
        frame = table.drop_columns(sorted(bounds)).to_pandas()
        frame[name] = shapely.from_wkb(frame[name].to_numpy())
        if box is not None:
            frame = frame[shapely.intersects(frame[name].to_numpy(), shapely.box(*box))].reset_index(drop=True)
        frame.attrs = json.loads(table.schema.metadata.get(b"PANDAS_ATTRS", b"{}"))
        return gpd.GeoDataFrame(frame, geometry=name, crs=_crs(json.dumps(column["crs"])))
    except StoreError:
        raise
    except (
        *(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError),
        *(pa.ArrowException, CRSError, shapely.errors.ShapelyError),
    ) as error:
        raise StoreError(f"{path} cannot be read ({str(error)[:200]}): {_MEND}") from error


def _read_near(path: Path, box: Bounds) -> pa.Table:
    """Read the rows of a GeoParquet file whose bounding boxes meet a box; all rows of a file that has none."""
    about = json.loads(read_schema(path, mend=_MEND).metadata[b"geo"])
    covering = about["columns"][about["primary_column"]].get("covering", {}).get("bbox")
    if covering is None:
        return read_table(path, mend=_MEND, most_rows=MOST_VALUES)
    west, south, east, north = box

    def may_hold(ranges: Mapping[str, tuple[Any, Any]]) -> bool:
        """Return whether the boxes of a row group may meet the box."""
        west_most, south_most, east_most, north_most = (
            ranges.get(".".join(covering[side]), (-math.inf, math.inf)) for side in ("xmin", "ymin", "xmax", "ymax")
        )
        across = west_most[0] <= east and east_most[1] >= west
        return bool(across and south_most[0] <= north and north_most[1] >= south)

    def keep(part: pa.Table) -> pa.BooleanArray:
        xmin, ymin, xmax, ymax = (_numbers_at(part, covering[side]) for side in ("xmin", "ymin", "xmax", "ymax"))
        return pa.array((xmin <= east) & (xmax >= west) & (ymin <= north) & (ymax >= south))

    return read_kept(path, mend=_MEND, keep=keep, may_hold=may_hold)


def _numbers_at(part: pa.Table, place: Sequence[str]) -> "NDArray[np.float64]":
    """Return the numbers of a column, or of a field inside it; NaN for null."""
    column = part[place[0]].combine_chunks()
    for name in place[1:]:
        column = column.field(name)
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)


@cache
def _crs(projjson: str) -> "CRS":
    """Parse a CRS, once: it takes as long as the table of a town."""
    from pyproj import CRS  # noqa: PLC0415

    return CRS.from_json(projjson)


def differing_files(folder: Path) -> list[str]:
    """Compare every file of a region with its manifest; return a line for each that is missing, changed or unknown.

    Each line begins with the path of the file and ends with what to do about it.
    """
    manifest = read_manifest(folder)
    found = []
    for name, record in manifest.files.items():
        path = folder / name
        if not path.is_file():
            found.append(f"{path}: missing: {_MEND}")
        elif path.stat().st_size != record.bytes:
            found.append(f"{path}: {path.stat().st_size} bytes, the manifest says {record.bytes}: {_MEND}")
        elif sha256_of(path) != record.sha256:
            found.append(f"{path}: SHA-256 is {sha256_of(path)}, the manifest says {record.sha256}: {_MEND}")
    known = {MANIFEST, *manifest.files}
    others = [path for path in sorted(folder.iterdir()) if path.name not in known]
    return found + [f"{path}: not in the manifest: move it away" for path in others]
