# SPDX-License-Identifier: Apache-2.0
"""A region on disk: `region.json` and the files it names; written whole or not at all."""

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import geopandas as gpd
import pandas as pd
import pyarrow as pa
import shapely
from filelock import FileLock, Timeout
from pyproj import CRS
from pyproj.exceptions import CRSError

from sasgeo_bench.errors import ConfigError, GridError, StoreError
from sasgeo_bench.features import check_features
from sasgeo_bench.graph import MapGraph
from sasgeo_bench.region import ATTRIBUTION, LICENCE, SCHEMA_VERSION, FileRecord, Manifest, Region
from sasgeo_bench.store.jsonfile import read_json
from sasgeo_bench.store.layerfile import read_layers
from sasgeo_bench.store.parquetfile import CHECKED, MOST_VALUES, VERIFIED, open_table, read_frame, write_frame
from sasgeo_bench.texts import json_text
from sasgeo_bench.tomlfile import check_document

Table = TypeVar("Table", bound=pd.DataFrame)

MANIFEST: Final = "region.json"
LAYERS: Final = "layers.tif"
FEATURES: Final = "features.parquet"
NODES: Final = "nodes.parquet"
EDGES: Final = "edges.parquet"
PREVIEW: Final = "preview.png"
_SAID: Final[Mapping[Any, Any]] = {"attribution": ATTRIBUTION, "licence": LICENCE}
_MEND: Final = "build the region again"


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal, read in pieces.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "empty").write_bytes(b"")
    ...     sha256_of(Path(folder) / "empty")[:8]
    'e3b0c442'
    """
    with path.open("rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()


def file_record(path: Path) -> FileRecord:
    """Size and hash of a file."""
    return FileRecord(sha256=sha256_of(path), bytes=path.stat().st_size)


def write_tables(folder: Path, features: gpd.GeoDataFrame, graph: MapGraph) -> None:
    """Write features, nodes and edges as (Geo)Parquet 1.1 into a folder."""
    geographic = {**CHECKED, "schema_version": "1.1.0"}
    _attributed(features).to_parquet(folder / FEATURES, write_covering_bbox=True, **geographic)
    _attributed(graph.nodes).to_parquet(folder / NODES, **geographic)
    write_frame(graph.edges, folder / EDGES, attrs=_SAID)


def _attributed(table: Table) -> Table:
    """A view of the table whose parquet file says where its data come from (`attrs` in the file's metadata)."""
    shown = table.copy(deep=False)
    shown.attrs = dict(_SAID)
    return shown


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `region.json`, the last file of a region: without it the folder is no region."""
    text = json_text(manifest.model_dump(mode="json"))
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def read_manifest(folder: Path) -> Manifest:
    """Read `region.json`.

    Raises
    ------
    StoreError
        If the folder holds no region, one of another schema, or a damaged manifest.

    Examples
    --------
    >>> read_manifest(Path("nowhere"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: nowhere holds no region.json: build the region first
    """
    path = folder / MANIFEST
    if not path.is_file():
        message = f"{folder} holds no {MANIFEST}: build the region first"
        raise StoreError(message)
    content = read_json(path, mend=_MEND)
    found = content.get("schema_version") if isinstance(content, dict) else None
    if found != SCHEMA_VERSION:
        message = f"{path} has schema version {found!r}, this version reads {SCHEMA_VERSION}: {_MEND}"
        raise StoreError(message)
    try:
        manifest = check_document(content, Manifest, source=MANIFEST)
        _ = manifest.grid, shapely.from_wkt(manifest.coverage.wkt), CRS.from_epsg(manifest.epsg)
    except (ConfigError, GridError, CRSError, shapely.errors.ShapelyError) as error:
        message = f"{path} is damaged ({str(error)[:200]}): {_MEND}"
        raise StoreError(message) from error
    lost = [name for name in (LAYERS, FEATURES, NODES, EDGES) if name not in manifest.files]
    if lost:
        message = f"{path} is damaged (its files lack {lost[0]}): build the region again"
        raise StoreError(message)
    return manifest


def read_region(folder: Path) -> Region:
    """Read a region whole.

    Raises
    ------
    StoreError
        If a file is missing or cannot be read.
    """
    manifest = read_manifest(folder)
    for name in (LAYERS, FEATURES, NODES, EDGES):
        _check_file(folder / name, manifest.files[name])
    return Region(
        manifest=manifest,
        layers=read_layers(folder / LAYERS),
        features=check_features(_read_geometry(folder / FEATURES)),
        graph=MapGraph(nodes=_read_geometry(folder / NODES), edges=read_frame(folder / EDGES, mend=_MEND)),
        coverage=shapely.from_wkt(manifest.coverage.wkt),
    )


def read_features(folder: Path) -> gpd.GeoDataFrame:
    """Read a region's features alone.

    Raises
    ------
    StoreError
        If the folder holds no region, or the file cannot be read.
    """
    manifest = read_manifest(folder)
    _check_file(folder / FEATURES, manifest.files[FEATURES])
    return check_features(_read_geometry(folder / FEATURES))


def check_files(folder: Path) -> None:
    """Refuse a region of which a file is missing, or not what `region.json` says.

    Raises
    ------
    StoreError
        Naming the first such file.

    Examples
    --------
    >>> check_files(Path("nowhere"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: nowhere holds no region.json: build the region first
    """
    for name, said in read_manifest(folder).files.items():
        _check_file(folder / name, said)


def _check_file(path: Path, said: FileRecord) -> None:
    """Refuse a file that is not what the manifest says: nothing else covers a raster, or the footer of a GeoParquet."""
    if not path.is_file() or file_record(path) != said:
        message = f"{path} is missing, or not what {MANIFEST} says: {_MEND}"
        raise StoreError(message)


def _read_geometry(path: Path) -> gpd.GeoDataFrame:
    """A table of geometry, after its size was looked at."""
    with open_table(path, mend=_MEND, most_rows=MOST_VALUES):
        pass
    try:
        return gpd.read_parquet(path, **VERIFIED)
    except (
        *(OSError, ValueError, KeyError, TypeError, AttributeError),
        *(pa.ArrowException, CRSError, shapely.errors.ShapelyError),
    ) as error:
        message = f"{path} cannot be read ({str(error)[:200]}): {_MEND}"
        raise StoreError(message) from error


def differing_files(folder: Path) -> list[str]:
    """Compare every file of a region with its manifest; a line for each that is missing, changed or unknown."""
    manifest = read_manifest(folder)
    found = []
    for name, record in manifest.files.items():
        path = folder / name
        if not path.is_file():
            found.append(f"{name}: missing")
        elif path.stat().st_size != record.bytes:
            found.append(f"{name}: {path.stat().st_size} bytes, the manifest says {record.bytes}")
        elif sha256_of(path) != record.sha256:
            found.append(f"{name}: SHA-256 is {sha256_of(path)}, the manifest says {record.sha256}")
    known = {MANIFEST, *manifest.files}
    found += [f"{path.name}: not in the manifest" for path in sorted(folder.iterdir()) if path.name not in known]
    return found


@contextmanager
def locked(folder: Path, *, tell: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of a region, or of something else that is written; a second run says so and waits.

    Raises
    ------
    StoreError
        If there is no right or no room for a lock.
    """
    lock = FileLock(folder.parent / f".{folder.name}.lock")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            tell(f"{folder} is being written by another run, waiting for it")
            lock.acquire()
    except OSError as error:
        message = f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        raise StoreError(message) from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def fresh_folder(target: Path) -> Iterator[Path]:
    """Yield an empty folder beside `target` that takes its place when the block ends well, and goes when it does not.

    Call it under `locked`: leftovers of a build that was killed are cleared first.
    """
    scratch = target.parent / f".{target.name}.partial"
    replaced = target.parent / f".{target.name}.replaced"
    if replaced.exists() and not target.exists():
        replaced.rename(target)  # killed between the two renames below: the old region is still whole
    for leftover in (scratch, replaced):
        _clear(leftover)
    scratch.mkdir(parents=True)
    try:
        yield scratch
        for path in scratch.rglob("*"):
            _flush(path)
        if os.path.lexists(target):  # a link that leads nowhere stands in the way too
            target.rename(replaced)
        scratch.rename(target)
    finally:
        _clear(scratch)
        _clear(replaced)


def _clear(path: Path) -> None:
    """Remove a folder, or a file or link where a folder was expected; what a link leads to stays."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    else:
        remove_tree(path)


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it, whatever a plugin has made there; nothing is raised, no link is followed.

    It goes down and up again folder by folder, with one of them open at a time: neither depth nor long names nor rights
    that were taken away stop it. What the system refuses to remove stays.

    Parameters
    ----------
    folder : Path
        To remove; it need not be there.

    Examples
    --------
    >>> remove_tree(Path("nowhere"))
    """
    with suppress(OSError):
        here = _opened(str(folder), None)
        try:
            above: list[_Above] = []
            left = os.listdir(here)  # noqa: PTH208 - no path is short enough
            while left or above:
                if not left:
                    name, left, known = above.pop()
                    here = _instead(here, os.open("..", os.O_RDONLY | os.O_DIRECTORY, dir_fd=here))
                    if not os.path.samestat(os.fstat(here), known):
                        return  # moved meanwhile: whatever lies here is none of it
                    with suppress(OSError):
                        os.rmdir(name, dir_fd=here)
                elif (below := _unlinked(left[-1], here)) is None:
                    left.pop()
                else:
                    above.append(_Above(left.pop(), left, os.fstat(here)))
                    here, left = _instead(here, below), os.listdir(below)  # noqa: PTH208
        finally:
            os.close(here)
        folder.rmdir()


class _Above(NamedTuple):
    """A folder that is being emptied: what was gone into, what else is left there, and which folder it is."""

    name: str
    left: list[str]
    known: os.stat_result


def _instead(old: int, new: int) -> int:
    os.close(old)
    return new


def _unlinked(name: str, beside: int) -> int | None:
    """Remove a file or link; a folder is opened instead, if it can be."""
    with suppress(OSError):
        os.unlink(name, dir_fd=beside)
        return None
    with suppress(OSError):
        return _opened(name, beside)
    return None


def _opened(name: str, beside: int | None) -> int:
    """A folder to work in, all rights given to its owner; no link is followed."""
    flags = os.O_DIRECTORY | os.O_NOFOLLOW
    if hasattr(os, "O_PATH"):  # opens without the right to read, so that this folder and no other gets its rights
        known = os.open(name, flags | os.O_PATH, dir_fd=beside)
        try:
            with suppress(OSError):
                Path(f"/proc/self/fd/{known}").chmod(0o700)
        finally:
            os.close(known)
    return os.open(name, flags | os.O_RDONLY, dir_fd=beside)


def _flush(path: Path) -> None:
    """Force a file to the disk before the folder gets its name."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
