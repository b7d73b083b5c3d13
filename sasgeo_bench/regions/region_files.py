# SPDX-License-Identifier: Apache-2.0
"""Read and write a region on disk: `region.json` and the files it names; written whole or not at all."""

import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import pyarrow as pa
import shapely

from sasgeo_bench.config import check_document
from sasgeo_bench.errors import ConfigError, GridError, StoreError
from sasgeo_bench.files.folders import FileRecord, file_record, sha256_of
from sasgeo_bench.files.json import read_json
from sasgeo_bench.files.parquet import CHECKED, MOST_VALUES, read_frame, read_table, write_frame
from sasgeo_bench.files.paths import given_path
from sasgeo_bench.osm.features import check_features
from sasgeo_bench.regions.imagery import ORTHO, Imagery
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE, SCHEMA_VERSION, Manifest, MapGraph, Region
from sasgeo_bench.texts import json_text

if TYPE_CHECKING:
    import geopandas as gpd
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray
    from pyproj import CRS

Table = TypeVar("Table", bound="pd.DataFrame")

MANIFEST: Final = "region.json"
LAYERS: Final = "layers.tif"
FEATURES: Final = "features.parquet"
NODES: Final = "nodes.parquet"
EDGES: Final = "edges.parquet"
PREVIEW: Final = "preview.png"
_ORIGIN: Final[Mapping[Any, Any]] = {"attribution": ATTRIBUTION, "licence": LICENCE}
_MEND: Final = "build the region again"


def write_tables(folder: Path, features: "gpd.GeoDataFrame", graph: MapGraph) -> None:
    """Write features, nodes and edges as (Geo)Parquet 1.1 into a folder."""
    geographic = {**CHECKED, "schema_version": "1.1.0"}
    _attributed(features).to_parquet(folder / FEATURES, write_covering_bbox=True, **geographic)
    _attributed(graph.nodes).to_parquet(folder / NODES, **geographic)
    write_frame(graph.edges, folder / EDGES, attrs=_ORIGIN)


def _attributed(table: Table) -> Table:
    """Return a shallow copy whose parquet file states attribution and licence (`attrs` in its metadata)."""
    shown = table.copy(deep=False)
    shown.attrs = dict(_ORIGIN)
    return shown


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `region.json`, the last file of a region: without it the folder is no region."""
    text = json_text(manifest.model_dump(mode="json"))
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def read_manifest(folder: Path) -> Manifest:
    """Read `region.json`; raise `StoreError` if it is missing, damaged or of another schema.

    >>> read_manifest(Path("nowhere"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: nowhere holds no region.json: build the region first
    """
    from pyproj import CRS  # noqa: PLC0415 - with GDAL and pandas the slowest import: only reading needs it
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    path = folder / MANIFEST
    if not path.is_file():
        message = f"{folder} holds no {MANIFEST}: build the region first"
        raise StoreError(message)
    content = read_json(path, mend=_MEND)
    found = content.get("schema_version") if isinstance(content, dict) else None
    if found != SCHEMA_VERSION:
        stated = "states no schema version" if found is None else f"has schema version {found!r}"
        message = f"{path} {stated}, this version reads {SCHEMA_VERSION}: {_MEND}"
        raise StoreError(message)
    try:
        manifest = check_document(content, Manifest, source=MANIFEST)
        _ = manifest.grid, shapely.from_wkt(manifest.coverage.wkt), CRS.from_epsg(manifest.epsg)
    except (ConfigError, GridError, CRSError, shapely.errors.ShapelyError) as error:
        message = f"{path} is damaged ({str(error)[:200]}): {_MEND}"
        raise StoreError(message) from error
    lost = [name for name in (LAYERS, FEATURES, NODES, EDGES) if name not in manifest.files]
    if lost:
        message = f"{path} is damaged (its files lack {lost[0]}): {_MEND}"
        raise StoreError(message)
    return manifest


def read_region(
    path: str | Path,
    *,
    around: Callable[[], AbstractContextManager[object]] = nullcontext,
    around_layer: Callable[[], AbstractContextManager[object]] = nullcontext,
    with_layers: bool = True,
) -> Region:
    """Read a region: its layers now, its features and graph when they are first used.

    All files are checked against their hashes now. Without `with_layers`, layers are read when they are first used,
    too, and `Region.layer` reads one of them alone: a country's take a gigabyte. `around` gives a context that is
    entered while something is read that the region keeps, `around_layer` one for a layer that it does not keep. Raise
    `StoreError` if a file is missing, changed or unreadable.
    """
    from sasgeo_bench.regions.layers import read_layers  # noqa: PLC0415 - imports GDAL

    folder = given_path(path)
    manifest = read_manifest(folder)
    for name in (LAYERS, FEATURES, NODES, EDGES):
        _check_file(folder / name, manifest.files[name])

    def layers() -> "NDArray[np.uint8]":
        """Read the layers when they are first used."""
        with around():
            return read_layers(folder / LAYERS)

    def layer(index: int) -> "NDArray[np.uint8]":
        """Read one layer whenever it is used."""
        with around_layer():
            found: NDArray[np.uint8] = read_layers(folder / LAYERS, bands=(index,))[0]
            return found

    def features() -> "gpd.GeoDataFrame":
        """Read the features when they are first used."""
        with around():
            return check_features(_read_geometry(folder / FEATURES))

    def graph() -> MapGraph:
        """Read the graph when it is first used."""
        with around():
            return MapGraph(nodes=_read_geometry(folder / NODES), edges=read_frame(folder / EDGES, mend=_MEND))

    return Region(
        manifest=manifest,
        layers=read_layers(folder / LAYERS) if with_layers else layers,
        features=features,
        graph=graph,
        coverage=shapely.from_wkt(manifest.coverage.wkt),
        imagery=_imagery(folder, manifest),
        read_layer=layer,
    )


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
    """Raise `StoreError` if the imagery of a map must not be passed on; call it before imagery leaves this machine."""
    if manifest.imagery is None or manifest.imagery.is_publishable:
        return
    kept = next(item for item in manifest.imagery.pictures if not item.publish)
    message = (
        f"{folder / ORTHO} holds {kept.file}, whose region file says publish = false (licence: {kept.licence}): leave "
        f"{manifest.id} out, or build it from a region file without [[imagery]]"
    )
    raise StoreError(message)


def _imagery(folder: Path, manifest: Manifest) -> Imagery | None:
    """Return what reads the imagery; its file is not opened."""
    if manifest.imagery is None:
        return None
    if ORTHO not in manifest.files:
        message = f"{folder / MANIFEST} is damaged (its files lack {ORTHO}): {_MEND}"
        raise StoreError(message)
    return Imagery(path=folder / ORTHO, file=manifest.files[ORTHO], record=manifest.imagery, epsg=manifest.epsg)


def read_features(folder: Path) -> "gpd.GeoDataFrame":
    """Read a region's features alone; raise `StoreError` as `read_region` does."""
    manifest = read_manifest(folder)
    _check_file(folder / FEATURES, manifest.files[FEATURES])
    return check_features(_read_geometry(folder / FEATURES))


def check_files(folder: Path) -> None:
    """Raise `StoreError` naming the first file of a region that is missing or differs from `region.json`."""
    for name, record in read_manifest(folder).files.items():
        _check_file(folder / name, record)


def _check_file(path: Path, record: FileRecord) -> None:
    """Refuse a file that differs from its record: nothing else protects a raster, or the footer of a GeoParquet."""
    if not path.is_file() or file_record(path) != record:
        message = f"{path} is missing, or not what {MANIFEST} says: {_MEND}"
        raise StoreError(message)


def _read_geometry(path: Path) -> "gpd.GeoDataFrame":
    """Read a table of geometry as `geopandas.read_parquet` does, which parses the same CRS anew for each table."""
    import geopandas as gpd  # noqa: PLC0415 - only tables of geometry need it
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    table = read_table(path, mend=_MEND, most_rows=MOST_VALUES)
    try:
        about = json.loads(table.schema.metadata[b"geo"])
        name = about["primary_column"]
        column = about["columns"][name]
        bounds = {each[0] for each in column.get("covering", {}).get("bbox", {}).values()}  # derived from the geometry
        frame = table.drop_columns(sorted(bounds)).to_pandas()
        frame[name] = shapely.from_wkb(frame[name].to_numpy())
        frame.attrs = json.loads(table.schema.metadata.get(b"PANDAS_ATTRS", b"{}"))
        return gpd.GeoDataFrame(frame, geometry=name, crs=_crs(json.dumps(column["crs"])))
    except (
        *(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError),
        *(pa.ArrowException, CRSError, shapely.errors.ShapelyError),
    ) as error:
        message = f"{path} cannot be read ({str(error)[:200]}): {_MEND}"
        raise StoreError(message) from error


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
