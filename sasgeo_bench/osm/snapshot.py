# SPDX-License-Identifier: Apache-2.0
"""Prepare an OSM file for reading: readable, sorted, and with one state of the world."""

import datetime as dt
from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copyfile, copyfileobj
from typing import Any, Final

import numpy as np
import osmium
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ExtractError, counted
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.osm.xml_text import NEW_IDS, Box, clean, has_several_streams, needs_cleaning, open_text, read_boxes

SUFFIXES: Final = (".osm.pbf", ".pbf", ".osm", ".osm.gz", ".osm.bz2", ".osh.pbf", ".osh", ".osh.gz", ".osh.bz2")
_HISTORY_SUFFIXES: Final = tuple(suffix for suffix in SUFFIXES if suffix.startswith(".osh"))
_CHANGE_SUFFIXES: Final = (".osc", ".osc.gz", ".osc.bz2", ".osc.pbf", ".o5c")
_OTHER_SUFFIXES: Final = (".o5m", ".opl", ".opl.gz", ".opl.bz2")
_PBF_MARK: Final = b"\n\tOSMHeader"  # after four bytes of length
_MOST_QUOTED: Final = 200  # characters of an error of osmium, which quotes a value of any length
_GZIP_MARK: Final = b"\x1f\x8b"
_BZIP2_MARK: Final = b"BZh"
_EPOCH: Final = dt.datetime(1970, 1, 2, tzinfo=dt.UTC)  # osmium returns 1970-01-01 for an object without a time
_MOST_FEATURES: Final = 16  # that a header lists; all known ones are four
_KINDS: Final = {"n": 0, "w": 1, "r": 2}
OBJECTS: Final = osmium.osm.NODE | osmium.osm.WAY | osmium.osm.RELATION  # changesets have no versions


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """A readable OSM file that is sorted and holds one state of the world.

    `boxes_lonlat` are the boxes of the file's header (west, south, east, north), most often one or none;
    `replicated_at` is its date or None.
    """

    path: Path
    boxes_lonlat: tuple[Box, ...]
    replicated_at: dt.datetime | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """Boxes (west, south, east, north, degrees) and date of a file's header; there may be none.

    `is_history` says that the file states to hold all versions of its objects; an XML file never does.
    """

    boxes_lonlat: tuple[Box, ...]
    replicated_at: dt.datetime | None
    is_history: bool = False


def read_header(path: Path) -> Header:
    """Read the header of an extract and no more; raise `ExtractError` as `open_snapshot` does."""
    _check_file(path)
    with _readable(path), scratch_folder("map") as scratch:
        content = _as_its_content(path, scratch)
        return _header(path, content)


def read_extent(path: Path) -> Header:
    """Read all objects of an extract for what its header may lack: the box of its nodes and its newest time.

    Of a full history all versions count. Raise `ExtractError` as `open_snapshot` does.
    """
    _check_file(path)
    with _readable(path), scratch_folder("map") as scratch:
        content = _as_its_content(path, scratch)
        places, newest = array("d"), _EPOCH
        for item in elements(osmium.FileProcessor(str(content), OBJECTS)):
            newest = max(newest, item.timestamp)
            if item.is_node() and item.location.valid():
                places.extend((item.lon, item.lat))
    lonlat = np.array(places, dtype=np.float64).reshape(-1, 2)
    box = (*lonlat.min(axis=0).tolist(), *lonlat.max(axis=0).tolist()) if len(lonlat) else None
    return Header(boxes_lonlat=(box,) if box else (), replicated_at=newest if newest > _EPOCH else None)


@contextmanager
def open_snapshot(path: Path, *, at: dt.date | None = None) -> Iterator[Snapshot]:
    """Yield one extract ready to read: sorted, each object once, with its nodes, and as of one day.

    A full history is cut at the end of the day `at` (UTC); of a file that is none, `at` is not used. Objects that an
    editor or the server has deleted are left out; of several versions of an object the newest is taken; ids that are
    negative, since an object was not uploaded yet, lie above `NEW_IDS`. Where ways carry the places of their nodes,
    these become nodes.

    The yielded path may lie in a temporary folder that is removed when the context ends. Raise `ExtractError` if the
    file is missing, empty, damaged, of a format not in `SUFFIXES`, or a history without a date.

    >>> with open_snapshot(Path("nowhere.osm.pbf")):
    ...     pass
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ExtractError: no extract at nowhere.osm.pbf: check the path
    """
    _check_file(path)
    with _readable(path), scratch_folder("map") as scratch:
        content = _as_its_content(path, scratch)
        stated = _header(path, content)
        survey = _survey(content)
        is_past, is_named = survey.is_history(path), path.name.endswith(_HISTORY_SUFFIXES)
        if is_past and at is None and (survey.is_flagged or is_named):
            raise ExtractError(f"{path.name} is a full history: give the date to cut it at")
        current, warnings = content, []
        if survey.repeated and not is_named:
            taken = "the newest was taken" if at is None else f"that of {at} was taken"
            warnings.append(f"{counted(survey.repeated, 'object')} stood there in more than one version: {taken}")
        elif is_named and not is_past:
            warnings.append("it is named like a full history, and holds one version of each object: read as it stands")
        if is_past or survey.repeated or survey.deleted:
            current = scratch / "at-date.osm.pbf"
            survey = _cut_history(content, current, at=at if is_past else None)
        _check_ids(path, survey, at=at if is_past else None)
        if survey.has_negative or survey.has_places:
            source, current = current, scratch / "plain.osm.pbf"
            _write_plain(source, current)
        if not survey.is_sorted:
            warnings.append("elements were out of order and have been sorted ('osmium sort' does it for good)")
        if not survey.is_sorted or current.name == "plain.osm.pbf":
            source, current = current, scratch / "sorted.osm.pbf"
            merger = osmium.MergeInputReader()
            with _one_type():
                merger.add_file(str(source))
            with osmium.SimpleWriter(str(current), overwrite=True) as writer, _one_type():
                merger.apply(writer, simplify=True)
        yield Snapshot(
            path=current,
            boxes_lonlat=stated.boxes_lonlat,
            replicated_at=None if is_past else stated.replicated_at,
            warnings=tuple(warnings),
        )


def _check_ids(path: Path, survey: "_Survey", *, at: dt.date | None) -> None:
    """Refuse a history that begins after the day `at`, and ids of objects beyond those of OpenStreetMap."""
    if at is not None and survey.largest_id == 0:
        raise ExtractError(f"{path.name} holds nothing of {at} or before: choose a later date")
    if survey.largest_id >= NEW_IDS:
        raise ExtractError(
            f"{path.name} has ids of up to {survey.largest_id}, OpenStreetMap of 12 digits: use osmium renumber"
        )


def is_history(path: Path) -> bool:
    """Return whether a file is a full history, with all versions of its objects; its name does not count.

    A PBF file says so in its header. XML does not: it is one if it holds several versions of an object, or is named
    as one and holds deleted objects. Raise `ExtractError` as `open_snapshot` does.
    """
    _check_file(path)
    with _readable(path), scratch_folder("map") as scratch:
        content = _as_its_content(path, scratch)
        return (
            _survey(content).is_history(path) if _is_xml(content) else _header_of(content).has_multiple_object_versions
        )


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise ExtractError(f"no extract at {path}: check the path")
    if path.name.endswith(_CHANGE_SUFFIXES):
        raise ExtractError(
            f"{path.name} is a change file: give the extract, with the changes applied (osmium apply-changes)"
        )
    if path.name.endswith(_OTHER_SUFFIXES):
        raise ExtractError(
            f"{path.name} is not read in its format: convert it (osmium cat {path.name} -o NAME.osm.pbf)"
        )
    if path.name.endswith((".json", ".geojson")):
        raise ExtractError(
            f"{path.name} is not read as an OSM file: say format = 'geojson' of a GeoJSON extract in its region file"
        )
    if not path.name.endswith(SUFFIXES):
        raise ExtractError(f"{path.name} is of no known format: unpack or convert it to {', '.join(SUFFIXES[:6])}")
    if path.stat().st_size == 0:
        raise ExtractError(f"{path} is empty: copy or download it again")


def _as_its_content(path: Path, scratch: Path) -> Path:
    """Return the path, a link to it with the suffix of its content (osmium goes by the name alone), or clean XML."""
    with plain_file(path).open("rb") as source:
        start = source.read(16)
    if start[4 : 4 + len(_PBF_MARK)] == _PBF_MARK:
        suffix = ".osm.pbf"
    elif start.startswith(_GZIP_MARK):
        suffix = ".osm.gz"
    elif start.startswith(_BZIP2_MARK):
        suffix = ".osm.bz2"
    elif start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        suffix = ".osm"
    else:
        raise ExtractError(f"{path} holds no OSM data: it begins with {start!r}; get the extract again")
    if suffix != ".osm.pbf" and needs_cleaning(path):
        clean(path, scratch / "clean.osm")
        return scratch / "clean.osm"
    if suffix == ".osm.bz2" and has_several_streams(path):
        with open_text(path) as source, (scratch / "unpacked.osm").open("wb") as target:
            copyfileobj(source, target)
        return scratch / "unpacked.osm"
    if path.name.endswith(suffix):
        return path
    link = scratch / f"extract{suffix}"
    with suppress(OSError):  # Windows asks for a right that few users have
        link.symlink_to(path.resolve())
        return link
    copyfile(path, link)
    return link


def _is_xml(content: Path) -> bool:
    return not content.name.endswith(".pbf")


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
        raise ExtractError(
            f"{path} cannot be read as OSM data ({str(error)[:_MOST_QUOTED]}): it is damaged, cut short or no OSM "
            "file; get it again"
        ) from error


def _header_of(path: Path) -> osmium.io.Header:
    with _one_type(), osmium.io.Reader(str(path), osmium.osm.NOTHING) as reader:
        return reader.header()


def _header(path: Path, content: Path) -> Header:
    header = _header_of(content)
    if _is_xml(content) and header.has_multiple_object_versions:
        raise ExtractError(
            f"{path.name} holds changes: give the extract, with the changes applied (osmium apply-changes)"
        )
    boxes = read_boxes(path) if _is_xml(content) else _header_boxes(header)  # osmium gives the first of several alone
    return Header(
        boxes_lonlat=boxes,
        replicated_at=_header_time(header),
        is_history=header.has_multiple_object_versions,
    )


def _header_boxes(header: osmium.io.Header) -> tuple[Box, ...]:
    box = header.box()
    if not box.valid():
        return ()
    low, high = box.bottom_left, box.top_right
    return ((low.lon, low.lat, high.lon, high.lat),)


def _header_time(header: osmium.io.Header) -> dt.datetime | None:
    text = header.get("osmosis_replication_timestamp") or header.get("timestamp")
    try:
        return dt.datetime.fromisoformat(text) if text else None
    except ValueError:
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Survey:
    """What the objects of a file are like.

    `repeated` counts objects that stand there again, `deleted` those that are not visible; `has_places`: ways carry
    the places of their nodes. A file flagged as a history is not looked at before it is cut.
    """

    is_flagged: bool
    is_sorted: bool = True
    has_versions: bool = False
    has_negative: bool = False
    largest_id: int = 0
    has_places: bool = False
    repeated: int = 0
    deleted: int = 0

    def is_history(self, path: Path) -> bool:
        """Return whether the file holds the past of its objects, and not only two copies of some."""
        is_named = path.name.endswith(_HISTORY_SUFFIXES)
        return self.is_flagged or self.has_versions or (is_named and self.deleted > 0)


@dataclass(slots=True, kw_only=True)
class _Found:
    """Objects in the order of a file: type (0 node, 1 way, 2 relation, osmium's order), id and version."""

    kinds: "array[int]" = field(default_factory=lambda: array("q"))
    ids: "array[int]" = field(default_factory=lambda: array("q"))
    versions: "array[int]" = field(default_factory=lambda: array("q"))

    def add(self, item: Any, version: int) -> None:  # noqa: ANN401 - an object of osmium
        self.kinds.append(_KINDS[item.type_str()])
        self.ids.append(item.id)
        self.versions.append(version)

    def survey(self, *, deleted: int = 0, has_places: bool) -> _Survey:
        number, kind = np.array(self.ids, dtype=np.int64), np.array(self.kinds, dtype=np.int64)
        # osmium's order: by type, negative ids first, then by the size of the id.
        keys = np.column_stack((kind, number > 0, np.abs(number)))
        order = np.lexsort(keys.T[::-1])
        is_again = (keys[order][1:] == keys[order][:-1]).all(axis=1)
        version = np.array(self.versions, dtype=np.int64)[order]
        return _Survey(
            is_flagged=False,
            is_sorted=bool((order == np.arange(len(order))).all()),
            has_versions=bool((is_again & (version[1:] != version[:-1])).any()),
            has_negative=bool((number < 0).any()),
            largest_id=max(-int(number.min()), int(number.max())) if len(number) else 0,
            has_places=has_places,
            repeated=int(is_again.sum()),
            deleted=deleted,
        )


def _survey(path: Path) -> _Survey:
    """Look at all objects once; at no nodes of a file that is sorted by its header: they are many."""
    header = _header_of(path)
    if header.has_multiple_object_versions:
        return _Survey(is_flagged=True)
    found, deleted, has_places = _Found(), 0, False
    may_have_places = _may_have_places(path, header)
    wanted = osmium.osm.WAY | osmium.osm.RELATION if header.get("sorting") == "Type_then_ID" else OBJECTS
    for item in elements(osmium.FileProcessor(str(path), wanted)):
        found.add(item, item.version)
        deleted += not item.visible
        has_places = has_places or (may_have_places and _has_places(item))
    return found.survey(deleted=deleted, has_places=has_places)


def _may_have_places(path: Path, header: osmium.io.Header) -> bool:
    """Return whether ways may carry the places of their nodes: to look at all of them takes longer than all else."""
    features = {header.get(f"pbf_optional_feature_{number}") for number in range(_MOST_FEATURES)}
    return _is_xml(path) or "LocationsOnWays" in features


def _has_places(item: Any) -> bool:  # noqa: ANN401 - an object of osmium
    return item.is_way() and any(node.location.valid() for node in item.nodes)


def _cut_history(path: Path, target: Path, *, at: dt.date | None) -> _Survey:
    """Write the last version of each object by the end of a day, or of all times, unless that one is deleted."""
    until = dt.datetime.combine(at or dt.date.max, dt.time.max, tzinfo=dt.UTC)
    kept = iter(_versions_at(path, until=until).tolist())
    found, has_places, may_have_places = _Found(), False, _may_have_places(path, _header_of(path))
    # File to write to that keeps the places of nodes on ways, where there are any
    with osmium.SimpleWriter(osmium.io.File(str(target), "pbf,locations_on_ways=true"), overwrite=True) as writer:
        following = next(kept, None)
        for number, item in enumerate(elements(osmium.FileProcessor(str(path), OBJECTS))):
            if number == following:
                writer.add(item)
                found.add(item, 0)  # one version of each
                has_places = has_places or (may_have_places and _has_places(item))
                following = next(kept, None)
    return found.survey(has_places=has_places)


def _write_plain(path: Path, target: Path) -> None:
    """Write objects with positive ids, and a node for each place that a way carries and no node of the file has."""
    refs, places = array("q"), array("d")
    there = array("q")
    with osmium.SimpleWriter(str(target), overwrite=True) as writer:
        for item in elements(osmium.FileProcessor(str(path), OBJECTS)):
            if item.is_node():
                there.append(item.id)
                writer.add(item.replace(id=_positive(item.id)))
            elif item.is_way():
                for node in item.nodes:
                    if node.location.valid():
                        refs.append(node.ref)
                        places.extend((node.lon, node.lat))
                nodes = [_positive(node.ref) for node in item.nodes]
                writer.add(item.replace(id=_positive(item.id), nodes=nodes))
            else:
                members = [(member.type, _positive(member.ref), member.role) for member in item.members]
                writer.add(item.replace(id=_positive(item.id), members=members))
        lonlat = np.array(places, dtype=np.float64).reshape(-1, 2)
        found, first = np.unique(np.array(refs, dtype=np.int64), return_index=True)
        is_lost = ~np.isin(found, np.array(there, dtype=np.int64))
        for ref, place in zip(found[is_lost].tolist(), lonlat[first[is_lost]].tolist(), strict=True):
            writer.add_node(osmium.osm.mutable.Node(id=_positive(ref), location=tuple(place)))


def own_id(identifier: int) -> int:
    """Return the id of an object as its file has it: negative if it has none of OpenStreetMap yet.

    >>> own_id(42), own_id(NEW_IDS + 42)
    (42, -42)
    """
    return NEW_IDS - identifier if identifier > NEW_IDS else identifier


def _positive(identifier: int) -> int:
    """Return the id, or the number above `NEW_IDS` of an object that has none yet."""
    return identifier if identifier >= 0 else NEW_IDS - identifier


def _versions_at(path: Path, *, until: dt.datetime) -> NDArray[np.int64]:
    """Return positions in the file, ascending, of the versions alive at a time; versions may come in any order."""
    found, numbers, alive = _Found(), array("q"), bytearray()
    for number, item in enumerate(elements(osmium.FileProcessor(str(path), OBJECTS))):
        if item.timestamp <= until:
            found.add(item, item.version)
            numbers.append(number)
            alive.append(item.visible)
    # Of an object the newest version, of equal ones that which stands last, sorts last
    kind, identifier, version, position = (
        np.array(each, dtype=np.int64) for each in (found.kinds, found.ids, found.versions, numbers)
    )
    order = np.lexsort((position, version, identifier, kind))
    is_newest = np.ones(len(order), dtype=bool)
    is_newest[:-1] = (np.diff(kind[order]) != 0) | (np.diff(identifier[order]) != 0)
    newest = order[is_newest]
    return np.sort(position[newest[np.frombuffer(alive, dtype=np.bool_)[newest]]])
