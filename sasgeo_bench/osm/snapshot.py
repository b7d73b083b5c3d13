# SPDX-License-Identifier: Apache-2.0
"""Prepare an OSM file for reading: readable, sorted, and with one state of the world."""

import datetime as dt
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import osmium
from numpy.typing import NDArray

from sasgeo_bench.errors import ExtractError

SUFFIXES: Final = (".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osh.pbf", ".osh", ".osh.gz", ".osh.bz2")
_HISTORY_SUFFIXES: Final = tuple(suffix for suffix in SUFFIXES if suffix.startswith(".osh"))
_PBF_MARK: Final = b"\n\tOSMHeader"  # after four bytes of length
_MOST_QUOTED: Final = 200  # characters of an error of osmium, which quotes a value of any length
_GZIP_MARK: Final = b"\x1f\x8b"
_BZIP2_MARK: Final = b"BZh"
OBJECTS: Final = osmium.osm.NODE | osmium.osm.WAY | osmium.osm.RELATION  # changesets have no versions
_RANK: Final = {"n": 0, "w": 1, "r": 2, "c": 3}  # nodes, ways, relations, changesets


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """A readable OSM file that is sorted and holds one state of the world.

    `box_lonlat` is the box of the file's header (west, south, east, north) or None; `replicated_at` its date or None.
    """

    path: Path
    box_lonlat: tuple[float, float, float, float] | None
    replicated_at: dt.datetime | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """Box (west, south, east, north, degrees) and date of a file's header; each may be None."""

    box_lonlat: tuple[float, float, float, float] | None
    replicated_at: dt.datetime | None


def read_header(path: Path) -> Header:
    """Read the header of an extract and no more; raise `ExtractError` as `open_snapshot` does."""
    _check_file(path)
    with _readable(path), TemporaryDirectory(prefix="sasgeo-") as scratch:
        content = _as_its_content(path, Path(scratch))
        header = _header_of(content)
        return Header(box_lonlat=_header_box(header), replicated_at=_header_time(header))


@contextmanager
def open_snapshot(path: Path, *, at: dt.date | None = None) -> Iterator[Snapshot]:
    """Yield one extract ready to read: sort it if it is out of order, cut a full history at the end of a day (UTC).

    The yielded path may lie in a temporary folder that is removed when the context ends. Raise `ExtractError` if the
    file is missing, empty, damaged, of a format not in `SUFFIXES`, or a history without a date.

    >>> with open_snapshot(Path("nowhere.osm.pbf")):
    ...     pass
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.ExtractError: no extract at nowhere.osm.pbf: check the path
    """
    _check_file(path)
    with _readable(path), TemporaryDirectory(prefix="sasgeo-") as scratch:
        content = _as_its_content(path, Path(scratch))
        header = _header_of(content)
        box, replicated_at = _header_box(header), _header_time(header)
        is_sorted = header.get("sorting") == "Type_then_ID"
        warnings: list[str] = []
        current = content
        if is_history(path) or header.has_multiple_object_versions:
            if at is None:
                message = f"{path.name} is a full history: give the date to cut it at"
                raise ExtractError(message)
            current = Path(scratch) / "at-date.osm.pbf"
            _cut_history(content, current, at=at)
            replicated_at = None
        elif not is_sorted and not _in_order(content):
            warnings.append("elements were out of order and have been sorted ('osmium sort' does it for good)")
            current = Path(scratch) / "sorted.osm.pbf"
            _sort(content, current)
        yield Snapshot(path=current, box_lonlat=box, replicated_at=replicated_at, warnings=tuple(warnings))


def is_history(path: Path) -> bool:
    """Return whether a file name is that of a full history, with all versions of its objects."""
    return path.name.endswith(_HISTORY_SUFFIXES)


def _check_file(path: Path) -> None:
    if not path.is_file():
        message = f"no extract at {path}: check the path"
        raise ExtractError(message)
    if not path.name.endswith(SUFFIXES):
        message = f"{path.name} is of no known format: name it {', '.join(SUFFIXES[:6])}"
        raise ExtractError(message)
    if path.stat().st_size == 0:
        message = f"{path} is empty: copy or download it again"
        raise ExtractError(message)


def _as_its_content(path: Path, scratch: Path) -> Path:
    """Return the path, or a link to it with the suffix of its content: osmium goes by the name alone."""
    kind = "osh" if is_history(path) else "osm"
    with path.open("rb") as source:
        start = source.read(16)
    if start[4 : 4 + len(_PBF_MARK)] == _PBF_MARK:
        suffix = f".{kind}.pbf"
    elif start.startswith(_GZIP_MARK):
        suffix = f".{kind}.gz"
    elif start.startswith(_BZIP2_MARK):
        suffix = f".{kind}.bz2"
    elif start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        suffix = f".{kind}"
    else:
        message = f"{path} holds no OSM data: it begins with {start!r}; get the extract again"
        raise ExtractError(message)
    if path.name.endswith(suffix):
        return path
    link = scratch / f"extract{suffix}"
    link.symlink_to(path.resolve())
    return link


def elements(source: Iterable[Any]) -> Iterator[Any]:
    """Yield the elements that osmium reads; raise `RuntimeError` on whatever it refuses in the file.

    `open_snapshot` turns that error into an `ExtractError`.
    """
    with _one_type():
        yield from source


@contextmanager
def _one_type() -> Iterator[None]:
    """Turn the unrelated exceptions of osmium's C++ side into `RuntimeError`, its most common one."""
    try:
        yield
    except (osmium.InvalidLocationError, ValueError, IndexError, OverflowError) as error:
        raise RuntimeError(str(error)) from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, UnicodeDecodeError) as error:  # text is decoded only when it is read
        message = (
            f"{path} cannot be read as OSM data ({str(error)[:_MOST_QUOTED]}): it is damaged, cut short or no OSM "
            "file; get it again"
        )
        raise ExtractError(message) from error


def _header_of(path: Path) -> osmium.io.Header:
    with _one_type(), osmium.io.Reader(str(path), osmium.osm.NOTHING) as reader:
        return reader.header()


def _header_box(header: osmium.io.Header) -> tuple[float, float, float, float] | None:
    box = header.box()
    if not box.valid():
        return None
    low, high = box.bottom_left, box.top_right
    return (low.lon, low.lat, high.lon, high.lat)


def _header_time(header: osmium.io.Header) -> dt.datetime | None:
    text = header.get("osmosis_replication_timestamp") or header.get("timestamp")
    try:
        return dt.datetime.fromisoformat(text) if text else None
    except ValueError:
        return None


def _in_order(path: Path) -> bool:
    """Return whether elements come in osmium's order: nodes, ways, relations, each by id (negative first, by size)."""
    last = (-1, 0, 0)
    for item in elements(osmium.FileProcessor(str(path))):
        identifier = item.id
        key = (_RANK[item.type_str()], int(identifier > 0), abs(identifier))
        if key < last:
            return False
        last = key
    return True


def _sort(path: Path, target: Path) -> None:
    merger = osmium.MergeInputReader()
    with _one_type():
        merger.add_file(str(path))
    with osmium.SimpleWriter(str(target), overwrite=True) as writer, _one_type():
        merger.apply(writer, simplify=True)


def _cut_history(path: Path, target: Path, *, at: dt.date) -> None:
    """Write the state at the end of a day: the last version of each object by then, unless that one is deleted."""
    until = dt.datetime.combine(at, dt.time.max, tzinfo=dt.UTC)
    kept = _versions_at(path, until=until)
    with osmium.SimpleWriter(str(target), overwrite=True) as writer:
        position = 0
        for number, item in enumerate(elements(osmium.FileProcessor(str(path), OBJECTS))):
            if position < len(kept) and kept[position] == number:
                writer.add(item)
                position += 1


def _versions_at(path: Path, *, until: dt.datetime) -> NDArray[np.int64]:
    """Return positions in the file, ascending, of the versions alive at a time; versions may come in any order."""
    latest: dict[tuple[str, int], tuple[int, int, bool]] = {}
    for number, item in enumerate(elements(osmium.FileProcessor(str(path), OBJECTS))):
        if item.timestamp <= until:
            key, version = (item.type_str(), item.id), item.version
            if key not in latest or version >= latest[key][0]:
                latest[key] = (version, number, item.visible)
    return np.sort(np.array([number for _, number, is_visible in latest.values() if is_visible], dtype=np.int64))
